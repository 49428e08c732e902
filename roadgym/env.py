"""The single environment: lane 0 of one block of the batch."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Unpack

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.error import ResetNeeded

from . import ENVIRONMENT_ID
from .moved import moved
from .parameters import ParameterError, shown, single_precision, whole
from .plant import Plant
from .task import Task, TaskParameters, make_task

if TYPE_CHECKING:  # it loads pygame, which only those need who ask for pictures
    from .rendering import History, Picture, Window
else:
    __getattr__ = moved(__name__, MEAN_SQUARES="roadgym.cars")

RESET_OPTIONS = ("speed", "bandwidth")


def state_names(task: Task) -> tuple[str, ...]:
    """Names of what the environments' ``state`` tells."""
    return (*task.car.motion.states, "level", "slope", "speed", "bandwidth")


def told_states(plant: Plant) -> npt.NDArray[np.float64]:
    """What the environments' ``state`` tells, shape (num_envs, states + 4)."""
    task = plant.task
    units = {} if task.vary is None else task.vary.unit_rows(plant.car_row)
    rows = [plant.row(name) * (plant.row(units[name]) if name in units else 1) for name in state_names(task)]
    return np.stack(rows, axis=1).astype(np.float64)


def check_options(options: Mapping[str, Any] | None, known: Sequence[str] = RESET_OPTIONS) -> dict[str, Any]:
    """The options of a reset as a dictionary; an unknown name, or what is no mapping, raises `ParameterError`."""
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise ParameterError(f"options must be a mapping with the keys {', '.join(known)}, got {shown(options)}")
    for name in options:
        if name not in known:
            raise ParameterError(f"unknown reset option {shown(name)}; known: {', '.join(known)}")
    return dict(options)


def check_render_mode(mode: Any, known: Sequence[str]) -> None:
    """Raise unless ``mode`` is None or a known one, and what it needs is installed."""
    if mode is not None:
        if not isinstance(mode, str) or mode not in known:
            raise ParameterError(f"unknown render_mode {shown(mode)}; known: {', '.join(known)}")
        from . import rendering  # noqa: F401  (a missing pygame is told here, not in the middle of a drive)


