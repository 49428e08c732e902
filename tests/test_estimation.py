"""Rules and agents on the mean of a Kalman filter."""

import json

import numpy as np
import pytest

import agents
import analysis
from agents.cli import main
from agents.comparison import make_rivals, table
from agents.controllers import CONTROLLERS
from agents.estimation import Estimated
from agents.report import theory_given
from agents.wrappers import learning, task_of
from roadgym import ParameterError
from roadgym.task import make_task
from roadgym.vector import QuarterCarVectorEnv
from roadgym.wrappers import VectorKalmanObservation

POINT = {"road": "gaussian", "speed": 1.5, "bandwidth": 0.1}
SENSORS = {"observation": ["travel", "acceleration"], "sensors": {"noise": 0.05}}


def test_who_measures_all_without_noise_drives_as_who_sees_all():
    envs = QuarterCarVectorEnv(64, max_episode_steps=None, **POINT)
    seen = agents.make_controller("skyhook_continuous", envs.task)
    filtered = agents.make_controller("skyhook_continuous", envs.task, estimator="kalman")
    observations, _ = envs.reset(seed=1)
    state = None
    for _ in range(20):
        damping, state = filtered.predict(observations, state)
        np.testing.assert_allclose(damping, seen.predict(observations)[0], rtol=1e-3)
        observations = envs.step(damping)[0]


def test_a_controller_filters_as_the_wrapper_does():
    plant = {"road": "gaussian", "speed": (0.7, 2.0), **SENSORS}
    envs = VectorKalmanObservation(QuarterCarVectorEnv(5, max_episode_steps=6, autoreset_mode="same_step", **plant))
    measured = QuarterCarVectorEnv(5, max_episode_steps=6, autoreset_mode="same_step", **plant)
    outside = agents.make_controller("clipped_lqr", envs.task)
    within = agents.make_controller("clipped_lqr", measured.task, estimator="kalman")
    means, observations = envs.reset(seed=1)[0], measured.reset(seed=1)[0]
    state, starts = None, np.ones(5, np.bool_)
    for _ in range(15):
        damping, state = within.predict(observations, state, starts)
        np.testing.assert_array_equal(damping, outside.predict(means)[0])
        means = envs.step(damping)[0]
        observations, _, _, starts, _ = measured.step(damping)
    one = within.predict(observations[2])
    np.testing.assert_array_equal(one[0], within.predict(observations)[0][2])
    assert one[0].shape == (1,)


@pytest.mark.statistical
def test_an_accelerometer_closes_most_of_the_gap():
    environment = {**POINT, "observation": ["acceleration"], "sensors": {"noise": 0.05}}
    estimated = agents.make_controller("mixed_lookahead", make_task(**environment), estimator="kalman", mixing=0.875)
    full = agents.make_controller("mixed_lookahead", make_task(**POINT), mixing=0.875)
    size = {"speeds": [1.5], "bandwidths": [0.1], "episodes": 128, "duration": 100.0}
    found = agents.evaluate({"estimated": estimated}, environment=environment, **size)["estimated"]
    known = agents.evaluate({"full": full}, environment=POINT, **size)["full"]
    best = analysis.optimal_damping("gaussian", speed=1.5, bounds=(0.05, 1.0)).cost
    share = (best - found.mean[0]) / (best - known.mean[0])
    error = np.hypot(found.standard_error[0], known.standard_error[0]) / (best - known.mean[0])
    assert share - 4 * error > 0.65
    assert share + 4 * error < 1


