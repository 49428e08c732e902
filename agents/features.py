"""What a learned policy sees: the observation, and optionally products of its signals.

The best damping is an even function of the state: nothing changes when road and car are mirrored, (Y, X, Z, U) ->
-(Y, X, Z, U). Products of two signals are even; with them alone a policy respects the symmetry exactly, and the switching
surfaces of classical controllers, such as Y' (Y' - Z') = 0, are planes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from roadgym.parameters import ParameterError
from roadgym.task import OPERATING_POINT

FEATURES = ("signals", "products")


class Features:
    """Maps observations, shape (n, signals), to what a policy sees, shape (n, size), float32.

    Args:
        names: names of the observed signals.
        kinds: a selection of `FEATURES`: "signals" as observed, "products" of every pair of them over
            sqrt(1 + sum of squares), so that they grow like the signals. The operating point is always there, as
            4 (share - 1/2), which is of order 1.

    Raises:
        ParameterError: an unknown kind, or none.
    """

    def __init__(self, names: Sequence[str], kinds: Sequence[str] = ("signals",)) -> None:
        if isinstance(kinds, str) or not kinds or any(kind not in FEATURES for kind in kinds):
            raise ParameterError(f"features must be a selection of {', '.join(FEATURES)}, got {kinds!r}")
        self._state = [i for i, name in enumerate(names) if name not in OPERATING_POINT]
        self._point = [i for i, name in enumerate(names) if name in OPERATING_POINT]
        self._first, self._second = np.triu_indices(len(self._state))
        self._signals, self._products = "signals" in kinds, "products" in kinds
        self.size = len(self._point) + self._signals * len(self._state) + self._products * len(self._first)

    def __call__(self, observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """The features of each row."""
        state = observations[:, self._state]
        parts = [(observations[:, self._point] - np.float32(0.5)) * np.float32(4)]
        if self._signals:
            parts.append(state)
        if self._products:
            scale = np.sqrt(1 + np.einsum("ij,ij->i", state, state))
            parts.append(state[:, self._first] * state[:, self._second] / scale[:, None])
        return np.concatenate(parts, axis=1, dtype=np.float32)
