"""A lower bound for cars that differ from episode to episode: the mean over cars of each one's own bound.

A controller that is told which car it drives can do all that one can who is not, and costs each car's bound at least. So no
controller costs less, in the mean over episodes, than the mean of the bounds over the law of the cars. That mean is taken over
cars that the environment's own generator draws. The fields of the car, which are uniform, serve as control variates of known
means: a bound is nearly a smooth function of them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from roadgym.parameters import ParameterError
from roadgym.task import Task
from roadgym.variation import OF_VALVE, Variation

from ..checks import FloatArray
from ..control_variates import SAMPLES_EACH, adjust
from .bound import STATISTICAL, LowerBound

PRECISION = 0.01  # standard error over the bound, at most
FEWEST, MOST = 24, 256  # cars


def drawn_task(task: Task, vary: Variation, values: list[float]) -> Task:
    """What is driven with the car and the valve that have these values of the fields: their own damping ratios and weights."""
    car, valve = vary.drawn(values)
    firmer, faster = vary.firmer(car), car.natural_frequency / vary.car.natural_frequency
    low, high = task.damping_range
    powers = (vary.car.time_powers.get(name, 0) for name in car.mean_squares)
    reward = tuple(weight * faster ** (2 * power) for weight, power in zip(task.reward, powers, strict=True))
    return dataclasses.replace(
        task, vary=None, car=car, valve=valve, damping_range=(firmer * low, firmer * high), reward=reward
    )


def mean_bound(
    task: Task, vary: Variation, seed: int, one: Callable[[Task], LowerBound], told: Callable[[int, int], None]
) -> LowerBound:
    """The mean over cars of the bound of each.

    Args:
        task: the task.
        vary: what varies in it.
        seed: fixes which cars are drawn.
        one: the bound of a task with one car.
        told: called as ``told(done, in all)``.

    Raises:
        ParameterError: more than `MOST` cars would be needed for `PRECISION`, or ``one`` raised it of a car.
    """
    values = vary.first_draws(np.random.SeedSequence(seed).generate_state(MOST, np.uint64).astype(np.uint64))
    low, high = np.array([ends for _, *ends in vary.ranges]).T[:, :, None]
    of_car = [k for k, name in enumerate(vary.names) if not name.startswith(OF_VALVE)]
    controls = ((2 * values - low - high) / (high - low))[of_car]
    fewest = max(FEWEST, SAMPLES_EACH * len(of_car))
    costs: FloatArray = np.empty(0)
    bound, mean, error, needed = None, 0.0, math.inf, fewest
    while len(costs) < needed:
        bound = one(drawn_task(task, vary, values[:, len(costs)].tolist()))
        costs = np.append(costs, bound.cost)
        told(len(costs), needed)
        if len(costs) == needed:
            adjusted = adjust(costs, controls[:, :needed], np.zeros(len(of_car)))
            mean, error = float(adjusted.mean()), float(adjusted.std(ddof=1)) / math.sqrt(needed)
            short = (error / (PRECISION * mean)) ** 2 if mean > 0 else math.inf
            if short * needed > MOST:
                raise ParameterError(
                    f"cars that vary so much would need more than {MOST} draws for a lower bound to {100 * PRECISION:g} %"
                )
            needed = max(needed, math.ceil(short * needed))
    assert bound is not None
    return dataclasses.replace(
        bound,
        cost=mean,
        assumption=f"{bound.assumption}; it may be told which car it drives",
        rigour=STATISTICAL,
        standard_error=error,
    )
