"""PPO of skrl on the native batch.

    pip install skrl
    python examples/learners/with_skrl.py

skrl takes a batch of Gymnasium as it is. Two things are worth knowing. It never asks for the step in which an environment only
begins its next episode (Gymnasium's autoreset mode NEXT_STEP), so that step is learned from, one in 501, at a reward of 0. And
by default it takes the truncation of an episode for no end at all: its sums run on into the next one. Both vanish
without a time limit, which this task does not need: nothing ever terminates, and here there is one operating point.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import torch
from gymnasium.wrappers.vector import RescaleAction
from share import ENVIRONMENT, share_of_gap
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.trainers.torch import SequentialTrainer, SequentialTrainerCfg
from skrl.utils import set_seed
from torch import nn

import roadgym

ROLLOUT = 64


def network(signals: int) -> nn.Sequential:
    """A number for each observation."""
    return nn.Sequential(nn.Linear(signals, 128), nn.ReLU(), nn.Linear(128, 64), nn.ReLU(), nn.Linear(64, 1))


class Policy(GaussianMixin, Model):
    """A Gaussian on [-1, 1]; what lies outside saturates in the damper."""

    def __init__(self, observation_space: Any, action_space: Any, device: Any) -> None:
        Model.__init__(self, observation_space=observation_space, action_space=action_space, device=device)
        GaussianMixin.__init__(self)
        self.mean, self.log_std = network(self.num_observations), nn.Parameter(torch.zeros(1))

    def compute(self, inputs: dict[str, Any], role: str) -> tuple[torch.Tensor, dict[str, Any]]:
        """Mean and logarithm of the standard deviation."""
        return self.mean(inputs["observations"]), {"log_std": self.log_std}


class Value(DeterministicMixin, Model):
    """The value of an observation."""

    def __init__(self, observation_space: Any, action_space: Any, device: Any) -> None:
        Model.__init__(self, observation_space=observation_space, action_space=action_space, device=device)
        DeterministicMixin.__init__(self)
        self.value = network(self.num_observations)

    def compute(self, inputs: dict[str, Any], role: str) -> tuple[torch.Tensor, dict[str, Any]]:
        """The value alone."""
        return self.value(inputs["observations"]), {}


def train(seed: int, timesteps: int, num_envs: int, folder: str) -> Policy:
    """Train a policy for ``timesteps`` control intervals over all environments."""
    set_seed(seed)
    batch = gym.make_vec(roadgym.ENVIRONMENT_ID, num_envs=num_envs, max_episode_steps=None, **ENVIRONMENT)
    env = wrap_env(RescaleAction(batch, -1, 1))
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space, "device": env.device}
    models = {"policy": Policy(**spaces), "value": Value(**spaces)}
    configuration = PPO_CFG(
        rollouts=ROLLOUT, learning_epochs=5, mini_batches=8, learning_rate=2e-3, value_clip=0.0, value_loss_scale=0.5
    )
    configuration.rewards_shaper = lambda rewards, *_: (
        rewards * (1 - configuration.discount_factor)
    )  # so values are of order one
    configuration.experiment.directory = folder
    configuration.experiment.write_interval = configuration.experiment.checkpoint_interval = 0
    memory = RandomMemory(memory_size=ROLLOUT, num_envs=num_envs, device=env.device)
    agent = PPO(models=models, memory=memory, cfg=configuration, **spaces)
    rounds = max(timesteps // (ROLLOUT * num_envs), 1)
    course = SequentialTrainerCfg(timesteps=rounds * ROLLOUT, headless=True, disable_progressbar=True)
    SequentialTrainer(env=env, agents=agent, cfg=course).train()
    return models["policy"]


def main() -> None:
    """Train, then tell the share of the gap."""
    parser = argparse.ArgumentParser(description="PPO of skrl at one operating point.")
    parser.add_argument("--seed", type=int, default=1, help="fixes weights, exploration and roads (%(default)s)")
    parser.add_argument("--timesteps", type=int, default=2_000_000, help="control intervals to train for (%(default)s)")
    parser.add_argument("--num-envs", type=int, default=256, help="cars that learn at once (%(default)s)")
    parser.add_argument("--episodes", type=int, default=256, help="roads of the evaluation (%(default)s)")
    chosen = parser.parse_args()
    torch.set_num_threads(1)  # the networks are small: more threads only wait for each other

    begin = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        policy = train(chosen.seed, chosen.timesteps, chosen.num_envs, folder)
    print(f"trained in {time.process_time() - begin:.0f} s of CPU")

    def answer(observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        with torch.no_grad():
            return policy.mean(torch.from_numpy(observations)).clamp(-1, 1).numpy()

    share, error = share_of_gap(answer, chosen.episodes)
    print(f"closes {100 * share:.2f} ± {100 * error:.2f} % of the gap")


if __name__ == "__main__":
    main()
