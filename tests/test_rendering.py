"""The picture of a drive, as somebody sees it who looks at it."""

import copy
import itertools
import pickle
import subprocess
import sys
import time
import warnings

import gymnasium
import numpy as np
import pygame
import pytest
from gymnasium.error import DependencyNotInstalled, ResetNeeded
from gymnasium.utils.env_checker import check_env
from plants import EVERY_PLANT, plant_name

import roadgym
from roadgym import ParameterError, rendering
from roadgym.env import QuarterCarEnv
from roadgym.gauges import PIXELS_PER_RADIAN
from roadgym.rendering import BODY, GROUND, LEFT, NOW, ROAD_REACH, ROAD_ZERO
from roadgym.roads import make_road

ID = roadgym.ENVIRONMENT_ID
every_plant = pytest.mark.parametrize("plant", EVERY_PLANT, ids=plant_name)
DAMPER = NOW + 30  # a column through the middle of the damper


@pytest.fixture(autouse=True)
def no_window(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield
    pygame.display.quit()


def make(mode="rgb_array", **parameters):
    return QuarterCarEnv(render_mode=mode, **parameters)


def act(damping):
    return np.array([damping], np.float32)


def where(picture, colour):
    """Rows and columns of the pixels of one colour, to the rounding of the smoothing."""
    return np.nonzero((np.abs(picture.astype(int) - colour) <= 2).all(axis=-1))


def body_row(picture):
    """The middle of the body, which nothing covers at its right end."""
    rows, columns = where(picture[:, : NOW + 80], BODY)
    ends = rows[(columns > NOW + 40) & (columns < NOW + 48) & (rows < ROAD_ZERO - 30)]
    return (ends.min() + ends.max()) / 2


def ground_row(picture, column):
    """The highest row of the ground in a column."""
    return where(picture[:, column], GROUND)[0].min()


@every_plant
def test_heights_in_the_picture_are_those_of_the_plant(plant):
    # no signal of the car is observed: the picture shows the plant
    env = make(**plant, speed=0.8, observation=["travel"])
    env.reset(seed=2)
    rest = body_row(env.render())
    rows, pictures = [], []
    for step in range(60):
        _, _, _, _, info = env.step(act(0.3))
        if step % 6 == 5:
            pictures.append(env.render())
            displacement, level, _ = env.history.trace[-1]
            scale = ROAD_REACH / env.history.limit
            rows.append((rest - body_row(pictures[-1]), scale * displacement))
            rows.append((ROAD_ZERO - ground_row(pictures[-1], NOW - 1), scale * level))
    assert pictures[0].shape == (640, 800, 3)
    assert pictures[0].dtype == np.uint8
    assert all(np.any(a != b) for a, b in itertools.pairwise(pictures))
    seen, expected = np.array(rows).T.reshape(2, -1, 2)
    assert np.abs(seen - expected)[:, 0].max() <= 1.0  # pixels; body
    # road: its line is some pixels high where it is steep
    assert np.abs(seen - expected)[:, 1].max() <= (8.0 if (make_road(plant["road"]).slope_variance or 9) > 2 else 4.0)
    assert np.ptp(expected, axis=0).min() > 12  # there was something to see
    squares = np.array([info["displacement"], info["travel"]]) / env.task.road.variance
    assert 0 < squares.min() < 50


def test_picture_shows_what_the_observation_says():
    env = make(road="gaussian", speed=1.5)
    env.reset(seed=3)
    for _ in range(40):
        observation = env.step(act(0.2))[0]
    assert env.history.trace[-1, :2] == pytest.approx(observation[[0, 2]])
    assert env.history.path[-1] == pytest.approx((40 * 0.2 * 1.5, observation[2]), rel=1e-5)


def test_road_moves_as_far_as_the_car():
    ratio, steps = 0.9, 60
    env = make(road="multiplicative", speed=ratio)
    env.reset(seed=5)
    levels = [env.step(act(0.3))[0][2] for _ in range(steps)]
    picture = env.render()
    scale = ROAD_REACH / env.history.limit
    for ago in range(5, 45):
        column = NOW - round(ago * 0.2 * ratio * PIXELS_PER_RADIAN)
        assert ground_row(picture, column) == pytest.approx(ROAD_ZERO - scale * levels[-1 - ago], abs=4), ago
    # nothing is drawn of a road that is not known yet
    assert len(where(picture[:, NOW + 1 :], GROUND)[0]) == 0
    env.reset()
    assert len(where(env.render(), GROUND)[0]) == 0


@pytest.mark.parametrize("noise", ["white", "high_pass", "low_pass"])
def test_distance_of_a_car_whose_speed_is_noise(noise):
    # a harmonic road is a known function of the distance
    env = make(road="harmonic", speed=0.3, speed_noise={"kind": noise, "intensity": 0.8})
    level, slope = env.reset(seed=4)[0][2:4]
    phase = np.arctan2(-slope, level)
    for _ in range(200):
        observation = env.step(act(0.3))[0]
    angle, level = np.array(env.history.path).T
    np.testing.assert_allclose(level, np.sqrt(2) * np.cos(phase + angle), atol=1e-3)
    assert np.float32(level[-1]) == observation[2]
    assert np.diff(angle).min() < 0 or noise == "low_pass"  # it went back now and then
    # as far as it has been, the road is drawn, also ahead of the wheel
    picture, here = env.render(), angle[-1]
    for column in range(max(LEFT, NOW - 250), NOW - 30, 10):
        expected = np.sqrt(2) * np.cos(phase + here + (column + 0.5 - NOW) / PIXELS_PER_RADIAN)
        assert ground_row(picture, column) == pytest.approx(ROAD_ZERO - expected * ROAD_REACH / env.history.limit, abs=4)


def test_a_crawling_car_keeps_its_road():
    env = make(road="harmonic", speed=0.02)
    env.reset(seed=0)
    for _ in range(400):
        env.step(act(0.3))
    _, columns = where(env.render(), GROUND)
    assert columns.min() == pytest.approx(NOW - 400 * 0.2 * 0.02 * PIXELS_PER_RADIAN, abs=2)
    assert len(env.history.path) < 400


def test_damper_has_the_colour_of_its_damping_on_the_scale():
    env = make(damping_range=(0.1, 0.9))
    env.reset(seed=0)
    colours = []
    for damping in (0.1, 0.3, 0.5, 0.7, 0.9):
        env.step(act(damping))
        picture = env.render()
        foot = where(picture[:, NOW - 40], rendering.INK)[0].max()  # the bridge under the damper
        colours.append(picture[foot - 30, DAMPER])
        row = rendering.BAR_TOP + (0.9 - damping) / 0.8 * (rendering.BAR_HEIGHT - 1)
        np.testing.assert_allclose(picture[round(row), rendering.COLUMN + 5], colours[-1], atol=2)
    np.testing.assert_allclose(colours[0], rendering.SOFT, atol=2)
    np.testing.assert_allclose(colours[-1], rendering.FIRM, atol=2)
    greens = [int(colour[1]) for colour in colours]
    assert greens == sorted(greens, reverse=True)
    assert len(set(greens)) == 5


def test_body_stays_in_the_picture_in_resonance():
    env = make(road="harmonic", speed=1.0)
    env.reset(seed=1)
    whole = len(where(env.render()[:460], BODY)[0])
    peak = 0.0
    for step in range(300):
        peak = max(peak, abs(env.step(act(0.05))[0][0]))
        if step % 20 == 0:
            assert len(where(env.render()[:460], BODY)[0]) > 0.97 * whole
    assert peak > 9  # three times what the scale shows by itself
    assert env.history.limit == pytest.approx(peak, rel=1e-6)


def test_traces_and_cost_are_of_this_episode():
    env = make()
    env.reset(seed=0)
    rewards = [env.step(act(0.3))[1] for _ in range(300)]
    assert env.history.cost == pytest.approx(-sum(rewards))
    assert env.history.trace[:, 2] == pytest.approx(rewards[-rendering.STEPS_SHOWN - 1 :])
    env.reset()
    assert env.history.steps == env.history.cost == 0


def test_drawing_does_not_change_the_drive():
    plain, drawn = QuarterCarEnv(speed_noise="low_pass"), make(speed_noise="low_pass")
    for env in (plain, drawn):
        env.reset(seed=8)
    for damping in np.linspace(0.05, 1, 10):
        expected, found = (env.step(act(damping)) for env in (plain, drawn))
        drawn.render()
        np.testing.assert_array_equal(found[0], expected[0])
        assert found[1:] == expected[1:]


def test_drawing_is_much_faster_than_the_film():
    env = make(speed=3.0)
    env.reset(seed=0)
    times = []
    for _ in range(60):
        env.step(act(0.3))
        begin = time.perf_counter()
        env.render()
        times.append(time.perf_counter() - begin)
    assert min(times) < 0.75 / env.metadata["render_fps"]  # the least, since other work disturbs the others


def test_shared_scales():
    calm, wild = make(road="harmonic", speed=0.2), make(road="harmonic", speed=1.0)
    for env in (calm, wild):
        env.reset(seed=1)
        for _ in range(100):
            env.step(act(0.05))
    assert calm.history.limit < wild.history.limit
    rendering.share_scales([calm.history, wild.history])
    assert calm.history.limit == wild.history.limit
    assert calm.history.reward_limit == wild.history.reward_limit


@pytest.mark.parametrize("mode", ["human", "rgb_array"])
def test_gymnasium_finds_no_fault(mode):
    env = gymnasium.make(ID, render_mode=mode)
    with warnings.catch_warnings():
        # the action is D itself, by design; agents that need [-1, 1] rescale it
        warnings.filterwarnings("ignore", message=".*recommend using a symmetric and normalized space.*")
        check_env(env.unwrapped)
    env.close()


def test_window_opens_by_itself_keeps_its_pace_and_closes():
    env = gymnasium.make(ID, render_mode="human")
    assert not pygame.display.get_init()
    env.reset(seed=0)
    begin = time.perf_counter()
    for _ in range(30):
        env.step(act(0.3))
    assert time.perf_counter() - begin > 29 / 60 - 0.03
    shown = pygame.surfarray.array3d(pygame.display.get_surface())
    assert len(where(shown, BODY)[0]) > 3000
    assert env.render() is None
    env.close()
    assert not pygame.display.get_init()
    env.close()


def test_modes():
    env = gymnasium.make(ID).unwrapped
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render method without specifying any render mode"):
        assert env.render() is None
    with pytest.raises(ParameterError, match="unknown render_mode 'ansi'; known: human, rgb_array"):
        QuarterCarEnv(render_mode="ansi")
    with pytest.raises(ResetNeeded):
        make().render()
    assert QuarterCarEnv.metadata["render_fps"] == rendering.FRAMES_PER_SECOND == 60


def test_gymnasiums_own_batch_draws():
    envs = gymnasium.make_vec(ID, num_envs=2, vectorization_mode="sync", render_mode="rgb_array")
    envs.reset(seed=0)
    first, second = envs.render()
    assert first.shape == second.shape == (640, 800, 3)
    assert np.any(first != second)


def test_recorded_video(tmp_path):
    from imageio_ffmpeg import count_frames_and_secs

    env = gymnasium.wrappers.RecordVideo(gymnasium.make(ID, render_mode="rgb_array"), str(tmp_path / "video"))
    env.reset(seed=0)
    for _ in range(19):
        env.step(act(0.3))
    env.close()
    (video,) = (tmp_path / "video").glob("*.mp4")
    assert count_frames_and_secs(video) == (20, pytest.approx(1 / 3, abs=0.02))


def test_human_rendering_wrapper():
    env = gymnasium.wrappers.HumanRendering(gymnasium.make(ID, render_mode="rgb_array"))
    env.reset(seed=0)
    env.step(act(0.3))
    assert pygame.display.get_surface().get_size() == (800, 640)
    env.close()


@pytest.mark.parametrize("mode", ["human", "rgb_array"])
def test_copies_draw_alike(mode):
    env = gymnasium.make(ID, render_mode=mode)
    env.reset(seed=5)
    env.step(act(0.3))
    env.render()
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    expected, picture = env.step(act(0.9)), env.render()
    for other in copies:
        found = other.step(act(0.9))
        np.testing.assert_array_equal(found[0], expected[0])
        assert found[1] == expected[1]
        np.testing.assert_array_equal(other.render(), picture)
        other.close()
    env.close()


def test_others_may_quit_pygame():
    env = make()
    env.reset(seed=0)
    picture = env.render()
    pygame.quit()
    np.testing.assert_array_equal(env.render(), picture)


def test_pictures_of_a_reset_are_kept():
    env = make()
    env.reset(seed=0)
    first = env.render()
    before = first.copy()
    env.step(act(1.0))
    env.render()
    np.testing.assert_array_equal(first, before)


def test_text_can_be_written_without_the_typeface(monkeypatch):
    env = make()
    env.reset(seed=0)
    usual = env.render()

    def missing(name):
        raise rendering.importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(rendering.importlib.metadata, "distribution", missing)
    other = copy.deepcopy(env)
    assert np.any(other.render() != usual)
    assert len(where(other.render(), rendering.INK)[0]) > 1000


def test_without_pygame_one_line_tells_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    monkeypatch.delitem(sys.modules, "roadgym.rendering")
    monkeypatch.delattr(roadgym, "rendering")
    QuarterCarEnv().reset(seed=0)
    with pytest.raises(DependencyNotInstalled, match=r"pip install -e '.*\[render\]'"):
        gymnasium.make(ID, render_mode="rgb_array")


def test_who_draws_nothing_loads_no_pygame():
    code = (
        "import gymnasium as g, sys; e = g.make('roadgym:roadgym/QuarterCar-v0'); e.reset(seed=0); "
        "e.step(e.action_space.sample()); e.close(); print([m for m in ('pygame', 'roadgym.rendering') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"
