"""Polynomials of the state as vectors of coefficients, and the generator of the plant as a matrix on them."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from roadgym.linear import LinearSystem

from ..checks import FloatArray

IntArray = npt.NDArray[np.int64]


def exponents(variables: int, degrees: Iterable[int]) -> IntArray:
    """Exponents of all monomials of these degrees, shape (monomials, variables)."""
    found = [
        np.bincount(np.array(chosen, np.int64), minlength=variables)
        for degree in degrees
        for chosen in itertools.combinations_with_replacement(range(variables), degree)
    ]
    return np.array(found, np.int64).reshape(-1, variables)


def values(powers: IntArray, points: FloatArray) -> FloatArray:
    """The monomials ``powers`` at ``points``, shape (points, monomials)."""
    result = np.ones((len(points), len(powers)))
    for point, power in zip(points.T, powers.T, strict=True):
        result *= (point[:, None] ** np.arange(power.max(initial=0) + 1))[:, power]
    return result


class Space:
    """A set of monomials in a fixed order; a polynomial is the vector of their coefficients.

    Args:
        powers: exponents, shape (any, variables); each is kept once.

    Attributes:
        powers: exponents, shape (size, variables).
        variables, size: how many variables and monomials there are.
    """

    def __init__(self, powers: IntArray) -> None:
        self.variables = powers.shape[1]
        self._digits = (int(powers.max()) + 3) ** np.arange(self.variables)
        self._codes, first = np.unique(powers @ self._digits, return_index=True)
        self.powers, self.size = powers[first], len(first)

    def places(self, powers: IntArray) -> IntArray:
        """Where monomials stand, in the shape of ``powers`` less its last axis; they must be in the space."""
        codes = powers @ self._digits
        found = np.searchsorted(self._codes, codes)
        assert np.array_equal(self._codes[np.minimum(found, self.size - 1)], codes)
        return np.asarray(found)

    def polynomial(self, powers: IntArray, coefficients: FloatArray) -> FloatArray:
        """Sum of ``coefficients``, shape (...), times the monomials ``powers``, shape (..., variables)."""
        return np.bincount(self.places(powers).ravel(), np.ravel(coefficients), self.size).astype(float)

    @functools.cached_property
    def one(self) -> int:
        """Where the constant stands."""
        return int(self.places(np.zeros(self.variables, np.int64)))

    def quadratic(self, form: FloatArray) -> FloatArray:
        """The quadratic form x' form x of the first variables."""
        unit = np.eye(self.variables, dtype=np.int64)[: len(form)]
        return self.polynomial(unit[:, None] + unit[None, :], form)


def generator(system: LinearSystem, scale: FloatArray, space: Space, of: IntArray) -> FloatArray:
    """d/dt E m(x) for each monomial m in ``of``, as polynomials of x, shape (size, monomials); x is the state over ``scale``.

    For a drift A x the generator is the sum of (A x)_i d_i and of Gamma_ij d_ij/2, where Gamma_ij is what the generator makes
    of x_i x_j beyond the drift: a quadratic polynomial on every road that `roadgym.linear.LinearSystem.form_rate` knows.

    Args:
        system: the plant at one operating point, in n states.
        scale: shape (n,).
        space: has the result.
        of: exponents, shape (monomials, variables); variables beyond the n states do not occur in them.
    """
    n = len(system.states)
    unit = np.eye(space.variables, dtype=np.int64)[:n]
    result = np.zeros((space.size, len(of)))

    def add(columns: IntArray, powers: IntArray, coefficients: FloatArray) -> None:
        np.add.at(result, (space.places(powers), columns), coefficients)

    drift = system.drift * scale / scale[:, None]
    for i, k in np.argwhere(drift):
        columns = np.flatnonzero(of[:, i])
        add(columns, of[columns] - unit[i] + unit[k], of[columns, i] * drift[i, k])
    for i, k in itertools.product(range(n), repeat=2):
        form = np.zeros((n, n))
        form[i, k] += 0.5
        form[k, i] += 0.5
        moved, constant = system.form_rate(form)
        spread = (moved - form @ system.drift - system.drift.T @ form) * np.outer(scale, scale)
        factor = of[:, i] * (of[:, k] - (i == k)) / (2 * scale[i] * scale[k])
        columns = np.flatnonzero(factor)
        rest = of[columns] - unit[i] - unit[k]
        if constant:
            add(columns, rest, factor[columns] * constant)
        for a, b in np.argwhere(spread):
            add(columns, rest + unit[a] + unit[b], factor[columns] * spread[a, b])
    return result
