"""Memory that is used again once nobody looks at it any more."""

from __future__ import annotations

import ctypes
import sys
from typing import Any

import numpy as np
import numpy.typing as npt

from .compiled import LINE

KEPT = 4  # arrays; whoever keeps more of them gets new ones


class Reused:
    """Arrays of one shape and type; each is handed out again when nobody else holds it, or a view of it.

    Args:
        shape, dtype: of the arrays.
        lines: do their rows begin at multiples of ``LINE`` bytes?

    Fresh memory costs more than what is written there, where it is large, and to ask for an address costs as much as to call
    the kernel, where it is small.
    """

    def __init__(self, shape: int | tuple[int, ...], dtype: npt.DTypeLike, lines: bool = False) -> None:
        self._shape, self._dtype, self._lines = shape, dtype, lines
        self._kept: list[tuple[npt.NDArray[np.generic], int]] = []
        self._unheld = -1

    def take(self) -> tuple[npt.NDArray[np.generic], int]:
        """An array that nobody else holds, with any content, and its address."""
        for pair in self._kept:
            if sys.getrefcount(pair[0]) == self._unheld:
                return pair
        array = self._fresh()
        pair = array, array.ctypes.data
        del array
        self._unheld = sys.getrefcount(pair[0])
        if len(self._kept) < KEPT:
            self._kept.append(pair)
        return pair

    def _fresh(self) -> npt.NDArray[np.generic]:
        if not self._lines or isinstance(self._shape, int):
            return np.empty(self._shape, self._dtype)
        (rows, count), size = self._shape, np.dtype(self._dtype).itemsize
        stride = -(-count * size // LINE) * LINE
        space = np.empty(rows * stride + LINE, np.uint8)
        held: Any = (ctypes.c_uint8 * space.size).from_buffer(space.data)
        # not of an array: then a view holds what is made here, and `take` sees it
        return np.ndarray(self._shape, self._dtype, held, -space.ctypes.data % LINE, (stride, size))

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_kept": []}
