"""A feedback driven on the plant: what it costs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np

from roadgym.plant import Plant
from roadgym.task import Task

from ..checks import FloatArray
from ..control_variates import adjust, control_dampings, expected_squares, least_transient
from .grid import SingleArray
from .iteration import Share

CARS, COMPARED_CARS = 2560, 640  # driven together: for the cost, and to compare grids over common noise
PIECE = 250  # intervals between two looks at the standard error
FEWEST_PIECES = 3  # the adjusted error is soon small, and shorter drives adjust less well

Respond = Callable[[int, int, SingleArray, SingleArray], None]


@dataclasses.dataclass(frozen=True)
class Drive:
    """Driven cost, adjusted by control variates, its standard error, root mean squares of the moving signals, and pieces."""

    cost: float
    standard_error: float
    deviation: FloatArray
    pieces: int


def drive(
    task: Task,
    respond: Respond,
    noise: np.random.SeedSequence,
    *,
    cars: int,
    moving: Sequence[str],
    precision: float,
    pieces: int | None,
    share: Share,
    threads: int,
    told: Callable[[float], None],
) -> Drive:
    """Drive ``cars`` by a feedback for ``pieces``, or until the relative standard error is at most ``precision``.

    ``respond`` is given a range of rows, observations of ``task``, and the row of D to write to; ``moving`` names the signals
    whose root mean squares are wanted.

    Constant dampings over the same noise serve as control variates, see `analysis.control_variates`. A start at rest leaves
    exp(-2 D_min natural_frequency t) of the variance at most; it is let die out to below 1e-4, and to far less for those.
    """
    seeds = noise.generate_state(cars, np.uint64).astype(np.uint64)

    def start() -> tuple[Plant, SingleArray]:
        plant = Plant(task, cars, threads=threads)
        return plant, plant.start(seeds).observations

    plant, states = start()
    rows = [task.car.mean_squares.index(name) for name in moving]
    low, high = np.array(task.damping_range, np.float32)
    damping = np.empty(cars, np.float32)
    total, squares = np.zeros(cars), np.zeros(len(rows))
    forgotten = 5 / (task.damping_range[0] * task.car.natural_frequency)
    skipped = math.ceil(max(forgotten, least_transient(task)) / task.control_interval)
    constants = control_dampings(task, skipped * task.control_interval, cars)
    weights = np.array(task.reward)
    expected = weights[weights > 0] @ expected_squares(task, constants, task.speed[0])[weights > 0]  # others may be infinite
    rivals = [start()[0] for _ in constants]
    held = [np.full(cars, constant, np.float32) for constant in constants]
    controls = np.zeros((len(constants), cars))

    step, measured, mean, error = 0, 0, 0.0, math.inf
    least = FEWEST_PIECES if pieces is None else pieces
    while measured < least * PIECE or (pieces is None and error > precision * mean):
        for _ in range(PIECE if step >= skipped else skipped):
            seen = states
            share(cars, lambda begin, end, seen=seen: respond(begin, end, seen, damping))
            interval = plant.step(np.clip(damping, low, high, out=damping))
            states = interval.observations
            rewards = [rival.step(constant).reward for rival, constant in zip(rivals, held, strict=True)]
            if step >= skipped:
                total -= interval.reward
                for control, reward in zip(controls, rewards, strict=True):
                    control -= reward
                squares += np.mean(interval.mean_squares[rows], axis=1, dtype=float)
                measured += 1
            step += 1
        if measured:
            adjusted = adjust(total / measured, controls / measured, expected)
            mean, error = float(adjusted.mean()), float(adjusted.std(ddof=1)) / math.sqrt(cars)
            told(min((precision * mean / error) ** 2, measured / (least * PIECE), 1.0))
    return Drive(mean, error, np.sqrt(squares / measured), measured // PIECE)
