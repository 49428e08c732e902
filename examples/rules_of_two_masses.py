"""What rules of semi-active damping cost on a car of two masses, over the best constant damping, on a road of ISO 8608.

    python examples/rules_of_two_masses.py

takes some minutes, a minute or two for each reward of them to find the best feedback, once. Every rule drives over the same
roads, so what one saves over another is known far better than the costs themselves.
"""

from __future__ import annotations

import argparse

import numpy as np

import agents
from agents.comparison import make_rivals
from roadgym import TwoMassCar
from roadgym.task import make_task

CAR = TwoMassCar(
    sprung_mass=400.0,
    unsprung_mass=50.0,
    spring_rate=30e3,
    tyre_rate=250e3,
    damping_coefficients=(300.0, 3900.0),
)
FOURTH = CAR.natural_frequency**4  # makes squared lengths comparable to squared accelerations
REWARDS = {
    "comfort": {"acceleration": 1.0},
    "comfort and grip": {"acceleration": 1.0, "tyre_deflection": 5 * FOURTH},
    "comfort, grip and travel": {"acceleration": 1.0, "travel": FOURTH / 2, "tyre_deflection": 5 * FOURTH},
}
RULES = (
    "skyhook",
    "skyhook_continuous",
    "groundhook",
    "hybrid",
    "add",
    "mixed_skyhook_add",
    "one_sensor_mix",
    "power_driven",
    "clipped_lqr",
    "one_step_lookahead",
    "mixed_lookahead",
    "optimal_feedback",
)


def main() -> None:
    """Tune, drive, print."""
    parser = argparse.ArgumentParser(description="Rules of semi-active damping on a car of two masses.")
    parser.add_argument("--road", default="iso_c", help="class of the road (%(default)s)")
    parser.add_argument("--speed", type=float, default=20.0, help="m/s (%(default)s)")
    parser.add_argument("--rewards", nargs="+", default=list(REWARDS), choices=REWARDS, help="(all)")
    parser.add_argument("--rules", nargs="+", default=list(RULES), choices=RULES, help="(all)")
    parser.add_argument("--episodes", type=int, default=512, help="(%(default)s)")
    parser.add_argument("--duration", type=float, help="measured time of an episode, s (300/natural frequency)")
    parser.add_argument("--seed", type=int, default=7, help="fixes the roads (%(default)s)")
    chosen = parser.parse_args()

    for name in chosen.rewards:
        environment = {"road": chosen.road, "speed": chosen.speed, "car": CAR, "reward": REWARDS[name]}
        rivals = make_rivals(make_task(**environment), chosen.rules)  # tuned where they have a parameter
        results = agents.evaluate(
            rivals,
            environment=environment,
            speeds=[chosen.speed],
            episodes=chosen.episodes,
            duration=chosen.duration,
            seed=chosen.seed,
        )
        best = results.pop("analytic_optimum").adjusted_costs[0]
        print(f"{name}: the best constant damping costs {best.mean():.4g}; over it")
        for rule, result in results.items():
            ratio = result.mean[0] / best.mean()
            error = (result.adjusted_costs[0] - ratio * best).std(ddof=1) / np.sqrt(best.size) / best.mean()
            parameters = "".join(f", {parameter} = {value:g}" for parameter, value in rivals[rule].parameters.items())
            print(f"{rule:>20} {ratio:.4f} ± {error:.4f}{parameters}")


if __name__ == "__main__":
    main()
