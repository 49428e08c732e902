"""Training on the advantage over the best constant damping instead of on the cost."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from stable_baselines3.common.vec_env import VecEnvWrapper

from .advantage import advantage_forms, value_form
from .operating_grid import OperatingGrid
from .vec_env import QuarterCarVecEnv, damping_from_action

CHOICES = 4  # damping ratios through which the advantage, smooth in D, is interpolated


class AdvantageReward(VecEnvWrapper):
    """Replaces each reward by minus the advantage A(s, D)/T of the damping that is set; see `agents.advantage`.

    Averaged over a drive, the advantage differs from the cost by a constant of the operating point, so the same policy is best.
    But the noise of the road, which the cost mixes into what the damper did, is averaged out by theory, over the interval and
    over all that a constant damping would make of its end: what is left to learn is what theory does not know. It is divided by
    the square root of the best constant damping's mean cost, so that speeds at which little moves are not forgotten. The policy
    needs no more signals for it; infos keep the returns of the environment's own reward.

    Args:
        venv: the environments; their plant must have an advantage (`agents.advantage.has_advantage`).
    """

    def __init__(self, venv: QuarterCarVecEnv) -> None:
        super().__init__(venv)
        self._envs = venv
        task = venv.task
        self._grid = OperatingGrid(task)
        self._dampings = np.linspace(*task.damping_range, CHOICES)
        # polynomials in D that are 1 at one of the choices and 0 at the others
        self._polynomials = np.linalg.inv(np.vander(self._dampings))
        self._state = np.full((venv.num_envs, 6), np.nan)
        # for each choice of damping, the coefficients of the products of two signals, and the constant
        self._first, self._second = np.triu_indices(4)
        self._coefficients = np.empty((venv.num_envs, CHOICES, len(self._first) + 1))

    def _look(self) -> None:
        """Note the state, and work out the forms where the operating point is new."""
        before, self._state = self._state, self._envs.envs.state()
        new = np.flatnonzero((self._state[:, 4:] != before[:, 4:]).any(axis=1))
        if len(new):
            points = self._state[new, 4:]
            # any constant damping will do for the comparison; the nearest node's is almost the best one
            doubled = points * [1, 2]
            node = np.rint(self._grid.place(doubled / (1 + doubled))).astype(int)
            reference = self._grid.damping[node[:, 0], node[:, 1]]
            task, (ratio, bandwidth) = self._envs.task, points.T
            forms, constants = advantage_forms(task, self._dampings, reference, ratio, bandwidth)
            twice = np.where(self._first == self._second, 1, 2)
            _, mean_cost = value_form(task, reference, ratio, bandwidth)
            scale = task.control_interval * task.car.natural_frequency * np.sqrt(mean_cost)[:, None]
            self._coefficients[new, :, :-1] = forms[..., self._first, self._second] * twice / scale[..., None]
            self._coefficients[new, :, -1] = constants / scale

    def reset(self) -> npt.NDArray[np.float32]:
        """First observations."""
        observations = self.venv.reset()
        self._look()
        return np.asarray(observations)

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Work out the advantage of the actions, and take them."""
        task = self._envs.task
        damping = damping_from_action(actions, task.damping_range, self._envs.damping_levels)
        weights = np.vander(np.clip(damping[:, 0], *task.damping_range).astype(float), CHOICES) @ self._polynomials
        coefficients = (weights[:, None, :] @ self._coefficients)[:, 0]
        squares = (coefficients[:, :-1] * self._state[:, self._first] * self._state[:, self._second]).sum(axis=1)
        self._rewards = np.asarray(-(squares + coefficients[:, -1]), np.float32)
        self.venv.step_async(actions)

    def step_wait(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.bool_], list[dict[str, Any]]]:
        """Drive one control interval."""
        observations, _, done, infos = self.venv.step_wait()
        self._look()
        return np.asarray(observations), self._rewards, done, infos
