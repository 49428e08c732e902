"""Training and the agent's folder."""

import json
import re
import shutil
import subprocess
import sys
import time
import zipfile

import gymnasium
import numpy as np
import pytest
import torch

import agents
import roadgym
from agents import training
from agents.cli import main
from agents.cli.commands import _kind
from agents.comparison import group_agents
from agents.features import FEATURES
from agents.training import ALGORITHMS, HYPERPARAMETERS, AgentError, load_hyperparameters, make_model, plain, training_seed
from roadgym.files import locked

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


def shrunken(name, algorithm=None):
    """Shipped hyperparameters with few environments and steps, small batches and a small network."""
    chosen = load_hyperparameters(algorithm or name, name)
    small = {"buffer_size": 2000, "learning_starts": 100, "batch_size": 32, "n_steps": 8, "n_epochs": 1, "gradient_steps": 1}
    small |= {"horizon": 4, "lookahead_steps": 3}
    network = chosen["policy_kwargs"] | {"net_arch": [8]}
    if "lstm_hidden_size" in network:
        network["lstm_hidden_size"] = 8
    chosen |= {key: value for key, value in small.items() if key in chosen}
    # the table of the feature lookahead takes half a second each time
    return chosen | {"n_envs": 4, "n_timesteps": 512, "features": ["signals", "products"], "policy_kwargs": network}


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
    assert description["hyperparameters"] == SMALL | {"training_reward": "cost"}
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


@pytest.fixture(scope="module", params=list(ALGORITHMS))
def each(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("agent") / request.param
    trained = agents.train(
        folder, algorithm=request.param, environment=ENVIRONMENT, hyperparameters=shrunken(request.param), seed=3
    )
    return request.param, folder, trained


def test_every_algorithm_trains_saves_and_loads(each):
    algorithm, folder, trained = each
    damping, _ = trained.predict(OBSERVATIONS)
    assert damping.shape == (11, 1)
    assert np.all((damping >= np.float32(0.05)) & (damping <= 1))
    loaded = agents.load(folder)
    np.testing.assert_array_equal(loaded.predict(OBSERVATIONS)[0], damping)
    assert loaded.description["algorithm"] == algorithm
    assert sorted(path.name for path in folder.iterdir()) == ["agent.json", "model-512.zip"]  # no replay buffer
    assert (folder / "model-512.zip").stat().st_size < 200_000


def parameters(agent):
    return {name: value.numpy() for name, value in agent.model.policy.state_dict().items()}


def test_agents_that_name_no_reward_learned_from_the_cost_and_go_on(tmp_path):
    """As earlier versions wrote them, whose files of hyperparameters left the default out."""
    asked = SMALL | {"training_reward": "cost"}
    for name in ("a", "b"):
        agents.train(tmp_path / name, environment=ENVIRONMENT, hyperparameters=asked)
    file = tmp_path / "a" / "agent.json"
    earlier = json.loads(file.read_text()) | {"hyperparameters": SMALL}
    file.write_text(json.dumps(earlier))
    agent = agents.train(tmp_path / "a", resume=True, environment=ENVIRONMENT, hyperparameters=asked)
    groups, _ = group_agents({"a": agent, "b": agents.load(tmp_path / "b")})
    assert list(groups) == ["agent"]
    assert _kind(earlier) == _kind(agent.description)


def test_every_algorithm_repeats_by_seed_and_resumes(each, tmp_path):
    algorithm, folder, trained = each
    again = agents.train(
        tmp_path / "again", algorithm=algorithm, environment=ENVIRONMENT, hyperparameters=shrunken(algorithm), seed=3
    )
    expected = parameters(trained)
    for name, value in parameters(again).items():
        np.testing.assert_array_equal(value, expected[name])
    shutil.copytree(folder, tmp_path / "copy")
    longer = [agents.train(tmp_path / path, resume=True, timesteps=1024) for path in ("again", "copy")]
    assert longer[0].description["timesteps"] == 1024
    first, second = map(parameters, longer)
    assert any(not np.array_equal(first[name], expected[name]) for name in expected)
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name])


