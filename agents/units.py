"""How figures are told to people: as frequency ratios and shares of E Z^2, or in m/s, km/h, m/s², mm and N of a car in SI."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from roadgym.reward import divergent_terms
from roadgym.task import Task

from .evaluation import OperatingPoint

KILOMETRES_PER_HOUR = 3.6
LARGER = {"m": ("mm", 1e3)}  # by a unit, the one that people use for what a car does
SHOWN = ("acceleration", "weighted_acceleration", "travel", "wheel_load")  # first of a car in SI


def in_si(task: Task) -> bool:
    """Is the car told in SI units, with a cost that is no share of the road's variance?"""
    return task.car.cost_unit is not None


def place(task: Task, point: OperatingPoint) -> str:
    """An operating point in words."""
    words = f"{point.speed:.3g} m/s" if in_si(task) else f"nu = {task.frequency_ratio(point.speed):.3g}"
    return words + (f", delta = {point.bandwidth:g}" if point.bandwidth else "")


def abscissa(task: Task, speed: Any) -> Any:
    """Speeds, m/s, as figures have them: in km/h, or as frequency ratios."""
    return KILOMETRES_PER_HOUR * speed if in_si(task) else task.frequency_ratio(speed)


def unit(task: Task, name: str) -> tuple[str, float]:
    """In which a root mean square is told, and how many of it are one of the car's unit."""
    own = task.car.motion.signals[name].unit
    return LARGER.get(own, (own, 1.0))


def root(task: Task, name: str, square: float) -> float:
    """A mean square of `agents.results.Row.squares` as a root mean square in its `unit`; of a car in SI."""
    return unit(task, name)[1] * math.sqrt(max(square, 0.0) * task.cost_unit)


def shown(task: Task) -> list[str]:
    """The signals that say what a drive in a car in SI is like, in order, as far as they are finite."""
    infinite = divergent_terms(task.car, task.road, task.speed_noise)
    return [name for name in SHOWN if name in task.car.mean_squares and name not in infinite]


def column(values: Sequence[float]) -> list[str]:
    """Figures in one form, so that the least has three digits."""
    finite = [abs(value) for value in values if math.isfinite(value) and value]
    decimals = max(0, 2 - math.floor(math.log10(min(finite)))) if finite else 0
    return [f"{value:.{decimals}f}" if math.isfinite(value) else "infinite" for value in values]


def squared(task: Task, name: str) -> str:
    """The unit of a mean square."""
    own = task.car.motion.signals[name].unit
    return f"({own})²" if "/" in own else f"{own}²"


def weighted(task: Task) -> str:
    """The cost in words."""

    def term(name: str, weight: float) -> str:
        told = f"{name.replace('_', ' ')} in {squared(task, name)}" if in_si(task) else name
        return (f"{weight:g} " if weight != 1 else "") + told

    return " + ".join(term(name, weight) for name, weight in task.reward_by_name.items())
