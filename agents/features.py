"""What a learned policy sees: the observation, and optionally products of its signals and theory's one-step lookahead.

The best damping is an even function of the state: nothing changes when road and car are mirrored, (Y, X, Z, U) ->
-(Y, X, Z, U). Products of two signals are even; with them alone a policy respects the symmetry exactly, and the switching
surfaces of classical controllers, such as Y' (Y' - Z') = 0, are planes.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from roadgym.parameters import ParameterError
from roadgym.task import OPERATING_POINT, Task

from .advantage import STATE, advantage_forms, has_advantage
from .operating_grid import NODES, OperatingGrid

FEATURES = ("signals", "products", "lookahead")


def has_lookahead(task: Task, kinds: Sequence[str]) -> bool:
    """Is the lookahead among the features of these ``kinds``: asked for, known to theory, and the whole state observed?"""
    return "lookahead" in kinds and has_advantage(task) and all(name in task.signals for name in (*STATE, *OPERATING_POINT))


class Features:
    """Maps observations, shape (n, signals), to what a policy sees, shape (n, size), float32.

    Args:
        task: the task that is observed.
        kinds: a selection of `FEATURES`: "signals" as observed; "products" of every pair of them over
            sqrt(1 + sum of squares), so that they grow like the signals; and "lookahead", the advantages (`agents.advantage`)
            of the firmest and of the middle damping over the softest, scaled alike, which are left out where theory does not
            know them or the task does not observe the whole state. The operating point is always there, as 4 (share - 1/2),
            which is of order 1.

    Raises:
        ParameterError: an unknown kind, or none.
    """

    def __init__(self, task: Task, kinds: Sequence[str] = ("signals",)) -> None:
        if isinstance(kinds, str) or not kinds or any(kind not in FEATURES for kind in kinds):
            raise ParameterError(f"features must be a selection of {', '.join(FEATURES)}, got {kinds!r}")
        names = task.signals
        self._state = [i for i, name in enumerate(names) if name not in OPERATING_POINT]
        self._point = [i for i, name in enumerate(names) if name in OPERATING_POINT]
        self._first, self._second = np.triu_indices(len(self._state))
        self._signals, self._products = "signals" in kinds, "products" in kinds
        self._lookahead = None
        if has_lookahead(task, kinds):
            self._lookahead = _Lookahead(task)
        self.size = (
            len(self._point)
            + self._signals * len(self._state)
            + self._products * len(self._first)
            + 2 * (self._lookahead is not None)
        )

    def __call__(self, observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """The features of each row."""
        state = observations[:, self._state]
        scale = np.sqrt(1 + np.einsum("ij,ij->i", state, state))[:, None]
        parts = [(observations[:, self._point] - np.float32(0.5)) * np.float32(4)]
        if self._signals:
            parts.append(state)
        if self._products:
            parts.append(state[:, self._first] * state[:, self._second] / scale)
        if self._lookahead is not None:
            parts.append(self._lookahead(observations) / scale)
        return np.concatenate(parts, axis=1, dtype=np.float32)


class _Lookahead:
    """Advantages of the firmest and of the middle damping over the softest, interpolated between operating points."""

    def __init__(self, task: Task) -> None:
        self._columns = [task.signals.index(name) for name in STATE]
        self._point = [task.signals.index(name) for name in OPERATING_POINT]
        self._grid = grid = OperatingGrid(task)
        low, high = task.damping_range
        points = (grid.damping.ravel(), grid.ratio.ravel(), grid.bandwidth.ravel())
        forms, constants = advantage_forms(task, [low, (low + high) / 2, high], *points)
        self._first, self._second = np.triu_indices(4)
        table = np.empty((NODES**2, 2, len(self._first) + 1))
        twice = np.where(self._first == self._second, 1, 2)
        table[..., :-1] = (forms[:, :0:-1] - forms[:, :1])[..., self._first, self._second] * twice
        table[..., -1] = constants[:, :0:-1] - constants[:, :1]
        # of order one where the signals are
        table /= np.sqrt(np.square(table[:, :1, :-1]).sum(axis=-1, keepdims=True))
        self._table = table.reshape(NODES, NODES, 2, -1).astype(np.float32)
        self._points = np.empty((0, 2), np.float32)
        self._forms = np.empty((0, *self._table.shape[2:]), np.float32)

    def __call__(self, observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Both, shape (n, 2)."""
        points = observations[:, self._point]
        if not np.array_equal(points, self._points):  # within an episode the operating point stays
            self._points, self._forms = points, self._interpolate(points)
        state = observations[:, self._columns]
        monomials = np.ones((len(state), len(self._first) + 1), np.float32)
        np.multiply(state[:, self._first], state[:, self._second], out=monomials[:, :-1])
        return np.asarray((self._forms @ monomials[:, :, None])[:, :, 0])

    def _interpolate(self, points: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """The forms at observed operating points, shape (n, 2, monomials)."""
        place = self._grid.place(points)
        node = np.minimum(place.astype(np.intp), NODES - 2)
        share = (place - node).astype(np.float32)
        forms = np.zeros((len(points), *self._table.shape[2:]), np.float32)
        for i, j in itertools.product((0, 1), repeat=2):  # the corners around each point
            weight = np.abs(1 - i - share[:, 0]) * np.abs(1 - j - share[:, 1])
            forms += weight[:, None, None] * self._table[node[:, 0] + i, node[:, 1] + j]
        return forms
