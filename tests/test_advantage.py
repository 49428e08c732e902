"""The advantage by theory, and learning from it."""

import numpy as np
import pytest
from scipy.linalg import solve_continuous_lyapunov

import agents
from agents.advantage import advantage_forms, has_advantage
from agents.controllers import make_controller, optimum, theoretical_cost
from agents.features import Features
from agents.vec_env import QuarterCarVecEnv
from analysis.quadratic import plant_system, value_form
from roadgym import ParameterError
from roadgym.plant import Plant
from roadgym.task import make_task

ENVIRONMENT = {"road": "multiplicative", "speed": (0.7, 3.0), "bandwidth": (0.1, 0.3)}
STATE = ("displacement", "velocity", "level", "slope")
WEIGHTS = {"displacement": 1.0, "velocity": 0.2, "acceleration": 0.3, "travel": 0.5, "relative_velocity": 0.1}


def stationary(damping, ratio, bandwidth):
    drift = np.zeros((4, 4))  # of (Y, X, Z, U), (7) and (13) of the paper
    drift[0, 1], drift[1] = 1, (-1, -2 * damping, 1, 2 * damping * ratio)
    drift[2, 3], drift[3, 2:] = ratio, (-ratio, -2 * bandwidth * ratio)
    return solve_continuous_lyapunov(drift, -np.diag([0, 0, 0, 4 * bandwidth * ratio]))


@pytest.mark.parametrize("reference", [0.3, 0.9])
@pytest.mark.parametrize("road", ["gaussian", "multiplicative"])
def test_mean_advantage_is_the_difference_of_costs(road, reference):
    """The performance difference lemma, with closed forms on both sides."""
    task = make_task(**{**ENVIRONMENT, "road": road}, reward=WEIGHTS)
    dampings = np.array([0.05, 0.3, 0.9])
    forms, constants = advantage_forms(task, dampings, [reference], [1.3], [0.2])
    _, mean_cost = value_form(plant_system(task, reference, 1.3, 0.2), WEIGHTS)
    assert mean_cost == pytest.approx(theoretical_cost(task, reference, 1.3, 0.2))
    for damping, form, constant in zip(dampings.tolist(), forms[0], constants[0], strict=True):
        found = np.trace(form @ stationary(damping, 1.3, 0.2)) + constant
        expected = theoretical_cost(task, damping, 1.3, 0.2) - theoretical_cost(task, reference, 1.3, 0.2)
        # steps of fourth order, whose rates times the step are up to 0.08
        assert found / task.control_interval == pytest.approx(expected, rel=1e-5, abs=1e-5)


@pytest.mark.statistical
@pytest.mark.parametrize("road", ["gaussian", "multiplicative"])
def test_advantage_is_what_simulation_finds(road):
    """From one state, held for one interval: the cost, and the value of where it ends, on average."""
    task = make_task(road=road, speed=1.3, bandwidth=0.2, reward=WEIGHTS)
    state = np.array([0.8, -0.5, 0.6, -0.9])
    lanes = 200_000
    plant = Plant(task, lanes)
    value, mean_cost = value_form(plant_system(task, 0.3, 1.3, 0.2), WEIGHTS)
    found = []
    for damping in (0.05, 0.9):
        plant.start(np.arange(lanes, dtype=np.uint64))  # the same noise for both
        for name, number in zip(STATE, state.tolist(), strict=True):
            plant.set_row(name, number)
        interval = plant.step(np.full(lanes, damping, np.float32))
        after = np.stack([plant.row(name) for name in STATE], axis=1).astype(float)
        total = -interval.reward.astype(float) * task.control_interval + np.einsum("ni,ij,nj->n", after, value, after)
        found.append(total - state @ value @ state - mean_cost * task.control_interval)
    forms, constants = advantage_forms(task, [0.05, 0.9], [0.3], [1.3], [0.2])
    expected = np.einsum("i,kij,j->k", state, forms[0], state) + constants[0]
    difference = found[1] - found[0]
    error = difference.std() / np.sqrt(lanes)
    assert error < 0.01 * abs(expected[1] - expected[0])
    assert abs(difference.mean() - (expected[1] - expected[0])) < 4 * error + 2e-3 * abs(expected[1] - expected[0])
    assert abs(found[0].mean() - expected[0]) < 4 * found[0].std() / np.sqrt(lanes) + 2e-3 * abs(expected[0])


