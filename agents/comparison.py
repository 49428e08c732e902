"""The main job: agents against the analytic optimum, classical controllers and the optimal feedback, over the same noise."""

from __future__ import annotations

import csv
import dataclasses
import datetime
import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import t as student

from analysis.response import needs_simulation
from roadgym.car import MEAN_SQUARES
from roadgym.parameters import ParameterError
from roadgym.task import Task, make_task

from .controllers import CONTROLLERS, Controller, OptimalFeedback, make_controller, optimum, theoretical_cost
from .evaluation import Evaluation, OperatingPoint, Predictor, evaluate
from .features import has_lookahead
from .names import csv_cell, name_folders
from .records import make_folder, plain, versions, write_atomically
from .training import Agent

RIVALS = ("analytic_optimum", "d_min", "d_max", "skyhook", "one_step_lookahead", "optimal_feedback")
CONSTANT = ("analytic_optimum", "d_min", "d_max")
SPEEDS = (0.7, 1.0, 1.5, 2.0, 3.0)
BANDWIDTHS = (0.1, 0.3)
AGENT = "agent"
CONFIDENCE = 0.95
LEAST_ROOM = 0.02  # of the cost of the best constant damping: a feedback that gains less leaves no gap to close


@dataclasses.dataclass(frozen=True)
class Share:
    """A ratio of costs with its confidence interval, at the level `CONFIDENCE`."""

    value: float
    low: float
    high: float


@dataclasses.dataclass(frozen=True)
class Row:
    """One controller at one operating point.

    Attributes:
        controller: its name.
        point: the operating point.
        cost, standard_error: mean cost over episodes and training seeds, and its standard error; cost is minus the mean reward,
            adjusted by control variates where theory is exact (`agents.evaluation`).
        driven_cost, driven_standard_error: the same as driven, without control variates.
        theory: what theory predicts, for constant dampings, where there is a closed form; else None.
        damping: the constant damping ratio, likewise.
        gain: share of the cost of the best constant damping that is saved.
        gap_closed: share of the way from the best constant damping to the best known feedback; None where that feedback saves
            less than `LEAST_ROOM`.
        switches: damping switches a second.
        squares: the mean squares over E Z^2 by name.
    """

    controller: str
    point: OperatingPoint
    cost: float
    standard_error: float
    driven_cost: float
    driven_standard_error: float
    theory: float | None
    damping: float | None
    gain: Share
    gap_closed: Share | None
    switches: float
    squares: dict[str, float]


@dataclasses.dataclass(frozen=True)
class MeanGap:
    """The share of the gap that a controller closes, averaged over all operating points that have a gap, and what is left out.

    Attributes:
        closed: mean share, of negative ones too; None where no point has a gap.
        points: those that it is over.
        left_out: the points without a gap, where the best known feedback saves less than `LEAST_ROOM`.
        loss: at those, the mean share of the best constant damping's cost that the controller costs more; None without any.
        largest_loss, largest_at: the largest one and its point, likewise.
    """

    closed: Share | None
    points: tuple[OperatingPoint, ...]
    left_out: tuple[OperatingPoint, ...]
    loss: Share | None
    largest_loss: Share | None
    largest_at: OperatingPoint | None


@dataclasses.dataclass(frozen=True)
class Comparison:
    """All rows, and what made them.

    Attributes:
        rows: one for each controller and operating point.
        task: the task, observed in full.
        agents: the learned controllers, by name; one agent for each training seed.
        references: the best known feedback at each operating point, by name; None where no feedback was driven.
        configuration: environment, evaluation, agents and versions, as JSON knows them.
        mean_gaps: of each learned controller, where a feedback was driven.
    """

    rows: tuple[Row, ...]
    task: Task
    agents: Mapping[str, Sequence[Predictor]]
    references: tuple[str | None, ...]
    configuration: dict[str, Any]
    mean_gaps: Mapping[str, MeanGap] = dataclasses.field(default_factory=dict)

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
        """Everything as JSON; what is infinite is null."""
        content = {
            "rows": [flat(row) for row in self.rows],
            "mean_gap_closed": {name: dataclasses.asdict(gap) for name, gap in self.mean_gaps.items()},
            **self.configuration,
        }
        return json.dumps(content, indent=2, allow_nan=False) + "\n"

    def to_csv(self) -> str:
        """The rows as CSV."""
        rows = [flat(row) for row in self.rows]
        text = io.StringIO()
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: csv_cell(value) for name, value in row.items()} for row in rows)
        return text.getvalue()


