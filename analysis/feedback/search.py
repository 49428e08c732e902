"""The search for the best feedback: tables are refined until the driven cost settles."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from roadgym.cars import MEAN_SQUARES, Car, make_car
from roadgym.parameters import ParameterError, positive_range, shown, whole, within
from roadgym.processors import usual_threads
from roadgym.reward import asked_signals, check_weights
from roadgym.roads import Road, make_road
from roadgym.task import Task, make_task

from ..checks import FloatArray
from .driving import CARS, COMPARED_CARS, Respond, drive
from .grid import STATE, SingleArray, evaluate, geometry_of
from .iteration import Tabulated, sharing, tabulate
from .model import Model
from .policy import OptimalFeedback, Refinement, kept_path, load, save
from .road_grid import grid_of
from .settings import COMPARED, Settings, is_refined
from .white.model import check as check_white
from .white.search import WhiteRoad, WhiteRoadFeedback

FORMAT = 4  # of the cached files; raise it whenever results change
BOX = 8.0  # half the sides of the rectangle, in root mean squares of the car; 5 of them cost 0.7 % at nu = 3


def check_plant(road: Road, car: Car, weighed: Sequence[str]) -> None:
    """Raises `ParameterError` for a plant, or a cost of these mean squares, for which `optimal_feedback` is not there."""
    if is_one_mass(car):
        grid_of(road)
    else:
        check_white(road, car, weighed)


def is_one_mass(car: Car) -> bool:
    """Is the car, with its road, described by `STATE`?"""
    return car.motion.is_one_mass and set(STATE[:2]) <= set(car.mean_squares)


def optimal_feedback(
    road: str | Mapping[str, Any] | Road,
    *,
    speed: float,
    bandwidth: float | None = None,
    natural_frequency: float | None = None,
    car: str | Mapping[str, Any] | Car | None = None,
    weights: Mapping[str, float] | None = None,
    bounds: tuple[float, float] | None = None,
    control_interval: float | None = None,
    tolerance: float = 0.005,
    precision: float = 0.003,
    refinements: int | None = None,
    seed: int = 0,
    threads: int | None = None,
    cache: str | os.PathLike[str] | None = None,
    report: Callable[[int, int], None] | None = None,
) -> OptimalFeedback | WhiteRoadFeedback:
    """The best state feedback within ``bounds`` at one operating point; `analysis.feedback` says how it is found.

    With the car of one mass it is one of (Y, X, Z, U) on second-order roads, and of (Y, X, Z) on first-order roads such as
    those of ISO 8608; with one of two masses, of the states of the car and the level, on first-order roads: that is found once
    for all their classes and speeds (`analysis.feedback.white`). Tables are refined until the driven cost changes by less than
    ``tolerance`` and the table expects about that cost, and the feedback with the least cost is driven once more, over fresh
    noise. Seconds to a minute on one processor, two with two masses.

    Args:
        road: a first-order road, and with one mass a Gaussian road, or a multiplicative road on a circle; or its name or
            mapping.
        speed: v > 0, m/s.
        bandwidth: delta > 0, 1, in place of the road's, at the same variance.
        natural_frequency: w1 of the car of one mass, rad/s, 1 by default; in place of ``car``.
        car: a car of one or of two masses, or its name or mapping.
        weights: weights of the mean squares, as of the reward of the environment; the car's by default.
        bounds: smallest and largest damping, 0 < low < high; the car's range by default, (0.05, 1) of one mass.
        control_interval: time between two settings of D, s; the car's by default, 0.2/natural_frequency of one mass.
        tolerance: relative change of the driven cost that ends the refinement.
        precision: relative standard error of the reported cost, at most.
        refinements: most tables to make, 1 to 4, of two masses 1 to 3; by default all.
        seed: fixes the noise; the result depends on nothing else.
        threads: number of threads; results do not depend on it. By default one a processor.
        cache: folder in which results are kept, and found again when all parameters are the same; it is made if need be.
        report: called as ``report(done, total)`` now and then; ``done`` never falls and ends at ``total``.

    Raises:
        ParameterError: a parameter out of range, a road of another kind, or a weight on no mean square.
    """
    road = make_road(road)
    if bandwidth is not None:
        road = road.with_bandwidth(within("bandwidth", bandwidth))
    the_car = make_car(car, natural_frequency).with_signals(asked_signals(weights))
    weights = the_car.default_reward if weights is None else weights
    checked = check_weights(weights, the_car, road, None)
    check_plant(road, the_car, [name for name, weight in checked.items() if weight])
    low, high = positive_range("bounds", the_car.default_damping_range if bounds is None else bounds, "damping")
    if low == high:
        raise ParameterError(f"bounds must be a pair (low, high) with low < high, got {shown(bounds)}")
    problem = (OneMass if is_one_mass(the_car) else WhiteRoad)(
        make_task(
            road=road,
            speed=within("speed", speed, "moving speed"),
            damping_range=(low, high),
            reward=weights,
            observation=(*the_car.motion.states, "level"),
            car=the_car,
            control_interval=control_interval,
        )
    )
    tolerance, precision = within("tolerance", tolerance, "relative_error"), within("precision", precision, "relative_error")
    refinements = problem.refinements if refinements is None else whole("refinements", refinements)
    if refinements > problem.refinements:
        raise ParameterError(f"refinements must be at most {problem.refinements}, got {shown(refinements)}")
    whole("seed", seed, low=0, of="seed")
    if not (cache is None or isinstance(cache, (str, os.PathLike))):
        raise ParameterError(f"cache must be a folder or None, got {shown(cache)}")
    settings = Settings(
        tolerance=tolerance,
        precision=precision,
        refinements=refinements,
        seed=seed,
        threads=usual_threads() if threads is None else whole("threads", threads, of="threads"),
    )
    chosen = {name: value for name, value in dataclasses.asdict(settings).items() if name != "threads"}
    text = json.dumps({"format": FORMAT, **problem.description, **chosen}, sort_keys=True)
    path = kept_path(cache, text)
    units, reached = 100 * (refinements + 1), 0

    def told(done: float) -> None:
        nonlocal reached
        reached = max(reached, min(int(units * done), units - 1))  # an estimate of what is left may rise again
        if report is not None:
            report(reached, units)

    result: OptimalFeedback | WhiteRoadFeedback | None = None if path is None else problem.load(path, text)
    if result is None:
        result = problem.find(settings, told)
        if path is not None:
            save(path, text, result)
    if report is not None:
        report(units, units)
    return result


class OneMass:
    """The search for a car of one mass.

    Attributes:
        refinements: most tables to make.
        description: what the result depends on beside the settings.
    """

    def __init__(self, task: Task) -> None:
        self._grid = grid_of(task.road)
        self._task = dataclasses.replace(task, signals=self._grid.state)
        self.refinements = len(self._grid.sizes)
        self._point: dict[str, Any] = {
            "road": task.road,
            "speed": task.speed[0],
            "natural_frequency": task.car.natural_frequency,
            "weights": task.reward_by_name,
            "bounds": task.damping_range,
            "control_interval": task.control_interval,
        }
        self.description = {**self._point, "road": dataclasses.asdict(task.road), "bounds": list(task.damping_range)}
        if task.car.mean_squares != MEAN_SQUARES:  # what the weights weigh is then its own affair
            signals = task.car.motion.signals
            self.description["signals"] = {name: dict(signals[name].terms) for name in task.reward_by_name}

    def load(self, path: Path, text: str) -> OptimalFeedback | None:
        """What was kept under this description, or None."""
        return load(path, text, self._point)

    def find(self, settings: Settings, told: Callable[[float], None]) -> OptimalFeedback:
        """Refine, choose, and drive once more; ``told`` is given the share that is done."""
        task, precision, threads = self._task, settings.precision, settings.threads
        shared_noise, own_noise = np.random.SeedSequence(settings.seed).spawn(2)
        model = Model(task)
        box = BOX * model.deviation
        interval = task.control_interval * task.car.natural_frequency
        history: list[Refinement] = []
        chosen: tuple[float, FloatArray, SingleArray] | None = None
        pieces = None
        coarse: Tabulated | None = None

        def rule(box: FloatArray, policy: SingleArray) -> Respond:
            shape = np.array(policy.shape[:3])
            geometry = geometry_of(task.road, shape, box, task.damping_range, interval, model.follows)
            flat, columns = policy.reshape(-1), np.arange(len(task.signals))

            def respond(begin: int, end: int, states: SingleArray, damping: SingleArray) -> None:
                evaluate(begin, end, states, columns, flat, geometry, shape, damping)

            return respond

        with sharing(threads) as share:
            for level, (rings, rays, rows) in enumerate(self._grid.sizes[: settings.refinements]):
                told_here = settings.share_of(level, told)
                value, policy, expected, sweeps = tabulate(
                    model, np.array([rings, rays, rows]), box, share, told_here(0.0, 0.8), coarse
                )
                coarse = value, (rings, rays, rows), box
                driven = drive(
                    task,
                    rule(box, policy),
                    shared_noise,
                    cars=COMPARED_CARS,
                    moving=STATE[:2],
                    precision=max(COMPARED, precision),
                    pieces=pieces,
                    share=share,
                    threads=threads,
                    told=told_here(0.8, 0.2),
                )
                pieces = driven.pieces
                refinement = Refinement(
                    rings=rings,
                    rays=rays,
                    rows=rows,
                    sweeps=sweeps,
                    expected=expected,
                    cost=driven.cost,
                    standard_error=driven.standard_error,
                )
                if chosen is None or driven.cost < chosen[0]:
                    chosen = driven.cost, box, policy
                history.append(refinement)
                if len(history) > 1 and is_refined(history[-2], refinement, settings.tolerance):
                    break
                box = BOX * self._grid.deviation(driven.deviation, model.deviation)
            assert chosen is not None
            _, box, policy = chosen
            final = drive(
                task,
                rule(box, policy),
                own_noise,
                cars=CARS,
                moving=STATE[:2],
                precision=precision,
                pieces=None,
                share=share,
                threads=threads,
                told=settings.share_of(settings.refinements, told)(0.0, 1.0),
            )
        return OptimalFeedback(
            **self._point,
            cost=final.cost,
            standard_error=final.standard_error,
            history=tuple(history),
            signals=self._grid.signals,
            box=box,
            policy=policy,
        )
