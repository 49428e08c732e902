"""A certificate of a plant: figures of the simulation beside those that theory expects, with a verdict on each.

Road, at the given speed: the variances E Z^2 and E U^2; the spectral density; the law of the level; its bound. At half and
double speed: the spectral density, and that the law is still the same. Car: the stationary mean squares; those where D
alternates between a soft and a firm level, whose covariance is periodic; and those where the skyhook rule switches D, against
what theory expects of each interval, given the state in which it began (`analysis.sampling.Switching`).

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
import json
import math
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
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
from .checks import FloatArray
from .response import mean_squares, needs_simulation
from .roads import level_bound, marginal_density
from .sampling import Samples, Switching, drive

FALSE_ALARM_RATE = 1e-3  # probability, at most, that a sound plant does not pass
FEWEST_LANES = 1024  # below, means of squares over lanes are too skew for the normal law far out in its tails
ROAD_TOLERANCE = 1e-3  # what rounding and tables may move the figures of a road that is exact in law
CAR_TOLERANCE = 5e-3  # what the car's scheme promises
SOFT = 0.25  # of the damping: the soft level where D switches
LAW_CELLS = 8192
WIDTH = 80  # columns of the table
SHORTER = {  # names of lines in the table
    r"^spectral density at ": "PSD, ",
    r", Kolmogorov-Smirnov distance$": " (KS distance)",
    r"^law at double against half speed": "law, 2 v against v/2",
    r"^mean square of the (.*) \(": r"\1, constant (",
    r" with (?:D )?(alternating|skyhook) \(": r", \1 (",
}
FREQUENCIES = (0.5, 1.0, 2.0)  # of the spectral density, over the angular rate of the road, wavenumber * speed


@dataclasses.dataclass(frozen=True, kw_only=True)
class Line:
    """One figure of a certificate.

    Attributes:
        name: what it is, with its unit.
        measured: the figure of the simulation.
        expected: that of theory; of a Kolmogorov-Smirnov distance, its mean on a sound plant; of a bound, the bound.
        standard_error: of measured less expected, from independent lanes; None for a bound, which is exact. On an ellipse the
            expected figure has an error too, that of the road's variance.
        tolerance: relative bias that a sound plant may have.
        distance: measured less expected, in standard errors; None for a bound.
        p_value: probability of at least this distance, in either direction, on a plant whose bias is the tolerance (of a
            Kolmogorov-Smirnov distance: on a sound plant); None for a bound.
        passed: the verdict.
    """

    name: str
    measured: float
    expected: float
    standard_error: float | None = None
    tolerance: float = 0.0
    distance: float | None = None
    p_value: float | None = None
    passed: bool

    def figures(self) -> dict[str, Any]:
        """The line by name for JSON, None in place of what is not finite."""
        return {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in dataclasses.asdict(self).items()
        }


def table_of(lines: Sequence[Line]) -> list[str]:
    """A table of lines with its head, as lines of `WIDTH` columns."""
    rows = [("", "measured", "expected", "error", "p", ""), *(_cells(line) for line in lines)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    room = min(widths[0], WIDTH - sum(2 + width for width in widths[1:]))
    text = []
    for name, *cells in rows:
        *above, last = textwrap.wrap(name, room, subsequent_indent="  ") or [""]
        padded = (cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True))
        text += [*above, "  ".join([last.ljust(room), *padded]).rstrip()]
    return text


@dataclasses.dataclass(frozen=True, kw_only=True)
class Certificate:
    """All lines of one plant.

    Attributes:
        plant: road and speed noise, in words.
        drive: how the plant was driven, in words.
        significance: p-value below which a line fails.
        lines: the figures.
        left_out: what has no closed form on this plant, and why.
    """

    plant: str
    drive: str
    significance: float
    lines: tuple[Line, ...]
    left_out: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Does every line pass?"""
        return all(line.passed for line in self.lines)

    def table(self) -> str:
        """The certificate as text of `WIDTH` columns, with shorter names of the lines."""
        text = [*wrapped(self.plant), *wrapped(self.drive), "", *table_of(self.lines)]
        failed = sum(not line.passed for line in self.lines)
        text += [
            "",
            f"{len(self.lines)} lines, {failed or 'none'} failed: the plant is {'NOT ' if failed else ''}certified",
            *wrapped(
                "error: standard error of measured less expected, from independent lanes. p: p-value, which allows for a bias "
                f"of {100 * ROAD_TOLERANCE:g} % of the road and {100 * CAR_TOLERANCE:g} % of the car. A line fails where it is "
                f"below {self.significance:.2g}; a sound plant fails any with a probability of at most {FALSE_ALARM_RATE:g}. "
                "PSD: power spectral density. KS: Kolmogorov-Smirnov. Mean squares are those of constant D, of D alternating "
                "between two levels, and of the skyhook rule."
            ),
        ]
        return "\n".join([*text, *(line for reason in self.left_out for line in wrapped(f"Left out: {reason}."))])

    def to_json(self) -> str:
        """The certificate as JSON; null for figures that a line does not have, or that are not finite."""
        data = dataclasses.asdict(self) | {"passed": self.passed, "lines": [line.figures() for line in self.lines]}
        return json.dumps(data, indent=2)


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
    whole("seed", seed, low=0, of="seed")
    if whole("lanes", lanes, of="lanes") < FEWEST_LANES:
        raise ParameterError(f"lanes must be at least {FEWEST_LANES} to have a standard error, got {lanes}")

    try:
        lines, left_out = _compared(road, speed_noise, speed, damping, the_car, seed, lanes, report)
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
                lines.append(_moment(f"{name} (m^2)", found, figure, tolerance=CAR_TOLERANCE, uncertainty=uncertainty))
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
        report=report,
    )

    return lines, left_out


