"""The best state feedback D(Y, X, Z, U) at one operating point of a second-order road, by dynamic programming.

The plant at one operating point is a Markov chain over control intervals; in each the damping ratio is held (zero-order hold).
Its least average cost g and relative value h satisfy Bellman's equation (D. P. Bertsekas, Dynamic Programming and Optimal
Control, vol. 2, 2012, chapter 5)

    g + h(s) = min over D of E [interval cost + h(s') | s, D],   s = (Y, X, Z, U).

Lengths here are in standard deviations of the road, times in 1/natural_frequency, as in `roadgym.compiled`.

*What is exact.* The generator maps quadratic forms of s to quadratic forms, on the Gaussian and on the bounded road alike:
drift A(D) s, noise along U of intensity 4 delta nu (1 + (1 - (Z^2 + U^2)/2)/alpha), with 1/alpha = 0 on the Gaussian road. So
the interval cost, given s and D, and the relative value h0 of the best constant damping are quadratic forms, found without
sampling. Only the rest w = h - h0 is tabulated; it is zero where feedback can gain nothing.

*The table.* (Y, X) on a rectangle, (Z, U) on a polar grid; Lagrange's cubics between. Half of it is computed: mirrored
states, (Y, X, Z, U) -> -(Y, X, Z, U), have the same value. The road's step is a rule of five points, with the exact conditional
mean and covariance; on it the car's step is regressed linearly, and what that leaves of the car's covariance, small to fifth
order in the interval, is neglected. The rule is coarse where the road forgets much in an interval: at 4 delta nu interval = 0.7
the table's own cost was 3 % off. 25 points mended that, but lowered the driven cost by 0.1 % only.

*The minimum over D.* The expected cost-to-go is found at five Chebyshev nodes of a variable that is affine in
exp(-2 D interval), the factor by which the relative velocity decays; the polynomial through them is minimised over the whole
range. Often, not always, its minimum lies at an end. The coefficients, which are smooth in s where D itself jumps, are the
feedback: they are interpolated, and minimised at the state met.

*The criterion.* What a table says of itself is not a cost. Each feedback is driven on the plant, and the table refined until
that no longer helps. Constant dampings drive over the same noise, and their exact costs take most of it out of the driven cost
(`analysis.control_variates`). Whatever the error of the table, the cost reported is that of a feedback that exists, so an upper
bound of the least cost, up to its standard error.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import io
import itertools
import json
import math
import os
import re
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from roadgym.cache import warn_not_kept
from roadgym.compiled import compiled
from roadgym.files import PART, whole_file
from roadgym.kernel import RESULT_SQUARE, REWARD
from roadgym.linear import LinearSystem
from roadgym.parameters import ParameterError, number_array, positive_range, shown, whole, within
from roadgym.plant import Plant
from roadgym.reward import check_weights
from roadgym.roads import Road, make_road
from roadgym.task import Task, make_task

from .checks import FloatArray
from .control_variates import adjust, control_dampings, expected_squares, least_transient
from .optimum import DISPLACEMENT, optimal_damping
from .quadratic import interval_mean, plant_system

SingleArray = npt.NDArray[np.float32]

FORMAT = 3  # of the cached files; raise it whenever results change
STATE = ("displacement", "velocity", "level", "slope")
GRIDS = ((6, 16, 24), (8, 24, 36), (11, 32, 54), (11, 32, 72))  # rings, rays, and rows (as many columns), coarse to fine
LARGEST_RADIUS = 4.0  # end of the polar grid on roads without a nearer bound; beyond lies 3e-4 of the Gaussian law
BOX = 8.0  # half the sides of the rectangle, in root mean squares of the car; 5 of them cost 0.7 % at nu = 3
SWEEPS, CHECK, SETTLED = 400, 10, 1e-3  # at most; between two checks; rms change of the value over the cost that ends them
LANES_DRIVEN, PIECE = 2560, 250  # cars driven together, and intervals between two looks at the standard error
FEWEST_PIECES = 3  # the adjusted error is soon small, and shorter drives adjust less well
COMPARED = 0.005  # relative standard error of the costs, over common noise, by which grids are compared
TRUSTED = 4.0  # times the tolerance by which the cost that a table expects may differ from the driven one

POINTS = 5  # of the rule for the road's step
CHANCE = np.array([1 / 3, 1 / 6, 1 / 6, 1 / 6, 1 / 6])
NODES = 5  # of D
NODE = -np.cos(np.pi * np.arange(NODES) / (NODES - 1))
# coefficients of t, ..., t^4 of the polynomial through (t_k, q_k), less its constant, from the differences q_k - q_0
POLYNOMIAL = np.linalg.inv(np.vander(NODE, NODES, increasing=True))[1:, 1:].astype(np.float32)
TRIALS = 9  # even points of [-1, 1] among which the minimum is sought before Newton's steps
LANE = 64  # states evaluated together

ZERO, ONE, TWO, THREE = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(3.0)
HALF, SIXTH = np.float32(0.5), np.float32(1.0 / 6.0)


@compiled
def locate(position: Any, size: Any) -> tuple[Any, Any]:
    """(first node of the stencil, place after it) of a position on a grid of ``size`` nodes, kept within the grid."""
    inside = min(max(position, 0.0), size - 1.0)
    first = min(max(int(inside) - 1, 0), size - 4)
    return first, np.float32(inside - first)


@compiled
def cubic(t: Any) -> tuple[Any, Any, Any, Any]:
    """Weights of the nodes 0, 1, 2, 3 in Lagrange's interpolation at ``t``, single precision."""
    a, b, c = t - ONE, t - TWO, t - THREE
    return -a * b * c * SIXTH, t * b * c * HALF, -t * a * c * HALF, t * a * b * SIXTH


