"""What is linear of a plant: road and car as matrices, and what follows for every road and every car at once.

Between two settings of D the plant is linear. A road that is a linear filter of white noise over its angle theta declares a
`ShapingFilter`, a car its `Motion`; `LinearSystem.of` stacks them into x = (car, road), in units of the road's standard
deviation and of time 1/w1:

    road   dr = F r dtheta + G dB(theta),   Z = c r,   dtheta = nu dt
    car    dq/dt = A q + b Z + e dZ/dt - f F_D,   F_D = 2 D (relative velocity)
    both   dx = drift x dt + noise dB(t)

Where c G is not zero, the rate of the level contains white noise: signals that it enters have no mean square, and are *rough*.

The bounded road has a noise whose intensity depends on its state, 1 + flatness (1 - r' P^-1 r/n) of that of its linear twin,
with the stationary covariance P and n states, on average 1. So it has the same second moments as its twin, and its generator
maps quadratic forms to quadratic forms (`form_rate`).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from .parameters import ParameterError, number, number_array

if TYPE_CHECKING:
    from .filters import SignalFilter

FloatArray = npt.NDArray[np.float64]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class ShapingFilter:
    """A road of unit variance as a linear filter over its angle, wavenumber * distance.

    Args:
        states: names of the states r.
        drift: F, shape (..., n, n), with leading axes over bandwidths.
        noise: G, shape (..., n, m); no columns where nothing is random but the start.
        level: c, the row of the level Z, shape (n,).
        covariance: P, the stationary covariance of r, shape (n, n).
        flatness: how much the intensity of the noise gives way to the state, 1/alpha on the bounded road; None where its law
            beyond the stationary second moments is not of this form.
        bandwidth: delta, where this is the filter (7), (8) of Wedig (2020), which has closed forms of its own.
    """

    states: tuple[str, ...]
    drift: FloatArray
    noise: FloatArray
    level: FloatArray
    covariance: FloatArray
    flatness: float | None = 0.0
    bandwidth: FloatArray | None = None

    @property
    def is_first_order(self) -> bool:
        """Is this the filter (4) of Wedig (2020), which has closed forms of its own?"""
        return self.drift.shape == (1, 1) and self.drift[0, 0] == -1

    @property
    def slowest(self) -> float:
        """Rate at which what has been is forgotten in the end, over the angle; 0 where nothing is."""
        return max(0.0, -float(np.max(np.linalg.eigvals(self.drift).real)))

    def autocovariance(self, angle: npt.ArrayLike) -> FloatArray:
        """E Z(0) Z(angle) at angles >= 0, in their shape; one operating point."""
        from scipy.linalg import expm

        turns = np.asarray(angle, float)
        return np.asarray(expm(self.drift * turns[..., None, None]) @ (self.covariance @ self.level) @ self.level)

    def spectrum(self, wavenumber: npt.ArrayLike) -> FloatArray:
        """Two-sided spectral density of the level over the angle, at wavenumbers over the road's; one operating point."""
        k = np.asarray(wavenumber, float)
        gain = self.level @ np.linalg.inv(1j * k[..., None, None] * np.eye(len(self.level)) - self.drift) @ self.noise
        return np.asarray(np.sum(np.abs(gain) ** 2, axis=-1))


RESERVED = frozenset({"level", "level_rate", "damper_force", "slope", "speed", "bandwidth", "turn", "rate", "damping"})
INPUTS = ("level", "level_rate", "damper_force")  # Z, dZ/dt and F_D, which enter signals beside the states of the car


