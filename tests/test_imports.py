"""Components of one's own from a module: on the command line, by an entry point, and with a recorded agent."""

import argparse
import json
import sys

import pytest

import agents
import roadgym
from agents.cli import main, make_parser
from agents.training import train
from roadgym import ROADS, ParameterError
from roadgym.component import import_modules
from roadgym.task import make_task

MODULE = """
import dataclasses
import roadgym

@dataclasses.dataclass(frozen=True, kw_only=True)
class OwnWave(roadgym.GaussianRoad):
    kind: str = dataclasses.field(default="own_wave", init=False)

roadgym.register("road", "own_wave", OwnWave)
"""
TINY = {"n_envs": 8, "n_steps": 16, "batch_size": 64, "n_epochs": 1, "n_timesteps": 128, "policy_kwargs": {"net_arch": [8]}}


def forget():
    """As in a new process."""
    ROADS.pop("own_wave", None)
    sys.modules.pop("own_wave", None)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with a module that registers a road."""
    (tmp_path / "own_wave.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    yield tmp_path
    forget()


def test_every_command_imports_first(capsys):
    (commands,) = (action for action in make_parser()._actions if isinstance(action, argparse._SubParsersAction))
    for command in commands.choices.values():
        assert "--import MODULE" in command.format_help()
    assert main(["cache", "--import", "no_such_module"]) == 2
    assert capsys.readouterr().err == "roadgym cache: cannot import 'no_such_module': No module named 'no_such_module'\n"


def test_a_road_of_a_module_drives_by_name(folder, capsys):
    drive = [
        "evaluate",
        "--controller",
        "d_max",
        "--road",
        "own_wave",
        "--speeds",
        "1",
        "--bandwidths",
        "0.1",
        "--episodes",
        "16",
    ]
    assert main(drive) == 2
    assert main([*drive, "--import", "json", "--import", "own_wave"]) == 0


@pytest.mark.parametrize("by", ["command", "class"])
def test_a_recorded_agent_brings_its_road_along(folder, by, capsys):
    if by == "command":
        (folder / "tiny.yaml").write_text(json.dumps({roadgym.ENVIRONMENT_ID: TINY}))
        options = ["--import", "own_wave", "--road", "own_wave", "--hyperparameters", "tiny.yaml", "--output", "agent"]
        assert main(["train", *options]) == 0
    else:
        import_modules(["own_wave"])
        train("agent", environment={"road": ROADS["own_wave"]()}, hyperparameters=TINY)
    assert json.loads((folder / "agent" / "agent.json").read_text())["imports"] == ["own_wave"]
    forget()
    assert agents.load("agent").task.road.kind == "own_wave"
    forget()
    (folder / "own_wave.py").unlink()
    capsys.readouterr()
    assert main(["evaluate", "--agent", "agent"]) == 2
    expected = "roadgym evaluate: cannot load the agent in 'agent': cannot import 'own_wave': No module named 'own_wave'"
    remedy = "its module must lie in the working folder or on PYTHONPATH"
    assert capsys.readouterr().err == f"{expected}; {remedy}\n"


def test_a_road_whose_module_says_nothing_of_it_is_told_as_unknown(folder):
    import_modules(["own_wave"])
    train("agent", environment={"road": "own_wave"}, hyperparameters=TINY)
    forget()
    (folder / "own_wave.py").write_text("")
    with pytest.raises(agents.AgentError, match="cannot load the agent in 'agent': unknown road 'own_wave'; known: harmonic"):
        agents.load("agent")


def test_an_installed_package_offers_its_road(folder, monkeypatch):
    metadata = folder / "own_wave-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: own-wave\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[roadgym.components]\nown_wave = own_wave\nbroken = no_such_module\n")
    with pytest.raises(ParameterError, match="unknown road 'own_wave'"):
        make_task(road="own_wave")
    monkeypatch.syspath_prepend(folder)
    assert make_task(road={"kind": "own_wave", "bandwidth": 0.2}).bandwidth == (0.2, 0.2)
    with pytest.raises(ParameterError, match="cannot import 'no_such_module'"):
        make_task(road="broken")
