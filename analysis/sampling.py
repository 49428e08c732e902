"""Figures of a driven plant, one a lane: what `analysis.certification` compares with theory.

Lanes are independent of each other, while the moments of one lane are not: so every figure here is the mean over the time of
one lane, and standard errors come from the spread between lanes.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np

from roadgym.compiled import LEVEL, SLOPE
from roadgym.kernel import RESULT_SQUARE
from roadgym.plant import Plant
from roadgym.roads import Road
from roadgym.speed import SpeedNoise
from roadgym.task import LARGEST_ANGLE, make_task

from .checks import FloatArray, check_size
from .phase_noise import slowest_decay

RECORD_ANGLE = 100.0  # rad that the slower of road and car turns in the record
SETTLED = 8.0  # times the slowest time constant before the record: e^-8 of a start at rest is left
REPORTS = 50  # intervals between two reports


@dataclasses.dataclass(frozen=True, kw_only=True)
class Samples:
    """Figures of independent lanes, over a record that begins when road and car have forgotten how they started.

    Attributes:
        level_square, slope_square: mean of Z^2 and of U^2, m^2, shape (lanes,).
        level: Z at the end of the record, m, shape (lanes,).
        largest_square: largest Z^2 + U^2 of all lanes at all times of the record, m^2.
        periodogram: interval |sum of window Z e^(-i w t)|^2 / sum of window^2, m^2 s, shape (frequencies, lanes).
        mean_squares: those of `roadgym.car.MEAN_SQUARES`, m^2, shape (5, lanes); infinite where they diverge.
        window: weights of the periodogram, Hann's, shape (times,).
        interval: time between two samples of the record, s.
    """

    level_square: FloatArray
    slope_square: FloatArray
    level: FloatArray
    largest_square: float
    periodogram: FloatArray
    mean_squares: FloatArray
    window: FloatArray
    interval: float


def drive(
    road: Road,
    speed_noise: SpeedNoise | None,
    *,
    speed: float,
    damping: float,
    natural_frequency: float,
    frequencies: Sequence[float],
    lanes: int,
    seed: int,
    report: Callable[[int, int], None] | None = None,
) -> Samples:
    """Drive independent cars at constant damping, at the largest substep that a task chooses by itself.

    Args:
        road, speed_noise: the plant.
        speed: v, m/s.
        damping: D, 1.
        natural_frequency: w1, rad/s.
        frequencies: angular frequencies w of the periodogram, rad/s.
        lanes: how many.
        seed: fixes the noise; different seeds share none.
        report: called as ``report(intervals done, intervals in all)`` now and then.
    """
    turn = speed * road.wavenumber
    task = make_task(
        road=road,
        speed_noise=speed_noise,
        speed=speed,
        damping_range=(damping / 2, damping),
        natural_frequency=natural_frequency,
        control_interval=2 * LARGEST_ANGLE / max(turn, natural_frequency),
    )
    plant = Plant(task, lanes)
    everyone = np.ones(lanes, np.bool_)
    plant.seed(np.random.SeedSequence(seed).generate_state(lanes, np.uint64).astype(np.uint64), everyone)
    plant.reset(plant.forced({}), everyone)

    # The road starts in its stationary law; only one whose law is wrong needs the time to show it.
    memories = [1 / (_decay(damping) * natural_frequency)]
    if road.kind == "first_order":
        memories.append(1 / turn)
    elif task.bandwidth[0] > 0:
        memories.append(1 / (_decay(task.bandwidth[0]) * turn))
    interval = task.control_interval
    skipped = math.ceil(SETTLED * max(memories) / interval)
    measured = math.ceil(RECORD_ANGLE / min(turn, natural_frequency) / interval)

    work = (skipped + measured) * task.substeps * lanes
    check_size("substeps of all lanes", "speed, damping and lanes", work, "work")
    window = np.hanning(measured + 2)[1:-1]
    waves = window[:, None] * np.exp(-1j * interval * np.outer(np.arange(measured), frequencies))
    transform = np.zeros((len(frequencies), lanes), np.complex128)
    level_square, slope_square, mean_squares = np.zeros(lanes), np.zeros(lanes), np.zeros((5, lanes))
    largest_square = 0.0
    actions = np.full(lanes, damping, np.float32)
    for step in range(-skipped, measured):
        results = plant.step(actions)[1]
        if report and (step % REPORTS == 0 or step == measured - 1):
            report(skipped + step + 1, skipped + measured)
        if step < 0:
            continue
        z, u = plant.row(LEVEL).astype(np.float64), plant.row(SLOPE).astype(np.float64)
        z_square, u_square = z * z, u * u
        level_square += z_square
        slope_square += u_square
        mean_squares += results[RESULT_SQUARE : RESULT_SQUARE + 5]
        largest_square = max(largest_square, float(np.max(z_square + u_square)))
        transform += waves[step][:, None] * z
    return Samples(
        level_square=road.variance * level_square / measured,
        slope_square=road.variance * slope_square / measured,
        level=math.sqrt(road.variance) * z,
        largest_square=road.variance * largest_square,
        periodogram=road.variance * interval * np.abs(transform) ** 2 / np.sum(window**2),
        mean_squares=road.variance * mean_squares / measured,
        window=window,
        interval=interval,
    )


def _decay(damping: float) -> float:
    """Rate at which x'' + 2 D x' + x = 0 decays in the end."""
    return float(slowest_decay(np.asarray(damping)))
