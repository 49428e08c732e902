"""What a comparison found: rows with gains and gaps, and their confidence intervals."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import t as student

from analysis import LowerBound
from analysis.response import needs_simulation
from roadgym.task import Task

from .evaluation import Evaluation, OperatingPoint, Predictor
from .names import csv_cell
from .theory import optimum, theoretical_cost

CONSTANT = ("analytic_optimum", "d_min", "d_max")
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
        worst_seed: the same of the training seed that closes least there; None of one seed alone.
        bound: what every controller costs at least there; None where no lower bound is known, or none was asked for.
        certified: share of the way from the best constant damping to the lower bound; None where there is none, or where it
            leaves less than `LEAST_ROOM`.
        switches: damping switches a second.
        squares: the mean squares by name, over the task's `cost_unit`: over E Z^2, or in SI units.
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
    worst_seed: Share | None
    bound: LowerBound | None
    certified: Share | None
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
        worst_seed: mean share that the training seed closes that closes least; None of one seed alone, and where `closed` is.
        least, least_at: the smallest share that any training seed closes at any point, and that point.
    """

    closed: Share | None
    points: tuple[OperatingPoint, ...]
    left_out: tuple[OperatingPoint, ...]
    loss: Share | None
    largest_loss: Share | None
    largest_at: OperatingPoint | None
    worst_seed: Share | None
    least: Share | None
    least_at: OperatingPoint | None


@dataclasses.dataclass(frozen=True)
class MeanCertified:
    """The certified share of a controller, averaged over all operating points that have one.

    Attributes:
        share: the mean; None where no point has one.
        points: those that it is over.
        left_out: the points without a lower bound, or where that leaves less than `LEAST_ROOM`.
    """

    share: Share | None
    points: tuple[OperatingPoint, ...]
    left_out: tuple[OperatingPoint, ...]


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
        bounds: the lower bound at each operating point, or in a few words why there is none; empty where none was asked for.
        mean_certified: of each learned controller and of the optimal feedback, where there are bounds.
    """

    rows: tuple[Row, ...]
    task: Task
    agents: Mapping[str, Sequence[Predictor]]
    references: tuple[str | None, ...]
    configuration: dict[str, Any]
    mean_gaps: Mapping[str, MeanGap] = dataclasses.field(default_factory=dict)
    bounds: tuple[LowerBound | str, ...] = ()
    mean_certified: Mapping[str, MeanCertified] = dataclasses.field(default_factory=dict)

    def row(self, controller: str, point: OperatingPoint) -> Row:
        """The row of a controller at a point."""
        return next(row for row in self.rows if row.controller == controller and row.point == point)

    @property
    def controllers(self) -> tuple[str, ...]:
        """Names of the controllers, in order."""
        return tuple(dict.fromkeys(row.controller for row in self.rows))

    @property
    def bounded(self) -> bool:
        """Is there a lower bound at any operating point?"""
        return any(isinstance(bound, LowerBound) for bound in self.bounds)

    @property
    def points(self) -> tuple[OperatingPoint, ...]:
        """The operating points, in order."""
        return tuple(dict.fromkeys(row.point for row in self.rows))

    def to_json(self) -> str:
        """Everything as JSON; what is infinite is null."""
        content = {
            "rows": [flat(row) for row in self.rows],
            "mean_gap_closed": {name: dataclasses.asdict(gap) for name, gap in self.mean_gaps.items()},
            "lower_bounds": [
                dataclasses.asdict(point) | ({"reason": bound} if isinstance(bound, str) else dataclasses.asdict(bound))
                for point, bound in zip(self.points, self.bounds, strict=bool(self.bounds))
            ],
            "mean_certified": {name: dataclasses.asdict(mean) for name, mean in self.mean_certified.items()},
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


@dataclasses.dataclass(frozen=True)
class Picture:
    """A picture that was written: its file, what it shows, and the file of the same for a narrow screen, if it needs one."""

    path: Path
    caption: str
    narrow: Path | None = None


def flat(row: Row) -> dict[str, Any]:
    """A row as one mapping of numbers and names."""
    content: dict[str, Any] = {"controller": row.controller, **dataclasses.asdict(row.point)}
    for name in ("cost", "standard_error", "driven_cost", "driven_standard_error", "theory", "damping"):
        content[name] = getattr(row, name)
    content["lower_bound"] = None if row.bound is None else row.bound.cost
    content["lower_bound_standard_error"] = None if row.bound is None else row.bound.standard_error
    for name in ("gain", "gap_closed", "worst_seed", "certified"):
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
        best = float(optimum(task, point.speed, point.bandwidth).damping)
        return float(task.valve.settled(best, task.damping_range))
    return None


def ratio(
    numerators: npt.NDArray[np.float64],
    denominators: npt.NDArray[np.float64],
    degrees_of_freedom: int | None = None,
    errors: npt.NDArray[np.float64] | None = None,
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
        errors: standard errors that the denominators have beside those of the episodes, shape (points,).
    """
    points, seeds, episodes = numerators.shape
    scale = denominators.mean(axis=-1)
    values = numerators.mean(axis=(1, 2)) / scale
    residuals = (numerators.mean(axis=1) - values[:, None] * denominators) / scale[:, None]
    freedom = episodes - 1 if degrees_of_freedom is None else degrees_of_freedom
    variances = residuals.var(axis=-1, ddof=1) / episodes
    if errors is not None:
        variances = variances + (values * errors / scale) ** 2
    error = math.sqrt(variances.sum()) / points
    half = student.ppf((1 + CONFIDENCE) / 2, freedom) * error
    if seeds > 1:
        spread = (numerators.mean(axis=-1) / scale[:, None]).mean(axis=0).std(ddof=1)
        half = math.hypot(half, student.ppf((1 + CONFIDENCE) / 2, seeds - 1) * spread / math.sqrt(seeds))
    value = float(values.mean())
    return Share(value, value - half, value + half)


