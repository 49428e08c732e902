"""Lower bounds by information relaxation: closed forms, what is driven, and values and penalties that are wrong."""

import dataclasses
import functools
import math

import numpy as np
import pytest

import analysis
import roadgym
from agents.theory import theoretical_cost
from analysis.bounds import METHODS, STATISTICAL, information_relaxation
from analysis.bounds.information_relaxation import Relaxation, standard_error
from analysis.bounds.relaxation.expansion import DEGREES, LineExpansion
from analysis.bounds.relaxation.moments import NoisePolynomials, RoadMoments
from analysis.feedback import Model, search
from analysis.feedback.road_grid import grid_of
from roadgym.parameters import ParameterError
from roadgym.plant import Plant
from roadgym.task import make_task

RATIO, INTERVAL, RANGE = 1.5, 0.2, (0.1, 1.0)


def task_of(road="multiplicative", damping_range=RANGE, speed=RATIO, reward=None, **changes):
    road = roadgym.roads.make_road(road)
    return make_task(
        road=road,
        speed=speed,
        damping_range=damping_range,
        reward=reward or {"displacement": 1.0},
        observation=grid_of(road).state,
        observe_operating_point=False,
        control_interval=INTERVAL,
        **changes,
    )


@functools.cache
def feedback_of(road, damping_range, speed):
    task = task_of(road, damping_range, speed)
    return analysis.optimal_feedback(
        task.road, speed=speed, bounds=damping_range, control_interval=INTERVAL, refinements=1, precision=0.02, threads=1
    )


@pytest.fixture(scope="module")
def small():
    """A relaxation that takes seconds; kept, but for its ``__wrapped__``."""

    @functools.cache
    def relaxed(road="multiplicative", damping_range=RANGE, speed=RATIO):
        feedback = feedback_of(road, damping_range, speed)
        return Relaxation(task_of(road, damping_range, speed), feedback, 1.0, 30, 3, 1, lambda done: None)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "CARS", 512)
        patch.setattr(information_relaxation, "CARS", 512)
        patch.setattr(information_relaxation, "VALUE_LEVEL", 0)
        patch.setattr(information_relaxation, "ROWS", 36)
        patch.setattr(information_relaxation, "LEVELS", 9)
        patch.setattr(information_relaxation, "LEAST", 16)
        yield relaxed


# ---------------------------------------------------------------------- moments of the road


@pytest.mark.parametrize("road", [roadgym.GaussianRoad(bandwidth=0.3), roadgym.MultiplicativeRoad.from_shape(shape=2.0)])
def test_stationary_moments_stay_as_they_are(road):
    """A quadrature of the stationary law, (11) of Wedig (2020) or Gaussian, is carried over an interval."""
    moments = RoadMoments(road.shaping_filter(), RATIO, INTERVAL, 8)
    if road.shaping_filter().flatness:  # 1 - r^2/r0^2 = W^(1/alpha), W uniform: a Jacobi weight in r^2/r0^2
        from scipy.special import roots_jacobi

        places, weights = roots_jacobi(10, road.shape - 1, 0)
        squares = (1 + places) / 2 * 2 * (road.shape + 1)
    else:
        from scipy.special import roots_laguerre

        places, weights = roots_laguerre(10)
        squares = 2 * places
    angles = 2 * np.pi * np.arange(16) / 16
    radii = np.sqrt(squares)[:, None]
    states = np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=-1).reshape(-1, 2)
    chance = np.repeat(weights / weights.sum() / 16, 16)
    before = np.stack([np.prod(states**exponents, axis=1) for exponents in moments.exponents])
    mean, central = moments.central(states)
    for exponents, stationary in zip(moments.exponents, before @ chance, strict=True):
        after = 0.0
        for i in range(exponents[0] + 1):
            for k in range(exponents[1] + 1):
                ways = math.comb(exponents[0], i) * math.comb(exponents[1], k)
                after += ways * central[i, k] * mean[:, 0] ** (exponents[0] - i) * mean[:, 1] ** (exponents[1] - k)
        assert chance @ after == pytest.approx(stationary, rel=1e-9, abs=1e-9)


