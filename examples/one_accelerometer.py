"""What a car's sensors are worth: a Kalman filter in front of a rule that needs the whole state, and agents beside it.

    python examples/one_accelerometer.py

takes some minutes, half a minute for each operating point to find its optimal feedback, once. The gap is that from the best
constant damping to the rule with the state known; all drive over the same roads. With ``--agents`` some learn from the same
sensors, and are kept in a folder, from which the script goes on:

    filtered    on the filter's mean, by apg;
    stacked     ppo on the last eight of what is measured;
    recurrent   ppo with a recurrent network on what is measured.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

import agents
import analysis
from agents.hyperparameters import load_hyperparameters
from agents.results import ratio
from agents.training import usual_algorithm
from roadgym.task import make_task

SENSORS = {
    "all": ["displacement", "velocity", "level", "slope"],
    "travel, velocity": ["travel", "velocity"],
    "travel, acceleration": ["travel", "acceleration"],
    "acceleration": ["acceleration"],
}
AGENTS = ("filtered", "stacked", "recurrent")


def learned(kind: str, environment: dict[str, Any], folder: Path, seed: int, timesteps: int | None) -> agents.Agent:
    """An agent of `AGENTS`, trained where the folder holds none."""
    if not (folder / "agent.json").exists():
        algorithm = {"stacked": "ppo", "recurrent": "recurrent_ppo"}.get(kind) or usual_algorithm(
            make_task(**environment), False, estimator="kalman"
        )
        chosen = load_hyperparameters(algorithm, "ppo_stacked" if kind == "stacked" else None)
        agents.train(
            folder,
            algorithm=algorithm,
            environment=environment,
            hyperparameters=chosen | ({"estimator": "kalman"} if kind == "filtered" else {}),
            seed=seed,
            timesteps=timesteps,
            report=agents.training.silent,
        )
    return agents.load(folder)


def main() -> None:
    """Drive, print."""
    parser = argparse.ArgumentParser(description="What a car's sensors are worth.")
    parser.add_argument("--road", default="gaussian", help="(%(default)s)")
    parser.add_argument("--speeds", type=float, nargs="+", default=[1.5], help="m/s (%(default)s)")
    parser.add_argument("--bandwidths", type=float, nargs="+", default=[0.1], help="of the road (%(default)s)")
    parser.add_argument(
        "--noises", type=float, nargs="+", default=[0.01, 0.05, 0.2], help="deviations of the road (%(default)s)"
    )
    parser.add_argument("--sensors", nargs="+", default=list(SENSORS), choices=SENSORS, help="(all sets)")
    parser.add_argument("--hide-operating-point", action="store_true", help="a bank of filters finds speed and bandwidth")
    parser.add_argument("--rule", default="optimal_feedback", help="(%(default)s)")
    parser.add_argument("--agents", nargs="*", default=[], choices=AGENTS, help="that learn on each set of sensors (none)")
    parser.add_argument("--output", default="runs/one_accelerometer", help="folder of the agents (%(default)s)")
    parser.add_argument("--timesteps", type=int, help="control intervals to train for (as of each algorithm)")
    parser.add_argument("--seeds", type=int, default=1, help="agents of each kind (%(default)s)")
    parser.add_argument("--episodes", type=int, default=256, help="(%(default)s)")
    parser.add_argument("--duration", type=float, help="measured time of an episode, s (300/natural frequency)")
    parser.add_argument("--seed", type=int, default=7, help="fixes the roads (%(default)s)")
    chosen = parser.parse_args()

    plant: dict[str, Any] = {"road": chosen.road, "speed": (0.5, 3.2), "bandwidth": (0.05, 0.5)}

    def driven(environment: dict[str, Any], drivers: dict[str, Any]) -> tuple[dict[str, Any], int]:
        """Costs of each episode, shape (points, episodes), by driver; and the degrees of freedom of their means."""
        found = agents.evaluate(
            drivers,
            environment=environment,
            speeds=chosen.speeds,
            bandwidths=chosen.bandwidths,
            episodes=chosen.episodes,
            duration=chosen.duration,
            seed=chosen.seed,
        )
        return {name: each.adjusted_costs for name, each in found.items()}, next(iter(found.values())).degrees_of_freedom

    task = make_task(**plant)
    known, freedom = driven(plant, {name: agents.make_controller(name, task) for name in ("analytic_optimum", chosen.rule)})
    best, full = known["analytic_optimum"], known[chosen.rule]
    points = [(speed, bandwidth) for speed in chosen.speeds for bandwidth in chosen.bandwidths]
    for point, constant, feedback in zip(points, best, full, strict=True):
        bound = analysis.lower_bound(task, speed=point[0], bandwidth=point[1])  # of who knows the whole state, so of all
        found = f"best constant damping {constant.mean():.4f}, {chosen.rule} {feedback.mean():.4f}"
        print(f"at {point}: no controller below {bound.cost:.4f}, {found}")
    print("by sensors and their noise, at each of these points: cost (share of the gap); and the mean share")
    for sensors in chosen.sensors:
        measured = {**plant, "observation": SENSORS[sensors], "observe_operating_point": not chosen.hide_operating_point}
        for noise in chosen.noises:
            environment = {**measured, "sensors": {"noise": noise}}
            rule = agents.make_controller(chosen.rule, make_task(**environment), estimator="kalman")
            drivers: dict[str, list[Any]] = {"rule on the filter": [rule]}
            where = f"{'-'.join(SENSORS[sensors])}-{noise:g}{'-hidden' * chosen.hide_operating_point}"
            for kind in chosen.agents:
                folders = [Path(chosen.output) / f"{kind}-{where}-{seed}" for seed in range(chosen.seeds)]
                drivers[kind] = [
                    learned(kind, environment, folder, seed, chosen.timesteps) for seed, folder in enumerate(folders)
                ]
            those = {f"{name} {seed}": driver for name, several in drivers.items() for seed, driver in enumerate(several)}
            costs, _ = driven(environment, those)
            for name, several in drivers.items():
                own = np.stack([costs[f"{name} {seed}"] for seed in range(len(several))], axis=1)
                cells = []
                for k in range(len(points)):
                    share = ratio((best[:, None] - own)[k, None], (best - full)[k, None], freedom)
                    half = 50 * (share.high - share.low)
                    cells.append(f"{own[k].mean():.4f} ({100 * share.value:.1f} ± {half:.1f} %)")
                mean = ratio(best[:, None] - own, best - full, freedom)
                cells.append(f"mean {100 * mean.value:.1f} ± {50 * (mean.high - mean.low):.1f} %")
                print(f"{sensors:>20} {noise:5g} {name:>18}: {', '.join(cells)}", flush=True)


if __name__ == "__main__":
    main()
