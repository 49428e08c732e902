"""Driving controllers over the same noise, and what that costs, with standard errors.

Constant dampings on the same roads, whose costs theory knows, serve as control variates, and on rough roads balances that hold
under every rule: see `analysis.control_variates`.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from analysis.control_variates import adjust, balances, control_dampings, expected_squares, least_transient
from analysis.identities import rows_of, watched
from roadgym.parameters import ParameterError, non_negative, positive, whole
from roadgym.task import Task, make_task
from roadgym.vector import QuarterCarVectorEnv

from .actions import damping_reader
from .names import title
from .records import Purpose, stream_seed

FEWEST_EPISODES = 16  # a standard error from fewer is itself uncertain by more than a fifth


class Predictor(Protocol):
    """What is evaluated: anything with ``predict``.

    Where it has an attribute ``task``, it is handed the signals that its task observes, else those of the environment. Where it
    has an ``action_space``, as the models of stable-baselines3 have, its answers are mapped onto damping ratios; see
    `agents.actions.damping_reader`. Where it has ``full_knowledge``, and that is true, it sees through no sensors: it is a
    reference for those that do.
    """

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        """(D, or the action that stands for it, and state) for observations."""


@dataclasses.dataclass(frozen=True)
class OperatingPoint:
    """A speed, m/s, and a bandwidth, 1; the bandwidth is 0 on a road without one."""

    speed: float
    bandwidth: float = 0.0


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Costs of one controller, as driven and adjusted by control variates.

    Adjusted values have the same expectation and less noise. Those of two controllers may be subtracted episode by episode, as
    the driven ones may.

    Attributes:
        points: the operating points.
        costs: mean cost (minus the reward) of each episode as driven, shape (points, episodes).
        squares: mean squares of each episode as driven, as told over the task's `cost_unit`: over E Z^2, or SI; in the order of
            ``names``, shape (squares, points, episodes).
        names: of the mean squares: those of `roadgym.cars.Car.mean_squares`, and of two masses weighted_acceleration too.
        switches: crossings of the middle of the damping range a second, shape (points,).
        adjusted_costs, adjusted_squares: the same less what the control variates tell of each road's luck.
        control_variates: the constant damping ratios that served, 1; empty where nothing is adjusted.
        balances: names of the identities that served, see `analysis.identities`.
    """

    points: tuple[OperatingPoint, ...]
    costs: npt.NDArray[np.float64]
    squares: npt.NDArray[np.float64]
    names: tuple[str, ...]
    switches: npt.NDArray[np.float64]
    adjusted_costs: npt.NDArray[np.float64]
    adjusted_squares: npt.NDArray[np.float64]
    control_variates: tuple[float, ...] = ()
    balances: tuple[str, ...] = ()

    @property
    def mean(self) -> npt.NDArray[np.float64]:
        """Mean cost at each point, from the adjusted costs."""
        return np.asarray(self.adjusted_costs.mean(axis=1))

    @property
    def standard_error(self) -> npt.NDArray[np.float64]:
        """Its standard error, from independent episodes."""
        return standard_error(self.adjusted_costs)

    @property
    def mean_squares(self) -> npt.NDArray[np.float64]:
        """Mean of the adjusted squares, shape (squares, points)."""
        return np.asarray(self.adjusted_squares.mean(axis=-1))

    @property
    def degrees_of_freedom(self) -> int:
        """Those of the standard error: the episodes less the mean and the coefficients of the control variates."""
        episodes: int = self.costs.shape[1]
        return episodes - 1 - len(self.control_variates) - len(self.balances)


@dataclasses.dataclass(frozen=True)
class _Constant:
    """The same damping ratio always, whatever is observed."""

    constant: float

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        return np.full((len(observation), 1), self.constant, np.float32), state