def level_distribution(road: Road, level: npt.ArrayLike) -> FloatArray:
    """Probability that Z is below ``level``, m: the integral of `analysis.marginal_density`, to 1e-4 or better.

    Raises:
        ParameterError: a road whose density is not known.
    """
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
    report: Callable[[str, int, int], None] | None,
) -> list[Line]:
    """Mean squares of the car where D switches."""
    what = "mean squares of the car where D switches"
    if speed_noise is not None:
        left_out.append(f"{what} ({no_closed_form(road, speed_noise)})")
        return []
    if road.shaping_filter() is None:
        left_out.append(f"{what} ({no_closed_form(road, None)})")
        return []
    switching = Switching(road, damping=damping, speed=speed, car=car, lanes=lanes, seed=seed)
    lines = []
    ways = {"D alternating": switching.alternate, "skyhook": switching.skyhook}
    if not switching.knows_state:
        why = (
            "of which the plant shows a part, or whose conditional moments are not known, or which has no velocity for skyhook"
        )
        left_out.append(f"{what} by the state ({why})")
        del ways["skyhook"]
    for way, drive_way in ways.items():
        measured, expected = drive_way(None if report is None else _at(report, f"with {way}"))
        for term, found, figures in zip(switching.names, measured, expected, strict=True):
            figure = float(np.mean(figures))
            name = f"{term.replace('_', ' ')} with {way} (m^2)"
            # lane by lane, what theory expects takes most of the noise out
            lines.append(_moment(name, found - figures + figure, figure, tolerance=CAR_TOLERANCE, uncertainty=uncertainty))
    return lines


def _moment(
    name: str, figures: FloatArray, expected: float, *, tolerance: float = ROAD_TOLERANCE, uncertainty: float = 0.0
) -> Line:
    """The mean of independent figures, shape (lanes,), against what is expected, which is positive.

    ``uncertainty`` is the relative standard error of what is expected.
    """
    from scipy.stats import norm

    measured = float(figures.mean())
    # on the harmonic road a figure may be the same in every lane, but for rounding
    least = max(uncertainty, float(np.finfo(np.float64).eps)) * expected
    error = math.hypot(float(figures.std(ddof=1)) / math.sqrt(figures.size), least)
    difference, allowed = measured - expected, tolerance * expected
    return Line(
        name=name,
        measured=measured,
        expected=expected,
        standard_error=error,
        tolerance=tolerance,
        distance=difference / error,
        p_value=float(norm.sf((abs(difference) - allowed) / error) + norm.sf((abs(difference) + allowed) / error)),
        passed=False,
    )


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


def _words(component: Road | SpeedNoise | Car) -> str:
    """Kind and parameters."""
    parameters = [
        f"{name} {value:g}" if isinstance(value, (int, float)) else f"{name} {value}"
        for name, value in dataclasses.asdict(component).items()
        if name != "kind" and value is not None
    ]
    return f"{component.kind} ({', '.join(parameters)})"


def _at(report: Callable[[str, int, int], None], what: str) -> Callable[[int, int], None]:
    return lambda done, total: report(what, done, total)


def wrapped(text: str) -> list[str]:
    """The text in lines of `WIDTH` columns."""
    return textwrap.wrap(text, WIDTH, subsequent_indent="  ", break_on_hyphens=False)


def _cells(line: Line) -> tuple[str, ...]:
    """A row of the table."""
    name, errors = line.name, ("exact", "")
    for pattern, shorter in SHORTER.items():
        name = re.sub(pattern, shorter, name)
    if line.standard_error is not None and line.p_value is not None:
        errors = (f"{line.standard_error:.2g}", f"{line.p_value:.2g}")
    return name, f"{line.measured:.5g}", f"{line.expected:.5g}", *errors, "pass" if line.passed else "FAIL"
