"""Lower bounds by sums of squares: against closed forms, known optima, all that is driven, and proofs that are wrong."""

import dataclasses
import math

import numpy as np
import pytest

import analysis
import roadgym
from agents.theory import optimum, theoretical_cost
from analysis.bounds import LowerBound, matrix_inequality, polynomials, sums_of_squares
from analysis.quadratic import periodic_mean_squares, plant_system
from roadgym.parameters import ParameterError
from roadgym.task import make_task

ROAD = roadgym.MultiplicativeRoad.from_shape(shape=2.0)
KNOWN = {  # (nu, delta): cost of the optimal feedback, and a bound that was reached with degree 6
    (0.7, 0.1): (1.118, 1.007),
    (1.0, 0.1): (0.705, 0.568),
    (1.0, 0.3): (0.672, 0.524),
    (1.5, 0.1): (0.2275, 0.149),
    (2.0, 0.1): (0.0985, 0.0531),
    (3.0, 0.3): (0.0811, 0.0397),
}
SMOOTH = ("displacement", "velocity", "acceleration", "travel", "relative_velocity")


def task_of(ratio=1.5, bandwidth=0.1, **changed):
    return make_task(**({"road": ROAD, "speed": ratio, "bandwidth": bandwidth, "damping_range": (0.05, 1.0)} | changed))


def bound_of(task, **settings):
    return sums_of_squares.bound(task, task.speed[0], task.bandwidth[0], **settings)


def certificate_of(task, **settings):
    return sums_of_squares.certificate(task, task.speed[0], task.bandwidth[0], **settings)


def best_constant(task):
    return float(optimum(task, task.speed[0], task.bandwidth[0]).cost)


@pytest.mark.parametrize("point", KNOWN)
def test_values_that_were_reached_before(point):
    optimal, reached = KNOWN[point]
    assert reached < bound_of(task_of(*point)).cost < optimal


@pytest.mark.parametrize("reward", [{"displacement": 1.0}, {"acceleration": 1.0, "travel": 0.5}, {"relative_velocity": 1.0}])
@pytest.mark.parametrize("held", [True, False])
@pytest.mark.parametrize("road", [ROAD, "gaussian"])
def test_where_the_damping_is_nearly_fixed_the_bound_is_the_closed_form(reward, held, road):
    task = task_of(road=road, damping_range=(0.3, 0.3 + 1e-6), reward=reward)
    cost = theoretical_cost(task, 0.3, 1.5, 0.1)
    assert cost * (1 - 1e-3) < certificate_of(task, held=held, degree=4).cost <= cost * (1 + 1e-6)


def test_a_higher_degree_gives_more_and_a_damping_that_moves_less():
    task = task_of()
    costs = [certificate_of(task, degree=degree).cost for degree in (2, 4, 6)]
    assert costs[0] < costs[1] < costs[2]
    assert certificate_of(task, degree=6, held=False).cost < costs[2]


def test_behind_a_valve_that_moves_the_damping_within_an_interval_the_bound_is_that_for_any_damping():
    ideal, late, slow = (bound_of(task_of(valve=valve), degree=4) for valve in (None, {"delay": 0.4}, {"rise_time": 0.1}))
    assert late == ideal
    assert slow.cost < ideal.cost
    assert "acting at any time" in slow.assumption


@pytest.mark.parametrize(
    "plant",
    [
        {"reward": {"acceleration": 1.0, "travel": 0.5}},
        {"road": "gaussian"},
        {"car": "two_mass", "road": "iso_c", "speed": 20.0, "bandwidth": None, "damping_range": None},
    ],
)
def test_of_degree_two_and_for_any_damping_it_is_the_matrix_inequality(plant):
    """Two proofs of the same value that have nothing in common but the plant."""
    task = task_of(**plant)
    other = matrix_inequality.bound(task, task.speed[0], task.bandwidth[0]).cost
    assert certificate_of(task, degree=2, held=False).cost == pytest.approx(other, rel=2e-3)


def test_it_certifies_more_of_two_masses_than_the_matrix_inequality():
    task = make_task(car="two_mass", road="iso_c", speed=20.0)
    assert 1.3 * matrix_inequality.bound(task, 20.0, 0.0).cost < bound_of(task).cost < 0.960  # of the optimal feedback


