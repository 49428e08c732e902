"""Road with two corners: a first-order filter, and a second-order one further up, which may resonate.

    (d/dtheta + 1) (d^2/dtheta^2 + 2 d k d/dtheta + k^2) Z = g dB/dtheta,   theta = wavenumber * distance

Below the wavenumber the spectrum is flat, from there to k times as much it falls with the square of the frequency, as measured
roads do, and beyond with its sixth power. A small damping d lets it peak at the second corner: a washboard on a rough road.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt

from .base import check_fields, check_variance
from .linear import LinearRoad


@dataclasses.dataclass(frozen=True, kw_only=True)
class TwoCornerRoad(LinearRoad):
    """Gaussian road of third order.

    Args:
        deviation: standard deviation of the level, m.
        corner_ratio: second over first corner, k, 1.
        corner_damping: damping ratio d of the second corner, 1.
        wavenumber: first corner Omega, rad/m.
    """

    kind: str = dataclasses.field(default="two_corner", init=False)
    deviation: float = 0.5
    corner_ratio: float = 5.0
    corner_damping: float = 0.3

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(self, deviation="length", corner_ratio="corner ratio", corner_damping="bandwidth")
        check_variance(self, "deviation")

    @property
    def variance(self) -> float:
        """E Z^2, m^2."""
        return self.deviation**2

    def matrices(self) -> tuple[npt.ArrayLike, npt.ArrayLike, npt.ArrayLike]:
        """Companion form of the equation above."""
        k, d = self.corner_ratio, self.corner_damping
        polynomial = np.polymul([1.0, 1.0], [1.0, 2 * d * k, k * k])
        companion = np.vstack([np.eye(3)[1:], -polynomial[:0:-1]])
        return companion, [[0], [0], [1]], [1, 0, 0]
