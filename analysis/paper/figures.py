"""Figures 2-14 of Wedig (2020) with the paper's parameters, and the data of each as tables.

One function a figure returns a `Drawing`; `write` puts the pictures and their tables (CSV) into a folder. Where the print and
the derivation disagree the corrected curves are solid and the printed ones dashed, or each has a panel of its own. Lengths are
in units of the road's amplitude (Figs. 3, 4: in metres) and the natural frequency is 1, as in the paper. Figure 1 is a sketch.
"""

from __future__ import annotations

import collections
import csv
import functools
import math
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from roadgym.files import make_folder, whole_file
from roadgym.installation import needs
from roadgym.parameters import ParameterError, shown, whole
from roadgym.roads import FirstOrderRoad, GaussianRoad, HarmonicRoad, MultiplicativeRoad, Road
from roadgym.speed import HighPassSpeedNoise, LowPassSpeedNoise, SpeedNoise, WhiteSpeedNoise

from ..checks import FloatArray
from ..response import mean_squares
from ..roads import density, marginal_density
from .drawing import (
    AMPLITUDE_LABEL,
    BLUE,
    ORANGE,
    PRINTED,
    SERIES,
    SPEED_LABEL,
    STYLE,
    VERMILION,
    Drawing,
    Report,
    Table,
    panels,
)
from .euler_maruyama import simulate
from .rotating_frame import mean_amplitude
from .stability_figures import figure_11, figure_12, figure_13, figure_14

with needs("report"):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import LogNorm, PowerNorm

FULL_SAMPLES, FULL_SPEEDS = 20_000_000, 41  # of Fig. 7, as in the paper
QUICK_SAMPLES, QUICK_SPEEDS = 400_000, 21


def write(
    folder: str | Path, numbers: Iterable[int] | None = None, *, full: bool = False, report: Report | None = None
) -> list[Path]:
    """Draw figures into a folder as PNG, each with its data as CSV; every file is written whole or not at all.

    Args:
        folder: made where it does not exist.
        numbers: of the paper's figures, 2 to 14; by default all.
        full: Fig. 7 with all the paper's samples.
        report: called as ``report(what, done, in all)`` now and then.

    Returns:
        The files.

    Raises:
        ParameterError: a figure that the paper does not have, or a folder that cannot be written.
    """
    try:
        asked = list(FIGURES if numbers is None else numbers)
    except Exception:  # whatever a foreign object may raise
        raise ParameterError(f"numbers must be of the figures {', '.join(map(str, FIGURES))}, got {shown(numbers)}") from None
    chosen = list(dict.fromkeys(whole("figure", number) for number in asked))
    for number in chosen:
        if number not in FIGURES:
            raise ParameterError(f"figure must be one of {', '.join(map(str, FIGURES))}, got {shown(number)}")
    if not isinstance(folder, (str, os.PathLike)):
        raise ParameterError(f"folder must name a folder, got {shown(folder)}")
    files = []
    try:
        target = make_folder(folder)
        for number in chosen:
            drawing = FIGURES[number](full, report)
            for name, table in drawing.tables.items():
                path = target / f"figure_{number:02d}{name and '_' + name}.csv"
                with whole_file(path) as part:
                    _write_table(table, part)
                files.append(path)
            FigureCanvasAgg(drawing.figure)
            path = target / f"figure_{number:02d}.png"
            with whole_file(path) as part:
                drawing.figure.savefig(part, dpi=200)
            files.append(path)
    except OSError as error:
        raise ParameterError(f"the folder {folder} cannot be written: {error.strerror or error}") from None
    return files


def _write_table(table: Table, path: Path) -> None:
    columns = [np.asarray(column) for column in table.values()]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(table)
        writer.writerows(zip(*(column.tolist() for column in columns), strict=True))


def _all_speeds() -> tuple[FloatArray, FloatArray]:
    """The speed axis of Fig. 2: l = nu up to 1 and 2 - 1/nu beyond, so that l = 2 is an infinite speed; and nu."""
    axis = np.linspace(0.0, 2.0, 801)
    with np.errstate(divide="ignore"):
        return axis, np.where(axis <= 1, axis, 1 / (2 - axis))


