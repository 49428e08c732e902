"""A reader's own road, registered in one line, through every command: the README's, with theory, and without."""

import dataclasses
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

import agents
import analysis
import roadgym
from agents.cli import main
from roadgym import ROADS, ParameterError
from roadgym.compiled import LEVEL, LaneFunction

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
HYPERPARAMETERS = """roadgym/QuarterCar-v0:
  n_envs: 8
  n_steps: 16
  batch_size: 64
  n_epochs: 1
  n_timesteps: 256
  policy_kwargs: {net_arch: [8]}
"""


@pytest.fixture(scope="module")
def two_frequency():
    """The README's road; a module of its own, so that its classes can be found again."""
    source = next(code for code in re.findall(r"```python\n(.*?)```", README, re.DOTALL) if "TwoFrequencyRoad" in code)
    scope: dict = {"__name__": __name__}
    exec(compile(source, "README.md", "exec"), scope)
    yield scope["TwoFrequencyRoad"]
    del ROADS["two_frequency"]


def test_theory_is_the_sum_over_the_waves(two_frequency):
    road = two_frequency(share=0.4, ratio=2.3)
    found = analysis.mean_squares(road, damping=0.2, speed=1.1)
    for name in roadgym.MEAN_SQUARES:
        parts = [
            getattr(analysis.mean_squares("harmonic", damping=0.2, speed=1.1 * k), name) * variance
            for k, variance in ((1.0, 1.0), (2.3, 0.16))
        ]
        assert getattr(found, name) == pytest.approx(sum(parts), rel=1e-12)
    assert found.standard_error is None
    best = analysis.optimal_damping(road, speed=2.0)
    assert best.standard_error is None
    with pytest.raises(ParameterError, match="a pair of lines for each of its waves"):
        analysis.spectral_density(road, 1.0, speed=1.0)


def test_every_command_takes_it(two_frequency, tmp_path, capsys):
    hyperparameters = tmp_path / "tiny.yaml"
    hyperparameters.write_text(HYPERPARAMETERS)
    road = ["--road", "two_frequency"]

    assert main(["certify", *road, "--lanes", "4096", "--json"]) == 0
    lines = {line["name"]: line for line in json.loads(capsys.readouterr().out)["lines"]}
    for name in roadgym.MEAN_SQUARES:
        assert lines[f"mean square of the {name.replace('_', ' ')} (m^2)"]["passed"]
        assert lines[f"{name.replace('_', ' ')} with D alternating (m^2)"]["passed"]
    assert lines["variance of the slope (m^2)"]["expected"] == pytest.approx((1 + 0.25 * 1.7**2) / 2)

    drive = ["--speeds", "1.2", "--episodes", "32"]
    agent, output = str(tmp_path / "agent"), tmp_path / "results"
    training = ["--speed-range", "1", "2", "--hyperparameters", str(hyperparameters)]
    assert main(["train", *road, *training, "--output", agent]) == 0
    assert main(["evaluate", "--agent", agent, *drive]) == 0
    capsys.readouterr()
    assert main(["compare", "--agent", agent, "--output", str(output), *drive]) == 0
    rows = {row["controller"]: row for row in json.loads((output / "comparison.json").read_text())["rows"]}
    exact = analysis.optimal_damping("two_frequency", speed=1.2)
    assert rows["analytic_optimum"]["theory"] == pytest.approx(exact.cost)
    assert rows["analytic_optimum"]["cost"] == pytest.approx(exact.cost, rel=0.02)
    assert rows["agent"]["gap_closed"] is not None  # the way to the best classical rule
    assert agents.load(agent).task.road.kind == "two_frequency"


def test_what_no_theory_knows_is_driven(two_frequency):
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Unknown(two_frequency):
        lines = None

    known, unknown = two_frequency(), Unknown()
    exact = analysis.mean_squares(known, damping=0.3, speed=1.2)
    found = analysis.mean_squares(unknown, damping=0.3, speed=1.2)
    for name in roadgym.MEAN_SQUARES:
        error = getattr(found.standard_error, name)
        assert 0 < error < 0.01 * getattr(exact, name)
        assert abs(getattr(found, name) - getattr(exact, name)) < 4 * error + 1e-3 * getattr(exact, name)
    best, driven = (analysis.optimal_damping(road, speed=2.0) for road in (known, unknown))
    assert driven.cost == pytest.approx(best.cost, abs=4 * driven.standard_error.cost + 2e-3 * best.cost)


@LaneFunction
def start_nowhere(lane, words, table):
    """No number."""
    lane[LEVEL] = math.nan


@dataclasses.dataclass(frozen=True, kw_only=True)
class Nowhere(roadgym.GaussianRoad):
    """A road whose author divided by zero."""

    kind: str = dataclasses.field(default="nowhere", init=False)
    start = start_nowhere


def test_a_road_that_is_not_a_number_ends_a_command_in_one_line(capsys):
    roadgym.register("road", "nowhere", Nowhere)
    try:
        assert main(["evaluate", "--controller", "d_max", "--road", "nowhere", "--episodes", "16"]) == 2
    finally:
        del ROADS["nowhere"]
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("roadgym evaluate: environment 0 of ")
    assert "Nowhere(" in last


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("wheel", "x", roadgym.GaussianRoad), "what must be one of road, speed_noise, car, got 'wheel'"),
        (("road", "gaussian", roadgym.WhiteSpeedNoise), "road 'gaussian' must be a dataclass that is a Road"),
        (("road", "mine", roadgym.GaussianRoad), "name of the road must be its kind, 'gaussian', got 'mine'"),
        (("speed_noise", "white", int), "speed noise 'white' must be a dataclass that is a SpeedNoise"),
    ],
)
def test_what_cannot_be_registered_is_refused(arguments, message):
    with pytest.raises(ParameterError, match=re.escape(message)):
        roadgym.register(*arguments)


def test_a_name_is_not_taken_twice():
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Other(roadgym.GaussianRoad):
        pass

    with pytest.raises(ParameterError, match="road 'gaussian' exists already"):
        roadgym.register("road", "gaussian", Other)
    roadgym.register("road", "gaussian", roadgym.GaussianRoad)  # the same again does no harm
    assert ROADS["gaussian"] is roadgym.GaussianRoad


class ThirdOrder(roadgym.LinearRoad):
    """Matrices alone, whatever they are."""

    variance = 1.0
    has_slope = True
    given = None

    def matrices(self):
        return self.given


@pytest.mark.parametrize(
    ("matrices", "message"),
    [
        (([[1.0]], [[1.0]], [1.0]), "must be stable"),
        (([[-1.0]], [[1.0]], [1.0, 2.0]), "must have the shapes"),
        ((-np.eye(5), np.ones((5, 1)), np.ones(5)), "must have the shapes"),
        (([[-1.0]], [[1.0]], [1.0]), "has_slope"),
        (([[-1.0, 0.0], [0.0, -2.0]], [[1.0], [0.0]], [0.0, 1.0]), "must move every state"),
    ],
)
def test_matrices_that_are_no_road_are_refused(matrices, message):
    road = type("OwnRoad", (ThirdOrder,), {"given": matrices})()
    with pytest.raises(ParameterError, match=message):
        road.shaping_filter()
