"""Controllers of a car of two masses."""

import itertools

import numpy as np
import pytest
from scipy.linalg import solve_continuous_lyapunov

from agents.advantage import state_of
from agents.comparison import WHEEL_RIVALS, compare, make_rivals
from agents.controllers import CONTROLLERS, make_controller, tune_controller
from agents.evaluation import evaluate
from agents.names import CONTROLLERS_SHOWN
from agents.report import notes, table
from analysis.quadratic import interval_forms, plant_system, regulator, value_form
from roadgym import ParameterError, TwoMassCar
from roadgym.linear import LinearSystem
from roadgym.plant import Plant
from roadgym.task import make_task

CAR = TwoMassCar(sprung_mass=400.0, unsprung_mass=50.0, spring_rate=30e3, tyre_rate=250e3, damping_coefficients=(300.0, 3900.0))
REWARD = {"acceleration": 1.0, "travel": 0.5 * 75.0**2, "tyre_deflection": 5 * 75.0**2}
ENVIRONMENT = {"road": "iso_c", "car": CAR, "speed": 20.0, "reward": REWARD}
TASK = make_task(**ENVIRONMENT)
LOW, HIGH = TASK.damping_range


def observe(**signals):
    """Observations of the task, shape (n, signals), of states by name, zero where none is given."""
    signals = {name: np.atleast_1d(np.asarray(value, float)) for name, value in signals.items()}
    n = max(map(len, signals.values()))
    signals["speed"] = np.full(n, 0.145 / 1.145)
    return np.stack([np.broadcast_to(signals.get(name, np.zeros(1)), n) for name in TASK.signals], axis=1).astype(np.float32)


def answer(name, observation, **parameters):
    return make_controller(name, TASK, **parameters).predict(observation)[0][:, 0]


@pytest.mark.parametrize("name", [name for name in CONTROLLERS if name != "optimal_feedback"])
def test_every_controller_drives_two_masses(name):
    state = np.random.default_rng(1).standard_normal((5, 9))
    observation = observe(**dict(zip(state_of(TASK), state, strict=True)))
    damping = answer(name, observation)
    assert damping.shape == (9,)
    assert np.all((damping >= np.float32(LOW)) & (damping <= np.float32(HIGH)))
    assert len(CONTROLLERS_SHOWN[name]) == 2


def test_rules_on_body_and_wheel_worked_out_by_hand():
    body, wheel = np.array([1.0, 1.0, -1.0, -1.0]), np.array([-2.0, 2.0, 2.0, -0.5])
    observation = observe(velocity=body, wheel_velocity=wheel)
    sky = body * (body - wheel) > 0
    ground = -wheel * (body - wheel) > 0
    assert answer("skyhook", observation) == pytest.approx(np.where(sky, HIGH, LOW))
    assert answer("groundhook", observation) == pytest.approx(np.where(ground, HIGH, LOW))
    mixture = 0.25 * np.where(sky, HIGH, LOW) + 0.75 * np.where(ground, HIGH, LOW)
    assert answer("hybrid", observation, mixing=0.25) == pytest.approx(mixture)
    for mixing, alone in ((1.0, "skyhook"), (0.0, "groundhook")):
        assert np.all(answer("hybrid", observation, mixing=mixing) == answer(alone, observation))


def test_rules_on_the_acceleration_worked_out_by_hand():
    """Of the body under the softest damper: -(travel) - 2 D_min (relative velocity)."""
    generator = np.random.default_rng(2)
    body, wheel, high, low = generator.standard_normal((4, 200))
    observation = observe(velocity=body, wheel_velocity=wheel, displacement=high, wheel_displacement=low)
    relative = body - wheel
    acceleration = low - high - 2 * LOW * relative
    assert answer("add", observation) == pytest.approx(np.where(acceleration * relative > 0, HIGH, LOW))
    slow = np.abs(acceleration) <= 0.7 * np.abs(body)
    mixed = np.where(slow, body, acceleration) * relative > 0
    assert answer("mixed_skyhook_add", observation, crossover=0.7) == pytest.approx(np.where(mixed, HIGH, LOW))
    assert answer("one_sensor_mix", observation, crossover=0.7) == pytest.approx(np.where(slow, HIGH, LOW))
    assert 0.1 < slow.mean() < 0.9


