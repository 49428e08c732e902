"""A measured profile as a road: what it is, how it is driven, and what theory says of it."""

import dataclasses
import json
import pickle

import gymnasium as gym
import numpy as np
import pytest
from plants import PROFILE
from scipy import linalg

import agents
import analysis
import roadgym
from agents.cli import environment_from, main, make_parser
from agents.training import train
from analysis.certification import level_distribution
from analysis.control_variates import control_dampings
from analysis.feedback import optimal_feedback
from analysis.quadratic import has_quadratic_value
from analysis.roads import level_bound
from roadgym import LinearCar, ParameterError, ProfileRoad, QuarterCar, TwoMassCar
from roadgym.compiled import COEFFICIENT, LANES, LEVEL, LEVEL_EXCESS, SLOPE, TURN
from roadgym.linear import Motion, Signal
from roadgym.plant import Plant
from roadgym.roads import make_road
from roadgym.roads.profile import PLACE, advance
from roadgym.task import make_task

REAL_CAR = TwoMassCar(sprung_mass=240, unsprung_mass=36, spring_rate=16e3, tyre_rate=160e3)
ROUGH = np.random.default_rng(2).standard_normal(120).cumsum() * 0.005
TINY = {"n_envs": 8, "n_steps": 16, "batch_size": 64, "n_epochs": 1, "n_timesteps": 128, "policy_kwargs": {"net_arch": [8]}}


@pytest.fixture
def road():
    return ProfileRoad(heights=ROUGH, spacing=0.25, join=3.0, wavenumber=0.8)


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "road.csv"
    path.write_text("".join(f"{0.25 * k + 478}, {z + 583}\n" for k, z in enumerate(ROUGH)))
    return path


def period_of(road):
    """Heights at the points of the period, m."""
    return road.periodic.levels * road.variance**0.5


def level_at(road, distance):
    """The road by interpolation, m."""
    period = period_of(road)
    points = road.spacing * np.arange(len(period) + 1)
    return np.interp(np.asarray(distance) % points[-1], points, np.append(period, period[0]))


def test_the_end_fades_over_into_the_beginning(road):
    period = period_of(road)
    assert len(period) == len(ROUGH) - 1 - 12  # 3 m of steps of 0.25 m
    assert abs(period.mean()) < 1e-15
    trend = np.polynomial.Polynomial.fit(np.arange(len(ROUGH)), ROUGH, 1)(np.arange(len(ROUGH)))
    level = ROUGH - trend
    kept = period[12:] - level[12 : len(period)]  # as it was measured, but for the mean
    np.testing.assert_allclose(kept, kept[0], atol=1e-15)
    np.testing.assert_allclose(period[0] - kept[0], level[len(period)], atol=1e-15)  # what came after the last one
    assert np.abs(np.diff(np.append(period, period[0]))).max() < 1.2 * np.abs(np.diff(level)).max()


def test_altitude_and_grade_do_not_count(road):
    distance = road.spacing * np.arange(len(ROUGH))
    uphill = dataclasses.replace(road, heights=tuple(ROUGH + 583 + 0.06 * distance))
    np.testing.assert_allclose(period_of(uphill), period_of(road), atol=1e-12)


def test_a_tenth_of_the_length_is_joined_by_default_and_nothing_where_the_heights_are_a_period():
    assert ProfileRoad(heights=ROUGH, spacing=0.25).join == pytest.approx(0.1 * 0.25 * (len(ROUGH) - 1))
    whole = ProfileRoad(heights=ROUGH, spacing=0.25, join=0)
    np.testing.assert_allclose(period_of(whole), ROUGH - ROUGH.mean(), atol=1e-15)


