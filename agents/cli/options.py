"""Options that commands share, and what they make of them."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from typing import Any

from roadgym import CARS, ROADS, SPEED_NOISES, ParameterError, QuarterCar, TwoMassCar, Valve
from roadgym.sensors import Sensor
from roadgym.task import signals

from ..estimation import ESTIMATORS


def nonempty(text: str) -> str:
    """A path, of an argument that is not empty."""
    if not text:
        raise argparse.ArgumentTypeError("must not be empty")
    return text


def component(text: str) -> Any:
    """A component: its name, or the mapping that JSON tells."""
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
        if name.strip() in found:
            raise argparse.ArgumentTypeError(f"{name.strip()!r} has two weights")
        try:
            found[name.strip()] = float(value) if separator else 1.0
        except ValueError:
            raise argparse.ArgumentTypeError(f"the weight of {name!r} must be a number, got {value!r}") from None
    return found


CAR_NAMES = ", ".join([*CARS, *CARS.presets])
ROAD_KINDS = ", ".join(kind for kind in ROADS if kind != ROADS.of_file)
ROAD_NAMES = f"{ROAD_KINDS}, iso_a to iso_h"
OBSERVED = dict.fromkeys([*signals(QuarterCar()), *QuarterCar.optional])  # of one mass
OF_TWO_MASSES = ", ".join(name for name in signals(TwoMassCar()) if name not in OBSERVED)

RANGE: dict[str, Any] = {"type": float, "nargs": 2, "metavar": ("LOW", "HIGH")}
# by the environment's parameter: the option that sets it, and how it is read
ENVIRONMENT: dict[str, tuple[str, dict[str, Any]]] = {
    "road": (
        "--road",
        {
            "type": component,
            "metavar": "ROAD",
            "help": f"{ROAD_NAMES}, a file of a profile, or a JSON mapping with the key kind",
        },
    ),
    "speed_noise": (
        "--speed-noise",
        {
            "type": component,
            "metavar": "SPEED_NOISE",
            "help": f"{', '.join(SPEED_NOISES)}, or a JSON mapping with the key kind",
        },
    ),
    "speed": ("--speed-range", RANGE | {"nargs": "+", "help": "range of speeds, or one, m/s (0.5 3.2; of two masses 15 25)"}),
    "bandwidth": ("--bandwidth-range", RANGE | {"help": "range of bandwidths (0.05 0.5)"}),
    "damping_range": ("--damping-range", RANGE | {"help": "range of the action (the car's, 0.05 1)"}),
    "reward": (
        "--weights",
        {"type": weights, "metavar": "NAME=WEIGHT,...", "help": "weights of the cost (the car's, displacement=1)"},
    ),
    "observation": (
        "--observation",
        {
            "nargs": "*",
            "metavar": "NAME",
            "help": f"signals to observe, of the car of one mass {', '.join(OBSERVED)}; of two masses also {OF_TWO_MASSES}; "
            "with no name, the operating point (speed, bandwidth) alone",
        },
    ),
    "observe_operating_point": (
        "--hide-operating-point",
        {"action": "store_const", "const": False, "help": "do not observe speed and bandwidth unless named"},
    ),
    "control_interval": (
        "--control-interval",
        {"type": float, "metavar": "S", "help": "time between actions, s (the car's, 0.2/natural frequency)"},
    ),
    "car": (
        "--car",
        {"type": component, "metavar": "CAR", "help": f"{CAR_NAMES}, or a JSON mapping with the key kind"},
    ),
    "sensors": (
        "--sensors",
        {
            "type": component,
            "metavar": "JSON",
            "help": f"mapping of {', '.join(Sensor.__dataclass_fields__)}, by signal or for all, and unit, road or car (ideal)",
        },
    ),
    "valve": (
        "--valve",
        {"type": component, "metavar": "JSON", "help": f"mapping of {', '.join(Valve.__dataclass_fields__)} (ideal)"},
    ),
    "vary": (
        "--vary",
        {
            "type": component,
            "metavar": "JSON",
            "help": "mapping from fields of the car, or valve.FIELD, to bounds between which each episode draws its own (none)",
        },
    ),
    "natural_frequency": (
        "--natural-frequency",
        {"type": float, "metavar": "W1", "help": "natural frequency of the car of one mass, rad/s (1)"},
    ),
}


def add_training(parser: argparse.ArgumentParser, *, seed_of: str, checkpoints: bool = True) -> None:
    """Options of training."""
    group = parser.add_argument_group("training")
    group.add_argument(
        "--algorithm",
        help="apg, ppo, sac, td3, a2c, dqn or recurrent_ppo, which needs the extra recurrent "
        "(apg; ppo with hyperparameters or wrappers, with valves and sensors that apg refuses, and to tune)",
    )
    group.add_argument(
        "--hyperparameters",
        type=nonempty,
        metavar="FILE",
        help="YAML file of hyperparameters, or the name of a shipped one: ppo_plain, ppo_stacked, ppo_scheduling "
        "(the algorithm's own)",
    )
    group.add_argument(
        "--wrapper",
        dest="wrapper",
        action="append",
        default=[],
        metavar="MODULE:NAME",
        help="a Gymnasium vector wrapper around the batch of training, such as one with your own reward; may be given again",
    )
    group.add_argument(
        "--timesteps",
        type=int,
        metavar="N",
        help="control intervals to train for, completed to whole rollouts (the hyperparameters' n_timesteps)",
    )
    if checkpoints:
        group.add_argument(
            "--checkpoint-interval", type=int, default=100_000, metavar="N", help="timesteps between checkpoints (%(default)s)"
        )
    group.add_argument("--seed", type=int, default=0, help=f"seed of {seed_of} (%(default)s)")


def add_evaluation(parser: argparse.ArgumentParser, *, seed: bool = False) -> None:
    """Options of evaluation; its seed where no training has one."""
    group = parser.add_argument_group("evaluation")
    group.add_argument(
        "--speeds", type=float, nargs="+", metavar="V", help="speeds, m/s (0.7 1 1.5 2 3, or three of the range)"
    )
    group.add_argument(
        "--bandwidths", type=float, nargs="+", metavar="DELTA", help="road bandwidths (0.1 0.3, or the ends of the range)"
    )
    group.add_argument("--episodes", type=int, default=256, help="episodes at each operating point (%(default)s)")
    if seed:
        group.add_argument("--seed", type=int, default=0, help="seed of the roads (%(default)s)")


def add_estimator(parser: argparse.ArgumentParser, who: str) -> None:
    """The option of an estimator; ``who`` drives by it."""
    parser.add_argument(
        "--estimator",
        choices=ESTIMATORS,
        help=f"{who} by the mean of a Kalman filter of what is observed (--observation, --sensors)",
    )


def add_environment(parser: argparse.ArgumentParser) -> None:
    """Options of the environment."""
    options = {option for action in parser._actions for option in action.option_strings}
    held = "; with --agent, what it was trained on" if "--agent" in options else ""
    group = parser.add_argument_group("environment", f"by default the bounded road over a range of speeds and bandwidths{held}")
    for parameter, (option, how) in ENVIRONMENT.items():
        names = (
            [option, "--speed"] if parameter == "speed" and "--speed" not in options else [option]
        )  # one speed where films are
        group.add_argument(*names, dest=f"environment_{parameter}", **how)


def given_environment(chosen: argparse.Namespace) -> dict[str, Any]:
    """The parameters of the environment that are given, in the order of `ENVIRONMENT`."""
    found = {parameter: getattr(chosen, f"environment_{parameter}") for parameter in ENVIRONMENT}
    given = {parameter: value for parameter, value in found.items() if value is not None}
    if len(given.get("speed", ())) == 1:
        given["speed"] = 2 * given["speed"]
    return given | {"road": ROADS.lasting(given["road"])} if "road" in given else given


def environment_from(chosen: argparse.Namespace) -> dict[str, Any]:
    """Parameters of the environment from the options, over the defaults; checks them."""
    from roadgym.cars import make_car
    from roadgym.task import make_task

    from ..agent import DEFAULT_ENVIRONMENT

    given = given_environment(chosen)
    car = make_car(given.get("car"), given.get("natural_frequency"))
    environment = {**DEFAULT_ENVIRONMENT, **car.usual_plant, **given}
    if "bandwidth" not in given and make_task(road=environment["road"]).bandwidth[1] == 0:
        del environment["bandwidth"]
    make_task(**environment)
    return environment


def refuse(chosen: argparse.Namespace, names: Iterable[str], why: str) -> None:
    """Options that would have no effect are refused where they are given, for a reason.

    Args:
        chosen: what was parsed; ``given`` has the names of what was given.
        names: of the options, as in ``chosen``.
        why: told after the option.
    """
    for name in names:
        if name in chosen.given:
            parameter = name.removeprefix("environment_")
            option = ENVIRONMENT[parameter][0] if name != parameter else f"--{name.replace('_', '-')}"
            raise ParameterError(f"{option} cannot be given {why}")


def refuse_environment(chosen: argparse.Namespace, option: str = "--agent") -> None:
    """With an agent, which an option names, the environment is given."""
    refuse(chosen, (f"environment_{name}" for name in ENVIRONMENT), f"with {option}: the agent's environment holds")


def refuse_observation(chosen: argparse.Namespace) -> None:
    """Where classical controllers drive alone, nobody observes."""
    observed = ("environment_observation", "environment_observe_operating_point")
    refuse(chosen, observed, "with --controller: it is handed the signals that it needs")