def of_each_seed(
    numerators: npt.NDArray[np.float64], denominators: npt.NDArray[np.float64], degrees_of_freedom: int
) -> list[Share]:
    """`ratio` of each training seed alone."""
    return [ratio(numerators[:, [k]], denominators, degrees_of_freedom) for k in range(numerators.shape[1])]


def worst_of(seeds: Sequence[Share]) -> Share | None:
    """The smallest share of several training seeds; None of one alone."""
    return min(seeds, key=lambda share: share.value) if len(seeds) > 1 else None


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
    room = np.array([rooms[k] for k in within])
    shares = [(share, points[k]) for n, k in enumerate(within) for share in of_each_seed(saved[[k]], room[[n]], freedom)]
    least, least_at = min(shares, key=lambda share: share[0].value, default=(None, None))
    return MeanGap(
        closed=ratio(saved[within], room, freedom) if within else None,
        points=tuple(points[k] for k in within),
        left_out=tuple(points[k] for k in without),
        loss=ratio(-saved[without], best[without], freedom) if without else None,
        largest_loss=None if worst is None else losses[worst],
        largest_at=None if worst is None else points[without[worst]],
        worst_seed=worst_of(of_each_seed(saved[within], room, freedom)) if within else None,
        least=least,
        least_at=least_at,
    )


def room(best: npt.NDArray[np.float64], bound: LowerBound | str) -> npt.NDArray[np.float64] | None:
    """What can be saved at most of the best constant damping's costs, shape (episodes,); None if less than `LEAST_ROOM`."""
    if isinstance(bound, str):
        return None
    left = best - bound.cost
    return left if left.mean() > LEAST_ROOM * best.mean() else None


def mean_certified(
    seeds: Sequence[Evaluation], evaluations: Mapping[str, Evaluation], bounds: Sequence[LowerBound | str]
) -> MeanCertified:
    """(best constant - cost)/(best constant - lower bound) of a controller, averaged over the points that have a bound.

    It is the share that is reached, at least, of what any controller could save.

    Args:
        seeds: evaluations of its training seeds.
        evaluations: those of the rivals, the analytic optimum among them.
        bounds: the lower bound at each operating point, or why there is none.
    """
    best, points = evaluations["analytic_optimum"].adjusted_costs, seeds[0].points
    rooms = {k: (room(best[k], bound), bound) for k, bound in enumerate(bounds)}
    within = [k for k, (left, _) in rooms.items() if left is not None]
    saved = best[:, None] - np.stack([evaluation.adjusted_costs for evaluation in seeds], axis=1)
    share = None
    if within:
        errors = [bound.standard_error for k in within if isinstance(bound := rooms[k][1], LowerBound)]
        lefts = np.array([rooms[k][0] for k in within])
        share = ratio(saved[within], lefts, seeds[0].degrees_of_freedom, np.array(errors))
    return MeanCertified(
        share=share,
        points=tuple(points[k] for k in within),
        left_out=tuple(points[k] for k in rooms if k not in within),
    )


def error_over_seeds(costs: npt.NDArray[np.float64]) -> float:
    """Standard error of the mean of costs, shape (seeds, episodes), over both."""
    variance = costs.mean(axis=0).var(ddof=1) / costs.shape[1]
    if len(costs) > 1:
        variance += costs.mean(axis=1).var(ddof=1) / len(costs)
    return math.sqrt(variance)


def make_rows(
    task: Task,
    learned: Mapping[str, Sequence[Evaluation]],
    evaluations: Mapping[str, Evaluation],
    bounds: Sequence[LowerBound | str] = (),
) -> tuple[tuple[Row, ...], tuple[str | None, ...]]:
    """Rows with theory, gains and gaps, and the best known feedbacks, from what was driven.

    Args:
        task: the task.
        learned: evaluations of each learned controller, one for each training seed.
        evaluations: those of the rivals, the analytic optimum among them.
        bounds: the lower bound at each operating point, or why there is none; empty where none was asked for.
    """
    rows = []
    # a theory that is itself simulated proves nothing, and there is no theory of many cars
    closed = task.vary is None and not needs_simulation(task.road, task.speed_noise, task.car)
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
            saved, gap = (best[k] - costs)[None], rooms[k]
            bound = bounds[k] if bounds else ""
            left = room(best[k], bound)
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
                    gap_closed=None if gap is None else ratio(saved, gap[None], freedom),
                    worst_seed=None if gap is None else worst_of(of_each_seed(saved, gap[None], freedom)),
                    bound=None if isinstance(bound, str) else bound,
                    certified=None
                    if left is None or isinstance(bound, str)
                    else ratio(saved, left[None], freedom, np.array([bound.standard_error])),
                    switches=float(np.mean([evaluation.switches[k] for evaluation in seeds])),
                    squares=dict(zip(seeds[0].names, squares.tolist(), strict=True)),
                )
            )
    return tuple(rows), references
