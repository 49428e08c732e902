"""Evaluation, comparison and the command line, at small size."""

import csv
import errno
import html
import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import matplotlib.image
import numpy as np
import pytest

import agents
from agents.cli import main
from agents.comparison import (
    Share,
    compare,
    group_agents,
    table,
    with_error,
    write,
)
from agents.controllers import ConstantDamping, make_controller, optimum, theoretical_cost
from agents.evaluation import evaluate, standard_error
from roadgym import ParameterError
from roadgym.task import make_task

ENVIRONMENT = {"road": "multiplicative", "speed": (0.7, 3.0), "bandwidth": (0.1, 0.3)}
TASK = make_task(**ENVIRONMENT)
HYPERPARAMETERS = """
roadgym/QuarterCar-v0:
  n_envs: 8
  n_timesteps: 512
  n_steps: 16
  batch_size: 64
  n_epochs: 1
  policy_kwargs: {net_arch: [8]}
"""


@pytest.mark.statistical
def test_constant_damping_costs_what_theory_says():
    found = evaluate(
        {"constant": ConstantDamping(TASK, 0.4)},
        environment=ENVIRONMENT,
        speeds=[0.7, 1.5, 3.0],
        bandwidths=[0.1, 0.3],
        episodes=400,
    )["constant"]
    driven, error = found.costs.mean(axis=1), standard_error(found.costs)
    for k, point in enumerate(found.points):
        expected = theoretical_cost(TASK, float(np.float32(0.4)), point.speed, point.bandwidth)
        assert error[k] < 0.01 * expected
        assert abs(driven[k] - expected) < 4 * error[k]
        # other constant dampings on the same roads take out nearly all noise; the scheme's own bias shows up then
        assert found.standard_error[k] < 1e-4 * expected
        assert abs(found.mean[k] - expected) < 4 * found.standard_error[k] + 1e-4 * expected
    assert not found.switches.any()


def test_controllers_meet_the_same_roads():
    drivers = {"a": ConstantDamping(TASK, 0.4), "b": ConstantDamping(TASK, 0.41), "c": ConstantDamping(TASK, 0.4)}
    options = {"environment": ENVIRONMENT, "speeds": [1.5], "bandwidths": [0.1], "episodes": 32, "duration": 50.0}
    found = evaluate(drivers, **options)
    np.testing.assert_array_equal(found["a"].costs, found["c"].costs)
    # the roads are common, so a small change of damping changes each episode alike
    difference = found["a"].costs - found["b"].costs
    assert difference.std() < 0.1 * found["a"].costs.std()
    other = evaluate({"a": drivers["a"]}, seed=1, **options)
    assert not np.array_equal(other["a"].costs, found["a"].costs)


def test_switches_are_counted():
    class EverySecondStep(ConstantDamping):
        firm = False

        def damping(self, signals):
            self.firm = not self.firm
            return 1.0 if self.firm else 0.05

    found = evaluate(
        {"switching": EverySecondStep(TASK, 0.05)},
        environment=ENVIRONMENT,
        speeds=[1.5],
        bandwidths=[0.1],
        episodes=16,
        duration=20.0,
        transient=2.0,
    )
    assert found["switching"].switches == pytest.approx([1 / 0.2])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"episodes": 3}, "episodes must be at least 16 to have a standard error, got 3"),
        ({"duration": 0.01}, "duration must be at least one control interval"),
        ({"transient": -1.0}, "transient must not be negative"),
        ({"speeds": [4.0]}, r"speed must lie within the environment's range \[0.7, 3\], got 4"),
        ({"speeds": []}, "at least one speed is needed"),
    ],
)
def test_evaluations_without_an_error_bar_are_refused(change, message):
    options = {"environment": ENVIRONMENT, "speeds": [1.5], "bandwidths": [0.1], "episodes": 16, "duration": 10.0}
    with pytest.raises(ParameterError, match=message):
        evaluate({"constant": ConstantDamping(TASK, 0.4)}, **options | change)


