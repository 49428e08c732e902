"""The advantage of a damping ratio over the best constant one, as agents use it; the mathematics is in `analysis.quadratic`."""

from __future__ import annotations

from analysis.quadratic import advantage_forms, has_quadratic_value
from roadgym.task import OPERATING_POINT, Task

__all__ = ["advantage_forms", "has_advantage", "hidden", "is_differentiable", "operating_point", "state_of"]

ROAD_STATES = {"level", "slope"}  # those of a road that the environments tell


def state_of(task: Task) -> tuple[str, ...]:
    """Names of the states of car and road, such as (Y, X, Z, U); of the car alone on a road that is no filter."""
    road = task.road.shaping_filter()
    return task.car.motion.states + (() if road is None else road.states)


def operating_point(task: Task) -> tuple[str, ...]:
    """Names of what makes an operating point of ``task``: the speed, and the bandwidth on a road that has one."""
    return OPERATING_POINT if task.bandwidth[1] > 0 else OPERATING_POINT[:1]


def is_differentiable(task: Task, estimator: str | None = None) -> bool:
    """Can a policy be differentiated through the plant?

    That is where the rate of valves is not limited, and what is seen is what there is; or where an ``estimator`` filters
    sensors that tell at once and have no biases, of cars behind ideal valves.
    """
    if estimator is None:
        differ = () if task.vary is None else task.vary.names
        return task.valve.rate is None and "valve.rate" not in differ and not task.real_sensors
    at_once = all(sensor.delay == sensor.interval == sensor.bias == 0 for sensor in task.real_sensors.values())
    return at_once and task.ideal_valve


def hidden(task: Task) -> tuple[str, ...]:
    """Names of what is drawn for each episode and not observed: of speed and bandwidth, and of the fields of car and valve."""
    ends = {name: getattr(task, name) for name in OPERATING_POINT}
    unseen = [name for name, (low, high) in ends.items() if low < high and name not in task.signals]
    return (*unseen, *(() if task.vary is None else task.vary.names))


def has_advantage(task: Task) -> bool:
    """Is it known, and a form of what the batch environment tells of the state?"""
    road = task.road.shaping_filter()
    told = road is not None and set(road.states) <= ROAD_STATES and not task.car.motion.filters
    return has_quadratic_value(task) and told
