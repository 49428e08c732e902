"""The single environment, as a user of Gymnasium meets it."""

import copy
import json
import pickle
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RescaleAction
from plants import EVERY_PLANT, plant_name

import roadgym
from roadgym import ParameterError

ID = roadgym.ENVIRONMENT_ID
every_plant = pytest.mark.parametrize("plant", EVERY_PLANT, ids=plant_name)


def drive(env, seed, steps=12):
    """Observations and rewards of a few steps with actions of all sizes."""
    observation, _ = env.reset(seed=seed)
    seen = [(observation, 0.0)]
    for action in np.linspace(0.05, 1.0, steps, dtype=np.float32):
        observation, reward, *_ = env.step(np.array([action]))
        seen.append((observation, reward))
    return seen


def assert_same(first, second):
    for (a, r), (b, s) in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)
        assert r == s


@every_plant
def test_gymnasium_finds_no_fault(plant):
    env = gymnasium.make(ID, **plant)
    with warnings.catch_warnings():
        # the action is D itself, by design; agents that need [-1, 1] rescale it
        warnings.filterwarnings("ignore", message=".*recommend using a symmetric and normalized space.*")
        check_env(env.unwrapped)


@every_plant
def test_stable_baselines3_finds_no_fault(plant):
    from stable_baselines3.common.env_checker import check_env as check

    check(RescaleAction(gymnasium.make(ID, **plant), np.float32(-1), np.float32(1)))


@every_plant
def test_spec_survives_json(plant):
    env = gymnasium.make(ID, **plant)
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert_same(drive(env, 3), drive(again, 3))


def test_spec_with_objects_and_ranges_survives_json():
    env = gymnasium.make(
        ID,
        road=roadgym.MultiplicativeRoad(bandwidth=0.1, noise_intensity=0.3, level_bound=1.0),
        speed=(0.7, 2.0),
        bandwidth=(0.05, 0.5),
        damping_range=(0.05, 1.0),
        reward={"displacement": 1.0, "travel": 0.5},
    )
    text = env.spec.to_json()
    json.loads(text)
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(text))
    assert again.unwrapped.task == env.unwrapped.task
    assert_same(drive(env, 3), drive(again, 3))


@every_plant
def test_copies_go_on_alike(plant):
    env = gymnasium.make(ID, **plant)
    drive(env, 5)
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    for action in (0.1, 0.9):
        expected = env.step(np.array([action], np.float32))
        for other in copies:
            found = other.step(np.array([action], np.float32))
            np.testing.assert_array_equal(found[0], expected[0])
            assert found[1] == expected[1]


