"""One control interval of a car over a road that is known at its ends, as polynomials in the damping ratio.

Given the road the car is linear, and D is held for the interval, so the state at its end is linear in the state and the road,
the mean cost a quadratic form of them, and both are smooth in D. Between the ends the road follows Hermite's cubic where its
slope is a number, and the chord where its rate contains white noise, of which the chord is the conditional mean (a Brownian
bridge). What the true road does beside that is left to whoever knows where the car really went.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from roadgym.task import Task

from .checks import FloatArray

DEGREE = 4  # of the polynomials in D: the relative error is below 1e-5 in the usual ranges
QUADRATURE = 6  # points of Gauss's rule for the mean cost


@dataclasses.dataclass(frozen=True, eq=False)
class Interval:
    """A control interval in units of the road's standard deviation and of time 1/w1; made by `of`.

    With the place a of D in its range, from -1 to 1, and u = (states of the car, ends of the road) the state at the end is
    sum_k a^k u motion_k, and the mean cost sum_k a^k u' cost_k u.

    Attributes:
        smooth: whether the ends of the road are (Z, dZ/dt) at the start and at the end, or Z alone at both.
        duration: T.
        motion: shape (DEGREE + 1, inputs, states).
        cost: shape (DEGREE + 1, inputs, inputs).
    """

    smooth: bool
    duration: float
    motion: FloatArray
    cost: FloatArray

    @classmethod
    def of(cls, task: Task) -> Interval:
        """The control interval of ``task``."""
        from scipy.linalg import expm

        car = task.car.motion
        duration = task.control_interval * task.car.natural_frequency
        smooth = task.road.has_slope and (task.speed_noise is None or task.speed_noise.smooth)
        path = _path(duration, smooth)
        cars, order = len(car.states), len(path)
        size = cars + order
        begin = np.zeros((size, size))  # (car, ends) -> (car, level and its derivatives) at the start
        begin[:cars, :cars], begin[cars:, cars:] = np.eye(cars), path
        rows = np.zeros((len(car.signals), size + 1))  # with the damper's force last
        rows[:, : cars + 2], rows[:, -1] = car.rows[:, : cars + 2], car.rows[:, -1]
        factors = dict(zip(car.signals, rows, strict=True))
        relative = factors[car.relative][:-1]
        free = np.zeros((size, size))
        free[:cars, :cars], free[:cars, cars], free[:cars, cars + 1] = car.drift, car.level_entry, car.slope_entry
        free[cars:, cars:] = np.diag(np.ones(order - 1), 1)
        entry = np.append(car.force_entry, np.zeros(order))
        places, shares = np.polynomial.legendre.leggauss(QUADRATURE)
        nodes = -np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))
        motion, cost = [], []
        low, high = task.damping_range
        for damping in (low + (high - low) * (nodes + 1) / 2).tolist():
            drift = free - 2 * damping * np.outer(entry, relative)
            weighed = np.zeros((size, size))
            for name, weight in task.weights_by_name.items():
                row = factors[name][:-1] + 2 * damping * factors[name][-1] * relative
                weighed += weight * np.outer(row, row)
            passed = [expm(drift * duration * (1 + place) / 2) @ begin for place in places.tolist()]
            motion.append((expm(drift * duration) @ begin)[:cars].T)
            cost.append(sum(share / 2 * here.T @ weighed @ here for here, share in zip(passed, shares.tolist(), strict=True)))
        powers = np.linalg.inv(np.vander(nodes, increasing=True))
        return cls(smooth, duration, *(np.tensordot(powers, np.array(found), 1) for found in (motion, cost)))


def _path(duration: float, smooth: bool) -> FloatArray:
    """The level and its derivatives at the start, from the ends of the road, shape (4, 4) or (2, 2)."""
    t = duration
    if not smooth:
        return np.array([[1, 0], [-1 / t, 1 / t]])
    second, third = [-6 / t**2, -4 / t, 6 / t**2, -2 / t], [12 / t**3, 6 / t**2, -12 / t**3, 6 / t**2]
    return np.array([[1, 0, 0, 0], [0, 1, 0, 0], second, third])
