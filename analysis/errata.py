"""Slips of Wedig (2020), each with a number that shows it: as printed, as derived, and as simulated.

`ERRATA.md` beside this file says in words what is wrong and why. What is simulated are the original equations, from which the
paper starts and about which there is no doubt: phase and car (18), (19), (25), (30), and road (7), (8).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from roadgym.compiled import LEVEL, SLOPE
from roadgym.parameters import ParameterError
from roadgym.plant import Plant
from roadgym.roads import GaussianRoad, HarmonicRoad, MultiplicativeRoad, Road
from roadgym.speed import HighPassSpeedNoise, LowPassSpeedNoise, SpeedNoise, WhiteSpeedNoise
from roadgym.task import make_task

from .response import mean_squares
from .rotating_frame import MomentSystem, mean_amplitude, moment_system
from .simulation import Estimate, driven_mean_squares, simulate, simulate_stability
from .stability import lyapunov_exponents, rotation_numbers


@dataclasses.dataclass(frozen=True, kw_only=True)
class Check:
    """A number that the paper has wrong.

    Attributes:
        name: of the slip, as in ERRATA.md.
        equation: where it is, by the paper's numbers.
        quantity: what is measured, with its parameters; natural frequency and amplitude of the road are 1.
        printed: by the paper.
        right: by the derivation.
        simulated: by simulation of the original equations, free of the first-order bias of the time step.
    """

    name: str
    equation: str
    quantity: str
    printed: float
    right: float
    simulated: Estimate


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
    """The checks as text."""
    head = ("erratum", "equation", "quantity", "printed", "right", "simulated", "printed off", "right off")
    rows: list[tuple[str, ...]] = [head]
    for check in checks:
        off = (f"{check.simulated.distance(value):.1f}" for value in (check.printed, check.right))
        found = f"{check.simulated.value:.5g} ± {check.simulated.standard_error:.2g}"
        rows.append((check.name, check.equation, check.quantity, f"{check.printed:.5g}", f"{check.right:.5g}", found, *off))
    widths = [max(len(row[column]) for row in rows) for column in range(len(head))]
    lines = []
    for row in rows:
        words = [cell.ljust(width) for cell, width in zip(row[:3], widths, strict=False)]
        numbers = [cell.rjust(width) for cell, width in zip(row[3:], widths[3:], strict=True)]
        lines.append("  ".join(words + numbers).rstrip())
    return "\n".join([*lines, "", "Off: simulated less formula, in standard errors."])


def _amplitude(speed_noise: SpeedNoise, damping: float) -> Estimate:
    """|E C| from the original equations, nu = 1."""
    found = simulate(
        HarmonicRoad(),
        speed_noise,
        damping=damping,
        speed=[1.0],
        samples=20_000_000,
        time_step=5e-3,
        lanes=1024,
        bias=True,
    )
    result = found[0].amplitude.without_bias
    assert result is not None
    return result


def _amplitude_check(name: str, equation: str, words: str, speed_noise: SpeedNoise) -> Check:
    """|E C| at resonance with D = 0.1."""
    printed, right = (
        float(abs(mean_amplitude(speed_noise, damping=0.1, speed=1.0, form=form))) for form in ("printed", "exact")
    )
    return Check(
        name=name,
        equation=equation,
        quantity=f"|E C|, D = 0.1, nu = 1, {words}",
        printed=printed,
        right=right,
        simulated=_amplitude(speed_noise, 0.1),
    )


def white_noise(name: str) -> Check:
    """Covariations that (20)-(24) leave out, at a noise where the printed system has no stationary mean."""
    return _amplitude_check(name, "(20)-(24)", "sigma = 0.5", WhiteSpeedNoise(intensity=0.5))


def resonance_induction(name: str) -> Check:
    """The same where the printed system is stable: |E C| never exceeds the resonance without noise, 5.099."""
    return _amplitude_check(name, "(24), Fig. 8", "sigma = 0.2", WhiteSpeedNoise(intensity=0.2))


def forcing(name: str) -> Check:
    """The forcing of G alone: Ito's drift with the printed forcing, against both of Ito."""
    noise, damping, speed = WhiteSpeedNoise(intensity=1.0), 0.5, 1.0
    right = moment_system(noise, damping=damping, speed=speed)
    printed = moment_system(noise, damping=damping, speed=speed, form="printed")
    mixed = MomentSystem(matrix=right.matrix, forcing=printed.forcing)
    values = [float(np.hypot(*system.stationary()[:2])) for system in (mixed, right)]
    return Check(
        name=name,
        equation="(22)",
        quantity="|E C|, D = 0.5, nu = 1, sigma = 1",
        printed=values[0],
        right=values[1],
        simulated=_amplitude(noise, damping),
    )


