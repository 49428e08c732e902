"""The page of a measured road: what was found of it, and pictures, in one file of HTML."""

from __future__ import annotations

import base64
import html
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import analysis
from analysis.identification import steps_between
from roadgym.installation import needs
from roadgym.parameters import ParameterError
from roadgym.roads import iso8608, sample_road

from .figure_style import save_figure
from .measured_road import Candidate, MeasuredRoad, mapping, options, summary
from .records import versions, write_atomically
from .results import Picture

with needs("report"):
    from matplotlib.figure import Figure

TEMPLATE = Path(__file__).with_name("road_page.html")
MEASURED, DRIVEN, LAW, STANDARD = "#000000", "#D55E00", "#0072B2", "#009E73"  # Okabe and Ito's, each with its own line style
CONFIDENCE = 0.95
MOST_POINTS = 2500  # heights in a picture


PAGE = "road.html"
ENDS = ("", "_narrow")  # of the pictures' names, for wide and for narrow screens


def check_folder(folder: Path, name: str) -> None:
    """Look what `write` would write over: the page of a file of the same ``name`` and its pictures may be there, nothing else.

    Raises:
        ParameterError: it is something else.
    """
    files = [PAGE, *(f"{picture}{end}.png" for picture in drawings() for end in ENDS)]
    there = [file for file in files if (folder / file).exists()]
    text = (folder / PAGE).read_text(encoding="utf-8", errors="replace") if PAGE in there else ""
    title = re.search("<title>(.*): a measured road</title>", text)
    if there and (title is None or html.unescape(title.group(1)) != name):
        raise ParameterError(f"{str(folder)!r} must not hold the {there[0]} of others than {name!r}: choose another folder")


def write(measured: MeasuredRoad, folder: Path) -> list[Path]:
    """Write the page and its pictures into a folder that exists; returns the files."""
    pictures = draw(measured, folder)
    page = folder / PAGE
    write_atomically(page, make_page(measured, pictures))
    return [page, *(path for picture in pictures for path in (picture.path, picture.narrow) if path is not None)]


def drawings() -> dict[str, tuple[Callable[[MeasuredRoad, bool], Figure], str]]:
    """By name, what draws each picture, and its caption."""
    return {
        "spectrum": (
            draw_spectrum,
            "Spectral density of the measured heights over the spatial frequency. Marks: means over the bands of ISO 8608, "
            f"with {100 * CONFIDENCE:g} % intervals; grey: single ordinates. Lines: what was fitted. The slanted bands are the "
            "classes.",
        ),
        "profile": (
            draw_profile,
            "The measured profile, and under it on the same scales a generated road, the one to drive; of both without waves "
            f"longer than those that were fitted, and no more than {MOST_POINTS} heights.",
        ),
        "residuals": (
            draw_residuals,
            f"Measured over fitted density, in the bands of ISO 8608; {100 * CONFIDENCE:g} % of the marks of a sound fit are "
            "in the grey band.",
        ),
        "heights": (
            draw_heights,
            "How often each height above the trend occurs, and the densities of a Gaussian and, where there is one, of the "
            "bounded road.",
        ),
    }


def draw(measured: MeasuredRoad, folder: Path) -> list[Picture]:
    """Draw every picture, for a wide and for a narrow screen."""
    pictures = []
    for name, (figure, caption) in drawings().items():
        wide, narrow = (folder / f"{name}{end}.png" for end in ENDS)
        save_figure(figure(measured, False), wide)
        save_figure(figure(measured, True), narrow)
        pictures.append(Picture(wide, caption, narrow))
    return pictures


def panels(narrow: bool, rows: int = 1, height: float = 4.6, **options: Any) -> tuple[Figure, Any]:
    """A figure of one column and its axes, shape (rows,)."""
    figure = Figure(figsize=(4.2, 0.85 * height) if narrow else (8.6, height), layout="constrained")
    axes = figure.subplots(rows, 1, squeeze=False, **options)[:, 0]
    for axis in axes:
        axis.grid(visible=True, which="both", linewidth=0.25)
    return figure, axes


