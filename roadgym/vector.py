"""The native batch environment."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
import numpy.typing as npt
from gymnasium import logger
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from .env import RESET_OPTIONS, QuarterCarEnv, check_options, check_render_mode, told_states
from .moved import moved
from .parameters import ParameterError, shown, single_precision, whole
from .plant import Interval, Plant
from .task import OPERATING_POINT, TaskParameters, make_task

if TYPE_CHECKING:  # it loads pygame, which only those need who ask for pictures
    from .rendering import History, Picture
else:
    __getattr__ = moved(__name__, MEAN_SQUARES="roadgym.cars")

Floats = npt.NDArray[np.float32]


def make_autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    """An autoreset mode from its name, its value, or as it is."""
    for candidate in AutoresetMode:
        if isinstance(mode, (str, AutoresetMode)) and mode in (
            candidate,
            candidate.value,
            candidate.name,
            candidate.name.lower(),
        ):
            return candidate
    raise ParameterError(f"autoreset_mode must be one of {[m.name for m in AutoresetMode]}, got {shown(mode)}")


class QuarterCarVectorEnv(VectorEnv[Floats, Floats, npt.NDArray[Any]]):
    """``num_envs`` quarter cars, stepped together; environment i with seed s equals `QuarterCarEnv` with seed s + i bit by bit.

    Observations, actions, rewards and infos are those of `QuarterCarEnv`, with a first axis over the environments. With
    ``render_mode="rgb_array"`` `render` gives the picture of each, as Gymnasium's ``HumanRendering`` and ``RecordVideo`` for
    vector environments take them; this needs the extra ``render``.

    Args:
        num_envs: number of environments.
        max_episode_steps: steps in an episode; None, 0 or -1 for no limit.
        autoreset_mode: when an environment whose episode is over begins the next one. NEXT_STEP: in the next step, which
            ignores its action, returns the first observation and the reward 0. SAME_STEP: at once; the last observation and the
            infos of the old episode are under "final_obs" and "final_info". DISABLED: when ``reset`` is called with the option
            "reset_mask", a boolean array of shape (num_envs,); until then it drives on, truncated in every step.
        threads: number of threads; results do not depend on it. By default one a processor, where the batch is
            large enough, or fewer where OMP_NUM_THREADS says so.

    All others are the parameters of `roadgym.task.make_task`.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": QuarterCarEnv.metadata["render_fps"]}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = 500,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int | None = None,
        render_mode: str | None = None,
        **parameters: Unpack[TaskParameters],
    ) -> None:
        self.num_envs = whole("num_envs", num_envs, of="num_envs")
        mode = make_autoreset_mode(autoreset_mode)
        limit = 0 if max_episode_steps is None else whole("max_episode_steps", max_episode_steps, low=-1)
        limit = 0 if limit == -1 else limit and whole("max_episode_steps", limit, of="max_episode_steps")
        check_render_mode(render_mode, self.metadata["render_modes"])
        self.task = make_task(**parameters)
        self.autoreset_mode = mode  # as Gymnasium's own vector environments have it
        self.metadata = {**self.metadata, "autoreset_mode": mode}
        self.render_mode = render_mode
        self.single_action_space = self.task.action_space
        self.single_observation_space = self.task.observation_space
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.signal_names = self.task.signals
        self.signal_scale = self.task.signal_scale
        self.plant = Plant(
            self.task,
            self.num_envs,
            max_episode_steps=limit,
            autoreset=mode.name.lower(),
            threads=None if threads is None else whole("threads", threads, of="threads"),
            told=True,
        )
        told = (*self.task.car.mean_squares, "damping", *(() if self.task.ideal_valve else ("damping_command",)), "speed")
        self._told = (*told, *(("bandwidth",) if self.task.bandwidth[1] > 0 else ()))
        self._masks = tuple(f"_{name}" for name in (*self._told, *(self.task.vary.names if self.task.vary else ())))
        self._same_step = mode is AutoresetMode.SAME_STEP
        self._all = np.ones(self.num_envs, np.bool_)
        self.histories: list[History] = []  # of each environment, for pictures, where there is a render_mode
        self._picture: Picture | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_picture": None}  # a copy draws for itself

    def _info(self, interval: Interval, mask: npt.NDArray[np.bool_]) -> dict[str, Any]:
        """What `QuarterCarEnv` tells, as arrays over the environments, with Gymnasium's masks."""
        info: dict[str, Any] = dict(zip(self._told, interval.rows()))  # noqa: B905  (the last, of no use to all, may be left)
        if self.task.vary is not None:
            info |= zip(self.task.vary.names, self.plant.drawn.copy(), strict=True)
        info.update(dict.fromkeys(self._masks, mask))
        return info

    def _forced(self, chosen: dict[str, Any]) -> npt.NDArray[np.float64]:
        """The operating points that the options fix, see `Plant.forced`; NaN too where one of them is None."""
        drawn = {name: value for name, value in chosen.items() if isinstance(value, (list, tuple)) and None in value}
        known = {name: [getattr(self.task, name)[0] if each is None else each for each in drawn[name]] for name in drawn}
        forced = self.plant.forced(chosen | known)
        for row, name in enumerate(OPERATING_POINT):
            if name in drawn:
                forced[row, [each is None for each in drawn[name]]] = np.nan
        return forced

    def _seeds(self, seed: int | Sequence[int | None] | None, mask: npt.NDArray[np.bool_]) -> None:
        """Seed the masked environments: s + i from an integer s, or one each from a sequence, None leaving one as it is."""
        n = self.num_envs
        if seed is None:
            if self.plant.started:
                return
            seed = int(self.np_random.integers(2**63))
        if isinstance(seed, int):
            seeds = np.arange(n, dtype=np.uint64) + np.uint64(seed)
        else:
            if not self.plant.started:
                fresh = self.np_random.integers(2**63, size=n).tolist()
                seed = [new if given is None else given for given, new in zip(seed, fresh, strict=True)]
            mask = mask & np.array([given is not None for given in seed])
            seeds = np.array([given or 0 for given in seed], np.uint64)
        self.plant.seed(seeds, mask)

    def _checked_seed(self, seed: Any) -> int | list[int | None] | None:
        """``seed`` as Python's integers, with room for the last environment; see `_seeds`."""
        if seed is None:
            return None
        if isinstance(seed, np.ndarray) and seed.ndim == 1:
            seed = list(seed)
        if not isinstance(seed, (list, tuple)):
            first = whole("seed", seed, low=0, of="seed")
            whole("seed of the last environment", first + self.num_envs - 1, low=0, of="seed")
            return first
        if len(seed) != self.num_envs:
            raise ParameterError(f"seed must be one integer or {self.num_envs} of them, got {len(seed)}")
        return [None if each is None else whole(f"seed {i}", each, low=0, of="seed") for i, each in enumerate(seed)]

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin the next episode everywhere, or where the option "reset_mask" is true.

        The options "speed" and "bandwidth", a number or one for each environment, fix the operating point of that episode; a
        None among them leaves it to be drawn.
        """
        chosen = check_options(options, (*RESET_OPTIONS, "reset_mask"))
        mask = chosen.get("reset_mask", self._all)
        usable = isinstance(mask, np.ndarray) and not isinstance(mask, np.ma.MaskedArray)
        if not usable or mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise ParameterError(f"option 'reset_mask' must be a boolean array of shape ({self.num_envs},), got {shown(mask)}")
        mask = np.require(mask, np.bool_, ["C", "A", "W"])  # as compiled code takes it
        if not self.plant.started and not mask.all():
            raise ResetNeeded("the first reset must reset every environment")
        forced = self._forced(chosen)
        checked = self._checked_seed(seed)
        super().reset(seed=checked if isinstance(checked, int) else None)
        self._seeds(checked, mask)
        began = self.plant.reset(forced, mask)
        info = self._info(began, mask.copy())
        info["damping"][:] = 0.0  # no interval has been driven
        self._begin_histories(mask)
        return began.observations, info

    def state(self) -> npt.NDArray[np.float64]:
        """The states of the car, then (Z, U, nu, delta), whatever is observed; shape (num_envs, 6) with one mass, (Y, X) first.

        States and level are in units of the road's standard deviation, X = (dY/dt)/w1 and U = (dZ/dt)/(speed * wavenumber), 0
        on a road that has no slope; nu = speed * wavenumber / w1 with the mean speed, and delta is the bandwidth. Of cars that
        vary w1 is that of the nominal one, so a state that can be observed is what an ideal sensor tells of it.
        """
        return told_states(self.plant)

    def _begin_histories(self, mask: npt.NDArray[np.bool_]) -> None:
        """Forget what the masked environments drove before the episode that they are at the start of."""
        if self.render_mode is not None:
            from .rendering import History

            self.histories = self.histories or [History(self.plant, i) for i in range(self.num_envs)]
            for i in np.flatnonzero(mask):
                self.histories[i] = History(self.plant, int(i))

    def _trace(self, damping: Floats) -> Interval:
        """`Plant.step`, remembered for pictures."""
        interval, angle, level = self.plant.trace(damping)
        begun = self.plant.elapsed_steps == 0
        for i in np.flatnonzero(~begun):
            self.histories[i].note(interval, angle, level)
        self._begin_histories(begun)
        return interval

    def render(self) -> tuple[npt.NDArray[np.uint8], ...] | None:
        """The pictures now, one of each environment, as `QuarterCarEnv` draws it."""
        if self.render_mode is None:
            logger.warn("render was called without a render_mode; make_vec takes render_mode='rgb_array'")
            return None
        if not self.histories:
            raise ResetNeeded("call reset before render")
        from .rendering import Picture

        picture = self._picture = self._picture or Picture(self.task)
        return tuple(picture.draw(history, "Quarter car").copy() for history in self.histories)

    def step(
        self, actions: Floats
    ) -> tuple[Floats, npt.NDArray[Any], npt.NDArray[np.bool_], npt.NDArray[np.bool_], dict[str, Any]]:
        """Drive one control interval with the damping ratios ``actions``, shape (num_envs, 1)."""
        if not self.plant.started:
            raise ResetNeeded("call reset before step")
        damping = single_precision("actions", actions, (self.num_envs, 1))
        if not math.isfinite(np.dot(damping[:, 0], damping[:, 0])) and not np.isfinite(damping).all():  # a sum, and who is it
            raise ParameterError(f"actions must be finite, got {damping[~np.isfinite(damping)][0]} among them")
        interval = self.plant.step(damping.reshape(-1)) if self.render_mode is None else self._trace(damping.reshape(-1))
        truncated, info = interval.truncated, self._info(interval, self._all.copy())
        if self._same_step and truncated.any():
            final_info = {name: value.copy() if name[0] == "_" else value for name, value in info.items()}
            info["final_info"], info["_final_info"] = final_info, truncated.copy()
            info["final_obs"], info["_final_obs"] = np.full(self.num_envs, None, object), truncated.copy()
            for i in np.flatnonzero(truncated):
                info["final_obs"][i] = interval.final_observations[i]
        return interval.observations, interval.rewards, np.zeros(self.num_envs, np.bool_), truncated, info
