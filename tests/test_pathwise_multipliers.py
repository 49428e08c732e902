"""Lower bounds by pathwise multipliers: weak duality step by step, closed forms, and what is driven."""

import numpy as np
import pytest

import roadgym
from agents.theory import theoretical_cost
from analysis.bounds import matrix_inequality, pathwise_multipliers
from analysis.bounds.pathwise_multipliers import Held, _single
from analysis.bounds.relaxation.multipliers import ascend, dual
from roadgym.linear import LinearSystem
from roadgym.parameters import ParameterError
from roadgym.task import make_task

COMFORT = {"car": "two_mass", "road": "iso_c", "speed": 20.0}
HILLS = tuple(np.cumsum(np.random.default_rng(3).normal(size=600)) * 2e-3)
PROFILE = {"car": "two_mass", "road": roadgym.ProfileRoad(heights=HILLS, spacing=0.25), "speed": 20.0}


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Few and short roads."""
    for name, value in {"DURATION": 4.0, "SHARES": (0.15,), "TRIED": 1, "GROUP": 4, "HALVED": 2, "STEPS": 150}.items():
        monkeypatch.setattr(pathwise_multipliers, name, value)


def bound_of(task, **settings):
    return pathwise_multipliers.bound(task, task.speed[0], task.bandwidth[0], precision=0.2, threads=1, **settings)


def problem():
    """(plant over steps, forcing of one road, what the bracket has beyond it, its road and noise, P)."""
    task = make_task(**COMFORT)
    held = Held(task.road.shaping_filter(), task, float(task.frequency_ratio(20.0)), 0.05)
    generator = np.random.default_rng(1)
    noise = generator.standard_normal((60, 5)) * np.sqrt(np.diagonal(held.covariance))
    road, form = np.cumsum(noise[:, 4:], axis=0), generator.standard_normal((5, 5))
    form = 0.1 * (form + form.T)
    return held, *held.forcing(road, noise, form), road, noise, form


def test_no_force_within_the_sector_costs_less_than_multipliers_prove_on_a_road_that_is_known():
    held, forcing, beyond, road, noise, form = problem()
    start = np.full(60, _single(held, road, noise, form))
    proved, multipliers = ascend(dual(held.chain, forcing), start, scale=start[0], gain=1e-9, steps=200, reach=20)
    assert proved > dual(held.chain, forcing)(start)[0]
    assert multipliers.min() >= 0
    generator, least = np.random.default_rng(2), np.inf
    for rule in range(50):
        car, total, summed = generator.standard_normal(4) * 0.3 * generator.random(), 0.0, beyond
        for k in range(60):  # with nothing but the plant and x'Px: none of the sums of the forcing
            state = np.append(car, road[k])
            share = generator.random() if rule % 2 else float(generator.random() < 0.5)
            known = held.relative[:-1] @ state + held.end @ noise[k] / 2
            force = share * known / (1 - share * held.relative[-1])  # a share of the relative velocity, its own part included
            pair = np.append(state, force)
            mean = held.whole @ pair
            after = mean + noise[k]
            penalty = after @ form @ after - mean @ form @ mean - np.sum(form * held.covariance)
            total += pair @ held.cost @ pair + held.constant - penalty
            own = np.append(car, force)
            summed += own @ held.chain.cost @ own + 2 * forcing.linear[k] @ own
            car = after[:4]
        assert summed == pytest.approx(total)
        least = min(least, total)
    assert least > proved + beyond


def test_the_slope_of_the_dual_is_that_of_differences():
    held, forcing, _, *known = problem()
    function, place = dual(held.chain, forcing), np.full(60, _single(held, *known))
    slope = function(place)[1]
    for k in (0, 30, 59):
        step = 1e-3 * place[0] * (np.arange(60) == k)
        assert (function(place + step)[0] - function(place - step)[0]) / (2 * step[k]) == pytest.approx(slope[k], rel=1e-4)


@pytest.mark.statistical
@pytest.mark.parametrize(
    "plant",
    [
        {"road": "gaussian", "speed": 1.5, "bandwidth": 0.8, "reward": {"acceleration": 1.0, "travel": 0.5}},
        {"road": "harmonic", "speed": 1.5},
        COMFORT,
        PROFILE,
    ],
)
def test_where_the_damping_is_nearly_fixed_it_is_the_closed_form_but_for_the_ends(plant, monkeypatch):
    monkeypatch.setattr(pathwise_multipliers, "DURATION", 60.0)
    task = make_task(**plant, damping_range=(0.3, 0.3 + 1e-4))
    found = bound_of(task)
    exact = theoretical_cost(task, 0.3, task.speed[0], task.bandwidth[0])
    assert found.cost < exact + 4 * found.standard_error
    assert found.cost == pytest.approx(exact, rel=0.03, abs=4 * found.standard_error)
    assert found.standard_error < 0.02 * exact


@pytest.mark.statistical
def test_it_certifies_more_than_a_matrix_inequality_and_less_than_is_driven():
    task = make_task(**COMFORT)
    found = bound_of(task)
    assert 1.2 * matrix_inequality.bound(task, 20.0, 0.0).cost < found.safe
    assert found.cost < 0.960  # of the optimal feedback


def test_a_measured_road_has_a_bound_for_those_who_know_it_ahead():
    found = bound_of(make_task(**PROFILE))
    assert found.standard_error == 0
    assert "know the road ahead" in found.assumption
    best = min(theoretical_cost(make_task(**PROFILE), damping, 20.0, 0.0) for damping in (0.2, 0.3, 0.4, 0.5))
    assert 0.2 * best < found.cost < best


def test_a_wave_has_a_bound_above_that_of_the_matrix_inequality_and_below_a_rule_that_is_driven():
    task = make_task(road="harmonic", speed=1.5)
    low, high = task.damping_range
    plant = LinearSystem.of(task.road.shaping_filter(), task.car.motion, damping=[low, high], ratio=1.5)
    moved = plant.transition(0.02)
    state, squares = np.array([0.0, 0.0, np.sqrt(2), 0.0]), []
    for _ in range(20000):  # firm where that brakes the body
        firm = state[1] * (plant.signals["relative_velocity"][0] @ state) > 0
        state = moved[int(firm)] @ state
        squares.append(state[0] ** 2)
    found = bound_of(task)
    assert found.standard_error == 0
    assert 1.5 * matrix_inequality.bound(task, 1.5, 0.0).cost < found.cost < np.mean(squares[10000:])


@pytest.mark.parametrize(
    ("plant", "reason"),
    [
        ({"road": "first_order", "speed": 1.0}, "a damper that feels no white noise"),
        ({"road": "multiplicative", "speed": 1.0}, "a road of Gaussian noise"),
    ],
)
def test_what_it_is_not_there_for(plant, reason):
    with pytest.raises(ParameterError, match=reason):
        bound_of(make_task(**plant))
