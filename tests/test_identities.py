"""What holds whatever sets the damping: known by theory, driven under rules of every kind, and false on a wrong plant."""

import dataclasses
import math

import numpy as np
import pytest

import agents
from agents.cli import main
from analysis.certification import certify
from analysis.identities import identities, rows_of, watched
from roadgym import FirstOrderRoad, TwoMassCar
from roadgym.cars import make_car
from roadgym.linear import LinearSystem
from roadgym.plant import Plant
from roadgym.roads import make_road
from roadgym.task import make_task

CAR, SPEED = TwoMassCar(), 20.0
ROADS = ("iso_c", "first_order", "gaussian", "multiplicative", "harmonic")


def level_rows(road_filter, car, ratio):
    """Rows of the states of the car, the level and its rate over the state of car and road."""
    cars = len(car.states)
    rows = np.zeros((cars + 2, cars + len(road_filter.states)))
    rows[:cars, :cars] = np.eye(cars)
    rows[cars, cars:], rows[cars + 1, cars:] = road_filter.level, ratio * road_filter.level @ road_filter.drift
    return rows


@pytest.mark.parametrize("road", ROADS)
@pytest.mark.parametrize(
    "car", ["one_mass", "two_mass", "renault_megane", {"kind": "two_mass", "tyre_damping": 300.0}], ids=str
)
def test_they_hold_at_every_constant_damping(road, car):
    """By Lyapunov's equation, which knows nothing of them."""
    road, car = make_road(road), make_car(car)
    ratio = 1.3 if road.wavenumber == 1 else SPEED * road.wavenumber / car.natural_frequency
    found = identities(road.shaping_filter(), car.motion, ratio)
    assert found
    for damping in (0.05, 0.3, 2.0):
        system = LinearSystem.of(road.shaping_filter(), car.motion, damping=damping, ratio=ratio)
        covariance = system.covariance()
        relative = system.signals[car.motion.relative]
        for each in found:
            rows = each.rows[:, :-1] @ level_rows(road.shaping_filter(), car.motion, ratio)
            squares = np.einsum("ki,ij,kj->k", rows, covariance, rows)
            left, terms = each.left(squares, 2 * damping * relative @ covariance @ relative, ratio)
            assert abs(left) < 1e-8 * terms, each.name


def test_where_the_road_is_rough_they_hold_at_every_speed():
    road, car = make_road("first_order").shaping_filter(), TwoMassCar(tyre_damping=200.0).motion
    for each, other in zip(identities(road, car, 0.7), identities(road, car, 1.4), strict=True):
        for ratio in (0.7, 1.4):
            system = LinearSystem.of(road, car, damping=0.4, ratio=ratio)
            covariance, relative = system.covariance(), system.signals["relative_velocity"]
            power = 0.8 * relative @ covariance @ relative
            for identity in (each, other):
                rows = identity.rows[:, :-1] @ level_rows(road, car, ratio)
                left, terms = identity.left(np.einsum("ki,ij,kj->k", rows, covariance, rows), power, ratio)
                assert abs(left) < 1e-8 * terms


def test_on_white_velocity_they_are_the_known_ones():
    """E t v_u = -S/2, and the power of the damper k_t S/2, 81 W (shown in units of the variance and of times in 1/w1)."""
    road = FirstOrderRoad.from_iso8608("C", lowest_frequency=1e-4)
    w1, ratio = CAR.natural_frequency, SPEED * road.wavenumber / CAR.natural_frequency
    found = {each.name: each for each in identities(road.shaping_filter(), CAR.motion, ratio)}
    strength = 2 * math.pi**2 * 0.1**2 * 256e-6 * SPEED
    # the change of t^2 is 2 t v_u, and S is in m^2/s
    deflection = found["tyre_deflection^2"]
    assert road.variance * w1 * ratio * deflection.mean == pytest.approx(-strength, rel=1e-9)
    power = found["power"]
    assert -road.variance * w1 * ratio * CAR.spring_rate * power.mean == pytest.approx(CAR.tyre_rate * strength / 2, rel=1e-3)
    assert CAR.tyre_rate * strength / 2 == pytest.approx(80.85, abs=0.01)
    assert {"momentum^2", "momentum × tyre_deflection", "momentum × travel", "travel^2"} <= set(found)


