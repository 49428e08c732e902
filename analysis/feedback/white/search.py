"""The search for the feedback on roads of white velocity, and what it finds."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from roadgym.task import Task

from ...checks import FloatArray
from ..driving import CARS, COMPARED_CARS, Respond, drive
from ..grid import SingleArray
from ..iteration import Share, settle, sharing
from ..policy import Feedback, are_positive, read
from ..settings import COMPARED, Settings, Told, is_refined
from .model import COORDINATES, SLOW, Chain, Model, coordinates, white_task
from .table import respond, spread, sweep

GRIDS = (11, 15, 21)  # nodes of each axis, coarse to fine
BOX = 5.0  # half the sides of the grid, in root mean squares of the coordinates
SWEEPS, CHECK = 600, 20  # at most; between two checks


@dataclasses.dataclass(frozen=True, kw_only=True)
class WhiteRefinement:
    """One table and its feedback.

    Attributes:
        nodes: of each of the four axes.
        sweeps: applications of Bellman's operator.
        expected: average cost that the table expects, as `WhiteTable.cost`; biased by its own errors.
        cost: driven cost, over the noise that all refinements share.
        standard_error: of the latter.
    """

    nodes: int
    sweeps: int
    expected: float
    cost: float
    standard_error: float


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class WhiteTable:
    """What serves all roads of white velocity: lengths are over sqrt(S), times in 1/w1, and the weights sum to 1.

    Attributes:
        constant: the best constant damping.
        cost, standard_error: driven cost of the feedback over S.
        history: the refinements, coarse to fine.
        box: half the sides of the grid over `COORDINATES`, shape (4,).
        policy: coefficients of the tabulated part in the variable of D, and in its square; shape (2, nodes, nodes, nodes,
            nodes).
    """

    constant: float
    cost: float
    standard_error: float
    history: tuple[WhiteRefinement, ...]
    box: FloatArray
    policy: SingleArray


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class WhiteRoadFeedback(Feedback):
    """The best feedback found of a car of two masses on a first-order road, of the states of the car and the level.

    Its cost is that on a road of white velocity, which the road is but for its corner.

    Attributes:
        task: the car on this road.
        table: what was found for all first-order roads and speeds.
    """

    task: Task
    table: WhiteTable

    @property
    def state(self) -> tuple[str, ...]:
        """The states of the car, and the level."""
        return (*self.task.car.motion.states, "level")

    @property
    def history(self) -> tuple[WhiteRefinement, ...]:
        """The refinements, coarse to fine; costs as of `WhiteTable`."""
        return self.table.history

    def kept(self) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
        """Those of the table."""
        names = ("constant", "cost", "standard_error")
        figures: dict[str, Any] = {name: getattr(self.table, name) for name in names}
        figures["history"] = [dataclasses.asdict(refinement) for refinement in self.history]
        return figures, {"box": self.table.box, "policy": self.table.policy}

    def _evaluate(self, rows: npt.NDArray[Any], columns: npt.NDArray[np.int64]) -> SingleArray:
        result = np.empty(len(rows), np.float32)
        respond(0, len(rows), rows, columns, *self._rule, result)
        return np.clip(result, *np.array(self.bounds, np.float32), out=result)

    @functools.cached_property
    def _rule(self) -> tuple[Any, ...]:
        """Arguments of `respond`."""
        return rule_of(self.task, self.table.constant, self.table.box, self.table.policy)


def rule_of(task: Task, constant: float, box: FloatArray, policy: SingleArray) -> tuple[Any, ...]:
    """The feedback on the road of ``task`` at its speed, as `respond` takes it."""
    ratio = float(task.frequency_ratio(task.speed[0]))
    exact = Chain(task, ratio, constant).forms()
    forms = np.concatenate([exact.matrices, np.zeros((*exact.matrices.shape[:2], 1))], axis=2)[1:]
    forms[:, 0, -1] = exact.constants[1:]
    strength = 2 * ratio  # S, where the road's variance is 1
    rows = coordinates(task.car.motion, ratio) / math.sqrt(strength)
    shape = np.array(policy.shape[1:])
    return policy.reshape(2, -1), rows, strength, forms, 2 * box / (shape - 1), shape, np.array(exact.variable)


def driver_of(rule: tuple[Any, ...]) -> Respond:
    """A rule of `rule_of` for rows of the states of the car and the level."""

    def drives(begin: int, end: int, states: SingleArray, damping: SingleArray) -> None:
        respond(begin, end, states, np.arange(states.shape[1]), *rule, damping)

    return drives


def solve(
    model: Model, nodes: int, box: FloatArray, share: Share, told: Callable[[float], None]
) -> tuple[SingleArray, float, int]:
    """Relative value iteration: (policy, average cost that the table expects, sweeps)."""
    shape = np.full(4, nodes)
    cell = 2 * box / (shape - 1)
    shifts = model.shifts / cell[:2]
    planes, total = nodes**2, nodes**4
    tables = np.empty((len(shifts), total), np.float32)
    policy = np.empty((total, 2), np.float32)

    def apply(old: SingleArray, new: SingleArray, target: SingleArray) -> None:
        for shift, table in zip(shifts, tables, strict=True):
            value, result = old.reshape(planes, -1), table.reshape(planes, -1)
            share(planes, functools.partial(_spread, value, shift, shape, result))

        def part(begin: int, end: int) -> None:
            sweep(begin, end, tables, model.maps, model.forms, cell, shape, new, target)

        share((planes + 1) // 2, part)

    expected, done = settle(apply, np.zeros(total, np.float32), total // 2, policy, told, sweeps=SWEEPS, check=CHECK)
    return np.ascontiguousarray(policy.T).reshape(2, *shape), expected / model.interval, done


def _spread(value: SingleArray, shift: FloatArray, shape: Any, result: SingleArray, begin: int, end: int) -> None:
    spread(begin, end, value, shift, shape, result)


class WhiteRoad:
    """The search for a car of two masses on a first-order road.

    Attributes:
        refinements: most tables to make.
        description: what the table depends on beside the settings: neither the class of the road nor the speed.
    """

    refinements = len(GRIDS)

    def __init__(self, task: Task) -> None:
        self._task = task
        motion, total = task.car.motion, sum(task.weights_by_name.values())
        interval = task.control_interval * task.car.natural_frequency
        self.description = {
            "states": motion.states,
            "equations": [_digits(getattr(motion, name)) for name in ("drift", "level_entry", "slope_entry", "force_entry")],
            "signals": {name: {k: _digits(v) for k, v in motion.signals[name].terms.items()} for name in motion.signals},
            "weights": {name: _digits(weight / total) for name, weight in task.weights_by_name.items()},
            "bounds": list(task.damping_range),
            "interval": _digits(interval),
        }

    def load(self, path: Path, text: str) -> WhiteRoadFeedback | None:
        """The feedback that was kept under this description, or None."""
        table = read(path, text, sound_table)
        return None if table is None else self.feedback(table)

    def feedback(self, table: WhiteTable) -> WhiteRoadFeedback:
        """That on the road of the task at its speed."""
        task = self._task
        # S in units of the road's variance, and the weights as the task has them
        unit = 2 * float(task.frequency_ratio(task.speed[0])) * sum(task.weights_by_name.values())
        return WhiteRoadFeedback(
            road=task.road,
            speed=task.speed[0],
            natural_frequency=task.car.natural_frequency,
            weights=task.reward_by_name,
            bounds=task.damping_range,
            control_interval=task.control_interval,
            cost=unit * table.cost,
            standard_error=unit * table.standard_error,
            signals=(*task.car.motion.states, "level", "speed"),
            task=task,
            table=table,
        )

    def find(self, settings: Settings, told: Told) -> WhiteRoadFeedback:
        """Refine, choose, and drive once more; ``told`` is given the share that is done."""
        shared_noise, own_noise = np.random.SeedSequence(settings.seed).spawn(2)
        task = white_task(self._task)
        model = Model(task)
        unit = 2 * SLOW * sum(task.weights_by_name.values())  # of costs, as of `feedback`
        scale = np.sqrt(2 * SLOW)
        box = BOX * model.deviation
        history: list[WhiteRefinement] = []
        chosen: tuple[float, FloatArray, SingleArray] | None = None
        pieces = None
        with sharing(settings.threads) as share:
            for level, nodes in enumerate(GRIDS[: settings.refinements]):
                told_here = settings.share_of(level, told)
                policy, expected, sweeps = solve(model, nodes, box, share, told_here(0.0, 0.8))
                driven = drive(
                    task,
                    driver_of(rule_of(task, model.constant, box, policy)),
                    shared_noise,
                    cars=COMPARED_CARS,
                    moving=COORDINATES,
                    precision=max(COMPARED, settings.precision),
                    pieces=pieces,
                    share=share,
                    threads=settings.threads,
                    told=told_here(0.8, 0.2),
                )
                pieces = driven.pieces
                refinement = WhiteRefinement(
                    nodes=nodes,
                    sweeps=sweeps,
                    expected=expected,
                    cost=driven.cost / unit,
                    standard_error=driven.standard_error / unit,
                )
                if chosen is None or driven.cost < chosen[0]:
                    chosen = driven.cost, box, policy
                history.append(refinement)
                if len(history) > 1 and is_refined(history[-2], refinement, settings.tolerance):
                    break
                box = BOX * np.maximum(driven.deviation / scale, model.deviation)
            assert chosen is not None
            _, box, policy = chosen
            final = drive(
                task,
                driver_of(rule_of(task, model.constant, box, policy)),
                own_noise,
                cars=CARS,
                moving=COORDINATES,
                precision=settings.precision,
                pieces=None,
                share=share,
                threads=settings.threads,
                told=settings.share_of(settings.refinements, told)(0.0, 1.0),
            )
        return self.feedback(
            WhiteTable(
                constant=model.constant,
                cost=final.cost / unit,
                standard_error=final.standard_error / unit,
                history=tuple(history),
                box=box,
                policy=policy,
            )
        )


def _digits(values: npt.ArrayLike) -> Any:
    """Numbers to ten digits: the same car and weights are one problem, however their units were rounded."""
    return np.array([float(f"{value:.10g}") for value in np.ravel(values)]).reshape(np.shape(values)).tolist()


def sound_table(figures: dict[str, Any], arrays: dict[str, npt.NDArray[Any]]) -> WhiteTable | None:
    """The table that was kept, if the search could have found it."""
    history = tuple(WhiteRefinement(**refinement) for refinement in figures["history"])
    table = WhiteTable(**figures | {"history": history}, box=arrays["box"], policy=arrays["policy"])
    chosen = min(history, key=lambda grid: grid.cost)
    positive = [table.constant, table.cost, table.standard_error, *table.box.tolist()]
    for grid in history:
        positive += [grid.sweeps, grid.expected, grid.cost, grid.standard_error]
    sound = (
        [grid.nodes for grid in history] == list(GRIDS[: len(history)])
        and are_positive(positive)
        and table.box.shape == (4,)
        and table.box.dtype == np.float64
        and table.policy.shape == (2, *[chosen.nodes] * 4)
        and table.policy.dtype == np.float32
        and bool(np.isfinite(table.policy).all())
    )
    return table if sound else None
