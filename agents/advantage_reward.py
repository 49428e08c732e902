"""Training on the advantage over the best constant damping instead of on the cost."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from analysis.quadratic import plant_system, value_form
from roadgym.installation import needs

from .actions import damping_from_action
from .advantage import advantage_forms
from .theory import NODES, OperatingGrid
from .vec_env import QuarterCarVecEnv

with needs("train"):
    from stable_baselines3.common.vec_env import VecEnvWrapper

CHOICES = 4  # damping ratios through which the advantage, smooth in D, is interpolated
MEMORY = 2000  # steps after which what was paid is forgotten
FIRST = 100.0  # weight of the constant damping in what was paid, at first


class AdvantageReward(VecEnvWrapper):
    """Replaces each reward by the cost that is saved against the best constant damping, with theory's help against noise:

        r = -((1 - c) (cost - rho) + c A(s, D)/T) / sqrt(rho),

    with the advantage A of the damping that is set and the mean cost rho of the best constant one (`agents.advantage`).

    For any constant c the mean over a long drive is (rho - mean cost)/sqrt(rho), as the mean of A is that of the cost less
    rho T and the change of a potential, h (A. Y. Ng, D. Harada and S. Russell, "Policy invariance under reward
    transformations", ICML 1999). So the same policy is best, by the average and without discount. It is not quite so here:
    training discounts, and then A and the cost weigh the near and the far differently; and c follows what is paid, so it moves
    as training goes on.

    But the noise of the road, which the cost mixes into what the damper did, is averaged out by theory, over the interval and
    over all that a constant damping would make of its end: what is left to learn is what theory does not know. That is least
    where c h is near the policy's own relative value: c = 1 - (1 - q)^2, with q <= 1 the ratio of the cost paid of late near
    the operating point to rho. The square root keeps operating points of small cost from being forgotten: without it they are,
    with it in full the large ones suffer. A is made from the full state, whatever the policy observes, and the policy needs no
    more signals for all this; infos keep the returns of the environment's own reward.

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
        self._rho, self._node = np.ones(venv.num_envs), np.zeros(venv.num_envs, np.intp)
        # cost over rho, and its weight, of late near each node; at first those of the constant damping
        self._paid, self._weight = np.full(NODES**2, FIRST), np.full(NODES**2, FIRST)
        self._advantages = np.empty(venv.num_envs)

    def _look(self) -> None:
        """Note the state, and work out the forms where the operating point is new."""
        before, self._state = self._state, self._envs.envs.state()
        new = np.flatnonzero((self._state[:, 4:] != before[:, 4:]).any(axis=1))
        if len(new):
            points = self._state[new, 4:]
            # any constant damping will do for the comparison; the nearest node's is almost the best one
            doubled = points * [1, 2]
            node = np.rint(self._grid.place(doubled / (1 + doubled))).astype(int)
            self._node[new] = node[:, 0] * NODES + node[:, 1]
            reference = self._grid.damping[node[:, 0], node[:, 1]]
            task, (ratio, bandwidth) = self._envs.task, points.T
            _, self._rho[new] = value_form(plant_system(task, reference, ratio, bandwidth), task.weights_by_name)
            forms, constants = advantage_forms(task, self._dampings, reference, ratio, bandwidth)
            twice = np.where(self._first == self._second, 1, 2)
            interval = task.control_interval * task.car.natural_frequency
            self._coefficients[new, :, :-1] = forms[..., self._first, self._second] * twice / interval
            self._coefficients[new, :, -1] = constants / interval

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
        self._advantages = squares + coefficients[:, -1]
        self.venv.step_async(actions)

    def step_wait(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.bool_], list[dict[str, Any]]]:
        """Drive one control interval."""
        observations, rewards, done, infos = self.venv.step_wait()
        cost = -rewards.astype(float)
        share = 1 - np.maximum(1 - self._paid / self._weight, 0)[self._node] ** 2
        saved = -((1 - share) * (cost - self._rho) + share * self._advantages) / np.sqrt(self._rho)
        for sums, values in ((self._paid, cost / self._rho), (self._weight, np.ones_like(cost))):
            sums *= 1 - 1 / MEMORY
            np.add.at(sums, self._node, values)
        self._look()
        return np.asarray(observations), saved.astype(np.float32), done, infos
