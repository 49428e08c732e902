"""PPO of stable-baselines3, or of its sibling in JAX, sbx, on single environments, as any other is trained with them.

    python examples/learners/with_stable_baselines3.py
    pip install sbx-rl
    python examples/learners/with_stable_baselines3.py --package sbx

The environments are stepped one by one here; `agents.vec_env.QuarterCarVecEnv` is the native batch for these libraries, and
`agents.train` the whole recipe.
"""

from __future__ import annotations

import argparse
import importlib
import time
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import torch
from share import ENVIRONMENT, share_of_gap
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

import roadgym

ROLLOUT = 4096  # steps of all environments together


def rescaled(env: gym.Env[Any, Any]) -> gym.Env[Any, Any]:
    """Takes actions in [-1, 1], as Gaussian policies give them."""
    return gym.wrappers.RescaleAction(env, -1, 1)


def train(package: str, seed: int, timesteps: int, num_envs: int) -> Any:
    """A model trained for ``timesteps`` control intervals over all environments."""
    envs = make_vec_env(roadgym.ENVIRONMENT_ID, num_envs, seed=seed, env_kwargs=ENVIRONMENT, wrapper_class=rescaled)
    batch = VecNormalize(envs, norm_obs=False)  # observations are in standard deviations, returns in hundreds
    algorithm = importlib.import_module(package).PPO
    options = {"n_steps": ROLLOUT // num_envs, "batch_size": 512, "n_epochs": 5, "learning_rate": 1e-3}
    return algorithm("MlpPolicy", batch, seed=seed, **options).learn(timesteps)


def main() -> None:
    """Train, then tell the share of the gap."""
    parser = argparse.ArgumentParser(description="PPO of stable-baselines3 at one operating point.")
    parser.add_argument("--package", choices=("stable_baselines3", "sbx"), default="stable_baselines3", help="(%(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="fixes weights, exploration and roads (%(default)s)")
    parser.add_argument("--timesteps", type=int, default=200_000, help="control intervals to train for (%(default)s)")
    parser.add_argument("--num-envs", type=int, default=16, help="cars that learn at once (%(default)s)")
    parser.add_argument("--episodes", type=int, default=256, help="roads of the evaluation (%(default)s)")
    chosen = parser.parse_args()
    torch.set_num_threads(1)  # the networks are small: more threads only wait for each other

    begin = time.process_time()
    model = train(chosen.package, chosen.seed, chosen.timesteps, chosen.num_envs)
    print(f"trained in {time.process_time() - begin:.0f} s of CPU")

    def answer(observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        return np.clip(model.predict(observations, deterministic=True)[0], -1, 1)

    share, error = share_of_gap(answer, chosen.episodes)
    print(f"closes {100 * share:.2f} ± {100 * error:.2f} % of the gap")


if __name__ == "__main__":
    main()
