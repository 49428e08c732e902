"""Classes of road roughness after ISO 8608:2016, "Mechanical vibration - Road surface profiles - Reporting of measured data".

The standard gives the one-sided spectral density of the height over the spatial frequency n, in cycles/m,

    G(n) = G(n0) (n/n0)^-2,    n0 = 0.1 cycles/m,

with a geometric mean of G(n0) for each class; its limits are half and twice that. As the heights of such a road have no
variance, a road of ours levels off below a lowest frequency. Over the angular wavenumber k = 2 pi n the law is s^2/k^2,
two-sided, with

    s^2 = 2 pi^2 n0^2 G(n0)  per metre.
"""

from __future__ import annotations

import math
from typing import Any

from ..parameters import ParameterError, positive, shown, within

REFERENCE = 0.1  # n0, cycles/m
MEANS = {name: 16e-6 * 4.0**k for k, name in enumerate("ABCDEFGH")}  # geometric means of G(n0), m^3
LOWEST, HIGHEST = 0.01, 10.0  # frequencies, cycles/m, between which roads follow the law by default


def strength(iso_class: Any) -> float:
    """s^2 of a class "A" to "H", or of a density G(n0) in m^3 of one's own, in m.

    Raises:
        ParameterError: neither a class nor a density.
    """
    if isinstance(iso_class, str) and iso_class.upper() in MEANS:
        density = MEANS[iso_class.upper()]
    elif isinstance(iso_class, str):
        raise ParameterError(f"iso_class must be a letter of {', '.join(MEANS)}, or G(n0) in m^3, got {shown(iso_class)}")
    else:
        density = within("iso_class", iso_class, "roughness")
    return 2 * math.pi**2 * REFERENCE**2 * density


def corners(lowest_frequency: Any, highest_frequency: Any) -> tuple[float, float, float]:
    """(wavenumber, rad/m; bandwidth; second corner over the first) of a second-order filter with these corners, cycles/m.

    Raises:
        ParameterError: no positive frequencies, or the highest not above the lowest.
    """
    low, high = positive("lowest_frequency", lowest_frequency), positive("highest_frequency", highest_frequency)
    if high <= low:
        raise ParameterError(f"highest_frequency must be above lowest_frequency, {low:g}, got {shown(highest_frequency)}")
    middle = math.sqrt(low * high)
    return 2 * math.pi * middle, (low + high) / (2 * middle), high / low
