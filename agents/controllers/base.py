"""What every controller is, constant dampings, and what rules on the motion see of it."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from roadgym.parameters import ParameterError, number, number_array, shown, single_precision
from roadgym.task import OPERATING_POINT, Task

from ..theory import optimum

Observation = npt.NDArray[np.float32]
Damping = npt.NDArray[np.float32]


LARGEST_SIGNAL = 1e6  # of an observation, in standard deviations of the road; those of the environment saturate far below


def command_name(controller: Controller) -> str:
    """Its name in `agents.CONTROLLERS`, by which commands know it; that of its class where it has none there."""
    from . import CONTROLLERS  # which holds what is built upon this module

    made = type(controller)
    return next((name for name, known in CONTROLLERS.items() if known is made), made.__name__)


class Controller(abc.ABC):
    """A rule that sets the damping ratio from an observation of ``task``.

    Raises:
        ParameterError: the task does not observe a signal that the rule needs.
    """

    needs: tuple[str, ...] = ()
    full_knowledge: ClassVar[bool] = False  # is it a reference, which sees the plant itself and not what its sensors tell
    tried: ClassVar[Mapping[str, tuple[float, ...]]] = {}  # values among which `tuned` chooses, by the parameter's name

    def __init__(self, task: Task) -> None:
        for name in self.needs:
            if name not in task.signals:
                raise ParameterError(
                    f"{command_name(self)} needs the signal {name!r}; the task observes {', '.join(task.signals)}"
                )
        self.task = task

    @property
    def parameters(self) -> dict[str, float]:
        """The parameters that can be tuned, by name."""
        return {name: float(getattr(self, name)) for name in self.tried}

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
    """A rule on signals of the car's motion, `seen`, in road standard deviations and units of time 1/w1.

    They are worked out from the states of the car and the road; an acceleration is that which the softest damper would give, so
    that a rule does not depend on its own last answer.
    """

    seen: ClassVar[tuple[str, ...]] = ("velocity", "relative_velocity")

    def __init__(self, task: Task) -> None:
        motion = task.car.motion
        for name in self.seen:
            if name not in motion.signals:
                known = ", ".join(motion.signals)
                raise ParameterError(f"{command_name(self)} needs a car with the signal {name!r}; known: {known}")
        terms = dict.fromkeys(term for name in (*self.seen, motion.relative) for term in motion.signals[name].terms)
        own = [term for term in terms if term not in ("level_rate", "damper_force")]
        self.needs = (*own, *(("slope", "speed") if "level_rate" in terms else ()), *self.needs)
        super().__init__(task)

    def motion(self, signals: Mapping[str, Observation]) -> tuple[Observation, ...]:
        """The signals that are `seen`, in order; the level rises at the rate nu U."""
        motion, softest = self.task.car.motion, np.float32(2 * self.task.damping_range[0])

        def value(name: str) -> Observation:
            if name == "damper_force":
                return softest * total(motion.relative)
            if name == "level_rate":
                share = signals["speed"]
                return share / (1 - share) * signals["slope"]
            return signals[name]

        def total(name: str) -> Observation:
            return np.asarray(sum(np.float32(factor) * value(term) for term, factor in motion.signals[name].terms.items()))

        return tuple(map(total, self.seen))

    def on_off(self, firm: npt.NDArray[np.bool_]) -> npt.NDArray[np.float64]:
        """D_max where ``firm``, else D_min."""
        low, high = self.task.damping_range
        return np.where(firm, high, low)