@pytest.mark.statistical
def test_rewards_average_to_the_cost_saved():
    """On the bounded road, for a policy that is not constant."""
    environment = {**ENVIRONMENT, "speed": 1.3, "bandwidth": 0.2}
    rewards, twins = (
        QuarterCarVecEnv(2048, max_episode_steps=10**6, environment=environment, training_reward=kind)
        for kind in ("advantage", "cost")
    )
    task, rival = twins.task, make_controller("skyhook", twins.task)
    for batch in (rewards, twins):  # the same roads for both
        batch.seed(3)
        observations = batch.reset()
    low, high = task.damping_range
    saved, cost = np.zeros(2048), np.zeros(2048)
    for step in range(600):
        damping, _ = rival.predict(observations)
        action = 2 * (damping - low) / (high - low) - 1
        observations, found, _, _ = rewards.step(action)
        _, paid, _, _ = twins.step(action)
        if step >= 200:
            saved += found / 400
            cost -= paid / 400
    best = optimum(task, 1.3, 0.2).cost
    expected = (best - cost) / np.sqrt(best)
    error = (saved - expected).std() / np.sqrt(2048)
    assert error < 0.02 * expected.mean()
    assert abs(saved.mean() - expected.mean()) < 4 * error + 2e-3 * expected.mean()


@pytest.mark.parametrize(
    ("environment", "known"),
    [
        ({"road": "gaussian"}, True),
        ({"road": "multiplicative"}, True),
        ({"road": "harmonic"}, False),
        ({"road": "first_order"}, True),
        ({"road": "iso_c", "speed": 20.0, "car": "two_mass"}, True),
        ({"road": "two_corner"}, False),
        ({"road": "gaussian", "speed_noise": "low_pass"}, False),
    ],
)
def test_plants_with_an_advantage(environment, known):
    assert has_advantage(make_task(**environment)) == known


def test_lookahead_features_are_differences_of_advantages():
    task = make_task(**ENVIRONMENT)
    generator = np.random.default_rng(5)
    points = generator.uniform([0.41, 0.2], [0.75, 0.37], (200, 2))  # as observed
    observations = np.concatenate([generator.normal(0, 1, (200, 4)), points], axis=1).astype(np.float32)
    firm, middle = Features(task, ["lookahead"])(observations)[:, 2:].T
    ratio, twice_bandwidth = (points / (1 - points)).T
    best = np.array([float(optimum(task, nu, d / 2).damping) for nu, d in zip(ratio, twice_bandwidth, strict=True)])
    forms, constants = advantage_forms(task, [0.05, 0.525, 1.0], best, ratio, twice_bandwidth / 2)
    state = observations[:, :4].astype(float)
    advantages = np.einsum("ni,nkij,nj->nk", state, forms, state) + constants
    # scaled, and interpolated between nodes of the operating point
    assert np.corrcoef(firm, advantages[:, 2] - advantages[:, 0])[0, 1] > 0.85
    clear = np.abs(firm) > 0.02
    assert clear.mean() > 0.8
    assert (np.sign(firm) == np.sign(advantages[:, 2] - advantages[:, 0]))[clear].all()
    assert (np.sign(middle) == np.sign(advantages[:, 1] - advantages[:, 0]))[np.abs(middle) > 0.02].all()


def test_lookahead_features_are_left_out_where_they_are_unknown():
    assert Features(make_task(**ENVIRONMENT), ["signals", "lookahead"]).size == 8
    for unknown in ({"observation": ["travel", "velocity"]}, {"speed_noise": "low_pass"}):
        task = make_task(**ENVIRONMENT, **unknown)
        assert Features(task, ["signals", "lookahead"]).size == len(task.signals)