@pytest.mark.statistical
@pytest.mark.parametrize("road", ["iso_c", "gaussian"])
@pytest.mark.parametrize("rule", ["random", "soft where it rises", "by the sum of all"])
def test_they_hold_under_rules_that_nobody_would_choose(road, rule):
    road = make_road(road)
    speed = SPEED if road.wavenumber != 1 else 1.3 * CAR.natural_frequency
    ratio = speed * road.wavenumber / CAR.natural_frequency
    found = identities(road.shaping_filter(), CAR.motion, ratio)
    car, lanes = watched(CAR, rows_of(found)), 2048
    task = make_task(car=car, road=road, speed=speed, damping_range=(0.05, 1.0), control_interval=0.02)
    plant, random = Plant(task, lanes), np.random.default_rng(5)
    plant.start(np.arange(lanes, dtype=np.uint64))
    total, power, steps = np.zeros((len(car.mean_squares), lanes)), np.zeros(lanes), 600
    relative = car.mean_squares.index("relative_velocity")
    for step in range(-300, steps):
        damping = {
            "random": random.uniform(0.05, 1.0, lanes),
            "soft where it rises": np.where(plant.row("velocity") > 0, 0.05, 0.8),
            "by the sum of all": 0.5 + 0.5 * np.tanh(plant.car_states.sum(axis=0)),
        }[rule]
        driven = plant.step(damping.astype(np.float32))
        if step >= 0:
            total += driven.mean_squares
            power += 2 * driven.damping * driven.mean_squares[relative]
    squares = dict(zip(car.mean_squares, total / steps, strict=True))
    for n, each in enumerate(found):
        own = np.array([squares[f"{n}.{k}"] for k in range(len(each.rows))]).reshape(-1, lanes)
        left, terms = each.left(own, power / steps, ratio)
        assert abs(left.mean()) < 4.5 * left.std(ddof=1) / math.sqrt(lanes) + 2e-4 * terms.mean(), each.name


@dataclasses.dataclass(frozen=True, kw_only=True)
class LostInTheTyre(TwoMassCar):
    """A scheme that forgets a little of the road: what is told is a car on a tyre that is 1 % softer than it says."""

    kind: str = dataclasses.field(default="lost", init=False)

    def table(self, substep, damping):
        return TwoMassCar(tyre_rate=0.99 * self.tyre_rate).table(substep, damping)


@pytest.mark.statistical
def test_a_wrong_plant_is_told_by_them():
    road = FirstOrderRoad.from_iso8608("C", lowest_frequency=0.1)
    sound = certify(road, car="two_mass", speed=SPEED, lanes=1024)
    assert sound.passed
    assert sum(line.name.startswith("balance of") for line in sound.lines) == 12
    power = [line for line in sound.lines if line.name.startswith("power of the damper (W)")]
    # white velocity gives 80.85 W, whose longest waves this road lacks
    assert [70 < line.expected < 80.85 for line in power] == [True, True]
    wrong = certify(road, car=LostInTheTyre(), speed=SPEED, lanes=4096)
    assert any(
        name.startswith(("balance of momentum", "power")) for name in (line.name for line in wrong.lines if not line.passed)
    )


def test_a_plant_is_certified_under_a_learned_rule(tmp_path, capsys):
    small = {"n_envs": 4, "n_timesteps": 64, "n_steps": 16, "batch_size": 32, "n_epochs": 1}
    road = {"kind": "first_order", "iso_class": "C", "lowest_frequency": 0.1}
    environment = {"car": "two_mass", "road": road, "speed": [15.0, 25.0], "control_interval": 0.02}
    agents.train(tmp_path / "agent", hyperparameters=small, environment=environment)
    assert main(["certify", "--agent", str(tmp_path / "agent"), "--speed", "20", "--lanes", "1024"]) == 0
    table = capsys.readouterr().out
    assert "power of the damper (W), the" in table
    assert "acceleration, the controller" in table
    assert main(["certify", "--agent", str(tmp_path / "agent"), "--speed", "30"]) == 2
    assert "speed must lie within the agent's range [15, 25], got 30" in capsys.readouterr().err
    assert main(["certify", "--agent", str(tmp_path / "agent"), "--road", "gaussian"]) == 2
    assert "--road cannot be given with --agent" in capsys.readouterr().err


def test_watching_changes_nothing_of_the_drive():
    more = {"sum": np.array([1.0, 1.0, 0.0, 0.0, -2.0, 0.0, 0.0])}
    parameters = {"road": "iso_c", "speed": SPEED, "precision": "float64"}
    plants = [Plant(make_task(car=car, **parameters), 8) for car in (CAR, watched(CAR, more))]
    for plant in plants:
        plant.start(np.arange(8, dtype=np.uint64))
    for damping in (0.1, 0.9, 0.4):
        plain, seen = (plant.step(np.full(8, damping, np.float32)) for plant in plants)
        np.testing.assert_array_equal(seen.mean_squares[:-1], plain.mean_squares)
