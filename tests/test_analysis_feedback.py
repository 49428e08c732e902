import functools
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import analysis
from analysis import feedback
from analysis.feedback import OptimalFeedback, optimal_feedback
from analysis.quadratic import plant_system
from roadgym.parameters import ParameterError
from roadgym.plant import Plant
from roadgym.roads import FirstOrderRoad, GaussianRoad, MultiplicativeRoad
from roadgym.task import make_task

ROAD = MultiplicativeRoad.from_shape(shape=2.0, bandwidth=0.3)
SPEED, BOUNDS = 1.5, (0.1, 1.0)
POINT = ("road", "speed", "natural_frequency", "weights", "bounds", "control_interval")
QUICK = {"precision": 0.02, "refinements": 1, "threads": 1}


@functools.cache
def found() -> OptimalFeedback:
    return optimal_feedback(ROAD, speed=SPEED, bounds=BOUNDS, precision=0.01, refinements=2, threads=1)


def drive(rule: Callable[[np.ndarray], np.ndarray], lanes: int = 1024) -> tuple[float, float]:
    """Cost and standard error of a rule D(observation) on the plant of `found`, over noise of its own."""
    plant = Plant(make_task(road=ROAD, speed=SPEED, damping_range=BOUNDS), lanes)
    observations = plant.start(np.arange(lanes, dtype=np.uint64)).observations
    skipped, steps, total = 250, 700, np.zeros(lanes)
    for step in range(skipped + steps):
        interval = plant.step(rule(observations).astype(np.float32))
        observations = interval.observations
        if step >= skipped:
            total -= interval.reward / steps
    return total.mean(), total.std(ddof=1) / math.sqrt(lanes)


@pytest.mark.statistical
@pytest.mark.parametrize("road", [GaussianRoad(bandwidth=0.2), ROAD])
def test_without_freedom_it_costs_what_theory_says_of_constant_damping(road) -> None:
    result = optimal_feedback(road, speed=1.2, bounds=(0.3, 0.3001), **{**QUICK, "precision": 0.005})
    theory = float(analysis.mean_squares(road, damping=0.3, speed=1.2).displacement) / road.variance
    assert abs(result.cost - theory) < 4 * result.standard_error + 2e-3 * theory
    assert result.standard_error <= 0.005 * result.cost
    assert result.history[0].expected == pytest.approx(theory, rel=3e-3)


@pytest.mark.statistical
def test_it_beats_the_best_constant_and_skyhook() -> None:
    def skyhook(observations: np.ndarray) -> np.ndarray:
        x, u = observations[:, 1], observations[:, 3]
        return np.where(x * (x - SPEED * u) > 0, BOUNDS[1], BOUNDS[0])

    constant = float(analysis.optimal_damping(ROAD, speed=SPEED, bounds=BOUNDS).cost)
    cost, error = drive(lambda observations: found().predict(observations)[0][:, 0])
    assert abs(cost - found().cost) < 4 * math.hypot(error, found().standard_error)
    assert cost + 4 * error < 0.5 * constant
    assert cost < 0.95 * drive(skyhook)[0]  # over the same noise


def test_history_tells_what_refinement_brings() -> None:
    history = found().history
    assert [(grid.rings, grid.rays, grid.rows) for grid in history] == list(feedback.GRIDS[: len(history)])
    assert history[-1].cost < 1.002 * history[0].cost
    assert history[1].sweeps < 0.8 * history[0].sweeps  # a finer table begins with the coarser one
    assert history[-1].expected == pytest.approx(history[-1].cost, rel=0.05)
    assert found().policy.shape[:3] in feedback.GRIDS


def test_mirrored_states_have_the_same_damping_within_the_bounds() -> None:
    states = np.random.default_rng(1).normal(size=(4000, 4)) * [0.6, 0.7, 0.9, 0.9]
    damping = found().damping(states)
    assert damping.dtype == np.float32
    assert damping.min() == np.float32(BOUNDS[0])
    assert damping.max() == np.float32(BOUNDS[1])
    close = np.isclose(damping, found().damping(-states), atol=1e-3)
    assert np.mean(close) > 0.999  # where D jumps, rounding decides
    assert np.any((damping > 0.2) & (damping < 0.9))  # not a mere switch
    far = found().damping(1e6 * states)
    assert np.all((far >= np.float32(BOUNDS[0])) & (far <= np.float32(BOUNDS[1])))


