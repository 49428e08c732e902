"""PPO of RLlib on single environments.

    pip install 'ray[rllib]'
    python examples/learners/with_rllib.py

RLlib makes the environments itself, of a function that is registered by a name, and steps them in Gymnasium's own vector
environment. Each release of it asks for one release of Gymnasium.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import ray
import torch
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.rl_module import RLModule
from ray.tune.registry import register_env
from share import ENVIRONMENT, share_of_gap

import roadgym

ROLLOUT = 4096  # steps of all environments together


def make(options: dict[str, Any]) -> gym.Env[Any, Any]:
    """The environment, with actions in [-1, 1]."""
    return gym.wrappers.RescaleAction(gym.make(roadgym.ENVIRONMENT_ID, **options), -1, 1)


def train(seed: int, timesteps: int, num_envs: int) -> RLModule:
    """The networks, trained for ``timesteps`` control intervals over all environments."""
    register_env("quarter_car", make)
    configuration = (
        PPOConfig()
        .environment("quarter_car", env_config=ENVIRONMENT)
        .env_runners(num_env_runners=0, num_envs_per_env_runner=num_envs, rollout_fragment_length=ROLLOUT // num_envs)
        .training(train_batch_size_per_learner=ROLLOUT, minibatch_size=512, num_epochs=5, lr=1e-3, lambda_=0.95, grad_clip=0.5)
        .debugging(seed=seed)
    )
    algorithm = configuration.build_algo()
    for _ in range(max(timesteps // ROLLOUT, 1)):
        algorithm.train()
    return algorithm.get_module()


def main() -> None:
    """Train, then tell the share of the gap."""
    parser = argparse.ArgumentParser(description="PPO of RLlib at one operating point.")
    parser.add_argument("--seed", type=int, default=1, help="fixes weights, exploration and roads (%(default)s)")
    parser.add_argument("--timesteps", type=int, default=200_000, help="control intervals to train for (%(default)s)")
    parser.add_argument("--num-envs", type=int, default=16, help="cars that learn at once (%(default)s)")
    parser.add_argument("--episodes", type=int, default=256, help="roads of the evaluation (%(default)s)")
    chosen = parser.parse_args()

    begin = time.process_time()
    networks = train(chosen.seed, chosen.timesteps, chosen.num_envs)
    print(f"trained in {time.process_time() - begin:.0f} s of CPU")

    def answer(observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        with torch.no_grad():
            parameters = networks.forward_inference({"obs": torch.from_numpy(observations)})["action_dist_inputs"]
        return parameters[:, :1].clamp(-1, 1).numpy()  # the mean, before the logarithm of the standard deviation

    share, error = share_of_gap(answer, chosen.episodes)
    print(f"closes {100 * share:.2f} ± {100 * error:.2f} % of the gap")
    ray.shutdown()


if __name__ == "__main__":
    main()
