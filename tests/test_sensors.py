"""Sensors: what an observation is beside the truth."""

import json

import gymnasium
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import roadgym
from roadgym import ParameterError, Sensors
from roadgym.env import QuarterCarEnv
from roadgym.task import make_task
from roadgym.vector import QuarterCarVectorEnv

PLANT = {"road": "gaussian", "speed": 1.5, "bandwidth": 0.1, "observe_operating_point": False}
SIGNALS = ["travel", "acceleration", "velocity", "level"]
LARGE = 4096


def drive(sensors, steps=12, num_envs=3, seed=3, observation=SIGNALS, **more):
    """Observations, shape (steps + 1, num_envs, signals), rewards and states of a drive."""
    envs = QuarterCarVectorEnv(num_envs, sensors=sensors, observation=observation, **{**PLANT, **more})
    seen, rewards, states = [envs.reset(seed=seed)[0]], [], [envs.state()]
    for step in range(steps):
        observations, paid, *_ = envs.step(np.full((num_envs, 1), 0.1 + 0.2 * (step % 4), np.float32))
        seen.append(observations)
        rewards.append(paid)
        states.append(envs.state())
    return np.array(seen), np.array(rewards), np.array(states)


def test_ideal_sensors_change_nothing():
    plain, paid, _ = drive(None)
    for ideal in (Sensors(), {}, {"noise": 0.0, "delay": {"travel": 0.0}}):
        seen, rewards, _ = drive(ideal)
        np.testing.assert_array_equal(seen, plain)
        np.testing.assert_array_equal(rewards, paid)


def test_only_observations_of_named_signals_are_disturbed():
    plain, paid, states = drive(None)
    seen, rewards, driven = drive({"noise": {"travel": 0.1}, "bias": {"velocity": 0.1}})
    np.testing.assert_array_equal(rewards, paid)
    np.testing.assert_array_equal(driven, states)
    changed = [bool(np.any(seen[..., k] != plain[..., k])) for k in range(len(SIGNALS))]
    assert changed == [True, False, True, False]


def test_the_operating_point_is_told_as_it_is():
    point = {"observe_operating_point": True, "speed": (1.0, 2.0)}
    seen, _, _ = drive({"noise": 0.3}, **point)
    plain, _, _ = drive(None, **point)
    np.testing.assert_array_equal(seen[..., 4:], plain[..., 4:])
    assert np.all(seen[..., :4] != plain[..., :4])


@pytest.mark.statistical
def test_noise_is_white_and_normal_with_its_deviation():
    seen, _, _ = drive({"noise": {"acceleration": 0.05, "travel": 0.2}}, steps=8, num_envs=LARGE)
    plain, _, _ = drive(None, steps=8, num_envs=LARGE)
    for column, deviation in ((0, 0.2), (1, 0.05)):
        noise = (seen - plain)[..., column].astype(float) / deviation
        samples = noise.size
        assert abs(noise.mean()) * np.sqrt(samples) < 4
        assert abs((noise**2).mean() - 1) * np.sqrt(samples / 2) < 4
        assert abs((noise**4).mean() - 3) * np.sqrt(samples / 96) < 4
        assert abs((noise[1:] * noise[:-1]).mean()) * np.sqrt(samples) < 4
    across = ((seen - plain)[..., 0] * (seen - plain)[..., 1]).astype(float) / 0.01
    assert abs(across.mean()) * np.sqrt(across.size) < 4


@pytest.mark.statistical
def test_a_bias_is_drawn_once_an_episode():
    envs = QuarterCarVectorEnv(LARGE, sensors={"bias": {"travel": 0.3}}, observation=["travel"], **PLANT)
    truth = QuarterCarVectorEnv(LARGE, observation=["travel"], **PLANT)
    found = []
    for _ in range(2):
        seed = 5 if not found else None
        first = envs.reset(seed=seed)[0] - truth.reset(seed=seed)[0]
        damping = np.full((LARGE, 1), 0.3, np.float32)
        later = envs.step(damping)[0] - truth.step(damping)[0]
        np.testing.assert_allclose(first, later, atol=1e-6)
        found.append(first.astype(float).ravel() / 0.3)
    assert abs((found[0] ** 2).mean() - 1) * np.sqrt(LARGE / 2) < 4
    assert abs((found[0] * found[1]).mean()) * np.sqrt(LARGE) < 4


