"""The Markov chain of one operating point over control intervals."""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt

from roadgym.linear import LinearSystem
from roadgym.task import Task

from ..checks import FloatArray
from ..optimum import optimal_damping
from ..quadratic import interval_mean, plant_system
from .grid import SingleArray, radius_of, road_stencils, variable_of
from .road_grid import grid_of

NODES = 5  # of D
NODE = -np.cos(np.pi * np.arange(NODES) / (NODES - 1))


@dataclasses.dataclass(frozen=True, eq=False)
class Part:
    """What an interval at one constant damping does to the n states of car and road.

    Attributes:
        transition: of them in the mean, shape (n, n).
        gain: how the noise of the car follows that of the rule (`RoadGrid.noise`), shape (2, 2): regression on that of the
            road; of what that leaves, the largest part as a factor.
        form, constant: interval cost plus E h0(s') - h0(s), a quadratic form of the state, shape (n, n), and a number.
    """

    transition: FloatArray
    gain: FloatArray
    form: FloatArray
    constant: float


class Model:
    """The Markov chain of an operating point up to its second moments, and h0 of the best constant damping.

    Its states are those of car and road, the car's less what follows the level of a slow road (`RoadGrid.follows`). Quadratic
    forms of n states are vectors of n^2 entries and a constant, and what takes one to its conditional mean after an interval is
    a matrix, as in `analysis.quadratic.interval_mean`.

    Attributes:
        grid: what the tables know of the road.
        follows: how much of Z is taken from (Y, X), shape (2,).
        deviation: root mean squares of what that leaves of (Y, X) under the best constant damping, shape (2,).
        maps, gains: see `analysis.feedback.iteration.sweep`.
        forms: coefficients of yy, yx, xx, yz, yu, xz, xu, zz, zu, uu and 1 of interval cost plus E h0(s') - h0(s), at each node
            of D, shape (NODES, 11).
    """

    def __init__(self, task: Task) -> None:
        self._task, self._road = task, task.road
        self._interval = task.control_interval * task.car.natural_frequency
        self._ratio = float(task.frequency_ratio(task.speed[0]))
        self.grid = grid_of(task.road)
        self.follows = self.grid.follows(self._ratio, task.damping_range)
        best = optimal_damping(
            task.road,
            speed=task.speed[0],
            car=task.car,
            weights=task.reward_by_name,
            bounds=task.damping_range,
        )
        constant = self._system(float(best.damping))
        backward, cost = self._backward(constant)
        size = len(constant.states)
        form, road = size**2, slice(2, size)
        value = np.append(np.linalg.solve(np.eye(form) - backward[:form, :form], cost[:form]), 0.0)
        self._away, self._back = np.eye(size), np.eye(size)
        self._away[:2, 2], self._back[:2, 2] = -self.follows, self.follows
        self.deviation = np.sqrt(np.diag(self._away @ constant.covariance() @ self._away.T)[:2])

        self._value = value

        middle, half, rate = variable_of(task.damping_range, self._interval)
        self.maps, self.gains, self.forms = np.zeros((NODES, 2, 4)), np.empty((NODES, 2, 2)), np.empty((NODES, 11))
        upper = np.triu_indices(4)
        order = [0, 1, 4, 2, 3, 5, 6, 7, 8, 9]  # the upper triangle has yy, yz, yu after yx, and xx after them
        for k, damping in enumerate(-np.log1p(-(middle + half * NODE)) / rate):
            part = self.part(damping)
            self.maps[k, :, :size], self.gains[k] = part.transition[:2], part.gain
            both = np.zeros((4, 4))
            both[:size, :size] = 2 * part.form - np.diag(np.diag(part.form))
            self.forms[k] = np.append(both[upper][order], part.constant)
        self._turn = part.transition[road, road]
        entries = np.arange(form).reshape(size, size)[road, road].ravel()
        self._second = backward[np.append(entries, form)][:, entries]  # of the road's squares; like the turn, whatever D

    def part(self, damping: float) -> Part:
        """What an interval at a constant damping does."""
        system = self._system(damping)
        noise = self._away @ system.step_covariance(self._interval) @ self._away.T
        gain = noise[:2, 2:] @ np.linalg.inv(noise[2:, 2:])
        left, ways = np.linalg.eigh(noise[:2, :2] - gain @ noise[2:, :2])
        own = (ways * np.sqrt(np.maximum(left, 0)))[:, ::-1]
        backward, cost = self._backward(system)
        form = cost + backward @ self._value - self._value
        matrix = self._back.T @ form[:-1].reshape(noise.shape) @ self._back
        return Part(
            transition=self._away @ system.transition(self._interval) @ self._back,
            gain=np.hstack([gain, own])[:, :2],
            form=(matrix + matrix.T) / 2,
            constant=float(form[-1]),
        )

    def _system(self, damping: float) -> LinearSystem:
        """The plant at a constant damping."""
        return plant_system(self._task, damping, self._ratio, self._task.bandwidth[0])

    def _backward(self, system: LinearSystem) -> tuple[FloatArray, FloatArray]:
        """(conditional mean of a form over an interval, mean cost over it as a form)."""
        backward, cost = interval_mean(system, system.cost_form(self._task.weights_by_name), self._interval)
        return backward, cost / self._interval

    def road_step(self, rings: int, rays: int) -> tuple[FloatArray, FloatArray, npt.NDArray[np.int64], SingleArray]:
        """(road, offset, index, weight) of the sweep: the computed half of the polar grid, and the road's step from it."""
        radius, states = radius_of(self._road), len(self._turn)
        ring, ray = np.divmod(np.arange(rings * rays // 2), rays // 2)
        r, angle = (ring + 0.5) * radius / (rings - 0.5), 2 * np.pi / rays * ray
        road = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)
        before = road[:, :states]
        mean = np.zeros_like(road)
        mean[:, :states] = before @ self._turn.T
        forms = np.append((before[:, :, None] * before[:, None, :]).reshape(len(road), -1), np.ones((len(road), 1)), axis=1)
        square = (forms @ self._second).reshape(-1, states, states)
        offset = self.grid.noise(square - mean[:, :states, None] * mean[:, None, :states])
        points = np.zeros_like(offset)
        points[..., :states] = offset[..., :states]
        points += mean[:, None]
        points *= np.minimum(1, radius / np.linalg.norm(points, axis=2))[:, :, None]
        offset[..., :states] = (points - mean[:, None])[..., :states]
        index = np.empty((*points.shape[:2], 16), np.int64)
        weight = np.empty(index.shape, np.float32)
        road_stencils(points.reshape(-1, 2), radius / (rings - 0.5), rings, rays, index.reshape(-1, 16), weight.reshape(-1, 16))
        return road, offset, index, weight
