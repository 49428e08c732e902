"""What a policy answers with, such as numbers in [-1, 1] or levels, and the damping ratios that it stands for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from roadgym.parameters import ParameterError, number_array, shown

Damping = npt.NDArray[np.float32]


def action_space(levels: int | None) -> spaces.Box | spaces.Discrete:
    """What a policy answers with: a number in [-1, 1], or one of ``levels``."""
    return spaces.Box(-1.0, 1.0, (1,), np.float32) if levels is None else spaces.Discrete(levels)


def damping_from_action(action: npt.NDArray[Any], damping_range: tuple[float, float], levels: int | None = None) -> Damping:
    """The damping ratio D, shape (n, 1) from actions of that shape, by the affine map of [-1, 1] onto ``damping_range``.

    Args:
        action: in [-1, 1], any shape, which the result keeps; with ``levels``, one of 0, ..., levels - 1, shape (n,), spread
            equally over [-1, 1].
        damping_range: the softest and the firmest damping, 1.
        levels: number of levels of a discrete action.

    Raises:
        ParameterError: actions that are not finite, or levels that do not exist.
    """
    low, high = damping_range
    sound = type(action) is np.ndarray and action.dtype == np.float32 and np.isfinite(action).all()  # as those of a policy are
    given = action if sound else number_array("action", action)
    if levels is not None:
        if given.ndim != 1 or not np.all((given >= 0) & (given < levels) & (given == np.floor(given))):
            raise ParameterError(f"action must be integers from 0 to {levels - 1}, shape (n,), got {shown(action)}")
        values = given.astype(np.float32)[:, None] * np.float32(2 / (levels - 1)) - 1
    else:
        values = np.clip(given, -1e6, 1e6).astype(np.float32, copy=False)  # it saturates at the range in any case
    return np.asarray(low + (values + 1) * (0.5 * (high - low)), np.float32)


def damping_reader(space: spaces.Space[Any] | None, damping_range: tuple[float, float]) -> Callable[[Any], Damping]:
    """What makes damping ratios, shape (n, 1), of the answers of a controller whose ``action_space`` is ``space``.

    Args:
        space: None, or bounds above zero, where the answers are damping ratios themselves; other bounds, shape (1,), such as
            those of ``RescaleAction``, stand for the ends of ``damping_range``; and discrete actions for equal steps over it.
        damping_range: the softest and the firmest damping, 1.

    Raises:
        ParameterError: a space of another sort, or bounds of damping ratios that are not ``damping_range``; in use, an answer
            that is not in the space, or in the range where there is no space.
    """
    ends = np.array(damping_range, np.float32)
    if isinstance(space, spaces.Discrete):
        first, levels = int(space.start), int(space.n)
        if levels < 2:
            raise ParameterError(f"action_space must have at least 2 levels, got {space}")
        return lambda action: damping_from_action(number_array("action", action) - first, damping_range, levels)
    bounds = ends
    if space is not None:
        if not isinstance(space, spaces.Box) or space.shape != (1,) or not space.is_bounded():
            raise ParameterError(f"action_space must be discrete or a bounded box of shape (1,), got {shown(space)}")
        bounds = np.array([space.low[0], space.high[0]], np.float32)
        if bounds[0] > 0 and not np.array_equal(bounds, ends):  # of no damping ratios, then, but of another range
            raise ParameterError(f"action_space must have the bounds of damping_range, {damping_range}, got {space}")

    def read(action: Any) -> Damping:
        values = number_array("action", action).astype(np.float32)
        outside = (values < bounds[0]) | (values > bounds[1])
        if outside.any():
            raise ParameterError(f"action must lie within [{bounds[0]:g}, {bounds[1]:g}], got {values[outside][0]:g}")
        if np.array_equal(bounds, ends):
            return values
        return damping_from_action(2 * (values - bounds[0]) / (bounds[1] - bounds[0]) - 1, damping_range)

    return read
