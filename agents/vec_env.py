"""The native batch environment as a stable-baselines3 `VecEnv`."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

from roadgym.vector import QuarterCarVectorEnv

from .features import Features


def damping_from_action(action: npt.NDArray[Any], damping_range: tuple[float, float]) -> npt.NDArray[np.float32]:
    """The damping ratio D for an action in [-1, 1], by the affine map onto ``damping_range``."""
    low, high = damping_range
    return np.asarray(low + (np.asarray(action, np.float32) + 1) * (0.5 * (high - low)), np.float32)


def observation_space(signals: spaces.Box, features: Features | None) -> spaces.Box:
    """The space of what a policy sees."""
    if features is None:
        return signals
    largest = np.float32(np.abs(signals.high).max() * np.sqrt(signals.shape[0]))
    return spaces.Box(-largest, largest, (features.size,), np.float32)


class QuarterCarVecEnv(VecEnv):
    """``num_envs`` quarter cars for stable-baselines3; actions in [-1, 1] are mapped onto the damping range.

    Infos hold what stable-baselines3 reads: "terminal_observation" and "TimeLimit.truncated" where an episode ended, and there
    "episode" with its return "r", length "l" and time "t", as its Monitor gives them.

    Args:
        num_envs: number of environments.
        max_episode_steps: steps in an episode.
        environment: parameters of `roadgym.vector.QuarterCarVectorEnv`.
        features: what the policy sees; None for the observations as they are, or kinds of `agents.features.FEATURES`.
    """

    def __init__(
        self,
        num_envs: int,
        *,
        max_episode_steps: int = 500,
        environment: Mapping[str, Any] | None = None,
        features: Sequence[str] | None = None,
    ) -> None:
        self.envs = QuarterCarVectorEnv(
            num_envs,
            max_episode_steps=max_episode_steps,
            autoreset_mode=AutoresetMode.SAME_STEP,
            **(environment or {}),
        )
        self.task = self.envs.task
        self.render_mode = None
        action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.features = None if features is None else Features(self.task.signals, features)
        super().__init__(num_envs, observation_space(self.task.observation_space, self.features), action_space)
        self._actions = np.zeros((num_envs, 1), np.float32)
        self._returns = np.zeros(num_envs)
        self._lengths = np.zeros(num_envs, np.int64)
        self._begin = time.monotonic()

    def reset(self) -> npt.NDArray[np.float32]:
        """First observations, shape (num_envs, signals); the seed of `seed` takes effect here."""
        given = self._seeds if any(seed is not None for seed in self._seeds) else None
        observations, _ = self.envs.reset(seed=given)
        self._reset_seeds()
        self._reset_options()
        self._returns[:] = 0
        self._lengths[:] = 0
        return self._see(observations)

    def _see(self, observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        return observations if self.features is None else self.features(observations)

    def step_async(self, actions: npt.NDArray[np.float32]) -> None:
        """Take the actions, shape (num_envs, 1), for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.bool_], list[dict[str, Any]]]:
        """Drive one control interval."""
        damping = damping_from_action(self._actions, self.task.damping_range)
        observations, rewards, _, truncated, info = self.envs.step(damping)
        self._returns += rewards
        self._lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if truncated.any():
            elapsed = round(time.monotonic() - self._begin, 6)
            ended = np.flatnonzero(truncated)
            final = self._see(np.stack(info["final_obs"][ended]))
            for row, i in enumerate(ended):
                infos[i] = {
                    "terminal_observation": final[row],
                    "TimeLimit.truncated": True,
                    "episode": {"r": float(self._returns[i]), "l": int(self._lengths[i]), "t": elapsed},
                }
            self._returns[truncated] = 0
            self._lengths[truncated] = 0
        return self._see(observations), np.asarray(rewards, np.float32), truncated, infos

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