def flat(row: Row) -> dict[str, Any]:
    """A row as one mapping of numbers and names."""
    content: dict[str, Any] = {"controller": row.controller, **dataclasses.asdict(row.point)}
    for name in ("cost", "standard_error", "driven_cost", "driven_standard_error", "theory", "damping"):
        content[name] = getattr(row, name)
    for name in ("gain", "gap_closed"):
        share = getattr(row, name)
        for part, label in (("value", name), ("low", f"{name}_low"), ("high", f"{name}_high")):
            content[label] = None if share is None else getattr(share, part)
    content["switches"] = row.switches
    content.update({name: value if math.isfinite(value) else None for name, value in row.squares.items()})
    return content


def constant_damping(task: Task, controller: str, point: OperatingPoint) -> float | None:
    """The damping ratio that a controller keeps at a point, if theory knows it."""
    if controller == "d_min":
        return task.damping_range[0]
    if controller == "d_max":
        return task.damping_range[1]
    if controller == "analytic_optimum":
        return float(optimum(task, point.speed, point.bandwidth).damping)
    return None


def ratio(
    numerators: npt.NDArray[np.float64], denominators: npt.NDArray[np.float64], degrees_of_freedom: int | None = None
) -> Share:
    """Mean over operating points of ratios of means, with its interval; all training seeds drive over the same noise.

    The interval adds two parts in squares, by Student's law each: episodes, whose ratios are linearised, and the means of the
    training seeds. Points have roads of their own, so their errors are independent; a training seed is one agent at all points,
    so its shares are averaged before seeds are compared. The seeds meet the same episodes, whose noise the second part holds
    too in part: the interval is rather too wide. With one seed there is the first part alone: it speaks of that agent, not of
    the training.

    Args:
        numerators: shape (points, seeds, episodes).
        denominators: shape (points, episodes).
        degrees_of_freedom: of a mean over episodes, at one point; the episodes less one by default.
    """
    points, seeds, episodes = numerators.shape
    scale = denominators.mean(axis=-1)
    values = numerators.mean(axis=(1, 2)) / scale
    residuals = (numerators.mean(axis=1) - values[:, None] * denominators) / scale[:, None]
    freedom = episodes - 1 if degrees_of_freedom is None else degrees_of_freedom
    error = math.sqrt((residuals.var(axis=-1, ddof=1) / episodes).sum()) / points
    half = student.ppf((1 + CONFIDENCE) / 2, freedom) * error
    if seeds > 1:
        spread = (numerators.mean(axis=-1) / scale[:, None]).mean(axis=0).std(ddof=1)
        half = math.hypot(half, student.ppf((1 + CONFIDENCE) / 2, seeds - 1) * spread / math.sqrt(seeds))
    value = float(values.mean())
    return Share(value, value - half, value + half)


def best_feedbacks(evaluations: Mapping[str, Evaluation]) -> tuple[str | None, ...]:
    """The best known feedback at each operating point: the optimal one where it was driven, else the best classical one."""
    names = [name for name in evaluations if name not in CONSTANT]
    points = range(len(evaluations["analytic_optimum"].points))
    if "optimal_feedback" in names:
        return tuple("optimal_feedback" for _ in points)
    return tuple(min(names, key=lambda name: evaluations[name].mean[k], default=None) for k in points)


def gaps(evaluations: Mapping[str, Evaluation], references: Sequence[str | None]) -> list[npt.NDArray[np.float64] | None]:
    """What the best known feedback saves at each operating point, shape (episodes,); None if less than `LEAST_ROOM`."""
    best = evaluations["analytic_optimum"].adjusted_costs
    rooms: list[npt.NDArray[np.float64] | None] = []
    for k, reference in enumerate(references):
        room = None if reference is None else best[k] - evaluations[reference].adjusted_costs[k]
        rooms.append(room if room is not None and room.mean() > LEAST_ROOM * best[k].mean() else None)
    return rooms


