"""The advantage of a damping ratio, by theory: what one control interval with it costs more than the best constant damping.

Let h(s) be the relative value of a constant damping D*, a quadratic form of the state s = (Y, X, Z, U) by a Lyapunov equation,
and rho its mean cost. Over one control interval T

    A(s, D) = E[integral of the cost over T + h(s(T)) | s, D] - h(s) - rho T,

again a quadratic form of s for each D, plus a constant: the generator maps quadratic forms to quadratic forms on the Gaussian
and on the bounded road alike, whose noise along U has the intensity 4 delta nu (1 + (1 - (Z^2 + U^2)/2)/alpha), with
1/alpha = 0 on the Gaussian road. By the performance difference lemma (S. Kakade and J. Langford, "Approximately optimal
approximate reinforcement learning", ICML 2002) the mean of A/T over any policy's drive is that policy's mean cost minus rho.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from roadgym.roads import GaussianRoad, MultiplicativeRoad
from roadgym.task import Task

Floats = npt.NDArray[np.float64]

LARGEST_STEP = 0.08  # of the fastest rate times a step of fourth order; the error of a step is about its fifth power over 120


def has_advantage(task: Task) -> bool:
    """Is it known: on a Gaussian road, or a bounded one on a circle, at a constant speed?"""
    known = isinstance(task.road, GaussianRoad) or (isinstance(task.road, MultiplicativeRoad) and task.road.is_circle)
    return known and task.speed_noise is None


def mean_drift(damping: npt.ArrayLike, ratio: npt.ArrayLike, bandwidth: npt.ArrayLike) -> Floats:
    """Drift matrix of (Y, X, Z, U) at constant damping, in units of time 1/w1; (7), (13) of Wedig (2020).

    Arguments broadcast; the result has their shape and two axes of length 4 after it.
    """
    d, nu, delta = np.broadcast_arrays(*(np.asarray(value, float) for value in (damping, ratio, bandwidth)))
    drift = np.zeros((*d.shape, 4, 4))
    drift[..., 0, 1] = 1
    drift[..., 1, :] = np.stack([-np.ones(d.shape), -2 * d, np.ones(d.shape), 2 * d * nu], axis=-1)
    drift[..., 2, 3] = nu
    drift[..., 3, 2], drift[..., 3, 3] = -nu, -2 * delta * nu
    return drift


def cost_form(task: Task, damping: npt.ArrayLike, ratio: npt.ArrayLike) -> Floats:
    """The weighted squares as a quadratic form of (Y, X, Z, U); shapes as for `mean_drift`."""
    d, nu = np.broadcast_arrays(np.asarray(damping, float), np.asarray(ratio, float))
    one, nothing = np.ones(d.shape), np.zeros(d.shape)
    rows = {
        "displacement": (one, nothing, nothing, nothing),
        "velocity": (nothing, one, nothing, nothing),
        "acceleration": (one, 2 * d, -one, -2 * d * nu),
        "travel": (one, nothing, -one, nothing),
        "relative_velocity": (nothing, one, nothing, -nu),
    }
    total = np.zeros((*d.shape, 4, 4))
    for name, weight in task.weights_by_name.items():
        row = np.stack(rows[name], axis=-1)
        total += weight * row[..., :, None] * row[..., None, :]
    return total


def _noise(task: Task, ratio: Floats, bandwidth: Floats) -> tuple[Floats, Floats]:
    """(constant, slope) of the noise's intensity along U, as a function of Z^2 + U^2."""
    road = task.road
    flatness = 1 / road.shape if isinstance(road, MultiplicativeRoad) and road.is_circle else 0.0
    intensity = 4 * bandwidth * ratio
    return intensity * (1 + flatness), -0.5 * intensity * flatness


def value_form(task: Task, damping: npt.ArrayLike, ratio: npt.ArrayLike, bandwidth: npt.ArrayLike) -> tuple[Floats, Floats]:
    """(h, rho): relative value of constant dampings as a quadratic form, in units of time 1/w1, and their mean cost.

    Shapes as for `mean_drift`. The road has unit variance.
    """
    drift, identity = mean_drift(damping, ratio, bandwidth), np.eye(4)
    constant, slope = _noise(task, np.asarray(ratio, float), np.asarray(bandwidth, float))
    transposed = np.swapaxes(drift, -1, -2)
    # A' P + P A + slope P_UU diag(0, 0, 1, 1) = -C as a system for the 16 entries of P
    whole = np.einsum("...ik,jl->...ijkl", transposed, identity) + np.einsum("...jl,ik->...ijkl", transposed, identity)
    whole[..., 2, 2, 3, 3] += slope
    whole[..., 3, 3, 3, 3] += slope
    cost = np.broadcast_to(cost_form(task, damping, ratio), drift.shape)
    shape = drift.shape[:-2]
    value = np.linalg.solve(whole.reshape(*shape, 16, 16), -cost.reshape(*shape, 16, 1)).reshape(*shape, 4, 4)
    return value, constant * value[..., 3, 3]


def advantage_forms(
    task: Task, dampings: npt.ArrayLike, reference: npt.ArrayLike, ratio: npt.ArrayLike, bandwidth: npt.ArrayLike
) -> tuple[Floats, Floats]:
    """(forms, constants): A(s, D) = s' form s + constant of each of ``dampings``, in units of time 1/w1.

    Args:
        task: the road's kind, the weights, the control interval and the car.
        dampings: damping ratios D, shape (choices,).
        reference: the constant damping D* to compare with, shape (n,).
        ratio, bandwidth: frequency ratio nu and bandwidth delta, shape (n,).

    Returns:
        Arrays of shape (n, choices, 4, 4) and (n, choices).
    """
    choices = np.asarray(dampings, float)
    base, nu, delta = (np.asarray(value, float)[:, None] for value in (reference, ratio, bandwidth))
    interval = task.control_interval * task.car.natural_frequency
    fastest = 2 * max(1.0, float(np.max(nu)), 2 * float(np.max(choices)))  # squares change twice as fast as the state
    steps = max(1, math.ceil(interval * fastest / LARGEST_STEP))
    step = interval / steps
    value, mean_cost = value_form(task, base, nu, delta)
    drift, cost = mean_drift(choices, nu, delta), cost_form(task, choices, nu)
    constant, slope = _noise(task, nu, delta)
    road_square = np.diag([0.0, 0.0, 1.0, 1.0])
    forms = np.broadcast_to(value, drift.shape)
    constants = np.broadcast_to(-mean_cost * interval, drift.shape[:-2])
    for _ in range(steps):  # backwards in time, by Taylor's series of both to fourth order
        derivative, factor, moved = forms, 1.0, forms
        for order in range(1, 5):
            factor = factor * step / order
            constants = constants + factor * constant * derivative[..., 3, 3]
            half = derivative @ drift
            derivative = half + np.swapaxes(half, -1, -2) + (slope * derivative[..., 3, 3])[..., None, None] * road_square
            if order == 1:
                derivative = derivative + cost
            moved = moved + factor * derivative
        forms = moved
    return forms - value, constants