def test_errors_in_brackets():
    assert with_error(0.25614, 0.0012) == "0.2561(12)"
    assert with_error(34.06, 0.52) == "34.06(52)"
    assert with_error(5.0, 0.0) == "5.0000"


RIVALS = ("d_min", "skyhook", "one_step_lookahead")


@pytest.fixture(scope="module")
def comparison():
    return compare(
        make_controller("skyhook", TASK),
        environment=ENVIRONMENT,
        speeds=[1.0, 2.0],
        bandwidths=[0.1, 0.3],
        controllers=RIVALS,
        episodes=16,
    )


def test_comparison_states_gains_and_theory(comparison):
    point = comparison.points[0]
    agent, skyhook, best = (comparison.row(name, point) for name in ("agent", "skyhook", "analytic_optimum"))
    assert agent.cost == skyhook.cost  # the agent here is skyhook, and the roads are the same
    assert agent.gain.value == pytest.approx(1 - agent.cost / best.cost)
    assert agent.standard_error < 0.5 * agent.driven_standard_error
    assert abs(agent.cost - agent.driven_cost) < 5 * agent.driven_standard_error
    assert best.gain == Share(0, 0, 0)
    assert agent.theory is None
    assert best.theory == pytest.approx(theoretical_cost(TASK, best.damping, point.speed, point.bandwidth))
    assert agent.squares["displacement"] == pytest.approx(agent.cost, rel=1e-5)  # single precision
    text = " ".join(table(comparison).split())
    assert "One training seed" in text
    assert "Constant dampings on the same roads, whose costs theory knows, serve as control variates: D = 0." in text
    content = json.loads(comparison.to_json())
    assert len(content["rows"]) == 4 * 5
    assert content["environment"]["road"] == "multiplicative"
    assert content["versions"]["roadgym"]
    rows = list(csv.DictReader(comparison.to_csv().splitlines()))
    assert [float(row["cost"]) for row in rows] == [row["cost"] for row in content["rows"]]


