"""Roads for the inner problems: what each does to the car at every damping, interval by interval."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from roadgym.plant import Plant
from roadgym.task import Task

from ...checks import FloatArray
from ...feedback.grid import SingleArray, radius_of, road_stencils, variable_of
from ...feedback.model import Model
from ...feedback.policy import OptimalFeedback
from .expansion import EXPANSIONS
from .inner import Chain, IndexArray, Steps

FINER = 3  # substeps for each of the task's: the polynomials ask for more of the road's moments than a cost does


def levels(task: Task, count: int) -> FloatArray:
    """Admissible dampings, evenly placed in `variable_of`, as the plant takes them."""
    middle, half, rate = variable_of(task.damping_range, task.control_interval * task.car.natural_frequency)
    found = -np.log1p(-(middle + half * np.linspace(-1.0, 1.0, count))) / rate
    return np.clip(found.astype(np.float32), *np.array(task.damping_range, np.float32)).astype(float)


def nearest(dampings: FloatArray, wanted: SingleArray) -> IndexArray:
    """Which of ascending ``dampings`` lie nearest to those wanted."""
    return np.searchsorted((dampings[1:] + dampings[:-1]) / 2, wanted)


@dataclasses.dataclass(frozen=True, eq=False)
class Drives:
    """Roads, and what cars did on them.

    Attributes:
        road: its states at the ends of the intervals, shape (intervals + 1, paths, states).
        added: what each interval adds to the car's states, as of `Model`, at each damping, shape (intervals, paths, dampings,
            2).
        car: those of the car under the feedback at the ends of the intervals, shape (intervals + 1, paths, 2).
        chosen: which damping was nearest to the feedback's, and set, shape (intervals, paths).
    """

    road: FloatArray
    added: FloatArray
    car: FloatArray
    chosen: IndexArray

    @classmethod
    def over(
        cls,
        task: Task,
        dampings: FloatArray,
        maps: FloatArray,
        follows: FloatArray,
        feedback: OptimalFeedback,
        *,
        paths: int,
        intervals: int,
        seeds: npt.NDArray[np.uint64],
        threads: int,
    ) -> Drives:
        """Drive cars of constant damping, and one under the feedback, over each of the roads.

        Args:
            task: the plant; its states are observed.
            dampings, maps: constant dampings, and what an interval makes of the car's states at each.
            follows: how much of Z is taken from (Y, X) in these.
            feedback: at its operating point.
            paths, intervals, seeds, threads: how many roads, how long, and which.
        """
        plant = Plant(dataclasses.replace(task, substeps=FINER * task.substeps), paths * (len(dampings) + 1), threads=threads)
        states = plant.start(np.tile(seeds, len(dampings) + 1)).observations
        actions = np.repeat(np.append(dampings, 0.0), paths).astype(np.float32)
        own = slice(len(dampings) * paths, None)
        settling = math.ceil(8 / (task.car.decay(task.damping_range[0]) * task.car.natural_frequency) / task.control_interval)
        shape = (len(dampings) + 1, paths, len(task.signals))
        roads, added, cars, choices = [], [], [], []
        before = np.empty(shape)
        for step in range(settling + intervals + 1):
            after = states.astype(float).reshape(shape)
            after[..., :2] -= follows * after[..., 2:3]
            if step > settling:
                added.append(after[:-1, :, :2] - np.einsum("aij,apj->api", maps, before[:-1, :, :2]))
            if step >= settling:
                roads.append(after[0, :, 2:])
                cars.append(after[-1, :, :2])
            if step < settling + intervals:
                chosen = nearest(dampings, feedback.damping(states[own]))
                actions[own] = dampings[chosen]
                if step >= settling:
                    choices.append(chosen)
                before, states = after, plant.step(actions).observations
        return cls(np.array(roads), np.moveaxis(np.array(added), 1, 2), np.array(cars), np.array(choices))


class RoadChain:
    """The chain of an operating point at some dampings.

    Attributes:
        dampings: shape (dampings,).
        chain: see `Chain`.
    """

    def __init__(self, task: Task, model: Model, dampings: FloatArray, rings: int, rays: int) -> None:
        self.dampings = dampings
        self._rings, self._rays, self._radius = rings, rays, radius_of(task.road)
        parts = [model.part(damping) for damping in dampings.tolist()]
        steps = np.array([part.transition for part in parts])
        self._forms, self._constants = np.array([part.form for part in parts]), np.array([part.constant for part in parts])
        self._entry = steps[:, :2, 2:]
        squares = np.stack([self._forms[:, 0, 0], 2 * self._forms[:, 0, 1], self._forms[:, 1, 1]], axis=1)
        self.chain = Chain(np.ascontiguousarray(steps[:, :2, :2]), np.array([part.gain for part in parts]), squares)
        self._expansion = EXPANSIONS[self._entry.shape[2]](task, self.chain.gains)

    def steps(self, road: FloatArray, added: FloatArray) -> Steps:
        """What one road does, from ``road``, shape (intervals + 1, states), and ``added``, shape (intervals, dampings, 2)."""
        before, after = road[:-1], road[1:]
        moved = np.einsum("aij,nj->nai", self._entry, before)
        noise = added - moved
        mean, offset, factor, rest = self._expansion(before, after, noise)
        index, weight = self._stencils(road)
        states = road.shape[1]
        point_index, point_weight = self._stencils((mean[:, None, :states] + offset[..., :states]).reshape(-1, states))
        shape = *offset.shape[:2], 16
        return Steps(
            index,
            weight,
            point_index.reshape(shape),
            point_weight.reshape(shape),
            factor,
            offset,
            moved,
            noise,
            rest,
            2 * np.einsum("aij,nj->nai", self._forms[:, :2, 2:], before),
            np.einsum("ni,aij,nj->na", before, self._forms[:, 2:, 2:], before) + self._constants,
        )

    def _stencils(self, points: FloatArray) -> tuple[IndexArray, SingleArray]:
        index, weight = np.empty((len(points), 16), np.int64), np.empty((len(points), 16), np.float32)
        plane = np.zeros((len(points), 2))
        plane[:, : points.shape[1]] = points
        road_stencils(plane, self._radius / (self._rings - 0.5), self._rings, self._rays, index, weight)
        return index, weight
