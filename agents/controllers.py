"""Controllers: all answer observations with damping ratios through ``predict``, as stable-baselines3's models do.

``predict(observation, state=None, episode_start=None, deterministic=True)`` returns (D, state), D of shape (n, 1), float32,
for observations of shape (n, signals); one observation of shape (signals,) gives D of shape (1,). Unlike a bare model's action,
which lies in [-1, 1], D is what the environment takes.

The rules act on the body's velocity, the relative velocity and the travel, as the car defines them: with one mass those are
Y', Y' - Z' and Y - Z. Two ideas of the literature are left out, since that car has nothing for them to act on: groundhook damps
the motion of the wheel, which there follows the road; and road holding is judged by the load of the tyre, which has no
deflection.
"""

from __future__ import annotations

import abc
import itertools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import analysis
from analysis.quadratic import plant_system, regulator_gain
from roadgym.cache import user_folder
from roadgym.parameters import ParameterError, number, number_array, shown, single_precision
from roadgym.task import OPERATING_POINT, Task

from .advantage import STATE, advantage_forms, has_advantage
from .theory import optimum as optimum
from .theory import road_at as road_at
from .theory import theoretical_cost as theoretical_cost

Observation = npt.NDArray[np.float32]
Damping = npt.NDArray[np.float32]


LARGEST_SIGNAL = 1e6  # of an observation, in standard deviations of the road; those of the environment saturate far below


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
        """(D, state); see the module's docstring. Every rule here is deterministic and keeps no state.

        Raises:
            ParameterError: an observation of another shape, or with numbers that no observation has.
        """
        observation = self._checked(observation)
        rows = np.atleast_2d(observation)
        damping = self.damping({name: rows[:, i] for i, name in enumerate(self.task.signals)})
        values = np.clip(np.broadcast_to(damping, len(rows)), *self.task.damping_range).astype(np.float32)[:, None]
        return values.reshape((*observation.shape[:-1], 1)), state

    def _checked(self, observation: Any) -> Observation:
        """The observation as float32, shape (signals,) or (n, signals)."""
        array = observation if isinstance(observation, np.ndarray) else number_array("observation", observation)
        names = self.task.signals
        if array.ndim not in (1, 2) or array.shape[-1] != len(names):
            raise ParameterError(f"observation must have {len(names)} signals, got the shape {array.shape}")
        result = single_precision("observation", array, array.shape)
        if not np.all(np.abs(result) <= LARGEST_SIGNAL):
            raise ParameterError(f"observation must be of finite numbers up to {LARGEST_SIGNAL:g}, got {shown(observation)}")
        for name in OPERATING_POINT:
            if name in names:
                share = result[..., names.index(name)]
                if not np.all((share >= 0) & (share < 1)):
                    raise ParameterError(f"observation must have {name} from 0 to below 1, got {shown(observation)}")
        return result


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
        self.constant = number("damping", damping)  # it saturates at the range

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


class SemiActive(Controller):
    """A rule on the body's and the suspension's motion, in road standard deviations and units of time 1/w1.

    It is worked out from the states of the car and the road, in the terms of the car's own signals.
    """

    seen = ("velocity", "relative_velocity", "travel")

    def __init__(self, task: Task) -> None:
        known = task.car.motion.signals
        for name in self.seen:
            if name not in known:
                raise ParameterError(f"{type(self).__name__} needs a car with the signal {name!r}; known: {', '.join(known)}")
        terms = dict.fromkeys(term for name in self.seen for term in known[name].terms)
        own = [term for term in terms if term != "level_rate"]
        self.needs = (*own, *(("slope", "speed") if "level_rate" in terms else ()), *self.needs)
        super().__init__(task)

    def motion(self, signals: Mapping[str, Observation]) -> tuple[Observation, Observation, Observation]:
        """Velocity of the body, relative velocity and travel; the level rises at the rate nu U."""

        def value(name: str) -> Observation:
            if name == "level_rate":
                share = signals["speed"]
                return share / (1 - share) * signals["slope"]
            return signals[name]

        def total(name: str) -> Observation:
            terms = self.task.car.motion.signals[name].terms.items()
            return np.asarray(sum(np.float32(factor) * value(term) for term, factor in terms))

        velocity, relative, travel = map(total, self.seen)
        return velocity, relative, travel

    def soft_acceleration(self, relative: Observation, travel: Observation) -> Observation:
        """Acceleration that the softest damper would give the body."""
        return -2 * np.float32(self.task.damping_range[0]) * relative - travel

    def on_off(self, firm: npt.NDArray[np.bool_]) -> npt.NDArray[np.float64]:
        """D_max where ``firm``, else D_min."""
        low, high = self.task.damping_range
        return np.where(firm, high, low)


