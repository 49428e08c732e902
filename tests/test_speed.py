"""Speed noise: the law of the angle."""

import dataclasses
import math

import numpy as np
import pytest
from scipy import stats
from speed_plants import phase_variance, started_plant

from roadgym import SPEED_NOISES, HarmonicRoad, HighPassSpeedNoise, LowPassSpeedNoise, ParameterError, WhiteSpeedNoise
from roadgym import speed as speed_module
from roadgym.speed import make_speed_noise
from roadgym.task import make_task

HARMONIC = HarmonicRoad()


def noise_law(noise, interval, natural_frequency=1.0):
    """(pull of Psi, covariance) of (Psi, angle, area) after a substep, from the table that the kernel reads."""
    table = noise.table(interval, natural_frequency, make_task(road="harmonic").road)
    factor = np.zeros((3, 3))
    factor[np.tril_indices(3)] = table[speed_module.FACTOR : speed_module.FACTOR + 6]
    return table[speed_module.PULL : speed_module.PULL + 3], factor @ factor.T, table[speed_module.SPREAD] ** 2


NOISES = [
    WhiteSpeedNoise(intensity=0.4),
    *(
        kind(intensity=0.4, corner_frequency=corner)
        for kind in (LowPassSpeedNoise, HighPassSpeedNoise)
        for corner in (0.01, 1.0, 30.0)
    ),
]


@pytest.mark.parametrize("noise", NOISES, ids=str)
@pytest.mark.parametrize("interval", [0.02, 0.1, 0.5])
def test_angle_of_a_substep_has_the_variance_of_its_equation(noise, interval):
    pull, covariance, stationary = noise_law(noise, interval)
    assert pull[1] ** 2 * stationary + covariance[1, 1] == pytest.approx(phase_variance(noise, interval), rel=1e-7)
    if noise.kind != "white":
        assert stationary == pytest.approx(noise.intensity**2 / (2 * noise.corner_frequency))
        assert pull[0] ** 2 * stationary + covariance[0, 0] == pytest.approx(stationary)


@pytest.mark.parametrize("noise", NOISES, ids=str)
def test_two_substeps_have_the_law_of_one_of_twice_the_length(noise):
    pull, covariance, _ = noise_law(noise, 0.05)
    # (Psi, angle, area) over a substep as a linear map of the same three at its start, the angle and the area adding up
    step = np.array([[pull[0], 0, 0], [pull[1], 1, 0], [pull[2], 0.05, 1]])
    twice, whole, _ = noise_law(noise, 0.1)
    np.testing.assert_allclose((step @ step)[:, 0], twice, rtol=1e-12)
    np.testing.assert_allclose(step @ covariance @ step.T + covariance, whole, rtol=1e-7, atol=1e-14)


def test_table_knows_the_natural_frequency():
    noise = LowPassSpeedNoise(intensity=0.4, corner_frequency=2.0)
    fast = LowPassSpeedNoise(intensity=0.4 * math.sqrt(8), corner_frequency=16.0)  # all rates times 8
    for slow_part, fast_part in zip(noise_law(noise, 0.1), noise_law(fast, 0.1, 8.0), strict=True):
        np.testing.assert_allclose(slow_part, fast_part, rtol=1e-12)


@pytest.mark.statistical
@pytest.mark.parametrize("name", list(SPEED_NOISES))
def test_driven_phase_has_its_law(name):
    """After many substeps the phase is Gaussian, with the mean and the variance of the equation."""
    number, intervals = 50_000, 25
    noise = SPEED_NOISES[name](intensity=0.3)
    plant = started_plant(number, road="harmonic", speed_noise=noise, speed=1.0, precision="float64")
    first = np.arctan2(-plant.row("slope"), plant.row("level"))
    for _ in range(intervals):
        plant.step(np.full(number, 0.5, np.float32))
    time = intervals * plant.task.control_interval
    last = np.arctan2(-plant.row("slope"), plant.row("level"))
    turned = (last - first - time + math.pi) % (2 * math.pi) - math.pi
    assert stats.kstest(turned, stats.norm(scale=math.sqrt(phase_variance(noise, time))).cdf).pvalue > 1e-3


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        ("pink", "unknown speed noise 'pink'; known: white, low_pass, high_pass"),
        ({"kind": "white", "intensity": 0}, "intensity must be positive, got 0"),
        ({"kind": "low_pass", "corner_frequency": -1.0}, "corner_frequency must be positive, got -1.0"),
        ({"kind": "high_pass", "corner_frequency": float("inf")}, "corner_frequency must be finite, got inf"),
        ({"kind": "white", "corner_frequency": 1.0}, "unknown parameter 'corner_frequency' of speed noise 'white'"),
        (0.2, "speed noise must be a name, a mapping or a SpeedNoise, got 0.2"),
    ],
)
def test_bad_noises_are_refused_by_name(noise, message):
    with pytest.raises(ParameterError, match=message):
        make_speed_noise(noise, make_task(road="harmonic").road)


@pytest.mark.parametrize("name", ["white", "high_pass"])
@pytest.mark.parametrize("road", ["first_order", "gaussian", "multiplicative"])
def test_rough_noise_is_refused_on_random_roads(road, name):
    with pytest.raises(ParameterError, match=f"{name} speed noise is defined on the harmonic road only"):
        make_task(road=road, speed_noise=name)


@pytest.mark.parametrize("name", list(SPEED_NOISES))
def test_noise_survives_being_a_mapping(name):
    noise = SPEED_NOISES[name](intensity=0.3)
    assert noise.kind == name
    assert make_speed_noise(dataclasses.asdict(noise), make_task(road="harmonic").road) == noise
    assert make_speed_noise("none", make_task(road="harmonic").road) is None


@pytest.mark.parametrize("name", list(SPEED_NOISES))
@pytest.mark.parametrize("corner", [10.0, 300.0, 3000.0])
def test_table_holds_for_any_corner(name, corner):
    """The variance of the angle a substep against its closed form, also where the filter is much faster than the substep."""
    interval = 0.1
    noise = SPEED_NOISES[name](intensity=0.5, **({} if name == "white" else {"corner_frequency": corner}))
    table = noise.table(interval, 1.0, HARMONIC)
    psi, angle = speed_module.FACTOR, slice(speed_module.FACTOR + 1, speed_module.FACTOR + 3)
    spread = table[speed_module.SPREAD]
    # given Psi at the start the angle has the pull times Psi and the factor times normals
    variance = (table[speed_module.PULL + 1] * spread) ** 2 + np.sum(table[angle] ** 2)
    assert variance == pytest.approx(phase_variance(noise, interval), rel=1e-6)
    if name != "white":
        assert table[psi] ** 2 + (table[speed_module.PULL] * spread) ** 2 == pytest.approx(spread**2, rel=1e-6)
