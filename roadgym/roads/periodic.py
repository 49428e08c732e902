"""Levels that are straight between even points and repeat themselves: what is exact of them.

With n levels z_j at the angles j a, a = wavenumber * spacing, the level over the angle has the Fourier coefficients

    c_k = (1/n) sum over j of z_j exp(-2 pi i j k/n)  sinc(k/n)^2,    sinc(x) = sin(pi x)/(pi x),

at the wavenumbers 2 pi k/(n a) over that of the road: the discrete Fourier transform, again and again, under the transform of
the triangle. A place on it that is uniform over the period makes it stationary, and no two lines have anything to do with each
other in the mean: each share 2 |c_k|^2 of the variance goes through a linear car on its own.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import numpy.typing as npt

from ..linear import FloatArray

POWERS = (2, 0, -2, -4, -6, -8, -10, -12)  # of wavenumbers, in which the gain of a car is a series


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class LineSpectrum:
    """A spectrum of lines.

    Attributes:
        shares: of the variance, shape (lines,).
        ratios: wavenumbers over that of the road, likewise; growing.
        rest: sums over all lines beyond of the share times the ratio to each of the `POWERS`.
    """

    shares: FloatArray
    ratios: FloatArray
    rest: tuple[float, ...]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PeriodicLevel:
    """A level over the angle that is straight between even points and repeats itself.

    Args:
        levels: at the points of one period, of mean zero, in standard deviations of the level, shape (n,).
        angle: between two points, rad.
    """

    levels: FloatArray
    angle: float

    @property
    def period(self) -> float:
        """Angle after which it repeats itself, rad."""
        return self.angle * len(self.levels)

    @functools.cached_property
    def climbs(self) -> FloatArray:
        """From each point to the next, shape (n,)."""
        return np.roll(self.levels, -1) - self.levels

    @property
    def slope_variance(self) -> float:
        """Mean square of the slope over the angle."""
        return float(np.mean(self.climbs**2) / self.angle**2)

    @property
    def bound(self) -> float:
        """The largest level, up or down."""
        return float(np.abs(self.levels).max())

    @functools.cached_property
    def _powers(self) -> FloatArray:
        """|DFT|^2 over n^2, shape (n,)."""
        return np.asarray(np.abs(np.fft.fft(self.levels) / len(self.levels)) ** 2)

    def lines(self, bands: int) -> LineSpectrum:
        """The lines below ``bands`` times the wavenumber of the points, ``2 pi/angle``, and what is beyond them."""
        from scipy.special import zeta

        number = len(self.levels)
        order = np.arange(1, bands * number)
        shares = 2 * np.tile(self._powers, bands)[1:] * np.sinc(order / number) ** 4
        # beyond, with k = (m + x) n, the shares fall as (m + x)^-4 in each class of equal x
        x = np.arange(1, number) / number
        strength = 2 * self._powers[1:] * (np.sin(np.pi * x) / np.pi) ** 4
        first = 2 * math.pi / self.angle
        rest = [first**power * float(strength @ zeta(4 - power, bands + x)) for power in POWERS]
        return LineSpectrum(shares=shares, ratios=order.astype(float) * (2 * math.pi / self.period), rest=tuple(rest))

    def autocovariance(self, angle: npt.ArrayLike) -> FloatArray:
        """E Z(0) Z(angle), in the shape of ``angle``.

        That of the points, under the cubic spline that the triangle's autocorrelation is.
        """
        number = len(self.levels)
        points = np.fft.ifft(self._powers).real * number
        lag = np.asarray(angle, float) / self.angle
        first = np.floor(lag).astype(np.int64)
        total = np.zeros(lag.shape)
        for offset in (-1, 0, 1, 2):
            away = np.abs(lag - (first + offset))
            spline = np.where(away < 1, 2 / 3 - away**2 + away**3 / 2, np.maximum(2 - away, 0) ** 3 / 6)
            total += points[(first + offset) % number] * spline
        return total

    @functools.cached_property
    def _law(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(edges, distribution at them, density after them): both are straight between the levels of the points."""
        following = self.levels + self.climbs
        low, high = np.minimum(self.levels, following), np.maximum(self.levels, following)
        high = np.maximum(high, low + 1e-12 * self.bound)  # what is flat is nearly so
        share = 1 / (len(low) * (high - low))
        edges = np.concatenate([low, high])
        order = np.argsort(edges)
        edges = edges[order]
        density = np.maximum(np.cumsum(np.concatenate([share, -share])[order]), 0.0)
        density[-1] = 0.0
        distribution = np.concatenate([[0.0], np.cumsum(density[:-1] * np.diff(edges))])
        return edges, distribution / distribution[-1], density

    def distribution(self, level: npt.ArrayLike) -> FloatArray:
        """Probability that Z is below ``level``, in its shape."""
        edges, distribution, _ = self._law
        return np.asarray(np.interp(np.asarray(level, float), edges, distribution))

    def density(self, level: npt.ArrayLike) -> FloatArray:
        """Density of Z at ``level``, in its shape; very large at a level at which the road is flat."""
        edges, _, density = self._law
        places = np.searchsorted(edges, np.asarray(level, float), side="right") - 1
        return np.where(places < 0, 0.0, density[np.maximum(places, 0)])


def joined(heights: FloatArray, steps: int) -> FloatArray:
    """One period of ``heights`` without their straight trend, whose last ``steps`` steps fade over into the first.

    The fade is a raised cosine: neither the height nor the slope of what is joined jumps.

    Args:
        heights: measured, shape (n,).
        steps: in which they are joined, at most n/2; with none the heights are a period as they are.

    Returns:
        Heights at the points of the period, shape (n - 1 - steps,), or (n,) without steps.
    """
    if steps == 0:
        return heights
    place = np.linspace(-1.0, 1.0, len(heights))
    level = heights - np.polynomial.polynomial.polyval(place, np.polynomial.polynomial.polyfit(place, heights, 1))
    period = level[: len(level) - 1 - steps].copy()
    share = (1 - np.cos(math.pi * np.arange(steps) / steps)) / 2
    period[:steps] = (1 - share) * level[len(period) : len(period) + steps] + share * level[:steps]
    return period
