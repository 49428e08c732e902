"""Rules with a model: quadratic forms of the state, or tables, that are worked out once for each operating point."""

from __future__ import annotations

import abc
import itertools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import analysis
from analysis.quadratic import active_force, interval_forms, plant_system, value_form
from roadgym.cache import user_folder
from roadgym.parameters import ParameterError, within
from roadgym.task import OPERATING_POINT, Task

from ..advantage import has_advantage, state_of
from ..theory import optimum, road_at
from .base import Controller, Observation, command_name, observed_bandwidth, observed_speed
from .rules import SHARES


class Scheduled(Controller):
    """A rule with forms of the state of car and road, such as (Y, X, Z, U), worked out once for each operating point.

    Raises:
        ParameterError: a plant outside the model: noise on the speed, an ellipse, a road whose states are not observed, or a
            car with a weighting.
    """

    def __init__(self, task: Task) -> None:
        if not has_advantage(task):
            name, plant, road = command_name(self), f"a {task.road.kind} road", task.road.shaping_filter()
            if task.car.motion.filters:
                asked = ", ".join(task.car.motion.filters)
                raise ParameterError(f"{name} needs a car without a weighting, got one that tells {asked}")
            if task.speed_noise is not None:
                plant = f"{task.speed_noise.kind} speed noise"
            elif road is not None and road.flatness is None:
                plant = "an ellipse"
            raise ParameterError(
                f"{name} needs a gaussian or first-order road, or a multiplicative one on a circle, "
                f"at a constant speed; got {plant}"
            )
        self.state = state_of(task)
        self.needs = (*self.state, *(name for name in OPERATING_POINT if name == "speed" or task.bandwidth[1] > 0))
        super().__init__(task)
        self._forms: dict[tuple[float, float], Any] = {}

    @abc.abstractmethod
    def make_forms(self, ratio: float, bandwidth: float) -> Any:
        """What the rule needs at a frequency ratio nu and a bandwidth, 0 on a road without one."""

    @abc.abstractmethod
    def rule(self, forms: Any, state: npt.NDArray[np.float64], ratio: float) -> npt.NDArray[np.float64]:
        """Damping ratios, shape (n,), of states, shape (n, states)."""

    def damping(self, signals: Mapping[str, Observation]) -> npt.ArrayLike:
        """The rule, at each distinct operating point."""
        state = np.stack([signals[name] for name in self.state], axis=1).astype(float)
        ratio = self.task.frequency_ratio(observed_speed(signals, self.task))
        bandwidth = observed_bandwidth(signals) if "bandwidth" in self.needs else np.zeros_like(ratio)
        points = np.stack([ratio, bandwidth], axis=1)
        answer = np.empty(len(state))
        # neighbouring rows mostly share their operating point, so runs of equal rows are found instead of sorting all
        edges = np.flatnonzero(np.any(np.diff(points, axis=0) != 0, axis=1)) + 1
        for begin, end in itertools.pairwise([0, *edges.tolist(), len(state)]):
            key = float(points[begin, 0]), float(points[begin, 1])
            if key not in self._forms:
                self._forms[key] = self.make_forms(*key)
            answer[begin:end] = self.rule(self._forms[key], state[begin:end], key[0])
        return answer


class ClippedLinearQuadratic(Scheduled):
    """The best linear active force for the weights of the reward, as far as the damper can give it.

    The regulator sees the state of car and road; where the force enters a weighed signal itself, as it does the acceleration,
    its cost has a cross term.

    Source: the linear-quadratic regulator, clipped, as in H. E. Tseng and J. K. Hedrick, "Semi-active control laws - optimal
    and sub-optimal", Veh. Syst. Dyn. 23, 1994.
    """

    def make_forms(self, ratio: float, bandwidth: float) -> Any:
        """Feedback gain of the force, and the relative velocity, as rows of the state."""
        system = plant_system(self.task, 0.0, ratio, bandwidth)
        return active_force(self.task, ratio, bandwidth)[0], system.signals[self.task.car.motion.relative]

    def rule(self, forms: Any, state: npt.NDArray[np.float64], ratio: float) -> npt.NDArray[np.float64]:
        """D = force over twice the relative velocity, clipped to the range where the damper can only brake."""
        gain, row = forms
        force, relative = -state @ gain, state @ row
        return np.asarray(force * relative / (2 * np.maximum(relative**2, 1e-12)))


