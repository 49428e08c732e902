"""The advantage of a damping ratio over the best constant one, as agents use it; the mathematics is in `analysis.quadratic`."""

from __future__ import annotations

from analysis.quadratic import advantage_forms, has_quadratic_value
from roadgym.task import OPERATING_POINT, Task

__all__ = ["advantage_forms", "has_advantage", "is_differentiable", "operating_point", "state_of"]

ROAD_STATES = {"level", "slope"}  # those of a road that the environments tell
DIFFERENTIABLE = {"valve.delay", "valve.rise_time", "valve.fall_time"}  # fields by which cars may differ


def state_of(task: Task) -> tuple[str, ...]:
    """Names of the states of car and road, such as (Y, X, Z, U); of the car alone on a road that is no filter."""
    road = task.road.shaping_filter()
    return task.car.motion.states + (() if road is None else road.states)


def operating_point(task: Task) -> tuple[str, ...]:
    """Names of what makes an operating point of ``task``: the speed, and the bandwidth on a road that has one."""
    return OPERATING_POINT if task.bandwidth[1] > 0 else OPERATING_POINT[:1]


def is_differentiable(task: Task, estimator: str | None = None) -> bool:
    """Can a policy be differentiated through the plant?

    That is where cars differ by delays and lags of their valves at most, whose rate is not limited, and what is seen is what
    there is; or, of cars that are alike behind an ideal valve, an ``estimator`` makes one filter a car of sensors that tell at
    once and have no biases, where the operating point is known.
    """
    if estimator is None:
        differ = set() if task.vary is None else {*task.vary.names}
        return task.valve.rate is None and differ <= DIFFERENTIABLE and not task.real_sensors
    if task.vary is not None or not task.ideal_valve:
        return False
    known = {"speed": task.speed[0] == task.speed[1], "bandwidth": task.bandwidth[0] == task.bandwidth[1]}
    at_once = all(sensor.delay == sensor.interval == sensor.bias == 0 for sensor in task.real_sensors.values())
    return at_once and all(known[name] or name in task.signals for name in OPERATING_POINT)


def has_advantage(task: Task) -> bool:
    """Is it known, and a form of what the batch environment tells of the state?"""
    road = task.road.shaping_filter()
    told = road is not None and set(road.states) <= ROAD_STATES and not task.car.motion.filters
    return has_quadratic_value(task) and told
