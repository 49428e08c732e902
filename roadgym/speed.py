"""Noise on the driving speed: white (18), low-pass (25) and high-pass (30) of Wedig (2020).

The angle of the road, phi = wavenumber * distance, obeys (B a Wiener process, W = wavenumber)

    white      dphi = W v dt + sigma dB
    low-pass   dphi = (W v + w_g Psi) dt,    dPsi = -w_g Psi dt + sigma dB
    high-pass  dphi = W v dt + dPsi,         dPsi = -w_g Psi dt + sigma dB

All three are linear with constant coefficients, so (Psi, the angle, the area under the angle) after a substep is drawn from its
exact joint Gaussian law; Psi starts in its stationary law.

White and high-pass noise make dphi/dt contain white noise: they are defined on the harmonic road, whose level is a function of
the angle. Low-pass noise is a random speed v(t) = v + w_g Psi / W and drives every road; on random roads the car never
reverses, so there the angle of a substep is cut at zero, which is an approximation of first order in the substep.
"""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from .compiled import (
    LANES,
    RATE,
    SPEED,
    SPEED_STATE,
    TURN,
    TURN_EXCESS,
    TURN_VARIANCE,
    LaneFunction,
    like,
)
from .component import Registry
from .noise import normal_pair
from .parameters import ParameterError, check_ratio
from .roads import Road
from .roads.base import check_fields

# the table: the substep, the pull of Psi on (Psi, angle, area), the Cholesky factor of their covariance, and four constants
INTERVAL, PULL, FACTOR, VARIANCE, RATE_GAIN, SPREAD, FLOOR = 0, 1, 4, 10, 11, 12, 13


@LaneFunction
def start(lane: Any, words: Any, table: Any) -> None:
    """Psi from its stationary law."""
    first, _ = normal_pair(words[0], words[LANES])
    lane[SPEED_STATE] = table[SPREAD] * first
    lane[RATE] = max(lane[SPEED] + table[RATE_GAIN] * lane[SPEED_STATE], table[FLOOR])


@LaneFunction
def advance(lanes: Any, words: Any, table: Any) -> None:
    """Psi, the angle of the substep, and the mean of the angle's path above its chord."""
    half = like(lanes, 0.5)
    for i in range(LANES):
        first, second = normal_pair(words[i], words[LANES + i])
        third, _ = normal_pair(words[2 * LANES + i], words[3 * LANES + i])
        state = lanes[SPEED_STATE + i]
        turn = table[PULL + 1] * state + table[FACTOR + 1] * first + table[FACTOR + 2] * second
        area = table[PULL + 2] * state + table[FACTOR + 3] * first + table[FACTOR + 4] * second + table[FACTOR + 5] * third
        state = table[PULL] * state + table[FACTOR] * first
        lanes[SPEED_STATE + i] = state
        lanes[TURN_EXCESS + i] = area / table[INTERVAL] - half * turn
        lanes[TURN_VARIANCE + i] = table[VARIANCE]
        lanes[TURN + i] = max(lanes[SPEED + i] * table[INTERVAL] + turn, table[FLOOR])
        lanes[RATE + i] = max(lanes[SPEED + i] + table[RATE_GAIN] * state, table[FLOOR])


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpeedNoise(abc.ABC):
    """Noise on the driving speed.

    Args:
        intensity: sigma, rad/s^(1/2).
    """

    kind: str = dataclasses.field(default="", init=False)
    intensity: float = 0.2

    constructors: ClassVar[Mapping[str, str]] = {}  # class methods that make it of another parameter, by that parameter
    smooth: ClassVar[bool] = False  # is the speed itself a number, that is, free of white noise
    words_per_substep: ClassVar[int] = 4
    start: ClassVar[LaneFunction] = start
    advance: ClassVar[LaneFunction] = advance

    def __post_init__(self) -> None:
        check_fields(self, intensity="noise_intensity")

    @property
    @abc.abstractmethod
    def rates(self) -> tuple[float, float, float]:
        """(w_g, pull of Psi on dphi/dt, white noise in dphi over that in Psi): rad/s, rad/s, 1."""

    @property
    def phase_spread(self) -> tuple[float, float]:
        """(p, q): the random part of the phase has the variance sigma^2 (p t - q f(t)), f(t) = (1 - exp(-w_g t))/w_g; both 1.

        By integration of Psi over the time: with (w_g, pull, white) and a = pull/w_g, p = (a + white)^2, q = a (a + 2 white).
        """
        corner, pull, white = self.rates
        share = pull / corner if corner > 0 else 0.0
        return (share + white) ** 2, share * (share + 2 * white)

    def check_road(self, road: Road) -> None:
        """Raise `ParameterError` unless this noise is defined on ``road``."""
        if not (road.takes_phase_noise or self.smooth):
            raise ParameterError(
                f"{self.kind} speed noise is defined on the harmonic road only, because the speed contains white noise; "
                f"on a {road.kind} road use low_pass speed noise or none"
            )

    def check_range(self, natural_frequency: float, *, driven: bool = True) -> None:
        """Raise `ParameterError` unless intensity and corner frequency are in their ranges on a car of this w1, rad/s.

        Those of a plant that is ``driven`` are narrower than those of closed forms.
        """
        kind = "" if driven else "constant "
        relative = self.intensity / math.sqrt(natural_frequency)
        check_ratio("intensity", self.intensity, "sigma/sqrt(w1)", relative, f"{kind}relative intensity")
        if self.rates[0] > 0:
            check_ratio(
                "corner_frequency", self.rates[0], "w_g/w1", self.rates[0] / natural_frequency, f"{kind}relative corner"
            )

    def table(self, interval: float, natural_frequency: float, road: Road) -> npt.NDArray[np.float64]:
        """Constants for a substep of ``interval``, in units of 1/natural_frequency."""
        from scipy.linalg import expm

        corner, pull, white = (rate / natural_frequency for rate in self.rates)
        white *= natural_frequency  # a plain ratio
        drift = np.array([[-corner, 0.0, 0.0], [pull, 0.0, 0.0], [0.0, 1.0, 0.0]])
        noise = np.array([1.0 if corner > 0 else 0.0, white, 0.0]) * self.intensity / math.sqrt(natural_frequency)

        def law(time: float) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
            # C. F. Van Loan, "Computing integrals involving the matrix exponential", IEEE Trans. Automat. Contr. 23, 1978,
            # over a time in which the filter moves little, since the block holds exp(+corner time) too; then doubled
            doublings = max(0, math.ceil(math.log2(max(corner * time, 1e-300))))
            part = time / 2**doublings
            block = np.block([[-drift, np.outer(noise, noise)], [np.zeros((3, 3)), drift.T]]) * part
            exponential = expm(block)
            transition = exponential[3:, 3:].T
            covariance = transition @ exponential[:3, 3:]
            for _ in range(doublings):
                covariance = transition @ covariance @ transition.T + covariance
                transition = transition @ transition
            return transition, covariance

        transition, covariance = law(interval)
        # mean variance of the angle about its chord, given where it ends: 3-point Gauss-Legendre over the substep
        bridge = 0.0
        for node, weight in ((0.5 - math.sqrt(0.15), 5 / 18), (0.5, 8 / 18), (0.5 + math.sqrt(0.15), 5 / 18)):
            part = law(node * interval)[1]
            rest = law((1 - node) * interval)[0]
            shared = (rest @ part)[1, 1]
            bridge += weight * (part[1, 1] - shared**2 / covariance[1, 1])
        factor = semidefinite_factor(covariance)
        spread = noise[0] / math.sqrt(2 * corner) if corner > 0 else 0.0
        floor = -np.inf if road.takes_phase_noise else 0.0
        return np.concatenate(
            [[interval], transition[:, 0], factor[np.tril_indices(3)], [6 * bridge, pull if self.smooth else 0, spread, floor]]
        )


