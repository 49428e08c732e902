"""The roads: parameters, exact laws, boundedness, and negative controls that must fail."""

import dataclasses
import json

import numpy as np
import pytest
from plants import EVERY_ROAD
from scipy import stats

from roadgym import GaussianRoad, HarmonicRoad, MultiplicativeRoad, ParameterError
from roadgym.plant import Plant
from roadgym.roads import make_road
from roadgym.roads.kicks import CELLS, direction_quantiles
from roadgym.task import make_task

LANES = 1_000_000


def road_lanes(road, *, number=LANES, level, slope, time, speed=1.0, **parameters):
    """Level and slope, in standard deviations, of lanes that all start at one point, and the largest square radius."""
    plant = Plant(make_task(road=road, speed=speed, **parameters), number)
    plant.start(np.arange(number, dtype=np.uint64))
    plant.set_row("level", level)
    plant.set_row("slope", slope)
    actions = np.full(number, 0.5, np.float32)
    largest = 0.0
    for _ in range(round(time / plant.task.control_interval)):
        plant.step(actions)
        z, u = plant.row("level").astype(float), plant.row("slope").astype(float)
        largest = max(largest, float(np.max(z**2 + u**2)))
    return z, u, largest


def radial_test(z, u, shape):
    """Kolmogorov-Smirnov test of r^2/r0^2 against its law, 1 - (1 - r^2/r0^2)^shape; (11)."""
    square = (z**2 + u**2) / (2 * (shape + 1))
    return stats.kstest(square, lambda x: 1 - np.clip(1 - x, 0, 1) ** shape)


@pytest.mark.statistical
@pytest.mark.parametrize("shape", [0.25, 0.5, 1.0, 2.0, 3.0, 10.0])
def test_bounded_road_has_its_radial_law_and_stays_in_its_circle(shape):
    bandwidth = 0.5
    road = MultiplicativeRoad.from_shape(shape=shape, bandwidth=bandwidth, level_bound=0.9)
    # ten times the time in which the road forgets, 1/(2 delta v Omega), at the largest substep that a task may have
    coarse = {"control_interval": 0.5, "substeps": 2} if shape < 0.5 else {}  # the scheme for small shapes is slow
    z, u, largest = road_lanes(road, level=0.3, slope=-0.2, time=10 / (2 * bandwidth), **coarse)
    assert largest <= 2 * (shape + 1)
    assert radial_test(z, u, shape).pvalue > 1e-3
    assert abs(np.mean(z**2) - 1) < 5 * np.std(z**2) / np.sqrt(LANES)
    assert abs(np.mean(u**2) - 1) < 5 * np.std(u**2) / np.sqrt(LANES)


@pytest.mark.statistical
@pytest.mark.parametrize("shape", [0.25, 2.0])
def test_bounded_road_starts_in_its_radial_law(shape):
    road = MultiplicativeRoad.from_shape(shape=shape)
    plant = Plant(make_task(road=road), 300_000)
    plant.start(np.arange(300_000, dtype=np.uint64))
    z, u = plant.row("level").astype(float), plant.row("slope").astype(float)
    assert np.max(z**2 + u**2) <= 2 * (shape + 1)
    assert radial_test(z, u, shape).pvalue > 1e-3