def test_another_process_drives_the_same_road():
    code = (
        "import gymnasium, numpy as np\n"
        "env = gymnasium.make('roadgym:roadgym/QuarterCar-v0', speed=(0.7, 2.0))\n"
        "env.reset(seed=11)\n"
        "for _ in range(5): observation, reward, *_ = env.step(np.array([0.3], np.float32))\n"
        "print(observation.tobytes().hex(), float(reward).hex())"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    env = gymnasium.make(ID, speed=(0.7, 2.0))
    env.reset(seed=11)
    for _ in range(5):
        observation, reward, *_ = env.step(np.array([0.3], np.float32))
    assert output == [observation.tobytes().hex(), float(reward).hex()]


def test_importing_the_environment_loads_no_learning_library():
    heavy = ("torch", "stable_baselines3", "scipy.linalg", "scipy.special", "matplotlib", "analysis", "agents")
    code = f"import roadgym, roadgym.env, roadgym.vector, sys; print([m for m in {heavy} if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"


def test_foreign_packages_named_like_ours_do_no_harm(tmp_path):
    for name in ("analysis", "agents"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('a decoy was imported')\n")
    code = (
        "import gymnasium as g; e = g.make('roadgym:roadgym/QuarterCar-v0'); e.reset(seed=0); e.step(e.action_space.sample())"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path)


def test_seeds_fix_the_road_and_resets_change_it():
    env = gymnasium.make(ID)
    first, again, other = drive(env, 1), drive(env, 1), drive(env, 2)
    assert_same(first, again)
    assert not np.array_equal(first[0][0], other[0][0])
    env.reset(seed=1)
    second, _ = env.reset()
    assert not np.array_equal(second, first[0][0])
    unseeded = gymnasium.make(ID).reset()[0], gymnasium.make(ID).reset()[0]
    assert not np.array_equal(*unseeded)


def test_road_does_not_depend_on_what_the_controller_does():
    levels = []
    for action in (0.05, 1.0):
        env = gymnasium.make(ID)
        env.reset(seed=9)
        levels.append([env.step(np.array([action], np.float32))[0][2:4] for _ in range(30)])
    np.testing.assert_array_equal(*levels)


def test_actions_saturate_and_nonsense_raises():
    env = gymnasium.make(ID).unwrapped
    env.reset(seed=0)
    assert env.step(np.array([7.0], np.float32))[4]["damping"] == 1.0
    assert env.step(np.array([-7.0], np.float32))[4]["damping"] == pytest.approx(0.05)
    for action in (np.array([np.nan]), np.array([np.inf]), np.zeros(2), np.float32(0.3)):
        with pytest.raises(ParameterError, match="action must"):
            env.step(action)


def test_step_before_reset_raises():
    with pytest.raises(gymnasium.error.ResetNeeded):
        gymnasium.make(ID).unwrapped.step(np.array([0.3], np.float32))


def test_episodes_are_truncated_not_terminated():
    env = gymnasium.make(ID)
    env.reset(seed=0)
    ends = [env.step(np.array([0.3], np.float32))[2:4] for _ in range(500)]
    assert ends == [(False, False)] * 499 + [(False, True)]


def test_reset_options_fix_one_episode():
    env = gymnasium.make(ID, speed=(0.7, 2.0), bandwidth=(0.05, 0.5))
    observation, info = env.reset(seed=1, options={"speed": 1.2, "bandwidth": 0.2})
    assert info == pytest.approx(dict.fromkeys((*roadgym.MEAN_SQUARES, "damping"), 0.0) | {"speed": 1.2, "bandwidth": 0.2})
    assert observation[-2:] == pytest.approx([1.2 / 2.2, 0.4 / 1.4])
    _, info = env.reset()
    assert info["speed"] != pytest.approx(1.2)
    speeds = [env.reset()[1]["speed"] for _ in range(200)]
    assert 0.7 <= min(speeds) < 0.8
    assert 1.9 < max(speeds) <= 2.0
    with pytest.raises(ParameterError, match=r"option 'speed' must lie within \[0.7, 2\], got 2.5"):
        env.reset(options={"speed": 2.5})
    with pytest.raises(ParameterError, match="unknown reset option 'velocity'"):
        env.reset(options={"velocity": 1.0})
    with pytest.raises(ParameterError, match="a harmonic road has no bandwidth"):
        gymnasium.make(ID, road="harmonic").reset(options={"bandwidth": 0.1})


def test_info_and_reward_are_the_same_mean_squares():
    road = roadgym.GaussianRoad(bandwidth=0.2, noise_intensity=0.7, wavenumber=1.5)
    weights = {"displacement": 1.0, "acceleration": 0.5, "relative_velocity": 0.25}
    env = gymnasium.make(ID, road=road, reward=weights, natural_frequency=2.0, speed=1.5)
    env.reset(seed=4)
    for _ in range(5):
        _, reward, _, _, info = env.step(np.array([0.4], np.float32))
        expected = -sum(weight * info[name] for name, weight in weights.items()) / road.variance
        assert reward == pytest.approx(expected, rel=1e-5)  # single precision
    assert info["damping"] == pytest.approx(0.4)
    assert info["speed"] == pytest.approx(1.5)
    assert set(info) == {*roadgym.MEAN_SQUARES, "damping", "speed", "bandwidth"}


def test_observation_names_and_scale():
    signals = ("travel", "acceleration", "level", "displacement", "relative_velocity", "velocity", "slope")
    env = gymnasium.make(ID, observation=signals, road="gaussian", speed=2.0).unwrapped
    assert env.signal_names == (*signals, "speed", "bandwidth")
    env.reset(seed=2)
    for _ in range(20):
        observation, *_ = env.step(np.array([0.3], np.float32))
    value = dict(zip(env.signal_names, observation.astype(float), strict=True))
    assert value["travel"] == pytest.approx(value["displacement"] - value["level"], abs=1e-5)
    assert value["relative_velocity"] == pytest.approx(value["velocity"] - 2.0 * value["slope"], abs=1e-5)
    assert value["acceleration"] == pytest.approx(-0.6 * value["relative_velocity"] - value["travel"], abs=1e-5)
    assert value["speed"] == pytest.approx(2 / 3)
    metres = observation * env.signal_scale
    assert metres[2] == pytest.approx(value["level"] * np.sqrt(env.task.road.variance))
    assert observation in env.observation_space


def test_signals_that_are_white_noise_are_not_offered():
    assert gymnasium.make(ID, road="first_order").unwrapped.signal_names == ("displacement", "velocity", "level", "speed")
    with pytest.raises(ParameterError, match="unknown signal 'slope' on this plant"):
        gymnasium.make(ID, road="first_order", observation=["slope"])
    with pytest.raises(ParameterError, match="signal 'acceleration' is infinite on white speed noise"):
        gymnasium.make(ID, road="harmonic", speed_noise="white", observation=["acceleration"])
    env = gymnasium.make(ID, road="first_order")
    env.reset(seed=0)
    info = env.step(np.array([0.3], np.float32))[4]
    assert info["acceleration"] == info["relative_velocity"] == np.inf


def test_warm_up_leaves_the_state_that_driving_leaves():
    cold = gymnasium.make(ID, road="harmonic", natural_frequency=1.0)
    warm = gymnasium.make(ID, road="harmonic", warm_up=60.0, warm_up_damping=0.5)
    assert np.all(cold.reset(seed=1)[0][:2] == 0)
    # on a harmonic road what is left after 60 time units at D = 0.5 is the forced motion (3) alone, to exp(-30)
    observation, _ = warm.reset(seed=1)
    y, x, z, u = observation[:4].astype(complex)
    gain = (1 + 1j) / 1j  # (1 + 2 D i nu)/(1 - nu^2 + 2 D i nu)
    expected = gain * (z - 1j * u)
    assert y == pytest.approx(expected.real, abs=2e-3)  # the substep of 0.1 rad bends the line by h^4/720 or so
    assert -x == pytest.approx(expected.imag, abs=2e-3)


def test_everything_scales_with_natural_frequency_and_wavenumber():
    plain = gymnasium.make(ID, road={"kind": "gaussian"}, speed=1.5)
    scaled = gymnasium.make(
        ID,
        road={"kind": "gaussian", "wavenumber": 0.5, "noise_intensity": 0.2 * np.sqrt(0.5)},
        speed=1.5 * 8.0 / 0.5,
        natural_frequency=8.0,
    )
    assert scaled.unwrapped.task.control_interval == pytest.approx(0.2 / 8)
    for (a, r), (b, s) in zip(drive(plain, 6), drive(scaled, 6), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)  # single precision, constants rounded differently
        assert r == pytest.approx(s, rel=1e-4, abs=1e-7)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"road": "cobbles"}, "unknown road 'cobbles'"),
        ({"speed": (2.0, 1.0)}, r"speed must be a pair \(low, high\) with low <= high, got \(2.0, 1.0\)"),
        ({"speed": -1.0}, "speed must be positive, got -1.0"),
        ({"speed": (1.0, 2.0, 3.0)}, "speed must be one number or a pair"),
        ({"damping_range": (0.0, 1.0)}, "damping_range, low end, must be positive, got 0.0"),
        ({"damping_range": (0.5, 0.5)}, "low < high"),
        ({"damping_range": (1.0, 0.1)}, "low <= high"),
        ({"bandwidth": 0.0}, "bandwidth must be positive, got 0.0"),
        ({"road": "harmonic", "bandwidth": 0.1}, "a harmonic road has no bandwidth"),
        ({"road": "gaussian", "speed_noise": "white"}, "white speed noise is defined on the harmonic road only"),
        ({"road": "multiplicative", "speed_noise": "high_pass"}, "high_pass speed noise is defined on the harmonic road only"),
        ({"speed_noise": "pink"}, "unknown speed noise 'pink'; known: white, low_pass, high_pass"),
        ({"reward": {"comfort": 1.0}}, "unknown reward term 'comfort'"),
        ({"reward": {"travel": -1.0}}, "weight of travel must not be negative, got -1.0"),
        ({"reward": {}}, "at least one positive weight"),
        ({"road": "first_order", "reward": {"acceleration": 1.0}}, "mean square of acceleration is infinite on a first_order"),
        (
            {"road": "harmonic", "speed_noise": "white", "reward": {"relative_velocity": 1.0}},
            "mean square of relative_velocity is infinite on white speed noise",
        ),
        ({"observation": ["level", "level"]}, "more than once"),
        ({"observation": "level"}, "must be a sequence of signal names"),
        ({"natural_frequency": 0}, "natural_frequency must be positive, got 0"),
        ({"control_interval": -0.1}, "control_interval must be positive, got -0.1"),
        ({"substeps": 0}, "substeps must be at least 1, got 0"),
        ({"substeps": 2.5}, "substeps must be an integer, got 2.5"),
        ({"warm_up": -1}, "warm_up must not be negative, got -1"),
        ({"precision": "float16"}, 'precision must be "float32" or "float64"'),
    ],
)
def test_bad_parameters_are_refused_by_name(parameters, message):
    with pytest.raises(ParameterError, match=message):
        gymnasium.make(ID, **parameters)
