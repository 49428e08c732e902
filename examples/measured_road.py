"""From a measured road to an agent: fit a bounded road to the profile, train on that, and drive on the profile itself.

    python examples/measured_road.py --profile profile.csv --output runs/measured

takes some minutes. Without a file one is made, of class C, with longer waves than the standard's. The fitted road
never repeats itself, so an agent cannot learn the profile by heart; what it loses against driving on the road it was trained on
is told beside what the best constant damping loses.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np

import agents
import analysis
import roadgym
from roadgym.task import make_task

LONGEST_WAVE = 100.0  # m; hills are no business of a suspension
OBSERVATION = ("velocity", "wheel_velocity", "travel", "tyre_deflection", "speed")  # what the road is like is not among them


def find_road(profile: roadgym.Profile) -> tuple[roadgym.ProfileRoad, roadgym.MultiplicativeRoad]:
    """The profile as a road without its hills, and a bounded road that has its spectrum in the waves that shake a car.

    A profile of some hundred metres does not tell where the spectrum levels off; there it does at `LONGEST_WAVE`.
    """
    measured = roadgym.ProfileRoad(heights=tuple(profile.heights), spacing=profile.spacing, longest_wave=LONGEST_WAVE)
    found = analysis.identify(profile.heights, profile.spacing)
    highest = found.corners[1][0] if found.corners else 10.0

    def bounded(roughness: float) -> roadgym.MultiplicativeRoad:
        return roadgym.MultiplicativeRoad.from_iso8608(
            roughness, lowest_frequency=1 / LONGEST_WAVE, highest_frequency=highest, shape=2.0
        )

    def density(road: roadgym.roads.Road) -> float:
        """At waves of 5 m, over which the body resonates at 20 m/s or so."""
        return float(analysis.spectral_density(road, 2 * math.pi / 5, speed=1.0))

    return measured, bounded(1e-4 * density(found.second_order.road) / density(bounded(1e-4)))


def main() -> None:
    """Read, fit, train or load, drive, print."""
    parser = argparse.ArgumentParser(description="An agent that is trained on a fitted road and driven on the measured one.")
    parser.add_argument("--profile", help="file of distances and heights (one is made)")
    parser.add_argument("--output", default="runs/measured", help="folder of the agent (%(default)s)")
    parser.add_argument("--car", default="two_mass", help="the car (%(default)s)")
    parser.add_argument("--speed", type=float, default=20.0, help="m/s (%(default)s)")
    parser.add_argument("--timesteps", type=int, default=300_000, help="control intervals to train for (%(default)s)")
    parser.add_argument("--episodes", type=int, default=128, help="(%(default)s)")
    parser.add_argument("--duration", type=float, default=20.0, help="measured time of an episode, s (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="fixes the roads (%(default)s)")
    chosen = parser.parse_args()

    if chosen.profile is None:
        known = roadgym.PowerLawRoad.from_iso8608("C", waviness=2.3)
        distance, heights = roadgym.sample_road(known, spacing=0.1, points=10_000, seed=chosen.seed)
        profile = roadgym.Profile(distance=distance, heights=heights[0])
    else:
        profile = roadgym.read_profile(chosen.profile)
    measured, fitted = find_road(profile)
    length = profile.spacing * (len(profile.heights) - 1)
    print(f"{length:.0f} m, every {profile.spacing:g} m; fitted: {fitted}")

    plant: dict[str, Any] = {"car": chosen.car, "speed": chosen.speed, "observation": OBSERVATION}
    folder = Path(chosen.output)
    if not (folder / "agent.json").exists():
        environment = {**plant, "road": fitted, "observe_operating_point": False}
        agents.train(folder, environment=environment, seed=chosen.seed, timesteps=chosen.timesteps)
    agent = agents.load(folder)

    costs = {}
    for name, road in (("the fitted road", fitted), ("the profile", measured)):
        environment = {**plant, "road": road}
        task = make_task(**environment)
        result = agents.evaluate(
            {"agent": agent, "skyhook": agents.make_controller("skyhook", make_task(**{**environment, "observation": None}))},
            environment=environment,
            speeds=[chosen.speed],
            bandwidths=[getattr(road, "bandwidth", 0.0)],
            episodes=chosen.episodes,
            duration=chosen.duration,
            seed=chosen.seed,
        )
        best = analysis.optimal_damping(
            road, speed=chosen.speed, car=task.car, weights=task.reward_by_name, bounds=task.damping_range
        )
        costs[name] = {"best constant D": (float(best.cost), 0.0)}
        costs[name] |= {who: (float(each.mean[0]), float(each.standard_error[0])) for who, each in result.items()}
        print(f"on {name}: best constant D {float(best.damping):.3f}")
        for who, (cost, error) in costs[name].items():
            share = cost / float(best.cost)
            print(f"{who:>18} {cost:.4f} ± {error:.4f} (m/s²)², {share:.3f} of the best constant damping")
    shares = [costs[name]["agent"][0] / costs[name]["best constant D"][0] for name in costs]
    print(f"lost on the way to the profile: {100 * (shares[1] - shares[0]):+.1f} % of the best constant damping's cost")
    carried = analysis.optimal_damping(fitted, speed=chosen.speed, car=chosen.car, weights={"acceleration": 1.0}).damping
    there = analysis.mean_squares(measured, speed=chosen.speed, car=chosen.car, damping=carried).acceleration
    lost = float(there) / costs["the profile"]["best constant D"][0] - 1
    print(f"the constant damping that is best on the fitted road loses {100 * np.maximum(lost, 0):.2f} % there")


if __name__ == "__main__":
    main()
