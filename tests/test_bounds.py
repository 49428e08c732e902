"""Lower bounds of every controller: against closed forms, against all that is driven, and against proofs that are wrong."""

import dataclasses
import json

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import analysis
import roadgym
from agents.controllers import make_controller
from agents.evaluation import evaluate
from agents.theory import optimum, theoretical_cost
from analysis.bounds import (
    METHODS,
    PROVED,
    RIGOURS,
    LowerBound,
    Method,
    kept_files,
    matrix_inequality,
    refusal,
    sums_of_squares,
)
from analysis.quadratic import periodic_mean_squares, plant_system
from roadgym.parameters import ParameterError
from roadgym.roads import make_road
from roadgym.task import make_task

ONE_MASS = ("gaussian", "multiplicative", "harmonic", "first_order", "two_corner", "power_law")
SMOOTH = ("displacement", "velocity", "acceleration", "travel", "relative_velocity")
WHEEL = ("acceleration", "weighted_acceleration", "travel", "tyre_deflection", "wheel_load")


def bandwidth_of(task):
    return task.bandwidth[0]


def bound_of(task):
    return matrix_inequality.certificate(task, task.speed[0], bandwidth_of(task))


def constant_cost(task, damping):
    return theoretical_cost(task, damping, task.speed[0], bandwidth_of(task))


def random_task(generator):
    """A task with one speed and any plant that is linear, cost and range of damping."""
    low, high = np.sort(generator.uniform(0.05, 1.0, 2)).tolist()
    if generator.random() < 0.3:
        names = generator.choice(WHEEL, generator.integers(1, 4), replace=False).tolist()
        scales = {"acceleration": 1.0, "weighted_acceleration": 1.0, "travel": 1e3, "tyre_deflection": 1e4, "wheel_load": 1e-6}
        plant = {"car": "two_mass", "road": f"iso_{generator.choice(list('abcde'))}", "speed": float(generator.uniform(5, 35))}
    else:
        road = str(generator.choice(ONE_MASS))
        rough = ("acceleration", "relative_velocity") if not make_road(road).has_slope else ()
        names = [name for name in generator.choice(SMOOTH, 2, replace=False).tolist() if name not in rough]
        scales = dict.fromkeys(SMOOTH, 1.0)
        plant = {"road": road, "speed": float(10 ** generator.uniform(-0.7, 0.7))}
        if road in ("gaussian", "multiplicative"):
            plant["bandwidth"] = float(generator.uniform(0.03, 0.6))
        names = names or ["displacement"]
    reward = {name: scales[name] * float(generator.uniform(0.1, 2)) for name in names}
    return make_task(**plant, reward=reward, damping_range=(low, max(high, low + 1e-3)))


# ---------------------------------------------------------------------- the matrix inequality


@pytest.mark.parametrize(
    "plant",
    [
        *({"road": road, "speed": 1.5} for road in ONE_MASS),
        {"road": "gaussian", "speed": 0.7, "reward": {"acceleration": 1.0, "travel": 0.5}},
        {"road": "first_order", "speed": 2.0, "reward": {"travel": 1.0, "velocity": 0.3}},
        {"car": "two_mass", "road": "iso_c", "speed": 20.0},
        {"car": "two_mass", "road": "iso_c", "speed": 20.0, "reward": {"weighted_acceleration": 1.0, "wheel_load": 1e-7}},
    ],
)
def test_where_the_damping_is_nearly_fixed_the_bound_is_the_closed_form(plant):
    task = make_task(**plant, damping_range=(0.3, 0.3 + 1e-6))
    cost, found = constant_cost(task, 0.3), bound_of(task)
    assert found.holds
    assert cost * (1 - 2e-5) < found.cost <= cost * (1 + 1e-7)


