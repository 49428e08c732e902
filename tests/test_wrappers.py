"""The recipe that learns well as wrappers: single, batch and stable-baselines3's environments are one."""

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.env_checker import check_env

import roadgym
from agents import wrappers
from agents.vec_env import QuarterCarVecEnv
from roadgym import ParameterError

LIMIT = 7
PLANT = {"speed": (0.7, 2.0), "bandwidth": (0.1, 0.3), "damping_range": (0.1, 0.9)}
RECIPES = [
    {},
    {"features": None, "training_reward": "cost"},
    {"features": ["signals", "products"], "frame_stack": 3, "training_reward": "cost"},
    {"damping_levels": 3},
]


def single(**recipe):
    return wrappers.learning(gymnasium.make(roadgym.ENVIRONMENT_ID, max_episode_steps=LIMIT, **PLANT), **recipe)


def batch(n, mode="NEXT_STEP", **recipe):
    envs = gymnasium.make_vec(roadgym.ENVIRONMENT_ID, n, max_episode_steps=LIMIT, autoreset_mode=mode, **PLANT)
    return wrappers.learning(envs, **recipe)


def actions_for(recipe, steps, n):
    rng = np.random.default_rng(3)
    if "damping_levels" in recipe:
        return rng.integers(0, 3, (steps, n))
    return rng.uniform(-1, 1, (steps, n, 1)).astype(np.float32)


def drive(env, seed, actions):
    """(observations, rewards) of episodes one after the other, the first observation of each included."""
    seen, paid = [env.reset(seed=seed)[0]], []
    for action in actions:
        observation, reward, _, truncated, _ = env.step(action)
        seen.append(observation)
        paid.append(reward)
        if truncated:
            seen.append(env.reset()[0])
    return seen, paid


@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize("mode", ["NEXT_STEP", "SAME_STEP", "DISABLED"])
def test_a_batch_of_one_is_the_single_environment(recipe, mode):
    """Bit by bit, over the ends of episodes."""
    actions = actions_for(recipe, 2 * LIMIT + 3, 1)
    seen, paid = drive(single(**recipe), 5, [action[0] for action in actions])
    envs = batch(1, mode, **recipe)
    found, rewards = [envs.reset(seed=5)[0][0]], []
    for action in actions:
        observations, reward, _, truncated, info = envs.step(action)
        if truncated[0] and mode == "SAME_STEP":
            found.append(info["final_obs"][0])
        found.append(observations[0])
        rewards.append(reward[0])
        if truncated[0] and mode == "NEXT_STEP":
            observations, reward, *_ = envs.step(action)
            assert reward[0] == 0
            found.append(observations[0])
        if truncated[0] and mode == "DISABLED":
            found.append(envs.reset(options={"reset_mask": truncated})[0][0])
    np.testing.assert_array_equal(found, seen)
    np.testing.assert_array_equal(rewards, paid)


@pytest.mark.parametrize("recipe", RECIPES)
def test_the_batch_of_stable_baselines3_is_the_wrapped_batch(recipe):
    n = 5
    adapter = QuarterCarVecEnv(n, max_episode_steps=LIMIT, environment=PLANT, **{"training_reward": "advantage", **recipe})
    default = {"features": None} if "features" not in recipe else {}  # the adapter's
    envs = batch(n, "SAME_STEP", **recipe | default)
    adapter.seed(8)
    np.testing.assert_array_equal(adapter.reset(), envs.reset(seed=8)[0])
    for action in actions_for(recipe, 2 * LIMIT + 3, n):
        (seen, paid, done, infos), (observations, rewards, _, truncated, info) = adapter.step(action), envs.step(action)
        np.testing.assert_array_equal(seen, observations)
        np.testing.assert_array_equal(paid, rewards.astype(np.float32))
        np.testing.assert_array_equal(done, truncated)
        for i in range(n):
            assert {name: infos[i][name] for name in roadgym.MEAN_SQUARES} == {
                name: info[name][i] for name in roadgym.MEAN_SQUARES
            }
            if done[i]:
                np.testing.assert_array_equal(infos[i]["terminal_observation"], info["final_obs"][i])


def test_only_what_is_reset_begins_anew():
    envs, twin = (batch(2, "DISABLED", features=None, frame_stack=3) for _ in range(2))
    for each in (envs, twin):
        each.reset(seed=1)
        each.step(np.zeros((2, 1), np.float32))
        last = each.step(np.zeros((2, 1), np.float32))[0]
    begun = envs.reset(options={"reset_mask": np.array([True, False])})[0]
    np.testing.assert_array_equal(begun[1], last[1])
    assert np.ptp([begun[0, :4], begun[0, 6:10], begun[0, 10:]], axis=0).max() == 0  # the first observation three times
    action = np.full((2, 1), 0.5, np.float32)
    np.testing.assert_array_equal(envs.step(action)[0][1], twin.step(action)[0][1])


def test_infos_tell_the_cost_as_it_is():
    env, raw = single(), gymnasium.make(roadgym.ENVIRONMENT_ID, **PLANT)
    env.reset(seed=2), raw.reset(seed=2)
    for action in (-1.0, 0.0, 1.0):
        *_, info = env.step(np.array([action], np.float32))
        assert info["cost"] == pytest.approx(-raw.step(np.array([info["damping"]], np.float32))[1], rel=1e-6)


def test_where_theory_knows_no_advantage_the_cost_is_paid():
    env = wrappers.learning(gymnasium.make(roadgym.ENVIRONMENT_ID, road="harmonic"))
    env.reset(seed=1)
    _, reward, _, _, info = env.step(np.array([0.0], np.float32))
    assert "cost" not in info
    assert reward == pytest.approx(-info["displacement"] / env.unwrapped.task.road.variance)
    for wrapper, bare in ((wrappers.AdvantageReward, env), (wrappers.VectorAdvantageReward, None)):
        bare = bare or gymnasium.make_vec(roadgym.ENVIRONMENT_ID, 2, road="harmonic")
        with pytest.raises(ParameterError, match="a plant whose advantage theory knows"):
            wrapper(bare)


@pytest.mark.parametrize("recipe", RECIPES)
def test_the_wrapped_environment_is_one_of_gymnasium(recipe):
    env = single(**recipe)
    check_env(env, warn=False)
    again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.observation_space == env.observation_space
    assert again.action_space == env.action_space
    seen, expected = (drive(each, 4, [a[0] for a in actions_for(recipe, 3, 1)]) for each in (again, env))
    np.testing.assert_array_equal(seen[0], expected[0])
    np.testing.assert_allclose(seen[1], expected[1], rtol=1e-3)  # what was paid before counts
    envs = batch(3, **recipe)
    observations, *_ = envs.step(envs.action_space.sample()) if envs.reset(seed=1) else ()
    assert observations in envs.observation_space


def test_other_environments_and_rewards_are_refused():
    with pytest.raises(ParameterError, match="env must be a roadgym environment, got <"):
        wrappers.learning(gymnasium.make("CartPole-v1"))
    with pytest.raises(ParameterError, match='training_reward must be "cost" or "advantage", got \'comfort\''):
        single(training_reward="comfort")
    for env in (single(), batch(2)):
        with pytest.raises(ParameterError, match=r"env must take damping ratios, got one within \w+ already: wrap it once"):
            wrappers.learning(env)