def _draw_speed_axis(axis: Any) -> None:
    axis.set_xlim(0, 2)
    axis.set_xticks([0, 0.25, 0.5, 0.75, 1, 1.25, 1.5, 1.75, 2], ["0", "¼", "½", "¾", "1", "4/3", "2", "4", "∞"])
    axis.set_xlabel(SPEED_LABEL + ", scale $\\nu$ up to 1, $2 - 1/\\nu$ beyond")


def _deviation(road: Road, damping: float, ratio: FloatArray, quantity: str, limit: float) -> FloatArray:
    """Root of a mean square over the variance of the road, and its ``limit`` at an infinite speed."""
    result = np.full(ratio.shape, limit)
    known = np.isfinite(ratio)
    squares = getattr(mean_squares(road, damping=damping, speed=ratio[known] / road.wavenumber), quantity)
    result[known] = np.sqrt(squares / road.variance)
    return result


def figure_2(full: bool = False, report: Report | None = None) -> Drawing:
    """Amplitude ratio (3) and ratio of standard deviations (6) over the speed, D = 0.1 and 0.2."""
    figure, [[axis]] = panels()
    place, ratio = _all_speeds()
    columns: dict[str, npt.ArrayLike] = {"axis (1)": place, "frequency ratio (1)": ratio}
    for number, damping in enumerate((0.1, 0.2)):
        for road, color, lines, name, label in (
            (HarmonicRoad(), VERMILION, ("-", (0, (5, 1.5))), "amplitude ratio", "harmonic road, $Y/Z$"),
            (FirstOrderRoad(), BLUE, ("-.", (0, (1, 0.8))), "deviation ratio", "random road, $\\sigma_y/\\sigma_z$"),
        ):
            values = _deviation(road, damping, ratio, "displacement", 0.0)
            columns[f"{name} at D={damping:g} (1)"] = values
            axis.plot(place, values, color=color, linestyle=lines[number], label=f"{label}, $D = {damping:g}$", **STYLE)
    _draw_speed_axis(axis)
    axis.set_ylim(bottom=0)
    axis.set_ylabel("response over excitation (1)")
    axis.legend(loc="upper left", fontsize=8)
    return Drawing(figure, {"": columns})


def _density_figure(shape: float, claim: bool) -> Drawing:
    """The joint density (11) as a map, and its marginal."""
    road = MultiplicativeRoad.from_shape(shape=shape, level_bound=0.9)
    figure, [[left, right]] = panels(2)
    places = np.linspace(-0.895, 0.895, 180)  # in cells of 0.01 m; no node is on the circle, where the density may be infinite
    level, slope = np.meshgrid(places, places)
    values = density(road, level, slope)
    shown = np.where(values > 0, values, np.nan)
    norm = LogNorm(np.nanmin(shown), np.nanpercentile(shown, 99.5)) if claim else None
    mesh = left.pcolormesh(places, places, shown, cmap="cividis", norm=norm, shading="nearest", rasterized=True)
    angle = np.linspace(0, 2 * math.pi, 400)
    left.plot(0.9 * np.cos(angle), 0.9 * np.sin(angle), color=VERMILION, linewidth=1.2, label="bound $r_0 = 0.9$ m")
    left.set(aspect="equal", xlabel="level $z$ (m)", ylabel="slope $u$ (m)", xlim=(-1.02, 1.02), ylim=(-1.02, 1.22))
    left.grid(visible=False)
    left.legend(loc="upper right", fontsize=8)
    bar = figure.colorbar(mesh, ax=left, label="$p(z, u)$ (1/m$^2$)", shrink=0.85, extend="max" if claim else "neither")
    if claim:
        bar.set_ticks([0.2, 0.5, 1.0, 2.0], labels=["0.2", "0.5", "1", "2"])
        bar.minorticks_off()
    figure.set_layout_engine("constrained", w_pad=0.14)
    z = np.linspace(-0.8999, 0.8999, 1001)
    marginal = marginal_density(road, z)
    columns = {"level (m)": z, "marginal density (1/m)": marginal}
    right.plot(z, marginal, color=BLUE, label=f"marginal of (11), $\\alpha = {shape:g}$", **STYLE)
    if claim:
        columns["density of the sinusoid (1/m)"] = sinusoid = marginal_density(HarmonicRoad(amplitude=0.9), z)
        name = "sinusoidal road, as the\npaper has it for $\\alpha = 1/2$"
        right.plot(z, sinusoid, color=VERMILION, linestyle=PRINTED, label=name, **STYLE)
        right.set_ylim(0, 2.5)
    else:
        right.set_ylim(bottom=0)
    right.set(xlabel="level $z$ (m)", ylabel="$p(z)$ (1/m)", xlim=(-1.02, 1.02))
    right.legend(loc="upper center" if claim else "lower center", fontsize=8)
    joint = {"level (m)": level.ravel(), "slope (m)": slope.ravel(), "density (1/m^2)": values.ravel()}
    return Drawing(figure, {"joint": joint, "marginal": columns})


