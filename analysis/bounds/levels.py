"""Conditional means over an interval as a function of the damping that is held over it: at levels, and between them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from roadgym.parameters import ParameterError

from ..checks import FloatArray
from ..feedback.grid import variable_of

MOST = 12  # order of the polynomial
LEFT = 5e-7  # that it may leave out of a random polynomial with coefficients -1 and 1
NODES = 48  # even, of D, at which the remainder is looked at
ELLIPSES = 2.0 ** np.arange(1, 8)  # sums of the semi-axes, over half the range of D


class Levels:
    """The conditional mean exp(interval G(D)) over a range of D as a polynomial of t in [0, 1].

    t is affine in exp(-rate D), see `analysis.feedback.grid.variable_of`: the factor by which the relative velocity decays, so
    that to leading order in the interval the conditional mean of a polynomial is one of t.

    Args:
        generator: G as a function of D, of which it is a quadratic polynomial; shape (n, n).
        bounds: range of D.
        interval: in units of 1/w1.

    Attributes:
        means: coefficients of the polynomial in Bernstein's basis, shape (order + 1, n, n).

    Raises:
        ParameterError: the range is too wide for so long an interval.
    """

    def __init__(self, generator: Callable[[float], FloatArray], bounds: tuple[float, float], interval: float) -> None:
        from scipy.linalg import expm
        from scipy.sparse import csr_matrix

        self._middle, self._half, self._interval = sum(bounds) / 2, (bounds[1] - bounds[0]) / 2, interval
        self._centre, self._width, self._decay = variable_of(bounds, interval)
        low, middle, high = (generator(damping) for damping in (bounds[0], self._middle, bounds[1]))
        self._terms = [csr_matrix(each) for each in (middle, (high - low) / 2, (high + low) / 2 - middle)]
        sample = np.random.default_rng(0).choice([-1.0, 1.0], len(middle))
        order = self._order(sample)
        t = (1 - np.cos(np.pi * np.arange(order + 1) / order)) / 2
        means = np.stack([expm(interval * self._generator(place).toarray()) for place in self._places(t)])
        self.means = np.einsum("kj,jab->kab", np.linalg.inv(_bernstein(order, t)), means)

    def remainder(self, start: FloatArray) -> FloatArray:
        """Bound over the range of D of what `means` leaves out of exp(interval G(D)) start, shape (n,)."""
        places = np.cos(np.pi * np.arange(NODES + 1) / NODES)
        inside = -np.expm1(-self._decay * (self._middle + self._half * places))
        t = ((inside - self._centre) / self._width + 1) / 2
        control = self.means @ start
        order = len(control) - 1
        apart = np.stack([self._mean(place, start) for place in places]) - _bernstein(order, t) @ control
        # and the same function beyond its interpolation at the nodes, see Trefethen, theorem 8.2
        most_t = [(1 + (abs(1 - self._centre) + math.exp(self._decay * reach)) / self._width) / 2 for reach in self._reaches()]
        columns = [np.asarray(abs(term).sum(axis=0)).ravel() for term in self._terms]  # the last is that of the cost
        polynomial, rest = float(np.abs(start[:-1]).sum()), abs(float(start[-1]))
        tail = math.inf
        for ellipse, t_size in zip(ELLIPSES, most_t, strict=True):
            axis = (ellipse + 1 / ellipse) / 2
            growth, added = (
                self._interval * sum(axis**power * norm for power, norm in enumerate(norms))
                for norms in ([each[:-1].max() for each in columns], [each[-1] for each in columns])
            )
            whole = math.log(polynomial + rest * added + rest) + growth  # by variation of constants
            left_out = math.log(max(float(np.abs(control).max()), 1e-300)) + order * math.log(2 * t_size)
            tail = min(tail, np.logaddexp(whole, left_out) + math.log(4 / (ellipse - 1)) - NODES * math.log(ellipse))
        return np.asarray(np.abs(_chebyshev(apart)).sum(axis=0) + math.exp(min(tail, 700.0)))

    def _reaches(self) -> list[float]:
        """- Re D at most on each of the ellipses."""
        return [float(self._half * (ellipse + 1 / ellipse) / 2 - self._middle) for ellipse in ELLIPSES]

    def _places(self, t: FloatArray) -> FloatArray:
        """D of t, from -1 to 1."""
        damping = -np.log1p(-(self._centre + self._width * (2 * t - 1))) / self._decay
        return np.asarray((damping - self._middle) / self._half)

    def _generator(self, place: float) -> Any:
        return self._terms[0] + place * self._terms[1] + place**2 * self._terms[2]

    def _mean(self, place: float, start: FloatArray) -> FloatArray:
        from scipy.sparse.linalg import expm_multiply

        return np.asarray(expm_multiply(self._interval * self._generator(place), start))

    def _order(self, sample: FloatArray) -> int:
        """The least that leaves out at most `LEFT` of ``sample``."""
        t = (1 + np.cos(np.pi * np.arange(2 * MOST + 1) / (2 * MOST))) / 2
        coefficients = np.abs(_chebyshev(np.stack([self._mean(place, sample) for place in self._places(t)]))).max(axis=1)
        left = np.cumsum(coefficients[::-1])[::-1]  # from each order on
        enough = np.flatnonzero(left[3 : MOST + 2] <= LEFT)
        if not len(enough):
            raise ParameterError(
                "there is no lower bound by sums of squares: the range of D is too wide for so long a control interval; "
                "held must be false"
            )
        return 2 + int(enough[0])


def _bernstein(order: int, t: FloatArray) -> FloatArray:
    """Bernstein's polynomials at ``t``, shape (points, order + 1)."""
    k = np.arange(order + 1)
    return np.array([math.comb(order, each) for each in k]) * t[:, None] ** k * (1 - t[:, None]) ** (order - k)


def _chebyshev(samples: FloatArray) -> FloatArray:
    """Chebyshev coefficients of what has ``samples`` at cos(pi k/n), along the first axis."""
    from scipy.fft import dct

    result = np.asarray(dct(samples, type=1, axis=0)) / (len(samples) - 1)
    result[[0, -1]] /= 2
    return result
