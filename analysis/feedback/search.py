"""The search for the best feedback: tables are refined until the driven cost settles."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from roadgym.cars import MEAN_SQUARES, Car, make_car
from roadgym.parameters import ParameterError, positive_range, shown, whole, within
from roadgym.reward import check_weights
from roadgym.roads import Road, make_road
from roadgym.task import Task, make_task

from ..checks import FloatArray
from ..optimum import DISPLACEMENT
from .driving import drive
from .grid import GRIDS, STATE, SingleArray, geometry_of
from .iteration import sharing, solve
from .model import Model
from .policy import OptimalFeedback, Refinement, load, save

FORMAT = 3  # of the cached files; raise it whenever results change
BOX = 8.0  # half the sides of the rectangle, in root mean squares of the car; 5 of them cost 0.7 % at nu = 3
COMPARED = 0.005  # relative standard error of the costs, over common noise, by which grids are compared
TRUSTED = 4.0  # times the tolerance by which the cost that a table expects may differ from the driven one


def check_road(road: Road) -> None:
    """Raises `ParameterError` for a road on which `optimal_feedback` is not there."""
    road_filter = road.shaping_filter()
    if road_filter is None or road_filter.bandwidth is None or road_filter.flatness is None:
        raise ParameterError(f"road must be gaussian, or multiplicative on a circle, got {road!r}")


def check_car(car: Car) -> None:
    """Raises `ParameterError` for a car for which `optimal_feedback` is not there."""
    if not (car.motion.is_one_mass and set(STATE[:2]) <= set(car.mean_squares)):
        raise ParameterError(f"car must be of one mass, got {car!r}")


def optimal_feedback(
    road: str | Mapping[str, Any] | Road,
    *,
    speed: float,
    bandwidth: float | None = None,
    natural_frequency: float | None = None,
    car: str | Mapping[str, Any] | Car | None = None,
    weights: Mapping[str, float] = DISPLACEMENT,
    bounds: tuple[float, float] = (0.05, 1.0),
    control_interval: float | None = None,
    tolerance: float = 0.005,
    precision: float = 0.003,
    refinements: int = len(GRIDS),
    seed: int = 0,
    threads: int | None = None,
    cache: str | os.PathLike[str] | None = None,
    report: Callable[[int, int], None] | None = None,
) -> OptimalFeedback:
    """The best state feedback D(Y, X, Z, U) within ``bounds`` at one operating point; `analysis.feedback` says how it is found.

    Tables are refined until the driven cost changes by less than ``tolerance`` and the table expects about that cost, and the
    feedback with the least cost is driven once more, over fresh noise. Seconds to a minute on one processor.

    Args:
        road: a Gaussian road, or a multiplicative road on a circle, or its name or mapping.
        speed: v > 0, m/s.
        bandwidth: delta > 0, 1, in place of the road's, at the same variance.
        natural_frequency: w1 of the car of one mass, rad/s, 1 by default; in place of ``car``.
        car: a car of one mass, or its name or mapping.
        weights: weights of the mean squares, as of the reward of the environment.
        bounds: smallest and largest damping, 0 < low < high.
        control_interval: time between two settings of D, s; 0.2/natural_frequency by default.
        tolerance: relative change of the driven cost that ends the refinement.
        precision: relative standard error of the reported cost, at most.
        refinements: most tables to make, 1 to 4.
        seed: fixes the noise; the result depends on nothing else.
        threads: number of threads; results do not depend on it. By default one a processor.
        cache: folder in which results are kept, and found again when all parameters are the same; it is made if need be.
        report: called as ``report(done, total)`` now and then; ``done`` never falls and ends at ``total``.

    Raises:
        ParameterError: a parameter out of range, a road of another kind, or a weight on no mean square.
    """
    road = make_road(road)
    check_road(road)
    if bandwidth is not None:
        road = road.with_bandwidth(within("bandwidth", bandwidth))
    the_car = make_car(car, natural_frequency)
    check_car(the_car)
    check_weights(weights, the_car, road, None)
    low, high = positive_range("bounds", bounds, "damping")
    if low == high:
        raise ParameterError(f"bounds must be a pair (low, high) with low < high, got {shown(bounds)}")
    task = make_task(
        road=road,
        speed=within("speed", speed, "moving speed"),
        damping_range=(low, high),
        reward=weights,
        observation=STATE,
        car=the_car,
        control_interval=control_interval,
    )
    tolerance, precision = within("tolerance", tolerance, "relative_error"), within("precision", precision, "relative_error")
    if whole("refinements", refinements) > len(GRIDS):
        raise ParameterError(f"refinements must be at most {len(GRIDS)}, got {shown(refinements)}")
    whole("seed", seed, low=0, of="seed")
    if not (cache is None or isinstance(cache, (str, os.PathLike))):
        raise ParameterError(f"cache must be a folder or None, got {shown(cache)}")
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    threads = available if threads is None else whole("threads", threads, of="threads")

    description = {
        "format": FORMAT,
        "road": dataclasses.asdict(road),
        "speed": task.speed[0],
        "natural_frequency": task.car.natural_frequency,
        "weights": task.reward_by_name,
        "bounds": [low, high],
        "control_interval": task.control_interval,
        "tolerance": tolerance,
        "precision": precision,
        "refinements": refinements,
        "seed": seed,
    }
    if the_car.mean_squares != MEAN_SQUARES:  # what the weights weigh is then its own affair
        description["signals"] = {name: dict(the_car.motion.signals[name].terms) for name in task.reward_by_name}
    text = json.dumps(description, sort_keys=True)
    path = None if cache is None else Path(cache) / f"feedback-{hashlib.sha256(text.encode()).hexdigest()[:32]}.npz"
    point: dict[str, Any] = {
        "road": road,
        "speed": task.speed[0],
        "natural_frequency": task.car.natural_frequency,
        "weights": task.reward_by_name,
        "bounds": (low, high),
        "control_interval": task.control_interval,
    }
    units, reached = 100 * (refinements + 1), 0

    def told(done: float) -> None:
        nonlocal reached
        reached = max(reached, min(int(units * done), units - 1))  # an estimate of what is left may rise again
        if report is not None:
            report(reached, units)

    result = None if path is None else load(path, text, point)
    if result is None:
        result = _find(
            task,
            point,
            tolerance=tolerance,
            precision=precision,
            refinements=refinements,
            seed=seed,
            threads=threads,
            told=told,
        )
        if path is not None:
            save(path, text, result)
    if report is not None:
        report(units, units)
    return result


def _find(
    task: Task,
    point: Mapping[str, Any],
    *,
    tolerance: float,
    precision: float,
    refinements: int,
    seed: int,
    threads: int,
    told: Callable[[float], None],
) -> OptimalFeedback:
    """Refine, choose, and drive once more; ``told`` is given the share that is done."""
    shared_noise, own_noise = np.random.SeedSequence(seed).spawn(2)
    model = Model(task)
    box = BOX * model.deviation
    interval = task.control_interval * task.car.natural_frequency
    history: list[Refinement] = []
    chosen: tuple[float, FloatArray, SingleArray] | None = None
    pieces = None

    def table_of(box: FloatArray, policy: SingleArray) -> tuple[SingleArray, FloatArray, npt.NDArray[np.int64]]:
        shape = np.array(policy.shape[:3])
        return policy.reshape(-1), geometry_of(task.road, shape, box, task.damping_range, interval), shape

    def within(level: int, begin: float, width: float) -> Callable[[float], None]:
        return lambda done: told((level + begin + width * done) / (refinements + 1))

    with sharing(threads) as share:
        for level, (rings, rays, rows) in enumerate(GRIDS[:refinements]):
            policy, expected, sweeps = solve(model, np.array([rings, rays, rows]), box, share, within(level, 0.0, 0.8))
            driven = drive(
                task,
                table_of(box, policy),
                shared_noise,
                precision=max(COMPARED, precision),
                pieces=pieces,
                share=share,
                threads=threads,
                told=within(level, 0.8, 0.2),
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
            if len(history) > 1 and _is_refined(history[-2], refinement, tolerance):
                break
            box = BOX * driven.deviation
        assert chosen is not None
        _, box, policy = chosen
        final = drive(
            task,
            table_of(box, policy),
            own_noise,
            precision=precision,
            pieces=None,
            share=share,
            threads=threads,
            told=within(refinements, 0.0, 1.0),
        )
    return OptimalFeedback(
        **point, cost=final.cost, standard_error=final.standard_error, history=tuple(history), box=box, policy=policy
    )


def _is_refined(coarse: Refinement, fine: Refinement, tolerance: float) -> bool:
    """Has the driven cost settled, and does the table know it?"""
    trusted = abs(fine.expected - fine.cost) <= TRUSTED * tolerance * fine.cost + 2 * fine.standard_error
    return trusted and abs(fine.cost - coarse.cost) <= tolerance * fine.cost
