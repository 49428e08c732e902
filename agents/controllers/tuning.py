"""The parameter of a rule, chosen by driving."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from roadgym.plant import Plant
from roadgym.task import Task

from .base import Controller

LANES = 256  # cars driven together, on common roads
SETTLING, DRIVEN = 20.0, 60.0  # time driven before costs count, and after, in units of 1/w1


def tuned(make: Callable[..., Controller], task: Task, seed: int = 0) -> Controller:
    """The controller with the parameters, of those that it offers as `Controller.tried`, that cost least.

    Its own default is one of the choices. Each drives the same roads, at the middle of the task's ranges of speed and
    bandwidth, for a second or so. A controller without parameters is made as it is.

    Args:
        make: makes the controller of a task and parameters by name.
        task: the task.
        seed: fixes the roads.

    Raises:
        ParameterError: the task has not what the controller needs.
    """
    first = make(task)
    names = list(first.tried)
    if not names:
        return first
    tried = [dict(zip(names, values, strict=True)) for values in itertools.product(*first.tried.values())]
    choices = [first.parameters, *(choice for choice in tried if choice != first.parameters)]
    return min((make(task, **choice) for choice in choices), key=lambda controller: driven_cost(controller, task, seed))


def driven_cost(controller: Controller, task: Task, seed: int) -> float:
    """Mean cost of a controller at the middle of the task's ranges."""
    interval = task.control_interval * task.car.natural_frequency
    middle: Mapping[str, Any] = {"speed": sum(task.speed) / 2, "bandwidth": sum(task.bandwidth) / 2 or None}
    plant = Plant(task, LANES)
    everyone = np.ones(LANES, np.bool_)
    plant.seed(np.random.SeedSequence(seed).generate_state(LANES, np.uint64).astype(np.uint64), everyone)
    seen = plant.reset(plant.forced(dict(middle)), everyone).observations
    total, settling, steps = 0.0, math.ceil(SETTLING / interval), math.ceil(DRIVEN / interval)
    for step in range(settling + steps):
        driven = plant.step(controller.predict(seen)[0][:, 0])
        seen = driven.observations
        if step >= settling:
            total -= float(driven.reward.mean())
    return total / steps
