"""The spectrum of a measured profile, and the likelihood of what is fitted to it.

Heights fall over many decades of their spectral density, so what little leaks from the long waves would hide the short ones.
Their differences from point to point do not: with the waviness 2 of ISO 8608 they are white. So the estimate is that of the
differences, less their mean and with it the slope of the whole record, by the sine tapers of K. S. Riedel and A. Sidorenko,
"Minimum bias multiple taper spectral estimation", IEEE Trans. Signal Process. 43, 1995, divided by the gain of the difference:

    D_j = 1/K sum over tapers k of |sum over t of h_k(t) (z_(t+1) - z_t) e^(-2 pi i j t/N)|^2,
    G(n_j) = 2 spacing D_j / (2 sin(pi n_j spacing))^2,    n_j = j/(N spacing).

Each ordinate has about 2 K degrees of freedom, and neighbours within K + 1 of each other share noise.

What is fitted maximises Whittle's likelihood, - sum of log S_j + D_j/S_j, S_j being the mean of D_j under the parameters. With
the autocovariance of the road S_j is exact, with all that folds back beyond the Nyquist frequency and leaks through the tapers
(A. M. Sykulski et al., "The debiased Whittle likelihood", Biometrika 106, 2019): `expected_ordinates`. The score of a Gaussian
road has 1 + 1/(2K) times the variance that the information alone would say, since the tapers weigh the ends of the record
less; standard errors and likelihoods here allow for it.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from roadgym.parameters import ParameterError, number_array, positive, shown

from .checks import FloatArray

TAPERS = 5
FIRST = 4  # ordinate, below which the mean that was taken off is seen through the tapers
SPREAD = 1 + 1 / (2 * TAPERS)  # variance of a score over what the information says
FEWEST_POINTS = 256
STEP = 1e-4  # of a logarithm, in derivatives
# first centre frequency, cycles/m, number, and how many make an octave, of the bands of ISO 8608; each begins where one ends
BANDS = ((2.0**-20, 16, 1), (2.0 ** (-5 + 2 / 3), 8, 3), (2.0 ** (-2 + 5 / 24), 200, 12))


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Bands:
    """A spectrum that is smoothed over bands of constant relative width.

    Attributes:
        low, centre, high: ends and geometric centre of each band, cycles/m, shape (bands,).
        density: mean of G over it, m^3.
        degrees_of_freedom: of the density, about those of a chi-square variate.
    """

    low: FloatArray
    centre: FloatArray
    high: FloatArray
    density: FloatArray
    degrees_of_freedom: FloatArray


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class ProfileSpectrum:
    """One-sided spectral density G of the heights over the spatial frequency.

    Attributes:
        frequency: n, cycles/m, shape (ordinates,); the mean and the Nyquist frequency are not among them.
        density: G(n), m^3.
        ordinates: D of the differences, m^2.
        degrees_of_freedom: of each ordinate, 1.
        spacing: distance of two heights, m.
        points: number of heights.
    """

    frequency: FloatArray
    density: FloatArray
    ordinates: FloatArray
    degrees_of_freedom: int
    spacing: float
    points: int

    @property
    def gain(self) -> FloatArray:
        """What G is multiplied with to be D, 1/m, shape (ordinates,)."""
        return (2 * np.sin(math.pi * self.frequency * self.spacing)) ** 2 / (2 * self.spacing)

    def chosen(self, band: tuple[float, float]) -> npt.NDArray[np.bool_]:
        """Which ordinates are in a band of frequencies, cycles/m.

        Raises:
            ParameterError: too few for a fit.
        """
        inside = (self.frequency >= band[0]) & (self.frequency <= band[1])
        if inside.sum() < 8 * TAPERS:
            low, high = self.frequency[[0, -1]]
            raise ParameterError(
                f"band must hold at least {8 * TAPERS} of the frequencies that the profile resolves, {low:.3g} to {high:.3g} "
                f"cycles/m, got {band[0]:.3g} to {band[1]:.3g} with {inside.sum()}"
            )
        return inside

    def smoothed(self) -> Bands:
        """The density in the bands of ISO 8608: octaves up to 0.03125 cycles/m, thirds up to 0.25, then twelfths.

        Ordinates count as far as their own cell, 1/length wide, is in the band, as the standard has it. Only whole bands are
        there.
        """
        cell = float(self.frequency[1] - self.frequency[0])
        edges = np.append(self.frequency - cell / 2, self.frequency[-1] + cell / 2)
        centres = np.concatenate([first * 2.0 ** (np.arange(number) / parts) for first, number, parts in BANDS])
        halves = np.concatenate([np.full(number, 0.5 / parts) for _, number, parts in BANDS])
        low, high = centres * 2**-halves, centres * 2**halves
        whole = (low >= edges[0]) & (high <= edges[-1])
        low, centre, high = low[whole], centres[whole], high[whole]
        total = np.concatenate([[0.0], np.cumsum(self.density * cell)])
        density = (np.interp(high, edges, total) - np.interp(low, edges, total)) / (high - low)
        freedom = np.maximum(2 * (high - low) / (cell * SPREAD), self.degrees_of_freedom)
        return Bands(low=low, centre=centre, high=high, density=density, degrees_of_freedom=freedom)


@functools.lru_cache(maxsize=4)
def sine_tapers(number: int) -> FloatArray:
    """The tapers, shape (TAPERS, number), of unit energy each."""
    place = np.arange(1, number + 1) / (number + 1)
    return math.sqrt(2 / (number + 1)) * np.sin(math.pi * np.outer(np.arange(1, TAPERS + 1), place))


@functools.lru_cache(maxsize=4)
def taper_overlap(number: int) -> FloatArray:
    """Mean over the tapers of the sum of h(t) h(t + lag), at the lags 0 to number - 1."""
    from scipy.signal import correlate

    return np.asarray(np.mean([correlate(taper, taper, method="fft")[number - 1 :] for taper in sine_tapers(number)], axis=0))


def checked_heights(heights: Any, spacing: Any) -> tuple[FloatArray, float]:
    """Heights as a float array, shape (points,), and their distance.

    Raises:
        ParameterError: no row of numbers, too few, or all on a line.
    """
    checked = number_array("heights", heights)
    distance = positive("spacing", spacing)
    if checked.ndim != 1 or checked.size < FEWEST_POINTS:
        raise ParameterError(f"heights must be {FEWEST_POINTS} or more in a row, got the shape {checked.shape}")
    if not np.ptp(np.diff(checked)) > 1e-12 * np.abs(checked).max():
        raise ParameterError(f"heights must not all be on a line, got {shown(checked[:3])} and so on")
    return checked, distance


def ordinates(heights: FloatArray) -> FloatArray:
    """D_j from j = FIRST on, below the Nyquist frequency, m^2; heights of shape (..., points) in the last axis."""
    from scipy import fft

    steps = np.diff(heights)
    steps = steps - steps.mean(axis=-1, keepdims=True)
    number = steps.shape[-1]
    total = sum(np.abs(fft.rfft(taper * steps)) ** 2 for taper in sine_tapers(number))
    return np.asarray(total / TAPERS)[..., FIRST : (number + 1) // 2]


def expected_ordinates(autocovariance: FloatArray) -> FloatArray:
    """Exact means of `ordinates`, of a stationary profile with this autocovariance at the lags 0 to points - 1, m^2."""
    from scipy import fft

    number = autocovariance.size - 1
    mirrored = np.concatenate([autocovariance[1:2], autocovariance])
    weighed = -np.diff(mirrored, 2) * taper_overlap(number)
    return np.asarray(2 * fft.rfft(weighed).real - weighed[0])[FIRST : (number + 1) // 2]


def profile_spectrum(heights: npt.ArrayLike, spacing: float) -> ProfileSpectrum:
    """Spectral density of a profile; see the module's docstring.

    Args:
        heights: m, at equal distances, shape (points,).
        spacing: their distance, m.

    Raises:
        ParameterError: a value out of range, too few heights, or all on a line.
    """
    z, distance = checked_heights(heights, spacing)
    measured = ordinates(z)
    frequency = np.arange(FIRST, FIRST + measured.size) / ((z.size - 1) * distance)
    density = 2 * distance * measured / (2 * np.sin(math.pi * frequency * distance)) ** 2
    return ProfileSpectrum(
        frequency=frequency,
        density=density,
        ordinates=measured,
        degrees_of_freedom=2 * TAPERS,
        spacing=distance,
        points=z.size,
    )


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class WhittleFit:
    """What maximises Whittle's likelihood.

    Attributes:
        parameters: where, shape (p,).
        gradient: of the logarithm of the mean ordinates there, shape (ordinates, p).
        ratio: measured over mean ordinates, shape (ordinates,); about 1.
        log_likelihood: its value, over SPREAD, so that differences of it are those of a likelihood.
    """

    parameters: FloatArray
    gradient: FloatArray
    ratio: FloatArray
    log_likelihood: float

    @property
    def inverse_information(self) -> FloatArray:
        """Covariance of the parameters if the ordinates were independent, shape (p, p); huge where nothing fixes one."""
        size = self.parameters.size
        return np.asarray(np.linalg.inv(self.gradient.T @ self.gradient + 1e-12 * np.eye(size)))

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the parameters on a Gaussian road, shape (p, p)."""
        return SPREAD * self.inverse_information

    @property
    def information_criterion(self) -> float:
        """Akaike's: the least is best, of what is fitted to the same ordinates."""
        return 2 * self.parameters.size - 2 * self.log_likelihood

    @property
    def distance(self) -> float:
        """Largest distance of the cumulative sum of the ratios, over the whole of it, from an even rise."""
        number = self.ratio.size
        return float(np.abs(np.cumsum(self.ratio) / self.ratio.sum() - np.arange(1, number + 1) / number).max())

    @property
    def p_value(self) -> float:
        """Of Bartlett's test whether the ratios are 1 all over the band; above the truth where much is fitted.

        Source: M. S. Bartlett, "Problemes de l'analyse spectrale des series temporelles stationnaires", Publ. Inst. Statist.
        Univ. Paris III-3, 1954: the distance times the root of the number of ordinates follows Kolmogorov's law.
        """
        from scipy.stats import kstwobign

        return float(kstwobign.sf(self.distance * math.sqrt(self.ratio.size / SPREAD)))


