"""Evaluations behind sensors and valves: who sees what, and what theory is worth there."""

import itertools

import numpy as np
import pytest

import agents
from agents.cli import main
from agents.controllers import make_controller
from agents.driving import frames
from agents.evaluation import evaluate, through_sensors
from agents.results import constant_damping
from agents.theory import theoretical_cost
from agents.wrappers import AdvantageReward, training_reward
from analysis.certification import certify
from roadgym import ParameterError, Valve
from roadgym.env import QuarterCarEnv
from roadgym.task import make_task

PLANT = {"road": "gaussian", "speed": 1.5, "bandwidth": 0.1}
GRID = {"speeds": [1.5], "bandwidths": [0.1], "episodes": 32, "duration": 40.0}
NOISY = {"noise": 0.5}


class Reference(agents.Controller):
    """Skyhook that says that it sees the truth."""

    full_knowledge = True
    needs = ("velocity", "relative_velocity")

    def damping(self, signals):
        low, high = self.task.damping_range
        return np.where(signals["velocity"] * signals["relative_velocity"] > 0, high, low)


class Sensing(Reference):
    full_knowledge = False


def costs(environment, controllers):
    task = make_task(**{**environment, "observation": ["velocity", "relative_velocity"]})
    made = {name: kind(task) for name, kind in controllers.items()}
    return {name: found.costs for name, found in evaluate(made, environment=environment, **GRID).items()}


def test_rules_see_sensors_and_references_see_the_truth():
    both = {"reference": Reference, "sensing": Sensing}
    plain, noisy = costs(PLANT, both), costs({**PLANT, "sensors": NOISY}, both)
    np.testing.assert_array_equal(plain["reference"], plain["sensing"])
    np.testing.assert_array_equal(noisy["reference"], plain["reference"])
    assert noisy["sensing"].mean() > 1.05 * plain["sensing"].mean()


def test_the_optimal_feedback_is_a_reference_and_rules_are_not():
    task = make_task(**PLANT, sensors=NOISY)
    environment = {**PLANT, "sensors": NOISY}
    assert through_sensors(make_controller("optimal_feedback", task), environment)["sensors"] is None
    for name in ("skyhook", "clipped_lqr", "analytic_optimum"):
        assert through_sensors(make_controller(name, task), environment)["sensors"] == NOISY


def test_films_show_each_what_it_sees():
    pytest.importorskip("pygame")
    environment = {**PLANT, "sensors": NOISY}
    task = make_task(**{**environment, "observation": ["velocity", "relative_velocity"], "observe_operating_point": False})

    def pictures(kind):
        return list(itertools.islice(frames([("car", kind(task))], environment, seed=1), 12))

    assert not np.array_equal(pictures(Reference)[-1], pictures(Sensing)[-1])


@pytest.mark.statistical
@pytest.mark.parametrize("valve", [{"delay": 0.1, "rise_time": 0.1, "fall_time": 0.2}, {"levels": 6}], ids=str)
def test_constant_dampings_cost_what_theory_says_behind_a_valve(valve):
    environment = {**PLANT, "valve": valve, "sensors": NOISY}
    task = make_task(**environment)
    made = {"analytic_optimum": make_controller("analytic_optimum", task)}
    found = evaluate(made, environment=environment, **{**GRID, "episodes": 64, "duration": 150.0})["analytic_optimum"]
    damping = constant_damping(task, "analytic_optimum", found.points[0])
    expected = theoretical_cost(task, damping, 1.5, 0.1)
    assert found.control_variates
    assert abs(found.mean[0] - expected) < 4 * found.standard_error[0] + 3e-4 * expected
    raw = found.costs[0]
    assert abs(raw.mean() - expected) < 4 * raw.std(ddof=1) / np.sqrt(raw.size)
    levels = Valve(**valve).settled(found.control_variates, task.damping_range)
    np.testing.assert_allclose(levels, found.control_variates, rtol=1e-9)


def test_balances_serve_only_where_damping_keeps_its_value():
    environment = {"road": "iso_c", "car": "two_mass", "speed": 20.0}
    grid = {"speeds": [20.0], "episodes": 64, "duration": 1.0}
    served = []
    for valve in (None, {"delay": 0.005}, {"rise_time": 0.01}):
        task = make_task(**environment, valve=valve)
        made = {"skyhook": make_controller("skyhook", task)}
        served.append(evaluate(made, environment={**environment, "valve": valve}, **grid)["skyhook"].balances)
    assert served[0] == served[1] != ()
    assert served[2] == ()


def test_a_slow_valve_is_paid_its_cost():
    slow = make_task(**PLANT, valve={"rise_time": 0.1})
    assert training_reward("advantage", make_task(**PLANT)) == "advantage"
    assert training_reward("advantage", slow) == "cost"
    with pytest.raises(ParameterError, match="an ideal valve"):
        AdvantageReward(QuarterCarEnv(**PLANT, valve={"rise_time": 0.1}))


def test_the_plant_is_certified_under_a_rule_with_sensors():
    task = make_task(**PLANT, observation=["velocity", "relative_velocity"], sensors=NOISY, valve={"rise_time": 0.1})
    certificate = certify("gaussian", speed=1.5, lanes=1024, driver=Sensing(task))
    assert certificate.passed


def test_commands_take_sensors_and_valves(capsys):
    point = ["--road", "gaussian", "--speeds", "1.5", "--bandwidths", "0.1", "--episodes", "16"]
    given = ["--sensors", '{"noise": {"velocity": 0.1}}', "--valve", '{"rise_time": 0.05}']
    said = []
    for more in ([], given):
        main(["evaluate", "--controller", "skyhook", *point, *more])
        said.append(capsys.readouterr().out)
    assert said[0] != said[1]
    assert main(["evaluate", "--controller", "skyhook", *point, "--sensors", '{"noise": {"speed": 1}}']) != 0
    assert "sensors cannot be of 'speed'" in capsys.readouterr().err
