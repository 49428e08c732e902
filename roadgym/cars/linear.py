"""Cars that are their matrices, of up to four states: a `roadgym.linear.Motion` in, an exact car out.

Between two settings of D the states q obey dq/dt = A(D) q + b Z + e(D) dZ/dt, and a car that stands on the road rises with it:
where the level and all heights rise by the same, nothing else happens. So with w, 1 for each height and 0 for each velocity,
the heights above the road p = q - w Z obey

    dp/dt = A(D) p + (e(D) - w) dZ/dt.

Over a substep h the level is taken as the straight line between its ends, raised by its mean excess m over that line, as by the
car of one mass (`roadgym.cars.one_mass`), so that the forces on the car have the right integral and first moment:

    p(h) = Phi p(0) + (1/h) integral of Phi (e - w) (Z1 - Z0) + (Phi - I) (e - w) m,    Phi(D, h) = exp(h A(D)).

All three factors are entire functions of D: at the beginning of an interval they come from their Chebyshev series over the
range of D, whose last terms are below rounding.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

from ..compiled import DAMPING, LANES, LEVEL, LEVEL_EXCESS, WORK, LaneFunction, like
from ..linear import FloatArray, Motion
from ..parameters import ParameterError
from .base import Car

STATES = 4  # at most
DEGREE = 12  # in D; with h D times the damper's own rate below 2, the series' rest is below 1e-10
NODES = np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))  # of its Chebyshev series, over [-1, 1]
FACTORS = STATES * STATES + 2 * STATES  # Phi row by row, then those of the climb and of the excess

PREVIOUS_LEVEL = WORK
FACTOR = PREVIOUS_LEVEL + LANES

# the table: middle and inverse half width of the range of D, w, then the coefficients of the factors, the highest power first
HEIGHTS, SERIES = 2, 2 + STATES


@LaneFunction
def prepare(lanes: Any, car: Any, work: Any, table: Any) -> None:
    """The factors of a substep at the damping of each lane, by Horner's rule."""
    middle, inverse = table[0], table[1]
    for k in range(FACTORS):
        row = FACTOR + k * LANES
        for i in range(LANES):
            work[row + i] = table[SERIES + k * (DEGREE + 1)]
        for n in range(1, DEGREE + 1):
            coefficient = table[SERIES + k * (DEGREE + 1) + n]
            for i in range(LANES):
                work[row + i] = work[row + i] * ((work[DAMPING + i] - middle) * inverse) + coefficient
    for i in range(LANES):
        work[PREVIOUS_LEVEL + i] = lanes[LEVEL + i]


@LaneFunction
def advance(lanes: Any, car: Any, work: Any, table: Any) -> None:
    """One substep."""
    w0, w1, w2, w3 = table[HEIGHTS], table[HEIGHTS + 1], table[HEIGHTS + 2], table[HEIGHTS + 3]
    zero = like(lanes, 0.0)
    for i in range(LANES):
        old, z, excess = work[PREVIOUS_LEVEL + i], lanes[LEVEL + i], lanes[LEVEL_EXCESS + i]
        climb = z - old
        p0, p1 = car[i] - w0 * old, car[LANES + i] - w1 * old
        p2, p3 = car[2 * LANES + i] - w2 * old, car[3 * LANES + i] - w3 * old
        f = FACTOR + i
        car[i] = zero + (work[f] * p0 + work[f + LANES] * p1) + (work[f + 2 * LANES] * p2 + work[f + 3 * LANES] * p3)
        f += 4 * LANES
        car[LANES + i] = (work[f] * p0 + work[f + LANES] * p1) + (work[f + 2 * LANES] * p2 + work[f + 3 * LANES] * p3)
        f += 4 * LANES
        car[2 * LANES + i] = (work[f] * p0 + work[f + LANES] * p1) + (work[f + 2 * LANES] * p2 + work[f + 3 * LANES] * p3)
        f += 4 * LANES
        car[3 * LANES + i] = (work[f] * p0 + work[f + LANES] * p1) + (work[f + 2 * LANES] * p2 + work[f + 3 * LANES] * p3)
        f += 4 * LANES
        car[i] += work[f] * climb + work[f + 4 * LANES] * excess + w0 * z
        car[LANES + i] += work[f + LANES] * climb + work[f + 5 * LANES] * excess + w1 * z
        car[2 * LANES + i] += work[f + 2 * LANES] * climb + work[f + 6 * LANES] * excess + w2 * z
        car[3 * LANES + i] += work[f + 3 * LANES] * climb + work[f + 7 * LANES] * excess + w3 * z
        work[PREVIOUS_LEVEL + i] = z


