"""Relative value iteration on a table."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.interpolate import make_interp_spline

from roadgym.compiled import compiled

from ..checks import FloatArray
from .grid import ZERO, SingleArray, add_shifted, interpolate, minimise
from .model import NODE, NODES, Model

SWEEPS, CHECK, SETTLED = 400, 5, 1e-3  # at most; between two checks; rms change of the value over the cost that ends them
# coefficients of t, ..., t^4 of the polynomial through (t_k, q_k), less its constant, from the differences q_k - q_0
POLYNOMIAL = np.linalg.inv(np.vander(NODE, NODES, increasing=True))[1:, 1:].astype(np.float32)


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
    chance: Any,
    forms: Any,
    shape: Any,
    cell: Any,
) -> None:
    """Bellman's operator at the road nodes ``begin`` to ``end`` of the computed half; also the policy, unless it is empty.

    Args:
        old, new: the tabulated value, shape (rings * rays, rows * columns).
        policy: coefficients of the polynomials in the variable of D, shape (rings * rays, rows * columns, 4), or no entry.
        index, weight: stencils of the road's step, shape (nodes, points, 16).
        offset: its points less their mean, with what noise of its own the car has, shape (nodes, points, 2).
        road: (z, u) of the nodes, shape (nodes, 2).
        maps: mean of the car's step, shape (NODES, 2, 4).
        gains: how it follows that noise, shape (NODES, 2, 2).
        chance: weights of the points, shape (points,).
        forms: interval cost plus drift of h0, see `Model`, shape (NODES, 11).
        shape: rings, rays, rows.
        cell: sides of the rectangle's cells, shape (2,).
    """
    rays, size = shape[1], shape[2]
    cells = size * size
    centre = 0.5 * (size - 1)
    points = len(chance)
    tables = np.empty((points, cells), np.float32)
    expected = np.empty((NODES, cells), np.float32)
    middle = np.empty(size, np.float32)
    q = np.empty((NODES, size))
    coefficients = np.empty((4, size), np.float32)
    place, least = np.empty(size, np.float32), np.empty(size, np.float32)
    for node in range(begin, end):
        for j in range(points):
            table = tables[j]
            table[:] = ZERO
            for m in range(16):
                source, w = old[index[node, j, m]], weight[node, j, m]
                for k in range(cells):
                    table[k] += w * source[k]
        for a in range(NODES):
            expected[a, :] = ZERO
            for j in range(points):
                dz, du = offset[node, j, 0], offset[node, j, 1]
                row_shift = (gains[a, 0, 0] * dz + gains[a, 0, 1] * du) / cell[0]
                column_shift = (gains[a, 1, 0] * dz + gains[a, 1, 1] * du) / cell[1]
                add_shifted(tables[j], size, row_shift, column_shift, np.float32(chance[j]), middle, expected[a])
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
                    value = interpolate(e, size, row_start + row_step * x, column_start + column_step * x)
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


Share = Callable[[int, Callable[..., None]], None]


@contextlib.contextmanager
def sharing(threads: int) -> Iterator[Share]:
    """A function that runs ``function(begin, end)`` over parts of a range, one a thread; parts write to places of their own."""
    with ThreadPoolExecutor(threads) as pool:

        def share(count: int, function: Callable[[int, int], None]) -> None:
            edges = [count * k // threads for k in range(threads + 1)]
            for future in [pool.submit(function, low, high) for low, high in itertools.pairwise(edges)]:
                future.result()

        yield share


def settle(
    apply: Callable[[SingleArray, SingleArray, SingleArray], None],
    value: SingleArray,
    centre: int,
    policy: SingleArray,
    told: Callable[[float], None],
    *,
    sweeps: int = SWEEPS,
    check: int = CHECK,
) -> tuple[float, int]:
    """Apply Bellman's operator until the value changes by the same everywhere: (that change, sweeps).

    Args:
        apply: called as ``apply(old, new, policy)``: sets the new value, and the policy unless that is empty.
        value: the tabulated value to begin with, which is overwritten.
        centre: where in it the relative value is zero.
        policy: set by the last application.
        told: called with the share that is done, now and then.
        sweeps, check: at most as many, and as many between two looks at the change.
    """
    old, new = value, np.empty_like(value)
    done, expected, settled = 0, 0.0, False
    while not settled and done < sweeps:
        for _ in range(check):
            apply(old, new, policy[:0])
            old, new = new, old
        done += check
        change = old - new
        expected = float(np.mean(change, dtype=float))
        settled = float(np.std(change, dtype=float)) <= SETTLED * abs(expected)
        old -= old.flat[centre]  # single precision has its digits where the value is near zero
        told(done / sweeps)
    apply(old, new, policy)
    return expected, done


Tabulated = tuple[SingleArray, Sequence[int], FloatArray]  # a value, its rings, rays and rows, and its box


def regridded(coarse: Tabulated, shape: Sequence[int], box: FloatArray) -> SingleArray:
    """A tabulated value on another grid by cubic splines, where that is wider by the value at the edge."""
    value, (rings, rays, rows), side = coarse
    new_rings, new_rays, new_rows = shape
    values = value.reshape(rings, rays, rows, rows).astype(float)
    values = np.concatenate([values, values[:, :1]], axis=1)  # the rays close
    places = [
        (np.arange(new_rings) + 0.5) * (rings - 0.5) / (new_rings - 0.5) - 0.5,
        np.arange(new_rays) * rays / new_rays,
        *((1 + np.linspace(-1, 1, new_rows) * box[k] / side[k]) * (rows - 1) / 2 for k in range(2)),
    ]
    for axis, place in enumerate(places):
        count = values.shape[axis]
        values = make_interp_spline(np.arange(count), values, k=min(3, count - 1), axis=axis)(np.clip(place, 0, count - 1))
    return np.ascontiguousarray(values.reshape(new_rings * new_rays, new_rows**2), np.float32)


def tabulate(
    model: Model,
    shape: npt.NDArray[np.int64],
    box: FloatArray,
    share: Share,
    told: Callable[[float], None],
    coarse: Tabulated | None = None,
) -> tuple[SingleArray, SingleArray, float, int]:
    """Relative value iteration: (value, policy, average cost that the table expects, sweeps).

    The value is the tabulated part w before its results, shape (rings * rays, rows * columns). With a ``coarse`` one to begin
    with, a half to a tenth of the sweeps are left.
    """
    rings, rays, size = shape.tolist()
    road, offset, index, weight = model.road_step(rings, rays)
    cell = 2 * box / (size - 1)
    value = np.zeros((rings * rays, size * size), np.float32) if coarse is None else regridded(coarse, shape.tolist(), box)
    policy = np.empty((*value.shape, 4), np.float32)

    def apply(old: SingleArray, new: SingleArray, target: SingleArray) -> None:
        def part(begin: int, end: int) -> None:
            plant = model.maps, model.gains, model.grid.chance, model.forms
            sweep(begin, end, old, new, target, index, weight, offset, road, *plant, shape, cell)

        share(len(road), part)

    expected, done = settle(apply, value, size * size // 2, policy, told)
    return value, policy.reshape(rings, rays, size, size, 4), expected, done
