"""Car models. To add one: write a file like its neighbours and a line in `CARS`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..component import Registry
from ..parameters import ParameterError, within
from .base import Car
from .linear import LinearCar
from .one_mass import MEAN_SQUARES, QuarterCar
from .two_mass import PRESETS, TwoMassCar

__all__ = ["CARS", "MEAN_SQUARES", "Car", "LinearCar", "QuarterCar", "TwoMassCar", "make_car"]

CARS: Registry[Car] = Registry("car", Car, {"one_mass": QuarterCar, "two_mass": TwoMassCar}, PRESETS)


def make_car(car: str | Mapping[str, Any] | Car | None, natural_frequency: float | None = None) -> Car:
    """A car from its name, from a mapping with the key "kind" and its parameters, or as it is.

    Args:
        car: what it is made from; None for the car of one mass.
        natural_frequency: w1 of the car of one mass, rad/s, 1 by default; not beside ``car``.

    Raises:
        ParameterError: unknown kind or parameter, a value out of range, or both arguments.
    """
    if car is None:
        made: Car = QuarterCar(
            natural_frequency=1.0 if natural_frequency is None else within("natural_frequency", natural_frequency)
        )
    elif natural_frequency is not None:
        raise ParameterError(
            "natural_frequency must not be given beside car: it is a parameter of that car, or follows from its parameters"
        )
    else:
        made = CARS.make(car)
    within(f"natural_frequency of the {made.kind} car", made.natural_frequency, "natural_frequency")
    return made