@dataclasses.dataclass(frozen=True, kw_only=True)
class LinearCar(Car):
    """A car whose `motion`, of four states at most, is all that there is; nothing is compiled for it.

    It must rise with the road as a whole: `table` raises `ParameterError` where it does not.
    """

    is_its_motion: ClassVar[bool] = True
    rows = STATES
    working_rows = 1 + FACTORS
    prepare = prepare
    advance = advance

    def table(self, substep: float, damping: tuple[float, float]) -> FloatArray:
        """Heights, and the Chebyshev series of the factors as polynomials in D over its range."""
        from scipy.linalg import expm

        if (self.rows, self.working_rows, self.squared) != (STATES, LinearCar.working_rows, 0):
            raise ParameterError(f"rows, working_rows and squared of a {self.kind} car are those of LinearCar")
        motion, (low, high) = self.motion.own, damping
        check_rises(motion, self.kind)
        factors = factors_at_nodes(motion, substep, damping, lambda blocks: np.array([expm(block) for block in blocks]))
        powers = (np.polynomial.chebyshev.chebfit(NODES, factors, DEGREE).T @ chebyshev_powers())[:, ::-1]
        follows = np.zeros(STATES)
        follows[: len(motion.states)] = motion.follows
        return np.concatenate([[(low + high) / 2, 1 / max((high - low) / 2, 1e-9)], follows, powers.ravel()])


def check_rises(motion: Motion, kind: str) -> None:
    """Raise `ParameterError` for a car of a ``kind`` with too many states, or that does not rise with the road."""
    size = len(motion.states)
    if size > STATES:
        raise ParameterError(f"a {kind} car must have {STATES} states at most, got {', '.join(motion.states)}")
    heights, relative = motion.follows, motion.rows[list(motion.signals).index(motion.relative)]
    forces = np.column_stack([np.vstack([motion.drift, relative[:size]]) * heights, [*motion.level_entry, relative[size]]])
    if np.any(np.abs(forces.sum(axis=1)) > 1e-9 * np.abs(forces).sum(axis=1)):  # beyond what rounding leaves
        raise ParameterError(f"a {kind} car must rise with the road: drift follows + level_entry must be zero")


def factors_at_nodes(
    motion: Motion, substep: float, damping: tuple[float, float], exponentials: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    """The factors of a substep at the nodes of their Chebyshev series over the range of D, shape (DEGREE + 1, FACTORS).

    Args:
        motion: the equations, without filters.
        substep: in units of 1/w1.
        damping: smallest and largest D that is met.
        exponentials: of matrices, shape (nodes, n, n).
    """
    size, (low, high) = len(motion.states), damping
    relative = motion.rows[list(motion.signals).index(motion.relative)]
    middle, half = (low + high) / 2, max((high - low) / 2, 1e-9)
    blocks, damper = np.zeros((DEGREE + 1, size + 1, size + 1)), motion.damper
    for node, block in zip(NODES.tolist(), blocks, strict=True):
        twice = 2 * (middle + half * node)
        block[:size, size] = motion.slope_entry - twice * relative[size + 1] * motion.force_entry - motion.follows
        block[:size, :size] = motion.drift + twice * damper
    factors = np.zeros((DEGREE + 1, FACTORS))
    for row, block, exponential in zip(factors, blocks, exponentials(blocks * substep), strict=True):
        phi = np.zeros((STATES, STATES))
        phi[:size, :size] = exponential[:size, :size]
        climb, excess = np.zeros(STATES), np.zeros(STATES)
        climb[:size] = exponential[:size, size] / substep
        excess[:size] = (phi[:size, :size] - np.eye(size)) @ block[:size, size]
        row[:] = np.concatenate([phi.ravel(), climb, excess])
    return factors


@functools.cache
def chebyshev_powers() -> FloatArray:
    """Chebyshev's polynomials in powers, the lowest first, shape (DEGREE + 1, DEGREE + 1)."""
    basis = np.zeros((DEGREE + 1, DEGREE + 1))
    for k in range(DEGREE + 1):
        basis[k, : k + 1] = np.polynomial.chebyshev.cheb2poly(np.eye(DEGREE + 1)[k])
    return basis
