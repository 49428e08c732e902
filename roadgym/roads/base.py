"""What every road is: frozen parameters, the stationary law, and compiled functions over lanes."""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar, TypeVar

import numpy as np
import numpy.typing as npt

from ..compiled import LEVEL, OWN_ROWS, SLOPE, LaneFunction
from ..linear import ShapingFilter
from ..parameters import ParameterError, check_ratio, within
from .periodic import PeriodicLevel

Self = TypeVar("Self", bound="Road")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Road(abc.ABC):
    """A road Z(s) over the distance s, stationary, with zero mean.

    Parameters are kept as plain floats.

    A new road subclasses this, as a frozen keyword-only dataclass whose field ``kind`` is its name, checks its parameters in
    ``__post_init__`` and supplies the abstract properties and up to three lane functions (see `roadgym.compiled`). They see the
    road in units of its standard deviation and in terms of the angle wavenumber * distance:

    - ``prepare``, of one lane: fills the COEFFICIENT rows from the rows TURN (angle a substep) and BANDWIDTH; None if there is
      nothing to prepare;
    - ``start``, of one lane: draws LEVEL and SLOPE from the stationary law with up to four words;
    - ``advance``, of a whole block: moves LEVEL and SLOPE on by one substep with ``words_per_substep`` words a lane, and sets
      LEVEL_EXCESS.

    What theory needs to know it asks the road: `lines`, `shaping_filter` or `periodic`, of which one is enough for every mean
    square, the best constant damping and the autocovariance. A road with none is driven wherever theory would be asked.

    What a component says of itself is checked when it is used (`roadgym.task.check_component`, `roadgym.plant.Plant`). Lane
    functions are trusted: nothing checks what they read and write. The table that they see has NaN after its end, so one
    that reads a little too far gives NaN, which is detected; what one raises is lost, with all that it would have done
    after it; one that reads or writes far off, or more words than it asked for, breaks the process.
    """

    kind: str = dataclasses.field(default="", init=False)
    wavenumber: float = 1.0

    has_slope: ClassVar[bool] = True  # is dZ/ds a number, that is, does Z contain no white noise in its derivative
    words_per_substep: ClassVar[int] = 2
    rows: ClassVar[int] = OWN_ROWS  # of its own, from COEFFICIENT on
    takes_phase_noise: ClassVar[bool] = False  # does ``advance`` heed TURN_EXCESS and TURN_VARIANCE, and turn backwards too
    constructors: ClassVar[Mapping[str, str]] = {}  # class methods that make it of another parameter, by that parameter
    largest_loss: ClassVar[float] = math.inf  # bandwidth times the angle of a step up to which its law is right
    loss_range: ClassVar[str] = "loss"  # range of the bandwidth times the angle of a substep, in `roadgym.parameters.RANGES`
    prepare: ClassVar[LaneFunction | None] = None
    start: ClassVar[LaneFunction]
    advance: ClassVar[LaneFunction]

    def __post_init__(self) -> None:
        check_fields(self, wavenumber="wavenumber")

    @property
    @abc.abstractmethod
    def variance(self) -> float:
        """Stationary variance E Z^2, m^2."""

    @property
    def precision(self) -> str:
        """Floating-point format that the road's law needs at least: "float32" or "float64"."""
        return "float32"

    @property
    def variance_standard_error(self) -> float:
        """Standard error of the variance, m^2, where that is not exact."""
        return 0.0

    def check_driven(self) -> None:  # noqa: B027  (most roads that exist can be driven)
        """Raise `ParameterError` for a road that theory knows, and that cannot be driven."""

    def table(self) -> npt.NDArray[np.float64]:
        """Constants for the lane functions, the same for every lane."""
        return np.zeros(1)

    @property
    def lines(self) -> tuple[tuple[float, float], ...] | None:
        """The spectrum of a road that is a sum of waves with independent uniform phases; None of any other road.

        A pair for each wave: its share of the variance, and its wavenumber over that of the road.
        """
        return None

    @property
    def periodic(self) -> PeriodicLevel | None:
        """The level of a road that repeats itself and is straight between points, too many lines for a filter; else None."""
        return None

    def shaping_filter(self, bandwidth: npt.ArrayLike | None = None) -> ShapingFilter | None:
        """The road as a linear filter, see `roadgym.linear`; None where it is none. Of waves, an oscillator each.

        Args:
            bandwidth: in place of the road's own, at the same variance, any shape; on roads that have one.
        """
        return None if self.lines is None else waves(self.lines)

    @property
    def state_rows(self) -> tuple[int, ...] | None:
        """Rows of the block that hold the states of `shaping_filter`; None where they are not all kept."""
        road = self.shaping_filter()
        return (LEVEL, SLOPE)[: len(road.states)] if road is not None and len(road.states) <= 2 else None

    @property
    def slope_variance(self) -> float | None:
        """Stationary variance of the scaled slope U over that of the level, 1; None where it is not known."""
        road = self.shaping_filter()
        if road is None or not self.has_slope:
            return None
        slope = road.level @ road.drift
        return float(slope @ road.covariance @ slope)

    def with_bandwidth(self: Self, bandwidth: float) -> Self:
        """The same road with another bandwidth and the same variance; raises `ParameterError` on roads without one."""
        raise ParameterError(f"a {self.kind} road has no bandwidth")


def waves(lines: tuple[tuple[float, float], ...]) -> ShapingFilter:
    """A sum of waves (see `Road.lines`): oscillators without damping and noise, whose phases are uniform at the start."""
    shares, ratios = np.array(lines, float).T
    size = 2 * len(lines)
    drift = np.zeros((size, size))
    drift[range(0, size, 2), range(1, size, 2)], drift[range(1, size, 2), range(0, size, 2)] = ratios, -ratios
    level = np.zeros(size)
    level[::2] = np.sqrt(shares)
    names = (
        ("level", "slope")
        if len(lines) == 1
        else (f"{part} of wave {k + 1}" for k in range(len(lines)) for part in ("level", "slope"))
    )
    return ShapingFilter(states=tuple(names), drift=drift, noise=np.zeros((size, 0)), level=level, covariance=np.eye(size))


def check_fields(component: Any, **ranges: str) -> None:
    """Make each named field of a frozen component a float, in the range of `roadgym.parameters.RANGES` that stands by it.

    Raises:
        ParameterError: it is not.
    """
    for name, of in ranges.items():
        object.__setattr__(component, name, within(name, getattr(component, name), of))


def check_variance(road: Road, name: str) -> None:
    """Raise `ParameterError` unless the variance is in its range; ``name`` is the parameter that fixes it."""
    check_ratio(name, getattr(road, name), "the variance E Z^2", road.variance, "variance")
