"""Memory that is used again once nobody looks at it any more."""

from __future__ import annotations

import sys

import numpy as np
import numpy.typing as npt

KEPT = 4  # arrays; whoever keeps more of them gets new ones


class Reused:
    """Arrays of one shape and type; each is handed out again when nobody else holds it, or a view of it.

    Fresh memory costs more than what is written there, where it is large, and to ask for an address costs as much as to call
    the kernel, where it is small.
    """

    def __init__(self, shape: int | tuple[int, ...], dtype: npt.DTypeLike) -> None:
        self._shape, self._dtype = shape, dtype
        self._kept: list[tuple[npt.NDArray[np.generic], int]] = []
        self._unheld = -1

    def take(self) -> tuple[npt.NDArray[np.generic], int]:
        """An array that nobody else holds, with any content, and its address."""
        for pair in self._kept:
            if sys.getrefcount(pair[0]) == self._unheld:
                return pair
        array = np.empty(self._shape, self._dtype)
        pair = array, array.ctypes.data
        del array
        self._unheld = sys.getrefcount(pair[0])
        if len(self._kept) < KEPT:
            self._kept.append(pair)
        return pair

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_kept": []}