def break_off(done, total, reward):
    if done >= 0.7 * total:
        raise KeyboardInterrupt


def test_broken_off_training_ends_as_an_unbroken_one(each, tmp_path):
    algorithm, _, trained = each
    options = {"algorithm": algorithm, "environment": ENVIRONMENT, "hyperparameters": shrunken(algorithm), "seed": 3}
    with pytest.raises(KeyboardInterrupt):
        agents.train(tmp_path, **options, checkpoint_interval=200, report=break_off)
    assert 200 <= agents.load(tmp_path).description["timesteps"] < 300
    torch.manual_seed(0)  # whoever goes on is another process
    resumed = agents.train(tmp_path, resume=True)
    assert resumed.description["reward_statistics"] == trained.description["reward_statistics"]
    expected = parameters(trained)
    for name, value in parameters(resumed).items():
        np.testing.assert_array_equal(value, expected[name])


class Unpicklable(gymnasium.vector.VectorWrapper):
    """Gymnasium's wrapper with something that no pickle takes."""

    def __init__(self, env):
        super().__init__(env)
        self.file = sys.stdout


def test_what_cannot_be_pickled_goes_on_with_new_noise(tmp_path, caplog):
    options = {"environment": ENVIRONMENT, "hyperparameters": SMALL, "wrappers": [Unpicklable]}
    with pytest.raises(KeyboardInterrupt):
        agents.train(tmp_path, **options, checkpoint_interval=64, report=break_off)
    assert caplog.text.count("wrappers cannot be pickled") == 1
    assert 64 <= agents.load(tmp_path).description["timesteps"] < 256
    assert agents.train(tmp_path, resume=True).description["timesteps"] == 256


def test_damaged_checkpoint_goes_on_with_new_noise(tmp_path, caplog):
    with pytest.raises(KeyboardInterrupt):
        small_agent(tmp_path, checkpoint_interval=64, report=break_off)
    model = tmp_path / agents.load(tmp_path).description["model"]
    with zipfile.ZipFile(model, "a") as parts, pytest.warns(UserWarning, match="Duplicate name"):
        parts.writestr("training.pickle", b"of another version")
    assert agents.train(tmp_path, resume=True).description["timesteps"] == 256
    assert "cannot be gone on with exactly, but with new noise" in caplog.text


def test_resumed_replay_fills_before_it_is_learned_from(tmp_path):
    hyperparameters = shrunken("sac") | {"learning_starts": 100}
    trained = agents.train(tmp_path / "a", algorithm="sac", environment=ENVIRONMENT, hyperparameters=hyperparameters, seed=1)
    filled = agents.train(tmp_path / "a", resume=True, timesteps=512 + 100)
    learned = agents.train(tmp_path / "a", resume=True, timesteps=612 + 200)
    first, second, third = map(parameters, (trained, filled, learned))
    assert all(np.array_equal(first[name], second[name]) for name in first)
    assert any(not np.array_equal(first[name], third[name]) for name in first)


def test_rewards_are_scaled_alike_after_a_resume(tmp_path):
    hyperparameters = shrunken("td3")
    trained = agents.train(tmp_path / "a", algorithm="td3", environment=ENVIRONMENT, hyperparameters=hyperparameters, seed=1)
    resumed = agents.train(tmp_path / "a", resume=True, timesteps=516)
    before, after = (agent.description["reward_statistics"] for agent in (trained, resumed))
    assert after["count"] == before["count"] + 4
    assert after["var"] == pytest.approx(before["var"], rel=0.2)


