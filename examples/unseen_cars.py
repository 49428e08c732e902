"""What it is worth to learn on cars that differ, where the car that is driven was never seen.

    python examples/unseen_cars.py --output runs/unseen_cars

trains agents on a quarter car of two masses on a road of ISO 8608 that meet

    nominal     the car as it is told, with an ideal valve;
    lags        that car behind a valve whose lag is drawn for each episode;
    all         cars with a mass, a spring, a tyre and a lag of their own, drawn for each episode;
    apg         the same cars,

and drives them on cars that none of them has met: each episode another one of that law, the same for every agent; and on the
nominal car, behind valves of several lags. Nobody is told what was drawn. Those of *apg* learn by analytic policy gradient,
which knows the equations of each car, all others by PPO from the cost alone. Agents are trained once: with the same folder the
script goes on from what it finds there.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

import agents
from agents.comparison import make_rivals
from agents.hyperparameters import load_hyperparameters
from roadgym import TwoMassCar
from roadgym.task import make_task

CAR = TwoMassCar()
LAG = 0.03  # s, the longest
CARS = {  # field: nominal value, and by what share of it at most it differs
    "sprung_mass": (CAR.sprung_mass, 0.25),
    "spring_rate": (CAR.spring_rate, 0.2),
    "tyre_rate": (CAR.tyre_rate, 0.2),
}
LAGS = {"valve.rise_time": (0.0, LAG), "valve.fall_time": (0.0, LAG)}
LAW = {name: (value * (1 - share), value * (1 + share)) for name, (value, share) in CARS.items()} | LAGS
LEARNERS: dict[str, tuple[str, dict[str, Any]]] = {  # algorithm, and what it is trained on
    "nominal": ("ppo", {}),
    "lags": ("ppo", {"vary": LAGS}),
    "all": ("ppo", {"vary": LAW}),
    "apg": ("apg", {"vary": LAW}),
}
PLAIN = load_hyperparameters("ppo", "ppo_plain") | {
    "n_envs": 64,
    "n_steps": 64,
    "batch_size": 512,
    "n_timesteps": 1_000_000,
    "gae_lambda": 0.95,  # behind a slow valve what an action does comes later
}
HYPERPARAMETERS = {"ppo": PLAIN, "apg": load_hyperparameters("apg")}


def main() -> None:
    """Train or load, drive, print."""
    parser = argparse.ArgumentParser(description="Agents on cars that they have not met.")
    parser.add_argument("--output", default="runs/unseen_cars", help="folder of the agents (%(default)s)")
    parser.add_argument("--road", default="iso_c", help="class of the road (%(default)s)")
    parser.add_argument("--speed", type=float, default=20.0, help="m/s (%(default)s)")
    parser.add_argument("--seeds", type=int, default=2, help="agents of each kind (%(default)s)")
    parser.add_argument("--timesteps", type=int, help="control intervals to train for (as of each algorithm)")
    parser.add_argument("--learners", nargs="*", default=list(LEARNERS), choices=LEARNERS, help="(all)")
    parser.add_argument("--rules", nargs="*", default=["skyhook_continuous", "clipped_lqr"], help="(%(default)s)")
    parser.add_argument("--lags", type=float, nargs="*", default=[0.0, 10.0, 20.0, 30.0], metavar="MS", help="(%(default)s)")
    parser.add_argument("--episodes", type=int, default=256, help="each with a car of its own (%(default)s)")
    parser.add_argument("--duration", type=float, default=10.0, help="measured time of an episode, s (%(default)s)")
    chosen = parser.parse_args()

    plant: dict[str, Any] = {"road": chosen.road, "speed": chosen.speed, "car": CAR, "control_interval": 0.01}
    learned: dict[str, list[agents.Agent]] = {}
    for name in chosen.learners:
        algorithm, own = LEARNERS[name]
        for seed in range(chosen.seeds):
            folder = Path(chosen.output) / f"{name}-{seed}"
            if not (folder / "agent.json").exists():
                agents.train(
                    folder,
                    algorithm=algorithm,
                    environment=plant | own,
                    hyperparameters=HYPERPARAMETERS[algorithm],
                    seed=seed,
                    timesteps=chosen.timesteps,
                    report=agents.training.silent,
                )
            learned.setdefault(name, []).append(agents.load(folder))
    rivals = make_rivals(make_task(**plant), chosen.rules)  # the best constant damping, and rules, all of the nominal car
    drivers = {f"{name} {seed}": agent for name, those in learned.items() for seed, agent in enumerate(those)} | rivals

    places: dict[str, dict[str, Any]] = {"unseen cars": {"vary": LAW}}
    places |= {f"lag {lag:g} ms": {"valve": {"rise_time": lag / 1e3, "fall_time": lag / 1e3}} for lag in chosen.lags}
    print("saved of the cost of the best constant damping of the nominal car, in per cent, with standard errors")
    print(f"{'':>15}", *(f"{name:>18}" for name in (*rivals, *learned)))
    for where, own in places.items():
        # paired: episode i has the same road and the same car whoever drives
        results = agents.evaluate(
            drivers,
            environment=plant | own,
            speeds=[chosen.speed],
            episodes=chosen.episodes,
            duration=chosen.duration,
            transient=3.0,
            seed=7,
        )
        best = results["analytic_optimum"].adjusted_costs[0]
        cells = []
        for name in (*rivals, *learned):
            those = [results[f"{name} {seed}"] for seed in range(chosen.seeds)] if name in learned else [results[name]]
            costs = np.array([result.adjusted_costs[0] for result in those])
            share = 1 - costs.mean() / best.mean()
            left = (best - costs.mean(axis=0) - share * best) / best.mean()
            error = np.hypot(
                left.std(ddof=1) / np.sqrt(left.size), costs.mean(axis=1).std() / best.mean() / np.sqrt(len(costs))
            )
            cells.append(f"{100 * share:.2f} ± {100 * error:.2f}")
        print(f"{where:>15}", *(f"{cell:>18}" for cell in cells), flush=True)


if __name__ == "__main__":
    main()
