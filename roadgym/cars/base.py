"""What every car is: frozen parameters, its equations as matrices, and compiled functions over lanes."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from ..compiled import LaneFunction
from ..linear import Motion
from ..parameters import ParameterError

if TYPE_CHECKING:  # it loads pygame, which only those need who ask for pictures
    from ..drawing import Canvas


@dataclasses.dataclass(frozen=True, kw_only=True)
class Car(abc.ABC):
    """A car that a road moves, and a damper of ratio D resists.

    A new car subclasses this, as a frozen keyword-only dataclass whose field ``kind`` is its name, and supplies its
    ``natural_frequency`` w1, rad/s, and its `motion`: everything that theory, reward and observation know of it follows, and
    a signal that is added there is a mean square, a term of the reward and an observation at once. Its two lane functions (see
    `roadgym.compiled`) see lengths in standard deviations of the road and times in 1/w1. Both are of a block:

    - ``prepare``, at the beginning of a control interval, or of each substep where a valve moves the damping: what depends on
      the damping ``work[DAMPING + i]``;
    - ``advance``: moves the states ``car[k * LANES + i]``, in the order of `motion`, on by one substep ``work[SUBSTEP]``, over
      a level that goes to ``lanes[LEVEL + i]`` straight, but for its mean excess ``lanes[LEVEL_EXCESS + i]`` over that line.

    They may square the first ``squared`` of the signals themselves, which is faster: then ``prepare`` sets the rows
    ``work[WORK + k * LANES + i]`` to the squares now times ``work[SHARE]``, and ``advance`` adds to them. All other signals are
    squared for them. After these rows follow ``working_rows`` more for their own use within an interval. Signals behind filters
    (`roadgym.filters`) are made for them too.
    """

    if TYPE_CHECKING:

        @property
        def natural_frequency(self) -> float:
            """Undamped natural frequency w1 of the body, rad/s: the unit of time."""

    kind: str = dataclasses.field(default="", init=False)

    constructors: ClassVar[Mapping[str, str]] = {}  # class methods that make it of another parameter, by that parameter
    cost_unit: ClassVar[float | None] = None  # that of the weighted mean squares in the reward; None: E Z^2 of the road
    default_reward: ClassVar[Mapping[str, float]] = {"displacement": 1.0}
    optional: ClassVar[Mapping[str, Mapping[str, Any]]] = {}  # signals that it tells where asked to, and the fields that ask
    evaluated: ClassVar[tuple[str, ...]] = ()  # those of them that evaluations tell unasked
    usual_plant: ClassVar[Mapping[str, Any]] = {}  # parameters of the environment where a command is not given them
    starts_on_road: ClassVar[bool] = False  # does an episode start with its heights at that of the road, or at zero
    is_its_motion: ClassVar[bool] = False  # is its `motion` all that there is, with no equations of the lane functions' own
    time_powers: ClassVar[Mapping[str, int]] = {}  # powers of w1 over which signals are told that are told in metres
    squared: ClassVar[int] = 0
    working_rows: ClassVar[int] = 0
    prepare: ClassVar[LaneFunction]
    advance: ClassVar[LaneFunction]

    @property
    @abc.abstractmethod
    def motion(self) -> Motion:
        """Its equations in units of time 1/natural_frequency."""

    @property
    def rows(self) -> int:
        """Rows of the block that it needs, its states first; those of filters of its signals are not among them."""
        return len(self.motion.own.states)

    def with_signals(self, names: Iterable[str]) -> Self:
        """The car as it is, or telling those of its `optional` signals too that are among ``names``."""
        fields = {field: value for name in names for field, value in self.optional.get(name, {}).items()}
        return dataclasses.replace(self, **fields) if fields else self

    def table(self, substep: float, damping: tuple[float, float]) -> npt.NDArray[np.float64]:
        """Constants for the lane functions, the same for every lane.

        Args:
            substep: in units of 1/natural_frequency.
            damping: smallest and largest D that is met.
        """
        return np.zeros(1)

    @property
    def units(self) -> Mapping[str, float]:
        """The units in which a `roadgym.linear.Signal` can be told: by name, how many of it the 1 of the equations is."""
        w1 = self.natural_frequency
        return {"m": 1.0, "m/s": w1, "m/s²": w1**2}

    @property
    def unit_factors(self) -> npt.NDArray[np.float64]:
        """What makes each signal of the equations, in metres and times of 1/w1, one in its unit; shape (signals,).

        Raises:
            ParameterError: a signal in a unit that the car does not know.
        """
        known = self.units
        for name, signal in self.motion.signals.items():
            if signal.unit not in known:
                raise ParameterError(f"unit of the signal {name!r} must be one of {', '.join(known)}, got {signal.unit!r}")
        return np.array([known[signal.unit] for signal in self.motion.signals.values()])

    @property
    def default_damping_range(self) -> tuple[float, float]:
        """The range of D where none is given."""
        return (0.05, 1.0)

    @property
    def default_control_interval(self) -> float:
        """Time between actions where none is given, s."""
        return 0.2 / self.natural_frequency

    @property
    def static_load(self) -> float | None:
        """Mean force of its wheel on the road, N; None where it has no wheel of its own, or no mass."""
        return None

    @property
    def damping_unit(self) -> float | None:
        """Damping coefficient at D = 1, N s/m; None where the car has no mass."""
        return None

    @property
    def mean_squares(self) -> tuple[str, ...]:
        """Names of its signals, each of which has a mean square."""
        return tuple(self.motion.signals)

    @property
    def fastest(self) -> float:
        """The largest of its undamped natural frequencies, and of the rates of its filters, in units of w1."""
        own = float(np.abs(np.linalg.eigvals(self.motion.own.drift)).max())
        return max(own, *(chosen.rate for chosen in self.motion.filters.values())) if self.motion.filters else own

    @property
    def firmness(self) -> float:
        """Rate at which D = 1/2 alone stops the relative velocity, in units of w1: 1 for one mass."""
        return float(-np.trace(self.motion.damper))

    def decay(self, damping: float) -> float:
        """Rate at which its free motion, filters included, decays in the end at a constant D, in units of w1."""
        return float(-np.linalg.eigvals(self.motion.drift + 2 * damping * self.motion.damper).real.max())

    def draw(self, canvas: Canvas) -> None:
        """Draw the car; by default a body over a wheel that follows the road."""
        from ..drawing import body_on_wheel

        body_on_wheel(canvas, canvas.contact)
