"""Train an agent over a range of roads, then compare it with the best constant damping and with skyhook.

    python examples/train_and_compare.py --output runs/example

takes about two minutes. The agent is trained once: with the same folder the script goes on from what it finds there. Every
controller drives over the same roads, so what the agent saves is known far better than the costs themselves.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

import agents
from roadgym.task import make_task

ENVIRONMENT: dict[str, Any] = {
    "road": "multiplicative",
    "speed": (0.5, 3.2),
    "bandwidth": (0.05, 0.5),
    "damping_range": (0.05, 1.0),
}
RIVALS = ("analytic_optimum", "skyhook")
SPEEDS, BANDWIDTHS = (0.7, 1.0, 1.5, 2.0, 3.0), (0.1, 0.3)


def main() -> None:
    """Train or load, drive, print."""
    parser = argparse.ArgumentParser(description="An agent against the best constant damping and skyhook.")
    parser.add_argument("--output", default="runs/example", help="folder of the agent (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="fixes training and evaluation (%(default)s)")
    parser.add_argument("--timesteps", type=int, help="control intervals to train for (those of the hyperparameters)")
    parser.add_argument("--episodes", type=int, default=256, help="at each operating point (%(default)s)")
    parser.add_argument("--duration", type=float, default=300.0, help="measured time of an episode, s (%(default)s)")
    chosen = parser.parse_args()

    folder = Path(chosen.output)
    if not (folder / "agent.json").exists():
        agents.train(folder, environment=ENVIRONMENT, seed=chosen.seed, timesteps=chosen.timesteps)
    agent = agents.load(folder)
    print(f"{folder}: {agent.description['algorithm']}, {agent.description['timesteps']} steps")

    # Anything with predict() can be evaluated; agents and classical controllers both answer with damping ratios.
    task = make_task(**ENVIRONMENT)
    results = agents.evaluate(
        {"agent": agent, **{name: agents.make_controller(name, task) for name in RIVALS}},
        environment=ENVIRONMENT,
        speeds=SPEEDS,
        bandwidths=BANDWIDTHS,
        episodes=chosen.episodes,
        duration=chosen.duration,
        seed=chosen.seed,
    )

    print(f"{'speed':>6}{'bandwidth':>11}" + "".join(f"{name:>20}" for name in (*results, "agent saves")))
    driven, best = results["agent"], results["analytic_optimum"]
    for k, point in enumerate(driven.points):
        cells = [f"{result.mean[k]:.4f} ± {result.standard_error[k]:.4f}" for result in results.values()]
        # adjusted_costs has the shape (points, episodes); episode i met the same road under each controller
        saved = best.adjusted_costs[k] - driven.adjusted_costs[k]
        error = saved.std(ddof=1) / np.sqrt(saved.size)
        cells.append(f"{saved.mean():.4f} ± {error:.4f}")
        print(f"{point.speed:6g}{point.bandwidth:11g}" + "".join(f"{cell:>20}" for cell in cells))


if __name__ == "__main__":
    main()
