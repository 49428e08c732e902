"""The car on a sinusoidal road whose phase moves at random: the averages behind mean amplitudes and mean squares.

Time is in units of 1/w1, nu is the mean angular rate of the phase. With e^(i phi) for the road, every stationary mean is an
average

    <F> = integral over tau > 0 of f(tau) R(tau),   R(tau) = E exp(-i (phi(t + tau) - phi(t))),

of the Laplace transform F(s) of some f. With N = 1 + 2 D s + s^2 the mean amplitude is <(1 + 2 D s)/N>. Mean squares follow
from P_m = E|d^m q/dt^m|^2 of the filter q'' + 2 D q' + q = e^(i phi), as `analysis.response` says.

*None, white and high-pass noise.* R is a mixture of exp(-s tau), s = rate + i nu, over rates >= 0: zero; sigma^2/2; w_g times a
Poisson variable of mean kappa = sigma^2/(2 w_g). There the P_m are sums of positive terms.

*Low-pass noise.* R is a like sum, e^kappa (-kappa)^n/n! exp(-(sigma^2/2 + n w_g + i nu) tau), which cancels by e^(2 kappa). The
hierarchy of the moments with the Hermite polynomials of the filtered noise does not. With A the matrix of free decay,
q'' + 2 D q' + q = 0, and v = sigma^2 w_g/2 the variance of the angular rate, it is the continued fraction

    X_n = [A + i nu + n w_g + (n + 1) v X_(n+1)]^(-1),   <F> a polynomial in X_0, X_1, ... for each F,

in which every step adds operators that dissipate, so nothing is lost. Truncated after X_1 it is the Gaussian closure (28), (29)
of Wedig (2020). Functions of A are kept as pairs (x, y) for x + y A, where A^2 = 2 D A - 1, so D = 1 is a point like any other.
R. Kubo, "Stochastic Liouville equations", J. Math. Phys. 4, 1963; H. Risken, "The Fokker-Planck equation", Springer 1996.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from roadgym.parameters import ParameterError
from roadgym.speed import SpeedNoise

from .checks import ComplexArray, FloatArray, check_size

Function: TypeAlias = tuple[ComplexArray, ComplexArray]  # (x, y) for x + y A
MeanSquaresOfFilter: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]  # P_0, P_1, P_2, P_3

MOST_LEVELS = 100_000  # of the continued fraction; far beyond what any car on a road asks for


def mean_transfer(
    speed_noise: SpeedNoise | None, damping: FloatArray, frequency_ratio: FloatArray, natural_frequency: float
) -> ComplexArray:
    """Mean amplitude E C over the road's amplitude, <(1 + 2 D s)/N>; 1.

    Args:
        speed_noise: noise on the phase, or None.
        damping: D > 0, 1.
        frequency_ratio: nu >= 0, 1, of a shape that broadcasts with ``damping``.
        natural_frequency: w1, rad/s.
    """
    if speed_noise is not None and speed_noise.smooth:
        return _low_pass(speed_noise, damping, frequency_ratio, natural_frequency)[0]
    result = 0j
    for rate, weight in zip(*_rates(speed_noise, natural_frequency), strict=True):
        s = rate + 1j * frequency_ratio
        result = result + weight * (1 + 2 * damping * s) / (1 + 2 * damping * s + s * s)
    return np.asarray(result)


def filter_mean_squares(
    speed_noise: SpeedNoise | None, damping: FloatArray, frequency_ratio: FloatArray, natural_frequency: float
) -> MeanSquaresOfFilter:
    """Mean squares P_0, ..., P_3 of q and its derivatives, 1; P_3 is infinite under white and high-pass noise.

    Arguments as in `mean_transfer`.
    """
    if speed_noise is not None and speed_noise.smooth:
        return _low_pass(speed_noise, damping, frequency_ratio, natural_frequency)[1]
    p0 = p1 = p2 = np.zeros(())
    for rate, weight in zip(*_rates(speed_noise, natural_frequency), strict=True):
        terms = decaying_mean_squares(damping, frequency_ratio, rate)
        p0, p1, p2 = p0 + weight * terms[0], p1 + weight * terms[1], p2 + weight * terms[2]
    p3 = frequency_ratio**2 * p2 if speed_noise is None else np.full_like(p2, np.inf)
    return p0, p1, p2, p3


def decaying_mean_squares(
    damping: FloatArray, frequency_ratio: FloatArray | float, rate: FloatArray | float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """P_0, P_1, P_2 for the correlation R = exp(-(rate + i nu) tau); no term is negative."""
    size = rate**2 + frequency_ratio**2
    real = 1 + 2 * damping * rate + (rate - frequency_ratio) * (rate + frequency_ratio)
    denominator = 2 * damping * (real**2 + (2 * frequency_ratio * (damping + rate)) ** 2)
    square = 4 * damping**2
    p0 = 2 * damping + rate * (1 + square + 4 * damping * rate + size)
    p1 = rate + (2 * damping + rate) * size
    p2 = rate * (1 + 4 * damping * rate + (1 + square) * size) + 2 * damping * size**2
    return p0 / denominator, p1 / denominator, p2 / denominator


def slowest_decay(damping: FloatArray) -> FloatArray:
    """Rate at which the car's free motion decays in the end, in units of w1: D, or D - sqrt(D^2 - 1) beyond D = 1."""
    above = np.maximum(damping, 1.0)
    slowest: FloatArray = np.minimum(damping, 1 / (above + np.sqrt((above - 1) * (above + 1))))
    return slowest


def is_known(speed_noise: SpeedNoise) -> bool:
    """Is R a sum of exponentials with positive weights, or that of low-pass noise, which the continued fraction serves?"""
    linear, filtered = speed_noise.phase_spread
    return filtered <= 0 or (speed_noise.smooth and linear == filtered == 1)


