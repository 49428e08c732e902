"""Checkpoints of a training: it goes on from one as if it had never stopped, bit by bit.

What algorithms of stable-baselines3 save is enough to drive. To learn on in the same numbers takes their environments, their
buffers and the random states as well, as they stand between two rollouts; those lie in the same file until the training ends.
"""

from __future__ import annotations

import logging
import pickle
import random
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from roadgym.installation import needs

from .agent import TRAINING, save

with needs("train"):
    import cloudpickle
    import torch
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import VecNormalize


def frozen(model: BaseAlgorithm) -> bytes | None:
    """A training between two rollouts; None where somebody's wrappers cannot be pickled."""
    envs, log = model.get_vec_normalize_env(), model._logger
    assert envs is not None
    model._logger = None  # type: ignore[assignment]
    try:
        # what VecNormalize leaves out of its pickles goes beside it
        content: bytes = cloudpickle.dumps((model, envs.venv, envs.returns, *_random_states()))
    except Exception:  # it is somebody else's
        return None
    finally:
        model._logger = log
    return content


def _random_states() -> tuple[Any, ...]:
    return torch.get_rng_state(), np.random.get_state(), random.getstate()  # noqa: NPY002 - stable-baselines3 draws from it


def thawed(file: Path) -> BaseAlgorithm | None:
    """The training in the file of a model, random states set; None where there is none, or none that can be gone on with."""
    try:
        with zipfile.ZipFile(file) as parts:
            content = parts.read(TRAINING) if TRAINING in parts.namelist() else None
        if content is None:
            return None
        model, batch, returns, of_torch, of_numpy, of_python = pickle.loads(content)
    except Exception as error:  # unpickling what other versions wrote can raise anything
        logging.getLogger("roadgym").warning(
            "%s cannot be gone on with exactly, but with new noise: %s", file.name, " ".join(str(error).split())
        )
        return None
    envs: VecNormalize = model.get_vec_normalize_env()
    envs.set_venv(batch)
    envs.returns = returns
    torch.set_rng_state(of_torch)
    np.random.set_state(of_numpy)  # noqa: NPY002
    random.setstate(of_python)
    found: BaseAlgorithm = model
    return found


class Checkpoints(BaseCallback):
    """Saves the agent, and its training, at the first rollout after every ``interval`` timesteps, and reports progress."""

    def __init__(
        self,
        folder: Path,
        description: dict[str, Any],
        total: int,
        interval: int,
        report: Callable[[int, int, float | None], None],
    ) -> None:
        super().__init__()
        self._folder, self._description, self._total, self._interval = folder, description, total, interval
        self._report, self._next, self._warned = report, interval, False

    def _init_callback(self) -> None:
        self._next = self.model.num_timesteps + self._interval

    def _on_rollout_start(self) -> None:
        if self.model.num_timesteps >= self._next:
            self._next += self._interval * (1 + (self.model.num_timesteps - self._next) // self._interval)  # one for all passed
            kept = frozen(self.model)
            if kept is None and not self._warned:
                self._warned = True
                logging.getLogger("roadgym").warning("wrappers cannot be pickled: a resumed training will meet new noise")
            save(self._folder, self.model, self._description, kept)

    def _on_step(self) -> bool:
        self._report(min(self.num_timesteps, self._total), self._total, self._mean_reward())
        return True

    def _mean_reward(self) -> float | None:
        episodes = self.model.ep_info_buffer
        if not episodes:
            return None
        return float(np.mean([episode["r"] / episode["l"] for episode in episodes]))
