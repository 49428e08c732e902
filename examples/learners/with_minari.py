"""A data set of drives with Minari: recorded, loaded, and learned from by imitation.

    pip install 'minari[create]'
    python examples/learners/with_minari.py

A classical rule drives, with some noise on its answers, and Minari writes observations, actions, rewards and infos to a folder.
Whoever loads them finds the environment too, road, car, sensors and all, as a data set holds the specification of what it was
recorded on. Here a network then imitates the actions, which is the simplest thing to do with a data set.
"""

from __future__ import annotations

import argparse
import os
import tempfile

import gymnasium as gym
import minari
import numpy as np
import numpy.typing as npt
import torch
from share import ENVIRONMENT, share_of_gap
from torch import nn

import agents
import roadgym
from roadgym.task import make_task

DATA_SET = "roadgym/rule-v0"


def record(rule: str, drives: int, seed: int) -> None:
    """Write a data set of ``drives`` episodes of a rule, with noise on its answers."""
    generator = np.random.default_rng(seed)
    env = minari.DataCollector(gym.make(roadgym.ENVIRONMENT_ID, **ENVIRONMENT), record_infos=True)
    controller = agents.make_controller(rule, make_task(**ENVIRONMENT))
    low, high = controller.task.damping_range
    for drive in range(drives):
        observation, _ = env.reset(seed=seed if drive == 0 else None)
        over = False
        while not over:
            damping, _ = controller.predict(observation[None])
            noisy = np.clip(damping[0] + 0.1 * generator.standard_normal(1, np.float32), low, high)
            observation, _, _, over, _ = env.step(noisy)
    told = {"author": "nobody", "author_email": "none", "code_permalink": "none"}  # for a data set that is published
    description = f"{rule}, with noise of .1 on its damping ratio"
    env.create_dataset(DATA_SET, eval_env=env.env, algorithm_name=rule, description=description, **told)
    env.close()


def imitate(data: minari.MinariDataset, seed: int, epochs: int = 20) -> nn.Module:
    """A network that answers as the data set does, by least squares; actions in [-1, 1] for observations."""
    torch.manual_seed(seed)
    low, high = data.action_space.low, data.action_space.high
    episodes = list(data)
    seen = torch.from_numpy(np.concatenate([episode.observations[:-1] for episode in episodes]))  # the last has no action
    done = torch.from_numpy(np.concatenate([2 * (episode.actions - low) / (high - low) - 1 for episode in episodes]))
    network = nn.Sequential(
        nn.Linear(seen.shape[1], 128), nn.ReLU(), nn.Linear(128, 64), nn.ReLU(), nn.Linear(64, 1), nn.Tanh()
    )
    optimizer = torch.optim.Adam(network.parameters(), 2e-3)
    for _ in range(epochs):
        for rows in torch.randperm(len(seen)).split(512):
            optimizer.zero_grad()
            (network(seen[rows]) - done[rows]).square().mean().backward()
            optimizer.step()
    return network


def main() -> None:
    """Record, load, imitate, tell the share of the gap."""
    parser = argparse.ArgumentParser(description="Imitation of a rule from a data set of Minari.")
    parser.add_argument("--rule", default="skyhook", help="what drives (%(default)s)")
    parser.add_argument("--drives", type=int, default=100, help="episodes of the data set (%(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="fixes roads, noise and weights (%(default)s)")
    parser.add_argument("--episodes", type=int, default=256, help="roads of the evaluation (%(default)s)")
    chosen = parser.parse_args()
    torch.set_num_threads(1)  # the networks are small: more threads only wait for each other

    with tempfile.TemporaryDirectory() as folder:
        os.environ["MINARI_DATASETS_PATH"] = folder  # without it, in the home folder, to be kept
        record(chosen.rule, chosen.drives, chosen.seed)
        data = minari.load_dataset(DATA_SET)
        env = data.recover_environment()
        same = env.unwrapped.task == make_task(**ENVIRONMENT)
        print(f"{data.total_episodes} drives, {data.total_steps} steps; the environment is recovered: {same}")
        network = imitate(data, chosen.seed)

    def answer(observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        with torch.no_grad():
            return network(torch.from_numpy(observations)).numpy()

    share, error = share_of_gap(answer, chosen.episodes)
    print(f"closes {100 * share:.2f} ± {100 * error:.2f} % of the gap")


if __name__ == "__main__":
    main()
