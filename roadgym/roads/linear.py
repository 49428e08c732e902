"""Roads that are linear filters of white noise, of any order up to four: matrices in, an exact road out.

    dr = F r dtheta + G dB(theta),   Z = c r,   theta = wavenumber * distance

A subclass declares F, G and c (`LinearRoad.matrices`); start, transition and theory follow. At each substep the state and the
area under the level are drawn together from their exact joint Gaussian law, so the samples are exact in law at any substep, and
the car sees the right force over it, whether the slope of the road is a number or white noise.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ..compiled import COEFFICIENT, LANES, LEVEL, LEVEL_EXCESS, SLOPE, TURN, LaneFunction, compiled, like
from ..linear import FloatArray, ShapingFilter, lyapunov
from ..noise import normal_pair
from ..parameters import ParameterError
from .base import Road

ORDER = 4  # at most
STATE = COEFFICIENT  # rows of r
NORMAL = STATE + ORDER * LANES  # standard normals of this substep
NEXT = NORMAL + 6 * LANES  # r after the substep, then the excess
PULL = NEXT + (ORDER + 1) * LANES  # what they are of r before, row by row
FACTOR = PULL + (ORDER + 1) * ORDER * LANES  # lower triangle of the Cholesky factor of their covariance
ROWS = (FACTOR - COEFFICIENT) // LANES + (ORDER + 1) * (ORDER + 2) // 2

# the table: the order, then F, G G', c, the row of the slope, and the Cholesky factor of the stationary covariance
DRIFT = 1
INTENSITY = DRIFT + ORDER * ORDER
LEVEL_ROW = INTENSITY + ORDER * ORDER
SLOPE_ROW = LEVEL_ROW + ORDER
SPREAD = SLOPE_ROW + ORDER
TERMS = 14  # of Taylor's series over a part of the angle in which no rate turns by more than a quarter


@compiled
def product(one: Any, other: Any, target: Any) -> None:
    """Set ``target`` to a product of matrices, which are too small for a library's call and its copies."""
    size = len(one)
    for i in range(size):
        for k in range(size):
            total = 0.0
            for j in range(size):
                total += one[i, j] * other[j, k]
            target[i, k] = total


@compiled
def transition(drift: Any, intensity: Any, angle: Any) -> tuple[Any, Any]:
    """(Phi, Sigma): r(angle) is Phi r(0) plus noise of covariance Sigma; Taylor's series over a part of it, then doubled."""
    size = len(drift)
    doublings = 0
    part = angle
    while part * np.abs(drift).sum() > 0.25:
        part *= 0.5
        doublings += 1
    phi, term = np.eye(size), np.eye(size)
    sigma, gain = np.zeros((size, size)), intensity * part
    moved, spread = np.empty((size, size)), np.empty((size, size))
    for order in range(1, TERMS):
        product(term, drift, moved)
        product(drift, gain, spread)
        for i in range(size):
            for k in range(size):
                term[i, k] = moved[i, k] * (part / order)
                phi[i, k] += term[i, k]
                sigma[i, k] += gain[i, k]
                gain[i, k] = (spread[i, k] + spread[k, i]) * (part / (order + 1))
    for _ in range(doublings):
        product(phi, sigma, moved)
        product(moved, phi.T, spread)
        sigma += spread
        product(phi, phi, moved)
        phi[:] = moved
    return phi, sigma


