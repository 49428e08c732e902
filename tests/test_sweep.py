"""Many trainings at once: each agent is the one that a training alone gives, and what fails is told."""

import json
import re
import sys

import torch

import agents
from agents import sweep
from agents.cli import main
from agents.training import silent, train

TINY = {"n_envs": 8, "n_steps": 16, "batch_size": 64, "n_epochs": 1, "n_timesteps": 128, "policy_kwargs": {"net_arch": [8]}}


def test_a_sweep_trains_and_compares(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.yaml").write_text(json.dumps({"roadgym/QuarterCar-v0": TINY}))
    options = ["--hyperparameters", "tiny.yaml", "--speed-range", "1", "2", "--speeds", "1.5", "--bandwidths", "0.1"]
    command = ["sweep", *options, "--controllers", "skyhook", "--bound", "none", "--episodes", "16", "--output", "swept"]
    assert main([*command, "--over", "damping-range", "0.2 1"]) == 0
    said = capsys.readouterr()
    assert re.search(r"\ndamping-range 0\.2 1 +1 +\d\.\d{4} +-?\d+\.\d ±\d+\.\d % +n/a$", said.out, re.M)
    assert said.err.endswith("jobs: 2 of 2\nwrote swept/sweep.json\n")
    folder = tmp_path / "swept" / "damping-range_0.2_1"
    swept = agents.load(folder / "agent-0")
    assert swept.description["command"] == " ".join(sys.argv)
    environment = swept.description["environment"]
    assert environment["damping_range"] == [0.2, 1.0]
    alone = train(tmp_path / "alone", algorithm="ppo", environment=environment, hyperparameters=TINY, report=silent)
    for one, other in zip(swept.model.policy.parameters(), alone.model.policy.parameters(), strict=True):
        assert torch.equal(one, other)
    (outcome,) = json.loads((tmp_path / "swept" / "sweep.json").read_text())
    assert outcome["closed"] == json.loads((folder / "comparison.json").read_text())["mean_gap_closed"]["agent"]["closed"]
    # what is done is not done again; a seed that fails is told, and the others are compared
    (folder / "agent-1").write_text("no folder")
    written = (folder / "comparison.html").stat().st_mtime_ns
    assert main([*command, "--over", "damping-range", "0.2 1", "--seeds", "2", "--on", "here"]) == 1
    said = capsys.readouterr().out
    assert re.search(r"\ndamping-range 0\.2 1 +1 +\d", said)
    assert "damping-range 0.2 1: seed 1: train_agent failed: AgentError: cannot write to the folder" in said
    assert (folder / "comparison.html").stat().st_mtime_ns == written


def test_every_combination_is_swept(tmp_path, monkeypatch):
    def swept(cases, folder, *, seeds, executor):
        assert list(seeds) == [4, 5]
        found.update({name: training["environment"] for name, (training, _) in cases.items()})
        return [sweep.Outcome("", (), None, None, None, ())]

    found = {}
    monkeypatch.setattr(sweep, "sweep", swept)
    over = ["--over", "damping-range", "0.1 1", "0.2 1", "--over", "road", "gaussian", "multiplicative"]
    assert main(["sweep", *over, "--seeds", "2", "--seed", "4", "--on", "here", "--output", str(tmp_path)]) == 0
    assert {name: (plant["damping_range"], plant["road"]) for name, plant in found.items()} == {
        f"damping-range {low} 1, road {road}": ([low, 1.0], road)
        for low in (0.1, 0.2)
        for road in ("gaussian", "multiplicative")
    }


def test_what_cannot_be_swept_is_told_at_once(tmp_path, capsys):
    command = ["sweep", "--output", str(tmp_path / "swept")]
    for options, told in (
        (["--over", "seeds", "1"], "--over must name an option of training or of the environment, got 'seeds'"),
        (["--over", "road"], "--over must name an option once, and at least one value of it, got 'road'"),
        (["--over", "road", "gaussian", "cobbles"], "unknown road 'cobbles'"),
        (["--on", "moon"], "on must be one of here, processes, ray, slurm, got 'moon'"),
        (["--on", "slurm", "--launch", "short"], "--launch must be NAME=VALUE, got 'short'"),
        (["--seeds", "0"], "seeds must be at least 1"),
    ):
        assert main([*command, *options]) == 2
        assert told in capsys.readouterr().err
