"""Controllers and the features of learned ones."""

import numpy as np
import pytest

import analysis
import roadgym
from agents.controllers import (
    CONTROLLERS,
    AnalyticOptimum,
    ConstantDamping,
    OneStepLookahead,
    SkyhookOnOff,
    make_controller,
)
from agents.evaluation import evaluate
from agents.features import Features
from roadgym import ParameterError
from roadgym.plant import Plant
from roadgym.task import make_task

TASK = make_task(speed=(0.5, 3.0), bandwidth=(0.05, 0.5))
SIGNALS = ("displacement", "velocity", "level", "slope", "speed", "bandwidth")


def observe(**signals):
    """Observations, shape (n, signals), of operating points and states by name."""
    signals = {name: np.atleast_1d(np.asarray(value, float)) for name, value in signals.items()}
    if "speed" in signals:
        signals["speed"] = signals["speed"] / (1 + signals["speed"])
    if "bandwidth" in signals:
        signals["bandwidth"] = 2 * signals["bandwidth"] / (1 + 2 * signals["bandwidth"])
    n = max(len(value) for value in signals.values())
    columns = [np.broadcast_to(signals.get(name, np.zeros(1)), n) for name in SIGNALS]
    return np.stack(columns, axis=1).astype(np.float32)


ON_THE_WHEEL = {"groundhook", "hybrid"}  # which the car of one mass has not


@pytest.mark.parametrize("name", [name for name in CONTROLLERS if name not in {"optimal_feedback", *ON_THE_WHEEL}])
def test_every_controller_answers_within_the_range(name):
    controller = make_controller(name, TASK)
    state = np.random.default_rng(1).standard_normal((4, 9))
    observation = observe(displacement=state[0], velocity=state[1], level=state[2], slope=state[3], speed=1.5, bandwidth=0.1)
    damping, _ = controller.predict(observation)
    assert damping.shape == (9, 1)
    assert damping.dtype == np.float32
    assert np.all((damping >= np.float32(0.05)) & (damping <= 1))
    single, _ = controller.predict(observation[3])
    assert single.shape == (1,)
    assert single == damping[3]


def test_analytic_optimum_follows_the_operating_point():
    controller = AnalyticOptimum(TASK)
    points = [(2.0, 0.1), (3.0, 0.3), (0.7, 0.1), (2.0, 0.1)]
    observation = observe(speed=[v for v, _ in points], bandwidth=[b for _, b in points])
    damping, _ = controller.predict(observation)
    for value, (speed, bandwidth) in zip(damping[:, 0], points, strict=True):
        road = TASK.road.with_bandwidth(bandwidth)
        assert value == pytest.approx(analysis.optimal_damping(road, speed=speed).damping, rel=1e-4)
    assert damping[2] == 1.0  # below nu = sqrt(2) the firmest damper is the best
    assert np.all(controller.predict(observation[::-1])[0] == damping[::-1])


def test_skyhook_brakes_the_body_and_nothing_else():
    # relative velocity = velocity - nu * slope, with nu = 2
    observation = observe(velocity=[1, 1, -1, -1], slope=[0.25, 0.75, -0.25, -0.75], speed=2.0, bandwidth=0.1)
    damping, _ = SkyhookOnOff(TASK).predict(observation)
    assert damping[:, 0] == pytest.approx([1.0, 0.05, 1.0, 0.05])


def state_of(travel, relative, velocity, speed=2.0):
    """An observation with this travel, relative velocity and body velocity."""
    velocity, relative = np.asarray(velocity, float), np.asarray(relative, float)
    return observe(displacement=travel, velocity=velocity, slope=(velocity - relative) / speed, speed=speed, bandwidth=0.1)


def test_classical_rules_on_states_worked_out_by_hand():
    # travel, relative velocity, body velocity; soft acceleration = -0.1 relative - travel
    observation = state_of([1, -1, 1, 0.1], [1, 1, -1, 1], [0.2, 0.2, 0.2, 2.0])
    add = make_controller("add", TASK).predict(observation)[0][:, 0]
    assert add == pytest.approx([0.05, 1.0, 1.0, 0.05])
    # slow body motion in the last state only: |acceleration| 0.2 against sqrt(2) * 2
    mixed = make_controller("mixed_skyhook_add", TASK).predict(observation)[0][:, 0]
    assert mixed == pytest.approx([0.05, 1.0, 1.0, 1.0])
    least = make_controller("least_acceleration", TASK).predict(state_of([1, -1, 0.6], [1, 1, -1], [0, 0, 0]))[0][:, 0]
    assert least == pytest.approx([0.05, 0.5, 0.3], abs=1e-6)
    sky = make_controller("skyhook_continuous", TASK).predict(state_of([0, 0, 0], [1, 2, -1], [0.5, 0.2, 0.5]))[0][:, 0]
    assert sky == pytest.approx([0.5, 0.1, 0.05], abs=1e-6)


def test_lookahead_weighs_one_interval_and_what_follows():
    """Its forms against a simulation: what an interval at D, and the best constant damping ever after, cost from a state."""
    ratio, bandwidth = 1.5, 0.3
    controller = OneStepLookahead(TASK)
    dampings, forms, constants = controller.make_forms(ratio, bandwidth)
    road = roadgym.GaussianRoad(bandwidth=bandwidth, noise_intensity=1.0)
    best = analysis.optimal_damping(road, speed=ratio)
    lanes, steps = 20_000, 150
    state = np.array([0.8, -0.5, 1.2, 0.4])
    costs = []
    for k in (0, len(dampings) - 1):
        plant = Plant(make_task(road=road, speed=ratio, precision="float64", substeps=8), lanes)
        plant.start(np.arange(lanes, dtype=np.uint64))
        for row, value in zip(("displacement", "velocity", "level", "slope"), state, strict=True):
            plant.set_row(row, value)
        total = np.zeros(lanes)
        for step in range(steps):
            damping = dampings[k] if step == 0 else best.damping
            total += 0.2 * (plant.step(np.full(lanes, damping, np.float32)).mean_squares[0] - best.cost)
        costs.append(total)
    simulated = costs[1] - costs[0]
    predicted = np.einsum("i,kij,j->k", state, forms, state) + constants
    assert simulated.mean() == pytest.approx(predicted[-1] - predicted[0], abs=4 * simulated.std() / np.sqrt(lanes) + 0.005)


