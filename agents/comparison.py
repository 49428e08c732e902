"""The main job: one agent against the analytic optimum and classical controllers, over the same noise."""

from __future__ import annotations

import dataclasses
import datetime
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from analysis.response import needs_simulation
from roadgym.task import Task, make_task

from .controllers import make_controller, optimum, theoretical_cost
from .evaluation import Evaluation, OperatingPoint, Predictor, evaluate, standard_error
from .figures import draw_cost_over_speed, draw_policy
from .training import make_folder, plain, versions, write_atomically

RIVALS = ("analytic_optimum", "d_min", "d_max", "skyhook")
SPEEDS = (0.7, 1.0, 1.5, 2.0, 3.0)
BANDWIDTHS = (0.1, 0.3)
AGENT = "agent"


@dataclasses.dataclass(frozen=True)
class Row:
    """One controller at one operating point.

    Attributes:
        controller: its name.
        point: the operating point.
        cost, standard_error: mean cost and its standard error; cost is minus the mean reward.
        theory: what theory predicts, for constant dampings, where there is a closed form; else None.
        damping: the constant damping ratio, likewise.
        gain: share of the analytic optimum's cost that is saved, with its standard error from paired noise.
        switches: damping switches a second.
        gap_closed: share of the way from the best constant damping to the optimal feedback, where that was driven and saves
            more than 2 % of the cost; else None.
    """

    controller: str
    point: OperatingPoint
    cost: float
    standard_error: float
    theory: float | None
    damping: float | None
    gain: float
    gain_standard_error: float
    switches: float
    gap_closed: float | None


@dataclasses.dataclass(frozen=True)
class Comparison:
    """All rows, and what made them."""

    rows: tuple[Row, ...]
    task: Task
    configuration: dict[str, Any]

    def row(self, controller: str, point: OperatingPoint) -> Row:
        """The row of a controller at a point."""
        return next(row for row in self.rows if row.controller == controller and row.point == point)

    @property
    def controllers(self) -> tuple[str, ...]:
        """Names of the controllers, in order."""
        return tuple(dict.fromkeys(row.controller for row in self.rows))

    @property
    def points(self) -> tuple[OperatingPoint, ...]:
        """The operating points, in order."""
        return tuple(dict.fromkeys(row.point for row in self.rows))

    def to_json(self) -> str:
        """Everything as JSON."""
        rows = []
        for row in self.rows:
            content = dataclasses.asdict(row)
            content.update(content.pop("point"))
            rows.append(content)
        return json.dumps({"rows": rows, **self.configuration}, indent=2) + "\n"


def constant_damping(task: Task, controller: str, point: OperatingPoint) -> float | None:
    """The damping ratio that a controller keeps at a point, if theory knows it."""
    if controller == "d_min":
        return task.damping_range[0]
    if controller == "d_max":
        return task.damping_range[1]
    if controller == "analytic_optimum":
        return float(optimum(task, point.speed, point.bandwidth).damping)
    return None


def make_rows(task: Task, evaluations: Mapping[str, Evaluation]) -> tuple[Row, ...]:
    """Rows with theory and gains from what was driven."""
    rows = []
    closed = not needs_simulation(task.road, task.speed_noise)  # a theory that is itself simulated proves nothing
    best = evaluations["analytic_optimum"].costs
    for name, evaluation in evaluations.items():
        for k, point in enumerate(evaluation.points):
            mean = float(best[k].mean())
            gain = 1 - float(evaluation.mean[k]) / mean
            # error of the ratio by linearisation, from paired episodes: both drove over the same roads
            spread = standard_error((evaluation.costs[k] - (1 - gain) * best[k])[None])[0] / mean
            damping = constant_damping(task, name, point)
            gap_closed = None
            if "optimal_feedback" in evaluations:
                room = mean - float(evaluations["optimal_feedback"].mean[k])
                gap_closed = (mean - float(evaluation.mean[k])) / room if room > 0.02 * mean else None
            rows.append(
                Row(
                    controller=name,
                    point=point,
                    cost=float(evaluation.mean[k]),
                    standard_error=float(evaluation.standard_error[k]),
                    theory=theoretical_cost(task, damping, point.speed, point.bandwidth)
                    if damping is not None and closed
                    else None,
                    damping=damping,
                    gain=gain,
                    gain_standard_error=float(spread),
                    switches=float(evaluation.switches[k]),
                    gap_closed=gap_closed,
                )
            )
    return tuple(rows)


