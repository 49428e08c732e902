"""A measured road: heights at even distances, straight between them, which repeat themselves.

A car that drives it in an episode starts at a place of its own, uniform over the period, which makes the road stationary; from
there it goes on around the period. The level at the end of a substep is exact, and so is its mean above the chord, however many
points a substep passes: the table has the area under the profile up to each of them. So only the car's own scheme
(`roadgym.cars`) is not exact.

What is measured has two ends. Its straight trend (altitude and grade) is taken out, and the last ``join`` metres fade over into
the first, along a raised cosine: the period is the length less ``join``. With ``join=0`` the heights are a period already,
the first following the last after one more spacing, and nothing but their mean is taken out. Hills are most of the variance of
a real road and move no car; waves longer than ``longest_wave`` are taken out of the period. `roadgym.roads.periodic` has what
theory knows of it.

The heights themselves are parameters, not the file that they come from: so a trained agent drives the road that it learned on,
wherever its folder is and whatever becomes of the file.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..compiled import COEFFICIENT, LANES, LEVEL, LEVEL_EXCESS, SLOPE, TURN, LaneFunction
from ..linear import FloatArray
from ..noise import uniform
from ..parameters import RANGES, ParameterError, check_ratio, non_negative, number_array, positive, shown
from .base import Road, check_fields
from .periodic import PeriodicLevel, joined
from .profile_files import read_profile

PLACE = COEFFICIENT  # row of our own: where on the period, in points

# the table: points in a period, points in a unit of angle, slope of a unit of climb, then of each point its level, the climb to
# the next one, and the area up to it in units of one point
NUMBER, PACE, STEEPNESS, POINTS = 0, 1, 2, 3
JOIN = 0.1  # of the length, by default


@LaneFunction
def start(lane: Any, words: Any, table: Any) -> None:
    """A place uniform over the period: the stationary law."""
    place = table[NUMBER] * uniform(words[0])
    row = POINTS + 3 * int(place)
    lane[PLACE] = place
    lane[LEVEL] = table[row] + (place - int(place)) * table[row + 1]
    lane[SLOPE] = table[STEEPNESS] * table[row + 1]


@LaneFunction
def advance(lanes: Any, words: Any, table: Any) -> None:
    """On by TURN; the mean level is the difference of two areas, as the area of a whole period is zero."""
    number, last = table[NUMBER], int(table[NUMBER]) - 1
    for i in range(LANES):
        place, way = lanes[PLACE + i], table[PACE] * lanes[TURN + i]
        old = int(place)
        share, row = place - old, POINTS + 3 * old
        area = table[row + 2] + share * (table[row] + 0.5 * share * table[row + 1])
        place += way
        place -= number * math.floor(place / number)
        new = min(int(place), last)
        share, row = place - new, POINTS + 3 * new
        level = table[row] + share * table[row + 1]
        area = table[row + 2] + share * (table[row] + 0.5 * share * table[row + 1]) - area
        lanes[LEVEL_EXCESS + i] = 0.0 if new == old and way < 1.0 else area / way - 0.5 * (lanes[LEVEL + i] + level)
        lanes[PLACE + i] = place
        lanes[LEVEL + i] = level
        lanes[SLOPE + i] = table[STEEPNESS] * table[row + 1]


@dataclasses.dataclass(frozen=True, kw_only=True)
class ProfileRoad(Road):
    """A measured road, straight between its points.

    Args:
        heights: m, of the points in order.
        spacing: distance between two of them, m.
        join: over how many metres the end fades over into the beginning, at most half of the length; by default a tenth of it,
            and 0 where the heights are one period as they are.
        longest_wave: m; longer ones are taken out. By default they stay.
        wavenumber: Omega, rad/m, the unit of speed: nu = speed * wavenumber/w1 is what is observed of the speed. By default 1,
            with which nu is about 1 where waves of 6 m, of those that shake a car the most, come at its natural frequency.
    """

    kind: str = dataclasses.field(default="profile", init=False)
    heights: tuple[float, ...] = dataclasses.field(repr=False)
    spacing: float
    join: float | None = None
    longest_wave: float | None = None

    constructors = {"file": "from_file"}  # noqa: RUF012 - of the class, as its base declares
    words_per_substep = 0
    rows = 1
    start = start
    advance = advance

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(self, spacing="profile spacing")
        heights, allowed = number_array("heights", self.heights), RANGES["profile points"]
        if heights.ndim != 1 or not allowed.low <= heights.size <= allowed.high:
            raise ParameterError(
                f"heights must be {allowed.low:.0f} to {allowed.high:.0f} numbers in a row, got the shape {heights.shape}"
            )
        object.__setattr__(self, "heights", tuple(heights.tolist()))
        length = self.spacing * (heights.size - 1)
        join = JOIN * length if self.join is None else non_negative("join", self.join)
        if join and not self.spacing <= join <= length / 2:
            raise ParameterError(
                f"join must be 0, or from the spacing, {self.spacing:g} m, to half of the length, {length / 2:g} m, "
                f"got {shown(self.join)}"
            )
        object.__setattr__(self, "join", join)
        if self.longest_wave is not None:
            object.__setattr__(self, "longest_wave", positive("longest_wave", self.longest_wave))
        check_ratio("heights", repr(self), "the variance E Z^2", self.variance, "variance")

    @classmethod
    def from_file(
        cls,
        file: str | os.PathLike[str],
        *,
        units: str | Sequence[str] | None = None,
        column: int | None = None,
        join: float | None = None,
        longest_wave: float | None = None,
        wavenumber: float = 1.0,
    ) -> ProfileRoad:
        """The road of a file, see `roadgym.roads.profile_files`.

        Args:
            file: its path.
            units, column: of `roadgym.read_profile`.
            join, longest_wave, wavenumber: as above.

        Raises:
            ParameterError: a file that cannot be read as a profile, or a value out of range.
        """
        profile = read_profile(file, units, column=column)
        return cls(
            heights=tuple(profile.heights.tolist()),
            spacing=profile.spacing,
            join=join,
            longest_wave=longest_wave,
            wavenumber=wavenumber,
        )

    @functools.cached_property
    def _hash(self) -> int:
        return hash((self.heights, self.spacing, self.join, self.longest_wave, self.wavenumber))

    def __hash__(self) -> int:
        """That of the parameters, found once: caches ask again and again."""
        return self._hash

    @functools.cached_property
    def _period(self) -> FloatArray:
        """Heights at the points of the period, of mean zero, m."""
        period = joined(np.array(self.heights), round((self.join or 0.0) / self.spacing))
        waves = np.fft.rfft(period - period.mean())
        if self.longest_wave is not None:
            length = self.spacing * len(period)
            waves[: math.ceil(length / self.longest_wave * (1 - 1e-9))] = 0
        return np.asarray(np.fft.irfft(waves, len(period)))

    @functools.cached_property
    def variance(self) -> float:
        """E Z^2 over the period, of the straight lines between the points, m^2."""
        following = np.roll(self._period, -1)
        return float(np.mean(self._period**2 + self._period * following + following**2) / 3)

    @property
    def precision(self) -> str:
        """Double, for the place on the period."""
        return "float64"

    @functools.cached_property
    def periodic(self) -> PeriodicLevel:
        """The period in standard deviations of the road."""
        return PeriodicLevel(levels=self._period / math.sqrt(self.variance), angle=self.spacing * self.wavenumber)

    @property
    def slope_variance(self) -> float:
        """E U^2 over E Z^2, of the straight lines."""
        return self.periodic.slope_variance

    def table(self) -> FloatArray:
        """The points; see above."""
        levels, climbs, angle = self.periodic.levels, self.periodic.climbs, self.periodic.angle
        area = np.concatenate([[0.0], np.cumsum(levels + climbs / 2)[:-1]])
        return np.concatenate([[len(levels), 1 / angle, 1 / angle], np.stack([levels, climbs, area], axis=1).ravel()])