def test_hills_are_taken_out_and_what_shakes_the_car_stays():
    distance = 0.25 * np.arange(1600)
    hills, bumps = 2 * np.sin(2 * np.pi * distance / 400) + np.cos(2 * np.pi * distance / 200), np.resize(ROUGH, 1600)
    bumps = bumps - bumps.mean()
    road = ProfileRoad(heights=hills + bumps, spacing=0.25, join=0, longest_wave=100.0)
    waves = np.abs(np.fft.rfft(period_of(road))), np.abs(np.fft.rfft(bumps))
    np.testing.assert_allclose(waves[0][:4], 0, atol=1e-10)
    np.testing.assert_allclose(waves[0][4:], waves[1][4:], atol=1e-10)  # from 100 m on, itself included
    flat, whole = (
        analysis.mean_squares(one, damping=0.3, speed=20.0, car=REAL_CAR)
        for one in (road, dataclasses.replace(road, longest_wave=None))
    )
    assert float(flat.displacement) < 0.01 * float(whole.displacement)
    assert float(flat.acceleration) == pytest.approx(float(whole.acceleration), rel=0.04)


def test_moments_law_and_autocovariance_are_those_of_the_straight_lines(road):
    length = road.spacing * len(period_of(road))
    distance = np.linspace(0, length, 2_000_000, endpoint=False)
    level = level_at(road, distance)
    assert road.variance == pytest.approx(np.mean(level**2), rel=1e-5)
    slope = np.gradient(level, distance[1]) / road.wavenumber
    assert road.slope_variance * road.variance == pytest.approx(np.mean(slope**2), rel=1e-3)
    for lag in (0, 12345, 400_000, 1_300_000):
        expected = np.mean(level * np.roll(level, -lag))
        found = analysis.certification.autocovariance(road, None, distance[lag] / 3.0, speed=3.0)
        assert float(found) == pytest.approx(expected, abs=1e-5 * road.variance)
    places = np.linspace(-1.1, 1.1, 23) * level_bound(road)
    below = (level[:, None] < places).mean(axis=0)
    np.testing.assert_allclose(level_distribution(road, places), below, atol=1e-5)
    assert level_bound(road) == pytest.approx(np.abs(level).max(), rel=1e-4)
    fine = np.linspace(-1.05, 1.05, 400_001) * level_bound(road)
    density = analysis.marginal_density(road, fine)
    assert np.sum(density) * (fine[1] - fine[0]) == pytest.approx(1, abs=2e-3)


def test_the_lines_hold_all_of_the_variance_and_of_the_slope(road):
    for bands in (1, 3):
        lines = road.periodic.lines(bands)
        assert lines.shares.sum() + lines.rest[1] == pytest.approx(1, abs=1e-12)
        assert lines.shares @ lines.ratios**2 + lines.rest[0] == pytest.approx(road.slope_variance, rel=1e-12)


@pytest.mark.parametrize("angle", [1e-4, 0.07, 0.2, 1.3, 9.0, 60.0])
def test_a_substep_passes_any_number_of_points_exactly(road, angle):
    """Level, slope and mean above the chord, from places all over the period, its end included."""
    table, points = road.table(), len(period_of(road))
    lanes = np.zeros(COEFFICIENT + LANES)
    places = points * (np.arange(LANES) + 0.37) / LANES
    places[-1] = points - 1e-3
    lanes[PLACE : PLACE + LANES], lanes[TURN : TURN + LANES] = places, angle
    deviation, unit = road.variance**0.5, road.spacing
    lanes[LEVEL : LEVEL + LANES] = level_at(road, places * unit) / deviation
    advance.function(lanes, None, table)
    way = angle / road.wavenumber
    ends = places * unit + way
    np.testing.assert_allclose(lanes[LEVEL : LEVEL + LANES], level_at(road, ends) / deviation, atol=1e-11)
    np.testing.assert_allclose(lanes[PLACE : PLACE + LANES], ends / unit % points, atol=1e-9)
    a_bit = 1e-6
    climb = (level_at(road, ends + a_bit) - level_at(road, ends)) / (a_bit * road.wavenumber * deviation)
    np.testing.assert_allclose(lanes[SLOPE : SLOPE + LANES], climb, atol=1e-6)
    shares = (np.arange(200_000) + 0.5) / 200_000
    for lane in range(0, LANES, 9):
        start = places[lane] * unit
        mean = level_at(road, start + way * shares).mean() / deviation
        chord = (level_at(road, start) + level_at(road, start + way)) / (2 * deviation)
        assert lanes[LEVEL_EXCESS + lane] == pytest.approx(mean - chord, abs=2e-8)


