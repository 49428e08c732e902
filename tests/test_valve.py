"""The valve: what it makes of commands, and what the car makes of that."""

import json

import gymnasium
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

import roadgym
from roadgym import ParameterError, Valve
from roadgym.env import QuarterCarEnv
from roadgym.plant import Plant
from roadgym.task import make_task
from roadgym.vector import QuarterCarVectorEnv

LOW, HIGH, INTERVAL = 0.05, 1.0, 0.2
HARMONIC = {"road": "harmonic", "speed": 1.5, "control_interval": INTERVAL, "precision": "float64"}
COMMANDS = np.where(np.random.default_rng(1).random(30) < 0.5, LOW, HIGH).astype(np.float32)
COMMANDS[::5] = 0.4


def in_force(valve, commands, fine=2000):
    """D over a fine grid of each interval, shape (intervals, fine + 1), by small steps of the chain."""
    step = INTERVAL / fine
    damping = target = LOW
    values = np.empty((len(commands), fine + 1))
    for k in range(len(commands)):
        values[k, 0] = damping
        for j in range(fine):
            n = int(np.floor((k * INTERVAL + (j + 0.5) * step - valve.delay) / INTERVAL))
            level = LOW if n < 0 else min(max(float(commands[n]), LOW), HIGH)
            if valve.levels:
                level = LOW + (HIGH - LOW) / (valve.levels - 1) * round((level - LOW) * (valve.levels - 1) / (HIGH - LOW))
            most = np.inf if valve.rate is None else valve.rate * step
            target += min(max(level - target, -most), most)
            time = valve.rise_time if target > damping else valve.fall_time
            damping = target if time == 0 else target + (damping - target) * np.exp(-step / time)
            values[k, j + 1] = damping
    return values


def driven(valve, commands=COMMANDS, num_envs=1, **plant):
    """D in force and mean squares of each interval, and the state before and after, of a drive through a valve."""
    envs = QuarterCarVectorEnv(num_envs, max_episode_steps=None, valve=valve, **{**HARMONIC, **plant})
    envs.reset(seed=0)
    first, told = envs.state(), []
    for command in commands:
        *_, info = envs.step(np.full((num_envs, 1), command, np.float32))
        told.append(info)
    return {name: np.array([info[name] for info in told]) for name in told[0]}, first, envs


VALVES = [
    Valve(delay=0.03),
    Valve(delay=0.43),
    Valve(levels=3),
    Valve(rise_time=0.1, fall_time=0.03),
    Valve(rise_time=0.05),
    Valve(fall_time=0.05, rate=4.0),
    Valve(rate=5.0),
    Valve(delay=0.13, levels=4, rate=8.0, rise_time=0.1, fall_time=0.03),
]
every_valve = pytest.mark.parametrize("valve", VALVES, ids=str)


@every_valve
def test_damping_in_force_is_that_of_the_chain_step_by_step(valve):
    told, _, _ = driven(valve)
    values = in_force(valve, COMMANDS)
    means = (values[:, 1:] + values[:, :-1]).mean(axis=1) / 2
    np.testing.assert_allclose(told["damping"][:, 0], means, atol=4e-4)  # what the small steps are worth
    np.testing.assert_allclose(told["damping_command"][:, 0], np.clip(COMMANDS, np.float32(LOW), 1), atol=1e-7)


@every_valve
def test_the_car_is_that_of_the_differential_equations(valve):
    """A car on a wave, by an ODE solver of high order between the corners of D."""
    told, first, envs = driven(valve)
    values, fine = in_force(valve, COMMANDS), 2000
    y, x, z, u, nu, _ = first[0]
    step, time = INTERVAL / fine, 0.0

    def road(t):
        return z * np.cos(nu * t) + u * np.sin(nu * t), nu * (u * np.cos(nu * t) - z * np.sin(nu * t))

    squares = []
    for row in values:
        grid = time + step * np.arange(fine + 1)

        def motion(t, state, row=row, grid=grid):
            level, rate = road(t)
            damping = row[min(int((t - grid[0]) / step) + 1, fine)] if valve.rise_time == 0 else np.interp(t, grid, row)
            return [state[1], -2 * damping * (state[1] - rate) - (state[0] - level)]

        solution = solve_ivp(motion, (grid[0], grid[-1]), [y, x], t_eval=grid, max_step=INTERVAL / 100, rtol=1e-7, atol=1e-9)
        level, rate = road(grid)
        middle = (row[1:] + row[:-1]) / 2 if valve.rise_time else row[1:]
        force = -2 * middle * (solution.y[1] - rate)[:-1] - (solution.y[0] - level)[:-1]
        squares.append((force**2).mean())
        (y, x), time = solution.y[:, -1], grid[-1]
    np.testing.assert_allclose(envs.state()[0, :2], [y, x], atol=1.5e-3)
    found = told["acceleration"][:, 0] / envs.task.road.variance
    assert abs(found.mean() / np.mean(squares) - 1) < 2e-3
    np.testing.assert_allclose(found, squares, atol=0.02 * np.mean(squares))


