"""Tables over (Y, X) and (Z, U), their interpolation, and the feedback that they hold."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from roadgym.compiled import compiled
from roadgym.roads import Road

from ..checks import FloatArray

SingleArray = npt.NDArray[np.float32]

STATE = ("displacement", "velocity", "level", "slope")
LARGEST_RADIUS = 4.0  # end of the polar grid on roads without a nearer bound; beyond lies 3e-4 of the Gaussian law
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
def interpolate(table: Any, size: Any, row_place: Any, column_place: Any) -> Any:
    """A square table by Lagrange's cubics at a place in cells from its first node, kept within it."""
    row, t = locate(row_place, size)
    v0, v1, v2, v3 = cubic(t)
    column, t = locate(column_place, size)
    h0, h1, h2, h3 = cubic(t)
    p = row * size + column
    total = v0 * (h0 * table[p] + h1 * table[p + 1] + h2 * table[p + 2] + h3 * table[p + 3])
    p += size
    total += v1 * (h0 * table[p] + h1 * table[p + 1] + h2 * table[p + 2] + h3 * table[p + 3])
    p += size
    total += v2 * (h0 * table[p] + h1 * table[p + 1] + h2 * table[p + 2] + h3 * table[p + 3])
    p += size
    total += v3 * (h0 * table[p] + h1 * table[p + 1] + h2 * table[p + 2] + h3 * table[p + 3])
    return total


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
def evaluate(begin: int, end: int, states: Any, columns: Any, policy: Any, geometry: Any, shape: Any, damping: Any) -> None:
    """The feedback for the rows ``begin`` to ``end`` of ``states``; Y, X, Z, and U where there is one, are the ``columns``.

    ``policy`` is flat; ``geometry`` has the spacing of the rings, the sides of the cells, the three numbers that turn the
    variable of D into D, and how much of Z is taken from Y and X; ``damping`` takes the result, float32.
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
            z, u = np.float64(states[first + n, columns[2]]), 0.0
            if len(columns) > 3:
                u = np.float64(states[first + n, columns[3]])
            y, x = y - geometry[6] * z, x - geometry[7] * z
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


def radius_of(road: Road) -> float:
    """End of the polar grid: the bound of the road, or where hardly any of its law lies beyond, in standard deviations."""
    road_filter = road.shaping_filter()
    if road_filter is None or not road_filter.flatness:
        return LARGEST_RADIUS
    return min(math.sqrt(2 * (1 / road_filter.flatness + 1)), LARGEST_RADIUS)


def variable_of(bounds: tuple[float, float], interval: float) -> tuple[float, float, float]:
    """(middle, half range, rate) of the variable t in [-1, 1] of D: 1 - exp(-rate D) = middle + half range * t."""
    rate = min(2 * interval, 4 / bounds[1])  # where exp(-2 D interval) vanishes, a slower exponential tells more
    low, high = (-math.expm1(-rate * bound) for bound in bounds)
    return (low + high) / 2, (high - low) / 2, rate


def geometry_of(
    road: Road,
    shape: npt.NDArray[np.int64],
    box: FloatArray,
    bounds: tuple[float, float],
    interval: float,
    follows: FloatArray,
) -> FloatArray:
    """Spacing of the rings, sides of the cells, `variable_of`, and how much of Z is taken from (Y, X)."""
    spacing = radius_of(road) / (shape[0] - 0.5)
    return np.array([spacing, *(2 * box / (shape[2] - 1)), *variable_of(bounds, interval), *follows])