class OneStepLookahead(Scheduled):
    """The damping that is best for one control interval, if the best constant damping took over after it.

    Of a few damping ratios the one of least advantage (`agents.advantage`), a quadratic form of the state, wins: one exact step
    of policy improvement on the analytic optimum.

    Source: the rollout of D. P. Bertsekas, Dynamic Programming and Optimal Control, vol. 1, 2017, section 6.4.
    """

    choices = 9

    def make_forms(self, ratio: float, bandwidth: float) -> Any:
        """(dampings, forms of shape (choices, states, states), constants): what a few damping ratios cost."""
        dampings = np.linspace(*self.task.damping_range, self.choices)
        value = self.value(ratio, bandwidth)[None]
        forms, constants = interval_forms(self.task, value, dampings, [ratio], [bandwidth])
        return dampings, forms[0], constants[0]

    def value(self, ratio: float, bandwidth: float) -> npt.NDArray[np.float64]:
        """The quadratic form by which the end of the interval is judged."""
        speed = ratio * self.task.car.natural_frequency / self.task.road.wavenumber
        constant = float(optimum(self.task, speed, bandwidth).damping)
        return value_form(plant_system(self.task, constant, ratio, bandwidth), self.task.weights_by_name)[0]

    def rule(self, forms: Any, state: npt.NDArray[np.float64], ratio: float) -> npt.NDArray[np.float64]:
        """The damping of the least form."""
        dampings, quadratic, constants = forms
        costs = np.einsum("ni,kij,nj->nk", state, quadratic, state, optimize=True) + constants
        return np.asarray(dampings[np.argmin(costs, axis=1)])


class MixedLookahead(OneStepLookahead):
    """The damping that is best for one control interval, if what follows cost something between a constant and an active one.

    The end of the interval is judged by ``mixing`` times the value of the best active force and 1 - ``mixing`` times that of
    the best constant damping: what a damper can do lies between the two.

    Args:
        task: the task.
        mixing: the share of the active force's value.
    """

    tried = {"mixing": SHARES[:-1]}  # noqa: RUF012  (of the class, as its base declares)

    def __init__(self, task: Task, mixing: float = 0.5) -> None:
        super().__init__(task)
        self.mixing = within("mixing", mixing)

    def value(self, ratio: float, bandwidth: float) -> npt.NDArray[np.float64]:
        """The mixture."""
        return (1 - self.mixing) * super().value(ratio, bandwidth) + self.mixing * active_force(self.task, ratio, bandwidth)[1]


class OptimalFeedback(Scheduled):
    """The best state feedback at each operating point, by dynamic programming; see `analysis.optimal_feedback`.

    It is kept in the user's cache folder. With one mass each operating point takes some seconds the first time; with two, one
    serves all speeds and classes of road, and takes a minute or two.

    It is a reference of full knowledge: evaluations hand it the state itself, not what sensors tell of it. It knows no valve
    that is not ideal: behind one it is no longer the best.

    Attributes:
        report: called as ``report(what, done, in all)`` while a feedback is found, if it is set.

    Raises:
        ParameterError: a road or a speed noise for which there is no such feedback.
    """

    full_knowledge = True

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        analysis.feedback.check_plant(task.road, task.car, list(task.reward_by_name))
        self.report: Callable[[str, int, int], None] | None = None

    def make_forms(self, ratio: float, bandwidth: float) -> analysis.Feedback:
        """The feedback at this operating point."""
        task, report = self.task, self.report
        speed = ratio * task.speed_unit
        where = f"nu = {ratio:.3g}" if task.car.cost_unit is None else f"{speed:.3g} m/s"
        what = f"optimal feedback at {where}" + (f", delta = {bandwidth:.3g}" if bandwidth else "")
        return analysis.optimal_feedback(
            road_at(task, float(f"{bandwidth:.6g}")),
            # observed in single precision: six digits make neighbouring roundings one operating point, and one file
            speed=float(f"{ratio * task.car.natural_frequency / task.road.wavenumber:.6g}"),
            car=task.car,
            weights=task.reward_by_name,
            bounds=task.damping_range,
            control_interval=task.control_interval,
            cache=cache_folder(),
            report=None if report is None else lambda done, total: report(what, done, total),
        )

    def rule(self, forms: Any, state: npt.NDArray[np.float64], ratio: float) -> npt.NDArray[np.float64]:
        """Damping ratios, shape (n,), of states, shape (n, states)."""
        return np.asarray(forms.damping(state))


def cache_folder() -> Path | None:
    """Where feedbacks are kept: $XDG_CACHE_HOME/roadgym, by default ~/.cache/roadgym, or what the system has in its place."""
    return user_folder()
