"""``roadgym certify --optimal`` and ``roadgym compare --bound``: what is driven, held against what no controller can beat."""

import dataclasses
import json
import re

import pytest

from agents.cli import main
from agents.comparison import compare
from agents.optimality import certify_optimality
from analysis.bounds import METHODS, PROVED, LowerBound
from roadgym.parameters import ParameterError

METHOD = ["--methods", "matrix_inequality"]
PLANT = ["--road", "gaussian", "--speed", "2", "--bandwidth", "0.3", "--lanes", "64", *METHOD]
ENVIRONMENT = {"road": "gaussian", "speed": (1.0, 3.0), "bandwidth": (0.1, 0.3)}


def claimed(cost):
    """A method that claims a bound."""

    def bound(task, speed, bandwidth, *, report):
        return LowerBound(cost=cost, method="matrix_inequality", assumption="nothing", rigour=PROVED)

    return dataclasses.replace(METHODS["matrix_inequality"], bound=bound)


@pytest.fixture
def without_feedback(monkeypatch):
    """The optimal feedback, which takes long, is not known."""

    def refused(*_):
        raise ParameterError("not here")

    monkeypatch.setattr("analysis.feedback.check_plant", refused)


@pytest.mark.usefixtures("without_feedback")
def test_one_point_from_both_sides_reads_in_80_columns(capsys):
    assert main(["certify", "--optimal", "--controller", "skyhook", *PLANT]) == 0
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    assert re.search(r"^best constant D +0\.82\d+\(\d+\) +0\.0 ±0\.0 %$", text, re.MULTILINE)
    assert re.search(r"^skyhook +0\.3\d+\(\d+\) +\d\d\.\d ±\d\.\d %$", text, re.MULTILINE)
    assert re.search(r"^bound by a matrix inequality +0\.0\d+$", text, re.MULTILINE)
    assert "By a matrix inequality: proved, for any controller" in " ".join(text.split())
    assert text.endswith("no bound exceeds a driven cost\n")


@pytest.mark.usefixtures("without_feedback")
def test_a_bound_above_a_driven_cost_is_told_by_code_1_and_one_within_its_error_is_not(capsys, monkeypatch):
    monkeypatch.setitem(METHODS, "matrix_inequality", claimed(0.9))
    assert main(["certify", "--optimal", "--json", *PLANT]) == 1
    told = json.loads(capsys.readouterr().out)
    assert told["passed"] is False
    (row,) = told["rows"]
    assert row["cost"] < told["bounds"]["matrix_inequality"]["cost"] == 0.9
    monkeypatch.setitem(METHODS, "matrix_inequality", claimed(row["cost"] * 1.0005))
    assert main(["certify", "--optimal", *PLANT]) == 0


@pytest.mark.usefixtures("without_feedback")
def test_rules_behind_sensors_and_a_valve_are_held_against_the_bounds_of_full_knowledge(capsys):
    told = {}
    realism = ["--sensors", '{"noise": 0.5}', "--valve", '{"delay": 0.2}']
    for name, more in {"ideal": [], "real": realism}.items():
        assert main(["certify", "--optimal", "--json", "--controller", "skyhook", *PLANT, *more]) == 0
        told[name] = json.loads(capsys.readouterr().out)
    costs = {name: {row["controller"]: row["cost"] for row in found["rows"]} for name, found in told.items()}
    assert costs["real"]["skyhook"] > 1.1 * costs["ideal"]["skyhook"]
    assert told["real"]["bounds"] == told["ideal"]["bounds"]


@pytest.mark.usefixtures("without_feedback")
def test_where_no_bound_is_known_the_reason_is_told(capsys):
    plant = ["--road", "harmonic", "--speed-noise", "white", "--lanes", "32", *METHOD]
    assert main(["certify", "--optimal", *plant]) == 0
    text = capsys.readouterr().out
    assert "By a matrix inequality: none, white noise on the speed." in text
    assert text.endswith("no lower bound is known\n")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--optimal", "--damping", "0.3"], "--damping cannot be given with --optimal, which finds the best one"),
        (["--weights", "travel=1"], "--weights cannot be given without --optimal"),
        (["--bandwidth", "0.2"], "--bandwidth cannot be given without --optimal"),
        (["--optimal", *PLANT[:-2], "--methods", "guess"], "methods must be of matrix_inequality"),
        (["--optimal", "--weights", "comfort=1", *PLANT], "unknown reward term 'comfort'"),
        (["--optimal", "--road", "first_order", "--bandwidth", "0.2"], "bandwidth"),
    ],
)
def test_wrong_options_are_told_in_one_line(arguments, message, capsys):
    assert main(["certify", *arguments]) == 2
    told = capsys.readouterr().err
    assert message in told
    assert told.count("\n") == 1


def test_compare_knows_which_bounds_it_can_be_asked_for(capsys):
    assert main(["compare", "--bound", "loose"]) == 2
    assert "bound must be fast, tight, none or a method's name, got 'loose'" in capsys.readouterr().err
    with pytest.raises(ParameterError, match="bound must be fast, tight, none"):
        compare(None, environment=ENVIRONMENT, bound="loose")


def test_a_comparison_holds_costs_against_the_bounds_that_it_is_asked_for():
    options = {"environment": ENVIRONMENT, "speeds": [2.0], "bandwidths": [0.3], "controllers": ("skyhook",), "episodes": 16}
    told = []
    fast = compare(None, **options, report=lambda *progress: told.append(progress))
    assert ("lower bounds", 100, 100) in told
    (bound,) = fast.bounds
    for row in fast.rows:
        best = fast.row("analytic_optimum", row.point).cost
        assert row.certified.value == pytest.approx((best - row.cost) / (best - bound.cost))
    assert json.loads(fast.to_json())["bound"] == "fast"
    none = compare(None, **options, bound="none")
    assert none.bounds == ()
    assert {row.certified for row in none.rows} == {None}


def test_methods_may_be_chosen_and_other_ones_are_left_out():
    told = certify_optimality(
        environment={"road": "harmonic", "speed": 1.0},
        speed=1.0,
        methods=["matrix_inequality"],
        episodes=32,
        report=lambda *_: None,
    )
    assert list(told.bounds) == ["matrix_inequality"]
    assert told.passed