def test_noise_is_that_of_the_signal_whatever_else_is_observed_and_whoever_drives():
    sensors = {"noise": 0.1}
    alone, _, _ = drive(sensors, observation=["velocity"])
    among, _, _ = drive(sensors)
    np.testing.assert_array_equal(alone[..., 0], among[..., 2])
    noise = []
    for damping in (0.1, 0.9):
        envs = [QuarterCarVectorEnv(2, sensors=each, observation=SIGNALS, **PLANT) for each in (sensors, None)]
        for env in envs:
            env.reset(seed=1)
        for _ in range(5):
            seen, plain = (env.step(np.full((2, 1), damping, np.float32))[0] for env in envs)
        noise.append(seen - plain)
    np.testing.assert_allclose(noise[0], noise[1], atol=2e-6)


def test_resolution_rounds_to_whole_steps_in_the_unit_that_is_told():
    task = make_task(**PLANT, observation=["travel"])
    metre = float(task.signal_scale[0])
    seen, _, _ = drive({"resolution": {"travel": 0.25}}, observation=["travel"])
    plain, _, _ = drive(None, observation=["travel"])
    np.testing.assert_array_equal(seen, np.rint(plain / 0.25) * 0.25)
    by_car, _, _ = drive({"resolution": {"travel": 0.25 * metre}, "unit": "car"}, observation=["travel"])
    np.testing.assert_allclose(by_car, seen, rtol=1e-6)


@pytest.mark.parametrize("late", [1, 3])
def test_a_delay_of_whole_intervals_tells_the_past(late):
    interval = make_task(**PLANT).control_interval
    seen, _, _ = drive({"delay": {"travel": late * interval}})
    plain, _, _ = drive(None)
    np.testing.assert_array_equal(seen[late:, :, 0], plain[:-late, :, 0])
    np.testing.assert_array_equal(seen[:late, :, 0], np.broadcast_to(plain[0, :, 0], (late, 3)))
    np.testing.assert_array_equal(seen[..., 1:], plain[..., 1:])


def test_a_delay_of_a_part_of_an_interval_is_one_of_substeps():
    whole = {"substeps": 4, "control_interval": 0.2, "precision": "float64"}
    half = {"substeps": 2, "control_interval": 0.1, "precision": "float64"}
    # a harmonic road without noise is the same however it is cut
    road = {"road": "harmonic", "speed": 1.5, "observe_operating_point": False}
    envs = QuarterCarVectorEnv(2, sensors={"delay": 0.3}, observation=["velocity", "acceleration"], **road, **whole)
    truth = QuarterCarVectorEnv(2, observation=["velocity", "acceleration"], **road, **half)
    envs.reset(seed=2)
    past = [truth.reset(seed=2)[0]]
    for step in range(8):
        damping = np.full((2, 1), 0.1 + 0.2 * (step % 4), np.float32)
        past += [truth.step(damping)[0], truth.step(damping)[0]]
        seen = envs.step(damping)[0]
        np.testing.assert_allclose(seen, past[max(0, 2 * (step + 1) - 3)], atol=1e-6)


@pytest.mark.parametrize("held", [2, 3])
def test_an_interval_holds_each_sample_with_its_noise(held):
    interval = make_task(**PLANT).control_interval
    seen, _, _ = drive({"interval": {"travel": held * interval}, "noise": {"travel": 0.1}}, steps=11)
    fresh, _, _ = drive(None, steps=11)
    for k in range(12):
        np.testing.assert_array_equal(seen[k, :, 0], seen[k - k % held, :, 0])
    assert np.all(seen[held:, :, 0][::held] != fresh[held:, :, 0][::held])
    quiet, _, _ = drive({"interval": {"travel": held * interval}}, steps=11)
    np.testing.assert_array_equal(quiet[::held, :, 0], fresh[::held, :, 0])
    late, _, _ = drive({"interval": {"travel": held * interval}, "delay": {"travel": interval}}, steps=11)
    np.testing.assert_array_equal(late[1:, :, 0], quiet[:-1, :, 0])


