"""The reward: minus a weighted sum of the interval's mean squares, over the variance of the road."""

from __future__ import annotations

from collections.abc import Mapping

from .car import MEAN_SQUARES
from .parameters import ParameterError, non_negative
from .roads import Road
from .speed import SpeedNoise


def divergent_terms(road: Road, speed_noise: SpeedNoise | None) -> tuple[str, ...]:
    """Mean squares that are infinite on this plant, because the road's rate of change contains white noise."""
    if road.has_slope and (speed_noise is None or speed_noise.smooth):
        return ()
    return "acceleration", "relative_velocity"


def check_weights(weights: Mapping[str, float], road: Road, speed_noise: SpeedNoise | None = None) -> dict[str, float]:
    """The weights of the reward by mean square, all five, zero where none was given.

    Raises:
        ParameterError: an unknown mean square, a negative weight, no positive weight, or weight on one that diverges.
    """
    if not isinstance(weights, Mapping):
        raise ParameterError(f"reward must be a mapping from {', '.join(MEAN_SQUARES)} to weights, got {weights!r}")
    for name in weights:
        if name not in MEAN_SQUARES:
            raise ParameterError(f"unknown reward term {name!r}; known: {', '.join(MEAN_SQUARES)}")
    result = {name: non_negative(f"weight of {name}", weights.get(name, 0.0)) for name in MEAN_SQUARES}
    if not any(result.values()):
        raise ParameterError(f"reward needs at least one positive weight, got {dict(weights)!r}")
    for name in divergent_terms(road, speed_noise):
        if result[name]:
            cause = f"{speed_noise.kind} speed noise" if speed_noise and road.has_slope else f"a {road.kind} road"
            raise ParameterError(f"the mean square of {name} is infinite on {cause}, so its weight must be 0")
    return result