def test_conditional_moments_of_a_gaussian_road_are_gaussian():
    road = roadgym.GaussianRoad(bandwidth=0.3)
    _, central = RoadMoments(road.shaping_filter(), RATIO, INTERVAL, 4).central(np.array([[0.3, -0.7], [2.0, 1.0]]))
    assert central[0, 4] == pytest.approx(3 * central[0, 2] ** 2, rel=1e-9)
    assert central[2, 2] == pytest.approx(central[2, 0] * central[0, 2] + 2 * central[1, 1] ** 2, rel=1e-9)
    assert central[0, 3] == pytest.approx(0, abs=1e-12)


def worst_mean(road, interval, roads):
    """Largest |z| of mean penalties on driven roads, if the moments were those of ``interval``."""
    task = task_of(road, substeps=9)
    plant = Plant(task, roads, threads=1)
    before = plant.start(np.arange(roads, dtype=np.uint64)).observations[:, 2:].astype(float)
    after = plant.step(np.ones(roads, np.float32)).observations[:, 2:].astype(float)
    moments = RoadMoments(task.road.shaping_filter(), RATIO, interval, sum(DEGREES))
    _, offset, factor = NoisePolynomials(moments, *DEGREES)(before, after)
    worst = 0.0
    for i, k in ((0, 1), (1, 0), (0, 2), (1, 1), (2, 0), (0, 4), (2, 2)):  # w that is a monomial, times any predictable factor
        penalty = (factor * offset[:, :, 0] ** i * offset[:, :, 1] ** k).sum(axis=1)
        for weight in (1.0, before[:, 0], before[:, 0] ** 2, before[:, 1] ** 2):
            worst = max(worst, abs((weight * penalty).mean()) / (weight * penalty).std() * math.sqrt(len(before)))
    return worst


@pytest.mark.statistical
@pytest.mark.parametrize("road", ["gaussian", "multiplicative"])
def test_penalties_have_mean_zero_and_biased_ones_have_not(road):
    assert worst_mean(road, INTERVAL, 65536) < 4.5
    assert worst_mean(road, 0.9 * INTERVAL, 8192) > 20


def test_the_points_of_the_noise_reproduce_polynomials():
    """Lagrange's polynomials at the road that came, less their means: those of any polynomial of the degrees are exact."""
    road = roadgym.MultiplicativeRoad.from_shape(shape=2.0)
    moments = RoadMoments(road.shaping_filter(), RATIO, INTERVAL, sum(DEGREES))
    before, after = np.array([[0.4, 0.9]]), np.array([[0.7, 0.5]])
    mean, offset, factor = NoisePolynomials(moments, *DEGREES)(before, after)
    _, central = moments.central(before)
    came = (after - mean)[0]
    for i, k in ((1, 0), (0, 1), (2, 0), (1, 1), (0, 4), (2, 4)):
        found = factor[0] @ (offset[0, :, 0] ** i * offset[0, :, 1] ** k)
        assert found == pytest.approx(came[0] ** i * came[1] ** k - central[i, k][0], rel=1e-6, abs=1e-9)


def penalties_on_a_line(ratio):
    """(level before, the car's noise, gains, expansion) of driven roads, if the expansion were that of a frequency ratio."""
    task, dampings, lanes = task_of("first_order", substeps=6), (0.1, 1.0), 16384
    model = Model(task)
    parts, noise = [model.part(damping) for damping in dampings], []
    for damping, part in zip(dampings, parts, strict=True):
        plant = Plant(task, lanes, threads=1)
        ends = [plant.start(np.arange(lanes, dtype=np.uint64)).observations.astype(float)]
        ends.append(plant.step(np.full(lanes, damping, np.float32)).observations.astype(float))
        for end in ends:
            end[:, :2] -= model.follows * end[:, 2:]
        before, after = (end[:, 2:] for end in ends)
        noise.append(ends[1][:, :2] - ends[0] @ part.transition[:2].T)
    gains = np.array([part.gain for part in parts])
    scaled = dataclasses.replace(task, speed=(ratio, ratio))
    found = LineExpansion(scaled, gains)(before, after, np.stack(noise, axis=1))
    return before[:, 0], np.stack(noise, axis=1), gains, found