def test_no_constant_or_periodic_damping_of_random_tasks_costs_less():
    generator = np.random.default_rng(5)
    for _ in range(12):
        low, high = np.sort(generator.uniform(0.05, 1.5, 2)).tolist()
        names = generator.choice(SMOOTH, 2, replace=False).tolist()
        task = task_of(
            float(generator.uniform(0.4, 3)),
            float(generator.uniform(0.05, 0.5)),
            road=str(generator.choice(["gaussian", "multiplicative"])),
            damping_range=(low, high + 0.01),
            control_interval=float(generator.uniform(0.05, 0.4)),
            reward={name: float(generator.uniform(0.1, 2)) for name in names},
        )
        least = bound_of(task, degree=4).cost
        ratio, interval = task.frequency_ratio(task.speed[0]), task.control_interval * task.car.natural_frequency
        assert least < best_constant(task) * (1 + 1e-9)
        chosen = generator.uniform(low, high, 6)
        squares = periodic_mean_squares([plant_system(task, each, ratio, task.bandwidth[0]) for each in chosen], interval)
        assert least < sum(weight * squares[name] for name, weight in task.weights_by_name.items())


def rate_by_differences(task, found, damping, states, step=1e-3):
    """L_D V at states (Y, X, Z, U) of the bounded road of shape 2, from equations (1), (7), (8) and differences of V."""
    ratio, delta = task.frequency_ratio(task.speed[0]), task.bandwidth[0]
    y, x, z, u = states.T
    slope = ratio * u
    drift = np.stack([x, -(y - z) - 2 * damping * (x - slope), slope, -ratio * (2 * delta * u + z)], axis=1)
    intensity = 4 * delta * ratio * (1 + 1 / 2) * (1 - (z**2 + u**2) / 6)
    along = (found.value_at(states + step * drift) - found.value_at(states - step * drift)) / (2 * step)
    kick = np.array([0, 0, 0, step])
    curvature = found.value_at(states + kick) - 2 * found.value_at(states) + found.value_at(states - kick)
    return along + intensity * curvature / (2 * step**2)


def least_margin(task, found, generator):
    """Least of c_D + L_D V - g over random states and dampings, over the mean cost."""
    states = generator.normal(size=(4000, 4)) * [2.0, 2.0, 1.0, 1.0]
    turned = generator.normal(size=(4000, 2))
    states[:, 2:] = np.sqrt(6 * generator.uniform(size=(4000, 1))) * turned / np.linalg.norm(turned, axis=1)[:, None]
    least = np.inf
    for damping in np.append(generator.uniform(0.05, 1.0, 5), [0.05, 1.0]):
        y, x, z, u = states.T
        relative = x - task.frequency_ratio(task.speed[0]) * u
        terms = {"displacement": y, "acceleration": -(y - z) - 2 * damping * relative, "travel": y - z}
        cost = sum(weight * terms[name] ** 2 for name, weight in task.weights_by_name.items())
        least = min(least, float(np.min(cost + rate_by_differences(task, found, damping, states) - found.cost)))
    return least / best_constant(task)


@pytest.mark.parametrize("reward", [{"displacement": 1.0}, {"acceleration": 1.0, "travel": 0.5}])
def test_the_certificate_holds_at_random_states_by_equations_of_its_own(reward):
    task = task_of(reward=reward)
    found = certificate_of(task, held=False, degree=6)
    assert found.least_eigenvalue > 0
    assert least_margin(task, found, np.random.default_rng(1)) > -1e-4


def test_a_wrong_generator_is_caught(monkeypatch):
    right = sums_of_squares.generator

    def wrong(system, scale, space, of):
        """The noise takes away what it should add."""
        still = dataclasses.replace(system, noise=0 * system.noise)
        return 2 * right(still, scale, space, of) - right(system, scale, space, of)

    task = task_of(reward={"displacement": 1.0})
    monkeypatch.setattr(sums_of_squares, "generator", wrong)
    try:
        found = certificate_of(task, held=False, degree=4)
    except ParameterError:
        return  # nothing could be proved
    assert least_margin(task, found, np.random.default_rng(1)) < -1e-3


