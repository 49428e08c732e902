"""Your own training loop on the batch environment: proximal policy optimisation (PPO) in one file, in the style of CleanRL.

    python examples/own_training_loop.py

trains for about a minute at one operating point, then drives the policy and the best constant damping over the same roads
and prints what both cost, beside what theory says of the constant one.

Two things about this environment are easy to get wrong, and are marked in the code:

- Episodes never terminate: a time limit cuts them. The value of the state they are cut in belongs in the return.
- The batch starts a new episode one step after the last one ended (Gymnasium's autoreset mode NEXT_STEP). That step ignores
  the action and pays nothing; it is no transition, and is not learned from.

Source: J. Schulman et al., "Proximal policy optimization algorithms", 2017; "generalised advantage estimation", 2015.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
import torch
from torch import nn

import analysis
import roadgym

Floats = npt.NDArray[np.float32]

DAMPING = (0.05, 1.0)
ROAD = roadgym.MultiplicativeRoad.from_shape(shape=2.0, bandwidth=0.1, level_bound=1.0)
SPEED = 1.5
TRAINING, EVALUATION = 0, 1  # what a seed is for
GAMMA, LAMBDA, CLIP, ENTROPY = 0.99, 0.95, 0.2, 0.002
EPOCHS, MINIBATCHES, LEARNING_RATE = 5, 8, 2e-3


class Agent(nn.Module):
    """A Gaussian policy on [-1, 1] and a value, from observations of shape (n, signals).

    Args:
        signals: size of an observation.
        generator: source of the initial weights and of the exploration.
    """

    def __init__(self, signals: int, generator: torch.Generator) -> None:
        super().__init__()
        self.generator = generator
        self.policy, self.value = self._network(signals, 0.01), self._network(signals, 1.0)
        self.log_std = nn.Parameter(torch.zeros(1))

    def _network(self, signals: int, gain: float) -> nn.Sequential:
        first, second, last = nn.Linear(signals, 128), nn.Linear(128, 64), nn.Linear(64, 1)
        for layer, scale in ((first, 2**0.5), (second, 2**0.5), (last, gain)):
            nn.init.orthogonal_(layer.weight, scale, generator=self.generator)
            nn.init.zeros_(layer.bias)
        return nn.Sequential(first, nn.ReLU(), second, nn.ReLU(), last)

    def act(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """An action drawn from the policy, and its log-probability; shape (n,) each."""
        mean = self.policy(observation).squeeze(-1)
        noise = torch.randn(mean.shape, generator=self.generator)
        return mean + noise * self.log_std.exp(), self.log_probability(noise)

    def log_probability(self, noise: torch.Tensor) -> torch.Tensor:
        """Log-density of an action that is ``noise`` standard deviations off the mean."""
        density: torch.Tensor = -0.5 * noise**2 - self.log_std - 0.5 * np.log(2 * np.pi)
        return density


def damping_from(action: torch.Tensor) -> Floats:
    """Damping ratios, shape (n, 1), for actions in [-1, 1], shape (n,); what lies outside saturates."""
    low, high = DAMPING
    return np.asarray(low + (action.numpy()[:, None] + 1) * (high - low) / 2, np.float32)


def base_seed(seed: int, purpose: int) -> int:
    """Seed of a batch. Its car i has this seed + i: batches seeded 1 and 2 would share all roads but one."""
    return int(np.random.SeedSequence((seed, purpose)).generate_state(1)[0])


def make_envs(num_envs: int, **options: Any) -> gym.vector.VectorEnv[Floats, Floats, Any]:
    """The native batch, not ``num_envs`` objects."""
    plant: dict[str, Any] = {"road": ROAD, "speed": SPEED, "damping_range": DAMPING}
    return gym.make_vec(roadgym.ENVIRONMENT_ID, num_envs=num_envs, **plant, **options)


def train(seed: int, timesteps: int, num_envs: int = 256, steps: int = 64) -> Agent:
    """Train an agent for ``timesteps`` control intervals over all environments."""
    envs = make_envs(num_envs)
    generator = torch.Generator().manual_seed(seed)
    observation = torch.from_numpy(envs.reset(seed=base_seed(seed, TRAINING))[0])  # shape (num_envs, signals)
    agent = Agent(observation.shape[1], generator)
    optimizer = torch.optim.Adam(agent.parameters(), LEARNING_RATE, eps=1e-5)
    fresh = torch.zeros(num_envs, dtype=torch.bool)  # is the next step only a reset

    observations = torch.zeros((steps + 1, num_envs, observation.shape[1]))
    actions, log_probabilities, rewards = (torch.zeros((steps, num_envs)) for _ in range(3))
    truncated, valid = (torch.zeros((steps, num_envs), dtype=torch.bool) for _ in range(2))
    iterations = max(timesteps // (steps * num_envs), 1)
    for iteration in range(iterations):
        optimizer.param_groups[0]["lr"] = LEARNING_RATE * (1 - iteration / iterations)
        for t in range(steps):
            observations[t] = observation
            with torch.no_grad():
                actions[t], log_probabilities[t] = agent.act(observation)
            seen, reward, _, ended, _ = envs.step(damping_from(actions[t]))
            observation = torch.from_numpy(seen)
            rewards[t] = torch.from_numpy(reward) * (1 - GAMMA)  # so values are of order one
            valid[t] = ~fresh  # a step that only resets is no transition
            truncated[t] = fresh = torch.from_numpy(ended)
        observations[steps] = observation

        # The observation after a truncated step is the last one of its episode: its value is the one to bootstrap
        # from, and none is replaced by zero, as nothing terminates. Only the sum over later steps stops there.
        with torch.no_grad():
            values = agent.value(observations).squeeze(-1)
        surprises = rewards + GAMMA * values[1:] - values[:-1]
        advantages = torch.zeros_like(rewards)
        later = torch.zeros(num_envs)
        for t in reversed(range(steps)):
            later = surprises[t] + GAMMA * LAMBDA * later * ~truncated[t]
            advantages[t] = later

        chosen = valid.reshape(-1).nonzero().squeeze(-1)
        batch = [part.reshape(steps * num_envs, *part.shape[2:]) for part in (observations[:-1], actions, log_probabilities)]
        advantage, target = advantages.reshape(-1), (advantages + values[:-1]).reshape(-1)
        for _ in range(EPOCHS):
            for rows in chosen[torch.randperm(len(chosen), generator=generator)].chunk(MINIBATCHES):
                state, action, old = (part[rows] for part in batch)
                noise = (action - agent.policy(state).squeeze(-1)) / agent.log_std.exp()
                ratio = (agent.log_probability(noise) - old).exp()
                gain = (advantage[rows] - advantage[rows].mean()) / (advantage[rows].std() + 1e-8)
                policy_loss = -torch.min(ratio * gain, ratio.clamp(1 - CLIP, 1 + CLIP) * gain).mean()
                value_loss = (agent.value(state).squeeze(-1) - target[rows]).square().mean()
                loss = policy_loss + 0.5 * value_loss - ENTROPY * agent.log_std.mean()
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
                optimizer.step()
        if iteration % 20 == 19:
            done, cost = (iteration + 1) * steps * num_envs, -rewards[valid].mean() / (1 - GAMMA)
            print(f"{done:8d} steps: mean cost {cost:.3f}, exploration ± {agent.log_std.exp().item():.2f}")
    return agent


def drive(driver: Agent | None, damping: float, seed: int, cars: int, steps: int) -> npt.NDArray[np.float64]:
    """Mean cost of each car, shape (cars,), after a transient of 500 steps; at a constant damping where nobody drives."""
    envs = make_envs(cars, max_episode_steps=None)
    observation, _ = envs.reset(seed=base_seed(seed, EVALUATION))
    action = np.full((cars, 1), damping, np.float32)
    costs = np.zeros(cars)
    for step in range(500 + steps):
        if driver is not None:
            with torch.no_grad():
                action = damping_from(driver.policy(torch.from_numpy(observation)).squeeze(-1))
        observation, reward, *_ = envs.step(action)
        costs -= reward if step >= 500 else 0.0
    return costs / steps


def main() -> None:
    """Train, then compare with the best constant damping."""
    parser = argparse.ArgumentParser(description="PPO in one file against the best constant damping.")
    parser.add_argument("--seed", type=int, default=1, help="fixes weights, exploration and roads (%(default)s)")
    parser.add_argument("--timesteps", type=int, default=2_000_000, help="control intervals to train for (%(default)s)")
    parser.add_argument("--cars", type=int, default=1024, help="cars of the evaluation (%(default)s)")
    parser.add_argument("--steps", type=int, default=1500, help="measured control intervals of each (%(default)s)")
    chosen = parser.parse_args()
    torch.set_num_threads(1)  # the networks are small: more threads only wait for each other

    begin = time.perf_counter()
    agent = train(chosen.seed, chosen.timesteps)
    print(f"trained in {time.perf_counter() - begin:.0f} s")

    best = analysis.optimal_damping(ROAD, speed=SPEED, bounds=DAMPING)
    constant, learned = (drive(driver, float(best.damping), chosen.seed, chosen.cars, chosen.steps) for driver in (None, agent))
    error = np.sqrt(chosen.cars)
    print(f"best constant damping {best.damping:.3f}: cost {best.cost:.4f} by theory,", end=" ")
    print(f"{constant.mean():.4f} ± {constant.std(ddof=1) / error:.4f} driven")
    print(f"trained policy: cost {learned.mean():.4f} ± {learned.std(ddof=1) / error:.4f}")
    # both drove over the same roads, so the difference is known better than either cost
    saved = constant - learned
    print(f"saved: {saved.mean():.4f} ± {saved.std(ddof=1) / error:.4f} of {constant.mean():.4f}")


if __name__ == "__main__":
    main()
