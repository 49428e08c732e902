"""Signals through a linear filter: how a filter is told, and how a plant follows it from substep to substep.

A filter has states f of its own, df/dt = F f + B u, with the source u, a signal of the car, and the filtered signal C f. In
theory these states are some more of the car's (`filtered`). The plant need not know that: its car moves
as before, and the filter follows the source over each substep h.

Let the source be u = g + k dZ/dt, where g = c q + l Z is what does not jump between two settings of D. As the car itself does
(`roadgym.cars.linear`), the filter takes the level as the straight line between its ends, raised by its mean excess m over that
line, and so g, which rises above its own line by the mean n:

    f(h) = E f(0) + P (g(0) + n + k (Z1 - Z0)/h) + Q (g(h) + n + k (Z1 - Z0)/h) + (E - I) B k m,    E = exp(h F),

where P and Q make the exact answer to a straight line, and the last term is that of the impulses k m and -k m. With the rate
G = c (A q + b Z) that g has beside the road's, n = (G(0) - G(h)) h/12 + (l + c e) m: the mean squares are of fourth order in h
as those of the car. Neither dZ/dt nor the squares of the source enter: the filtered signal is finite where the source is rough.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from .linear import FloatArray, Motion, Signal
from .parameters import ParameterError, number_array, positive


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class SignalFilter:
    """A filter of a signal, in sections of second order side by side, whose outputs add up; in units of time 1/w1.

    Its gain falls with the frequency in the end, so that white noise has a mean square behind it.

    Args:
        source: name of the signal that it filters.
        sections: F of each section, shape (sections, 2, 2).
        entries: B of each, shape (sections, 2).
        outputs: C of each, shape (sections, 2).
        rate: the largest angular frequency that it must follow exactly, of which a substep is a tenth of a radian.
    """

    source: str
    sections: FloatArray
    entries: FloatArray
    outputs: FloatArray
    rate: float

    def __post_init__(self) -> None:
        """Raise `ParameterError` for matrices of a wrong shape, and for a filter that does not forget."""
        count = len(np.atleast_1d(self.sections))
        for name, shape in (("sections", (count, 2, 2)), ("entries", (count, 2)), ("outputs", (count, 2))):
            array = number_array(f"{name} of a signal's filter", getattr(self, name))
            if array.shape != shape:
                raise ParameterError(f"{name} of a signal's filter must have the shape {shape}, got {array.shape}")
            object.__setattr__(self, name, array)
        if not np.all(np.linalg.eigvals(self.sections).real < 0):
            raise ParameterError("sections of a signal's filter must be stable")
        positive("rate of a signal's filter", self.rate)

    @property
    def size(self) -> int:
        """How many states it has."""
        return self.entries.size

    @property
    def drift(self) -> FloatArray:
        """F of all sections, shape (size, size)."""
        whole = np.zeros((len(self.sections), 2, len(self.sections), 2))
        whole[range(len(self.sections)), :, range(len(self.sections))] = self.sections
        return whole.reshape(self.size, self.size)


def filtered(motion: Motion, name: str, symbol: str, chosen: SignalFilter) -> Motion:
    """Equations with one more signal, ``name``, another one of theirs through a filter, in the unit of that.

    Raises:
        ParameterError: a source that is no signal of the car itself.
    """
    if chosen.source not in motion.own.signals:
        raise ParameterError(f"source of {name} must be one of {', '.join(motion.own.signals)}, got {chosen.source!r}")
    size, entry, source = len(motion.states), chosen.entries.ravel(), motion.signals[chosen.source]
    *own, level, rate, force = motion.rows[list(motion.signals).index(chosen.source)].tolist()
    states = [f"{name}_{k + 1}" for k in range(chosen.size)]
    drift = np.zeros((size + chosen.size, size + chosen.size))
    drift[:size, :size], drift[size:, :size], drift[size:, size:] = motion.drift, np.outer(entry, own), chosen.drift
    output = Signal(dict(zip(states, chosen.outputs.ravel().tolist(), strict=True)), symbol, source.unit)
    return dataclasses.replace(
        motion,
        states=(*motion.states, *states),
        drift=drift,
        level_entry=np.append(motion.level_entry, level * entry),
        slope_entry=np.append(motion.slope_entry, rate * entry),
        force_entry=np.append(motion.force_entry, -force * entry),
        follows=np.append(motion.follows, 0 * entry),
        signals={**motion.signals, name: output},
        filters={**motion.filters, name: chosen},
    )


def filter_sources(motion: Motion, name: str, substep: float) -> FloatArray:
    """What D makes of the source of a filter: coefficients of (1, D, D^2) of g, G h/12, k and l + c e, shape (3, 2 n + 4).

    Args:
        motion: the equations, of n states without filters.
        name: of the source.
        substep: in units of 1/w1.
    """
    own = motion.own
    size, places = len(own.states), {signal: k for k, signal in enumerate(own.signals)}
    relative = own.rows[places[own.relative]]
    states = np.column_stack([own.drift, own.level_entry, own.slope_entry])  # what states, level and its rate add to dq/dt
    damper = -2 * np.outer(own.force_entry, relative[:-1])  # and D times them
    source = own.rows[places[name]]
    firm = 2 * source[-1] * relative[:-1]
    signal = (source[:-1], firm, 0 * firm)  # of (q, Z, dZ/dt), in powers of D
    rate = (source[:size] @ states, firm[:size] @ states + source[:size] @ damper, firm[:size] @ damper)
    polynomial = np.zeros((3, 2 * size + 4))
    for power, (rows, rates) in enumerate(zip(signal, rate, strict=True)):
        polynomial[power, : size + 1] = rows[: size + 1]
        polynomial[power, size + 1 : 2 * size + 2] = rates[: size + 1] * (substep / 12)
        polynomial[power, 2 * size + 2] = rows[size + 1]
        polynomial[power, 2 * size + 3] = rows[size] + rates[size + 1]
    return polynomial


def filter_table(motion: Motion, substep: float) -> FloatArray:
    """Constants for `roadgym.signals.advance_filters`: of each filter a count, then two parts.

    They are its number of sections; `filter_sources`, one after the other; and for each section E, P, Q and (E - I) B.

    Args:
        motion: the equations with their filters.
        substep: in units of 1/w1.
    """
    if not motion.filters:
        return np.zeros(0)
    from scipy.linalg import expm

    tables = []
    for chosen in motion.filters.values():
        polynomial = filter_sources(motion, chosen.source, substep)
        steps = []
        for section, entry in zip(chosen.sections, chosen.entries, strict=True):
            block = np.zeros((4, 4))  # the section, an input that grows by 1 a substep, and 1
            block[:2, :2], block[:2, 2], block[2, 3] = section, entry, 1 / substep
            step = expm(block * substep)
            decay, steady, growing = step[:2, :2], step[:2, 2], step[:2, 3]
            steps.append(np.concatenate([decay.ravel(), steady - growing, growing, (decay - np.eye(2)) @ entry]))
        tables.append(np.concatenate([[len(steps)], polynomial.ravel(), *steps]))
    return np.concatenate(tables)