def mean_gap(seeds: Sequence[Evaluation], evaluations: Mapping[str, Evaluation], references: Sequence[str | None]) -> MeanGap:
    """The mean share of the gap that a learned controller closes, from evaluations of its training seeds and of the rivals."""
    best, points, freedom = evaluations["analytic_optimum"].adjusted_costs, seeds[0].points, seeds[0].degrees_of_freedom
    rooms = gaps(evaluations, references)
    within = [k for k, room in enumerate(rooms) if room is not None]
    without = [k for k, room in enumerate(rooms) if room is None]
    saved = best[:, None] - np.stack([evaluation.adjusted_costs for evaluation in seeds], axis=1)
    losses = [ratio(-saved[[k]], best[[k]], freedom) for k in without]
    worst = max(range(len(losses)), key=lambda k: losses[k].value, default=None)
    return MeanGap(
        closed=ratio(saved[within], np.array([rooms[k] for k in within]), freedom) if within else None,
        points=tuple(points[k] for k in within),
        left_out=tuple(points[k] for k in without),
        loss=ratio(-saved[without], best[without], freedom) if without else None,
        largest_loss=None if worst is None else losses[worst],
        largest_at=None if worst is None else points[without[worst]],
    )


def error_over_seeds(costs: npt.NDArray[np.float64]) -> float:
    """Standard error of the mean of costs, shape (seeds, episodes), over both."""
    variance = costs.mean(axis=0).var(ddof=1) / costs.shape[1]
    if len(costs) > 1:
        variance += costs.mean(axis=1).var(ddof=1) / len(costs)
    return math.sqrt(variance)


def make_rows(
    task: Task, learned: Mapping[str, Sequence[Evaluation]], evaluations: Mapping[str, Evaluation]
) -> tuple[tuple[Row, ...], tuple[str | None, ...]]:
    """Rows with theory, gains and gaps, and the best known feedbacks, from what was driven.

    Args:
        task: the task.
        learned: evaluations of each learned controller, one for each training seed.
        evaluations: those of the rivals, the analytic optimum among them.
    """
    rows = []
    closed = not needs_simulation(task.road, task.speed_noise)  # a theory that is itself simulated proves nothing
    best = evaluations["analytic_optimum"].adjusted_costs
    references = best_feedbacks(evaluations)
    rooms = gaps(evaluations, references)
    for name, seeds in {**learned, **{name: [evaluation] for name, evaluation in evaluations.items()}}.items():
        for k, point in enumerate(seeds[0].points):
            freedom = seeds[0].degrees_of_freedom
            costs = np.stack([evaluation.adjusted_costs[k] for evaluation in seeds])
            driven_costs = np.stack([evaluation.costs[k] for evaluation in seeds])
            damping = constant_damping(task, name, point)
            squares = np.mean([evaluation.mean_squares[:, k] for evaluation in seeds], axis=0)
            saved, room = (best[k] - costs)[None], rooms[k]
            rows.append(
                Row(
                    controller=name,
                    point=point,
                    cost=float(costs.mean()),
                    standard_error=error_over_seeds(costs),
                    driven_cost=float(driven_costs.mean()),
                    driven_standard_error=error_over_seeds(driven_costs),
                    theory=theoretical_cost(task, damping, point.speed, point.bandwidth)
                    if damping is not None and closed
                    else None,
                    damping=damping,
                    gain=ratio(saved, best[k][None], freedom),
                    gap_closed=None if room is None else ratio(saved, room[None], freedom),
                    switches=float(np.mean([evaluation.switches[k] for evaluation in seeds])),
                    squares=dict(zip(MEAN_SQUARES, squares.tolist(), strict=True)),
                )
            )
    return tuple(rows), references


def observed_in_full(environment: Mapping[str, Any]) -> dict[str, Any]:
    """The environment with all that it observes by default."""
    return {name: value for name, value in environment.items() if name not in ("observation", "observe_operating_point")}


