"""Kalman filters that are driven again in torch: what they know, gradients, and what is learned on them in seconds."""

import numpy as np
import pytest
import torch
from gradients import SMALL, check_gradient

import agents
from agents.differentiable_filter import DrivenFilter
from agents.evaluation import evaluate
from agents.report import theory_given
from agents.training import load_hyperparameters, make_model
from agents.vec_env import QuarterCarVecEnv
from roadgym import ParameterError

RANGES = {"speed": (0.7, 3.0), "bandwidth": (0.1, 0.4)}
SENSED = {"observation": ["travel", "acceleration"], "sensors": {"noise": 0.05}}
TOLD = {"observation": ["travel", "acceleration", "speed", "bandwidth"], "sensors": {"noise": 0.05}}
PLANTS = {
    "bounded": {"road": "multiplicative", **RANGES, **TOLD},
    "one point": {"road": "gaussian", "speed": 1.5, "bandwidth": 0.1, **SENSED},
    "two masses": {"road": "iso_c", "car": "two_mass", "speed": 20.0, **SENSED},
    "hidden": {"road": "gaussian", **RANGES, **SENSED, "observe_operating_point": False},
    "cars that differ": {
        "road": "gaussian",
        "speed": (0.7, 3.0),
        "bandwidth": 0.2,
        **SENSED,
        "vary": {"natural_frequency": [0.6, 1.4]},
    },
    "third order": {"road": "two_corner", "speed": 1.0, "observation": ["velocity"], "sensors": {"noise": 0.01}},
}
FILTER = SMALL | {"estimator": "kalman"}


def driven(environment, steps, last=None, seed=3, number=32, estimator="kalman"):
    """What a batch drove, with dampings all over the range; ``last`` is the place of that of the last interval."""
    envs = QuarterCarVecEnv(number, environment=environment, features=["signals"], estimator=estimator)
    envs.seed(seed)
    roads = envs.driven_roads(steps)
    seen, rng = envs.reset(), np.random.default_rng(1)
    for step in range(steps):
        roads.note(step, *envs.road_and_car())
        action = rng.uniform(-1, 1, (number, 1)).astype(np.float32)
        if last is not None and step == steps - 1:
            action[:] = last
        before, (seen, _, ended, _) = seen, envs.step(action)
        roads.answer(step, before, action, ended)
    roads.note(steps, *envs.road_and_car())
    roads.finish()
    return roads, seen


def again(roads, start, last):
    """What the filters of ``roads`` tell before step ``last``, driven again from ``start`` on by the same dampings."""
    follow = roads._filter.begin(start)
    for step in range(start + 1, last + 1):
        place = torch.from_numpy(roads._places[step - 1])
        told = roads._sees(roads._look(step), roads._car[step], place, step, follow)
    return told.numpy()


@pytest.mark.parametrize("plant", PLANTS)
def test_filters_that_are_driven_again_know_the_same(plant):
    roads, _ = driven(PLANTS[plant], 40)
    noise = PLANTS[plant]["sensors"]["noise"]
    assert float(roads._filter._errors.std()) == pytest.approx(noise, rel=0.1)  # sensors err as much as they do
    np.testing.assert_allclose(again(roads, 2, 39), roads._seen[39], rtol=1e-3, atol=1e-3)


def test_what_another_damping_does_to_what_is_known_is_what_the_filter_does():
    """The same roads and noise twice, with another damping in one interval: what the filter tells changes as the model says."""
    (roads, first), (_, second) = (driven(PLANTS["bounded"], 40, last=place) for place in (-0.2, 0.2))
    follow = [roads._filter.begin(39) for _ in range(2)]
    told = []
    for place, after in zip((-0.2, 0.2), follow, strict=True):
        places = torch.full((32,), place)
        car = roads._cars[39].moved(roads._car[39], roads._forced[39], places)
        told.append(roads._sees(roads._look(39), car, places, 40, after).numpy())
    changed = second - first
    assert np.abs(told[1] - told[0] - changed).max() < 0.03 * np.abs(changed).max()


def test_first_the_state_is_known_and_then_what_the_filter_makes_of_sensors(monkeypatch):
    (roads, _), (plain, _) = driven(PLANTS["bounded"], 12), driven({"road": "multiplicative", **RANGES}, 12, estimator=None)
    seen = roads._sees(roads._look(11), roads._car[11], torch.from_numpy(roads._places[10]), 11, None)
    np.testing.assert_allclose(seen, plain._seen[11], rtol=1e-4, atol=1e-4)  # that of a batch with no sensors
    begun = []
    monkeypatch.setattr(DrivenFilter, "begin", lambda driven, *_: begun.append(model.num_timesteps))
    model = make_model("apg", load_hyperparameters("apg") | FILTER | {"state_known": 0.5}, PLANTS["bounded"], 3, None)
    model.learn(4 * 512)
    assert begun == [3 * 512] * 4 + [4 * 512] * 4


@pytest.mark.parametrize("plant", ["bounded", "two masses", "cars that differ"])
def test_gradients_are_those_of_finite_differences(plant):
    chosen = load_hyperparameters("apg") | FILTER | {"noise": 0.0, "policy_kwargs": {"net_arch": [8], "activation_fn": "Tanh"}}
    model = make_model("apg", chosen, PLANTS[plant], 3, None)
    model.learn(model.n_envs * model.n_steps)
    check_gradient(model.rollout_buffer, model.policy.network)


def test_seconds_of_training_save_most_of_what_sensors_can(tmp_path):
    """Where speed and bandwidth are hidden: a bank finds them when the agent drives."""
    ranges = {"speed": (1.0, 2.0), "bandwidth": (0.1, 0.3)}
    environment = {"road": "multiplicative", **ranges, **SENSED, "observe_operating_point": False}
    chosen = {"n_envs": 64, "n_steps": 32, "horizon": 16, "gradient_steps": 8, "n_timesteps": 16 * 2048}
    agent = agents.train(
        tmp_path / "a",
        environment=environment,
        algorithm="apg",
        hyperparameters=load_hyperparameters("apg") | FILTER | chosen,
    )
    assert agent.description["filter_told"] == ["speed", "bandwidth"]
    assert "where the filter was told speed and bandwidth, with" in theory_given(agent)
    assert len(agent.filter.bank) == 25
    size = {"speeds": [1.5], "bandwidths": [0.1], "episodes": 16, "duration": 100.0}
    found = evaluate({"agent": agent}, environment=environment, **size)["agent"]
    assert found.mean < 0.5  # the best constant damping costs .982, certainty equivalence .290


@pytest.mark.parametrize(
    "changes",
    [
        {"sensors": {"noise": 0.05, "delay": 0.2}},
        {"sensors": {"noise": 0.05, "bias": 0.1}},
        {"valve": {"rise_time": 0.1}},
    ],
)
def test_what_is_more_than_a_plain_filter_is_refused(changes):
    with pytest.raises(ParameterError, match="sensors must be ideal but for noise and resolution, and the valve ideal, for"):
        make_model("apg", load_hyperparameters("apg") | FILTER, PLANTS["bounded"] | changes, 0, None)
