"""Figures 2-14 of Wedig (2020) with the paper's parameters, and the data of each as tables.

One function a figure returns a `Drawing`; `write` puts the pictures and their tables (CSV) into a folder. Where the print and
the derivation disagree the corrected curves are solid and the printed ones dashed, or each has a panel of its own. Lengths are
in units of the road's amplitude (Figs. 3, 4: in metres) and the natural frequency is 1, as in the paper. Figure 1 is a sketch.
"""

from __future__ import annotations

import collections
import csv
import dataclasses
import functools
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm, PowerNorm
from matplotlib.figure import Figure

from roadgym.files import make_folder, whole_file
from roadgym.parameters import ParameterError, shown, whole
from roadgym.roads import FirstOrderRoad, GaussianRoad, HarmonicRoad, MultiplicativeRoad, Road
from roadgym.speed import HighPassSpeedNoise, LowPassSpeedNoise, SpeedNoise, WhiteSpeedNoise

from .checks import FloatArray
from .response import mean_squares
from .roads import density, marginal_density
from .rotating_frame import mean_amplitude
from .simulation import simulate
from .stability import critical_noise, rotation_numbers

# M. Okabe and K. Ito's colours, told apart by readers with any colour vision, each with a line style of its own
BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILION, PURPLE = (
    *("#000000", "#E69F00", "#56B4E9", "#009E73"),
    *("#F0E442", "#0072B2", "#D55E00", "#CC79A7"),
)
SERIES: tuple[tuple[str, Any], ...] = (
    (BLACK, "-"),
    (BLUE, (0, (6, 1.5))),
    (VERMILION, "-."),
    (GREEN, (0, (3, 1))),
    (ORANGE, "-"),
    (PURPLE, (0, (5, 1, 1, 1, 1, 1))),
    (SKY, (0, (1, 0.8))),
    ("#7F7F7F", "--"),
)
STABLE = "corrected: stable, almost surely and\nin mean, at every noise for $D > 0$"
PRINTED: Any = (0, (3, 1.6))
SPEED_LABEL = "frequency ratio $\\nu = v\\Omega/\\omega_1$"
AMPLITUDE_LABEL = "mean amplitude $V_m/\\mu = |E\\,C|/\\mu$"
STYLE = {"linewidth": 1.5}

FULL_SAMPLES, FULL_SPEEDS = 20_000_000, 41  # of Fig. 7, as in the paper
QUICK_SAMPLES, QUICK_SPEEDS = 400_000, 21

Table = Mapping[str, npt.ArrayLike]
Report = Callable[[str, int, int], None]


@dataclasses.dataclass(frozen=True)
class Drawing:
    """A picture, and what is drawn in it.

    Attributes:
        figure: the picture.
        tables: columns of equal length by name, with unit; one table or several, by what they are ("" for the only one).
    """

    figure: Figure
    tables: Mapping[str, Table]


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


def _panels(columns: int = 1, rows: int = 1, width: float = 5.6, height: float = 3.8, **options: Any) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width if columns == 1 else 4.4 * columns, height * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    for axis in axes.flat:
        axis.grid(visible=True, linewidth=0.3)
    return figure, axes


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
    figure, [[axis]] = _panels()
    place, ratio = _all_speeds()
    columns: dict[str, npt.ArrayLike] = {"axis (1)": place, "frequency ratio (1)": ratio}
    for damping, line in ((0.1, "-"), (0.2, (0, (5, 1.5)))):
        for road, color, name, label in (
            (HarmonicRoad(), VERMILION, "amplitude ratio", "harmonic road, $Y/Z$"),
            (FirstOrderRoad(), BLUE, "deviation ratio", "random road, $\\sigma_y/\\sigma_z$"),
        ):
            values = _deviation(road, damping, ratio, "displacement", 0.0)
            columns[f"{name} at D={damping:g} (1)"] = values
            axis.plot(place, values, color=color, linestyle=line, label=f"{label}, $D = {damping:g}$", **STYLE)
    _draw_speed_axis(axis)
    axis.set_ylim(bottom=0)
    axis.set_ylabel("response over excitation (1)")
    axis.legend(loc="upper left", fontsize=8)
    return Drawing(figure, {"": columns})


