"""The best constant damping."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from roadgym.cars import Car, make_car
from roadgym.parameters import positive_range, within
from roadgym.reward import asked_signals, check_weights, cost_unit
from roadgym.roads import Road, make_road
from roadgym.speed import SpeedNoise, make_speed_noise

from .checks import FloatArray, broadcast, check_size
from .driven import driven_optimum
from .response import RELATIVE_ERROR, checked_bandwidth, checked_speed, has_closed_form, mean_squares, needs_simulation

DISPLACEMENT: Mapping[str, float] = MappingProxyType({"displacement": 1.0})
COARSE, FINE, ROUNDS = 129, 17, 8  # points of the first grid and of each finer one; the bracket shrinks by 8 a round


@dataclasses.dataclass(frozen=True, kw_only=True)
class Optimum:
    """The best constant damping and what it costs, each in the common shape of the arguments.

    Args:
        damping: D, 1.
        cost: weighted mean squares over the road's variance, or over the car's `cost_unit`: minus the mean reward.
        standard_error: standard errors of both, where they come from simulation; None where they are exact.
    """

    damping: FloatArray
    cost: FloatArray
    standard_error: Optimum | None = None


def optimal_damping(
    road: str | Mapping[str, Any] | Road,
    speed_noise: str | Mapping[str, Any] | SpeedNoise | None = None,
    *,
    speed: npt.ArrayLike,
    natural_frequency: float | None = None,
    car: str | Mapping[str, Any] | Car | None = None,
    weights: Mapping[str, float] = DISPLACEMENT,
    bounds: tuple[float, float] | None = None,
    bandwidth: npt.ArrayLike | None = None,
    relative_error: float = RELATIVE_ERROR,
) -> Optimum:
    """The constant damping within ``bounds`` at which the weighted mean squares are least.

    The global minimum: a grid even in log D finds its neighbourhood, ever finer ones the minimum, to about 1e-8 of itself, as
    far as rounding lets it be seen. A minimum at a bound is exactly that bound; where the cost is flat, the bound goes first.
    Bounds are needed because the best damping may be infinite, as for the displacement on second-order and harmonic roads at
    speeds below sqrt(2) w1/wavenumber, or zero.

    Low-pass noise on a random road has no closed form: there the plant is driven at a grid of dampings over the same noise,
    then at a finer one about the least cost, and a cubic in log D through its costs has the minimum. The result has standard
    errors, that of a damping on a bound being zero. It takes seconds for each operating point, and the same call gives the
    same numbers.

    Args:
        road: a road, or its name or mapping.
        speed_noise: noise on the speed, or its name or mapping, or None.
        speed: v >= 0, m/s, any shape.
        natural_frequency: w1 of the car of one mass, rad/s, 1 by default; in place of ``car``.
        car: a car, or its name or mapping; the car of one mass by default.
        weights: weights of the mean squares, as of the reward of the environment.
        bounds: smallest and largest damping, 0 < low <= high; the car's range by default, (0.05, 1) of one mass.
        bandwidth: delta > 0, 1, in place of the road's, at the same variance; any shape that broadcasts with ``speed``.
        relative_error: standard error over the mean, 1, at which a simulation ends.

    Raises:
        ParameterError: a value out of range, or a weight on a mean square that diverges.
    """
    road = make_road(road)
    speed_noise = make_speed_noise(speed_noise, road)
    the_car = make_car(car, natural_frequency).with_signals(asked_signals(weights))
    checked = check_weights(weights, the_car, road, speed_noise)
    driven = needs_simulation(road, speed_noise, the_car)
    closed = has_closed_form(road, the_car) and not driven
    bounds = the_car.default_damping_range if bounds is None else bounds
    low, high = positive_range("bounds", bounds, "constant damping" if closed else "damping")
    relative_error = within("relative_error", relative_error)
    if speed_noise is not None:
        speed_noise.check_range(the_car.natural_frequency, driven=driven)
    arrays = {"speed": checked_speed(speed, road, the_car.natural_frequency)}
    if bandwidth is not None:
        arrays["bandwidth"] = checked_bandwidth(bandwidth, road)
    speed, *rest = broadcast(**arrays)
    check_size("operating points", "speed and bandwidth", speed.size, "driven points" if driven else "operating points")
    if driven:
        found = np.empty((4, *speed.shape))
        for index in np.ndindex(speed.shape):
            here = road.with_bandwidth(float(rest[0][index])) if rest else road
            found[:, *index] = driven_optimum(
                here,
                speed_noise,
                speed=float(speed[index]),
                car=the_car,
                weights=tuple(checked.values()),
                bounds=(low, high),
                relative_error=relative_error,
            )
        damping, cost, *errors = (part[()] for part in found)
        return Optimum(damping=damping, cost=cost, standard_error=Optimum(damping=errors[0], cost=errors[1]))

    def cost_of(damping: FloatArray) -> FloatArray:
        result = mean_squares(
            road,
            speed_noise,
            damping=damping,
            speed=speed,
            car=the_car,
            bandwidth=rest[0] if rest else None,
        )
        return np.asarray(sum(weight * result[name] for name, weight in checked.items() if weight) / cost_unit(the_car, road))

    points = np.geomspace(np.full(speed.shape, low), high, COARSE)
    for _ in range(ROUNDS + 1):
        costs = cost_of(points)
        best = np.argmin(costs, axis=0, keepdims=True)
        damping, cost = np.take_along_axis(points, best, 0)[0], np.take_along_axis(costs, best, 0)[0]
        left = np.take_along_axis(points, np.maximum(best - 1, 0), 0)[0]
        right = np.take_along_axis(points, np.minimum(best + 1, len(points) - 1), 0)[0]
        points = np.linspace(left, right, FINE)
    for bound in (high, low):
        at_bound = cost_of(np.full(speed.shape, bound))
        flat = at_bound <= cost * (1 + 4 * np.finfo(np.float64).eps)
        damping, cost = np.where(flat, bound, damping), np.where(flat, at_bound, cost)
    return Optimum(damping=damping[()], cost=cost[()])
