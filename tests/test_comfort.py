"""Wk of ISO 2631-1: its table, its states beside a car, and the plant that follows it."""

import dataclasses
import itertools
import json
import math

import gymnasium
import numpy as np
import pytest
from scipy import signal
from scipy.integrate import quad
from scipy.linalg import expm, solve_discrete_lyapunov

import analysis
import roadgym
from agents import evaluate
from analysis.comfort import comfort_reaction, frequency_weighting
from analysis.quadratic import plant_system
from analysis.sampling import Switching
from roadgym import ParameterError, QuarterCar, Road, TwoMassCar
from roadgym.cars import make_car
from roadgym.comfort import weighting_filter
from roadgym.compiled import COEFFICIENT, LANES, LEVEL, LEVEL_EXCESS, LaneFunction
from roadgym.filters import SignalFilter, filtered
from roadgym.linear import Motion, Signal
from roadgym.plant import Plant
from roadgym.task import make_task
from roadgym.vector import QuarterCarVectorEnv

TWO, ONE = TwoMassCar(weighting="Wk"), QuarterCar(natural_frequency=8.0, weighting="Wk")
WEIGHTED = {"weighted_acceleration": 1.0}

# ISO 2631-1:1997, table 3, one-third octave bands from .1 to 400 Hz: |W| * 1000
BANDS = [1, 1.25, 1.6, 2, 2.5, 3.15, 4, 5, 6.3, 8]
FREQUENCIES = [round(f * 10.0**k, 6) for k in (-1, 0, 1, 2) for f in BANDS][:37]
TABLE = [
    31.2,
    48.6,
    79.0,
    121,
    182,
    263,
    352,
    418,
    459,
    477,
    482,
    484,
    494,
    531,
    631,
    804,
    967,
    1039,
    1054,
    1036,
    988,
    902,
    768,
]
TABLE += [636, 513, 405, 314, 246, 186, 132, 88.7, 54.0, 28.5, 15.2, 7.90, 3.98, 1.95]


def transfer():
    """(numerator, denominator) polynomials of W(s), the factors multiplied out."""
    w = {k: 2 * math.pi * f for k, f in {1: 0.4, 2: 100.0, 3: 12.5, 4: 12.5, 5: 2.37, 6: 3.35}.items()}
    above = [[1, 0, 0], [w[2] ** 2], [w[4] ** 2 / w[3], w[4] ** 2], [1, w[5] / 0.91, w[5] ** 2]]
    below = [[1, math.sqrt(2) * w[k], w[k] ** 2] for k in (1, 2)]
    below += [[1, w[4] / 0.63, w[4] ** 2], [1, w[6] / 0.91, w[6] ** 2]]
    numerator, denominator = np.ones(1), np.ones(1)
    for factor in above:
        numerator = np.polymul(numerator, factor)
    for factor in below:
        denominator = np.polymul(denominator, factor)
    return numerator, denominator


def road_density(road, turn, w):
    """One-sided spectral density of the level, m^2 s, at angular frequencies w, from the road's filter over its angle."""
    return 2 * road.variance * road.shaping_filter().spectrum(w / turn) / turn


def acceleration_gain(car, damping, w):
    """Acceleration of the body over the height of the road, 1/s^2, from the equations in SI units."""
    s, w1 = 1j * w, car.natural_frequency
    if car.kind == "one_mass":
        return s**2 * (2 * damping * w1 * s + w1**2) / (s**2 + 2 * damping * w1 * s + w1**2)
    k, c = car.spring_rate, float(car.damping_coefficient(damping))
    link, tyre = k + c * s, car.tyre_rate
    body = car.sprung_mass * s**2 + link
    return s**2 * link * tyre / (body * (car.unsprung_mass * s**2 + link + tyre) - link**2)


