"""Checks of arrays and choices: companions of `roadgym.parameters`."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from roadgym.parameters import RANGES, ParameterError, check_ratio, number_array, shown

FloatArray: TypeAlias = npt.NDArray[np.float64]
ComplexArray: TypeAlias = npt.NDArray[np.complex128]


def range_array(name: str, value: Any, of: str) -> FloatArray:
    """``value``, a number or an array of any shape, as a float array in the range ``of`` of `roadgym.parameters.RANGES`."""
    allowed, result = RANGES[of], number_array(name, value)
    if allowed.low > 0:
        _require(name, "positive", result, result > 0)
    if allowed.low == 0:
        _require(name, "zero or above", result, result >= 0)
    inside = (result >= allowed.low) & (result <= allowed.high)
    _require(name, f"within [{allowed.low:g}, {allowed.high:g}]", result, inside)
    return result


def ratio_array(name: str, value: FloatArray, what: str, ratio: FloatArray, of: str) -> None:
    """Raise unless the dimensionless ``ratio``, ``what`` in words, in which ``name`` enters, is in the range ``of``."""
    value, ratio = np.broadcast_arrays(value, ratio)
    outside = (ratio < RANGES[of].low) | (ratio > RANGES[of].high)
    if outside.any():
        check_ratio(name, float(value[outside].flat[0]), what, float(ratio[outside].flat[0]), of)


def _require(name: str, what: str, array: FloatArray, allowed: Any) -> None:
    if not np.all(allowed):
        raise ParameterError(f"{name} must be {what}, got {array[~allowed].flat[0]}")


def one_of(name: str, value: Any, allowed: Iterable[str]) -> str:
    """``value`` if it is among the ``allowed`` names."""
    names = list(allowed)
    if not isinstance(value, str) or value not in names:
        raise ParameterError(f"{name} must be one of {', '.join(names)}, got {shown(value)}")
    return str(value)


def broadcast(**arrays: FloatArray) -> tuple[FloatArray, ...]:
    """The arrays, by name, in their common shape, which must not be too large."""
    shapes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
    try:
        size = math.prod(np.broadcast_shapes(*(array.shape for array in arrays.values())))
    except ValueError:
        raise ParameterError(f"shapes do not broadcast: {shapes}") from None
    check_size("entries in the common shape", shapes, size, "array size")
    return tuple(np.broadcast_arrays(*arrays.values()))


def check_size(what: str, shapes: str, size: float, of: str) -> None:
    """Raise unless there are at most as many of ``what`` as the range ``of`` allows; ``shapes`` says what made them."""
    if size > RANGES[of].high:
        raise ParameterError(f"{shapes} must make at most {RANGES[of].high:.0f} {what}, got {size:.0f}")


@contextlib.contextmanager
def single_threaded_algebra() -> Iterator[None]:
    """Linear algebra of NumPy and scipy on one thread, whatever their libraries would take.

    Matrices here have a few hundred rows: threads wait for each other longer than they compute, on busy processors many times
    as long. Without threadpoolctl, of the extra bounds, the threads are left to the environment, as by OPENBLAS_NUM_THREADS.
    """
    import scipy.linalg  # noqa: F401 - a library must be loaded to be limited

    try:
        from threadpoolctl import threadpool_limits
    except ImportError:
        limited: contextlib.AbstractContextManager[object] = contextlib.nullcontext()
    else:
        limited = threadpool_limits(1, user_api="blas")
    with limited:
        yield
