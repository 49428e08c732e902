import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

import analysis
from roadgym.cars import MEAN_SQUARES
from roadgym.parameters import ParameterError
from roadgym.roads import FirstOrderRoad, GaussianRoad, HarmonicRoad, MultiplicativeRoad
from roadgym.speed import HighPassSpeedNoise, LowPassSpeedNoise, WhiteSpeedNoise


def cost(road, noise, weights, damping, **arguments) -> np.ndarray:
    result = dict(analysis.mean_squares(road, noise, damping=damping, **arguments))
    return sum(weight * result[name] for name, weight in weights.items()) / road.variance


def test_first_order_road_has_a_closed_form() -> None:
    speed = np.array([0.4, 1.0, 3.0, 10.0])
    best = analysis.optimal_damping(FirstOrderRoad(wavenumber=2.0), speed=speed / 2, bounds=(0.01, 10))
    np.testing.assert_allclose(best.damping, (1 + np.sqrt(2 + speed**2)) / (2 * speed), rtol=1e-6)


@pytest.mark.parametrize("road", [HarmonicRoad(), GaussianRoad(bandwidth=0.2), MultiplicativeRoad()])
def test_below_root_two_the_largest_damping_is_best(road) -> None:
    best = analysis.optimal_damping(road, speed=[0.3, 1.0, 1.4], bounds=(0.05, 3.0))
    assert best.damping.tolist() == [3.0] * 3  # exactly the bound


def test_above_root_two_the_smallest_damping_is_best_on_the_harmonic_road() -> None:
    best = analysis.optimal_damping("harmonic", speed=[1.42, 3.0], bounds=(0.05, 3.0))
    assert best.damping.tolist() == [0.05] * 2
    assert best.cost[1] == pytest.approx((1 + 0.3**2) / (8**2 + 0.3**2))


@settings(deadline=None, derandomize=True, max_examples=40)
@given(
    speed=st.floats(0.05, 8),
    bandwidth=st.floats(0.01, 2),
    weights=st.dictionaries(st.sampled_from(MEAN_SQUARES), st.floats(0.01, 10), min_size=1),
    low=st.floats(0.01, 1),
    width=st.floats(1, 100),
)
def test_it_is_the_global_minimum(speed: float, bandwidth: float, weights: dict, low: float, width: float) -> None:
    road = GaussianRoad(bandwidth=bandwidth)
    bounds = (low, low * width)
    best = analysis.optimal_damping(road, speed=speed, weights=weights, bounds=bounds)
    assert bounds[0] <= best.damping <= bounds[1]
    assert float(best.cost) == pytest.approx(float(cost(road, None, weights, best.damping, speed=speed)), rel=1e-14)
    dense = cost(road, None, weights, np.geomspace(*bounds, 2001), speed=speed)
    assert best.cost <= dense.min() * (1 + 1e-13)
    refined = minimize_scalar(
        lambda d: float(cost(road, None, weights, d, speed=speed)), bounds=bounds, method="bounded", options={"xatol": 1e-10}
    )
    assert best.cost <= refined.fun * (1 + 1e-13)


@pytest.mark.parametrize(
    "noise", [WhiteSpeedNoise(intensity=0.8), LowPassSpeedNoise(intensity=0.8), HighPassSpeedNoise(intensity=0.8)]
)
def test_speed_noise(noise) -> None:
    road, weights = HarmonicRoad(wavenumber=1.5), {"displacement": 1.0, "travel": 0.5}
    speed = np.array([0.3, 1.0, 2.0])
    best = analysis.optimal_damping(road, noise, speed=speed, weights=weights, natural_frequency=1.2)
    dense = cost(road, noise, weights, np.geomspace(0.05, 1, 500)[:, np.newaxis], speed=speed, natural_frequency=1.2)
    assert np.all(best.cost <= dense.min(axis=0) * (1 + 1e-13))
    np.testing.assert_allclose(best.cost, dense.min(axis=0), rtol=1e-4)


def test_shapes_broadcast_and_bandwidth_overrides() -> None:
    road = MultiplicativeRoad()
    speed, bandwidth = np.array([[1.0], [3.0]]), np.array([0.1, 0.3, 1.0])
    best = analysis.optimal_damping(road, speed=speed, bandwidth=bandwidth)
    assert best.damping.shape == best.cost.shape == (2, 3)
    for i, j in np.ndindex(2, 3):
        alone = analysis.optimal_damping(road.with_bandwidth(bandwidth[j]), speed=speed[i, 0])
        assert isinstance(alone.damping, np.float64)
        assert best.cost[i, j] == pytest.approx(alone.cost, rel=1e-12)


def test_a_fixed_damping_and_a_flat_cost() -> None:
    fixed = analysis.optimal_damping("gaussian", speed=3.0, bounds=(0.3, 0.3))
    assert fixed.damping == 0.3
    standing = analysis.optimal_damping("gaussian", speed=0.0, bounds=(0.2, 0.3))
    assert (standing.damping, standing.cost) == (0.2, 1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"road": "first_order", "weights": {"acceleration": 1.0}}, "acceleration is infinite on a first_order road"),
        ({"road": "harmonic", "speed_noise": "white", "weights": {"relative_velocity": 1.0}}, "infinite on white speed noise"),
        ({"road": "gaussian", "weights": {"comfort": 1.0}}, "unknown reward term 'comfort'"),
        ({"road": "gaussian", "weights": {}}, "at least one positive weight"),
        ({"road": "gaussian", "bounds": (0.0, 1.0)}, "bounds, low end, must be positive"),
        ({"road": "gaussian", "bounds": (1.0, 0.5)}, "low <= high"),
        ({"road": "gaussian", "bounds": (0.1, math.inf)}, "bounds, high end, must be finite"),
        ({"road": "gaussian", "speed": -1.0}, "speed must be zero or above"),
        ({"road": "gaussian", "speed_noise": "low_pass", "relative_error": -1.0}, "relative_error must be positive"),
        ({"road": "harmonic", "bandwidth": 0.2}, "bandwidth must be None"),
    ],
)
def test_bad_input_is_named(arguments: dict, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        analysis.optimal_damping(**{"speed": 1.0, **arguments})
