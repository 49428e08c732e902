"""Controllers: all answer observations with damping ratios through ``predict``, as stable-baselines3's models do.

``predict(observation, state=None, episode_start=None, deterministic=True)`` returns (D, state), D of shape (n, 1), float32,
for observations of shape (n, signals); one observation of shape (signals,) gives D of shape (1,). Unlike a bare model's action,
which lies in [-1, 1], D is what the environment takes.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

import analysis
from roadgym.parameters import ParameterError
from roadgym.roads import Road
from roadgym.task import Task

Observation = npt.NDArray[np.float32]
Damping = npt.NDArray[np.float32]


class Controller(abc.ABC):
    """A rule that sets the damping ratio from an observation of ``task``.

    Raises:
        ParameterError: the task does not observe a signal that the rule needs.
    """

    needs: tuple[str, ...] = ()

    def __init__(self, task: Task) -> None:
        for name in self.needs:
            if name not in task.signals:
                raise ParameterError(
                    f"{type(self).__name__} needs the signal {name!r}; the task observes {', '.join(task.signals)}"
                )
        self.task = task

    @abc.abstractmethod
    def damping(self, signals: Mapping[str, Observation]) -> npt.ArrayLike:
        """Damping ratios, shape (n,), from signals by name, shape (n,) each, as observed."""

    def predict(
        self,
        observation: Observation,
        state: Any = None,
        episode_start: npt.NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[Damping, Any]:
        """(D, state); see the module's docstring. Every rule here is deterministic and keeps no state."""
        rows = np.atleast_2d(observation)
        if rows.shape[-1] != len(self.task.signals):
            raise ParameterError(f"observation must have {len(self.task.signals)} signals, got the shape {observation.shape}")
        damping = self.damping({name: rows[:, i] for i, name in enumerate(self.task.signals)})
        values = np.clip(np.broadcast_to(damping, len(rows)), *self.task.damping_range).astype(np.float32)[:, None]
        return values.reshape((*observation.shape[:-1], 1)), state


def observed_speed(signals: Mapping[str, Observation], task: Task) -> npt.NDArray[np.float64]:
    """Speed in m/s from its observation nu/(1 + nu)."""
    share = signals["speed"].astype(np.float64)
    result: npt.NDArray[np.float64] = share / (1 - share) * task.car.natural_frequency / task.road.wavenumber
    return result


def observed_bandwidth(signals: Mapping[str, Observation]) -> npt.NDArray[np.float64]:
    """Bandwidth from its observation 2 delta/(1 + 2 delta)."""
    share = signals["bandwidth"].astype(np.float64)
    return share / (1 - share) / 2


class ConstantDamping(Controller):
    """The same damping ratio always: a passive suspension."""

    def __init__(self, task: Task, damping: float) -> None:
        super().__init__(task)
        self.constant = damping

    def damping(self, signals: Mapping[str, Observation]) -> npt.ArrayLike:
        """The constant."""
        return self.constant


class AnalyticOptimum(Controller):
    """The best constant damping by theory at the observed operating point; see `analysis.optimal_damping`."""

    needs = ("speed",)

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        self._known: dict[tuple[float, float], float] = {}
        self._asked, self._answer = np.empty((2, 0)), np.empty(0)

    def damping(self, signals: Mapping[str, Observation]) -> npt.ArrayLike:
        """The optimum, found once for each distinct operating point."""
        speed = observed_speed(signals, self.task)
        bandwidth = observed_bandwidth(signals) if "bandwidth" in signals else np.zeros(len(speed))
        asked = np.stack([speed, bandwidth])
        if not np.array_equal(asked, self._asked):  # within an episode the operating point stays
            self._asked = asked
            self._answer = np.array([self._optimum(v, b) for v, b in asked.T.tolist()])
        return self._answer

    def _optimum(self, speed: float, bandwidth: float) -> float:
        if (speed, bandwidth) not in self._known:
            self._known[speed, bandwidth] = float(optimum(self.task, speed, bandwidth).damping)
        return self._known[speed, bandwidth]


def road_at(task: Task, bandwidth: float) -> Road:
    """The task's road at ``bandwidth``, or as it is where it has none (0)."""
    return task.road.with_bandwidth(bandwidth) if bandwidth else task.road


def optimum(task: Task, speed: float, bandwidth: float) -> analysis.Optimum:
    """Best constant damping of ``task`` by theory at an operating point (m/s, 1; bandwidth 0 where there is none)."""
    return analysis.optimal_damping(
        road_at(task, bandwidth),
        task.speed_noise,
        speed=speed,
        natural_frequency=task.car.natural_frequency,
        weights=task.weights_by_name,
        bounds=task.damping_range,
    )


def theoretical_cost(task: Task, damping: float, speed: float, bandwidth: float) -> float:
    """Minus the mean reward of a constant damping by theory: the weighted mean squares over E Z^2."""
    squares = analysis.mean_squares(
        road_at(task, bandwidth),
        task.speed_noise,
        damping=damping,
        speed=speed,
        natural_frequency=task.car.natural_frequency,
    )
    total = sum(weight * float(getattr(squares, name)) for name, weight in task.weights_by_name.items())
    return total / task.road.variance


class SkyhookOnOff(Controller):
    """D_max where the damper would brake the body, Y' (Y' - Z') > 0, else D_min.

    Source: D. Karnopp, M. J. Crosby and R. A. Harwood, "Vibration control using semi-active force generators",
    J. Eng. Ind. 96, 1974, in its on-off form.
    """

    needs = ("velocity", "slope", "speed")

    def damping(self, signals: Mapping[str, Observation]) -> npt.ArrayLike:
        """The rule, with Z'/w1 = nu U."""
        share = signals["speed"]
        relative = signals["velocity"] - share / (1 - share) * signals["slope"]
        low, high = self.task.damping_range
        return np.where(signals["velocity"] * relative > 0, high, low)


CONTROLLERS: dict[str, Callable[[Task], Controller]] = {
    "analytic_optimum": AnalyticOptimum,
    "d_min": lambda task: ConstantDamping(task, task.damping_range[0]),
    "d_max": lambda task: ConstantDamping(task, task.damping_range[1]),
    "skyhook": SkyhookOnOff,
}


def make_controller(name: str, task: Task) -> Controller:
    """A controller by its name in `CONTROLLERS`.

    Raises:
        ParameterError: an unknown name, or signals that the task does not observe.
    """
    if name not in CONTROLLERS:
        raise ParameterError(f"unknown controller {name!r}; known: {', '.join(CONTROLLERS)}")
    return CONTROLLERS[name](task)