@dataclasses.dataclass(frozen=True)
class Signal:
    """What is observed of a car, and has a mean square: a sum of its states and of `INPUTS`.

    Args:
        terms: factor of each by name.
        symbol: how pictures call it.
        unit: in which it is told, of those that the car knows (`roadgym.cars.Car.units`); in metres velocities are over w1 and
            accelerations over w1^2, as in the equations.
    """

    terms: Mapping[str, float]
    symbol: str
    unit: str = "m"


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """The equations of a car between two settings of its damper, in units of time 1/w1.

    Args:
        states: names of the states q.
        drift: A, without the damper, shape (n, n).
        level_entry, slope_entry, force_entry: b, e and f, shape (n,).
        signals: by name, see `Signal`; the damper's force does not enter the one that is ``relative``.
        relative: name of the signal that the damper resists, the relative velocity.
        follows: 1 for each state that is a height, and nearly that of a slow road, else 0; shape (n,).
        filters: by the signal that each makes, where `roadgym.filters.filtered` made these equations; the last states are
            theirs.
    """

    states: tuple[str, ...]
    drift: FloatArray
    level_entry: FloatArray
    slope_entry: FloatArray
    force_entry: FloatArray
    signals: Mapping[str, Signal]
    relative: str = "relative_velocity"
    follows: FloatArray
    filters: Mapping[str, SignalFilter] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raise `ParameterError` for matrices of a wrong shape, and for names or terms that are not defined."""
        size = len(self.states)
        for name in ("drift", "level_entry", "slope_entry", "force_entry", "follows"):
            array, shape = number_array(f"{name} of a car's motion", getattr(self, name)), (size,) * (1 + (name == "drift"))
            if array.shape != shape:
                raise ParameterError(f"{name} of a car's motion must have the shape {shape}, got {array.shape}")
            object.__setattr__(self, name, array)
        names = (*self.states, *INPUTS)
        for name, signal in self.signals.items():
            for term, factor in signal.terms.items():
                if term not in names:
                    raise ParameterError(f"signal {name!r} has the unknown term {term!r}; known: {', '.join(names)}")
                number(f"factor of {term} in the signal {name!r}", factor)
        for taken in {*self.states, *self.signals} & RESERVED:
            raise ParameterError(f"states and signals of a car must not be named {', '.join(sorted(RESERVED))}, got {taken!r}")
        if self.relative not in self.signals or "damper_force" in self.signals[self.relative].terms:
            raise ParameterError(f"relative must be a signal that has no damper_force, got {self.relative!r}")

    @functools.cached_property
    def own(self) -> Motion:
        """These equations without their filters."""
        if not self.filters:
            return self
        size = len(self.states) - sum(chosen.size for chosen in self.filters.values())
        names = {*self.states[:size], *INPUTS}
        vectors = {name: getattr(self, name)[:size] for name in ("level_entry", "slope_entry", "force_entry", "follows")}
        return dataclasses.replace(
            self,
            states=self.states[:size],
            drift=self.drift[:size, :size],
            signals={name: signal for name, signal in self.signals.items() if names >= set(signal.terms)},
            filters={},
            **vectors,
        )

    @functools.cached_property
    def rows(self) -> FloatArray:
        """Factors of the states and of `INPUTS` in each signal, shape (signals, n + 3)."""
        names = (*self.states, *INPUTS)
        return np.array([[float(signal.terms.get(name, 0.0)) for name in names] for signal in self.signals.values()])

    @property
    def rough(self) -> tuple[str, ...]:
        """Names of the signals that the rate of the level enters, and with it white noise where that contains some."""
        relative_rate = self.rows[list(self.signals).index(self.relative), -2]
        return tuple(name for name, row in zip(self.signals, self.rows, strict=True) if row[-2] or (row[-1] and relative_rate))

    @property
    def damper(self) -> FloatArray:
        """What 2 D times it adds to the drift: - force_entry relative, shape (n, n)."""
        relative = self.rows[list(self.signals).index(self.relative), : len(self.states)]
        return -np.outer(self.force_entry, relative)

    @property
    def is_one_mass(self) -> bool:
        """Is this the car (1) of Wedig (2020), whose mean squares have closed forms?"""
        relative = self.rows[list(self.signals).index(self.relative)]
        return self.states == ("displacement", "velocity") and all(
            np.array_equal(own, known)
            for own, known in (
                (self.drift, [[0, 1], [-1, 0]]),
                (self.level_entry, [0, 1]),
                (self.slope_entry, [0, 0]),
                (self.force_entry, [0, 1]),
                (relative, [0, 1, 0, -1, 0]),
            )
        )


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class LinearSystem:
    """Car and road at constant dampings, speeds and bandwidths; made by `of`. Leading axes (...) are those operating points.

    Attributes:
        states: names of the states x, those of the car first.
        car_states: how many they are.
        filter_states: how many of them, the last, are those of filters, which do not act back on the car.
        drift: shape (..., n, n).
        noise: shape (..., n, m).
        signals: rows of the signals by name, shape (..., n) each.
        rough: names of the signals that contain white noise.
        force_entry: f, and force of each signal, for a force in place of the damper's; shape (n,) and numbers.
        heights: Z as a row of the road, for the states of the car that are heights; shape (car states, road states).
        road_covariance: P of `ShapingFilter`.
        flatness: of `ShapingFilter`.
    """

    states: tuple[str, ...]
    car_states: int
    filter_states: int
    drift: FloatArray
    noise: FloatArray
    signals: Mapping[str, FloatArray]
    rough: frozenset[str]
    force_entry: FloatArray
    force: Mapping[str, float]
    heights: FloatArray
    road_covariance: FloatArray
    flatness: float | None

    @classmethod
    def of(cls, road: ShapingFilter, car: Motion, *, damping: npt.ArrayLike, ratio: npt.ArrayLike) -> LinearSystem:
        """Stack road and car.

        Args:
            road: the road, its leading axes broadcasting with the others.
            car: the car.
            damping: D, any shape.
            ratio: nu = speed * wavenumber / w1, any shape.
        """
        twice, nu = np.broadcast_arrays(2 * np.asarray(damping, float), np.asarray(ratio, float))
        shape = np.broadcast_shapes(twice.shape, road.drift.shape[:-2])
        twice, nu = (np.broadcast_to(value, shape)[..., None] for value in (twice, nu))  # rows
        cars, roads = len(car.states), len(road.states)

        slope = nu * (road.level @ road.drift)
        roughness = road.level @ road.noise  # of the slope, in units of the root of nu

        factors = dict(zip(car.signals, car.rows, strict=True))

        def row(name: str) -> FloatArray:
            level, rate, _ = factors[name][cars:]
            own = np.broadcast_to(factors[name][:cars], (*shape, cars))
            return np.concatenate([own, level * road.level + rate * slope], axis=-1)

        relative = row(car.relative)
        drift = np.zeros((*shape, cars + roads, cars + roads))
        drift[..., :cars, :cars] = car.drift
        drift[..., :cars, cars:] = car.level_entry[:, None] * road.level + car.slope_entry[:, None] * slope[..., None, :]
        drift[..., cars:, cars:] = nu[..., None] * road.drift
        drift[..., :cars, :] -= twice[..., None] * car.force_entry[:, None] * relative[..., None, :]
        relative_rate = factors[car.relative][cars + 1]
        entry = car.slope_entry - twice * relative_rate * car.force_entry
        noise = np.zeros((*shape, cars + roads, road.noise.shape[-1]))
        noise[..., :cars, :] = entry[..., None] * roughness[..., None, :]
        noise[..., cars:, :] = road.noise
        force = {name: float(factor[-1]) for name, factor in factors.items()}
        signals = {name: row(name) + twice * force[name] * relative for name in car.signals}
        return cls(
            states=car.states + road.states,
            car_states=cars,
            filter_states=cars - len(car.own.states),
            drift=drift,
            noise=noise * np.sqrt(nu)[..., None],
            signals=signals,
            rough=frozenset(car.rough if np.any(roughness) else ()),
            force_entry=np.append(car.force_entry, np.zeros(roads)),
            force=force,
            heights=np.outer(car.follows, road.level),
            road_covariance=road.covariance,
            flatness=road.flatness,
        )

    def covariance(self) -> FloatArray:
        """Stationary covariance of x, shape (..., n, n).

        The road's is known, and drives the car, as both drive the filters of signals.
        """
        own, cars, size = self.car_states - self.filter_states, self.car_states, len(self.states)
        order = np.array([*range(own, cars), *range(own), *range(cars, size)])  # each of the three is driven by those after it
        drift, noise = self.drift[..., order[:, None], order], self.noise[..., order, :]
        covariance = self.road_covariance
        for first in (self.filter_states, 0)[: 1 + bool(self.filter_states)]:
            covariance = _joint_covariance(drift[..., first:, first:], noise[..., first:, :], covariance)
        place = np.argsort(order)
        return covariance[..., place[:, None], place]

    def mean_squares(self) -> dict[str, FloatArray]:
        """Stationary mean squares of the signals by name, shape (...); infinite where they are rough."""
        # On a slow road the car follows the level, and what matters is a small difference of large numbers: with heights above
        # the road as states, mean squares are right to 1e-8 of themselves for D from .001 to 100 and nu from .001 to 1000.
        away, back = np.eye(len(self.states)), np.eye(len(self.states))
        cars = self.car_states
        away[:cars, cars:], back[:cars, cars:] = -self.heights, self.heights
        covariance = dataclasses.replace(self, drift=away @ self.drift @ back, noise=away @ self.noise).covariance()
        found = {}
        for name, row in self.signals.items():
            above = row @ back
            found[name] = np.einsum("...i,...ij,...j->...", above, covariance, above)
            if name in self.rough:  # at rest even white noise is none
                found[name] = np.where(np.any(self.noise, axis=(-2, -1)), np.inf, found[name])
        return found

    def transition(self, time: float) -> FloatArray:
        """exp(drift * time), shape (..., n, n); ``time`` in units of 1/w1."""
        from scipy.linalg import expm

        return np.asarray(expm(self.drift * time))

    def step_covariance(self, time: float) -> FloatArray:
        """Mean over the stationary law of the covariance of x after ``time``, given where it began; shape (..., n, n)."""
        covariance, transition = self.covariance(), self.transition(time)
        return covariance - transition @ covariance @ _transposed(transition)

    def autocovariance(self, name: str, time: npt.ArrayLike) -> FloatArray:
        """E s(0) s(t) of the signal ``name`` at the lags ``time`` >= 0, in units of 1/w1, shape (..., times)."""
        self._smooth(name)
        row, memory = self.signals[name], self.covariance() @ self.signals[name][..., None]
        lags = np.atleast_1d(np.asarray(time, float))
        return np.stack([(row[..., None, :] @ self.transition(lag) @ memory)[..., 0, 0] for lag in lags.tolist()], axis=-1)

    def spectrum(self, name: str, frequency: npt.ArrayLike) -> FloatArray:
        """Two-sided spectral density of the signal ``name`` at angular frequencies over w1, shape (..., frequencies).

        Its integral over all frequencies, divided by 2 pi, is the mean square.

        Raises:
            ParameterError: a rough signal, or a road without noise, whose spectrum is a set of lines.
        """
        self._smooth(name)
        if not self.noise.any():
            raise ParameterError(f"the spectrum of {name} is a set of lines: the road has no noise")
        identity = np.eye(len(self.states))
        found = []
        for w in np.atleast_1d(np.asarray(frequency, float)).tolist():
            gain = self.signals[name][..., None, :] @ np.linalg.inv(1j * w * identity - self.drift) @ self.noise
            found.append(np.sum(np.abs(gain) ** 2, axis=(-2, -1)))
        return np.stack(found, axis=-1)

    def _smooth(self, name: str) -> None:
        if name not in self.signals:
            raise ParameterError(f"unknown signal {name!r}; known: {', '.join(self.signals)}")
        if name in self.rough:
            raise ParameterError(f"the signal {name!r} contains white noise on this road: its mean square is infinite")

    def cost_form(self, weights: Mapping[str, float]) -> FloatArray:
        """The weighted squares as a quadratic form of x, shape (..., n, n).

        Raises:
            ParameterError: a weight on a rough signal, or an unknown one.
        """
        total = np.zeros(self.drift.shape)
        for name, weight in weights.items():
            if weight:
                self._smooth(name)
                total += weight * self.signals[name][..., :, None] * self.signals[name][..., None, :]
        return total

    def form_rate(self, form: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(quadratic form, constant) that d/dt E x' form x is, a quadratic form of x itself; shapes (..., n, n) and (...).

        Raises:
            ParameterError: a road whose law is not of the form above.
        """
        if self.flatness is None:
            raise ParameterError("the conditional moments of this road are not known in closed form")
        gain = np.einsum("...ij,...ij->...", self._intensity, form)
        moved = form @ self.drift + _transposed(self.drift) @ form
        return moved - (self.flatness * gain)[..., None, None] * self._excess, (1 + self.flatness) * gain

    @functools.cached_property
    def _intensity(self) -> FloatArray:
        """noise noise', the intensity of the linear twin's noise."""
        return self.noise @ _transposed(self.noise)

    @functools.cached_property
    def _excess(self) -> FloatArray:
        """r' P^-1 r/n as a form of x."""
        form, cars = np.zeros(self.drift.shape[-2:]), self.car_states
        form[cars:, cars:] = np.linalg.inv(self.road_covariance) / len(self.road_covariance)
        return form

    def form_generator(self) -> FloatArray:
        """`form_rate` as a matrix on (the n^2 entries of the form row by row, a constant), shape (..., n^2 + 1, n^2 + 1)."""
        size = len(self.states)
        basis = np.eye(size * size).reshape(size * size, *[1] * (self.drift.ndim - 2), size, size)
        forms, constants = self.form_rate(basis)
        matrix = np.zeros((*self.drift.shape[:-2], size * size + 1, size * size + 1))
        matrix[..., :-1, :-1] = np.moveaxis(forms.reshape(*forms.shape[:-2], size * size), 0, -1)
        matrix[..., -1, :-1] = np.moveaxis(constants, 0, -1)
        return matrix


