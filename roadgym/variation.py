"""Cars that differ from episode to episode: fields of the car and of the valve, drawn anew for each.

A field is uniform between its bounds, a function of (seed, episode, field) alone: it is the same for every controller, and
whatever else varies. Who drives is told nothing of it: observations, actions, rewards and infos are those of the *nominal* car,
in its units, and a damping ratio D stands for the damping coefficient that it is in the nominal car, or for itself where a car
has no mass. So the same action is the same damper, on another car.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from .cars import Car
from .cars.varied import SERIES, VariedCar, in_terms_of
from .compiled import LANES, compiled
from .linear import Motion, Signal
from .noise import CAR, keys_from_seeds, philox, uniform
from .parameters import RANGES, ParameterError, number, shown
from .record import EPISODE, KEY
from .reward import divergence_cause, divergent_terms
from .roads import Road
from .speed import SpeedNoise
from .valve import Valve

OF_VALVE = "valve."  # before the names of its fields
VALVE_FIELDS = ("delay", "rate", "rise_time", "fall_time")


@dataclasses.dataclass(frozen=True)
class Variation:
    """What varies around a nominal car and valve; made by `make_variation`.

    Attributes:
        ranges: name, low and high end of each field; those of the valve are named as "valve.rise_time".
        car, valve: the nominal ones.
    """

    ranges: tuple[tuple[str, float, float], ...]
    car: Car
    valve: Valve

    @property
    def names(self) -> tuple[str, ...]:
        """Of the fields."""
        return tuple(name for name, _, _ in self.ranges)

    @property
    def varies_valve(self) -> bool:
        """Is a field of the valve among them?"""
        return any(name.startswith(OF_VALVE) for name in self.names)

    @property
    def slowest_valve(self) -> Valve:
        """The valve with the longest of all its times, which needs the most room."""
        return self.drawn([high for _, _, high in self.ranges])[1]

    @functools.cached_property
    def corners(self) -> tuple[Car, ...]:
        """The cars at all combinations of the ends."""
        ends = [ends for name, *ends in self.ranges if not name.startswith(OF_VALVE)]
        fixed = [[high] for name, _, high in self.ranges if name.startswith(OF_VALVE)]
        order = sorted(self.names, key=lambda name: name.startswith(OF_VALVE))
        found = []
        for values in itertools.product(*ends, *fixed):
            chosen = dict(zip(order, values, strict=True))
            found.append(self.drawn([chosen[name] for name in self.names])[0])
        return tuple(found)

    @property
    def cars(self) -> tuple[tuple[Car, float], ...]:
        """The nominal car and the corners, each with its `firmer`."""
        return tuple((car, self.firmer(car)) for car in (self.car, *self.corners))

    def drawn(self, values: Sequence[float]) -> tuple[Car, Valve]:
        """The car and the valve with these values of the fields, in order.

        Raises:
            ParameterError: a value that they refuse.
        """
        of_car: dict[str, Any] = {}
        of_valve: dict[str, Any] = {}
        for name, value in zip(self.names, values, strict=True):
            (of_valve if name.startswith(OF_VALVE) else of_car)[name.removeprefix(OF_VALVE)] = value
        return dataclasses.replace(self.car, **of_car), dataclasses.replace(self.valve, **of_valve)

    def firmer(self, car: Car) -> float:
        """What a nominal damping ratio is multiplied by to be that of ``car``, 1."""
        own, nominal = car.damping_unit, self.car.damping_unit
        return 1.0 if own is None or nominal is None else nominal / own

    def motion(self, values: Sequence[float]) -> Motion:
        """The equations of the car with these values of the fields, in order, in terms of the nominal one."""
        car, _ = self.drawn(values)
        return in_terms_of(self.car, car, self.firmer(car))

    def told_motion(self, values: Sequence[float]) -> Motion:
        """`motion` of states in the units in which environments tell them: as signals, where they are any."""
        motion = self.motion(values)
        units = np.ones(len(motion.states))
        for k, j in self._signals_of_states.items():
            units[k] = motion.rows[j, k]
        shares = dict(zip(motion.states, (1 / units).tolist(), strict=True))

        def told(signal: Signal) -> Signal:
            terms = {term: factor * shares.get(term, 1.0) for term, factor in signal.terms.items()}
            return dataclasses.replace(signal, terms=terms)

        return dataclasses.replace(
            motion,
            drift=motion.drift * (units[:, None] / units),
            level_entry=units * motion.level_entry,
            slope_entry=units * motion.slope_entry,
            force_entry=units * motion.force_entry,
            signals={name: told(signal) for name, signal in motion.signals.items()},
        )

    @property
    def _signals_of_states(self) -> dict[int, int]:
        """By the place of each state that is a signal the place of that."""
        motion = self.car.motion
        places = {name: j for j, (name, signal) in enumerate(motion.signals.items()) if dict(signal.terms) == {name: 1.0}}
        return {k: places[name] for k, name in enumerate(motion.states) if name in places}

    @property
    def driven_car(self) -> VariedCar:
        """What compiled code knows of all of them."""
        return VariedCar(nominal=self.car)

    def places(self, first: int) -> dict[str, int]:
        """Where the numbers of lanes are in a block whose rows of the car begin at ``first``, see `roadgym.record.PLANT`."""
        car, filters = self.driven_car, bool(self.car.motion.filters)
        return {
            "kept": first + SERIES,
            "kept_end": first + car.rows * LANES,
            "own_signals": first + car.signal_row,
            "own_sources": filters * (first + car.source_row),
            "own_valve": self.varies_valve * (first + car.valve_row),
        }

    def unit_rows(self, first: int) -> dict[str, int]:
        """Rows of what makes of a state the signal of its name, as the nominal car tells it, for each state that is a signal.

        Args:
            first: as of `places`.
        """
        states, begin = self.car.motion.states, self.places(first)["own_signals"]
        return {states[k]: begin + (j * (len(states) + 3) + k) * LANES for k, j in self._signals_of_states.items()}

    def numbers(
        self, values: npt.NDArray[np.float64], substep: float, interval: float, damping: tuple[float, float]
    ) -> npt.NDArray[np.float64]:
        """The numbers of lanes with these values of the fields, shape (fields, n), see `VariedCar.numbers`; shape (rows, n)."""
        driven, rows = self.driven_car, []
        for lane in values.T.tolist():
            car, valve = self.drawn(lane)
            rows.append(driven.numbers(car, valve, self.firmer(car), substep, interval, damping))
        return np.array(rows).T

    def draws(self, counters: npt.NDArray[np.uint32]) -> npt.NDArray[np.float64]:
        """The values of the next episodes, shape (fields, n), from rows of counters, see `roadgym.record`, shape (rows, n)."""
        words = np.array([zlib.crc32(name.encode()) for name in self.names], np.uint32)
        shares = np.empty((len(words), counters.shape[1]))
        key = KEY // LANES
        _fill(words, counters[key], counters[key + 1], counters[EPISODE // LANES], shares)
        low, high = np.array([ends for _, *ends in self.ranges]).T[:, :, None]
        return np.asarray(low + (high - low) * shares)

    def first_draws(self, seeds: npt.NDArray[np.uint64]) -> npt.NDArray[np.float64]:
        """The values in the first episodes of environments with these seeds, shape (fields, n)."""
        counters = np.full((EPISODE // LANES + 1, len(seeds)), 0xFFFFFFFF, np.uint32)  # episodes before the first
        counters[KEY // LANES : KEY // LANES + 2] = keys_from_seeds(seeds)
        return self.draws(counters)


@compiled
def _fill(words: Any, first: Any, second: Any, episodes: Any, shares: Any) -> None:
    for j in range(words.size):
        for i in range(episodes.size):
            word, _, _, _ = philox(words[j], np.uint32(0), episodes[i] + np.uint32(1), np.uint32(CAR), first[i], second[i])
            shares[j, i] = uniform(word)


def make_variation(
    vary: Any, car: Car, valve: Valve, interval: float, road: Road, speed_noise: SpeedNoise | None
) -> Variation | None:
    """What varies, from a mapping of fields of the car, or of the valve as "valve.rise_time", to (low, high); None for nothing.

    Args:
        vary: the mapping, or None.
        car, valve: the nominal ones.
        interval: the control interval, s.
        road, speed_noise: what they drive on.

    Raises:
        ParameterError: a field that is not there or no number, a range that is none, or that holds a value which car or valve
            refuse, or with which other signals are infinite.
    """
    if vary is None or vary == {}:
        return None
    if not isinstance(vary, Mapping):
        raise ParameterError(f"vary must be a mapping from fields of the car or of the valve to (low, high), got {shown(vary)}")
    if not car.is_its_motion:
        raise ParameterError(f"vary needs a car that is its motion alone, as every LinearCar is, got the {car.kind} car")
    numbers = {field.name: getattr(car, field.name) for field in dataclasses.fields(car)}
    fields = [name for name, value in numbers.items() if isinstance(value, (int, float)) and not isinstance(value, bool)]
    known = [*fields, *(OF_VALVE + name for name in VALVE_FIELDS)]
    ranges = []
    for name, ends in vary.items():
        if name not in known:
            raise ParameterError(f"vary knows no field {shown(name)} of a number; known: {', '.join(known)}")
        if name in (*car.mean_squares, "damping", "speed", "bandwidth"):
            raise ParameterError(f"vary cannot tell the field {name!r} from the info of that name")
        listed = isinstance(ends, (Sequence, np.ndarray)) and not isinstance(ends, (str, bytes)) and len(ends) == 2
        low, high = (
            (number(f"{end} end of vary {name}", value) for end, value in zip(("low", "high"), ends, strict=True))
            if listed
            else (0, 0)
        )
        if not low < high:
            raise ParameterError(f"vary {name} must be a pair (low, high) with low < high, got {shown(ends)}")
        ranges.append((name, low, high))
    if len(ranges) > RANGES["varied fields"].high:
        raise ParameterError(f"vary must name at most {RANGES['varied fields'].high:g} fields, got {len(ranges)}")
    found = Variation(tuple(ranges), car, valve)
    for k, (name, *ends) in enumerate(found.ranges):
        nominal = Variation(found.ranges[k : k + 1], car, valve)
        for end in ends:
            try:
                nominal.drawn([end])[1].check(interval)
            except ParameterError as error:
                raise ParameterError(f"vary {name} holds a value that is refused: {error}") from None
    for corner in found.corners:
        if (corner.motion.states, list(corner.motion.signals)) != (car.motion.states, list(car.motion.signals)):
            raise ParameterError(f"vary must leave a {car.kind} car its states and signals")
        infinite = {*divergent_terms(corner, road, speed_noise)} ^ {*divergent_terms(car, road, speed_noise)}
        for name in sorted(infinite):
            cause = divergence_cause(road, speed_noise)
            raise ParameterError(f"vary must leave {name} finite or infinite, as it is in the nominal car, on {cause}")
    return found
