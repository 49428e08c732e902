"""The environment among its neighbours: stable-baselines3, sb3-contrib, Gymnasium's wrappers, and rl-baselines3-zoo's files."""

import importlib
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
import torch
import yaml
from gymnasium import spaces, wrappers
from gymnasium.wrappers import vector as vector_wrappers
from sb3_contrib import TQC, RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

import agents
import roadgym
from agents.training import ALGORITHMS, HYPERPARAMETERS, algorithm_class, load_hyperparameters, make_model
from agents.vec_env import QuarterCarVecEnv
from roadgym.task import make_task

ID = "roadgym:roadgym/QuarterCar-v0"
LIMIT = 20
LOW, HIGH = 0.2, 0.9
PLANT = {"speed": (0.7, 2.0), "damping_range": (LOW, HIGH)}


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Small networks train fastest on one thread."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def single(**options):
    return gymnasium.make(ID, **({"max_episode_steps": LIMIT} | PLANT | options))


def batch(num_envs=4, **options):
    return gymnasium.make_vec(ID, num_envs=num_envs, **({"max_episode_steps": LIMIT} | PLANT | options))


def actions_for(shape):
    return np.random.default_rng(5).uniform(LOW, HIGH, shape).astype(np.float32)


def test_a_batch_needs_no_import_of_ours():
    code = (
        f"import gymnasium; e = gymnasium.make_vec({ID!r}, num_envs=3); print(type(e.unwrapped).__name__, *e.reset()[0].shape)"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True)
    assert done.stdout.split() == ["QuarterCarVectorEnv", "3", "6"], done.stderr


# stable-baselines3


def rescaled(env):
    return wrappers.RescaleAction(env, np.float32(-1), np.float32(1))


def test_processes_of_stable_baselines3_drive_the_same_roads():
    options = {"n_envs": 2, "seed": 9, "env_kwargs": PLANT | {"max_episode_steps": LIMIT}, "wrapper_class": rescaled}
    local = make_vec_env(ID, vec_env_cls=DummyVecEnv, **options)
    others = make_vec_env(ID, vec_env_cls=SubprocVecEnv, **options)
    try:
        np.testing.assert_array_equal(others.reset(), local.reset())
        ends = 0
        for action in np.random.default_rng(3).uniform(-1, 1, (LIMIT + 5, 2, 1)).astype(np.float32):
            found, expected = others.step(action), local.step(action)
            for a, b in zip(found[:3], expected[:3], strict=True):
                np.testing.assert_array_equal(a, b)
            for i in np.flatnonzero(expected[2]):
                assert found[3][i]["TimeLimit.truncated"]
                assert found[3][i]["episode"]["r"] == expected[3][i]["episode"]["r"]
                np.testing.assert_array_equal(found[3][i]["terminal_observation"], expected[3][i]["terminal_observation"])
                ends += 1
        assert ends == 2
    finally:
        others.close()


@pytest.mark.parametrize("native", [False, True])
def test_evaluate_policy_pays_what_the_episodes_pay(native):
    """A controller in evaluate_policy earns the rewards that stepping by hand adds up."""
    task = make_task(**PLANT)
    controller = agents.make_controller("skyhook", task)
    if native:  # the adapter maps actions in [-1, 1] onto the range

        class Mapped:
            def predict(self, observation, state=None, episode_start=None, deterministic=True):
                damping, state = controller.predict(observation, state, episode_start, deterministic)
                return 2 * (damping - LOW) / (HIGH - LOW) - 1, state

        model, envs = Mapped(), QuarterCarVecEnv(3, max_episode_steps=LIMIT, environment=PLANT)
    else:
        model, envs = controller, make_vec_env(ID, n_envs=3, env_kwargs=PLANT | {"max_episode_steps": LIMIT})
    envs.seed(31)
    rewards, lengths = evaluate_policy(model, envs, n_eval_episodes=6, return_episode_rewards=True)
    assert lengths == [LIMIT] * 6
    expected = np.zeros((2, 3))
    for i in range(3):
        env = single()
        for episode in range(2):
            observation, _ = env.reset(seed=31 + i if episode == 0 else None)
            for _ in range(LIMIT):
                observation, reward, *_ = env.step(controller.predict(observation)[0])
                expected[episode, i] += reward
    assert rewards == pytest.approx(expected.ravel().tolist(), rel=1e-4)


