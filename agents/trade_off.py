"""The picture of a trade-off: two mean squares of a drive against each other."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import analysis
from analysis.response import needs_simulation
from roadgym.installation import needs
from roadgym.task import Task, make_task

from .controllers import OptimalFeedback
from .evaluation import OperatingPoint, evaluate
from .figure_style import STYLES, Report, plain_ticks, save_figure, style
from .names import figure_label, title
from .results import Comparison
from .theory import road_at
from .units import in_si, place, root, shown, unit

with needs("report"):
    from matplotlib.figure import Figure

FRONT = (0.1, 0.3, 1.0, 3.0, 10.0)  # factors of the first weight along the front of the optimal feedbacks


def trade_off(task: Task) -> list[str]:
    """The two mean squares of `draw_pareto`: the first two that are weighed; of a car in SI at least comfort and grip."""
    weighed = list(task.reward_by_name)
    beside = ["wheel_load"] if in_si(task) and len(weighed) == 1 and "wheel_load" in shown(task) else []
    return [*weighed[:2], *(name for name in beside if name not in weighed)]


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
        found.append([driven.mean_squares[driven.names.index(name), 0] for name in names])
    if report:
        report("optimal feedbacks of other weights", len(FRONT), len(FRONT))
    return np.array(found)


def draw_pareto(comparison: Comparison, path: Path, report: Report | None) -> str:
    """The first two weighted mean squares against each other at one operating point; returns the caption.

    A line of constant dampings by theory, the controllers as driven, and the front of the optimal feedbacks for other weights,
    where the comparison drove the optimal feedback.
    """
    task = comparison.task
    names = trade_off(task)
    speeds = sorted({point.speed for point in comparison.points})
    point = next(point for point in comparison.points if point.speed == speeds[(len(speeds) - 1) // 2])
    figure = Figure(figsize=(9.0, 5.4), layout="constrained")
    axis = figure.subplots()

    def told(name: str, values: Any) -> Any:
        return np.vectorize(lambda value: root(task, name, value))(values) if in_si(task) else values

    if not needs_simulation(task.road, task.speed_noise, task.car):
        dampings = np.geomspace(*task.damping_range, 120)
        squares = analysis.mean_squares(
            road_at(task, point.bandwidth),
            task.speed_noise,
            damping=dampings,
            speed=point.speed,
            car=task.car,
        )
        x, y = (told(name, np.asarray(squares[name]) / task.cost_unit) for name in names)
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
    if "optimal_feedback" in comparison.controllers and len(task.reward_by_name) > 1:
        front = optimal_front(comparison, names, point, report)
        look = {**STYLES["optimal_feedback"], "markersize": 5}
        xs, ys = (told(name, values).tolist() for name, values in zip(names, front.T, strict=True))
        axis.plot(xs, ys, linestyle=":", label="optimal feedback, other weights", **look)
    for name in comparison.controllers:
        if name in ("d_min", "d_max"):
            continue  # the ends of the line
        row = comparison.row(name, point)
        at = [float(told(signal, row.squares[signal])) for signal in names]
        look = {"markersize": 8, **style(comparison, name)}
        axis.plot(*at, linestyle="none", label=figure_label(title(name)), **look)
        xs.append(at[0])
        ys.append(at[1])
    # the line runs far off, where nobody drives
    for set_limits, values in ((axis.set_xlim, xs), (axis.set_ylim, ys)):
        set_limits(*((min(values) / 1.1, max(values) * 1.1) if in_si(task) else (min(values) / 1.3, max(values) * 1.6)))
    labels = [name.replace("_", " ") for name in names]
    if in_si(task):
        labels = [f"{label}, {unit(task, name)[0]}, root mean square" for label, name in zip(labels, names, strict=True)]
    else:
        labels = [f"mean square of {label} over $E\\,Z^2$" for label in labels]
    axis.set_xlabel(labels[0])
    axis.set_ylabel(labels[1])
    axis.grid(visible=True, which="both", linewidth=0.3)
    if not in_si(task):
        axis.set_xscale("log")
        axis.set_yscale("log")
        for side in (axis.xaxis, axis.yaxis):
            plain_ticks(side)
    figure.legend(loc="outside right upper", fontsize=8)
    save_figure(figure, path)
    one, other = (name.replace("_", " ") for name in names)
    return f"{one} against {other} at {place(task, point)}: lower and further left is better in both."