@pytest.mark.parametrize("car", ["one_mass", "two_mass"])
def test_mean_squares_converge_with_the_second_power_of_the_substep(car):
    plant = {} if car == "one_mass" else {"car": car, "speed": 6.0, "control_interval": 0.005}
    scale = 1.0 if car == "one_mass" else 0.025
    valve = {"delay": 0.03 * scale, "rise_time": 0.05 * scale, "fall_time": 0.1 * scale}
    found = []
    for substeps in (8, 16, 128):
        told, _, envs = driven(valve, **plant, substeps=substeps)
        names = envs.task.car.mean_squares
        found.append(np.array([told[name].mean() for name in names]))
    coarse, middle = (np.abs(each / found[-1] - 1) for each in found[:2])
    assert coarse.max() < 1e-3
    assert middle.max() < 0.4 * coarse.max()


def test_what_is_needed_keeps_the_mean_squares():
    for valve in ({"delay": 0.07}, {"rise_time": 0.01, "fall_time": 0.1}, {"rate": 10.0}):
        told, _, envs = driven(valve)
        exact, _, _ = driven(valve, substeps=8 * envs.task.substeps)
        for name in envs.task.car.mean_squares:
            assert abs(told[name].mean() / exact[name].mean() - 1) < 3e-4


def test_quantisation_alone_is_that_of_the_commands_bit_by_bit():
    levels = np.linspace(LOW, HIGH, 5)
    nearest = levels[np.abs(COMMANDS[:, None] - levels).argmin(axis=1)].astype(np.float32)
    told, _, _ = driven({"levels": 5})
    plain, _, _ = driven(None, nearest)
    np.testing.assert_array_equal(told["damping"].astype(np.float32), plain["damping"].astype(np.float32))
    np.testing.assert_allclose(told["acceleration"], plain["acceleration"], rtol=1e-6)


def test_a_delay_of_whole_intervals_is_the_commands_later():
    told, _, _ = driven({"delay": 2 * INTERVAL})
    plain, _, _ = driven(None, np.concatenate([[LOW, LOW], COMMANDS[:-2]]))
    np.testing.assert_array_equal(told["damping"][2:], plain["damping"][2:])
    np.testing.assert_allclose(told["acceleration"], plain["acceleration"], rtol=1e-6)  # D_min in double precision at first
    assert "damping_command" not in plain


def test_the_ideal_valve_is_no_valve():
    plain, _, _ = driven(None)
    for ideal in ({}, Valve(), {"delay": 0.0, "rise_time": 0}):
        told, _, _ = driven(ideal)
        assert told.keys() == plain.keys()
        for name, values in told.items():
            np.testing.assert_array_equal(values, plain[name])


def test_a_constant_command_comes_to_what_theory_knows():
    for valve in ({"delay": 0.3, "rise_time": 0.2, "fall_time": 0.1, "rate": 2.0}, {"levels": 4, "delay": 0.05}):
        made = Valve(**valve)
        commands = np.full(200, 0.5, np.float32)
        told, _, envs = driven(valve, commands)
        settled = float(made.settled(0.5, envs.task.damping_range))
        plain, _, _ = driven(None, np.full(200, settled, np.float32), substeps=envs.task.substeps)
        np.testing.assert_allclose(told["damping"][100:], settled, rtol=1e-6)
        np.testing.assert_allclose(told["acceleration"][-20:], plain["acceleration"][-20:], rtol=1e-3)


times = st.one_of(st.just(0.0), st.floats(1e-3, 0.7))
valves = st.builds(
    lambda delay, levels, rate, rise, fall: Valve(delay=delay, levels=levels, rate=rate, rise_time=rise, fall_time=fall),
    times,
    st.none() | st.integers(2, 20),
    st.none() | st.floats(0.1, 50.0),
    times,
    times,
).filter(lambda valve: not valve.ideal)


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(valve=valves, seed=st.integers(0, 1000), precision=st.sampled_from(("float32", "float64")))
def test_damping_stays_within_its_range_and_the_batch_is_its_cars(valve, seed, precision):
    plant = {"road": "gaussian", "speed": 1.5, "valve": valve, "precision": precision, "observation": ["acceleration"]}
    envs = QuarterCarVectorEnv(65, max_episode_steps=8, autoreset_mode="same_step", **plant)
    single = QuarterCarEnv(**plant)
    np.testing.assert_array_equal(single.reset(seed=seed + 64)[0], envs.reset(seed=seed)[0][64])
    actions = np.random.default_rng(seed).uniform(-0.5, 1.5, (16, 65, 1)).astype(np.float32)
    low, high = (np.asarray(end, precision) for end in envs.task.damping_range)
    for step, action in enumerate(actions):
        seen, rewards, _, _, info = envs.step(action)
        own, reward, _, _, told = single.step(action[64])
        ended = step % 8 == 7
        np.testing.assert_array_equal(own, info["final_obs"][64] if ended else seen[64])
        assert np.asarray(reward, precision) == rewards[64]
        for name in ("damping", "damping_command", "acceleration"):
            assert told[name] == info[name][64]
        for values in (info["damping"], envs.plant.row("damping")):
            assert np.all((values >= low * (1 - 1e-6)) & (values <= high * (1 + 1e-6)))
        if ended:
            np.testing.assert_array_equal(single.reset()[0], seen[64])


