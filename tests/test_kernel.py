"""The stepping kernel: what a control interval adds up, what it draws, and that nothing unsound leaves it."""

import numpy as np
import pytest
from scipy.linalg import expm

import roadgym
from roadgym.compiled import LANES
from roadgym.parameters import PlantError
from roadgym.plant import Plant
from roadgym.record import COUNTERS, STEP, interval_weights
from roadgym.task import make_task


def started_plant(number, seed=0, **parameters):
    plant = Plant(make_task(**parameters), number, threads=1)
    plant.start(np.arange(seed, seed + number, dtype=np.uint64))
    return plant


@pytest.mark.parametrize("substeps", [1, 2, 3, 4, 5, 6, 17])
def test_weights_integrate_cubics_exactly(substeps):
    weights = interval_weights(substeps)
    assert np.all(weights > 0)
    for power in range(4 if substeps > 1 else 2):
        assert weights @ np.linspace(0, 1, substeps + 1) ** power == pytest.approx(1 / (power + 1), rel=1e-13)


@pytest.mark.parametrize("speed", [0.3, 1.0, 3.0])
def test_mean_squares_are_those_of_the_integral_where_the_damping_switches(speed):
    """Without noise the answer is known: the harmonic road and the car are one linear system between two switches."""
    interval, steps = 0.2, 40
    plant = started_plant(1, road="harmonic", speed=speed, precision="float64", control_interval=interval)
    signals = np.array([row[0] for row in (plant.row(name) for name in ("displacement", "velocity", "level", "slope"))])
    measured, exact = np.zeros(5), np.zeros(5)
    for step in range(steps):
        damping = float(np.float32(1.0 if step % 2 else 0.05))
        measured += plant.step(np.array([damping], np.float32)).mean_squares[:, 0]
        drift = np.array([[0, 1, 0, 0], [-1, -2 * damping, 1, 2 * damping * speed], [0, 0, 0, speed], [0, 0, -speed, 0]])
        relative, travel = np.array([0, 1, 0, -speed]), np.array([1, 0, -1, 0])
        outputs = np.stack([[1, 0, 0, 0], [0, 1, 0, 0], 2 * damping * relative + travel, travel, relative])
        fine = 400
        transition, paths = expm(drift * interval / fine), [signals]
        for _ in range(fine):
            paths.append(transition @ paths[-1])
        signals = paths[-1]
        exact += interval_weights(fine) @ (np.array(paths) @ outputs.T) ** 2
    # a substep of 0.1 rad has an error of its fourth power over 180, times sixteen where all frequencies are doubled by squares
    np.testing.assert_allclose(measured, exact, rtol=2e-4)


def polynomial_moments(start, time, bandwidth, shape):
    """E Z^2, Z U, U^2, Z^4, U^4 of the bounded road of unit variance after ``time``; its generator keeps the degree."""
    powers = [(i, k) for i in range(5) for k in range(5 - i)]
    place = {power: n for n, power in enumerate(powers)}
    generator = np.zeros((len(powers), len(powers)))

    def add(row, power, factor):
        if factor:
            generator[row, place[power]] += factor

    for row, (i, k) in enumerate(powers):
        add(row, (i - 1, k + 1), i)
        add(row, (i + 1, k - 1), -k)
        add(row, (i, k), -2 * bandwidth * k)
        noise = 2 * bandwidth * k * (k - 1)
        add(row, (i, k - 2), noise * (1 + 1 / shape))
        add(row, (i + 2, k - 2), -noise / (2 * shape))
        add(row, (i, k), -noise / (2 * shape))
    now = np.array([start[0] ** i * start[1] ** k for i, k in powers])
    later = expm(generator * time) @ now
    return [later[place[power]] for power in ((2, 0), (1, 1), (0, 2), (4, 0), (0, 4))]


@pytest.mark.statistical
@pytest.mark.parametrize("shape", [0.3, 0.5, 0.7, 2.0, 10.0])
def test_moments_of_second_and_fourth_degree_relax_as_they_should(shape):
    """A feedback sees them, not only the stationary law; with steps of one size they relaxed up to a quarter too fast."""
    bandwidth, time, number = 0.45, 0.8, 400_000 if shape >= 0.5 else 40_000
    road = roadgym.MultiplicativeRoad.from_shape(shape=shape, bandwidth=bandwidth)
    plant = started_plant(number, road=road, speed=1.0, control_interval=0.2)
    start = np.array([0.6, -0.8]) * np.sqrt(2 * (shape + 1) * 0.8)
    plant.set_row("level", start[0])
    plant.set_row("slope", start[1])
    for _ in range(round(time / 0.2)):
        plant.step(np.full(number, 0.5, np.float32))
    z, u = plant.row("level").astype(float), plant.row("slope").astype(float)
    for found, exact in zip((z * z, z * u, u * u, z**4, u**4), polynomial_moments(start, time, bandwidth, shape), strict=True):
        assert abs(found.mean() - exact) < 4.5 * found.std() / np.sqrt(number)


def test_lanes_that_fill_the_block_meet_new_noise_at_every_step():
    plant = started_plant(3)
    for _ in range(5):
        plant.step(np.full(3, 0.3, np.float32))
    assert set(plant._counters.reshape(-1, COUNTERS)[0, STEP : STEP + LANES].tolist()) == {5}


def test_a_car_that_noise_stops_drives_on():
    """On a bounded road of small shape a car that stands still once took the kernel into an endless loop."""
    noise = roadgym.LowPassSpeedNoise(intensity=3.0)
    plant = started_plant(4, road=roadgym.MultiplicativeRoad.from_shape(shape=0.3), speed_noise=noise, speed=0.3)
    for _ in range(30):
        interval = plant.step(np.full(4, 0.3, np.float32))
    assert np.isfinite(interval.observations).all()


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("row", ["displacement", "velocity", "level", "slope"])
@pytest.mark.parametrize("unsound", [np.nan, np.inf])
def test_what_is_not_finite_raises_and_a_reset_heals(threads, row, unsound):
    number = 64 * 64 if threads > 1 else 70
    plant = Plant(make_task(road="gaussian"), number, threads=threads)
    plant.start(np.arange(number, dtype=np.uint64))
    values = plant.row(row)
    values[67] = unsound
    plant.set_row(row, values)
    with pytest.raises(PlantError, match=f"environment 67 of {number} "):
        plant.step(np.full(number, 0.3, np.float32))
    plant.start(np.arange(number, dtype=np.uint64))
    plant.step(np.full(number, 0.3, np.float32))