def test_predict_finds_its_signals() -> None:
    task = make_task(road=ROAD, speed=SPEED, observation=["slope", "travel", "velocity", "displacement", "level"])
    states = np.random.default_rng(2).normal(size=(70, 4)).astype(np.float32)
    y, x, z, u = states.T
    observations = np.stack([u, y - z, x, y, z, 0 * y, 0 * y], axis=1)
    moved = found().with_signals(task.signals)
    damping, state = moved.predict(observations, "state")
    assert state == "state"
    assert damping.shape == (70, 1)
    np.testing.assert_array_equal(damping[:, 0], found().damping(states))
    np.testing.assert_array_equal(moved.predict(observations[3])[0], damping[3])
    with pytest.raises(ParameterError, match="slope"):
        found().with_signals(["displacement", "velocity", "level"])
    with pytest.raises(ParameterError, match=r"7 signals.*\(70, 4\)"):
        moved.predict(states)
    with pytest.raises(ParameterError, match="finite"):
        moved.predict(observations * np.float32(np.nan))
    with pytest.raises(ParameterError, match="states"):
        moved.damping(observations)


@pytest.mark.parametrize(
    ("road", "comfort"),
    [
        (GaussianRoad(bandwidth=0.2), "acceleration"),
        (MultiplicativeRoad.from_shape(shape=0.7, bandwidth=0.2), "acceleration"),
        (FirstOrderRoad(), "velocity"),
    ],
)
def test_the_quadratic_part_is_exact(road, comfort) -> None:
    """At the best constant damping, here a bound and so a node of D, cost and drift of h0 add up to a constant: its cost."""
    weights = {"displacement": 1.0, comfort: 0.5 if comfort == "acceleration" else 0.01, "travel": 0.1}
    best = analysis.optimal_damping(road, speed=1.0, weights=weights, bounds=(0.6, 1.0))
    assert best.damping == 1.0
    forms = feedback.Model(make_task(road=road, speed=1.0, reward=weights, damping_range=(0.6, 1.0))).forms
    np.testing.assert_allclose(forms[-1, :10], 0, atol=1e-9)
    assert forms[-1, 10] == pytest.approx(float(best.cost), rel=1e-9)


def test_the_road_step_has_the_exact_mean_and_covariance() -> None:
    road = GaussianRoad(bandwidth=0.2)
    model = feedback.Model(make_task(road=road, speed=1.0))
    nodes, offset, _, _ = model.road_step(5, 16)
    step = model._turn
    inner = np.linalg.norm(nodes, axis=1) < 2  # beyond, points are moved back to the grid's end
    covariance = np.einsum("j,njk,njl->nkl", feedback.PLANE.chance, offset, offset)[inner]
    np.testing.assert_allclose(feedback.PLANE.chance @ offset[inner], 0, atol=1e-12)
    np.testing.assert_allclose(covariance, np.broadcast_to(np.eye(2) - step @ step.T, covariance.shape), atol=1e-12)


def test_on_a_first_order_road_the_rule_has_the_noise_of_road_and_car_at_each_damping() -> None:
    task = make_task(road="first_order", speed=2.0)
    model = feedback.Model(task)
    nodes, offset, _, _ = model.road_step(8, 2)
    offset = offset[np.abs(nodes[:, 0]).argmin()]
    np.testing.assert_allclose(model.grid.chance @ offset, 0, atol=1e-4)
    for damping in (0.05, 1.0):
        noise = offset @ model.part(damping).gain.T  # of the car less what follows the level
        noise += np.outer(offset[:, 0], model.follows)
        both = np.column_stack([noise, offset[:, :1]])
        exact = plant_system(task, damping, 2.0).step_covariance(task.control_interval)
        np.testing.assert_allclose(both.T @ (model.grid.chance[:, None] * both), exact, atol=1e-4)


