"""The parser: every command with its options."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from roadgym import SPEED_NOISES, QuarterCar, TwoMassCar, __version__
from roadgym.roads.profile_formats import HEIGHT_UNITS

from ..benchmark import CASES
from ..names import CONTROLLERS_SHOWN
from .commands import run_compare, run_drive, run_evaluate, run_export, run_train, run_tune
from .options import (
    CAR_NAMES,
    ENVIRONMENT,
    ROAD_KINDS,
    ROAD_NAMES,
    add_environment,
    add_estimator,
    add_evaluation,
    add_training,
    component,
    nonempty,
    weights,
)
from .road import run_road
from .suite import add_suite
from .sweep import run_sweep
from .theory_commands import run_benchmark, run_cache, run_certify, run_errata, run_explore, run_figures

CLASSICAL = ", ".join(name for name in CONTROLLERS_SHOWN if name != "agent")


def make_parser() -> argparse.ArgumentParser:
    """All commands and their options."""
    parser = argparse.ArgumentParser(
        prog="roadgym",
        description="Learn to damp a car on a random road, and know how far from the exact optimum you are.",
        epilog="exit codes: 0 success; 1 a plant or a profile that is not certified, or part of a sweep that failed; 2 a wrong "
        "argument, a file that cannot be read or written, or a missing package (one line says which); 130 interrupted. Colours "
        "and bars on a terminal only, and none with NO_COLOR.",
    )
    parser.add_argument("--version", action="version", version=f"roadgym {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    train = _command(commands, "train", run_train, "train an agent into a folder", "roadgym train --output runs/apg --seed 1")
    train.add_argument("--output", type=nonempty, required=True, metavar="DIR", help="folder of the agent")
    train.add_argument("--resume", action="store_true", help="go on with the agent in the folder")
    train.add_argument("--tensorboard", action="store_true", help="write logs for TensorBoard into the folder")
    add_training(train, seed_of="training")
    add_estimator(train, "the agent sees and drives")
    add_environment(train)

    tune = _command(
        commands,
        "tune",
        run_tune,
        "search for hyperparameters; the same command goes on with a study that was interrupted",
        "roadgym tune --algorithm ppo --storage study.db --output best.yaml",
    )
    tune.add_argument(
        "--storage",
        type=nonempty,
        required=True,
        metavar="PLACE",
        help="of the study: an SQLite file, or a folder, on which many processes may search at once",
    )
    tune.add_argument("--trials", type=int, default=20, help="trials in all, those in the file included (%(default)s)")
    tune.add_argument(
        "--output", type=nonempty, metavar="FILE", help="write the best as YAML that train --hyperparameters takes"
    )
    add_training(tune, seed_of="the search, of training and of the evaluation's roads", checkpoints=False)
    tune.set_defaults(algorithm="ppo")
    add_environment(tune)

    evaluate = _command(
        commands, "evaluate", run_evaluate, "drive one controller and print its costs", "roadgym evaluate --agent runs/apg"
    )
    who = evaluate.add_mutually_exclusive_group(required=True)
    who.add_argument("--agent", type=nonempty, metavar="DIR", help="folder of a trained agent, or a task of the suite")
    who.add_argument("--controller", metavar="NAME", help=f"a classical controller: {CLASSICAL}")
    evaluate.add_argument("--json", action="store_true", help="print JSON instead of a table")
    add_evaluation(evaluate, seed=True)
    add_estimator(evaluate, "the controller drives")
    add_environment(evaluate)

    compare = _command(
        commands,
        "compare",
        run_compare,
        "train an agent, then compare it with the analytic optimum and classical controllers over the same noise",
        "roadgym compare --output results",
    )
    compare.add_argument(
        "--output",
        type=nonempty,
        default="roadgym-results",
        metavar="DIR",
        help="folder of the results (%(default)s, with a number where that holds others)",
    )
    compare.add_argument(
        "--agent",
        type=nonempty,
        nargs="+",
        metavar="DIR",
        help="folders of trained agents, instead of training; those that differ in the seed alone are one learned controller",
    )
    compare.add_argument(
        "--seeds", type=int, default=1, help="agents to train, each of another seed from --seed on (%(default)s)"
    )
    compare.add_argument("--json", action="store_true", help="print JSON instead of the table")
    _add_references(compare)
    add_training(compare, seed_of="training, where it is the first one's, and of the evaluation's roads")
    add_evaluation(compare)
    add_estimator(compare, "agents trained here, and classical controllers, drive")
    add_environment(compare)

    sweep = _command(
        commands,
        "sweep",
        run_sweep,
        "train and compare many agents at once, seeds by values of options, on this machine or a cluster; the same command "
        "goes on where it was stopped; exit code 1 if any of it failed",
        "roadgym sweep --over algorithm apg ppo --over road multiplicative gaussian --seeds 5 --output sweep",
    )
    sweep.add_argument("--output", type=nonempty, required=True, metavar="DIR", help="folder of agents, comparisons and jobs")
    sweep.add_argument(
        "--over",
        nargs="+",
        action="append",
        default=[],
        metavar=("OPTION", "VALUE"),
        help="values to try of an option of training or of the environment, several words in quotes: --over damping-range "
        "'0.05 1' '0.2 1'; may be given again, for all combinations",
    )
    sweep.add_argument("--seeds", type=int, default=1, help="agents of each, of seeds from --seed on (%(default)s)")
    sweep.add_argument("--on", default="processes", metavar="WHERE", help="here, processes, ray or slurm (%(default)s)")
    sweep.add_argument("--workers", type=int, metavar="N", help="how many at once (the processors; Slurm must be told)")
    sweep.add_argument(
        "--launch",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="an option of ray.init, or of submitit such as slurm_partition=short; may be given again",
    )
    _add_references(sweep)
    add_training(sweep, seed_of="training, where it is the first one's, and of the evaluation's roads")
    add_evaluation(sweep)
    add_estimator(sweep, "agents, and classical controllers, drive")
    add_environment(sweep)

    drive = _command(
        commands,
        "drive",
        run_drive,
        "watch a controller drive, in a window or as a film, alone or beside another one over the very same road",
        "roadgym drive --controller skyhook --road multiplicative",
    )
    who = drive.add_mutually_exclusive_group(required=True)
    who.add_argument("--agent", type=nonempty, metavar="DIR", help="folder of a trained agent, or a task of the suite")
    who.add_argument("--controller", metavar="NAME", help=f"a classical controller: {CLASSICAL}")
    drive.add_argument("--versus", metavar="NAME", help="another controller, or the folder of another agent, side by side")
    drive.add_argument(
        "--output", type=nonempty, metavar="FILE", help="write a film, .mp4 or .gif, instead of opening a window"
    )
    drive.add_argument("--seconds", type=float, metavar="S", help="of film (10; a window until it is closed)")
    drive.add_argument(
        "--pace",
        type=float,
        default=1.0,
        metavar="P",
        help="0.3 for slow motion: seconds of the drive in one of the film, where control intervals allow it (%(default)s)",
    )
    drive.add_argument("--speed", type=float, metavar="V", help="speed, m/s (drawn from the environment's range)")
    drive.add_argument("--bandwidth", type=float, metavar="DELTA", help="road bandwidth (drawn from the environment's range)")
    drive.add_argument("--seed", type=int, default=0, help="seed of the road (%(default)s)")
    add_environment(drive)

    export = _command(
        commands,
        "export",
        run_export,
        "write a trained agent as C99, as ONNX, or as a table of the damping over two signals",
        "roadgym export --agent runs/ppo --to c --output firmware",
    )
    export.add_argument(
        "--agent", type=nonempty, required=True, metavar="DIR", help="folder of a trained agent, or a task of the suite"
    )
    export.add_argument(
        "--to",
        choices=("c", "onnx", "table"),
        required=True,
        help="c: header, source, and a check with test vectors; onnx: one model, which needs the extra onnx; table: CSV, and C "
        "that looks it up, and what the table costs beside the agent",
    )
    export.add_argument(
        "--output", type=nonempty, default=".", metavar="DIR", help="folder of the files, which are not there yet (%(default)s)"
    )
    export.add_argument("--name", metavar="NAME", help="of the files and the names in C (that of the agent's folder)")
    export.add_argument(
        "--signals", nargs=2, metavar="NAME", help="of the table (the two that explain most of the agent's damping)"
    )
    add_evaluation(export, seed=True)

    certify = _command(
        commands,
        "certify",
        run_certify,
        "drive a plant and compare its law, spectrum and response with the exact ones; exit code 1 if any line fails. With "
        "--optimal: how far from the optimum it can be driven, from both sides",
        "roadgym certify --road gaussian --speed 1.5",
    )
    certify.add_argument(
        "--road",
        type=component,
        help=f"{ROAD_NAMES}, a file of a profile, or a JSON mapping (multiplicative; of two masses iso_c)",
    )
    certify.add_argument(
        "--speed-noise", type=component, help=f"{', '.join(SPEED_NOISES)}, or a JSON mapping with the key kind (none)"
    )
    certify.add_argument(
        "--speed", type=float, metavar="V", help="speed, m/s (1; of two masses 20; with --agent the middle of its range)"
    )
    certify.add_argument("--damping", type=float, default=0.3, metavar="D", help="damping ratio (%(default)s)")
    certify.add_argument(
        "--optimal",
        action="store_true",
        help="the best constant damping, the best feedback and all lower bounds, with the share that is certified; exit code 1 "
        "if a bound exceeds a driven cost",
    )
    certify.add_argument("--bandwidth", type=float, metavar="DELTA", help="with --optimal: of the road (the road's own)")
    for name in ("damping_range", "reward", "sensors", "valve"):
        option, how = ENVIRONMENT[name]
        certify.add_argument(option, dest=f"environment_{name}", **{**how, "help": f"with --optimal: {how['help']}"})
    certify.add_argument(
        "--methods", nargs="+", metavar="NAME", help="with --optimal: lower bounds to find, such as matrix_inequality (all)"
    )
    certify.add_argument("--car", **ENVIRONMENT["car"][1])
    certify.add_argument("--natural-frequency", **ENVIRONMENT["natural_frequency"][1])
    who = certify.add_mutually_exclusive_group()
    who.add_argument("--agent", type=nonempty, metavar="DIR", help="certify under a trained agent's rule too, on its plant")
    who.add_argument("--controller", metavar="NAME", help=f"certify under a controller's rule too: {CLASSICAL}")
    certify.add_argument("--lanes", type=int, default=16384, help="independent cars (%(default)s; with --optimal 1024)")
    certify.add_argument("--seed", type=int, default=0, help="seed of the roads (%(default)s)")
    certify.add_argument("--json", action="store_true", help="print JSON instead of the table")

    road = _command(
        commands,
        "road",
        run_road,
        "tell class, waviness, roughness index and parameters of a measured profile; exit code 1 if it is not of the class "
        "that it claims",
        "roadgym road profile.csv --units mm --output results",
    )
    road.add_argument("file", type=nonempty, metavar="FILE", help="heights over the distance: a table (CSV), ERD or OpenCRG")
    road.add_argument("--units", metavar="UNIT", help=f"of the heights: {', '.join(HEIGHT_UNITS)} (what the file tells, or m)")
    road.add_argument(
        "--column", type=int, metavar="N", help="which heights of the file, from 1 (the only ones, or the middle)"
    )
    road.add_argument(
        "--band", type=float, nargs=2, metavar=("LOW", "HIGH"), help="frequencies to fit, cycles/m (0.011 2.83, of ISO 8608)"
    )
    road.add_argument(
        "--folded",
        action="store_true",
        help="the heights are mere points of a road, as a simulation gives them, and no averages as of a profilometer",
    )
    road.add_argument("--iso-class", metavar="CLASS", help="A to H: certify that the profile is of this class of ISO 8608")
    road.add_argument("--json", action="store_true", help="print JSON instead of the text")
    road.add_argument(
        "--output",
        type=nonempty,
        metavar="DIR",
        help="write a page with pictures, road.html, into this folder, over that of a file of the same name alone",
    )

    benchmark = _command(
        commands, "benchmark", run_benchmark, "measure speed side by side with peers", "roadgym benchmark --output speed.json"
    )
    benchmark.add_argument("--only", nargs="+", metavar="CASE", help=f"some cases only, of {', '.join(CASES)}")
    benchmark.add_argument("--scaling", action="store_true", help="cost over the number of environments and substeps too")
    benchmark.add_argument("--json", action="store_true", help="print JSON instead of the tables")
    benchmark.add_argument(
        "--output", type=nonempty, metavar="FILE", help="write the results as JSON, and the scaling as a picture beside it"
    )

    figures = _command(
        commands, "figures", run_figures, "draw figures 2 to 14 of the paper, with data", "roadgym figures --output figures"
    )
    figures.add_argument(
        "--output", type=nonempty, required=True, metavar="DIR", help="folder of the pictures (PNG) and their data (CSV)"
    )
    figures.add_argument("--only", type=int, nargs="+", metavar="N", help="figures to draw (2 to 14)")
    figures.add_argument("--full", action="store_true", help="simulate Fig. 7 with all the paper's samples (half a minute)")

    explore = _command(
        commands,
        "explore",
        run_explore,
        "write one page of HTML that shows mean squares, optimum, amplitudes and road laws, live",
        "roadgym explore --output explorer.html",
    )
    explore.add_argument("--output", type=nonempty, required=True, metavar="FILE", help="the page")
    explore.add_argument("--car", default="one_mass", help=f"{CAR_NAMES} (%(default)s)")
    explore.add_argument(
        "--road",
        help=f"of one mass {ROAD_KINDS} (multiplicative); of two masses iso_a to iso_h (iso_c)",
    )
    explore.add_argument("--speed-noise", default="none", help=f"none, {', '.join(SPEED_NOISES)} (%(default)s)")
    explore.add_argument(
        "--value",
        nargs=2,
        action="append",
        default=[],
        metavar=("NAME", "NUMBER"),
        help="first damping, damping_min or damping_max; of one mass frequency_ratio, bandwidth, shape, intensity or "
        "corner_frequency; of two masses sprung_mass, unsprung_mass, spring_rate, tyre_rate or kilometres_per_hour",
    )
    explore.add_argument(
        "--weights",
        type=weights,
        metavar="NAME=WEIGHT,...",
        help=f"weights of the cost, of one mass of {', '.join(QuarterCar().mean_squares)} (displacement=1); of two masses of "
        f"{', '.join(TwoMassCar().mean_squares)} (acceleration=1)",
    )

    errata = _command(
        commands,
        "errata",
        run_errata,
        "show where the paper errs: both formulas, and evidence",
        "roadgym errata --only forcing",
    )
    errata.add_argument("--only", nargs="+", metavar="NAME", help="errata to check, by their names in the table (all)")
    errata.add_argument("--json", action="store_true", help="print JSON instead of the table")

    add_suite(commands, _command)

    cache = _command(
        commands,
        "cache",
        run_cache,
        "tell where compiled code, optimal feedbacks and lower bounds are kept, and how much",
        "roadgym cache --clear",
    )
    cache.add_argument("--clear", action="store_true", help="remove them; they are made again when they are needed")
    return parser


def _add_references(parser: argparse.ArgumentParser) -> None:
    """What agents are compared with."""
    parser.add_argument(
        "--controllers",
        nargs="+",
        metavar="NAME",
        help=f"controllers to compare with, of {CLASSICAL} (those that most speak of, as far as the road allows)",
    )
    parser.add_argument(
        "--bound",
        default="fast",
        metavar="BOUND",
        help="lower bounds of all controllers to hold the costs against: fast, tight (minutes a point), none, or one method, "
        "such as matrix_inequality (%(default)s)",
    )


def _command(commands: Any, name: str, run: Any, summary: str, example: str) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(name, help=summary, description=summary, epilog=f"example: {example}")
    parser.set_defaults(run=run)
    parser.add_argument(
        "--import",
        dest="imports",
        type=nonempty,
        action="append",
        default=[],
        metavar="MODULE",
        help="import a Python module first, for the components of your own that it registers; may be given again",
    )
    return parser


def given_options(arguments: Sequence[str] | None) -> frozenset[str]:
    """Names of the options that are given, whatever their values; the arguments must be right."""
    parser = make_parser()
    commands = list(_commands(parser).values())
    for command in commands:
        for action in command._actions:
            action.default = argparse.SUPPRESS
            if isinstance(action, argparse._SubParsersAction):  # a command of commands
                commands += action.choices.values()
    return frozenset(vars(parser.parse_args(arguments)))


def _commands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The commands by name."""
    (found,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    return dict(found.choices)
