"""A valve between the damping ratio that is commanded and the one in force: delay, quantisation, limited rate, lag, in order.

    command -> after the delay -> nearest level -> target r, |dr/dt| <= rate -> dD/dt = (r - D)/tau -> D in force

with tau the rise time where r > D, and the fall time where r < D. A delay may be any number of control intervals and a part of
one. All of it is exact: between the jumps of its input D is the sum of a straight line and an exponential. D in force goes from
one command to the next, so it stays within the range of damping ratios. At a start the valve has been told the softest damping
for long; a warm-up is driven without a valve.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from .component import make_part
from .parameters import check_ratio, whole, within
from .record import interval_weights


@dataclasses.dataclass(frozen=True, kw_only=True)
class Valve:
    """What is between a command and the damping in force; by default nothing, D is in force at once.

    Args:
        delay: of a command, s.
        levels: how many damping ratios it can set, at equal distances over the range, the nearest to the command; None for all.
        rate: largest rate at which its target moves, damping ratio a second, 1/s; None for any.
        rise_time: time constant of the lag towards a firmer damping, s.
        fall_time: that towards a softer one, s.

    Raises:
        ParameterError: a number out of its range.
    """

    delay: float = 0.0
    levels: int | None = None
    rate: float | None = None
    rise_time: float = 0.0
    fall_time: float = 0.0

    def __post_init__(self) -> None:
        for name in ("delay", "rise_time", "fall_time"):
            object.__setattr__(self, name, within(f"{name} of the valve", getattr(self, name), "valve time"))
        if self.levels is not None:
            object.__setattr__(self, "levels", whole("levels of the valve", self.levels, low=2, of="levels"))
        if self.rate is not None:
            object.__setattr__(self, "rate", within("rate of the valve", self.rate, "valve rate"))

    @property
    def ideal(self) -> bool:
        """Is every command in force at once?"""
        return self == Valve()

    def is_still(self, interval: float) -> bool:
        """Does D in force keep its value within each control ``interval``, s?"""
        whole_delay = abs(self.delay / interval - round(self.delay / interval)) < 1e-9
        return whole_delay and self.rate is None and self.rise_time == self.fall_time == 0

    def settled(self, damping: npt.ArrayLike, damping_range: tuple[float, float]) -> npt.NDArray[np.float64]:
        """The damping ratios that constant commands come to in the end, any shape."""
        low, high = damping_range
        kept: npt.NDArray[np.float64] = np.clip(np.asarray(damping, float), low, high)
        if self.levels is None:
            return kept
        step = (high - low) / (self.levels - 1)
        return np.asarray(low + step * np.rint((kept - low) / step))

    def check(self, interval: float) -> None:
        """Raise `ParameterError` unless the delay is in its range at a control ``interval``, s."""
        what = "the delay in control intervals"
        check_ratio("delay of the valve", self.delay, what, self.delay / interval, "delay")

    def numbers(self, interval: float, natural_frequency: float) -> dict[str, float]:
        """What compiled code knows of it, see `roadgym.record.PLANT`: delays in control intervals, times in units of 1/w1.

        Args:
            interval: the control interval, s.
            natural_frequency: w1, rad/s.
        """
        late, part = divmod(round(self.delay / interval, 9), 1)
        return {
            "valve": not self.ideal,
            "valve_moves": not self.is_still(interval),
            "valve_late": int(late),
            "valve_part": part,
            "valve_levels": self.levels or 0,
            "valve_rate": math.inf if self.rate is None else self.rate / natural_frequency,
            "valve_rise": self.rise_time * natural_frequency,
            "valve_fall": self.fall_time * natural_frequency,
        }

    def rows(self, interval: float) -> int:
        """Rows of the block that it needs: D in force, the target, and the commands that wait, the newest first."""
        return 0 if self.ideal else 4 + math.floor(self.delay / interval)


def make_valve(valve: Any) -> Valve:
    """A valve from a mapping of its parameters, or as it is; None for the ideal one.

    Raises:
        ParameterError: something else, an unknown parameter, or a value out of range.
    """
    return Valve() if valve is None else make_part(Valve, "valve", valve)


def shares_of_ends(substeps: int) -> npt.NDArray[np.float64]:
    """Shares of both ends of each substep in a mean over the interval, shape (substeps, 2), where D differs between substeps.

    Those of a substep make 1/substeps, so that what jumps has its due weight, and those of an instant the weight in
    `roadgym.record.interval_weights`, so that what is smooth keeps the order of that rule.
    """
    before = np.cumsum(interval_weights(substeps))[:-1]
    steps = np.arange(substeps)
    return np.stack([before - steps / substeps, (steps + 1) / substeps - before], axis=1)