@pytest.mark.statistical
def test_on_a_first_order_road_it_beats_the_best_lookahead_and_knows_its_cost() -> None:
    result = optimal_feedback("first_order", speed=2.0, bounds=(0.2, 1.0), **QUICK)
    assert result.state == ("displacement", "velocity", "level")
    assert result.cost + 4 * result.standard_error < 0.75 * 0.2666  # of the mixed lookahead
    assert result.history[-1].expected == pytest.approx(result.cost, rel=0.05)
    level = np.random.default_rng(1).normal(size=500)
    states = np.stack([0.4 * level, -0.3 * level, level], axis=1)
    np.testing.assert_allclose(result.damping(states), result.damping(-states), atol=1e-3)


def test_minima_of_polynomials() -> None:
    coefficients = np.random.default_rng(3).normal(size=(4, 500)).astype(np.float32)
    place, least = np.empty(500, np.float32), np.empty(500, np.float32)
    feedback.minimise(coefficients, 500, place, least)
    powers = np.linspace(-1, 1, 4001)[:, None] ** np.arange(1, 5)
    values = powers @ coefficients
    np.testing.assert_allclose(least, values.min(axis=0) - values[0], atol=3e-3)
    at_place = np.sum(place ** np.arange(1, 5)[:, None] * coefficients, axis=0)
    np.testing.assert_allclose(at_place - values[0], least, atol=1e-5)


def test_units_do_not_matter() -> None:
    road = GaussianRoad(bandwidth=0.3, noise_intensity=0.5, wavenumber=0.5)
    one = optimal_feedback(road, speed=2.0, bounds=BOUNDS, **QUICK)
    other = optimal_feedback(
        GaussianRoad(wavenumber=0.25), speed=24.0, bandwidth=0.3, natural_frequency=6.0, bounds=BOUNDS, **QUICK
    )
    assert other.control_interval == pytest.approx(0.2 / 6)
    assert other.cost == pytest.approx(one.cost, rel=1e-3)
    assert other.road.bandwidth == 0.3


def test_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "new"
    calls: list[tuple[int, int]] = []

    def find(**changes) -> OptimalFeedback:
        calls.clear()
        arguments = {"speed": 2.5, "bounds": (0.2, 1.0), **QUICK, "cache": folder, **changes}
        return optimal_feedback(ROAD, report=lambda done, total: calls.append((done, total)), **arguments)

    with monkeypatch.context() as patch:

        def fail(*arguments, **keywords) -> None:
            raise KeyboardInterrupt

        patch.setattr(np, "savez", fail)
        with pytest.raises(KeyboardInterrupt):
            find()
    assert list(folder.iterdir()) == []  # whole or not at all

    first = find()
    assert len(calls) > 2
    assert calls == sorted(calls)
    assert calls[-1] == (200, 200)
    (path,) = folder.iterdir()

    def same(other: OptimalFeedback) -> bool:
        equal = all(getattr(first, name) == getattr(other, name) for name in ("cost", "standard_error", "history", "weights"))
        return equal and np.array_equal(first.policy, other.policy) and np.array_equal(first.box, other.box)

    assert same(find())
    assert calls == [(200, 200)]  # read, not found anew
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    assert same(find(threads=2))  # whatever the number of threads
    assert len(calls) > 2
    assert path.stat().st_size == len(content)
    with path.open("wb") as file:
        np.savez(file, description="another")
    assert feedback.load(path, "another", {}) is None
    path.write_bytes(content[:200] + bytes([content[200] ^ 255]) + content[201:])
    assert feedback.load(path, "another", {}) is None
    path.write_bytes(b"")
    assert feedback.load(path, "another", {}) is None