def high_pass(name: str) -> Check:
    """Signs and terms of (33)-(36): high-pass noise reduces the resonance least, it does not induce one."""
    noise = HighPassSpeedNoise(intensity=0.5, corner_frequency=1.0)
    return _amplitude_check(name, "(33)-(36)", "sigma = 0.5, w_g = 1", noise)


def low_pass_closure(name: str) -> Check:
    """Not a slip but an approximation: the Gaussian closure (28b) against the exact mean."""
    noise = LowPassSpeedNoise(intensity=0.5, corner_frequency=0.1)
    return _amplitude_check(name, "(28), (29)", "sigma = 0.5, w_g = 0.1", noise)


def top_exponent(name: str) -> Check:
    """The noise turns the amplitudes; it does not stretch them."""
    return Check(
        name=name,
        equation="(37), (41), (42)",
        quantity="top Lyapunov exponent, D = 0.1, sigma = 0.5",
        printed=float(lyapunov_exponents(0.1, intensity=0.5, form="printed")[0]),
        right=float(lyapunov_exponents(0.1, intensity=0.5)[0]),
        simulated=simulate_stability(0.1, intensity=0.5).top,
    )


def stability_map(name: str) -> Check:
    """The same beyond critical damping, above the printed bound 0.382 of sigma^2: stable all the same."""
    intensity = math.sqrt(0.5)
    return Check(
        name=name,
        equation="(43), Fig. 14",
        quantity="top Lyapunov exponent, D = 1.5, sigma^2 = 0.5",
        printed=float(lyapunov_exponents(1.5, intensity=intensity, form="printed")[0]),
        right=float(lyapunov_exponents(1.5, intensity=intensity)[0]),
        simulated=simulate_stability(1.5, intensity=intensity).top,
    )


def mean_exponent(name: str) -> Check:
    """Means decay faster than paths, because phases spread; as printed those of Figs. 8 and 10 would grow at this noise."""
    return Check(
        name=name,
        equation="(44), (45)",
        quantity="top exponent in mean, D = 0.1, sigma = 0.5",
        printed=float(lyapunov_exponents(0.1, intensity=0.5, sense="mean", form="printed")[0]),
        right=float(lyapunov_exponents(0.1, intensity=0.5, sense="mean")[0]),
        simulated=simulate_stability(0.1, intensity=0.5, samples=20_000_000).mean,
    )


def sum_angle(name: str) -> Check:
    """Mean rate of the sum of the angles, over both modes of the car."""
    found = simulate_stability(0.1, intensity=0.5, speed=0.4, samples=20_000_000)
    upper, lower = rotation_numbers(0.1, speed=0.4)
    return Check(
        name=name,
        equation="(40)",
        quantity="mean rate of Gamma + Theta, D = 0.1, nu = 0.4",
        printed=2.0,
        right=float(upper + lower),
        simulated=Estimate(
            value=found.upper.value + found.lower.value,
            standard_error=math.hypot(found.upper.standard_error, found.lower.standard_error),
        ),
    )


def limit_cycles(name: str) -> Check:
    """Growth of a small difference between two orbits of (38), (39) in twenty turns: a limit cycle would make it vanish."""
    from scipy.integrate import solve_ivp

    damping = 0.5

    def angles(_: float, state: np.ndarray) -> list[float]:
        psi, delta = state
        return [
            -(damping * math.sin(2 * psi) + math.cos(delta)),
            math.sin(delta) * (1 / math.tan(psi) - math.tan(psi)),
        ]

    turns = 20 * math.pi / math.sqrt(1 - damping**2)
    centre = np.array([math.pi / 4, math.acos(-damping)])
    ratios = []
    for tolerance in (1e-8, 1e-11):
        ends = [
            solve_ivp(
                angles, (0.0, turns), [*(centre + np.array([start, 0.0]))], method="DOP853", rtol=tolerance, atol=tolerance
            ).y[:, -1]
            for start in (0.2, 0.21)
        ]
        ratios.append(float(np.linalg.norm(ends[1] - ends[0])) / 0.01)
    return Check(
        name=name,
        equation="(38), (39), Fig. 11",
        quantity="distance of two orbits after 20 turns over before, D = 0.5",
        printed=0.0,
        right=1.0,
        simulated=Estimate(value=ratios[1], standard_error=max(abs(ratios[1] - ratios[0]), 1e-12)),
    )


def _driven(road: Road, *, interval: float, substeps: int, lanes: int) -> Plant:
    """Cars on a road in its stationary law."""
    plant = Plant(make_task(road=road, control_interval=interval, substeps=substeps, precision="float64"), lanes)
    everyone = np.ones(lanes, np.bool_)
    plant.seed(np.random.SeedSequence(0).generate_state(lanes, np.uint64).astype(np.uint64), everyone)
    plant.reset(plant.forced({}), everyone)
    return plant