def test_comparison_is_written_as_one_page_with_files_beside(comparison, tmp_path):
    files = write(comparison, tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(path.name for path in files)
    pictures = [file for file in files if file.suffix == ".png"]
    for file in pictures:
        picture = matplotlib.image.imread(file)
        assert picture.shape[0] > 500
        assert picture[..., :3].std() > 0.05  # not blank
    page = (tmp_path / "out" / "comparison.html").read_text()
    assert not re.search(r"(src|href)=\"(?!data:)", page)  # it asks the network for nothing
    assert page.count("data:image/png;base64,") == len(pictures) == 4  # each for narrow screens too
    cells = [cell.strip() for cell in re.findall(r'<td class="number">(.*?)</td>', page)]
    for row in comparison.rows:
        assert with_error(row.cost, row.standard_error) in cells
    assert f"numpy&nbsp;{np.__version__}" in page


class SeesLess(ConstantDamping):
    """A controller that sees two signals in its own order."""

    def damping(self, signals):
        assert set(signals) == {"travel", "velocity", "speed", "bandwidth"}
        return 0.1 + 0.2 * (signals["travel"] > 0)


def test_each_controller_is_handed_what_its_task_observes():
    own = make_task(**ENVIRONMENT, observation=["velocity", "travel"])
    options = {"speeds": [1.5], "bandwidths": [0.1], "episodes": 16, "duration": 20.0}
    found = evaluate({"less": SeesLess(own, 0.0), "all": make_controller("skyhook", TASK)}, environment=ENVIRONMENT, **options)
    alone = evaluate({"all": make_controller("skyhook", TASK)}, environment=ENVIRONMENT, **options)
    np.testing.assert_array_equal(found["all"].costs, alone["all"].costs)
    assert found["less"].mean[0] > 0


ODD_NAMES = (r"$\frac{$", "=größe/\n", "x" * 300)


def test_odd_names_are_shown_in_every_file(tmp_path):
    found = compare(
        {name: [make_controller("skyhook", TASK)] for name in ODD_NAMES},
        environment=ENVIRONMENT,
        speeds=[1.5],
        bandwidths=[0.1],
        controllers=[],
        episodes=16,
    )
    files = write(found, tmp_path)
    pictures = 2 * len(ODD_NAMES)  # a policy of each, for phones too
    assert len({file.name.casefold() for file in files}) == len(files) == 6 + pictures
    assert all(file.parent == tmp_path and file.stat().st_size for file in files)
    cells = [row["controller"] for row in csv.DictReader(io.StringIO(found.to_csv()))]
    assert cells == [ODD_NAMES[0], f"'{ODD_NAMES[1]}", ODD_NAMES[2], "analytic_optimum"]
    page = (tmp_path / "comparison.html").read_text(encoding="utf-8")
    assert all(html.escape(name) in page for name in ODD_NAMES)


def stand_in(seed, **changes):
    """What `group_agents` looks at."""
    description = {"algorithm": "ppo", "environment": {"road": "gaussian"}, "hyperparameters": changes, "seed": seed}
    return SimpleNamespace(description=description)


def test_no_agent_is_dropped_for_the_name_of_its_folder():
    learned = {"A/agent-0": stand_in(0), "B/agent-0": stand_in(0, gamma=0.9), "A/agent-1": stand_in(1)}
    groups, _ = group_agents(learned)
    assert groups == {"A/agent-0": [learned["A/agent-0"], learned["A/agent-1"]], "B/agent-0": [learned["B/agent-0"]]}
    groups, _ = group_agents({"runs/skyhook": stand_in(0), "runs/other": stand_in(0, gamma=0.9)})
    assert list(groups) == ["runs/skyhook", "runs/other"]  # skyhook is somebody else


def test_weights_of_two_signals_draw_their_front(tmp_path, monkeypatch):
    monkeypatch.setattr("agents.trade_off.FRONT", (1.0,))
    environment = {**ENVIRONMENT, "reward": {"acceleration": 1.0, "travel": 0.5}}
    found = compare(
        None, environment=environment, speeds=[1.5], bandwidths=[0.3], controllers=["skyhook", "optimal_feedback"], episodes=16
    )
    files = write(found, tmp_path)
    assert tmp_path / "pareto.png" in files
    assert "acceleration against travel at nu = 1.5, delta = 0.3" in (tmp_path / "comparison.html").read_text()
    # the optimal feedback is best for these weights, and each controller costs its weighted mean squares
    costs = {row.controller: row.cost for row in found.rows}
    assert min(costs, key=costs.get) == "optimal_feedback"
    for row in found.rows:
        assert row.cost == pytest.approx(row.squares["acceleration"] + 0.5 * row.squares["travel"], rel=1e-4)


def test_schedule_of_an_agent_that_sees_the_operating_point(tmp_path):
    own = make_task(**ENVIRONMENT, observation=[])
    found = compare(ConstantDamping(own, 0.5), environment=ENVIRONMENT, speeds=[1.5], controllers=[], episodes=16)
    assert found.references == (None, None)
    files = write(found, tmp_path)
    assert tmp_path / "schedule.png" in files
    page = (tmp_path / "comparison.html").read_text()
    excess = float(re.search(r"at most ([0-9.]+) % above the least", page)[1])
    worst = max(
        theoretical_cost(TASK, 0.5, speed, bandwidth) / optimum(TASK, speed, bandwidth).cost - 1
        for speed in np.linspace(0.7, 3.0, 60).tolist()
        for bandwidth in (0.1, 0.3)
    )
    assert excess == pytest.approx(100 * worst, abs=0.006)


def run(*arguments):
    return main([str(argument) for argument in arguments])


def full_disk(path, text):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path.name)


