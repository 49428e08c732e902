"""What a learned policy answers with: numbers in [-1, 1] or levels, mapped onto damping ratios."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from roadgym.parameters import ParameterError, number_array, shown


def action_space(levels: int | None) -> spaces.Box | spaces.Discrete:
    """What a policy answers with: a number in [-1, 1], or one of ``levels``."""
    return spaces.Box(-1.0, 1.0, (1,), np.float32) if levels is None else spaces.Discrete(levels)


def damping_from_action(
    action: npt.NDArray[Any], damping_range: tuple[float, float], levels: int | None = None
) -> npt.NDArray[np.float32]:
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
    given = number_array("action", action)
    if levels is not None:
        if given.ndim != 1 or not np.all((given >= 0) & (given < levels) & (given == np.floor(given))):
            raise ParameterError(f"action must be integers from 0 to {levels - 1}, shape (n,), got {shown(action)}")
        values = given.astype(np.float32)[:, None] * np.float32(2 / (levels - 1)) - 1
    else:
        values = np.clip(given, -1e6, 1e6).astype(np.float32)  # it saturates at the range in any case
    return np.asarray(low + (values + 1) * (0.5 * (high - low)), np.float32)
