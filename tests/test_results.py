"""Gains, gaps and their confidence intervals, from costs that are made up."""

import csv
import dataclasses
import io
import json
import re

import numpy as np
import pytest

from agents.evaluation import Evaluation, OperatingPoint
from agents.report import mean_gap_closed, table
from agents.results import Comparison, make_rows, mean_certified, mean_gap, ratio
from analysis.bounds import PROVED, STATISTICAL, LowerBound
from roadgym.task import make_task

TASK = make_task(road="multiplicative", speed=(0.7, 3.0), bandwidth=(0.1, 0.3))


def driven(*costs, episodes=32):
    """An evaluation at one point, of these costs with a little noise that all have in common."""
    noise = np.random.default_rng(1).normal(0, 0.05, (1, episodes))
    return [evaluation(cost * (1 + noise)) for cost in costs]


def evaluation(costs):
    """An evaluation of these costs, shape (points, episodes), without control variates."""
    points = tuple(OperatingPoint(1.0 + k, 0.1) for k in range(len(costs)))
    squares = np.zeros((5, *costs.shape))
    return Evaluation(points, costs, squares, TASK.car.mean_squares, np.zeros(len(costs)), costs, squares)


def test_gap_closed_is_the_share_of_the_way_to_the_optimal_feedback():
    rivals = {"analytic_optimum": driven(1.0)[0], "optimal_feedback": driven(0.2)[0]}
    rows, references = make_rows(TASK, {"agent": driven(0.4)}, rivals)
    assert references == ("optimal_feedback",)
    assert [row.gap_closed.value for row in rows] == pytest.approx([0.75, 0.0, 1.0])
    # the noise is common, so it cancels in the ratio, though not in the cost
    assert rows[0].gap_closed.high - rows[0].gap_closed.low < 1e-12
    assert rows[0].standard_error > 1e-3
    better, _ = make_rows(TASK, {"agent": driven(0.1)}, rivals)
    assert better[0].gap_closed.value == pytest.approx(1.125)  # over 100 %
    rivals["optimal_feedback"] = driven(0.99)[0]  # nothing to be gained
    rows, references = make_rows(TASK, {"agent": driven(0.4)}, rivals)
    assert [row.gap_closed for row in rows] == [None] * 3
    text = table(Comparison(rows, TASK, {"agent": [None]}, references, {}))
    assert "n/a" in text


def bounded(cost, standard_error=0.0):
    rigour = STATISTICAL if standard_error else PROVED
    return LowerBound(cost=cost, method="matrix_inequality", assumption="any", rigour=rigour, standard_error=standard_error)


def test_certified_share_is_the_share_of_the_way_to_the_lower_bound():
    rivals = {"analytic_optimum": driven(1.0)[0], "optimal_feedback": driven(0.2)[0]}
    rows, _ = make_rows(TASK, {"agent": driven(0.4)}, rivals, [bounded(0.1)])
    assert [row.certified.value for row in rows] == pytest.approx([0.6 / 0.9, 0.0, 0.8 / 0.9], rel=0.02)
    assert all(row.certified.value < row.gap_closed.value for row in rows if row.controller == "agent")
    for nothing in ("no reason", bounded(0.99)):  # there is none, or nothing to save
        rows, _ = make_rows(TASK, {"agent": driven(0.4)}, rivals, [nothing])
        assert [row.certified for row in rows] == [None] * 3
    mean = mean_certified(driven(0.4), rivals, ["no reason"])
    assert mean.share is None
    assert len(mean.left_out) == 1


def test_interval_of_the_certified_share_holds_the_error_of_the_bound():
    best, agent = evaluation(np.ones((2, 32))), evaluation(np.full((2, 32), 0.4))
    bounds = [bounded(0.1, 0.009), bounded(0.2, 0.0)]
    (row, *_), _ = make_rows(TASK, {"agent": [agent]}, {"analytic_optimum": best}, bounds)
    student = 2.0395  # 31 degrees of freedom
    assert row.certified.high - row.certified.value == pytest.approx(student * 0.6 / 0.9 * 0.01, rel=1e-3)
    mean = mean_certified([agent], {"analytic_optimum": best}, bounds)
    assert mean.share.value == pytest.approx((0.6 / 0.9 + 0.6 / 0.8) / 2)
    assert mean.share.high - mean.share.value == pytest.approx(student * 0.6 / 0.9 * 0.01 / 2, rel=1e-3)


