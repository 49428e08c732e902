"""Stationary mean squares of the car at constant damping: (3), (6), (14)-(17) of Wedig (2020), and more of the same kind.

All are combinations of the mean squares P_m of q and its derivatives, where q'' + 2 D q' + q = Z in units of time 1/w1, because
the car's transfer function has the numerator 1 + 2 D s:

    displacement P_0 + 4 D^2 P_1, velocity P_1 + 4 D^2 P_2, acceleration P_2 + 4 D^2 P_3, travel P_2, relative velocity P_3.

`roadgym.reward` says which of them diverge on a road whose rate of change contains white noise.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from roadgym.cars import MEAN_SQUARES, Car, make_car
from roadgym.cars.one_mass import MOTION
from roadgym.linear import LinearSystem, ShapingFilter
from roadgym.parameters import ParameterError, within
from roadgym.roads import Road, make_road
from roadgym.speed import SpeedNoise, make_speed_noise

from .checks import FloatArray, broadcast, check_size, range_array, ratio_array
from .driven import driven_mean_squares
from .line_response import line_mean_squares
from .phase_noise import MeanSquaresOfFilter, decaying_mean_squares, filter_mean_squares, is_known

RELATIVE_ERROR = 3e-3  # standard error over the mean, of what is simulated


class MeanSquares(Mapping[str, FloatArray]):
    """Stationary mean squares of the car by name, m^2, not divided by the road's variance; each is an attribute, too.

    Of the car of one mass: displacement E Y^2, velocity E (Y'/w1)^2, acceleration E (Y''/w1^2)^2, travel E (Y - Z)^2, and
    relative_velocity E ((Y' - Z')/w1)^2. Results are frozen dataclasses, whose fields are these and the standard error.

    Attributes:
        names: of the mean squares, each of which has the common shape of what was asked.
        standard_error: standard errors of all, m^2, where they come from simulation; None where they are exact.
    """

    names: ClassVar[tuple[str, ...]] = ()
    standard_error: MeanSquares | None

    @staticmethod
    def of(squares: Mapping[str, FloatArray], standard_error: MeanSquares | None = None) -> MeanSquares:
        """The mean squares by name, and their standard errors."""
        made: MeanSquares = _fields_of(tuple(squares))(**squares, standard_error=standard_error)
        return made

    def __getitem__(self, name: str) -> FloatArray:
        """The mean square of a signal."""
        if name not in self.names:
            raise KeyError(name)
        square: FloatArray = getattr(self, name)
        return square

    def __iter__(self) -> Iterator[str]:
        """The names of the signals."""
        return iter(self.names)

    def __len__(self) -> int:
        """How many they are."""
        return len(self.names)

    def __reduce__(self) -> Any:
        """The class is made anew where a copy is unpickled."""
        return MeanSquares.of, (dict(self), self.standard_error)

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> FloatArray:
            """The mean square of a signal."""


@functools.cache
def _fields_of(names: tuple[str, ...]) -> Any:
    """The class of results with these mean squares."""
    fields: list[Any] = [*((name, FloatArray) for name in names), ("standard_error", MeanSquares | None, None)]
    namespace = {"names": names}
    return dataclasses.make_dataclass(
        "MeanSquares", fields, bases=(MeanSquares,), namespace=namespace, frozen=True, kw_only=True, eq=False
    )


def mean_squares(
    road: str | Mapping[str, Any] | Road,
    speed_noise: str | Mapping[str, Any] | SpeedNoise | None = None,
    *,
    damping: npt.ArrayLike,
    speed: npt.ArrayLike,
    natural_frequency: float | None = None,
    car: str | Mapping[str, Any] | Car | None = None,
    bandwidth: npt.ArrayLike | None = None,
    relative_error: float = RELATIVE_ERROR,
) -> MeanSquares:
    """Stationary mean squares at constant damping; (3), (6), (16), (17) of Wedig (2020) and their companions.

    Exact on every road that is a linear filter or bounded, and with one mass under speed noise on the harmonic road: to
    rounding without low-pass noise, and with it to 1e-10 of each mean square for D <= 5, however slow, fast or weak it is; to
    1e-8 on a filter without closed form, such as that of the two-corner road, and of other cars. Of a multiplicative road only
    variance and bandwidth enter. On a measured profile they are sums over its lines, to 1e-8 (`analysis.line_response`).

    Low-pass noise on a random road has no closed form, nor has a road of one's own that declares neither lines nor a filter nor
    a period: there the plant itself is driven, seconds for each operating point, and the result has a standard error. The noise
    has a fixed seed, so the same call gives the same numbers.

    Args:
        road: a road, or its name or mapping.
        speed_noise: noise on the speed, or its name or mapping, or None.
        damping: D > 0, 1, any shape.
        speed: mean speed v >= 0, m/s, any shape that broadcasts; above zero where there is no closed form.
        natural_frequency: w1 of the car of one mass, rad/s, 1 by default; in place of ``car``.
        car: a car, or its name or mapping; the car of one mass by default.
        bandwidth: delta > 0, 1, in place of the road's, at the same variance; any shape that broadcasts; second-order roads.
        relative_error: standard error over the mean, 1, at which a simulation ends.

    Returns:
        The mean squares of all signals of the car, in the squares of the units in which it tells them: m^2, of the car of two
        masses SI. Infinite where they diverge because the road's rate of change contains white noise.

    Raises:
        ParameterError: a value out of range.
    """
    road = make_road(road)
    speed_noise = make_speed_noise(speed_noise, road)
    the_car = make_car(car, natural_frequency)
    w1 = the_car.natural_frequency
    driven, closed = needs_simulation(road, speed_noise, the_car), has_closed_form(road, the_car)
    if speed_noise is not None:
        speed_noise.check_range(w1, driven=driven)
    relative_error = within("relative_error", relative_error)
    arrays = {
        "damping": range_array("damping", damping, "constant damping" if closed and not driven else "damping"),
        "speed": checked_speed(speed, road, w1),
    }
    if bandwidth is not None:
        arrays["bandwidth"] = checked_bandwidth(bandwidth, road)
    damping, speed, *rest = broadcast(**arrays)
    ratio = speed * (road.wavenumber / w1)
    if driven:
        check_size("operating points to simulate", "damping and speed", damping.size, "driven points")
        bandwidths = rest[0] if bandwidth is not None else None
        return _simulated(road, speed_noise, damping, speed, the_car, bandwidths, relative_error)
    if not closed:
        ratio_array("speed", speed, "nu = speed * wavenumber/natural_frequency", ratio, "linear frequency ratio")
    road_filter = road.shaping_filter(rest[0] if rest else None)
    if road_filter is None:
        found = line_mean_squares(road, the_car.motion, damping=damping, ratio=ratio)
    elif closed:
        found = _closed(road, road_filter, speed_noise, damping, ratio, w1)
    else:
        found = LinearSystem.of(road_filter, the_car.motion, damping=damping, ratio=ratio).mean_squares()
    factors = dict(zip(the_car.mean_squares, the_car.unit_factors.tolist(), strict=True))
    return MeanSquares.of({name: factors[name] ** 2 * (road.variance * square) for name, square in found.items()})


def has_closed_form(road: Road, car: Car) -> bool:
    """Are their mean squares known in closed form, which is exact in a wider range than Lyapunov's equation?"""
    motion = car.motion
    if not (motion.is_one_mass and car.mean_squares == MEAN_SQUARES and np.array_equal(motion.rows, MOTION.rows)):
        return False
    road_filter = road.shaping_filter()
    known = road_filter is not None and (road_filter.is_first_order or road_filter.bandwidth is not None)
    return known or road.lines is not None


def _closed(
    road: Road,
    road_filter: ShapingFilter,
    speed_noise: SpeedNoise | None,
    damping: FloatArray,
    ratio: FloatArray,
    natural_frequency: float,
) -> dict[str, FloatArray]:
    """Mean squares by name over the road's variance, by the closed forms that there are."""
    if road.lines is not None:
        terms = [
            [share * term for term in filter_mean_squares(_of_wave(speed_noise, k), damping, k * ratio, natural_frequency)]
            for share, k in road.lines
        ]
        p0, p1, p2, p3 = (np.sum(part, axis=0) for part in zip(*terms, strict=True))
    elif road_filter.is_first_order:
        p0, p1, p2 = decaying_mean_squares(damping, 0.0, ratio)
        p3 = np.where(ratio > 0, np.inf, 0.0)
    else:
        assert road_filter.bandwidth is not None
        p0, p1, p2, p3 = _second_order(damping, ratio, road_filter.bandwidth)
    gain = 4 * damping**2
    values = (p0 + gain * p1, p1 + gain * p2, p2 + gain * p3, p2, p3)
    return dict(zip(MEAN_SQUARES, values, strict=True))


def _of_wave(speed_noise: SpeedNoise | None, ratio: float) -> SpeedNoise | None:
    """Noise on the phase of a wave that turns ``ratio`` times as fast as the road's angle."""
    return None if speed_noise is None else dataclasses.replace(speed_noise, intensity=ratio * speed_noise.intensity)


def checked_speed(speed: npt.ArrayLike, road: Road, natural_frequency: float) -> FloatArray:
    """Speeds v >= 0, m/s, whose frequency ratios are in the range of closed forms."""
    result = range_array("speed", speed, "any speed")
    ratio = result * (road.wavenumber / natural_frequency)
    ratio_array("speed", result, "nu = speed * wavenumber/natural_frequency", ratio, "constant frequency ratio")
    return result


def checked_bandwidth(bandwidth: npt.ArrayLike, road: Road) -> FloatArray:
    """Bandwidths in place of the road's: on second-order roads, and not on an ellipse, whose variance each would change."""
    result = range_array("bandwidth", bandwidth, "constant bandwidth")
    own = getattr(road, "bandwidth", None)
    if own is None:
        raise ParameterError(f"bandwidth must be None: a {road.kind} road has none")
    for other in result[result != own].flat[:1]:
        road.with_bandwidth(float(other))
    return result


def needs_simulation(road: Road, speed_noise: SpeedNoise | None, car: Car) -> bool:
    """Is there no theory, so that the plant must be driven: on a road that is no linear filter, or with noise on the speed?"""
    if speed_noise is None:
        return road.shaping_filter() is None and road.periodic is None
    known = road.lines is not None and road.takes_phase_noise and is_known(speed_noise)
    return not (known and has_closed_form(road, car))


def _simulated(
    road: Road,
    speed_noise: SpeedNoise | None,
    damping: FloatArray,
    speed: FloatArray,
    car: Car,
    bandwidth: FloatArray | None,
    relative_error: float,
) -> MeanSquares:
    """Mean squares with standard errors, one simulation for each operating point."""
    result = np.empty((2, len(car.mean_squares), *damping.shape))
    for index in np.ndindex(damping.shape):
        here = road if bandwidth is None else road.with_bandwidth(float(bandwidth[index]))
        result[:, :, *index] = driven_mean_squares(
            here, speed_noise, float(damping[index]), float(speed[index]), car, relative_error
        )
    means, errors = (MeanSquares.of(dict(zip(car.mean_squares, part, strict=True))) for part in result)
    return MeanSquares.of(means, standard_error=errors)


def _second_order(damping: FloatArray, ratio: FloatArray, bandwidth: FloatArray) -> MeanSquaresOfFilter:
    """P_0, ..., P_3 on a second-order road of variance 1; no term is negative."""
    mixed, crossed = bandwidth + damping * ratio, damping + bandwidth * ratio
    denominator = ((1 - ratio) * (1 + ratio)) ** 2 + 4 * ratio * crossed * mixed  # (15)
    cube = ratio**3 / damping
    p0 = 1 + 4 * bandwidth * ratio * crossed + bandwidth * cube
    p1 = ratio**2 / damping * crossed
    p2 = cube * mixed
    p3 = cube * (4 * damping * bandwidth * ratio * mixed + damping * ratio**3 + bandwidth)
    return p0 / denominator, p1 / denominator, p2 / denominator, p3 / denominator


def covariance(
    road: str | Mapping[str, Any] | Road,
    *,
    damping: npt.ArrayLike,
    speed: npt.ArrayLike,
    natural_frequency: float | None = None,
    car: str | Mapping[str, Any] | Car | None = None,
) -> FloatArray:
    """Stationary covariance of the states of car and road, by Lyapunov's equation; (Y, X, Z, U) of one mass on second order.

    Solved numerically, independent of the closed forms of `mean_squares`; the moment equations (14) of Wedig (2020) are it.

    Args:
        road: a road that is a linear filter, or bounded.
        damping: D > 0, 1, any shape.
        speed: v >= 0, m/s, any shape that broadcasts.
        natural_frequency, car: as of `mean_squares`.

    Returns:
        Covariance matrices, m^2, in the common shape followed by (n, n), n = 4 on a second-order road.
    """
    road = make_road(road)
    road_filter = road.shaping_filter()
    if road_filter is None:
        raise ParameterError(f"road must be a linear filter, see roadgym.linear.ShapingFilter; a {road.kind} road is none")
    the_car = make_car(car, natural_frequency)
    w1 = the_car.natural_frequency
    damping, speed = broadcast(damping=range_array("damping", damping, "damping"), speed=checked_speed(speed, road, w1))
    nu = speed * (road.wavenumber / w1)
    return road.variance * LinearSystem.of(road_filter, the_car.motion, damping=damping, ratio=nu).covariance()