@pytest.mark.statistical
def test_on_a_first_order_road_penalties_have_mean_zero_at_each_damping_and_follow_any_function():
    def worst(before, found):
        first, second = found.offset[0].T
        largest = 0.0
        for function in (np.abs(first - 0.2), first * second, np.maximum(second, 0) ** 2, np.sin(4 * first)):
            for weight in (1.0, before**2):
                penalty = weight * (found.factor @ function).T
                largest = max(largest, np.max(np.abs(penalty.mean(axis=1)) / penalty.std(axis=1)) * math.sqrt(len(before)))
        return largest

    before, noise, gains, found = penalties_on_a_line(RATIO)
    assert worst(before, found) < 4.5
    assert worst(before, penalties_on_a_line(0.8 * RATIO)[-1]) > 9
    # a function of noise of road and car of which a rule with the exact law knows the mean
    follows, own = gains[1].T
    nodes, weights = np.polynomial.hermite_e.hermegauss(60)
    weights = weights / weights.sum()
    deviation = math.sqrt(-math.expm1(-2 * RATIO * INTERVAL))

    def bent(added):
        return np.sin(2 * added[..., 1]) + added[..., 1] * added[..., 0]

    mean = weights @ bent(deviation * nodes[:, None, None] * follows + nodes[:, None] * own) @ weights
    values = bent(found.offset[0] @ gains[1].T)
    exact = bent(noise[:, 1]) - mean
    assert np.std(found.factor[:, 1] @ values - exact) < 0.02 * np.std(exact)
    assert np.abs(found.rest[:, 1]).max() < 0.02


# ---------------------------------------------------------------------- the bound


@pytest.mark.statistical
@pytest.mark.parametrize("road", ["gaussian", "multiplicative", "first_order"])
def test_with_one_damping_it_is_the_closed_form(small, road):
    found = small(road, (0.3, 0.3001))
    task = task_of(road)
    exact = theoretical_cost(task, 0.3, RATIO, task.bandwidth[0])
    assert found.cost <= exact + 4 * found.standard_error
    assert found.cost == pytest.approx(exact, rel=0.02)
    assert found.standard_error < 0.01 * exact


@pytest.mark.statistical
@pytest.mark.parametrize("road", ["gaussian", "multiplicative", "first_order"])
def test_it_lies_just_below_the_best_feedback(small, road):
    found = small(road)
    assert found.driven == pytest.approx(feedback_of(road, RANGE, RATIO).cost, rel=0.05)
    assert found.cost < found.driven + 3 * found.standard_error
    assert found.cost > 0.8 * found.driven
    coarse = 0.1 if road == "first_order" else 0.05  # one that is told the road does better on each, but for a coarse grid
    assert np.all(found.gaps < coarse * found.driven)
    assert found.charge >= 0
    assert found.standard_error < 0.1 * found.driven


@pytest.mark.statistical
def test_with_a_wrong_value_it_is_lower_and_still_a_bound(small, monkeypatch):
    right, tabulate = small(), information_relaxation.tabulate

    def wrong(*arguments):
        value, *others = tabulate(*arguments)
        return np.zeros_like(value), *others

    monkeypatch.setattr(information_relaxation, "tabulate", wrong)
    found = small.__wrapped__()
    assert found.cost < right.cost - 3 * found.standard_error


@pytest.mark.statistical
def test_a_biased_penalty_is_caught(small, monkeypatch):
    """With penalties whose mean is not zero the feedback's bracket no longer has the mean that its cost says."""
    central = RoadMoments.central

    def biased(self, states):
        mean, found = central(self, states)
        return mean, {exponents: 0.7 * moment if sum(exponents) == 2 else moment for exponents, moment in found.items()}

    right = small()
    assert abs(right.bracket.mean() - right.driven) < 4.5 * math.hypot(standard_error(right.bracket), right.driven_error)
    monkeypatch.setattr(RoadMoments, "central", biased)
    found = small.__wrapped__()
    assert abs(found.bracket.mean() - found.driven) > 6 * math.hypot(standard_error(found.bracket), found.driven_error)


