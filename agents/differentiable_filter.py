"""The Kalman filter as torch sees it: what it would have known, had the car been damped otherwise, with gradients.

A drive that was recorded is driven again (`agents.differentiable`); the sensors tell of the new one with the errors that they
had in the old one, and mean and covariance follow as in `roadgym.kalman`, both by the damping: so the gradient knows what a
damping does to the car, and what it does to what is known of the car.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from roadgym.installation import needs
from roadgym.kalman import Belief, KalmanFilter, Rows
from roadgym.task import OPERATING_POINT, SATURATION

with needs("train"):
    import torch
    from torch import Tensor

ROUNDING = 1e-6  # variance of a measurement in single precision
SERIES = 1e-7  # of the largest coefficient, below which those of a series are left out


class Filtering(Protocol):
    """A layer of a batch that filters, `roadgym.wrappers.VectorKalmanObservation`."""

    filter: KalmanFilter
    belief: Belief | None
    measured: Rows


class DrivenFilter:
    """The filters of a batch while it is recorded, and when it is driven again.

    Args:
        layer: what filters, one filter a car, of sensors that tell at once and have no biases.
        num_envs: cars of the batch.
        steps: control intervals that are recorded.

    Attributes:
        task: what is measured.
        columns: of the measured signals, in its observation.
    """

    def __init__(self, layer: Filtering, num_envs: int, steps: int) -> None:
        self.task, self._layer, self._known = layer.filter.task, layer, layer.filter
        self.columns = [self.task.signals.index(name) for name in layer.filter.measured]
        self._beliefs: list[Belief | None] = [None] * (steps + 1)
        self._measured = np.empty((steps + 1, num_envs, len(self.columns)), np.float32)
        self._low, high = self.task.damping_range
        self._width = high - self._low
        self._noise = np.maximum(layer.filter.noise, ROUNDING).tolist()
        self._looks: dict[tuple[int, int], tuple[Belief, tuple[Tensor, ...]]] = {}  # of the episodes of a visit

    def note(self, step: int) -> None:
        """Record what is known where a step begins, or after the last one where it ends."""
        self._beliefs[step], self._measured[step] = self._layer.belief, self._layer.measured[:, self.columns]

    def finish(self, true: Tensor) -> None:
        """Work out the errors of the sensors from what they would have told without, from the second step on.

        Args:
            true: shape (steps, num_envs, measured).
        """
        self._errors = torch.from_numpy(self._measured[1:]) - true
        first = self._beliefs[0]
        self._looks = {key: look for key, look in self._looks.items() if first is not None and key == models_of(first)}

    def begin(self, step: int) -> Following:
        """The filters as they were at the beginning of a step."""
        belief = self._beliefs[step]
        assert belief is not None
        return Following(self, belief, *self._look(belief))

    def _look(self, belief: Belief) -> tuple[Tensor, ...]:
        """What `Following` takes of the models of all cars, worked out once an episode."""
        key, model, place = models_of(belief), belief.model, belief.place
        if key in self._looks:
            return self._looks[key][1]
        sizes = np.abs(model.series).max(axis=(0, 2))
        count = int(np.flatnonzero(sizes > SERIES * sizes.max())[-1]) + 1
        shares = np.array([np.pad(np.polynomial.chebyshev.cheb2poly(row), (0, count))[:count] for row in np.eye(count)])
        series = np.einsum("kc,pke->pce", shares, model.series[:, :count])
        names = self._known.full.signals
        told = np.zeros((len(model.told), model.told.shape[2], len(names)))
        told[:, :, [n for n, name in enumerate(names) if name not in OPERATING_POINT]] = np.moveaxis(model.told, 1, 2)
        self._looks[key] = belief, tuple(single(part[place]) for part in (series, model.rows, told))
        return self._looks[key][1]


class Following:
    """The filters along a stretch that is driven again.

    Args:
        driven: those that were recorded.
        belief: what was known at its beginning.
        series: of transition and noise by the place of D, ``rows`` of what is measured, and what is ``told``.
    """

    def __init__(self, driven: DrivenFilter, belief: Belief, series: Tensor, rows: Tensor, told: Tensor) -> None:
        self._driven = driven
        # the mean, and beside it the covariance
        self._known = single(np.concatenate([belief.mean[:, :, None], belief.covariance], axis=2))
        self._series, self._rows, self._told = series, rows, told

    def __call__(self, step: int, place: Tensor, true: Tensor) -> Tensor:
        """What the filters tell before a step, shape (n, signals), the operating point 0.

        Args:
            step: its number.
            place: of D in its range, -1 to 1, in the interval before; shape (n,).
            true: what ideal sensors would tell, shape (n, measured).
        """
        driven, size = self._driven, self._known.shape[1]
        transition, noise = (powers(place, self._series.shape[1])[:, None] @ self._series).view(-1, 2, size, size).unbind(1)
        moved = transition @ self._known
        known = torch.cat([moved[:, :, :1], torch.baddbmm(noise, moved[:, :, 1:], transition.mT)], 2)
        damping = (driven._low + driven._width * (place + 1) / 2)[:, None, None]
        rows = self._rows[:, 0] + damping * self._rows[:, 1]
        measured = true + driven._errors[step - 1]
        for j, variance in enumerate(driven._noise):
            row = rows[:, j, None]
            foretold = row @ known  # the measurement, and its covariances with the states
            gain = foretold[:, :, 1:]
            spread = variance + gain @ row.mT
            wrong = torch.cat([foretold[:, :, :1] - measured[:, j, None, None], gain], 2)
            known = torch.baddbmm(known, gain.mT, wrong / spread, alpha=-1)
        self._known = known
        return (known[:, None, :, 0] @ self._told)[:, 0].clamp(-SATURATION, SATURATION)


def models_of(belief: Belief) -> tuple[int, int]:
    """What tells the models of all cars from others, as long as the belief is kept."""
    return id(belief.model), id(belief.place)


def powers(place: Tensor, count: int) -> Tensor:
    """Powers from 0 on of places, shape (..., count)."""
    return place[..., None] ** torch.arange(count)


def single(array: npt.NDArray[np.floating]) -> Tensor:
    """The array in single precision."""
    return torch.from_numpy(np.ascontiguousarray(array, np.float32))
