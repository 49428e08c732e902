"""The Markov chain over control intervals on a road of white velocity, and the exact quadratic part of the value."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from roadgym.cars import Car
from roadgym.linear import LinearSystem, Motion
from roadgym.parameters import ParameterError
from roadgym.roads import FirstOrderRoad, Road
from roadgym.task import Task, make_task

from ...checks import FloatArray
from ...quadratic import interval_mean, regulator, value_form
from .table import CHANCE, DEGREE, TERMS

COORDINATES = ("tyre_deflection", "wheel_velocity", "travel", "velocity")  # those that the road shakes first
ROUGH = 2  # how many these are
SLOW = 0.01  # corner, in units of w1, of the first-order road that stands for one of white velocity; what matters is its square
PRICE = 0.01  # of the square of the active force over the sum of the weights, without which comfort alone has no optimum
ACTIVE = 0.5  # share of the active force's value in the quadratic part


def coordinates(motion: Motion, ratio: float) -> FloatArray:
    """`COORDINATES` as rows of the state (car, level), velocities relative to the mean -nu Z of the road's; shape (4, 5)."""
    names = (*motion.states, "level")
    rows = np.array([[motion.signals[name].terms.get(term, 0.0) for term in names] for name in COORDINATES])
    rows[[1, 3], -1] += ratio
    return rows


def check(road: Road, car: Car, weighed: Sequence[str]) -> None:
    """Raise `ParameterError` for a plant, or a cost of these mean squares, that `COORDINATES` do not tell of."""
    motion, road_filter = car.motion, road.shaping_filter()
    terms = {term for name in COORDINATES if name in motion.signals for term in motion.signals[name].terms}
    if not set(COORDINATES) <= set(motion.signals) or len(motion.states) != 4 or not terms <= {*motion.states, "level"}:
        raise ParameterError(
            f"car must be of one mass, or of the signals {', '.join(COORDINATES)}, without a weighting, got {car!r}"
        )
    if road_filter is None or not road_filter.is_first_order:
        raise ParameterError(f"road must be of first order for a {car.kind} car, got {road!r}")
    for ratio in (0.0, 1.0):
        moved = np.linalg.inv(np.vstack([coordinates(motion, ratio), [0, 0, 0, 0, 1]]))[:, -1]
        for name in weighed:
            row = motion.signals[name].terms
            if abs(sum(row.get(term, 0.0) * step for term, step in zip((*motion.states, "level"), moved, strict=True))) > 1e-9:
                raise ParameterError(f"weights must be on what a road of white velocity leaves finite, got one on {name}")


