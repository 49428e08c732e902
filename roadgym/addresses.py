"""What compiled code is given of a component: its functions by their addresses, and its constants."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from .compiled import CompilationError, LaneFunction
from .parameters import ParameterError, number_array

if TYPE_CHECKING:
    from .cars import Car
    from .roads import Road
    from .speed import SpeedNoise

PADDING = 4096  # numbers after a table, all NaN: what reads beyond its end shows, and reads nobody else's memory


def padded_table(name: str, table: Any, dtype: np.dtype[Any], *, finite: bool = True) -> npt.NDArray[Any]:
    """The constants of a component for compiled code, with `PADDING` after them.

    Args:
        name: of the table, for messages.
        table: its numbers.
        dtype: of compiled code.
        finite: must they be; a bound of minus infinity is a constant too.

    Raises:
        ParameterError: no numbers in one row.
    """
    row = number_array(name, table) if finite else np.asarray(table, np.float64)
    if row.ndim != 1 or row.size == 0:
        raise ParameterError(f"{name} must be one row of numbers, got the shape {row.shape}")
    with np.errstate(over="ignore"):
        constants = row.astype(dtype)
    if np.any(np.isinf(constants) & np.isfinite(row)):
        raise ParameterError(f"{name} must have numbers that {dtype} holds, up to {np.finfo(dtype).max:.2g}")
    return np.concatenate([constants, np.full(PADDING, np.nan, dtype)])


def lane_address(component: Road | SpeedNoise | Car, function: LaneFunction | None, dtype: np.dtype[Any]) -> int:
    """Address of a component's function for the kernel, 0 where it has none.

    Raises:
        ParameterError: it does not compile.
    """
    try:
        return 0 if function is None else function.address(dtype)
    except CompilationError as error:
        raise ParameterError(f"a lane function of the {component.kind} component does not compile: {error}") from error
