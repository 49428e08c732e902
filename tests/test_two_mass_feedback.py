"""The best feedback of a car of two masses, on a coarse table."""

import json
import math
import pickle
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import analysis
from agents.controllers import make_controller
from analysis.feedback import kept_files
from analysis.feedback.white.model import COORDINATES, Model, coordinates, white_task
from analysis.feedback.white.search import GRIDS, WhiteRoad
from analysis.feedback.white.table import CHANCE, interpolate
from roadgym import FirstOrderRoad, ParameterError, TwoMassCar
from roadgym.plant import Plant
from roadgym.task import make_task

CAR = TwoMassCar(sprung_mass=400.0, unsprung_mass=50.0, spring_rate=30e3, tyre_rate=250e3, damping_coefficients=(900.0, 3900.0))
PROBLEM = {"car": CAR, "weights": {"acceleration": 1.0}, "control_interval": 0.01, "precision": 0.02, "refinements": 1}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("feedback")


@pytest.fixture(scope="module", autouse=True)
def few_cars() -> Iterator[None]:
    """What it drives is enough here to choose, and takes seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("analysis.feedback.white.search.CARS", 512)
        yield


@pytest.fixture(scope="module")
def found(folder: Path) -> analysis.WhiteRoadFeedback:
    result = analysis.optimal_feedback("iso_c", speed=20.0, cache=folder, **PROBLEM)
    assert isinstance(result, analysis.WhiteRoadFeedback)
    return result


def states_of(number: int) -> np.ndarray:
    """States of car and level of an ISO road, about as they are met."""
    scale = [1.2, 1.1, 0.6, 1.6, 1.0]
    return np.random.default_rng(3).standard_normal((number, 5)) * scale


def test_a_table_expects_what_its_feedback_costs(found: analysis.WhiteRoadFeedback) -> None:
    (refinement,) = found.history
    assert refinement.nodes == GRIDS[0]
    assert refinement.expected == pytest.approx(refinement.cost, rel=0.05)  # a coarse table
    assert found.cost == pytest.approx(refinement.cost * found.cost / found.table.cost, rel=0.05)


def test_one_table_serves_every_class_and_speed(found: analysis.WhiteRoadFeedback, folder: Path, monkeypatch) -> None:
    def unwanted(*arguments: object) -> None:
        raise AssertionError("solved again")

    monkeypatch.setattr(WhiteRoad, "find", unwanted)
    other = analysis.optimal_feedback("iso_b", speed=10.0, cache=folder, **PROBLEM)
    assert np.array_equal(other.table.policy, found.table.policy)
    assert other.cost == pytest.approx(found.cost / 8, rel=1e-9)  # a quarter of the roughness, half the speed
    # on roads of slow corners D depends on lengths over sqrt(S) alone
    slow = [
        analysis.optimal_feedback(FirstOrderRoad.from_iso8608(name, lowest_frequency=1e-4), speed=v, cache=folder, **PROBLEM)
        for name, v in (("C", 20.0), ("A", 5.0))
    ]
    heights = states_of(200) * [0.1, 0.1, 0.06, 0.16, 0.0]  # from a level of zero
    dampings = []
    for feedback in slow:
        nu = feedback.speed * feedback.road.wavenumber / CAR.natural_frequency
        dampings.append(feedback.damping(heights * math.sqrt(2 * nu / 0.01)))
    assert np.mean(np.abs(dampings[0] - dampings[1]) > 1e-2) < 0.02


def test_mirrored_states_have_the_same_damping(found: analysis.WhiteRoadFeedback) -> None:
    states = states_of(300)
    np.testing.assert_allclose(found.damping(states), found.damping(-states), rtol=1e-4)
    low, high = found.bounds
    assert np.all((found.damping(5 * states) >= np.float32(low)) & (found.damping(5 * states) <= np.float32(high)))
    observed = np.concatenate([states, np.full((300, 1), 0.1)], axis=1).astype(np.float32)
    assert found.predict(observed)[0].shape == (300, 1)
    copied = pickle.loads(pickle.dumps(found))
    assert np.array_equal(copied.damping(states), found.damping(states))


@pytest.mark.statistical
def test_it_costs_less_than_every_lookahead(found: analysis.WhiteRoadFeedback) -> None:
    """By more than four standard errors of the difference over the same roads."""
    environment = {"road": "iso_c", "speed": 20.0, "car": CAR, "control_interval": 0.01, "reward": PROBLEM["weights"]}
    task = make_task(**environment)
    assert task.signals == found.signals
    lanes, costs = 1024, {}
    drivers = {name: make_controller(name, task) for name in ("one_step_lookahead", "mixed_lookahead")}
    for name, driver in {**drivers, "found": found}.items():
        plant = Plant(task, lanes)
        seen = plant.start(np.arange(lanes, dtype=np.uint64)).observations
        total = np.zeros(lanes)
        for step in range(1000):
            driven = plant.step(driver.predict(seen)[0][:, 0])
            seen = driven.observations
            if step >= 300:
                total -= driven.reward / 700
        costs[name] = total
    for name in drivers:
        difference = costs[name] - costs["found"]
        assert difference.mean() > 4 * difference.std() / math.sqrt(lanes)


def test_without_a_choice_it_costs_what_theory_says() -> None:
    """E z_s''^2 = S (c^2 k_t + k_s^2 M)/(2 c m_s^2) on a road of white velocity, of a constant damping."""
    c = 1500.0
    bounds = tuple(float(CAR.damping_ratio(value)) for value in (c, 1.0001 * c))
    result = analysis.optimal_feedback("iso_c", speed=20.0, bounds=bounds, **{**PROBLEM, "precision": 0.01})
    strength = result.road.noise_intensity**2 * result.speed
    squares = c**2 * CAR.tyre_rate + CAR.spring_rate**2 * (CAR.sprung_mass + CAR.unsprung_mass)
    assert result.cost == pytest.approx(strength * squares / (2 * c * CAR.sprung_mass**2), rel=2e-3)
    assert result.table.constant == pytest.approx(bounds[0], rel=1e-3)


def test_the_chain_has_the_moments_of_the_plant() -> None:
    """What an interval makes of the coordinates on average, and what it adds to the first two, against the plant itself."""
    task = white_task(make_task(road="iso_c", speed=20.0, car=CAR, control_interval=0.01))
    model = Model(task)
    lanes = 200_000
    plant = Plant(task, lanes)
    plant.start(np.arange(lanes, dtype=np.uint64))
    start = [0.02, 0.03, 0.05, -0.1, 0.01]
    for name, value in zip((*CAR.motion.states, "level"), start, strict=True):
        plant.set_row(name, value)
    plant.step(np.full(lanes, task.damping_range[1], np.float32))
    rows = coordinates(CAR.motion, 0.01) / math.sqrt(0.02)
    after = rows @ np.concatenate([plant.car_states, plant.road_states])
    error = after.std(axis=1) / math.sqrt(lanes)
    # a corner of 0.01 is left out
    assert np.all(np.abs(after.mean(axis=1) - model.maps[2] @ (rows @ start)) < 5 * error + 2e-4)
    added = model.shifts[2].T @ (CHANCE[:, None] * model.shifts[2])
    np.testing.assert_allclose(np.cov(after[:2]), added, rtol=0.02)
    assert len(COORDINATES) == 4


def test_interpolation_is_exact_for_cubics() -> None:
    shape, generator = np.array([5, 6, 5, 7]), np.random.default_rng(6)
    powers = generator.integers(0, 4, (6, 4))

    def values(*places: np.ndarray) -> np.ndarray:
        return sum(np.prod([(place / 3) ** power for place, power in zip(places, row, strict=True)], axis=0) for row in powers)

    table = values(*np.meshgrid(*map(np.arange, shape), indexing="ij")).astype(np.float32).ravel()
    for place in generator.uniform(0, shape - 1.0, (50, 4)):
        assert interpolate(table, place, shape) == pytest.approx(values(*place), rel=1e-4, abs=1e-4)


def test_damaged_files_are_found_anew(found: analysis.WhiteRoadFeedback, folder: Path) -> None:
    (path,) = kept_files(folder)
    with np.load(path, allow_pickle=False) as file:
        content = {name: file[name] for name in file.files}
    figures = json.loads(str(content["figures"]))
    road = WhiteRoad(found.task)
    text = str(content["description"])
    assert road.load(path, text) is not None
    assert road.load(path, "another") is None
    damaged = [
        {"box": content["box"] * np.nan},
        {"policy": content["policy"][:1]},
        {"policy": content["policy"] * np.float32(np.nan)},
        {"figures": json.dumps(figures | {"cost": -1.0})},
        {"figures": json.dumps(figures | {"history": []})},
    ]
    copy = folder / "copy.npz"
    for change in damaged:
        np.savez(copy, **content | change)
        assert road.load(copy, text) is None, change
    np.savez(copy, **content)
    assert road.load(copy, text) is not None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"road": "gaussian"}, "road must be of first order for a two_mass car"),
        (
            {"weights": {"displacement": 1.0}},
            "weights must be on what a road of white velocity leaves finite, got one on displ",
        ),
        ({"weights": {"velocity": 1.0}}, "got one on velocity"),
        ({"refinements": 4}, "refinements must be at most 3, got 4"),
        ({"bounds": (0.5, 0.2)}, "bounds must be a pair"),
    ],
)
def test_what_is_not_there_is_refused(change: dict, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        analysis.optimal_feedback(**{"road": "iso_c", "speed": 20.0, **PROBLEM, **change})
