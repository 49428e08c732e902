"""Driving to look at: one controller, or two side by side over the very same road, in a window or as a film."""

from __future__ import annotations

import itertools
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from roadgym.env import QuarterCarEnv
from roadgym.files import check_file, whole_file
from roadgym.installation import needs
from roadgym.parameters import ParameterError, positive, whole
from roadgym.task import Task, make_task

from . import pretrained
from .agent import Agent, load
from .controllers import CONTROLLERS, make_controller
from .errors import AgentError
from .evaluation import Predictor, answers, observed_by, through_sensors
from .names import printable, shortened
from .records import Purpose, stream_seed

Frame = npt.NDArray[np.uint8]
Report = Callable[[str, int, int], None]

FRAMES_PER_SECOND: int = QuarterCarEnv.metadata["render_fps"]
GIF_SHARE = 3  # a GIF counts time in 1/100 s: every third of 60 frames a second is 20 of them, 5/100 s each
SECONDS = 10.0  # of a film, unless told otherwise


def check_output(output: str | Path) -> Path:
    """``output`` as the path of a film that can be written.

    Raises:
        ParameterError: its ending is none of `WRITERS`.
        AgentError: its folder does not exist or cannot be written, or it is a folder itself.
    """
    path = Path(output)
    if path.suffix.lower() not in WRITERS:
        raise ParameterError(f"output must end in {' or '.join(WRITERS)}, got {str(output)!r}")
    if path.is_dir() or not path.parent.is_dir():
        raise AgentError(f"cannot write {str(path)!r}: {'it is a folder' if path.is_dir() else 'no such folder'}")
    try:
        check_file(path)
    except OSError as error:
        raise AgentError(f"cannot write {str(path)!r}: {error.strerror or error}") from None
    return path


def find_rival(name: str) -> Agent | None:
    """The agent in the folder ``name``, or that of this name that is shipped, or None where it is a controller's name.

    Raises:
        ParameterError: it is neither.
        AgentError: the folder holds no agent.
    """
    if name in CONTROLLERS:
        return None
    if not Path(name).is_dir() and pretrained.find(name) is None:
        raise ParameterError(f"versus must be the folder of an agent or one of {', '.join(CONTROLLERS)}, got {name!r}")
    return load(name)


def make_driver(name: str, agent: Agent | None, task: Task) -> Predictor:
    """The agent, if it can drive on ``task``, or the controller of that name.

    Raises:
        ParameterError: the agent was trained to answer in another range; an unknown controller.
    """
    if agent is None:
        return make_controller(name, task)
    own, here = agent.task.damping_range, task.damping_range
    if own != here:
        raise ParameterError(f"the agent {name!r} cannot drive here: its damping_range is {own}, here it is {here}")
    return agent


def frames(
    drivers: Sequence[tuple[str, Predictor]],
    environment: Mapping[str, Any],
    *,
    seed: int,
    options: dict[str, Any] | None = None,
    every: int = 1,
) -> Iterator[Frame]:
    """Pictures side by side, one of each driver, without end: of the start, and as they drive on; scales are shared.

    All drive the same road, that of ``seed``, from the same start.

    Args:
        drivers: title and driver.
        environment: parameters of `roadgym.env.QuarterCarEnv`.
        seed: fixes the road; no training or evaluation meets it.
        options: of the reset.
        every: control intervals from one picture to the next.
    """
    from roadgym.rendering import share_scales

    cars: list[tuple[QuarterCarEnv, Callable[..., Any], list[Any]]] = []
    task = make_task(**environment)
    for title, driver in drivers:
        seen = {"observation": list(observed_by(driver, task)), "observe_operating_point": False}  # each its own signals
        env = QuarterCarEnv(render_mode="rgb_array", **{**through_sensors(driver, environment), **seen})
        env.render_title, env.render_every = shortened(printable(title)), every
        observation, _ = env.reset(seed=stream_seed(seed, Purpose.FILM), options=options)
        cars.append((env, answers(driver, env.task), [observation, None]))
    for step in itertools.count():
        share_scales([env.history for env, _, _ in cars if env.history])
        if step % every == 0:
            pictures = [np.asarray(env.render()) for env, _, _ in cars]
            for picture in pictures[1:]:
                picture[:, 0] = 200  # a thin line between them
            yield np.hstack(pictures)
        for env, predict, memory in cars:
            damping, memory[1] = predict(memory[0][None], memory[1], np.array([step == 0]), deterministic=True)
            memory[0] = env.step(damping[0])[0]


