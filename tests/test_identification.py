"""Identification of profiles: known roads are found within their errors, and told apart."""

import dataclasses
import math

import numpy as np
import pytest

import analysis
import roadgym
from roadgym import FirstOrderRoad, GaussianRoad, MultiplicativeRoad
from roadgym.env import QuarterCarEnv

FINER = 4  # points of a bounded road that are drawn between two that are kept, so that its higher moments are right


def profiles(road, *, spacing, points, number, finer=1):
    for seed in range(number):
        _, heights = roadgym.sample_road(road, spacing=spacing / finer, points=finer * (points - 1) + 1, seed=1000 + seed)
        yield heights[0, ::finer]


def scores_of(road, which, found):
    """How far the logarithms of the parameters are from the truth, in standard errors, shape (profiles, parameters)."""
    rows = []
    for one in found:
        road_found = getattr(one, which)
        names = list(road_found.errors)
        rows.append(
            [
                math.log(getattr(road_found.road, name) / getattr(road, name))
                * getattr(road_found.road, name)
                / road_found.errors[name]
                for name in names
            ]
        )
    return np.array(rows), names


def check(scores, *, widest=4.0, spread=0.35):
    """Mean 0, deviation 1, none far out."""
    number = len(scores)
    assert np.abs(scores.mean(axis=0)).max() < 3.5 / math.sqrt(number)
    assert np.abs(scores).max() < widest
    np.testing.assert_array_less(np.abs(scores.std(axis=0, ddof=1) - 1), spread)


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("road", "which", "spacing"),
    [
        (FirstOrderRoad.from_iso8608("C", lowest_frequency=0.03), "first_order", 0.1),
        (GaussianRoad(bandwidth=0.1), "second_order", 0.5),
        (GaussianRoad(bandwidth=1.5, wavenumber=1.0, noise_intensity=0.03), "second_order", 0.2),
    ],
)
def test_parameters_are_found_within_their_errors(road, which, spacing):
    found = [analysis.identify(heights, spacing) for heights in profiles(road, spacing=spacing, points=4001, number=30)]
    scores, names = scores_of(road, which, found)
    assert names[:2] == ["noise_intensity", "wavenumber"]
    check(scores)
    # Bartlett's test is cautious, and the right order wins but where Akaike's criterion takes one parameter too many
    assert np.mean([getattr(one, which).fit.p_value < 0.05 for one in found]) < 0.2
    kinds = [one.best.road.kind for one in found]
    assert kinds.count(road.kind) >= 0.7 * len(kinds)
    away = np.array([one.kurtosis_distance for one in found])
    assert abs(away.mean()) < 4 / math.sqrt(len(away)) + 0.2  # a short record is a little flatter
    assert 0.6 < away.std(ddof=1) < 1.35


@pytest.mark.statistical
def test_bounded_roads_are_found_within_their_errors():
    road = MultiplicativeRoad.from_shape(shape=1.5, bandwidth=0.2, wavenumber=0.8, level_bound=0.05)
    found = [analysis.identify(heights, 0.5) for heights in profiles(road, spacing=0.5, points=5001, number=20, finer=FINER)]
    assert all(one.best is one.bounded for one in found)
    assert all(one.kurtosis_distance < -3 for one in found)
    scores, names = scores_of(road, "bounded", found)
    assert names == ["noise_intensity", "wavenumber", "bandwidth", "level_bound", "shape"]
    check(scores, spread=0.45)
    for one in found:  # the linear twin has the same spectrum
        twin = one.second_order.road
        assert twin.variance == pytest.approx(one.bounded.road.variance, rel=1e-9)
        assert one.largest < 0.05 * 1.05
        assert abs(one.bounded.road.level_bound / one.largest - 1) < 0.3


def test_the_orders_are_told_apart():
    smooth = next(profiles(GaussianRoad(bandwidth=0.3), spacing=0.3, points=4000, number=1))
    rough = next(profiles(FirstOrderRoad(), spacing=0.3, points=4000, number=1))
    found = analysis.identify(smooth, 0.3)
    assert found.best is found.second_order
    assert found.first_order.fit.p_value < 1e-6
    assert found.second_order.fit.p_value > 0.01
    assert found.corners is None
    assert found.first_order.fit.information_criterion > found.second_order.fit.information_criterion + 100
    found = analysis.identify(rough, 0.3)
    assert found.first_order.fit.p_value > 0.01
    assert found.first_order.fit.information_criterion < found.second_order.fit.information_criterion + 1


def test_one_corner_alone_is_known_where_the_profile_holds_no_more():
    """Of class C between 0.0001 and 0.4 cycles/m over half a kilometre: the upper corner is known, Omega and delta are not."""
    road = GaussianRoad.from_iso8608("C", lowest_frequency=1e-4, highest_frequency=0.4)
    found = analysis.identify(next(profiles(road, spacing=0.25, points=2000, number=1)), 0.25)
    (_, unsure), (upper, error) = found.corners
    assert unsure > 4 * error
    assert error < 0.15
    assert abs(math.log(upper / 0.4)) < 3.5 * error
    assert found.second_order.errors["bandwidth"] / found.second_order.road.bandwidth > 2 * error


def test_a_unit_of_height_changes_heights_alone():
    heights = next(profiles(GaussianRoad(bandwidth=0.3), spacing=0.3, points=2000, number=1))
    one, other = analysis.identify(heights, 0.3), analysis.identify(1e-3 * heights + 50.0, 0.3)
    expected = dataclasses.replace(one.second_order.road, noise_intensity=1e-3 * one.second_order.road.noise_intensity)
    for name in ("noise_intensity", "wavenumber", "bandwidth"):
        assert getattr(other.second_order.road, name) == pytest.approx(getattr(expected, name), rel=1e-3)
    assert other.kurtosis == pytest.approx(one.kurtosis, rel=1e-6)


def test_what_is_found_can_be_driven():
    heights = next(profiles(GaussianRoad(bandwidth=0.3), spacing=0.3, points=2000, number=1))
    road = analysis.identify(heights, 0.3).best.road
    env = QuarterCarEnv(road=road, speed=1.0)
    env.reset(seed=1)
    assert math.isfinite(env.step(np.array([0.3], np.float32))[1])