def test_power_driven_damper_is_that_of_its_authors():
    """In SI units, case by case."""
    travel = np.array([0.01, -0.01, -0.03, -0.002, 0.01, 0.0])
    relative = np.array([0.2, 0.2, 0.02, 0.1, 0.0, 0.0])
    k, (soft, firm) = CAR.spring_rate, CAR.damping_coefficients
    expected = [
        soft
        if k * r * v + soft * v**2 >= 0 and v
        else firm
        if k * r * v + firm * v**2 < 0
        else -k * r / v
        if v
        else (soft + firm) / 2
        for r, v in zip(travel, relative, strict=True)
    ]
    assert expected[2] == firm
    assert soft < expected[3] < firm
    deviation = TASK.road.variance**0.5
    observation = observe(displacement=travel / deviation, velocity=relative / (deviation * CAR.natural_frequency))
    assert CAR.damping_coefficient(answer("power_driven", observation)) == pytest.approx(expected, rel=1e-4)


def test_rules_on_the_wheel_refuse_a_car_without_one():
    with pytest.raises(ParameterError, match=r"^groundhook needs a car with the signal 'wheel_velocity'; known: displ[^\n]*$"):
        make_controller("groundhook", make_task())


@pytest.mark.parametrize(
    ("name", "parameters", "message"),
    [
        ("hybrid", {"mixing": 1.5}, "mixing must lie within"),
        ("mixed_skyhook_add", {"crossover": 0}, "crossover must be positive, got 0"),
        ("hybrid", {"gain": 1}, "unknown parameter 'gain' of hybrid; known: mixing"),
        ("d_min", {"gain": 1}, "unknown parameter 'gain' of d_min; known: none"),
    ],
)
def test_parameters_out_of_range_are_refused(name, parameters, message):
    with pytest.raises(ParameterError, match=message):
        make_controller(name, TASK, **parameters)


def test_tuned_parameters_cost_least_and_are_told():
    from agents.controllers.tuning import driven_cost

    found = tune_controller("hybrid", TASK)
    best, chosen = driven_cost(found, TASK, seed=0), found.parameters["mixing"]
    assert best == driven_cost(make_controller("hybrid", TASK, mixing=chosen), TASK, seed=0)
    assert best < driven_cost(make_controller("hybrid", TASK, mixing=1.0 if chosen < 0.5 else 0.0), TASK, seed=0)
    assert tune_controller("skyhook", TASK).parameters == {}
    compared = compare(
        None,
        environment={"road": "gaussian", "speed": 1.5, "bandwidth": 0.3},
        speeds=[1.5],
        bandwidths=[0.3],
        controllers=["mixed_skyhook_add"],
        episodes=16,
    )
    crossover = compared.configuration["parameters"]["mixed_skyhook_add"]["crossover"]
    assert crossover in {2**0.5, *CONTROLLERS["mixed_skyhook_add"].tried["crossover"]}
    assert f"crossover = {crossover:g}" in dict(notes(compared))["mixed skyhook-ADD"]
    assert f"crossover = {crossover:g}" in table(compared)


def test_a_car_with_a_wheel_is_compared_with_rules_on_it(monkeypatch):
    monkeypatch.setattr("agents.comparison.tune_controller", make_controller)
    assert set(make_rivals(TASK, None)) == set(WHEEL_RIVALS)
    assert "groundhook" not in make_rivals(make_task(), None)


