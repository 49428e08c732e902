"""What the tables know of a road: its states, the grid over them, the rule for their noise, and how the car follows them.

The states (Z, U) of a second-order road have a polar grid. The one state Z of a first-order road has the grid of two rays, on
which U is zero.
"""

from __future__ import annotations

import abc
import math

import numpy as np

from roadgym.parameters import ParameterError
from roadgym.roads import Road

from ..checks import FloatArray
from .grid import STATE

# rings, rays, and rows (as many columns), coarse to fine
GRIDS = ((6, 16, 24), (8, 24, 36), (11, 32, 54), (11, 32, 72))
LINE_GRIDS = ((8, 2, 36), (12, 2, 54), (16, 2, 72), (24, 2, 108))
POINTS, REACH = 21, 4.0  # even ones for the noise of a line, and the last, in standard deviations before they are scaled


class RoadGrid(abc.ABC):
    """A kind of road.

    Attributes:
        state: names of the states of car and road.
        point: names of the signals that tell of the operating point.
        sizes: of the tables, coarse to fine: rings, rays, and rows.
        chance: weights of the rule for the noise of an interval, shape (points,).
    """

    state: tuple[str, ...]
    point: tuple[str, ...]
    sizes: tuple[tuple[int, int, int], ...]
    chance: FloatArray

    @property
    def signals(self) -> tuple[str, ...]:
        """All of these names."""
        return (*self.state, *self.point)

    @abc.abstractmethod
    def noise(self, covariance: FloatArray) -> FloatArray:
        """Points of the rule, in noise of this covariance of the road, shape (k, states, states): shape (k, points, 2).

        What the road has less than two states is noise of the car's own, of variance 1.
        """

    @abc.abstractmethod
    def follows(self, ratio: float, bounds: tuple[float, float]) -> FloatArray:
        """How much of Z is taken from (Y, X) in the tables, at a frequency ratio nu and a range of D, shape (2,)."""

    @abc.abstractmethod
    def deviation(self, driven: FloatArray, constant: FloatArray) -> FloatArray:
        """Root mean squares of the car's states, shape (2,), by which the table that follows a drive is made wide.

        Args:
            driven: of (Y, X), in that drive.
            constant: under the best constant damping, less what follows Z.
        """


class Plane(RoadGrid):
    """Roads of second order, with the states (Z, U)."""

    state, point = STATE, ("speed", "bandwidth")
    sizes = GRIDS
    chance = np.array([1 / 3, 1 / 6, 1 / 6, 1 / 6, 1 / 6])

    def noise(self, covariance: FloatArray) -> FloatArray:
        """Five points, exact to second moments."""
        slope = np.sqrt(np.maximum(covariance[:, 1, 1], 1e-12))
        shared = covariance[:, 0, 1] / slope
        level = np.sqrt(np.maximum(covariance[:, 0, 0] - shared**2, 0))
        first = math.sqrt(3) * np.stack([shared, slope], axis=1)
        second = math.sqrt(3) * np.stack([level, np.zeros_like(level)], axis=1)
        return np.stack([0 * first, first, -first, second, -second], axis=1)

    def follows(self, ratio: float, bounds: tuple[float, float]) -> FloatArray:
        """Nothing: the car hardly follows a road at whose speeds there is much to gain."""
        return np.zeros(2)

    def deviation(self, driven: FloatArray, constant: FloatArray) -> FloatArray:
        """Those of the drive: about resonance a constant damping leaves several times as much."""
        return driven


class Line(RoadGrid):
    """Roads of first order, with the state Z; they are Gaussian."""

    state, point = STATE[:3], ("speed",)
    sizes = LINE_GRIDS

    def __init__(self) -> None:
        nodes = np.linspace(-REACH, REACH, POINTS)
        self.chance = np.exp(-(nodes**2) / 2)
        self.chance /= self.chance.sum()
        self._nodes = nodes / np.sqrt(self.chance @ nodes**2)

    def noise(self, covariance: FloatArray) -> FloatArray:
        """Even points, at which the rule for Gaussian noise converges fastest; the car's own noise is 1 and -1 in turn.

        So it has nothing to do with the road's: the sum over points in turn vanishes to as many digits as the rule has.
        """
        road = self._nodes * np.sqrt(covariance[:, 0, 0])[:, None]
        return np.stack(np.broadcast_arrays(road, (-1.0) ** np.arange(POINTS)), axis=2)

    def follows(self, ratio: float, bounds: tuple[float, float]) -> FloatArray:
        """E YZ and E XZ at a constant damping within the range: on a slow road the car follows the level."""
        firm = 1 + 2 * math.sqrt(bounds[0] * bounds[1]) * ratio
        return np.array([1.0, ratio]) * firm / (firm + ratio**2)

    def deviation(self, driven: FloatArray, constant: FloatArray) -> FloatArray:
        """Those of the constant damping: what a firm damper would take up of the road's noise must find room."""
        return constant


PLANE, LINE = Plane(), Line()


def grid_of(road: Road) -> RoadGrid:
    """What the tables know of ``road``.

    Raises:
        ParameterError: a road that they are not for.
    """
    road_filter = road.shaping_filter()
    if road_filter is not None and road_filter.is_first_order:
        return LINE
    if road_filter is None or road_filter.bandwidth is None or road_filter.flatness is None:
        raise ParameterError(f"road must be of first order, gaussian, or multiplicative on a circle, got {road!r}")
    return PLANE
