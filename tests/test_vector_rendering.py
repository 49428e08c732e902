"""Pictures of the batch: those of the single environments, and Gymnasium's wrappers that show and film them."""

import copy
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.wrappers import vector as vector_wrappers

import roadgym

ID = roadgym.ENVIRONMENT_ID
RANGES = {"speed": (0.7, 2.0)}


def batch(n=3, **options):
    return gymnasium.make_vec(ID, n, render_mode="rgb_array", **RANGES, **options)


@pytest.mark.parametrize("mode", ["NEXT_STEP", "SAME_STEP", "DISABLED"])
def test_pictures_are_those_of_the_single_environments(mode):
    limit = 4
    envs = batch(max_episode_steps=limit, autoreset_mode=mode)
    singles = [gymnasium.make(ID, render_mode="rgb_array", max_episode_steps=limit, **RANGES) for _ in range(3)]
    envs.reset(seed=5)
    for i, env in enumerate(singles):
        env.reset(seed=5 + i)
    actions = np.random.default_rng(1).uniform(0.05, 1, (6, 3, 1)).astype(np.float32)
    for action in actions:
        truncated = envs.step(action)[3]
        for env, each in zip(singles, action, strict=True):
            env.step(each)
        if mode != "SAME_STEP" or not truncated.any():
            for picture, env in zip(envs.render(), singles, strict=True):
                np.testing.assert_array_equal(picture, env.render())
        if truncated.any():
            for env in singles:
                env.reset()
            if mode == "NEXT_STEP":
                envs.step(action)
            if mode == "DISABLED":
                envs.reset(options={"reset_mask": truncated})
            for picture, env in zip(envs.render(), singles, strict=True):
                np.testing.assert_array_equal(picture, env.render())


def test_a_batch_without_pictures_says_so():
    with pytest.warns(UserWarning, match="render was called without a render_mode"):
        assert gymnasium.make_vec(ID, 2).render() is None
    with pytest.raises(ResetNeeded, match="call reset before render"):
        batch().render()


def test_copies_draw_for_themselves():
    envs = batch()
    envs.reset(seed=1)
    before = envs.render()
    for again in (copy.deepcopy(envs), pickle.loads(pickle.dumps(envs))):
        for action in (0.2, 0.9):
            again.step(np.full((3, 1), action, np.float32))
        assert not np.array_equal(again.render()[0], before[0])
    np.testing.assert_array_equal(envs.render(), before)


def test_a_window_shows_the_batch(monkeypatch):
    pytest.importorskip("cv2")  # which that wrapper needs
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    envs = vector_wrappers.HumanRendering(batch(2))
    envs.reset(seed=1)
    envs.step(np.full((2, 1), 0.3, np.float32))
    assert envs.window is not None
    envs.close()


def test_a_film_shows_the_batch(tmp_path):
    pytest.importorskip("moviepy")
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    if not hasattr(vector_wrappers, "RecordVideo"):
        pytest.skip("Gymnasium 1.1 films no batch")
    driven, folder = batch(2, max_episode_steps=5), str(tmp_path / "film")
    envs = vector_wrappers.RecordVideo(driven, folder, episode_trigger=lambda episode: episode == 0)
    envs.reset(seed=1)
    for _ in range(7):
        envs.step(np.full((2, 1), 0.3, np.float32))
    envs.close()
    (file,) = (tmp_path / "film").glob("*.mp4")
    frames, _ = imageio_ffmpeg.count_frames_and_secs(str(file))
    assert frames in (5, 6)  # the first observation and five steps; moviepy may lose the last frame in rounding
