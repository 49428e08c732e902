"""Evaluation of whatever answers observations: in damping ratios, or in actions of a space of its own."""

import re
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import PPO

import agents
import roadgym
from agents.wrappers import learning
from roadgym import ParameterError
from roadgym.task import make_task

ENVIRONMENT = {"speed": 1.0, "damping_range": (0.2, 0.6)}
POINT = {"environment": ENVIRONMENT, "speeds": [1.0], "bandwidths": [0.1], "episodes": 16, "duration": 10.0}


def always(action, space=None):
    """What answers with one action always; ``space`` is the action space that it has, as the models of libraries have."""

    def predict(observation, state=None, episode_start=None, deterministic=True):
        return np.array([action] * len(observation)), state

    given = {} if space is None else {"action_space": space}
    return SimpleNamespace(predict=predict, **given)


def test_a_model_of_other_observations_is_refused_with_what_to_do():
    model = PPO("MlpPolicy", learning(gymnasium.make(roadgym.ENVIRONMENT_ID, **ENVIRONMENT)), device="cpu")
    message = r"observation_space must have the shape \(6,\) of displacement, .*, got \(18,\): train with agents.train, or wrap"
    with pytest.raises(ParameterError, match=message):
        agents.evaluate({"model": model}, **POINT)


def test_who_has_no_task_observes_the_environment_whoever_drives_beside():
    widths = set()

    def predict(observation, state=None, episode_start=None, deterministic=True):
        widths.add(observation.shape[1])
        return np.full((len(observation), 1), 0.3, np.float32), state

    environment = ENVIRONMENT | {"observation": ["travel"], "observe_operating_point": False}
    whole = agents.make_controller("skyhook", make_task(**ENVIRONMENT))
    agents.evaluate({"narrow": SimpleNamespace(predict=predict), "whole": whole}, **POINT | {"environment": environment})
    assert widths == {1}


@pytest.mark.parametrize(
    ("action", "space", "damping"),
    [
        ([0.3], spaces.Box(0.2, 0.6, (1,), np.float32), 0.3),
        ([-0.5], spaces.Box(-1, 1, (1,), np.float32), 0.3),
        ([2.5], spaces.Box(0, 10, (1,), np.float64), 0.3),
        ([1.0], spaces.Box(-1, 1, (1,), np.float32), 0.6),
        (1, spaces.Discrete(5), 0.3),
        (4, spaces.Discrete(5, start=3), 0.3),
    ],
)
def test_an_action_drives_as_the_damping_that_it_stands_for(action, space, damping):
    found = agents.evaluate({"model": always(action, space), "damping": always([damping])}, **POINT)
    np.testing.assert_allclose(found["model"].costs, found["damping"].costs, rtol=1e-6)


@pytest.mark.parametrize(
    ("action", "space", "message"),
    [
        ([0.7], None, "action must lie within [0.2, 0.6], got 0.7"),
        ([-0.1], None, "action must lie within [0.2, 0.6], got -0.1"),
        ([1.5], spaces.Box(-1, 1, (1,), np.float32), "action must lie within [-1, 1], got 1.5"),
        (5, spaces.Discrete(5), "action must be integers from 0 to 4"),
        ([0.3], spaces.Box(0.1, 0.6, (1,), np.float32), "action_space must have the bounds of damping_range, (0.2, 0.6)"),
        ([0.3], spaces.Box(-np.inf, np.inf, (1,)), "action_space must be discrete or a bounded box of shape (1,)"),
        ([0.3, 0.3], spaces.Box(-1, 1, (2,)), "action_space must be discrete or a bounded box of shape (1,)"),
        ([1], spaces.MultiDiscrete([3]), "action_space must be discrete or a bounded box of shape (1,)"),
        (0, spaces.Discrete(1), "action_space must have at least 2 levels"),
    ],
)
def test_answers_that_stand_for_no_damping_are_refused(action, space, message):
    with pytest.raises(ParameterError, match=re.escape(message)):
        agents.evaluate({"model": always(action, space)}, **POINT)
