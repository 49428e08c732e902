"""What a plant tells of a control interval."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from .record import RESULT_BANDWIDTH, RESULT_DAMPING, RESULT_SPEED, REWARD, SQUARES

Floats = npt.NDArray[np.float64]


class Interval:
    """What happened to the environments in a control interval, or at a reset.

    Attributes:
        observations: shape (num_envs, signals), float32.
        rewards: in the precision of the plant, shape (num_envs,).
        truncated: whose episode has ended, shape (num_envs,).
        final_observations: the last observations of these episodes, with the autoreset "same_step", where the others are those
            of the next episodes already; meaningless where none has ended.
    """

    __slots__ = ("_results", "final_observations", "observations", "rewards", "truncated")

    def __init__(
        self,
        observations: npt.NDArray[np.float32],
        results: Floats,
        rewards: npt.NDArray[Any],
        truncated: npt.NDArray[np.bool_],
        final_observations: npt.NDArray[np.float32],
    ) -> None:
        self.observations, self._results, self.rewards = observations, results, rewards
        self.truncated, self.final_observations = truncated, final_observations

    @property
    def reward(self) -> Floats:
        """In double precision, shape (num_envs,)."""
        row: Floats = self._results[REWARD]
        return row

    @property
    def mean_squares(self) -> Floats:
        """Of the interval, in the plant's unit, shape (squares, num_envs), in the order of the car's."""
        return self._results[SQUARES:]

    @property
    def damping(self) -> Floats:
        """The damping ratios that were in force, in the mean over the interval, shape (num_envs,)."""
        row: Floats = self._results[RESULT_DAMPING]
        return row

    @property
    def speed(self) -> Floats:
        """The mean speed, in the plant's unit, shape (num_envs,)."""
        row: Floats = self._results[RESULT_SPEED]
        return row

    @property
    def bandwidth(self) -> Floats:
        """Of the road, 0 where it has none, shape (num_envs,)."""
        row: Floats = self._results[RESULT_BANDWIDTH]
        return row

    def rows(self) -> list[Floats]:
        """Mean squares one by one, damping, speed and bandwidth, shape (num_envs,) each."""
        rows: list[Floats] = list(self._results)
        return [*rows[SQUARES:], *rows[RESULT_DAMPING:SQUARES]]

    def only(self) -> list[float]:
        """Reward, damping, speed, bandwidth and mean squares of the first environment, in this order, as numbers."""
        return self._results[:, 0].tolist()  # type: ignore[no-any-return]


class CommandedInterval(Interval):
    """An interval of a plant with a valve that is not ideal; `only` tells the command after all else."""

    __slots__ = ()

    @property
    def mean_squares(self) -> Floats:
        """Of the interval, in the plant's unit, shape (squares, num_envs), in the order of the car's."""
        return self._results[SQUARES:-1]

    def rows(self) -> list[Floats]:
        """Mean squares one by one, damping in force and commanded, speed and bandwidth, shape (num_envs,) each."""
        rows: list[Floats] = list(self._results)
        return [*rows[SQUARES:-1], rows[RESULT_DAMPING], rows[-1], *rows[RESULT_SPEED:SQUARES]]

    @property
    def command(self) -> Floats:
        """The damping ratios that were commanded, within the range, shape (num_envs,)."""
        row: Floats = self._results[-1]
        return row
