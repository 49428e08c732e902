"""What a road and its noise are to the inner problems: points about the conditional mean, and factors whose mean is zero.

A function f of car and road after an interval is nearly an interpolation, in the noise, of its values at some points. That less
its conditional mean is the sum of the values at the points times a factor each: the interpolation's cardinal functions at the
noise that came, less their exact conditional means. So the mean of the sum is zero for any f, given state and damping.
"""

from __future__ import annotations

import abc
from typing import NamedTuple

import numpy as np

from roadgym.task import Task

from ...checks import FloatArray
from .moments import NoisePolynomials, RoadMoments, hermite

# even degrees of the polynomials in the noise of the slope, and in what of the level's does not follow from it
DEGREES = (10, 4)
POINTS, REACH = 21, 4.0  # even ones in the noise of a single state, and the last, in standard deviations
OWN = 2  # even degree in what of the car's noise does not follow from that


class Expanded(NamedTuple):
    """The noise of some intervals.

    Attributes:
        mean: of the road, shape (intervals, 2).
        offset: points of the noise, shape (intervals, points, 2); the first is no noise.
        factor: see above, shape (intervals, dampings, points).
        rest: of the car's noise, what does not follow that of the points, shape (intervals, dampings, 2).
    """

    mean: FloatArray
    offset: FloatArray
    factor: FloatArray
    rest: FloatArray


class Expansion(abc.ABC):
    """The noise of a road of one operating point.

    Args:
        task: the plant at the operating point.
        gains: how the car's noise follows that of the points at each damping, shape (dampings, 2, 2).
    """

    def __init__(self, task: Task, gains: FloatArray) -> None:
        road = task.road.shaping_filter()
        assert road is not None
        self._road, self._gains = road, gains
        self._ratio = float(task.frequency_ratio(task.speed[0]))
        self._interval = task.control_interval * task.car.natural_frequency

    @abc.abstractmethod
    def __call__(self, before: FloatArray, after: FloatArray, noise: FloatArray) -> Expanded:
        """The noise of intervals from the road ``before`` to ``after``.

        Args:
            before, after: states of the road, shape (intervals, states).
            noise: of the car, shape (intervals, dampings, 2).
        """


class PlaneExpansion(Expansion):
    """The road has two states, and the car's noise nearly follows theirs: polynomials (`NoisePolynomials`)."""

    def __init__(self, task: Task, gains: FloatArray) -> None:
        super().__init__(task, gains)
        self._polynomials = NoisePolynomials(RoadMoments(self._road, self._ratio, self._interval, sum(DEGREES)), *DEGREES)

    def __call__(self, before: FloatArray, after: FloatArray, noise: FloatArray) -> Expanded:
        """See `Expansion`."""
        mean, offset, factor = self._polynomials(before, after)
        rest = noise - np.einsum("aij,nj->nai", self._gains, after - mean)
        return Expanded(mean, offset, np.repeat(factor[:, None], len(self._gains), axis=1), rest)


class LineExpansion(Expansion):
    """The road has one state, and is Gaussian; the car has noise of its own beside it, another at each damping.

    In the road's noise the interpolation is by cubics between even points, whose means under the Gaussian law are numbers; a
    polynomial in the car's own multiplies it.
    """

    def __init__(self, task: Task, gains: FloatArray) -> None:
        super().__init__(task, gains)
        nodes = np.linspace(-REACH, REACH, POINTS)
        self._order = np.argsort(np.abs(nodes), kind="stable")
        own, self._series, self._values = hermite(OWN)
        self._nodes = np.stack(np.meshgrid(nodes[self._order], own, indexing="ij"), axis=-1).reshape(-1, 2)
        fine = np.linspace(-9.0, 9.0, 90001)
        chance = np.exp(-(fine**2) / 2)
        self._mean = np.outer(chance / chance.sum() @ self._along(fine), self._values[:, 0])

    def _along(self, noise: FloatArray) -> FloatArray:
        """The cardinal functions of the cubics at the road's ``noise``, shape (k,), constant beyond: shape (k, points)."""
        place = (np.clip(noise, -REACH, REACH) + REACH) * (POINTS - 1) / (2 * REACH)
        first = np.clip(place.astype(np.int64) - 1, 0, POINTS - 4)
        t = place - first
        a, b, c = t - 1, t - 2, t - 3
        found = np.zeros((len(noise), POINTS))
        cubics = np.stack([-a * b * c / 6, t * b * c / 2, -t * a * c / 2, t * a * b / 6], axis=1)
        np.put_along_axis(found, first[:, None] + np.arange(4), cubics, axis=1)
        return found[:, self._order]

    def __call__(self, before: FloatArray, after: FloatArray, noise: FloatArray) -> Expanded:
        """See `Expansion`."""
        keep = np.exp(-self._ratio * self._interval)
        deviation = np.sqrt(1 - keep**2)
        mean = np.column_stack([keep * before[:, 0], np.zeros(len(before))])
        came = after[:, 0] - mean[:, 0]
        follows, own = self._gains[:, :, 0], self._gains[:, :, 1]
        left = noise - came[:, None, None] * follows
        e = np.einsum("nai,ai->na", left, own / np.sum(own**2, axis=1, keepdims=True))
        powers = e[..., None] ** np.arange(OWN + 1)
        across = powers @ (self._values @ self._series).T
        factor = self._along(came / deviation)[:, None, :, None] * across[:, :, None, :] - self._mean
        offset = np.broadcast_to(self._nodes * [deviation, 1.0], (len(before), *self._nodes.shape))
        return Expanded(mean, np.ascontiguousarray(offset), factor.reshape(*e.shape, -1), left - e[..., None] * own)


EXPANSIONS: dict[int, type[Expansion]] = {1: LineExpansion, 2: PlaneExpansion}  # by the number of the road's states
