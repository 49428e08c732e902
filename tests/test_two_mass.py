"""The car of two masses in kilograms and newtons: what it is told in, and that it moves as its equations say."""

import json
import math
import re

import gymnasium
import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_lyapunov, solve_discrete_lyapunov

import agents
import analysis
import roadgym
from agents.cli import main
from agents.comparison import compare, write
from agents.comparison import table as comparison_table
from roadgym import FirstOrderRoad, ParameterError, TwoMassCar
from roadgym.cars import make_car
from roadgym.cars.linear import DEGREE, FACTORS, SERIES, STATES
from roadgym.plant import Plant
from roadgym.task import make_task
from roadgym.vector import QuarterCarVectorEnv

CAR = TwoMassCar()
CLASS_C = {"kind": "first_order", "iso_class": "C"}
PRESETS = ("two_mass", "savaresi", "renault_megane", "golden_car")


def equations(car, c, *, tyre_damping=0.0):
    """(drift, entry of the road's velocity) of (z_s - z_u, z_u - z, z_s', z_u') in SI units, written down anew."""
    m_s, m_u, k_s, k_t = car.sprung_mass, car.unsprung_mass, car.spring_rate, car.tyre_rate
    drift = np.array(
        [
            [0, 0, 1, -1],
            [0, 0, 0, 1],
            [-k_s / m_s, 0, -c / m_s, c / m_s],
            [k_s / m_u, -k_t / m_u, c / m_u, -(c + tyre_damping) / m_u],
        ]
    )
    return drift, np.array([0, -1, 0, tyre_damping / m_u])


def signals_of(car, c):
    """Rows of the signals over that state, in SI units."""
    return {
        "acceleration": np.array([-car.spring_rate, 0, -c, c]) / car.sprung_mass,
        "travel": np.array([1, 0, 0, 0]),
        "relative_velocity": np.array([0, 0, 1, -1]),
        "velocity": np.array([0, 0, 1, 0]),
        "wheel_velocity": np.array([0, 0, 0, 1]),
        "tyre_deflection": np.array([0, 1, 0, 0]),
        "wheel_load": np.array([0, car.tyre_rate, 0, 0]),
    }


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("road_class", ["A", "C", "H"])
def test_mean_squares_are_those_of_the_equations_in_si_units(name, road_class):
    """On white velocity, which a road of its class is but for waves longer than a kilometre."""
    car, speed = make_car(name), 20.0
    road = FirstOrderRoad.from_iso8608(road_class, lowest_frequency=1e-4)
    strength = 2 * math.pi**2 * 0.1**2 * 16e-6 * 4 ** "ABCDEFGH".index(road_class) * speed
    c = float(car.damping_coefficient(0.3))
    drift, entry = equations(car, c)
    covariance = solve_continuous_lyapunov(drift, -strength * np.outer(entry, entry))
    found = analysis.mean_squares(road, car=car, damping=0.3, speed=speed)
    for signal, row in signals_of(car, c).items():
        assert float(found[signal]) == pytest.approx(row @ covariance @ row, rel=2e-3), signal
    weights = {"acceleration": 2.0, "tyre_deflection": 3e4}
    best = analysis.optimal_damping(road, car=car, speed=speed, weights=weights, bounds=(0.3, 0.3))
    assert float(best.cost) == pytest.approx(2 * float(found.acceleration) + 3e4 * float(found.tyre_deflection))


def test_closed_forms_of_white_velocity():
    """Class C at 20 m/s (D. Hrovat 1997): as they are usually told, m/s^2, mm and the share of the static load."""
    for c, acceleration, travel, deflection, share in ((665, 1.366, 14.5, 5.16, 0.305), (1500, 1.587, 9.64, 4.10, 0.242)):
        road = FirstOrderRoad.from_iso8608("C", lowest_frequency=1e-4)
        found = analysis.mean_squares(road, car=CAR, damping=CAR.damping_ratio(c), speed=20.0)
        assert math.sqrt(found.acceleration) == pytest.approx(acceleration, abs=1e-3)
        assert 1e3 * math.sqrt(found.travel) == pytest.approx(travel, abs=0.05)
        assert 1e3 * math.sqrt(found.tyre_deflection) == pytest.approx(deflection, abs=5e-3)
        static = 9.81 * (CAR.sprung_mass + CAR.unsprung_mass)
        assert math.sqrt(found.wheel_load) / static == pytest.approx(share, abs=1e-3)


