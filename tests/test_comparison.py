"""Evaluation, comparison and the command line, at small size."""

import json
import re
import subprocess
import sys

import matplotlib.image
import numpy as np
import pytest

import agents
from agents.cli import main
from agents.comparison import Comparison, compare, make_rows, table, with_error, write
from agents.controllers import ConstantDamping, make_controller, theoretical_cost
from agents.evaluation import Evaluation, OperatingPoint, evaluate
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
        transient=25.0,
    )["constant"]
    for k, point in enumerate(found.points):
        expected = theoretical_cost(TASK, float(np.float32(0.4)), point.speed, point.bandwidth)
        assert found.standard_error[k] < 0.01 * expected
        assert abs(found.mean[k] - expected) < 4 * found.standard_error[k]
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
        {"switching": EverySecondStep(TASK, 0.0)},
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


@pytest.fixture(scope="module")
def comparison():
    return compare(
        make_controller("skyhook", TASK), environment=ENVIRONMENT, speeds=[1.0, 2.0], bandwidths=[0.1, 0.3], episodes=16
    )


def test_comparison_states_gains_and_theory(comparison):
    point = comparison.points[0]
    agent, skyhook, best = (comparison.row(name, point) for name in ("agent", "skyhook", "analytic_optimum"))
    assert agent.cost == skyhook.cost  # the agent here is skyhook, and the roads are the same
    assert agent.gain == pytest.approx(1 - agent.cost / best.cost)
    assert best.gain == 0
    assert agent.theory is None
    assert best.theory == pytest.approx(theoretical_cost(TASK, best.damping, point.speed, point.bandwidth))
    text = table(comparison)
    assert len(text.splitlines()) == 2 + 1 + 4 + 3
    assert max(len(line) for line in text.splitlines()) < 128
    content = json.loads(comparison.to_json())
    assert len(content["rows"]) == 4 * 5
    assert content["environment"]["road"] == "multiplicative"
    assert content["versions"]["roadgym"]


def test_comparison_is_written_with_pictures(comparison, tmp_path):
    files = write(comparison, tmp_path / "out", make_controller("skyhook", TASK))
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(path.name for path in files)
    for file in files:
        if file.suffix == ".png":
            picture = matplotlib.image.imread(file)
            assert picture.shape[0] > 500
            assert picture[..., :3].std() > 0.05  # not blank


def run(*arguments):
    return main([str(argument) for argument in arguments])


def test_command_line_goes_the_whole_way(tmp_path, capsys):
    hyperparameters = tmp_path / "small.yaml"
    hyperparameters.write_text(HYPERPARAMETERS)
    output = tmp_path / "results"
    options = ["--episodes", 16, "--speeds", 1.5, "--bandwidths", 0.1]
    assert run("compare", "--output", output, "--hyperparameters", hyperparameters, *options) == 0
    first = capsys.readouterr().out
    assert re.search(r"1\.5 +0\.1 ", first)
    assert {"comparison.json", "comparison.txt", "cost_over_speed.png", "policy.png", "agent"} == {
        path.name for path in output.iterdir()
    }
    # the same command again finds its agent trained, and says the same
    assert run("compare", "--output", output, "--hyperparameters", hyperparameters, *options) == 0
    assert capsys.readouterr().out == first
    assert run("compare", "--agent", output / "agent", "--output", tmp_path / "again", "--json", *options) == 0
    assert json.loads(capsys.readouterr().out)["rows"][0]["controller"] == "agent"
    assert run("evaluate", "--agent", output / "agent", *options) == 0
    assert "switches" in capsys.readouterr().out
    assert run("evaluate", "--controller", "skyhook", "--json", *options) == 0
    assert json.loads(capsys.readouterr().out)["rows"][0]["standard_error"] > 0
    # another seed in the same folder is another agent: refused, and the first one stays
    assert run("compare", "--output", output, "--seed", 1, "--hyperparameters", hyperparameters, *options) == 2
    assert "holds an agent already" in capsys.readouterr().err
    assert agents.load(output / "agent").description["seed"] == 0
    assert run("train", "--output", output / "agent", "--resume", "--timesteps", 600) == 0
    assert agents.load(output / "agent").description["timesteps"] >= 600


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
        (["train", "--output", "x", "--hyperparameters", "none.yaml"], "cannot read hyperparameters"),
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


def test_help_is_quick_and_has_an_example():
    code = "import sys, agents.cli as c\ntry: c.main(['compare', '--help'])\nexcept SystemExit: print('torch' in sys.modules)"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "example: roadgym compare --output results" in output
    assert output.endswith("False\n")


def test_gap_closed_is_the_share_of_the_way_to_the_optimal_feedback():
    point = OperatingPoint(1.5, 0.1)
    generator = np.random.default_rng(1)

    def driven(mean):
        return Evaluation((point,), generator.normal(mean, 1e-3, (1, 32)), np.zeros(1))

    costs = {"agent": 0.4, "analytic_optimum": 1.0, "optimal_feedback": 0.2}
    rows = make_rows(TASK, {name: driven(mean) for name, mean in costs.items()})
    assert [row.gap_closed for row in rows] == pytest.approx([0.75, 0.0, 1.0], abs=0.01)
    costs["optimal_feedback"] = 0.99  # nothing to be gained
    rows = make_rows(TASK, {name: driven(mean) for name, mean in costs.items()})
    assert [row.gap_closed for row in rows] == [None] * 3
    text = table(Comparison(rows, TASK, {}))
    assert "gap closed" in text
    assert "n/a" in text