def test_numbers_of_the_car_of_butsuen_and_others():
    """Values over the intensity S of the velocity on a road without corner, in terms of (m/s^2)^2, 1/s^4 and m."""
    car = roadgym.TwoMassCar(sprung_mass=240, unsprung_mass=36, spring_rate=16e3, tyre_rate=160e3)
    iso = make_road("iso_c")
    road = roadgym.FirstOrderRoad(wavenumber=1e-3 * iso.wavenumber, noise_intensity=iso.noise_intensity)
    intensity = 2 * road.variance * road.wavenumber * 20.0
    reached = {(0.0, 0.0): 510, (100.0, 1e3): 583, (500.0, 0.0): 613, (1e3, 1e4): 1228, (1e4, 1e5): 4412}
    for (travel, tyre), expected in reached.items():
        reward = {"acceleration": 1.0} | ({"travel": travel} if travel else {}) | ({"tyre_deflection": tyre} if tyre else {})
        softest, firmest = 300 / car.damping_unit, 4000 / car.damping_unit
        task = make_task(car=car, road=road, speed=20.0, reward=reward, damping_range=(softest, firmest))
        assert bound_of(task).cost / intensity == pytest.approx(expected, abs=0.6)


def test_no_constant_damping_of_a_hundred_plants_beats_the_bound():
    generator = np.random.default_rng(16)
    ratios = []
    for _ in range(100):
        task = random_task(generator)
        found = bound_of(task)
        assert found.holds
        assert found.cost > 0
        costs = [constant_cost(task, damping) for damping in np.linspace(*task.damping_range, 9).tolist()]
        ratios.append(found.cost / min(costs))
    assert max(ratios) <= 1 + 1e-9
    assert np.quantile(ratios, 0.9) > 0.5  # they say something too


def test_no_damping_that_changes_at_random_beats_the_bound():
    """Exact second moments of the plant under random sequences of dampings, held over intervals."""
    generator = np.random.default_rng(17)
    for _ in range(16):
        task = random_task(generator)
        cost = bound_of(task).cost
        ratio, bandwidth = task.frequency_ratio(task.speed[0]), bandwidth_of(task)
        ends = np.array(task.damping_range)
        dampings = generator.uniform(*ends, 12) if generator.random() < 0.5 else generator.choice(ends, 12)
        systems = [plant_system(task, damping, ratio, bandwidth or None) for damping in dampings.tolist()]
        if any(name in systems[0].rough for name in task.weights_by_name):
            continue
        squares = periodic_mean_squares(systems, 0.3 * float(generator.uniform(0.1, 2)))
        assert sum(weight * squares[name] for name, weight in task.weights_by_name.items()) >= cost


class Poor:
    """A rule behind noisy sensors, a delay of two intervals and a valve that lags; its damping stays in the range."""

    def __init__(self, rule):
        self.rule, self.task = rule, rule.task

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        generator, queue, valve = state or (np.random.default_rng(3), [], None)
        noisy = observation.copy()
        noisy[:, :-2] += 0.1 * generator.standard_normal(noisy[:, :-2].shape).astype(np.float32)  # all but the operating point
        queue = [*queue, self.rule.predict(noisy)[0]][-3:]
        valve = queue[0] if valve is None else valve + 0.4 * (queue[0] - valve)
        return valve, (generator, queue, valve)


@pytest.mark.statistical
@pytest.mark.parametrize("road", ["gaussian", "multiplicative"])
def test_no_rule_that_is_driven_beats_the_bound(road):
    environment = {"road": road, "speed": (0.5, 4.0), "bandwidth": (0.05, 0.5)}
    task = make_task(**environment)
    names = ("skyhook", "one_step_lookahead")
    rules = {name: make_controller(name, task) for name in names}
    rules |= {f"{name}, noisy and late": Poor(rules[name]) for name in names[:2]}
    driven = evaluate(rules, environment=environment, speeds=[0.7, 2.0], bandwidths=[0.1], episodes=32)
    points = driven["skyhook"].points
    bounds = [analysis.lower_bound(task, speed=point.speed, bandwidth=point.bandwidth).safe for point in points]
    for evaluation in driven.values():
        assert (np.array(bounds) <= evaluation.mean + 4 * evaluation.standard_error).all()


