"""The pictures of a comparison: cost over speed, an agent's use of the damper, its schedule, two signals against each other."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import analysis
from analysis.response import needs_simulation
from roadgym.files import whole_file
from roadgym.installation import needs
from roadgym.reward import divergent_terms
from roadgym.task import OPERATING_POINT, Task, make_task
from roadgym.vector import QuarterCarVectorEnv

from .controllers import OptimalFeedback
from .evaluation import OperatingPoint, Predictor, answers, drive, evaluate, observed_by
from .names import figure_label, file_names, title
from .records import Purpose, stream_seed
from .results import Comparison, Picture
from .theory import optimum, road_at, theoretical_cost

with needs("report"):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

# Okabe and Ito's colours, told apart by readers with any colour vision, each with a mark of its own
STYLES: dict[str, dict[str, Any]] = {
    "analytic_optimum": {"color": "#0072B2", "marker": "s"},
    "d_min": {"color": "#999999", "marker": "v"},
    "d_max": {"color": "#000000", "marker": "^"},
    "skyhook": {"color": "#009E73", "marker": "D"},
    "one_step_lookahead": {"color": "#CC79A7", "marker": "P"},
    "optimal_feedback": {"color": "#E69F00", "marker": "*", "markersize": 9},
}
LEARNED = ("#D55E00", "#56B4E9", "#882255", "#117733")
OTHERS = ("x", "+", "1", "2", "3", "4", "|")
FRONT = (0.1, 0.3, 1.0, 3.0, 10.0)  # factors of the first weight along the front of the optimal feedbacks
Report = Callable[[str, int, int], None]


def style(comparison: Comparison, name: str) -> dict[str, Any]:
    """Colour and mark of a controller, for `matplotlib.axes.Axes.errorbar`."""
    if name in comparison.agents:
        number = list(comparison.agents).index(name)
        return {"color": LEARNED[number % len(LEARNED)], "marker": "o", "zorder": 5}
    if name in STYLES:
        return STYLES[name]
    others = [other for other in comparison.controllers if other not in STYLES and other not in comparison.agents]
    return {"color": "#666666", "marker": OTHERS[others.index(name) % len(OTHERS)]}


def draw_figures(comparison: Comparison, folder: Path, report: Report | None = None) -> list[Picture]:
    """Draw every picture that the comparison has; returns them in order."""
    pictures = [
        Picture(
            draw_cost_over_speed(comparison, folder / "cost_over_speed.png"),
            "Cost over the frequency ratio ν, the speed in units of natural frequency over wavenumber. Marks: driven, with two "
            "standard errors. Full lines: theory.",
            draw_cost_over_speed(comparison, folder / "cost_over_speed_narrow.png", narrow=True),
        )
    ]
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
    if len(comparison.task.reward_by_name) > 1:
        path = folder / "pareto.png"
        pictures.append(Picture(path, draw_pareto(comparison, path, report)))
    return pictures


# signals across and up in the two rows of `draw_policy`
AXES = (("velocity", "relative_velocity"), ("displacement", "travel"))
SPEEDS_IN_WORDS = ("one speed", "two speeds", "three speeds")
# for each speed, signals by name and the damping that was chosen there, all of shape (states,)
Met = dict[float, tuple[dict[str, npt.NDArray[np.float32]], npt.NDArray[np.float32]]]


def shows_policy(task: Task) -> bool:
    """Has the car all signals of `draw_policy`, and are they numbers on this plant?"""
    rough = divergent_terms(task.car, task.road, task.speed_noise)
    return all(name in task.car.mean_squares and name not in rough for name in itertools.chain(*AXES))


def save_figure(figure: Figure, path: Path) -> None:
    """Write the figure whole or not at all."""
    FigureCanvasAgg(figure)
    with whole_file(path) as part:
        figure.savefig(part, dpi=150)


def draw_cost_over_speed(comparison: Comparison, path: Path, *, narrow: bool = False) -> Path:
    """Measured costs with error bars over the frequency ratio, and theory's curves for the constant dampings.

    A panel for each bandwidth, side by side, or one under the other for a ``narrow`` screen.
    """
    task = comparison.task
    bandwidths = sorted({point.bandwidth for point in comparison.points})
    number = len(bandwidths)
    shown = len(comparison.controllers)
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
            ratios = [task.frequency_ratio(row.point.speed) for row in rows]
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
                axis.plot(task.frequency_ratio(fine), curve, color=look["color"], linewidth=1.2)
        axis.set_yscale("log")
        axis.set_title(f"bandwidth $\\delta = {bandwidth:g}$" if bandwidth else task.road.kind)
        axis.grid(visible=True, which="both", linewidth=0.3)
    for axis in axes[-1:] if narrow else axes:
        axis.set_xlabel("frequency ratio $\\nu = v\\Omega/\\omega_1$")
    for axis in axes if narrow else axes[:1]:
        axis.set_ylabel("cost: weighted mean square\nover $E\\,Z^2$")
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
    font: dict[str, Any] = {"fontsize": 8} if narrow else {}
    low, high = task.damping_range
    mesh: Any = None
    for column, (speed, (signal, values)) in enumerate(met.items()):
        for row, (across, up) in enumerate(AXES):
            axis, x, y = axes[row, column], signal[across], signal[up]
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
                point = f"$\\nu = {task.frequency_ratio(speed):g}$" + (f", $\\delta = {bandwidth:g}$" if bandwidth else "")
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
    ratios = task.frequency_ratio(speeds)
    largest, place = 0.0, comparison.points[0]
    for number, bandwidth in enumerate(bandwidths):
        best = [optimum(task, speed, bandwidth) for speed in speeds.tolist()]
        colour = ("#0072B2", "#009E73", "#CC79A7", "#E69F00")[number % 4]
        label = f"$\\delta = {bandwidth:g}$" if bandwidth else task.road.kind
        look: dict[str, Any] = {"color": colour, "marker": "osD^"[number % 4], "markevery": (3 * number, 12), "markersize": 4}
        left.plot(ratios, [point.damping for point in best], label=f"analytic, {label}", **look)
        for agent in agents:
            point = {"speed": ratios / (1 + ratios), "bandwidth": np.full(len(speeds), 2 * bandwidth / (1 + 2 * bandwidth))}
            seen = np.stack([point[signal] for signal in observed_by(agent, task)], axis=1).astype(np.float32)
            damping = answers(agent, task)(seen)[0][:, 0]
            pairs = zip(speeds.tolist(), damping.tolist(), strict=True)
            costs = [theoretical_cost(task, d, speed, bandwidth) for speed, d in pairs]
            excess = np.array(costs) / [float(point.cost) for point in best] - 1
            left.plot(ratios, damping, "--", linewidth=1.2, label=f"learned, {label}" if agent is agents[0] else None, **look)
            right.plot(ratios, 100 * excess, "--", linewidth=1.2, **look)
            if excess.max() > largest:
                largest, place = float(excess.max()), OperatingPoint(float(speeds[excess.argmax()]), bandwidth)
    left.set_ylabel("damping ratio $D$")
    right.set_ylabel("cost above the least, %")
    for axis in (left, right):
        axis.set_xlabel("frequency ratio $\\nu = v\\Omega/\\omega_1$")
        axis.grid(visible=True, linewidth=0.3)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=2 * len(bandwidths), fontsize=8)
    save_figure(figure, path)
    at = f"nu = {task.frequency_ratio(place.speed):.3g}" + (f", delta = {place.bandwidth:g}" if place.bandwidth else "")
    who = name if len(agents) == 1 else f"the {len(agents)} training seeds of {name}"
    return (
        f"The schedule of {who}, which sees the operating point alone, over the analytic optimum D*(nu, delta). By theory its "
        f"cost is at most {100 * largest:.2f} % above the least, at {at}."
    )


def optimal_front(
    comparison: Comparison, names: Sequence[str], point: OperatingPoint, report: Report | None
) -> npt.NDArray[np.float64]:
    """Two mean squares of the optimal feedbacks for `FRONT` of their weights' ratios, driven, shape (5, 2)."""
    weights = comparison.task.reward_by_name
    found = []
    for number, factor in enumerate(FRONT):
        if report:
            report("optimal feedbacks of other weights", number, len(FRONT))
        reward = {names[0]: factor * weights[names[0]], names[1]: weights[names[1]]}
        environment = {**comparison.configuration["environment"], "reward": reward}
        feedback = OptimalFeedback(make_task(**environment))
        seed, episodes = comparison.configuration["seed"], comparison.configuration["episodes"]
        options = {"speeds": [point.speed], "bandwidths": [point.bandwidth], "episodes": episodes, "seed": seed}
        driven = evaluate({"optimal": feedback}, environment=environment, **options)["optimal"]
        found.append([driven.mean_squares[comparison.task.car.mean_squares.index(name), 0] for name in names])
    if report:
        report("optimal feedbacks of other weights", len(FRONT), len(FRONT))
    return np.array(found)