@pytest.mark.statistical
@pytest.mark.parametrize(("level_bound", "slope_bound", "shape"), [(0.5, 1.0, 1.5), (1.0, 0.6, 0.8), (1.0, 0.8, 0.4)])
def test_road_on_an_ellipse_agrees_with_euler_and_maruyama(level_bound, slope_bound, shape):
    bandwidth = 0.3
    intensity = np.sqrt(2 * bandwidth / shape) * slope_bound
    road = MultiplicativeRoad(bandwidth=bandwidth, noise_intensity=intensity, level_bound=level_bound, slope_bound=slope_bound)
    assert road.shape == pytest.approx(shape)
    generator = np.random.default_rng(4)
    lanes, h, steps = 20_000, 0.004, 6_000
    z, u = np.zeros(lanes), np.zeros(lanes)
    squares, free = np.zeros(lanes), np.zeros(lanes)
    for step in range(steps):
        clipped = np.maximum(1 - (z / level_bound) ** 2 - (u / slope_bound) ** 2, 0)
        noise = intensity * np.sqrt(clipped * h) * generator.standard_normal(lanes)
        z, u = z + h * u, u - h * (2 * bandwidth * u + z) + noise
        if step >= steps // 2:
            squares += z**2 / (steps // 2)
            free += clipped / (steps // 2)
    error = squares.std() / np.sqrt(lanes)
    combined = np.hypot(error, road.variance_standard_error)
    # Euler and Maruyama's own bias is of the order of its step
    assert abs(squares.mean() - road.variance) < 4 * combined + h * road.variance
    # the closure of the second moments, exact with the clipped noise: E Z^2 = sigma^2 E V^2 / (4 delta Omega)
    assert intensity**2 * free.mean() / (4 * bandwidth) == pytest.approx(squares.mean(), rel=0.02)
    if slope_bound > level_bound:
        formula = 1 / (1 / level_bound**2 + 1 / slope_bound**2 + 4 * bandwidth / intensity**2)  # (12), which does not hold
        assert road.variance > 1.05 * formula


def test_ellipse_refuses_what_only_a_circle_has():
    road = MultiplicativeRoad(slope_bound=0.5)
    with pytest.raises(ParameterError, match="bandwidth cannot be replaced on an ellipse"):
        road.with_bandwidth(0.2)
    assert MultiplicativeRoad(slope_bound=1.0).is_circle


@pytest.mark.statistical
def test_radial_law_holds_at_any_substep_but_a_coarse_euler_scheme_fails_it():
    shape, bandwidth = 2.0, 0.5
    road = MultiplicativeRoad.from_shape(shape=shape, bandwidth=bandwidth, level_bound=0.9)
    z, u, _ = road_lanes(road, number=400_000, level=0.3, slope=-0.2, time=15, control_interval=0.5, substeps=1)
    assert radial_test(z, u, shape).pvalue > 1e-3

    # Euler and Maruyama with the same substep, brought back to the circle where it leaves it
    generator = np.random.default_rng(3)
    z, u = np.full(400_000, 0.3), np.full(400_000, -0.2)
    square, h = 2 * (shape + 1), 0.5
    for _ in range(30):
        free = np.sqrt(np.maximum(1 - (z**2 + u**2) / square, 0))
        noise = np.sqrt(4 * bandwidth * (shape + 1) / shape * h) * free * generator.standard_normal(z.size)
        z, u = z + h * u, u - h * (2 * bandwidth * u + z) + noise
        shrink = np.minimum(1, np.sqrt(square / (z**2 + u**2)))
        z, u = z * shrink, u * shrink
    assert radial_test(z, u, shape).pvalue < 1e-6


@pytest.mark.parametrize("shape", [0.5, 0.51, 0.75, 1.0, 1.5, 2.0, 10.0, 1000.0])
def test_table_of_directions_has_the_second_moment_of_its_law(shape):
    quantiles = direction_quantiles(shape)
    assert quantiles.shape == (CELLS + 1,)
    assert np.all(np.diff(quantiles) >= 0)
    assert quantiles[-1] <= 1
    low, high = quantiles[:-1], quantiles[1:]
    second = np.mean((low**2 + low * high + high**2) / 3)
    assert second == pytest.approx(0.5 / shape, rel=5e-5)
    # the fourth moment of a coordinate of a uniform direction, 3/(2 shape (2 shape + 2)), is what the chords may miss
    fourth = np.mean(sum(low**k * high ** (4 - k) for k in range(5)) / 5)
    assert fourth == pytest.approx(3 / (2 * shape * (2 * shape + 2)), rel=1e-2)


@pytest.mark.statistical
@pytest.mark.parametrize("name", EVERY_ROAD)
@pytest.mark.parametrize("speed", [0.5, 2.0])
def test_every_road_starts_in_its_law_and_keeps_it_at_any_speed(name, speed):
    number = 200_000
    road = make_road(EVERY_ROAD[name])
    plant = Plant(make_task(road=road, speed=speed), number)
    plant.start(np.arange(number, dtype=np.uint64))
    law = {
        "harmonic": stats.arcsine(-np.sqrt(2), 2 * np.sqrt(2)),
        "multiplicative": stats.beta(2.5, 2.5, -np.sqrt(6), 2 * np.sqrt(6)),  # (1 - z^2/r0^2)^(alpha - 1/2), alpha = 2
    }.get(name, stats.norm())  # all others are Gaussian
    cdf = law.cdf if road.periodic is None else road.periodic.distribution
    for _ in range(2):
        z = plant.row("level").astype(float)
        assert stats.kstest(z, cdf).pvalue > 1e-3
        for _ in range(10):
            plant.step(np.full(number, 0.5, np.float32))


@pytest.mark.statistical
@pytest.mark.parametrize("shape", [0.3, 0.5, 2.0, None])
def test_second_order_roads_have_the_exact_autocovariance(shape):
    bandwidth, number = 0.3, 400_000
    if shape is None:
        road = GaussianRoad(bandwidth=bandwidth, noise_intensity=1.0)
    else:
        road = MultiplicativeRoad.from_shape(shape=shape, bandwidth=bandwidth, level_bound=1.0)
        number = number if shape >= 0.5 else number // 4
    plant = Plant(make_task(road=road, speed=1.0, control_interval=0.3, substeps=1), number)
    plant.start(np.arange(number, dtype=np.uint64))
    z0 = plant.row("level").astype(float)
    frequency = np.sqrt(1 - bandwidth**2)
    for lag in range(1, 6):
        plant.step(np.full(number, 0.5, np.float32))
        angle = 0.3 * lag
        exact = np.exp(-bandwidth * angle) * (np.cos(frequency * angle) + bandwidth / frequency * np.sin(frequency * angle))
        products = z0 * plant.row("level").astype(float)
        assert abs(products.mean() - exact) < 4.5 * products.std() / np.sqrt(number)


def test_variances_and_shape():
    assert GaussianRoad(bandwidth=0.1, noise_intensity=0.2, wavenumber=2.0).variance == pytest.approx(0.04 / 0.8)
    assert HarmonicRoad(amplitude=3.0).variance == pytest.approx(4.5)
    road = MultiplicativeRoad.from_shape(shape=3.0, bandwidth=0.2, level_bound=0.9, wavenumber=1.7)
    assert road.shape == pytest.approx(3.0)
    assert road.variance == pytest.approx(0.81 / 8)
    assert road.variance == pytest.approx(1 / (2 / 0.81 + 4 * 0.2 * 1.7 / road.noise_intensity**2))  # (12)


def test_the_shape_is_a_parameter_by_name():
    parameters = {"shape": 3.0, "bandwidth": 0.2, "level_bound": 0.9, "wavenumber": 1.7}
    road = make_road({"kind": "multiplicative", **parameters})
    assert road == MultiplicativeRoad.from_shape(**parameters)
    assert make_road({"kind": "multiplicative", "shape": 3.0}).shape == 3.0
    assert make_road(json.loads(json.dumps(dataclasses.asdict(road)))) == road


@pytest.mark.parametrize("name", ["gaussian", "multiplicative"])
def test_another_bandwidth_keeps_variance_and_shape(name):
    road = make_road(name)
    other = road.with_bandwidth(0.37)
    assert other.bandwidth == 0.37
    assert other.variance == pytest.approx(road.variance)
    if name == "multiplicative":
        assert other.shape == road.shape


@pytest.mark.parametrize("name", EVERY_ROAD)
def test_road_survives_being_a_mapping(name):
    road = make_road(EVERY_ROAD[name])
    assert road.kind == name
    assert make_road(dataclasses.asdict(road)) == road


@pytest.mark.parametrize(
    ("road", "message"),
    [
        ("cobblestones", "unknown road 'cobblestones'; known: harmonic, first_order, gaussian, multiplicative"),
        ({"kind": "gaussian", "bandwith": 0.1}, "unknown parameter 'bandwith' of road 'gaussian'"),
        ({"kind": "gaussian", "bandwidth": -0.1}, "bandwidth must be positive, got -0.1"),
        ({"kind": "multiplicative", "level_bound": float("nan")}, "level_bound must be finite, got nan"),
        ({"kind": "harmonic", "amplitude": "high"}, "amplitude must be a number, got 'high'"),
        ({"kind": "multiplicative", "slope_bound": 0}, "slope_bound must be positive, got 0"),
        ({"kind": "harmonic", "wavenumber": 0}, "wavenumber must be positive, got 0"),
        (
            {"kind": "multiplicative", "shpe": 1},
            "known: wavenumber, bandwidth, noise_intensity, level_bound, slope_bound, iso_class, shape",
        ),
        (
            {"kind": "multiplicative", "shape": 1, "noise_intensity": 1},
            "unknown parameter 'noise_intensity' of road 'multiplicative' beside 'shape'; known: shape, bandwidth, ",
        ),
        ({"kind": "multiplicative", "shape": 0}, "shape must be positive, got 0"),
        ({"kind": "gaussian", "shape": 1}, "unknown parameter 'shape' of road 'gaussian'"),
        (3, "road must be a name, a mapping or a Road, got 3"),
    ],
)
def test_bad_roads_are_refused_by_name(road, message):
    with pytest.raises(ParameterError, match=message.replace("(", r"\(").replace(")", r"\)")):
        make_road(road)
