"""The command line: ``roadgym train``, ``tune``, ``evaluate``, ``compare``, ``drive``, ``certify``, ``benchmark``, ``figures``,
``explore``, ``errata`` and ``cache``.

Exit codes: 0 success, 1 a plant that is not certified, 2 a wrong argument, a file that cannot be read or written, or a missing
package (one line says which), 130 interrupted.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import io
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from roadgym import ROADS, SPEED_NOISES, ParameterError, __version__
from roadgym.kernel import SIGNALS

from .errors import AgentError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # letters that it does not have, and names that are no text
    parser = make_parser()
    chosen = parser.parse_args(arguments)
    try:
        code: int | None = chosen.run(chosen)
        print(end="", flush=True)
    except (ParameterError, AgentError) as error:
        return _fault(chosen.command, str(error))
    except KeyboardInterrupt:
        remedies = {
            "train": "; --resume goes on from the last checkpoint",
            "compare": "; the same command resumes its agent",
            "tune": "; the same command goes on with the study",
        }
        remedy = remedies.get(chosen.command, "")
        print(f"roadgym {chosen.command}: interrupted{remedy}", file=sys.stderr)
        return 130
    except BrokenPipeError:
        _finish_output()
        return 0
    except OSError as error:  # such as a full disk
        where = "" if error.filename is None else f"cannot use {str(error.filename)!r}: "
        _finish_output()
        return _fault(chosen.command, f"{where}{error.strerror or error}")
    return code or 0


def _fault(command: str, message: str) -> int:
    """Say in one line what is wrong; returns the exit code."""
    print(f"roadgym {command}: {' '.join(message.split())}", file=sys.stderr)
    return 2


def _finish_output() -> None:
    """Write out what the standard output still holds, or let it be lost: Python would try at its end, and complain."""
    try:
        print(end="", flush=True)
    except OSError:
        with contextlib.suppress(OSError), open(os.devnull, "wb") as nowhere:  # noqa: PTH123 - a device, not a path
            os.dup2(nowhere.fileno(), sys.stdout.fileno())


def make_parser() -> argparse.ArgumentParser:
    """All commands and their options."""
    parser = argparse.ArgumentParser(
        prog="roadgym",
        description="Learn to damp a car on a random road, and know how far from the exact optimum you are.",
        epilog="exit codes: 0 success; 1 a plant that is not certified; 2 a wrong argument, a file that cannot be read or "
        "written, or a missing package (one line says which); 130 interrupted. Colours and bars on a terminal only, and none "
        "with NO_COLOR.",
    )
    parser.add_argument("--version", action="version", version=f"roadgym {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    train = _command(commands, "train", run_train, "train an agent into a folder", "roadgym train --output runs/ppo --seed 1")
    train.add_argument("--output", type=_path, required=True, metavar="DIR", help="folder of the agent")
    train.add_argument("--resume", action="store_true", help="go on with the agent in the folder")
    train.add_argument("--tensorboard", action="store_true", help="write logs for TensorBoard into the folder")
    _add_training(train)
    _add_environment(train)

    tune = _command(
        commands,
        "tune",
        run_tune,
        "search for hyperparameters; the same command goes on with a study that was interrupted",
        "roadgym tune --algorithm ppo --storage study.db --output best.yaml",
    )
    tune.add_argument("--storage", type=_path, required=True, metavar="FILE", help="SQLite file of the study")
    tune.add_argument("--trials", type=int, default=20, help="trials in all, those in the file included (%(default)s)")
    tune.add_argument("--output", type=_path, metavar="FILE", help="write the best as YAML that train --hyperparameters takes")
    _add_training(tune)
    _add_environment(tune)

    evaluate = _command(
        commands, "evaluate", run_evaluate, "drive one controller and print its costs", "roadgym evaluate --agent runs/ppo"
    )
    who = evaluate.add_mutually_exclusive_group(required=True)
    who.add_argument("--agent", type=_path, metavar="DIR", help="folder of a trained agent")
    who.add_argument("--controller", metavar="NAME", help="a classical controller, such as skyhook")
    evaluate.add_argument("--json", action="store_true", help="print JSON instead of a table")
    _add_evaluation(evaluate)
    _add_environment(evaluate)

    compare = _command(
        commands,
        "compare",
        run_compare,
        "train an agent, then compare it with the analytic optimum and classical controllers over the same noise",
        "roadgym compare --output results",
    )
    compare.add_argument(
        "--output", type=_path, default="roadgym-results", metavar="DIR", help="folder of the results (%(default)s)"
    )
    compare.add_argument(
        "--agent",
        type=_path,
        nargs="+",
        metavar="DIR",
        help="folders of trained agents, instead of training; those that differ in the seed alone are one learned controller",
    )
    compare.add_argument(
        "--seeds", type=int, default=1, help="agents to train, each of another seed from --seed on (%(default)s)"
    )
    compare.add_argument("--json", action="store_true", help="print JSON instead of the table")
    compare.add_argument("--controllers", nargs="+", metavar="NAME", help="classical controllers to compare with")
    _add_training(compare)
    _add_evaluation(compare)
    _add_environment(compare)

    drive = _command(
        commands,
        "drive",
        run_drive,
        "watch a controller drive, in a window or as a film, alone or beside another one over the very same road",
        "roadgym drive --controller skyhook --road multiplicative",
    )
    who = drive.add_mutually_exclusive_group(required=True)
    who.add_argument("--agent", type=_path, metavar="DIR", help="folder of a trained agent")
    who.add_argument("--controller", metavar="NAME", help="a classical controller, such as skyhook")
    drive.add_argument("--versus", metavar="NAME", help="another controller, or the folder of another agent, side by side")
    drive.add_argument("--output", type=_path, metavar="FILE", help="write a film, .mp4 or .gif, instead of opening a window")
    drive.add_argument(
        "--seconds", type=float, metavar="S", help="of film, each of 60 control intervals (10; a window until it is closed)"
    )
    drive.add_argument("--speed", type=float, metavar="V", help="speed, m/s (drawn from the environment's range)")
    drive.add_argument("--bandwidth", type=float, metavar="DELTA", help="road bandwidth (drawn from the environment's range)")
    drive.add_argument("--seed", type=int, default=0, help="seed of the road (%(default)s)")
    _add_environment(drive)

    certify = _command(
        commands,
        "certify",
        run_certify,
        "drive a plant and compare its law, spectrum and response with the exact ones; exit code 1 if any line fails",
        "roadgym certify --road gaussian --speed 1.5",
    )
    certify.add_argument(
        "--road", type=_component, default="multiplicative", help=f"{', '.join(ROADS)}, or a JSON mapping (%(default)s)"
    )
    certify.add_argument(
        "--speed-noise", type=_component, help=f"{', '.join(SPEED_NOISES)}, or a JSON mapping with the key kind (none)"
    )
    certify.add_argument("--speed", type=float, default=1.0, metavar="V", help="speed, m/s (%(default)s)")
    certify.add_argument("--damping", type=float, default=0.3, metavar="D", help="damping ratio (%(default)s)")
    certify.add_argument("--natural-frequency", type=float, default=1.0, metavar="W1", help="of the car, rad/s (%(default)s)")
    certify.add_argument("--lanes", type=int, default=16384, help="independent cars (%(default)s)")
    certify.add_argument("--seed", type=int, default=0, help="seed of the roads (%(default)s)")
    certify.add_argument("--json", action="store_true", help="print JSON instead of the table")

    benchmark = _command(
        commands, "benchmark", run_benchmark, "measure speed side by side with peers", "roadgym benchmark --output speed.json"
    )
    benchmark.add_argument("--only", nargs="+", metavar="CASE", help="some cases only")
    benchmark.add_argument("--scaling", action="store_true", help="cost over the number of environments and substeps too")
    benchmark.add_argument("--json", action="store_true", help="print JSON instead of the tables")
    benchmark.add_argument(
        "--output", type=_path, metavar="FILE", help="write the results as JSON, and the scaling as a picture beside it"
    )

    figures = _command(
        commands, "figures", run_figures, "draw figures 2 to 14 of the paper, with data", "roadgym figures --output figures"
    )
    figures.add_argument(
        "--output", type=_path, required=True, metavar="DIR", help="folder of the pictures (PNG) and their data (CSV)"
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
    explore.add_argument("--output", type=_path, required=True, metavar="FILE", help="the page")
    explore.add_argument("--road", default="multiplicative", help=f"{', '.join(ROADS)} (%(default)s)")
    explore.add_argument("--speed-noise", default="none", help=f"none, {', '.join(SPEED_NOISES)} (%(default)s)")
    explore.add_argument(
        "--value",
        nargs=2,
        action="append",
        default=[],
        metavar=("NAME", "NUMBER"),
        help="first damping, frequency_ratio, bandwidth, shape, intensity, corner_frequency, damping_min, damping_max",
    )
    explore.add_argument("--weights", type=_weights, metavar="NAME=WEIGHT,...", help="weights of the cost (displacement=1)")

    errata = _command(
        commands,
        "errata",
        run_errata,
        "show where the paper errs: both formulas, and evidence",
        "roadgym errata --only forcing",
    )
    errata.add_argument("--only", nargs="+", metavar="NAME", help="errata to check, by their names in the table")
    errata.add_argument("--json", action="store_true", help="print JSON instead of the table")

    cache = _command(
        commands,
        "cache",
        run_cache,
        "tell where compiled code and optimal feedbacks are kept, and how much",
        "roadgym cache --clear",
    )
    cache.add_argument("--clear", action="store_true", help="remove them; they are made again when they are needed")
    return parser


def _command(commands: Any, name: str, run: Any, summary: str, example: str) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(name, help=summary, description=summary, epilog=f"example: {example}")
    parser.set_defaults(run=run)
    return parser


def _add_training(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("training")
    group.add_argument(
        "--algorithm",
        default="ppo",
        help="ppo, sac, td3, a2c, dqn or recurrent_ppo, which needs roadgym[recurrent] (%(default)s)",
    )
    group.add_argument(
        "--hyperparameters",
        type=_path,
        metavar="FILE",
        help="YAML file of hyperparameters, or the name of a shipped one: ppo_plain, ppo_stacked, ppo_scheduling "
        "(the algorithm's own)",
    )
    group.add_argument(
        "--timesteps", type=int, help="control intervals to train for, instead of the hyperparameters' n_timesteps"
    )
    if parser.get_default("run") is not run_tune:
        group.add_argument(
            "--checkpoint-interval", type=int, default=100_000, help="timesteps between checkpoints (%(default)s)"
        )
    group.add_argument("--seed", type=int, default=0, help="seed of training and of the evaluation's roads (%(default)s)")


def _add_evaluation(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("evaluation")
    group.add_argument("--speeds", type=float, nargs="+", metavar="V", help="speeds, m/s (0.7 1 1.5 2 3)")
    group.add_argument("--bandwidths", type=float, nargs="+", metavar="DELTA", help="road bandwidths (0.1 0.3)")
    group.add_argument("--episodes", type=int, default=256, help="episodes at each operating point (%(default)s)")
    if parser.get_default("run") is run_evaluate:
        group.add_argument("--seed", type=int, default=0, help="seed of the roads (%(default)s)")


def _add_environment(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group(
        "environment", "by default the bounded road over a range of speeds and bandwidths; with --agent, what it was trained on"
    )
    group.add_argument("--road", type=_component, help=f"{', '.join(ROADS)}, or a JSON mapping with the key kind")
    group.add_argument("--speed-noise", type=_component, help=f"{', '.join(SPEED_NOISES)}, or a JSON mapping with the key kind")
    group.add_argument("--speed-range", type=float, nargs=2, metavar=("LOW", "HIGH"), help="range of speeds, m/s (0.5 3.2)")
    group.add_argument("--bandwidth-range", type=float, nargs=2, metavar=("LOW", "HIGH"), help="range of bandwidths (0.05 0.5)")
    group.add_argument("--damping-range", type=float, nargs=2, metavar=("LOW", "HIGH"), help="range of the action (0.05 1)")
    group.add_argument("--weights", type=_weights, metavar="NAME=WEIGHT,...", help="weights of the cost (displacement=1)")
    group.add_argument(
        "--observation",
        nargs="*",
        metavar="NAME",
        help=f"signals to observe, of {', '.join(SIGNALS)}; with no name, the operating point (speed, bandwidth) alone",
    )
    group.add_argument(
        "--hide-operating-point", action="store_true", default=None, help="do not observe speed and bandwidth unless named"
    )
    group.add_argument("--control-interval", type=float, metavar="S", help="time between actions, s (0.2/natural frequency)")
    group.add_argument("--natural-frequency", type=float, metavar="W1", help="natural frequency of the car, rad/s (1)")


def _path(text: str) -> str:
    if not text:
        raise argparse.ArgumentTypeError("must not be empty")
    return text


def _component(text: str) -> Any:
    if not text.lstrip().startswith("{"):
        return text
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise argparse.ArgumentTypeError(f"not JSON: {error}") from None


def _weights(text: str) -> dict[str, float]:
    weights = {}
    for part in text.split(","):
        name, separator, value = part.partition("=")
        try:
            weights[name.strip()] = float(value) if separator else 1.0
        except ValueError:
            raise argparse.ArgumentTypeError(f"the weight of {name!r} must be a number, got {value!r}") from None
    return weights


def environment_from(chosen: argparse.Namespace) -> dict[str, Any]:
    """Parameters of the environment from the options, over the defaults; checks them."""
    from roadgym.task import make_task

    from .training import DEFAULT_ENVIRONMENT

    environment = dict(DEFAULT_ENVIRONMENT)
    given = {
        "road": chosen.road,
        "speed_noise": chosen.speed_noise,
        "speed": chosen.speed_range,
        "bandwidth": chosen.bandwidth_range,
        "damping_range": chosen.damping_range,
        "reward": chosen.weights,
        "observation": chosen.observation,
        "observe_operating_point": None if chosen.hide_operating_point is None else False,
        "control_interval": chosen.control_interval,
        "natural_frequency": chosen.natural_frequency,
    }
    environment.update({name: value for name, value in given.items() if value is not None})
    if chosen.bandwidth_range is None and make_task(road=environment["road"]).bandwidth[1] == 0:
        del environment["bandwidth"]
    make_task(**environment)
    return environment


def _grid(chosen: argparse.Namespace) -> dict[str, Any]:
    from .comparison import BANDWIDTHS, SPEEDS

    return {"speeds": chosen.speeds or SPEEDS, "bandwidths": chosen.bandwidths or BANDWIDTHS}


def _check_evaluation(chosen: argparse.Namespace, environment: dict[str, Any]) -> None:
    """Find fault with the evaluation before any long work."""
    from roadgym.parameters import whole
    from roadgym.task import make_task

    from .comparison import observed_in_full
    from .controllers import make_controller
    from .evaluation import FEWEST_EPISODES, make_points

    grid = _grid(chosen)
    task = make_task(**observed_in_full(environment))
    make_points(task, grid["speeds"], grid["bandwidths"])
    for name in getattr(chosen, "controllers", None) or ():
        make_controller(name, task)
    whole("episodes", chosen.episodes, low=FEWEST_EPISODES)
    whole("seed", chosen.seed, low=0)


def _train(chosen: argparse.Namespace, folder: Path, environment: dict[str, Any] | None, *, seed: int, resume: bool) -> Any:
    from .progress import training_progress
    from .training import load_hyperparameters, train

    with training_progress() as report:
        return train(
            folder,
            algorithm=chosen.algorithm,
            environment=environment,
            hyperparameters=load_hyperparameters(chosen.algorithm, chosen.hyperparameters),
            seed=seed,
            timesteps=chosen.timesteps,
            checkpoint_interval=chosen.checkpoint_interval,
            resume=resume,
            tensorboard=getattr(chosen, "tensorboard", False),
            report=report,
        )


def run_train(chosen: argparse.Namespace) -> None:
    """``roadgym train``."""
    folder = Path(chosen.output)
    agent = _train(chosen, folder, None if chosen.resume else environment_from(chosen), seed=chosen.seed, resume=chosen.resume)
    print(f"trained for {agent.description['timesteps']} steps: {folder}")


def run_tune(chosen: argparse.Namespace) -> None:
    """``roadgym tune``."""
    from .progress import tuning_progress
    from .training import load_hyperparameters, make_output
    from .tuning import tune, write_best

    if chosen.output:
        make_output(chosen.output)  # before the work
    with tuning_progress() as report:
        best = tune(
            chosen.storage,
            algorithm=chosen.algorithm,
            trials=chosen.trials,
            timesteps=chosen.timesteps,
            environment=environment_from(chosen),
            hyperparameters=load_hyperparameters(chosen.algorithm, chosen.hyperparameters),
            seed=chosen.seed,
            report=report,
        )
    print(f"best of {best.trials} trials: trial {best.number}, {best.value:.4f} of the best constant damping's costs")
    for name, value in best.hyperparameters.items():
        print(f"  {name}: {value}")
    if chosen.output:
        write_best(best, chosen.output, " ".join(["roadgym", *sys.argv[1:]]))
        print(f"wrote {chosen.output}", file=sys.stderr)


def run_evaluate(chosen: argparse.Namespace) -> None:
    """``roadgym evaluate``."""
    from roadgym.task import make_task

    from .comparison import adjusted_by, observed_in_full, with_error
    from .controllers import make_controller
    from .evaluation import Predictor, evaluate, standard_error
    from .progress import work_progress
    from .training import load

    if chosen.agent:
        agent = load(chosen.agent)
        controller: Predictor = agent
        environment, name = agent.description["environment"], chosen.agent
        _refuse_environment(chosen)
    else:
        environment = environment_from(chosen)
        name = chosen.controller
        controller = make_controller(name, make_task(**observed_in_full(environment)))
    _check_evaluation(chosen, environment)
    with work_progress() as report:
        result = evaluate(
            {name: controller},
            environment=environment,
            episodes=chosen.episodes,
            seed=chosen.seed,
            report=report,
            **_grid(chosen),
        )[name]
    rows = [
        {
            "speed": point.speed,
            "bandwidth": point.bandwidth,
            "cost": float(result.mean[k]),
            "standard_error": float(result.standard_error[k]),
            "driven_cost": float(result.costs[k].mean()),
            "driven_standard_error": float(standard_error(result.costs[k])),
            "switches": float(result.switches[k]),
        }
        for k, point in enumerate(result.points)
    ]
    if chosen.json:
        print(json.dumps({"controller": name, "control_variates": result.control_variates, "rows": rows}, indent=2))
        return
    print("speed m/s  bandwidth            cost  switches 1/s")
    for row in rows:
        cost = with_error(row["cost"], row["standard_error"])
        print(f"{row['speed']:9g}  {row['bandwidth']:9g}  {cost:>14}  {row['switches']:12.3f}")
    if result.control_variates:
        print(adjusted_by(result.control_variates))


def run_compare(chosen: argparse.Namespace) -> None:
    """``roadgym compare``."""
    from roadgym.files import remove_parts
    from roadgym.parameters import whole

    from .comparison import AGENT, compare, group_agents, table, write
    from .progress import work_progress
    from .training import LOCK, load, locked, make_folder

    if chosen.agent:
        _refuse_environment(chosen)
        known: dict[Path, str] = {}
        for name in chosen.agent:
            other = known.setdefault(Path(name).resolve(), name)
            if other is not name:
                raise ParameterError(f"--agent has the same folder twice, {other!r} and {name!r}")
        learned, environment = group_agents({folder: load(folder) for folder in chosen.agent})
    else:
        learned, environment = {AGENT: []}, environment_from(chosen)
        whole("seeds", chosen.seeds)
    _check_evaluation(chosen, environment)
    folder = make_folder(chosen.output)
    with locked(folder / LOCK, "comparison"):
        remove_parts(folder)
        for seed in () if chosen.agent else range(chosen.seed, chosen.seed + chosen.seeds):
            place = folder / f"agent-{seed}"
            same = _same_agent(chosen, place, environment, seed)
            learned[AGENT].append(_train(chosen, place, environment, seed=seed, resume=same))
        with work_progress() as report:
            comparison = compare(
                learned,
                environment=environment,
                episodes=chosen.episodes,
                seed=chosen.seed,
                report=report,
                controllers=chosen.controllers,
                **_grid(chosen),
            )
        print(comparison.to_json() if chosen.json else table(comparison), flush=True)  # before the files, which may fail
        with work_progress() as report:
            files = write(comparison, folder, report)
    for file in files:
        print(f"wrote {file}", file=sys.stderr)


def run_drive(chosen: argparse.Namespace) -> None:
    """``roadgym drive``."""
    from roadgym.task import make_task

    from .comparison import observed_in_full
    from .driving import check_output, drive, find_rival, make_driver
    from .progress import work_progress
    from .training import load

    if chosen.output:
        check_output(chosen.output)
    found = [(chosen.agent or chosen.controller, load(chosen.agent) if chosen.agent else None)]
    if chosen.versus:
        found.append((chosen.versus, find_rival(chosen.versus)))
    agents = [agent for _, agent in found if agent]
    if agents:
        _refuse_environment(chosen)
    environment = agents[0].description["environment"] if agents else environment_from(chosen)
    task = make_task(**observed_in_full(environment))
    drivers = [(name, make_driver(name, agent, task)) for name, agent in found]
    with work_progress() as report:
        drive(
            drivers,
            environment=environment,
            output=chosen.output,
            seconds=chosen.seconds,
            speed=chosen.speed,
            bandwidth=chosen.bandwidth,
            seed=chosen.seed,
            report=report,
        )
    if chosen.output:
        print(chosen.output)


def run_certify(chosen: argparse.Namespace) -> int:
    """``roadgym certify``."""
    from analysis.certification import certify

    from .progress import work_progress

    with work_progress() as report:
        certificate = certify(
            chosen.road,
            chosen.speed_noise,
            speed=chosen.speed,
            damping=chosen.damping,
            natural_frequency=chosen.natural_frequency,
            seed=chosen.seed,
            lanes=chosen.lanes,
            report=report,
        )
    print(certificate.to_json() if chosen.json else certificate.table())
    return 0 if certificate.passed else 1


def run_benchmark(chosen: argparse.Namespace) -> None:
    """``roadgym benchmark``."""
    from .benchmark import CASES, draw_scaling, scaling, scaling_table, table
    from .training import make_output, versions, write_atomically

    if chosen.output:
        path = make_output(chosen.output)  # before the work
        picture = path.with_suffix(".png")
        if chosen.scaling and make_output(picture) == path:
            raise ParameterError(f"output must not end in .png, which the picture beside it does, got {chosen.output!r}")
    names = chosen.only or list(CASES)
    for name in names:
        if name not in CASES:
            raise ParameterError(f"unknown case {name!r}; known: {', '.join(CASES)}")
    results = []
    for name in names:
        print(f"measuring {name}", file=sys.stderr, flush=True)
        results.append(CASES[name]())
    rows = scaling() if chosen.scaling else []
    content = {"results": [dataclasses.asdict(r) for r in results], "scaling": rows, "versions": versions()}
    if chosen.json:
        print(json.dumps(content, indent=2))
    else:
        print("\n\n".join([table(results), *([scaling_table(rows)] if rows else [])]))
    if chosen.output:
        write_atomically(path, json.dumps(content, indent=2) + "\n")
        if rows:
            draw_scaling(rows, picture)


def run_figures(chosen: argparse.Namespace) -> None:
    """``roadgym figures``."""
    from analysis.paper.figures import write

    from .progress import work_progress

    with work_progress() as report:
        files = write(chosen.output, chosen.only, full=chosen.full, report=report)
    for file in files:
        print(file)


def run_explore(chosen: argparse.Namespace) -> None:
    """``roadgym explore``."""
    from analysis import explorer

    view = {"road": chosen.road, "speed_noise": chosen.speed_noise, **dict(chosen.value)}
    print(explorer.write(chosen.output, view | ({"weights": chosen.weights} if chosen.weights else {})))


def run_errata(chosen: argparse.Namespace) -> None:
    """``roadgym errata``."""
    from analysis.paper import errata

    from .progress import work_progress

    with work_progress() as report:
        checks = errata.run(chosen.only, report=report)
    print(json.dumps([dataclasses.asdict(check) for check in checks], indent=2) if chosen.json else errata.table(checks))


def run_cache(chosen: argparse.Namespace) -> None:
    """``roadgym cache``."""
    from analysis.feedback import kept_files
    from roadgym import cache

    from .controllers import cache_folder

    places = (
        ("compiled code", cache.compiled_folder(), cache.compiled_files),
        ("optimal feedbacks", cache_folder(), lambda: kept_files(cache_folder())),
    )
    print(f"{'':17}  {'files':>6}  {'MB':>8}  folder")
    for what, folder, find in places:
        sizes = [path.stat().st_size for path in find() if path.exists()]
        print(f"{what:17}  {len(sizes):6}  {sum(sizes) / 1e6:8.2f}  {folder or 'nowhere: there is no home folder'}")
    if chosen.clear:
        cache.clear_compiled()
        for path in kept_files(cache_folder()):
            path.unlink(missing_ok=True)
        print("cleared")


def _same_agent(chosen: argparse.Namespace, folder: Path, environment: dict[str, Any], seed: int) -> bool:
    """Does the folder hold an agent that this very command began? Then it is resumed; any other is an error of training."""
    from .training import DESCRIPTION, load, load_hyperparameters, plain

    if not (folder / DESCRIPTION).exists():
        return False
    known = load(folder).description
    asked = {
        "algorithm": chosen.algorithm,
        "environment": plain(environment),
        "hyperparameters": plain(load_hyperparameters(chosen.algorithm, chosen.hyperparameters)),
        "seed": seed,
    }
    return all(known.get(name) == value for name, value in asked.items())


def _refuse_environment(chosen: argparse.Namespace) -> None:
    """With an agent the environment is given."""
    options = ("road", "speed_noise", "speed_range", "bandwidth_range", "damping_range", "weights")
    for name in (*options, "observation", "hide_operating_point", "control_interval", "natural_frequency"):
        if getattr(chosen, name) is not None:
            raise ParameterError(f"--{name.replace('_', '-')} cannot be given with --agent: the agent's environment holds")


if __name__ == "__main__":
    sys.exit(main())
