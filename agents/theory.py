"""What theory says of constant dampings on a task: the cost of any, the best at an operating point and on a grid."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TypeVar

import numpy as np
import numpy.typing as npt

import analysis
from roadgym.roads import Road
from roadgym.task import Task

NODES = 17  # over the speed, and over the bandwidth

Result = TypeVar("Result")


def remembered(function: Callable[[Task], Result]) -> Callable[[Task], Result]:
    """``function``, with its last results kept: hundreds of single environments of one task ask for the same."""
    kept = functools.lru_cache(maxsize=8)(function)

    @functools.wraps(function)
    def asked(task: Task) -> Result:
        try:
            hash(task)
        except TypeError:  # a road of one's own that holds a list
            return function(task)
        return kept(task)

    return asked


def road_at(task: Task, bandwidth: float) -> Road:
    """The task's road at ``bandwidth``, or as it is where it has none (0)."""
    return task.road.with_bandwidth(bandwidth) if bandwidth else task.road


def optimum(task: Task, speed: float, bandwidth: float) -> analysis.Optimum:
    """Best constant damping of ``task`` by theory at an operating point (m/s, 1; bandwidth 0 where there is none)."""
    return analysis.optimal_damping(
        road_at(task, bandwidth),
        task.speed_noise,
        speed=speed,
        car=task.car,
        weights=task.reward_by_name,
        bounds=task.damping_range,
    )


def theoretical_cost(task: Task, damping: float, speed: float, bandwidth: float) -> float:
    """Minus the mean reward of a constant damping by theory."""
    squares = analysis.mean_squares(
        road_at(task, bandwidth),
        task.speed_noise,
        damping=damping,
        speed=speed,
        car=task.car,
    )
    return sum(weight * float(squares[name]) for name, weight in task.reward_by_name.items()) / task.cost_unit


class OperatingGrid:
    """A grid over the task's speeds and bandwidths, of equal steps in what is observed: nu/(1 + nu) and 2 delta/(1 + 2 delta).

    Attributes:
        ratio, bandwidth: nu and delta of the nodes, shape (NODES, NODES); the first axis is that of the speed.
        damping: the best constant damping ratio at the nodes by theory, likewise.
        low, step: the first node and the step to the next in what is observed, shape (2,).
    """

    def __init__(self, task: Task) -> None:
        ends = np.array([[task.frequency_ratio(speed) for speed in task.speed], [2 * delta for delta in task.bandwidth]])
        ends = ends / (1 + ends)
        self.low, widths = ends[:, 0], ends[:, 1] - ends[:, 0]
        self.step = np.maximum(widths, 1e-9) / (NODES - 1)
        shares = self.low + widths / (NODES - 1) * np.stack(np.meshgrid(range(NODES), range(NODES), indexing="ij"), axis=-1)
        self.ratio, twice_bandwidth = np.moveaxis(shares / (1 - shares), -1, 0)
        self.bandwidth = twice_bandwidth / 2
        speed = 1 / task.frequency_ratio(1.0)
        pairs = list(zip(self.ratio.ravel().tolist(), self.bandwidth.ravel().tolist(), strict=True))
        found: dict[tuple[float, float], float] = {}  # without a bandwidth all nodes of a speed are one point
        for nu, delta in pairs:
            if (nu, delta) not in found:
                found[nu, delta] = float(optimum(task, nu * speed, delta).damping)
        self.damping = np.array([found[pair] for pair in pairs]).reshape(NODES, NODES)

    @staticmethod
    @remembered
    def of(task: Task) -> OperatingGrid:
        """The grid of ``task``, which may be one that was asked for before."""
        return OperatingGrid(task)

    def place(self, shares: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
        """Where observed operating points lie, in steps from the first node, shape (n, 2) as ``shares``; within the grid."""
        return np.asarray(np.clip((shares - self.low) / self.step, 0, NODES - 1))
