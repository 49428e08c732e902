"""The reward: minus the cost, a weighted sum of the interval's mean squares over a unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from .cars import Car
from .moved import moved
from .parameters import ParameterError, non_negative, shown, within
from .roads import Road
from .speed import SpeedNoise

if not TYPE_CHECKING:
    __getattr__ = moved(__name__, MEAN_SQUARES="roadgym.cars")


def cost_unit(car: Car, road: Road) -> float:
    """What weighted mean squares, as they are told, are divided by to be the cost: E Z^2 of the road, or the car's own unit."""
    return road.variance if car.cost_unit is None else car.cost_unit


def divergent_terms(car: Car, road: Road, speed_noise: SpeedNoise | None) -> tuple[str, ...]:
    """Mean squares that are infinite on this plant, because the road's rate of change contains white noise."""
    smooth = road.has_slope and (speed_noise is None or speed_noise.smooth)
    return () if smooth else car.motion.rough


def divergence_cause(road: Road, speed_noise: SpeedNoise | None) -> str:
    """What makes them so, for a message."""
    return f"{speed_noise.kind} speed noise" if speed_noise and road.has_slope else f"a {road.kind} road"


def asked_signals(*lists: Any) -> list[str]:
    """The names of signals in rewards and observations, before these are checked."""
    return [name for names in lists if isinstance(names, (Mapping, Sequence)) for name in names if isinstance(name, str)]


def check_weights(weights: Mapping[str, float], car: Car, road: Road, speed_noise: SpeedNoise | None) -> dict[str, float]:
    """The weights of the reward by mean square of the car, all of them, zero where none was given.

    Raises:
        ParameterError: an unknown mean square, a negative weight, no positive weight, or weight on one that diverges.
    """
    known = car.mean_squares
    if not isinstance(weights, Mapping):
        raise ParameterError(f"reward must be a mapping from {', '.join(known)} to weights, got {shown(weights)}")
    for name in weights:
        if name not in known:
            offered = dict.fromkeys((*known, *car.optional))
            raise ParameterError(f"unknown reward term {shown(name)}; known: {', '.join(offered)}")
    result = {name: _weight(f"weight of {name}", weights.get(name, 0.0)) for name in known}
    if not any(result.values()):
        raise ParameterError(f"reward needs at least one positive weight, got {shown(dict(weights))}")
    for name in divergent_terms(car, road, speed_noise):
        if result[name]:
            cause = divergence_cause(road, speed_noise)
            raise ParameterError(f"the mean square of {name} is infinite on {cause}, so its weight must be 0")
    return result


def _weight(name: str, value: Any) -> float:
    """Zero, or a number in the range of weights."""
    return within(name, value, "weight") if non_negative(name, value) else 0.0
