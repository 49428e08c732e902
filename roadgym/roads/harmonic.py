"""Harmonic road, (2) of Wedig (2020): Z = amplitude cos(phi), with phi driven at the angular rate v * wavenumber plus noise.

The pair (cos phi, -sin phi) is rotated by the angle of the substep, whose law is exact (see `roadgym.speed`), so the sampled
road is exact in law. Between samples the mean level is that of the chord in phi, corrected for the random path of phi about
its chord to first order in that path and for its variance to second order: weak error of third order a substep.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from ..compiled import LANES, LEVEL, LEVEL_EXCESS, SLOPE, TURN, TURN_EXCESS, TURN_VARIANCE, LaneFunction, like
from ..noise import uniform
from .base import Road, check_fields


@LaneFunction
def start(lane: Any, words: Any, table: Any) -> None:
    """A uniform phase: the stationary law."""
    phase = 2.0 * math.pi * uniform(words[0])
    lane[LEVEL] = math.sqrt(2.0) * math.cos(phase)
    lane[SLOPE] = -math.sqrt(2.0) * math.sin(phase)


@LaneFunction
def advance(lanes: Any, words: Any, table: Any) -> None:
    """Rotate by TURN and bring the radius back to sqrt(2), from which rounding would let it drift."""
    half, one, three_halves = like(lanes, 0.5), like(lanes, 1.0), like(lanes, 1.5)
    quarter, twenty_fourth = like(lanes, 0.25), like(lanes, 1.0 / 24.0)
    for i in range(LANES):
        turn = lanes[TURN + i]
        z, u = lanes[LEVEL + i], lanes[SLOPE + i]
        cosine, sine = np.cos(turn), np.sin(turn)
        new_z = cosine * z + sine * u
        new_u = cosine * u - sine * z
        scale = three_halves - quarter * (new_z * new_z + new_u * new_u)
        new_z, new_u = new_z * scale, new_u * scale
        lanes[LEVEL + i] = new_z
        lanes[SLOPE + i] = new_u
        # the chord's mean of cos is (z0 + z1)/2 * tan(turn/2)/(turn/2)
        square = turn * turn
        curve = square * (one + square * like(lanes, 0.1)) - lanes[TURN_VARIANCE + i]
        lanes[LEVEL_EXCESS + i] = (z + new_z) * curve * twenty_fourth + half * (u + new_u) * lanes[TURN_EXCESS + i]


@dataclasses.dataclass(frozen=True, kw_only=True)
class HarmonicRoad(Road):
    """Sinusoidal road; equation (2), and (18), (25), (30) with speed noise.

    Args:
        amplitude: mu, m.
        wavenumber: Omega, rad/m.
    """

    kind: str = dataclasses.field(default="harmonic", init=False)
    amplitude: float = 1.0

    words_per_substep = 0
    takes_phase_noise = True
    start = start
    advance = advance

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(self, amplitude="length")

    @property
    def variance(self) -> float:
        """E Z^2 = mu^2 / 2, m^2."""
        return self.amplitude**2 / 2

    @property
    def lines(self) -> tuple[tuple[float, float], ...]:
        """One wave."""
        return ((1.0, 1.0),)
