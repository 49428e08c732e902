"""Training, the agent's folder, and the stable-baselines3 adapter."""

import json
import shutil

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RescaleAction
from stable_baselines3.common.vec_env import DummyVecEnv

import agents
import roadgym
from agents.training import AgentError, load_hyperparameters, plain, training_seed
from agents.vec_env import QuarterCarVecEnv, damping_from_action
from roadgym import ParameterError

SMALL = {
    "n_envs": 4,
    "n_timesteps": 256,
    "policy": "MlpPolicy",
    "normalize": {"norm_obs": False, "norm_reward": True},
    "features": ["signals", "products"],
    "n_steps": 16,
    "batch_size": 32,
    "n_epochs": 1,
    "learning_rate": "lin_0.001",
    "policy_kwargs": {"net_arch": [8], "activation_fn": "ReLU"},
}
ENVIRONMENT = {"road": "multiplicative", "speed": [0.7, 2.0], "bandwidth": [0.1, 0.3]}


def small_agent(folder, **options):
    return agents.train(folder, environment=ENVIRONMENT, hyperparameters=SMALL, **options)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("agent") / "ppo"
    return folder, small_agent(folder, seed=3, checkpoint_interval=100)


OBSERVATIONS = np.random.default_rng(2).uniform(0, 0.7, (11, 6)).astype(np.float32)


def test_agent_answers_with_damping_ratios(trained):
    _, agent = trained
    damping, _ = agent.predict(OBSERVATIONS)
    assert damping.shape == (11, 1)
    assert np.all((damping >= np.float32(0.05)) & (damping <= 1))
    assert agent.predict(OBSERVATIONS[0])[0] == pytest.approx(damping[0])


def test_loaded_agent_is_the_trained_one(trained):
    folder, agent = trained
    loaded = agents.load(folder)
    np.testing.assert_array_equal(loaded.predict(OBSERVATIONS)[0], agent.predict(OBSERVATIONS)[0])
    description = json.loads((folder / "agent.json").read_text())
    assert description["environment"] == ENVIRONMENT
    assert description["hyperparameters"] == SMALL
    assert description["seed"] == 3
    assert description["timesteps"] == 256
    assert set(description["versions"]) >= {"python", "roadgym", "torch", "stable-baselines3", "gymnasium"}
    assert sorted(path.name for path in folder.iterdir()) == ["agent.json", "model-256.zip"]


def test_seed_fixes_training(trained, tmp_path):
    _, agent = trained
    again = small_agent(tmp_path / "again", seed=3, checkpoint_interval=100)
    other = small_agent(tmp_path / "other", seed=4)
    np.testing.assert_array_equal(again.predict(OBSERVATIONS)[0], agent.predict(OBSERVATIONS)[0])
    assert not np.array_equal(other.predict(OBSERVATIONS)[0], agent.predict(OBSERVATIONS)[0])
    seeds = [training_seed(seed, 0) for seed in range(100)]
    assert np.min(np.diff(np.sort(seeds))) > 10**6  # batches of environments with neighbouring seeds do not overlap


def test_interrupted_training_keeps_its_last_checkpoint_and_resumes(tmp_path):
    folder = tmp_path / "agent"

    def interrupt(done, total, reward):
        if done >= 150:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        small_agent(folder, seed=3, checkpoint_interval=100, report=interrupt)
    part = agents.load(folder)
    assert 100 <= part.description["timesteps"] < 256
    with pytest.raises(AgentError, match="holds an agent already"):
        small_agent(folder, seed=3)
    done = agents.train(folder, resume=True)
    assert 256 <= done.description["timesteps"] < 256 + 64  # whole rollouts of 4 environments and 16 steps
    assert done.description["reward_statistics"]["count"] > part.description["reward_statistics"]["count"]
    again = agents.train(folder, resume=True)
    assert again.description == done.description  # nothing was left to do


def test_killed_while_saving_leaves_a_sound_agent(tmp_path, monkeypatch):
    folder = tmp_path / "agent"
    written = []

    def stop(path, text):
        if written:
            raise OSError("the disk is full")
        written.append(path)
        path.write_text(text)

    monkeypatch.setattr("agents.training.write_atomically", stop)
    with pytest.raises(OSError, match="disk is full"):
        small_agent(folder, seed=3, checkpoint_interval=64)
    assert agents.load(folder).description["timesteps"] == 64


@pytest.mark.parametrize("damage", ["missing", "no description", "not json", "foreign", "no model", "truncated", "other shape"])
def test_unusable_folders_are_told_in_one_line(trained, tmp_path, damage):
    folder = tmp_path / "agent"
    shutil.copytree(trained[0], folder)
    description = json.loads((folder / "agent.json").read_text())
    model = folder / description["model"]
    if damage == "missing":
        shutil.rmtree(folder)
    elif damage == "no description":
        (folder / "agent.json").unlink()
    elif damage == "not json":
        (folder / "agent.json").write_text("{")
    elif damage == "foreign":
        (folder / "agent.json").write_text('{"name": "someone else"}')
    elif damage == "no model":
        model.unlink()
    elif damage == "truncated":
        model.write_bytes(model.read_bytes()[:-2000])
    elif damage == "other shape":
        description["hyperparameters"]["features"] = ["signals"]
        (folder / "agent.json").write_text(json.dumps(description))
    with pytest.raises(AgentError, match=str(folder)) as caught:
        agents.load(folder)
    assert "\n" not in str(caught.value)


def test_output_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(AgentError, match="cannot write to the folder"):
        small_agent(tmp_path / "file" / "agent")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"learning_rate": "lin_fast"}, "learning_rate must be a number or lin_<number>"),
        ({"lerning_rate": 0.1}, "hyperparameters of ppo: .*lerning_rate"),
        ({"n_envs": 0}, "n_envs must be at least 1"),
        ({"normalize": {"norm_obs": True}}, "norm_obs must be false"),
        ({"policy_kwargs": {"activation_fn": "Relu6000"}}, "unknown activation_fn 'Relu6000'"),
        ({"features": ["cubes"]}, "features must be a selection of signals, products"),
        ({"n_timesteps": 0}, "timesteps must be at least 1"),
    ],
)
def test_bad_hyperparameters_are_refused_by_name(tmp_path, change, message):
    with pytest.raises(ParameterError, match=message):
        agents.train(tmp_path / "agent", environment=ENVIRONMENT, hyperparameters=SMALL | change)


def test_hyperparameter_files(tmp_path):
    assert load_hyperparameters("ppo")["policy"] == "MlpPolicy"
    with pytest.raises(ParameterError, match="unknown algorithm 'dreamer'; known: ppo"):
        load_hyperparameters("dreamer")
    file = tmp_path / "own.yaml"
    file.write_text("CartPole-v1: {n_envs: 3}")
    with pytest.raises(ParameterError, match="holds no hyperparameters for roadgym/QuarterCar-v0"):
        load_hyperparameters("ppo", file)
    file.write_text("a: [")
    with pytest.raises(ParameterError, match="cannot read hyperparameters"):
        load_hyperparameters("ppo", file)


def test_roads_become_plain_mappings():
    road = roadgym.MultiplicativeRoad(bandwidth=0.2)
    content = plain({"road": road, "speed": (1.0, np.float64(2.0))})
    assert json.loads(json.dumps(content))["road"]["kind"] == "multiplicative"
    assert roadgym.roads.make_road(content["road"]) == road


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