def figure_3(full: bool = False, report: Report | None = None) -> Drawing:
    """Density (11) of level and slope, r0 = 0.9 m and alpha = 3."""
    return _density_figure(3.0, claim=False)


def figure_4(full: bool = False, report: Report | None = None) -> Drawing:
    """Singular density (11), alpha = 1/2: its marginal is uniform, not that of the sinusoid."""
    return _density_figure(0.5, claim=True)


def _bandwidth_figure(quantity: str, limit: float, label: str) -> Drawing:
    figure, [[axis]] = panels()
    place, ratio = _all_speeds()
    columns: dict[str, npt.ArrayLike] = {"axis (1)": place, "frequency ratio (1)": ratio}
    styles = ((VERMILION, "-."), *SERIES[:2], SERIES[3], SERIES[6])
    for bandwidth, (color, line) in zip((0.0, 0.05, 0.1, 0.2, 0.5), styles, strict=True):
        road = GaussianRoad(bandwidth=bandwidth) if bandwidth else HarmonicRoad()
        values = _deviation(road, 0.105, ratio, quantity, limit)
        columns[f"ratio at delta={bandwidth:g} (1)"] = values
        name = f"$\\delta = {bandwidth:g}$" + ("" if bandwidth else " (harmonic)")
        axis.plot(place, values, color=color, linestyle=line, label=name, **STYLE)
    _draw_speed_axis(axis)
    axis.set_ylim(bottom=0)
    axis.set_ylabel(label)
    axis.legend(title="$D = 0.105$")
    return Drawing(figure, {"": columns})


def figure_5(full: bool = False, report: Report | None = None) -> Drawing:
    """Root of (16), displacement over road, for the bandwidths 0 (harmonic) to 0.5."""
    return _bandwidth_figure("displacement", 0.0, "standard deviations $\\sigma_y/\\sigma_z$ (1)")


def figure_6(full: bool = False, report: Report | None = None) -> Drawing:
    """Root of (17), velocity over road, for the bandwidths 0 (harmonic) to 0.5."""
    return _bandwidth_figure("velocity", 2 * 0.105, "standard deviations $\\sigma_x/\\sigma_z$, $X = \\dot Y/\\omega_1$ (1)")


