"""Plants that are deliberately wrong, and the lines of the certificate on which each fails."""

import dataclasses
import math

import numpy as np

from roadgym import (
    FirstOrderRoad,
    GaussianRoad,
    LowPassSpeedNoise,
    MultiplicativeRoad,
    WhiteSpeedNoise,
)
from roadgym.compiled import (
    BANDWIDTH,
    COEFFICIENT,
    LANES,
    LEVEL,
    LEVEL_EXCESS,
    RATE,
    SLOPE,
    SPEED,
    TURN,
    TURN_EXCESS,
    TURN_VARIANCE,
    LaneFunction,
)
from roadgym.noise import normal_pair
from roadgym.roads import gaussian
from roadgym.roads.gaussian import oscillator
from roadgym.roads.multiplicative import CURVE, SHAPE, SQUARE_CHORD
from roadgym.speed import FACTOR, INTERVAL, VARIANCE


@LaneFunction
def prepare_noise_by_the_step(lane, words, table):
    """The Gaussian road's transition with its noise scaled by the step instead of the step's root."""
    angle = np.float64(lane[TURN])
    a, b, d = oscillator(angle, np.float64(lane[BANDWIDTH]))
    scale = math.sqrt(angle)
    level = math.sqrt(max(1.0 - a * a - b * b, 1e-300))
    shared = b * (a - d) / level
    lane[gaussian.A], lane[gaussian.B], lane[gaussian.D] = a, b, d
    lane[gaussian.LEVEL_NOISE] = level * scale
    lane[gaussian.SHARED_NOISE] = shared * scale
    lane[gaussian.SLOPE_NOISE] = math.sqrt(max(1.0 - b * b - d * d - shared * shared, 0.0)) * scale


class NoiseByTheStep(GaussianRoad):
    prepare = prepare_noise_by_the_step


@LaneFunction
def prepare_by_time(lane, words, table):
    """The Gaussian road's transition over the time of the substep, its noise still that of the distance."""
    time = np.float64(lane[TURN]) / np.float64(lane[SPEED])
    a, b, d = oscillator(time, np.float64(lane[BANDWIDTH]))
    scale = math.sqrt(np.float64(lane[SPEED])) if table[0] > 0.0 else 1.0
    level = math.sqrt(max(1.0 - a * a - b * b, 1e-300))
    shared = b * (a - d) / level
    lane[gaussian.A], lane[gaussian.B], lane[gaussian.D] = a, b, d
    lane[gaussian.LEVEL_NOISE] = level * scale
    lane[gaussian.SHARED_NOISE] = shared * scale
    lane[gaussian.SLOPE_NOISE] = math.sqrt(max(1.0 - b * b - d * d - shared * shared, 0.0)) * scale


class DriftByTime(GaussianRoad):
    """Noise by distance, drift by time: the law depends on the speed."""

    prepare = prepare_by_time

    def table(self):
        return np.ones(1)


class AllByTime(GaussianRoad):
    """Noise and drift by time: the law is right at every speed, the spectrum only at speed 1."""

    prepare = prepare_by_time


@LaneFunction
def prepare_double_corner(lane, words, table):
    """The first-order road at twice its corner frequency, the area left out."""
    keep = math.exp(-2.0 * np.float64(lane[TURN]))
    lane[COEFFICIENT] = keep
    lane[COEFFICIENT + LANES] = math.sqrt(1.0 - keep * keep)
    lane[COEFFICIENT + 2 * LANES] = 0.0
    lane[COEFFICIENT + 3 * LANES] = 0.0
    lane[COEFFICIENT + 4 * LANES] = 0.0


class DoubleCorner(FirstOrderRoad):
    prepare = prepare_double_corner


class DoubleCornerNoise(LowPassSpeedNoise):
    def table(self, interval, natural_frequency, road):
        right = LowPassSpeedNoise(intensity=self.intensity, corner_frequency=2 * self.corner_frequency)
        return right.table(interval, natural_frequency, road)