def standard_error(samples: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Standard error of the mean over the last axis, whose entries are independent."""
    return np.asarray(samples.std(axis=-1, ddof=1) / np.sqrt(samples.shape[-1]))


def make_points(task: Task, speeds: Sequence[float], bandwidths: Sequence[float]) -> tuple[OperatingPoint, ...]:
    """Every pair of a speed and a bandwidth, or the speeds alone on a road without bandwidth.

    Raises:
        ParameterError: a value outside the task's range.
    """
    chosen = {"speed": list(speeds), "bandwidth": list(bandwidths) if task.bandwidth[1] > 0 else [0.0]}
    for name, values in chosen.items():
        low, high = getattr(task, name)
        for value in values:
            if not low <= value <= high:
                raise ParameterError(f"{name} must lie within the environment's range [{low:g}, {high:g}], got {value:g}")
        if not values:
            raise ParameterError(f"at least one {name} is needed")
    return tuple(OperatingPoint(v, b) for v in chosen["speed"] for b in chosen["bandwidth"])


def evaluated_task(environment: Mapping[str, Any]) -> Task:
    """The task of an environment whose car tells what evaluations want to know too, `roadgym.cars.Car.evaluated`."""
    car = make_task(**environment).car
    return make_task(**{**environment, "car": car.with_signals(car.evaluated), "natural_frequency": None})


def observed_by(controller: Predictor, task: Task) -> tuple[str, ...]:
    """The signals that a controller is handed: those that its own task observes, or else those of ``task``."""
    own: Task = getattr(controller, "task", task)
    return own.signals


def through_sensors(controller: Predictor, environment: Mapping[str, Any]) -> dict[str, Any]:
    """The environment as a controller sees it: without its sensors, for a reference of full knowledge."""
    return {**environment, "sensors": None} if getattr(controller, "full_knowledge", False) else dict(environment)


def in_units_of(own: Task, here: Task) -> Callable[[npt.NDArray[np.float32]], npt.NDArray[np.float32]]:
    """What takes observations of the signals of ``own``, made on the plant of ``here``, to what they are on its own plant.

    Observations are in standard deviations of the road and in terms of its wavenumber; another road has others.
    """
    names = own.signals

    def scales(task: Task) -> npt.NDArray[np.float64]:
        factors = dict(zip(task.car.mean_squares, np.sqrt(task.square_units).tolist(), strict=True))
        known = factors | {"level": math.sqrt(task.road.variance), "bandwidth": 1.0, "speed": task.speed_unit}
        known["slope"] = known["level"] * task.road.wavenumber
        return np.array([known.get(name, known["level"]) for name in names])

    factors = (scales(here) / scales(own)).astype(np.float32)
    speed = names.index("speed") if "speed" in names else None

    def translated(observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        found = observations * factors
        if speed is not None:
            ratio = factors[speed] * observations[:, speed] / (1 - observations[:, speed])
            found[:, speed] = ratio / (1 + ratio)
        return found

    return (lambda observations: observations) if np.all(factors == 1) else translated


def answers(controller: Predictor, task: Task) -> Callable[..., tuple[npt.NDArray[np.float32], Any]]:
    """The controller's ``predict``, whose answers are damping ratios in the range of ``task``; any other raises in use.

    Raises:
        ParameterError: an action space that cannot be mapped onto the range, or an observation space of other observations.
    """
    handed, space = observed_by(controller, task), getattr(controller, "observation_space", None)
    if space is not None and space.shape != (len(handed),):
        raise ParameterError(
            f"observation_space must have the shape ({len(handed)},) of {', '.join(handed)}, got {space.shape}: "
            "train with agents.train, or wrap predict so that it makes what the model sees of them"
        )
    read = damping_reader(getattr(controller, "action_space", None), task.damping_range)

    def predict(*arguments: Any, **named: Any) -> tuple[npt.NDArray[np.float32], Any]:
        action, state = controller.predict(*arguments, **named)
        return read(action), state

    return predict


def drive(
    controller: Predictor, envs: QuarterCarVectorEnv, seed: int, options: Mapping[str, Any], task: Task | None = None
) -> Iterator[tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[Any], dict[str, Any]]]:
    """Drive on and on after a reset, handing the controller what it observes of the signals of ``envs``.

    One without a task of its own observes the signals of ``task``, by default all of them. One whose task is on another road
    is handed them in terms of that road (`in_units_of`).

    Yields:
        Observations before the step, damping ratios, rewards and infos of each step.
    """
    column = {signal: i for i, signal in enumerate(envs.task.signals)}
    columns = [column[signal] for signal in observed_by(controller, task or envs.task)]
    observations, _ = envs.reset(seed=seed, options=dict(options))
    state, start = None, np.ones(envs.num_envs, np.bool_)
    predict = answers(controller, task or envs.task)
    translated = in_units_of(getattr(controller, "task", envs.task), envs.task)
    while True:
        damping, state = predict(translated(observations[:, columns]), state, start, deterministic=True)
        start = np.zeros(envs.num_envs, np.bool_)
        before = observations
        observations, rewards, _, _, infos = envs.step(damping)
        yield before, damping, rewards, infos


def evaluate(
    controllers: Mapping[str, Predictor],
    *,
    environment: Mapping[str, Any],
    speeds: Sequence[float],
    bandwidths: Sequence[float] = (),
    episodes: int = 256,
    duration: float | None = None,
    transient: float | None = None,
    seed: int = 0,
    report: Callable[[str, int, int], None] | None = None,
) -> dict[str, Evaluation]:
    """Drive each controller over the same roads at every operating point.

    Where theory is exact, constant dampings inside the damping range are driven too, and serve as control variates. All see the
    environment through its sensors, but those of full knowledge, such as the optimal feedback.

    Args:
        controllers: by name.
        environment: parameters of `roadgym.vector.QuarterCarVectorEnv`.
        speeds, bandwidths: the grid of operating points, m/s and 1.
        episodes: independent episodes at each point.
        duration: measured time of an episode, s; 300/natural_frequency by default.
        transient: time discarded before it, s; by default 5/(D_min natural_frequency), twice that on harmonic roads, and in a
            narrow range of dampings as much more as lets constant ones serve as control variates. A start at rest leaves a
            share exp(-2 D t) of the variance, and exp(-D t) where the road remembers its own start. Of the mean cost it is
            below 1e-4, even at D_min all the time, but for second-order roads with bandwidth times frequency ratio below 0.025.
        seed: fixes the roads; no road of one seed is met in training or under another seed.
        report: called as ``report(what, steps done, steps in all)`` now and then.

    Raises:
        ParameterError: a parameter out of range, or too few or too short episodes for a standard error.
    """
    task = evaluated_task(environment)
    environment = {**environment, "car": task.car, "natural_frequency": None}
    points = make_points(task, speeds, bandwidths)
    if whole("episodes", episodes) < FEWEST_EPISODES:
        raise ParameterError(f"episodes must be at least {FEWEST_EPISODES} to have a standard error, got {episodes}")
    w1 = task.car.natural_frequency
    lasts = 300 / w1 if duration is None else positive("duration", duration)
    # what has no noise remembers its start as long as the car does
    repeats = task.road.lines is not None or task.road.periodic is not None
    slowest = min(car.decay(firmer * end) * car.natural_frequency for car, firmer in task.cars for end in task.damping_range)
    forgotten = (10 if repeats else 5) / slowest
    skips = max(forgotten, least_transient(task)) if transient is None else non_negative("transient", transient)
    measured, skipped = round(lasts / task.control_interval), round(skips / task.control_interval)
    if measured < 1:
        raise ParameterError(f"duration must be at least one control interval, {task.control_interval:g} s, got {duration:g}")

    number = episodes * len(points)
    everyone = (*controllers.values(), _Constant(math.nan))  # that of the control variates, which is handed those of the task
    observed = dict.fromkeys(signal for controller in everyone for signal in observed_by(controller, task))
    constants = control_dampings(task, skipped * task.control_interval, episodes)
    # balances need as long a start to be forgotten, and a damping that keeps its value in each interval
    steady = bool(constants) and task.holds_damping
    known = balances(task, len(constants), episodes) if steady else []
    more = rows_of(known)
    plant = {**environment, "observation": list(observed), "reward": task.reward_by_name}
    if more:
        plant = {name: value for name, value in plant.items() if name != "natural_frequency"} | {"car": watched(task.car, more)}

    @functools.cache
    def batch(sensors: bool) -> QuarterCarVectorEnv:
        return QuarterCarVectorEnv(number, max_episode_steps=None, **(plant if sensors else {**plant, "sensors": None}))

    for controller in controllers.values():
        answers(controller, task)  # what cannot drive is told at once
    options: dict[str, Any] = {"speed": np.repeat([point.speed for point in points], episodes)}
    if task.bandwidth[1] > 0:
        options["bandwidth"] = np.repeat([point.bandwidth for point in points], episodes)
    middle = np.float32(sum(task.damping_range) / 2)
    shape, names = (len(points), episodes), (*task.car.mean_squares, *more)
    relative = names.index(task.car.motion.relative)
    ratios = np.array([task.frequency_ratio(point.speed) for point in points])[:, None]

    def driven(name: str, controller: Predictor) -> tuple[npt.NDArray[np.float64], ...]:
        """Costs, squares and switches, as of `Evaluation`, with what `more` are of; and the power of the damper."""
        turn = next(turns)
        total, squares, switches = np.zeros(number), np.zeros((len(names), number)), np.zeros(number)
        power = np.zeros(number)
        firm = np.zeros(number, np.bool_)
        envs = batch(through_sensors(controller, plant).get("sensors") is not None)
        steps = drive(controller, envs, stream_seed(seed, Purpose.EVALUATION), options, task)
        for step, (_, damping, rewards, infos) in enumerate(itertools.islice(steps, skipped + measured)):
            was_firm, firm = firm, damping[:, 0] > middle
            if step >= skipped:
                total -= rewards
                for square, signal in zip(squares, names, strict=True):
                    square += infos[signal]
                power += 2 * infos["damping"] * infos[names[relative]]
                switches += firm != was_firm
            if report and (step % 50 == 49 or step == skipped + measured - 1):
                report(f"driving {turn} of {len(constants) + len(controllers)}: {title(name)}", step + 1, skipped + measured)
        return (
            (total / measured).reshape(shape),
            (squares / (measured * task.cost_unit)).reshape(-1, *shape),
            switches.reshape(shape).mean(axis=1) / (measured * task.control_interval),
            (power / (measured * task.square_units[relative])).reshape(shape),
        )

    turns, own, edges = itertools.count(1), len(task.reward), np.cumsum([0, *(len(each.rows) for each in known)])
    controls = [driven(f"constant D = {damping:.2g}", _Constant(damping))[1][:own] for damping in constants]
    expected = np.empty((len(points), own, len(constants)))
    for k, point in enumerate(points) if constants else ():
        expected[k] = expected_squares(task, constants, point.speed, point.bandwidth)
    result = {}
    for name, controller in controllers.items():
        costs, squares, switches, power = driven(name, controller)
        watch = squares[own:] * (task.cost_unit / task.road.variance)
        found = [
            each.left(watch[low:high], power, ratios)
            for each, (low, high) in zip(known, itertools.pairwise(edges), strict=True)
        ]
        squares = squares[:own]
        adjusted_costs, adjusted_squares = costs.copy(), squares.copy()
        for (k, n), _ in np.ndenumerate(np.empty((len(points), own))):
            if constants and np.isfinite(expected[k, n]).all() and np.isfinite(squares[n, k]).all():
                means, sizes = np.append(expected[k, n], np.zeros(len(known))), [terms[k].mean() for _, terms in found]
                variates = [*(control[n, k] for control in controls), *(left[k] for left, _ in found)]
                adjusted_squares[n, k] = adjust(squares[n, k], np.array(variates), means, np.append(expected[k, n], sizes))
                adjusted_costs[k] += task.reward[n] * (adjusted_squares[n, k] - squares[n, k])
        served = tuple(each.name for each in known)
        result[name] = Evaluation(
            points, costs, squares, names[:own], switches, adjusted_costs, adjusted_squares, constants, served
        )
    return result
