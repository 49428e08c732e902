"""A car whose numbers are each lane's own: what drives where `roadgym.variation` varies the car from episode to episode.

Each lane moves in the time of its own car, by the scheme of `roadgym.cars.linear`. After its states the block has, for each
lane, the series of its factors, what makes its signals, the sources of its filters, and its valve. They are written at the
start of an episode, and are in terms of the nominal car, with r = w1/nominal w1 and

    D of its own = firmer * D that is commanded,    signal as the nominal car tells it = unit * signal of its own,

so that the kernel, whose time is that of the nominal car, knows nothing else of it.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..compiled import DAMPING, LANES, LEVEL, LaneFunction
from ..filters import filter_sources, filtered
from ..linear import FloatArray, Motion, Signal
from ..valve import Valve
from .base import Car
from .linear import (
    DEGREE,
    FACTOR,
    FACTORS,
    NODES,
    PREVIOUS_LEVEL,
    STATES,
    LinearCar,
    chebyshev_powers,
    factors_at_nodes,
)

SERIES = STATES * LANES  # first of the rows of a lane's own numbers, after the states
TERMS = FACTORS * (DEGREE + 1)
VALVE_NUMBERS = (
    "valve_late",
    "valve_part",
    "valve_rate",
    "valve_rise",
    "valve_fall",
)  # of `roadgym.record.PLANT`, one row each


def exponentials(matrices: FloatArray) -> FloatArray:
    """Of matrices, shape (..., n, n), by Taylor's series and squaring: as many at once as there are."""
    size = float(np.abs(matrices).sum(axis=-1).max())
    halvings = max(0, math.ceil(math.log2(max(size, 1e-9) / 0.5)))
    small = matrices / 2**halvings
    found = term = np.eye(matrices.shape[-1]) + 0 * matrices
    for k in range(1, 15):  # 0.5^15/15! is below rounding
        term = term @ small / k
        found = found + term
    for _ in range(halvings):
        found = found @ found
    return found


@functools.cache
def _powers_of_values() -> FloatArray:
    """What makes of values at the nodes the coefficients of powers, the highest first, shape (nodes, powers)."""
    fitted = np.polynomial.chebyshev.chebfit(NODES, np.eye(DEGREE + 1), DEGREE)
    return np.asarray((fitted.T @ chebyshev_powers())[:, ::-1])


def in_terms_of(nominal: Car, car: Car, firmer: float) -> Motion:
    """The equations of ``car`` in the time of the ``nominal`` one, of its damping ratio, with signals as it tells them.

    Args:
        nominal: a car of the same states and signals.
        car: that drives.
        firmer: its own damping ratio over the nominal one, 1.
    """
    whole, faster = car.motion, car.natural_frequency / nominal.natural_frequency
    own, names = whole.own, list(whole.signals)
    powers = [nominal.time_powers.get(name, 0) for name in names]
    units = (car.unit_factors / nominal.unit_factors * faster ** np.array(powers)).tolist()
    unit = dict(zip(names, units, strict=True))
    force = firmer / unit[own.relative]
    of_input = {"level_rate": 1 / faster, "damper_force": force}

    def told(name: str, signal: Signal) -> Signal:
        terms = {term: factor * unit[name] * of_input.get(term, 1.0) for term, factor in signal.terms.items()}
        return dataclasses.replace(signal, terms=terms)

    found = dataclasses.replace(
        own,
        drift=faster * own.drift,
        level_entry=faster * own.level_entry,
        force_entry=faster * force * own.force_entry,
        signals={name: told(name, signal) for name, signal in own.signals.items()},
    )
    for name, chosen in nominal.motion.filters.items():  # which hear the signal in terms of the nominal car
        found = filtered(found, name, whole.signals[name].symbol, chosen)
    return found


@LaneFunction
def prepare(lanes: Any, car: Any, work: Any, table: Any) -> None:
    """The factors of a substep at the damping of each lane, by Horner's rule."""
    middle, inverse = table[0], table[1]
    for k in range(FACTORS):
        row, place = FACTOR + k * LANES, SERIES + k * (DEGREE + 1) * LANES
        for i in range(LANES):
            work[row + i] = car[place + i]
        for _ in range(DEGREE):
            place += LANES
            for i in range(LANES):
                work[row + i] = work[row + i] * ((work[DAMPING + i] - middle) * inverse) + car[place + i]
    for i in range(LANES):
        work[PREVIOUS_LEVEL + i] = lanes[LEVEL + i]


@dataclasses.dataclass(frozen=True, kw_only=True)
class VariedCar(LinearCar):
    """Cars like a nominal one, each lane's by itself; not for use by name.

    Args:
        nominal: the car in whose terms all is told.
    """

    kind: str = dataclasses.field(default="varied", init=False)
    nominal: Car

    prepare = prepare

    @property
    def natural_frequency(self) -> float:
        """That of the nominal car, rad/s: the unit of time."""
        return self.nominal.natural_frequency

    @property
    def motion(self) -> Motion:
        """That of the nominal car."""
        return self.nominal.motion

    @property
    def units(self) -> Mapping[str, float]:
        """Those of the nominal car."""
        return self.nominal.units

    @property
    def signal_row(self) -> int:
        """The first row of what makes the signals, after the first of the car's."""
        return SERIES + TERMS * LANES

    @property
    def source_row(self) -> int:
        """That of the sources of filters."""
        return self.signal_row + self.motion.rows.size * LANES

    @property
    def valve_row(self) -> int:
        """That of the valve's numbers."""
        return self.source_row + len(self.motion.filters) * 3 * (2 * len(self.motion.own.states) + 4) * LANES

    @property
    def rows(self) -> int:  # type: ignore[override]
        """States, and the numbers of a lane."""
        return self.valve_row // LANES + len(VALVE_NUMBERS)

    def table(self, substep: float, damping: tuple[float, float]) -> FloatArray:
        """Middle and inverse half width of the range of D, and which states are heights."""
        low, high = damping
        heights = np.zeros(STATES)
        heights[: len(self.motion.own.states)] = self.motion.own.follows
        return np.array([(low + high) / 2, 1 / max((high - low) / 2, 1e-9), *heights])

    def numbers(
        self, car: Car, valve: Valve, firmer: float, substep: float, interval: float, damping: tuple[float, float]
    ) -> FloatArray:
        """The numbers of a lane, one for each row after the states.

        Args:
            car, valve: that it drives.
            firmer: its own damping ratio over the nominal one, 1.
            substep: in units of 1/w1 of the nominal car.
            interval: the control interval, s.
            damping: smallest and largest nominal D that is met.
        """
        told = in_terms_of(self.nominal, car, firmer)
        factors = factors_at_nodes(told.own, substep, damping, exponentials)
        sources = [filter_sources(told, chosen.source, substep).ravel() for chosen in told.filters.values()]
        of_valve = valve.numbers(interval, self.nominal.natural_frequency)
        series = (factors.T @ _powers_of_values()).ravel()
        return np.concatenate([series, told.rows.ravel(), *sources, [of_valve[name] for name in VALVE_NUMBERS]])
