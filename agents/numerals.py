"""How numbers are written: shares in per cent, values with the error of their last digits, columns under their points."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from .results import Share

NUMBER = re.compile(r"-?\d")


def percent(share: Share | None) -> str:
    """A share in per cent with half its confidence interval, or n/a; no number where it is a loss of more than all."""
    if share is None:
        return "n/a"
    if share.value < -1:
        return "< -100 %"
    # adding 0 makes 0.0 of -0.0
    return f"{round(100 * share.value, 1) + 0:.1f} ±{50 * (share.high - share.low):.1f} %"


def above(share: Share) -> str:
    """What a cost is to one that it is compared with, from the share that it is above: in per cent, or as a multiple."""
    if share.value > 1:
        return f"{1 + share.value:.3g} times"
    if share.value >= 0:
        return f"{percent(share)} above"
    return f"{percent(Share(-share.value, -share.high, -share.low))} below"


def aligned(cells: Sequence[str]) -> list[str]:
    """The cells in one width, numbers with their decimal points under each other, other text at the right."""
    parts = [cell.partition(".") if NUMBER.match(cell) else ("", "", "") for cell in cells]
    left, right = (max(len(part) for part in side) for side in ([p[0] for p in parts], [p[1] + p[2] for p in parts]))
    width = max(left + right, *map(len, cells))
    return [
        (part[0].rjust(left) + (part[1] + part[2]).ljust(right) if part[0] else cell).rjust(width)
        for cell, part in zip(cells, parts, strict=True)
    ]


def with_error(value: float, error: float) -> str:
    """``value`` with the standard error of its last digits in brackets: 0.2561(12) is 0.2561 ± 0.0012."""
    if not np.isfinite(error) or error <= 0:
        return f"{value:.4f}"
    digits = _decimals(value, error)
    return f"{value:.{digits}f}({round(error * 10**digits)})"


def _decimals(value: float, error: float) -> int:
    """Decimals that show two digits of a standard error, but no more than six digits of the value."""
    if not (np.isfinite(error) and error > 0):
        return 4
    most = 6 + max(0, -int(np.floor(np.log10(abs(value)))) - 1) if value else 6
    return min(max(1 - int(np.floor(np.log10(error))), 0), most)


def as_exact_as(value: float, cost: float, error: float) -> str:
    """An exact value, with no fewer decimals than a cost of this standard error is shown with."""
    return f"{value:.{max(4, _decimals(cost, error))}f}"