def group_agents(agents: Mapping[str, Agent]) -> tuple[dict[str, list[Agent]], dict[str, Any]]:
    """(agents of several training seeds by name, their common environment observed in full), from agents by folder.

    Those that differ in nothing but the seed are one learned controller, named by the first one's folder and as many of the
    folders above it as tell the names apart, or "agent" where there is one only.

    Raises:
        ParameterError: their environments differ in more than what is observed.
    """
    groups: list[list[str]] = []
    kinds: list[Any] = []
    for folder, agent in agents.items():
        kind = [agent.description[key] for key in ("algorithm", "environment", "hyperparameters")]
        if kind not in kinds:
            kinds.append(kind)
            groups.append([])
        groups[kinds.index(kind)].append(folder)
    plants = [observed_in_full(kind[1]) for kind in kinds]
    for plant, group in zip(plants, groups, strict=True):
        if plant != plants[0]:
            raise ParameterError(f"agents must have one environment, but for what they observe; {group[0]!r} has another one")
    if len(groups) == 1:
        return {AGENT: list(agents.values())}, plants[0]
    names = name_folders([group[0] for group in groups], {*CONTROLLERS, *TITLES, *TITLES.values()})
    return {name: [agents[folder] for folder in group] for name, group in zip(names, groups, strict=True)}, plants[0]


def make_rivals(task: Task, names: Sequence[str] | None) -> dict[str, Controller]:
    """The rivals by name, the analytic optimum first; by default those of `RIVALS` that this task allows.

    Raises:
        ParameterError: an unknown controller, or one that needs what the task has not.
    """
    rivals = {"analytic_optimum": make_controller("analytic_optimum", task)}
    for name in RIVALS if names is None else names:
        try:
            rivals[name] = make_controller(name, task)
        except ParameterError:
            if names is not None:
                raise
    return rivals


