"""What a learned policy sees: the observation, and optionally products of its signals and theory's one-step lookahead, of
the last observation or of a stack of them.

The best damping is an even function of the state: nothing changes when road and car are mirrored, (Y, X, Z, U) ->
-(Y, X, Z, U). Products of two signals are even; with them alone a policy respects the symmetry exactly, and the switching
surfaces of classical controllers, such as Y' (Y' - Z') = 0, are planes.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from roadgym.parameters import ParameterError, shown, whole
from roadgym.task import OPERATING_POINT, Task

from .advantage import advantage_forms, has_advantage, operating_point, state_of
from .theory import NODES, OperatingGrid, remembered

Rows = npt.NDArray[np.float32]

FEATURES = ("signals", "products", "lookahead")


def has_lookahead(task: Task, kinds: Sequence[str]) -> bool:
    """Is the lookahead among the features of these ``kinds``: asked for, known to theory, and the whole state observed?"""
    return (
        "lookahead" in kinds
        and has_advantage(task)
        and all(name in task.signals for name in (*state_of(task), *operating_point(task)))
    )


class Features:
    """Maps observations, shape (n, signals), to what a policy sees, shape (n, size), float32.

    Args:
        task: the task that is observed.
        kinds: a selection of `FEATURES`: "signals" as observed; "products" of every pair of them over
            sqrt(1 + sum of squares), so that they grow like the signals; and "lookahead", the advantages (`agents.advantage`)
            of the firmest and of the middle damping over the softest, scaled alike, which are left out where theory does not
            know them or the task does not observe the whole state. The operating point is always there, as 4 (share - 1/2),
            which is of order 1.

    Attributes:
        state, point: columns of the moving signals and of the operating point.
        first, second: of the products, places of the factors among the moving signals.
        signals, products: are they seen?
        lookahead: what makes the advantages, or None.
        size: numbers that are seen.

    Raises:
        ParameterError: an unknown kind, or none.
    """

    def __init__(self, task: Task, kinds: Sequence[str] = ("signals",)) -> None:
        if isinstance(kinds, str) or not kinds or any(kind not in FEATURES for kind in kinds):
            raise ParameterError(f"features must be a selection of {', '.join(FEATURES)}, got {kinds!r}")
        names = task.signals
        self.state = [i for i, name in enumerate(names) if name not in OPERATING_POINT]
        self.point = [i for i, name in enumerate(names) if name in OPERATING_POINT]
        self.first, self.second = np.triu_indices(len(self.state))
        self.signals, self.products = "signals" in kinds, "products" in kinds
        self.lookahead = None
        if has_lookahead(task, kinds):
            self.lookahead = Lookahead(task)
        self.size = (
            len(self.point)
            + self.signals * len(self.state)
            + self.products * len(self.first)
            + 2 * (self.lookahead is not None)
        )

    def __call__(self, observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """The features of each row."""
        state = observations[:, self.state]
        scale = np.sqrt(1 + np.einsum("ij,ij->i", state, state))[:, None]
        parts = [(observations[:, self.point] - np.float32(0.5)) * np.float32(4)]
        if self.signals:
            parts.append(state)
        if self.products:
            parts.append(state[:, self.first] * state[:, self.second] / scale)
        if self.lookahead is not None:
            parts.append(self.lookahead(observations) / scale)
        return np.concatenate(parts, axis=1, dtype=np.float32)


@remembered
def _lookahead_table(task: Task) -> npt.NDArray[np.float32]:
    """Coefficients of the products of two signals, and constants, of both advantages at the nodes of `OperatingGrid`."""
    grid, (low, high) = OperatingGrid.of(task), task.damping_range
    points = (grid.damping.ravel(), grid.ratio.ravel(), grid.bandwidth.ravel())
    forms, constants = advantage_forms(task, [low, (low + high) / 2, high], *points)
    first, second = np.triu_indices(len(state_of(task)))
    table = np.empty((NODES**2, 2, len(first) + 1))
    table[..., :-1] = (forms[:, :0:-1] - forms[:, :1])[..., first, second] * np.where(first == second, 1, 2)
    table[..., -1] = constants[:, :0:-1] - constants[:, :1]
    # of order one where the signals are
    table /= np.sqrt(np.square(table[:, :1, :-1]).sum(axis=-1, keepdims=True))
    return table.reshape(NODES, NODES, 2, -1).astype(np.float32)


class Lookahead:
    """Advantages of the firmest and of the middle damping over the softest, interpolated between operating points.

    Attributes:
        columns, point: columns of the state and of the operating point.
        grid: the operating points of the table.
        first, second: places of the factors of a monomial in the state.
        table: coefficients of the monomials, and constants, shape (NODES, NODES, 2, monomials + 1).
    """

    def __init__(self, task: Task) -> None:
        self.columns = [task.signals.index(name) for name in state_of(task)]
        self.point = [task.signals.index(name) for name in operating_point(task)]
        self.grid = OperatingGrid.of(task)
        self.first, self.second = np.triu_indices(len(self.columns))
        self.table = _lookahead_table(task)
        self._points = np.empty((0, len(self.point)), np.float32)
        self._forms = np.empty((0, *self.table.shape[2:]), np.float32)

    def __call__(self, observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Both, shape (n, 2)."""
        points = observations[:, self.point]
        if not np.array_equal(points, self._points):  # within an episode the operating point stays
            self._points, self._forms = points, self.forms(points)
        state = observations[:, self.columns]
        monomials = np.ones((len(state), len(self.first) + 1), np.float32)
        np.multiply(state[:, self.first], state[:, self.second], out=monomials[:, :-1])
        return np.asarray((self._forms @ monomials[:, :, None])[:, :, 0])

    def forms(self, points: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """The forms at observed operating points, shape (n, 2, monomials)."""
        place = self.grid.place(np.pad(points, [(0, 0), (0, 2 - points.shape[1])]))  # no bandwidth is one of 0
        node = np.minimum(place.astype(np.intp), NODES - 2)
        share = (place - node).astype(np.float32)
        forms = np.zeros((len(points), *self.table.shape[2:]), np.float32)
        for i, j in itertools.product((0, 1), repeat=2):  # the corners around each point
            weight = np.abs(1 - i - share[:, 0]) * np.abs(1 - j - share[:, 1])
            forms += weight[:, None, None] * self.table[node[:, 0] + i, node[:, 1] + j]
        return forms


class Sight:
    """What a policy sees of a task: the last observations, and features of them.

    A stack of k observations begins with the newest one; of the k - 1 older ones, newest first, it holds all signals but the
    operating point, which does not change in an episode. At the start of an episode, the first observation stands for those
    before it. Features are those of the whole stack: products pair signals of different times too, so that a policy can weigh
    products of whatever it filters from the past.

    Args:
        task: the task that is observed.
        features: kinds of `FEATURES`; None for the observations as they are.
        frame_stack: number of observations that are seen together.

    Attributes:
        space: the space of what is seen.
        moving: columns of the signals that change in an episode.
        frame_stack: number of observations that are seen together.
        features: what makes features of the stack, or None.

    Raises:
        ParameterError: an unknown kind of feature, or features that show nothing of the task.
    """

    def __init__(self, task: Task, features: Sequence[str] | None = None, frame_stack: int = 1) -> None:
        self.frame_stack = whole("frame_stack", frame_stack, of="frame_stack")
        self.moving = [i for i, name in enumerate(task.signals) if name not in OPERATING_POINT]
        older = tuple(task.signals[i] for i in self.moving) * (self.frame_stack - 1)
        stacked = dataclasses.replace(task, signals=task.signals + older)
        self._width, self._kept = len(task.signals), len(stacked.signals) - len(self.moving)
        if not (features is None or (isinstance(features, Sequence) and all(isinstance(kind, str) for kind in features))):
            raise ParameterError(f"features must be a sequence of names or None, got {shown(features)}")
        self.features = None if features is None else Features(stacked, features)
        self.space = stacked.observation_space
        if self.features is not None:
            if self.features.size == 0:
                raise ParameterError(f"features must leave something to see of {', '.join(task.signals)}, got {features!r}")
            self.space = spaces.Box(-np.inf, np.inf, (self.features.size,), np.float32)

    def stack(self, frames: Rows | None, observations: Rows, starts: npt.NDArray[np.bool_] | None) -> Rows | None:
        """The stack, shape (n, width), with new observations, shape (n, signals), on top; None where only one is seen.

        ``frames`` is the stack before, None for none yet; ``starts`` tells the rows, shape (n,), whose episode begins.
        """
        if self.frame_stack == 1:
            return None
        fresh = np.concatenate([observations, np.tile(observations[:, self.moving], self.frame_stack - 1)], axis=1)
        if frames is None:
            return fresh
        moved = [observations, frames[:, self.moving], frames[:, self._width : self._kept]]
        stacked = np.concatenate(moved, axis=1)
        return stacked if starts is None else np.where(np.asarray(starts)[:, None], fresh, stacked)

    def __call__(self, observations: Rows, frames: Rows | None) -> Rows:
        """What the policy sees of new observations and the stack that they are on top of, shape (n, size)."""
        seen = observations if frames is None else frames
        return seen if self.features is None else self.features(seen)
