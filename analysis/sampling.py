"""Figures of a driven plant, one a lane: what `analysis.certification` compares with theory.

Lanes are independent of each other, while the moments of one lane are not: so every figure here is the mean over the time of
one lane, and standard errors come from the spread between lanes.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from roadgym.cars import Car
from roadgym.plant import Plant
from roadgym.resolution import LARGEST_ANGLE
from roadgym.roads import Road
from roadgym.sensors import Sensors
from roadgym.speed import SpeedNoise
from roadgym.task import Task, make_task

from .checks import FloatArray, check_size
from .driven import lane_seeds
from .identities import identities, rows_of, watched
from .phase_noise import slowest_decay
from .quadratic import interval_mean, periodic_mean_squares, plant_system

RECORD_ANGLE = 100.0  # rad that the slower of road and car turns in the record
SETTLED = 8.0  # times the slowest time constant before the record: e^-8 of a start at rest is left
REPORTS = 50  # intervals between two reports
DAMPING_NODES = 7  # of D, between which what theory expects is interpolated: to 1e-6 of it over the damper's whole range


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


class Driver(Protocol):
    """Who sets the damping ratio of cars, see `agents.evaluation.Predictor`; ``task`` tells the plant and what is observed."""

    task: Task

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        """(D, shape (n, 1), and state) for observations."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Driven:
    """Figures of independent lanes whose D a rule has set.

    Attributes:
        mean_squares: as told, shape (names, lanes).
        expected: what theory expects of them, likewise, or the same of every lane, shape (names,); None where it does not know.
        rates: what each identity leaves, which is zero on average, and the sum of its terms, shape (identities, lanes) each.
        power: mean of F_D times the relative velocity, shape (lanes,), in the units of `analysis.identities`.
    """

    mean_squares: FloatArray
    expected: FloatArray | None
    rates: tuple[FloatArray, FloatArray]
    power: FloatArray