def test_a_wrong_proof_is_not_taken(monkeypatch):
    """Twice the value that was found, or a Gram matrix that is not positive, must not pass."""
    right = sums_of_squares.solve

    def greedy(program, report):
        unknowns, grams = right(program, report)
        unknowns[0] *= 1.01
        return unknowns, grams

    monkeypatch.setattr(sums_of_squares, "solve", greedy)
    with pytest.raises(ParameterError, match="too much to prove"):
        certificate_of(task_of(), degree=4)


def test_what_lies_between_the_levels_is_bounded():
    """The conditional mean at dampings that are none of the levels, within what the remainder allows."""
    from scipy.linalg import expm

    conditions = sums_of_squares._HeldConditions(sums_of_squares._Plant(task_of(), 1.5, 0.1), 6)
    levels, generator = conditions._levels, np.random.default_rng(2)
    start = generator.normal(size=conditions.space.size + 1)
    bound = levels.remainder(start)
    order = len(levels.means) - 1
    centre, half, decay = sums_of_squares.variable_of((0.05, 1.0), 0.2)
    for damping in generator.uniform(0.05, 1.0, 5):
        t = ((-np.expm1(-decay * damping) - centre) / half + 1) / 2
        weights = [math.comb(order, k) * t**k * (1 - t) ** (order - k) for k in range(order + 1)]
        exact = expm(conditions._rate(damping) * 0.2) @ start
        apart = np.abs(exact - np.tensordot(weights, levels.means, 1) @ start)
        assert np.all(apart <= bound + 1e-11)
        assert bound.max() < 1e-3


def test_conditional_means_of_quadratic_forms_are_those_of_the_plant():
    system = plant_system(task_of(), 0.4, 1.5, 0.1)
    space = polynomials.Space(polynomials.exponents(4, (0, 2, 4)))
    matrix = polynomials.generator(system, np.ones(4), space, space.powers)
    form = np.random.default_rng(0).normal(size=(4, 4))
    moved, constant = system.form_rate(form)
    expected = space.quadratic(moved)
    expected[space.one] += constant
    np.testing.assert_allclose(matrix @ space.quadratic(form), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("plant", "reason"),
    [
        ({"road": "harmonic", "bandwidth": None}, "without noise"),
        ({"road": "harmonic", "bandwidth": None, "speed_noise": "white"}, "white noise on the speed"),
    ],
)
def test_where_there_is_none_a_reason_is_given(plant, reason):
    task = task_of(**plant)
    assert reason in sums_of_squares.refusal(task)
    with pytest.raises(ParameterError, match=reason):
        bound_of(task)


def test_a_road_within_an_ellipse_is_refused():
    task = dataclasses.replace(task_of(), road=roadgym.MultiplicativeRoad(slope_bound=0.8))
    assert "not known" in sums_of_squares.refusal(task)


@pytest.mark.parametrize("degree", [3, 0, 14, 2.5])
def test_a_degree_that_is_none_is_refused_in_one_line(degree):
    with pytest.raises(ParameterError, match="degree must") as caught:
        bound_of(task_of(), degree=degree)
    assert "\n" not in str(caught.value)


def test_the_front_door_takes_it_and_progress_ends():
    seen = []
    task = task_of()
    found = analysis.lower_bound(task, method="sums_of_squares", report=lambda done, total: seen.append((done, total)))
    assert isinstance(found, LowerBound)
    assert "held" in found.assumption
    assert found.cost <= analysis.lower_bound(task).cost
    assert seen == sorted(seen)
    assert seen[-1][0] == seen[-1][1]


@pytest.mark.parametrize("speed", [1.0, 3.0])
def test_costs_that_the_damper_enters_are_bounded_for_a_damping_that_is_held_too(speed):
    task = make_task(road="multiplicative", speed=speed, bandwidth=0.1, reward={"acceleration": 1.0})
    held, moving = (sums_of_squares.certificate(task, speed, 0.1, degree=4, held=held).cost for held in (True, False))
    assert moving < held < float(optimum(task, speed, 0.1).cost)