@LaneFunction
def advance_stratonovich(lanes, words, table):
    """Rotate, kick on the sphere, rotate, by Stratonovich's calculus; table[CURVE] is 1 with Ito's correction of the drift."""
    for i in range(LANES):
        first, _ = normal_pair(words[i], words[LANES + i])
        angle, bandwidth = np.float64(lanes[TURN + i]), np.float64(lanes[BANDWIDTH + i])
        a, b, d = oscillator(0.5 * angle, bandwidth * (1.0 - table[CURVE] * 0.5 / table[SHAPE]))
        kick = math.sqrt(2.0 * bandwidth * angle / table[SHAPE]) * first
        old_u = lanes[SLOPE + i]
        z = a * lanes[LEVEL + i] + b * old_u
        u = d * old_u - b * lanes[LEVEL + i]
        u = u * math.cos(kick) + math.sqrt(max(table[SQUARE_CHORD] - z * z - u * u, 0.0)) * math.sin(kick)
        lanes[LEVEL + i] = a * z + b * u
        lanes[SLOPE + i] = d * u - b * z
        lanes[LEVEL_EXCESS + i] = angle * (old_u - lanes[SLOPE + i]) / 12.0


@LaneFunction
def advance_euler(lanes, words, table):
    """Euler and Maruyama's scheme, the noise cut off outside the circle."""
    for i in range(LANES):
        first, _ = normal_pair(words[i], words[LANES + i])
        angle, bandwidth = lanes[TURN + i], lanes[BANDWIDTH + i]
        z, u = lanes[LEVEL + i], lanes[SLOPE + i]
        free = max(table[SQUARE_CHORD] - z * z - u * u, 0.0)
        lanes[LEVEL + i] = z + angle * u
        lanes[SLOPE + i] = (
            u - angle * (2.0 * bandwidth * u + z) + math.sqrt(2.0 * bandwidth * angle / table[SHAPE] * free) * first
        )
        lanes[LEVEL_EXCESS + i] = angle * (u - lanes[SLOPE + i]) / 12.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stratonovich(MultiplicativeRoad):
    """A sound scheme with the correction, and without it the most usual of all mistakes."""

    corrected: bool = True

    words_per_substep = 2
    precision = "float64"
    advance = advance_stratonovich

    def table(self):
        return np.array([*super().table()[:CURVE], float(self.corrected)])


class Euler(Stratonovich):
    advance = advance_euler


@LaneFunction
def advance_to_nothing(lanes, words, table):
    """What a division by zero leaves behind."""
    for i in range(LANES):
        lanes[LEVEL + i] = np.nan
        lanes[SLOPE + i] = np.nan


class NotANumber(GaussianRoad):
    advance = advance_to_nothing


@LaneFunction
def advance_shifted(lanes, words, table):
    """White phase noise whose mean rate is sigma^2/2 too high: the correction that this equation does not need."""
    for i in range(LANES):
        _, second = normal_pair(words[i], words[LANES + i])
        lanes[TURN_EXCESS + i] = 0.0
        lanes[TURN_VARIANCE + i] = table[VARIANCE]
        lanes[TURN + i] = lanes[SPEED + i] * table[INTERVAL] + table[FACTOR + 2] * second + 0.5 * table[VARIANCE]
        lanes[RATE + i] = lanes[SPEED + i]


class ShiftedWhiteNoise(WhiteSpeedNoise):
    advance = advance_shifted


WRONG = {
    "noise scaled by the step": (NoiseByTheStep(bandwidth=0.3), None, ["variance of the level", "variance of the slope"]),
    "drift by time": (DriftByTime(bandwidth=0.3), None, ["variance at double over half speed", "law at double against half"]),
    "all by time": (AllByTime(bandwidth=0.3), None, ["spectral density at 0.5 m/s", "spectral density at 2 m/s"]),
    "double corner of the road": (DoubleCorner(), None, ["spectral density at 1 m/s", "mean square of the displacement"]),
    "double corner of the noise": ("harmonic", DoubleCornerNoise(intensity=0.5), ["spectral density at 1 m/s, 2 rad/s"]),
    "Ito's correction left out": (
        Stratonovich(corrected=False),
        None,
        ["variance of the level", "spectral density at 1 m/s, 1 rad/s", "mean square of the displacement"],
    ),
    "mean frequency shifted": ("harmonic", ShiftedWhiteNoise(intensity=0.5), ["spectral density at 1 m/s, 1 rad/s"]),
    "out of the circle": (Euler(), None, ["at most 1", "law of the level"]),
}
