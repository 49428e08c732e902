"""The inner problem of one road by weak duality: a multiplier for each step, and the best of them by ascent.

For a road that is known, car states c and a force u of the damper beyond the softest one, the inner problem is

    minimise   sum over k of  (c, u)'C (c, u) + 2 l_k'(c, u)     subject to   c_{k+1} = S c_k + E u_k + a_k,
               u_k (v_k - u_k) >= 0,   v_k = r'c_k + e u_k + b_k,   the start free.

It is not convex. For any multipliers m_k >= 0 the minimum of the sum less m_k u_k (v_k - u_k), without the constraints, is no
larger: a regulator with known forcing, solved by Riccati's recursion. It is concave in the multipliers, with the slope
-u_k (v_k - u_k) along its own solution, and -inf where the recursion finds no minimum: at the step, backwards in time, where
it ceases to be convex. What is done about that step hardly matters for others: so there alone an ascent is made shorter.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from roadgym.compiled import compiled

from ...checks import FloatArray

MEMORY = 20  # pairs of steps and changes of slope that the ascent knows
PATIENCE = 30  # steps over which it must gain
FIRST, CAREFUL = 0.1, 1e-3  # the largest change of a multiplier in a step along the slope alone
SHORTER, ENOUGH, TRIALS, LOCAL = 0.3, 1e-4, 30, 8  # of a step that fails; gain over what the slope promises; at most so many


class Chain(NamedTuple):
    """A step of the car while the force is held; n states of the car.

    Attributes:
        step: S, shape (n, n).
        entry: E, shape (n,).
        cost: C, shape (n + 1, n + 1).
        relative: r, shape (n,).
        relative_entry: e.
    """

    step: FloatArray
    entry: FloatArray
    cost: FloatArray
    relative: FloatArray
    relative_entry: float


class Forcing(NamedTuple):
    """What one road does in each of its N steps.

    Attributes:
        added: a, shape (N, n).
        linear: l, shape (N, n + 1).
        relative: b, shape (N,).
    """

    added: FloatArray
    linear: FloatArray
    relative: FloatArray


@compiled
def solve_positive(matrix: Any, right: Any) -> Any:
    """Solve a symmetric system in place, by elimination; False where the matrix is not positive definite."""
    size = len(right)
    for i in range(size):
        if not matrix[i, i] > 0.0:
            return False
        for j in range(i + 1, size):
            factor = matrix[j, i] / matrix[i, i]
            for k in range(i, size):
                matrix[j, k] -= factor * matrix[i, k]
            right[j] -= factor * right[i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            right[i] -= matrix[i, k] * right[k]
        right[i] /= matrix[i, i]
    return True


@compiled
def descend(chain: Any, forcing: Any, multipliers: Any, gains: Any, offsets: Any, slopes: Any) -> Any:
    """(the minimum less the multipliers' part, -1); or, where there is none, -inf and the step at which it is lost.

    Args:
        chain, forcing: the inner problem.
        multipliers: shape (N,).
        gains, offsets: room for the solution u = -gain c - offset, shapes (N, n) and (N,).
        slopes: takes the derivative to each multiplier, shape (N,); only where there is a minimum.
    """
    size = len(chain.entry)
    value, linear, constant = np.zeros((size, size)), np.zeros(size), 0.0
    whole, moved = np.empty((size, size + 1)), np.empty((size, size + 1))
    whole[:, :size], whole[:, size] = chain.step, chain.entry
    square, side = np.empty((size + 1, size + 1)), np.empty(size + 1)
    for k in range(len(multipliers) - 1, -1, -1):
        weight, added = multipliers[k], forcing.added[k]
        for i in range(size):
            for j in range(size + 1):
                total = 0.0
                for m in range(size):
                    total += value[i, m] * whole[m, j]
                moved[i, j] = total
        for i in range(size + 1):
            total = forcing.linear[k, i]
            for m in range(size):
                total += whole[m, i] * linear[m] + moved[m, i] * added[m]
            side[i] = total
            for j in range(i + 1):
                total = chain.cost[i, j]
                for m in range(size):
                    total += whole[m, i] * moved[m, j]
                square[i, j] = square[j, i] = total
        square[size, size] += weight * (1.0 - chain.relative_entry)
        side[size] -= 0.5 * weight * forcing.relative[k]
        if not square[size, size] > 0.0:
            return -np.inf, k
        for i in range(size):
            gains[k, i] = (square[size, i] - 0.5 * weight * chain.relative[i]) / square[size, size]
            constant += 2.0 * linear[i] * added[i]
            for j in range(size):
                constant += added[i] * value[i, j] * added[j]
        offsets[k] = side[size] / square[size, size]
        constant -= side[size] * offsets[k]
        for i in range(size):
            linear[i] = side[i] - gains[k, i] * side[size]
            for j in range(size):
                value[i, j] = square[i, j] - gains[k, i] * gains[k, j] * square[size, size]
    car, after = -linear, np.empty(size)
    if not solve_positive(value, car):
        return -np.inf, 0
    for i in range(size):
        constant += linear[i] * car[i]
    for k in range(len(multipliers)):
        force, relative = -offsets[k], forcing.relative[k]
        for i in range(size):
            force -= gains[k, i] * car[i]
            relative += chain.relative[i] * car[i]
        relative += chain.relative_entry * force
        slopes[k] = -force * (relative - force)
        for i in range(size):
            total = forcing.added[k, i] + chain.entry[i] * force
            for j in range(size):
                total += chain.step[i, j] * car[j]
            after[i] = total
        car[:] = after
    return constant, -1


Dual = Callable[[FloatArray], tuple[float, FloatArray, int]]


def dual(chain: Chain, forcing: Forcing) -> Dual:
    """(value, slope, step at which there is none) of `descend` as a function of the multipliers."""
    gains, offsets = np.empty_like(forcing.added), np.empty(len(forcing.added))

    def found(multipliers: FloatArray) -> tuple[float, FloatArray, int]:
        slopes = np.empty(len(multipliers))
        value, lost = descend(chain, forcing, multipliers, gains, offsets, slopes)
        return float(value), slopes, int(lost)

    return found


def ascend(function: Dual, start: FloatArray, *, scale: float, gain: float, steps: int, reach: int) -> tuple[float, FloatArray]:
    """(largest value found, where) of a concave function over what is not negative; -inf is outside of where it is defined.

    By the quasi-Newton method of limited memory (J. Nocedal, Mathematics of Computation 35, 1980), projected on the bounds.

    Args:
        function: its value, its slope, and the step at which it has none.
        start: where it is finite.
        scale: of the multipliers.
        gain: of the value in `PATIENCE` steps, below which it ends.
        steps: at most.
        reach: how many steps before and after one at which there is no value are made shorter.
    """
    place, (best, slope, _) = start, function(start)
    kept: list[tuple[FloatArray, FloatArray]] = []
    history, first = [best], FIRST
    while len(history) <= steps and (len(history) <= PATIENCE or best - history[-1 - PATIENCE] >= gain):
        free = (place > 0) | (slope > 0)
        way = _direction(np.where(free, slope, 0.0), kept, free)
        if not kept:
            way = way * (first * scale / max(float(np.abs(slope).max()), 1e-300))
        for trial in range(TRIALS):
            tried = np.maximum(place + way, 0.0)
            value, other, lost = function(tried)
            if value >= best + ENOUGH * float(slope @ (tried - place)):
                break
            near = slice(None) if lost < 0 or trial >= LOCAL else slice(max(0, lost - reach), lost + reach)
            way[near] *= SHORTER
        else:
            if not kept:
                break
            kept, first = [], CAREFUL
            continue
        moved, turned = tried - place, slope - other
        if float(moved @ turned) > 0:
            kept = [*kept, (moved, turned)][-MEMORY:]
        place, best, slope = tried, value, other
        history.append(best)
    return best, place


def _direction(slope: FloatArray, kept: list[tuple[FloatArray, FloatArray]], free: Any) -> FloatArray:
    """The two loops of the method, over the coordinates that are free."""
    pairs = [(moved, turned, float(moved @ turned)) for moved, turned in ((m * free, t * free) for m, t in kept)]
    pairs = [pair for pair in pairs if pair[2] > 0]
    way, shares = slope, []
    for moved, turned, product in reversed(pairs):
        shares.append(float(moved @ way) / product)
        way = way - shares[-1] * turned
    if pairs:
        way = way * (pairs[-1][2] / float(pairs[-1][1] @ pairs[-1][1]))
    for moved, turned, product in pairs:
        way = way + (shares.pop() - float(turned @ way) / product) * moved
    return np.where(free, way, 0.0)
