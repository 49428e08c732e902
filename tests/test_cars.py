"""Cars as components: what a car of one's own needs, and that every registered one is what its matrices say."""

import dataclasses
import math

import gymnasium
import numpy as np
import pytest
from scipy.linalg import expm

import agents
import analysis
import roadgym
from agents.evaluation import evaluate
from analysis.quadratic import plant_system
from roadgym import CARS, FirstOrderRoad, GaussianRoad, LinearCar, ParameterError, QuarterCar, TwoMassCar
from roadgym.cars import make_car
from roadgym.cars.one_mass import MOTION
from roadgym.linear import LinearSystem, Motion, Signal
from roadgym.plant import Plant
from roadgym.roads import make_road
from roadgym.task import make_task

ROAD = GaussianRoad(bandwidth=0.3, noise_intensity=1.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CarWithADriver(QuarterCar):
    """The car of one mass with one mean square more: half the travel on top of the height, as at the end of a lever."""

    kind: str = dataclasses.field(default="with_a_driver", init=False)

    @property
    def motion(self) -> Motion:
        lever = Signal({"displacement": 1.5, "level": -0.5}, "d")
        return dataclasses.replace(MOTION, signals={**MOTION.signals, "lever": lever})


@dataclasses.dataclass(frozen=True, kw_only=True)
class SquaredForIt(QuarterCar):
    """The car of one mass whose squares the kernel works out from its matrices; those that it works out itself go to waste."""

    kind: str = dataclasses.field(default="squared_for_it", init=False)
    squared = 0
    working_rows = QuarterCar.squared + QuarterCar.working_rows


@dataclasses.dataclass(frozen=True, kw_only=True)
class MatrixCar(LinearCar):
    """The car of one mass from its matrices alone."""

    kind: str = dataclasses.field(default="matrix", init=False)
    natural_frequency: float = 1.0

    @property
    def motion(self) -> Motion:
        return MOTION


def driven(car, lanes=64, steps=60, **parameters):
    """Mean squares of each lane and the states of the car at the end, where D switches between five levels."""
    plant = Plant(make_task(car=car, **{"road": ROAD, "speed": 1.3, "precision": "float64"} | parameters), lanes)
    plant.start(np.arange(lanes, dtype=np.uint64))
    total = np.zeros((len(car.mean_squares), lanes))
    levels = np.array([0.05, 0.3, 1.0, 0.1, 0.6], np.float32)
    for step in range(steps):
        total += plant.step(np.roll(np.resize(levels, lanes), step)).mean_squares
    return total / steps, plant.car_states


@pytest.mark.parametrize(
    "parameters",
    [
        {},
        {"road": "multiplicative", "speed_noise": "low_pass"},
        {"road": "harmonic", "speed_noise": "white"},
        {"road": "first_order"},
        {"damping_range": (0.05, 3.0), "substeps": 2, "control_interval": 0.5},
    ],
)
@pytest.mark.parametrize("other", [SquaredForIt(), MatrixCar()])
def test_the_compiled_car_is_that_of_its_matrices(other, parameters):
    """Closed form against matrix exponential, and own squares against those from the rows of its signals."""
    squares, states = driven(QuarterCar(), **parameters)
    other_squares, other_states = driven(other, **parameters)
    # 1e-10 is what the series in D of the matrix car leave out, and the series in D^2 - 1 of the closed form
    np.testing.assert_allclose(other_states, states, atol=1e-8)
    np.testing.assert_allclose(other_squares, squares, rtol=1e-7)


def test_a_mean_square_of_ones_own_is_observed_known_to_theory_and_weighed():
    car = CarWithADriver()
    plant = Plant(make_task(car=car, road=ROAD, observation=("lever", "displacement", "level"), precision="float64"), 3)
    plant.start(np.arange(3, dtype=np.uint64))
    for _ in range(5):
        seen = plant.step(np.full(3, 0.3, np.float32)).observations
    np.testing.assert_allclose(seen[:, 0], 1.5 * seen[:, 1] - 0.5 * seen[:, 2], rtol=1e-6)

    theory = analysis.mean_squares(ROAD, damping=0.3, speed=1.2, car=car)
    assert tuple(theory) == (*roadgym.MEAN_SQUARES, "lever")
    plain = analysis.mean_squares(ROAD, damping=0.3, speed=1.2)
    for name in plain:
        assert theory[name] == pytest.approx(plain[name], rel=1e-10)
    environment = {"road": ROAD, "speed": 1.2, "car": car, "reward": {"lever": 2.0}, "damping_range": (0.3, 0.31)}
    found = evaluate(
        {"constant": agents.make_controller("d_min", make_task(**environment))},
        environment=environment,
        speeds=[1.2],
        bandwidths=[0.3],
    )
    cost = 2 * float(theory.lever) / ROAD.variance
    assert abs(found["constant"].mean[0] - cost) < 4 * found["constant"].standard_error[0] + 1e-4 * cost


def test_a_preset_is_a_kind_whose_parameters_may_be_others():
    stiffer = make_car({"kind": "savaresi", "tyre_rate": 3e5})
    assert stiffer == dataclasses.replace(make_car("savaresi"), tyre_rate=3e5)
    assert make_road({"kind": "iso_c", "lowest_frequency": 0.02}) == FirstOrderRoad.from_iso8608("C", lowest_frequency=0.02)
    assert make_road({"kind": "iso_c"}) == make_road("iso_c")
    with pytest.raises(ParameterError, match="unknown parameter 'colour' of car 'two_mass'"):
        make_car({"kind": "savaresi", "colour": 3})


@pytest.fixture
def registered():
    roadgym.register("car", "with_a_driver", CarWithADriver)
    yield
    del CARS["with_a_driver"]


def test_an_agent_trains_on_a_mean_square_of_ones_own(registered, tmp_path):
    environment = {
        "car": "with_a_driver",
        "road": "gaussian",
        "speed": [1.0, 1.5],
        "reward": {"lever": 1.0, "displacement": 0.5},
    }
    small = {"n_envs": 4, "n_timesteps": 64, "n_steps": 16, "batch_size": 32, "n_epochs": 1}
    agents.train(tmp_path / "agent", hyperparameters=small, environment=environment)
    agent = agents.load(tmp_path / "agent")
    assert agent.task.car == CarWithADriver()
    env = gymnasium.make(roadgym.ENVIRONMENT_ID, **environment)
    observation, _ = env.reset(seed=1)
    _, reward, *_, info = env.step(agent.predict(observation)[0])
    cost = (info["lever"] + 0.5 * info["displacement"]) / env.unwrapped.task.road.variance
    assert reward == pytest.approx(-cost, rel=1e-6)


def test_errors_of_cars_tell_what_is_wrong():
    for parameters, message in (
        ({"car": "three_mass"}, "unknown car 'three_mass'; known: one_mass, two_mass"),
        ({"car": {"kind": "one_mass", "mass": 3}}, "unknown parameter 'mass' of car 'one_mass'; known: natural_frequency"),
        ({"car": "one_mass", "natural_frequency": 2.0}, "natural_frequency must not be given beside car: it is a parameter"),
        ({"car": "two_mass", "natural_frequency": 2.0}, "beside car: .* or follows from its parameters"),
        ({"car": TwoMassCar(), "reward": {"sound": 1.0}}, "unknown reward term 'sound'; known: displacement, .*wheel_load"),
        ({"car": {"kind": "two_mass", "tyre_rate": -1.0}}, "tyre_rate must be positive, got -1"),
    ):
        with pytest.raises(ParameterError, match=message):
            gymnasium.make(roadgym.ENVIRONMENT_ID, **parameters)
    assert make_task(car="one_mass") == make_task()
    assert make_task(car={"kind": "one_mass", "natural_frequency": 2.0}) == make_task(natural_frequency=2.0)

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Unknown(MatrixCar):
        @property
        def motion(self) -> Motion:
            return dataclasses.replace(MOTION, signals={**MOTION.signals, "nonsense": Signal({"temperature": 1.0}, "T")})

    with pytest.raises(ParameterError, match="signal 'nonsense' has the unknown term 'temperature'; known: displacement, velo"):
        make_task(car=Unknown())

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class HungFromTheSky(MatrixCar):
        @property
        def motion(self) -> Motion:
            return dataclasses.replace(MOTION, level_entry=np.zeros(2))

    with pytest.raises(ParameterError, match="must rise with the road"):
        Plant(make_task(car=HungFromTheSky()), 1)


def own_motion(**changes):
    """A car of one's own with other equations than those of one mass."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Own(MatrixCar):
        @property
        def motion(self) -> Motion:
            return dataclasses.replace(MOTION, **changes)

    return Own()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"drift": np.zeros((3, 3))}, r"drift of a car's motion must have the shape \(2, 2\), got \(3, 3\)"),
        ({"drift": np.array([[0.0, 1.0], [np.nan, 0.0]])}, "drift of a car's motion must be finite, got nan"),
        ({"drift": np.array([[0.0, 1.0], [-1.0, 3.0]])}, "drift of the matrix car must be stable with a damper"),
        ({"force_entry": np.ones(1)}, r"force_entry of a car's motion must have the shape \(2,\), got \(1,\)"),
        ({"relative": "slip"}, "relative must be a signal that has no damper_force, got 'slip'"),
        ({"relative": "acceleration"}, "relative must be a signal that has no damper_force, got 'acceleration'"),
        (
            {"signals": {**MOTION.signals, "speed": Signal({"velocity": 1.0}, "v")}},
            "must not be named bandwidth, .*got 'speed'",
        ),
    ],
)
def test_equations_that_are_none_are_refused(changes, message):
    with pytest.raises(ParameterError, match=message):
        make_task(car=own_motion(**changes))


@pytest.mark.parametrize(("name", "value"), [("rows", 1), ("squared", 9), ("squared", 2.5)])
def test_rows_that_would_not_hold_the_car_are_refused(name, value):
    other = dataclasses.make_dataclass("Other", [], bases=(QuarterCar,), namespace={name: value}, frozen=True, kw_only=True)
    with pytest.raises(ParameterError, match=f"{name} of the one_mass car must be"):
        make_task(car=other())


def test_closed_forms_are_those_of_their_own_equations_alone():
    """A car that has the names of the car of one mass, and a damper to the sky, or an acceleration that is another."""
    skyhook = own_motion(signals={**MOTION.signals, "relative_velocity": Signal({"velocity": 1.0}, "v")})
    other = own_motion(signals={**MOTION.signals, "acceleration": Signal({"displacement": -2.0, "level": 2.0}, "a")})
    found = analysis.mean_squares(ROAD, damping=0.3, speed=1.0, car=other)
    assert found.acceleration == pytest.approx(4 * found.travel, rel=1e-9)
    system = LinearSystem.of(ROAD.shaping_filter(), skyhook.motion, damping=0.3, ratio=1.0)
    expected = {name: ROAD.variance * square for name, square in system.mean_squares().items()}
    assert dict(analysis.mean_squares(ROAD, damping=0.3, speed=1.0, car=skyhook)) == pytest.approx(expected)
    for car, message in (
        (skyhook, "car must be of one mass"),
        (TwoMassCar(), "road must be of first order for a two_mass car"),
    ):
        with pytest.raises(ParameterError, match=message):
            analysis.optimal_feedback(ROAD, speed=1.0, car=car)


def test_every_pair_of_masses_rises_with_the_road():
    """What rounding leaves of a sum of rates is no rate."""
    random = np.random.default_rng(3)
    for sprung, unsprung, spring, tyre in random.uniform((200, 20, 1e4, 1e5), (600, 60, 4e4, 3e5), (200, 4)).tolist():
        car = TwoMassCar(sprung_mass=sprung, unsprung_mass=unsprung, spring_rate=spring, tyre_rate=tyre)
        assert np.isfinite(car.table(0.02, (0.05, 1.0))).all()


# every car that is registered


def every_car():
    return [pytest.param(CARS[name](), id=name) for name in CARS]


@pytest.mark.parametrize("car", every_car())
def test_kernel_moves_the_state_as_the_matrices_do(car):
    """On the harmonic road, without noise: car and road are one linear system, whose exponential is known."""
    task = make_task(car=car, road="harmonic", speed=0.8 * car.natural_frequency, damping_range=(0.05, 1.0), substeps=400)
    plant = Plant(dataclasses.replace(task, precision="float64"), 2)
    plant.start(np.arange(2, dtype=np.uint64))
    start = np.concatenate([plant.car_states, [plant.row("level"), plant.row("slope")]])
    interval = plant.step(np.array([0.05, 0.7], np.float32))
    w1 = car.natural_frequency
    for lane, damping in enumerate((0.05, 0.7)):
        system = plant_system(task, float(np.float32(damping)), task.frequency_ratio(0.8 * w1))
        exact = expm(system.drift * task.control_interval * w1) @ start[:, lane]
        assert plant.car_states[:, lane] == pytest.approx(exact[: len(car.motion.states)], abs=1e-8)
        fine = np.array([expm(system.drift * task.control_interval * w1 * t) @ start[:, lane] for t in np.linspace(0, 1, 201)])
        weights = np.full(201, 1 / 200.0)
        weights[[0, -1]] /= 2
        for name, square in zip(car.mean_squares, interval.mean_squares[:, lane], strict=True):
            assert square == pytest.approx(float(weights @ (fine @ system.signals[name]) ** 2), rel=1e-3, abs=1e-9)


@pytest.mark.statistical
@pytest.mark.parametrize("car", every_car())
@pytest.mark.parametrize("damping", [0.05, 0.3, 1.0])
def test_constant_damping_costs_what_theory_says(car, damping):
    """At the substep that a task chooses by itself."""
    w1, lanes = car.natural_frequency, 2048
    task = make_task(car=car, road=GaussianRoad(bandwidth=0.6), speed=1.2 * w1, damping_range=(0.03, 1.0))
    plant = Plant(task, lanes)
    plant.start(np.arange(lanes, dtype=np.uint64))
    actions, total, steps = np.full(lanes, damping, np.float32), np.zeros((len(car.mean_squares), lanes)), 300
    for step in range(math.ceil(6 / (car.decay(damping) * task.control_interval * w1)) + steps):
        interval = plant.step(actions)
        if step >= math.ceil(6 / (car.decay(damping) * task.control_interval * w1)):
            total += interval.mean_squares
    theory = analysis.mean_squares(task.road, damping=float(np.float32(damping)), speed=1.2 * w1, car=car)
    for name, unit, found in zip(car.mean_squares, task.square_units.tolist(), total / steps, strict=True):
        expected, error = float(theory[name]) / unit, found.std(ddof=1) / math.sqrt(lanes)
        assert abs(found.mean() - expected) < 4 * error + 1e-3 * expected, name


def test_two_masses_on_a_road_of_white_velocity_have_the_closed_forms():
    """(D. Hrovat 1997): on a first-order road whose corner is far below, with E z' z' = S delta and no tyre damping."""
    car = TwoMassCar()
    m_s, m_u, k_s, k_t = car.sprung_mass, car.unsprung_mass, car.spring_rate, car.tyre_rate
    road, speed, w1 = roadgym.FirstOrderRoad(noise_intensity=0.01, wavenumber=1e-6), 20.0, car.natural_frequency
    strength, mass, ratio = 0.01**2 * speed, m_s + m_u, speed * road.wavenumber / w1
    for c in (300.0, 1500.0, 4000.0):
        system = LinearSystem.of(road.shaping_filter(), car.motion, damping=c / (2 * math.sqrt(k_s * m_s)), ratio=ratio)
        found = {name: road.variance * float(square) for name, square in system.mean_squares().items()}
        expected = {
            "acceleration": strength * (c * c * k_t + k_s**2 * mass) / (2 * c * m_s**2) / w1**4,
            "travel": strength * mass / (2 * c),
            "relative_velocity": strength * k_t / (2 * c) / w1**2,
            "tyre_deflection": strength
            * (k_t * mass**2 * c * c + k_s**2 * mass**3 - 2 * k_s * k_t * m_s * m_u * mass + k_t**2 * m_s**2 * m_u)
            / (2 * c * k_t**2 * m_s**2),
            "velocity": strength
            * (c * c * k_t * mass + k_s**2 * mass**2 + k_s * k_t * m_s**2)
            / (2 * c * k_t * m_s**2)
            / w1**2,
        }
        for name, value in expected.items():
            assert found[name] == pytest.approx(value, rel=1e-4), name
        assert found["wheel_load"] == pytest.approx((k_t / k_s) ** 2 * found["tyre_deflection"], rel=1e-12)