def figure_7(full: bool = False, report: Report | None = None) -> Drawing:
    """Means and densities of A and B by Euler-Maruyama, white noise of 0.2, D = 0.1: Ito's amplitudes, and the printed ones."""
    samples, number = (FULL_SAMPLES, FULL_SPEEDS) if full else (QUICK_SAMPLES, QUICK_SPEEDS)
    noise = WhiteSpeedNoise(intensity=0.2)
    speeds = np.linspace(0.0, 2.0, number)
    fine = np.linspace(0.0, 2.0, 401)
    figure, axes = panels(2, 2, height=3.2, sharex=True, sharey=True)
    means: dict[str, list[Any]] = collections.defaultdict(list)
    densities: dict[str, list[Any]] = collections.defaultdict(list)
    mesh: Any = None
    for row, (form, title) in enumerate((("ito", "corrected"), ("printed", "as printed"))):
        found = simulate(
            "harmonic",
            noise,
            damping=0.1,
            speed=speeds.tolist(),
            form=form,
            samples=samples,
            histogram=(-6.0, 9.0, 300),
            report=None if report is None else functools.partial(report, f"figure 7, {title}"),
        )
        exact = mean_amplitude(noise, damping=0.1, speed=fine, form="printed" if form == "printed" else "exact")
        for column, (name, curve) in enumerate((("A", exact.real), ("B", -exact.imag))):
            axis = axes[row, column]
            estimates = [point.second if column else point.first for point in found]
            cells = np.array([point.second_density if column else point.first_density for point in found])
            edges = found[0].edges
            mesh = axis.pcolormesh(
                speeds,
                (edges[1:] + edges[:-1]) / 2,
                cells.T,
                cmap="Greys",
                norm=PowerNorm(0.4, 0.0, 3.0),
                shading="nearest",
                rasterized=True,
            )
            axis.plot(
                fine, curve, color=VERMILION if row else BLUE, linestyle=PRINTED if row else "-", label="formula", **STYLE
            )
            axis.errorbar(
                speeds,
                [estimate.value for estimate in estimates],
                [2 * estimate.standard_error for estimate in estimates],
                color=ORANGE,
                linestyle="none",
                marker="o",
                markersize=3,
                capsize=2,
                label="simulated, ± 2 standard errors",
            )
            axis.set_title(f"$E({name})$ and $p({name.lower()})$, {title}", fontsize=10)
            axis.grid(visible=False)
            means["form"].extend([form] * number)
            means["amplitude"].extend([name] * number)
            means["frequency ratio (1)"].extend(speeds.tolist())
            means["mean (1)"].extend(estimate.value for estimate in estimates)
            means["standard error (1)"].extend(estimate.standard_error for estimate in estimates)
            formula = mean_amplitude(noise, damping=0.1, speed=speeds, form="printed" if row else "exact")
            means["formula (1)"].extend((-formula.imag if column else formula.real).tolist())
            densities["form"].extend([form] * cells.size)
            densities["amplitude"].extend([name] * cells.size)
            densities["frequency ratio (1)"].extend(np.repeat(speeds, cells.shape[1]).tolist())
            densities["cell from (1)"].extend(np.tile(edges[:-1], number).tolist())
            densities["cell to (1)"].extend(np.tile(edges[1:], number).tolist())
            densities["density (1)"].extend(cells.ravel().tolist())
    for axis in axes[1]:
        axis.set_xlabel(SPEED_LABEL)
    for axis in axes[:, 0]:
        axis.set_ylabel("amplitude over $\\mu$ (1)")
    axes[0, 0].set(xlim=(0, 2), xticks=[0, 0.5, 1, 1.5, 2], ylim=(-6, 9))
    for axis in axes[:, 1]:
        axis.legend(loc="lower right", fontsize=8)
    figure.colorbar(mesh, ax=axes, label="density of the amplitude (1)", shrink=0.7, extend="max", pad=0.02)
    return Drawing(figure, {"means": dict(means), "densities": dict(densities)})


def _resonances(
    axis: Any,
    columns: dict[str, npt.ArrayLike],
    cases: Sequence[tuple[str, str, SpeedNoise | None]],
    form: str,
    marks: str = "",
    **style: Any,
) -> None:
    """|E C| over the speed for each case (name, label, noise), D = 0.1, into a panel and into the table.

    Each case has a line style of its own, or one of ``marks`` where ``style`` has one for all.
    """
    speed = np.linspace(0.0, 2.0, 401)
    columns["frequency ratio (1)"] = speed
    for number, ((name, label, noise), (color, line)) in enumerate(zip(cases, SERIES, strict=False)):
        values = np.abs(mean_amplitude(noise, damping=0.1, speed=speed, form=form))
        columns[f"{form} at {name} (1)"] = values
        own = {"marker": marks[number], "markevery": (8 * number, 40), "markersize": 4.5} if marks else {}
        axis.plot(speed, values, **{"color": color, "linestyle": line, "label": label, **STYLE, **own, **style})
    axis.set(xlim=(0, 2), xticks=[0, 0.5, 1, 1.5, 2], xlabel=SPEED_LABEL)


def figure_8(full: bool = False, report: Report | None = None) -> Drawing:
    """Resonance under white noise of growing intensity, D = 0.1; 0.5 is not legible in the paper's figure."""
    figure, [[left, right]] = panels(2, sharey=True)
    columns: dict[str, npt.ArrayLike] = {}
    cases: list[tuple[str, str, SpeedNoise | None]] = []
    for intensity in (0.0, 0.2, 0.3, 0.4, 0.5, 0.8, 1.0, 1.5):
        noise = WhiteSpeedNoise(intensity=intensity) if intensity else None
        cases.append((f"sigma={intensity:g}", f"{intensity:g}", noise))
    _resonances(left, columns, cases, "exact")
    _resonances(right, columns, cases, "printed")
    left.set(title="corrected: noise only reduces", ylabel=AMPLITUDE_LABEL, ylim=(0, 26))
    right.set_title("as printed, formal beyond $\\sigma^2 = 2D\\omega_1$")
    right.legend(title="$\\sigma/\\sqrt{\\omega_1}$", fontsize=8, title_fontsize=8)
    return Drawing(figure, {"": columns})