@pytest.mark.statistical
def test_a_bank_over_cars_saves_what_the_filter_of_the_nominal_car_loses():
    nominal = make_task(**POINT, **SENSORS)
    varied = {**POINT, **SENSORS, "vary": {"natural_frequency": (0.6, 1.4)}}
    rule = agents.make_controller("mixed_lookahead", make_task(**POINT))
    drivers = {"bank": Estimated(rule, make_task(**varied)), "nominal": Estimated(rule, nominal)}
    found = agents.evaluate(drivers, environment=varied, speeds=[1.5], bandwidths=[0.1], episodes=64, duration=60.0)
    saved = found["nominal"].costs[0] - found["bank"].costs[0]  # the same cars on the same roads
    assert saved.mean() > 4 * saved.std() / np.sqrt(len(saved))
    assert found["bank"].mean[0] < 0.75 * found["nominal"].mean[0]


@pytest.mark.parametrize("name", sorted(set(CONTROLLERS) - {"groundhook", "hybrid", "optimal_feedback"}))
def test_every_rule_takes_a_car_with_sensors(name):
    task = make_task(**POINT, **SENSORS)
    rule = agents.make_controller(name, task, estimator="kalman")
    assert rule.task is task
    damping, state = rule.predict(np.zeros((3, 4), np.float32))
    again, _ = rule.predict(np.ones((3, 4), np.float32) * 0.5, state, np.array([True, False, False]))
    for each in (damping, again):
        assert each.shape == (3, 1)
        assert np.all((each >= np.float32(0.05)) & (each <= 1))


