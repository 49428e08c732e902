"""A Gymnasium environment whose plant is a quarter car on a random road, after W. V. Wedig (ENOC 2020).

Importing this package registers ``roadgym/QuarterCar-v0`` with Gymnasium, for `gymnasium.make` and `gymnasium.make_vec`, and
the tasks of the suite, `roadgym.suite`.
"""

from __future__ import annotations

from typing import Any

import gymnasium

from .cars import CARS, MEAN_SQUARES, Car, LinearCar, QuarterCar, TwoMassCar
from .parameters import ParameterError, PlantError
from .roads import (
    ROADS,
    FirstOrderRoad,
    GaussianRoad,
    HarmonicRoad,
    LinearRoad,
    MultiplicativeRoad,
    PowerLawRoad,
    Profile,
    ProfileRoad,
    Road,
    TwoCornerRoad,
    read_profile,
    sample_road,
)
from .sensors import Sensors
from .speed import SPEED_NOISES, HighPassSpeedNoise, LowPassSpeedNoise, SpeedNoise, WhiteSpeedNoise
from .suite import TASKS, SuiteTask
from .valve import Valve

__all__ = [
    "CARS",
    "ENVIRONMENT_ID",
    "MEAN_SQUARES",
    "ROADS",
    "SPEED_NOISES",
    "TASKS",
    "Car",
    "FirstOrderRoad",
    "GaussianRoad",
    "HarmonicRoad",
    "HighPassSpeedNoise",
    "LinearCar",
    "LinearRoad",
    "LowPassSpeedNoise",
    "MultiplicativeRoad",
    "ParameterError",
    "PlantError",
    "PowerLawRoad",
    "Profile",
    "ProfileRoad",
    "QuarterCar",
    "Road",
    "Sensors",
    "SpeedNoise",
    "SuiteTask",
    "TwoCornerRoad",
    "TwoMassCar",
    "Valve",
    "WhiteSpeedNoise",
    "__version__",
    "read_profile",
    "register",
    "sample_road",
]

__version__ = "0.1.0"

ENVIRONMENT_ID = "roadgym/QuarterCar-v0"


def register(what: str, name: str, component: type) -> None:
    """Add a component of one's own, for use by name in the environment, in theory and in every command.

    Args:
        what: "road", "speed_noise" or "car".
        name: its kind.
        component: a frozen keyword-only dataclass, a `Road`, a `SpeedNoise` or a `Car`.

    Raises:
        ParameterError: no such sort of component, a class of another sort, or a name that is taken.
    """
    tables: dict[str, Any] = {"road": ROADS, "speed_noise": SPEED_NOISES, "car": CARS}
    if what not in tables:
        raise ParameterError(f"what must be one of {', '.join(tables)}, got {what!r}")
    tables[what].register(name, component)


for _id, _steps, _parameters in (
    (ENVIRONMENT_ID, 500, {}),
    *((task.id, task.max_episode_steps, dict(task.parameters)) for task in TASKS.values()),
):
    gymnasium.register(
        id=_id,
        entry_point="roadgym.env:QuarterCarEnv",
        vector_entry_point="roadgym.vector:QuarterCarVectorEnv",
        max_episode_steps=_steps,
        kwargs=_parameters,
    )
