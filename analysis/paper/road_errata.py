"""Errata of Wedig (2020) in the roads and in the mean squares of the car: (7)-(17)."""

from __future__ import annotations

import math

import numpy as np

from roadgym.cars import QuarterCar
from roadgym.roads import GaussianRoad, HarmonicRoad, MultiplicativeRoad

from ..driven import driven_mean_squares
from ..response import mean_squares
from ..roads import density
from .check import CALCULATION, SIMULATION, Check, calculated
from .euler_maruyama import Estimate, simulate


def level_rate(name: str) -> Check:
    """Without its wavenumber, (7) contradicts (9)-(12): the factor of vU under which (8) keeps the density (11)."""
    wavenumber, bandwidth, bound, shape = 2.0, 0.3, 1.0, 3.0
    square = 2 * bandwidth * wavenumber * bound**2 / shape  # sigma^2 of (11)
    factors = []
    for z, u in ((0.3, 0.4), (-0.5, 0.2), (0.1, -0.7)):
        free = 1 - (z**2 + u**2) / bound**2
        p = free ** (shape - 1)
        p_z, p_u = (-2 * x / bound**2 * (shape - 1) * free ** (shape - 2) for x in (z, u))
        diffused = shape * ((shape - 1) * free ** (shape - 2) * (2 * u / bound**2) ** 2 - 2 / bound**2 * p)  # of V^2 p, in u
        factors.append((wavenumber * (2 * bandwidth * p + (2 * bandwidth * u + z) * p_u) + square / 2 * diffused) / (u * p_z))
    return Check(
        name=name,
        kind="slip",
        equation="(7)",
        quantity="c of dZ = c v U dt under which (11) is stationary, Omega = 2",
        printed=1.0,
        right=wavenumber,
        evidence=CALCULATION,
        found=calculated(float(np.mean(factors))),
    )


def marginal(name: str) -> Check:
    """At alpha = 1/2 the level is uniform; the law of the sinusoid is the limit alpha -> 0. By quadrature of (11)."""
    road = MultiplicativeRoad.from_shape(shape=0.5, level_bound=1.0)
    middles = (np.arange(400) + 0.5) / 400
    z, angle = np.meshgrid(middles / 2, math.pi * (middles - 0.5))  # 0 < z < r0/2, and every u = edge sin(angle)
    edge = np.sqrt(1 - z**2)
    return Check(
        name=name,
        kind="slip",
        equation="text below (11), Fig. 4",
        quantity="probability of |Z| < r0/2, alpha = 1/2",
        printed=1 / 3,
        right=0.5,
        evidence=CALCULATION,
        found=calculated(float(np.mean(density(road, z, edge * np.sin(angle)) * edge * np.cos(angle)) * math.pi)),
    )


def square_increment(name: str) -> Check:
    """The noise of d(U^2) is 2 U V sigma v^(1/2) dW, where the paper has V sigma v^(1/2) dW."""
    road, slope, step = GaussianRoad(), 0.25, 1e-8  # V = 1
    spread = road.noise_intensity * math.sqrt(step)
    drift = -2 * road.bandwidth * slope * step
    up, down = ((slope + drift + sign * spread) ** 2 for sign in (1, -1))
    return Check(
        name=name,
        kind="slip",
        equation="d(U^2), before (12)",
        quantity="factor of dW at U = 0.25, V = 1, sigma v^(1/2) = 0.2",
        printed=road.noise_intensity,
        right=2 * slope * road.noise_intensity,
        evidence=CALCULATION,
        found=calculated((up - down) / (2 * math.sqrt(step))),
    )


def ellipse(name: str) -> Check:
    """Off the circle the path leaves the ellipse and (12) does not hold; right is the variance of the plant's own scheme."""
    bandwidth, level_bound, slope_bound, square = 0.1, 0.5, 1.0, 0.2
    road = MultiplicativeRoad(
        bandwidth=bandwidth, noise_intensity=math.sqrt(square), level_bound=level_bound, slope_bound=slope_bound
    )
    found = simulate(road, damping=0.5, speed=[1.0], samples=20_000_000, time_step=5e-3, lanes=1024, bias=True)[0]
    simulated = found.first_square.without_bias
    assert simulated is not None
    error = math.hypot(simulated.standard_error, road.variance_standard_error)
    return Check(
        name=name,
        kind="slip",
        equation="text below (8), (12)",
        quantity="E Z^2, z0 = 0.5, u0 = 1, delta = 0.1, sigma^2 = 0.2",
        printed=1 / (level_bound**-2 + slope_bound**-2 + 4 * bandwidth / square),
        right=road.variance,
        evidence=SIMULATION,
        found=Estimate(value=simulated.value, standard_error=error),
    )


def skew_symmetric(name: str) -> Check:
    """The matrix of (14) has a diagonal: it is skew-symmetric at D = delta = 0 alone, and singular there at nu = 1."""
    damping, bandwidth, speed = 0.105, 0.1, 1.0
    found = np.trace(
        [
            [0.0, -1.0, -speed, 0.0],
            [1.0, 2 * damping, 0.0, -speed],
            [speed, 0.0, 2 * bandwidth * speed, -1.0],
            [0.0, speed, 1.0, 2 * (damping + bandwidth * speed)],
        ]
    )
    return Check(
        name=name,
        kind="wording",
        equation="text below (14)",
        quantity="trace of the matrix, D = 0.105, delta = 0.1, nu = 1",
        printed=0.0,
        right=4 * (damping + bandwidth * speed),
        evidence=CALCULATION,
        found=calculated(float(found)),
    )


def high_speed(name: str) -> Check:
    """True in the limit, where all ratios are 0; but (16) goes as delta (4 D + 1/D)/nu, and the harmonic as (2 D/nu)^2."""
    road, damping, speed = GaussianRoad(), 0.105, 20.0
    means, errors = driven_mean_squares(road, None, damping, speed, QuarterCar(), 0.01)
    root = math.sqrt(means[0] / road.variance)
    return Check(
        name=name,
        kind="wording",
        equation="text below (17), Fig. 5",
        quantity="sigma_y/sigma_z, D = 0.105, delta = 0.1, nu = 20",
        printed=math.sqrt(mean_squares("harmonic", damping=damping, speed=speed).displacement / HarmonicRoad().variance),
        right=math.sqrt(mean_squares(road, damping=damping, speed=speed).displacement / road.variance),
        evidence=SIMULATION,
        found=Estimate(value=root, standard_error=root * float(errors[0] / means[0]) / 2),
    )