def test_a_hidden_operating_point_is_the_most_probable_one():
    environment = {"road": "gaussian", "speed": (0.7, 3.0), "observe_operating_point": False, **SENSORS}
    rule = agents.make_controller("one_step_lookahead", make_task(**environment), estimator="kalman")
    envs = QuarterCarVectorEnv(8, max_episode_steps=None, **environment)
    observations, state = envs.reset(seed=1)[0], None
    for _ in range(30):
        damping, state = rule.predict(observations, state)
        observations = envs.step(damping)[0]
    assert len(rule.controller._forms) <= 5  # so rules with a table have few of them to find


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: agents.make_controller("skyhook", make_task(**POINT), estimator="luenberger"),
            "unknown estimator 'luenberger'",
        ),
        (lambda: agents.make_controller("skyhook", make_task(road="harmonic"), estimator="kalman"), "got a harmonic road"),
        (
            lambda: Estimated(agents.make_controller("d_min", make_task(**POINT, observation=["travel"])), make_task(**POINT)),
            "does not tell the signal 'travel'; it tells displacement, velocity, level, slope, speed, bandwidth",
        ),
        (lambda: learning(QuarterCarVectorEnv(1), estimator=["kalman"]), "unknown estimator"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(make, message):
    with pytest.raises(ParameterError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_learning_sees_the_mean_and_is_paid_for_the_truth():
    plant = {"road": "gaussian", "speed": (0.7, 2.0), **SENSORS}
    filtered = learning(QuarterCarVectorEnv(4, **plant), estimator="kalman")
    assert task_of(filtered).signals == ("displacement", "velocity", "level", "slope", "speed", "bandwidth")
    plain = learning(QuarterCarVectorEnv(4, **plant), features=None)
    filtered.reset(seed=1)
    plain.reset(seed=1)
    for _ in range(3):
        actions = np.linspace(-1, 1, 4, dtype=np.float32)[:, None]
        seen, paid, *_ = filtered.step(actions)
        observed, reward, *_ = plain.step(actions)
        np.testing.assert_array_equal(paid, reward)
        assert seen.shape == (4, 2 + 4 + 10 + 2)  # the operating point, signals, products, and the lookahead of theory
        assert observed.shape == (4, 4)


def test_an_agent_learns_on_the_filter_and_drives_by_it(tmp_path):
    environment = {"road": "multiplicative", "speed": (0.7, 2.0), **SENSORS}
    hyperparameters = {
        "n_envs": 8,
        "n_steps": 16,
        "batch_size": 64,
        "features": ["signals", "products", "lookahead"],
        "training_reward": "advantage",
        "estimator": "kalman",
    }
    agent = agents.train(
        tmp_path / "agent", environment=environment, hyperparameters=hyperparameters, timesteps=256, report=lambda *_: None
    )
    loaded = agents.load(tmp_path / "agent")
    envs = QuarterCarVectorEnv(4, max_episode_steps=None, **environment)
    learned = learning(
        VectorKalmanObservation(QuarterCarVectorEnv(4, max_episode_steps=None, **environment)),
        features=hyperparameters["features"],
        training_reward="cost",
    )
    observations, seen = envs.reset(seed=1)[0], learned.reset(seed=1)[0]
    states = [None, None]
    for _ in range(10):
        damping, states[0] = agent.predict(observations, states[0])
        again, states[1] = loaded.predict(observations, states[1])
        np.testing.assert_array_equal(damping, again)
        actions, _ = agent.model.predict(seen, deterministic=True)
        seen = learned.step(actions)[0]
        observations, *_, info = envs.step(damping)
        np.testing.assert_allclose(learned.unwrapped.plant.row("displacement"), envs.plant.row("displacement"), atol=1e-6)
    assert info["damping"].std() > 0
    given = "drives by a Kalman filter of travel, acceleration; learned from theory's advantage"
    assert theory_given(loaded).startswith(given)
    assert theory_given(loaded).endswith(", with theory's one-step lookahead among its features.")
    with pytest.raises(ParameterError, match="unknown estimator 'x'"):
        agents.train(
            tmp_path / "other", environment=environment, hyperparameters={**hyperparameters, "estimator": "x"}, timesteps=1
        )
    assert not (tmp_path / "other").exists()


MEASURED = ["--observation", "acceleration", "--sensors", '{"noise": 0.05}', "--estimator", "kalman"]
SMALL = ["--road", "gaussian", "--speeds", "1.5", "--bandwidths", "0.1", "--episodes", "16"]


def test_the_command_evaluates_a_rule_on_the_filter(capsys):
    assert main(["evaluate", "--controller", "skyhook", *SMALL, *MEASURED, "--json"]) == 0
    filtered = json.loads(capsys.readouterr().out)["rows"][0]
    assert main(["evaluate", "--controller", "skyhook", *SMALL, "--json"]) == 0
    seen = json.loads(capsys.readouterr().out)["rows"][0]
    assert seen["cost"] + 4 * seen["standard_error"] < filtered["cost"] < 0.98  # which the best constant damping costs


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (["evaluate", "--controller", "skyhook", "--observation", "travel"], "--observation cannot be given with --controller"),
        (["evaluate", "--controller", "skyhook", "--road", "harmonic", *MEASURED], "got a harmonic road"),
        (["compare", "--road", "harmonic", *MEASURED, "--output", "results"], "got a harmonic road"),
        (["train", "--road", "harmonic", *MEASURED, "--output", "agent"], "got a harmonic road"),
    ],
)
def test_commands_refuse_in_one_line(command, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(command) == 2
    told = capsys.readouterr().err.strip()
    assert message in told
    assert "\n" not in told
    assert not list(tmp_path.glob("*/*"))


def test_a_comparison_has_rules_on_the_filter_beside_the_reference():
    environment = {"road": "gaussian", "speed": (1.0, 2.0), **SENSORS}
    rivals = make_rivals(make_task(road="gaussian"), ["d_min", "skyhook"], "kalman", make_task(**environment))
    assert list(rivals) == ["analytic_optimum", "d_min", "skyhook, filtered"]
    compared = agents.compare(
        None,
        environment=environment,
        speeds=[1.5],
        bandwidths=[0.1],
        controllers=["d_min", "skyhook", "skyhook_continuous"],
        episodes=16,
        estimator="kalman",
        report=lambda *_: None,
    )
    assert set(compared.controllers) == {"analytic_optimum", "d_min", "skyhook, filtered", "skyhook_continuous, filtered"}
    text = " ".join(table(compared).split())
    assert "continuous skyhook, filtered" in text
    assert "sensors tell travel, acceleration" in text