def figure_9(full: bool = False, report: Report | None = None) -> Drawing:
    """Resonance reduction under low-pass noise, D = 0.1: exact, and with the paper's Gaussian closure (28), (29)."""
    figure, axes = panels(2, sharey=True)
    columns: dict[str, npt.ArrayLike] = {}
    for axis, intensity in zip(axes[0], (0.2, 0.5), strict=True):
        cases: list[tuple[str, str, SpeedNoise | None]] = []
        for corner in (0.0, 0.1, 0.5, 1.0, 5.0):
            noise = LowPassSpeedNoise(intensity=intensity, corner_frequency=corner) if corner else None
            cases.append((f"sigma={intensity:g} corner={corner:g}", f"{corner:g}", noise))
        _resonances(axis, columns, cases, "exact", "os^Dv", linestyle="-")
        _resonances(axis, columns, cases, "closure", "os^Dv", linestyle=(0, (1, 1.2)), label=None, linewidth=2.0)
        axis.plot([], [], color="#7F7F7F", linestyle=(0, (1, 1.2)), linewidth=2.0, label="closure (28), (29)")
        axis.set(title=f"$\\sigma = {intensity:g}\\sqrt{{\\omega_1}}$", ylim=(0, 5.5))
    axes[0, 0].set_ylabel(AMPLITUDE_LABEL)
    axes[0, 1].legend(title="exact, $\\omega_g/\\omega_1$", fontsize=8, title_fontsize=8)
    return Drawing(figure, {"": columns})


def figure_10(full: bool = False, report: Report | None = None) -> Drawing:
    """High-pass noise, D = 0.1: reduced resonance, where the paper has resonance induction.

    At sigma = 0.2, above, the printed equations do what the paper says of its figure. At the sigma = 0.5 of its text, below,
    their means are unstable, and white noise has the highest peak. So the former is most likely what was drawn.
    """
    figure, axes = panels(2, 2, height=3.6, sharex=True)
    columns: dict[str, npt.ArrayLike] = {}
    remarks = (": most likely the paper's figure", " (text): formal, unstable means")
    for row, intensity, remark in zip(axes, (0.2, 0.5), remarks, strict=True):
        white, sigma = WhiteSpeedNoise(intensity=intensity), f"$\\sigma = {intensity:g}\\sqrt{{\\omega_1}}$"
        cases: list[tuple[str, str, SpeedNoise | None]] = [
            (f"sigma={intensity:g} no noise", "no noise", None),
            (f"sigma={intensity:g} corner=0", "$\\omega_g = 0$ (white)", white),
        ]
        for corner in (0.1, 5.0):
            noise = HighPassSpeedNoise(intensity=intensity, corner_frequency=corner)
            cases.append((f"sigma={intensity:g} corner={corner:g}", f"$\\omega_g = {corner:g}\\,\\omega_1$", noise))
        for axis, form in zip(row, ("exact", "printed"), strict=True):
            _resonances(axis, columns, cases, form)
            axis.set_ylim(bottom=0)
        row[0].set_ylabel(AMPLITUDE_LABEL)
        row[0].set_title(f"corrected, {sigma}", fontsize=10)
        row[1].set_title(f"as printed, {sigma}{remark}", fontsize=10)
    for axis in axes[0]:
        axis.set(ylim=(0, 9), xlabel="")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    return Drawing(figure, {"": columns})


FIGURES: dict[int, Callable[[bool, Report | None], Drawing]] = {
    2: figure_2,
    3: figure_3,
    4: figure_4,
    5: figure_5,
    6: figure_6,
    7: figure_7,
    8: figure_8,
    9: figure_9,
    10: figure_10,
    11: figure_11,
    12: figure_12,
    13: figure_13,
    14: figure_14,
}