@pytest.mark.parametrize("road", [roadgym.GaussianRoad(bandwidth=0.1), roadgym.MultiplicativeRoad.from_shape(shape=2.0)])
def test_penalties_are_not_lost_to_rounding(road):
    """From the centre to the edge, polynomials of no noise less their means stay of the order of 1.

    Where the moments have lost their digits, the means are anything.
    """
    reach = math.sqrt(2 * (1 / road.shaping_filter().flatness + 1)) if road.shaping_filter().flatness else 4.0
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    radii = reach * np.array([0.0, 0.3, 0.9, 0.99, 0.999])[:, None]
    before = np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=-1).reshape(-1, 2)
    for ratio in (0.5, 3.0):
        moments = RoadMoments(road.shaping_filter(), ratio, INTERVAL, sum(DEGREES))
        mean, _ = moments.central(before)
        _, _, factor = NoisePolynomials(moments, *DEGREES)(before, mean)
        assert np.abs(factor).max() < 10


def test_penalties_are_smaller_in_tails_where_these_are_met():
    """On a bounded road the noise has tails near the edge, of which single intervals would decide the bound."""
    road = roadgym.MultiplicativeRoad.from_shape(shape=2.0, bandwidth=0.1).shaping_filter()
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    reach = math.sqrt(2 * (1 / road.flatness + 1))
    before = 0.92 * reach * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    moments = RoadMoments(road, 3.0, INTERVAL, sum(DEGREES))
    mean, central = moments.central(before)
    far = 5.5 / np.sqrt(central[0, 2])[:, None] * np.stack([central[1, 1], central[0, 2]], axis=-1)
    size = np.abs(NoisePolynomials(moments, *DEGREES)(before, mean + far)[2]).sum(axis=1)
    tails = central[0, 10] / (945 * central[0, 2] ** 5)
    assert size[tails > 10].max() < 0.25 * size[tails < 2].min()


def test_results_do_not_depend_on_threads(small):
    task, feedback = task_of(), feedback_of("multiplicative", RANGE, RATIO)
    found = [Relaxation(task, feedback, 0.2, 10, 0, threads, lambda done: None) for threads in (1, 2)]
    assert found[0].cost == found[1].cost


def test_the_method_at_an_operating_point_of_a_task_with_ranges(small, monkeypatch, tmp_path):
    quick = functools.partial(analysis.optimal_feedback, refinements=1, precision=0.02)
    monkeypatch.setattr(information_relaxation, "optimal_feedback", quick)
    task = make_task(road="gaussian", speed=(1.0, 2.0), bandwidth=(0.05, 0.3), damping_range=RANGE)
    told = []
    found = information_relaxation.bound(
        task,
        1.5,
        0.1,
        precision=0.5,
        intervals=20,
        cache=tmp_path,
        threads=1,
        report=lambda done, total: told.append((done, total)),
    )
    assert (found.method, found.rigour) == ("information_relaxation", STATISTICAL)
    assert 0 < found.standard_error < found.cost
    assert told == sorted(told)
    assert told[-1] == (100, 100)
    assert METHODS["information_relaxation"].bound is information_relaxation.bound


@pytest.mark.parametrize(
    ("plant", "reason"),
    [
        ({"road": "two_corner"}, "a road of first order, a Gaussian one, or a bounded one on a circle"),
        ({"road": "harmonic", "speed_noise": {"kind": "white", "intensity": 0.1}}, "white noise on the speed"),
        ({"road": "iso_c", "car": "two_mass", "speed": 20.0}, "the car of one mass"),
    ],
)
def test_what_it_is_not_there_for(plant, reason):
    task = make_task(**plant)
    assert reason in information_relaxation.refusal(task)
    with pytest.raises(ParameterError, match=reason):
        information_relaxation.bound(task, task.speed[0], task.bandwidth[0])


@pytest.mark.parametrize("settings", [{"precision": 0}, {"precision": "low"}, {"intervals": 0}, {"threads": 0}])
def test_bad_settings_are_named(settings):
    (name,) = settings
    with pytest.raises(ParameterError, match=f"^{name} must be"):
        information_relaxation.bound(task_of(), RATIO, 0.1, **settings)
