"""Files of hyperparameters, and what is refused of them."""

import re

import pytest
from test_training import ENVIRONMENT, SMALL, shrunken

import agents
import roadgym
from agents.agent import complete
from agents.training import load_hyperparameters
from roadgym import ParameterError


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
        ({"frame_stack": 0}, "frame_stack must be at least 1"),
        ({"damping_levels": 1}, "damping_levels must be at least 2"),
        ({"noise_std": -1}, "noise_std must not be negative"),
        ({"noise_std": 0.1}, "hyperparameters of ppo: .*action_noise"),
    ],
)
def test_bad_hyperparameters_are_refused_by_name(tmp_path, change, message):
    with pytest.raises(ParameterError, match=message):
        agents.train(tmp_path / "agent", environment=ENVIRONMENT, hyperparameters=SMALL | change)


@pytest.mark.parametrize(("algorithm", "own"), [("dqn", {"damping_levels": None}), ("sac", {"damping_levels": 2})])
def test_actions_that_an_algorithm_cannot_take_are_refused(tmp_path, algorithm, own):
    with pytest.raises(ParameterError, match=f"hyperparameters of {algorithm}: The algorithm only supports"):
        agents.train(
            tmp_path / "agent", algorithm=algorithm, environment=ENVIRONMENT, hyperparameters=shrunken(algorithm) | own
        )


def test_hyperparameter_files(tmp_path, monkeypatch):
    assert load_hyperparameters("ppo")["policy"] == "MlpPolicy"
    monkeypatch.chdir(tmp_path)  # a name is that of a shipped file wherever it is said
    assert load_hyperparameters("ppo", "ppo_scheduling") != load_hyperparameters("ppo")
    # the plain agent differs from the default one in what theory gives it, and in nothing else
    plain = {"training_reward": "cost", "features": ["signals", "products"]}
    assert load_hyperparameters("ppo", "ppo_plain") == load_hyperparameters("ppo") | plain
    with pytest.raises(ParameterError, match=r"cannot read hyperparameters from 'no.yaml': .* by name there are: a2c, "):
        load_hyperparameters("ppo", "no.yaml")
    with pytest.raises(ParameterError, match="unknown algorithm 'dreamer'; known: apg, ppo, sac, td3, "):
        load_hyperparameters("dreamer")
    file = tmp_path / "own.yaml"
    file.write_text("CartPole-v1: {n_envs: 3}")
    with pytest.raises(ParameterError, match="holds no hyperparameters for roadgym/QuarterCar-v0"):
        load_hyperparameters("ppo", file)
    file.write_text("a: [")
    with pytest.raises(ParameterError, match="cannot read hyperparameters"):
        load_hyperparameters("ppo", file)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{env_wrapper: gymnasium.wrappers.TimeLimit}", "env_wrapper must be agents.wrappers.learning alone, got 'gymnasium"),
        (
            "{env_wrapper: [agents.wrappers.learning, other.one]}",
            "env_wrapper must be agents.wrappers.learning alone, got ['",
        ),
        (
            "{features: [signals], env_wrapper: {agents.wrappers.learning: {features: [products]}}}",
            "features must stand in the file once, got ['signals'] beside ['products']",
        ),
        ("{noise_type: ornstein-uhlenbeck}", "noise_type must be normal, got 'ornstein-uhlenbeck'"),
        ("{policy_kwargs: \"dict(net_arch=open('x'))\"}", "policy_kwargs must be a mapping, or dict(...) of plain values and "),
        ('{policy_kwargs: "print(1)"}', "policy_kwargs must be a mapping, or dict(...) of plain values and classes of nn"),
        (
            '{normalize: "dict(True)"}',
            "normalize must be a mapping, or dict(...) of plain values and classes of nn, got",
        ),
    ],
)
def test_what_a_file_of_the_zoo_may_not_ask_for(tmp_path, content, message):
    file = tmp_path / "own.yaml"
    file.write_text(f"roadgym/QuarterCar-v0: {content}")
    with pytest.raises(ParameterError, match=re.escape(message)):
        load_hyperparameters("ppo", file)


EARLIER = {  # sac.yaml before it was one of rl-baselines3-zoo's too
    "n_envs": 64,
    "n_timesteps": 800000,
    "policy": "MlpPolicy",
    "normalize": {"norm_obs": False, "norm_reward": True},
    "features": ["signals", "products", "lookahead"],
    "buffer_size": 300000,
    "learning_starts": 20000,
    "train_freq": 1,
    "gradient_steps": 2,
    "batch_size": 512,
    "gamma": 0.95,
    "tau": 0.01,
    "ent_coef": "auto_0.01",
    "target_entropy": -4,
    "learning_rate": "lin_0.001",
    "policy_kwargs": {"net_arch": [64, 64], "activation_fn": "ReLU"},
}


def test_a_shipped_file_asks_for_the_agents_that_it_trained_before():
    assert complete(EARLIER) == complete(load_hyperparameters("sac"))


def test_the_wrapper_of_a_file_brings_its_defaults(tmp_path):
    file = tmp_path / "own.yaml"
    file.write_text('roadgym/QuarterCar-v0: {env_wrapper: agents.wrappers.learning, normalize: "dict(norm_obs=False)"}')
    assert load_hyperparameters("ppo", file) == {
        "features": ["signals", "products", "lookahead"],
        "training_reward": "advantage",
        "normalize": {"norm_obs": False},
    }


def test_what_stands_beside_the_wrapper_of_a_file_is_not_lost(tmp_path):
    file = tmp_path / "own.yaml"
    wrapper = "{agents.wrappers.learning: {training_reward: cost}}"
    file.write_text(f"roadgym/QuarterCar-v0: {{features: [signals], training_reward: cost, env_wrapper: {wrapper}}}")
    assert load_hyperparameters("ppo", file) == {"features": ["signals"], "training_reward": "cost"}


def test_hyperparameters_that_would_not_fit_into_memory_are_refused(tmp_path):
    file = tmp_path / "bomb.yaml"
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 12)]
    for text, message in (
        ("\n".join([*lines, f"{roadgym.ENVIRONMENT_ID}: {{gamma: *a11}}"]), "more than 10000 entries"),
        (f"{roadgym.ENVIRONMENT_ID}: &me {{policy_kwargs: *me}}", "more than 10000 entries"),
        ("[" * 3_000, "recursion"),
        ("#" * 2_000_000, "more than 1000000 bytes"),
        (f"{roadgym.ENVIRONMENT_ID}: {{n_envs: {'1' * 10_000}}}", "cannot read hyperparameters"),
    ):
        file.write_text(text)
        with pytest.raises(ParameterError, match=message) as caught:
            load_hyperparameters("ppo", file)
        assert "\n" not in str(caught.value)
    file.write_text(f"common: &common {{n_steps: 8}}\n{roadgym.ENVIRONMENT_ID}: {{<<: *common, n_envs: 4}}")
    assert load_hyperparameters("ppo", file) == {"n_steps": 8, "n_envs": 4}
