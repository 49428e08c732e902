"""The pictures of a comparison: cost over speed, an agent's use of the damper, its schedule, two signals against each other."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import analysis
from analysis import LowerBound
from analysis.response import needs_simulation
from roadgym.installation import needs
from roadgym.reward import divergent_terms
from roadgym.task import OPERATING_POINT, Task
from roadgym.vector import QuarterCarVectorEnv

from .evaluation import OperatingPoint, Predictor, answers, drive, observed_by
from .figure_style import STYLES, Report, plain_ticks, save_figure, speed_label, style
from .names import figure_label, file_names, title
from .records import Purpose, stream_seed
from .results import Comparison, Picture
from .theory import optimum, road_at, theoretical_cost
from .trade_off import draw_pareto, trade_off
from .units import abscissa, in_si, place, root, shown, unit, weighted

with needs("report"):
    from matplotlib.figure import Figure


def draw_figures(comparison: Comparison, folder: Path, report: Report | None = None) -> list[Picture]:
    """Draw every picture that the comparison has; returns them in order."""
    over = (
        "the speed"
        if in_si(comparison.task)
        else "the frequency ratio ν, the speed in units of natural frequency over wavenumber"
    )
    band = " Band: between the best known feedback and what no controller can beat." if comparison.bounded else ""
    pictures = [
        Picture(
            draw_cost_over_speed(comparison, folder / "cost_over_speed.png"),
            f"Cost over {over}. Marks: driven, with two standard errors. Full lines: theory.{band}",
            draw_cost_over_speed(comparison, folder / "cost_over_speed_narrow.png", narrow=True),
        )
    ]
    if in_si(comparison.task):
        path, narrow = folder / "root_mean_squares.png", folder / "root_mean_squares_narrow.png"
        caption = "Root mean squares over the speed: comfort, travel and grip. Marks: driven. Full line: theory."
        draw_root_mean_squares(comparison, path)
        draw_root_mean_squares(comparison, narrow, narrow=True)
        pictures.append(Picture(path, caption, narrow))
    endings = file_names(comparison.agents)
    for name, agents in comparison.agents.items():
        agent, suffix = agents[0], "" if len(comparison.agents) == 1 else f"-{endings[name]}"
        seen = set(observed_by(agent, comparison.task)) - set(OPERATING_POINT)
        if not seen and not needs_simulation(comparison.task.road, comparison.task.speed_noise, comparison.task.car):
            path = folder / f"schedule{suffix}.png"
            pictures.append(Picture(path, draw_schedule(name, agents, comparison, path)))
        elif seen and shows_policy(comparison.task):
            met = states_met(agent, comparison)
            path, narrow = folder / f"policy{suffix}.png", folder / f"policy{suffix}_narrow.png"
            caption = f"The damping that {name} chooses over the states that it meets, at {SPEEDS_IN_WORDS[len(met) - 1]}."
            draw_policy(met, comparison, path)
            draw_policy(met, comparison, narrow, narrow=True)
            pictures.append(Picture(path, caption, narrow))
    if len(trade_off(comparison.task)) > 1:
        path = folder / "pareto.png"
        pictures.append(Picture(path, draw_pareto(comparison, path, report)))
    return pictures


FARTHEST = 10.0  # times below the least driven cost at which the picture ends, wherever the lower bound is
# signals across and up in the two rows of `draw_policy`
AXES = (("velocity", "relative_velocity"), ("displacement", "travel"))
SPEEDS_IN_WORDS = ("one speed", "two speeds", "three speeds")
# for each speed, signals by name and the damping that was chosen there, all of shape (states,)
Met = dict[float, tuple[dict[str, npt.NDArray[np.float32]], npt.NDArray[np.float32]]]


def shows_policy(task: Task) -> bool:
    """Has the car all signals of `draw_policy`, and are they numbers on this plant?"""
    rough = divergent_terms(task.car, task.road, task.speed_noise)
    return all(name in task.car.mean_squares and name not in rough for name in itertools.chain(*AXES))


def draw_cost_over_speed(comparison: Comparison, path: Path, *, narrow: bool = False) -> Path:
    """Measured costs with error bars over the frequency ratio, and theory's curves for the constant dampings.

    A panel for each bandwidth, side by side, or one under the other for a ``narrow`` screen.
    """
    task = comparison.task
    bandwidths = sorted({point.bandwidth for point in comparison.points})
    number = len(bandwidths)
    shown = len(comparison.controllers) + comparison.bounded
    lines_of_legend = math.ceil(shown / (2 if narrow else 3 * number))
    size = (4.2, 2.9 * number + 0.5) if narrow else (5.2 * number + 0.6, 4.6)
    figure = Figure(figsize=(size[0], size[1] + 0.2 * lines_of_legend), layout="constrained")
    axes = figure.subplots(*((number, 1) if narrow else (1, number)), sharex=True, sharey=True, squeeze=False).flatten()
    speeds = sorted({point.speed for point in comparison.points})
    fine = np.linspace(speeds[0], speeds[-1], 80)
    for axis, bandwidth in zip(axes, bandwidths, strict=True):
        for name in comparison.controllers:
            rows = [comparison.row(name, point) for point in comparison.points if point.bandwidth == bandwidth]
            rows.sort(key=lambda row: row.point.speed)
            look = {"markersize": 5, **style(comparison, name)}
            ratios = [abscissa(task, row.point.speed) for row in rows]
            axis.errorbar(
                ratios,
                [row.cost for row in rows],
                [2 * row.standard_error for row in rows],
                linestyle="none" if rows[0].theory is not None else "--",
                linewidth=1.2,
                capsize=2,
                label=figure_label(title(name)),
                **look,
            )
            if rows[0].theory is not None:
                low, high = task.damping_range
                constant = {"d_min": low, "d_max": high}
                curve = [
                    optimum(task, speed, bandwidth).cost
                    if name == "analytic_optimum"
                    else theoretical_cost(task, constant[name], speed, bandwidth)
                    for speed in fine.tolist()
                ]
                axis.plot(abscissa(task, fine), curve, color=look["color"], linewidth=1.2)
        if comparison.bounded:
            _draw_bounds(axis, comparison, bandwidth)
        axis.set_yscale("log")
        if in_si(task):
            plain_ticks(axis.yaxis)
        named = comparison.configuration["environment"].get("road")
        road = named if isinstance(named, str) else task.road.kind
        axis.set_title(f"bandwidth $\\delta = {bandwidth:g}$" if bandwidth else road)
        axis.grid(visible=True, which="both", linewidth=0.3)
    for axis in axes[-1:] if narrow else axes:
        axis.set_xlabel(speed_label(task))
    for axis in axes if narrow else axes[:1]:
        axis.set_ylabel(f"cost: {weighted(task)}" if in_si(task) else "cost: weighted mean square\nover $E\\,Z^2$")
    if comparison.bounded:  # a bound may be far below all that was driven
        least, bound = min(row.cost for row in comparison.rows), axes[0].get_ylim()[0]
        axes[0].set_ylim(bottom=max(bound, least / FARTHEST))
    figure.legend(  # beside the panels, so that it covers nothing
        *axes[0].get_legend_handles_labels(),
        loc="outside lower center",
        ncols=math.ceil(shown / lines_of_legend),
        fontsize=8,
        title="marks: driven, ± 2 standard errors; lines: theory" + ("\n" if narrow else " ") + "(dashed: a guide to the eye)",
        title_fontsize=8,
    )
    save_figure(figure, path)
    return path


def _draw_bounds(axis: Any, comparison: Comparison, bandwidth: float) -> None:
    """The lower bound, and a band from it to the best known feedback."""
    found = sorted(
        (abscissa(comparison.task, point.speed), bound.cost, comparison.row(reference, point).cost if reference else bound.cost)
        for point, bound, reference in zip(comparison.points, comparison.bounds, comparison.references, strict=True)
        if point.bandwidth == bandwidth and isinstance(bound, LowerBound)
    )
    if found:
        across, low, high = np.array(found).T
        axis.fill_between(across, low, high, color="#999999", alpha=0.25, linewidth=0)
        axis.plot(
            across, low, color="#555555", linewidth=1.0, linestyle=":", marker="_", label="lower bound of all controllers"
        )


def draw_root_mean_squares(comparison: Comparison, path: Path, *, narrow: bool = False) -> Path:
    """What a drive in a car in SI is like over the speed, every controller in a panel for each of `agents.units.shown`."""
    task, names = comparison.task, shown(comparison.task)
    columns = 1 if narrow else 2
    lines = math.ceil(len(names) / columns)
    figure = Figure(figsize=(4.2, 2.4 * lines + 1.2) if narrow else (9.6, 3.0 * lines + 0.9), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False, sharex=True).flatten()
    bandwidth = comparison.points[0].bandwidth
    speeds = sorted({point.speed for point in comparison.points})
    fine = np.linspace(speeds[0], speeds[-1], 60)
    for axis, name in zip(axes, names, strict=False):
        for controller in comparison.controllers:
            rows = [comparison.row(controller, point) for point in comparison.points if point.bandwidth == bandwidth]
            rows.sort(key=lambda row: row.point.speed)
            look = {"markersize": 5, **style(comparison, controller)}
            x, y = [abscissa(task, row.point.speed) for row in rows], [root(task, name, row.squares[name]) for row in rows]
            line = "none" if rows[0].theory is not None else "--"
            axis.plot(x, y, linestyle=line, linewidth=1.2, label=figure_label(title(controller)), **look)
        if comparison.row("analytic_optimum", comparison.points[0]).theory is not None:
            dampings = [optimum(task, speed, bandwidth).damping for speed in fine.tolist()]
            road = road_at(task, bandwidth)
            squares = analysis.mean_squares(road, task.speed_noise, damping=dampings, speed=fine, car=task.car)[name]
            curve = [root(task, name, square / task.cost_unit) for square in squares.tolist()]
            axis.plot(abscissa(task, fine), curve, color=STYLES["analytic_optimum"]["color"], linewidth=1.2)
        axis.set_ylabel(f"{name.replace('_', ' ')}, {unit(task, name)[0]}")
        axis.grid(visible=True, linewidth=0.3)
    for axis in axes[len(names) :]:
        axis.set_axis_off()
    for axis in axes[len(names) - columns : len(names)]:
        axis.set_xlabel(speed_label(task))
        axis.tick_params(labelbottom=True)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2 if narrow else 4, fontsize=8)
    save_figure(figure, path)
    return path


def states_met(agent: Predictor, comparison: Comparison) -> Met:
    """The states that the agent meets, at three speeds of the comparison or fewer."""
    task = comparison.task
    bandwidth = comparison.points[0].bandwidth
    speeds = sorted({point.speed for point in comparison.points})
    number, steps_shown, skipped = 512, 150, 100
    observed = dict.fromkeys((*task.signals, *observed_by(agent, task), *itertools.chain(*AXES)))
    environment = {**comparison.configuration["environment"], "observation": list(observed)}
    met: Met = {}
    for speed in [speeds[0], speeds[len(speeds) // 2], speeds[-1]] if len(speeds) > 3 else speeds:
        envs = QuarterCarVectorEnv(number, max_episode_steps=None, **environment)
        options = {"speed": speed} | ({"bandwidth": bandwidth} if bandwidth else {})
        steps = drive(agent, envs, stream_seed(comparison.configuration["seed"], Purpose.PICTURE), options, task)
        seen, chosen = [], []
        for observations, damping, _, _ in itertools.islice(steps, skipped, skipped + steps_shown):
            seen.append(observations)
            chosen.append(damping[:, 0])
        states = np.concatenate(seen)
        met[speed] = {name: states[:, i] for i, name in enumerate(observed)}, np.concatenate(chosen)
    return met


def draw_policy(met: Met, comparison: Comparison, path: Path, *, narrow: bool = False) -> Path:
    """The damping that an agent chooses over the states that it meets, at each speed of `states_met`.

    Upper row: over the velocities of the body and of the suspension, where skyhook switches on the axes. Lower row: over the
    displacement and the travel. For a ``narrow`` screen the rows are columns, one speed under the other.
    """
    task = comparison.task
    bandwidth = comparison.points[0].bandwidth
    size = (4.2, 2.3 * len(met) + 0.8) if narrow else (3.5 * len(met) + 1.0, 6.8)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(*((len(met), 2) if narrow else (2, len(met))), squeeze=False)
    axes = grid.T if narrow else grid  # a row for each of `AXES`, a column for each speed
    symbols = {name: signal.symbol for name, signal in task.car.motion.signals.items()}
    labels = {
        "velocity": f"body velocity {symbols['velocity']}/(ω₁σ)",
        "relative_velocity": f"relative velocity {symbols['relative_velocity']}/(ω₁σ)",
        "displacement": f"displacement {symbols['displacement']}/σ",
        "travel": f"travel {symbols['travel']}/σ",
    }
    scale = dict.fromkeys(labels, 1.0)
    if in_si(task):
        factors = dict(zip(task.car.mean_squares, np.sqrt(task.square_units).tolist(), strict=True))
        scale = {name: factors[name] * unit(task, name)[1] for name in labels}
        labels = {name: f"{name.replace('_', ' ')}, {unit(task, name)[0]}" for name in labels}
    font: dict[str, Any] = {"fontsize": 8} if narrow else {}
    low, high = task.damping_range
    mesh: Any = None
    for column, (speed, (signal, values)) in enumerate(met.items()):
        for row, (across, up) in enumerate(AXES):
            axis, x, y = axes[row, column], scale[across] * signal[across], scale[up] * signal[up]
            width, height = (np.quantile(np.abs(v), 0.995) for v in (x, y))
            mesh = axis.hexbin(
                x,
                y,
                values,
                gridsize=28,
                extent=(-width, width, -height, height),
                vmin=low,
                vmax=high,
                cmap="cividis",
                mincnt=3,
            )
            axis.set_xlim(-width, width)
            axis.set_ylim(-height, height)
            axis.axhline(0, color="white", linewidth=0.8)
            axis.axvline(0, color="white", linewidth=0.8)
            axis.tick_params(labelsize=font.get("fontsize"))
            axis.set_xlabel(labels[across], **font)
            if narrow or column == 0:
                axis.set_ylabel(labels[up], **font)
            if narrow or row == 0:
                point = f"{abscissa(task, speed):g} km/h" if in_si(task) else f"$\\nu = {task.frequency_ratio(speed):g}$"
                point += f", $\\delta = {bandwidth:g}$" if bandwidth else ""
                axis.set_title(point, **({"fontsize": 9} if narrow else {}))
    bar = figure.colorbar(mesh, ax=grid, shrink=0.8, location="bottom" if narrow else "right")
    bar.set_label("mean damping ratio $D$ that the agent chooses", **font)
    bar.ax.tick_params(labelsize=font.get("fontsize"))
    save_figure(figure, path)
    return path


def draw_schedule(name: str, agents: Sequence[Predictor], comparison: Comparison, path: Path) -> str:
    """The damping that agents who see the operating point alone choose, over the analytic optimum; returns the caption.

    Left: D over the frequency ratio. Right: by how much their cost exceeds the least, both by theory.
    """
    task = comparison.task
    speeds = np.linspace(*task.speed, 60)
    bandwidths = sorted({point.bandwidth for point in comparison.points})
    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    ratios, across = task.frequency_ratio(speeds), abscissa(task, speeds)
    largest, worst = 0.0, comparison.points[0]
    for number, bandwidth in enumerate(bandwidths):
        best = [optimum(task, speed, bandwidth) for speed in speeds.tolist()]
        colour = ("#0072B2", "#009E73", "#CC79A7", "#E69F00")[number % 4]
        label = f"$\\delta = {bandwidth:g}$" if bandwidth else task.road.kind
        look: dict[str, Any] = {"color": colour, "marker": "osD^"[number % 4], "markevery": (3 * number, 12), "markersize": 4}
        left.plot(across, [point.damping for point in best], label=f"analytic, {label}", **look)
        for agent in agents:
            point = {"speed": ratios / (1 + ratios), "bandwidth": np.full(len(speeds), 2 * bandwidth / (1 + 2 * bandwidth))}
            seen = np.stack([point[signal] for signal in observed_by(agent, task)], axis=1).astype(np.float32)
            damping = answers(agent, task)(seen)[0][:, 0]
            pairs = zip(speeds.tolist(), damping.tolist(), strict=True)
            costs = [theoretical_cost(task, d, speed, bandwidth) for speed, d in pairs]
            excess = np.array(costs) / [float(point.cost) for point in best] - 1
            left.plot(across, damping, "--", linewidth=1.2, label=f"learned, {label}" if agent is agents[0] else None, **look)
            right.plot(across, 100 * excess, "--", linewidth=1.2, **look)
            if excess.max() > largest:
                largest, worst = float(excess.max()), OperatingPoint(float(speeds[excess.argmax()]), bandwidth)
    left.set_ylabel("damping ratio $D$")
    right.set_ylabel("cost above the least, %")
    for axis in (left, right):
        axis.set_xlabel(speed_label(task))
        axis.grid(visible=True, linewidth=0.3)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=2 * len(bandwidths), fontsize=8)
    save_figure(figure, path)
    who = name if len(agents) == 1 else f"the {len(agents)} training seeds of {name}"
    return (
        f"The schedule of {who}, which sees the operating point alone, over the analytic optimum D*(nu, delta). By theory its "
        f"cost is at most {100 * largest:.2f} % above the least, at {place(task, worst)}."
    )
