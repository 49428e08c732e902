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
    """Interpolation in the noise of a road of two states, the second driven: at a few points, by polynomials of mean zero.

    A function f of the road after an interval is, about its mean m, nearly the polynomial through its values at the points
    m + offset_q, so f less its conditional mean nearly the sum of f(m + offset_q) times a ``factor`` each: Lagrange's
    polynomial at the road that came less its exact conditional mean. The factors have conditional mean zero, whatever f is.

    Args:
        moments: of the road, up to the sum of both degrees at least.
        along, across: nodes for the driven state, and for what of the other does not follow from it, in standard deviations.
    """

    def __init__(self, moments: RoadMoments, along: FloatArray, across: FloatArray) -> None:
        self._moments, self._nodes = moments, (along, across)

    def __call__(self, before: FloatArray, after: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(mean, offset, factor) of steps from ``before`` to ``after``, shape (k, 2) both.

        Shapes (k, 2), (k, points, 2) and (k, points).
        """
        mean, moment = self._moments.central(before)
        slope = np.sqrt(np.maximum(moment[0, 2], 1e-24))
        follows = moment[1, 1] / slope**2
        level = np.sqrt(np.maximum(moment[2, 0] - follows * moment[1, 1], 1e-24))
        along, across = self._nodes
        xi = (after[:, 1] - mean[:, 1]) / slope
        zeta = (after[:, 0] - mean[:, 0]) / level - follows * slope / level * xi
        powers = np.empty((len(before), len(along), len(across)))
        for i, k in np.ndindex(*powers.shape[1:]):
            terms = [math.comb(k, j) * (-follows) ** j * moment[k - j, i + j] for j in range(k + 1)]
            powers[:, i, k] = xi**i * zeta**k - np.sum(terms, axis=0) / (slope**i * level**k)
        lagrange = [np.linalg.inv(np.vander(nodes, increasing=True)) for nodes in (along, across)]
        factor = np.einsum("nij,ip,jq->npq", powers, *lagrange).reshape(len(before), -1)
        first, second = (nodes.ravel() for nodes in np.meshgrid(along, across, indexing="ij"))
        offset = np.stack(
            [(follows * slope)[:, None] * first + level[:, None] * second, slope[:, None] * first + 0 * second], axis=2
        )
        return mean, offset, factor
