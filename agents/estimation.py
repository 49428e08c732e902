"""Driving by the mean of a Kalman filter: certainty equivalence for every rule and every agent that needs the whole state."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from roadgym.kalman import Belief, KalmanFilter
from roadgym.parameters import ParameterError, shown
from roadgym.task import OPERATING_POINT, Task

ESTIMATORS = ("kalman",)

Rows = npt.NDArray[np.float32]
State = tuple[Belief, Rows]


def check_estimator(estimator: Any) -> None:
    """Raise `ParameterError` unless it is None or the name of an estimator."""
    if estimator is not None and estimator not in ESTIMATORS:
        raise ParameterError(f"unknown estimator {shown(estimator)}; known: {', '.join(ESTIMATORS)}")


class Driver(Protocol):
    """Who answers what ``task`` observes with damping ratios."""

    @property
    def task(self) -> Task:
        """The task."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        """(D, state) for observations."""


def updated(known: KalmanFilter, state: State | None, observations: Rows, starts: npt.NDArray[np.bool_] | None) -> Belief:
    """What is known with new observations, shape (n, signals).

    Args:
        known: the filter.
        state: what was known before, and the damping ratios that were answered; None at the start.
        observations: what is measured.
        starts: whose episode begins, shape (n,); None for nobody's.
    """
    if state is None:
        return known.begin(observations)
    belief, damping = state
    belief = known.advance(belief, damping[:, 0], observations)
    return known.restarted(belief, np.asarray(starts), observations) if starts is not None and np.any(starts) else belief


class Estimated:
    """A controller that takes the mean of a Kalman filter, `roadgym.kalman`, for the state.

    With the optimal feedback that is certainty equivalence. The damping in force is the one that was answered.

    Args:
        controller: anything with ``predict`` and a ``task`` of the same plant, of whose signals the filter tells each.
        task: what is measured: its observation, through its sensors.

    Attributes:
        controller, task: as they were given.
        filter: the filter.

    Raises:
        ParameterError: a plant that is not linear, no measured signal, or a controller that needs what no filter tells.
    """

    def __init__(self, controller: Driver, task: Task) -> None:
        self.controller, self.task, self.filter = controller, task, KalmanFilter(task)
        told = self.filter.full.signals
        for name in controller.task.signals:
            if name not in told:
                raise ParameterError(f"a Kalman filter does not tell the signal {name!r}; it tells {', '.join(told)}")
        self._columns = [told.index(name) for name in controller.task.signals]
        self._point = [told.index(name) for name in OPERATING_POINT if name in told]

    @property
    def parameters(self) -> dict[str, float]:
        """Those of the controller."""
        return dict(getattr(self.controller, "parameters", {}))

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: npt.NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """(D, state), D of shape (n, 1) for observations of shape (n, signals), or (1,) for one of shape (signals,).

        The state holds what the filter knows: hand it back with the next observations; rows where ``episode_start`` is true
        forget. Where the operating point is hidden, the controller is told the most probable one.
        """
        rows = np.atleast_2d(np.asarray(observation, np.float32))
        filtered, inner = (None, None) if state is None else state
        belief = updated(self.filter, filtered, rows, episode_start)
        means = self.filter.observation(belief)
        means[:, self._point] = self.filter.likeliest(belief)
        damping, inner = self.controller.predict(means[:, self._columns], inner, episode_start, deterministic)
        return np.reshape(damping, (*np.shape(observation)[:-1], 1)), ((belief, damping), inner)
