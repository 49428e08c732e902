"""What is paid for the cost that is saved against the best constant damping, with theory's help against noise:

    r = -((1 - c) (cost - rho) + c A(s, D)/T) / sqrt(rho),

with the advantage A of the damping that is set and the mean cost rho of the best constant one (`agents.advantage`).

For any constant c the mean over a long drive is (rho - mean cost)/sqrt(rho), as the mean of A is that of the cost less rho T
and the change of a potential, h (A. Y. Ng, D. Harada and S. Russell, "Policy invariance under reward transformations", ICML
1999). So the same policy is best, by the average and without discount. It is not quite so here: training discounts, and then A
and the cost weigh the near and the far differently; and c follows what is paid, so it moves as training goes on.

But the noise of the road, which the cost mixes into what the damper did, is averaged out by theory, over the interval and over
all that a constant damping would make of its end: what is left to learn is what theory does not know. That is least where c h
is near the policy's own relative value: c = 1 - (1 - q)^2, with q <= 1 the ratio of the cost paid of late near the operating
point to rho. The square root keeps operating points of small cost from being forgotten: without it they are, with it in full
the large ones suffer.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from analysis.quadratic import plant_system, value_form
from roadgym.env import state_names
from roadgym.task import Task

from .advantage import advantage_forms, state_of
from .theory import NODES, OperatingGrid

CHOICES = 4  # damping ratios through which the advantage, smooth in D, is interpolated
MEMORY = 2000  # steps of the whole batch after which what was paid is forgotten
FIRST = 100.0  # weight of the constant damping in what was paid, at first


class SavedCost:
    """The reward of ``num_envs`` cars on ``task``, which must have an advantage (`agents.advantage.has_advantage`).

    In a batch, what was paid near an operating point is that of all its cars, so a reward depends a little on the others.
    """

    def __init__(self, task: Task, num_envs: int) -> None:
        self._task = task
        self._grid = OperatingGrid.of(task)
        self._dampings = np.linspace(*task.damping_range, CHOICES)
        # polynomials in D that are 1 at one of the choices and 0 at the others
        self._polynomials = np.linalg.inv(np.vander(self._dampings))
        told = state_names(task)
        self._columns = np.array([told.index(name) for name in state_of(task)])
        self._state, self._point = np.full((num_envs, len(self._columns)), np.nan), np.full((num_envs, 2), np.nan)
        # for each choice of damping, the coefficients of the products of two signals, and the constant
        self._first, self._second = np.triu_indices(len(self._columns))
        self._coefficients = np.empty((num_envs, CHOICES, len(self._first) + 1))
        self._rho, self._node = np.ones(num_envs), np.zeros(num_envs, np.intp)
        # cost over rho, and its weight, of late near each node; at first those of the constant damping
        self._paid, self._weight = np.full(NODES**2, FIRST), np.full(NODES**2, FIRST)

    def look(self, state: npt.NDArray[np.float64]) -> None:
        """Note the state, as of `roadgym.vector.QuarterCarVectorEnv.state`; work out the forms where the point is new."""
        before, self._point, self._state = self._point, state[:, -2:], state[:, self._columns]
        new = np.flatnonzero((self._point != before).any(axis=1))
        if len(new):
            points = self._point[new]
            # any constant damping will do for the comparison; the nearest node's is almost the best one
            doubled = points * [1, 2]
            node = np.rint(self._grid.place(doubled / (1 + doubled))).astype(int)
            self._node[new] = node[:, 0] * NODES + node[:, 1]
            reference = self._grid.damping[node[:, 0], node[:, 1]]
            task, (ratio, bandwidth) = self._task, points.T
            _, self._rho[new] = value_form(plant_system(task, reference, ratio, bandwidth), task.weights_by_name)
            forms, constants = advantage_forms(task, self._dampings, reference, ratio, bandwidth)
            twice = np.where(self._first == self._second, 1, 2)
            interval = task.control_interval * task.car.natural_frequency
            self._coefficients[new, :, :-1] = forms[..., self._first, self._second] * twice / interval
            self._coefficients[new, :, -1] = constants / interval

    def advantage(self, damping: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
        """A/T of damping ratios, shape (n, 1), in the state that was looked at last; shape (n,)."""
        weights = np.vander(np.clip(damping[:, 0], *self._task.damping_range).astype(float), CHOICES) @ self._polynomials
        coefficients = (weights[:, None, :] @ self._coefficients)[:, 0]
        squares = (coefficients[:, :-1] * self._state[:, self._first] * self._state[:, self._second]).sum(axis=1)
        return np.asarray(squares + coefficients[:, -1])

    def reward(
        self, cost: npt.NDArray[np.float64], advantage: npt.NDArray[np.float64], driven: npt.NDArray[np.bool_]
    ) -> npt.NDArray[np.float64]:
        """What is paid for an interval that cost ``cost``, shape (n,); 0 to those that are not ``driven``."""
        share = 1 - np.maximum(1 - self._paid / self._weight, 0)[self._node] ** 2
        saved = -((1 - share) * (cost - self._rho) + share * advantage) / np.sqrt(self._rho)
        for sums, values in ((self._paid, cost / self._rho), (self._weight, np.ones_like(cost))):
            sums *= 1 - driven.mean() / MEMORY
            np.add.at(sums, self._node[driven], values[driven])
        return np.where(driven, saved, 0.0)
