"""Checks of parameters, with messages that name the parameter, the value and what is allowed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any


class ParameterError(ValueError):
    """A parameter outside its range, of the wrong kind, or in a combination that is not defined."""


def number(name: str, value: Any) -> float:
    """``value`` as a finite float."""
    try:
        result = float(value)
    except (TypeError, ValueError):
        raise ParameterError(f"{name} must be a number, got {value!r}") from None
    if not math.isfinite(result):
        raise ParameterError(f"{name} must be finite, got {value!r}")
    return result


def positive(name: str, value: Any) -> float:
    """``value`` as a finite float above zero."""
    result = number(name, value)
    if result <= 0:
        raise ParameterError(f"{name} must be positive, got {value!r}")
    return result


def non_negative(name: str, value: Any) -> float:
    """``value`` as a finite float, zero or above."""
    result = number(name, value)
    if result < 0:
        raise ParameterError(f"{name} must not be negative, got {value!r}")
    return result


def positive_range(name: str, value: Any) -> tuple[float, float]:
    """``(low, high)`` with 0 < low <= high, from a pair or from one number."""
    if isinstance(value, (str, Mapping)) or not hasattr(value, "__len__"):
        single = positive(name, value)
        return single, single
    if len(value) != 2:
        raise ParameterError(f"{name} must be one number or a pair (low, high), got {value!r}")
    low, high = positive(f"{name}, low end,", value[0]), positive(f"{name}, high end,", value[1])
    if low > high:
        raise ParameterError(f"{name} must be a pair (low, high) with low <= high, got {value!r}")
    return low, high


def whole(name: str, value: Any, *, low: int = 1) -> int:
    """``value`` as an integer, at least ``low``."""
    if isinstance(value, bool) or not hasattr(value, "__index__"):
        raise ParameterError(f"{name} must be an integer, got {value!r}")
    result = int(value.__index__())
    if result < low:
        raise ParameterError(f"{name} must be at least {low}, got {value!r}")
    return result
