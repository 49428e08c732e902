"""What Wedig (2020) has wrong, each with a number that shows it: as printed, as derived, and as the evidence has it.

`ERRATA.md` beside this file says in words what is wrong and why. The evidence starts from what is in no doubt, and could have
come out for the print: simulation of the original equations, phase and car (18), (19), (30) and road (7), (8); or a calculation
from the paper's own equations. What one step of a stochastic equation does on average is calculated with both of the increments
+-dt^(1/2) of W, so that no rule of stochastic calculus is taken for granted.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from roadgym.parameters import ParameterError
from roadgym.roads import GaussianRoad, HarmonicRoad, MultiplicativeRoad
from roadgym.speed import HighPassSpeedNoise, SpeedNoise, WhiteSpeedNoise

from .checks import FloatArray
from .response import mean_squares
from .roads import density
from .rotating_frame import ROTATION, SLOPE_FORCING, mean_amplitude, moment_system
from .simulation import Estimate, driven_mean_squares, simulate, simulate_stability
from .stability import lyapunov_exponents

KINDS = {
    "slip": "Slips",
    "consequence": "The slip of (20)-(23) again, and what follows from it",
    "wording": "Statements whose wording is off",
    "scan": "Hard to read in the scan, not counted as slips",
}
SIMULATION, CALCULATION = "simulation", "calculation"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Check:
    """A number on which the print and the derivation disagree.

    Attributes:
        name: of the entry, as in ERRATA.md.
        kind: one of `KINDS`; a "consequence" is no error of its own, and of a "scan" the paper may be innocent.
        equation: where it is, by the paper's numbers.
        quantity: what is measured, with its parameters; natural frequency and amplitude of the road are 1.
        printed: by the paper.
        right: by the derivation.
        evidence: "simulation" of the original equations, or "calculation" from the paper's own.
        found: by the evidence. Simulated, it is free of the first-order bias of the time step; calculated, it has no standard
            error, 0.
    """

    name: str
    kind: str
    equation: str
    quantity: str
    printed: float
    right: float
    evidence: str
    found: Estimate

    def agrees(self, value: float) -> bool:
        """Does the evidence allow this value: within four standard errors, or to rounding where it is calculated?"""
        if self.evidence == SIMULATION:
            return abs(self.found.distance(value)) < 4
        return math.isclose(self.found.value, value, rel_tol=1e-5)

    def off(self, value: float) -> str:
        """How far the evidence is from a value, in standard errors; calculated, whether it agrees."""
        if self.evidence == SIMULATION:
            distance = self.found.distance(value)
            return f"{distance:.1f}" if abs(distance) < 1000 else f"{distance:.0f}"
        return "agrees" if self.agrees(value) else "differs"

    def found_text(self) -> str:
        """What the evidence found, with its standard error if it has one."""
        error = f" ± {self.found.standard_error:.2g}" if self.evidence == SIMULATION else ""
        return f"{self.found.value:.5g}{error}"


def run(names: Iterable[str] | None = None, *, report: Callable[[str, int, int], None] | None = None) -> list[Check]:
    """Run the checks of these names; by default all.

    Args:
        names: of `CHECKS`.
        report: called as ``report(what, done, in all)``.

    Raises:
        ParameterError: an unknown name.
    """
    chosen = list(CHECKS if names is None else dict.fromkeys(names))
    for name in chosen:
        if name not in CHECKS:
            raise ParameterError(f"erratum must be one of {', '.join(CHECKS)}, got {name!r}")
    results = []
    for name in chosen:
        results.append(CHECKS[name](name))
        if report:
            report("errata", len(results), len(chosen))
    return results


def table(checks: Sequence[Check]) -> str:
    """The checks as text of at most 80 columns, by their kinds."""
    rows = [("", "printed", "off", "right", "off", "evidence")]
    for check in checks:
        numbers = (f"{check.printed:.5g}", check.off(check.printed), f"{check.right:.5g}", check.off(check.right))
        rows.append((check.name, *numbers, check.found_text()))
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    texts = [
        "  ".join([row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))])
        for row in rows
    ]
    lines = []
    for kind, heading in KINDS.items():
        chosen = [(text, check) for text, check in zip(texts[1:], checks, strict=True) if check.kind == kind]
        if chosen:
            lines += [heading, texts[0]]
            for text, check in chosen:
                lines += [text, f"    {check.equation}: {check.quantity}"]
            lines.append("")
    return "\n".join([*lines, "Off: the evidence less the formula, in standard errors where it is simulated."])


def _calculated(value: float) -> Estimate:
    return Estimate(value=value, standard_error=0.0)


def _mean_rate(after: Callable[[float, float], float]) -> float:
    """Mean rate of change of a quantity ``after(dt, dW)`` a step of its equations.

    The mean over dW = +-dt^(1/2) is right to first order in dt; a step half as long takes the next order off.
    """

    def rate(step: float) -> float:
        root = math.sqrt(step)
        return ((after(step, root) + after(step, -root)) / 2 - after(0.0, 0.0)) / step

    return 2 * rate(5e-5) - rate(1e-4)


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

        return _mean_rate(displacement)

    car = _step_car(1.0, 0.5, 0.0, noise, damping, speed)
    return Check(
        name=name,
        kind="slip",
        equation="(20b), (21b)",
        quantity="rate of A cos phi + B sin phi at Y = 1, X = 0.5, sigma = 0.5",
        printed=rate("printed"),
        right=rate("closure"),
        evidence=CALCULATION,
        found=_calculated(_mean_rate(lambda *step: car(*step)[0])),
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

        return _mean_rate(velocity)

    car = _step_car(0.0, 0.0, 0.0, noise, damping, speed)
    return Check(
        name=name,
        kind="consequence",
        equation="(22)",
        quantity="mean rate of X at Y = X = 0, Z = 1, D = 0.5, sigma = 1",
        printed=rate("printed"),
        right=rate("closure"),
        evidence=CALCULATION,
        found=_calculated(_mean_rate(lambda *step: car(*step)[1])),
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
        found=_calculated(_mean_rate(product)),
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
        found=_calculated(float(np.linalg.eigvals([[0.0, 1.0], [-1.0, -2 * damping]]).real.max())),
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
        found=_calculated(float(np.mean(factors))),
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
        found=_calculated(float(np.mean(density(road, z, edge * np.sin(angle)) * edge * np.cos(angle)) * math.pi)),
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
        found=_calculated((up - down) / (2 * math.sqrt(step))),
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
        found=_calculated(float(found)),
    )


def high_speed(name: str) -> Check:
    """True in the limit, where all ratios are 0; but (16) goes as delta (4 D + 1/D)/nu, and the harmonic as (2 D/nu)^2."""
    road, damping, speed = GaussianRoad(), 0.105, 20.0
    means, errors = driven_mean_squares(road, None, damping, speed, 1.0, 0.01)
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
        found=_calculated(float(brentq(growth, 0.01, 1.0, xtol=1e-12))),
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
        found=_calculated(float(np.linalg.norm(ends[1] - ends[0])) / 0.01),
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
        found=_calculated(_mean_rate(angle)),
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
        found=_calculated(float(standing[0])),
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
        found=_calculated(_mean_rate(lambda *step: car(*step)[1])),
    )


CHECKS: dict[str, Callable[[str], Check]] = {
    check.__name__: check
    for check in (
        level_rate,
        marginal,
        square_increment,
        ellipse,
        product_rule,
        high_pass_increment,
        forcing,
        white_noise,
        resonance_induction,
        high_pass,
        top_exponent,
        stability_map,
        mean_exponent,
        skew_symmetric,
        high_speed,
        diagonal_term,
        limit_cycles,
        sum_angle,
        forcing_sign,
        road_rate,
    )
}
