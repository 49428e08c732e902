"""Controllers: all answer observations with damping ratios through ``predict``, as stable-baselines3's models do.

``predict(observation, state=None, episode_start=None, deterministic=True)`` returns (D, state), D of shape (n, 1), float32,
for observations of shape (n, signals); one observation of shape (signals,) gives D of shape (1,). Unlike a bare model's action,
which lies in [-1, 1], D is what the environment takes.

Classical rules (`agents.controllers.rules`) act on signals of the motion, and drive any car that has them; those with a model
(`agents.controllers.scheduled`) take the whole state of car and road. Some have a parameter: `make_controller` takes it by
name, and `tune_controller` finds it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import overload

from roadgym.kalman import KalmanFilter
from roadgym.parameters import ParameterError, shown
from roadgym.task import Task

from ..estimation import Estimated, check_estimator
from ..theory import optimum as optimum
from ..theory import road_at as road_at
from ..theory import theoretical_cost as theoretical_cost
from .base import LARGEST_SIGNAL as LARGEST_SIGNAL
from .base import AnalyticOptimum as AnalyticOptimum
from .base import ConstantDamping as ConstantDamping
from .base import Controller as Controller
from .base import Damping as Damping
from .base import Observation as Observation
from .base import SemiActive as SemiActive
from .base import observed_bandwidth as observed_bandwidth
from .base import observed_speed as observed_speed
from .rules import AccelerationDrivenDamper as AccelerationDrivenDamper
from .rules import GroundhookOnOff as GroundhookOnOff
from .rules import Hybrid as Hybrid
from .rules import LeastAcceleration as LeastAcceleration
from .rules import MixedSkyhookADD as MixedSkyhookADD
from .rules import OneSensorMix as OneSensorMix
from .rules import PowerDrivenDamper as PowerDrivenDamper
from .rules import SkyhookContinuous as SkyhookContinuous
from .rules import SkyhookOnOff as SkyhookOnOff
from .scheduled import ClippedLinearQuadratic as ClippedLinearQuadratic
from .scheduled import MixedLookahead as MixedLookahead
from .scheduled import OneStepLookahead as OneStepLookahead
from .scheduled import OptimalFeedback as OptimalFeedback
from .scheduled import Scheduled as Scheduled
from .scheduled import cache_folder as cache_folder
from .tuning import tuned

CONTROLLERS: dict[str, Callable[..., Controller]] = {  # each takes the task, and its parameters by name
    "analytic_optimum": AnalyticOptimum,
    "d_min": lambda task: ConstantDamping(task, task.damping_range[0]),
    "d_max": lambda task: ConstantDamping(task, task.damping_range[1]),
    "skyhook": SkyhookOnOff,
    "skyhook_continuous": SkyhookContinuous,
    "groundhook": GroundhookOnOff,
    "hybrid": Hybrid,
    "add": AccelerationDrivenDamper,
    "mixed_skyhook_add": MixedSkyhookADD,
    "one_sensor_mix": OneSensorMix,
    "power_driven": PowerDrivenDamper,
    "least_acceleration": LeastAcceleration,
    "clipped_lqr": ClippedLinearQuadratic,
    "one_step_lookahead": OneStepLookahead,
    "mixed_lookahead": MixedLookahead,
    "optimal_feedback": OptimalFeedback,
}


def _known(name: str) -> Callable[..., Controller]:
    if not isinstance(name, str) or name not in CONTROLLERS:
        raise ParameterError(f"unknown controller {shown(name)}; known: {', '.join(CONTROLLERS)}")
    return CONTROLLERS[name]


@overload
def make_controller(name: str, task: Task, *, estimator: None = ..., **parameters: float) -> Controller: ...


@overload
def make_controller(name: str, task: Task, *, estimator: str, **parameters: float) -> Estimated: ...


def make_controller(name: str, task: Task, *, estimator: str | None = None, **parameters: float) -> Controller | Estimated:
    """A controller by its name in `CONTROLLERS`.

    Args:
        name: the name.
        task: the task.
        estimator: "kalman" for the controller on the mean of a Kalman filter, `agents.estimation.Estimated`, of what the task
            observes.
        parameters: those of the controller that are not to be its own defaults, by name.

    Raises:
        ParameterError: an unknown name or parameter, or signals that the task does not observe.
    """
    check_estimator(estimator)
    if estimator is not None:
        full = KalmanFilter(task).full
        return Estimated(make_controller(name, full, estimator=None, **parameters), task)
    make = _known(name)
    known = getattr(make, "tried", {})
    for parameter in parameters:
        if parameter not in known:
            raise ParameterError(f"unknown parameter {shown(parameter)} of {name}; known: {', '.join(known) or 'none'}")
    return make(task, **parameters)


def tune_controller(name: str, task: Task, seed: int = 0) -> Controller:
    """A controller by its name, with the parameters that cost least on ``task``; see `agents.controllers.tuning.tuned`.

    It takes a few seconds, and is the same every time; `Controller.parameters` tells what was chosen.

    Raises:
        ParameterError: as of `make_controller`.
    """
    return tuned(_known(name), task, seed)