@LaneFunction
def prepare(lane: Any, words: Any, table: Any) -> None:
    """Joint law of the state and of the level's mean above its chord, in double precision."""
    order, angle = int(table[0]), np.float64(lane[TURN])
    size = order + 1
    # the area under the level is one state more
    drift, intensity = np.zeros((size, size)), np.zeros((size, size))
    level = np.zeros(order)
    for i in range(order):
        level[i] = table[LEVEL_ROW + i]
        drift[order, i] = level[i]
        for k in range(order):
            drift[i, k] = table[DRIFT + ORDER * i + k]
            intensity[i, k] = table[INTENSITY + ORDER * i + k]
    phi, sigma = transition(drift, intensity, angle)
    # excess = area/angle - (Z before + Z after)/2
    turn = np.eye(size)
    turn[order, order] = 1.0 / angle if angle > 0.0 else 0.0
    turn[order, :order] = -0.5 * level
    pull = turn @ phi
    covariance = turn @ sigma @ turn.T
    for i in range(size):
        for k in range(order):
            before = 0.5 * level[k] if i == order else 0.0
            lane[PULL + (ORDER * i + k) * LANES] = pull[i, k] - before
    factor = np.zeros((size, size))
    for k in range(size):
        rest = covariance[k, k]
        for j in range(k):
            rest -= factor[k, j] * factor[k, j]
        if rest > 1e-12 * covariance[k, k]:
            factor[k, k] = math.sqrt(rest)
            for i in range(k + 1, size):
                shared = covariance[i, k]
                for j in range(k):
                    shared -= factor[i, j] * factor[k, j]
                factor[i, k] = shared / factor[k, k]
    for i in range(size):
        for k in range(i + 1):
            lane[FACTOR + (i * (i + 1) // 2 + k) * LANES] = factor[i, k]


@LaneFunction
def start(lane: Any, words: Any, table: Any) -> None:
    """The stationary law, with four words."""
    order, zero = int(table[0]), like(lane, 0.0)
    first, second = normal_pair(words[0], words[LANES])
    third, fourth = normal_pair(words[2 * LANES], words[3 * LANES])
    lane[LEVEL], lane[SLOPE] = zero, zero
    for i in range(order):
        row = SPREAD + ORDER * i
        value = table[row] * first + table[row + 1] * second + table[row + 2] * third + table[row + 3] * fourth
        lane[STATE + i * LANES] = value
        lane[LEVEL] += table[LEVEL_ROW + i] * value
        lane[SLOPE] += table[SLOPE_ROW + i] * value


@LaneFunction
def advance(lanes: Any, words: Any, table: Any) -> None:
    """One exact Gaussian transition of the state and of the area under the level."""
    order, zero = int(table[0]), like(lanes, 0.0)
    for pair in range((order + 2) // 2):
        word, row = 2 * pair * LANES, NORMAL + 2 * pair * LANES
        for i in range(LANES):
            lanes[row + i], lanes[row + LANES + i] = normal_pair(words[word + i], words[word + LANES + i])
    for k in range(order + 1):
        row = NEXT + k * LANES
        for i in range(LANES):
            lanes[row + i] = zero
        for j in range(order):
            pull, state = PULL + (ORDER * k + j) * LANES, STATE + j * LANES
            for i in range(LANES):
                lanes[row + i] += lanes[pull + i] * lanes[state + i]
        for j in range(k + 1):
            factor, normal = FACTOR + (k * (k + 1) // 2 + j) * LANES, NORMAL + j * LANES
            for i in range(LANES):
                lanes[row + i] += lanes[factor + i] * lanes[normal + i]
    for i in range(LANES):
        lanes[LEVEL + i], lanes[SLOPE + i] = zero, zero
        lanes[LEVEL_EXCESS + i] = lanes[NEXT + order * LANES + i]
    for k in range(order):
        state, following = STATE + k * LANES, NEXT + k * LANES
        level, slope = table[LEVEL_ROW + k], table[SLOPE_ROW + k]
        for i in range(LANES):
            value = lanes[following + i]
            lanes[state + i] = value
            lanes[LEVEL + i] += level * value
            lanes[SLOPE + i] += slope * value


@dataclasses.dataclass(frozen=True, kw_only=True)
class LinearRoad(Road):
    """A road that is a linear filter of white noise, of order four at most.

    A subclass is a frozen keyword-only dataclass that supplies `matrices` and the ``variance``; where the level's rate contains
    white noise, it says ``has_slope = False``.
    """

    rows = ROWS
    prepare = prepare
    start = start
    advance = advance

    @abc.abstractmethod
    def matrices(self) -> tuple[npt.ArrayLike, npt.ArrayLike, npt.ArrayLike]:
        """F, shape (n, n), stable; G, shape (n, m); and c, shape (n,), over the angle and up to the scale of G."""

    @functools.cached_property
    def _filter(self) -> ShapingFilter:
        """The filter with states and level of unit variance.

        Raises:
            ParameterError: matrices that are not those of a stable road of order four at most, or a slope that is not as said.
        """
        drift, noise, level = (np.asarray(matrix, float) for matrix in self.matrices())
        size = len(level)
        if not 1 <= size <= ORDER or drift.shape != (size, size) or noise.shape[:1] != (size,) or noise.ndim != 2:
            shapes = f"(n, n), (n, m), (n,), n <= {ORDER}, got {drift.shape}, {noise.shape}, {level.shape}"
            raise ParameterError(
                f"matrices of a {self.kind} road must have the shapes (n, n), (n, m), (n,), n <= {ORDER}, got {shapes}"
            )
        if not np.linalg.eigvals(drift).real.max() < 0:
            raise ParameterError(f"matrices of a {self.kind} road must be stable: eigenvalues below zero")
        covariance = lyapunov(drift, noise @ noise.T)
        scale = np.sqrt(np.diag(covariance))
        if not (np.all(scale > 0) and level @ covariance @ level > 0):
            raise ParameterError(f"matrices of a {self.kind} road must move every state, and the level")
        if bool(np.any(level @ noise)) == self.has_slope:
            raise ParameterError(f"has_slope of a {self.kind} road must tell whether its level's rate is free of white noise")
        level = level * scale
        return ShapingFilter(
            states=tuple(f"road state {k + 1}" for k in range(size)),
            drift=drift * scale / scale[:, None],
            noise=noise / scale[:, None],
            level=level / math.sqrt(level @ (covariance / np.outer(scale, scale)) @ level),
            covariance=covariance / np.outer(scale, scale),
        )

    def shaping_filter(self, bandwidth: npt.ArrayLike | None = None) -> ShapingFilter:
        """`matrices`, scaled so that every state and the level have the variance 1."""
        return self._filter

    @property
    def state_rows(self) -> tuple[int, ...]:
        """Those from STATE on."""
        return tuple(STATE + k * LANES for k in range(len(self._filter.states)))

    @property
    def words_per_substep(self) -> int:  # type: ignore[override]
        """Two for each pair of normals: one normal a state, and one for the area."""
        return 2 * ((len(self._filter.level) + 2) // 2)

    def table(self) -> FloatArray:
        """Order and matrices."""
        road = self._filter
        size = len(road.level)

        def square(matrix: FloatArray) -> FloatArray:
            padded = np.zeros((ORDER, ORDER))
            padded[:size, :size] = matrix
            return padded.ravel()

        rows = np.zeros((2, ORDER))
        rows[:, :size] = road.level, road.level @ road.drift * self.has_slope
        spread = np.linalg.cholesky(road.covariance).astype(float)
        return np.concatenate([[size], square(road.drift), square(road.noise @ road.noise.T), *rows, square(spread)])
