"""What is found of a measured profile, put together: as text, as figures for JSON, and as a road to drive."""

from __future__ import annotations

import dataclasses
import json
import math
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from analysis.identification import Identified, IdentifiedRoad, identify, less_trend
from analysis.profile_certificate import ProfileCertificate, certify_profile
from analysis.roughness import BAND, WIDEST, PowerLaw, RoughnessFit, fit_iso8608, international_roughness_index
from analysis.spectra import WhittleFit
from roadgym.parameters import ParameterError
from roadgym.roads import Profile, Road, read_profile

WIDTH = 80  # columns of the text
DIGITS = 6  # of the parameters of a road to drive
SOUND = 0.01  # p-value of Bartlett's test below which a profile does not have the spectrum of a road


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """A road that the profile may come from.

    Attributes:
        road: the road.
        told: its parameters with their standard errors, in words.
        errors: standard errors by name.
        fit: that of its spectrum.
    """

    road: Road
    told: str
    errors: dict[str, float]
    fit: WhittleFit


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredRoad:
    """All that is found of a profile.

    Attributes:
        name: of the file.
        profile: its heights.
        roughness: class and waviness.
        index: IRI, m/km; None where the heights are too far apart for it.
        identified: roads with parameters.
        certificate: against the class that is claimed; None where none is.
        candidates: roads, the one to drive first.
    """

    name: str
    profile: Profile
    roughness: RoughnessFit
    index: float | None
    identified: Identified
    certificate: ProfileCertificate | None
    candidates: tuple[Candidate, ...]

    @property
    def road(self) -> Road:
        """The road to drive."""
        return self.candidates[0].road

    @property
    def heights_above_trend(self) -> npt.NDArray[np.float64]:
        """Heights above the line of least squares, m, shape (points,)."""
        return less_trend(self.profile.heights)


def measure(
    path: str | Path,
    *,
    units: str | None = None,
    column: int | None = None,
    band: tuple[float, float] = BAND,
    folded: bool = False,
    iso_class: str | None = None,
) -> MeasuredRoad:
    """Read a profile and find out all about it.

    Args:
        path: the file.
        units: of its heights, in place of what it tells.
        column: which heights of the file, from 1.
        band: frequencies to fit, cycles/m.
        folded: are the heights mere points; see `analysis.fit_iso8608`.
        iso_class: that the profile claims.

    Raises:
        ParameterError: a file or a profile that cannot be used: what is wrong.
    """
    profile = read_profile(path, units, column=column)
    try:
        return _measured(Path(path).name, profile, band=band, folded=folded, iso_class=iso_class)
    except ParameterError as error:
        raise ParameterError(f"profile {str(path)!r}: {error}") from None


def _measured(name: str, profile: Profile, *, band: tuple[float, float], folded: bool, iso_class: str | None) -> MeasuredRoad:
    """All that is found of a profile that was read."""
    heights, spacing = profile.heights, profile.spacing
    roughness = fit_iso8608(heights, spacing, band=band, folded=folded)
    identified = identify(heights, spacing, band=roughness.band)
    return MeasuredRoad(
        name=name,
        profile=profile,
        roughness=roughness,
        index=None if spacing > WIDEST else international_roughness_index(heights, spacing),
        identified=identified,
        certificate=None
        if iso_class is None
        else certify_profile(heights, spacing, iso_class, band=roughness.band, folded=folded),
        candidates=_candidates(roughness, identified),
    )


def _candidates(roughness: RoughnessFit, identified: Identified) -> tuple[Candidate, ...]:
    """The roads that were fitted, the best first; the bounded one where the heights ask for it, before its linear twin."""
    found = [_candidate(road) for road in (identified.first_order, identified.second_order, identified.bounded) if road]
    law = roughness.free
    try:
        road = roughness.road()
    except ParameterError:  # such a waviness no road can have
        pass
    else:
        told = f"G(n0) {_relative(law.roughness, law.relative_error)} m^3, waviness {_shown(law.waviness, law.waviness_error)}"
        errors = {"roughness": law.roughness * law.relative_error, "waviness": law.waviness_error}
        found.append(Candidate(road=road, told=told, errors=errors, fit=law.fit))
    best = identified.best.road
    return tuple(sorted(found, key=lambda one: (one.fit.information_criterion, one.road is not best)))


def _candidate(identified: IdentifiedRoad) -> Candidate:
    symbols = {"noise_intensity": "sigma", "wavenumber": "Omega", "bandwidth": "delta", "level_bound": "r0", "shape": "alpha"}
    units = {"noise_intensity": " m^1/2", "wavenumber": " rad/m", "level_bound": " m"}
    told = ", ".join(
        f"{symbols[name]} {_shown(getattr(identified.road, name), error)}{units.get(name, '')}"
        for name, error in identified.errors.items()
    )
    return Candidate(road=identified.road, told=told, errors=dict(identified.errors), fit=identified.fit)


def _shown(value: float, error: float) -> str:
    """A value with its standard error."""
    return _relative(value, error / value)


def _relative(value: float, relative: float) -> str:
    """A positive value with its standard error, given over it; both to the second digit of the error."""
    if relative > 1:
        return f"{value:.1g} (unsure)"
    error = value * relative
    digits = math.floor(math.log10(value)) - math.floor(math.log10(error)) + 2
    return f"{value:.{digits}g} ± {error:.2g}"


