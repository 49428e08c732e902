"""The stable-baselines3 adapter."""

import json
import re

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RescaleAction, TransformReward
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecVideoRecorder

import roadgym
from agents import wrappers
from agents.vec_env import QuarterCarVecEnv, damping_from_action
from roadgym import ParameterError
from roadgym.env import QuarterCarEnv

ENVIRONMENT = {"road": "multiplicative", "speed": [0.7, 2.0], "bandwidth": [0.1, 0.3]}


def test_discrete_actions_drive_like_the_damping_that_they_stand_for():
    chosen, direct = (
        QuarterCarVecEnv(3, environment=ENVIRONMENT, damping_levels=3),
        QuarterCarVecEnv(3, environment=ENVIRONMENT),
    )
    assert chosen.action_space.n == 3
    for envs in (chosen, direct):
        envs.seed(4)
        envs.reset()
    for _ in range(5):
        steps = chosen.step(np.array([0, 1, 2])), direct.step(np.array([[-1], [0], [1]], np.float32))
        np.testing.assert_array_equal(steps[0][0], steps[1][0])
        np.testing.assert_array_equal(steps[0][1], steps[1][1])


def test_adapter_equals_single_environments_in_a_dummy_vec_env():
    n, limit, low, high = 5, 6, np.float32(-1), np.float32(1)

    def single():
        return RescaleAction(gymnasium.make(roadgym.ENVIRONMENT_ID, max_episode_steps=limit, **ENVIRONMENT), low, high)

    native = QuarterCarVecEnv(n, max_episode_steps=limit, environment=ENVIRONMENT)
    dummy = DummyVecEnv([single] * n)
    for envs in (native, dummy):
        envs.seed(40)
    np.testing.assert_array_equal(native.reset(), dummy.reset())
    actions = np.random.default_rng(1).uniform(-1, 1, (15, n, 1)).astype(np.float32)
    returns = np.zeros(n)
    for k, action in enumerate(actions):
        (obs, rewards, dones, infos), (obs_2, rewards_2, dones_2, infos_2) = native.step(action), dummy.step(action)
        # the two rescale in other orders of operations: D differs in its last digit
        np.testing.assert_allclose(obs, obs_2, atol=2e-6)
        np.testing.assert_allclose(rewards, rewards_2, rtol=1e-4, atol=1e-6)
        np.testing.assert_array_equal(dones, dones_2)
        returns += rewards
        for info, info_2 in zip(infos, infos_2, strict=True):
            assert info.get("TimeLimit.truncated", False) == info_2["TimeLimit.truncated"]
            if dones[0]:
                np.testing.assert_allclose(info["terminal_observation"], info_2["terminal_observation"], atol=2e-6)
                assert info["episode"]["l"] == limit
        if dones[0]:
            assert [info["episode"]["r"] for info in infos] == pytest.approx(returns)
            returns[:] = 0
        assert dones.all() == ((k + 1) % limit == 0)


def test_options_reach_the_environments_at_the_next_reset_alone():
    native = QuarterCarVecEnv(3, environment=ENVIRONMENT)
    dummy = DummyVecEnv([lambda: gymnasium.make(roadgym.ENVIRONMENT_ID, **ENVIRONMENT)] * 3)
    for options in ({"speed": 1.25}, [{"speed": 0.75}, {}, {"speed": 1.5, "bandwidth": 0.25}], None):
        for envs in (native, dummy):
            envs.seed(4)
            envs.set_options(options)
        np.testing.assert_array_equal(native.reset(), dummy.reset())
        np.testing.assert_array_equal(native.reset(), dummy.reset())  # drawn again
    with pytest.raises(ParameterError, match="unknown reset option 'velocity'; known: speed, bandwidth"):
        native.set_options([{}, {"velocity": 1.0}, {}])
    with pytest.raises(ParameterError, match="options must be one mapping or 3 of them, got 2"):
        native.set_options([{}, {}])
    native.set_options({"speed": 99.0})
    with pytest.raises(ParameterError, match=r"option 'speed' must lie within \[0.7, 2\], got"):
        native.reset()


def recorded(**options):
    return make_vec_env(
        roadgym.ENVIRONMENT_ID,
        n_envs=3,
        seed=6,
        env_kwargs={"max_episode_steps": 4, **ENVIRONMENT},
        wrapper_class=wrappers.learning,
        **options,
    )


