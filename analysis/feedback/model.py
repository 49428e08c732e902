"""The Markov chain of one operating point over control intervals."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from roadgym.linear import LinearSystem
from roadgym.task import Task

from ..checks import FloatArray
from ..optimum import optimal_damping
from ..quadratic import interval_mean, plant_system
from .grid import SingleArray, radius_of, road_stencils, variable_of

POINTS = 5  # of the rule for the road's step
CHANCE = np.array([1 / 3, 1 / 6, 1 / 6, 1 / 6, 1 / 6])
NODES = 5  # of D
NODE = -np.cos(np.pi * np.arange(NODES) / (NODES - 1))


@dataclasses.dataclass(frozen=True, eq=False)
class Part:
    """What an interval at one constant damping does.

    Attributes:
        transition: of (Y, X, Z, U) in the mean, shape (4, 4).
        gain: regression of the noise of (Y, X) on that of (Z, U), shape (2, 2).
        form, constant: interval cost plus E h0(s') - h0(s), a quadratic form of the state, shape (4, 4), and a number.
    """

    transition: FloatArray
    gain: FloatArray
    form: FloatArray
    constant: float


class Model:
    """The Markov chain of an operating point up to its second moments, and h0 of the best constant damping.

    Quadratic forms are vectors of 16 entries and a constant, and what takes one to its conditional mean after an interval is a
    matrix, as in `analysis.quadratic.interval_mean`.

    Attributes:
        deviation: root mean squares of (Y, X) under the best constant damping, shape (2,).
        maps, gains: see `analysis.feedback.iteration.sweep`.
        forms: coefficients of yy, yx, xx, yz, yu, xz, xu, zz, zu, uu and 1 of interval cost plus E h0(s') - h0(s), at each node
            of D, shape (NODES, 11).
    """

    def __init__(self, task: Task) -> None:
        self._task, self._road = task, task.road
        self._interval = task.control_interval * task.car.natural_frequency
        best = optimal_damping(
            task.road,
            speed=task.speed[0],
            car=task.car,
            weights=task.reward_by_name,
            bounds=task.damping_range,
        )
        constant = self._system(float(best.damping))
        backward, cost = self._backward(constant)
        value = np.append(np.linalg.solve(np.eye(16) - backward[:16, :16], cost[:16]), 0.0)
        self.deviation = np.sqrt(np.diag(constant.covariance())[:2])

        self._value = value

        middle, half, rate = variable_of(task.damping_range, self._interval)
        self.maps, self.gains, self.forms = np.empty((NODES, 2, 4)), np.empty((NODES, 2, 2)), np.empty((NODES, 11))
        upper = np.triu_indices(4)
        order = [0, 1, 4, 2, 3, 5, 6, 7, 8, 9]  # the upper triangle has yy, yz, yu after yx, and xx after them
        for k, damping in enumerate(-np.log1p(-(middle + half * NODE)) / rate):
            part = self.part(damping)
            self.maps[k], self.gains[k] = part.transition[:2], part.gain
            both = 2 * part.form - np.diag(np.diag(part.form))
            self.forms[k] = np.append(both[upper][order], part.constant)
        self._turn = part.transition[2:, 2:]
        self._second = backward[:, [10, 11, 15]]  # of zz, zu, uu; like the turn, whatever D

    def part(self, damping: float) -> Part:
        """What an interval at a constant damping does."""
        system = self._system(damping)
        noise = system.step_covariance(self._interval)
        backward, cost = self._backward(system)
        form = cost + backward @ self._value - self._value
        matrix = form[:16].reshape(4, 4)
        return Part(
            transition=system.transition(self._interval),
            gain=noise[:2, 2:] @ np.linalg.inv(noise[2:, 2:]),
            form=(matrix + matrix.T) / 2,
            constant=float(form[16]),
        )

    def _system(self, damping: float) -> LinearSystem:
        """The plant at a constant damping."""
        return plant_system(self._task, damping, self._task.frequency_ratio(self._task.speed[0]), self._task.bandwidth[0])

    def _backward(self, system: LinearSystem) -> tuple[FloatArray, FloatArray]:
        """(conditional mean of a form over an interval, mean cost over it as a form)."""
        backward, cost = interval_mean(system, system.cost_form(self._task.weights_by_name), self._interval)
        return backward, cost / self._interval

    def road_step(self, rings: int, rays: int) -> tuple[FloatArray, FloatArray, npt.NDArray[np.int64], SingleArray]:
        """(road, offset, index, weight) of the sweep: the computed half of the polar grid, and the road's step from it."""
        radius = radius_of(self._road)
        ring, ray = np.divmod(np.arange(rings * rays // 2), rays // 2)
        r, angle = (ring + 0.5) * radius / (rings - 0.5), 2 * np.pi / rays * ray
        road = np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)
        mean = road @ self._turn.T
        forms = np.zeros((len(road), 17))
        forms[:, [10, 11, 14, 15]] = (road[:, :, None] * road[:, None, :]).reshape(-1, 4)
        forms[:, 16] = 1
        zz, zu, uu = (forms @ self._second).T
        slope = np.sqrt(np.maximum(uu - mean[:, 1] ** 2, 1e-12))
        shared = (zu - mean[:, 0] * mean[:, 1]) / slope
        level = np.sqrt(np.maximum(zz - mean[:, 0] ** 2 - shared**2, 0))
        first = math.sqrt(3) * np.stack([shared, slope], axis=1)
        second = math.sqrt(3) * np.stack([level, np.zeros_like(level)], axis=1)
        points = np.stack([mean, mean + first, mean - first, mean + second, mean - second], axis=1)
        points *= np.minimum(1, radius / np.linalg.norm(points, axis=2))[:, :, None]
        index = np.empty((*points.shape[:2], 16), np.int64)
        weight = np.empty(index.shape, np.float32)
        road_stencils(points.reshape(-1, 2), radius / (rings - 0.5), rings, rays, index.reshape(-1, 16), weight.reshape(-1, 16))
        return road, points - mean[:, None], index, weight
