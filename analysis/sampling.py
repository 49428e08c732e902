"""Figures of a driven plant, one a lane: what `analysis.certification` compares with theory.

Lanes are independent of each other, while the moments of one lane are not: so every figure here is the mean over the time of
one lane, and standard errors come from the spread between lanes.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from roadgym.cars import Car
from roadgym.plant import Plant
from roadgym.roads import Road
from roadgym.speed import SpeedNoise
from roadgym.task import LARGEST_ANGLE, make_task

from .checks import FloatArray, check_size
from .driven import lane_seeds
from .phase_noise import slowest_decay
from .quadratic import interval_mean, periodic_mean_squares, plant_system

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
        mean_squares: those of the car, as told, shape (squares, lanes); infinite where they diverge.
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
    car: Car,
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
        car: the car.
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
        car=car,
        control_interval=2 * LARGEST_ANGLE / max(turn, car.fastest * car.natural_frequency),
    )
    plant = Plant(task, lanes)
    plant.start(lane_seeds(np.random.SeedSequence(seed), lanes))

    # The road starts in its stationary law; only one whose law is wrong needs the time to show it.
    memories = [1 / (car.decay(damping) * car.natural_frequency)]
    road_filter = road.shaping_filter()
    if road_filter is not None and road_filter.slowest > 0:
        memories.append(1 / (road_filter.slowest * turn))
    elif task.bandwidth[0] > 0:
        memories.append(1 / (float(slowest_decay(np.asarray(task.bandwidth[0]))) * turn))
    interval = task.control_interval
    skipped = math.ceil(SETTLED * max(memories) / interval)
    measured = math.ceil(RECORD_ANGLE / min(turn, car.natural_frequency) / interval)

    work = (skipped + measured) * task.substeps * lanes
    check_size("substeps of all lanes", "speed, damping and lanes", work, "work")
    window = np.hanning(measured + 2)[1:-1]
    waves = window[:, None] * np.exp(-1j * interval * np.outer(np.arange(measured), frequencies))
    transform = np.zeros((len(frequencies), lanes), np.complex128)
    level_square, slope_square, mean_squares = np.zeros(lanes), np.zeros(lanes), np.zeros((len(car.mean_squares), lanes))
    largest_square = 0.0
    actions = np.full(lanes, damping, np.float32)
    for step in range(-skipped, measured):
        driven = plant.step(actions)
        if report and (step % REPORTS == 0 or step == measured - 1):
            report(skipped + step + 1, skipped + measured)
        if step < 0:
            continue
        z, u = plant.row("level").astype(np.float64), plant.row("slope").astype(np.float64)
        z_square, u_square = z * z, u * u
        level_square += z_square
        slope_square += u_square
        mean_squares += driven.mean_squares
        largest_square = max(largest_square, float(np.max(z_square + u_square)))
        transform += waves[step][:, None] * z
    return Samples(
        level_square=road.variance * level_square / measured,
        slope_square=road.variance * slope_square / measured,
        level=math.sqrt(road.variance) * z,
        largest_square=road.variance * largest_square,
        periodogram=road.variance * interval * np.abs(transform) ** 2 / np.sum(window**2),
        mean_squares=task.square_units[:, None] * mean_squares / measured,
        window=window,
        interval=interval,
    )


class Switching:
    """Independent cars whose D switches between a soft and a firm level, at the substep that a task chooses by itself.

    Args:
        road: a road with a shaping filter.
        damping: the soft and the firm level, 1.
        speed, car, lanes, seed: as for `drive`.

    Attributes:
        names: the mean squares that are finite.
    """

    def __init__(self, road: Road, *, damping: tuple[float, float], speed: float, car: Car, lanes: int, seed: int) -> None:
        self._task = make_task(road=road, speed=speed, damping_range=damping, car=car)
        self._levels = np.array(damping, np.float32)
        self._interval = self._task.control_interval * car.natural_frequency
        self._ratio = float(self._task.frequency_ratio(speed))
        bandwidth = self._task.bandwidth[0]
        self._soft, self._firm = (plant_system(self._task, float(level), self._ratio, bandwidth) for level in self._levels)
        self.names = [name for name in car.mean_squares if name not in self._soft.rough]
        self._rows = np.array([car.mean_squares.index(name) for name in self.names])
        self._units = self._task.square_units[self._rows, None]
        self._plant = Plant(self._task, lanes)
        self._plant.start(lane_seeds(np.random.SeedSequence(seed), lanes))

    def _drive(self, firm: Callable[[int], Any], report: Callable[[int, int], None] | None) -> FloatArray:
        """Mean squares of each lane, as told, shape (names, lanes); steps before the record have negative numbers."""
        skipped = math.ceil(SETTLED / (min(map(self._task.car.decay, self._levels.tolist())) * self._interval))
        measured = self._measured()
        totals = np.zeros((len(self.names), self._plant.num_envs))
        for step in range(-skipped, measured):
            actions = np.broadcast_to(np.where(firm(step), self._levels[1], self._levels[0]), self._plant.num_envs)
            driven = self._plant.step(np.ascontiguousarray(actions))
            if step >= 0:
                totals += driven.mean_squares[self._rows]
            if report and (step % REPORTS == 0 or step == measured - 1):
                report(skipped + step + 1, skipped + measured)
        return np.asarray(self._units * totals / measured)

    def _measured(self) -> int:
        return math.ceil(RECORD_ANGLE / min(self._ratio, 1.0) / self._interval)

    def alternate(self, report: Callable[[int, int], None] | None = None) -> tuple[FloatArray, FloatArray]:
        """(measured, expected) mean squares with D firm and soft in turn, as told, shapes (names, lanes) and (names,)."""
        expected = periodic_mean_squares([self._firm, self._soft], self._interval)
        measured = self._drive(lambda step: step % 2 == 0, report)
        return measured, self._units[:, 0] * np.array([float(expected[name]) for name in self.names])

    @property
    def knows_state(self) -> bool:
        """Can `skyhook` be driven: is the state all that there is, and are its conditional moments known?"""
        known = {"velocity", "relative_velocity"} <= set(self._task.car.mean_squares)
        return known and self._soft.flatness is not None and self._task.road.state_rows is not None

    def skyhook(self, report: Callable[[int, int], None] | None = None) -> tuple[FloatArray, FloatArray]:
        """(measured, expected) mean squares with D firm where it brakes the body, as told, shape (names, lanes) each.

        Whatever sets D, the mean of a square over an interval has a known mean, given the state at its beginning: a quadratic
        form. What is expected of a lane is the average of that over the states in which its D was set.
        """
        size = len(self._soft.states)
        forms = np.empty((2, len(self.names), size * size + 1))
        for k, system in enumerate((self._soft, self._firm)):
            for n, name in enumerate(self.names):
                forms[k, n] = interval_mean(system, system.cost_form({name: 1.0}), self._interval)[1] / self._interval
        expected = np.zeros((len(self.names), self._plant.num_envs))
        velocity, relative = (self._soft.signals[name] for name in ("velocity", "relative_velocity"))

        def firm(step: int) -> Any:
            state = np.concatenate([self._plant.car_states, self._plant.road_states]).astype(float)
            braking = (velocity @ state) * (relative @ state) > 0
            if step >= 0:
                squares = (state[:, None] * state).reshape(size * size, -1)
                soft, hard = (form[:, :-1] @ squares + form[:, -1:] for form in forms)
                expected[:] += np.where(braking, hard, soft)
            return braking

        measured = self._drive(firm, report)
        return measured, self._units * expected / self._measured()