def test_cars_follow_the_profile_from_a_place_of_their_own(road):
    plant = Plant(make_task(road=road, speed=(0.5, 2.0)), 300)
    plant.start(np.arange(300, dtype=np.uint64))
    places = plant.row(PLACE) * road.spacing
    speeds = plant.row("speed") / road.wavenumber
    assert len(np.unique(places)) == 300
    for k in range(1, 40):
        plant.step(np.full(300, 0.3, np.float32))
        expected = level_at(road, places + speeds * plant.task.control_interval * k)
        np.testing.assert_allclose(plant.row("level") * road.variance**0.5, expected, atol=1e-10)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SeatedCar(LinearCar):
    kind: str = dataclasses.field(default="seated", init=False)
    natural_frequency: float = 2.0

    @property
    def motion(self):
        return Motion(
            states=("displacement", "velocity", "seat", "seat_velocity"),
            drift=np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1], [4.0, 1.2, -4.0, -1.2]]),
            level_entry=np.array([0, 1, 0, 0]),
            slope_entry=np.zeros(4),
            force_entry=np.array([0, 1, 0, 0]),
            follows=np.array([1, 0, 1, 0]),
            signals={
                "relative_velocity": Signal({"velocity": 1, "level_rate": -1}, "r"),
                "seat_acceleration": Signal({"displacement": 4.0, "seat": -4.0, "velocity": 1.2, "seat_velocity": -1.2}, "a"),
                "body_force": Signal({"damper_force": -1.0, "displacement": -1.0, "level": 1.0}, "f"),
            },
        )


def exact_mean_squares(road, car, damping, ratio):
    """From the response that repeats itself, piece by piece with matrix exponentials; in heights above the road."""
    level, motion = road.periodic, car.motion
    z, step, size, rows = level.levels, level.angle / ratio, len(motion.states), motion.rows
    relative, twice, w = rows[list(motion.signals).index(motion.relative)], 2 * damping, motion.follows
    block = np.zeros((size + 2, size + 2))  # states, level, rate of the level
    block[:size, :size] = motion.drift + twice * motion.damper
    block[:size, size] = block[:size, :size] @ w + motion.level_entry - twice * relative[size] * motion.force_entry
    block[:size, size + 1] = motion.slope_entry - twice * relative[size + 1] * motion.force_entry - w
    block[size, size + 1] = 1
    signals = rows[:, : size + 2] + twice * rows[:, size + 2 :] * relative[: size + 2]
    signals[:, size] += signals[:, :size] @ w
    advance_one = linalg.expm(block * step)
    rates = (np.roll(z, -1) - z) / step

    def around(state):
        states = []
        for k in range(len(z)):
            states.append(np.concatenate([state, [z[k], rates[k]]]))
            state = (advance_one @ states[-1])[:size]
        return state, np.array(states)

    period = np.linalg.matrix_power(advance_one[:size, :size], len(z))
    _, states = around(np.linalg.solve(np.eye(size) - period, around(np.zeros(size))[0]))
    found, halvings = {}, max(0, int(np.ceil(np.log2(np.abs(block).sum() * step))))
    for name, row in zip(motion.signals, signals, strict=True):
        # the integral of the square over a piece as a form of its beginning: Van Loan's over a small part, then doubled
        part, nothing = step / 2**halvings, np.zeros_like(block)
        exponential = linalg.expm(np.block([[-block.T, np.outer(row, row)], [nothing, block]]) * part)
        way = exponential[size + 2 :, size + 2 :]
        form = way.T @ exponential[: size + 2, size + 2 :]
        for _ in range(halvings):
            form, way = form + way.T @ form @ way, way @ way
        found[name] = np.einsum("ki,ij,kj->", states, form, states) / (step * len(z))
    return found


