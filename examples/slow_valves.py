"""What a slow valve costs the rules of two masses, over the best constant damping, on a road of ISO 8608.

    python examples/slow_valves.py

takes a quarter of an hour on one core. Each line is a valve: a lag, a delay, or a number of levels, and nothing else. Rules
with a parameter are tuned behind that valve, or with ``--unaware`` on the ideal one. With ``--agents`` three drive too that see
the state, and not what the valve does: one that has learned with an ideal valve, one that has learned behind that valve, and
one that has met another lag, up and down, and another delay in each episode, up to the longest that are asked for. They are
kept in a folder, from which the script goes on.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import agents
from agents.comparison import make_rivals
from agents.theory import optimum
from roadgym import TwoMassCar, Valve
from roadgym.task import make_task

CAR = TwoMassCar(
    sprung_mass=400.0,
    unsprung_mass=50.0,
    spring_rate=30e3,
    tyre_rate=250e3,
    damping_coefficients=(300.0, 3900.0),
)
REWARD = {"acceleration": 1.0, "tyre_deflection": 5 * CAR.natural_frequency**4}  # comfort and grip
RULES = ("skyhook_continuous", "hybrid", "clipped_lqr", "mixed_lookahead")
LAGS, DELAYS, LEVELS = (5.0, 10.0, 20.0, 30.0), (2.0, 5.0, 10.0), (2, 4, 8, 16)  # ms, ms


def valves(lags: list[float], delays: list[float], levels: list[int]) -> dict[str, Valve]:
    """The ideal valve, then slow ones one by one, by what is said of them."""
    found = {"ideal": Valve()}
    found |= {f"lag {lag:g} ms": Valve(rise_time=lag / 1e3, fall_time=lag / 1e3) for lag in lags}
    found |= {f"delay {delay:g} ms": Valve(delay=delay / 1e3) for delay in delays}
    return found | {f"{count} levels": Valve(levels=count) for count in levels}


def learned(environment: dict[str, Any], folder: Path, timesteps: int | None) -> agents.Agent:
    """An agent of the default algorithm, trained where the folder holds none."""
    if not (folder / "agent.json").exists():
        agents.train(folder, environment=environment, timesteps=timesteps, report=agents.training.silent)
    return agents.load(folder)


def main() -> None:
    """Tune, drive, print."""
    parser = argparse.ArgumentParser(description="What a slow valve costs rules of semi-active damping.")
    parser.add_argument("--road", default="iso_c", help="class of the road (%(default)s)")
    parser.add_argument("--speed", type=float, default=20.0, help="m/s (%(default)s)")
    parser.add_argument("--lags", type=float, nargs="*", default=list(LAGS), metavar="MS", help="time constants, ms")
    parser.add_argument("--delays", type=float, nargs="*", default=list(DELAYS), metavar="MS", help="ms")
    parser.add_argument("--levels", type=int, nargs="*", default=list(LEVELS), metavar="N", help="numbers of levels")
    parser.add_argument("--rules", nargs="*", default=list(RULES), help="(%(default)s)")
    parser.add_argument("--agents", action="store_true", help="train agents too")
    parser.add_argument("--output", default="runs/slow_valves", help="folder of the agents (%(default)s)")
    parser.add_argument("--timesteps", type=int, help="control intervals to train for (as of the algorithm)")
    parser.add_argument("--unaware", action="store_true", help="tune on the ideal valve")
    parser.add_argument("--episodes", type=int, default=256, help="(%(default)s)")
    parser.add_argument("--duration", type=float, default=10.0, help="measured time of an episode, s (%(default)s)")
    parser.add_argument("--seed", type=int, default=7, help="fixes the roads (%(default)s)")
    chosen = parser.parse_args()

    plant: dict[str, Any] = {"road": chosen.road, "speed": chosen.speed, "car": CAR, "reward": REWARD}
    best = float(optimum(make_task(**plant), chosen.speed, 0.0).cost)
    print(f"the best constant damping costs {best:.4g}; over it")
    lag, delay = (max(times, default=0.0) / 1e3 for times in (chosen.lags, chosen.delays))
    longest = {"valve.rise_time": lag, "valve.fall_time": lag, "valve.delay": delay}
    many = {**plant, "vary": {name: (0.0, time) for name, time in longest.items() if time}}
    columns = [*chosen.rules, *(("agent, unaware", "agent, aware", "agent, of many") if chosen.agents else ())]
    print(f"{'':>15}", *(f"{name:>20}" for name in columns))
    for said, valve in valves(chosen.lags, chosen.delays, chosen.levels).items():
        environment = {**plant, "valve": valve}
        rivals = make_rivals(make_task(**(plant if chosen.unaware else environment)), chosen.rules)
        if chosen.agents:
            folder = Path(chosen.output)
            rivals["agent, unaware"] = learned(plant, folder / "ideal", chosen.timesteps)
            rivals["agent, aware"] = learned(environment, folder / said.replace(" ", "-"), chosen.timesteps)
            rivals["agent, of many"] = learned(many, folder / "many", chosen.timesteps)
        results = agents.evaluate(
            rivals,
            environment=environment,
            speeds=[chosen.speed],
            episodes=chosen.episodes,
            duration=chosen.duration,
            seed=chosen.seed,
        )
        cells = [f"{results[name].mean[0] / best:.4f} ± {results[name].standard_error[0] / best:.4f}" for name in columns]
        print(f"{said:>15}", *(f"{cell:>20}" for cell in cells), flush=True)


if __name__ == "__main__":
    main()
