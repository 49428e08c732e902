"""What a road engineer asks of a measured profile: its class after ISO 8608, its waviness, its International Roughness Index.

*Class and waviness.* The law G(n) = G(n0) (n/n0)^-w of `roadgym.roads.iso8608` is fitted by Whittle's likelihood
(`analysis.spectra`), with w free, and with w = 2.

*Roughness index*, IRI, after ASTM E1926 and M. W. Sayers, "On the calculation of International Roughness Index from
longitudinal road profile", Transportation Research Record 1501, 1995: the mean of |slope of the body - slope of the wheel|,
of a quarter car, per kg of body of the masses 1 and 0.15 kg, the springs 63.3 and 653 N/m and the damper 6 N s/m, that drives
at 80 km/h over the profile, whose slope is averaged over 250 mm before. It is exact for a profile that is straight between two
heights. On a road of waviness 2 it is sqrt(2/pi) times the standard deviation of that difference, `expected_iri`: without the
average 1000 sqrt(2 pi n0^2 G(n0) k_t/(c V)) = 554.7 sqrt(G(n0)) m/km times sqrt(m^-3); with it, 2.17 m/km on class A.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from roadgym.cars import make_car
from roadgym.parameters import ParameterError, positive, within
from roadgym.roads import PowerLawRoad, iso8608

from .checks import FloatArray
from .spectra import ProfileSpectrum, WhittleFit, checked_heights, fit_whittle, profile_spectrum

BAND = (0.011, 2.83)  # cycles/m, of ISO 8608
SHORTEST = 4.0  # spacings in the shortest wave of the band, where nothing is known of what folds back on shorter ones
WAVINESS = 2.0  # of ISO 8608
WAVINESS_LIMITS = (1.05, 8.0)

CAR = "golden_car"
DAMPER = 6.0  # N s/m, of that car, per kg of its body
IRI_SPEED = 80 / 3.6  # m/s
BASE = 0.25  # m, over which the slope is averaged
LEAD = 11.0  # m, whose mean slope body and wheel have in the beginning
WIDEST = 0.5  # m, of two heights: beyond, the waves that shake the wheel are lost


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PowerLaw:
    """A law G(n0) (n/n0)^-w, fitted.

    Attributes:
        roughness: G(n0), m^3.
        relative_error: standard error of the roughness over it, that of its logarithm.
        waviness: w.
        waviness_error: its standard error, 0 where it was given.
        fit: the fit, whose parameters are the logarithm of G(n0) and, where it is free, w.
    """

    roughness: float
    relative_error: float
    waviness: float
    waviness_error: float
    fit: WhittleFit

    @property
    def iso_class(self) -> str:
        """Letter of the class of ISO 8608 whose limits, half and twice its mean, the roughness is in; A and H are open."""
        place = round(math.log(self.roughness / iso8608.MEANS["A"], 4))
        return list(iso8608.MEANS)[min(max(place, 0), len(iso8608.MEANS) - 1)]

    @property
    def class_limits(self) -> tuple[float, float]:
        """Limits of the class, m^3; 0 below A, infinite above H."""
        mean = iso8608.MEANS[self.iso_class]
        return 0.0 if self.iso_class == "A" else mean / 2, math.inf if self.iso_class == "H" else 2 * mean

    @property
    def limit_distances(self) -> tuple[float, float]:
        """How far the roughness is from the lower and the upper limit of its class, in standard errors of its logarithm."""
        low, high = self.class_limits
        below = math.inf if low == 0 else math.log(self.roughness / low) / self.relative_error
        return below, math.inf if high == math.inf else math.log(high / self.roughness) / self.relative_error

    def density(self, frequency: npt.ArrayLike) -> FloatArray:
        """G(n), m^3, at frequencies n, cycles/m, in their shape."""
        return np.asarray(self.roughness * (np.asarray(frequency, float) / iso8608.REFERENCE) ** -self.waviness)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RoughnessFit:
    """What `fit_iso8608` found.

    Attributes:
        band: frequencies that were fitted, cycles/m.
        spectrum: the measured spectrum.
        free: the law with its own waviness.
        standard: the law with w = 2.
    """

    band: tuple[float, float]
    spectrum: ProfileSpectrum
    free: PowerLaw
    standard: PowerLaw

    def road(self) -> PowerLawRoad:
        """A road of the law with its own waviness, over the band and an octave on either side, where its ends are rounded.

        Raises:
            ParameterError: a waviness that roads cannot have.
        """
        low, high = self.band
        return PowerLawRoad.from_iso8608(
            self.free.roughness, waviness=self.free.waviness, lowest_frequency=low / 2, highest_frequency=2 * high
        )


def fit_iso8608(
    heights: npt.ArrayLike, spacing: float, *, band: tuple[float, float] = BAND, folded: bool = False
) -> RoughnessFit:
    """Roughness and waviness of a profile, with standard errors.

    Args:
        heights: m, at equal distances, shape (points,).
        spacing: their distance, m.
        band: frequencies to fit, cycles/m; that of ISO 8608. What the profile does not resolve of it is left out: waves longer
            than a quarter of it, and shorter than four spacings, or two where ``folded``.
        folded: are the heights mere points of a road whose law goes on beyond the shortest waves that they resolve, which then
            fold back on longer ones? So are those of a simulated road; those of a profilometer are averaged, and are not.

    Raises:
        ParameterError: a value out of range, or a profile that resolves too little of the band.
    """
    spectrum = profile_spectrum(heights, spacing)
    low, high = resolved_band(spectrum, band, folded)
    inside = spectrum.chosen((low, high))
    n, gain, measured = spectrum.frequency[inside], spectrum.gain[inside], spectrum.ordinates[inside]

    def mean(parameters: FloatArray) -> FloatArray:
        logarithm, waviness = parameters[0], parameters[1] if parameters.size > 1 else WAVINESS
        if not folded:
            return np.asarray(gain * np.exp(logarithm) * (n / iso8608.REFERENCE) ** -waviness)
        from scipy.special import zeta

        x = n * spectrum.spacing  # the sum of all that folds back is Hurwitz's zeta function
        series = zeta(waviness, x) + zeta(waviness, 1 - x)
        return np.asarray(gain * np.exp(logarithm) * (iso8608.REFERENCE * spectrum.spacing) ** waviness * series)

    start = math.log(float(np.mean(measured / mean(np.zeros(1)))))
    standard = fit_whittle(measured, mean, [start])
    limits = ([-np.inf, WAVINESS_LIMITS[0]], [np.inf, WAVINESS_LIMITS[1]])
    free = fit_whittle(measured, mean, [*standard.parameters.tolist(), WAVINESS], limits)
    return RoughnessFit(band=(low, high), spectrum=spectrum, free=_law(free), standard=_law(standard))


def resolved_band(spectrum: ProfileSpectrum, band: tuple[float, float], folded: bool) -> tuple[float, float]:
    """The part of a band, cycles/m, that a profile resolves; see `fit_iso8608`.

    Raises:
        ParameterError: no band.
    """
    low, high = (positive(f"band, {end} end,", value) for end, value in zip(("low", "high"), band, strict=True))
    if low >= high:
        raise ParameterError(f"band must be a pair (low, high) with low < high, got {band!r}")
    shortest = spectrum.frequency[-1] if folded else 1 / (SHORTEST * spectrum.spacing)
    return max(low, float(spectrum.frequency[0])), min(high, float(shortest))


def _law(fit: WhittleFit) -> PowerLaw:
    errors = np.sqrt(np.diag(fit.covariance)).tolist()
    waviness, waviness_error = (fit.parameters[1], errors[1]) if fit.parameters.size > 1 else (WAVINESS, 0.0)
    return PowerLaw(
        roughness=math.exp(fit.parameters[0]),
        relative_error=errors[0],
        waviness=float(waviness),
        waviness_error=waviness_error,
        fit=fit,
    )


def international_roughness_index(heights: npt.ArrayLike, spacing: float, *, speed: float = IRI_SPEED) -> float:
    """IRI of a profile, m/km (mm/m); see the module's docstring.

    The slope is averaged over as many spacings as come nearest to 250 mm, and at least one; so from 167 mm on over no more than
    the straight line between two heights.

    Args:
        heights: m, at equal distances, shape (points,); more than 11 m of them.
        spacing: their distance, m, 0.5 m at most.
        speed: of the car, m/s; the index is defined for 80 km/h.

    Raises:
        ParameterError: a value out of range.
    """
    z, distance = checked_heights(heights, spacing)
    v = within("speed", speed, "moving speed")
    lead = round(LEAD / checked_iri_spacing(distance))
    if lead >= z.size:
        raise ParameterError(f"heights must be of more than {LEAD:g} m for an IRI, got {(z.size - 1) * distance:.3g} m")
    slopes = averaged_slopes(z, distance)
    start = (z[lead] - z[0]) / (lead * distance)
    return float(1000 * np.abs(golden_car(slopes, distance / v, start)).mean())


def expected_iri(roughness: float, *, spacing: float = BASE, speed: float = IRI_SPEED) -> float:
    """Mean IRI, m/km, of an endless road of waviness 2 whose heights are known at points of this spacing; exact.

    Args:
        roughness: G(n0), m^3.
        spacing: distance of the points, m, 0.5 m at most.
        speed: m/s.

    Raises:
        ParameterError: a value out of range.
    """
    return 1000 * math.sqrt(2 / math.pi * float(iri_response(roughness, spacing, speed)[0]))


def iri_response(roughness: float, spacing: float, speed: float = IRI_SPEED) -> FloatArray:
    """Autocovariance of the slope of the body less that of the wheel at lags of one spacing, on a road of waviness 2."""
    from scipy.signal import correlate

    distance = checked_iri_spacing(positive("spacing", spacing))
    v = within("speed", speed, "moving speed")
    # differences of the heights are independent, of this variance; of the car's memory e^-20 is left after 10 s
    variance = iso8608.strength(within("roughness", roughness)) * distance
    impulse = np.zeros(math.ceil(10.0 * v / distance))
    impulse[0] = math.sqrt(variance)
    heights = np.concatenate([np.zeros(round(BASE / distance) + 1), np.cumsum(impulse)])
    response = golden_car(averaged_slopes(heights, distance), distance / v, 0.0)
    return np.asarray(correlate(response, response, method="fft")[response.size - 1 :])


def checked_iri_spacing(spacing: float) -> float:
    """A spacing at which the IRI is defined.

    Raises:
        ParameterError: it is too wide.
    """
    if spacing > WIDEST:
        raise ParameterError(f"spacing must be at most {WIDEST:g} m for an IRI, got {spacing:g}")
    return spacing


def averaged_slopes(heights: FloatArray, spacing: float) -> FloatArray:
    """Slopes over the base, or over one spacing where that is longer, shape (points - base,)."""
    base = max(1, int(BASE / spacing + 0.5))
    return np.asarray((heights[base:] - heights[:-base]) / (base * spacing))


def golden_car(slopes: FloatArray, time: float, start: float) -> FloatArray:
    """Slope of the body less that of the wheel after each of the ``slopes``, that last for a ``time`` each; exact.

    Both begin with the slope ``start``. The car that drives over slopes moves in slopes; each mode is a filter of first order.
    """
    from scipy.signal import lfilter

    car = make_car(CAR)
    motion, w1 = car.motion, car.natural_frequency
    rates, modes = np.linalg.eig(w1 * (motion.drift + DAMPER / w1 * motion.damper))  # 2 D = DAMPER/w1
    inverse = np.linalg.inv(modes)
    entry, begin = inverse @ (w1 * motion.level_entry), inverse @ (start * motion.follows)
    seen = motion.rows[list(motion.signals).index("travel"), : len(motion.states)] @ modes
    found = np.zeros(slopes.size)
    for k in np.flatnonzero(rates.imag > 0):  # of each pair of conjugate modes one
        keep = np.exp(rates[k] * time)
        gain = np.expm1(rates[k] * time) / rates[k] * entry[k]
        mode, _ = lfilter([gain], [1, -keep], slopes.astype(complex), zi=[keep * begin[k]])
        found += 2 * (seen[k] * mode).real
    return found