def _density_figure(shape: float, claim: bool) -> Drawing:
    """The joint density (11) as a map, and its marginal."""
    road = MultiplicativeRoad.from_shape(shape=shape, level_bound=0.9)
    figure, [[left, right]] = _panels(2)
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
    figure, [[axis]] = _panels()
    place, ratio = _all_speeds()
    columns: dict[str, npt.ArrayLike] = {"axis (1)": place, "frequency ratio (1)": ratio}
    styles = ((VERMILION, "-"), *SERIES[:2], SERIES[3], SERIES[6])
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
    figure, axes = _panels(2, 2, height=3.2, sharex=True, sharey=True)
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
    axis: Any, columns: dict[str, npt.ArrayLike], cases: Sequence[tuple[str, str, SpeedNoise | None]], form: str, **style: Any
) -> None:
    """|E C| over the speed for each case (name, label, noise), D = 0.1, into a panel and into the table."""
    speed = np.linspace(0.0, 2.0, 401)
    columns["frequency ratio (1)"] = speed
    for (name, label, noise), (color, line) in zip(cases, SERIES, strict=False):
        values = np.abs(mean_amplitude(noise, damping=0.1, speed=speed, form=form))
        columns[f"{form} at {name} (1)"] = values
        axis.plot(speed, values, **{"color": color, "linestyle": line, "label": label, **STYLE, **style})
    axis.set(xlim=(0, 2), xticks=[0, 0.5, 1, 1.5, 2], xlabel=SPEED_LABEL)


def figure_8(full: bool = False, report: Report | None = None) -> Drawing:
    """Resonance under white noise of growing intensity, D = 0.1; 0.5 is not legible in the paper's figure."""
    figure, [[left, right]] = _panels(2, sharey=True)
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
    figure, axes = _panels(2, sharey=True)
    columns: dict[str, npt.ArrayLike] = {}
    for axis, intensity in zip(axes[0], (0.2, 0.5), strict=True):
        cases: list[tuple[str, str, SpeedNoise | None]] = []
        for corner in (0.0, 0.1, 0.5, 1.0, 5.0):
            noise = LowPassSpeedNoise(intensity=intensity, corner_frequency=corner) if corner else None
            cases.append((f"sigma={intensity:g} corner={corner:g}", f"{corner:g}", noise))
        _resonances(axis, columns, cases, "exact", linestyle="-")
        _resonances(axis, columns, cases, "closure", linestyle=(0, (1, 1.2)), label=None, linewidth=2.0)
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
    figure, axes = _panels(2, 2, height=3.6, sharex=True)
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


