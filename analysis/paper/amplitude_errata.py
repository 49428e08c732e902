"""Errata of Wedig (2020) in the amplitudes under noise on the speed, and in their stability: (20)-(45)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from roadgym.roads import HarmonicRoad
from roadgym.speed import HighPassSpeedNoise, SpeedNoise, WhiteSpeedNoise

from ..checks import FloatArray
from .check import CALCULATION, SIMULATION, Check, calculated, mean_rate
from .euler_maruyama import simulate
from .exponents import simulate_stability
from .rotating_frame import ROTATION, SLOPE_FORCING, mean_amplitude, moment_system
from .stability import lyapunov_exponents


def _step_amplitudes(
    state: Sequence[float], noise: WhiteSpeedNoise, damping: float, speed: float, form: str, amplitude: float = 1.0
) -> Callable[[float, float], FloatArray]:
    """A, B, G, H after a step of (20b), (21b), (22), (23)."""
    system = moment_system(noise, damping=damping, speed=speed, form=form)
    before = np.array(state)
    drift = system.matrix @ before + amplitude * system.forcing
    spread = noise.intensity * (ROTATION @ before - 2 * damping * amplitude * SLOPE_FORCING)
    return lambda step, increment: before + step * drift + increment * spread


def _step_car(
    displacement: float, velocity: float, phase: float, noise: WhiteSpeedNoise, damping: float, speed: float
) -> Callable[[float, float], tuple[float, float]]:
    """Y and X after a step of (18), (19), with X = Q + 2 D Z so that no derivative of the road enters."""
    level = math.cos(phase)
    other = velocity - 2 * damping * level

    def after(step: float, increment: float) -> tuple[float, float]:
        new_level = math.cos(phase + speed * step + noise.intensity * increment)
        new_other = other - step * (2 * damping * velocity + displacement - level)
        return displacement + step * velocity, new_other + 2 * damping * new_level

    return after


def _amplitude_check(name: str, kind: str, equation: str, words: str, speed_noise: SpeedNoise) -> Check:
    """|E C| at nu = 1 and D = 0.1, by both formulas and from the original equations."""
    printed, right = (
        float(abs(mean_amplitude(speed_noise, damping=0.1, speed=1.0, form=form))) for form in ("printed", "exact")
    )
    found = simulate(
        HarmonicRoad(),
        speed_noise,
        damping=0.1,
        speed=[1.0],
        samples=20_000_000,
        time_step=5e-3,
        lanes=1024,
        bias=True,
    )
    simulated = found[0].amplitude.without_bias
    assert simulated is not None
    return Check(
        name=name,
        kind=kind,
        equation=equation,
        quantity=f"|E C| (no noise: 5.099), D = 0.1, nu = 1, {words}",
        printed=printed,
        right=right,
        evidence=SIMULATION,
        found=simulated,
    )


def product_rule(name: str) -> Check:
    """Covariations that (20b), (21b) leave out: the printed amplitudes contradict Y' = w1 X, by which they are defined."""
    noise, damping, speed = WhiteSpeedNoise(intensity=0.5), 0.1, 1.0

    def rate(form: str) -> float:
        amplitudes = _step_amplitudes((1.0, 0.0, 0.5, 0.0), noise, damping, speed, form)

        def displacement(step: float, increment: float) -> float:
            a, b, _, _ = amplitudes(step, increment)
            phase = speed * step + noise.intensity * increment
            return float(a * math.cos(phase) + b * math.sin(phase))

        return mean_rate(displacement)

    car = _step_car(1.0, 0.5, 0.0, noise, damping, speed)
    return Check(
        name=name,
        kind="slip",
        equation="(20b), (21b)",
        quantity="rate of A cos phi + B sin phi at Y = 1, X = 0.5, sigma = 0.5",
        printed=rate("printed"),
        right=rate("closure"),
        evidence=CALCULATION,
        found=calculated(mean_rate(lambda *step: car(*step)[0])),
    )