class SkyhookOnOff(SemiActive):
    """D_max where the damper would brake the body, Y' (Y' - Z') > 0, else D_min.

    Source: D. Karnopp, M. J. Crosby and R. A. Harwood, "Vibration control using semi-active force generators",
    J. Eng. Ind. 96, 1974, in its on-off form.
    """

    def damping(self, signals: Mapping[str, Observation]) -> npt.ArrayLike:
        """The rule."""
        velocity, relative, _ = self.motion(signals)
        return self.on_off(velocity * relative > 0)


class SkyhookContinuous(SemiActive):
    """The force of a damper D_max between the body and the sky, 2 D_max Y', as far as the damper can give it.

    Source: Karnopp, Crosby and Harwood (1974), as for `SkyhookOnOff`.
    """

    def damping(self, signals: Mapping[str, Observation]) -> npt.ArrayLike:
        """D = D_max Y'/(Y' - Z'), clipped to the range."""
        velocity, relative, _ = self.motion(signals)
        return self.task.damping_range[1] * velocity * relative / np.maximum(relative**2, np.float32(1e-12))


class AccelerationDrivenDamper(SemiActive):
    """ADD: D_max where the damper would reduce the body's acceleration, Y'' (Y' - Z') > 0, else D_min.

    Y'' is what the softest damper would give, so that the rule does not depend on its own last answer.

    Source: S. M. Savaresi, E. Silani and S. Bittanti, "Acceleration-driven-damper (ADD): an optimal control algorithm for
    comfort-oriented semiactive suspensions", J. Dyn. Syst. Meas. Control 127, 2005.
    """

    def damping(self, signals: Mapping[str, Observation]) -> npt.ArrayLike:
        """The rule."""
        _, relative, travel = self.motion(signals)
        return self.on_off(self.soft_acceleration(relative, travel) * relative > 0)


class MixedSkyhookADD(SemiActive):
    """Skyhook where the body moves slowly, Y''^2 <= 2 w1^2 Y'^2, and ADD where it moves fast.

    The crossover, sqrt(2) w1, is the frequency at which no damping amplifies or reduces the road.

    Source: S. M. Savaresi and C. Spelta, "Mixed sky-hook and ADD: approaching the filtering limits of a semi-active
    suspension", J. Dyn. Syst. Meas. Control 129, 2007.
    """

    def damping(self, signals: Mapping[str, Observation]) -> npt.ArrayLike:
        """The rule."""
        velocity, relative, travel = self.motion(signals)
        acceleration = self.soft_acceleration(relative, travel)
        slow = acceleration**2 <= 2 * velocity**2
        return self.on_off(np.where(slow, velocity, acceleration) * relative > 0)


class LeastAcceleration(SemiActive):
    """The damping that makes |Y''| least at this instant: 2 D (Y' - Z') = -(Y - Z) where the range allows it."""

    def damping(self, signals: Mapping[str, Observation]) -> npt.ArrayLike:
        """D = -(Y - Z)/(2 (Y' - Z')), clipped to the range."""
        _, relative, travel = self.motion(signals)
        return np.asarray(-travel * relative / (2 * np.maximum(relative**2, np.float32(1e-12))))


