"""How finely a plant must be stepped, and in which format, for its mean squares to be right."""

from __future__ import annotations

import math
from collections.abc import Sequence

from .cars import Car
from .parameters import check_ratio, whole
from .roads import Road
from .speed import SpeedNoise

LARGEST_ANGLE = 0.1  # largest angle, rad, of the car and of the road in a substep
LARGEST_TURN_VARIANCE = 0.1  # largest variance, rad^2, of the random part of the harmonic road's angle in a substep
LARGEST_DECAY = 0.2  # largest product of damping ratio and angle of the car in a substep
FINER = 0.3  # share of these angles where D moves within a control interval, as the mean squares are of second order then
BROAD = 3.0  # bandwidth beyond which a substep must resolve more than the road's angle
SINGLE_DECAY = 6e-4  # least share of a slow motion that decays in a substep, for single precision to keep 1e-4 of it
SINGLE_SUBSTEP = 0.004  # shortest substep, 1/w1, in which single precision does that with the velocity
SINGLE_HARMONIC_ANGLE = 0.05  # least angle of the harmonic road in a substep for that: slower, the travel is lost in rounding


def fastest_rate(road: Road, speed_noise: SpeedNoise | None, car: Car, speed: float, bandwidth: float = 0.0) -> float:
    """Angular rate, rad/s, whose product with a substep must be at most `LARGEST_ANGLE`.

    The largest of those of the car, of the road at ``speed``, and of the noise on the speed. At constant speed and damping it
    keeps the scheme's bias below 1e-4 of each mean square for bandwidths up to 2. A road of large ``bandwidth`` has a fast
    motion beside its angle: from `BROAD` on, (bandwidth/BROAD)^(2/3) times its rate keeps it below 3e-4 up to a bandwidth of
    10, and below 1.3e-3 up to 100.

    On the harmonic road the variance of the random turn in a substep h, at most sigma^2 h, and less where a filter makes it
    sigma^2 w_g h^2/2 (low-pass) or sigma^2/w_g (high-pass), is kept to `LARGEST_TURN_VARIANCE`, and w_g h to 1. Then for
    sigma <= 10 sqrt(w1) and 0.01 w1 <= w_g <= 100 w1 the mean squares are within 1e-4 under white and high-pass noise, and
    within 1e-3 under low-pass noise.

    On random roads a noise whose standard deviation is more than a quarter of the speed stops the car now and then. The angle
    of a substep is then cut at zero, and the substep must follow the noise: two of its standard deviations and three times its
    corner frequency keep the mean squares within 0.5 %.
    """
    rate = speed * road.wavenumber
    fastest = max(rate * math.pow(max(1.0, bandwidth / BROAD), 2 / 3), car.fastest * car.natural_frequency)
    if speed_noise is None:
        return fastest
    square, corner = float(speed_noise.intensity**2), speed_noise.rates[0]
    deviation = math.sqrt(square * corner / 2)  # of a low-pass noise
    if road.takes_phase_noise:
        turn = square * LARGEST_ANGLE / LARGEST_TURN_VARIANCE
        if speed_noise.smooth:
            turn = min(turn, deviation * LARGEST_ANGLE / math.sqrt(LARGEST_TURN_VARIANCE))
        elif corner > 0 and square / corner <= LARGEST_TURN_VARIANCE:
            turn = 0.0
        return max(fastest, turn, LARGEST_ANGLE * corner)
    if deviation > rate / 4:
        return max(fastest, rate + 2 * deviation, 3 * corner)
    return fastest


def needed_precision(
    road: Road, car: Car, ratio: float, bandwidths: tuple[float, float], damping: tuple[float, float], substep: float
) -> str:
    """The format that keeps the mean squares within 1e-4; ``ratio`` is the least nu, ``substep`` in units of 1/w1.

    In a substep a slow motion loses little, and is rounded by 2^-24 of itself: the one must be much more than the other.
    """
    slowest = min(car.decay(end) for end in damping)
    slowest = min(slowest, *(ratio * min(delta, 0.5 / delta) if delta > 0 else ratio for delta in bandwidths))
    single = slowest * substep >= SINGLE_DECAY and substep >= SINGLE_SUBSTEP
    if road.lines is not None:
        single = single and ratio * substep >= SINGLE_HARMONIC_ANGLE
    return road.precision if single else "float64"


def strictest_precision(
    road: Road,
    cars: Sequence[tuple[Car, float]],
    rate: float,
    bandwidths: tuple[float, float],
    damping: tuple[float, float],
    substep: float,
) -> str:
    """`needed_precision` of the most demanding of ``cars``, each with what makes a nominal damping ratio its own.

    The least ``rate`` of the road is in rad/s, the ``substep`` in s.
    """
    return max(
        needed_precision(
            road,
            car,
            rate / car.natural_frequency,
            bandwidths,
            (firmer * damping[0], firmer * damping[1]),
            substep * car.natural_frequency,
        )
        for car, firmer in cars
    )  # float64, where one needs it


def needed_substeps(
    road: Road,
    speed_noise: SpeedNoise | None,
    car: Car,
    speeds: tuple[float, float],
    bandwidth: float,
    damping: float,
    interval: float,
    given: int | None,
    still: bool = True,
) -> int:
    """Substeps in a control interval: those ``given`` if they are enough to be stable, or as many as it takes to be exact.

    Where D is not ``still`` within an interval it takes more; how fast it moves does not count, as a valve moves exactly.
    """
    # the slowest speed is the one that noise stops most easily, the fastest turns the road the fastest
    angle = interval * max(fastest_rate(road, speed_noise, car, end, bandwidth) for end in speeds)
    decay = damping * car.firmness * interval * car.natural_frequency
    if given is None:
        share = 1.0 if still else FINER
        needed = max(math.ceil(angle / (share * LARGEST_ANGLE) - 1e-9), math.ceil(decay / (share * LARGEST_DECAY) - 1e-9), 2)
        check_ratio(
            "control_interval",
            interval,
            "the number of substeps in it, at this speed, natural_frequency and bandwidth,",
            needed,
            "substeps",
        )
        return needed
    number = whole("substeps", given, of="substeps")
    # of a broad road the fast motion must not be skipped; on random roads too few substeps only follow the noise less well
    followed = speed_noise if road.takes_phase_noise else None
    largest = interval * max(
        fastest_rate(road, followed, car, speeds[1]),
        damping * car.firmness * car.natural_frequency / 2,
        speeds[1] * road.wavenumber * bandwidth,
    )
    check_ratio("substeps", given, "the largest angle in a substep", largest / number, "substep")
    return number