def equations(car, damping, turn):
    """(drift, acceleration of the body) by the states of the car in SI units, and the level and slope of a wave."""
    w1 = car.natural_frequency
    if car.kind == "one_mass":
        row = np.array([-(w1**2), -2 * damping * w1, w1**2, 2 * damping * w1 * turn])
        return np.array([[0, 1, 0, 0], row]), row
    k, c, tyre = car.spring_rate, float(car.damping_coefficient(damping)), car.tyre_rate
    row = np.array([-k, k, -c, c, 0, 0]) / car.sprung_mass
    wheel = np.array([k, -k - tyre, c, -c, tyre, 0]) / car.unsprung_mass
    return np.array([[0, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0], row, wheel]), row


def by_quadrature(road, car, damping, speed):
    """Mean square of the weighted acceleration: |W|^2 |H|^2 S over all frequencies."""
    turn = speed * road.wavenumber

    def density(logarithm):
        w = np.array([math.exp(logarithm)])
        gain = acceleration_gain(car, damping, w) * frequency_weighting(w / (2 * math.pi))
        return float((np.abs(gain) ** 2 * road_density(road, turn, w) * w / (2 * math.pi))[0])

    edges = np.log([1e-4, 0.1, 1, 5, 15, 50, 150, 1000, 1e5])
    return sum(quad(density, low, high, epsabs=0, epsrel=1e-9, limit=200)[0] for low, high in itertools.pairwise(edges))


def test_the_table_of_the_standard():
    """It is printed for nominal frequencies, to the last digit, but for two that are cut off where they should be rounded."""
    gains = 1000 * np.abs(frequency_weighting(FREQUENCIES))
    cut = []
    for f, found, printed in zip(FREQUENCIES, gains.tolist(), TABLE, strict=True):
        digits = max(0, 2 - math.floor(math.log10(printed)))
        if round(found, digits) != printed:
            cut.append((f, printed, math.floor(found)))
    assert cut == [(1.25, 484, 484), (16, 768, 768)]


def test_the_states_are_the_formula():
    """Of the filter alone, and beside a car: the spectrum of what it makes of the acceleration."""
    f = np.geomspace(0.01, 1000, 61)
    gain = frequency_weighting(f)
    made = weighting_filter("Wk", "acceleration", 8.0)
    s = 2j * math.pi * f / 8.0
    found = [made.outputs.ravel() @ np.linalg.solve(each * np.eye(8) - made.drift, made.entries.ravel()) for each in s]
    np.testing.assert_allclose(found, gain, rtol=1e-11)
    np.testing.assert_allclose(np.polyval(transfer()[0], 8.0 * s) / np.polyval(transfer()[1], 8.0 * s), gain, rtol=1e-11)
    for car in (TWO, ONE):
        task = make_task(car=car, road="gaussian", speed=8.0)
        system = plant_system(task, 0.3, task.frequency_ratio(8.0), 0.1)
        w = 2 * math.pi * f / car.natural_frequency
        ratio = system.spectrum("weighted_acceleration", w) / system.spectrum("acceleration", w)
        np.testing.assert_allclose(ratio, np.abs(gain) ** 2, rtol=1e-7)


@pytest.mark.parametrize(("road", "car"), [("iso_c", TWO), ("gaussian", ONE), ("iso_c", ONE), ("gaussian", TWO)])
def test_mean_squares_are_integrals_over_frequency(road, car):
    """Finite on a rough road too, where the acceleration of one mass is not; the other signals are what they are without it."""
    for damping, speed in ((0.03, 10.0), (0.3, 20.0), (1.0, 30.0)):
        found = analysis.mean_squares(road, car=car, damping=damping, speed=speed)
        expected = by_quadrature(roadgym.roads.make_road(road), car, damping, speed)
        told = float(found.weighted_acceleration) * (car.natural_frequency**4 if car.kind == "one_mass" else 1)
        assert told == pytest.approx(expected, rel=1e-6)
        plain = analysis.mean_squares(road, car=dataclasses.replace(car, weighting=None), damping=damping, speed=speed)
        for name, square in plain.items():
            assert float(found[name]) == pytest.approx(float(square), rel=1e-9), name


