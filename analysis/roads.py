"""Stationary densities and spectra of the roads: (5) and (11) of Wedig (2020), and their marginals.

The variance is `road.variance`. Level Z and scaled slope U, dZ/ds = wavenumber * U, are both in metres.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from roadgym.linear import ShapingFilter
from roadgym.parameters import ParameterError
from roadgym.roads import Road, make_road

from .checks import FloatArray, broadcast, range_array, ratio_array


def density(road: str | Mapping[str, Any] | Road, level: npt.ArrayLike, slope: npt.ArrayLike) -> FloatArray:
    """Joint stationary density p(z, u) of level and slope; (11) of Wedig (2020), and its Gaussian limit.

    Args:
        road: a Gaussian or multiplicative road.
        level: z, m, any shape.
        slope: u, m, any shape that broadcasts with ``level``.

    Returns:
        p, 1/m^2, in the common shape; zero outside the circle of a multiplicative road, and infinite on it for a shape below 1.

    Raises:
        ParameterError: a road without joint density: the slope of a first-order road is white noise, and level and slope of
            a harmonic road lie on a curve; a multiplicative road on an ellipse, whose density is not known.
    """
    road = make_road(road)
    z, u = broadcast(level=range_array("level", level, "array entry"), slope=range_array("slope", slope, "array entry"))
    road_filter = road.shaping_filter()
    if road_filter is not None and road_filter.states == ("level", "slope") and road_filter.noise.any():
        if road_filter.flatness == 0:
            return np.exp(-(z * z + u * u) / (2 * road.variance)) / (2 * math.pi * road.variance)
        shape, bound = _bounded(road, road_filter)
        return shape / (math.pi * bound**2) * _bounded_power(np.hypot(z, u) / bound, shape - 1)
    if not road.has_slope:
        cause = f"the slope of a {road.kind} road is white noise"
    elif road.lines is not None and len(road.lines) == 1:
        cause = f"level and slope of a {road.kind} road lie on an ellipse"
    else:
        cause = f"none is known for a {road.kind} road"
    raise ParameterError(f"road must have a joint density of level and slope, as gaussian and multiplicative roads do: {cause}")


def _bounded(road: Road, road_filter: ShapingFilter) -> tuple[float, float]:
    """Shape alpha and bound r0, m, of a bounded road: E Z^2 = r0^2/(2 (alpha + 1)).

    Raises:
        ParameterError: an ellipse, where (11) does not hold.
    """
    if road_filter.flatness is None:
        raise ParameterError(f"road must have a known density, as a multiplicative one has on a circle, got {road!r}")
    shape = 1 / road_filter.flatness
    return shape, math.sqrt(2 * (shape + 1) * road.variance)


def level_bound(road: Road) -> float:
    """The largest level of a road whose law is known, m; infinite where there is none.

    Raises:
        ParameterError: a road whose law is not known.
    """
    road_filter = road.shaping_filter()
    if road.periodic is not None:
        return math.sqrt(road.variance) * road.periodic.bound
    if road.lines is not None:
        return math.sqrt(2 * road.variance) * sum(math.sqrt(share) for share, _ in road.lines)
    if road_filter is None:
        raise ParameterError(f"road must be of a kind whose level has a known density, got a {road.kind} road")
    return math.inf if road_filter.flatness == 0 else _bounded(road, road_filter)[1]


def marginal_density(road: str | Mapping[str, Any] | Road, level: npt.ArrayLike) -> FloatArray:
    """Stationary density p(z) of the level.

    Gaussian on roads that are linear filters of white noise; proportional to (1 - z^2/r0^2)^(alpha - 1/2) on a multiplicative
    road, from (11) of Wedig (2020) by integration over the slope; the arcsine law on a harmonic road, to which that tends for
    alpha -> 0; on a measured profile even between the heights of two points, the sum over all its pieces.

    Args:
        road: any road.
        level: z, m, any shape.

    Returns:
        p, 1/m, in the shape of ``level``; zero beyond the bound of the road, and infinite at it where the law is singular.
    """
    road = make_road(road)
    z = range_array("level", level, "array entry")
    road_filter = road.shaping_filter()
    if road.periodic is not None:
        deviation = math.sqrt(road.variance)
        return road.periodic.density(z / deviation) / deviation
    if road_filter is not None and road_filter.flatness == 0 and road_filter.noise.any():
        return np.exp(-z * z / (2 * road.variance)) / math.sqrt(2 * math.pi * road.variance)
    if road.lines is not None and len(road.lines) == 1:
        amplitude = math.sqrt(2 * road.variance)
        return _bounded_power(np.abs(z) / amplitude, -0.5) / (math.pi * amplitude)
    if road_filter is not None and road.lines is None:
        from scipy.special import poch

        shape, bound = _bounded(road, road_filter)
        peak = float(poch(shape + 0.5, 0.5)) / (math.sqrt(math.pi) * bound)
        return peak * _bounded_power(np.abs(z) / bound, shape - 0.5)
    raise ParameterError(f"road must be of a kind whose level has a known density, got a {road.kind} road")


def spectral_density(road: str | Mapping[str, Any] | Road, frequency: npt.ArrayLike, *, speed: npt.ArrayLike) -> FloatArray:
    """Spectral density S(w) of the level in time, at constant speed; (5) of Wedig (2020), and its second-order companion.

    Two-sided in the angular frequency w: the integral of S over -inf < w < inf, divided by 2 pi, is the variance. A
    multiplicative road has the spectrum of the Gaussian road with its variance, because its drift is linear.

    Args:
        road: a road that is a filter of white noise, or bounded.
        frequency: w, rad/s, any shape.
        speed: v, m/s, any shape that broadcasts with ``frequency``.

    Returns:
        S, m^2 s, in the common shape.

    Raises:
        ParameterError: a road whose spectrum is a set of lines, or not known.
    """
    road = make_road(road)
    w, v = broadcast(
        frequency=range_array("frequency", frequency, "array entry"), speed=range_array("speed", speed, "moving speed")
    )
    turn = v * road.wavenumber
    ratio_array("speed", v, "speed * wavenumber", turn, "angular rate")
    x = w / turn
    road_filter = road.shaping_filter()
    if road_filter is None or not road_filter.noise.any():
        waves = road.lines is not None or road.periodic is not None
        cause = "a pair of lines for each of its waves" if waves else "not known"
        raise ParameterError(f"road must have a spectral density: the spectrum of a {road.kind} road is {cause}")
    if road_filter.is_first_order:
        return 2 * road.variance / (turn * (1 + x * x))
    if road_filter.bandwidth is not None:
        delta = float(road_filter.bandwidth)
        return 4 * delta * road.variance / (turn * (((1 - x) * (1 + x)) ** 2 + (2 * delta * x) ** 2))
    return road.variance * road_filter.spectrum(x) / turn


def _bounded_power(radius: FloatArray, exponent: float) -> FloatArray:
    """(1 - radius^2)^exponent inside the unit circle, its limit on it, and zero outside."""
    inside = np.maximum((1 - radius) * (1 + radius), 0.0)
    with np.errstate(divide="ignore"):
        return np.where(radius <= 1, inside**exponent, 0.0)
