"""Compiled code: a table of four axes, its interpolation, Bellman's operator on it, and the feedback that it holds."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from roadgym.compiled import compiled

from ..grid import LANE, ZERO, cubic, locate, minimise

CHANCE = np.array([1 / 3, 1 / 6, 1 / 6, 1 / 6, 1 / 6])  # of the rule for the noise of an interval
NODES = 3  # of the variable of D, at -1, 0 and 1, for the tabulated part
DEGREE = 4  # of the polynomials of the exact part in that variable
TERMS = 11  # of a quadratic form of four states: 00, 01, ..., 33 of the upper triangle, and 1
HALF = np.float32(0.5)


@compiled
def interpolate(table: Any, place: Any, shape: Any) -> Any:
    """The flat ``table`` at a ``place`` given in cells from the first node of each axis; kept within the grid."""
    i, t = locate(place[0], shape[0])
    a = cubic(t)
    j, t = locate(place[1], shape[1])
    b = cubic(t)
    k, t = locate(place[2], shape[2])
    c = cubic(t)
    n, t = locate(place[3], shape[3])
    d0, d1, d2, d3 = cubic(t)
    total = ZERO
    for p in range(4):
        for q in range(4):
            start = (((i + p) * shape[1] + j + q) * shape[2] + k) * shape[3] + n
            part = ZERO
            for r in range(4):
                row = start + r * shape[3]
                part += c[r] * (d0 * table[row] + d1 * table[row + 1] + d2 * table[row + 2] + d3 * table[row + 3])
            total += a[p] * b[q] * part
    return total


@compiled
def spread(begin: int, end: int, value: Any, shift: Any, shape: Any, result: Any) -> None:
    """The mean of ``value`` over the noise of the first two axes, at their nodes ``begin`` to ``end``.

    Args:
        value, result: shape (nodes of the first two axes, nodes of the others).
        shift: the points of the rule, in cells of the first two axes, shape (points, 2).
        shape: nodes of each axis.
    """
    for node in range(begin, end):
        row = result[node]
        row[:] = ZERO
        for point in range(len(CHANCE)):
            i, t = locate(node // shape[1] + shift[point, 0], shape[0])
            a = cubic(t)
            j, t = locate(node % shape[1] + shift[point, 1], shape[1])
            b = cubic(t)
            for p in range(4):
                for q in range(4):
                    weight = np.float32(CHANCE[point]) * a[p] * b[q]
                    source = value[(i + p) * shape[1] + j + q]
                    for k in range(len(row)):
                        row[k] += weight * source[k]


@compiled
def polynomial(x: Any, forms: Any, power: int) -> Any:
    """The quadratic form that is the coefficient of this ``power`` of the variable of D, with its constant, at a state x."""
    total, term = forms[power, TERMS - 1], 0
    for i in range(4):
        for k in range(i, 4):
            total += forms[power, term] * x[i] * x[k]
            term += 1
    return total


@compiled
def sweep(begin: int, end: int, tables: Any, maps: Any, forms: Any, cell: Any, shape: Any, new: Any, policy: Any) -> None:
    """Bellman's operator at the nodes ``begin`` to ``end`` of the first two axes; also the policy, unless it is empty.

    Args:
        tables: value after the noise of an interval, at each node of D, shape (NODES, nodes).
        maps: what an interval makes of the state on average, shape (NODES, 4, 4).
        forms: see `analysis.feedback.white.model.Model`, shape (DEGREE + 1, TERMS).
        cell: sides of the grid's cells, shape (4,).
        shape: nodes of each axis.
        new: the value, flat; the mirrored half is written too.
        policy: coefficients of the tabulated part in the variable of D and in its square, shape (nodes, 2), or no entry.
    """
    count = shape[3]
    last = new.size - 1
    x, place = np.empty(4), np.empty(4)
    base = np.empty(count)
    coefficients = np.empty((DEGREE, count), np.float32)
    best, least = np.empty(count, np.float32), np.empty(count, np.float32)
    for node in range(begin, end):
        x[0] = (node // shape[1] - 0.5 * (shape[0] - 1)) * cell[0]
        x[1] = (node % shape[1] - 0.5 * (shape[1] - 1)) * cell[1]
        for k in range(shape[2]):
            x[2] = (k - 0.5 * (shape[2] - 1)) * cell[2]
            first = (node * shape[2] + k) * count
            for n in range(count):
                x[3] = (n - 0.5 * (count - 1)) * cell[3]
                found = (ZERO, ZERO, ZERO)
                for choice in range(NODES):
                    for i in range(4):
                        m = maps[choice, i]
                        moved = m[0] * x[0] + m[1] * x[1] + m[2] * x[2] + m[3] * x[3]
                        place[i] = moved / cell[i] + 0.5 * (shape[i] - 1)
                    found = (found[1], found[2], interpolate(tables[choice], place, shape))
                linear, square = HALF * (found[2] - found[0]), HALF * (found[2] + found[0]) - found[1]
                base[n] = found[1] + polynomial(x, forms, 0)
                for power in range(1, DEGREE + 1):
                    coefficients[power - 1, n] = polynomial(x, forms, power)
                coefficients[0, n] += linear
                coefficients[1, n] += square
                if policy.size:
                    policy[first + n, 0] = policy[last - first - n, 0] = linear
                    policy[first + n, 1] = policy[last - first - n, 1] = square
            minimise(coefficients, count, best, least)
            for n in range(count):
                start = coefficients[1, n] - coefficients[0, n] + coefficients[3, n] - coefficients[2, n]
                new[first + n] = new[last - first - n] = base[n] + start + least[n]


@compiled
def respond(
    begin: int,
    end: int,
    states: Any,
    columns: Any,
    tables: Any,
    coordinates: Any,
    scale: float,
    forms: Any,
    cell: Any,
    shape: Any,
    variable: Any,
    damping: Any,
) -> None:
    """The feedback for the rows ``begin`` to ``end`` of ``states``, of which the ``columns`` are those of car and road.

    Args:
        tables: the policy, a flat table of each coefficient, shape (2, nodes).
        coordinates: of the table, as rows of the state, shape (4, states).
        scale: of the tabulated part in the forms' units.
        forms: coefficients of the powers of the variable of D, quadratic forms of the state, shape (DEGREE, states, states);
            their constants, shape (DEGREE,), in a column more.
        cell, shape: of the grid.
        variable: (middle, half range, rate), see `analysis.feedback.grid.variable_of`.
        damping: takes the result, float32.
    """
    size = len(columns)
    x, place = np.empty(size), np.empty(4)
    coefficients = np.empty((DEGREE, LANE), np.float32)
    best, least = np.empty(LANE, np.float32), np.empty(LANE, np.float32)
    for first in range(begin, end, LANE):
        count = min(LANE, end - first)
        for n in range(count):
            for i in range(size):
                x[i] = states[first + n, columns[i]]
            for i in range(4):
                total = 0.0
                for k in range(size):
                    total += coordinates[i, k] * x[k]
                place[i] = total / cell[i] + 0.5 * (shape[i] - 1)
            for power in range(DEGREE):
                total = forms[power, 0, size]
                for i in range(size):
                    for k in range(size):
                        total += forms[power, i, k] * x[i] * x[k]
                coefficients[power, n] = total
            for power in range(2):
                coefficients[power, n] += scale * interpolate(tables[power], place, shape)
        minimise(coefficients, count, best, least)
        for n in range(count):
            damping[first + n] = -math.log1p(-(variable[0] + variable[1] * best[n])) / variable[2]