def _mean(figures: np.ndarray) -> Estimate:
    return Estimate(value=float(figures.mean()), standard_error=float(figures.std(ddof=1)) / math.sqrt(figures.size))


def marginal(name: str) -> Check:
    """At alpha = 1/2 the level is uniform; the law of the sinusoid is the limit alpha -> 0."""
    road = MultiplicativeRoad.from_shape(shape=0.5, bandwidth=0.5)
    plant = _driven(road, interval=0.5, substeps=10, lanes=16384)
    inside = np.zeros(plant.num_envs)
    times = 40
    for _ in range(times):
        plant.step(np.full(plant.num_envs, 0.5, np.float32))
        inside += np.abs(plant.row(LEVEL)) * math.sqrt(road.variance) < road.level_bound / 2
    return Check(
        name=name,
        equation="(11), Fig. 4",
        quantity="probability of |Z| < r0/2, alpha = 1/2",
        printed=1 / 3,
        right=0.5,
        simulated=_mean(inside / times),
    )


def square_increment(name: str) -> Check:
    """Quadratic variation of U^2: its noise is 2 U V sigma v^(1/2) dW, where the paper has V sigma v^(1/2) dW."""
    road, interval = GaussianRoad(), 1e-4
    plant = _driven(road, interval=interval, substeps=1, lanes=65536)
    total, before = np.zeros(plant.num_envs), plant.row(SLOPE)
    times = 20
    for _ in range(times):
        plant.step(np.full(plant.num_envs, 0.5, np.float32))
        after = plant.row(SLOPE)
        total += (after**2 - before**2) ** 2 * (road.variance**2 / interval)
        before = after
    square = road.noise_intensity**2
    return Check(
        name=name,
        equation="before (12)",
        quantity="E (d(U^2))^2/dt, Gaussian road, sigma = 0.2, delta = 0.1",
        printed=square,
        right=4 * square * road.variance,
        simulated=_mean(total / times),
    )


def level_rate(name: str) -> Check:
    """Without its wavenumber, (7) contradicts E Z^2 = E U^2 of (12)."""
    road = GaussianRoad(wavenumber=2.0, bandwidth=0.3)
    found = simulate(road, damping=0.5, speed=[0.5], samples=20_000_000, time_step=5e-3, lanes=1024, bias=True)[0]
    z, u = found.first_square.without_bias, found.second_square.without_bias
    assert z is not None
    assert u is not None
    ratio = z.value / u.value
    # the squares of level and slope rise and fall together, so this is an upper bound
    error = ratio * math.hypot(z.standard_error / z.value, u.standard_error / u.value)
    return Check(
        name=name,
        equation="(7)",
        quantity="E Z^2/E U^2, Omega = 2",
        printed=1 / road.wavenumber,
        right=1.0,
        simulated=Estimate(value=ratio, standard_error=error),
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
        equation="(12)",
        quantity="E Z^2, z0 = 0.5, u0 = 1, delta = 0.1, sigma^2 = 0.2",
        printed=1 / (level_bound**-2 + slope_bound**-2 + 4 * bandwidth / square),
        right=road.variance,
        simulated=Estimate(value=simulated.value, standard_error=error),
    )


def high_speed(name: str) -> Check:
    """At high speed the response depends on the bandwidth: (16) tends to delta (4 D + 1/D)/nu, not to (2 D/nu)^2."""
    road, damping, speed = GaussianRoad(), 0.105, 20.0
    means, errors = driven_mean_squares(road, None, damping, speed, 1.0, 0.01)
    root = math.sqrt(means[0] / road.variance)
    return Check(
        name=name,
        equation="(16), Fig. 5",
        quantity="sigma_y/sigma_z, D = 0.105, delta = 0.1, nu = 20",
        printed=math.sqrt(mean_squares("harmonic", damping=damping, speed=speed).displacement / HarmonicRoad().variance),
        right=math.sqrt(mean_squares(road, damping=damping, speed=speed).displacement / road.variance),
        simulated=Estimate(value=root, standard_error=root * float(errors[0] / means[0]) / 2),
    )


CHECKS: dict[str, Callable[[str], Check]] = {
    check.__name__: check
    for check in (
        level_rate,
        marginal,
        square_increment,
        ellipse,
        high_speed,
        white_noise,
        resonance_induction,
        forcing,
        low_pass_closure,
        high_pass,
        top_exponent,
        stability_map,
        mean_exponent,
        sum_angle,
        limit_cycles,
    )
}
