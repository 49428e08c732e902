"""Wrappers of one's own around the batch of training: what is paid, seen and answered, and what the trained agent keeps."""

import json
import sys

import numpy as np
import pytest

import agents
import roadgym
from agents import tuning
from agents.cli import main
from agents.hyperparameters import load_hyperparameters
from agents.report import theory_given
from agents.wrappers import find_wrapper
from roadgym import ParameterError
from roadgym.vector import QuarterCarVectorEnv

MODULE = """
import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorActionWrapper, VectorWrapper
from gymnasium.wrappers.vector import NormalizeObservation
from agents.wrappers import VectorDampingAction

class Comfort(VectorWrapper):
    def step(self, actions):
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        return observations, -infos["acceleration"], terminated, truncated, infos

class Doubled(VectorWrapper):
    def __init__(self, env):
        super().__init__(env)
        width = env.single_observation_space.shape[0]
        self.single_observation_space = spaces.Box(-np.inf, np.inf, (2 * width,), np.float32)

class Rescaled(VectorWrapper):
    def __init__(self, env):
        super().__init__(env)
        self.single_action_space = spaces.Box(-2, 2, (1,), np.float32)

class Mirrored(VectorActionWrapper):
    def actions(self, actions):
        return -actions

class Unpaid(VectorWrapper):
    def step(self, actions):
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        return observations, 0.0, terminated, truncated, infos

class Untold(VectorWrapper):
    def step(self, actions):
        return *self.env.step(actions)[:4], None

class Misspelt(VectorWrapper):
    def step(self, actions):
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        return observations, -infos["aceleration"], terminated, truncated, infos

def lost(envs):
    return {}["no such one"]

def bare(envs):
    return envs.unwrapped

def levels(envs):
    return VectorDampingAction(envs, 3)

def nothing(envs):
    return None
"""
TINY = {"n_envs": 8, "n_steps": 16, "batch_size": 64, "n_epochs": 1, "n_timesteps": 128, "policy_kwargs": {"net_arch": [8]}}
PLANT = {"road": "gaussian", "speed": (0.7, 2.0)}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with a module of wrappers."""
    (tmp_path / "own_wraps.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    yield tmp_path
    sys.modules.pop("own_wraps", None)


def test_own_rewards_are_what_is_learned_from(folder):
    agent = agents.train("agent", environment=PLANT, hyperparameters=TINY, wrappers=[find_wrapper("own_wraps:Comfort")])
    assert agent.description["hyperparameters"]["wrappers"] == ["own_wraps:Comfort"]
    envs = agent.model.get_env()
    envs.reset()
    *_, infos = envs.step(np.zeros((8, 1), np.float32))
    expected = [-info["acceleration"] for info in infos]
    assert envs.get_original_reward().tolist() == pytest.approx(expected, rel=1e-6)


def test_own_wrappers_are_put_on_again_where_the_agent_drives(folder):
    agent = agents.train("agent", environment=PLANT, hyperparameters=TINY, wrappers=["own_wraps:Mirrored", "own_wraps:Comfort"])
    loaded = agents.load("agent")
    envs = QuarterCarVectorEnv(5, **PLANT)
    observations, _ = envs.reset(seed=3)
    damping, _ = loaded.predict(observations)
    np.testing.assert_array_equal(damping, agent.predict(observations)[0])
    answered, _ = agent.model.predict(observations, deterministic=True)
    low, high = loaded.task.damping_range
    np.testing.assert_allclose(damping, low + (1 - answered) * (high - low) / 2, rtol=1e-5)
    assert np.ptp(damping) > 0


def test_the_command_line_takes_wrappers_and_compares(folder, capsys):
    (folder / "tiny.yaml").write_text(json.dumps({roadgym.ENVIRONMENT_ID: TINY}))
    options = [
        "--road",
        "gaussian",
        "--speed-range",
        "0.7",
        "2",
        "--hyperparameters",
        "tiny.yaml",
        "--wrapper",
        "own_wraps:Mirrored",
    ]
    drive = ["--speeds", "1", "--bandwidths", "0.1", "--episodes", "16", "--controllers", "d_max"]
    assert main(["compare", "--output", "results", *options, *drive]) == 0
    assert main(["compare", "--output", "results", *options, *drive]) == 0  # the same agent is gone on with
    assert main(["evaluate", "--agent", "results/agent-0", *drive[:-2]]) == 0
    sys.modules.pop("own_wraps")
    (folder / "own_wraps.py").unlink()
    capsys.readouterr()
    assert main(["evaluate", "--agent", "results/agent-0"]) == 2
    error = "cannot load the agent in 'results/agent-0': cannot import 'own_wraps': No module named 'own_wraps'"
    remedy = "its module must lie in the working folder or on PYTHONPATH"
    assert capsys.readouterr().err == f"roadgym evaluate: {error}; {remedy}\n"


@pytest.mark.parametrize(
    ("wrapper", "message"),
    [
        (
            "own_wraps:NormalizeObservation",
            "wrapper 'own_wraps:NormalizeObservation': (ValueError: Expected autoreset_|AssertionError)",
        ),
        (
            "own_wraps:Doubled",
            "wrapper 'own_wraps:Doubled' changes observations: an agent would not",
        ),
        ("own_wraps:Rescaled", "wrapper 'own_wraps:Rescaled' changes actions: only a VectorActionWrapper may"),
        ("own_wraps:levels", "wrapper 'own_wraps:levels': env must take damping ratios, got one within VectorDampingAction"),
        ("own_wraps:lost", "wrapper 'own_wraps:lost': KeyError: 'no such one'"),
        ("own_wraps:bare", "wrapper 'own_wraps:bare' must give a wrapper of the batch that it takes, got "),
        ("own_wraps:nothing", "wrapper 'own_wraps:nothing' must give a wrapper of the batch that it takes, got None"),
        ("own_wraps:none", "wrapper 'own_wraps:none' cannot be found: the module has no such function"),
        ("no_such:one", "cannot import 'no_such'"),
        ("own_wraps", "wrapper must be named as module:name, got 'own_wraps'"),
        (lambda envs: envs, "wrapper .* cannot be found"),
        (3, "wrappers must be a list of strings, got "),
    ],
)
def test_wrappers_that_cannot_be_kept_are_refused_before_training(folder, wrapper, message):
    with pytest.raises(ParameterError, match=message):
        agents.train("agent", environment=PLANT, hyperparameters=TINY, wrappers=[wrapper])
    assert not (folder / "agent").exists()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Unpaid", "must return an array of rewards, shape (8,), got 0.0"),
        ("Untold", "must return a mapping of infos, got None"),
        ("Misspelt", "KeyError: 'aceleration'"),
    ],
)
def test_what_a_wrapper_does_wrong_in_use_is_one_line(folder, capsys, name, message):
    (folder / "tiny.yaml").write_text(json.dumps({roadgym.ENVIRONMENT_ID: TINY}))
    options = ["--road", "gaussian", "--hyperparameters", "tiny.yaml", "--wrapper", f"own_wraps:{name}"]
    assert main(["train", "--output", "agent", *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()[-1:]
    separator = ":" if name == "Misspelt" else ""
    assert line == f"roadgym train: wrapper 'own_wraps:{name}'{separator} {message}"
    assert not (folder / "agent").exists()


@pytest.mark.parametrize("value", [3, None, [3], ["own_wraps", None]])
def test_lists_of_names_are_lists_of_names(folder, value):
    for name in ("wrappers", "imports"):
        with pytest.raises(ParameterError, match=f"{name} must be a list of strings, got "):
            agents.train("agent", environment=PLANT, hyperparameters=TINY, **{name: value})
    with pytest.raises(ParameterError, match="wrappers must be a list of strings, got "):
        agents.train("agent", environment=PLANT, hyperparameters=TINY | {"wrappers": value})
    with pytest.raises(ParameterError, match="wrappers must be a list of strings, got "):
        agents.tune("study.db", environment=PLANT, hyperparameters=TINY | {"wrappers": value})
    assert not (folder / "study.db").exists()
    assert not (folder / "agent").exists()


def test_one_name_is_a_list_of_one_and_is_imported_at_once(folder):
    agent = agents.train("agent", environment=PLANT, hyperparameters=TINY, wrappers="own_wraps:Comfort", imports="own_wraps")
    assert agent.description["hyperparameters"]["wrappers"] == ["own_wraps:Comfort"]
    assert agent.description["imports"] == ["own_wraps"]
    with pytest.raises(ParameterError, match="cannot import 'no_such': No module"):
        agents.train("other", environment=PLANT, hyperparameters=TINY, imports="no_such")
    assert not (folder / "other").exists()


def test_an_agent_goes_on_with_its_own_wrappers_and_no_others(folder):
    given = {"environment": PLANT, "hyperparameters": TINY | {"wrappers": ["own_wraps:Comfort"]}}
    agents.train("agent", **given, wrappers=["own_wraps:Mirrored"])
    agents.train("agent", **given, wrappers=["own_wraps:Mirrored"], resume=True)
    agents.train("agent", wrappers=["own_wraps:Mirrored"], resume=True)
    for others in ({**given}, {"wrappers": ["own_wraps:Comfort"]}):
        with pytest.raises(ParameterError, match=r"hyperparameters must be {'wrappers': .*'own_wraps:Mirrored'.*}, as of the"):
            agents.train("agent", **others, resume=True)
    (folder / "other_wraps.py").write_text("")
    agents.train("agent", resume=True, imports=["other_wraps"])
    assert agents.load("agent").description["imports"] == ["other_wraps"]


def test_a_comparison_says_what_wrappers_changed(folder):
    agent = agents.train("agent", environment=PLANT, hyperparameters=TINY, wrappers=["own_wraps:Comfort"])
    assert theory_given(agent).startswith("learned from the cost, as changed by own_wraps:Comfort, with")


def test_a_search_tries_what_is_wrapped(folder, monkeypatch):
    monkeypatch.setattr(tuning, "EPISODES", 16)
    monkeypatch.setattr(tuning, "DURATION", 20.0)
    monkeypatch.setitem(tuning.SEARCH_SPACES, "ppo", {"learning_rate": (1e-4, 1e-3)})
    (folder / "tiny.yaml").write_text(json.dumps({roadgym.ENVIRONMENT_ID: TINY}))
    options = ["--road", "gaussian", "--speed-range", "0.7", "2", "--hyperparameters", "tiny.yaml", "--output", "best.yaml"]
    assert main(["tune", "--storage", "s.db", "--trials", "1", "--wrapper", "own_wraps:Mirrored", *options]) == 0
    assert load_hyperparameters("ppo", "best.yaml")["wrappers"] == ["own_wraps:Mirrored"]