class QuarterCarEnv(gymnasium.Env[npt.NDArray[np.float32], npt.NDArray[np.float32]]):
    """A quarter car on a random road; the action sets its damping ratio D for the next control interval.

    By default the car is one mass, the body on a spring and a damper that follow the road; it has no wheel of its own. What is
    told in metres of that car, a car in SI units such as `roadgym.TwoMassCar` tells in its units (`roadgym.cars.Car.units`).

    - Action: D itself, `Box(damping_range)`, shape (1,), float32. It saturates at the range, as an actuator does; an action
      that is not finite or has another shape raises.
    - Reward: minus the weighted sum of the interval's mean squares over the road's variance E Z^2; of a car in SI units, over
      nothing, so that rough roads cost more than smooth ones. With the default weights of one mass the
      mean reward at constant D is minus the variance ratio E Y^2 / E Z^2, for example (16) of Wedig (2020).
    - Observation: float32, the signals named in ``signal_names``, in units of the road's standard deviation (velocity over w1,
      acceleration over w1^2), saturating at 20 of them; then, unless it is hidden, the operating point, speed as nu/(1 + nu)
      with nu = speed * wavenumber / natural_frequency and, where it exists, bandwidth delta as 2 delta/(1 + 2 delta).
      ``signal_scale`` holds the factors that make metres, or the car's units, of them.
    - Info, in double precision: the interval's mean squares ``displacement``, ``velocity``, ``acceleration``, ``travel`` and
      ``relative_velocity`` in m^2 (velocities over w1, accelerations over w1^2; infinite where the road's slope is white
      noise), the ``damping`` that was in force, in the mean over the interval, and the operating point ``speed`` (m/s) and
      ``bandwidth`` (1); with a `roadgym.Valve` that is not ideal, ``damping_command`` too, the action within its range. At a
      reset no interval has been driven yet: mean squares and damping are 0.
    - `roadgym.Sensors` disturb the observation alone: infos, rewards and ``state`` are true values.
    - Episodes never terminate; a time limit truncates them (500 steps by registration). Each starts with the road in its
      stationary law and the car at rest, at zero or, of two masses, standing on the road; or warmed up.
    - ``reset(options={"speed": ..., "bandwidth": ...})`` fixes the operating point of this episode.
    - Rendering: with "rgb_array" `render` returns the picture, uint8, shape (640, 800, 3); with "human" a window shows it at
      every reset and step, 60 of them a second. `roadgym.rendering` says what is in it; its title is ``render_title``, and who
      draws every n-th step alone says so by ``render_every``. This needs pygame, of the extra ``render``.

    The parameters are those of `roadgym.task.make_task`. The noise depends on the seed, the number of resets since it was given
    and the step alone, so two controllers with the same seed meet the same road.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["human", "rgb_array"], "render_fps": 60}  # type: ignore[misc]

    def __init__(
        self,
        *,
        render_mode: str | None = None,
        **parameters: Unpack[TaskParameters],
    ) -> None:
        check_render_mode(render_mode, self.metadata["render_modes"])
        self.task = make_task(**parameters)
        self.render_mode = render_mode
        self.render_title = "Quarter car"
        self.render_every = 1
        self.action_space = self.task.action_space
        self.observation_space = self.task.observation_space
        self.signal_names = self.task.signals
        self.signal_scale = self.task.signal_scale
        self.plant = Plant(self.task, 1, threads=1, told=True)
        self._mask, self._has_bandwidth = np.ones(1, np.bool_), self.task.bandwidth[1] > 0
        self._names, self._valve = self.task.car.mean_squares, not self.task.ideal_valve
        self._fields = () if self.task.vary is None else self.task.vary.names
        self.history: History | None = None
        self._picture: Picture | None = None
        self._window: Window | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_picture": None, "_window": None}  # a copy draws for itself

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """Begin the next episode; see the class for ``options``."""
        forced = self.plant.forced(check_options(options))
        seed = None if seed is None else whole("seed", seed, low=0, of="seed")
        super().reset(seed=seed)
        if seed is None and not self.plant.started:
            seed = int(self.np_random.integers(2**63))
        if seed is not None:
            self.plant.seed(np.array([seed], np.uint64), self._mask)
        began = self.plant.reset(forced, self._mask)
        if self.render_mode is not None:
            from .rendering import History

            self.history = History(self.plant)
            if self.render_mode == "human":
                self.render()
        _, _, speed, bandwidth, *_ = began.only()
        info = {**dict.fromkeys(self._names, 0.0), "damping": 0.0, "speed": speed}
        if self._valve:
            info["damping_command"] = 0.0
        if self._has_bandwidth:
            info["bandwidth"] = bandwidth
        if self._fields:
            info.update(zip(self._fields, self.plant.drawn[:, 0].tolist(), strict=True))
        return began.observations[0], info

    def state(self) -> npt.NDArray[np.float64]:
        """State of the car, then (Z, U, nu, delta), in one row; see `roadgym.vector.QuarterCarVectorEnv.state`."""
        found: npt.NDArray[np.float64] = told_states(self.plant)[0]
        return found

    def step(self, action: npt.NDArray[np.float32]) -> tuple[npt.NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Drive one control interval with the damping ratio ``action``, shape (1,)."""
        if not self.plant.started:
            raise ResetNeeded("call reset before step")
        actions = single_precision("action", action, (1,))
        if not math.isfinite(actions.item()):
            raise ParameterError(f"action must be one finite number, shape (1,), got {shown(action)}")
        interval = self.plant.step(actions) if self.history is None else self.history.step(actions)
        reward, damping, speed, bandwidth, *squares = interval.only()
        info: dict[str, Any] = dict(zip(self._names, squares))  # noqa: B905  (to be strict takes a fiftieth of the step)
        info["damping"] = damping
        if self._valve:
            info["damping_command"] = squares[-1]
        info["speed"] = speed
        if self._has_bandwidth:
            info["bandwidth"] = bandwidth
        if self._fields:
            info.update(zip(self._fields, self.plant.drawn[:, 0].tolist(), strict=True))
        if self.render_mode == "human":
            self.render()
        return interval.observations[0], reward, False, False, info

    def render(self) -> npt.NDArray[np.uint8] | None:
        """The picture now in the mode "rgb_array"; in the mode "human" it goes to the window."""
        if self.render_mode is None:
            gymnasium.logger.warn(
                "You are calling render method without specifying any render mode. You can specify the render_mode at "
                f'initialization, e.g. gymnasium.make("{ENVIRONMENT_ID}", render_mode="rgb_array")'
            )
            return None
        if self.history is None:
            raise ResetNeeded("call reset before render")
        from .rendering import Picture, Window

        if self._picture is None:
            self._picture = Picture(self.task)
        pixels = self._picture.draw(self.history, self.render_title, self.render_every)
        if self.render_mode == "rgb_array":
            return pixels.copy()
        if self._window is None:
            self._window = Window(pixels.shape[1], pixels.shape[0])
        self._window.show(pixels)
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None
