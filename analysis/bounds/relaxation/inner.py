"""Compiled code: the inner problem of one road, by dynamic programming over the car's states, and one policy's share in it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from roadgym.compiled import compiled

from ...checks import FloatArray
from ...feedback.grid import HALF, ZERO, SingleArray, add_shifted, interpolate

IndexArray = npt.NDArray[np.int64]


@compiled
def bilinear(table: Any, size: Any, row_place: Any, column_place: Any) -> Any:
    """A square table by linear interpolation at a place in cells from its first node, kept within it; double precision."""
    row_place = min(max(row_place, 0.0), size - 1.0)
    column_place = min(max(column_place, 0.0), size - 1.0)
    row, column = min(int(row_place), size - 2), min(int(column_place), size - 2)
    s, t = row_place - row, column_place - column
    p = row * size + column
    return (1.0 - s) * ((1.0 - t) * table[p] + t * table[p + 1]) + s * ((1.0 - t) * table[p + size] + t * table[p + size + 1])


@compiled
def blend(value: Any, index: Any, weight: Any, result: Any) -> None:
    """The table over the car's states at one state of the road."""
    result[:] = ZERO
    for m in range(len(index)):
        source, w = value[index[m]], weight[m]
        for k in range(len(result)):
            result[k] += w * source[k]


@compiled
def penalty_table(slices: Any, factor: Any, offset: Any, gain: Any, rest: Any, grid: Any, middle: Any, result: Any) -> None:
    """The penalty of one interval and one damping, over the mean of the car's states after it.

    Args:
        slices: w at the points of the road, shape (points, cells); the first is its mean.
        factor, offset: see `analysis.bounds.relaxation.expansion`, shapes (points,) and (points, 2).
        gain: how the car's states follow the noise of the points, shape (2, 2).
        rest: of the car's noise, what does not, shape (2,).
        grid: that of w.
        middle: room for a row.
        result: takes it, shape (cells,).
    """
    size, cell = grid.size, grid.cell
    result[:] = ZERO
    for q in range(len(factor)):
        row_shift = (gain[0, 0] * offset[q, 0] + gain[0, 1] * offset[q, 1]) / cell[0]
        column_shift = (gain[1, 0] * offset[q, 0] + gain[1, 1] * offset[q, 1]) / cell[1]
        add_shifted(slices[q], size, row_shift, column_shift, np.float32(factor[q]), middle, result)
    down, right = np.float32(rest[0] / cell[0]) * HALF, np.float32(rest[1] / cell[1]) * HALF
    source = slices[0]
    for i in range(1, size - 1):
        for k in range(1, size - 1):
            p = i * size + k
            result[p] += down * (source[p + size] - source[p - size]) + right * (source[p + 1] - source[p - 1])


class Chain(NamedTuple):
    """What an interval does to the car at each damping; the quadratic part of interval cost plus drift of h0.

    Attributes:
        maps: of the car's states, shape (dampings, 2, 2).
        gains: how their noise follows that of the points, shape (dampings, 2, 2).
        squares: coefficients of yy, yx, xx, shape (dampings, 3).
    """

    maps: FloatArray
    gains: FloatArray
    squares: FloatArray


class Steps(NamedTuple):
    """One road over the intervals.

    Attributes:
        nodes, weights: stencils in w of the road at their ends, shape (intervals + 1, 16).
        point_nodes, point_weights: of the points about its mean, shape (intervals, points, 16).
        factor, offset: see `Expanded`.
        moved: what it adds to the car's states in the mean, shape (intervals, dampings, 2).
        noise: what it adds beyond that, likewise.
        rest: of the noise, what does not follow that of the points as ``Chain.gains`` says, likewise.
        linear, constant: interval cost plus drift of h0: linear part in the car's states, and constant, shape (intervals,
            dampings, 2) and (intervals, dampings).
    """

    nodes: IndexArray
    weights: SingleArray
    point_nodes: IndexArray
    point_weights: SingleArray
    factor: FloatArray
    offset: FloatArray
    moved: FloatArray
    noise: FloatArray
    rest: FloatArray
    linear: FloatArray
    constant: FloatArray


class Grid(NamedTuple):
    """A square grid about rest over the car's states: nodes of a side, and sides of a cell."""

    size: int
    cell: FloatArray


@compiled
def stage(chain: Any, steps: Any, n: int, a: int, y: Any, x: Any) -> Any:
    """(interval cost plus drift of h0, mean of both states of the car after it)."""
    s, m = chain.squares[a], chain.maps[a]
    cost = s[0] * y * y + s[1] * y * x + s[2] * x * x
    cost += steps.linear[n, a, 0] * y + steps.linear[n, a, 1] * x + steps.constant[n, a]
    mean_y = m[0, 0] * y + m[0, 1] * x + steps.moved[n, a, 0]
    mean_x = m[1, 0] * y + m[1, 1] * x + steps.moved[n, a, 1]
    return cost, mean_y, mean_x