@pytest.mark.parametrize("levels", [2, 4])
def test_discrete_damping_takes_its_levels_only(tmp_path, levels):
    hyperparameters = shrunken("dqn") | {"damping_levels": levels}
    agent = agents.train(tmp_path / "dqn", algorithm="dqn", environment=ENVIRONMENT, hyperparameters=hyperparameters)
    allowed = np.linspace(0.05, 1, levels)
    damping = agent.predict(np.random.default_rng(5).normal(0, 2, (500, 6)).astype(np.float32))[0]
    assert np.abs(damping - allowed).min(axis=1).max() < 1e-6
    one = agent.predict(OBSERVATIONS[0])[0]
    assert one.shape == (1,)
    assert np.abs(one - allowed).min() < 1e-6


def test_missing_package_is_told_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    with pytest.raises(ImportError, match=r"sb3_contrib is not installed, .*: pip install -e '.*\[recurrent\]'"):
        agents.train(tmp_path / "agent", algorithm="recurrent_ppo", environment=ENVIRONMENT)
    assert not (tmp_path / "agent").exists()


@pytest.mark.parametrize("name", sorted(path.stem for path in HYPERPARAMETERS.glob("*.yaml")))
def test_shipped_hyperparameters_fit_their_algorithm(name):
    algorithm = name if name in ALGORITHMS else name.split("_")[0]
    chosen = load_hyperparameters(algorithm, name)
    assert chosen["n_timesteps"] >= 100_000
    if "buffer_size" not in chosen and "batch_size" in chosen:
        assert chosen["n_envs"] * chosen["n_steps"] % chosen["batch_size"] == 0  # else the last batch is a short one
    assert set(chosen["features"]) <= set(FEATURES)
    smaller = {"n_envs": 2, "features": ["signals"]} | ({"batch_size": 2} if "batch_size" in chosen else {})
    make_model(algorithm, chosen | smaller, ENVIRONMENT, 0, None)


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


def test_failed_saving_leaves_a_sound_agent(tmp_path, monkeypatch):
    folder = tmp_path / "agent"
    written = []

    def stop(path):
        written.append(path)
        if len(written) > 2:  # the second time that model and description are written
            raise OSError("the disk is full")

    monkeypatch.setattr("roadgym.files.sync", stop)
    with pytest.raises(AgentError, match=r"cannot save the agent in .*: the disk is full"):
        small_agent(folder, seed=3, checkpoint_interval=64)
    assert agents.load(folder).description["timesteps"] == 64
    assert len(list(folder.iterdir())) == 2


def test_files_of_others_in_the_folder_are_left_alone(tmp_path):
    folder = tmp_path / "agent"
    folder.mkdir()
    for name in ("model-best.zip", "model-64.zip", "model-256.zip"):
        (folder / name).write_text(name)
    trained = small_agent(folder, checkpoint_interval=64)
    for name in ("model-best.zip", "model-64.zip", "model-256.zip"):
        assert (folder / name).read_text() == name
    assert len(list(folder.iterdir())) == 5  # with agent.json and its model
    np.testing.assert_array_equal(agents.load(folder).predict(OBSERVATIONS)[0], trained.predict(OBSERVATIONS)[0])


def test_checkpoints_after_a_resume_are_as_far_apart_as_before(tmp_path, monkeypatch):
    saved = []

    def note(folder, model, description, kept=None, save=training.save):
        saved.append(model.num_timesteps)
        save(folder, model, description, kept)

    monkeypatch.setattr("agents.training.save", note)
    monkeypatch.setattr("agents.checkpoints.save", note)
    small_agent(tmp_path, checkpoint_interval=100)
    assert saved == [128, 256]  # the first of the rollouts of 64
    saved.clear()
    agents.train(tmp_path, resume=True, timesteps=512, checkpoint_interval=60)
    assert saved == [320, 384, 448, 512]


def test_second_training_in_a_folder_is_refused_at_once(trained, tmp_path):
    folder = tmp_path / "agent"
    shutil.copytree(trained[0], folder)
    before = (folder / "agent.json").read_bytes()

    def second(done, total, reward):
        with pytest.raises(AgentError, match="is in use by another training"):
            agents.train(folder, resume=True)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        agents.train(folder, resume=True, timesteps=512, report=second)
    assert (folder / "agent.json").read_bytes() == before  # the first one came to no checkpoint
    assert not (folder / ".lock").exists()
    new = tmp_path / "new"
    new.mkdir()
    with locked(new / ".lock"), pytest.raises(AgentError, match="is in use by another training"):
        small_agent(new)


