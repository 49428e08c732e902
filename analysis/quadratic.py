"""Quadratic forms of the state: relative value, advantage, and the linear-quadratic regulator, for every linear plant.

Let h(x) be the relative value of a constant damping D*, a quadratic form of the state x = (car, road) by a Lyapunov equation,
and rho its mean cost. Over one control interval T

    A(x, D) = E[integral of the cost over T + h(x(T)) | x, D] - h(x) - rho T,

again a quadratic form of x for each D, plus a constant, as the generator maps quadratic forms to quadratic forms
(`roadgym.linear`). By the performance difference lemma (S. Kakade and J. Langford, "Approximately optimal approximate
reinforcement learning", ICML 2002) the mean of A/T over any policy's drive is that policy's mean cost minus rho.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from roadgym.linear import LinearSystem
from roadgym.parameters import ParameterError
from roadgym.task import Task

from .checks import FloatArray

PRICE = 0.01  # of the square of an active force, over the sum of the weights
LARGEST_STEP = 0.08  # of the fastest rate times a step of fourth order; the error of a step is about its fifth power over 120


def has_quadratic_value(task: Task) -> bool:
    """Is the relative value of a constant damping known: on a linear or bounded road with noise, at a constant speed?"""
    road = task.road.shaping_filter()
    return task.speed_noise is None and road is not None and road.flatness is not None and bool(road.noise.any())


def plant_system(
    task: Task, damping: npt.ArrayLike, ratio: npt.ArrayLike, bandwidth: npt.ArrayLike | None = None
) -> LinearSystem:
    """The plant of ``task`` at constant dampings D, frequency ratios nu and bandwidths, which broadcast.

    Raises:
        ParameterError: a road that is no linear filter, or noise on the speed.
    """
    if task.speed_noise is not None:
        raise ParameterError(f"speed_noise must be None for a linear plant, got {task.speed_noise.kind}")
    road = task.road.shaping_filter(bandwidth if task.bandwidth[1] > 0 else None)
    if road is None:
        raise ParameterError(f"road must be a linear filter, see roadgym.linear.ShapingFilter; a {task.road.kind} road is none")
    return LinearSystem.of(road, task.car.motion, damping=damping, ratio=ratio)


def value_form(system: LinearSystem, weights: Mapping[str, float]) -> tuple[FloatArray, FloatArray]:
    """(h, rho): relative value of the constant dampings as a quadratic form, in units of time 1/w1, and their mean cost.

    Shapes (..., n, n) and (...), of the road's variance 1.
    """
    generator, size = system.form_generator(), len(system.states)
    cost = system.cost_form(weights).reshape(*generator.shape[:-2], size * size, 1)
    value: FloatArray = np.linalg.solve(generator[..., :-1, :-1], -cost)[..., 0].astype(float)
    mean_cost: FloatArray = np.einsum("...i,...i->...", generator[..., -1, :-1], value)
    return value.reshape(*value.shape[:-1], size, size), mean_cost


def interval_forms(
    task: Task, value: FloatArray, dampings: npt.ArrayLike, ratio: npt.ArrayLike, bandwidth: npt.ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """(forms, constants): E[integral of the cost + h(x(T)) | x, D] - h(x) over one control interval, for any quadratic form h.

    Args:
        task: the plant, the weights and the control interval.
        value: h, shape (points, n, n).
        dampings: damping ratios D, shape (choices,).
        ratio, bandwidth: frequency ratio nu and bandwidth delta, shape (points,).

    Returns:
        Arrays of shape (points, choices, n, n) and (points, choices), in units of time 1/w1.
    """
    choices = np.asarray(dampings, float)
    nu, delta = (np.asarray(given, float)[:, None] for given in (ratio, bandwidth))
    interval = task.control_interval * task.car.natural_frequency
    rates = (task.car.fastest, float(np.max(nu)), 2 * task.car.firmness * float(np.max(choices)))
    steps = max(1, math.ceil(interval * 2 * max(rates) / LARGEST_STEP))  # squares change twice as fast as the state
    step = interval / steps
    system = plant_system(task, choices, nu, delta)
    cost = system.cost_form(task.weights_by_name)
    before = value[:, None]
    forms, constants = np.broadcast_to(before, cost.shape), np.zeros(cost.shape[:-2])
    for _ in range(steps):  # backwards in time, by Taylor's series of both to fourth order
        derivative, factor, moved = forms, 1.0, forms
        for order in range(1, 5):
            factor = factor * step / order
            derivative, gained = system.form_rate(derivative)
            constants = constants + factor * gained
            if order == 1:
                derivative = derivative + cost
            moved = moved + factor * derivative
        forms = moved
    return forms - before, constants


def advantage_forms(
    task: Task, dampings: npt.ArrayLike, reference: npt.ArrayLike, ratio: npt.ArrayLike, bandwidth: npt.ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """(forms, constants): A(x, D) = x' form x + constant of each of ``dampings``, in units of time 1/w1.

    Args:
        task: the plant, the weights and the control interval.
        dampings: damping ratios D, shape (choices,).
        reference: the constant damping D* to compare with, shape (points,).
        ratio, bandwidth: frequency ratio nu and bandwidth delta, shape (points,).

    Returns:
        Arrays of shape (points, choices, n, n) and (points, choices).
    """
    base, nu, delta = (np.asarray(given, float) for given in (reference, ratio, bandwidth))
    value, mean_cost = value_form(plant_system(task, base, nu, delta), task.weights_by_name)
    forms, constants = interval_forms(task, value, dampings, nu, delta)
    return forms, constants - mean_cost[:, None] * task.control_interval * task.car.natural_frequency


def interval_mean(system: LinearSystem, cost: FloatArray, interval: float) -> tuple[FloatArray, FloatArray]:
    """Conditional means over an interval, exact, as matrices on forms (see `roadgym.linear.LinearSystem.form_generator`).

    Args:
        system: the plant at one operating point.
        cost: a quadratic form, shape (n, n).
        interval: in units of 1/w1.

    Returns:
        The matrix that takes a form to the conditional mean of what it is after the interval, shape (n^2 + 1, n^2 + 1), and the
        form of the conditional mean of the integral of the cost over the interval, shape (n^2 + 1,).
    """
    from scipy.linalg import expm

    generator = system.form_generator()
    size = len(generator)
    integral = np.zeros((size + 1, size + 1))  # one row and column more integrate the cost
    integral[:-1, :-1] = generator
    integral[: size - 1, -1] = cost.reshape(-1)
    step = expm(integral * interval)
    return step[:-1, :-1], step[:-1, -1]


def regulator(system: LinearSystem, weights: Mapping[str, float], price: float) -> tuple[FloatArray, FloatArray]:
    """(gain, value) of the best active force u = -gain x in place of the damper's: the linear-quadratic regulator.

    Its cost is the weighted squares and ``price`` times u^2; the relative value is a quadratic form, on the linear twin of a
    bounded road. Shapes (n,) and (n, n); u is positive against the motion of the car, as the force of a damper whose D is zero
    in ``system``.
    """
    from scipy.linalg import solve_continuous_are

    size = len(system.states)
    entry = -system.force_entry[:, None]
    cross, square = np.zeros((size, 1)), np.array([[price]])
    for name, weight in weights.items():
        cross += weight * system.force[name] * system.signals[name][:, None]
        square = square + weight * system.force[name] ** 2
    value = solve_continuous_are(system.drift, entry, system.cost_form(weights), square, s=cross)
    return np.linalg.solve(square, entry.T @ value + cross.T)[0], np.asarray(value)


def active_force(task: Task, ratio: float, bandwidth: float) -> tuple[FloatArray, FloatArray]:
    """(gain, value) of `regulator` at an operating point of ``task``, in units of time 1/w1.

    The force pays with a hundredth of its mean square times the sum of the weights: without that the one for displacement or
    acceleration alone has no optimum.
    """
    weights = task.weights_by_name
    return regulator(plant_system(task, 0.0, ratio, bandwidth), weights, PRICE * sum(weights.values()))


def regulator_gain(system: LinearSystem, weights: Mapping[str, float], price: float) -> FloatArray:
    """The gain of `regulator`, shape (n,)."""
    return regulator(system, weights, price)[0]


def periodic_mean_squares(systems: Sequence[LinearSystem], interval: float) -> dict[str, FloatArray]:
    """Mean squares of the smooth signals by name where the damping runs through that of ``systems``, over and over.

    What the damping does is fixed beforehand, so the covariance repeats itself after a period, on every road whose second
    moments are known. In units of the road's variance.

    Args:
        systems: the plant at each damping, at one operating point; the road is the same.
        interval: how long each is held, in units of 1/w1.
    """
    twins = [dataclasses.replace(system, flatness=0.0) for system in systems]  # second moments do not know the difference
    steps = [(twin.transition(interval), twin.step_covariance(interval)) for twin in twins]
    covariance = twins[0].covariance()
    period, noise = np.eye(len(covariance)), np.zeros_like(covariance)
    for transition, added in steps:
        period, noise = transition @ period, transition @ noise @ transition.T + added
    cars = systems[0].car_states
    while np.abs(period[:, :cars]).max() > np.finfo(float).eps:  # until the car has forgotten how it started
        period, noise = period @ period, period @ noise @ period.T + noise
    covariance = period @ covariance @ period.T + noise
    found = {name: np.zeros(()) for name in systems[0].signals if name not in systems[0].rough}
    for twin, (transition, added) in zip(twins, steps, strict=True):
        for name in found:
            _, form = interval_mean(twin, twin.cost_form({name: 1.0}), interval)
            found[name] += (form[:-1] @ covariance.reshape(-1) + form[-1]) / (interval * len(systems))
        covariance = transition @ covariance @ transition.T + added
    return found
