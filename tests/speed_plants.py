"""Plants under speed noise, and what theory says of them, for the tests of speed noise."""

import math

import numpy as np

import analysis
from roadgym import MEAN_SQUARES
from roadgym.plant import Plant
from roadgym.task import make_task


def started_plant(number, **parameters):
    plant = Plant(make_task(**parameters), number)
    plant.start(np.arange(number, dtype=np.uint64))
    return plant


def phase_variance(noise, time):
    """Variance of the random part of the phase."""
    if noise.kind == "white":
        return noise.intensity**2 * time
    corner = noise.corner_frequency
    filtered = (1 - math.exp(-corner * time)) / corner
    return noise.intensity**2 * (filtered if noise.kind == "high_pass" else time - filtered)


def exact_mean_squares(road, noise, *, damping, speed):
    theory = analysis.mean_squares(road, noise, damping=damping, speed=speed)
    return np.array([getattr(theory, name) for name in MEAN_SQUARES]) / make_task(road=road).road.variance


def finite_terms(road, noise):
    """Which of the five mean squares are finite, whether or not there is a closed form."""
    if road == "first_order" or noise in ("white", "high_pass"):
        return [0, 1, 3]
    return [0, 1, 2, 3, 4]
