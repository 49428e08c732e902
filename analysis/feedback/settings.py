"""What every search for a feedback is told, and when its tables are fine enough."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Protocol

COMPARED = 0.005  # relative standard error of the costs, over common noise, by which grids are compared
TRUSTED = 4.0  # times the tolerance by which the cost that a table expects may differ from the driven one

Told = Callable[[float], None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """See `analysis.optimal_feedback`."""

    tolerance: float
    precision: float
    refinements: int
    seed: int
    threads: int

    def share_of(self, level: int, told: Told) -> Callable[[float, float], Told]:
        """Of a level of refinement: what tells of a part of it, from a share of it on and of a width."""
        return lambda begin, width: lambda done: told((level + begin + width * done) / (self.refinements + 1))


class Refined(Protocol):
    """One table and its feedback: the average cost that the table expects, the driven one, and that one's standard error."""

    @property
    def expected(self) -> float: ...  # noqa: D102
    @property
    def cost(self) -> float: ...  # noqa: D102
    @property
    def standard_error(self) -> float: ...  # noqa: D102


def is_refined(coarse: Refined, fine: Refined, tolerance: float) -> bool:
    """Has the driven cost settled, and does the table know it?"""
    trusted = abs(fine.expected - fine.cost) <= TRUSTED * tolerance * fine.cost + 2 * fine.standard_error
    return trusted and abs(fine.cost - coarse.cost) <= tolerance * fine.cost
