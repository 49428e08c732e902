"""Options that commands share, and what they make of them."""

from __future__ import annotations

import argparse
import json
from typing import Any

from roadgym import CARS, ROADS, SPEED_NOISES, ParameterError, QuarterCar
from roadgym.task import signals


def nonempty(text: str) -> str:
    """A path, of an argument that is not empty."""
    if not text:
        raise argparse.ArgumentTypeError("must not be empty")
    return text


def component(text: str) -> Any:
    """A road, a speed noise or a car: its name, or the mapping that JSON tells."""
    if not text.lstrip().startswith("{"):
        return text
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise argparse.ArgumentTypeError(f"not JSON: {error}") from None


def weights(text: str) -> dict[str, float]:
    """Weights by name, from "NAME=WEIGHT,..."; 1 where none is given."""
    found = {}
    for part in text.split(","):
        name, separator, value = part.partition("=")
        try:
            found[name.strip()] = float(value) if separator else 1.0
        except ValueError:
            raise argparse.ArgumentTypeError(f"the weight of {name!r} must be a number, got {value!r}") from None
    return found


RANGE: dict[str, Any] = {"type": float, "nargs": 2, "metavar": ("LOW", "HIGH")}
# by the environment's parameter: the option that sets it, and how it is read
ENVIRONMENT: dict[str, tuple[str, dict[str, Any]]] = {
    "road": (
        "--road",
        {"type": component, "metavar": "ROAD", "help": f"{', '.join(ROADS)}, or a JSON mapping with the key kind"},
    ),
    "speed_noise": (
        "--speed-noise",
        {
            "type": component,
            "metavar": "SPEED_NOISE",
            "help": f"{', '.join(SPEED_NOISES)}, or a JSON mapping with the key kind",
        },
    ),
    "speed": ("--speed-range", RANGE | {"help": "range of speeds, m/s (0.5 3.2)"}),
    "bandwidth": ("--bandwidth-range", RANGE | {"help": "range of bandwidths (0.05 0.5)"}),
    "damping_range": ("--damping-range", RANGE | {"help": "range of the action (0.05 1)"}),
    "reward": ("--weights", {"type": weights, "metavar": "NAME=WEIGHT,...", "help": "weights of the cost (displacement=1)"}),
    "observation": (
        "--observation",
        {
            "nargs": "*",
            "metavar": "NAME",
            "help": f"signals to observe, of {', '.join(signals(QuarterCar()))}; with no name, the operating point (speed, "
            "bandwidth) alone",
        },
    ),
    "observe_operating_point": (
        "--hide-operating-point",
        {"action": "store_const", "const": False, "help": "do not observe speed and bandwidth unless named"},
    ),
    "control_interval": (
        "--control-interval",
        {"type": float, "metavar": "S", "help": "time between actions, s (0.2/natural frequency)"},
    ),
    "car": (
        "--car",
        {"type": component, "metavar": "CAR", "help": f"{', '.join(CARS)}, or a JSON mapping with the key kind"},
    ),
    "natural_frequency": (
        "--natural-frequency",
        {"type": float, "metavar": "W1", "help": "natural frequency of the car of one mass, rad/s (1)"},
    ),
}


def add_training(parser: argparse.ArgumentParser, *, checkpoints: bool = True) -> None:
    """Options of training."""
    group = parser.add_argument_group("training")
    group.add_argument(
        "--algorithm",
        default="ppo",
        help="ppo, sac, td3, a2c, dqn or recurrent_ppo, which needs the extra recurrent (%(default)s)",
    )
    group.add_argument(
        "--hyperparameters",
        type=nonempty,
        metavar="FILE",
        help="YAML file of hyperparameters, or the name of a shipped one: ppo_plain, ppo_stacked, ppo_scheduling "
        "(the algorithm's own)",
    )
    group.add_argument(
        "--timesteps", type=int, help="control intervals to train for, instead of the hyperparameters' n_timesteps"
    )
    if checkpoints:
        group.add_argument(
            "--checkpoint-interval", type=int, default=100_000, help="timesteps between checkpoints (%(default)s)"
        )
    group.add_argument("--seed", type=int, default=0, help="seed of training and of the evaluation's roads (%(default)s)")


def add_evaluation(parser: argparse.ArgumentParser, *, seed: bool = False) -> None:
    """Options of evaluation; its seed where no training has one."""
    group = parser.add_argument_group("evaluation")
    group.add_argument("--speeds", type=float, nargs="+", metavar="V", help="speeds, m/s (0.7 1 1.5 2 3)")
    group.add_argument("--bandwidths", type=float, nargs="+", metavar="DELTA", help="road bandwidths (0.1 0.3)")
    group.add_argument("--episodes", type=int, default=256, help="episodes at each operating point (%(default)s)")
    if seed:
        group.add_argument("--seed", type=int, default=0, help="seed of the roads (%(default)s)")


def add_environment(parser: argparse.ArgumentParser) -> None:
    """Options of the environment."""
    group = parser.add_argument_group(
        "environment", "by default the bounded road over a range of speeds and bandwidths; with --agent, what it was trained on"
    )
    for parameter, (option, how) in ENVIRONMENT.items():
        group.add_argument(option, dest=f"environment_{parameter}", **how)


def given_environment(chosen: argparse.Namespace) -> dict[str, Any]:
    """The parameters of the environment that are given, in the order of `ENVIRONMENT`."""
    found = {parameter: getattr(chosen, f"environment_{parameter}") for parameter in ENVIRONMENT}
    return {parameter: value for parameter, value in found.items() if value is not None}


def environment_from(chosen: argparse.Namespace) -> dict[str, Any]:
    """Parameters of the environment from the options, over the defaults; checks them."""
    from roadgym.task import make_task

    from ..agent import DEFAULT_ENVIRONMENT

    given = given_environment(chosen)
    environment = {**DEFAULT_ENVIRONMENT, **given}
    if "bandwidth" not in given and make_task(road=environment["road"]).bandwidth[1] == 0:
        del environment["bandwidth"]
    make_task(**environment)
    return environment


def refuse_environment(chosen: argparse.Namespace) -> None:
    """With an agent the environment is given."""
    for parameter in given_environment(chosen):
        raise ParameterError(f"{ENVIRONMENT[parameter][0]} cannot be given with --agent: the agent's environment holds")
