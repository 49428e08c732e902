"""Checks of arrays and choices: companions of `roadgym.parameters`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from roadgym.parameters import ParameterError

FloatArray: TypeAlias = npt.NDArray[np.float64]
ComplexArray: TypeAlias = npt.NDArray[np.complex128]


def number_array(name: str, value: Any) -> FloatArray:
    """``value``, a number or an array of any shape, as a float array without NaN or infinity."""
    try:
        array = np.asarray(value)
    except ValueError:  # ragged
        array = np.asarray(None)
    if array.dtype.kind not in "biuf":
        raise ParameterError(f"{name} must be a number or an array of numbers, got {value!r}")
    result = array.astype(np.float64)
    _require(name, "finite", result, np.isfinite(result))
    return result


def positive_array(name: str, value: Any) -> FloatArray:
    """``value``, a number or an array of any shape, as a float array above zero."""
    result = number_array(name, value)
    _require(name, "positive", result, result > 0)
    return result


def non_negative_array(name: str, value: Any) -> FloatArray:
    """``value``, a number or an array of any shape, as a float array, zero or above."""
    result = number_array(name, value)
    _require(name, "zero or above", result, result >= 0)
    return result


def _require(name: str, what: str, array: FloatArray, allowed: Any) -> None:
    if not np.all(allowed):
        raise ParameterError(f"{name} must be {what}, got {array[~allowed].flat[0]}")


def one_of(name: str, value: Any, allowed: Iterable[str]) -> str:
    """``value`` if it is among the ``allowed`` names."""
    names = list(allowed)
    if value not in names:
        raise ParameterError(f"{name} must be one of {', '.join(names)}, got {value!r}")
    return str(value)


def broadcast(**arrays: FloatArray) -> tuple[FloatArray, ...]:
    """The arrays, by name, in their common shape."""
    try:
        return tuple(np.broadcast_arrays(*arrays.values()))
    except ValueError:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise ParameterError(f"shapes do not broadcast: {shapes}") from None