def white_task(task: Task) -> Task:
    """The same car on a first-order road whose corner is `SLOW`, of variance 1 and so of S = 2 `SLOW`."""
    car = task.car
    return make_task(
        road=FirstOrderRoad(noise_intensity=math.sqrt(2.0)),
        speed=SLOW * car.natural_frequency,
        car=car,
        reward=task.reward_by_name,
        damping_range=task.damping_range,
        control_interval=task.control_interval,
        observation=(*car.motion.states, "level"),
        observe_operating_point=False,
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Forms:
    """Interval cost plus drift of h0, as a polynomial in the variable of D whose coefficients are quadratic forms of the state.

    Attributes:
        matrices: shape (DEGREE + 1, states, states).
        constants: shape (DEGREE + 1,).
        variable: (middle, half range, rate), see `variable_of`.
    """

    matrices: FloatArray
    constants: FloatArray
    variable: tuple[float, float, float]


def variable_of(car: Car, bounds: tuple[float, float], interval: float) -> tuple[float, float, float]:
    """(middle, half range, rate) of the variable t in [-1, 1] of D: 1 - exp(-rate D) = middle + half range * t."""
    rate = min(2 * car.firmness * interval, 4 / bounds[1])
    low, high = (-math.expm1(-rate * bound) for bound in bounds)
    return (low + high) / 2, (high - low) / 2, rate


class Chain:
    """The chain of ``task`` at one frequency ratio: systems at constant D, and h0, with the value of a constant damping."""

    def __init__(self, task: Task, ratio: float, constant: float) -> None:
        self.task, self.ratio = task, ratio
        self.interval = task.control_interval * task.car.natural_frequency
        self.variable = variable_of(task.car, task.damping_range, self.interval)
        total = sum(task.weights_by_name.values())
        self.weights = {name: weight / total for name, weight in task.weights_by_name.items()}
        passive, _ = value_form(self.system(constant), self.weights)
        _, active = regulator(self.system(0.0), self.weights, PRICE)
        self.value = (1 - ACTIVE) * passive + ACTIVE * active

    def system(self, damping: float) -> LinearSystem:
        """Car and road at a constant damping."""
        return system_of(self.task, damping, self.ratio)

    def dampings(self, variable: FloatArray) -> FloatArray:
        """D at values of the variable."""
        middle, half, rate = self.variable
        return np.asarray(-np.log1p(-(middle + half * variable)) / rate)

    def forms(self) -> Forms:
        """The polynomials, through Chebyshev's nodes."""
        nodes = -np.cos(np.pi * np.arange(DEGREE + 1) / DEGREE)
        start = np.append(self.value.ravel(), 0.0)
        found = []
        for damping in self.dampings(nodes).tolist():
            system = self.system(damping)
            backward, cost = interval_mean(system, system.cost_form(self.weights), self.interval)
            found.append(cost + backward @ start - start)
        polynomials = np.linalg.inv(np.vander(nodes, increasing=True)) @ np.array(found)
        size = len(self.value)
        matrices = polynomials[:, :-1].reshape(-1, size, size)
        return Forms((matrices + matrices.swapaxes(1, 2)) / 2, polynomials[:, -1], self.variable)


def system_of(task: Task, damping: float, ratio: float) -> LinearSystem:
    """The plant of ``task``, whose road is of first order, at a constant damping and a frequency ratio nu."""
    road = task.road.shaping_filter()
    assert road is not None
    return LinearSystem.of(road, task.car.motion, damping=damping, ratio=ratio)


def best_constant(task: Task) -> float:
    """The best constant damping on a road of white velocity."""
    from scipy.optimize import minimize_scalar

    low, high = np.log(task.damping_range)

    def cost(place: float) -> float:
        return float(value_form(system_of(task, math.exp(place), SLOW), task.weights_by_name)[1])

    return float(np.clip(math.exp(minimize_scalar(cost, bounds=(low, high), method="bounded").x), *task.damping_range))


class Model:
    """The chain on a road of white velocity with S = 1, in `COORDINATES`; weights sum to 1.

    Attributes:
        constant: the best constant damping.
        interval: between two settings of D, in units of 1/w1.
        deviation: root mean squares of the coordinates under the best constant damping, shape (4,).
        maps: what an interval makes of them on average, at the nodes -1, 0, 1 of the variable of D, shape (3, 4, 4).
        shifts: the points of the rule for what it adds to the first two, likewise, shape (3, points, 2).
        forms: coefficients of the powers of the variable of D, quadratic forms as 00, 01, ..., 33 and 1; shape
            (DEGREE + 1, TERMS).
    """

    def __init__(self, task: Task) -> None:
        self.constant = best_constant(task)
        chain = Chain(task, SLOW, self.constant)
        self.interval = chain.interval
        length = math.sqrt(2 * SLOW)  # sqrt(S)
        whole = np.vstack([coordinates(task.car.motion, SLOW) / length, [0, 0, 0, 0, 1]])
        back = np.linalg.inv(whole)

        def own(matrix: FloatArray) -> FloatArray:
            """What a matrix that maps states makes of the coordinates, where the level is zero."""
            return np.asarray((whole @ matrix @ back)[:4, :4])

        covariance = chain.system(self.constant).covariance()
        self.deviation = np.sqrt(np.diag(whole @ covariance @ whole.T)[:4])
        self.maps, self.shifts = np.empty((3, 4, 4)), np.empty((3, len(CHANCE), ROUGH))
        for node, damping in enumerate(chain.dampings(np.array([-1.0, 0.0, 1.0])).tolist()):
            system = chain.system(damping)
            self.maps[node] = own(system.transition(chain.interval))
            added = (whole @ system.step_covariance(chain.interval) @ whole.T)[:ROUGH, :ROUGH]
            factor = math.sqrt(3) * np.linalg.cholesky(added)
            self.shifts[node] = np.vstack([np.zeros(ROUGH), factor[:, 0], -factor[:, 0], factor[:, 1], -factor[:, 1]])
        exact = chain.forms()
        upper = np.triu_indices(4)
        twice = np.where(upper[0] == upper[1], 1, 2)
        self.forms = np.empty((DEGREE + 1, TERMS))
        for power, matrix in enumerate(exact.matrices):
            self.forms[power, :-1] = (back.T @ matrix @ back)[:4, :4][upper] * twice / length**2
        self.forms[:, -1] = exact.constants / length**2
