"""Stationary densities and spectra of the roads: (5) and (11) of Wedig (2020), and their marginals.

The variance is `road.variance`. Level Z and scaled slope U, dZ/ds = wavenumber * U, are both in metres.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from roadgym.parameters import ParameterError
from roadgym.roads import GaussianRoad, HarmonicRoad, MultiplicativeRoad, Road, make_road

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
    if isinstance(road, GaussianRoad):
        return np.exp(-(z * z + u * u) / (2 * road.variance)) / (2 * math.pi * road.variance)
    if isinstance(road, MultiplicativeRoad):
        _check_circle(road)
        peak = road.shape / (math.pi * road.level_bound**2)
        return peak * _bounded_power(np.hypot(z, u) / road.level_bound, road.shape - 1)
    cause = {
        "first_order": "the slope of a first_order road is white noise",
        "harmonic": "level and slope of a harmonic road lie on an ellipse",
    }.get(road.kind, f"none is known for a {road.kind} road")
    raise ParameterError(f"road must have a joint density of level and slope, as gaussian and multiplicative roads do: {cause}")


def _check_circle(road: MultiplicativeRoad) -> None:
    """Raise `ParameterError` on an ellipse, where (11) does not hold."""
    if not road.is_circle:
        raise ParameterError(
            f"slope_bound must be None or level_bound, {road.level_bound:g}, for a known density, got {road.slope_bound:g}"
        )


def marginal_density(road: str | Mapping[str, Any] | Road, level: npt.ArrayLike) -> FloatArray:
    """Stationary density p(z) of the level.

    Gaussian on roads that are linear filters of white noise; proportional to (1 - z^2/r0^2)^(alpha - 1/2) on a multiplicative
    road, from (11) of Wedig (2020) by integration over the slope; the arcsine law on a harmonic road, to which that tends for
    alpha -> 0.

    Args:
        road: any road.
        level: z, m, any shape.

    Returns:
        p, 1/m, in the shape of ``level``; zero beyond the bound of the road, and infinite at it where the law is singular.
    """
    road = make_road(road)
    z = range_array("level", level, "array entry")
    road_filter = road.shaping_filter()
    if road_filter is not None and road_filter.flatness == 0 and road_filter.noise.any():
        return np.exp(-z * z / (2 * road.variance)) / math.sqrt(2 * math.pi * road.variance)
    if isinstance(road, HarmonicRoad):
        return _bounded_power(np.abs(z) / road.amplitude, -0.5) / (math.pi * road.amplitude)
    if isinstance(road, MultiplicativeRoad):
        _check_circle(road)
        from scipy.special import poch

        peak = float(poch(road.shape + 0.5, 0.5)) / (math.sqrt(math.pi) * road.level_bound)
        return peak * _bounded_power(np.abs(z) / road.level_bound, road.shape - 0.5)
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
        cause = "a pair of lines for each of its waves" if road.lines is not None else "not known"
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