def lyapunov(drift: FloatArray, intensity: FloatArray) -> FloatArray:
    """Stationary covariance P of dx = drift x dt + noise of this intensity: drift P + P drift' + intensity = 0; stacks too."""
    return _sylvester(drift, drift, -intensity)


def _joint_covariance(drift: FloatArray, noise: FloatArray, driver: FloatArray) -> FloatArray:
    """Stationary covariance of states that are driven, and of those that drive them, whose own is known and which come last.

    That of both solves Sylvester's equation, and that of the driven Lyapunov's.
    """
    count, size = drift.shape[-1] - driver.shape[-1], drift.shape[-1]
    driven, cross, own = drift[..., :count, :count], drift[..., :count, count:], noise[..., :count, :]
    mixed = _sylvester(driven, drift[..., count:, count:], -cross @ driver - own @ _transposed(noise[..., count:, :]))
    forced = cross @ _transposed(mixed)
    result = np.empty((*drift.shape[:-2], size, size))
    result[..., :count, :count] = lyapunov(driven, forced + _transposed(forced) + own @ _transposed(own))
    result[..., :count, count:], result[..., count:, :count] = mixed, _transposed(mixed)
    result[..., count:, count:] = driver
    return result


def _transposed(matrices: FloatArray) -> FloatArray:
    return np.swapaxes(matrices, -1, -2)


def _sylvester(left: FloatArray, right: FloatArray, target: FloatArray) -> FloatArray:
    """X with left X + X right' = target, for stacks of small matrices."""
    rows, columns = left.shape[-1], right.shape[-1]
    whole = np.einsum("...ik,jl->...ijkl", left, np.eye(columns)) + np.einsum("ik,...jl->...ijkl", np.eye(rows), right)
    matrix = whole.reshape(*whole.shape[:-4], rows * columns, rows * columns)
    flat = np.broadcast_to(target, (*whole.shape[:-4], rows, columns)).reshape(*whole.shape[:-4], rows * columns, 1)
    return np.linalg.solve(matrix, flat).reshape(*whole.shape[:-4], rows, columns)