@pytest.mark.parametrize("car", [QuarterCar(natural_frequency=2.0), REAL_CAR, SeatedCar()], ids=lambda car: car.kind)
@pytest.mark.parametrize("speed", [0.7, 6.0, 40.0])
def test_mean_squares_are_those_of_the_exact_response(road, car, speed):
    dampings = np.array([0.03, 0.3, 1.0, 4.0])
    found = analysis.mean_squares(road, damping=dampings, speed=speed, car=car)
    assert found.standard_error is None
    units = dict(zip(car.mean_squares, car.unit_factors, strict=True))
    for k, damping in enumerate(dampings.tolist()):
        exact = exact_mean_squares(road, car, damping, speed * road.wavenumber / car.natural_frequency)
        for name, square in exact.items():
            unit = road.variance * units[name] ** 2
            assert found[name][k] / unit == pytest.approx(square, rel=1e-8), (name, damping)


def test_mean_squares_of_many_operating_points_are_those_of_each(road):
    damping, speed = np.array([[0.1], [0.5]]), np.array([1.0, 2.0, 1.0])
    together = analysis.mean_squares(road, damping=damping, speed=speed)
    for index in np.ndindex(2, 3):
        alone = analysis.mean_squares(road, damping=damping[index[0], 0], speed=speed[index[1]])
        for name in together:
            assert together[name][index] == pytest.approx(float(alone[name]), rel=1e-12)


def test_the_unit_of_speed_changes_nothing_in_metres(road):
    other = dataclasses.replace(road, wavenumber=3.0)
    first, second = (analysis.mean_squares(one, damping=0.3, speed=8.0, car=REAL_CAR) for one in (road, other))
    for name in first:
        assert float(first[name]) == pytest.approx(float(second[name]), rel=1e-10)


def test_a_long_wave_of_many_points_is_a_harmonic_road():
    wave = ProfileRoad(heights=np.cos(2 * np.pi * np.arange(4000) / 4000), spacing=2 * np.pi / 4000, join=0)
    found = analysis.mean_squares(wave, damping=0.2, speed=1.3)
    exact = analysis.mean_squares("harmonic", damping=0.2, speed=1.3)
    for name in exact:
        assert float(found[name]) == pytest.approx(float(exact[name]), rel=1e-5)


def test_the_best_damping_is_where_the_cost_is_least(road):
    weights = {"acceleration": 1.0, "travel": 0.5}
    best = analysis.optimal_damping(road, speed=2.0, weights=weights)
    assert best.standard_error is None
    assert 0.06 < best.damping < 0.95
    grid = np.linspace(0.9, 1.1, 21) * best.damping
    squares = analysis.mean_squares(road, damping=grid, speed=2.0)
    costs = sum(weight * squares[name] for name, weight in weights.items()) / road.variance
    assert np.argmin(costs) == 10
    assert float(best.cost) == pytest.approx(costs[10], rel=1e-12)


@pytest.mark.statistical
@pytest.mark.parametrize("car", [QuarterCar(), REAL_CAR], ids=lambda car: car.kind)
def test_constant_damping_costs_in_the_environment_what_theory_says(road, car):
    weights, speed, number = {"acceleration": 1.0, "travel": 0.5}, 1.5 * car.natural_frequency, 2048
    best = analysis.optimal_damping(road, speed=speed, car=car, weights=weights)
    plant = {"road": road, "car": car, "speed": speed, "damping_range": (0.05, 1.0)}
    interval = 0.2 / car.natural_frequency
    envs = gym.make_vec("roadgym/QuarterCar-v0", num_envs=number, reward=weights, control_interval=interval, **plant)
    envs.reset(seed=3)
    actions = np.full((number, 1), best.damping, np.float32)
    costs = np.array([-envs.step(actions)[1] for _ in range(500)])[200:].mean(axis=0)
    error = costs.std(ddof=1) / number**0.5
    assert abs(costs.mean() - best.cost) < 4 * error + 1e-3 * best.cost
    assert error < 0.01 * best.cost


