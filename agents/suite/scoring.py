"""Scores: how far from the best constant damping, 0, to the best known feedback, 100.

Everybody drives over the same roads as the constant damping beside them, and costs are adjusted by control variates where
theory knows any (`agents.evaluation`). A score is the mean over the task's operating points of the shares of the way at each,
in per cent; its interval is of 95 % and holds what other roads, other training seeds, and better known references would
change. Above 100 is who costs less than what was the best known when the references were made, below 0 who costs more than a
passive damper.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from roadgym.suite import SuiteTask

from ..evaluation import Evaluation, Predictor
from ..results import Share, ratio
from .drivers import ZERO, drive_on, zero_of
from .reference import References, references


@dataclasses.dataclass(frozen=True, kw_only=True)
class Score:
    """The score of an entry on a task, in per cent.

    Attributes:
        mean: over the operating points.
        points: at each of them.
        worst: the least of these.
        worst_speed, worst_bandwidth: where that is, m/s and 1.
        seeds: how many training seeds were driven.
        episodes: at each operating point.
    """

    mean: Share
    points: tuple[Share, ...]
    worst_speed: float
    worst_bandwidth: float
    seeds: int
    episodes: int

    @property
    def worst(self) -> Share:
        """The least over the operating points."""
        return min(self.points, key=lambda share: share.value)


def score(
    task: SuiteTask,
    entries: Mapping[str, Sequence[Predictor]],
    *,
    episodes: int = 256,
    seed: int = 1,
    known: References | None = None,
    report: Callable[[str, int, int], None] | None = None,
    **points: Sequence[float],
) -> dict[str, Score]:
    """Drive entries on a task and score them.

    Args:
        task: the task.
        entries: by name who drives, once for each training seed.
        episodes: at each operating point.
        seed: fixes the roads. The references were driven over those of seed 0.
        known: the references; by default those that come with the package.
        report: called as ``report(what, steps done, in all)``.
        points: "speeds" and "bandwidths", to score at some of the task's operating points alone.

    Raises:
        ParameterError: an entry that cannot drive here, or too few episodes.
    """
    known = references(task) if known is None else known
    drivers = {f"{name}, seed {k + 1}": driver for name, seeds in entries.items() for k, driver in enumerate(seeds)}
    zero = {ZERO: zero_of(task, known.points[0].damping)}
    driven = drive_on(task, drivers | zero, episodes=episodes, seed=seed, report=report, **points)
    return {
        name: _score(known, [driven[f"{name}, seed {k + 1}"] for k in range(len(seeds))], driven[ZERO])
        for name, seeds in entries.items()
    }


def _score(known: References, seeds: Sequence[Evaluation], zero: Evaluation) -> Score:
    at = {each.point: each for each in known.points}
    here = [at[point] for point in zero.points]
    saved = zero.adjusted_costs[:, None] - np.stack([each.adjusted_costs for each in seeds], axis=1)
    # the share of the constant damping's cost, as driven beside it, that is saved, over the share that the best known saves
    room = zero.adjusted_costs * np.array([[each.room] for each in here])
    errors = zero.mean * np.array([each.room_error for each in here])
    freedom = zero.degrees_of_freedom

    def percent(places: list[int]) -> Share:
        share = ratio(saved[places], room[places], freedom, errors[places])
        return Share(100 * share.value, 100 * share.low, 100 * share.high)

    shares = tuple(percent([k]) for k in range(len(here)))
    worst = here[int(np.argmin([share.value for share in shares]))].point
    return Score(
        mean=percent(list(range(len(here)))),
        points=shares,
        worst_speed=worst.speed,
        worst_bandwidth=worst.bandwidth,
        seeds=len(seeds),
        episodes=saved.shape[-1],
    )


def to_json(found: Score) -> dict[str, Any]:
    """A score in terms of JSON."""
    return {**dataclasses.asdict(found), "worst": dataclasses.asdict(found.worst)}