class Switching:
    """Independent cars whose D a rule sets, at the substep that a task chooses by itself.

    Args:
        road: a road with a shaping filter.
        damping: the softest and the firmest level, 1.
        speed, car, lanes, seed: as for `drive`.
        control_interval: time between actions, s; 0.2/w1 by default.
        observation: signals that are observed; those of the task by default.

    Attributes:
        names: the mean squares that are finite.
        identities: what holds whatever the rule, see `analysis.identities`.
    """

    def __init__(
        self,
        road: Road,
        *,
        damping: tuple[float, float],
        speed: float,
        car: Car,
        lanes: int,
        seed: int,
        control_interval: float | None = None,
        observation: Sequence[str] | None = None,
        sensors: Sensors | None = None,
    ) -> None:
        if control_interval is None:
            control_interval = 0.2 / car.natural_frequency
        plain = make_task(road=road, speed=speed, damping_range=damping, car=car, control_interval=control_interval)
        self._ratio, bandwidth = float(plain.frequency_ratio(speed)), plain.bandwidth[0]
        road_filter = road.shaping_filter(bandwidth or None)
        assert road_filter is not None
        self.identities = identities(road_filter, car.motion.own, self._ratio)
        more = rows_of(self.identities)
        self._task = make_task(
            road=road,
            speed=speed,
            damping_range=damping,
            car=watched(car, more) if more else car,
            reward=plain.reward_by_name,
            observation=observation,
            control_interval=control_interval,
            sensors=sensors,
        )
        self._levels = np.array(damping, np.float32)
        self._interval = self._task.control_interval * car.natural_frequency
        nodes = -np.cos(np.pi * np.arange(DAMPING_NODES) / (DAMPING_NODES - 1))
        self._nodes = (damping[0] + damping[1]) / 2 + (damping[1] - damping[0]) / 2 * nodes
        self._systems = [plant_system(plain, node, self._ratio, bandwidth) for node in self._nodes.tolist()]
        self.names = [name for name in car.mean_squares if name not in self._systems[0].rough]
        self._rows = np.array([car.mean_squares.index(name) for name in self.names])
        self._units = plain.square_units[self._rows, None]
        self._watched = [self._task.car.mean_squares.index(name) for name in more]
        self._relative = car.mean_squares.index(car.motion.relative)
        self._plant = Plant(self._task, lanes)
        self._start = self._plant.start(lane_seeds(np.random.SeedSequence(seed), lanes))

    def _drive(self, choose: Callable[[int, Any], Any], report: Callable[[int, int], None] | None) -> Driven:
        """Drive by ``choose(step, observations)``, which answers with D; steps before the record have negative numbers."""
        skipped = math.ceil(SETTLED / (min(map(self._task.car.decay, self._levels.tolist())) * self._interval))
        measured = self.steps
        totals, power = np.zeros((len(self._task.reward), self._plant.num_envs)), np.zeros(self._plant.num_envs)
        seen = self._start.observations
        for step in range(-skipped, measured):
            damping = np.clip(np.broadcast_to(choose(step, seen), self._plant.num_envs), *self._levels).astype(np.float32)
            driven = self._plant.step(damping)
            seen = driven.observations
            if step >= 0:
                totals += driven.mean_squares
                power += 2 * driven.damping * driven.mean_squares[self._relative]
            if report and (step % REPORTS == 0 or step == measured - 1):
                report(skipped + step + 1, skipped + measured)
        squares, power = totals / measured, power / measured
        edges = np.cumsum([len(identity.rows) for identity in self.identities])
        parts = np.split(squares[self._watched], edges[:-1]) if len(edges) else []
        found = [each.left(part, power, self._ratio) for each, part in zip(self.identities, parts, strict=True)]
        shape = (len(found), self._plant.num_envs)
        rates = np.reshape([left for left, _ in found], shape), np.reshape([terms for _, terms in found], shape)
        return Driven(mean_squares=self._units * squares[self._rows], expected=None, rates=rates, power=power)

    @property
    def steps(self) -> int:
        """Intervals in the record, in which the car turns by `RECORD_ANGLE`."""
        return math.ceil(RECORD_ANGLE / self._interval)

    def alternate(self, report: Callable[[int, int], None] | None = None) -> Driven:
        """D firm and soft in turn, whose covariance is periodic and known."""
        expected = periodic_mean_squares([self._systems[-1], self._systems[0]], self._interval)
        driven = self._drive(lambda step, seen: self._levels[1 - step % 2], report)
        return dataclasses.replace(
            driven, expected=self._units[:, 0] * np.array([float(expected[name]) for name in self.names])
        )

    @property
    def knows_skyhook(self) -> bool:
        """Has the car what the skyhook rule takes?"""
        return {"velocity", "relative_velocity"} <= set(self._task.car.mean_squares)

    @property
    def knows_state(self) -> bool:
        """Is the state all that there is, and are its conditional moments known?"""
        return self._systems[0].flatness is not None and self._task.road.state_rows is not None

    def skyhook(self, report: Callable[[int, int], None] | None = None) -> Driven:
        """D firm where it brakes the body."""
        velocity, relative = (self._systems[0].signals[name] for name in ("velocity", "relative_velocity"))

        def choose(step: int, seen: Any) -> Any:
            state = self._state
            return np.where((velocity @ state) * (relative @ state) > 0, *self._levels[::-1])

        return self._by_state(choose, report)

    def follow(self, driver: Driver, report: Callable[[int, int], None] | None = None) -> Driven:
        """D as a driver sets it."""
        memory: list[Any] = [None, np.ones(self._plant.num_envs, np.bool_)]

        def choose(step: int, seen: Any) -> Any:
            damping, memory[0] = driver.predict(seen, memory[0], memory[1], deterministic=True)
            memory[1] = np.zeros(self._plant.num_envs, np.bool_)
            return np.asarray(damping)[:, 0]

        return self._by_state(choose, report)

    @property
    def _state(self) -> FloatArray:
        """Of car and road, shape (states, lanes)."""
        return np.concatenate([self._plant.car_states, self._plant.road_states]).astype(float)

    def _by_state(self, choose: Callable[[int, Any], Any], report: Callable[[int, int], None] | None) -> Driven:
        """`_drive`, and what theory expects of each interval, given the state in which it began.

        Whatever sets D, the mean of a square over an interval has a known mean, given the state at its beginning: a quadratic
        form, which is smooth in D and interpolated in it. What is expected of a lane is the average of that over the states in
        which its D was set.
        """
        if not self.knows_state:
            return self._drive(choose, report)
        size = len(self._systems[0].states)
        forms = np.empty((len(self._nodes), len(self.names), size * size + 1))
        for k, system in enumerate(self._systems):
            for n, name in enumerate(self.names):
                forms[k, n] = interval_mean(system, system.cost_form({name: 1.0}), self._interval)[1] / self._interval
        powers = np.linalg.inv(np.vander(self._nodes))  # from values at the nodes to coefficients, the highest power first
        coefficients = np.tensordot(powers, forms, 1)
        expected = np.zeros((len(self.names), self._plant.num_envs))

        def noted(step: int, seen: Any) -> Any:
            damping = np.clip(choose(step, seen), *self._levels).astype(np.float32)
            if step >= 0:
                state = self._state
                squares = (state[:, None] * state).reshape(size * size, -1)
                value = np.zeros_like(expected)
                for coefficient in coefficients:
                    value = value * damping + coefficient[:, :-1] @ squares + coefficient[:, -1:]
                expected[:] += value
            return damping

        driven = self._drive(noted, report)
        return dataclasses.replace(driven, expected=self._units * expected / self.steps)