def mapping(road: Road) -> dict[str, Any]:
    """The road as the mapping that options and environments take, to six digits."""
    found = {name: value for name, value in dataclasses.asdict(road).items() if value is not None}
    return {name: float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value for name, value in found.items()}


def options(road: Road) -> list[str]:
    """Options of the commands that drive, with which they drive this very road."""
    found = [f"--road '{json.dumps(mapping(road))}'"]
    bandwidth = mapping(road).get("bandwidth")
    if bandwidth is not None:  # which a command else draws from a range of its own
        found.append(f"--bandwidth-range {bandwidth:g} {bandwidth:g}")
    return found


def summary(measured: MeasuredRoad) -> list[tuple[str, str]]:
    """What was found, in order: a term, and a sentence on it."""
    profile, roughness, identified = measured.profile, measured.roughness, measured.identified
    low, high = roughness.band
    length = (profile.heights.size - 1) * profile.spacing
    spread = float(profile.heights.max() - profile.heights.min())
    found = [
        (
            "profile",
            f"{profile.heights.size} heights, {profile.spacing:g} m apart, {length:.4g} m; {spread:.3g} m between the "
            "highest and the lowest",
        ),
        ("band", f"{low:.3g} to {high:.3g} cycles/m, as far as the profile resolves that of ISO 8608"),
        (
            "class",
            f"{_law(roughness.free)}, with a waviness of {_shown(roughness.free.waviness, roughness.free.waviness_error)}",
        ),
        ("at waviness 2", f"{_law(roughness.standard)}; " + verdict(roughness.standard.fit)),
        (
            "IRI",
            f"none: heights must be at most {WIDEST:g} m apart" if measured.index is None else f"{measured.index:.2f} m/km",
        ),
        (
            "law of heights",
            f"kurtosis {identified.kurtosis:.3f}, {abs(identified.kurtosis_distance):.1f} standard errors "
            f"{'below' if identified.kurtosis_distance < 0 else 'above'} the 3 of a Gaussian road "
            f"(p = {identified.gaussian_p_value:.2g})",
        ),
    ]
    if identified.corners is not None:
        corners = " and ".join(_relative(*corner) for corner in identified.corners)
        found.append(("corners", f"{corners} cycles/m, of the gaussian road, between which G falls with n^-2"))
    return found


def _law(law: PowerLaw) -> str:
    low, high = law.limit_distances
    parts = [
        f"{away:.1f} standard errors {side}"
        for away, side in ((low, "above its lower"), (high, "below its upper"))
        if away < math.inf
    ]
    return f"{law.iso_class}: G(n0) = {_relative(law.roughness, law.relative_error)} m^3, {' and '.join(parts)} limit"


def verdict(fit: WhittleFit) -> str:
    """Whether the profile has the spectrum that was fitted, in words."""
    has = "has" if fit.p_value >= SOUND else "does not have"
    return f"the profile {has} this spectrum (p = {fit.p_value:.2g})"


def table(measured: MeasuredRoad) -> str:
    """All that was found, as text of `WIDTH` columns."""
    terms = summary(measured)
    indent = max(len(term) for term, _ in terms) + 2
    text = [measured.name, ""]
    for term, sentence in terms:
        text += _filled(term.ljust(indent), sentence, indent)
    text += [
        "",
        "Roads with their parameters and standard errors, the one to drive first; dAIC is",
        "Akaike's criterion above the least, p Bartlett's for the spectrum.",
        "",
    ]
    least = measured.candidates[0].fit.information_criterion
    text.append(f"{'road':16}{'dAIC':>8}{'p':>10}")
    for one in measured.candidates:
        text.append(f"{one.road.kind:16}{one.fit.information_criterion - least:8.1f}{one.fit.p_value:10.2g}")
        text += _filled("  ", one.told, 4)
    text += ["", "To drive it:", *(f"  {option}" for option in options(measured.road))]
    if measured.certificate is not None:
        text += ["", measured.certificate.table()]
    return "\n".join(text)


def _filled(begin: str, sentence: str, indent: int) -> list[str]:
    return textwrap.wrap(
        sentence, WIDTH, initial_indent=begin, subsequent_indent=" " * indent, break_on_hyphens=False, drop_whitespace=True
    )


def figures(measured: MeasuredRoad) -> dict[str, Any]:
    """All that was found, in terms of what JSON knows; null for what is not finite."""
    profile, roughness, identified = measured.profile, measured.roughness, measured.identified

    def law(one: PowerLaw) -> dict[str, Any]:
        return {
            "iso_class": one.iso_class,
            "roughness": one.roughness,
            "roughness_error": one.roughness * one.relative_error,
            "waviness": one.waviness,
            "waviness_error": one.waviness_error,
            "p_value": one.fit.p_value,
        }

    return {
        "file": measured.name,
        "points": profile.heights.size,
        "spacing": profile.spacing,
        "band": list(roughness.band),
        "free": law(roughness.free),
        "standard": law(roughness.standard),
        "iri": measured.index,
        "kurtosis": identified.kurtosis,
        "kurtosis_distance": identified.kurtosis_distance,
        "largest": identified.largest,
        "roads": [
            {
                "road": mapping(one.road),
                "errors": {name: error if math.isfinite(error) else None for name, error in one.errors.items()},
                "information_criterion": one.fit.information_criterion,
                "p_value": one.fit.p_value,
            }
            for one in measured.candidates
        ],
        "certificate": None if measured.certificate is None else measured.certificate.figures(),
    }