@compiled
def least(options: Any, p: int) -> Any:
    """The least of column ``p`` over an evenly spaced variable: by the parabola about the least entry."""
    best = 0
    for option in range(1, len(options)):
        if options[option, p] < options[best, p]:
            best = option
    middle = min(max(best, 1), len(options) - 2)
    slope = 0.5 * (options[middle + 1, p] - options[middle - 1, p])
    curvature = options[middle + 1, p] - 2.0 * options[middle, p] + options[middle - 1, p]
    found = options[best, p]
    if curvature > 0.0 and abs(slope) < curvature:
        found = min(found, options[middle, p] - 0.5 * slope * slope / curvature)
    return found


@compiled
def relax(value: Any, grid: Any, chain: Any, steps: Any, stride: int, fine: Any, beyond: Any) -> None:
    """The inner problem of one road: its value beyond h0 + w at the end becomes that at the beginning.

    Args:
        value: w, shape (road nodes, cells).
        grid: that of w.
        chain, steps: the plant and the road.
        stride: every so many of the dampings are tried, three or more; between them the cost is a parabola.
        fine: the grid of the inner problem.
        beyond: its value less h0 + w, shape (nodes of ``fine``,); overwritten.
    """
    intervals, points = steps.point_nodes.shape[:2]
    size, cell, cells = grid.size, grid.cell, grid.size**2
    slices, here = np.empty((points, cells), np.float32), np.empty(cells, np.float32)
    penalty, middle = np.empty(cells, np.float32), np.empty(size, np.float32)
    options = np.empty((1 + (len(chain.maps) - 1) // stride, fine.size**2))
    centre, fine_centre = 0.5 * (size - 1), 0.5 * (fine.size - 1)
    blend(value, steps.nodes[intervals], steps.weights[intervals], here)
    for n in range(intervals - 1, -1, -1):
        for q in range(points):
            blend(value, steps.point_nodes[n, q], steps.point_weights[n, q], slices[q])
        for option in range(len(options)):
            a = option * stride
            penalty_table(slices, steps.factor[n, a], steps.offset[n], chain.gains[a], steps.rest[n, a], grid, middle, penalty)
            dy, dx = steps.noise[n, a, 0], steps.noise[n, a, 1]
            for i in range(fine.size):
                y = (i - fine_centre) * fine.cell[0]
                for k in range(fine.size):
                    x = (k - fine_centre) * fine.cell[1]
                    cost, mean_y, mean_x = stage(chain, steps, n, a, y, x)
                    cost -= interpolate(penalty, size, mean_y / cell[0] + centre, mean_x / cell[1] + centre)
                    y_after, x_after = mean_y + dy, mean_x + dx
                    cost += interpolate(here, size, y_after / cell[0] + centre, x_after / cell[1] + centre)
                    cost += bilinear(
                        beyond, fine.size, y_after / fine.cell[0] + fine_centre, x_after / fine.cell[1] + fine_centre
                    )
                    options[option, i * fine.size + k] = cost
        blend(value, steps.nodes[n], steps.weights[n], here)
        for i in range(fine.size):
            row = (i - fine_centre) * fine.cell[0] / cell[0] + centre
            for k in range(fine.size):
                column = (k - fine_centre) * fine.cell[1] / cell[1] + centre
                p = i * fine.size + k
                beyond[p] = least(options, p) - interpolate(here, size, row, column)


@compiled
def along(value: Any, grid: Any, chain: Any, steps: Any, car: Any, chosen: Any) -> Any:
    """Cost less penalties and h0, as of `relax`, along one drive; with w at the end and without it at the beginning.

    Args:
        value, grid, chain, steps: see `relax`.
        car: the car's states at the ends of the intervals, shape (intervals + 1, 2).
        chosen: which damping was set in each interval, shape (intervals,).
    """
    intervals, points = steps.point_nodes.shape[:2]
    size, cell, cells = grid.size, grid.cell, grid.size**2
    slices, here = np.empty((points, cells), np.float32), np.empty(cells, np.float32)
    penalty, middle = np.empty(cells, np.float32), np.empty(size, np.float32)
    centre = 0.5 * (size - 1)
    total = 0.0
    for n in range(intervals):
        a = chosen[n]
        for q in range(points):
            blend(value, steps.point_nodes[n, q], steps.point_weights[n, q], slices[q])
        penalty_table(slices, steps.factor[n, a], steps.offset[n], chain.gains[a], steps.rest[n, a], grid, middle, penalty)
        cost, mean_y, mean_x = stage(chain, steps, n, a, car[n, 0], car[n, 1])
        total += cost - interpolate(penalty, size, mean_y / cell[0] + centre, mean_x / cell[1] + centre)
    for n, sign in ((0, -1.0), (intervals, 1.0)):
        blend(value, steps.nodes[n], steps.weights[n], here)
        total += sign * interpolate(here, size, car[n, 0] / cell[0] + centre, car[n, 1] / cell[1] + centre)
    return total