# sb3-contrib


def test_tqc_learns_from_truncated_episodes():
    envs = QuarterCarVecEnv(4, max_episode_steps=LIMIT, environment=PLANT)
    model = TQC("MlpPolicy", envs, seed=1, learning_starts=40, batch_size=32, buffer_size=1000, policy_kwargs={"net_arch": [8]})
    before = [parameter.clone() for parameter in model.actor.parameters()]
    model.learn(4 * (2 * LIMIT + 1))
    assert any(not torch.equal(a, b) for a, b in zip(before, model.actor.parameters(), strict=True))
    buffer = model.replay_buffer
    size = buffer.pos
    assert np.flatnonzero(buffer.timeouts[:size].all(axis=1)).tolist() == [LIMIT - 1, 2 * LIMIT - 1]
    assert not buffer._get_samples(np.array([LIMIT - 1])).dones.any()  # the value of the last observation is bootstrapped
    # what followed a truncated step is the last observation of its episode, not the first of the next
    assert np.all(buffer.next_observations[LIMIT - 1, :, :5] != buffer.observations[LIMIT, :, :5])
    np.testing.assert_array_equal(buffer.next_observations[: LIMIT - 1], buffer.observations[1:LIMIT])
    episode = buffer.rewards[:LIMIT].sum(axis=0)
    assert [info["r"] for info in list(model.ep_info_buffer)[:4]] == pytest.approx(episode.tolist(), rel=1e-5)


def test_recurrent_policy_learns_and_remembers():
    envs = QuarterCarVecEnv(4, max_episode_steps=LIMIT, environment=PLANT)
    network = {"net_arch": [8], "lstm_hidden_size": 8}
    model = RecurrentPPO("MlpLstmPolicy", envs, seed=1, n_steps=30, batch_size=40, n_epochs=1, policy_kwargs=network)
    before = [parameter.clone() for parameter in model.policy.parameters()]
    model.learn(240)
    assert any(not torch.equal(a, b) for a, b in zip(before, model.policy.parameters(), strict=True))
    assert {info["l"] for info in model.ep_info_buffer} == {LIMIT}
    observation = envs.reset()
    start, later = np.ones(4, np.bool_), np.zeros(4, np.bool_)
    first, memory = model.predict(observation, None, start, deterministic=True)
    second, _ = model.predict(observation, memory, later, deterministic=True)
    forgotten, _ = model.predict(observation, memory, start, deterministic=True)
    assert not np.array_equal(second, first)
    np.testing.assert_allclose(forgotten, first, atol=1e-6)


# Gymnasium's wrappers


def test_statistics_of_an_episode():
    env, raw = wrappers.RecordEpisodeStatistics(single()), single()
    env.reset(seed=2), raw.reset(seed=2)
    total = 0.0
    for action in actions_for((LIMIT, 1)):
        *_, info = env.step(action)
        total += raw.step(action)[1]
    assert info["episode"]["r"] == pytest.approx(total, rel=1e-6)
    assert info["episode"]["l"] == LIMIT


def test_statistics_of_the_episodes_of_a_batch():
    envs, raw = vector_wrappers.RecordEpisodeStatistics(batch()), batch()
    envs.reset(seed=2), raw.reset(seed=2)
    total, found = np.zeros(4), []
    for action in actions_for((2 * LIMIT + 1, 4, 1)):  # the first step of the second episode is a reset, and pays nothing
        *_, truncated, info = envs.step(action)
        total += raw.step(action)[1]
        if truncated.any():
            found.append((info["episode"]["r"], info["episode"]["l"], total.copy()))
            total[:] = 0
    assert len(found) == 2
    for returns, lengths, expected in found:
        assert returns == pytest.approx(expected, rel=1e-5)
        assert lengths.tolist() == [LIMIT] * 4


