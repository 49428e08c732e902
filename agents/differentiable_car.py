"""Cars as torch sees them over a control interval, and what ideal sensors tell of them: one for all, or each its own.

A matrix has the shape (inputs, outputs) where all cars share it, and a first axis of the cars where these differ (``vary``).
States and signals of cars that differ are in terms of the nominal one, as the environments tell them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from analysis.interval import Interval
from roadgym.installation import needs
from roadgym.linear import Motion
from roadgym.task import SATURATION, Task

from .differentiable_filter import powers, single

with needs("train"):
    import torch
    from torch import Tensor


@dataclasses.dataclass(frozen=True, eq=False)
class Sensing:
    """Ideal sensors, the operating point 0; made by `of`.

    Attributes:
        of_car: makes of states of the car signals, and the relative velocity after them.
        of_road: likewise of the level, its rate and the slope.
        of_force: factors of the damper's force in the signals, shape (signals,), or (n, signals) of cars that differ.
        felt: is the force in any of them?
        ends: of the range of D.
    """

    of_car: Tensor
    of_road: Tensor
    of_force: Tensor
    felt: bool
    ends: tuple[float, float]

    @classmethod
    def of(cls, task: Task, motions: Sequence[Motion]) -> Sensing:
        """Those of what ``task`` observes, of one car or of several."""
        states = len(task.car.motion.states)
        relative, rows = (np.array(part) for part in zip(*(observed_rows(task, motion) for motion in motions), strict=True))
        both = np.concatenate([np.delete(rows, states + 2, 1), np.pad(relative, [(0, 0), (0, 1)])[..., None]], 2)
        of_car, of_road, of_force = (shared(part) for part in (both[:, :states], both[:, states:], rows[:, states + 2]))
        return cls(of_car, of_road, of_force, bool(rows[:, states + 2].any()), task.damping_range)

    def from_road(self, path: Tensor, road: Tensor) -> Tensor:
        """What of it the road makes: from the level and its rate, and the road's states, each of shape (steps, n, 2)."""
        return product(torch.cat([path, road[..., 1:]], -1), self.of_road)

    def __call__(self, car: Tensor, place: Tensor, given: Tensor) -> Tensor:
        """What they tell after an interval at a damping in ``place``, shape (n, signals); ``given`` is the road's part."""
        both = affine(given, car, self.of_car)
        told, relative = both[..., :-1], both[..., -1]
        if self.felt:
            low, high = self.ends
            force = (low + high + (high - low) * place) * relative
            told = torch.addcmul(told, force[..., None], self.of_force)
        return told.clamp(-SATURATION, SATURATION)


@dataclasses.dataclass(frozen=True, eq=False)
class Cars:
    """The cars of a batch; made by `of`.

    Attributes:
        smooth: as of `analysis.interval.Interval`.
        terms, states: how many, of polynomials in D and of a car.
        motion, forcing: make of states of a car, and of ends of the road, coefficients of its states after an interval.
        squares: makes of both those of the mean cost.
        sensing: of what the policy is shown.
        measuring: of what is measured.
    """

    smooth: bool
    terms: int
    states: int
    motion: Tensor
    forcing: Tensor
    squares: Tensor
    sensing: Sensing
    measuring: Sensing

    @classmethod
    def of(cls, task: Task, shown: Task, drawn: npt.NDArray[np.float64]) -> Cars:
        """Those with these values of what varies, shape (fields, n), on ``task``; a policy sees what ``shown`` observes."""
        vary = task.vary
        motions = [task.car.motion] if vary is None else [vary.told_motion(values) for values in drawn.T.tolist()]
        interval = Interval.of(task, motions)
        count, terms, inputs, states = interval.motion.shape
        motion, squares = (
            shared(np.moveaxis(part, 2, 1).reshape(count, inputs, -1)) for part in (interval.motion, interval.cost)
        )
        own, ends = torch.split(motion, [states, inputs - states], -2)
        sensors = Sensing.of(shown, motions), Sensing.of(task, motions)
        return cls(interval.smooth, terms, states, own, ends, squares, *sensors)

    def forced(self, ends: Tensor) -> Tensor:
        """What the road adds to the coefficients of states, from its ends, shape (steps, n, ends)."""
        return product(ends, self.forcing)

    def moved(self, car: Tensor, forced: Tensor, place: Tensor) -> Tensor:
        """States at the end of an interval, shape (..., n, states), by a polynomial in the place of D."""
        coefficients = affine(forced, car, self.motion).reshape(*car.shape[:-1], self.terms, self.states)
        return (powers(place, self.terms)[..., None, :] @ coefficients)[..., 0, :]

    def cost(self, car: Tensor, ends: Tensor, place: Tensor) -> Tensor:
        """Mean costs of intervals, shape (steps, n)."""
        given = torch.cat([car, ends], -1)
        forms = product(given, self.squares).reshape(*place.shape, self.terms, -1)
        return (powers(place, self.terms) * (forms @ given[..., None])[..., 0]).sum(-1)


def shared(array: npt.NDArray[np.floating]) -> Tensor:
    """Matrices of cars in single precision, without their first axis where there is one car."""
    return single(array[0] if len(array) == 1 else array)


def product(rows: Tensor, matrix: Tensor) -> Tensor:
    """Rows, shape (steps, n, inputs), times the matrix of all, or of each."""
    return rows @ matrix if matrix.dim() == 2 else (rows.transpose(0, 1) @ matrix).transpose(0, 1)


def affine(added: Tensor, rows: Tensor, matrix: Tensor) -> Tensor:
    """The same and what is ``added``; also of one step, shape (n, inputs)."""
    if rows.dim() == 3:
        return added + product(rows, matrix)
    if matrix.dim() == 2:
        return torch.addmm(added, rows, matrix)
    return torch.baddbmm(added[:, None], rows[:, None], matrix)[:, 0]


def observed_rows(task: Task, motion: Motion) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """(relative velocity, what ``task`` observes) as factors of the states of the car, Z and dZ/dt; and of the force and U.

    Shapes (states + 2,) and (states + 4, signals); speed and bandwidth are zero.
    """
    known = dict(zip(motion.signals, motion.rows, strict=True))
    places = {name: n for n, name in enumerate(motion.states)} | {"level": len(motion.states), "slope": len(motion.states) + 3}
    rows = np.zeros((len(task.signals), len(motion.states) + 4))
    for row, name in zip(rows, task.signals, strict=True):
        if name in known:
            row[:-1] = known[name]
        elif name in places:
            row[places[name]] = 1.0
    return known[motion.relative][:-1], rows.T