class Scheduled(SemiActive):
    """A rule with quadratic forms of the state (Y, X, Z, U) that are worked out once for each operating point.

    Raises:
        ParameterError: a plant outside the model of the forms: noise on the speed, an ellipse, or a road of one's own.
    """

    needs = (*STATE, "speed", "bandwidth")

    def __init__(self, task: Task) -> None:
        if not has_advantage(task):
            what = "an ellipse" if task.speed_noise is None else f"{task.speed_noise.kind} speed noise"
            plant = what if task.road.shaping_filter() is not None else f"a {task.road.kind} road"
            if not task.car.motion.is_one_mass:
                plant = f"a {task.car.kind} car"
            raise ParameterError(
                f"{type(self).__name__} needs a car of one mass, on a gaussian road, or multiplicative on a circle, at a "
                f"constant speed; got {plant}"
            )
        super().__init__(task)
        self._forms: dict[tuple[float, float], Any] = {}

    @abc.abstractmethod
    def make_forms(self, ratio: float, bandwidth: float) -> Any:
        """What the rule needs at a frequency ratio nu and a bandwidth."""

    @abc.abstractmethod
    def rule(self, forms: Any, state: npt.NDArray[np.float64], ratio: float) -> npt.NDArray[np.float64]:
        """Damping ratios, shape (n,), of states, shape (n, 4)."""

    def damping(self, signals: Mapping[str, Observation]) -> npt.ArrayLike:
        """The rule, at each distinct operating point."""
        state = np.stack([signals[name] for name in STATE], axis=1).astype(float)
        ratio = self.task.frequency_ratio(observed_speed(signals, self.task))
        points = np.stack([ratio, observed_bandwidth(signals)], axis=1)
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

    The regulator sees the road's state, and pays for its force with a hundredth of its mean square, without which the force
    for displacement alone has no optimum.

    Source: the linear-quadratic regulator, clipped, as in H. E. Tseng and J. K. Hedrick, "Semi-active control laws - optimal
    and sub-optimal", Veh. Syst. Dyn. 23, 1994.
    """

    price = 0.01

    def make_forms(self, ratio: float, bandwidth: float) -> npt.NDArray[np.float64]:
        """Feedback gain of the force on (Y, X, Z, U)."""
        return regulator_gain(plant_system(self.task, 0.0, ratio, bandwidth), self.task.weights_by_name, self.price)

    def rule(self, forms: Any, state: npt.NDArray[np.float64], ratio: float) -> npt.NDArray[np.float64]:
        """D = force/(2 (Y' - Z')), clipped to the range where the damper can only brake."""
        force = -state @ forms
        relative = state[:, 1] - ratio * state[:, 3]
        return np.asarray(force * relative / (2 * np.maximum(relative**2, 1e-12)))


class OneStepLookahead(Scheduled):
    """The damping that is best for one control interval, if the best constant damping took over after it.

    Of a few damping ratios the one of least advantage (`agents.advantage`), a quadratic form of the state, wins: one exact step
    of policy improvement on the analytic optimum.

    Source: the rollout of D. P. Bertsekas, Dynamic Programming and Optimal Control, vol. 1, 2017, section 6.4.
    """

    choices = 9

    def make_forms(self, ratio: float, bandwidth: float) -> Any:
        """(dampings, forms of shape (choices, 4, 4), constants): advantages of a few damping ratios."""
        speed = ratio * self.task.car.natural_frequency / self.task.road.wavenumber
        constant = float(optimum(self.task, speed, bandwidth).damping)
        dampings = np.linspace(*self.task.damping_range, self.choices)
        forms, constants = advantage_forms(self.task, dampings, [constant], [ratio], [bandwidth])
        return dampings, forms[0], constants[0]

    def rule(self, forms: Any, state: npt.NDArray[np.float64], ratio: float) -> npt.NDArray[np.float64]:
        """The damping of the least form."""
        dampings, quadratic, constants = forms
        costs = np.einsum("ni,kij,nj->nk", state, quadratic, state, optimize=True) + constants
        return np.asarray(dampings[np.argmin(costs, axis=1)])


class OptimalFeedback(Scheduled):
    """The best state feedback at each operating point, by dynamic programming; see `analysis.optimal_feedback`.

    Each operating point takes some seconds the first time, and is kept in the user's cache folder.

    Attributes:
        report: called as ``report(what, done, in all)`` while a feedback is found, if it is set.

    Raises:
        ParameterError: a road or a speed noise for which there is no such feedback.
    """

    def __init__(self, task: Task) -> None:
        super().__init__(task)
        analysis.feedback.check_road(task.road)
        analysis.feedback.check_car(task.car)
        if task.speed_noise is not None:
            raise ParameterError(f"optimal_feedback needs a constant speed, got {task.speed_noise.kind} speed noise")
        self.report: Callable[[str, int, int], None] | None = None

    def make_forms(self, ratio: float, bandwidth: float) -> analysis.OptimalFeedback:
        """The feedback at this operating point."""
        task, report = self.task, self.report
        what = f"optimal feedback at nu = {ratio:.3g}, delta = {bandwidth:.3g}"
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
        """Damping ratios, shape (n,), of states, shape (n, 4)."""
        return np.asarray(forms.damping(state))


def cache_folder() -> Path | None:
    """Where feedbacks are kept: $XDG_CACHE_HOME/roadgym, by default ~/.cache/roadgym, or what the system has in its place."""
    return user_folder()


CONTROLLERS: dict[str, Callable[[Task], Controller]] = {
    "analytic_optimum": AnalyticOptimum,
    "d_min": lambda task: ConstantDamping(task, task.damping_range[0]),
    "d_max": lambda task: ConstantDamping(task, task.damping_range[1]),
    "skyhook": SkyhookOnOff,
    "skyhook_continuous": SkyhookContinuous,
    "add": AccelerationDrivenDamper,
    "mixed_skyhook_add": MixedSkyhookADD,
    "least_acceleration": LeastAcceleration,
    "clipped_lqr": ClippedLinearQuadratic,
    "one_step_lookahead": OneStepLookahead,
    "optimal_feedback": OptimalFeedback,
}


def make_controller(name: str, task: Task) -> Controller:
    """A controller by its name in `CONTROLLERS`.

    Raises:
        ParameterError: an unknown name, or signals that the task does not observe.
    """
    if not isinstance(name, str) or name not in CONTROLLERS:
        raise ParameterError(f"unknown controller {shown(name)}; known: {', '.join(CONTROLLERS)}")
    return CONTROLLERS[name](task)