def test_a_damper_in_the_tyre():
    car = TwoMassCar(tyre_damping=400.0)
    road, speed, c = roadgym.GaussianRoad.from_iso8608("C"), 20.0, float(car.damping_coefficient(0.25))
    drift, entry = equations(car, c, tyre_damping=400.0)
    shaping = road.shaping_filter()
    turn = speed * road.wavenumber
    whole = np.zeros((6, 6))
    whole[:4, :4], whole[4:, 4:] = drift, turn * shaping.drift
    whole[:4, 4:] = np.outer(entry, turn * shaping.level @ shaping.drift)
    noise = math.sqrt(road.variance * turn) * np.concatenate([np.zeros((4, shaping.noise.shape[1])), shaping.noise])
    covariance = solve_continuous_lyapunov(whole, -noise @ noise.T)
    load = np.zeros(6)
    load[[1, 3]] = car.tyre_rate, car.tyre_damping
    load[4:] = -car.tyre_damping * turn * shaping.level @ shaping.drift
    found = analysis.mean_squares(road, car=car, damping=0.25, speed=speed)
    assert float(found.wheel_load) == pytest.approx(load @ covariance @ load, rel=1e-6)
    for signal in ("acceleration", "travel", "tyre_deflection"):
        row = np.append(signals_of(car, c)[signal], [0, 0])
        assert float(found[signal]) == pytest.approx(row @ covariance @ row, rel=1e-6), signal
    rough = analysis.mean_squares(CLASS_C, car=car, damping=0.25, speed=speed)
    assert math.isinf(rough.wheel_load)
    assert math.isfinite(rough.acceleration)
    with pytest.raises(ParameterError, match="mean square of wheel_load is infinite on a first_order road"):
        make_task(car=car, road=CLASS_C, reward={"wheel_load": 1.0})


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("damping", [0.03, 0.3, 1.0])
def test_the_scheme_is_exact_on_white_velocity_at_the_default_substep(name, damping):
    """What the substeps make of white velocity has a stationary covariance of its own, at wheel hop too."""
    car = make_car(name)
    task = make_task(car=car, road=CLASS_C, speed=20.0, damping_range=(0.03, 1.0))
    step = task.control_interval * car.natural_frequency / task.substeps
    table = car.table(step, task.damping_range)
    powers = ((damping - table[0]) * table[1]) ** np.arange(DEGREE, -1, -1)
    factors = table[SERIES:].reshape(FACTORS, DEGREE + 1) @ powers
    transition, climb, excess = factors[:16].reshape(STATES, STATES), factors[16:20], factors[20:]
    # of a Brownian path the climb has the variance h, and the mean excess over the chord h/12, independent of it
    noise = step * np.outer(climb, climb) + step / 12 * np.outer(excess, excess)
    found = solve_discrete_lyapunov(transition, noise)
    motion = car.motion
    drift = motion.drift + 2 * damping * motion.damper
    exact = solve_continuous_lyapunov(drift, -np.outer(motion.follows, motion.follows))
    for row in (np.eye(4)[2], np.eye(4)[3], np.array([1, -1, 0, 0]), np.array([0, 1, 0, 0]), np.array([0, 0, 1, -1])):
        assert row @ found @ row == pytest.approx(row @ exact @ row, rel=2e-6)
    np.testing.assert_allclose(transition, expm(drift * step), atol=1e-9)


@pytest.mark.statistical
@pytest.mark.parametrize("damping", [0.03, 0.3, 1.0])
def test_constant_damping_scores_the_theory_in_the_environment(damping):
    """Info and reward in SI units, by default everything, D beyond the damper's own range too."""
    lanes = 2048
    envs = QuarterCarVectorEnv(
        lanes, max_episode_steps=None, car="two_mass", road="iso_c", speed=20.0, damping_range=(0.03, 1.0)
    )
    envs.reset(seed=3)
    interval = envs.task.control_interval
    assert interval == 0.005
    settled = math.ceil(6 / (CAR.decay(damping) * CAR.natural_frequency * interval))
    names, steps = CAR.mean_squares, 400
    total, cost = np.zeros((len(names), lanes)), np.zeros(lanes)
    actions = np.full((lanes, 1), damping, np.float32)
    for step in range(settled + steps):
        _, reward, _, _, info = envs.step(actions)
        if step >= settled:
            total += [info[name] for name in names]
            cost -= reward
    theory = analysis.mean_squares("iso_c", car="two_mass", damping=damping, speed=20.0)
    for name, found in zip((*names, "cost"), (*total / steps, cost / steps), strict=True):
        expected = float(theory[name if name != "cost" else "acceleration"])
        assert abs(found.mean() - expected) < 4 * found.std(ddof=1) / math.sqrt(lanes) + 1e-4 * expected, name