def test_command_line_goes_the_whole_way(tmp_path, capsys, monkeypatch):
    hyperparameters = tmp_path / "small.yaml"
    hyperparameters.write_text(HYPERPARAMETERS)
    output = tmp_path / "results"
    options = ["--episodes", 16, "--speeds", 1.5, "--bandwidths", 0.1]
    compared = [*options, "--controllers", "skyhook"]
    assert run("compare", "--output", output, "--hyperparameters", hyperparameters, *compared) == 0
    first = capsys.readouterr().out
    assert re.search(r"1\.5 +0\.1 ", first)
    assert "agent: learned from the cost, without theory's one-step lookahead" in " ".join(first.split())
    written = ["comparison.html", "comparison.json", "comparison.csv", "comparison.txt", "cost_over_speed.png"]
    written += ["cost_over_speed_narrow.png", "policy.png", "policy_narrow.png"]
    assert {*written, "agent-0"} == {path.name for path in output.iterdir()}
    # the table is there even where the files cannot be written
    with monkeypatch.context() as patch:
        patch.setattr("agents.comparison.write_atomically", full_disk)
        assert run("compare", "--output", tmp_path / "full", "--agent", output / "agent-0", *compared) == 2
    printed = capsys.readouterr()
    assert printed.out == first
    assert printed.err.splitlines()[-1] == f"roadgym compare: cannot use 'comparison.json': {os.strerror(errno.ENOSPC)}"
    # the same command again finds its agent trained, and says the same
    assert run("compare", "--output", output, "--hyperparameters", hyperparameters, *compared) == 0
    assert capsys.readouterr().out == first
    assert run("compare", "--agent", output / "agent-0", "--output", tmp_path / "again", "--json", *compared) == 0
    assert json.loads(capsys.readouterr().out)["rows"][0]["controller"] == "agent"
    assert run("evaluate", "--agent", output / "agent-0", *options) == 0
    said = capsys.readouterr().out
    assert "switches" in said
    assert "Constant dampings on the same roads, whose costs theory knows, serve as control variates" in " ".join(said.split())
    assert run("evaluate", "--controller", "skyhook", "--json", *options) == 0
    said = json.loads(capsys.readouterr().out)
    assert 0 < said["rows"][0]["standard_error"] < said["rows"][0]["driven_standard_error"]
    assert said["control_variates"]
    # more seeds train beside the first one
    assert run("compare", "--output", output, "--seeds", 2, "--hyperparameters", hyperparameters, *compared) == 0
    assert "Mean of 2 training seeds" in capsys.readouterr().out
    assert agents.load(output / "agent-1").description["seed"] == 1
    # other hyperparameters in the same folder are another agent: refused, with the way out, and the first one stays
    hyperparameters.write_text(HYPERPARAMETERS.replace("[8]", "[9]"))
    assert run("compare", "--output", output, "--hyperparameters", hyperparameters, *compared) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "holds an agent of other options, agent-0: choose another folder with --output" in said
    assert agents.load(output / "agent-0").description["hyperparameters"]["policy_kwargs"]["net_arch"] == [8]
    assert run("train", "--output", output / "agent-0", "--resume", "--timesteps", 600) == 0
    assert agents.load(output / "agent-0").description["timesteps"] >= 600
    # two agents that differ in more than the seed are two learned controllers
    assert run("train", "--output", output / "wider", "--hyperparameters", hyperparameters) == 0
    folders = [output / "agent-0", output / "wider"]
    assert run("compare", "--agent", *folders, "--output", tmp_path / "two", "--json", *compared) == 0
    rows = json.loads("{" + capsys.readouterr().out.partition("{")[2])["rows"]
    assert {row["controller"] for row in rows} == {"agent-0", "wider", "analytic_optimum", "skyhook"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["compare", "--road", "cobbles"], "unknown road 'cobbles'"),
        (["compare", "--damping-range", "0", "1"], "damping_range, low end, must be positive"),
        (["compare", "--speed-range", "3", "1"], "low <= high"),
        (["compare", "--speeds", "9"], "speed must lie within the environment's range"),
        (["compare", "--bandwidth-range", "-1", "1"], "bandwidth, low end, must be positive"),
        (["compare", "--speed-noise", "white"], "white speed noise is defined on the harmonic road only"),
        (["compare", "--agent", "nowhere"], "no agent in 'nowhere': no such folder"),
        (["compare", "--episodes", "2"], "episodes must be at least 16"),
        (["compare", "--algorithm", "dreamer"], "unknown algorithm 'dreamer'"),
        (["compare", "--output", "file/folder"], "cannot write to the folder 'file/folder'"),
        (["compare", "--seed", "-1"], "seed must be at least 0"),
        (["compare", "--agent", "x/agent", "y/agent", "./x/agent"], "the same folder twice, 'x/agent' and './x/agent'"),
        (["compare", "--output", "file"], "'file' is not a folder"),
        (["train", "--output", "file"], "'file' is not a folder"),
        (["tune", "--storage", "s.db", "--output", "."], "cannot write '.': '.' is a folder"),
        (["tune", "--storage", "s.db", "--output", "file/best.yaml"], "cannot write 'file/best.yaml': 'file' is not a folder"),
        (["figures", "--output", "file"], "the folder file cannot be written: 'file' is not a folder"),
        (["figures", "--output", "file/folder"], "the folder file/folder cannot be written: Not a directory"),
        (["benchmark", "--output", "."], "cannot write '.': '.' is a folder"),
        (["benchmark", "--output", "x.png", "--scaling"], "output must not end in .png"),
        (["explore", "--output", "."], "cannot write '.': '.' is a folder"),
        (["explore", "--output", os.devnull], "is not a regular file"),
        (["drive", "--controller", "skyhook", "--output", "none/film.gif"], "cannot write 'none/film.gif': no such folder"),
        (["train", "--output", "x", "--hyperparameters", "none.yaml"], "cannot read hyperparameters"),
        (["train", "--output", "x", "--seed", "4294967296"], "seed must be at most 4294967295"),
        (["train", "--output", "x", "--weights", "comfort=1"], "unknown reward term 'comfort'"),
        (["evaluate", "--agent", "nowhere"], "no agent in 'nowhere'"),
        (["evaluate", "--controller", "fuzzy"], "unknown controller 'fuzzy'"),
        (["evaluate", "--controller", "skyhook", "--road", "first_order"], "needs the signal 'slope'"),
    ],
)
def test_mistakes_get_one_line(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("in the way of a folder")
    assert main(arguments) == 2
    said = capsys.readouterr().err.strip()
    assert message in said
    assert "\n" not in said
    assert not any(tmp_path.glob("x/*"))


def test_output_takes_letters_that_it_does_not_have(tmp_path, monkeypatch):
    said = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(said, encoding="ascii"))
    assert main(["explore", "--output", str(tmp_path / "größe.html")]) == 0
    assert said.getvalue().splitlines()[0].endswith(rb"gr\xf6\xdfe.html")
    assert (tmp_path / "größe.html").stat().st_size


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no full device")
def test_output_that_cannot_be_written_is_told_in_one_line(tmp_path, capsys, monkeypatch):
    with Path("/dev/full").open("w") as full:
        monkeypatch.setattr("sys.stdout", full)
        assert main(["explore", "--output", str(tmp_path / "page.html")]) == 2
    assert capsys.readouterr().err == f"roadgym explore: {os.strerror(errno.ENOSPC)}\n"


def test_help_is_quick_and_has_an_example():
    code = "import sys, agents.cli as c\ntry: c.main(['compare', '--help'])\nexcept SystemExit: print('torch' in sys.modules)"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "example: roadgym compare --output results" in output
    assert output.endswith("False\n")