def test_clipped_regulator_is_linear_where_the_damper_can_follow():
    controller = make_controller("clipped_lqr", TASK)
    gain, _ = controller.make_forms(1.5, 0.1)
    observation = np.repeat(observe(velocity=0.3, level=0.2, slope=0.1, speed=1.5, bandwidth=0.1), 2, axis=0)
    observation[1, :4] *= 0.5  # half the state, half the force, the same damping
    damping = controller.predict(observation)[0][:, 0]
    assert damping[0] == pytest.approx(damping[1], rel=1e-5)
    relative = 0.3 - 1.5 * 0.1
    assert damping[0] == pytest.approx(np.clip(-(gain @ [0, 0.3, 0.2, 0.1]) / (2 * relative), 0.05, 1.0), rel=1e-4)


@pytest.mark.statistical
def test_lookahead_improves_on_the_best_constant_everywhere():
    environment = {"speed": (0.7, 3.0), "bandwidth": (0.1, 0.3)}
    task = make_task(**environment)
    drivers = {name: make_controller(name, task) for name in ("analytic_optimum", "one_step_lookahead")}
    found = evaluate(
        drivers,
        environment=environment,
        speeds=[0.7, 1.5, 3.0],
        bandwidths=[0.1, 0.3],
        episodes=64,
        duration=150.0,
        transient=30.0,
    )
    difference = found["analytic_optimum"].costs - found["one_step_lookahead"].costs
    assert np.all(difference.mean(axis=1) > 4 * difference.std(axis=1) / 8)


def test_controllers_say_which_signal_they_miss():
    with pytest.raises(ParameterError, match=r"^skyhook needs the signal 'slope'; the task observes displacement"):
        SkyhookOnOff(make_task(road="first_order"))
    with pytest.raises(ParameterError, match="unknown controller 'fuzzy'; known: analytic_optimum"):
        make_controller("fuzzy", TASK)
    with pytest.raises(ParameterError, match="observation must have 6 signals"):
        ConstantDamping(TASK, 0.3).predict(np.zeros((2, 3), np.float32))


def test_products_alone_are_even_and_signals_are_kept():
    observation = observe(displacement=[0.5, 2], velocity=[1, -1], level=[-0.3, 4], slope=[2, 0.1], speed=1.5, bandwidth=0.1)
    mirrored = observation.copy()
    mirrored[:, :4] *= -1
    even = Features(TASK, ["products"])
    np.testing.assert_array_equal(even(observation), even(mirrored))
    assert even(observation).shape == (2, even.size) == (2, 12)
    both = Features(TASK, ["signals", "products"])
    assert both(observation).shape == (2, 16)
    np.testing.assert_array_equal(both(observation)[:, 2:6], observation[:, :4])
    scale = np.sqrt(1 + np.sum(observation[0, :4] ** 2))
    assert both(observation)[0, 7] == pytest.approx(observation[0, 0] * observation[0, 1] / scale)
    with pytest.raises(ParameterError, match="features must be a selection of signals, products"):
        Features(TASK, ["cubes"])


def test_optimal_feedback_is_worked_out_once_and_kept(tmp_path, monkeypatch):
    asked = []

    class Feedback:
        def damping(self, states):
            return np.full(len(states), 0.3)

    def work_out(road, **options):
        asked.append((road.bandwidth, options["speed"], options["cache"]))
        return Feedback()

    monkeypatch.setattr("analysis.optimal_feedback", work_out)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    controller = make_controller("optimal_feedback", TASK)
    observation = observe(velocity=[1, 2, 3], speed=[1.5, 1.5, 2.0], bandwidth=0.1)
    for _ in range(2):
        assert controller.predict(observation)[0][:, 0] == pytest.approx([0.3] * 3)
    assert asked == [(0.1, 1.5, tmp_path / "roadgym"), (0.1, 2.0, tmp_path / "roadgym")]


@pytest.mark.parametrize("name", ["clipped_lqr", "one_step_lookahead", "optimal_feedback"])
@pytest.mark.parametrize(
    ("plant", "message"),
    [
        ({"road": "gaussian", "speed_noise": "low_pass"}, "low_pass speed noise"),
        ({"road": {"kind": "multiplicative", "bandwidth": 0.3, "noise_intensity": 0.4, "slope_bound": 0.7}}, "an ellipse"),
    ],
)
def test_rules_with_a_model_refuse_what_is_outside_it(name, plant, message):
    with pytest.raises(ParameterError, match=f"^{name} needs .* at a constant speed; got {message}"):
        make_controller(name, make_task(**plant))


def test_rules_with_a_model_refuse_a_weighted_car_and_say_why():
    weighted = make_task(car="two_mass", road="iso_c", speed=20.0, reward={"weighted_acceleration": 1.0})
    with pytest.raises(ParameterError, match=r"^clipped_lqr needs a car without a weighting, got .* weighted_acceleration$"):
        make_controller("clipped_lqr", weighted)
    with pytest.raises(ParameterError, match=r"^clipped_lqr needs a gaussian or .*; got a power_law road$"):
        make_controller("clipped_lqr", make_task(road="power_law"))