def compare(
    agents: Predictor | Mapping[str, Sequence[Predictor]] | None,
    *,
    environment: Mapping[str, Any],
    speeds: Sequence[float] = SPEEDS,
    bandwidths: Sequence[float] = BANDWIDTHS,
    controllers: Sequence[str] | None = None,
    episodes: int = 256,
    seed: int = 0,
    report: Callable[[str, int, int], None] | None = None,
) -> Comparison:
    """Drive learned agents, classical controllers and the optimal feedback over the same roads.

    Args:
        agents: one agent, anything with ``predict`` that answers with D; or by name the agents of several training seeds;
            None to compare the classical controllers alone.
        environment: parameters of the environment, with ranges that hold the operating points. Every controller is handed the
            signals that it needs, whatever the environment observes.
        speeds, bandwidths: the grid of operating points, m/s and 1.
        controllers: names of the rivals; the analytic optimum is always among them. By default those of `RIVALS` that the plant
            allows.
        episodes, seed, report: as for `agents.evaluate`.

    Raises:
        ParameterError: a parameter out of range, or a signal missing that a controller needs.
    """
    named = {} if agents is None else agents if isinstance(agents, Mapping) else {AGENT: [agents]}
    plant = observed_in_full(environment)
    task = make_task(**plant)
    rivals = make_rivals(task, controllers)
    for rival in rivals.values():
        if isinstance(rival, OptimalFeedback):
            rival.report = report
    drivers: dict[str, Predictor] = {}
    for name, seeds in named.items():
        if name in rivals or not seeds:
            raise ParameterError(f"agents must have names of their own and at least one agent each, got {name!r}")
        drivers.update({f"{name}, seed {k + 1} of {len(seeds)}": agent for k, agent in enumerate(seeds)})
    evaluations = evaluate(
        {**drivers, **rivals},
        environment=plant,
        speeds=speeds,
        bandwidths=bandwidths,
        episodes=episodes,
        seed=seed,
        report=report,
    )
    driven = iter([evaluations.pop(name) for name in drivers])
    learned = {name: [next(driven) for _ in seeds] for name, seeds in named.items()}
    rows, references = make_rows(task, learned, evaluations)
    mean_gaps = {name: mean_gap(seeds, evaluations, references) for name, seeds in learned.items()} if any(references) else {}
    configuration = {
        "environment": plain(plant),
        "episodes": episodes,
        "seed": seed,
        "confidence": CONFIDENCE,
        "control_variates": evaluations["analytic_optimum"].control_variates,
        "best_known_feedback": references,
        "agents": {name: [plain(getattr(agent, "description", None)) for agent in seeds] for name, seeds in named.items()},
        "versions": versions(),
        "written": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
    return Comparison(rows, task, named, references, configuration, mean_gaps)


TITLES = {
    "agent": "agent",
    "analytic_optimum": "best constant D",
    "d_min": "D_min",
    "d_max": "D_max",
    "skyhook": "skyhook",
    "skyhook_continuous": "cont. skyhook",
    "add": "ADD",
    "mixed_skyhook_add": "mixed SH-ADD",
    "least_acceleration": "least acc.",
    "clipped_lqr": "clipped LQR",
    "one_step_lookahead": "lookahead",
    "optimal_feedback": "optimal",
}


def percent(share: Share | None) -> str:
    """A share in per cent with half its confidence interval, or n/a."""
    # adding 0 makes 0.0 of -0.0
    return "n/a" if share is None else f"{round(100 * share.value, 1) + 0:.1f} ±{50 * (share.high - share.low):.1f}%"


def above(share: Share) -> str:
    """By how much a cost is above, or below, in per cent with half its confidence interval."""
    if share.value >= 0:
        return f"{percent(share)} above"
    return f"{percent(Share(-share.value, -share.high, -share.low))} below"


def weighted(task: Task) -> str:
    """The cost in words."""
    return " + ".join((f"{weight:g} " if weight != 1 else "") + name for name, weight in task.weights_by_name.items())


def notes(comparison: Comparison) -> list[str]:
    """What the columns mean, a sentence each."""
    low, high = comparison.task.damping_range
    lines = [
        f"cost: mean square of {weighted(comparison.task)} over E Z^2, with the standard error of the last digits in brackets; "
        f"D within [{low:g}, {high:g}].",
        f"gain: share of the cost of the best constant D that is saved. Intervals are of {100 * CONFIDENCE:g} % confidence.",
    ]
    variates = comparison.configuration.get("control_variates")
    if variates:
        lines.append(adjusted_by(variates))
        away = [(row.driven_cost - row.theory) / row.driven_standard_error for row in comparison.rows if row.theory is not None]
        lines.append(
            f"As driven, without that adjustment, the {len(away)} costs of constant D in this table are within "
            f"{max(map(abs, away)):.1f} standard errors of theory."
        )
    if any(name is not None for name in comparison.references):
        kinds = " or ".join(dict.fromkeys(TITLES.get(name, name) for name in comparison.references if name is not None))
        lines.append(
            f"gap closed: share of the way from the best constant D to the best known feedback ({kinds}); over 100 % where "
            f"that is beaten, n/a where it saves less than {100 * LEAST_ROOM:g} %. The mean counts all other "
            "points alike, with negative shares too."
        )
    for name, seeds in comparison.agents.items():
        given = theory_given(seeds[0])
        if given is not None:
            lines.append(f"{name} {given}")
        lines.append(
            f"{name}: mean of {len(seeds)} training seeds."
            if len(seeds) > 1
            else f"{name}: one training seed; the intervals do not hold what another seed would change."
        )
    return lines


def columns(comparison: Comparison) -> list[tuple[str, str, list[str]]]:
    """The table as columns: title of the controller, of the column, and a cell for each operating point."""
    task, points = comparison.task, comparison.points
    found = [("nu", "", [f"{task.frequency_ratio(point.speed):g}" for point in points])]
    if task.bandwidth[1] > 0:
        found.append(("delta", "", [f"{point.bandwidth:g}" for point in points]))
    for name in comparison.controllers:
        rows = [comparison.row(name, point) for point in points]
        found.append((TITLES.get(name, name), "cost", [with_error(row.cost, row.standard_error) for row in rows]))
        if name == "analytic_optimum":
            if rows[0].theory is not None:
                found.append(("", "theory", [f"{row.theory:.4f}" for row in rows]))
            found.append(("", "D", [f"{row.damping:.3f}" for row in rows]))
        if name in comparison.agents:
            if any(comparison.references):
                found.append(("", "gap closed", [percent(row.gap_closed) for row in rows]))
            else:
                found.append(("", "gain", [percent(row.gain) for row in rows]))
    return found


def theory_given(agent: Predictor) -> str | None:
    """What a trained agent was given of theory, in words; None of what was not trained here."""
    if not isinstance(agent, Agent):
        return None
    reward = {
        "advantage": "theory's advantage over the best constant damping, made from the full state whatever it observes",
        "cost": "the cost",
    }.get(agent.description.get("training_reward", ""))
    if reward is None:  # of an agent that was trained before this was noted
        return None
    lookahead = has_lookahead(agent.task, agent.description["hyperparameters"].get("features", ()))
    return f"learned from {reward}, {'with' if lookahead else 'without'} theory's one-step lookahead among its features."


def adjusted_by(control_variates: Sequence[float]) -> str:
    """What the control variates are, in a sentence."""
    dampings = ", ".join(f"{damping:.2g}" for damping in control_variates)
    if len(control_variates) == 1:
        return f"A constant damping on the same roads, whose cost theory knows, serves as control variate: D = {dampings}."
    return f"Constant dampings on the same roads, whose costs theory knows, serve as control variates: D = {dampings}."


def mean_gap_closed(comparison: Comparison, name: str) -> str:
    """The mean share of the gap that a learned controller closes, what it is over, and what is left out, in words."""
    gap = comparison.mean_gaps[name]
    total, left = len(gap.points) + len(gap.left_out), len(gap.left_out)
    text = f"{name}: no operating point has a gap to close."
    if gap.closed is not None:
        over = (
            f"all {total} operating points" if not left else f"the {len(gap.points)} of {total} operating points that have one"
        )
        text = f"{name} closes {percent(gap.closed)} of the gap on average over {over}."
    if gap.loss is not None and gap.largest_loss is not None and gap.largest_at is not None:
        place = f"nu = {comparison.task.frequency_ratio(gap.largest_at.speed):g}"
        place += f", delta = {gap.largest_at.bandwidth:g}" if gap.largest_at.bandwidth else ""
        text += (
            f" Where there is none ({left} of {total} points), its cost is {above(gap.loss)} that of the best constant D on "
            f"average, {above(gap.largest_loss)} at worst ({place})."
        )
    return text


def table(comparison: Comparison) -> str:
    """The comparison as text: one line an operating point, costs with the standard error of their last digits in brackets."""
    found = columns(comparison)
    head, under = [title for title, _, _ in found], [label for _, label, _ in found]
    lines = [head, under, *(list(cells) for cells in zip(*(cells for _, _, cells in found), strict=True))]
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
            text.append("-" * max(map(len, text)))
    text.append("")
    text += [mean_gap_closed(comparison, name) for name in comparison.mean_gaps]
    return "\n".join([*text, *notes(comparison)])


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


def write(comparison: Comparison, folder: str | Path, report: Callable[[str, int, int], None] | None = None) -> list[Path]:
    """Write the report, comparison.html with everything in it, and beside it JSON, CSV, the table and the figures.

    Args:
        comparison: what was driven.
        folder: where to; it is made if need be.
        report: called as ``report(what, done, in all)`` while the figures are drawn.

    Returns:
        The files, the report first.
    """
    from .figures import draw_figures
    from .report import make_report

    path = make_folder(folder)
    figures = draw_figures(comparison, path, report)
    contents = {
        "comparison.html": make_report(comparison, figures),
        "comparison.json": comparison.to_json(),
        "comparison.csv": comparison.to_csv(),
        "comparison.txt": table(comparison) + "\n",
    }
    for name, content in contents.items():
        write_atomically(path / name, content)
    return [*(path / name for name in contents), *(figure.path for figure in figures)]