def test_an_episode_starts_soft_and_infos_are_those_of_a_start():
    env = QuarterCarEnv(valve={"rise_time": 1.0}, warm_up=5.0, **HARMONIC)
    _, info = env.reset(seed=1)
    assert info["damping"] == info["damping_command"] == 0
    assert env.plant.row("damping")[0] == pytest.approx(LOW)
    *_, info = env.step(np.array([1.0], np.float32))
    assert LOW < info["damping"] < info["damping_command"] == 1
    end = LOW + (1 - LOW) * (1 - np.exp(-INTERVAL))
    assert env.plant.row("damping")[0] == pytest.approx(end)
    env.reset()
    assert env.plant.row("damping")[0] == pytest.approx(LOW)


def test_observed_acceleration_is_with_the_damping_in_force():
    plant = {
        **HARMONIC,
        "observation": ["acceleration", "travel", "relative_velocity"],
        "valve": {"fall_time": 0.3, "delay": 0.05},
    }
    env = QuarterCarEnv(observe_operating_point=False, **plant)
    env.reset(seed=1)
    for command in COMMANDS[:10]:
        (acceleration, travel, relative), *_ = env.step(command[None])
        damping = env.plant.row("damping")[0]
        assert acceleration == pytest.approx(-2 * damping * relative - travel, abs=1e-5)


def test_the_picture_shows_what_is_in_force():
    pytest.importorskip("pygame")
    env = QuarterCarEnv(render_mode="rgb_array", valve={"rise_time": 0.4}, **HARMONIC)
    env.reset(seed=1)
    env.step(np.array([1.0], np.float32))
    assert env.history.damping == env.plant.row("damping")[0] < 0.5


def test_weighted_acceleration_and_warm_up_go_through_a_valve():
    plant = {"car": "two_mass", "road": "iso_c", "speed": 20.0, "reward": {"weighted_acceleration": 1.0}}
    pair = [Plant(make_task(valve=each, **plant, substeps=24), 64) for each in ({"rise_time": 1e-9}, None)]
    for each in pair:
        each.start(np.arange(64, dtype=np.uint64))
        for step in range(60):
            driven = each.step(np.full(64, 0.2 + 0.3 * (step % 2), np.float32))
        each.found = driven.mean_squares.copy()
    np.testing.assert_allclose(pair[0].found, pair[1].found, rtol=2e-3)


def test_spec_survives_json():
    env = gymnasium.make(roadgym.ENVIRONMENT_ID, valve=VALVES[-1], **HARMONIC)
    text = env.spec.to_json()
    json.loads(text)
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(text))
    assert again.unwrapped.task == env.unwrapped.task


@pytest.mark.parametrize(
    ("valve", "message"),
    [
        ("quick", "valve must be a mapping of parameters or a Valve, got 'quick'"),
        ({"lag": 1}, "unknown parameter 'lag' of valve; known: delay, levels, rate, rise_time, fall_time"),
        ({"delay": -0.1}, "delay of the valve must not be negative, got -0.1"),
        ({"levels": 1}, "levels of the valve must be at least 2, got 1"),
        ({"levels": 2.5}, "levels of the valve must be an integer"),
        ({"rate": 0}, "rate of the valve must be positive"),
        ({"rise_time": float("inf")}, "rise_time of the valve must be finite"),
        ({"delay": 1e5}, "delay of the valve must be such that the delay in control intervals lies within [0, 1000]"),
    ],
)
def test_what_is_wrong_is_told_in_one_line(valve, message):
    with pytest.raises(ParameterError) as told:
        make_task(valve=valve, **HARMONIC)
    assert str(told.value).startswith(message)
    assert "\n" not in str(told.value)


def test_a_delay_as_long_as_an_episode_is_refused():
    with pytest.raises(ParameterError, match="delay of the valve must be shorter than an episode, 2 s, got 2"):
        QuarterCarVectorEnv(2, max_episode_steps=10, valve={"delay": 2.0}, **HARMONIC)