@pytest.mark.parametrize("damping", [0.03, 1.0])
def test_single_precision_costs_little(damping):
    """Over the same road, so that their difference is that of the formats; the longest memory loses most."""
    found = []
    for precision in ("float32", "float64"):
        task = make_task(car=CAR, road=CLASS_C, speed=20.0, damping_range=(0.03, 1.0), precision=precision)
        plant = Plant(task, 256)
        plant.start(np.arange(256, dtype=np.uint64))
        found.append(sum(plant.step(np.full(256, damping, np.float32)).mean_squares.mean(axis=1) for _ in range(1000)))
    assert np.abs(found[0] / found[1] - 1).max() < 2e-4


def test_an_episode_starts_on_the_road():
    plant = Plant(make_task(car=CAR, road=CLASS_C, speed=20.0, observation=("travel", "tyre_deflection", "level")), 64)
    seen = plant.start(np.arange(64, dtype=np.uint64)).observations
    assert not seen[:, :2].any()
    assert seen[:, 2].std() > 0.5
    assert not plant.row("velocity").any()


def test_ratios_and_coefficients():
    car = TwoMassCar.from_ratios(mass_ratio=0.15, stiffness_ratio=10, natural_frequency=8.0, damping_range=(0.1, 0.9))
    assert (car.unsprung_mass, car.spring_rate, car.tyre_rate) == pytest.approx((0.15, 64.0, 640.0))
    assert car.default_damping_range == pytest.approx((0.1, 0.9))
    other = TwoMassCar.from_ratios(mass_ratio=0.15, stiffness_ratio=10, natural_frequency=8.0, sprung_mass=300.0)
    one, two = (analysis.mean_squares("iso_b", car=each, damping=0.3, speed=20.0) for each in (car, other))
    assert float(one.acceleration) == pytest.approx(float(two.acceleration))
    assert float(two.wheel_load) == pytest.approx(300.0**2 * float(one.wheel_load))
    values = np.array([300.0, 4000.0])
    np.testing.assert_allclose(CAR.damping_coefficient(CAR.damping_ratio(values)), values)
    assert CAR.damping_ratio(1500) == pytest.approx(1500 / (2 * math.sqrt(16e3 * 240)))
    assert make_task(car=CAR, road=CLASS_C).damping_range == pytest.approx(tuple(CAR.damping_ratio(values)))


def test_the_specification_survives_json():
    chosen = {"kind": "two_mass", "sprung_mass": 300, "damping_coefficients": [200, 3000], "tyre_damping": 50}
    env = gymnasium.make(roadgym.ENVIRONMENT_ID, car=json.loads(json.dumps(chosen)), road="gaussian", speed=5.0)
    spec = gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json())
    assert gymnasium.make(spec).unwrapped.task == env.unwrapped.task
    assert hash(env.unwrapped.task.car) == hash(make_car(chosen))


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"damping_coefficients": [3000, 200]}, r"damping_coefficients must be .*\[3000, 200\]"),
        ({"damping_coefficients": [300, 300]}, "damping_coefficients must be a pair .* low < high"),
        ({"damping_coefficients": "ab"}, "damping_coefficients must be a pair .* low < high, got 'ab'"),
        ({"damping_coefficients": [1, 2, 3]}, "damping_coefficients must be a pair"),
        ({"damping_coefficients": [1, 1e300]}, "damping_coefficients, high end, must lie within"),
        ({"sprung_mass": 1e12}, r"sprung_mass must lie within \[1e-06, 1e\+09\], got 1000000000000.0"),
        ({"tyre_rate": 1e300}, r"tyre_rate must lie within \[1e-12, 1e\+15\], got 1e\+300"),
        ({"tyre_damping": 1e300}, "tyre_damping must lie within"),
        ({"tyre_damping": -1}, "tyre_damping must not be negative, got -1"),
        ({"unsprung_mass": "heavy"}, "unsprung_mass must be a number, got 'heavy'"),
        ({"mass_ratio": 0.1}, "car 'two_mass' needs stiffness_ratio beside 'mass_ratio'"),
        ({"mass_ratio": 0.1, "spring_rate": 3}, "unknown parameter 'spring_rate' of car 'two_mass' beside 'mass_ratio'"),
    ],
)
def test_cars_that_are_none(parameters, message):
    with pytest.raises(ParameterError, match=message):
        make_car({"kind": "two_mass", **parameters})


