"""What vibration does to the body: the frequency weightings of ISO 2631-1, as filters of a car's signals.

    W(s) = s^2/(s^2 + w_1 s/Q_1 + w_1^2)  w_2^2/(s^2 + w_2 s/Q_2 + w_2^2)
           (1 + s/w_3)/(1 + s/(Q_4 w_4) + (s/w_4)^2)
           (1 + s/(Q_5 w_5) + (s/w_5)^2)/(1 + s/(Q_6 w_6) + (s/w_6)^2) (w_5/w_6)^2

with w_k = 2 pi f_k: band limits, the change from acceleration to velocity, and a step upwards.

Source: ISO 2631-1:1997, Mechanical vibration and shock - Evaluation of human exposure to whole-body vibration, annex A.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from .filters import SignalFilter, filtered
from .linear import Motion
from .parameters import ParameterError, shown


@dataclasses.dataclass(frozen=True, kw_only=True)
class Weighting:
    """Frequencies f_k, Hz, and quality factors Q_k, 1, of W(s).

    Attributes:
        highpass, lowpass: (f_1, Q_1) and (f_2, Q_2), the limits of the band.
        transition: (f_3, f_4, Q_4).
        step: (f_5, Q_5, f_6, Q_6).
    """

    highpass: tuple[float, float]
    lowpass: tuple[float, float]
    transition: tuple[float, float, float]
    step: tuple[float, float, float, float]

    def gain(self, s: Any) -> Any:
        """W(s) at complex frequencies s, rad/s, in their shape."""
        (f1, q1), (f2, q2), (f3, f4, q4), (f5, q5, f6, q6) = self.highpass, self.lowpass, self.transition, self.step
        w1, w2, w3, w4, w5, w6 = (2 * math.pi * f for f in (f1, f2, f3, f4, f5, f6))
        band = s**2 / (s**2 + w1 * s / q1 + w1**2) * (w2**2 / (s**2 + w2 * s / q2 + w2**2))
        transition = (1 + s / w3) / (1 + s / (q4 * w4) + (s / w4) ** 2)
        step = (1 + s / (q5 * w5) + (s / w5) ** 2) / (1 + s / (q6 * w6) + (s / w6) ** 2) * (w5 / w6) ** 2
        return band * transition * step

    @property
    def partial_fractions(self) -> tuple[Any, Any]:
        """Poles p, rad/s, and residues r of W(s): the sum of r/(s - p) and of the conjugates, shape (4,) each.

        All poles are complex, and no two the same.
        """
        pairs = np.array([self.highpass, self.lowpass, self.transition[1:], self.step[2:]])
        w, damping = 2 * np.pi * pairs[:, 0], 1 / (2 * pairs[:, 1])
        p = w * (-damping + 1j * np.sqrt(1 - damping**2))
        w3, w5 = 2 * np.pi * self.transition[0], 2 * np.pi * self.step[0]
        numerator = p**2 * w[1] ** 2 * (1 + p / w3) * w[2] ** 2 * (p**2 + w5 * p / self.step[1] + w5**2)
        distances = (p[:, None] - p) * (p[:, None] - p.conj())
        np.fill_diagonal(distances, 2j * p.imag)
        return p, numerator / distances.prod(axis=1)


WEIGHTINGS: Mapping[str, Weighting] = {
    # vertical, at the seat
    "Wk": Weighting(
        highpass=(0.4, math.sqrt(0.5)),
        lowpass=(100.0, math.sqrt(0.5)),
        transition=(12.5, 12.5, 0.63),
        step=(2.37, 0.91, 3.35, 0.91),
    ),
}


WEIGHTED: Mapping[str, Mapping[str, Any]] = {"weighted_acceleration": {"weighting": "Wk"}}  # `roadgym.cars.Car.optional`


def check_weighting(weighting: Any) -> None:
    """Raise `ParameterError` for what is not the name of a weighting."""
    if not (isinstance(weighting, str) and weighting in WEIGHTINGS):
        raise ParameterError(f"weighting must be one of {', '.join(WEIGHTINGS)}, got {shown(weighting)}")


def weighting_filter(weighting: str, source: str, natural_frequency: float) -> SignalFilter:
    """W(s) as a filter of the signal ``source``, in units of time 1/natural_frequency.

    Its partial fractions, r/(s - p) and the conjugate of each, are the sections z' = p z + |p| u, with the states Re z and Im z
    and the output 2 Re(r z)/|p|: their size is that of the source.
    """
    chosen = WEIGHTINGS[weighting]
    poles, residues = (numbers / natural_frequency for numbers in chosen.partial_fractions)
    size = np.abs(poles)
    return SignalFilter(
        source=source,
        sections=np.moveaxis(np.array([[poles.real, -poles.imag], [poles.imag, poles.real]]), -1, 0),
        entries=np.stack([size, 0 * size], axis=-1),
        outputs=np.stack([2 * residues.real / size, -2 * residues.imag / size], axis=-1),
        rate=2 * math.pi * chosen.transition[0] / natural_frequency,
    )


@functools.lru_cache(maxsize=256)
def weighted(motion: Motion, weighting: str | None, natural_frequency: float) -> Motion:
    """The equations of a car, where there is a weighting with the signal weighted_acceleration: what the body feels of it."""
    if weighting is None:
        return motion
    symbol = f"{motion.signals['acceleration'].symbol}w"
    return filtered(motion, "weighted_acceleration", symbol, weighting_filter(weighting, "acceleration", natural_frequency))