def semidefinite_factor(covariance: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Lower triangular L with L L' = covariance, where the covariance may be singular to rounding."""
    size = len(covariance)
    factor = np.zeros((size, size))
    for j in range(size):
        rest = covariance[j, j] - factor[j, :j] @ factor[j, :j]
        if rest > 1e-13 * covariance[j, j]:
            factor[j, j] = math.sqrt(rest)
            for i in range(j + 1, size):
                factor[i, j] = (covariance[i, j] - factor[i, :j] @ factor[j, :j]) / factor[j, j]
    return factor


@dataclasses.dataclass(frozen=True, kw_only=True)
class WhiteSpeedNoise(SpeedNoise):
    """White noise on the angular rate; (18)."""

    kind: str = dataclasses.field(default="white", init=False)

    @property
    def rates(self) -> tuple[float, float, float]:
        """No filter: the white noise acts on the angle."""
        return 0.0, 0.0, 1.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class LowPassSpeedNoise(SpeedNoise):
    """Low-pass noise on the angular rate; (25).

    Args:
        intensity: sigma, rad/s^(1/2).
        corner_frequency: w_g, rad/s.
    """

    kind: str = dataclasses.field(default="low_pass", init=False)
    corner_frequency: float = 1.0

    smooth = True

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(self, corner_frequency="corner_frequency")

    @property
    def rates(self) -> tuple[float, float, float]:
        """Psi acts on the rate; the angle has no white noise of its own."""
        return self.corner_frequency, self.corner_frequency, 0.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class HighPassSpeedNoise(SpeedNoise):
    """High-pass noise on the angular rate; (30).

    Args:
        intensity: sigma, rad/s^(1/2).
        corner_frequency: w_g, rad/s.
    """

    kind: str = dataclasses.field(default="high_pass", init=False)
    corner_frequency: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(self, corner_frequency="corner_frequency")

    @property
    def rates(self) -> tuple[float, float, float]:
        """The angle moves with Psi, white noise included."""
        return self.corner_frequency, -self.corner_frequency, 1.0


SPEED_NOISES: Registry[SpeedNoise] = Registry(
    "speed noise",
    SpeedNoise,
    {
        "white": WhiteSpeedNoise,
        "low_pass": LowPassSpeedNoise,
        "high_pass": HighPassSpeedNoise,
    },
)


def make_speed_noise(speed_noise: str | Mapping[str, Any] | SpeedNoise | None, road: Road) -> SpeedNoise | None:
    """A speed noise for ``road`` from its name, a mapping with the key "kind", or as it is; None or "none" for none.

    Raises:
        ParameterError: unknown kind or parameter, a value out of range, or a noise that is not defined on ``road``.
    """
    if speed_noise is None or (isinstance(speed_noise, str) and speed_noise == "none"):
        return None
    noise = SPEED_NOISES.make(speed_noise)
    noise.check_road(road)
    return noise