@compiled
def road_stencil(z: Any, u: Any, spacing: Any, rings: Any, rays: Any, index: Any, weight: Any) -> None:
    """Sixteen nodes of the polar grid and their weights at (z, u); across the centre lie the rays opposite."""
    first, t = locate(math.sqrt(z * z + u * u) / spacing - 0.5 + 2.0, rings + 2)  # two mirrored rings inside the first
    along = cubic(t)
    position = (math.atan2(u, z) / (2.0 * math.pi) + 1.0) * rays
    ray = int(position) - 1
    around = cubic(np.float32(position - ray))
    for i in range(4):
        ring, start = first - 2 + i, ray
        if ring < 0:
            ring, start = -1 - ring, ray + rays // 2
        for k in range(4):
            place = start + k
            while place >= rays:
                place -= rays
            index[4 * i + k] = ring * rays + place
            weight[4 * i + k] = along[i] * around[k]


@compiled
def road_stencils(points: Any, spacing: Any, rings: Any, rays: Any, index: Any, weight: Any) -> None:
    """`road_stencil` at ``points``, shape (n, 2)."""
    for n in range(len(points)):
        road_stencil(points[n, 0], points[n, 1], spacing, rings, rays, index[n], weight[n])


@compiled
def add_shifted(source: Any, size: Any, row_shift: Any, column_shift: Any, factor: Any, middle: Any, target: Any) -> None:
    """Add ``factor`` times the square table ``source``, read at a shift given in cells, to ``target``."""
    whole_shift = math.floor(column_shift)
    low = min(max(1 - whole_shift, 0), size)  # between low and high no stencil meets the edge, and all weights are the same
    high = min(max(size - 2 - whole_shift, low), size)
    m0, m1, m2, m3 = cubic(np.float32(column_shift - whole_shift + 1.0))
    m0, m1, m2, m3 = factor * m0, factor * m1, factor * m2, factor * m3
    for i in range(size):
        row, t = locate(i + row_shift, size)
        w0, w1, w2, w3 = cubic(t)
        r0 = source[row * size : (row + 1) * size]
        r1 = source[(row + 1) * size : (row + 2) * size]
        r2 = source[(row + 2) * size : (row + 3) * size]
        r3 = source[(row + 3) * size : (row + 4) * size]
        for k in range(size):
            middle[k] = w0 * r0[k] + w1 * r1[k] + w2 * r2[k] + w3 * r3[k]
        out = target[i * size : (i + 1) * size]
        if high > low:
            inner = middle[low + whole_shift - 1 : high + whole_shift + 2]
            span = out[low:high]
            for k in range(high - low):
                span[k] += m0 * inner[k] + m1 * inner[k + 1] + m2 * inner[k + 2] + m3 * inner[k + 3]
        for k in range(size):
            if k < low or k >= high:
                column, t = locate(k + column_shift, size)
                w0, w1, w2, w3 = cubic(t)
                value = w0 * middle[column] + w1 * middle[column + 1] + w2 * middle[column + 2] + w3 * middle[column + 3]
                out[k] += factor * value


@compiled
def minimise(coefficients: Any, count: Any, place: Any, least: Any) -> None:
    """Where in [-1, 1] the polynomials without constant have their minima, and these less the values at -1.

    ``coefficients`` of t, ..., t^4 in four rows; the best of TRIALS points, then two steps of Newton's method about it.
    """
    c1s, c2s, c3s, c4s = coefficients[0], coefficients[1], coefficients[2], coefficients[3]
    step = np.float32(2.0 / (TRIALS - 1))
    for k in range(count):
        c1, c2, c3, c4 = c1s[k], c2s[k], c3s[k], c4s[k]
        start = c2 - c1 + c4 - c3
        best, t = start, -ONE
        for n in range(1, TRIALS):
            s = np.float32(n) * step - ONE
            value = (((c4 * s + c3) * s + c2) * s + c1) * s
            t = s if value < best else t
            best = min(value, best)
        low, high = max(t - step, -ONE), min(t + step, ONE)
        s = t
        for _ in range(2):
            slope = ((np.float32(4.0) * c4 * s + THREE * c3) * s + TWO * c2) * s + c1
            curvature = (np.float32(12.0) * c4 * s + np.float32(6.0) * c3) * s + TWO * c2
            s = min(max(s - slope / (curvature if curvature > ZERO else ONE), low), high)
        value = (((c4 * s + c3) * s + c2) * s + c1) * s
        place[k] = s if value < best else t
        least[k] = min(value, best) - start