TWO_MASSES = {
    "road": "iso_c",
    "speed": (15.0, 25.0),
    "car": "two_mass",
    "reward": {"acceleration": 1.0, "tyre_deflection": 1e4},
}


def test_two_masses_have_a_mean_advantage_too():
    """The performance difference lemma again, with theory's own mean costs on the one side."""
    task = make_task(**TWO_MASSES)
    dampings, ratio = np.array([0.08, 0.3, 0.9]), float(task.frequency_ratio(18.0))
    forms, constants = advantage_forms(task, dampings, [0.25], [ratio], [0.0])
    base = theoretical_cost(task, 0.25, 18.0, 0.0)
    for damping, form, constant in zip(dampings.tolist(), forms[0], constants[0], strict=True):
        system = plant_system(task, damping, ratio)
        found = np.trace(form @ system.covariance()) + constant
        expected = theoretical_cost(task, damping, 18.0, 0.0) - base
        interval = task.control_interval * task.car.natural_frequency
        assert found / interval == pytest.approx(expected, rel=1e-4, abs=1e-5 * base)


@pytest.mark.statistical
def test_two_masses_are_paid_what_they_save():
    """On average, for a policy that is not constant; and a damping that saves is seen among the features."""
    environment = {**TWO_MASSES, "speed": 20.0}
    batches = [
        QuarterCarVecEnv(512, max_episode_steps=10**6, environment=environment, training_reward=kind)
        for kind in ("advantage", "cost")
    ]
    task, rival = batches[0].task, make_controller("clipped_lqr", batches[0].task)
    low, high = task.damping_range
    sums = []
    for batch in batches:  # the same roads for both
        batch.seed(3)
        observations, total = batch.reset(), np.zeros(512)
        for step in range(1200):
            damping, _ = rival.predict(observations)
            observations, paid, _, _ = batch.step(2 * (damping - low) / (high - low) - 1)
            total += paid / 800 if step >= 400 else 0
        sums.append(total)
    best = optimum(task, 20.0, 0.0).cost
    expected = (best + sums[1]) / np.sqrt(best)
    error = (sums[0] - expected).std() / np.sqrt(512)
    assert expected.mean() > 0
    assert error < 0.05 * expected.mean()
    assert abs(sums[0].mean() - expected.mean()) < 4 * error + 2e-3 * expected.mean()
    features = Features(task, ["lookahead"])
    assert features.size == 3
    assert np.abs(features(observations)[:, 1:]).max() > 0.1


HYPERPARAMETERS = {
    "n_envs": 8,
    "n_steps": 16,
    "batch_size": 64,
    "n_epochs": 1,
    "n_timesteps": 256,
    "policy_kwargs": {"net_arch": [8]},
}


@pytest.mark.parametrize(
    ("environment", "asked", "used"),
    [
        (ENVIRONMENT, "advantage", "advantage"),
        ({**ENVIRONMENT, "observation": ["travel"], "observe_operating_point": False}, "advantage", "advantage"),
        (ENVIRONMENT, "cost", "cost"),
        ({"road": "harmonic", "speed_noise": "white"}, "advantage", "cost"),
    ],
)
def test_an_agent_tells_what_it_learned_from(environment, asked, used, tmp_path):
    agent = agents.train(tmp_path, environment=environment, hyperparameters={**HYPERPARAMETERS, "training_reward": asked})
    assert agent.description["training_reward"] == used
    envs = agent.model.get_env()
    envs.reset()
    actions = np.zeros((8, 1), np.float32)
    for _ in range(3):
        _, _, _, infos = envs.step(actions)
    saved = [
        reward + info["displacement"] / envs.get_attr("task")[0].road.variance
        for reward, info in zip(envs.get_original_reward().tolist(), infos, strict=True)
    ]
    assert (np.abs(saved).max() > 0.1) == (used == "advantage")


def test_an_unknown_training_reward_is_refused(tmp_path):
    with pytest.raises(ParameterError, match='training_reward must be "cost" or "advantage", got \'comfort\''):
        agents.train(tmp_path / "agent", hyperparameters={**HYPERPARAMETERS, "training_reward": "comfort"})
    assert not (tmp_path / "agent").exists()
