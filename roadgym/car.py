"""The former place of `roadgym.cars.one_mass`."""

import warnings

from .cars.one_mass import MEAN_SQUARES, MOTION, QuarterCar, free_decay

__all__ = ["MEAN_SQUARES", "MOTION", "QuarterCar", "free_decay"]

warnings.warn("roadgym.car is now roadgym.cars", DeprecationWarning, stacklevel=2)