def fit_whittle(
    measured: FloatArray,
    mean: Callable[[FloatArray], FloatArray],
    start: Sequence[float],
    limits: tuple[Sequence[float], Sequence[float]] | None = None,
) -> WhittleFit:
    """Maximise Whittle's likelihood: the squares of what is minimised are twice the deviance of each ordinate.

    Args:
        measured: ordinates, shape (ordinates,).
        mean: the mean ordinates, under parameters of shape (p,), in the same shape.
        start: parameters to begin with, near 1 in scale, such as logarithms.
        limits: least and greatest parameters.
    """
    from scipy.optimize import least_squares

    def deviance(parameters: FloatArray) -> FloatArray:
        ratio = measured / mean(parameters)
        square = np.maximum(ratio - 1 - np.log(ratio), 0.0)
        return np.asarray(np.sign(ratio - 1) * np.sqrt(2 * square))

    found = least_squares(
        deviance, start, bounds=(-np.inf, np.inf) if limits is None else limits, x_scale="jac", xtol=1e-10, ftol=1e-12
    ).x
    steps = STEP * np.eye(found.size)
    gradient = np.stack([np.log(mean(found + step) / mean(found - step)) / (2 * STEP) for step in steps], axis=-1)
    expected = mean(found)
    ratio = measured / expected
    likelihood = -float(np.sum(np.log(expected) + ratio)) / SPREAD
    return WhittleFit(parameters=found, gradient=gradient, ratio=ratio, log_likelihood=likelihood)