def test_best_constant_damping_for_the_weighted_acceleration():
    best = analysis.optimal_damping("iso_c", car="two_mass", speed=20.0, weights=WEIGHTED)
    costs = [by_quadrature(roadgym.roads.make_road("iso_c"), TWO, float(best.damping) * k, 20.0) for k in (0.97, 1, 1.03)]
    assert float(best.cost) == pytest.approx(costs[1], rel=1e-6)
    assert costs[1] < min(costs[0], costs[2])


@LaneFunction
def _start(lane, words, table):
    lane[LEVEL] = 0.0


@LaneFunction
def _advance(lanes, words, table):
    for i in range(LANES):
        lanes[LEVEL + i] = lanes[COEFFICIENT + i]
        lanes[LEVEL_EXCESS + i] = lanes[COEFFICIENT + LANES + i]


@dataclasses.dataclass(frozen=True, kw_only=True)
class GivenRoad(Road):
    """A level that is what the first of its rows says, and above its chord by what the second says."""

    kind: str = dataclasses.field(default="given", init=False)
    has_slope = False
    words_per_substep = 0
    start, advance = _start, _advance

    @property
    def variance(self):
        return 1.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class CarWithFilters(roadgym.LinearCar):
    """One mass whose velocity sinks in too, a state of its own, with two signals behind filters."""

    kind: str = dataclasses.field(default="with_filters", init=False)
    natural_frequency: float = 1.0

    @property
    def motion(self):
        own = Motion(
            states=("displacement", "velocity", "sunk"),
            drift=np.array([[0, 1, 0], [-1, 0, 0], [0, 0.5, -0.5]]),
            level_entry=np.array([0, 1, 0]),
            slope_entry=np.zeros(3),
            force_entry=np.array([0, 1, 0]),
            follows=np.array([1, 0, 0]),
            signals={
                "displacement": Signal({"displacement": 1}, "y"),
                "acceleration": Signal({"displacement": -1, "level": 1, "damper_force": -1}, "a"),
                "relative_velocity": Signal({"velocity": 1, "level_rate": -1}, "r"),
            },
        )
        slow = SignalFilter(
            source="relative_velocity", sections=[[[-0.3, -0.4], [0.4, -0.3]]], entries=[[1, 0]], outputs=[[1, 2]], rate=1.0
        )
        fast = dataclasses.replace(slow, source="acceleration", sections=[[[-2, 1], [0, -3]]], rate=2.0)
        return filtered(filtered(own, "slow", "s", slow), "fast", "f", fast)


@pytest.mark.parametrize("car", [TWO, ONE, TwoMassCar(weighting="Wk", tyre_damping=400.0), CarWithFilters()])
@pytest.mark.parametrize("damping", [0.03, 0.3, 1.0])
def test_the_scheme_is_exact_on_white_velocity_at_the_default_substep(car, damping):
    """What a substep of the kernel makes of states, climb and mean excess of a Brownian road has a stationary covariance."""
    usual = make_task(car=car, road="gaussian", speed=0.1, damping_range=(0.01, 1.0))
    step = usual.control_interval * car.natural_frequency / usual.substeps
    task = make_task(
        car=car,
        road=GivenRoad(),
        speed=0.1,
        damping_range=(0.01, 1.0),
        control_interval=step / car.natural_frequency,
        substeps=1,
        precision="float64",
        reward={"displacement": 1.0},
    )
    states, motion = car.motion.states, car.motion
    plant = Plant(task, LANES)
    plant.start(np.zeros(LANES, np.uint64))
    for place, name in enumerate((*states, COEFFICIENT, COEFFICIENT + LANES)):  # a lane for each
        plant.set_row(name, np.arange(LANES) == place)
    driven = plant.step(np.full(LANES, damping, np.float32))
    moved = plant.car_states[:, : len(states) + 2]
    moved[:, len(states)] -= motion.follows  # heights above the road
    transition, climb, excess = moved[:, : len(states)], moved[:, -2], moved[:, -1]
    found = solve_discrete_lyapunov(transition, step * np.outer(climb, climb) + step / 12 * np.outer(excess, excess))
    brown = roadgym.FirstOrderRoad(wavenumber=1.01e-3 * car.natural_frequency)
    exact = analysis.mean_squares(brown, car=car, damping=damping, speed=1.0)
    strength = 2 * brown.variance * brown.wavenumber / car.natural_frequency
    for name in motion.filters:
        row = np.array([motion.signals[name].terms.get(state, 0.0) for state in states])
        unit = car.unit_factors[list(motion.signals).index(name)]
        rough = motion.filters[name].source in motion.rough
        told = unit**2 * strength * (row @ found @ row)
        squares = driven.mean_squares[list(motion.signals).index(name), : len(states) + 2]
        np.testing.assert_allclose(squares, (np.append(row, [0, 0]) ** 2 + (row @ moved) ** 2) / 2, rtol=1e-9)
        assert told == pytest.approx(float(exact[name]), rel=5e-4 if rough else 2e-5), name