def drive(
    drivers: Sequence[tuple[str, Predictor]],
    *,
    environment: Mapping[str, Any],
    output: str | Path | None = None,
    seconds: float | None = None,
    pace: float = 1.0,
    speed: float | None = None,
    bandwidth: float | None = None,
    seed: int = 0,
    report: Report | None = None,
) -> int:
    """Show one driver, or several side by side over the same road; returns the number of frames.

    Args:
        drivers: title and driver.
        environment: parameters of `roadgym.env.QuarterCarEnv`.
        output: a film to write, .mp4 or .gif; None opens a window.
        seconds: of film, at 60 pictures a second; by default 10 of a file, and a window until it is closed.
        pace: seconds of the drive in one of the film, 1, as nearly as it can be where a picture shows whole control intervals;
            intervals longer than that are a picture each.
        speed, bandwidth: operating point, m/s and 1; by default drawn from the environment's range.
        seed: fixes the road, not negative.
        report: called as ``report(what, frames done, frames in all)`` while a film is written.

    Raises:
        ParameterError: a parameter out of range.
        AgentError: a file that cannot be written, or no display for a window.
        InstallationError: a package that it needs is not installed.
    """
    path = None if output is None else check_output(output)
    limit = None if seconds is None else max(1, round(positive("seconds", seconds) * FRAMES_PER_SECOND))
    point = {name: value for name, value in (("speed", speed), ("bandwidth", bandwidth)) if value is not None}
    whole("seed", seed, low=0)
    every = max(1, round(positive("pace", pace) / (FRAMES_PER_SECOND * make_task(**environment).control_interval)))
    film = frames(drivers, environment, seed=seed, options=point, every=every)
    if path is None:
        return show(itertools.islice(film, limit))
    total = limit or round(SECONDS * FRAMES_PER_SECOND)
    write(path, counted(itertools.islice(film, total), path.name, total, report), total)
    return total


def counted(film: Iterator[Frame], what: str, total: int, report: Report | None) -> Iterator[Frame]:
    """The same frames, reported now and then."""
    for number, frame in enumerate(film, 1):
        yield frame
        if report and (number % 10 == 0 or number == total):
            report(f"filming {what}", number, total)


def show(film: Iterator[Frame]) -> int:
    """Show frames in a window until it is closed or they end; returns how many were shown."""
    first = next(film)
    import pygame

    from roadgym.rendering import Window

    nowhere = AgentError("there is no display for a window: write a film instead, with --output drive.mp4")
    chosen = os.environ.get("SDL_VIDEODRIVER")
    if sys.platform == "linux" and not (chosen or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise nowhere
    try:
        window = Window(first.shape[1], first.shape[0])
    except pygame.error:
        raise nowhere from None
    shown = 0
    try:
        if not chosen and pygame.display.get_driver() in ("dummy", "offscreen"):  # what SDL falls back on
            raise nowhere
        for frame in itertools.chain([first], film):
            window.show(frame)
            shown += 1
            if any(event.type == pygame.QUIT for event in pygame.event.get()):
                break
    finally:
        window.close()
    return shown


def write(path: Path, film: Iterator[Frame], total: int) -> None:
    """Write ``total`` frames as a film, whole or not at all; the ending tells its format."""
    try:
        with whole_file(path) as part:
            WRITERS[path.suffix.lower()](part, film, total)
    except OSError as error:
        raise AgentError(f"cannot write {str(path)!r}: {error.strerror or error}") from None


def write_mp4(path: Path, film: Iterator[Frame], total: int) -> None:
    """H.264, which every browser plays."""
    with needs("render"):
        import imageio_ffmpeg
    first = next(film)
    writer = imageio_ffmpeg.write_frames(
        path, first.shape[1::-1], fps=FRAMES_PER_SECOND, codec="libx264", quality=6, ffmpeg_log_level="fatal"
    )
    try:
        writer.send(None)
        for frame in itertools.chain([first], film):
            writer.send(np.ascontiguousarray(frame))
    except OSError:
        raise OSError("the encoder stopped") from None
    finally:
        writer.close()
    if imageio_ffmpeg.count_frames_and_secs(path)[0] != total:
        raise OSError("the encoder lost frames")


def write_gif(path: Path, film: Iterator[Frame], total: int) -> None:
    """An endless GIF at 20 frames a second, every third of the film, in the colours of the picture and shades between them."""
    from roadgym import drawing, rendering

    with needs("render"):
        from PIL import Image
    colours = [rendering.damper_colour(share) for share in np.linspace(0, 1, 48)]
    for below in (np.array(drawing.PAPER), np.array(rendering.GROUND)):
        for stroke in (
            drawing.INK,
            drawing.GREY,
            rendering.HAIRLINE,
            drawing.BODY,
            rendering.ROAD,
            rendering.GROUND,
            rendering.REWARD,
            rendering.REWARD_AREA,
            rendering.FORCE,
            rendering.FIRM,
        ):
            shades = np.linspace(0, 1, 2 + np.abs(np.array(stroke) - below).max() // 26)  # 1/10 of black to white, at most
            colours += [tuple(np.rint(below + (stroke - below) * shade).astype(int).tolist()) for shade in shades]
    palette = Image.new("P", (1, 1))
    palette.putpalette(bytes(itertools.chain.from_iterable(colours)))
    images = (
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in itertools.islice(film, 0, None, GIF_SHARE)
    )
    duration = 1000 * GIF_SHARE // FRAMES_PER_SECOND  # ms
    with path.open("wb") as file:
        next(images).save(file, "GIF", save_all=True, append_images=images, duration=duration, loop=0)


WRITERS: dict[str, Callable[[Path, Iterator[Frame], int], None]] = {".mp4": write_mp4, ".gif": write_gif}