def _rates(speed_noise: SpeedNoise | None, natural_frequency: float) -> tuple[FloatArray, FloatArray]:
    """Rates of decay of R in units of w1, and their probabilities."""
    if speed_noise is None:
        return np.zeros(1), np.ones(1)
    if not is_known(speed_noise):
        raise ParameterError(f"speed_noise must be white, low_pass, high_pass or None, got {speed_noise!r}")
    strength = speed_noise.intensity**2 / (2 * natural_frequency)
    linear, filtered = speed_noise.phase_spread
    if filtered == 0:
        return np.array([strength * linear]), np.ones(1)
    corner = speed_noise.rates[0] / natural_frequency
    counts, weights = _poisson_rule(-strength * filtered / corner)
    return strength * linear + corner * counts, weights


def _poisson_rule(mean: float) -> tuple[FloatArray, FloatArray]:
    """Nodes and weights for averages over a Poisson variable, of functions whose poles have a real part below zero."""
    if mean <= 100:
        count = np.arange(math.ceil(mean + 12 * math.sqrt(mean) + 40), dtype=np.float64)
        return count, np.cumprod(np.concatenate([[math.exp(-mean)], mean / count[1:]]))
    # Gaussian quadrature from the Jacobi matrix of the Charlier polynomials (G. H. Golub, J. H. Welsch, Math. Comp. 23, 1969):
    # here the poles are more than ten standard deviations from the mean
    degree = np.arange(32)
    coupling = np.sqrt(mean * degree[1:])
    nodes, vectors = np.linalg.eigh(np.diag(mean + degree) + np.diag(coupling, 1) + np.diag(coupling, -1))
    return nodes, vectors[0] ** 2


def _low_pass(
    speed_noise: SpeedNoise, damping: FloatArray, frequency_ratio: FloatArray, natural_frequency: float
) -> tuple[ComplexArray, MeanSquaresOfFilter]:
    """Mean transfer function and P_0, ..., P_3 under low-pass noise.

    With G the generator of the hierarchy, R(tau) = <0|exp(-G tau)|0>, the average <s^m/N> is minus the factor of A in
    T_m = <0|G^m (A + G)^(-1)|0>. With d_n = X_n ... X_0, T_0 = d_0 and T_1 = i nu d_0 + v d_1. For T_3 the identity
    d_(n-1) = (A + i nu + n w_g) d_n + (n + 1) v d_(n+1) takes out terms in w_g^2 that cancel if the noise is fast. Then
    P_0 = Re <(2 D + s)/N>/2D, P_1 = Re <s/N>/2D and P_2 = -Re <s^3/N>/2D. For P_3 = Re <s^5/N>/2D the product A^2 T_3 stands
    for T_5: they differ by derivatives of R at 0+, which are no part of the mean square.
    """
    if not is_known(speed_noise):
        raise ParameterError(f"speed_noise must be white, low_pass, high_pass or None, got {speed_noise!r}")
    corner = speed_noise.rates[0] / natural_frequency
    variance = speed_noise.intensity**2 / (2 * natural_frequency) * corner
    turn = 1j * frequency_ratio
    twice = 2 * damping

    def times(a: Function, b: Function) -> Function:
        return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0] + twice * a[1] * b[1]

    def times_matrix(a: Function) -> Function:
        return -a[1], a[0] + twice * a[1]

    x = y = np.zeros(np.broadcast(damping, frequency_ratio).shape, dtype=np.complex128)
    fractions: list[Function] = []  # X_0, X_1, X_2, X_3 in the end
    levels = _levels(damping, corner, variance)
    check_size("terms of the series of low_pass speed_noise", "damping and speed", levels * x.size, "series")
    for n in range(levels, -1, -1):
        constant, slope = turn + n * corner + (n + 1) * variance * x, 1 + (n + 1) * variance * y
        determinant = constant * constant + twice * constant * slope + slope * slope
        x, y = (constant + twice * slope) / determinant, -slope / determinant
        fractions = [(x, y), *fractions[:3]]
    d0 = fractions[0]
    d1 = times(fractions[1], d0)
    d2 = times(fractions[2], d1)
    d3 = times(fractions[3], d2)
    first = -(turn * d0[1] + variance * d1[1])  # <s/N>
    matrix_d1 = times_matrix(d1)
    third = tuple(  # T_3
        turn * turn * turn * d0[i]
        - variance * ((corner + 3 * turn) * matrix_d1[i] + (corner * turn + 3 * variance) * d1[i])
        + variance**2 * (4 * corner * d2[i] + 6 * variance * d3[i])
        for i in range(2)
    )
    fifth = times_matrix(times_matrix((third[0], third[1])))
    mean_squares = d0[0].real / twice, first.real / twice, third[1].real / twice, -fifth[1].real / twice
    return twice * first - d0[1], mean_squares


def _levels(damping: FloatArray, corner: float, variance: float) -> int:
    """Where the continued fraction may start from zero: what that leaves out shrinks by more than e^36 on the way to X_0.

    One step shrinks it by about exp(-r/(spread sqrt(n))), r being the slowest rate of decay at level n and spread^2 = variance;
    the sum over n of either part of r, that of the car or n w_g, may do it. The 24 serves noise that is weak or fast.
    """
    slowest = float(np.min(slowest_decay(damping), initial=1.0))
    spread = math.sqrt(variance)
    levels = 24 + math.ceil(1.1 * min((18 * spread / slowest) ** 2, float((54 * spread / corner) ** (2 / 3))))
    if levels > MOST_LEVELS:
        softest = float(np.min(damping, initial=np.inf))
        raise ParameterError(
            f"low_pass speed_noise must be weaker or faster at damping {softest:g}: its series needs {levels} terms"
        )
    return levels