@pytest.mark.parametrize("value", ["x", None, [1.0, math.nan]])
def test_damping_that_is_no_number(value):
    with pytest.raises(ParameterError, match=r"^damping_coefficient must be"):
        CAR.damping_ratio(value)
    with pytest.raises(ParameterError, match=r"^damping_ratio must be"):
        CAR.damping_coefficient(value)


def test_a_comparison_is_told_as_people_speak_of_cars(tmp_path):
    """Speeds in m/s and km/h, root mean squares in m/s², mm and N, and no frequency ratio anywhere."""
    environment = {"car": "two_mass", "road": "iso_c", "speed": [15.0, 25.0], "control_interval": 0.02}
    options = {"speeds": [15.0, 25.0], "episodes": 16, "controllers": ("d_min", "skyhook")}
    comparison = compare(None, environment=environment, **options)
    text = comparison_table(comparison)
    assert max(map(len, text.splitlines())) <= 80
    assert "m/s  km/h" in text
    assert re.search(r"^ 25 +90 ", text, re.MULTILINE)
    assert "mean square of acceleration in (m/s²)²" in text
    assert not re.search(r"\bnu\b|E Z\^2", text)
    # theory at the middle point that is shown, the last of two
    best = analysis.optimal_damping("iso_c", car="two_mass", speed=25.0, weights={"acceleration": 1.0})
    theory = analysis.mean_squares("iso_c", car="two_mass", speed=25.0, damping=best.damping)
    (line,) = (line for line in text.splitlines() if line.startswith("best constant D") and "(" not in line)
    acceleration, weighted, travel, load = (float(cell) for cell in line.split()[-4:])
    assert 0.5 * acceleration < weighted < acceleration
    assert acceleration == pytest.approx(math.sqrt(theory.acceleration), rel=0.01)
    assert travel == pytest.approx(1e3 * math.sqrt(theory.travel), rel=0.03)
    assert load == pytest.approx(math.sqrt(theory.wheel_load), rel=0.02)
    page = write(comparison, tmp_path)[0].read_text(encoding="utf-8")
    assert "wheel load, N" in page
    assert "travel, mm" in page
    assert "25 m/s, 90 km/h" in page
    assert {"root_mean_squares.png", "pareto.png"} <= {file.name for file in tmp_path.iterdir()}


def test_what_is_infinite_is_left_out_of_what_a_drive_is_like(tmp_path):
    """The force of a tyre with a damper, where the road's slope is white noise; the numbers are written before the pictures."""
    car = {"kind": "two_mass", "tyre_damping": 100.0}
    options = {"speeds": [20.0], "episodes": 16, "controllers": ("d_min",)}
    comparison = compare(None, environment={"car": car, "road": "iso_c", "speed": 20.0, "control_interval": 0.02}, **options)
    assert "wheel load" not in comparison_table(comparison).partition("D:")[0]
    files = {file.name for file in write(comparison, tmp_path)}
    assert {"comparison.html", "comparison.json", "root_mean_squares.png"} <= files
    assert "pareto.png" not in files


def test_certify_takes_the_plant_that_two_masses_usually_have(capsys, monkeypatch):
    asked = []
    monkeypatch.setattr("analysis.certification.certify", lambda road, **rest: asked.append((road, rest)) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        main(["certify", "--car", "savaresi"])
    with pytest.raises(ZeroDivisionError):
        main(["certify"])
    assert [(road, rest["speed"]) for road, rest in asked] == [("iso_c", 20.0), ("multiplicative", 1.0)]


def test_no_controller_is_passed_over_by_a_certificate():
    road = roadgym.ProfileRoad(heights=tuple(0.01 * np.sin(np.arange(80.0) ** 2)), spacing=0.5)
    driver = agents.make_controller("skyhook", make_task(car="two_mass", road="iso_c", speed=20.0))
    with pytest.raises(ParameterError, match="driver must be None on a profile road"):
        analysis.certify(road, car="two_mass", speed=20.0, lanes=1024, driver=driver)