def stability_angles(damping: float, share: complex, time: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Angles (Delta, Psi) of (38), (39) along the exact solution: Delta = arg y - arg x and tan Psi = |x/y| for the complex
    free motion y = e^(a t) + share e^(b t), x = y', of the car with the roots a, b; D other than 1, time in units of 1/w1.
    """
    root = np.emath.sqrt((damping - 1) * (damping + 1))
    slow, fast = np.exp((root - damping) * time), share * np.exp((-root - damping) * time)
    y, x = slow + fast, (root - damping) * slow + (-root - damping) * fast
    return np.angle(y / x), np.arctan2(np.abs(x), np.abs(y))


def _draw_angles(axis: Any, angle: FloatArray, stability: FloatArray, **style: Any) -> None:
    """A path in the plane of both angles and its mirror image (Delta + pi, -Psi), cut where Delta wraps."""
    for shift, sign in ((0.0, 1.0), (math.pi, -1.0)):
        x = (angle + shift + math.pi) % (2 * math.pi) - math.pi
        x[np.abs(np.diff(x, append=x[-1])) > math.pi] = np.nan
        axis.plot(x, sign * stability, **style)
        middle = len(x) // 2
        if np.isfinite(x[middle : middle + 2]).all():
            ends = [(x[k], sign * stability[k]) for k in (middle, middle + 1)]
            arrow = {"arrowstyle": "-|>", "color": style["color"], "linewidth": 0.8}
            axis.annotate("", xy=ends[1], xytext=ends[0], arrowprops=arrow)


def _angle_axes() -> tuple[Figure, Any]:
    figure, [[axis]] = _panels(width=6.4, height=4.6)
    ticks = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    axis.set_xticks(math.pi * ticks, ["$-\\pi$", "$-\\pi/2$", "0", "$\\pi/2$", "$\\pi$"])
    axis.set_yticks(math.pi / 2 * ticks, ["$-\\pi/2$", "$-\\pi/4$", "0", "$\\pi/4$", "$\\pi/2$"])
    axis.set(xlim=(-math.pi, math.pi), ylim=(-math.pi / 2, math.pi / 2))
    axis.set(xlabel="difference angle $\\Delta$ (rad)", ylabel="stability angle $\\Psi$ (rad)")
    return figure, axis


def _angle_table(paths: Sequence[tuple[FloatArray, FloatArray, FloatArray]]) -> Table:
    time, angle, stability = (np.concatenate(part) for part in zip(*paths, strict=True))
    number = np.repeat(np.arange(len(paths)), [len(path[0]) for path in paths])
    return {
        "path": number,
        "time (1/natural frequency)": time,
        "difference angle (rad)": angle,
        "stability angle (rad)": stability,
    }


def figure_11(full: bool = False, report: Report | None = None) -> Drawing:
    """Angles of (38), (39) at D = 0.5: neutral closed orbits about four centres, one orbit for each start."""
    figure, axis = _angle_axes()
    damping = 0.5
    own = math.sqrt(1 - damping**2)
    time = np.linspace(0, math.pi / own, 801)
    paths = []
    for share in (0.1, 0.25, 0.45, 0.7, 0.9):
        for turned in (False, True):  # the other mode is the larger one: the mirror image in Delta
            angle, stability = stability_angles(damping, complex(1 / share if turned else share), time)
            paths.append((time, angle, stability))
            _draw_angles(axis, angle, stability, color=BLUE, linewidth=1.1)
    for sign in (1, -1):
        for centre in (math.pi - math.acos(damping), math.acos(damping) - math.pi):
            place = centre if sign > 0 else centre - math.copysign(math.pi, centre)
            axis.plot(place, sign * math.pi / 4, "o", color=VERMILION, markersize=6, zorder=3)
    axis.plot([], [], color=BLUE, label="closed orbits")
    axis.plot([], [], "o", color=VERMILION, label="centres, $\\Psi = \\pm\\pi/4$, $\\cos\\Delta = \\mp D$")
    figure.legend(loc="outside upper center", ncols=2)
    return Drawing(figure, {"": _angle_table(paths)})


def figure_12(full: bool = False, report: Report | None = None) -> Drawing:
    """Angles of (38), (39) at D = 1.5: every path ends in the fixed point of the slow root."""
    figure, axis = _angle_axes()
    damping = 1.5
    root = math.sqrt(damping**2 - 1)
    time = np.linspace(-3.0, 3.0, 1201)
    paths = []
    for turn in (0.03, 0.12, 0.25, 0.4, 0.6, 0.85):
        for side in (1, -1):
            angle, stability = stability_angles(damping, complex(np.exp(1j * math.pi * side * turn)), time)
            paths.append((time, angle, stability))
            _draw_angles(axis, angle, stability, color=BLUE, linewidth=1.1)
    for rate, mark, label in ((damping - root, "o", "stable fixed points"), (damping + root, "s", "unstable fixed points")):
        height = math.atan(rate)
        axis.plot(
            [math.pi, -math.pi, 0],
            [height, height, -height],
            mark,
            color=VERMILION if mark == "o" else BLACK,
            clip_on=False,
            linestyle="none",
            markersize=7,
            zorder=3,
            label=f"{label}, $\\sin 2\\Psi = \\pm 1/D$",
        )
    axis.plot([], [], color=BLUE, label="paths")
    figure.legend(loc="outside upper center", ncols=3, fontsize=8)
    return Drawing(figure, {"": _angle_table(paths)})


def figure_13(full: bool = False, report: Report | None = None) -> Drawing:
    """Rotation numbers (42), (43) over the speed, D = 0, 0.9 and 1."""
    figure, [[axis]] = _panels()
    speed = np.linspace(0.0, 2.0, 201)
    columns: dict[str, npt.ArrayLike] = {"frequency ratio (1)": speed}
    for damping, color, line in ((0.0, VERMILION, "-"), (0.9, GREEN, (0, (5, 1.5))), (1.0, BLACK, "-.")):
        for name, values in zip(("upper", "lower"), rotation_numbers(damping, speed=speed), strict=True):
            columns[f"{name} at D={damping:g} (1)"] = values
            label = f"$D = {damping:g}$" if name == "upper" else None
            axis.plot(speed, values, color=color, linestyle=line, label=label, **STYLE)
            axis.plot(speed, -values, color=color, linestyle=line, linewidth=0.7, alpha=0.7)
    axis.plot([], [], color="#7F7F7F", linewidth=0.7, label="reversed sense")
    axis.set(xlim=(0, 2), ylim=(-3.1, 3.1), xlabel=SPEED_LABEL, ylabel="rotation numbers $\\rho/\\omega_1$ (1)")
    figure.legend(loc="outside upper center", ncols=4)
    return Drawing(figure, {"": columns})


def figure_14(full: bool = False, report: Report | None = None) -> Drawing:
    """Stability map over the damping: printed bounds, where in truth noise never takes stability away."""
    figure, [[axis]] = _panels()
    damping = np.linspace(0.0, 1.5, 301)
    columns: dict[str, npt.ArrayLike] = {"damping (1)": damping}
    axis.axvspan(0, 1.5, color=GREEN, alpha=0.18, linewidth=0, label=STABLE)
    for sense, words, color, line in (
        ("almost_sure", "almost surely", VERMILION, PRINTED),
        ("mean", "in mean", BLUE, (0, (6, 1.2, 1, 1.2))),
    ):
        for form in ("ito", "printed"):
            columns[f"{form}, {sense} (1)"] = critical_noise(damping, sense=sense, form=form)
        axis.plot(
            damping, columns[f"printed, {sense} (1)"], color=color, linestyle=line, label=f"printed bound, {words}", **STYLE
        )
    axis.set(xlim=(0, 1.5), ylim=(0, 2.6), xlabel="damping ratio $D$ (1)", ylabel="critical noise $\\sigma^2/\\omega_1$ (1)")
    axis.legend(loc="upper left", fontsize=8)
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