def draw_pareto(comparison: Comparison, path: Path, report: Report | None) -> str:
    """The first two weighted mean squares against each other at one operating point; returns the caption.

    A line of constant dampings by theory, the controllers as driven, and the front of the optimal feedbacks for other weights,
    where the comparison drove the optimal feedback.
    """
    task = comparison.task
    names = list(task.reward_by_name)[:2]
    speeds = sorted({point.speed for point in comparison.points})
    point = next(point for point in comparison.points if point.speed == speeds[(len(speeds) - 1) // 2])
    figure = Figure(figsize=(9.0, 5.4), layout="constrained")
    axis = figure.subplots()
    if not needs_simulation(task.road, task.speed_noise, task.car):
        dampings = np.geomspace(*task.damping_range, 120)
        squares = analysis.mean_squares(
            road_at(task, point.bandwidth),
            task.speed_noise,
            damping=dampings,
            speed=point.speed,
            car=task.car,
        )
        x, y = (np.asarray(squares[name]) / task.cost_unit for name in names)
        axis.plot(x, y, color="#0072B2", linewidth=1.2, label="constant $D$, theory")
        for value in (0.1, 0.2, 0.3, 0.5, 0.7):
            if task.damping_range[0] < value < task.damping_range[1]:
                k = int(np.argmin(np.abs(dampings - value)))
                axis.plot(x[k], y[k], ".", color="#0072B2")
                text: dict[str, Any] = {
                    "textcoords": "offset points",
                    "fontsize": 7,
                    "color": "#0072B2",
                    "annotation_clip": True,
                }
                axis.annotate(f"{value:g}", (x[k], y[k]), (4, 4), **text)
    xs, ys = [], []
    if "optimal_feedback" in comparison.controllers:
        front = optimal_front(comparison, names, point, report)
        look = {**STYLES["optimal_feedback"], "markersize": 5}
        xs, ys = front.T.tolist()
        axis.plot(xs, ys, linestyle=":", label="optimal feedback, other weights", **look)
    for name in comparison.controllers:
        if name in ("d_min", "d_max"):
            continue  # the ends of the line
        row = comparison.row(name, point)
        place = [row.squares[signal] for signal in names]
        look = {"markersize": 8, **style(comparison, name)}
        axis.plot(*place, linestyle="none", label=figure_label(title(name)), **look)
        xs.append(place[0])
        ys.append(place[1])
    axis.set_xscale("log")
    axis.set_yscale("log")
    # the line runs far off, where nobody drives
    for set_limits, values in ((axis.set_xlim, xs), (axis.set_ylim, ys)):
        set_limits(min(values) / 1.3, max(values) * 1.6)
    axis.set_xlabel(f"mean square of {names[0].replace('_', ' ')} over $E\\,Z^2$")
    axis.set_ylabel(f"mean square of {names[1].replace('_', ' ')} over $E\\,Z^2$")
    at = f"nu = {task.frequency_ratio(point.speed):g}" + (f", delta = {point.bandwidth:g}" if point.bandwidth else "")
    axis.grid(visible=True, which="both", linewidth=0.3)
    for side in (axis.xaxis, axis.yaxis):
        side.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0)))
        side.set_major_formatter("{x:g}")
        side.set_minor_formatter(NullFormatter())
    figure.legend(loc="outside right upper", fontsize=8)
    save_figure(figure, path)
    return f"{names[0]} against {names[1]} at {at}: lower and further left is better in both."