@compiled
def sweep(
    begin: int,
    end: int,
    old: Any,
    new: Any,
    policy: Any,
    index: Any,
    weight: Any,
    offset: Any,
    road: Any,
    maps: Any,
    gains: Any,
    forms: Any,
    shape: Any,
    cell: Any,
) -> None:
    """Bellman's operator at the road nodes ``begin`` to ``end`` of the computed half; also the policy, unless it is empty.

    Args:
        old, new: the tabulated value, shape (rings * rays, rows * columns).
        policy: coefficients of the polynomials in the variable of D, shape (rings * rays, rows * columns, 4), or no entry.
        index, weight: stencils of the road's step, shape (nodes, POINTS, 16).
        offset: its five points less their mean, shape (nodes, POINTS, 2).
        road: (z, u) of the nodes, shape (nodes, 2).
        maps: mean of the car's step, shape (NODES, 2, 4).
        gains: its regression on the road's deviation from its mean, shape (NODES, 2, 2).
        forms: interval cost plus drift of h0, see `_Model`, shape (NODES, 11).
        shape: rings, rays, rows.
        cell: sides of the rectangle's cells, shape (2,).
    """
    rays, size = shape[1], shape[2]
    cells = size * size
    centre = 0.5 * (size - 1)
    tables = np.empty((POINTS, cells), np.float32)
    expected = np.empty((NODES, cells), np.float32)
    middle = np.empty(size, np.float32)
    q = np.empty((NODES, size))
    coefficients = np.empty((4, size), np.float32)
    place, least = np.empty(size, np.float32), np.empty(size, np.float32)
    for node in range(begin, end):
        for j in range(POINTS):
            table = tables[j]
            table[:] = ZERO
            for m in range(16):
                source, w = old[index[node, j, m]], weight[node, j, m]
                for k in range(cells):
                    table[k] += w * source[k]
        for a in range(NODES):
            expected[a, :] = ZERO
            for j in range(POINTS):
                dz, du = offset[node, j, 0], offset[node, j, 1]
                row_shift = (gains[a, 0, 0] * dz + gains[a, 0, 1] * du) / cell[0]
                column_shift = (gains[a, 1, 0] * dz + gains[a, 1, 1] * du) / cell[1]
                add_shifted(tables[j], size, row_shift, column_shift, np.float32(CHANCE[j]), middle, expected[a])
        z, u = road[node, 0], road[node, 1]
        here = node // (rays // 2) * rays + node % (rays // 2)
        mirror = here + rays // 2
        for i in range(size):
            y = (i - centre) * cell[0]
            for a in range(NODES):
                m, f, e, row_of_q = maps[a], forms[a], expected[a], q[a]
                row_start = (m[0, 0] * y + m[0, 2] * z + m[0, 3] * u) / cell[0] + centre
                column_start = (m[1, 0] * y + m[1, 2] * z + m[1, 3] * u) / cell[1] + centre
                row_step, column_step = m[0, 1] / cell[0], m[1, 1] / cell[1]
                constant = f[0] * y * y + (f[3] * z + f[4] * u) * y + f[7] * z * z + f[8] * z * u + f[9] * u * u + f[10]
                linear, square = f[1] * y + f[5] * z + f[6] * u, f[2]
                for k in range(size):
                    x = (k - centre) * cell[1]
                    row, t = locate(row_start + row_step * x, size)
                    v0, v1, v2, v3 = cubic(t)
                    column, t = locate(column_start + column_step * x, size)
                    h0, h1, h2, h3 = cubic(t)
                    p = row * size + column
                    value = v0 * (h0 * e[p] + h1 * e[p + 1] + h2 * e[p + 2] + h3 * e[p + 3])
                    p += size
                    value += v1 * (h0 * e[p] + h1 * e[p + 1] + h2 * e[p + 2] + h3 * e[p + 3])
                    p += size
                    value += v2 * (h0 * e[p] + h1 * e[p + 1] + h2 * e[p + 2] + h3 * e[p + 3])
                    p += size
                    value += v3 * (h0 * e[p] + h1 * e[p + 1] + h2 * e[p + 2] + h3 * e[p + 3])
                    row_of_q[k] = value + constant + (linear + square * x) * x
            for c in range(4):
                p0, p1, p2, p3 = POLYNOMIAL[c, 0], POLYNOMIAL[c, 1], POLYNOMIAL[c, 2], POLYNOMIAL[c, 3]
                for k in range(size):
                    first = q[0, k]
                    coefficients[c, k] = (
                        p0 * np.float32(q[1, k] - first)
                        + p1 * np.float32(q[2, k] - first)
                        + p2 * np.float32(q[3, k] - first)
                        + p3 * np.float32(q[4, k] - first)
                    )
            minimise(coefficients, size, place, least)
            for k in range(size):
                p = i * size + k
                value = np.float32(q[0, k] + least[k])
                new[here, p] = value
                new[mirror, cells - 1 - p] = value
                if policy.size:
                    for c in range(4):
                        policy[here, p, c] = coefficients[c, k]
                        policy[mirror, cells - 1 - p, c] = coefficients[c, k]


