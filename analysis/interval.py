"""One control interval of a car over a road that is known at its ends, as polynomials in the damping ratio.

Given the road the car is linear, and D is held for the interval, so the state at its end is linear in the state and the road,
the mean cost a quadratic form of them, and both are smooth in D. Between the ends the road follows Hermite's cubic where its
slope is a number, and the chord where its rate contains white noise, of which the chord is the conditional mean (a Brownian
bridge). What the true road does beside that is left to whoever knows where the car really went.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from roadgym.cars.varied import exponentials
from roadgym.linear import Motion
from roadgym.task import Task

from .checks import FloatArray

DEGREE = 4  # of the polynomials in D: the relative error is below 1e-5 in the usual ranges
QUADRATURE = 6  # points of Gauss's rule for the mean cost


@dataclasses.dataclass(frozen=True, eq=False)
class Interval:
    """A control interval in cars, in units of the road's standard deviation and of time 1/w1; made by `of`.

    With the place a of D in its range, from -1 to 1, and u = (states of the car, ends of the road) the state at the end is
    sum_k a^k u motion_k, and the mean cost sum_k a^k u' cost_k u.

    Attributes:
        smooth: whether the ends of the road are (Z, dZ/dt) at the start and at the end, or Z alone at both.
        motion: shape (cars, DEGREE + 1, inputs, states).
        cost: shape (cars, DEGREE + 1, inputs, inputs).
    """

    smooth: bool
    motion: FloatArray
    cost: FloatArray

    @classmethod
    def of(cls, task: Task, motions: Sequence[Motion]) -> Interval:
        """The control interval of ``task`` in cars of these ``motions``, which are alike but for their numbers."""
        car = motions[0]
        duration = task.control_interval * task.car.natural_frequency
        smooth = task.road.has_slope and (task.speed_noise is None or task.speed_noise.smooth)
        path = _path(duration, smooth)
        cars, order = len(car.states), len(path)
        size = cars + order
        begin = np.zeros((size, size))  # (car, ends) -> (car, level and its derivatives) at the start
        begin[:cars, :cars], begin[cars:, cars:] = np.eye(cars), path
        rows = np.zeros((len(motions), len(car.signals), size + 1))  # with the damper's force last
        both = np.array([motion.rows for motion in motions])
        rows[..., : cars + 2], rows[..., -1] = both[..., : cars + 2], both[..., -1]
        relative = rows[:, list(car.signals).index(car.relative), None, :-1]
        free = np.zeros((len(motions), size, size))
        for own, motion in zip(free, motions, strict=True):
            own[:cars, : cars + 2] = np.column_stack([motion.drift, motion.level_entry, motion.slope_entry])
        free[:, cars:, cars:] = np.diag(np.ones(order - 1), 1)
        entry = np.pad([motion.force_entry for motion in motions], [(0, 0), (0, order)])
        places, shares = np.polynomial.legendre.leggauss(QUADRATURE)
        nodes = -np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))
        low, high = task.damping_range
        twice = (2 * low + (high - low) * (nodes + 1))[:, None, None]
        drift = free[:, None] - twice * (entry[:, :, None] * relative)[:, None]
        weighed = np.zeros(drift.shape)
        for name, weight in task.weights_by_name.items():
            own = rows[:, list(car.signals).index(name), None, None]
            row = own[..., :-1] + twice * own[..., -1:] * relative[:, None]
            weighed += weight * np.swapaxes(row, -1, -2) * row
        times = duration * np.append((1 + places) / 2, 1)
        passed = exponentials(drift[:, :, None] * times[:, None, None]) @ begin
        within = passed[:, :, :-1]
        costs = np.swapaxes(within, -1, -2) @ weighed[:, :, None] @ within
        powers = np.linalg.inv(np.vander(nodes, increasing=True))
        found = np.swapaxes(passed[:, :, -1, :cars], -1, -2), np.einsum("q,cnqij->cnij", shares / 2, costs)
        return cls(smooth, *(np.einsum("kn,cnij->ckij", powers, part) for part in found))


def _path(duration: float, smooth: bool) -> FloatArray:
    """The level and its derivatives at the start, from the ends of the road, shape (4, 4) or (2, 2)."""
    t = duration
    if not smooth:
        return np.array([[1, 0], [-1 / t, 1 / t]])
    second, third = [-6 / t**2, -4 / t, 6 / t**2, -2 / t], [12 / t**3, 6 / t**2, -12 / t**3, 6 / t**2]
    return np.array([[1, 0, 0, 0], [0, 1, 0, 0], second, third])
