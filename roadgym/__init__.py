"""A Gymnasium environment whose plant is a quarter car on a random road, after W. V. Wedig (ENOC 2020).

Importing this package registers ``roadgym/QuarterCar-v0`` with Gymnasium, for `gymnasium.make` and `gymnasium.make_vec`.
"""

from __future__ import annotations

import gymnasium

from .car import MEAN_SQUARES, QuarterCar
from .parameters import ParameterError
from .roads import ROADS, FirstOrderRoad, GaussianRoad, HarmonicRoad, MultiplicativeRoad, Road
from .speed import SPEED_NOISES, HighPassSpeedNoise, LowPassSpeedNoise, SpeedNoise, WhiteSpeedNoise

__all__ = [
    "ENVIRONMENT_ID",
    "MEAN_SQUARES",
    "ROADS",
    "SPEED_NOISES",
    "FirstOrderRoad",
    "GaussianRoad",
    "HarmonicRoad",
    "HighPassSpeedNoise",
    "LowPassSpeedNoise",
    "MultiplicativeRoad",
    "ParameterError",
    "QuarterCar",
    "Road",
    "SpeedNoise",
    "WhiteSpeedNoise",
    "__version__",
]

__version__ = "0.1.0"

ENVIRONMENT_ID = "roadgym/QuarterCar-v0"

gymnasium.register(
    id=ENVIRONMENT_ID,
    entry_point="roadgym.env:QuarterCarEnv",
    vector_entry_point="roadgym.vector:QuarterCarVectorEnv",
    max_episode_steps=500,
)
