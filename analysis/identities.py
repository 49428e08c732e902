"""Identities that hold whatever sets the damping: exact tests of a plant under any policy.

Between two settings of D a quadratic form x' M x of the state of car and road changes at the mean rate

    E d/dt x' M x = E [x' B x - 2 (f' M x) F_D] + tr(M N N'),    B = M A + A' M,    F_D = 2 D (relative velocity),

with the matrices A, N and f of the plant without its damper (`roadgym.linear`); the bounded road's noise has the intensity of
its linear twin on average. In the long run nothing changes on average, so for every rule that sets D

- E x' B x = - tr(M N N') where M f = 0: two forms that no damper touches, such as travel, tyre deflection and the momentum
  of both masses, multiplied (white velocity of strength S: E t v_u = -S/2, E t v_s = m_u S/(2 m_s), E r (v_s - v_u) = 0, ...);
- E F_D (relative velocity) = E x' B x + tr(M N N') where M f is half the relative velocity: the mean power of the damper (white
  velocity: k_t S/2).

Means over time, not over the beginnings of intervals, are meant: squares of more signals (`watched`) have them.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from roadgym.cars import Car
from roadgym.linear import INPUTS, LinearSystem, Motion, ShapingFilter, Signal

from .checks import FloatArray

NEGLIGIBLE = 1e-9  # share of the largest


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Identity:
    """What has a known mean under every policy: a sum of mean squares of signals, less that power of the damper.

    On a road whose rate contains white noise it holds at every frequency ratio nu, on others at the one that was asked for.

    Attributes:
        name: of the two forms whose product is stationary, or "power".
        rows: signals by their factors of the car's states and of `roadgym.linear.INPUTS`, shape (k, n + 3).
        signs: factors of their mean squares, a constant and one of nu, shape (2, k).
        power: whether the mean of F_D times the relative velocity is subtracted.
        mean: the known mean over nu, in units of the road's variance and of times in 1/w1.
    """

    name: str
    rows: FloatArray
    signs: FloatArray
    power: bool
    mean: float

    def left(self, squares: FloatArray, power: FloatArray, ratio: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """What is left of measured figures, which is zero on average, and the sum of all terms, in the shape of ``power``.

        Args:
            squares: mean squares of the signals ``rows``, shape (k, ...).
            power: mean of F_D times the relative velocity, shape (...).
            ratio: nu, any shape that broadcasts with it.
        """
        nu = np.asarray(ratio, float)
        factors = self.signs.T.reshape(-1, 2, *[1] * np.ndim(power))
        terms = (factors[:, 0] + nu * factors[:, 1]) * squares
        lost = power if self.power else np.zeros_like(power)
        return terms.sum(axis=0) - lost - nu * self.mean, np.abs(terms).sum(axis=0) + lost + abs(nu * self.mean)


def identities(road: ShapingFilter, car: Motion, ratio: float) -> list[Identity]:
    """The identities of a plant; none where the kernel has no rows for what they are of.

    Args:
        road: the road, at one operating point.
        car: the car, without filters of its signals, which do not act on it.
        ratio: nu = speed * wavenumber/w1.
    """
    system, at_rest = (LinearSystem.of(road, car, damping=0.0, ratio=nu) for nu in (ratio, 0.0))
    cars = len(car.states)
    # the kernel knows the states of the car, the level and, where that is a number, its rate
    seen = np.zeros((cars + 1, len(system.states)))
    seen[:cars, :cars], seen[cars, cars:] = np.eye(cars), road.level
    if not np.any(road.level @ road.noise):
        seen = np.vstack([seen, np.append(np.zeros(cars), ratio * road.level @ road.drift)])
    if np.linalg.matrix_rank(seen) < len(system.states):
        return []
    back: FloatArray = np.linalg.pinv(seen).astype(float)
    damped = LinearSystem.of(road, car, damping=0.3, ratio=ratio)
    scale = np.sqrt(np.diag(damped.covariance()))

    def identity(name: str, form: FloatArray, *, power: bool = False) -> Identity:
        """That of a form M: squares of signals for x' B x, and - tr(M N N')."""
        resting, moving = (
            back.T @ (form @ drift + drift.T @ form) @ back for drift in (at_rest.drift, (system.drift - at_rest.drift) / ratio)
        )
        rows, signs = [], []
        for rate, column in ((resting, 0), (moving, 1)):
            values, vectors = np.linalg.eigh(rate)
            kept = np.abs(values) > NEGLIGIBLE * max(float(np.abs(rate).max()), float(np.abs(form).max()))
            own = np.zeros((int(kept.sum()), cars + len(INPUTS)))
            own[:, : len(rate)] = (vectors * np.sqrt(np.abs(values))).T[kept]
            sign = np.zeros((2, len(own)))
            sign[column] = np.sign(values[kept])
            rows.append(own)
            signs.append(sign)
        mean = -float(np.sum(form * (system.noise @ system.noise.T))) / ratio
        return Identity(name=name, rows=np.concatenate(rows), signs=np.concatenate(signs, axis=1), power=power, mean=mean)

    found = []
    if car.relative not in system.rough:
        found.append(identity("power", _energy(system, car, scale), power=True))
    forms = _untouched(system, car, scale)
    for (one, a), (other, b) in itertools.combinations_with_replacement(forms.items(), 2):
        form = (np.outer(a, b) + np.outer(b, a)) / 2
        name = f"{one}^2" if one == other else f"{one} × {other}"
        found.append(identity(name, form))
    return found


def _untouched(system: LinearSystem, car: Motion, scale: FloatArray) -> dict[str, FloatArray]:
    """Independent forms that the damper's force does not touch, and that do not see how high road and car are as a whole."""
    rise = np.append(car.follows, np.linalg.pinv(system.heights[car.follows > 0][:1])[:, 0])
    force = system.force_entry
    candidates = {name: row for name, row in system.signals.items() if not system.force[name] and name not in system.rough}
    touched = np.flatnonzero(force)
    for i, j in itertools.pairwise(touched.tolist()):
        row = np.zeros(len(force))
        row[i], row[j] = 1 / force[i], -1 / force[j]
        candidates["momentum" if len(touched) == 2 else f"{system.states[i]} and {system.states[j]}"] = row
    found: dict[str, FloatArray] = {}
    for name in sorted(candidates, key=lambda each: float(np.linalg.norm(candidates[each] * scale))):
        row = candidates[name]
        still = abs(row @ force) < NEGLIGIBLE and abs(row @ rise) < NEGLIGIBLE
        basis = np.array([*found.values(), row])
        if still and np.linalg.matrix_rank(basis * scale) == len(basis):
            found[name] = row
    return found


