"""Autocovariance R(t) = E Z(0) Z(t) of the level of a road in time, and the periodogram to expect of a record of it.

    first order   R(t) = E Z^2 e^(-a),                                            a = wavenumber v t      (4), (5)
    second order  R(t) = E Z^2 e^(-delta a) (cos b a + delta/b sin b a),          b = sqrt(1 - delta^2)   (7), (8)
    harmonic      R(t) = E Z^2 cos(a) e^(-w(t)/2),                                                        (2), (18), (25), (30)
    waves         the sum of such terms; any other filter of white noise by its matrix exponential,
    profile       that of its points under a spline (`roadgym.roads.periodic`),

w(t) being the variance of the phase's random part: sigma^2 t under white noise, sigma^2 (t - (1 - e^(-w_g t))/w_g) under
low-pass, sigma^2 (1 - e^(-w_g t))/w_g under high-pass noise. Equation numbers are those of Wedig (2020).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from roadgym.parameters import ParameterError
from roadgym.roads import Road
from roadgym.speed import SpeedNoise

from .checks import FloatArray, range_array
from .sampling import Samples


def autocovariance(road: Road, speed_noise: SpeedNoise | None, lag: npt.ArrayLike, *, speed: float) -> FloatArray:
    """Autocovariance E Z(0) Z(t) of the level in time; see the module's docstring.

    Args:
        road: a road.
        speed_noise: noise on the phase of a harmonic road, or None.
        lag: t >= 0, s, any shape.
        speed: v, m/s.

    Returns:
        R, m^2, in the shape of ``lag``.

    Raises:
        ParameterError: a plant without closed form, such as a random road under speed noise.
    """
    t = range_array("lag", lag, "lag")
    angle = speed * road.wavenumber * t
    if road.lines is not None and (speed_noise is None or road.takes_phase_noise):
        spread = _phase_variance(speed_noise, t)
        terms = [share * np.cos(k * angle) * np.exp(-k * k * spread / 2) for share, k in road.lines]
        return np.asarray(road.variance * np.sum(terms, axis=0))
    if road.periodic is not None and speed_noise is None:
        return road.variance * road.periodic.autocovariance(angle)
    road_filter = road.shaping_filter()
    if speed_noise is not None or road_filter is None:
        raise ParameterError(no_closed_form(road, speed_noise))
    if road_filter.is_first_order:
        return road.variance * np.exp(-angle)
    if road_filter.bandwidth is not None:
        delta = float(road_filter.bandwidth)
        root = np.sqrt(complex((delta - 1) * (delta + 1)))
        root = root if abs(root) > 1e-5 else 1e-5  # at critical damping the limit, to 1e-10
        first, second = -delta + root, -delta - root
        decay = (first * np.exp(second * angle) - second * np.exp(first * angle)) / (first - second)
        return np.asarray(road.variance * decay.real)
    return road.variance * road_filter.autocovariance(angle)


def no_closed_form(road: Road, speed_noise: SpeedNoise | None) -> str:
    """Why a plant has no autocovariance in closed form, in words."""
    if speed_noise is None:
        return f"none is known for a {road.kind} road, which declares neither lines nor a filter nor a period"
    return f"with {speed_noise.kind} noise there is no closed form on a {road.kind} road"


def _phase_variance(speed_noise: SpeedNoise | None, time: FloatArray) -> FloatArray:
    """Variance w(t) of the random part of the phase, rad^2, after the ``time`` t, s."""
    if speed_noise is None:
        return np.zeros_like(time)
    linear, filtered = speed_noise.phase_spread
    corner = speed_noise.rates[0]
    kept = -np.expm1(-corner * time) / corner if corner > 0 else time
    return np.asarray(speed_noise.intensity**2 * (linear * time - filtered * kept))


def expected_periodogram(
    samples: Samples, road: Road, speed_noise: SpeedNoise | None, speed: float, ratios: tuple[float, ...]
) -> FloatArray:
    """Exact mean of the periodogram of a record, m^2 s, at ``ratios`` times the road's angular rate; shape (ratios,).

    Raises:
        ParameterError: a plant whose autocovariance has no closed form.
    """
    from scipy.signal import correlate

    window = samples.window
    overlap = correlate(window, window)[window.size - 1 :]
    overlap[1:] *= 2  # both signs of the lag
    lag = samples.interval * np.arange(window.size)
    covariance = autocovariance(road, speed_noise, lag, speed=speed)
    waves = np.cos(np.outer(ratios, speed * road.wavenumber * lag))
    return np.asarray(samples.interval * (waves @ (overlap * covariance)) / overlap[0])
