"""The command line as a user meets it: what it refuses, how it stops, what its help says, what it leaves behind."""

import argparse
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time

import numpy as np
import pytest

import agents
from agents.cli import main, make_parser
from agents.controllers import CONTROLLERS
from agents.names import CONTROLLERS_SHOWN
from agents.training import silent
from analysis import explorer
from roadgym import CARS, TwoMassCar
from roadgym.__main__ import main as roadgym_main
from roadgym.task import signals

HYPERPARAMETERS = """
roadgym/QuarterCar-v0:
  n_envs: 8
  n_timesteps: 256
  n_steps: 16
  batch_size: 64
  n_epochs: 1
  policy_kwargs: {net_arch: [8]}
"""
QUICK = ["--episodes", "16", "--speeds", "1.5", "--bandwidths", "0.1", "--controllers", "skyhook"]
(COMMANDS,) = (action.choices for action in make_parser()._actions if isinstance(action, argparse._SubParsersAction))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder of work, with hyperparameters and a trained agent "a"."""
    folder = tmp_path_factory.mktemp("trained")
    (folder / "small.yaml").write_text(HYPERPARAMETERS)
    assert main(["train", "--output", str(folder / "a"), "--hyperparameters", str(folder / "small.yaml")]) == 0
    return folder


@pytest.fixture
def place(trained, tmp_path, monkeypatch):
    """A copy of it to work in."""
    shutil.copytree(trained, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "--resume", "--output", "a", "--algorithm", "sac"], "algorithm must be 'ppo', .* got 'sac'"),
        (["train", "--resume", "--output", "a", "--seed", "7"], "seed must be 0, .* got 7"),
        (
            ["train", "--resume", "--output", "a", "--hyperparameters", "ppo_plain"],
            "hyperparameters must be {.*'n_envs': 8.* got {",
        ),
        (
            ["train", "--resume", "--output", "a", "--road", "gaussian"],
            "environment must be {'road': 'multiplicative'}, .* got",
        ),
        (
            ["train", "--resume", "--output", "a", "--natural-frequency", "2"],
            "environment must be {'natural_frequency': not given}, .* got {'natural_frequency': 2.0}",
        ),
        (
            ["train", "--resume", "--output", "a", "--timesteps", "8"],
            "timesteps must be at least the 256 of the agent .*, got 8",
        ),
        (["compare", "--agent", "a", "--algorithm", "sac"], "--algorithm cannot be given as 'sac' with --agent, .* with 'ppo'"),
        (["compare", "--agent", "a", "--timesteps", "8"], "--timesteps cannot be given as 8 with --agent, .* with 256"),
        (["compare", "--agent", "a", "--hyperparameters", "sac"], "--hyperparameters cannot be given with --agent"),
        (["compare", "--agent", "a", "--checkpoint-interval", "9"], "--checkpoint-interval cannot be given with --agent"),
        (["compare", "--agent", "a", "--seeds", "1"], "--seeds cannot be given with --agent"),
        (["compare", "--agent", "a", "--road", "gaussian"], "--road cannot be given with --agent"),
        (["compare", "--road", "harmonic", "--bandwidths", "0.1"], "--bandwidths cannot be given on a harmonic road"),
        (["evaluate", "--controller", "skyhook", "--road", "harmonic", "--bandwidths", "0.1"], "--bandwidths cannot be given"),
        (["evaluate", "--agent", "a", "--weights", "travel"], "--weights cannot be given with --agent"),
        (["evaluate", "--controller", "skyhook", "--observation", "travel"], "--observation cannot be given with --controller"),
        (["drive", "--controller", "skyhook", "--hide-operating-point"], "--hide-operating-point cannot be given"),
        (["drive", "--agent", "a", "--observation", "travel"], "--observation cannot be given with --agent"),
        (["figures", "--output", "f", "--only", "2", "--full"], "--full cannot be given without Fig. 7"),
        (
            ["explore", "--output", "e.html", "--value", "damping", "1", "--value", "damping", "2"],
            "--value gives 'damping' twice",
        ),
    ],
)
def test_nothing_that_is_given_is_ignored_in_silence(arguments, message, place, capsys):
    capsys.readouterr()
    before = {path: path.stat().st_mtime_ns for path in place.rglob("*")}
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert re.search(message, said)
    assert said.count("\n") == 1
    assert before == {path: path.stat().st_mtime_ns for path in place.rglob("*")}


def test_what_agrees_may_be_said_again(place):
    again = ["--algorithm", "ppo", "--seed", "0", "--hyperparameters", "small.yaml", "--road", "multiplicative"]
    assert main(["train", "--resume", "--output", "a", "--timesteps", "512", *again]) == 0
    assert agents.load("a").description["timesteps"] == 512


def test_comparisons_of_other_agents_in_one_folder_come_one_beside_the_other(place, capsys):
    training = ["--hyperparameters", "small.yaml", *QUICK]
    assert main(["compare", *training]) == 0
    assert main(["compare", "--weights", "acceleration=1,travel=0.5", *training]) == 0
    assert main(["compare", "--observation", "velocity", "travel", "--timesteps", "128", *training]) == 0
    assert {path.name for path in place.glob("roadgym-results*")} == {
        "roadgym-results",
        "roadgym-results-2",
        "roadgym-results-3",
    }
    assert main(["compare", "--weights", "acceleration=1,travel=0.5", *training]) == 0  # finds its own again
    assert main(["compare", "--timesteps", "128", *training]) == 0  # and is not shown an agent that trained for longer
    assert len(list(place.glob("roadgym-results*"))) == 4
    said = capsys.readouterr().err
    assert "wrote roadgym-results-4" in said
    number = r"\d+\.\d"
    assert re.search(rf"took {number} s: compiling {number}, training {number}, .*driving {number}, .*writing {number}\n", said)


def test_what_is_trained_is_told_beforehand(place, caplog):
    assert main(["train", "--output", "b", "--hyperparameters", "small.yaml", "--timesteps", "200"]) == 0
    assert "200 timesteps are no whole rollouts of 128: training for 256" in caplog.messages
    assert agents.load("b").description["timesteps"] == 256
    caplog.clear()
    assert main(["train", "--output", "c", "--hyperparameters", "small.yaml", "--timesteps", "128"]) == 0
    assert agents.load("c").description["timesteps"] == 128
    assert not caplog.messages


def test_training_leaves_no_temporary_folder(place, monkeypatch):
    (place / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(place / "temporary"))
    assert main(["train", "--output", "b", "--hyperparameters", "small.yaml"]) == 0
    assert main(["train", "--output", "b", "--resume", "--timesteps", "512"]) == 0
    assert not list((place / "temporary").iterdir())


def start(*arguments, folder):
    """A command in a process of its own, which has begun when this returns."""
    heed = "signal.signal(signal.SIGINT, signal.default_int_handler)"  # whoever runs the tests may ignore it, as nohup does
    code = f"import signal, sys, agents.cli; {heed}; print(flush=True); sys.exit(agents.cli.main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, *arguments]
    working = subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    working.stdout.readline()
    return working


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize("seconds", [0.2, 1.0, 3.0])  # learning libraries are imported, then a checkpoint is far
def test_interruption_before_a_checkpoint_promises_none(tmp_path, seconds):
    working = start("train", "--output", "a", "--timesteps", "100000000", folder=tmp_path)
    time.sleep(seconds)
    working.send_signal(signal.SIGINT)
    said = working.communicate(timeout=300)[1]
    assert "Traceback" not in said
    assert working.returncode == 128 + signal.SIGINT
    saved = (tmp_path / "a" / "agent.json").exists()
    assert ("--resume goes on from the last checkpoint" in said) == saved
    assert ("nothing was saved yet" in said) != saved


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_terminated_film_leaves_nothing_half_written(tmp_path):
    working = start("drive", "--controller", "skyhook", "--output", "film.gif", "--seconds", "1000", folder=tmp_path)
    deadline = time.monotonic() + 300
    while not list(tmp_path.glob(".part-*")) and time.monotonic() < deadline:
        time.sleep(0.1)
    time.sleep(1.0)
    assert list(tmp_path.glob(".part-*"))
    working.terminate()
    said = working.communicate(timeout=300)[1]
    assert working.returncode == 128 + signal.SIGTERM
    assert said.splitlines()[-1] == "roadgym drive: interrupted"
    assert not list(tmp_path.iterdir())


def test_work_that_memory_does_not_hold_is_told_in_one_line(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("analysis.explorer.write", lambda *_: np.empty(2**56))
    assert main(["explore", "--output", str(tmp_path / "e.html")]) == 2
    assert capsys.readouterr().err == "roadgym explore: this takes more memory than there is\n"


def test_progress_is_told_in_python_too(tmp_path, capsys):
    hyperparameters = {"n_envs": 8, "n_timesteps": 256, "n_steps": 16, "batch_size": 64, "policy_kwargs": {"net_arch": [8]}}
    agent = agents.train(tmp_path / "a", hyperparameters=hyperparameters)
    assert "training: 256 of 256" in capsys.readouterr().err
    point = {"speeds": [1.5], "bandwidths": [0.1], "controllers": ["skyhook"], "episodes": 16}
    agents.compare(agent, environment=agent.description["environment"], **point)
    said = capsys.readouterr().err.splitlines()
    assert said.pop() == "lower bounds: 100 of 100"
    assert said[-1].startswith(f"driving {len(said)} of {len(said)}: skyhook: ")
    assert any("best constant D" in line for line in said)
    agents.train(tmp_path / "b", hyperparameters=hyperparameters, report=silent)
    assert not capsys.readouterr().err


@pytest.mark.parametrize("command", COMMANDS)
def test_help_speaks_of_what_the_command_has(command):
    text = " ".join(COMMANDS[command].format_help().split())
    own = {option for action in COMMANDS[command]._actions for option in action.option_strings}
    elsewhere = {"train --hyperparameters"}  # what is written here is for another command
    for words in elsewhere:
        text = text.replace(words, "")
    assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", text)) <= own
    if own & {"--controller", "--controllers"}:
        assert all(re.search(rf"\b{name}\b", text) for name in CONTROLLERS)
    if "--car" in own:
        assert all(re.search(rf"\b{name}\b", text) for name in (*CARS, *CARS.presets))
    if "--road" in own:
        assert "iso_a to iso_h" in text
    if "--observation" in own:
        assert all(re.search(rf"\b{name}\b", text) for name in (*signals(TwoMassCar()), *TwoMassCar.optional))


def test_help_of_the_explorer_has_all_that_its_page_takes():
    text = COMMANDS["explore"].format_help()
    names = (*explorer.RANGES, *explorer.roads(), *explorer.cars(), *TwoMassCar().mean_squares)
    assert [name for name in names if not re.search(rf"\b{name}\b", text)] == []


def test_every_controller_has_a_name_to_be_shown():
    assert set(CONTROLLERS) | {"agent"} == set(CONTROLLERS_SHOWN)


def test_interruption_before_a_command_begins_is_one_line(monkeypatch, capsys):
    def interrupted():
        raise KeyboardInterrupt

    monkeypatch.setattr("agents.cli.make_parser", interrupted)
    try:
        code = roadgym_main()
    except KeyboardInterrupt:  # which would end all tests
        code = None
    assert code == 130
    assert capsys.readouterr().err == "roadgym: interrupted\n"


def test_a_seed_beyond_the_largest_is_told_before_the_first_training(capsys, tmp_path):
    arguments = ["compare", "--seed", str(2**32 - 1), "--seeds", "2", "--output", str(tmp_path / "results")]
    assert main(arguments) == 2
    assert "seed must be at most 4294967295 for a training, got 4294967296" in capsys.readouterr().err
    assert not (tmp_path / "results").exists()