def label(candidate: Candidate) -> str:
    """Kind of a road, as pictures call it."""
    return f"{candidate.road.kind.replace('_', ' ')} road"


def road_density(candidate: Candidate, frequency: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """One-sided G(n) of a road, m^3, at frequencies n, cycles/m."""
    return 2 * analysis.spectral_density(candidate.road, 2 * math.pi * frequency, speed=1.0)


def draw_spectrum(measured: MeasuredRoad, narrow: bool) -> Figure:
    """The spectrum, smoothed and not, with the classes and the fits."""
    from scipy.stats import chi2

    figure, (axis,) = panels(narrow, height=5.2)
    spectrum, roughness = measured.roughness.spectrum, measured.roughness
    n = np.geomspace(spectrum.frequency[0], spectrum.frequency[-1], 300)
    bands = spectrum.smoothed()
    low, high = float(bands.density.min()) / 30, float(spectrum.density.max()) * 10
    for number, (name, mean) in enumerate(iso8608.MEANS.items()):
        middle = mean * (n / iso8608.REFERENCE) ** -2
        axis.fill_between(n, middle / 2, middle * 2, color="#888888", alpha=0.22 if number % 2 else 0.1, linewidth=0)
        seen = int(np.argmax(middle < high / 2))  # where it comes in
        if low < middle[seen] < high / 2:
            axis.text(n[seen], middle[seen], f" {name}", va="center", fontsize=9, color="#444444")
    axis.plot(spectrum.frequency, spectrum.density, color="#999999", linewidth=0.5, zorder=1)
    freedom = bands.degrees_of_freedom
    ends = np.array([freedom / chi2.isf((1 - sign * CONFIDENCE) / 2, freedom) for sign in (1, -1)])
    errors = bands.density * np.abs(ends - 1)
    axis.errorbar(
        bands.centre, bands.density, errors, fmt="o", color=MEASURED, markersize=3, linewidth=0.8, label="measured", zorder=3
    )
    inside = n[(n >= roughness.band[0]) & (n <= roughness.band[1])]
    for law, colour, style in ((roughness.free, LAW, "-"), (roughness.standard, STANDARD, "--")):
        axis.plot(inside, law.density(inside), style, color=colour, linewidth=1.8, label=f"w = {law.waviness:.3g}", zorder=4)
    first = measured.candidates[0]
    axis.plot(n, road_density(first, n), "-.", color=DRIVEN, linewidth=1.8, label=label(first), zorder=4)
    axis.set(xscale="log", yscale="log", ylim=(low, high), xlim=(n[0], n[-1]))
    axis.set_xlabel("spatial frequency n, cycles/m")
    axis.set_ylabel("G(n), m³")
    axis.legend(loc="lower left", fontsize=8)
    return figure


def draw_profile(measured: MeasuredRoad, narrow: bool) -> Figure:
    """The measured heights and those of a generated road, on the same scales."""
    figure, axes = panels(narrow, rows=2, height=5.0, sharex=True, sharey=True)
    spacing, points = measured.profile.spacing, min(measured.profile.heights.size, MOST_POINTS)
    distance = spacing * np.arange(points)
    steps = steps_between(measured.road, spacing)
    _, generated = sample_road(measured.road, spacing=spacing / steps, points=(points - 1) * steps + 1)
    for axis, heights, colour, title in (
        (axes[0], measured.profile.heights, MEASURED, f"measured, waves up to {1 / measured.roughness.band[0]:.3g} m"),
        (axes[1], generated[0, ::steps], DRIVEN, f"generated: {label(measured.candidates[0])}"),
    ):
        axis.plot(distance, 1000 * short_waves(heights, measured)[:points], color=colour, linewidth=0.8)
        axis.set_title(title, fontsize=10, loc="left")
        axis.set_ylabel("height, mm")
    axes[1].set_xlabel("distance, m")
    return figure


def short_waves(heights: npt.NDArray[np.float64], measured: MeasuredRoad) -> npt.NDArray[np.float64]:
    """Heights without waves longer than those of the band, m: Butterworth's filter of second order, back and forth."""
    from scipy.signal import butter, detrend, sosfiltfilt

    sections = butter(2, measured.roughness.band[0], "highpass", fs=1 / measured.profile.spacing, output="sos")
    longest = int(2 / (measured.roughness.band[0] * measured.profile.spacing))
    return np.asarray(sosfiltfilt(sections, detrend(heights), padlen=min(longest, heights.size - 1)))


def draw_residuals(measured: MeasuredRoad, narrow: bool) -> Figure:
    """Measured over fitted density in dB, of the power law and of the road to drive."""
    from scipy.stats import chi2

    figure, (axis,) = panels(narrow, height=3.8)
    bands = measured.roughness.spectrum.smoothed()
    low, high = measured.roughness.band
    inside = (bands.low >= low) & (bands.high <= high)
    n, freedom = bands.centre[inside], bands.degrees_of_freedom[inside]
    limits = [10 * np.log10(chi2.isf((1 + sign * CONFIDENCE) / 2, freedom) / freedom) for sign in (1, -1)]
    axis.fill_between(n, *limits, color="#888888", alpha=0.25, linewidth=0, label=f"{100 * CONFIDENCE:g} % of a sound fit")
    first = measured.candidates[0]
    for density, colour, style, name in (
        (measured.roughness.free.density(n), LAW, "o-", f"w = {measured.roughness.free.waviness:.3g}"),
        (road_density(first, n), DRIVEN, "s-.", label(first)),
    ):
        away = 10 * np.log10(bands.density[inside] / density)
        axis.plot(n, away, style, color=colour, linewidth=1.0, markersize=3.5, label=name)
    axis.axhline(0, color=MEASURED, linewidth=0.8)
    axis.set(xscale="log")
    axis.set_xlabel("spatial frequency n, cycles/m")
    axis.set_ylabel("measured over fitted, dB")
    axis.legend(fontsize=8, ncols=1 if narrow else 3)
    return figure


def draw_heights(measured: MeasuredRoad, narrow: bool) -> Figure:
    """Histogram of the heights, with the laws of the roads of second order."""
    figure, (axis,) = panels(narrow, height=3.8)
    heights = measured.heights_above_trend
    axis.hist(1000 * heights, bins=40, density=True, color="#BBBBBB", label="measured")
    deviation = float(heights.std())
    z = np.linspace(-1, 1, 801) * max(3.5 * deviation, 1.05 * float(np.abs(heights).max()))
    gaussian = np.exp(-0.5 * (z / deviation) ** 2) / (deviation * math.sqrt(2 * math.pi))
    axis.plot(1000 * z, gaussian / 1000, "--", color=LAW, linewidth=1.6, label="Gaussian of this deviation")
    bounded = measured.identified.bounded
    if bounded is not None:
        density = analysis.marginal_density(bounded.road, z) / 1000
        axis.plot(1000 * z, np.where(np.isfinite(density), density, np.nan), color=DRIVEN, linewidth=1.6, label="bounded road")
    axis.set_xlabel("height above the trend, mm")
    axis.set_ylabel("density, 1/mm")
    axis.legend(fontsize=8)
    return figure


def make_page(measured: MeasuredRoad, pictures: list[Picture]) -> str:
    """The page, for a browser or for print; it asks the network for nothing."""
    with needs("report"):
        import jinja2

    def encoded(path: Path | None) -> str | None:
        return None if path is None else base64.b64encode(path.read_bytes()).decode()

    least = measured.candidates[0].fit.information_criterion
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        name=measured.name,
        summary=summary(measured),
        pictures=[{"data": encoded(one.path), "narrow": encoded(one.narrow), "caption": one.caption} for one in pictures],
        roads=[
            {
                "kind": one.road.kind,
                "told": one.told,
                "above": f"{one.fit.information_criterion - least:.1f}",
                "p_value": f"{one.fit.p_value:.2g}",
            }
            for one in measured.candidates
        ],
        options=" ".join(options(measured.road)),
        mapping=json.dumps(mapping(measured.road)),
        certificate=measured.certificate,
        versions=versions(),
    )
