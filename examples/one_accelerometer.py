"""What a car's sensors are worth: a Kalman filter in front of a rule that needs the whole state.

    python examples/one_accelerometer.py

takes some minutes, half a minute for each operating point to find its optimal feedback, once. The gap is that from the best
constant damping to the rule with the state known; all drive over the same roads.
"""

from __future__ import annotations

import argparse
from typing import Any

import agents
from agents.results import ratio
from roadgym.task import make_task

SENSORS = {
    "all": ["displacement", "velocity", "level", "slope"],
    "travel, velocity": ["travel", "velocity"],
    "travel, acceleration": ["travel", "acceleration"],
    "acceleration": ["acceleration"],
}


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
    parser.add_argument("--episodes", type=int, default=256, help="(%(default)s)")
    parser.add_argument("--duration", type=float, help="measured time of an episode, s (300/natural frequency)")
    parser.add_argument("--seed", type=int, default=7, help="fixes the roads (%(default)s)")
    chosen = parser.parse_args()

    plant: dict[str, Any] = {"road": chosen.road, "speed": (0.5, 3.2), "bandwidth": (0.05, 0.5)}

    def driven(environment: dict[str, Any], *names: str, estimator: str | None = None) -> list[Any]:
        """Costs of each episode, shape (points, episodes), by rule; and the degrees of freedom of their means."""
        task = make_task(**environment)
        found = agents.evaluate(
            {name: agents.make_controller(name, task, estimator=estimator) for name in names},
            environment=environment,
            speeds=chosen.speeds,
            bandwidths=chosen.bandwidths,
            episodes=chosen.episodes,
            duration=chosen.duration,
            seed=chosen.seed,
        )
        return [*(found[name].adjusted_costs for name in names), found[names[0]].degrees_of_freedom]

    best, known, freedom = driven(plant, "analytic_optimum", chosen.rule)
    for k, point in enumerate((speed, bandwidth) for speed in chosen.speeds for bandwidth in chosen.bandwidths):
        print(f"at {point}: best constant damping {best[k].mean():.4f}, {chosen.rule} {known[k].mean():.4f}")
    print("by sensors and their noise, at each of these points: cost (share of the gap)")
    for sensors in chosen.sensors:
        environment = {**plant, "observation": SENSORS[sensors], "observe_operating_point": not chosen.hide_operating_point}
        for noise in chosen.noises:
            costs, _ = driven({**environment, "sensors": {"noise": noise}}, chosen.rule, estimator="kalman")
            cells = []
            for k in range(len(costs)):
                share = ratio((best - costs)[k, None, None], (best - known)[k, None], freedom)
                cells.append(f"{costs[k].mean():.4f} ({100 * share.value:.1f} ± {50 * (share.high - share.low):.1f} %)")
            print(f"{sensors:>20} {noise:5g}: {', '.join(cells)}", flush=True)


if __name__ == "__main__":
    main()
