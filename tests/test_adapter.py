"""The stable-baselines3 adapter."""

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RescaleAction
from stable_baselines3.common.vec_env import DummyVecEnv

import roadgym
from agents.vec_env import QuarterCarVecEnv, damping_from_action

ENVIRONMENT = {"road": "multiplicative", "speed": [0.7, 2.0], "bandwidth": [0.1, 0.3]}


def test_discrete_actions_drive_like_the_damping_that_they_stand_for():
    chosen, direct = (
        QuarterCarVecEnv(3, environment=ENVIRONMENT, damping_levels=3),
        QuarterCarVecEnv(3, environment=ENVIRONMENT),
    )
    assert chosen.action_space.n == 3
    for envs in (chosen, direct):
        envs.seed(4)
        envs.reset()
    for _ in range(5):
        steps = chosen.step(np.array([0, 1, 2])), direct.step(np.array([[-1], [0], [1]], np.float32))
        np.testing.assert_array_equal(steps[0][0], steps[1][0])
        np.testing.assert_array_equal(steps[0][1], steps[1][1])


def test_adapter_equals_single_environments_in_a_dummy_vec_env():
    n, limit, low, high = 5, 6, np.float32(-1), np.float32(1)

    def single():
        return RescaleAction(gymnasium.make(roadgym.ENVIRONMENT_ID, max_episode_steps=limit, **ENVIRONMENT), low, high)

    native = QuarterCarVecEnv(n, max_episode_steps=limit, environment=ENVIRONMENT)
    dummy = DummyVecEnv([single] * n)
    for envs in (native, dummy):
        envs.seed(40)
    np.testing.assert_array_equal(native.reset(), dummy.reset())
    actions = np.random.default_rng(1).uniform(-1, 1, (15, n, 1)).astype(np.float32)
    returns = np.zeros(n)
    for k, action in enumerate(actions):
        (obs, rewards, dones, infos), (obs_2, rewards_2, dones_2, infos_2) = native.step(action), dummy.step(action)
        # the two rescale in other orders of operations: D differs in its last digit
        np.testing.assert_allclose(obs, obs_2, atol=2e-6)
        np.testing.assert_allclose(rewards, rewards_2, rtol=1e-4, atol=1e-6)
        np.testing.assert_array_equal(dones, dones_2)
        returns += rewards
        for info, info_2 in zip(infos, infos_2, strict=True):
            assert info.get("TimeLimit.truncated", False) == info_2["TimeLimit.truncated"]
            if dones[0]:
                np.testing.assert_allclose(info["terminal_observation"], info_2["terminal_observation"], atol=2e-6)
                assert info["episode"]["l"] == limit
        if dones[0]:
            assert [info["episode"]["r"] for info in infos] == pytest.approx(returns)
            returns[:] = 0
        assert dones.all() == ((k + 1) % limit == 0)


def test_actions_of_the_adapter_map_onto_the_range():
    assert damping_from_action(np.array([-1, 0, 1]), (0.05, 1.0)) == pytest.approx([0.05, 0.525, 1.0])


def test_adapter_answers_stable_baselines3():
    envs = QuarterCarVecEnv(3, environment=ENVIRONMENT)
    assert len(envs.get_attr("task")) == 3
    assert envs.get_attr("render_mode") == [None] * 3
    with pytest.raises(AttributeError, match="share their parameters"):
        envs.set_attr("task", None)
