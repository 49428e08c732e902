"""Identification: which of Wedig's roads (2020) a measured profile comes from, with what parameters, how surely, how well.

*Spectrum.* The first-order road (4) and the second-order one (7), (8) are fitted by Whittle's likelihood with the exact means
of the ordinates (`analysis.spectra`): spacing, folding and tapers bias nothing. Standard errors come from the information at
the estimate. Of the second order all is surely known only where the profile holds both its corners.

*Bound.* The bounded road has the spectrum of its linear twin, so its shape alpha follows from the law of the heights,
p(z) ~ (1 - z^2/r0^2)^(alpha - 1/2), (11): its kurtosis is k = 3 (alpha + 1)/(alpha + 2), whence

    alpha = (2 k - 3)/(3 - k),    r0^2 = 2 (alpha + 1) E Z^2 (12).

Its noise is not Gaussian, and the standard errors of all its parameters are other ones, smaller as a rule: profiles are drawn
of the road that was found, and the spread of their scores and of their kurtosis makes the errors.

*How well.* Bartlett's test on measured over fitted ordinates, of the spectrum. Of the law, the kurtosis against 3 of a Gaussian
profile of the same spectrum, whose variance is 24/n^2 times the sum of rho(lag)^4 over all pairs of points (Z. A. Lomnicki,
"Tests for departure from normality in the case of linear stochastic processes", Metrika 4, 1961).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from roadgym.parameters import RANGES
from roadgym.roads import FirstOrderRoad, GaussianRoad, MultiplicativeRoad, Road, sample_road

from .autocovariance import autocovariance
from .checks import FloatArray
from .roughness import BAND, resolved_band
from .spectra import ProfileSpectrum, WhittleFit, checked_heights, expected_ordinates, fit_whittle, ordinates, profile_spectrum

LEVEL = 0.01  # of the tests by which a road is chosen
DRAWN = 64  # profiles that are drawn of a bounded road for its standard errors
SHAPES = (0.05, 1e3)  # of a bounded road that can be told from a sinusoid and from a Gaussian road
LARGEST_ANGLE = 0.1  # rad, of the road or of its faster motion, between two points that are drawn
BANDWIDTHS = (1e-3, 1e3)
FIRST_BANDWIDTHS = (0.03, 0.2, 1.0, 5.0, 25.0)  # where the search begins
FIRST_WAVENUMBERS = 9


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class IdentifiedRoad:
    """A road that was fitted.

    Attributes:
        road: the road.
        errors: standard errors of its parameters, by name; infinite where nothing fixes one.
        fit: that of the spectrum, whose parameters are logarithms; it has the information criterion, and Bartlett's test. On a
            bounded road it is that of the linear twin.
    """

    road: Road
    errors: Mapping[str, float]
    fit: WhittleFit


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Identified:
    """What `identify` found.

    Attributes:
        band: frequencies that were fitted, cycles/m.
        spectrum: the measured spectrum.
        first_order: `roadgym.FirstOrderRoad`.
        second_order: `roadgym.GaussianRoad`.
        bounded: `roadgym.MultiplicativeRoad`; None where the first order is the better one, where the heights are not flatter
            than Gaussian ones beyond chance, or are flatter than a sinusoid's, and where to draw such roads takes too long.
        kurtosis: of the heights, less their trend.
        kurtosis_distance: the kurtosis less 3, in standard errors of a Gaussian profile of second order.
        largest: greatest height above or below the trend, m.
    """

    band: tuple[float, float]
    spectrum: ProfileSpectrum
    first_order: IdentifiedRoad
    second_order: IdentifiedRoad
    bounded: IdentifiedRoad | None
    kurtosis: float
    kurtosis_distance: float
    largest: float

    @property
    def gaussian_p_value(self) -> float:
        """Of the test whether the kurtosis is that of a Gaussian profile."""
        return two_sided(self.kurtosis_distance)

    @property
    def corners(self) -> tuple[tuple[float, float], tuple[float, float]] | None:
        """Both corners of a second-order road of real ones, cycles/m, each with its relative standard error; None of others.

        They are Omega (delta -+ sqrt(delta^2 - 1)); a profile often fixes one of them alone, and neither Omega nor delta.
        """
        _, wavenumber, bandwidth = self.second_order.fit.parameters.tolist()
        if bandwidth <= 0:
            return None
        delta = math.exp(bandwidth)
        away, rate = math.acosh(delta), delta / math.sqrt((delta - 1) * (delta + 1))
        found = []
        for side in (-1, 1):
            row = np.array([0.0, 1.0, side * rate])
            error = math.sqrt(float(row @ self.second_order.fit.covariance @ row))
            found.append((math.exp(wavenumber + side * away) / (2 * math.pi), error))
        return found[0], found[1]

    @property
    def best(self) -> IdentifiedRoad:
        """The road to drive: of the better order, and bounded where the heights are flatter than Gaussian ones would be."""
        if self.first_order.fit.information_criterion <= self.second_order.fit.information_criterion:
            return self.first_order
        return self.second_order if self.bounded is None else self.bounded


def identify(heights: npt.ArrayLike, spacing: float, *, band: tuple[float, float] = BAND) -> Identified:
    """Fit the roads of first and second order, and the bounded one, to a profile.

    Args:
        heights: m, at equal distances, shape (points,).
        spacing: their distance, m.
        band: frequencies to fit, cycles/m, as far as the profile resolves them.

    Raises:
        ParameterError: a value out of range, or a profile that resolves too little of the band.
    """
    z, _ = checked_heights(heights, spacing)
    spectrum = profile_spectrum(z, spacing)
    band = resolved_band(spectrum, band, folded=True)
    inside = spectrum.chosen(band)
    first = _fit(spectrum, inside, first_order, [()])
    second = _fit(spectrum, inside, second_order, [(math.log(delta),) for delta in FIRST_BANDWIDTHS])
    above = less_trend(z)
    kurtosis = float(_kurtosis(above))
    memory = autocovariance(second.road, None, spectrum.spacing * np.arange(z.size), speed=1.0) / second.road.variance
    weight = np.append(1.0, np.full(z.size - 1, 2.0)) * (1 - np.arange(z.size) / z.size)
    error = math.sqrt(24 / z.size * float(weight @ memory**4))
    away = (kurtosis - 3) / error
    second_better = second.fit.information_criterion < first.fit.information_criterion
    flat = away < 0 and two_sided(away) < LEVEL
    return Identified(
        band=band,
        spectrum=spectrum,
        first_order=first,
        second_order=second,
        bounded=_bounded(spectrum, inside, second, kurtosis) if second_better and flat else None,
        kurtosis=kurtosis,
        kurtosis_distance=away,
        largest=float(np.abs(above).max()),
    )


def two_sided(distance: float) -> float:
    """Probability that a standard normal variate is as far from 0."""
    return math.erfc(abs(distance) / math.sqrt(2))


def first_order(parameters: FloatArray) -> FirstOrderRoad:
    """The road of the logarithms of sigma and Omega."""
    sigma, wavenumber = np.exp(parameters).tolist()
    return FirstOrderRoad(noise_intensity=sigma, wavenumber=wavenumber)


def second_order(parameters: FloatArray) -> GaussianRoad:
    """The road of the logarithms of sigma, Omega and delta."""
    sigma, wavenumber, bandwidth = np.exp(parameters).tolist()
    return GaussianRoad(noise_intensity=sigma, wavenumber=wavenumber, bandwidth=bandwidth)


def _fit(
    spectrum: ProfileSpectrum,
    inside: npt.NDArray[np.bool_],
    make: Callable[[FloatArray], Road],
    others: list[tuple[float, ...]],
) -> IdentifiedRoad:
    """The best road, of the logarithms of sigma, Omega and others, of which some to begin with are given."""
    measured = spectrum.ordinates[inside]
    length = spectrum.points * spectrum.spacing
    widest = math.log(0.05 * 2 * math.pi / length), math.log(20 * math.pi / spectrum.spacing)
    mean = _means(spectrum, inside, make)
    starts = []
    low, high = spectrum.frequency[inside][[0, -1]].tolist()
    for wavenumber in np.log(2 * math.pi * np.geomspace(low, high, FIRST_WAVENUMBERS)).tolist():
        for rest in others:
            ratio = measured / mean(np.array([0.0, wavenumber, *rest]))
            scale = math.log(float(ratio.mean()))  # sigma^2, which is the best there
            starts.append((scale - float(np.log(ratio).mean()), (scale / 2, wavenumber, *rest)))
    size = len(starts[0][1])
    limits = [(-20.0, 20.0), widest, *[(math.log(BANDWIDTHS[0]), math.log(BANDWIDTHS[1]))] * (size - 2)]
    least, greatest = zip(*limits, strict=True)
    fit = fit_whittle(measured, mean, min(starts)[1], (least, greatest))
    road = make(fit.parameters)
    names = ("noise_intensity", "wavenumber", "bandwidth")[:size]
    errors = np.sqrt(np.diag(fit.covariance)).tolist()
    return IdentifiedRoad(
        road=road,
        errors={name: getattr(road, name) * error for name, error in zip(names, errors, strict=True)},
        fit=fit,
    )


def _means(
    spectrum: ProfileSpectrum, inside: npt.NDArray[np.bool_], make: Callable[[FloatArray], Road]
) -> Callable[[FloatArray], FloatArray]:
    """The mean ordinates as a function of the parameters."""
    lag = spectrum.spacing * np.arange(spectrum.points)

    def mean(parameters: FloatArray) -> FloatArray:
        found = expected_ordinates(autocovariance(make(parameters), None, lag, speed=1.0))
        # rounding can leave nothing of a smooth road's shortest waves, and less
        return np.asarray(np.maximum(found, 1e-14 * found.max())[inside])

    return mean


def less_trend(heights: FloatArray) -> FloatArray:
    """Heights above the line of least squares, along the last axis."""
    from scipy.signal import detrend

    return np.asarray(detrend(heights))


def _kurtosis(heights: FloatArray) -> Any:
    """E Z^4/(E Z^2)^2 along the last axis."""
    square = heights**2
    return np.mean(square**2, axis=-1) / np.mean(square, axis=-1) ** 2


def _drawn(road: MultiplicativeRoad, spectrum: ProfileSpectrum) -> Iterator[FloatArray]:
    """Profiles of a bounded road as long as the measured one, DRAWN in all, in batches of shape (profiles, points).

    Between two heights the road takes steps, which the law of its higher moments needs.
    """
    steps = steps_between(road, spectrum.spacing)
    points = steps * (spectrum.points - 1) + 1
    together = min(int(RANGES["array size"].high) // points, DRAWN)
    for seed in range(0, DRAWN, together):
        number = min(together, DRAWN - seed)
        yield sample_road(road, spacing=spectrum.spacing / steps, points=points, number=number, seed=seed)[1][:, ::steps]


def steps_between(road: Road, spacing: float) -> int:
    """Steps of a road that is drawn from one height to the next, so that its faster motion is resolved."""
    return math.ceil(max(1.0, getattr(road, "bandwidth", 0.0)) * road.wavenumber * spacing / LARGEST_ANGLE)


def _bounded(
    spectrum: ProfileSpectrum, inside: npt.NDArray[np.bool_], second: IdentifiedRoad, kurtosis: float
) -> IdentifiedRoad | None:
    """The bounded road of the same spectrum, with errors from profiles that are drawn of it."""
    if kurtosis <= 1.5:
        return None
    shape = (2 * kurtosis - 3) / (3 - kurtosis)
    if not SHAPES[0] <= shape <= SHAPES[1]:
        return None
    twin = second_order(second.fit.parameters)
    bound = math.sqrt(2 * (shape + 1) * twin.variance)
    road = MultiplicativeRoad.from_shape(shape=shape, bandwidth=twin.bandwidth, level_bound=bound, wavenumber=twin.wavenumber)
    if steps_between(road, spectrum.spacing) * spectrum.points > RANGES["array size"].high / 4:
        return None
    expected = spectrum.ordinates[inside] / second.fit.ratio
    scores, found = [], []
    for heights in _drawn(road, spectrum):
        scores.append((ordinates(heights)[:, inside] / expected - 1) @ second.fit.gradient)
        found.append(_kurtosis(less_trend(heights)))
    twin_sigma, wavenumbers, bandwidths = second.fit.inverse_information @ np.concatenate(scores).T
    # d alpha/d k = 3/(3 - k)^2; sigma^2 = (1 + 1/alpha) times that of the twin; r0^2 = (alpha + 1)/(2 delta Omega) times it
    curved = np.concatenate(found)
    shapes = 3 / (3 - kurtosis) ** 2 * (curved - curved.mean())
    away = {
        "noise_intensity": twin_sigma - shapes / (2 * shape * (shape + 1)),
        "wavenumber": wavenumbers,
        "bandwidth": bandwidths,
        "level_bound": twin_sigma + shapes / (2 * (shape + 1)) - (wavenumbers + bandwidths) / 2,
        "shape": shapes / shape,
    }
    return IdentifiedRoad(
        road=road,
        errors={name: getattr(road, name) * float(np.sqrt(np.mean(each**2))) for name, each in away.items()},
        fit=second.fit,
    )
