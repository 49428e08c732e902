"""Driving controllers over the same noise, and what that costs, with standard errors."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from roadgym.parameters import ParameterError, non_negative, positive, whole
from roadgym.task import Task, make_task
from roadgym.vector import QuarterCarVectorEnv

from .training import stream_seed

FEWEST_EPISODES = 16  # a standard error from fewer is itself uncertain by more than a fifth


class Predictor(Protocol):
    """What is evaluated: anything with ``predict``."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        """(D, state) for observations."""


@dataclasses.dataclass(frozen=True)
class OperatingPoint:
    """A speed, m/s, and a bandwidth, 1; the bandwidth is 0 on a road without one."""

    speed: float
    bandwidth: float = 0.0


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Costs of one controller.

    Attributes:
        points: the operating points.
        costs: mean cost (minus the reward) of each episode, shape (points, episodes).
        switches: crossings of the middle of the damping range a second, shape (points,).
    """

    points: tuple[OperatingPoint, ...]
    costs: npt.NDArray[np.float64]
    switches: npt.NDArray[np.float64]

    @property
    def mean(self) -> npt.NDArray[np.float64]:
        """Mean cost at each point."""
        return np.asarray(self.costs.mean(axis=1))

    @property
    def standard_error(self) -> npt.NDArray[np.float64]:
        """Its standard error, from independent episodes."""
        return standard_error(self.costs)


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

    Args:
        controllers: by name.
        environment: parameters of `roadgym.vector.QuarterCarVectorEnv`.
        speeds, bandwidths: the grid of operating points, m/s and 1.
        episodes: independent episodes at each point.
        duration: measured time of an episode, s; 300/natural_frequency by default.
        transient: time discarded before it, s; by default 5/(D_min natural_frequency), after which what a start at rest leaves
            of the variance, exp(-2 D_min natural_frequency t) at most, is below 1e-4 of it.
        seed: fixes the roads; no road of one seed is met in training or under another seed.
        report: called as ``report(controller, steps done, steps in all)`` now and then.

    Raises:
        ParameterError: a parameter out of range, or too few or too short episodes for a standard error.
    """
    task = make_task(**environment)
    points = make_points(task, speeds, bandwidths)
    if whole("episodes", episodes) < FEWEST_EPISODES:
        raise ParameterError(f"episodes must be at least {FEWEST_EPISODES} to have a standard error, got {episodes}")
    w1 = task.car.natural_frequency
    lasts = 300 / w1 if duration is None else positive("duration", duration)
    skips = 5 / (task.damping_range[0] * w1) if transient is None else non_negative("transient", transient)
    measured, skipped = round(lasts / task.control_interval), round(skips / task.control_interval)
    if measured < 1:
        raise ParameterError(f"duration must be at least one control interval, {task.control_interval:g} s, got {duration:g}")

    number = episodes * len(points)
    envs = QuarterCarVectorEnv(number, max_episode_steps=None, **environment)
    options: dict[str, Any] = {"speed": np.repeat([point.speed for point in points], episodes)}
    if task.bandwidth[1] > 0:
        options["bandwidth"] = np.repeat([point.bandwidth for point in points], episodes)
    middle = np.float32(sum(task.damping_range) / 2)
    result = {}
    for name, controller in controllers.items():
        observations, _ = envs.reset(seed=stream_seed(seed, 1), options=options)
        total, switches = np.zeros(number), np.zeros(number)
        firm = np.zeros(number, np.bool_)
        state = None
        start = np.ones(number, np.bool_)
        for step in range(skipped + measured):
            damping, state = controller.predict(observations, state, start, deterministic=True)
            start = np.zeros(number, np.bool_)
            observations, rewards, _, _, _ = envs.step(damping)
            was_firm, firm = firm, damping[:, 0] > middle
            if step >= skipped:
                total -= rewards
                switches += firm != was_firm
            if report and (step % 50 == 49 or step == skipped + measured - 1):
                report(name, step + 1, skipped + measured)
        shape = (len(points), episodes)
        result[name] = Evaluation(
            points,
            (total / measured).reshape(shape),
            switches.reshape(shape).mean(axis=1) / (measured * task.control_interval),
        )
    return result