def test_bounds_are_in_json_and_csv_and_what_is_missing_has_its_reason():
    rivals = {"analytic_optimum": evaluation(np.ones((2, 32)))}
    bounds = (bounded(0.1, 0.01), "a road of soap")
    rows, references = make_rows(TASK, {}, rivals, bounds)
    found = Comparison(rows, TASK, {}, references, {}, {}, bounds, {})
    first, second = json.loads(found.to_json())["lower_bounds"]
    assert (first["cost"], first["standard_error"], first["rigour"]) == (0.1, 0.01, STATISTICAL)
    assert second == {"speed": 2.0, "bandwidth": 0.1, "reason": "a road of soap"}
    lines = list(csv.DictReader(io.StringIO(found.to_csv())))
    assert [line["lower_bound"] for line in lines] == ["0.1", ""]
    text = table(found)
    assert re.search(r"1  +0\.1 .* 0\.100\(10\)", text)
    assert "2 of 2" not in text
    assert "n/a where there is none: a road of soap." in " ".join(text.split())


def test_mean_gap_counts_every_point_that_has_one_and_tells_of_the_others():
    best, noise = np.ones((4, 1)), np.random.default_rng(2).normal(0, 0.01, (4, 64))
    rivals = {"analytic_optimum": evaluation(best + 0 * noise)}
    # feedback saves a half at two points and next to nothing at the other two
    rivals["optimal_feedback"] = evaluation(np.array([[0.5], [0.5], [0.99], [0.99]]) + 0 * noise)
    agents_costs = np.array([[0.6], [1.2], [1.05], [1.15]]) + noise - noise.mean(axis=1, keepdims=True)
    rows, references = make_rows(TASK, {"agent": [evaluation(agents_costs)]}, rivals)
    gap = mean_gap([evaluation(agents_costs)], rivals, references)
    assert gap.closed.value == pytest.approx((0.8 - 0.4) / 2)  # worse than a constant damping at one of them
    assert [point.speed for point in gap.points] == [1.0, 2.0]
    assert [point.speed for point in gap.left_out] == [3.0, 4.0]
    assert gap.loss.value == pytest.approx(0.10)
    assert (gap.largest_loss.value, gap.largest_at.speed) == (pytest.approx(0.15), 4.0)
    # the roads of two points are independent
    errors = agents_costs[:2].std(axis=1, ddof=1) / 8 / 0.5
    assert gap.closed.high - gap.closed.value == pytest.approx(1.9983 * np.hypot(*errors) / 2, rel=1e-3)
    found = Comparison(rows, TASK, {"agent": [None]}, references, {}, {"agent": gap})
    said = mean_gap_closed(found, "agent")
    assert said.startswith("agent closes 20.0 ±")
    assert "on average over the 2 of 4 operating points that have one" in said
    assert re.search(r"\(2 of 4 points\), its cost is 10.0 ±[0-9.]+ % above that of the best constant D on average, ", said)
    assert re.search(r", 15.0 ±[0-9.]+ % above at worst \(nu = 4, delta = 0.1\)", said)
    better = mean_gap([evaluation(0.9 * rivals["optimal_feedback"].costs)], rivals, references)
    assert "10.9 ±0.0 % below" in mean_gap_closed(dataclasses.replace(found, mean_gaps={"agent": better}), "agent")
    assert said in " ".join(table(found).split())
    assert json.loads(found.to_json())["mean_gap_closed"]["agent"]["closed"]["value"] == gap.closed.value


@pytest.mark.parametrize(("points", "gaps"), [(1, 1), (1, 0), (2, 1)])
def test_what_is_said_of_one_point_is_in_the_singular(points, gaps):
    best = np.ones((points, 1)) + np.random.default_rng(2).normal(0, 0.01, (points, 64))
    feedback = np.array([[0.5]] * gaps + [[0.99]] * (points - gaps))
    rivals = {"analytic_optimum": evaluation(best), "optimal_feedback": evaluation(feedback * best)}
    rows, references = make_rows(TASK, {"agent": [evaluation(1.1 * best)]}, rivals)
    gap = mean_gap([evaluation(1.1 * best)], rivals, references)
    said = mean_gap_closed(Comparison(rows, TASK, {"agent": [None]}, references, {}, {"agent": gap}), "agent")
    assert {
        (1, 1): "agent closes none of the gap (-20.0 ±0.0 %) from the best constant D to the optimal feedback, at the one "
        "operating point.",
        (
            1,
            0,
        ): "agent: no operating point has a gap to close. Its cost is 10.0 ±0.0 % above that of the best constant D (nu = 1, "
        "delta = 0.1).",
        (2, 1): "agent closes none of the gap (-20.0 ±0.0 %) from the best constant D to the optimal feedback, on average over "
        "the 1 of 2 operating points that has one. Where there is none (1 of 2 points), its cost is 10.0 ±0.0 % above that of "
        "the best constant D (nu = 2, delta = 0.1).",
    }[points, gaps] == said


