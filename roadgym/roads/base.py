"""What every road is: frozen parameters, the stationary law, and compiled functions over lanes."""

from __future__ import annotations

import abc
import dataclasses
from typing import Any, ClassVar, TypeVar

import numpy as np
import numpy.typing as npt

from ..compiled import LaneFunction
from ..linear import ShapingFilter
from ..parameters import ParameterError, check_ratio, within

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

    What a component says of itself is checked when it is used (`roadgym.task.check_component`, `roadgym.plant.Plant`). Lane
    functions are trusted: nothing checks what they read and write. The table that they see has NaN after its end, so one that
    reads a little too far gives NaN, which is detected; one that reads or writes far off, or more words than it asked for,
    breaks the process.
    """

    kind: str = dataclasses.field(default="", init=False)
    wavenumber: float = 1.0

    has_slope: ClassVar[bool] = True  # is dZ/ds a number, that is, does Z contain no white noise in its derivative
    words_per_substep: ClassVar[int] = 2
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

    def check_driven(self) -> None:  # noqa: B027  (most roads that exist can be driven)
        """Raise `ParameterError` for a road that theory knows, and that cannot be driven."""

    def table(self) -> npt.NDArray[np.float64]:
        """Constants for the lane functions, the same for every lane."""
        return np.zeros(1)

    def shaping_filter(self, bandwidth: npt.ArrayLike | None = None) -> ShapingFilter | None:
        """The road as a linear filter, see `roadgym.linear`; None where it is none.

        Args:
            bandwidth: in place of the road's own, at the same variance, any shape; on roads that have one.
        """
        return None

    def with_bandwidth(self: Self, bandwidth: float) -> Self:
        """The same road with another bandwidth and the same variance; raises `ParameterError` on roads without one."""
        raise ParameterError(f"a {self.kind} road has no bandwidth")


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