def proves(found, task, cost):
    """Is the certificate right at dampings in the range, by the plant at each of them, with nothing of its own matrices?

    Returns the least eigenvalue of the form that must not be negative, over its largest, and the least rate in the mean.
    """
    away = np.eye(len(found.states))
    ratio, bandwidth = task.frequency_ratio(task.speed[0]), bandwidth_of(task)
    least, rates = [], []
    for damping in np.linspace(*task.damping_range, 7).tolist():
        system = dataclasses.replace(plant_system(task, damping, ratio, bandwidth or None), flatness=0.0)
        cars = system.car_states
        away[:cars, cars:] = -system.heights
        form = away.T @ found.value @ away
        moved, gained = system.form_rate(form)
        left = system.cost_form(task.weights_by_name) + moved - away.T @ found.road @ away
        least.append(np.linalg.eigvalsh(left)[0] / np.abs(left).max())
        rates.append(float(gained + np.sum(found.road[cars:, cars:] * system.road_covariance)))
    return min(least) > -1e-9 and min(rates) >= cost * (1 - 1e-9)


@pytest.mark.parametrize("plant", [{"road": "gaussian", "speed": 1.5}, {"road": "first_order", "speed": 1.0}])
def test_certificates_are_right_by_the_plant_itself_and_wrong_ones_are_caught(plant):
    task = make_task(**plant, reward={"displacement": 1.0, "travel": 0.2})
    found = bound_of(task)
    assert proves(found, task, found.cost)
    assert not proves(found, task, 1.01 * found.cost)
    assert not proves(dataclasses.replace(found, value=1.05 * found.value), task, found.cost)
    assert not proves(dataclasses.replace(found, value=-found.value), task, found.cost)
    other = make_task(**plant, reward={"displacement": 1.0, "travel": 0.2}, damping_range=(0.05, 1.5))
    assert not proves(found, other, found.cost)  # it does not hold beyond the range


def test_more_room_costs_little_and_less_room_than_rounding_is_no_proof(monkeypatch):
    task = make_task(road="gaussian", speed=1.5)
    found = bound_of(task)
    monkeypatch.setattr(matrix_inequality, "MARGINS", (1e-6,))
    assert bound_of(task).cost == pytest.approx(found.cost, rel=1e-4)
    monkeypatch.setattr(matrix_inequality, "MARGINS", (0.0,))
    with pytest.raises(ParameterError, match="rounding is too large to prove it"):
        bound_of(task)


def test_linear_algebra_of_a_bound_is_on_one_thread_and_then_again_on_those_that_there_were():
    def threads():
        return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

    inside = []
    with threadpool_limits(2, user_api="blas"):
        before = threads()
        task = make_task(road="first_order", speed=1.0)
        sums_of_squares.certificate(task, 1.0, 0.0, degree=2, report=lambda done, total: inside.append(threads()))
        assert threads() == before == {2}
    assert all(each == {1} for each in inside)
    assert inside


# ---------------------------------------------------------------------- the front door


