"""The advantage of a damping ratio over the best constant one, as agents use it; the mathematics is in `analysis.quadratic`."""

from __future__ import annotations

from analysis.quadratic import advantage_forms, has_quadratic_value
from roadgym.task import Task

__all__ = ["STATE", "advantage_forms", "has_advantage"]

STATE = ("displacement", "velocity", "level", "slope")  # (Y, X, Z, U)


def has_advantage(task: Task) -> bool:
    """Is it known, and a form of what the batch environment tells of the state: on second-order roads at a constant speed?"""
    road = task.road.shaping_filter()
    return has_quadratic_value(task) and road is not None and task.car.motion.states + road.states == STATE
