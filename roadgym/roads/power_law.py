"""Roads of any waviness: the spectral density of the height falls with the power w of the spatial frequency, over a band.

    G(n) = G(n0) (n/n0)^-w,    n0 = 0.1 cycles/m

Measured roads have a waviness w of some 1.7 to 3.3, where ISO 8608 takes 2, and often one for their long waves and another for
their short ones. No filter of finite order has such a spectrum, unless w = 2; a chain of poles and zeros in turn comes near it
(A. Oustaloup et al., "Frequency-band complex noninteger differentiator", IEEE Trans. Circuits Syst. I 47, 2000). The road is

    Z = gain / (s + p1)  (s + z1)/(s + p2)  (s + z2)/(s + p3)  1/(s + p4)  white noise,    s = d/dtheta,

whose six corners are fitted to the law with its two ends rounded as filters round them, x = n/lowest frequency, R = highest
over lowest frequency:

    (1 + x^2)^(-w/2) / (1 + (x/R)^2),    beyond a break at x = b times (x/b)^(w1 - w2).

With w = 2 both pairs cancel, and it is the Gaussian road between two corners, exactly. Beyond the highest frequency the
density falls faster by n^-2 than before, so that the slope of the road is a number. How near a road comes to its law it says
itself (`PowerLawRoad.spectrum_error`): over three decades within 0.2 dB for w from 1.5 to 3, and over one and a half within
0.03 dB; with two slopes within 1.5 dB, which it misses at the break, that it rounds, and within 0.6 dB in the root mean square.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from ..linear import FloatArray, lyapunov
from ..parameters import ParameterError, positive, shown, within
from . import iso8608
from .base import check_fields, check_variance
from .linear import LinearRoad

NODES = 201  # of the fit; those of Chebyshev, dense towards the ends, keep the largest error near its least
DECIBEL = 10 / math.log(10)
SIDES = ("below", "above")


def law(x: FloatArray, waviness: tuple[float, float], highest: float, broken: float) -> FloatArray:
    """Logarithm of the law above, up to a constant, at frequencies ``x`` over the lowest."""
    long, short = waviness
    rounded = -long / 2 * np.log1p(x * x) - np.log1p((x / highest) ** 2)
    return rounded + (long - short) * np.log(np.maximum(x / broken, 1.0))


def gain(x: FloatArray, poles: FloatArray, zeros: FloatArray) -> FloatArray:
    """Logarithm of the squared gain of the chain at frequencies ``x``."""
    square = x * x
    return np.asarray(np.log(square + zeros[:, None] ** 2).sum(axis=0) - np.log(square + poles[:, None] ** 2).sum(axis=0))


@functools.cache
def corners(waviness: tuple[float, float], highest: float, broken: float) -> tuple[tuple[float, ...], tuple[float, ...], float]:
    """(p1, p2, p3, p4), (z1, z2), and the logarithm of the squared gain, by least squares of the logarithm of the spectrum."""
    from scipy.optimize import least_squares

    width = math.log(highest)
    x = np.exp(width * (1 + np.cos(math.pi * (np.arange(NODES) + 0.5) / NODES)) / 2)
    target = law(x, waviness, highest, broken)

    def chain(parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        ends, middles, halves = np.exp(parameters[:2]), parameters[2:4], parameters[4:]
        pairs = np.exp([middles - halves, middles + halves])
        return np.array([ends[0], *pairs[0], ends[1]]), pairs[1]

    def difference(parameters: FloatArray) -> FloatArray:
        return gain(x, *chain(parameters)) - target

    def away(parameters: FloatArray) -> FloatArray:
        found = difference(parameters)
        return np.asarray(found - found.mean())

    # A pair falls with n^-4 in place of n^-2 (or not at all) from its pole to its zero, over the share that this takes. There
    # is one for each half of the band, or for each side of the break.
    limits = np.array([[-2.0, width - 2, -2.0, -2.0, -width, -width], [2.0, width + 2, width + 2, width + 2, width, width]])
    fits = []
    for middles in width * np.array([0.25, 0.75]), np.array([math.log(broken) / 2, (math.log(broken) + width) / 2]):
        slopes = np.where(np.exp(middles) < broken, *waviness)
        start = np.concatenate([[0.0, width], middles, (slopes - 2) * width / 8])
        fits.append(least_squares(away, start, bounds=limits))
    found = min(fits, key=lambda fit: fit.cost).x
    poles, zeros = chain(found)
    return tuple(poles.tolist()), tuple(zeros.tolist()), -float(difference(found).mean())


@dataclasses.dataclass(frozen=True, kw_only=True)
class PowerLawRoad(LinearRoad):
    """Gaussian road of fourth order whose spectral density falls with a power of the frequency over a band.

    Args:
        deviation: standard deviation of the level, m.
        waviness: w, 1; or a pair, that below and that above the break.
        band_ratio: highest over lowest frequency of the band, 1.
        break_ratio: frequency of the break over the lowest, 1; with a pair only.
        wavenumber: lowest frequency of the band, rad/m.
    """

    kind: str = dataclasses.field(default="power_law", init=False)
    deviation: float = 0.5
    waviness: float | tuple[float, float] = 2.5
    band_ratio: float = 30.0
    break_ratio: float | None = None

    constructors = {"iso_class": "from_iso8608"}  # noqa: RUF012 - of the class, as its base declares

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(self, deviation="length", band_ratio="band ratio")
        check_variance(self, "deviation")
        object.__setattr__(self, "waviness", checked_waviness(self.waviness))
        if isinstance(self.waviness, float) != (self.break_ratio is None):
            raise ParameterError(f"break_ratio must be given with a pair of waviness, and only then, got {self.break_ratio!r}")
        if self.break_ratio is not None:
            check_fields(self, break_ratio="band ratio")
            if self.break_ratio >= self.band_ratio:
                raise ParameterError(f"break_ratio must be below band_ratio, {self.band_ratio:g}, got {self.break_ratio:g}")

    @classmethod
    def from_iso8608(
        cls,
        iso_class: str | float,
        *,
        waviness: float | tuple[float, float] = 2.0,
        break_frequency: float | None = None,
        lowest_frequency: float = iso8608.LOWEST,
        highest_frequency: float = iso8608.HIGHEST,
    ) -> PowerLawRoad:
        """A road with the density of a class of ISO 8608 at n0, and a waviness of one's own; see `roadgym.roads.iso8608`.

        Args:
            iso_class: "A" to "H", or the density G(n0) in m^3.
            waviness: w, 1; or a pair, that below and that above the break.
            break_frequency: the break, cycles/m; with a pair only.
            lowest_frequency, highest_frequency: ends of the band, cycles/m.
        """
        wavenumber, _, ratio = iso8608.corners(lowest_frequency, highest_frequency)
        wavenumber = 2 * math.pi * (low := positive("lowest_frequency", lowest_frequency))
        broken = None if break_frequency is None else positive("break_frequency", break_frequency) / low
        unit = cls(deviation=1.0, waviness=waviness, band_ratio=ratio, break_ratio=broken, wavenumber=wavenumber)
        density = iso8608.strength(iso_class) / (2 * math.pi**2 * iso8608.REFERENCE**2)
        return dataclasses.replace(unit, deviation=math.sqrt(density / unit.roughness))

    @property
    def variance(self) -> float:
        """E Z^2, m^2."""
        return self.deviation**2

    @property
    def roughness(self) -> float:
        """G(n0) of the law, m^3; where n0 is outside the band, of the law as it goes on there."""
        long, short = self._slopes
        intensity = 2 * self.variance / (self._unit_variance * self.wavenumber)  # of the law at the lowest frequency, m^3
        reference = 2 * math.pi * iso8608.REFERENCE / self.wavenumber
        return float(intensity * reference**-long * max(reference / self._break, 1.0) ** (long - short))

    @property
    def spectrum_error(self) -> tuple[float, float]:
        """(largest, root mean square) deviation of the spectrum from its law over the band, dB."""
        x = np.geomspace(1.0, self.band_ratio, 2001)
        poles, zeros, level = self._corners
        away = DECIBEL * (
            gain(x, np.array(poles), np.array(zeros)) + level - law(x, self._slopes, self.band_ratio, self._break)
        )
        return float(np.abs(away).max()), float(np.sqrt(np.mean(away**2)))

    @property
    def _slopes(self) -> tuple[float, float]:
        return self.waviness if isinstance(self.waviness, tuple) else (self.waviness, self.waviness)

    @property
    def _break(self) -> float:
        return self.band_ratio if self.break_ratio is None else self.break_ratio

    @property
    def _corners(self) -> tuple[tuple[float, ...], tuple[float, ...], float]:
        return corners(self._slopes, self.band_ratio, self._break)

    @functools.cached_property
    def _unit_variance(self) -> float:
        """Variance of the level of `matrices`, whose spectral density is that of the law itself."""
        drift, noise, level = (np.asarray(matrix, float) for matrix in self.matrices())
        return float(level @ lyapunov(drift, noise @ noise.T) @ level)

    def matrices(self) -> tuple[npt.ArrayLike, npt.ArrayLike, npt.ArrayLike]:
        """The chain from its highest corner to its lowest, a state for each pole."""
        (p1, p2, p3, p4), (z1, z2), level = self._corners
        # the output of s + z over s + p is its input, and z - p times its state
        drift = np.array([[-p4, 0, 0, 0], [1, -p3, 0, 0], [1, z2 - p3, -p2, 0], [1, z2 - p3, z1 - p2, -p1]])
        return drift, np.array([[math.exp(level / 2)], [0.0], [0.0], [0.0]]), np.array([0.0, 0.0, 0.0, 1.0])


def checked_waviness(value: Any) -> float | tuple[float, float]:
    """``value`` as one waviness in its range, or as a pair of them.

    Raises:
        ParameterError: neither.
    """
    if not isinstance(value, (list, tuple)):
        return within("waviness", value)
    if len(value) != 2:
        raise ParameterError(f"waviness must be one number or a pair, got {shown(value)}")
    return within("waviness, below the break,", value[0], "waviness"), within(
        "waviness, above the break,", value[1], "waviness"
    )
