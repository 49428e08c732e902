"""Conditional moments of a road after an interval, exact, and polynomials of its noise whose conditional mean is zero.

The road dr = nu F r dt + sqrt(nu I(r)) G dB, I = 1 + flatness (1 - r' P^-1 r/n), is that of `roadgym.linear`. Its generator
maps polynomials of a degree to polynomials of no higher degree, so the conditional means of all monomials after an interval are
those monomials before it times one matrix, the exponential of the generator's.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from roadgym.linear import ShapingFilter

from ...checks import FloatArray

Exponents = tuple[int, ...]

ROUNDING = 1e-3  # of a polynomial of the noise: what rounding of its mean could be at most
HEAVY = 2.0  # even moments of the noise over those of Gaussian noise: the largest of a degree that is kept


class RoadMoments:
    """Conditional moments of the states of a road after an interval, up to a degree.

    Args:
        road: the road at one bandwidth; its flatness must be known.
        ratio: frequency ratio nu.
        interval: in units of 1/w1.
        degree: the largest.
    """

    def __init__(self, road: ShapingFilter, ratio: float, interval: float, degree: int) -> None:
        from scipy.linalg import expm

        assert road.flatness is not None
        size = len(road.states)
        every = itertools.product(range(degree + 1), repeat=size)
        self.exponents: list[Exponents] = sorted((found for found in every if sum(found) <= degree), key=sum)
        place = {exponents: k for k, exponents in enumerate(self.exponents)}
        intensity = road.noise @ road.noise.T
        quadratic = -road.flatness / size * np.linalg.inv(road.covariance)
        generator = np.zeros((len(place), len(place)))  # row k: what it makes of monomial k

        def add(row: int, exponents: Exponents, down: Exponents, up: Exponents, factor: float) -> None:
            """Add ``factor`` times the derivative with respect to the states ``down``, times the states ``up``."""
            left = list(exponents)
            for state in down:
                factor *= left[state]
                left[state] -= 1
            if factor:
                for state in up:
                    left[state] += 1
                generator[row, place[tuple(left)]] += factor

        for exponents, row in place.items():
            for i, j in itertools.product(range(size), repeat=2):
                add(row, exponents, (i,), (j,), road.drift[i, j])
                add(row, exponents, (i, j), (), intensity[i, j] / 2 * (1 + road.flatness))
                for k, m in itertools.product(range(size), repeat=2):
                    add(row, exponents, (i, j), (k, m), intensity[i, j] / 2 * quadratic[k, m])
        self._step = expm(generator * ratio * interval)

    def central(self, states: FloatArray) -> tuple[FloatArray, dict[Exponents, FloatArray]]:
        """(mean, central moments by exponents) after the interval, from ``states``, shape (k, n): shapes (k, n) and (k,)."""
        powers = self._powers(states)
        before = np.array([math.prod(map(list.__getitem__, powers, exponents)) for exponents in self.exponents])
        raw = dict(zip(self.exponents, self._step @ before, strict=True))
        size = states.shape[1]
        mean = np.stack([raw[tuple(int(i == k) for k in range(size))] for i in range(size)], axis=1)
        back, found = self._powers(-mean), {}
        for exponents in self.exponents:
            total = np.zeros(len(states))
            for kept in itertools.product(*(range(power + 1) for power in exponents)):
                left = (power - some for power, some in zip(exponents, kept, strict=True))
                ways = math.prod(map(math.comb, exponents, kept))
                total += ways * raw[kept] * math.prod(map(list.__getitem__, back, left))
            found[exponents] = total
        return mean, found

    def _powers(self, states: FloatArray) -> list[list[FloatArray]]:
        """Of each state, its powers from 0 to the degree, shape (k,) each."""
        degree = sum(self.exponents[-1])
        return [list(itertools.accumulate([np.ones(len(row))] + [row] * degree, np.multiply)) for row in states.T]


class NoisePolynomials:
    """Expansion in the noise of a road of two states, the second driven: in polynomials of it whose mean is zero.

    A function f of the road after an interval is, about its mean m, nearly a sum of products of Hermite's polynomials of the
    noise, in standard deviations. Gauss's rule at the points m + offset_q gives the coefficients, sums of f(m + offset_q). So
    f less its conditional mean is nearly the sum of f(m + offset_q) times a ``factor`` each: the polynomials at the road that
    came, less their exact conditional means. The factors have conditional mean zero, whatever f is, and whatever law the
    noise has.

    Central moments of high degree lose their digits to rounding where there is little noise, as near the edge of a bounded
    road. Products of which more than `ROUNDING` could be lost are left out; with little noise they matter little. There the
    noise of the driven state has longer tails too, at which a polynomial of high degree is large and nothing that the function
    is: degrees whose moment is more than `HEAVY` times that of Gaussian noise are left out likewise, by the state before.

    Args:
        moments: of the road, up to the sum of both degrees at least.
        along, across: even degrees for the driven state, and for what of the other does not follow from it.
    """

    def __init__(self, moments: RoadMoments, along: int, across: int) -> None:
        self._moments, self._bases = moments, (hermite(along), hermite(across))

    def __call__(self, before: FloatArray, after: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(mean, offset, factor) of steps from ``before`` to ``after``, shape (k, 2) both.

        Shapes (k, 2), (k, points, 2) and (k, points).
        """
        (along, along_series, along_values), (across, across_series, across_values) = self._bases
        mean, moment = self._moments.central(before)
        slope = np.sqrt(np.maximum(moment[0, 2], 1e-24))
        follows = moment[1, 1] / slope**2
        level = np.sqrt(np.maximum(moment[2, 0] - follows * moment[1, 1], 1e-24))
        xi = (after[:, 1] - mean[:, 1]) / slope
        zeta = (after[:, 0] - mean[:, 0]) / level - follows * slope / level * xi
        size = 2 * np.hypot(*before.T)
        powers, kept = np.empty((2, len(before), len(along), len(across)))
        for i, k in np.ndindex(*powers.shape[1:]):
            terms = [math.comb(k, j) * (-follows) ** j * moment[k - j, i + j] for j in range(k + 1)]
            powers[:, i, k] = xi**i * zeta**k - np.sum(terms, axis=0) / (slope**i * level**k)
            kept[:, i, k] = np.finfo(float).eps * (size / slope) ** i * (size / level) ** k < ROUNDING
        for i in range(2, len(along), 2):  # and the odd degree before
            gaussian = math.prod(range(1, i, 2)) * slope**i
            kept[:, i - 1 : i + 1] *= (moment[0, i] < HEAVY * gaussian)[:, None, None]
        products = kept * np.einsum("nab,ia,kb->nik", powers, along_series, across_series, optimize=True)
        factor = np.einsum("nik,pi,qk->npq", products, along_values, across_values, optimize=True).reshape(len(before), -1)
        first, second = (nodes.ravel() for nodes in np.meshgrid(along, across, indexing="ij"))
        offset = np.stack(
            [(follows * slope)[:, None] * first + level[:, None] * second, slope[:, None] * first + 0 * second], axis=2
        )
        return mean, offset, factor


def hermite(degree: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(nodes, series, values) of Hermite's polynomials of even ``degree`` and lower, orthonormal for Gaussian noise.

    The nodes of Gauss's rule, the middle first, shape (degree + 1,); each polynomial's coefficients of the powers, shape
    (polynomials, powers); what a value at a node adds to the expansion's coefficients, shape (nodes, polynomials).
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(degree + 1)
    order = np.argsort(np.abs(nodes), kind="stable")
    nodes, weights = nodes[order], weights[order] / weights.sum()
    nodes[0] = 0.0
    size = np.sqrt([math.factorial(k) for k in range(degree + 1)])
    series = np.zeros((degree + 1, degree + 1))
    for k, unit in enumerate(np.eye(degree + 1)):
        series[k, : k + 1] = np.polynomial.hermite_e.herme2poly(unit)[: k + 1] / size[k]
    values = weights[:, None] * np.polynomial.hermite_e.hermevander(nodes, degree) / size
    return nodes, series, values