def forcing(name: str) -> Check:
    """The forcing of G alone: at A = B = G = H = 0 nothing else of (22) enters."""
    noise, damping, speed = WhiteSpeedNoise(intensity=1.0), 0.5, 1.0

    def rate(form: str) -> float:
        amplitudes = _step_amplitudes((0.0, 0.0, 0.0, 0.0), noise, damping, speed, form)

        def velocity(step: float, increment: float) -> float:
            _, _, g, h = amplitudes(step, increment)
            phase = speed * step + noise.intensity * increment
            return float(g * math.cos(phase) + h * math.sin(phase))

        return mean_rate(velocity)

    car = _step_car(0.0, 0.0, 0.0, noise, damping, speed)
    return Check(
        name=name,
        kind="consequence",
        equation="(22)",
        quantity="mean rate of X at Y = X = 0, Z = 1, D = 0.5, sigma = 1",
        printed=rate("printed"),
        right=rate("closure"),
        evidence=CALCULATION,
        found=calculated(mean_rate(lambda *step: car(*step)[1])),
    )


def white_noise(name: str) -> Check:
    """The mean of (24), where the printed one is stable as well."""
    return _amplitude_check(name, "consequence", "(24)", "sigma = 0.3", WhiteSpeedNoise(intensity=0.3))


def resonance_induction(name: str) -> Check:
    """The first growth of Fig. 8: |E C| never exceeds the resonance without noise."""
    return _amplitude_check(name, "consequence", "Fig. 8", "sigma = 0.2", WhiteSpeedNoise(intensity=0.2))


def high_pass(name: str) -> Check:
    """The resonance induction of Fig. 10, at the noise at which the printed equations show it."""
    noise = HighPassSpeedNoise(intensity=0.2, corner_frequency=0.1)
    return _amplitude_check(name, "consequence", "Fig. 10", "sigma = 0.2, w_g = 0.1", noise)


def high_pass_increment(name: str) -> Check:
    """(34) is (27) once more: it lacks the covariation of Psi and V, and has w_g B Psi^2 V with the sign of low-pass noise."""
    corner, square, psi = 1.0, 0.5, 1.0
    noise, damping = WhiteSpeedNoise(intensity=math.sqrt(square)), 0.1
    system = moment_system(noise, damping=damping, speed=0.0)  # A and x of (33)
    before = np.array([0.0, 1.0, 0.0, 0.0])
    drift = system.matrix @ before + system.forcing + corner * psi * (2 * damping * SLOPE_FORCING - ROTATION @ before)
    spread = noise.intensity * (ROTATION @ before - 2 * damping * SLOPE_FORCING)

    def product(step: float, increment: float) -> float:
        filtered = psi - corner * psi * step + noise.intensity * increment
        return float(filtered * (before + step * drift + increment * spread)[0])

    return Check(
        name=name,
        kind="slip",
        equation="(34)",
        quantity="mean rate of Psi A at Psi = B = 1, A = G = 0, w_g = 1, sigma^2 = 0.5",
        printed=-corner * psi**2,
        right=corner * psi**2 - square,
        evidence=CALCULATION,
        found=calculated(mean_rate(product)),
    )


def top_exponent(name: str) -> Check:
    """Without road, mu = 0, (19) holds no sigma: no exponent of its solutions can."""
    damping = 0.1
    return Check(
        name=name,
        kind="consequence",
        equation="(37), (41), (42)",
        quantity="top Lyapunov exponent, D = 0.1, sigma = 0.5",
        printed=float(lyapunov_exponents(damping, intensity=0.5, form="printed")[0]),
        right=float(lyapunov_exponents(damping, intensity=0.5)[0]),
        evidence=CALCULATION,
        found=calculated(float(np.linalg.eigvals([[0.0, 1.0], [-1.0, -2 * damping]]).real.max())),
    )


def stability_map(name: str) -> Check:
    """The same of the amplitudes along paths, beyond critical damping and the printed bound 0.382 of sigma^2."""
    intensity = math.sqrt(0.5)
    return Check(
        name=name,
        kind="consequence",
        equation="(43), Fig. 14",
        quantity="top Lyapunov exponent, D = 1.5, sigma^2 = 0.5",
        printed=float(lyapunov_exponents(1.5, intensity=intensity, form="printed")[0]),
        right=float(lyapunov_exponents(1.5, intensity=intensity)[0]),
        evidence=SIMULATION,
        found=simulate_stability(1.5, intensity=intensity).top,
    )


def mean_exponent(name: str) -> Check:
    """Means decay faster than paths, because phases spread."""
    return Check(
        name=name,
        kind="consequence",
        equation="(44), (45)",
        quantity="top exponent in mean, D = 0.1, sigma = 0.5",
        printed=float(lyapunov_exponents(0.1, intensity=0.5, sense="mean", form="printed")[0]),
        right=float(lyapunov_exponents(0.1, intensity=0.5, sense="mean")[0]),
        evidence=SIMULATION,
        found=simulate_stability(0.1, intensity=0.5, samples=20_000_000).mean,
    )