@compiled
def evaluate(begin: int, end: int, states: Any, columns: Any, policy: Any, geometry: Any, shape: Any, damping: Any) -> None:
    """The feedback for the rows ``begin`` to ``end`` of ``states``; Y, X, Z, U are the ``columns`` of a row.

    ``policy`` is flat; ``geometry`` has the spacing of the rings, the sides of the cells, and the three numbers that turn the
    variable of D into D; ``damping`` takes the result, float32.
    """
    rings, rays, size = shape[0], shape[1], shape[2]
    spacing, height, width = geometry[0], geometry[1], geometry[2]
    centre = 0.5 * (size - 1)
    index, weight = np.empty(16, np.int64), np.empty(16, np.float32)
    starts, weights = np.empty(64, np.uint64), np.empty(64, np.float32)
    total = np.empty(16, np.float32)
    coefficients = np.empty((4, LANE), np.float32)
    place, least = np.empty(LANE, np.float32), np.empty(LANE, np.float32)
    for first in range(begin, end, LANE):
        count = min(LANE, end - first)
        for n in range(count):
            y, x = np.float64(states[first + n, columns[0]]), np.float64(states[first + n, columns[1]])
            z, u = np.float64(states[first + n, columns[2]]), np.float64(states[first + n, columns[3]])
            road_stencil(z, u, spacing, rings, rays, index, weight)
            row, t = locate(y / height + centre, size)
            v = cubic(t)
            column, t = locate(x / width + centre, size)
            h0, h1, h2, h3 = cubic(t)
            for m in range(16):
                for i in range(4):
                    weights[4 * m + i] = weight[m] * v[i]
                    starts[4 * m + i] = 4 * ((index[m] * size + row + i) * size + column)
            for k in range(16):
                total[k] = ZERO
            for m in range(0, 64, 4):  # four rows at a time, each of four neighbours by four coefficients
                a, b, c, d = policy[starts[m] :], policy[starts[m + 1] :], policy[starts[m + 2] :], policy[starts[m + 3] :]
                for k in range(16):
                    total[k] += weights[m] * a[k] + weights[m + 1] * b[k] + weights[m + 2] * c[k] + weights[m + 3] * d[k]
            for c in range(4):
                coefficients[c, n] = h0 * total[c] + h1 * total[4 + c] + h2 * total[8 + c] + h3 * total[12 + c]
        minimise(coefficients, count, place, least)
        for n in range(count):
            damping[first + n] = -math.log1p(-(geometry[3] + geometry[4] * place[n])) / geometry[5]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Refinement:
    """One table and its feedback.

    Attributes:
        rings, rays, rows: size of the grid; it has as many columns as rows.
        sweeps: applications of Bellman's operator.
        expected: average cost that the table expects, 1; biased by its own errors.
        cost: driven cost, 1, over the noise that all refinements share.
        standard_error: of the latter.
    """

    rings: int
    rays: int
    rows: int
    sweeps: int
    expected: float
    cost: float
    standard_error: float


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class OptimalFeedback:
    """The best feedback found at one operating point; made by `optimal_feedback`.

    Attributes:
        road: the road, its bandwidth that of the operating point.
        speed: v, m/s.
        natural_frequency: w1, rad/s.
        weights: weights of the mean squares.
        bounds: smallest and largest damping, 1.
        control_interval: s.
        cost: driven cost, 1: minus the mean reward of the environment.
        standard_error: of the cost.
        history: the refinements, coarse to fine.
        signals: names of the signals in the observations that `predict` is given, in order.
        box: half the sides of the rectangle of (Y, X), in standard deviations of the road, shape (2,).
        policy: the tabulated polynomials, shape (rings, rays, rows, rows, 4).
    """

    road: Road
    speed: float
    natural_frequency: float
    weights: Mapping[str, float]
    bounds: tuple[float, float]
    control_interval: float
    cost: float
    standard_error: float
    history: tuple[Refinement, ...]
    signals: tuple[str, ...] = (*STATE, "speed", "bandwidth")
    box: FloatArray
    policy: SingleArray

    def __post_init__(self) -> None:
        for name in STATE:
            if name not in self.signals:
                raise ParameterError(f"optimal feedback needs the signal {name!r}; signals has {', '.join(self.signals)}")

    def with_signals(self, signals: Sequence[str]) -> OptimalFeedback:
        """The same feedback for observations of ``signals``, such as those of a task.

        Raises:
            ParameterError: a signal is missing that the feedback needs.
        """
        return dataclasses.replace(self, signals=tuple(signals))

    def damping(self, states: npt.ArrayLike) -> SingleArray:
        """D, shape (n,), float32, at ``states`` (Y, X, Z, U), shape (n, 4), in standard deviations of the road."""
        rows = np.atleast_2d(number_array("states", states))
        if rows.ndim != 2 or rows.shape[1] != len(STATE):
            raise ParameterError(f"states must have the shape (n, {len(STATE)}), got {np.shape(states)}")
        return self._evaluate(rows, np.arange(len(STATE)))

    def predict(
        self,
        observation: npt.NDArray[np.float32],
        state: Any = None,
        episode_start: npt.NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[SingleArray, Any]:
        """(D, state) for observations of ``signals``, as the environment makes them.

        D has the shape (n, 1), float32, for observations of shape (n, signals), and (1,) for one of shape (signals,). The
        feedback is deterministic and keeps no state. It does not look at the observed operating point: it is made for its own.

        Raises:
            ParameterError: an observation of another shape, or one that is not finite.
        """
        rows = np.atleast_2d(number_array("observation", observation))
        if rows.ndim != 2 or rows.shape[1] != len(self.signals):
            raise ParameterError(f"observation must have {len(self.signals)} signals, got the shape {np.shape(observation)}")
        columns = np.array([self.signals.index(name) for name in STATE])
        return self._evaluate(rows, columns).reshape((*np.shape(observation)[:-1], 1)), state

    def _evaluate(self, rows: npt.NDArray[Any], columns: npt.NDArray[np.int64]) -> SingleArray:
        result = np.empty(len(rows), np.float32)
        evaluate(0, len(rows), rows, columns, *self._table, result)
        return np.clip(result, *np.array(self.bounds, np.float32), out=result)

    @functools.cached_property
    def _table(self) -> tuple[SingleArray, FloatArray, npt.NDArray[np.int64]]:
        """Arguments of `evaluate`."""
        shape = np.array(self.policy.shape[:3])
        interval = self.control_interval * self.natural_frequency
        geometry = _geometry(self.road, shape, self.box, self.bounds, interval)
        return self.policy.reshape(-1), geometry, shape


def _radius(road: Road) -> float:
    """End of the polar grid: the bound of the road, or where hardly any of its law lies beyond, in standard deviations."""
    road_filter = road.shaping_filter()
    if road_filter is None or not road_filter.flatness:
        return LARGEST_RADIUS
    return min(math.sqrt(2 * (1 / road_filter.flatness + 1)), LARGEST_RADIUS)


def _variable(bounds: tuple[float, float], interval: float) -> tuple[float, float, float]:
    """(middle, half range, rate) of the variable t in [-1, 1] of D: 1 - exp(-rate D) = middle + half range * t."""
    rate = min(2 * interval, 4 / bounds[1])  # where exp(-2 D interval) vanishes, a slower exponential tells more
    low, high = (-math.expm1(-rate * bound) for bound in bounds)
    return (low + high) / 2, (high - low) / 2, rate


def _geometry(
    road: Road, shape: npt.NDArray[np.int64], box: FloatArray, bounds: tuple[float, float], interval: float
) -> FloatArray:
    """Spacing of the rings, sides of the cells, and `_variable`."""
    return np.array([_radius(road) / (shape[0] - 0.5), *(2 * box / (shape[2] - 1)), *_variable(bounds, interval)])


class _Model:
    """The Markov chain of an operating point up to its second moments, and h0 of the best constant damping.

    Quadratic forms are vectors of 16 entries and a constant, and what takes one to its conditional mean after an interval is a
    matrix, as in `analysis.quadratic.interval_mean`.

    Attributes:
        deviation: root mean squares of (Y, X) under the best constant damping, shape (2,).
        maps, gains: see `sweep`.
        forms: coefficients of yy, yx, xx, yz, yu, xz, xu, zz, zu, uu and 1 of interval cost plus E h0(s') - h0(s), at each node
            of D, shape (NODES, 11).
    """

    def __init__(self, task: Task) -> None:
        self._task, self._road = task, task.road
        self._interval = task.control_interval * task.car.natural_frequency
        best = optimal_damping(
            task.road,
            speed=task.speed[0],
            natural_frequency=task.car.natural_frequency,
            weights=task.weights_by_name,
            bounds=task.damping_range,
        )
        constant = self._system(float(best.damping))
        backward, cost = self._backward(constant)
        value = np.append(np.linalg.solve(np.eye(16) - backward[:16, :16], cost[:16]), 0.0)
        self.deviation = np.sqrt(np.diag(constant.covariance())[:2])

        middle, half, rate = _variable(task.damping_range, self._interval)
        self.maps, self.gains, self.forms = np.empty((NODES, 2, 4)), np.empty((NODES, 2, 2)), np.empty((NODES, 11))
        upper = np.triu_indices(4)
        order = [0, 1, 4, 2, 3, 5, 6, 7, 8, 9]  # the upper triangle has yy, yz, yu after yx, and xx after them
        for k, damping in enumerate(-np.log1p(-(middle + half * NODE)) / rate):
            system = self._system(damping)
            step, noise = system.transition(self._interval), system.step_covariance(self._interval)
            self.maps[k] = step[:2]
            self.gains[k] = noise[:2, 2:] @ np.linalg.inv(noise[2:, 2:])
            backward, cost = self._backward(system)
            form = cost + backward @ value - value
            matrix = form[:16].reshape(4, 4)
            both = matrix + matrix.T - np.diag(np.diag(matrix))
            self.forms[k] = np.append(both[upper][order], form[16])
        self._turn = step[2:, 2:]
        self._second = backward[:, [10, 11, 15]]  # of zz, zu, uu; like the turn, whatever D

    def _system(self, damping: float) -> LinearSystem:
        """The plant at a constant damping."""
        return plant_system(self._task, damping, self._task.frequency_ratio(self._task.speed[0]), self._task.bandwidth[0])

    def _backward(self, system: LinearSystem) -> tuple[FloatArray, FloatArray]:
        """(conditional mean of a form over an interval, mean cost over it as a form)."""
        backward, cost = interval_mean(system, system.cost_form(self._task.weights_by_name), self._interval)
        return backward, cost / self._interval

    def road_step(self, rings: int, rays: int) -> tuple[FloatArray, FloatArray, npt.NDArray[np.int64], SingleArray]:
        """(road, offset, index, weight) of `sweep`: the computed half of the polar grid, and the road's step from it."""
        radius = _radius(self._road)
        ring, ray = np.divmod(np.arange(rings * rays // 2), rays // 2)
        r, angle = (ring + 0.5) * radius / (rings - 0.5), 2 * np.pi / rays * ray
        road = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)
        mean = road @ self._turn.T
        forms = np.zeros((len(road), 17))
        forms[:, [10, 11, 14, 15]] = (road[:, :, None] * road[:, None, :]).reshape(-1, 4)
        forms[:, 16] = 1
        zz, zu, uu = (forms @ self._second).T
        slope = np.sqrt(np.maximum(uu - mean[:, 1] ** 2, 1e-12))
        shared = (zu - mean[:, 0] * mean[:, 1]) / slope
        level = np.sqrt(np.maximum(zz - mean[:, 0] ** 2 - shared**2, 0))
        first = math.sqrt(3) * np.stack([shared, slope], axis=1)
        second = math.sqrt(3) * np.stack([level, np.zeros_like(level)], axis=1)
        points = np.stack([mean, mean + first, mean - first, mean + second, mean - second], axis=1)
        points *= np.minimum(1, radius / np.linalg.norm(points, axis=2))[:, :, None]
        index = np.empty((*points.shape[:2], 16), np.int64)
        weight = np.empty(index.shape, np.float32)
        road_stencils(points.reshape(-1, 2), radius / (rings - 0.5), rings, rays, index.reshape(-1, 16), weight.reshape(-1, 16))
        return road, points - mean[:, None], index, weight


Share = Callable[[int, Callable[..., None]], None]


@contextlib.contextmanager
def _sharing(threads: int) -> Iterator[Share]:
    """A function that runs ``function(begin, end)`` over parts of a range, one a thread; parts write to places of their own."""
    with ThreadPoolExecutor(threads) as pool:

        def share(count: int, function: Callable[[int, int], None]) -> None:
            edges = [count * k // threads for k in range(threads + 1)]
            for future in [pool.submit(function, low, high) for low, high in itertools.pairwise(edges)]:
                future.result()

        yield share


def _solve(
    model: _Model, shape: npt.NDArray[np.int64], box: FloatArray, share: Share, told: Callable[[float], None]
) -> tuple[SingleArray, float, int]:
    """Relative value iteration: (policy, average cost that the table expects, sweeps)."""
    rings, rays, size = shape.tolist()
    road, offset, index, weight = model.road_step(rings, rays)
    cell = 2 * box / (size - 1)
    old = np.zeros((rings * rays, size * size), np.float32)
    new = np.empty_like(old)
    policy, none = np.empty((*old.shape, 4), np.float32), np.empty((0, 0, 4), np.float32)

    def apply(target: SingleArray) -> None:
        def part(begin: int, end: int) -> None:
            sweep(begin, end, old, new, target, index, weight, offset, road, model.maps, model.gains, model.forms, shape, cell)

        share(len(road), part)

    done, expected = 0, 0.0
    settled = False
    while not settled and done < SWEEPS:
        for _ in range(CHECK):
            apply(none)
            old, new = new, old
        done += CHECK
        change = old - new
        expected = float(np.mean(change, dtype=float))
        settled = float(np.std(change, dtype=float)) <= SETTLED * abs(expected)
        old -= old[0, size * size // 2]  # single precision has its digits where the value is near zero
        told(done / SWEEPS)
    apply(policy)
    return policy.reshape(rings, rays, size, size, 4), expected, done


@dataclasses.dataclass(frozen=True)
class _Drive:
    """Driven cost, adjusted by control variates, its standard error, root mean squares of (Y, X), and the pieces it took."""

    cost: float
    standard_error: float
    deviation: FloatArray
    pieces: int


def _drive(
    task: Task,
    table: tuple[SingleArray, FloatArray, npt.NDArray[np.int64]],
    noise: np.random.SeedSequence,
    *,
    precision: float,
    pieces: int | None,
    share: Share,
    threads: int,
    told: Callable[[float], None],
) -> _Drive:
    """Drive a feedback for ``pieces``, or until the relative standard error is at most ``precision``.

    Constant dampings over the same noise serve as control variates, see `analysis.control_variates`. A start at rest leaves
    exp(-2 D_min natural_frequency t) of the variance at most; it is let die out to below 1e-4, and to far less for those.
    """
    everyone = np.ones(LANES_DRIVEN, np.bool_)
    seeds = noise.generate_state(LANES_DRIVEN, np.uint64).astype(np.uint64)

    def start() -> tuple[Plant, SingleArray]:
        plant = Plant(task, LANES_DRIVEN, threads=threads)
        plant.seed(seeds, everyone)
        return plant, plant.reset(plant.forced({}), everyone)[0]

    plant, states = start()
    columns = np.array([task.signals.index(name) for name in STATE])
    low, high = np.array(task.damping_range, np.float32)
    damping = np.empty(LANES_DRIVEN, np.float32)
    total, squares = np.zeros(LANES_DRIVEN), np.zeros(2)
    forgotten = 5 / (task.damping_range[0] * task.car.natural_frequency)
    skipped = math.ceil(max(forgotten, least_transient(task)) / task.control_interval)
    constants = control_dampings(task, skipped * task.control_interval, LANES_DRIVEN)
    expected = np.array(task.weights) @ expected_squares(task, constants, task.speed[0])
    rivals = [start()[0] for _ in constants]
    held = [np.full(LANES_DRIVEN, constant, np.float32) for constant in constants]
    controls = np.zeros((len(constants), LANES_DRIVEN))

    def respond(seen: SingleArray) -> None:
        share(LANES_DRIVEN, lambda begin, end: evaluate(begin, end, seen, columns, *table, damping))

    step, measured, mean, error = 0, 0, 0.0, math.inf
    least = FEWEST_PIECES if pieces is None else pieces
    while measured < least * PIECE or (pieces is None and error > precision * mean):
        for _ in range(PIECE if step >= skipped else skipped):
            respond(states)
            states, results, _, _ = plant.step(np.clip(damping, low, high, out=damping))
            costs = [rival.step(constant)[1][REWARD] for rival, constant in zip(rivals, held, strict=True)]
            if step >= skipped:
                total -= results[REWARD]
                for control, cost in zip(controls, costs, strict=True):
                    control -= cost
                squares += np.mean(results[RESULT_SQUARE : RESULT_SQUARE + 2], axis=1, dtype=float)
                measured += 1
            step += 1
        if measured:
            adjusted = adjust(total / measured, controls / measured, expected)
            mean, error = float(adjusted.mean()), float(adjusted.std(ddof=1)) / math.sqrt(LANES_DRIVEN)
            told(min((precision * mean / error) ** 2, measured / (least * PIECE), 1.0))
    return _Drive(mean, error, np.sqrt(squares / measured), measured // PIECE)


def check_road(road: Road) -> None:
    """Raises `ParameterError` for a road on which `optimal_feedback` is not there."""
    road_filter = road.shaping_filter()
    if road_filter is None or road_filter.bandwidth is None or road_filter.flatness is None:
        raise ParameterError(f"road must be gaussian, or multiplicative on a circle, got {road!r}")


def optimal_feedback(
    road: str | Mapping[str, Any] | Road,
    *,
    speed: float,
    bandwidth: float | None = None,
    natural_frequency: float = 1.0,
    weights: Mapping[str, float] = DISPLACEMENT,
    bounds: tuple[float, float] = (0.05, 1.0),
    control_interval: float | None = None,
    tolerance: float = 0.005,
    precision: float = 0.003,
    refinements: int = len(GRIDS),
    seed: int = 0,
    threads: int | None = None,
    cache: str | os.PathLike[str] | None = None,
    report: Callable[[int, int], None] | None = None,
) -> OptimalFeedback:
    """The best state feedback D(Y, X, Z, U) within ``bounds`` at one operating point; see the module's docstring.

    Tables are refined until the driven cost changes by less than ``tolerance`` and the table expects about that cost, and the
    feedback with the least cost is driven once more, over fresh noise. Seconds to a minute on one processor.

    Args:
        road: a Gaussian road, or a multiplicative road on a circle, or its name or mapping.
        speed: v > 0, m/s.
        bandwidth: delta > 0, 1, in place of the road's, at the same variance.
        natural_frequency: w1, rad/s.
        weights: weights of the mean squares, as of the reward of the environment.
        bounds: smallest and largest damping, 0 < low < high.
        control_interval: time between two settings of D, s; 0.2/natural_frequency by default.
        tolerance: relative change of the driven cost that ends the refinement.
        precision: relative standard error of the reported cost, at most.
        refinements: most tables to make, 1 to 4.
        seed: fixes the noise; the result depends on nothing else.
        threads: number of threads; results do not depend on it. By default one a processor.
        cache: folder in which results are kept, and found again when all parameters are the same; it is made if need be.
        report: called as ``report(done, total)`` now and then; ``done`` never falls and ends at ``total``.

    Raises:
        ParameterError: a parameter out of range, a road of another kind, or a weight on no mean square.
    """
    road = make_road(road)
    check_road(road)
    if bandwidth is not None:
        road = road.with_bandwidth(within("bandwidth", bandwidth))
    check_weights(weights, road)
    low, high = positive_range("bounds", bounds, "damping")
    if low == high:
        raise ParameterError(f"bounds must be a pair (low, high) with low < high, got {shown(bounds)}")
    task = make_task(
        road=road,
        speed=within("speed", speed, "moving speed"),
        damping_range=(low, high),
        reward=weights,
        observation=STATE,
        natural_frequency=natural_frequency,
        control_interval=control_interval,
    )
    tolerance, precision = within("tolerance", tolerance, "relative_error"), within("precision", precision, "relative_error")
    if whole("refinements", refinements) > len(GRIDS):
        raise ParameterError(f"refinements must be at most {len(GRIDS)}, got {shown(refinements)}")
    whole("seed", seed, low=0, of="seed")
    if not (cache is None or isinstance(cache, (str, os.PathLike))):
        raise ParameterError(f"cache must be a folder or None, got {shown(cache)}")
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    threads = available if threads is None else whole("threads", threads, of="threads")

    description = {
        "format": FORMAT,
        "road": dataclasses.asdict(road),
        "speed": task.speed[0],
        "natural_frequency": task.car.natural_frequency,
        "weights": task.weights_by_name,
        "bounds": [low, high],
        "control_interval": task.control_interval,
        "tolerance": tolerance,
        "precision": precision,
        "refinements": refinements,
        "seed": seed,
    }
    text = json.dumps(description, sort_keys=True)
    path = None if cache is None else Path(cache) / f"feedback-{hashlib.sha256(text.encode()).hexdigest()[:32]}.npz"
    point: dict[str, Any] = {
        "road": road,
        "speed": task.speed[0],
        "natural_frequency": task.car.natural_frequency,
        "weights": task.weights_by_name,
        "bounds": (low, high),
        "control_interval": task.control_interval,
    }
    units, reached = 100 * (refinements + 1), 0

    def told(done: float) -> None:
        nonlocal reached
        reached = max(reached, min(int(units * done), units - 1))  # an estimate of what is left may rise again
        if report is not None:
            report(reached, units)

    result = None if path is None else _load(path, text, point)
    if result is None:
        result = _find(
            task,
            point,
            tolerance=tolerance,
            precision=precision,
            refinements=refinements,
            seed=seed,
            threads=threads,
            told=told,
        )
        if path is not None:
            _save(path, text, result)
    if report is not None:
        report(units, units)
    return result


def _find(
    task: Task,
    point: Mapping[str, Any],
    *,
    tolerance: float,
    precision: float,
    refinements: int,
    seed: int,
    threads: int,
    told: Callable[[float], None],
) -> OptimalFeedback:
    """Refine, choose, and drive once more; ``told`` is given the share that is done."""
    shared_noise, own_noise = np.random.SeedSequence(seed).spawn(2)
    model = _Model(task)
    box = BOX * model.deviation
    interval = task.control_interval * task.car.natural_frequency
    history: list[Refinement] = []
    chosen: tuple[float, FloatArray, SingleArray] | None = None
    pieces = None

    def table_of(box: FloatArray, policy: SingleArray) -> tuple[SingleArray, FloatArray, npt.NDArray[np.int64]]:
        shape = np.array(policy.shape[:3])
        return policy.reshape(-1), _geometry(task.road, shape, box, task.damping_range, interval), shape

    def within(level: int, begin: float, width: float) -> Callable[[float], None]:
        return lambda done: told((level + begin + width * done) / (refinements + 1))

    with _sharing(threads) as share:
        for level, (rings, rays, rows) in enumerate(GRIDS[:refinements]):
            policy, expected, sweeps = _solve(model, np.array([rings, rays, rows]), box, share, within(level, 0.0, 0.8))
            drive = _drive(
                task,
                table_of(box, policy),
                shared_noise,
                precision=max(COMPARED, precision),
                pieces=pieces,
                share=share,
                threads=threads,
                told=within(level, 0.8, 0.2),
            )
            pieces = drive.pieces
            refinement = Refinement(
                rings=rings,
                rays=rays,
                rows=rows,
                sweeps=sweeps,
                expected=expected,
                cost=drive.cost,
                standard_error=drive.standard_error,
            )
            if chosen is None or drive.cost < chosen[0]:
                chosen = drive.cost, box, policy
            history.append(refinement)
            if len(history) > 1 and _is_refined(history[-2], refinement, tolerance):
                break
            box = BOX * drive.deviation
        assert chosen is not None
        _, box, policy = chosen
        final = _drive(
            task,
            table_of(box, policy),
            own_noise,
            precision=precision,
            pieces=None,
            share=share,
            threads=threads,
            told=within(refinements, 0.0, 1.0),
        )
    return OptimalFeedback(
        **point, cost=final.cost, standard_error=final.standard_error, history=tuple(history), box=box, policy=policy
    )


def _is_refined(coarse: Refinement, fine: Refinement, tolerance: float) -> bool:
    """Has the driven cost settled, and does the table know it?"""
    trusted = abs(fine.expected - fine.cost) <= TRUSTED * tolerance * fine.cost + 2 * fine.standard_error
    return trusted and abs(fine.cost - coarse.cost) <= tolerance * fine.cost


def _save(path: Path, text: str, result: OptimalFeedback) -> None:
    """Keep a result, whole or not at all; where it cannot be kept there is a warning, for the result is worth more."""
    figures = {
        "cost": result.cost,
        "standard_error": result.standard_error,
        "history": [dataclasses.asdict(refinement) for refinement in result.history],
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as part, part.open("wb") as file:
            np.savez(file, description=text, figures=json.dumps(figures), box=result.box, policy=result.policy)
    except OSError as error:
        warn_not_kept(path.parent, error)


def kept_files(folder: Path | None) -> list[Path]:
    """The results that are kept in ``folder``, and what killed writers left there."""
    if folder is None or not folder.is_dir():
        return []
    return [
        path for path in folder.iterdir() if re.fullmatch(r"feedback-[0-9a-f]{32}\.npz", path.name) or PART.fullmatch(path.name)
    ]


def _load(path: Path, text: str, point: Mapping[str, Any]) -> OptimalFeedback | None:
    """A kept result, or None where there is none, or none that is sound and of this description."""
    try:
        content = path.read_bytes()
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if archive.testzip() is not None:  # reads all of it: NumPy looks at no checksum
                return None
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            if str(file["description"]) != text:
                return None
            figures = json.loads(str(file["figures"]))
            history = tuple(Refinement(**refinement) for refinement in figures["history"])
            box, policy = file["box"], file["policy"]
        return _sound(OptimalFeedback(**point, **figures | {"history": history}, box=box, policy=policy))
    except Exception:  # a damaged file can raise anything
        return None


def _sound(result: OptimalFeedback) -> OptimalFeedback | None:
    """The result, if `_find` could have found it."""
    grids = [(grid.rings, grid.rays, grid.rows) for grid in result.history]
    chosen = min(result.history, key=lambda grid: grid.cost)  # the first of equals, as `_find` chooses
    positive_figures = [result.cost, result.standard_error, *result.box.tolist()]
    for grid in result.history:
        positive_figures += [grid.sweeps, grid.expected, grid.cost, grid.standard_error]
    sound = (
        grids == list(GRIDS[: len(grids)])
        and all(type(figure) in (int, float) and 0 < figure < math.inf for figure in positive_figures)
        and result.box.shape == (2,)
        and result.box.dtype == np.float64
        and result.policy.shape == (chosen.rings, chosen.rays, chosen.rows, chosen.rows, 4)
        and result.policy.dtype == np.float32
        and bool(np.isfinite(result.policy).all())
    )
    return result if sound else None
