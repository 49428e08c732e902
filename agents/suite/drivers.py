"""Who drives on a task of the suite, by its origin: a classical rule with its parameters, or an agent that is shipped."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from roadgym.kalman import KalmanFilter
from roadgym.parameters import ParameterError
from roadgym.suite import SuiteTask
from roadgym.task import OPERATING_POINT, make_task

from .. import pretrained
from ..agent import load
from ..comparison import observed_in_full
from ..controllers import CONTROLLERS, ConstantDamping, make_controller, tune_controller
from ..estimation import Estimated
from ..evaluation import Evaluation, Predictor, evaluate
from ..names import FILTERED, title
from .baselines import learner_of

Origin = Mapping[str, Any]  # {"rule": name, "parameters": {...}, "estimator": name or None}, or {"agent": name}
CONSTANT, BEST_CONSTANT = ("d_min", "d_max"), "analytic_optimum"
CANDIDATES = (BEST_CONSTANT, "mixed_lookahead", "optimal_feedback")  # rules that are anywhere the best known
ZERO = "zero"  # of the score, beside the names of others
SHIPPED = ", shipped"  # after the title of the learner whose agent comes with the package


def rules_of(task: SuiteTask, names: Iterable[str] = CONTROLLERS) -> dict[str, Origin]:
    """The classical rules among ``names`` that the sensors of a task allow, by the name that is shown, tuned on the task.

    Where the state is hidden, they drive by the mean of a Kalman filter, as far as there is one.
    """
    plant, full = make_task(**task.parameters), make_task(**observed_in_full(task.parameters))
    known: dict[str, Origin] = {}
    for name in names:
        if name in CONSTANT or (name == BEST_CONSTANT and not task.single_constant):
            continue
        try:
            rule = tune_controller(name, full)
            seen = set(rule.needs) <= set(plant.signals)
            if not seen and set(rule.needs) - set(OPERATING_POINT):
                KalmanFilter(plant)  # which there may not be
        except ParameterError:
            continue
        origin: Origin = {"rule": name, "parameters": rule.parameters, "estimator": None if seen else "kalman"}
        known[title(name) + ("" if seen else FILTERED)] = origin
    return known


def known_on(task: SuiteTask, names: Iterable[str] = CONTROLLERS) -> dict[str, Origin]:
    """`rules_of` a task, and the agent that comes with the package for it."""
    shipped = {learner_of(task, "own").title + SHIPPED: {"agent": task.name}} if pretrained.find(task.name) else {}
    return rules_of(task, names) | shipped


def driver_of(task: SuiteTask, origin: Origin) -> Predictor:
    """Who drives.

    Raises:
        ParameterError: a rule that the task does not allow.
        AgentError: an agent that cannot be loaded.
    """
    if "agent" in origin:
        return load(origin["agent"])
    plant = make_task(**task.parameters)
    if origin["estimator"] is None:
        return make_controller(origin["rule"], plant, **origin["parameters"])
    full = make_task(**observed_in_full(task.parameters))
    return Estimated(make_controller(origin["rule"], full, **origin["parameters"]), plant)


def zero_of(task: SuiteTask, damping: float) -> Predictor:
    """The score's zero: one constant ``damping``, or the best one at each operating point."""
    full = make_task(**observed_in_full(task.parameters))
    return ConstantDamping(full, damping) if task.single_constant else make_controller(BEST_CONSTANT, full)


def drive_on(
    task: SuiteTask,
    drivers: Mapping[str, Predictor],
    *,
    episodes: int,
    seed: int,
    report: Callable[[str, int, int], None] | None = None,
    speeds: Sequence[float] | None = None,
    bandwidths: Sequence[float] | None = None,
) -> dict[str, Evaluation]:
    """`agents.evaluate` at the operating points of a task, or at some others."""
    return evaluate(
        drivers,
        environment=task.parameters,
        speeds=task.speeds if speeds is None else speeds,
        bandwidths=task.bandwidths if bandwidths is None else bandwidths,
        episodes=episodes,
        duration=task.duration,
        seed=seed,
        report=report,
    )
