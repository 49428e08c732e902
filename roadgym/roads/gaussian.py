"""Gaussian second-order road, (7), (8) of Wedig (2020) with V = 1:

    dZ = v W U dt,   dU = -v W (2 delta U + Z) dt + sigma sqrt(v) dB,   W = wavenumber, B a Wiener process.

The sampled pair (Z, U) is exact in law: one 2 x 2 Gaussian transition, whose covariance is I - M M' in units of the variance
because the stationary covariance is the identity. Between samples the level is a straight line plus the area that the pair's
slopes fix; what that leaves out has variance of order (angle a substep)^5.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ..compiled import BANDWIDTH, COEFFICIENT, LANES, LEVEL, LEVEL_EXCESS, SLOPE, TURN, LaneFunction, compiled, like
from ..linear import ShapingFilter
from ..noise import normal_pair
from ..parameters import within
from . import iso8608
from .base import Road, check_fields, check_variance


@compiled
def oscillator(angle: Any, bandwidth: Any) -> tuple[float, float, float]:
    """Entries (a, b, d) of exp(angle [[0, 1], [-1, -2 delta]]) = [[a, b], [-b, d]], any bandwidth delta > 0."""
    square = (1.0 - bandwidth * bandwidth) * angle * angle
    if square > 1e-8:
        root = math.sqrt(square)
        cosine, sine = math.cos(root), angle * math.sin(root) / root
    elif square < -1e-8:
        root = math.sqrt(-square)
        cosine, sine = math.cosh(root), angle * math.sinh(root) / root
    else:  # series about critical damping, where the next term is below 1e-17
        cosine, sine = 1.0 - square / 2.0, angle * (1.0 - square / 6.0)
    decay = math.exp(-bandwidth * angle)
    return decay * (cosine + bandwidth * sine), decay * sine, decay * (cosine - bandwidth * sine)


def second_order_filter(bandwidth: npt.ArrayLike, flatness: float | None = 0.0) -> ShapingFilter:
    """Equations (7), (8) for unit variance, where the intensity of the noise is on average 4 delta."""
    delta = np.asarray(bandwidth, float)
    drift, noise = np.zeros((*delta.shape, 2, 2)), np.zeros((*delta.shape, 2, 1))
    drift[..., 0, 1], drift[..., 1, 0], drift[..., 1, 1] = 1.0, -1.0, -2 * delta
    noise[..., 1, 0] = np.sqrt(4 * delta)
    return ShapingFilter(
        states=("level", "slope"),
        drift=drift,
        noise=noise,
        level=np.array([1.0, 0.0]),
        covariance=np.eye(2),
        flatness=flatness,
        bandwidth=delta,
    )


A, B, D = COEFFICIENT, COEFFICIENT + LANES, COEFFICIENT + 2 * LANES
LEVEL_NOISE, SHARED_NOISE, SLOPE_NOISE = COEFFICIENT + 3 * LANES, COEFFICIENT + 4 * LANES, COEFFICIENT + 5 * LANES


@LaneFunction
def prepare(lane: Any, words: Any, table: Any) -> None:
    """Transition matrix and Cholesky factor of the transition covariance, in double precision (1 - a^2 - b^2 cancels)."""
    a, b, d = oscillator(np.float64(lane[TURN]), np.float64(lane[BANDWIDTH]))
    level_noise = math.sqrt(max(1.0 - a * a - b * b, 0.0))
    shared_noise = b * (a - d) / level_noise if level_noise > 0.0 else 0.0
    lane[A], lane[B], lane[D] = a, b, d
    lane[LEVEL_NOISE] = level_noise
    lane[SHARED_NOISE] = shared_noise
    lane[SLOPE_NOISE] = math.sqrt(max(1.0 - b * b - d * d - shared_noise * shared_noise, 0.0))


@LaneFunction
def start(lane: Any, words: Any, table: Any) -> None:
    """Independent standard normals: the stationary law."""
    lane[LEVEL], lane[SLOPE] = normal_pair(words[0], words[LANES])


@LaneFunction
def advance(lanes: Any, words: Any, table: Any) -> None:
    """One exact Gaussian transition."""
    twelfth = like(lanes, 1.0 / 12.0)
    for i in range(LANES):
        first, second = normal_pair(words[i], words[LANES + i])
        z, u = lanes[LEVEL + i], lanes[SLOPE + i]
        new_u = lanes[D + i] * u - lanes[B + i] * z + lanes[SHARED_NOISE + i] * first + lanes[SLOPE_NOISE + i] * second
        lanes[LEVEL + i] = lanes[A + i] * z + lanes[B + i] * u + lanes[LEVEL_NOISE + i] * first
        lanes[SLOPE + i] = new_u
        lanes[LEVEL_EXCESS + i] = lanes[TURN + i] * (u - new_u) * twelfth


@dataclasses.dataclass(frozen=True, kw_only=True)
class GaussianRoad(Road):
    """Second-order Gaussian road; equations (7), (8) with V = 1.

    Args:
        bandwidth: damping ratio delta of the road filter, 1.
        noise_intensity: sigma, m^(1/2).
        wavenumber: centre frequency Omega, rad/m.
    """

    kind: str = dataclasses.field(default="gaussian", init=False)
    bandwidth: float = 0.1
    noise_intensity: float = 0.2

    constructors = {"iso_class": "from_iso8608"}  # noqa: RUF012 - of the class, as its base declares
    prepare = prepare
    start = start
    advance = advance

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(self, bandwidth="constant bandwidth", noise_intensity="noise_intensity")
        check_variance(self, "noise_intensity")

    @classmethod
    def from_iso8608(
        cls,
        iso_class: str | float,
        *,
        lowest_frequency: float = iso8608.LOWEST,
        highest_frequency: float = iso8608.HIGHEST,
    ) -> GaussianRoad:
        """A road of a class of ISO 8608 between two corners, beyond which it is smooth; see `roadgym.roads.iso8608`.

        Args:
            iso_class: "A" to "H", or the density G(n0) in m^3.
            lowest_frequency, highest_frequency: corners of the spectrum, cycles/m.
        """
        wavenumber, bandwidth, ratio = iso8608.corners(lowest_frequency, highest_frequency)
        return cls(bandwidth=bandwidth, noise_intensity=math.sqrt(iso8608.strength(iso_class) * ratio), wavenumber=wavenumber)

    @property
    def variance(self) -> float:
        """E Z^2 = E U^2 = sigma^2 / (4 delta Omega), m^2; (9)-(12) at V = 1."""
        return self.noise_intensity**2 / (4 * self.bandwidth * self.wavenumber)

    def shaping_filter(self, bandwidth: npt.ArrayLike | None = None) -> ShapingFilter:
        """Equations (7), (8) with V = 1."""
        return second_order_filter(self.bandwidth if bandwidth is None else bandwidth)

    def with_bandwidth(self, bandwidth: float) -> GaussianRoad:
        """The same road with another bandwidth and the same variance."""
        bandwidth = within("bandwidth", bandwidth, "constant bandwidth")
        scale = math.sqrt(bandwidth / self.bandwidth)
        return dataclasses.replace(self, bandwidth=bandwidth, noise_intensity=self.noise_intensity * scale)
