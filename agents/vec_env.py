"""The native batch environment as a stable-baselines3 `VecEnv`."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode

from roadgym.installation import needs
from roadgym.parameters import ParameterError, shown, whole
from roadgym.task import TaskParameters
from roadgym.vector import QuarterCarVectorEnv

from .actions import action_space
from .actions import damping_from_action as damping_from_action
from .features import Rows
from .features import Sight as Sight

with needs("train"):
    from stable_baselines3.common.vec_env import VecEnv


class QuarterCarVecEnv(VecEnv):
    """``num_envs`` quarter cars for stable-baselines3, with its actions (`damping_from_action`) and a policy's `Sight`.

    Infos hold what stable-baselines3 reads: "terminal_observation" and "TimeLimit.truncated" where an episode ended, and there
    "episode" with its return "r", length "l" and time "t", as its Monitor gives them.

    Args:
        num_envs: number of environments.
        max_episode_steps: steps in an episode.
        environment: parameters of `roadgym.vector.QuarterCarVectorEnv`.
        features, frame_stack: what the policy sees; see `Sight`.
        damping_levels: number of damping ratios to choose from, at equal distances over the range; by default all of it.
    """

    def __init__(
        self,
        num_envs: int,
        *,
        max_episode_steps: int = 500,
        environment: Mapping[str, Any] | None = None,
        features: Sequence[str] | None = None,
        frame_stack: int = 1,
        damping_levels: int | None = None,
    ) -> None:
        if not (environment is None or isinstance(environment, Mapping)):
            raise ParameterError(f"environment must be a mapping of parameters, got {shown(environment)}")
        known = ("threads", *TaskParameters.__annotations__)
        for name in environment or {}:
            if name not in known:
                raise ParameterError(f"unknown parameter {shown(name)} of environment; known: {', '.join(known)}")
        self.envs = QuarterCarVectorEnv(
            num_envs,
            max_episode_steps=max_episode_steps,
            autoreset_mode=AutoresetMode.SAME_STEP,
            **(environment or {}),
        )
        self.task = self.envs.task
        self.render_mode = None
        self.sight = Sight(self.task, features, frame_stack)
        self.damping_levels = None if damping_levels is None else whole("damping_levels", damping_levels, low=2, of="levels")
        super().__init__(num_envs, self.sight.space, action_space(self.damping_levels))
        self._frames: Rows | None = None
        self._actions: npt.NDArray[Any] = np.zeros((num_envs, 1), np.float32)
        self._returns = np.zeros(num_envs)
        self._lengths = np.zeros(num_envs, np.int64)
        self._begin = time.monotonic()

    def reset(self) -> npt.NDArray[np.float32]:
        """What is seen first, shape (num_envs, size); the seed of `seed` takes effect here."""
        given = self._seeds if any(seed is not None for seed in self._seeds) else None
        observations, _ = self.envs.reset(seed=given)
        self._reset_seeds()
        self._reset_options()
        self._returns[:] = 0
        self._lengths[:] = 0
        self._frames = self.sight.stack(None, observations, None)
        return self.sight(observations, self._frames)

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Take the actions, shape (num_envs, 1), or (num_envs,) where they are levels, for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.bool_], list[dict[str, Any]]]:
        """Drive one control interval."""
        damping = damping_from_action(self._actions, self.task.damping_range, self.damping_levels)
        observations, rewards, _, truncated, info = self.envs.step(damping)
        self._returns += rewards
        self._lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if truncated.any():
            elapsed = round(time.monotonic() - self._begin, 6)
            ended = np.flatnonzero(truncated)
            last = np.stack(info["final_obs"][ended])
            before = None if self._frames is None else self._frames[ended]
            final = self.sight(last, self.sight.stack(before, last, None))
            for row, i in enumerate(ended):
                infos[i] = {
                    "terminal_observation": final[row],
                    "TimeLimit.truncated": True,
                    "episode": {"r": float(self._returns[i]), "l": int(self._lengths[i]), "t": elapsed},
                }
            self._returns[truncated] = 0
            self._lengths[truncated] = 0
        self._frames = self.sight.stack(self._frames, observations, truncated)
        return self.sight(observations, self._frames), np.asarray(rewards, np.float32), truncated, infos

    def close(self) -> None:
        """Nothing to release."""

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """An attribute of the batch environment, once for each index."""
        return [getattr(self.envs if attr_name != "render_mode" else self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Refused: the environments share their parameters."""
        raise AttributeError(f"cannot set {attr_name!r}: the environments of a batch share their parameters")

    def env_method(
        self, method_name: str, *method_args: Any, indices: int | Iterable[int] | None = None, **method_kwargs: Any
    ) -> list[Any]:
        """Refused: there are no separate environments to call."""
        raise AttributeError(f"cannot call {method_name!r}: a batch has no separate environments")

    def env_is_wrapped(self, wrapper_class: type, indices: int | Iterable[int] | None = None) -> list[bool]:
        """Always false, but for stable-baselines3's Monitor, whose episode statistics the infos hold."""
        return [wrapper_class.__name__ == "Monitor" for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[npt.NDArray[np.uint8] | None]:
        """No images: a batch does not render."""
        return [None] * self.num_envs