def test_killed_training_goes_on(tmp_path):
    folder, file = tmp_path / "agent", tmp_path / "small.yaml"
    file.write_text(json.dumps({roadgym.ENVIRONMENT_ID: SMALL}))
    options = ["--output", folder, "--hyperparameters", file, "--timesteps", 10**6, "--checkpoint-interval", 16]
    process = subprocess.Popen([sys.executable, "-m", "agents.cli", "train", *map(str, options)], stderr=subprocess.DEVNULL)
    try:
        for _ in range(6000):
            if (folder / "agent.json").exists() and (folder / ".lock").exists():
                break
            time.sleep(0.01)
    finally:
        process.kill()
        process.wait()
    assert (folder / ".lock").exists()  # nobody took it away, and it is in nobody's way
    (folder / f".part-{'0' * 16}.zip").write_text("half a model")
    timesteps = agents.load(folder).description["timesteps"] + 100
    assert agents.train(folder, resume=True, timesteps=timesteps).description["timesteps"] >= timesteps
    assert not list(folder.glob(".*"))


@pytest.mark.skipif(sys.platform == "win32", reason="there are no such limits")
def test_full_disk_is_told_in_one_line_and_loses_no_checkpoint(trained, tmp_path, capsys):
    import resource

    folder = tmp_path / "agent"
    shutil.copytree(trained[0], folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (5000, limits[1]))
    try:
        code = main(["train", "--output", str(folder), "--resume", "--timesteps", "400"])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert code == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("roadgym train: cannot save the agent in ")
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


DAMAGES = [
    "missing",
    "no description",
    "not json",
    "deep",
    "foreign",
    "no seed",
    "no number",
    "no model",
    "elsewhere",
    "truncated",
    "other shape",
]


@pytest.mark.parametrize("damage", DAMAGES)
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
    elif damage == "deep":
        (folder / "agent.json").write_text("[" * 100_000)
    elif damage == "no seed":
        del description["seed"]
        (folder / "agent.json").write_text(json.dumps(description))
    elif damage == "no number":
        description["reward_statistics"]["var"] = "large"
        (folder / "agent.json").write_text(json.dumps(description))
    elif damage == "no model":
        model.unlink()
    elif damage == "elsewhere":
        shutil.copy(model, tmp_path)
        description["model"] = f"../{model.name}"
        (folder / "agent.json").write_text(json.dumps(description))
    elif damage == "truncated":
        model.write_bytes(model.read_bytes()[:-2000])
    elif damage == "other shape":
        description["hyperparameters"]["features"] = ["signals"]
        (folder / "agent.json").write_text(json.dumps(description))
    with pytest.raises(AgentError, match=str(folder)) as caught:
        agents.load(folder)
    assert "\n" not in str(caught.value)
    with pytest.raises(AgentError, match=str(folder)):
        agents.train(folder, resume=True, timesteps=512)


def test_output_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(AgentError, match="cannot write to the folder"):
        small_agent(tmp_path / "file" / "agent")


def test_help_names_what_can_be_chosen(capsys):
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    words = re.findall(r"\w+", capsys.readouterr().out)
    shipped = {path.stem for path in HYPERPARAMETERS.glob("*.yaml")}
    assert set(words) >= set(ALGORITHMS) | shipped
    assert shipped >= set(ALGORITHMS)


def test_roads_become_plain_mappings():
    road = roadgym.MultiplicativeRoad(bandwidth=0.2)
    content = plain({"road": road, "speed": (1.0, np.float64(2.0))})
    assert json.loads(json.dumps(content))["road"]["kind"] == "multiplicative"
    assert roadgym.roads.make_road(content["road"]) == road
