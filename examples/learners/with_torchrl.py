"""PPO of TorchRL on the native batch.

    pip install torchrl
    python examples/learners/with_torchrl.py

TorchRL takes a batch of Gymnasium in the autoreset modes SAME_STEP and DISABLED, and refuses NEXT_STEP, the default. With
DISABLED it resets by itself where an episode is over, so truncations come out as they are: the value of the last observation is
bootstrapped. Its distribution takes the range of the action from the environment, so nothing has to be rescaled.
"""

from __future__ import annotations

import argparse
import time

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import torch
from share import ENVIRONMENT, share_of_gap
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import roadgym

ROLLOUT, GAMMA, LAMBDA, EPOCHS, MINIBATCHES, LEARNING_RATE = 64, 0.99, 0.95, 5, 8, 2e-3


def network(signals: int, outputs: int) -> nn.Sequential:
    """Numbers for each observation."""
    return nn.Sequential(nn.Linear(signals, 128), nn.ReLU(), nn.Linear(128, 64), nn.ReLU(), nn.Linear(64, outputs))


def train(seed: int, timesteps: int, num_envs: int) -> nn.Module:
    """A network trained for ``timesteps`` control intervals over all environments; its first output says the action."""
    torch.manual_seed(seed)
    batch = gym.make_vec(roadgym.ENVIRONMENT_ID, num_envs=num_envs, autoreset_mode="DISABLED", **ENVIRONMENT)
    env = GymWrapper(batch)
    env.set_seed(seed)
    signals, space = batch.single_observation_space.shape[0], batch.single_action_space
    policy = nn.Sequential(network(signals, 2), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(policy, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=env.full_action_spec_unbatched,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": torch.tensor(space.low), "high": torch.tensor(space.high)},
        return_log_prob=True,
    )
    critic = ValueOperator(network(signals, 1), in_keys=["observation"])
    advantage = GAE(gamma=GAMMA, lmbda=LAMBDA, value_network=critic)
    loss = ClipPPOLoss(
        actor, critic, clip_epsilon=0.2, entropy_coeff=1e-3, critic_coeff=0.5, loss_critic_type="l2", normalize_advantage=True
    )
    optimizer = torch.optim.Adam(loss.parameters(), LEARNING_RATE, eps=1e-5)
    frames = ROLLOUT * num_envs
    collector = Collector(
        env,
        actor,
        frames_per_batch=frames,
        total_frames=max(timesteps // frames, 1) * frames,
        auto_register_policy_transforms=False,
    )
    for drive in collector:  # shape (num_envs, ROLLOUT)
        drive["next", "reward"] *= 1 - GAMMA  # so values are of order one
        with torch.no_grad():
            advantage(drive)
        rows = drive.reshape(-1)
        for _ in range(EPOCHS):
            for chosen in torch.randperm(frames).chunk(MINIBATCHES):
                losses = loss(rows[chosen])
                optimizer.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimizer.step()
    collector.shutdown()
    return policy


def main() -> None:
    """Train, then tell the share of the gap."""
    parser = argparse.ArgumentParser(description="PPO of TorchRL at one operating point.")
    parser.add_argument("--seed", type=int, default=1, help="fixes weights, exploration and roads (%(default)s)")
    parser.add_argument("--timesteps", type=int, default=2_000_000, help="control intervals to train for (%(default)s)")
    parser.add_argument("--num-envs", type=int, default=256, help="cars that learn at once (%(default)s)")
    parser.add_argument("--episodes", type=int, default=256, help="roads of the evaluation (%(default)s)")
    chosen = parser.parse_args()
    torch.set_num_threads(1)  # the networks are small: more threads only wait for each other

    begin = time.process_time()
    policy = train(chosen.seed, chosen.timesteps, chosen.num_envs)
    print(f"trained in {time.process_time() - begin:.0f} s of CPU")

    def answer(observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        with torch.no_grad():
            return policy(torch.from_numpy(observations))[0].tanh().numpy()

    share, error = share_of_gap(answer, chosen.episodes)
    print(f"closes {100 * share:.2f} ± {100 * error:.2f} % of the gap")


if __name__ == "__main__":
    main()
