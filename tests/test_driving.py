"""``roadgym drive``: films and windows of controllers over the same road."""

import itertools
import shutil
import subprocess
import sys

import numpy as np
import pygame
import pytest
from PIL import Image

import agents
import roadgym.rendering as picture
from agents import driving
from agents.cli import main
from agents.controllers import ConstantDamping, make_controller
from agents.errors import AgentError
from roadgym import ParameterError
from roadgym.task import make_task

ENVIRONMENT = {"road": "multiplicative", "speed": (0.5, 3.2), "bandwidth": (0.05, 0.5)}
POINT = {"speed": 1.5, "bandwidth": 0.1}
GROUND = np.s_[picture.ROAD_ZERO - 70 : picture.GROUND_BOTTOM, picture.LEFT : picture.NOW - 80]
TITLE = np.s_[10:38, picture.LEFT : picture.NOW]
HYPERPARAMETERS = {"n_envs": 2, "n_steps": 8, "batch_size": 16, "n_epochs": 1, "policy_kwargs": {"net_arch": [4]}}


@pytest.fixture(autouse=True)
def no_window(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield
    pygame.display.quit()


@pytest.fixture(scope="module")
def agent_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("driving") / "ppo"
    agents.train(folder, environment=ENVIRONMENT, hyperparameters=HYPERPARAMETERS, timesteps=16)
    return folder


def drivers(*names, environment=ENVIRONMENT):
    task = make_task(**environment)
    return [(name, make_controller(name, task)) for name in names]


def film(*names, frames, seed=0):
    return list(itertools.islice(driving.frames(drivers(*names), ENVIRONMENT, seed=seed, options=POINT), frames))


def halves(frame):
    return frame[:, : picture.WIDTH], frame[:, picture.WIDTH :]


class Watcher:
    """Drives softly, and does something after a number of steps."""

    def __init__(self, steps, what):
        self.steps, self.what = steps, what

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        self.steps -= 1
        if self.steps == 0:
            self.what()
        return np.full((len(observation), 1), 0.3, np.float32), state


def interrupt():
    raise KeyboardInterrupt


def test_two_drivers_meet_the_same_road_under_their_names():
    pictures = film("skyhook", "d_min", frames=80)
    assert pictures[0].shape == (picture.HEIGHT, 2 * picture.WIDTH, 3)
    for frame in pictures[20::20]:
        left, right = halves(frame)
        np.testing.assert_array_equal(left[GROUND], right[GROUND])
        assert len(np.unique(left[GROUND].reshape(-1, 3), axis=0)) > 5  # there is a road
        assert np.any(left[TITLE] != right[TITLE])
    left, right = halves(pictures[-1])
    assert np.any(
        left[: picture.ROAD_ZERO - 80, picture.NOW - 80 : picture.NOW + 80] != right[: picture.ROAD_ZERO - 80, 484:644]
    )


def test_neighbours_have_the_same_scale():
    # in resonance the soft one alone makes its picture zoom out
    resonance = {"road": "harmonic", "speed": 1.0}
    pair = drivers("d_min", "d_max", environment=resonance)
    *_, frame = itertools.islice(driving.frames(pair, resonance, seed=0), 120)
    left, right = halves(frame)
    np.testing.assert_array_equal(left[GROUND], right[GROUND])


def test_equal_drivers_make_equal_pictures_and_another_seed_another_road():
    left, right = halves(film("skyhook", "skyhook", frames=30)[-1])
    np.testing.assert_array_equal(left[:, 1:], right[:, 1:])
    assert np.any(film("skyhook", frames=30, seed=1)[-1][GROUND] != left[GROUND])


def test_mp4(tmp_path, capsys):
    from imageio_ffmpeg import count_frames_and_secs, get_ffmpeg_exe

    file = tmp_path / "drive.mp4"
    options = ["--controller", "skyhook", "--versus", "analytic_optimum", "--speed", "1.5", "--seconds", "0.5"]
    assert main(["drive", *options, "--output", str(file)]) == 0
    assert capsys.readouterr().out == f"{file}\n"
    assert count_frames_and_secs(file) == (30, pytest.approx(0.5))
    command = [get_ffmpeg_exe(), "-v", "error", "-i", file, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    decoded = np.frombuffer(subprocess.run(command, capture_output=True, check=True).stdout, np.uint8).reshape(30, 640, 1600, 3)
    left, right = halves(decoded[-1].astype(int))
    assert np.abs(left[GROUND] - right[GROUND]).max() < 60  # compressed
    assert [path.name for path in tmp_path.iterdir()] == ["drive.mp4"]


def test_gif_runs_as_fast_as_the_film(tmp_path):
    file = tmp_path / "drive.GIF"
    assert main(["drive", "--controller", "d_max", "--road", "gaussian", "--seconds", "0.5", "--output", str(file)]) == 0
    with Image.open(file) as image:
        assert image.size == (800, 640)
        assert image.n_frames == 10
        assert image.info["duration"] == 50
        image.seek(9)
        frame = np.asarray(image.convert("RGB")).astype(int)
    assert tuple(frame[2, 2]) == picture.PAPER
    assert (np.abs(frame - picture.FIRM).max(axis=-1) <= 3).sum() > 1000  # the damper
    assert (np.abs(frame - picture.GROUND).max(axis=-1) <= 3).sum() > 1000


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--output", "drive.avi"], "output must end in .mp4 or .gif, got 'drive.avi'"),
        (["--output", "drive"], "output must end in .mp4 or .gif"),
        (["--output", "nowhere/drive.mp4"], "no such folder"),
        (["--output", "folder.gif"], "it is a folder"),
        (["--seconds", "0", "--output", "a.gif"], "seconds must be positive"),
        (["--seed", "-1", "--output", "a.gif"], "seed must be at least 0"),
        (["--speed", "9", "--output", "a.gif"], r"'speed' must lie within [0.5, 3.2], got 9"),
        (["--versus", "nobody", "--output", "a.gif"], "versus must be the folder of an agent or one of analytic_optimum"),
        (["--road", "first_order", "--output", "a.gif"], "needs the signal 'slope'"),
    ],
)
def test_wrong_arguments_cost_one_line(options, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.gif").mkdir()
    assert main(["drive", "--controller", "skyhook", *options]) == 2
    error = capsys.readouterr().err
    assert error.startswith("roadgym drive: ")
    assert message in error
    assert error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["folder.gif"]


def test_agents_drive_on_the_roads_they_know(agent_folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(agent_folder, "ppo")
    assert main(["drive", "--agent", "ppo", "--versus", "ppo", "--seconds", "0.1", "--output", "both.gif"]) == 0
    assert main(["drive", "--controller", "skyhook", "--versus", "ppo", "--seconds", "0.1", "--output", "rival.gif"]) == 0
    with Image.open("rival.gif") as image:
        assert image.size == (1600, 640)
    assert main(["drive", "--agent", "ppo", "--road", "gaussian", "--output", "a.gif"]) == 2
    assert "--road cannot be given with --agent" in capsys.readouterr().err
    assert main(["drive", "--agent", "ppx", "--output", "a.gif"]) == 2
    assert "no agent in 'ppx'" in capsys.readouterr().err
    agent = agents.load("ppo")
    with pytest.raises(ParameterError, match="the agent 'ppo' cannot drive here: its damping_range is"):
        driving.make_driver("ppo", agent, make_task(**ENVIRONMENT, damping_range=(0.1, 1.0)))


def test_each_driver_sees_its_own_signals():
    """As an agent that was trained on a part of the state drives beside a controller that needs all of it."""
    seen = []

    class Sensors(ConstantDamping):
        def damping(self, signals):
            seen.append(tuple(signals))
            return 0.3

    sensors = Sensors(make_task(**ENVIRONMENT, observation=["travel", "velocity"], observe_operating_point=False), 0.3)
    pair = [("sensors", sensors), *drivers("skyhook")]
    hidden = {**ENVIRONMENT, "observation": ["level"], "observe_operating_point": False}  # of neither
    first, *_, last = itertools.islice(driving.frames(pair, hidden, seed=1, options=POINT), 4)
    assert first.shape == last.shape == (640, 1600, 3)
    assert set(seen) == {("travel", "velocity")}


def test_window_shows_both_until_it_is_closed():
    sizes = []

    def close():
        sizes.append(pygame.display.get_surface().get_size())
        pygame.event.post(pygame.event.Event(pygame.QUIT))

    pair = [("watcher", Watcher(7, close)), *drivers("skyhook")]
    assert driving.drive(pair, environment=ENVIRONMENT) == 8
    assert sizes[0][0] / sizes[0][1] == pytest.approx(1600 / 640, rel=0.01)
    assert not pygame.display.get_init()
    assert driving.drive(drivers("skyhook"), environment=ENVIRONMENT, seconds=0.2) == 12


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have a display always")
def test_without_display_one_line_tells_the_remedy(monkeypatch, capsys):
    for name in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert main(["drive", "--controller", "skyhook"]) == 2
    message = "roadgym drive: there is no display for a window: write a film instead, with --output drive.mp4\n"
    assert capsys.readouterr().err == message
    # a display that cannot be reached
    monkeypatch.setenv("DISPLAY", ":873")
    with pytest.raises(AgentError, match="there is no display"):
        driving.drive(drivers("skyhook"), environment=ENVIRONMENT)
    assert not pygame.display.get_init()


@pytest.mark.parametrize("ending", driving.WRITERS)
def test_interrupted_films_leave_what_was_there(ending, tmp_path):
    file = tmp_path / f"drive{ending}"
    file.write_text("before")
    with pytest.raises(KeyboardInterrupt):
        driving.drive([("watcher", Watcher(9, interrupt))], environment=ENVIRONMENT, output=file, seconds=1)
    assert [path.name for path in tmp_path.iterdir()] == [file.name]
    assert file.read_text() == "before"


def test_interrupted_windows_close():
    with pytest.raises(KeyboardInterrupt):
        driving.drive([("watcher", Watcher(3, interrupt))], environment=ENVIRONMENT)
    assert not pygame.display.get_init()


def test_films_that_cannot_be_written_are_told(tmp_path, monkeypatch):
    def full(path, film, total):
        path.write_bytes(next(film).tobytes()[:100])
        raise OSError(28, "No space left on device")

    monkeypatch.setitem(driving.WRITERS, ".gif", full)
    with pytest.raises(AgentError, match=r"cannot write '.*drive.gif': No space left on device"):
        driving.drive(drivers("skyhook"), environment=ENVIRONMENT, output=tmp_path / "drive.gif")
    assert list(tmp_path.iterdir()) == []
    # frames that the encoder lost are noticed
    with pytest.raises(AgentError, match="the encoder lost frames"):
        driving.write(tmp_path / "drive.mp4", iter(film("skyhook", frames=4)), 5)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("package", ["pygame", "imageio_ffmpeg"])
def test_missing_packages_are_named(package, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, "roadgym.rendering")
    monkeypatch.delattr(sys.modules["roadgym"], "rendering")
    assert main(["drive", "--controller", "skyhook", "--seconds", "0.1", "--output", str(tmp_path / "a.mp4")]) == 2
    error = capsys.readouterr().err
    assert f"the package {package} is not installed, which the extra render brings" in error
    assert list(tmp_path.iterdir()) == []


def test_progress_of_a_film(tmp_path):
    told = []
    driving.drive(
        drivers("d_min"),
        environment=ENVIRONMENT,
        output=tmp_path / "a.gif",
        seconds=0.5,
        report=lambda *what: told.append(what),
    )
    assert told == [("filming a.gif", done, 30) for done in (10, 20, 30)]


def test_long_names_fit_the_title():
    long = "runs/a-study-of-everything/with-many-seeds/seed-12/agent"
    (frame,) = itertools.islice(driving.frames([(long, drivers("d_min")[0][1])], ENVIRONMENT, seed=0, options=POINT), 1)
    _, columns = np.nonzero((frame[10:38, : picture.WIDTH - 130] != picture.PAPER).any(axis=-1))
    assert picture.NOW - 150 < columns.max() < picture.COLUMN - 30