@pytest.mark.parametrize("recipe", [{"training_reward": "cost"}, {"features": None, "frame_stack": 2, "damping_levels": 4}])
def test_the_batch_stands_in_for_the_environments_of_make_vec_env(recipe):
    native = recorded(vec_env_cls=QuarterCarVecEnv.from_functions, wrapper_kwargs=recipe)
    dummy = recorded(wrapper_kwargs=recipe)
    assert isinstance(native, QuarterCarVecEnv)
    assert native.action_space == dummy.action_space
    np.testing.assert_array_equal(native.reset(), dummy.reset())
    for k in range(6):
        action = np.full(3, k % 4) if "damping_levels" in recipe else np.full((3, 1), 0.1 * k, np.float32)
        steps = native.step(action), dummy.step(action)
        # sums over a batch are summed in another order than over one: features differ in their last digit
        np.testing.assert_allclose(steps[0][0], steps[1][0], rtol=1e-6, atol=1e-6)
        np.testing.assert_array_equal(steps[0][2], steps[1][2])
        if recipe.get("training_reward") == "cost":  # the other one depends on what the whole batch paid
            np.testing.assert_array_equal(steps[0][1], steps[1][1])
        for infos in zip(steps[0][3], steps[1][3], strict=True):
            for name in roadgym.MEAN_SQUARES:
                assert infos[0][name] == infos[1][name]
            assert ("episode" in infos[0]) == ("episode" in infos[1]) == (k == 3)
            if k == 3:
                assert infos[0]["episode"]["r"] == pytest.approx(infos[1]["episode"]["r"], rel=1e-5)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: gymnasium.make(roadgym.ENVIRONMENT_ID), "env must be gymnasium.make('roadgym/QuarterCar-v0') within"),
        (lambda: wrappers.learning(QuarterCarEnv()), "env must be gymnasium.make('roadgym/QuarterCar-v0') within"),
        (lambda: TransformReward(gymnasium.make(roadgym.ENVIRONMENT_ID), abs), "the batch has no TransformReward; wrap the"),
    ],
)
def test_what_is_no_batch_of_ours_is_refused(make, message):
    with pytest.raises(ParameterError, match=re.escape(message)):
        QuarterCarVecEnv.from_functions([make])


def test_no_environments_make_no_batch():
    with pytest.raises(ParameterError, match="functions must be at least one"):
        QuarterCarVecEnv.from_functions([])


def test_environments_that_differ_make_no_batch():
    functions = [lambda v=v: wrappers.learning(gymnasium.make(roadgym.ENVIRONMENT_ID, speed=v)) for v in (1.0, 1.0, 2.0)]
    with pytest.raises(ParameterError, match=r"environments must be alike, got .* as number 2"):
        QuarterCarVecEnv.from_functions(functions)


def test_infos_are_those_of_the_environment_for_a_monitor_too():
    native = QuarterCarVecEnv(3, max_episode_steps=2, environment=ENVIRONMENT)
    with pytest.warns(UserWarning, match="already wrapped with a `Monitor`"):  # as the batch's own infos have an "episode"
        envs = VecMonitor(native, info_keywords=("displacement", "damping"))
    batch = gymnasium.make_vec(roadgym.ENVIRONMENT_ID, 3, **ENVIRONMENT)
    envs.seed(2)
    envs.reset(), batch.reset(seed=2)
    for _ in range(2):
        *_, infos = envs.step(np.zeros((3, 1), np.float32))
        expected = batch.step(damping_from_action(np.zeros((3, 1)), (0.05, 1.0)))[4]
        names = [name for name in expected if name[0] != "_"]
        for i, info in enumerate(infos):
            assert {name: info[name] for name in names} == {name: expected[name][i] for name in names}
    assert [info["episode"]["displacement"] for info in infos] == expected["displacement"].tolist()


def test_infos_are_plain_dictionaries_of_plain_numbers():
    envs = QuarterCarVecEnv(3, environment=ENVIRONMENT)
    envs.reset()
    for info in envs.step(np.zeros((3, 1), np.float32))[3]:
        assert type(info) is dict
        assert json.loads(json.dumps(info)) == info


def test_infos_of_a_reset_are_those_of_the_environment():
    envs = QuarterCarVecEnv(2, environment=ENVIRONMENT)
    envs.seed(3)
    envs.reset()
    expected = gymnasium.make_vec(roadgym.ENVIRONMENT_ID, 2, **ENVIRONMENT).reset(seed=3)[1]
    for i, info in enumerate(envs.reset_infos):
        assert info == {name: value[i] for name, value in expected.items() if name[0] != "_"}
        assert info["speed"] > 0


def test_films_of_stable_baselines3_show_every_environment(tmp_path):
    native = recorded(vec_env_cls=QuarterCarVecEnv.from_functions)  # make_vec_env asks for pictures by itself
    assert native.render_mode == "rgb_array"
    recorder = VecVideoRecorder(native, str(tmp_path), lambda step: step == 2, video_length=3)
    recorder.reset()
    for _ in range(7):
        recorder.step(np.zeros((3, 1), np.float32))
    assert [file.suffix for file in tmp_path.iterdir()] == [".mp4"]
    single = recorded()  # beside each other: after the reset of an episode the same pictures as one by one
    native.seed(6), single.seed(6)
    native.reset(), single.reset()
    for _ in range(3):
        for envs in (native, single):
            envs.step(np.zeros((3, 1), np.float32))
    for picture, expected in zip(native.get_images(), single.get_images(), strict=True):
        np.testing.assert_array_equal(picture, expected)


def test_actions_of_the_adapter_map_onto_the_range():
    assert damping_from_action(np.array([-1, 0, 1]), (0.05, 1.0)) == pytest.approx([0.05, 0.525, 1.0])


def test_adapter_answers_stable_baselines3():
    envs = QuarterCarVecEnv(3, environment=ENVIRONMENT)
    assert len(envs.get_attr("task")) == 3
    assert envs.get_attr("render_mode") == [None] * 3
    with pytest.raises(AttributeError, match="share their parameters"):
        envs.set_attr("task", None)
