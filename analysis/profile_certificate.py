"""A certificate of a profile against the class of ISO 8608 that it claims: is somebody's generator right?

Lines: the roughness G(n0) of the law with w = 2, over which public generators err by a factor of 2 or of 4 pi^2 (limits of a
class taken for its mean, cycles for radians); the waviness, against 2; whether the spectrum is the law with w = 2 all over the
band, by Bartlett's test; and the roughness index that the class has at 80 km/h, see `analysis.roughness`.

The probability that a sound profile fails any line is at most `analysis.certificate.FALSE_ALARM_RATE`, shared out equally.
"""

from __future__ import annotations

import dataclasses
import json
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from roadgym.roads import iso8608

from .certificate import FALSE_ALARM_RATE, Line, judged, table_of, wrapped
from .roughness import BAND, WAVINESS, WIDEST, expected_iri, fit_iso8608, international_roughness_index, iri_response
from .spectra import SPREAD, WhittleFit, checked_heights

DENSITY_TOLERANCE = 0.05  # of the roughness; half of it of the index, its root
WAVINESS_TOLERANCE = 0.01


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProfileCertificate:
    """All lines of one profile.

    Attributes:
        profile: what it claims, in words.
        significance: p-value below which a line fails.
        lines: the figures.
        left_out: what cannot be told of this profile, and why.
    """

    profile: str
    significance: float
    lines: tuple[Line, ...]
    left_out: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Does every line pass?"""
        return all(line.passed for line in self.lines)

    def table(self) -> str:
        """The certificate as text of 80 columns."""
        failed = sum(not line.passed for line in self.lines)
        meaning = (
            "error: standard error of measured less expected. p: p-value, which allows for a bias of "
            f"{100 * DENSITY_TOLERANCE:g} % of the roughness, {50 * DENSITY_TOLERANCE:g} % of the index and "
            f"{100 * WAVINESS_TOLERANCE:g} % of the waviness. A line fails where it is below {self.significance:.2g}; a sound "
            f"profile fails any with a probability of at most {FALSE_ALARM_RATE:g}. Distance from the law: Bartlett's, of the "
            "cumulative periodogram."
        )
        return "\n".join(
            [
                *wrapped(self.profile),
                "",
                *table_of(self.lines),
                "",
                f"{len(self.lines)} lines, {failed or 'none'} failed: the profile is {'NOT ' if failed else ''}certified",
                *wrapped(meaning),
                *(line for reason in self.left_out for line in wrapped(f"Left out: {reason}.")),
            ]
        )

    def figures(self) -> dict[str, Any]:
        """The certificate by name, in terms of what JSON knows."""
        return dataclasses.asdict(self) | {"passed": self.passed, "lines": [line.figures() for line in self.lines]}

    def to_json(self) -> str:
        """The certificate as JSON."""
        return json.dumps(self.figures(), indent=2)


def certify_profile(
    heights: npt.ArrayLike,
    spacing: float,
    iso_class: str | float,
    *,
    band: tuple[float, float] = BAND,
    folded: bool = False,
) -> ProfileCertificate:
    """Compare a profile with the class that it claims, line by line; see the module's docstring.

    Args:
        heights: m, at equal distances, shape (points,).
        spacing: their distance, m.
        iso_class: "A" to "H", for the geometric mean of the class, or a density G(n0) in m^3.
        band, folded: frequencies to look at, and are the heights mere points; as of `analysis.fit_iso8608`.

    Raises:
        ParameterError: a value out of range, or a profile that resolves too little of the band.
    """
    mean = iso8608.strength(iso_class) / (2 * math.pi**2 * iso8608.REFERENCE**2)
    z, distance = checked_heights(heights, spacing)
    found = fit_iso8608(z, distance, band=band, folded=folded)
    law, free = found.standard, found.free
    error = mean * law.relative_error
    lines = [
        judged("roughness G(n0), at waviness 2 (m^3)", law.roughness, mean, error, DENSITY_TOLERANCE),
        judged("waviness", free.waviness, WAVINESS, free.waviness_error, WAVINESS_TOLERANCE),
        _spectrum_line(law.fit),
    ]
    left_out = []
    if distance <= WIDEST:
        covariance = 1e6 * iri_response(mean, distance)
        expected = expected_iri(mean, spacing=distance)
        index = international_roughness_index(z, distance)
        lines.append(judged("IRI (m/km)", index, expected, _index_error(covariance, z.size), DENSITY_TOLERANCE / 2))
    else:
        left_out.append(f"IRI (heights are {distance:g} m apart, and it asks for {WIDEST:g} m at most)")
    significance = FALSE_ALARM_RATE / len(lines)
    letter = f"class {iso_class.upper()}" if isinstance(iso_class, str) else f"G(n0) = {mean:g} m^3"
    low, high = found.band
    return ProfileCertificate(
        profile=f"{z.size} heights, {distance:g} m apart, of a road that claims {letter} of ISO 8608; {low:.3g} to {high:.3g} "
        "cycles/m",
        significance=significance,
        lines=tuple(
            dataclasses.replace(line, passed=line.p_value is not None and line.p_value >= significance) for line in lines
        ),
        left_out=tuple(left_out),
    )


def _spectrum_line(fit: WhittleFit) -> Line:
    """Bartlett's distance, against its mean where the law holds."""
    from scipy.stats import kstwobign

    scale = math.sqrt(SPREAD / fit.ratio.size)
    mean, error = float(kstwobign.mean()) * scale, float(kstwobign.std()) * scale
    return Line(
        name="distance of the spectrum from the law with waviness 2",
        measured=fit.distance,
        expected=mean,
        standard_error=error,
        distance=(fit.distance - mean) / error,
        p_value=fit.p_value,
        passed=False,
    )


def _index_error(covariance: npt.NDArray[np.float64], points: int) -> float:
    """Standard error of the mean of |x| over so many points of a Gaussian x with this autocovariance.

    E |x y| = 2/pi (s^2) (sqrt(1 - r^2) + r arcsin r) for a pair of standard deviation s and correlation r.
    """
    lags = min(covariance.size, points)
    r = np.clip(covariance[:lags] / covariance[0], -1, 1)
    shared = 2 / math.pi * covariance[0] * (np.sqrt(1 - r**2) + r * np.arcsin(r) - 1)
    weight = np.append(1.0, np.full(lags - 1, 2.0)) * (1 - np.arange(lags) / points)
    return math.sqrt(float(weight @ shared) / points)