def test_regulator_with_a_cross_term_is_the_best_linear_force():
    """Its gain makes the cost of a linear force least, which Lyapunov's equation tells without it."""
    system, weights = plant_system(TASK, 0.0, 0.145), TASK.weights_by_name
    gain, value = regulator(system, weights, 0.02)

    def cost(row):
        drift = system.drift + np.outer(system.force_entry, row)
        form = 0.02 * np.outer(row, row)
        for name, weight in weights.items():
            signal = system.signals[name] - system.force[name] * row
            form = form + weight * np.outer(signal, signal)
        return np.sum(solve_continuous_lyapunov(drift, -system.noise @ system.noise.T) * form)

    best = cost(gain)
    assert best == pytest.approx(np.sum(value * (system.noise @ system.noise.T)), rel=1e-8)
    for direction in np.random.default_rng(3).standard_normal((20, 5)):
        assert cost(gain + 1e-2 * direction) > best


@pytest.mark.statistical
def test_forms_of_any_value_are_what_simulation_finds():
    """Cost of an interval plus the change of a quadratic form, on average over what a random choice of D drives."""
    ratio = TASK.frequency_ratio(20.0)
    value = value_form(plant_system(TASK, 0.2, ratio), TASK.weights_by_name)[0] + np.diag([0.1, 0.2, 0.3, 0.1, 0.2])
    dampings = np.array([LOW, 0.3, HIGH], np.float32)
    forms, constants = interval_forms(TASK, value[None], dampings, [ratio], [0.0])
    lanes, steps = 4096, 400
    plant = Plant(TASK, lanes)
    plant.start(np.arange(lanes, dtype=np.uint64))
    generator, errors = np.random.default_rng(4), []
    state = np.concatenate([plant.car_states, plant.road_states])
    for step in range(steps):
        choice = generator.integers(0, 3, lanes)
        expected = np.einsum("in,nij,jn->n", state, forms[0, choice], state) + constants[0, choice]
        before = np.einsum("in,ij,jn->n", state, value, state)
        reward = plant.step(dampings[choice]).reward
        state = np.concatenate([plant.car_states, plant.road_states])
        found = -reward * TASK.control_interval * CAR.natural_frequency + np.einsum("in,ij,jn->n", state, value, state) - before
        if step >= 100:
            errors.append(found - expected)
    means = np.mean(errors, axis=0)
    assert abs(means.mean()) < 4 * means.std() / np.sqrt(lanes)
    assert means.std() / np.sqrt(lanes) < 1e-2 * np.abs(constants).max()


@pytest.mark.statistical
def test_the_more_a_controller_knows_the_less_it_costs():
    """The order of theory's rules, each ahead by more than four standard errors."""
    environment = {**ENVIRONMENT, "reward": {"acceleration": 1.0}}
    task = make_task(**environment)
    drivers = {name: make_controller(name, task) for name in ("analytic_optimum", "clipped_lqr", "mixed_lookahead")}
    found = evaluate(
        drivers,
        environment=environment,
        speeds=[20.0],
        episodes=96,
        duration=6.0,
        transient=8.0,
    )
    costs = [evaluation.costs[0] for evaluation in found.values()]
    for worse, better in itertools.pairwise(costs):
        difference = worse - better
        assert difference.mean() > 4 * difference.std() / np.sqrt(96)


def test_observations_in_single_precision_do_not_spoil_the_lookahead():
    """The state is a small difference of heights that saturate at twenty deviations of the road."""
    controller = make_controller("one_step_lookahead", TASK)
    ratio = float(TASK.frequency_ratio(20.0))
    system = LinearSystem.of(TASK.road.shaping_filter(), CAR.motion, damping=0.2, ratio=ratio)
    states = np.random.default_rng(5).multivariate_normal(np.zeros(5), system.covariance(), 4000)
    forms = controller.make_forms(ratio, 0.0)
    exact, single = (
        controller.rule(forms, states, ratio),
        controller.rule(forms, states.astype(np.float32).astype(float), ratio),
    )
    assert np.mean(exact != single) < 1e-3