def compare(
    agent: Predictor | None,
    *,
    environment: Mapping[str, Any],
    speeds: Sequence[float] = SPEEDS,
    bandwidths: Sequence[float] = BANDWIDTHS,
    controllers: Sequence[str] = RIVALS,
    episodes: int = 256,
    seed: int = 0,
    report: Callable[[str, int, int], None] | None = None,
    description: Mapping[str, Any] | None = None,
) -> Comparison:
    """Drive the agent, if there is one, and the classical controllers over the same roads.

    Args:
        agent: anything with ``predict`` that answers with D; None to compare the classical controllers alone.
        environment: parameters of the environment, with ranges that hold the operating points.
        speeds, bandwidths: the grid of operating points, m/s and 1.
        controllers: names of the classical controllers; the analytic optimum is always among them. Of those by default,
            skyhook is left out on a road without a slope.
        episodes, seed, report: as for `agents.evaluate`.
        description: what is known of the agent, for the record.

    Raises:
        ParameterError: a parameter out of range, or a signal missing that a controller needs.
    """
    task = make_task(**environment)
    drivers: dict[str, Predictor] = {} if agent is None else {AGENT: agent}
    names = dict.fromkeys(("analytic_optimum", *controllers))
    if controllers is RIVALS and "slope" not in task.signals:
        del names["skyhook"]
    for name in names:
        drivers[name] = make_controller(name, task)
    evaluations = evaluate(
        drivers,
        environment=environment,
        speeds=speeds,
        bandwidths=bandwidths,
        episodes=episodes,
        seed=seed,
        report=report,
    )
    configuration = {
        "environment": plain(environment),
        "episodes": episodes,
        "seed": seed,
        "agent": None if description is None else plain(description),
        "versions": versions(),
        "written": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
    return Comparison(make_rows(task, evaluations), task, configuration)


TITLES = {
    AGENT: "agent",
    "analytic_optimum": "best constant D",
    "d_min": "D_min",
    "d_max": "D_max",
    "skyhook": "on-off skyhook",
    "optimal_feedback": "optimal feedback",
}


def table(comparison: Comparison) -> str:
    """The comparison as text: one line an operating point, costs with the standard error of their last digits in brackets."""
    task = comparison.task
    low, high = task.damping_range
    names = comparison.controllers
    with_bandwidth = task.bandwidth[1] > 0
    head, under = ["nu"], [""]
    if with_bandwidth:
        head, under = [*head, "delta"], [*under, ""]
    for name in names:
        head, under = [*head, TITLES.get(name, name)], [*under, "cost"]
        if comparison.row(name, comparison.points[0]).theory is not None:
            head, under = [*head, ""], [*under, "theory"]
        if name == "analytic_optimum":
            head, under = [*head, ""], [*under, "D"]
        if name == AGENT:
            head, under = [*head, ""], [*under, "gain"]
            if "optimal_feedback" in names:
                head, under = [*head, ""], [*under, "gap closed"]
    lines = [head, under]
    for point in comparison.points:
        cells = [f"{task.frequency_ratio(point.speed):g}"] + ([f"{point.bandwidth:g}"] if with_bandwidth else [])
        for name in names:
            row = comparison.row(name, point)
            cells.append(with_error(row.cost, row.standard_error))
            if row.theory is not None:
                cells.append(f"{row.theory:.4f}")
            if name == "analytic_optimum":
                cells.append(f"{row.damping:.3f}")
            if name == AGENT:
                cells.append(f"{100 * row.gain:.1f}({max(1, round(1000 * row.gain_standard_error))})%")
                if "optimal_feedback" in names:
                    cells.append("n/a" if row.gap_closed is None else f"{100 * row.gap_closed:.0f}%")
        lines.append(cells)
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    # a title may reach into the columns that belong to it
    for i, title in enumerate(head):
        if title and i + 1 < len(head) and not head[i + 1]:
            widths[i] = max(len(line[i]) for line in lines[1:])
    text = []
    for number, line in enumerate(lines):
        if number == 0:
            text.append(_title_line(head, widths))
        else:
            text.append("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)).rstrip())
        if number == 1:
            text.append("-" * len(text[-1]))
    weights = " + ".join((f"{weight:g} " if weight != 1 else "") + name for name, weight in task.weights_by_name.items())
    text.append("")
    text.append(f"cost: mean square of {weights} over E Z^2, with the standard error of the last digits in brackets;")
    text.append(f"gain: share of the cost of the best constant D that the agent saves; D within [{low:g}, {high:g}].")
    if "optimal_feedback" in names:
        text.append("gap closed: share of the way from the best constant D to the optimal feedback.")
    return "\n".join(text)


def _title_line(head: Sequence[str], widths: Sequence[int]) -> str:
    """Titles, each right-aligned over its own column and the untitled ones after it."""
    cells, i = [], 0
    while i < len(head):
        j = i + 1
        while j < len(head) and not head[j]:
            j += 1
        cells.append(head[i].center(sum(widths[i:j]) + 2 * (j - i - 1)) if j > i + 1 else head[i].rjust(widths[i]))
        i = j
    return "  ".join(cells).rstrip()


def with_error(value: float, error: float) -> str:
    """``value`` with the standard error of its last digits in brackets: 0.2561(12) is 0.2561 ± 0.0012."""
    if not np.isfinite(error) or error <= 0:
        return f"{value:.4f}"
    digits = min(max(1 - int(np.floor(np.log10(error))), 0), 6)
    return f"{value:.{digits}f}({round(error * 10**digits)})"


def write(comparison: Comparison, folder: str | Path, agent: Predictor | None) -> list[Path]:
    """Write comparison.json, the table and the figures into ``folder``; returns the files."""
    path = make_folder(folder)
    write_atomically(path / "comparison.json", comparison.to_json())
    write_atomically(path / "comparison.txt", table(comparison) + "\n")
    files = [path / "comparison.json", path / "comparison.txt", path / "cost_over_speed.png"]
    draw_cost_over_speed(comparison, files[-1])
    if agent is not None and "slope" in comparison.task.signals:
        files.append(path / "policy.png")
        draw_policy(agent, comparison, files[-1])
    return files
