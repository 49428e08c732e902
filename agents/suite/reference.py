"""What scores of the suite are held against: at each operating point the best constant damping, the best known feedback, and a
lower bound of every controller.

They stand in ``references.json``, which ``roadgym suite references`` makes; they change with a release at most.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from analysis import LowerBound
from analysis.bounds import METHODS
from analysis.response import needs_simulation
from roadgym.parameters import ParameterError
from roadgym.suite import SuiteTask
from roadgym.task import Task, make_task

from ..certified import lower_bounds
from ..evaluation import OperatingPoint, make_points, standard_error
from ..records import make_output, write_atomically
from ..theory import optimum, theoretical_cost
from .drivers import ZERO, Origin, drive_on, driver_of, zero_of

FILE = Path(__file__).parent / "references.json"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reference:
    """What is known of one operating point.

    Attributes:
        point: the operating point.
        damping: the constant damping of the score's zero, 1.
        constant, constant_error: its cost, and the standard error of that; 0 where theory knows it.
        best, best_error: the cost of the best known controller, likewise.
        room, room_error: the share of the constant damping's cost that it saves, and the standard error of that.
        bound: what every controller costs at least, less two standard errors where it has one; None where nothing is known.
    """

    point: OperatingPoint
    damping: float
    constant: float
    constant_error: float
    best: float
    best_error: float
    room: float
    room_error: float
    bound: float | None


@dataclasses.dataclass(frozen=True, kw_only=True)
class References:
    """Those of a task.

    Attributes:
        points: of each operating point.
        best: what the best known controller is called.
        origin: where it comes from.
        bound: how the lower bounds are found, or why there are none.
        episodes, seed: with which was driven.
    """

    points: tuple[Reference, ...]
    best: str
    origin: Origin
    bound: str
    episodes: int
    seed: int

    @property
    def bound_score(self) -> float | None:
        """The score of a controller that would cost as little as the lower bounds, in per cent; None where one is missing."""
        shares = [(each.constant - each.bound) / (each.constant - each.best) for each in self.points if each.bound is not None]
        return 100 * float(np.mean(shares)) if len(shares) == len(self.points) else None


@functools.cache
def _kept() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(FILE.read_text(encoding="utf-8"))
    return found


def references(task: SuiteTask) -> References:
    """The references of a task.

    Raises:
        ParameterError: there are none yet.
    """
    if task.name not in _kept():
        raise ParameterError(f"there are no references of {task.name}: roadgym suite references makes them")
    return from_json(_kept()[task.name])


def from_json(content: Mapping[str, Any]) -> References:
    """References from what `to_json` made."""
    points = [
        Reference(point=OperatingPoint(each["speed"], each["bandwidth"]), **{k: v for k, v in each.items() if k not in PLACE})
        for each in content["points"]
    ]
    return References(**{**content, "points": tuple(points)})


PLACE = ("speed", "bandwidth")


def to_json(known: References) -> dict[str, Any]:
    """References in terms of JSON."""
    points = [
        {**dataclasses.asdict(each.point), **{k: v for k, v in dataclasses.asdict(each).items() if k != "point"}}
        for each in known.points
    ]
    return {**dataclasses.asdict(known), "points": points}


def constant_dampings(task: SuiteTask, plant: Task, points: Sequence[OperatingPoint]) -> list[float]:
    """The constant damping of the score's zero at each operating point, by theory."""
    best = [optimum(plant, point.speed, point.bandwidth) for point in points]
    if not task.single_constant:
        return [float(each.damping) for each in best]

    def mean_cost(damping: float) -> float:
        """Over that of the best constant damping, on average over the points."""
        costs = [theoretical_cost(plant, damping, point.speed, point.bandwidth) for point in points]
        return float(np.mean([cost / each.cost for cost, each in zip(costs, best, strict=True)]))

    found = minimize_scalar(mean_cost, bounds=plant.damping_range, method="bounded", options={"xatol": 1e-6})
    return [float(found.x)] * len(points)


def make_references(
    task: SuiteTask,
    candidates: Mapping[str, Origin],
    *,
    episodes: int = 256,
    seed: int = 0,
    report: Callable[[str, int, int], None],
) -> References:
    """Find the references of a task anew.

    Args:
        task: the task.
        candidates: by name who may be the best known controller; that is who costs least, over the zero, on average over the
            operating points.
        episodes, seed: as of `agents.evaluate`.
        report: called as ``report(what, done, in all)``.
    """
    plant = make_task(**task.parameters)
    points = make_points(plant, task.speeds, task.bandwidths)
    dampings = constant_dampings(task, plant, points)
    drivers = {name: driver_of(task, origin) for name, origin in candidates.items()}
    zero = {ZERO: zero_of(task, dampings[0])}
    driven = drive_on(task, drivers | zero, episodes=episodes, seed=seed, report=report)
    best = min(drivers, key=lambda name: float(np.mean(driven[name].mean / driven[ZERO].mean)))
    exact = plant.vary is None and not needs_simulation(plant.road, plant.speed_noise, plant.car)
    bounds = lower_bounds(plant, points, "fast", report)
    found = []
    for k, point in enumerate(points):
        cost, error = float(driven[best].mean[k]), float(driven[best].standard_error[k])
        constant, constant_error = float(driven[ZERO].mean[k]), float(driven[ZERO].standard_error[k])
        # where theory does not know the constant damping's cost, both over the same roads know their ratio better
        over = driven[best].adjusted_costs[k] - cost / constant * driven[ZERO].adjusted_costs[k]
        room_error = float(standard_error(over)) / constant
        if exact:
            constant, constant_error = theoretical_cost(plant, dampings[k], point.speed, point.bandwidth), 0.0
            room_error = error / constant
        found.append(
            Reference(
                point=point,
                damping=dampings[k],
                constant=constant,
                constant_error=constant_error,
                best=cost,
                best_error=error,
                room=1 - cost / constant,
                room_error=room_error,
                bound=bound.safe if isinstance(bound := bounds[k], LowerBound) else None,
            )
        )
    how = dict.fromkeys(METHODS[each.method].title if isinstance(each, LowerBound) else each for each in bounds)
    return References(
        points=tuple(found), best=best, origin=candidates[best], bound=" and ".join(how), episodes=episodes, seed=seed
    )


def write_references(found: Mapping[str, References], file: str | Path) -> None:
    """Put references of tasks by name into a file, beside those of other tasks that it holds."""
    path = make_output(file)
    known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    known |= {name: to_json(each) for name, each in found.items()}
    write_atomically(path, json.dumps(dict(sorted(known.items())), indent=1) + "\n")