def test_a_switching_damper_on_a_wave_is_followed_exactly():
    """Car, Wk and road solved by matrix exponentials, W(s) in a realisation of its own; the acceleration jumps with D."""
    hertz, intervals, fine = 3.0, 60, 20
    levels = np.random.default_rng(1).choice([0.1, 1.0], intervals).astype(np.float32)
    for car in (TWO, ONE):
        w1, turn = car.natural_frequency, 2 * math.pi * hertz
        task = make_task(
            car=car,
            road="harmonic",
            speed=turn,
            damping_range=(0.1, 1.0),
            reward=WEIGHTED,
            observation=("weighted_acceleration",),
            observe_operating_point=False,
            control_interval=0.01,
            precision="float64",
        )
        plant = Plant(task, 1, told=True)
        plant.start(np.array([4], np.uint64))
        filter_drift, entry, output, direct = signal.tf2ss(*transfer())
        assert not direct.any()
        wave = math.sqrt(task.road.variance)
        own = len(car.motion.own.states)
        system = np.concatenate([plant.car_states[:own, 0], np.zeros(8), [plant.row("level")[0], plant.row("slope")[0]]])
        system[own // 2 : own] *= w1  # velocities
        scale, figures = (w1**4 if own == 2 else 1.0), []  # one mass is told in metres
        for damping in levels.tolist():
            drift, row = equations(car, damping, turn)
            whole = np.zeros((own + 10, own + 10))
            places = [*range(own), own + 8, own + 9]
            whole[np.ix_(range(own), places)] = drift
            whole[np.ix_(range(own, own + 8), places)] = entry * row
            whole[own : own + 8, own : own + 8] = filter_drift
            whole[own + 8, own + 9], whole[own + 9, own + 8] = turn, -turn
            step, squares = expm(whole * task.control_interval / fine), []
            for _ in range(fine + 1):
                squares.append((wave * output[0] @ system[own : own + 8]) ** 2)
                system = step @ system
            system = np.linalg.solve(step, system)
            weights = np.array([1, *[4, 2] * (fine // 2 - 1), 4, 1]) / (3 * fine)
            told = plant.step(np.array([damping], np.float32))
            square = told.mean_squares[list(car.motion.signals).index("weighted_acceleration"), 0]
            assert told.reward[0] == pytest.approx(-square / task.cost_unit, rel=1e-12)
            seen = told.observations[0, 0] * task.signal_scale[0]
            figures.append(
                (scale * square, weights @ squares, math.sqrt(scale) * seen, wave * output[0] @ system[own : own + 8])
            )
        found, expected, seen, reached = np.array(figures).T
        assert found.mean() == pytest.approx(expected.mean(), rel=1e-4)
        np.testing.assert_allclose(found, expected, atol=1e-3 * expected.mean())
        np.testing.assert_allclose(seen, reached, atol=2e-5 * np.abs(reached).mean())


@pytest.mark.statistical
@pytest.mark.parametrize(("damping", "speed"), [(0.03, 20.0), (0.3, 10.0), (1.0, 30.0)])
def test_constant_damping_scores_the_theory_in_the_environment(damping, speed):
    """Reward and info in SI units, by default everything."""
    lanes, steps = 1024, 400
    envs = QuarterCarVectorEnv(
        lanes,
        max_episode_steps=None,
        car="two_mass",
        road="iso_c",
        speed=speed,
        damping_range=(0.03, 1.0),
        reward=WEIGHTED,
        warm_up=6 / (TWO.decay(damping) * TWO.natural_frequency),
        warm_up_damping=damping,
    )
    envs.reset(seed=5)
    square, cost, actions = np.zeros(lanes), np.zeros(lanes), np.full((lanes, 1), damping, np.float32)
    for _ in range(steps):
        _, reward, _, _, info = envs.step(actions)
        square += info["weighted_acceleration"] / steps
        cost -= reward / steps
    np.testing.assert_allclose(cost, square, rtol=1e-5)
    expected = float(analysis.mean_squares("iso_c", car=TWO, damping=damping, speed=speed).weighted_acceleration)
    assert abs(square.mean() - expected) < 4 * square.std(ddof=1) / math.sqrt(lanes) + 5e-3 * expected


def test_single_precision_costs_little():
    found = []
    for precision in ("float32", "float64"):
        plant = Plant(make_task(car=TWO, road="iso_c", speed=20.0, precision=precision), 256, told=True)
        plant.start(np.arange(256, dtype=np.uint64))
        squares = sum(plant.step(np.full(256, 0.2, np.float32)).mean_squares.mean(axis=1) for _ in range(1000))
        found.append(squares[list(TWO.motion.signals).index("weighted_acceleration")])
    assert found[0] == pytest.approx(found[1], rel=1e-4)


@pytest.mark.parametrize("car", [TWO, ONE])
def test_nothing_else_changes_and_it_is_off_by_default(car):
    plain = dataclasses.replace(car, weighting=None)
    assert make_task(car=plain, road="gaussian").car == plain
    assert "weighted_acceleration" not in plain.mean_squares
    results = []
    for each in (plain, car):
        task = make_task(car=each, road="gaussian", speed=8.0, control_interval=0.005, substeps=4, precision="float32")
        plant = Plant(task, 70)
        plant.start(np.arange(70, dtype=np.uint64))
        for k in range(30):
            driven = plant.step(np.full(70, (0.1, 0.9)[k % 2], np.float32))
        results.append((driven.mean_squares[: len(plain.mean_squares)], driven.observations, driven.reward))
    for without, with_it in zip(*results, strict=True):
        np.testing.assert_array_equal(without, with_it)


def test_reward_or_observation_switch_it_on():
    for asked in ({"reward": WEIGHTED}, {"observation": ["travel", "weighted_acceleration"]}):
        env = gymnasium.make(roadgym.ENVIRONMENT_ID, car="savaresi", road="iso_b", speed=20.0, **asked)
        assert env.unwrapped.task.car == dataclasses.replace(make_car("savaresi"), weighting="Wk")
        env.reset(seed=1)
        *_, info = env.step(env.action_space.high)
        assert info["weighted_acceleration"] > 0
        spec = gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json())
        assert gymnasium.make(spec).unwrapped.task == env.unwrapped.task
    chosen = json.loads(json.dumps({"kind": "two_mass", "weighting": "Wk"}))
    assert make_car(chosen) == TWO
    assert make_task(car="golden_car", road="iso_a", speed=20.0, reward=WEIGHTED).signals[-1] == "speed"


@pytest.mark.statistical
def test_the_covariance_with_a_switching_damper_holds_for_it_too():
    """D firm and soft in turn: the covariance of car, Wk and road is periodic; and firm where the rule says so."""
    switching = Switching(roadgym.roads.make_road("iso_c"), damping=(0.1, 0.8), speed=20.0, car=TWO, lanes=512, seed=1)
    assert switching.knows_state
    row = switching.names.index("weighted_acceleration")
    for driven in (switching.alternate(), switching.skyhook()):
        expected = np.broadcast_to(driven.expected.T, driven.mean_squares.T.shape)[:, row]
        rest = driven.mean_squares[row] - expected
        assert abs(rest.mean()) < 4 * rest.std(ddof=1) / math.sqrt(512) + 1e-3 * expected.mean()


class Still:
    """The same damping always."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.full((len(observation), 1), 0.4, np.float32), state


@pytest.mark.statistical
def test_evaluation_of_two_masses_tells_it_unasked():
    environment = {"car": "two_mass", "road": "iso_c", "speed": 20.0}
    found = evaluate({"still": Still()}, environment=environment, speeds=[20.0], episodes=32, duration=5.0)["still"]
    assert found.names == TWO.mean_squares
    row = found.names.index("weighted_acceleration")
    expected = float(analysis.mean_squares("iso_c", car=TWO, damping=0.4, speed=20.0).weighted_acceleration)
    samples = found.adjusted_squares[row, 0]
    assert abs(samples.mean() - expected) < 4.5 * samples.std(ddof=1) / math.sqrt(32)
    assert samples.std() < 0.3 * found.squares[row, 0].std()  # the control variates know it too
    one_mass = evaluate(
        {"still": Still()}, environment={"speed": 1.5}, speeds=[1.5], bandwidths=[0.1], episodes=16, duration=1.0, transient=0
    )
    assert one_mass["still"].names == roadgym.MEAN_SQUARES


def test_reactions():
    assert comfort_reaction(0) == comfort_reaction(0.3) == ("not uncomfortable",)
    assert comfort_reaction(0.315) == ("a little uncomfortable",)
    assert comfort_reaction(0.55) == ("a little uncomfortable", "fairly uncomfortable")
    assert comfort_reaction(1.3) == ("uncomfortable", "very uncomfortable")
    assert comfort_reaction(7.0) == ("extremely uncomfortable",)


def test_what_is_refused():
    for refused, message in (
        (lambda: make_car({"kind": "two_mass", "weighting": "Wd"}), "weighting must be one of Wk, got 'Wd'"),
        (lambda: QuarterCar(weighting=3), "weighting must be one of Wk, got 3"),
        (lambda: frequency_weighting([1.0], "Wx"), "weighting must be one of Wk, got 'Wx'"),
        (lambda: frequency_weighting(-1.0), "frequency must be at least 0, got -1.0"),
        (lambda: comfort_reaction(-1), "rms must not be negative, got -1"),
        (lambda: make_task(reward={"comfort": 1}), "unknown reward term 'comfort'; known: .*, weighted_acceleration$"),
        (
            lambda: make_task(car=CarWithFilters(), reward=WEIGHTED),
            "unknown reward term 'weighted_acceleration'; known: .*, fast$",
        ),
        (lambda: filtered(TWO.motion, "twice", "t", weighting_filter("Wk", "weighted_acceleration", 1.0)), "source of twice"),
        (
            lambda: SignalFilter(source="travel", sections=[[[1, 0], [0, -1]]], entries=[[1, 0]], outputs=[[1, 0]], rate=1),
            "stable",
        ),
        (lambda: SignalFilter(source="travel", sections=[[[-1]]], entries=[[1, 0]], outputs=[[1, 0]], rate=1), "shape"),
        (lambda: analysis.optimal_feedback("gaussian", speed=1.0, weights=WEIGHTED), "without a weighting"),
    ):
        with pytest.raises(ParameterError, match=message):
            refused()