@pytest.mark.statistical
def test_the_plant_is_certified_from_the_command_line(file, capsys):
    assert main(["certify", "--road", str(file), "--speed", "1.5", "--lanes", "2048"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("profile (wavenumber 1, spacing 0.25, join 2.975) road, no speed noise")
    for line in ("law of the level", "PSD, 1.5 m/s", "relative velocity, constant"):
        assert line in text
    assert "where D switches (none is known on a profile" in text


@pytest.mark.statistical
def test_weak_noise_on_the_speed_changes_little(road):
    noise = {"kind": "low_pass", "intensity": 0.02, "corner_frequency": 1.0}
    driven = analysis.mean_squares(road, noise, damping=0.4, speed=2.0, relative_error=0.02)
    exact = analysis.mean_squares(road, damping=0.4, speed=2.0)
    for name in exact:
        error = float(driven.standard_error[name])
        assert abs(float(driven[name] - exact[name])) < 4 * error + 0.01 * float(exact[name])


def test_what_theory_does_not_know_is_refused_in_one_line(road):
    for asked, told in (
        (lambda: analysis.covariance(road, damping=0.3, speed=1.0), "road must be a linear filter"),
        (lambda: analysis.spectral_density(road, 1.0, speed=1.0), "a profile road is a pair of lines for each of its waves"),
        (lambda: analysis.density(road, 0.0, 0.0), "must have a joint density"),
        (lambda: optimal_feedback(road, speed=1.0), "road"),
        (lambda: analysis.mean_squares(road, damping=0.3, speed=1.0, bandwidth=0.1), "a profile road has none"),
        (lambda: analysis.mean_squares(road, damping=0.3, speed=1e-4), r"lies within \[0.001"),
        (lambda: analysis.mean_squares(road, damping=100.0, speed=0.02, car=REAL_CAR), "number of lines"),
        (lambda: make_task(road=road, speed_noise="white"), "defined on the harmonic road only"),
        (lambda: make_task(road=road, bandwidth=0.1), "a profile road has no bandwidth"),
        (lambda: make_task(road=road, precision="float32"), 'precision must be "float64"'),
    ):
        with pytest.raises(ParameterError, match=told) as error:
            asked()
        assert "\n" not in str(error.value)


def test_constant_dampings_serve_as_control_variates_and_there_is_no_quadratic_value(road):
    task = make_task(road=road)
    assert len(control_dampings(task, 300.0, 64)) == 4
    assert not has_quadratic_value(task)


def test_a_road_is_its_heights(road, file):
    assert make_road(json.loads(json.dumps(dataclasses.asdict(road)))) == road
    copy = pickle.loads(pickle.dumps(road))
    assert copy == road
    assert len({road, copy, dataclasses.replace(road, spacing=0.3)}) == 2
    assert len(repr(road)) < 100
    env = gym.make("roadgym/QuarterCar-v0", road=PROFILE, speed=1.5)
    spec = gym.envs.registration.EnvSpec.from_json(env.spec.to_json())
    assert gym.make(spec).unwrapped.task == env.unwrapped.task


def test_a_file_is_a_road_by_its_name(file, monkeypatch):
    road = make_road(str(file))
    assert road == ProfileRoad.from_file(file)
    np.testing.assert_allclose(road.heights, ROUGH + 583, atol=1e-9)
    mapped = make_road({"kind": "profile", "file": str(file), "units": "cm", "join": 5.0, "wavenumber": 2.0})
    np.testing.assert_allclose(mapped.heights, (ROUGH + 583) / 100, atol=1e-9)
    assert (mapped.join, mapped.wavenumber) == (5.0, 2.0)
    monkeypatch.chdir(file.parent)
    file.rename("gaussian")
    assert make_road("gaussian") == roadgym.GaussianRoad()
    assert make_road("./gaussian") == road


@pytest.mark.parametrize(
    ("value", "told"),
    [
        ("nowhere.csv", "unknown road 'nowhere.csv'; known: .*, profile, iso_a.*, or a file that exists"),
        ("x" * 5000, "unknown road"),
        ("\0", "unknown road"),
        ("profile", "road 'profile' needs heights or file, got"),
        ({"kind": "profile", "spacing": 0.25}, "needs heights or file"),
        ({"kind": "profile", "heights": [1, 2]}, "needs spacing or file"),
        ({"kind": "profile", "file": "nowhere.csv"}, "cannot read the profile 'nowhere.csv': No such file"),
        ({"kind": "profile", "file": "road.csv", "spacing": 1.0}, "unknown parameter 'spacing' .* beside 'file'"),
        (PROFILE | {"heights": "high"}, "heights must be a number or an array of numbers, got 'high'"),
        (PROFILE | {"heights": [0.1] * 5}, r"heights must be 16 to 1000000 numbers in a row, got the shape \(5,\)"),
        (PROFILE | {"heights": np.zeros((20, 2))}, r"numbers in a row, got the shape \(20, 2\)"),
        (PROFILE | {"heights": [*ROUGH, float("nan")]}, "heights must be finite, got nan"),
        (PROFILE | {"heights": [3.0] * 20}, "heights must be such that the variance E Z"),
        (PROFILE | {"spacing": 0}, "spacing must be positive"),
        (PROFILE | {"spacing": 25}, r"spacing must lie within \[0.001, 10\], got 25"),
        (PROFILE | {"longest_wave": -5}, "longest_wave must be positive, got -5"),
        (PROFILE | {"longest_wave": 0.1}, "heights must be such that the variance"),
        (PROFILE | {"join": -1}, "join must not be negative"),
        (PROFILE | {"join": 0.3}, "join must be 0, or from the spacing, 0.5 m, to half of the length, 14.75 m, got 0.3"),
        (PROFILE | {"join": 15}, "to half of the length, 14.75 m, got 15"),
    ],
)
def test_bad_profiles_are_refused(value, told):
    with pytest.raises(ParameterError, match=told):
        make_road(value)


def test_an_agent_keeps_the_road_that_it_learned_on(file, tmp_path, capsys):
    (tmp_path / "tiny.yaml").write_text(json.dumps({roadgym.ENVIRONMENT_ID: TINY}))
    folder = tmp_path / "agent"
    options = ["--hyperparameters", str(tmp_path / "tiny.yaml"), "--output", str(folder)]
    assert main(["train", "--road", str(file), *options]) == 0
    assert main(["train", "--road", str(file), "--resume", "--timesteps", "256", *options]) == 0
    train(tmp_path / "by_name", environment={"road": str(file), "speed": [1.0, 2.0]}, hyperparameters=TINY)
    train(tmp_path / "by_name", environment={"road": str(file), "speed": [1.0, 2.0]}, timesteps=256, resume=True)
    road = make_road(str(file))
    file.write_text("gone\n")
    for trained in (folder, tmp_path / "by_name"):
        assert agents.load(trained).task.road == road
    capsys.readouterr()
    assert main(["evaluate", "--agent", str(folder), "--speeds", "1", "--episodes", "16"]) == 0


def test_commands_read_a_road_once(file):
    """Else who calls one again is told that the road has changed: what is written down are the heights."""
    environment = environment_from(make_parser().parse_args(["train", "--road", str(file), "--output", "agent"]))
    assert environment["road"] == make_road(str(file))
    assert "bandwidth" not in environment


def test_an_advantage_as_reward_falls_back_to_the_cost(tmp_path):
    train(tmp_path / "agent", environment={"road": PROFILE}, hyperparameters=TINY | {"training_reward": "advantage"})
    description = json.loads((tmp_path / "agent" / "agent.json").read_text())
    assert description["training_reward"] == "cost"
