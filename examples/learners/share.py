"""The task that the examples of this folder learn, and what a learned policy is worth on it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

import agents
from roadgym.task import make_task

ENVIRONMENT: dict[str, Any] = {"road": "multiplicative", "speed": 1.5, "bandwidth": 0.1}


class Learned:
    """A policy of any library, as `agents.evaluate` takes it.

    Args:
        answer: actions in [-1, 1], shape (n, 1), for observations of shape (n, signals).
    """

    action_space = spaces.Box(-1, 1, (1,), np.float32)  # by which the answers are mapped onto the range of damping ratios

    def __init__(self, answer: Callable[[npt.NDArray[np.float32]], npt.NDArray[np.float32]]) -> None:
        self.answer = answer

    def predict(
        self, observation: npt.NDArray[np.float32], state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """(actions, state) for observations; the policy has no memory."""
        return self.answer(observation), state


def share_of_gap(
    answer: Callable[[npt.NDArray[np.float32]], npt.NDArray[np.float32]], episodes: int = 256
) -> tuple[float, float]:
    """Share of the way from the best constant damping to the optimal feedback that a policy goes, with its standard error.

    Negative where it costs more than the best constant damping. The error is that of the roads: all drive over the same ones.

    Args:
        answer: see `Learned`.
        episodes: roads, each of 300 units of time.
    """
    task = make_task(**ENVIRONMENT)
    rivals = {name: agents.make_controller(name, task) for name in ("analytic_optimum", "optimal_feedback")}
    results = agents.evaluate(
        {"learned": Learned(answer), **rivals}, environment=ENVIRONMENT, speeds=[1.5], bandwidths=[0.1], episodes=episodes
    )
    learned, best, optimal = (result.adjusted_costs[0] for result in results.values())  # shape (episodes,) each
    saved, gap = best - learned, best - optimal
    share = saved.mean() / gap.mean()
    return float(share), float((saved - share * gap).std(ddof=1) / gap.mean() / np.sqrt(episodes))
