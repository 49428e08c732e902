"""A certificate of a plant: figures of the simulation beside those that theory expects, with a verdict on each.

Road, at the given speed: the variances E Z^2 and E U^2; the spectral density; the law of the level; its bound. At half and
double speed: the spectral density, and that the law is still the same. Car: the stationary mean squares; those where D
alternates between a soft and a firm level, whose covariance is periodic; and those where the skyhook rule switches D, against
what theory expects of each interval, given the state in which it began (`analysis.sampling.Switching`). Wherever D switches,
the balances of two forms and the power of the damper, which are known whatever the rule (`analysis.identities`); the rule of a
controller, such as a learned one, can be among them.

*Spectral density.* The measured figure is a periodogram under Hann's window, averaged over lanes. The expected one is its exact
mean, the spectrum as the same record shows it, sum over lags k of (window * window)(k) R(k) cos(w k) with the autocovariance R.
So neither leakage nor aliasing is a bias, and one formula serves continuous spectra and the lines of the harmonic road; see
`analysis.autocovariance`.

*Verdicts.* Each line tests the hypothesis that the plant is right, to within the tolerance it promises. The probability that
a sound plant fails any line is at most `FALSE_ALARM_RATE`, shared out equally between the lines (Bonferroni's inequality),
however the lines depend on each other; means over lanes are taken for normal.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from roadgym.cars import Car, QuarterCar, make_car
from roadgym.parameters import ParameterError, PlantError, whole, within
from roadgym.roads import Road, make_road
from roadgym.speed import SpeedNoise, make_speed_noise
from roadgym.task import check_plant

from .autocovariance import autocovariance as autocovariance
from .autocovariance import expected_periodogram, no_closed_form
from .certificate import CAR_TOLERANCE, FALSE_ALARM_RATE, ROAD_TOLERANCE, Certificate, Line, judged
from .checks import FloatArray
from .response import mean_squares, needs_simulation
from .roads import level_bound, marginal_density
from .sampling import Driven, Driver, Samples, Switching, drive

FEWEST_LANES = 1024  # below, means of squares over lanes are too skew for the normal law far out in its tails
SOFT = 0.25  # of the damping: the soft level where D switches
LAW_CELLS = 8192
FREQUENCIES = (0.5, 1.0, 2.0)  # of the spectral density, over the angular rate of the road, wavenumber * speed


def certify(
    road: str | Mapping[str, Any] | Road,
    speed_noise: str | Mapping[str, Any] | SpeedNoise | None = None,
    *,
    speed: float = 1.0,
    damping: float = 0.3,
    natural_frequency: float | None = None,
    car: str | Mapping[str, Any] | Car | None = None,
    seed: int = 0,
    lanes: int = 16384,
    driver: Driver | None = None,
    report: Callable[[str, int, int], None] | None = None,
) -> Certificate:
    """Drive a plant and compare it with theory, line by line; see the module's docstring.

    Args:
        road: a road, or its name or mapping.
        speed_noise: noise on the speed, or its name or mapping, or None.
        speed: v, m/s; the road is driven at v/2 and 2 v as well.
        damping: D, 1.
        natural_frequency: w1 of the car of one mass, rad/s, 1 by default; in place of ``car``.
        car: a car, or its name or mapping; the car of one mass by default.
        seed: fixes the noise.
        lanes: independent cars at each speed; standard errors fall as its root.
        driver: a controller for this plant, whose task tells its control interval, its range of D and what it observes, through
            sensors if it has some; the plant is certified under its rule too. A valve is left out, and so is what varies: what
            theory tells of a rule is of one car, and for a D that keeps its value in each interval.
        report: called as ``report(what, intervals done, intervals in all)`` now and then.

    Returns:
        The certificate; lines that are not defined on the plant are left out.

    Raises:
        ParameterError: a parameter out of range, or too few lanes for a standard error.
    """
    road = make_road(road)
    speed_noise = make_speed_noise(speed_noise, road)
    speed, damping = within("speed", speed, "moving speed"), within("damping", damping)
    the_car = make_car(car, natural_frequency)
    check_plant(road, speed_noise, (speed / 2, 2 * speed), the_car.natural_frequency)
    if driver is not None and (speed_noise is not None or road.shaping_filter() is None):
        plant = f"a {road.kind} road" if speed_noise is None else f"{speed_noise.kind} speed noise"
        raise ParameterError(f"driver must be None on {plant}, where theory does not know what it makes of the plant")
    whole("seed", seed, low=0, of="seed")
    if whole("lanes", lanes, of="lanes") < FEWEST_LANES:
        raise ParameterError(f"lanes must be at least {FEWEST_LANES} to have a standard error, got {lanes}")

    try:
        lines, left_out = _compared(road, speed_noise, speed, damping, the_car, seed, lanes, driver, report)
    except PlantError as error:
        lines, left_out = (
            [Line(name="numbers that are not finite", measured=math.nan, expected=0.0, passed=False)],
            [str(error)],
        )
    significance = FALSE_ALARM_RATE / max(1, sum(line.p_value is not None for line in lines))
    noise = "no speed noise" if speed_noise is None else f"{_words(speed_noise)} speed noise"
    return Certificate(
        plant=f"{_words(road)} road, {noise}" + ("" if car is None else f", {_words(the_car)} car"),
        drive=f"speed {speed:g} m/s, damping {damping:g}, natural frequency {the_car.natural_frequency:g} rad/s; "
        f"{lanes} lanes, seed {seed}",
        significance=significance,
        # a figure that is not a number has no p-value either, and fails
        lines=tuple(
            line if line.p_value is None else dataclasses.replace(line, passed=line.p_value >= significance) for line in lines
        ),
        left_out=tuple(left_out),
    )


def _compared(
    road: Road,
    speed_noise: SpeedNoise | None,
    speed: float,
    damping: float,
    car: Car,
    seed: int,
    lanes: int,
    driver: Driver | None,
    report: Callable[[str, int, int], None] | None,
) -> tuple[list[Line], list[str]]:
    """The lines, without their verdicts, and what is left out."""
    turn = speed * road.wavenumber
    # off its line, the spectrum of a sinusoid is leakage and nothing else
    ratios = (1.0,) if road.lines is not None and speed_noise is None else FREQUENCIES
    seeds = np.random.SeedSequence(seed).generate_state(4, np.uint64)
    speeds = {1.0: ratios, 0.5: (1.0,), 2.0: (1.0,)}
    samples = {
        factor: drive(
            road,
            speed_noise,
            speed=factor * speed,
            damping=damping,
            car=car,
            frequencies=[ratio * factor * turn for ratio in chosen],
            lanes=lanes,
            seed=int(own_seed),
            report=None if report is None else _at(report, f"at {factor * speed:g} m/s"),
        )
        for (factor, chosen), own_seed in zip(speeds.items(), seeds, strict=False)
    }
    own, slow, fast = samples[1.0], samples[0.5], samples[2.0]

    uncertainty = road.variance_standard_error / road.variance
    lines = [_moment("variance of the level (m^2)", own.level_square, road.variance, uncertainty=uncertainty)]
    left_out: list[str] = []
    if road.slope_variance is not None:
        expected = road.slope_variance * road.variance
        lines.append(_moment("variance of the slope (m^2)", own.slope_square, expected, uncertainty=uncertainty))
    elif road.has_slope:
        left_out.append(f"variance of the slope (none is known for a {road.kind} road)")
    try:
        for factor, chosen in speeds.items():
            figures = expected_periodogram(samples[factor], road, speed_noise, factor * speed, chosen)
            for ratio, found, figure in zip(chosen, samples[factor].periodogram, figures.tolist(), strict=True):
                name = f"spectral density at {factor * speed:g} m/s, {ratio * factor * turn:.4g} rad/s (m^2 s)"
                lines.append(_moment(name, found, figure, uncertainty=uncertainty))
    except ParameterError as error:
        left_out.append(f"spectral density ({error})")
    lines += _law_lines(road, own, slow, fast, left_out)
    try:
        if needs_simulation(road, speed_noise, car):
            if speed_noise is not None and not needs_simulation(road, speed_noise, QuarterCar()):
                raise ParameterError(f"with {speed_noise.kind} noise there is a closed form for one mass alone")
            raise ParameterError(no_closed_form(road, speed_noise))
        theory = mean_squares(road, speed_noise, damping=damping, speed=speed, car=car)
        for (term, square), found in zip(theory.items(), own.mean_squares, strict=True):
            name, figure = f"mean square of the {term.replace('_', ' ')}", float(square)
            if math.isfinite(figure):
                name = f"{name} ({_square(car, term)})"
                lines.append(_moment(name, found, figure, tolerance=CAR_TOLERANCE, uncertainty=uncertainty))
            else:
                left_out.append(f"{name} (infinite on this plant)")
    except ParameterError as error:
        left_out.append(f"mean squares of the car ({error})")
    lines += _switching_lines(
        road,
        speed_noise,
        left_out,
        damping=(SOFT * damping, damping),
        speed=speed,
        car=car,
        lanes=lanes,
        seed=int(seeds[3]),
        uncertainty=uncertainty,
        driver=driver,
        report=report,
    )

    return lines, left_out


def level_distribution(road: Road, level: npt.ArrayLike) -> FloatArray:
    """Probability that Z is below ``level``, m: the integral of `analysis.marginal_density`, to 1e-4 or better.

    Raises:
        ParameterError: a road whose density is not known.
    """
    if road.periodic is not None:
        return road.periodic.distribution(np.asarray(level) / math.sqrt(road.variance))
    bound = min(level_bound(road), 12 * math.sqrt(road.variance))
    # with z = bound sin(angle) the densities that are infinite at the bound become smooth; the midpoint rule never meets it
    edges = np.linspace(-math.pi / 2, math.pi / 2, LAW_CELLS + 1)
    middle = (edges[1:] + edges[:-1]) / 2
    mass = marginal_density(road, bound * np.sin(middle)) * bound * np.cos(middle) * (math.pi / LAW_CELLS)
    distribution = np.concatenate([[0.0], np.cumsum(mass)])
    angle = np.arcsin(np.clip(np.asarray(level) / bound, -1, 1))
    return np.asarray(np.interp(angle, edges, distribution))


def _law_lines(road: Road, own: Samples, slow: Samples, fast: Samples, left_out: list[str]) -> list[Line]:
    """The law of the level, its independence of the speed, and its bound."""
    from scipy import stats

    lines = []
    lanes = own.level.size
    try:
        test = stats.kstest(own.level, lambda level: level_distribution(road, level))
        lines.append(_largest_difference("law of the level, Kolmogorov-Smirnov distance", test, lanes))
    except ParameterError as error:
        left_out.append(f"law of the level ({error})")
    test = stats.ks_2samp(slow.level, fast.level, method="asymp")
    lines.append(_largest_difference("law at double against half speed, Kolmogorov-Smirnov distance", test, lanes / 2))
    # ratio of two means, to first order in what either is off; the runs share no noise, so lanes may be paired at will
    mean = slow.level_square.mean()
    ratio = fast.level_square.mean() / mean
    terms = ratio + (fast.level_square - ratio * slow.level_square) / mean
    lines.append(_moment("variance at double over half speed", terms, 1.0))
    road_filter = road.shaping_filter()
    if road_filter is not None and road_filter.flatness:
        largest = own.largest_square / level_bound(road) ** 2
        passed = bool(largest <= 1 + 8 * np.finfo(np.float64).eps)  # the rounding of the ratio itself
        lines.append(Line(name="largest (Z^2 + U^2)/r0^2, at most 1", measured=largest, expected=1.0, passed=passed))
    return lines


def _switching_lines(
    road: Road,
    speed_noise: SpeedNoise | None,
    left_out: list[str],
    *,
    damping: tuple[float, float],
    speed: float,
    car: Car,
    lanes: int,
    seed: int,
    uncertainty: float,
    driver: Driver | None,
    report: Callable[[str, int, int], None] | None,
) -> list[Line]:
    """Mean squares of the car where D switches."""
    what = "mean squares of the car where D switches"
    if speed_noise is not None:
        left_out.append(f"{what} ({no_closed_form(road, speed_noise)})")
        return []
    if road.shaping_filter() is None:
        cause = no_closed_form(road, None) if road.periodic is None else f"none is known on a {road.kind} road"
        left_out.append(f"{what} ({cause})")
        return []
    switching = Switching(road, damping=damping, speed=speed, car=car, lanes=lanes, seed=seed)
    ways: dict[str, Callable[..., Driven]] = {"D alternating": switching.alternate}
    if switching.knows_skyhook and switching.knows_state:
        ways["skyhook"] = switching.skyhook
    else:
        why = (
            "of which the plant shows a part, or whose conditional moments are not known, or which has no velocity for skyhook"
        )
        left_out.append(f"{what} by the state ({why})")
    runs = {way: (switching, run) for way, run in ways.items()}
    if driver is not None:
        task = driver.task
        followed = Switching(
            road,
            damping=task.damping_range,
            speed=speed,
            car=car,
            lanes=lanes,
            seed=seed,
            control_interval=task.control_interval,
            observation=task.signals,
            sensors=task.sensors,
        )
        runs["the controller"] = followed, functools.partial(followed.follow, driver)
    lines = []
    for way, (plant, run) in runs.items():
        driven = run(report=None if report is None else _at(report, f"with {way}"))
        if driven.expected is not None:
            for term, found, figures in zip(plant.names, driven.mean_squares, driven.expected, strict=True):
                figure = float(np.mean(figures))
                name = f"{term.replace('_', ' ')} with {way} ({_square(car, term)})"
                # lane by lane, what theory expects takes most of the noise out
                lines.append(_moment(name, found - figures + figure, figure, tolerance=CAR_TOLERANCE, uncertainty=uncertainty))
        for identity, left, terms in zip(plant.identities, *driven.rates, strict=True):
            if identity.power:
                unit, name = _power_unit(road, car)
                figures = unit * driven.power
                expected = float(np.mean(figures + unit * left))
                lines.append(_moment(f"{name} with {way}", expected - unit * left, expected, uncertainty=uncertainty))
            else:
                name = f"balance of {identity.name.replace('_', ' ')} with {way} (1)"
                lines.append(_moment(name, left / terms.mean(), 0.0, tolerance=ROAD_TOLERANCE, unit=1.0))
    return lines


def _power_unit(road: Road, car: Car) -> tuple[float, str]:
    """The power of the damper where it is 1 in the equations, and how it is told; per kilogram of the body without newtons."""
    w1, newton = car.natural_frequency, car.units.get("N")
    if newton is None:
        return road.variance * w1**3, "power of the damper (W/kg)"
    return road.variance * w1 * newton, "power of the damper (W)"


def _moment(
    name: str,
    figures: FloatArray,
    expected: float,
    *,
    tolerance: float = ROAD_TOLERANCE,
    uncertainty: float = 0.0,
    unit: float | None = None,
) -> Line:
    """The mean of independent figures, shape (lanes,), against what is expected.

    ``uncertainty`` is the relative standard error of what is expected; ``unit`` what errors are relative to, if not to that.
    """
    measured = float(figures.mean())
    # on the harmonic road a figure may be the same in every lane, but for rounding
    unit = expected if unit is None else unit
    least = max(uncertainty, float(np.finfo(np.float64).eps)) * unit
    error = math.hypot(float(figures.std(ddof=1)) / math.sqrt(figures.size), least)
    return judged(name, measured, expected, error, tolerance, unit)


def _largest_difference(name: str, test: Any, lanes: float) -> Line:
    """The result of a Kolmogorov-Smirnov test with this effective number of samples, against its asymptotic law."""
    from scipy.stats import kstwobign

    mean, error = kstwobign.mean() / math.sqrt(lanes), kstwobign.std() / math.sqrt(lanes)
    measured = float(test.statistic)
    return Line(
        name=name,
        measured=measured,
        expected=float(mean),
        standard_error=float(error),
        distance=float((measured - mean) / error),
        p_value=float(test.pvalue),
        passed=False,
    )


def _square(car: Car, name: str) -> str:
    """The unit of a signal's mean square."""
    unit = car.motion.signals[name].unit.replace("²", "^2")
    return f"({unit})^2" if "/" in unit else f"{unit}^2"


def _words(component: Road | SpeedNoise | Car) -> str:
    """Kind and parameters."""
    values = {field.name: getattr(component, field.name) for field in dataclasses.fields(component) if field.repr}
    parameters = [
        f"{name} {value:g}" if isinstance(value, (int, float)) else f"{name} {value}"
        for name, value in values.items()
        if name != "kind" and value is not None
    ]
    return f"{component.kind} ({', '.join(parameters)})"


def _at(report: Callable[[str, int, int], None], what: str) -> Callable[[int, int], None]:
    return lambda done, total: report(what, done, total)
