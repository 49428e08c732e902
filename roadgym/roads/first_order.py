"""First-order road, (4) of Wedig (2020): dZ = -v W Z dt + sigma sqrt(v) dB, W = wavenumber, B a Wiener process.

The level and its integral over the substep are drawn together from their exact joint Gaussian law, so the car, which needs the
area under the level, sees no bias of the first orders. dZ/dt contains white noise: the slope is not a number, and none is kept.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ..compiled import COEFFICIENT, LANES, LEVEL, LEVEL_EXCESS, SLOPE, TURN, LaneFunction, like
from ..linear import ShapingFilter
from ..noise import normal_pair
from ..parameters import positive
from . import iso8608
from .base import Road, check_fields, check_variance

KEEP, LEVEL_NOISE = COEFFICIENT, COEFFICIENT + LANES
EXCESS_MEAN, EXCESS_SHARED, EXCESS_NOISE = COEFFICIENT + 2 * LANES, COEFFICIENT + 3 * LANES, COEFFICIENT + 4 * LANES


@LaneFunction
def prepare(lane: Any, words: Any, table: Any) -> None:
    """Joint law of the level and of its mean above the chord, for unit variance, in double precision."""
    angle = np.float64(lane[TURN])
    keep = math.exp(-angle)
    lost = -math.expm1(-angle)  # 1 - keep
    level_variance = lost * (1.0 + keep)
    lane[KEEP] = keep
    lane[LEVEL_NOISE] = math.sqrt(level_variance)
    if angle > 1e-4:
        area_variance = 2.0 * angle - 4.0 * lost + level_variance
        covariance = lost * lost
        rest = max(area_variance - covariance * covariance / level_variance, 0.0)
        lane[EXCESS_MEAN] = lost / angle - 0.5 * (1.0 + keep)
        lane[EXCESS_SHARED] = covariance / (angle * math.sqrt(level_variance)) - 0.5 * math.sqrt(level_variance)
        lane[EXCESS_NOISE] = math.sqrt(rest) / angle
    else:  # leading orders, exact to better than 1e-4 of themselves
        lane[EXCESS_MEAN] = -angle * angle / 12.0
        lane[EXCESS_SHARED] = -angle * math.sqrt(2.0 * angle) / 12.0
        lane[EXCESS_NOISE] = math.sqrt(angle / 6.0)


@LaneFunction
def start(lane: Any, words: Any, table: Any) -> None:
    """A standard normal level: the stationary law."""
    zero = like(lane, 0.0)
    lane[LEVEL], _ = normal_pair(words[0], words[LANES])
    lane[SLOPE] = zero


@LaneFunction
def advance(lanes: Any, words: Any, table: Any) -> None:
    """One exact Gaussian transition of the level and of the area under it."""
    for i in range(LANES):
        first, second = normal_pair(words[i], words[LANES + i])
        z = lanes[LEVEL + i]
        lanes[LEVEL + i] = lanes[KEEP + i] * z + lanes[LEVEL_NOISE + i] * first
        lanes[LEVEL_EXCESS + i] = (
            lanes[EXCESS_MEAN + i] * z + lanes[EXCESS_SHARED + i] * first + lanes[EXCESS_NOISE + i] * second
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class FirstOrderRoad(Road):
    """First-order Gaussian road with the spectrum (5); equation (4).

    Args:
        noise_intensity: sigma, m^(1/2).
        wavenumber: corner frequency Omega, rad/m.
    """

    kind: str = dataclasses.field(default="first_order", init=False)
    noise_intensity: float = 0.5

    constructors = {"iso_class": "from_iso8608"}  # noqa: RUF012 - of the class, as its base declares
    has_slope = False
    prepare = prepare
    start = start
    advance = advance

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(self, noise_intensity="noise_intensity")
        check_variance(self, "noise_intensity")

    @classmethod
    def from_iso8608(cls, iso_class: str | float, *, lowest_frequency: float = iso8608.LOWEST) -> FirstOrderRoad:
        """A road of a class of ISO 8608, by the geometric mean of its roughness; see `roadgym.roads.iso8608`.

        Args:
            iso_class: "A" to "H", or the density G(n0) in m^3.
            lowest_frequency: spatial frequency below which the spectrum levels off, cycles/m.
        """
        wavenumber = 2 * math.pi * positive("lowest_frequency", lowest_frequency)
        return cls(noise_intensity=math.sqrt(iso8608.strength(iso_class)), wavenumber=wavenumber)

    @property
    def variance(self) -> float:
        """E Z^2 = sigma^2 / (2 Omega), m^2; (5)."""
        return self.noise_intensity**2 / (2 * self.wavenumber)

    def shaping_filter(self, bandwidth: npt.ArrayLike | None = None) -> ShapingFilter:
        """Equation (4)."""
        return ShapingFilter(
            states=("level",),
            drift=np.array([[-1.0]]),
            noise=np.array([[math.sqrt(2.0)]]),
            level=np.array([1.0]),
            covariance=np.eye(1),
        )
