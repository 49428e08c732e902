"""What the scheme makes of the car's mean squares under speed noise, exactly."""

import itertools

import numpy as np
import pytest
from plants import PLANTS, plant_name
from speed_plants import exact_mean_squares, finite_terms, started_plant
from speed_scheme import scheme_mean_squares

from roadgym import SPEED_NOISES, GaussianRoad, LowPassSpeedNoise, MultiplicativeRoad
from roadgym import compiled as rows
from roadgym.compiled import LANES
from roadgym.resolution import LARGEST_ANGLE

LINEAR_PLANTS = [plant for plant in PLANTS if plant["road"] in ("harmonic", "first_order", "gaussian")]  # known to this file


@pytest.mark.parametrize("plant", LINEAR_PLANTS, ids=plant_name)
def test_bias_falls_with_the_order_of_the_scheme(plant):
    """Fourth order without noise on the speed, second order with it, fitted to the change with each halved substep."""
    kind = plant["speed_noise"]
    noise = kind and SPEED_NOISES[kind](intensity=0.3)
    terms = finite_terms(plant["road"], kind)
    intervals = 0.1 / 2.0 ** np.arange(4)
    found = np.array(
        [
            scheme_mean_squares(plant["road"], noise, damping=0.3, speed=1.0, interval=h, modes=8, outer=16)[terms]
            for h in intervals
        ]
    )
    changes = np.abs(np.diff(found, axis=0)) / found[-1]
    orders = -np.polyfit(np.arange(3), np.log2(changes), 1)[0]
    assert np.all(orders > (3.9 if kind is None else 1.8))
    # so what is left at the finest substep is less than its last change
    if kind is None or plant["road"] == "harmonic":
        exact = exact_mean_squares(plant["road"], noise, damping=0.3, speed=1.0)[terms]
        assert np.all(np.abs(found[-1] / exact - 1) < np.maximum(changes[-1], 1e-9))


RANGE = itertools.product(("low_pass", "high_pass"), (0.2, 1.0), (0.05, 1.0, 10.0))


@pytest.mark.parametrize(("kind", "intensity", "corner"), [("white", 0.2, None), ("white", 1.0, None), *RANGE])
def test_longest_substep_holds_the_bar_for_every_noise(kind, intensity, corner):
    """sigma <= sqrt(w1) and 0.05 w1 <= w_g <= 10 w1 on the harmonic road."""
    noise = SPEED_NOISES[kind](intensity=intensity, **({} if corner is None else {"corner_frequency": corner}))
    terms = finite_terms("harmonic", kind)
    for damping, speed in ((0.1, 1.0), (0.1, 3.0), (1.0, 0.3)):
        interval = LARGEST_ANGLE / max(1.0, speed)
        found = scheme_mean_squares(
            "harmonic", noise, damping=damping, speed=speed, interval=interval, modes=20, outer=30, inner=5
        )
        exact = exact_mean_squares("harmonic", noise, damping=damping, speed=speed)
        # the bar is 0.5 %
        assert np.all(np.abs(found[terms] / exact[terms] - 1) < 1e-3)


@pytest.mark.parametrize("shape", [0.3, 0.5, 2.0])
@pytest.mark.parametrize("noise", [None, LowPassSpeedNoise(intensity=0.5, corner_frequency=2.0)])
def test_car_on_a_bounded_road_follows_it_as_on_the_gaussian_road(shape, noise):
    """The map from the ends of a substep to the car is the same, and so are the first two moments of the road: with them every
    mean square of the scheme, and its bias, is that of the Gaussian road."""
    bandwidth, interval, damping = 0.3, 0.3, np.float32(0.2)
    maps = {}
    for road in (
        GaussianRoad(bandwidth=bandwidth, noise_intensity=1.0),
        MultiplicativeRoad.from_shape(shape=shape, bandwidth=bandwidth, level_bound=1.0),
    ):
        plant = started_plant(
            LANES, road=road, speed_noise=noise, speed=1.3, control_interval=interval, substeps=1, precision="float64"
        )
        old_z, old_u = plant.row("level"), plant.row("slope")
        plant.step(np.full(LANES, damping))
        ends = np.stack([old_z, plant.row("level"), plant.row(rows.TURN) * (plant.row("slope") - old_u)], axis=1)
        car = np.stack([plant.row("displacement"), plant.row("velocity")], axis=1)
        maps[road.kind], residual, rank, _ = np.linalg.lstsq(ends, car, rcond=None)
        assert rank == 3
        assert np.all(residual < 1e-20)  # the car, at rest before, depends on nothing else
    np.testing.assert_allclose(maps["multiplicative"], maps["gaussian"], atol=1e-12)