def test_front_door_gives_the_largest_and_says_how_far_it_is_to_be_trusted():
    task = make_task(road="gaussian", speed=(0.5, 3.0), bandwidth=(0.05, 0.5))
    told = []
    bound = analysis.lower_bound(task, speed=1.5, bandwidth=0.1, report=lambda *progress: told.append(progress))
    assert bound.rigour in RIGOURS
    assert bound.cost < float(optimum(task, 1.5, 0.1).cost)
    assert told == sorted(told)
    assert told[-1][0] == told[-1][1]
    by_name = analysis.lower_bound(task, speed=1.5, bandwidth=0.1, method="matrix_inequality")
    assert bound.cost >= by_name.cost > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "speed must be given where the task has a range of it"),
        ({"speed": 1.0}, "bandwidth must be given where the task has a range of it"),
        ({"speed": -1.0, "bandwidth": 0.1}, "speed must be positive, got -1.0"),
        ({"speed": 1.0, "bandwidth": 0.1, "method": "guess"}, "method must be one of fast, tight, matrix_inequality"),
        ({"speed": 1.0, "bandwidth": 0.1, "seed": -1}, "seed must be at least 0, got -1"),
        ({"speed": 1.0, "bandwidth": 0.1, "threads": 0}, "threads must be at least 1, got 0"),
        ({"speed": 1.0, "bandwidth": 0.1, "cache": 3}, "cache must be a folder or None, got 3"),
        ({"speed": 1.0, "bandwidth": 0.1, "report": 5}, "report must be a function or None, got 5"),
    ],
)
def test_bad_input_is_told_in_one_line(arguments, message):
    task = make_task(road="gaussian", speed=(0.5, 3.0), bandwidth=(0.05, 0.5))
    with pytest.raises(ParameterError) as raised:
        analysis.lower_bound(task, **arguments)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


def test_where_there_is_no_bound_the_reason_is_told_without_raising_or_with():
    task = make_task(road="harmonic", speed_noise="white", speed=1.0)
    assert "white noise on the speed" in refusal(task, "matrix_inequality")
    assert refusal(task) is not None
    with pytest.raises(ParameterError, match=r"there is no lower bound for this task: .*white noise on the speed"):
        analysis.lower_bound(task)
    assert refusal(make_task(road="gaussian", speed=1.0)) is None
    varied = make_task(car="two_mass", road="iso_c", speed=20.0, vary={"sprung_mass": (200.0, 280.0)})
    for method in METHODS.values():  # past the front door too
        assert "cars that differ" in method.refusal(varied)
        assert (method.refuses(varied) is None) == method.each_car
    slow = make_task(road="gaussian", speed=1.0, valve={"rise_time": 0.1})
    assert refusal(slow) is None  # the damping may move at any time
    assert "an ideal valve" in refusal(slow, "information_relaxation")


def test_bounds_that_take_time_are_kept_and_damaged_files_are_none(tmp_path, monkeypatch):
    calls = []

    def slow(task, speed, bandwidth, *, seed, report):
        calls.append(seed)
        report(1, 2)
        return LowerBound(cost=0.01 + seed / 1000, method="slow", assumption="any", rigour=PROVED)

    monkeypatch.setitem(
        METHODS,
        "slow",
        Method(
            title="patience",
            refusal=lambda task: None,
            bound=slow,
            quick=False,
            settings=("seed",),
            revision=1,
        ),
    )
    for name in METHODS.keys() - {"slow", "matrix_inequality"}:
        monkeypatch.delitem(METHODS, name)
    task = make_task(road="gaussian", speed=1.5)
    arguments = {"method": "slow", "cache": tmp_path / "kept"}
    first = analysis.lower_bound(task, **arguments)
    assert analysis.lower_bound(task, **arguments) == first
    assert analysis.lower_bound(task, **arguments, seed=1) != first
    assert analysis.lower_bound(make_task(road="gaussian", speed=1.6), **arguments) == first  # found anew
    assert calls == [0, 1, 0]
    (path, *_) = files = kept_files(tmp_path / "kept")
    assert len(files) == 3
    for damage in ("", "{}", path.read_text().replace("0.01", "Infinity"), path.read_text().replace("proved", "hoped")):
        path.write_text(damage)
        before = len(calls)
        for seed, speed in ((0, 1.5), (1, 1.5), (0, 1.6)):
            analysis.lower_bound(make_task(road="gaussian", speed=speed), **arguments, seed=seed)
        assert len(calls) == before + 1
        assert json.loads(path.read_text())["bound"]["rigour"] == PROVED
    assert analysis.lower_bound(task).method == "matrix_inequality"  # "slow" is not quick
    assert analysis.lower_bound(task, method="tight", seed=90).method == "slow"