numbers = st.one_of(st.just(0.0), st.floats(0.001, 0.5))
times = st.one_of(st.just(0.0), st.floats(0.01, 1.5))


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    noise=numbers,
    bias=numbers,
    resolution=numbers,
    delay=times,
    interval=times,
    mode=st.sampled_from(("next_step", "same_step")),
)
def test_the_batch_is_its_cars_one_by_one(noise, bias, resolution, delay, interval, mode):
    sensors = {"noise": noise, "bias": bias, "resolution": resolution, "delay": {"travel": delay}, "interval": interval}
    plant = {**PLANT, "observation": SIGNALS, "sensors": sensors}
    envs = QuarterCarVectorEnv(66, max_episode_steps=9, autoreset_mode=mode, **plant)
    seen = envs.reset(seed=4)[0]
    single = QuarterCarEnv(**plant)
    np.testing.assert_array_equal(single.reset(seed=4 + 65)[0], seen[65])
    for step in range(16):
        action = np.full((66, 1), 0.1 + 0.2 * (step % 4), np.float32)
        seen, _, _, truncated, info = envs.step(action)
        if mode == "next_step" and step == 9:
            np.testing.assert_array_equal(single.reset()[0], seen[65])
            continue
        own = single.step(action[65])[0]
        np.testing.assert_array_equal(own, info["final_obs"][65] if "final_obs" in info else seen[65])
        if truncated[65] and mode == "same_step":
            np.testing.assert_array_equal(single.reset()[0], seen[65])


def test_a_reset_of_some_leaves_what_the_others_remember():
    delay = {"delay": 0.4, "noise": 0.1}
    pair = [QuarterCarVectorEnv(2, autoreset_mode="disabled", sensors=delay, observation=SIGNALS, **PLANT) for _ in range(2)]
    for env in pair:
        env.reset(seed=1)
        for _ in range(4):
            env.step(np.full((2, 1), 0.4, np.float32))
    pair[0].reset(options={"reset_mask": np.array([True, False])})
    for _ in range(3):
        first, second = (env.step(np.full((2, 1), 0.4, np.float32))[0] for env in pair)
        np.testing.assert_array_equal(first[1], second[1])


def test_sensors_of_two_masses_and_after_a_warm_up():
    plant = {"road": "iso_c", "speed": 20.0, "car": "two_mass", "observation": ["acceleration"], "warm_up": 0.5}
    noise = {"noise": {"acceleration": 0.5}, "unit": "car"}
    seen, plain = (QuarterCarVectorEnv(LARGE, sensors=each, **plant) for each in (noise, None))
    metres = seen.signal_scale[0]
    error = (seen.reset(seed=1)[0] - plain.reset(seed=1)[0])[:, 0] * metres
    assert 0.45 < error.std() < 0.55


def test_spec_survives_json_and_sensors_are_values():
    sensors = Sensors(noise={"travel": 0.1}, delay=0.2, unit="car")
    env = gymnasium.make(roadgym.ENVIRONMENT_ID, sensors=sensors, **PLANT)
    text = env.spec.to_json()
    json.loads(text)
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(text))
    assert again.unwrapped.task == env.unwrapped.task
    assert hash(Sensors(noise={"travel": 0.1, "level": 1})) == hash(Sensors(noise={"level": 1, "travel": 0.1}))


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
        ("accurate", "sensors must be a mapping"),
        ({"nose": 1}, "unknown parameter 'nose' of sensors; known: noise, bias"),
        ({"noise": {"wheel_load": 0.1}}, "sensors cannot be of 'wheel_load' on this plant; signals: displacement"),
        ({"noise": {"speed": 0.1}}, "sensors cannot be of 'speed'"),
        ({"noise": {"travel": -0.1}}, "noise of the sensor of travel must not be negative, got -0.1"),
        ({"bias": float("nan")}, "bias of sensors must be finite"),
        ({"resolution": "fine"}, "resolution of sensors must be a number"),
        ({"noise": {3: 0.1}}, "noise of sensors must be given by names of signals, got 3"),
        ({"unit": "inch"}, 'unit of sensors must be "road" or "car"'),
        ({"delay": 1e6}, "delay of sensors must be such that the delay of the sensor of displacement in control intervals"),
        ({"delay": 199.0, "interval": 0.01}, "interval of sensors must be such that the number of samples in the delay"),
        ({"noise": 1e9, "unit": "car"}, "noise of sensors must be such that that of the sensor of displacement"),
    ],
)
def test_what_is_wrong_is_told_in_one_line(sensors, message):
    plant = {**PLANT, "road": {"kind": "gaussian", "noise_intensity": 1e-3}, "bandwidth": None}
    with pytest.raises(ParameterError) as told:
        make_task(sensors=sensors, **plant)
    assert str(told.value).startswith(message)
    assert "\n" not in str(told.value)


def test_a_delay_as_long_as_an_episode_is_refused():
    with pytest.raises(ParameterError, match="delay of the sensor of travel must be shorter than an episode, 2 s, got 2"):
        QuarterCarVectorEnv(2, max_episode_steps=10, sensors={"delay": {"travel": 2.0}}, observation=["travel"], **PLANT)