def test_theory_has_the_decimals_of_the_cost():
    costs = 0.00137 + 1e-5 * np.random.default_rng(3).normal(0, 1, (1, 64))
    rows, references = make_rows(TASK, {}, {"analytic_optimum": evaluation(costs)})
    rows = tuple(dataclasses.replace(row, theory=0.00136912) for row in rows)
    configuration = {"control_variates": (0.3,)}
    text = " ".join(table(Comparison(rows, TASK, {}, references, configuration)).split())
    assert re.search(r" 0\.0013691 0\.0013\d{3}\(1\d\) ", text)  # both digits of the error, however small the cost
    assert "the one cost of constant D is within" in text


def test_mean_gap_of_several_seeds_holds_the_spread_of_their_means():
    rivals = {"analytic_optimum": evaluation(np.ones((2, 32))), "optimal_feedback": evaluation(np.full((2, 32), 0.2))}
    seeds = [evaluation(np.array([[a], [b]]) + np.zeros(32)) for a, b in ((0.3, 0.5), (0.4, 0.4), (0.6, 0.4))]
    gap = mean_gap(seeds, rivals, ("optimal_feedback",) * 2)
    # what a seed loses at one point and gains at the other does not count
    spread = np.std([0.75, 0.75, 0.625], ddof=1)
    assert gap.closed.value == pytest.approx(2.125 / 3)
    assert gap.closed.high - gap.closed.value == pytest.approx(4.3027 * spread / np.sqrt(3), rel=1e-3)
    assert [gap.worst_seed.value, gap.least.value, gap.least_at.speed] == pytest.approx([0.625, 0.5, 1.0])
    rows, references = make_rows(TASK, {"agent": seeds}, rivals)
    assert [row.worst_seed.value for row in rows[:2]] == pytest.approx([0.5, 0.625])
    text = " ".join(table(Comparison(rows, TASK, {"agent": [None] * 3}, references, {}, {"agent": gap})).split())
    assert "gap closed worst seed" in text
    assert (
        "The worst of its training seeds closes 62.5 ±0.0 % on average, and none less than 50.0 ±0.0 % anywhere (nu = 1,"
        in text
    )


def test_best_known_feedback_without_the_optimal_one_is_the_best_classical():
    rivals = {"analytic_optimum": driven(1.0)[0], "skyhook": driven(0.6)[0], "add": driven(0.5)[0], "d_min": driven(0.1)[0]}
    rows, references = make_rows(TASK, {"agent": driven(0.4)}, rivals)
    assert references == ("add",)  # a constant damping is no feedback
    assert rows[0].gap_closed.value == pytest.approx(1.2)


def test_interval_holds_the_spread_of_training_seeds():
    rivals = {"analytic_optimum": driven(1.0)[0], "optimal_feedback": driven(0.2)[0]}
    rows, _ = make_rows(TASK, {"agent": driven(0.3, 0.4, 0.5)}, rivals)
    gap = rows[0].gap_closed
    # Student's law with two degrees of freedom: 4.303 standard errors of shares that spread by 0.125
    assert gap.value == pytest.approx(0.75)
    assert gap.high - gap.value == pytest.approx(4.3027 * 0.125 / np.sqrt(3), rel=1e-3)


@pytest.mark.statistical
@pytest.mark.parametrize("points", [1, 5])
def test_interval_of_a_ratio_covers_the_truth(points):
    generator = np.random.default_rng(7)
    covered = 0
    for _ in range(400):
        road = generator.normal(1, 0.2, (points, 64))
        share = ratio((0.3 * road + generator.normal(0, 0.1, (points, 64)))[:, None], road)
        covered += share.low < 0.3 < share.high
    # 95 % of 400, within four standard errors of 1.1 %
    assert abs(covered / 400 - 0.95) < 4 * 0.011
