"""One erratum of Wedig (2020) in numbers, and how the numbers are calculated from the paper's own equations."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

from .euler_maruyama import Estimate

KINDS = {
    "slip": "Slips",
    "consequence": "The slip of (20)-(23) again, and what follows from it",
    "wording": "Statements whose wording is off",
    "scan": "Hard to read in the scan, not counted as slips",
}
SIMULATION, CALCULATION = "simulation", "calculation"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Check:
    """A number on which the print and the derivation disagree.

    Attributes:
        name: of the entry, as in ERRATA.md.
        kind: one of `KINDS`; a "consequence" is no error of its own, and of a "scan" the paper may be innocent.
        equation: where it is, by the paper's numbers.
        quantity: what is measured, with its parameters; natural frequency and amplitude of the road are 1.
        printed: by the paper.
        right: by the derivation.
        evidence: "simulation" of the original equations, or "calculation" from the paper's own.
        found: by the evidence. Simulated, it is free of the first-order bias of the time step; calculated, it has no standard
            error, 0.
    """

    name: str
    kind: str
    equation: str
    quantity: str
    printed: float
    right: float
    evidence: str
    found: Estimate

    def agrees(self, value: float) -> bool:
        """Does the evidence allow this value: within four standard errors, or to rounding where it is calculated?"""
        if self.evidence == SIMULATION:
            return abs(self.found.distance(value)) < 4
        return math.isclose(self.found.value, value, rel_tol=1e-5)

    def off(self, value: float) -> str:
        """How far the evidence is from a value, in standard errors; calculated, whether it agrees."""
        if self.evidence == SIMULATION:
            distance = self.found.distance(value)
            return f"{distance:.1f}" if abs(distance) < 1000 else f"{distance:.0f}"
        return "agrees" if self.agrees(value) else "differs"

    def found_text(self) -> str:
        """What the evidence found, with its standard error if it has one."""
        error = f" ± {self.found.standard_error:.2g}" if self.evidence == SIMULATION else ""
        return f"{self.found.value:.5g}{error}"


def calculated(value: float) -> Estimate:
    """What a calculation found: it has no standard error."""
    return Estimate(value=value, standard_error=0.0)


def mean_rate(after: Callable[[float, float], float]) -> float:
    """Mean rate of change of a quantity ``after(dt, dW)`` a step of its equations.

    The mean over dW = +-dt^(1/2) is right to first order in dt; a step half as long takes the next order off.
    """

    def rate(step: float) -> float:
        root = math.sqrt(step)
        return ((after(step, root) + after(step, -root)) / 2 - after(0.0, 0.0)) / step

    return 2 * rate(5e-5) - rate(1e-4)