def _energy(system: LinearSystem, car: Motion, scale: FloatArray) -> FloatArray:
    """M with M f half the relative velocity, and least B: the energy, where it is kept but for the damper."""
    size = len(system.states)
    first, second = np.triu_indices(size)
    basis = np.zeros((len(first), size, size))
    basis[range(len(first)), first, second] = basis[range(len(first)), second, first] = 1.0
    moved = basis @ system.drift + np.swapaxes(basis @ system.drift, 1, 2)
    rates = (moved * np.outer(scale, scale)).reshape(len(first), -1).T
    touched = (basis @ system.force_entry).T
    target = system.signals[car.relative] / 2
    particular = np.linalg.lstsq(touched, target, rcond=None)[0]
    _, values, rows = np.linalg.svd(touched)
    free = rows[np.sum(values > NEGLIGIBLE) :].T
    chosen = particular - free @ np.linalg.lstsq(rates @ free, rates @ particular, rcond=None)[0]
    return np.asarray(np.einsum("k,kij->ij", chosen, basis))


def rows_of(found: Sequence[Identity]) -> dict[str, FloatArray]:
    """The signals of identities by a name of their own, for `watched`; in order."""
    return {f"{n}.{k}": row for n, each in enumerate(found) for k, row in enumerate(each.rows)}


def watched(car: Car, signals: Mapping[str, FloatArray]) -> Car:
    """The same car with more signals, by factors of its own states and of `roadgym.linear.INPUTS`, shape (n + 3,) each."""
    own = car.motion
    names = (*own.own.states, *INPUTS)
    more = {
        name: Signal({term: float(factor) for term, factor in zip(names, row, strict=True) if factor}, name)
        for name, row in signals.items()
    }
    motion = dataclasses.replace(own, signals={**own.signals, **more})
    values = {field.name: getattr(car, field.name) for field in dataclasses.fields(car) if field.init}
    namespace = {"motion": property(lambda self: motion)}
    cls = dataclasses.make_dataclass(type(car).__name__, [], bases=(type(car),), namespace=namespace, frozen=True, kw_only=True)
    made: Car = cls(**values)
    return made