def diagonal_term(name: str) -> Check:
    """The term (sigma^2/2 - 2 D w1) sigma^2/2 changes sign at 4 D w1, and the printed (24) its stability at 2 D w1."""
    damping = 0.1

    def growth(square: float) -> float:
        noise = WhiteSpeedNoise(intensity=math.sqrt(square))
        return float(np.linalg.eigvals(moment_system(noise, damping=damping, speed=1.0, form="printed").matrix).real.max())

    return Check(
        name=name,
        kind="wording",
        equation="text below (24)",
        quantity="sigma^2 that makes (24) as printed unstable, D = 0.1",
        printed=4 * damping,
        right=2 * damping,
        evidence=CALCULATION,
        found=calculated(float(brentq(growth, 0.01, 1.0, xtol=1e-12))),
    )


def limit_cycles(name: str) -> Check:
    """Growth of a small difference between two orbits of (38), (39) in twenty turns: a limit cycle would make it vanish."""
    damping = 0.5

    def angles(_: float, state: FloatArray) -> list[float]:
        psi, delta = state
        return [
            -(damping * math.sin(2 * psi) + math.cos(delta)),
            math.sin(delta) * (1 / math.tan(psi) - math.tan(psi)),
        ]

    turns = 20 * math.pi / math.sqrt(1 - damping**2)
    starts = [(math.pi / 4 + start, math.acos(-damping)) for start in (0.2, 0.21)]
    ends = [solve_ivp(angles, (0.0, turns), start, method="DOP853", rtol=1e-11, atol=1e-11).y[:, -1] for start in starts]
    return Check(
        name=name,
        kind="wording",
        equation="Fig. 11",
        quantity="distance of two orbits after 20 turns over before, D = 0.5",
        printed=0.0,
        right=1.0,
        evidence=CALCULATION,
        found=calculated(float(np.linalg.norm(ends[1] - ends[0])) / 0.01),
    )


def sum_angle(name: str) -> Check:
    """Sum of the angles of (A, B) and (G, H), from (20b)-(23), where their difference and so every other term is 0."""
    speed = 0.4
    amplitudes = _step_amplitudes((1.0, 0.0, 1.0, 0.0), WhiteSpeedNoise(intensity=0.5), 0.1, speed, "printed", amplitude=0.0)

    def angle(step: float, increment: float) -> float:
        a, b, g, h = amplitudes(step, increment)
        return math.atan2(b, a) + math.atan2(h, g)

    return Check(
        name=name,
        kind="scan",
        equation="(40)",
        quantity="mean rate of Gamma + Theta where they are equal, nu = 0.4",
        printed=2.0,
        right=2 * speed,
        evidence=CALCULATION,
        found=calculated(mean_rate(angle)),
    )


def forcing_sign(name: str) -> Check:
    """A car that stands, v = sigma = 0, has Y = Z, so A = mu: the forcing of G is positive, as in (26)."""
    system = moment_system(None, damping=0.1, speed=0.0, form="printed")
    standing = np.linalg.solve([[0.0, 1.0], [-1.0, -0.2]], [0.0, -1.0])  # Y and X of (19) at rest on Z = 1
    scanned = dataclasses.replace(system, forcing=system.forcing * np.array([1.0, 1.0, -1.0, 1.0]))
    return Check(
        name=name,
        kind="scan",
        equation="(22), (24)",
        quantity="E A at v = 0 without noise",
        printed=float(scanned.stationary()[0]),
        right=float(system.stationary()[0]),
        evidence=CALCULATION,
        found=calculated(float(standing[0])),
    )


def road_rate(name: str) -> Check:
    """The slope's part of (32) without the 2 D that it has in (26)."""
    damping, speed = 0.1, 1.0
    car = _step_car(0.0, 0.0, math.pi / 2, WhiteSpeedNoise(intensity=0.5), damping, speed)
    return Check(
        name=name,
        kind="scan",
        equation="(32)",
        quantity="mean rate of X at Y = X = Psi = 0, phi = pi/2, D = 0.1, nu = 1",
        printed=-speed,
        right=-2 * damping * speed,
        evidence=CALCULATION,
        found=calculated(mean_rate(lambda *step: car(*step)[1])),
    )
