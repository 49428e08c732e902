"""The car under speed noise, driven, against theory and an independent simulation."""

import math

import numpy as np
import pytest
from scipy.linalg import expm
from speed_plants import exact_mean_squares, finite_terms, started_plant

from roadgym import SPEED_NOISES, LowPassSpeedNoise


def driven_mean_squares(plant, damping, settle, measure, terms):
    """Means and standard errors of the chosen mean squares over E Z^2, from independent lanes."""
    actions = np.full(plant.num_envs, damping, np.float32)
    interval = plant.task.control_interval
    for _ in range(round(settle / interval)):
        plant.step(actions)
    total = np.zeros((len(terms), plant.num_envs))
    for _ in range(round(measure / interval)):
        total += plant.step(actions).mean_squares[list(terms)]
    total /= round(measure / interval)
    return total.mean(axis=1), total.std(axis=1, ddof=1) / math.sqrt(plant.num_envs)


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("kind", "corner", "measure"),
    [("white", None, 500), ("low_pass", 0.05, 500), ("low_pass", 10.0, 500), ("high_pass", 0.05, 500), ("high_pass", 10.0, 50)],
)
def test_default_substep_holds_the_bar_by_simulation(kind, corner, measure):
    damping = 0.1
    noise = SPEED_NOISES[kind](intensity=1.0, **({} if corner is None else {"corner_frequency": corner}))
    plant = started_plant(24_576, road="harmonic", speed_noise=noise, speed=1.0)
    terms = finite_terms("harmonic", kind)
    found, error = driven_mean_squares(plant, damping, 100, measure, terms)
    exact = exact_mean_squares("harmonic", noise, damping=damping, speed=1.0)[terms]
    assert np.all(error / exact < 0.0015)
    assert np.all(np.abs(found / exact - 1) < 0.005 + 3 * error / exact)


class IndependentPlant:
    """Low-pass noise on the speed of a random road, in plain NumPy: nothing of it comes from the package but parameters.

    The noise is exact, with the trapezoidal rule for the distance of a step. The road follows over that distance by Strang's
    splitting into half a rotation, the rest of the equation and half a rotation (first order: exact). Between, the level is a
    straight line, on which the car's motion is exact. The steps must be fine.
    """

    def __init__(self, road, noise, speed, damping, step, lanes, seed):
        self.generator = np.random.default_rng(seed)
        self.road, self.noise, self.speed, self.step = road, noise, speed, step
        self.damping = damping
        self.psi = noise.intensity / math.sqrt(2 * noise.corner_frequency) * self.normal(lanes)
        self.rate = np.maximum(speed + noise.corner_frequency * self.psi, 0)
        if road.kind == "multiplicative":
            self.square_radius = 2 * (road.shape + 1)
            radius = np.sqrt(self.square_radius * (1 - self.generator.random(lanes) ** (1 / road.shape)))
            angle = 2 * math.pi * self.generator.random(lanes)
            self.z, self.u = radius * np.cos(angle), radius * np.sin(angle)
        else:
            self.z, self.u = self.normal(lanes), self.normal(lanes)
        self.y, self.x = np.zeros(lanes), np.zeros(lanes)
        # Y, X, level and its rate over one step, the rate being constant
        drift = np.array([[0, 1, 0, 0], [-1, -2 * damping, 1, 2 * damping], [0, 0, 0, 1], [0, 0, 0, 0]])
        self.car = expm(step * drift)[:2]

    def normal(self, lanes):
        return self.generator.standard_normal(lanes)

    def advance(self):
        keep = math.exp(-self.noise.corner_frequency * self.step)
        noise = self.noise.intensity * math.sqrt((1 - keep**2) / (2 * self.noise.corner_frequency))
        self.psi = keep * self.psi + noise * self.normal(self.psi.size)
        old_rate, old_z = self.rate, self.z
        self.rate = np.maximum(self.speed + self.noise.corner_frequency * self.psi, 0)  # the car does not reverse
        self.advance_road((old_rate + self.rate) / 2 * self.step)
        self.y, self.x = self.car @ np.stack([self.y, self.x, old_z, (self.z - old_z) / self.step])

    def advance_road(self, angle):
        noise = self.normal(angle.size)
        if self.road.kind == "first_order":
            keep = np.exp(-angle)
            self.z = keep * self.z + np.sqrt(1 - keep**2) * noise
            return
        cosine, sine = np.cos(angle / 2), np.sin(angle / 2)
        z, u = cosine * self.z + sine * self.u, cosine * self.u - sine * self.z
        delta = self.road.bandwidth
        if self.road.kind == "gaussian":
            keep = np.exp(-2 * delta * angle)
            u = keep * u + np.sqrt(1 - keep**2) * noise
        else:  # in Stratonovich's calculus, on the circle, with half of the damping before and after the kick
            keep = np.exp(-delta * (1 - 1 / (2 * self.road.shape)) * angle)
            kick = np.sqrt(2 * delta * angle / self.road.shape) * noise
            u = keep * u
            u = u * np.cos(kick) + np.sqrt(np.maximum(self.square_radius - z**2 - u**2, 0)) * np.sin(kick)
            u = keep * u
        self.z, self.u = cosine * z + sine * u, cosine * u - sine * z

    def mean_squares(self, settle, measure, every=10):
        total, count = np.zeros((5, self.z.size)), 0
        for step in range(round((settle + measure) / self.step)):
            self.advance()
            if step * self.step >= settle and step % every == 0:
                slope = self.u if self.road.has_slope else 0.0
                travel, relative = self.y - self.z, self.x - self.rate * slope
                acceleration = 2 * self.damping * relative + travel
                total += np.stack([self.y, self.x, acceleration, travel, relative]) ** 2
                count += 1
        total /= count
        return total.mean(axis=1), total.std(axis=1, ddof=1) / math.sqrt(self.z.size)


@pytest.mark.statistical
@pytest.mark.parametrize("name", ["first_order", "gaussian", "multiplicative"])
def test_low_pass_noise_on_random_roads_agrees_with_an_independent_simulation(name):
    # strong noise: the speed would be negative for 8 % of the time, and is zero then
    noise, speed, damping = LowPassSpeedNoise(intensity=1.0, corner_frequency=1.0), 1.0, 0.3
    parameters = {} if name == "first_order" else {"bandwidth": 0.3}
    plant = started_plant(8192, road={"kind": name, **parameters}, speed_noise=noise, speed=speed)
    terms = finite_terms(name, "low_pass")
    found, error = driven_mean_squares(plant, damping, 20, 60, terms)
    witness = IndependentPlant(plant.task.road, noise, speed, damping, 0.025, 6000, seed=5)
    expected, its_error = (figures[terms] for figures in witness.mean_squares(20, 60))
    assert np.all(np.hypot(error, its_error) / expected < 0.01)
    assert np.all(np.abs(found - expected) < 4 * np.hypot(error, its_error))
    # the noise matters: at constant speed the figures are others
    constant = exact_mean_squares(plant.task.road, None, damping=damping, speed=speed)[terms]
    assert np.any(np.abs(found - constant) > 10 * np.hypot(error, its_error))