def test_damaged_files_are_not_believed(tmp_path: Path) -> None:
    rings, rays, rows = feedback.GRIDS[0]
    refinement = {
        "rings": rings,
        "rays": rays,
        "rows": rows,
        "sweeps": 60,
        "expected": 0.5,
        "cost": 0.5,
        "standard_error": 0.01,
    }
    description, point = "a description", {name: getattr(found(), name) for name in POINT}
    figures = {"cost": 0.5, "standard_error": 0.01, "history": [refinement]}
    policy = np.random.default_rng(1).normal(size=(rings, rays, rows, rows, 4)).astype(np.float32)
    sound = {"figures": figures, "box": np.array([6.0, 7.0]), "policy": policy}
    path = tmp_path / "feedback.npz"

    def load(**changes) -> OptimalFeedback | None:
        content = {**sound, **changes}
        np.savez(path, **content | {"description": description, "figures": json.dumps(content["figures"])})
        return feedback.load(path, description, point)

    def grid(**changes) -> dict:
        return {"figures": figures | {"history": [refinement | changes]}}

    assert load() is not None
    broken = policy.copy()
    broken[0, 0, 0, 0, 0] = math.nan
    for changes in (
        {"figures": figures | {"cost": math.nan}},
        {"figures": figures | {"cost": -0.5}},
        {"figures": figures | {"cost": "0.5"}},
        {"figures": figures | {"cost": True}},
        {"figures": figures | {"standard_error": 0.0}},
        {"figures": figures | {"history": []}},
        {"figures": figures | {"history": [refinement, refinement]}},
        {"figures": figures | {"more": 1}},
        {"figures": [1]},
        grid(expected=math.inf),
        grid(sweeps=-1),
        {**grid(rows=4), "policy": policy[:, :, :4, :4]},
        {"policy": policy[..., :3]},
        {"policy": policy.astype(float)},
        {"policy": broken},
        {"box": np.array([6.0, math.nan])},
        {"box": np.array([6.0, -7.0])},
        {"box": np.array([6.0])},
        {"box": np.array(["6", "7"])},
    ):
        assert load(**changes) is None, changes
    assert load() is not None
    content = path.read_bytes()
    for place in range(0, len(content), 4999):  # wherever it is damaged
        path.write_bytes(content[:place] + bytes([content[place] ^ 16]) + content[place + 1 :])
        kept = feedback.load(path, description, point)
        assert kept is None or np.array_equal(kept.policy, policy), place
    at = content.index(policy.tobytes()[:100])
    path.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
    assert feedback.load(path, description, point) is None


def test_result_that_cannot_be_kept_is_returned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("in the way of a folder")
    monkeypatch.setattr("roadgym.cache._warned", False)
    with pytest.warns(RuntimeWarning, match="cache cannot be written"):
        feedback.save(tmp_path / "file" / "feedback.npz", "a description", found())
    feedback.save(tmp_path / "file" / "feedback.npz", "a description", found())  # it was told


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"road": "two_corner"}, "road must be of first order, gaussian"),
        ({"road": MultiplicativeRoad(slope_bound=0.5)}, "on a circle"),
        ({"road": "cobbles"}, "cobbles"),
        ({"speed": 0.0}, "speed must be positive, got 0"),
        ({"speed": (1.0, 2.0)}, "speed must be a number"),
        ({"bandwidth": -1.0}, "bandwidth must be positive, got -1"),
        ({"natural_frequency": 0.0}, "natural_frequency"),
        ({"weights": {"comfort": 1.0}}, "comfort"),
        ({"weights": {}}, "weight"),
        ({"bounds": (0.5, 0.5)}, "bounds must be a pair"),
        ({"bounds": (0.0, 0.5)}, "bounds, low end"),
        ({"control_interval": -0.2}, "control_interval"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"precision": 0.0}, "precision"),
        ({"refinements": 0}, "refinements must be at least 1"),
        ({"refinements": 9}, "refinements must be at most 4"),
        ({"seed": -1}, "seed"),
        ({"threads": 0}, "threads"),
    ],
)
def test_errors_name_the_parameter(changes: dict, message: str) -> None:
    arguments = {"road": ROAD, "speed": 1.0, **changes}
    with pytest.raises(ParameterError, match=message):
        optimal_feedback(arguments.pop("road"), **arguments)