def test_normalised_observations():
    steps = 4000
    env, raw = wrappers.NormalizeObservation(single(max_episode_steps=None)), single(max_episode_steps=None)
    env.reset(seed=2)
    seen, plain = [], [raw.reset(seed=2)[0]]
    for action in actions_for((steps, 1)):
        seen.append(env.step(action)[0])
        plain.append(raw.step(action)[0])
    np.testing.assert_allclose(env.obs_rms.mean, np.mean(plain, axis=0), atol=1e-4)
    np.testing.assert_allclose(env.obs_rms.var[:4], np.var(plain, axis=0)[:4], rtol=1e-3)
    late = np.array(seen[steps // 2 :])[:, :4]  # the operating point does not change in an episode
    assert np.all(np.abs(late.mean(axis=0)) < 0.3)
    assert late.var(axis=0) == pytest.approx(1, abs=0.3)


def test_normalised_observations_of_a_batch():
    envs = vector_wrappers.NormalizeObservation(batch(512, max_episode_steps=None))
    envs.reset(seed=2)
    for action in actions_for((100, 512, 1)):
        observations, *_ = envs.step(action)
    assert observations[:, :5].mean(axis=0) == pytest.approx(0, abs=0.15)
    assert observations[:, 1:5].var(axis=0) == pytest.approx(1, abs=0.2)
    assert np.ptp(observations[:, 5]) == 0  # all drive at the road's own bandwidth


@pytest.mark.parametrize("many", [False, True])
def test_normalised_rewards(many):
    steps, gamma = 400, 0.9
    make, normalise = (batch, vector_wrappers.NormalizeReward) if many else (single, wrappers.NormalizeReward)
    env, raw = normalise(make(max_episode_steps=None), gamma=gamma), make(max_episode_steps=None)
    env.reset(seed=2), raw.reset(seed=2)
    returns, value = [], 0.0
    for action in actions_for((steps, 4, 1) if many else (steps, 1)):
        scaled, plain = env.step(action)[1], raw.step(action)[1]
        value = gamma * value + plain
        returns.append(value)
    assert scaled == pytest.approx(plain / np.std(returns), rel=1e-3)


def test_stacked_frames_are_the_last_observations():
    env, raw = wrappers.FrameStackObservation(single(), 3), single()
    stacked, frames = env.reset(seed=2)[0], [raw.reset(seed=2)[0]] * 3
    np.testing.assert_array_equal(stacked, frames)
    for action in actions_for((6, 1)):
        stacked = env.step(action)[0]
        frames = [*frames[1:], raw.step(action)[0]]
        np.testing.assert_array_equal(stacked, frames)
        assert stacked in env.observation_space


@pytest.mark.parametrize(("action", "damping"), [(-1.0, LOW), (-0.5, 0.375), (0.0, 0.55), (1.0, HIGH)])
def test_rescaled_actions_reach_the_damper(action, damping):
    env = rescaled(single())
    env.reset(seed=2)
    assert env.step(np.array([action], np.float32))[4]["damping"] == pytest.approx(damping)
    envs = vector_wrappers.RescaleAction(batch(), np.float32(-1), np.float32(1))
    envs.reset(seed=2)
    assert envs.step(np.full((4, 1), action, np.float32))[4]["damping"] == pytest.approx(damping)


# the hyperparameter files of rl-baselines3-zoo

FILES = sorted(HYPERPARAMETERS.glob("*.yaml"))
ENVIRONMENT = {"road": "multiplicative", "speed": (0.5, 3.2)}


def read_as_the_zoo_does(file):
    """(arguments of the algorithm, n_envs, arguments of VecNormalize, the wrapper).

    What ``ExperimentManager._preprocess_hyperparams`` of rl-baselines3-zoo takes out, and what it makes objects of.
    """
    chosen = yaml.safe_load(file.read_text("utf-8"))[roadgym.ENVIRONMENT_ID]
    assert int(chosen.pop("n_timesteps")) > 0
    ((wrapper, options),) = (each for entry in chosen.pop("env_wrapper") for each in entry.items())
    module, _, name = wrapper.rpartition(".")
    wrap = getattr(importlib.import_module(module), name)
    chosen["policy_kwargs"] = eval(chosen["policy_kwargs"], {"nn": torch.nn})
    for name in ("learning_rate", "clip_range", "clip_range_vf", "delta_std"):
        if isinstance(chosen.get(name), str):
            kind, start = chosen[name].split("_")
            assert kind == "lin"
            chosen[name] = lambda progress, start=float(start): progress * start
    if (kind := chosen.pop("noise_type", None)) is not None:
        assert kind == "normal"
        chosen["action_noise"] = NormalActionNoise(np.zeros(1), chosen.pop("noise_std") * np.ones(1))
    normalise = chosen.pop("normalize", {})
    assert isinstance(normalise, dict)  # a string would be evaluated as Python
    if "gamma" in chosen:
        normalise["gamma"] = chosen["gamma"]
    return chosen, chosen.pop("n_envs", 1), normalise, lambda env: wrap(env, **options)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_hyperparameter_files_are_those_of_the_zoo(file):
    algorithm = max((name for name in ALGORITHMS if file.stem.startswith(name)), key=len)
    small = {"buffer_size": 1000} if algorithm in ("sac", "td3", "dqn") else {}  # memory
    chosen, n_envs, normalise, wrap = read_as_the_zoo_does(file)
    batch = make_vec_env(ID, n_envs, env_kwargs=ENVIRONMENT, wrapper_class=wrap, vec_env_cls=QuarterCarVecEnv.from_functions)
    envs = VecNormalize(batch, **normalise)
    model = algorithm_class(algorithm)(env=envs, seed=0, device="cpu", **chosen | small)
    hyperparameters = load_hyperparameters(algorithm, file) | small
    ours = make_model(algorithm, hyperparameters, ENVIRONMENT, 0, None)
    for progress in (1.0, 0.4):
        assert ours.lr_schedule(progress) == pytest.approx(model.lr_schedule(progress))
    if model.get_vec_normalize_env().norm_reward:
        assert ours.gamma == model.gamma == ours.get_vec_normalize_env().gamma
    assert ours.n_envs == model.n_envs
    assert ours.policy.activation_fn is model.policy.activation_fn
    assert ours.policy.net_arch == model.policy.net_arch
    assert repr(ours.action_noise if hasattr(ours, "action_noise") else None) == repr(chosen.get("action_noise"))
    both = ours.get_env(), envs
    for each in both:
        each.seed(3)
    np.testing.assert_array_equal(both[0].reset(), both[1].reset())
    actions = np.array([envs.action_space.sample() for _ in range(n_envs)])
    for found, expected in zip(*(each.step(actions)[:3] for each in both), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_the_command_of_the_zoo_trains(tmp_path):
    pytest.importorskip("rl_zoo3")
    command = ["-m", "rl_zoo3.train", "--algo", "ppo", "--env", roadgym.ENVIRONMENT_ID, "--gym-packages", "roadgym"]
    command += ["--conf-file", str(HYPERPARAMETERS / "ppo.yaml"), "-f", str(tmp_path), "--device", "cpu", "--eval-freq", "-1"]
    small = ["-n", "256", "-params", "n_envs:4", "n_steps:32", "batch_size:64"]
    done = subprocess.run([sys.executable, *command, *small], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (file,) = tmp_path.glob("ppo/*/roadgym-QuarterCar-v0.zip")
    model = PPO.load(file)
    assert model.observation_space.shape == (18,)
    assert model.action_space == spaces.Box(-1, 1, (1,), np.float32)
