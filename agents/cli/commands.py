"""What each command does; the libraries that it needs are loaded when it runs."""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from roadgym import ParameterError
from roadgym.installation import require

from .options import environment_from, given_environment, refuse, refuse_environment, refuse_observation

DESCRIPTION = "agent.json"


def grid(chosen: argparse.Namespace, environment: dict[str, Any]) -> dict[str, Any]:
    """The operating points that are chosen, or those of the paper where the environment has them, or others of its range."""
    from roadgym.task import make_task

    from ..comparison import BANDWIDTHS, SPEEDS, observed_in_full

    def within(values: tuple[float, ...], low: float, high: float, number: int) -> tuple[float, ...]:
        inside = all(low <= value <= high for value in values)
        return values if inside else tuple(dict.fromkeys(np.linspace(low, high, number).tolist()))

    task = make_task(**observed_in_full(environment))
    speeds, bandwidths = within(SPEEDS, *task.speed, 3), within(BANDWIDTHS, *task.bandwidth, 2)
    return {"speeds": chosen.speeds or speeds, "bandwidths": chosen.bandwidths or bandwidths}


def check_evaluation(chosen: argparse.Namespace, environment: dict[str, Any]) -> None:
    """Find fault with the evaluation before any long work."""
    from roadgym.kalman import KalmanFilter
    from roadgym.parameters import whole
    from roadgym.task import make_task

    from ..comparison import observed_in_full
    from ..controllers import make_controller
    from ..evaluation import FEWEST_EPISODES, make_points

    points = grid(chosen, environment)
    task = make_task(**observed_in_full(environment))
    if task.bandwidth[1] == 0:
        refuse(chosen, ["bandwidths"], f"on a {task.road.kind} road, which has no bandwidth")
    make_points(task, **points)
    if getattr(chosen, "estimator", None):
        KalmanFilter(make_task(**environment))
    for name in getattr(chosen, "controllers", None) or ():
        make_controller(name, task)
    whole("episodes", chosen.episodes, low=FEWEST_EPISODES)
    whole("seed", chosen.seed, low=0)


def _loaded(chosen: argparse.Namespace) -> dict[str, Any]:
    """Hyperparameters of the file, with the estimator of the command line."""
    from ..hyperparameters import load_hyperparameters

    estimator = getattr(chosen, "estimator", None)
    return load_hyperparameters(chosen.algorithm, chosen.hyperparameters) | ({"estimator": estimator} if estimator else {})


def _hyperparameters(chosen: argparse.Namespace) -> dict[str, Any]:
    """The same, with the wrappers of the command line."""
    from ..wrappers import with_wrappers

    return with_wrappers(_loaded(chosen), chosen.wrapper)


def choose_algorithm(chosen: argparse.Namespace, environment: Mapping[str, Any]) -> None:
    """Fill in the algorithm where none is named."""
    from roadgym.task import make_task

    from ..training import usual_algorithm

    if chosen.algorithm is None:
        other, estimator = chosen.hyperparameters is not None, getattr(chosen, "estimator", None)
        chosen.algorithm = usual_algorithm(make_task(**environment), other, chosen.wrapper, estimator)


def training_options(
    chosen: argparse.Namespace, environment: dict[str, Any] | None, *, seed: int, resume: bool
) -> dict[str, Any]:
    """What `agents.train` is told; to go on with an agent, what is given, which must be what it was trained with."""

    def given(value: Any, name: str) -> Any:
        return value if not resume or name in chosen.given else None

    return {
        "algorithm": given(chosen.algorithm, "algorithm"),
        "environment": environment,
        "hyperparameters": given(_loaded(chosen), "hyperparameters"),
        "wrappers": chosen.wrapper,
        "seed": given(seed, "seed"),
        "timesteps": chosen.timesteps,
        "checkpoint_interval": chosen.checkpoint_interval,
        "imports": chosen.imports,
    }


def run_train(chosen: argparse.Namespace) -> None:
    """``roadgym train``."""
    from ..agent import read_description
    from ..training import train

    folder = Path(chosen.output)
    if chosen.resume:
        refuse(chosen, ["estimator"], "with --resume: the agent's own holds")
        known = read_description(folder)["environment"]
        environment = {**known, **given_environment(chosen)}
    else:
        environment = environment_from(chosen)
    choose_algorithm(chosen, environment)
    options = training_options(chosen, environment, seed=chosen.seed, resume=chosen.resume)
    agent = train(folder, **options, resume=chosen.resume, tensorboard=chosen.tensorboard)
    print(f"trained for {agent.description['timesteps']} steps: {folder}")


def run_tune(chosen: argparse.Namespace) -> None:
    """``roadgym tune``."""
    from ..progress import tuning_progress
    from ..records import make_output
    from ..tuning import tune, write_best

    if chosen.output:
        make_output(chosen.output)  # before the work
    with tuning_progress() as report:
        best = tune(
            chosen.storage,
            algorithm=chosen.algorithm,
            trials=chosen.trials,
            timesteps=chosen.timesteps,
            environment=environment_from(chosen),
            hyperparameters=_hyperparameters(chosen),
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
    from analysis.certificate import wrapped
    from roadgym.task import make_task

    from ..agent import load
    from ..comparison import adjusted_by, observed_in_full, with_error
    from ..controllers import make_controller
    from ..evaluation import Predictor, evaluate, standard_error
    from ..progress import work_progress

    if chosen.agent:
        agent = load(chosen.agent)
        controller: Predictor = agent
        environment, name = agent.description["environment"], chosen.agent
        refuse_environment(chosen)
        refuse(chosen, ["estimator"], "with --agent: the agent's own holds")
    else:
        environment = environment_from(chosen)
        name = chosen.controller
        if chosen.estimator:
            controller = make_controller(name, make_task(**environment), estimator=chosen.estimator)
        else:
            refuse_observation(chosen)
            controller = make_controller(name, make_task(**observed_in_full(environment)))
    check_evaluation(chosen, environment)
    with work_progress() as report:
        result = evaluate(
            {name: controller},
            environment=environment,
            episodes=chosen.episodes,
            seed=chosen.seed,
            report=report,
            **grid(chosen, environment),
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
        variates = {"control_variates": result.control_variates, "balances": result.balances}
        print(json.dumps({"controller": name, **variates, "rows": rows}, indent=2))
        return
    print("speed m/s  bandwidth            cost  switches 1/s")
    for row in rows:
        cost = with_error(row["cost"], row["standard_error"])
        print(f"{row['speed']:9g}  {row['bandwidth']:9g}  {cost:>14}  {row['switches']:12.3f}")
    if result.control_variates:
        print("\n".join(wrapped(adjusted_by(result.control_variates, result.balances))))


def run_compare(chosen: argparse.Namespace) -> None:
    """``roadgym compare``."""
    from roadgym.files import remove_parts
    from roadgym.parameters import whole
    from roadgym.vector import QuarterCarVectorEnv

    from ..agent import load
    from ..certified import check_bound
    from ..comparison import AGENT, compare, group_agents, table, write
    from ..progress import Stopwatch, work_progress
    from ..records import LOCK, check_seed, locked, make_folder

    seeds = range(0)
    if chosen.agent:
        refuse_environment(chosen)
        known: dict[Path, str] = {}
        for name in chosen.agent:
            other = known.setdefault(Path(name).resolve(), name)
            if other is not name:
                raise ParameterError(f"--agent has the same folder twice, {other!r} and {name!r}")
        loaded = {folder: load(folder) for folder in chosen.agent}
        _refuse_training(chosen, {folder: agent.description for folder, agent in loaded.items()})
        learned, environment = group_agents(loaded)
        if chosen.estimator:  # of what the first one observes
            environment = next(iter(loaded.values())).description["environment"]
        kinds = [_kind(agent.description) for agent in loaded.values()]
    else:
        learned, environment = {AGENT: []}, environment_from(chosen)
        choose_algorithm(chosen, environment)
        seeds = range(chosen.seed, chosen.seed + whole("seeds", chosen.seeds))
        kinds = [_asked(chosen, environment)]
    check_evaluation(chosen, environment)
    check_bound(chosen.bound)
    for package, extra in (("stable_baselines3", "train"), ("matplotlib", "report"), ("jinja2", "report"), ("yaml", "report")):
        require(package, extra)  # before the work
    if seeds:
        check_seed(seeds[-1])
    folder = make_folder(_results_folder(chosen, kinds))
    steps, watch = 3 if seeds else 2, Stopwatch()
    with locked(folder / LOCK, "comparison"):
        remove_parts(folder)
        QuarterCarVectorEnv(1, **environment).reset(seed=0)  # which compiles the plant where it is not
        watch.note("compiling")
        if seeds:
            _tell(f"step 1 of {steps}: training {', '.join(str(folder / f'agent-{seed}') for seed in seeds)}")
            learned[AGENT] = _trained(chosen, folder, environment, seeds)
            watch.note("training")
        _tell(f"step {steps - 1} of {steps}: driving")
        with work_progress() as report:

            def tell(what: str, done: int, total: int) -> None:
                watch.note(next((part for part in ("driving", "lower bounds") if what.startswith(part)), "optimal feedback"))
                report(what, done, total)

            comparison = compare(
                learned,
                environment=environment,
                episodes=chosen.episodes,
                seed=chosen.seed,
                controllers=chosen.controllers,
                bound=chosen.bound,
                estimator=chosen.estimator,
                report=tell,
                **grid(chosen, environment),
            )
        watch.note("driving")
        print(comparison.to_json() if chosen.json else table(comparison), flush=True)  # before the files, which may fail
        _tell(f"step {steps} of {steps}: drawing and writing")
        with work_progress() as report:
            files = write(comparison, folder, report)
        watch.note("drawing and writing")
    _tell(f"took {watch}")
    for file in files:
        print(f"wrote {file}", file=sys.stderr)


def _trained(chosen: argparse.Namespace, folder: Path, environment: dict[str, Any], seeds: Sequence[int]) -> list[Any]:
    """The agents of all seeds, at once where several are to be begun."""
    from ..agent import load
    from ..jobs import executor
    from ..sweep import train_agent
    from ..training import train

    places = {seed: folder / f"agent-{seed}" for seed in seeds}
    there = {seed: (place / DESCRIPTION).exists() for seed, place in places.items()}
    options = {seed: training_options(chosen, environment, seed=seed, resume=resume) for seed, resume in there.items()}
    if list(there.values()).count(False) < 2:
        return [train(places[seed], **options[seed], resume=there[seed]) for seed in seeds]
    with executor(imports=chosen.imports) as processes:
        for future in [processes.submit(train_agent, str(places[seed].resolve()), options[seed]) for seed in seeds]:
            future.result()
    return [load(place) for place in places.values()]


def _tell(what: str) -> None:
    print(what, file=sys.stderr, flush=True)


def _refuse_training(chosen: argparse.Namespace, descriptions: Mapping[str, Mapping[str, Any]]) -> None:
    """With agents that are trained already nothing is trained."""
    folder, known = next(iter(descriptions.items()))
    for name in ("algorithm", "timesteps"):
        value = known[name]
        why = f"as {getattr(chosen, name)!r} with --agent, which trains nothing: {folder!r} was trained with {value!r}"
        refuse(chosen, [name], why)
    refuse(chosen, ["hyperparameters", "wrapper", "checkpoint_interval", "seeds"], "with --agent, which trains nothing")


def _kind(description: Mapping[str, Any]) -> dict[str, Any]:
    """What agents have in common that differ in the seed alone."""
    from ..agent import complete

    own = {name: description[name] for name in ("algorithm", "environment")}
    return own | {"hyperparameters": complete(description["hyperparameters"])}


def _asked(chosen: argparse.Namespace, environment: dict[str, Any]) -> dict[str, Any]:
    """The kind of agent that is to be trained."""
    from ..records import plain

    asked = {**vars(chosen), "environment": environment, "hyperparameters": _hyperparameters(chosen)}
    found: dict[str, Any] = plain(_kind(asked))
    return found


def _results_folder(chosen: argparse.Namespace, kinds: list[dict[str, Any]]) -> Path:
    """The folder of the results: the one that is given, or the first that holds no results of other agents.

    Raises:
        AgentError: the given one does.
    """
    from ..errors import AgentError

    base = Path(chosen.output)
    if "output" in chosen.given:
        other = _other_agent(chosen, base, kinds)
        if other is not None:
            raise AgentError(f"{str(base)!r} holds an agent of other options, {other}: choose another folder with --output")
        return base
    names = (base if number == 1 else base.with_name(f"{base.name}-{number}") for number in itertools.count(1))
    return next(folder for folder in names if _other_agent(chosen, folder, kinds) is None)


def _other_agent(chosen: argparse.Namespace, folder: Path, kinds: list[dict[str, Any]]) -> str | None:
    """An agent of another kind whose training or comparison ``folder`` holds, or one trained for longer than asked; or None."""
    from ..agent import read_description
    from ..training import outlasts

    for place in sorted(folder.glob(f"agent-*/{DESCRIPTION}")):
        description = read_description(place.parent)
        if _kind(description) not in kinds or (not chosen.agent and outlasts(description, chosen.timesteps)):
            return place.parent.name
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError, AttributeError):  # somebody else's file
        compared = json.loads((folder / "comparison.json").read_text(encoding="utf-8"))["agents"]
        for name, descriptions in compared.items():
            if any(description is not None and _kind(description) not in kinds for description in descriptions):
                return str(name)
    return None


def run_drive(chosen: argparse.Namespace) -> None:
    """``roadgym drive``."""
    from roadgym.task import make_task

    from ..agent import load
    from ..comparison import observed_in_full
    from ..driving import check_output, drive, find_rival, make_driver
    from ..names import title
    from ..progress import work_progress

    if chosen.output:
        check_output(chosen.output)
    found = [(chosen.agent or chosen.controller, load(chosen.agent) if chosen.agent else None)]
    if chosen.versus:
        found.append((chosen.versus, find_rival(chosen.versus)))
    agents = [agent for _, agent in found if agent]
    if agents:
        refuse_environment(chosen, "--agent" if chosen.agent else "--versus")
    else:
        refuse_observation(chosen)
    environment = agents[0].description["environment"] if agents else environment_from(chosen)
    task = make_task(**observed_in_full(environment))
    drivers = [(name if agent else title(name), make_driver(name, agent, task)) for name, agent in found]
    with work_progress() as report:
        drive(
            drivers,
            environment=environment,
            output=chosen.output,
            seconds=chosen.seconds,
            pace=chosen.pace,
            speed=chosen.speed,
            bandwidth=chosen.bandwidth,
            seed=chosen.seed,
            report=report,
        )
    if chosen.output:
        print(chosen.output)


def run_export(chosen: argparse.Namespace) -> None:
    """``roadgym export``."""
    from ..agent import load
    from ..export import check_output, export, file_name, tabulate, told
    from ..progress import work_progress

    name = file_name(Path(chosen.agent).resolve().name) if chosen.name is None else chosen.name
    check_output(chosen.to, chosen.output, name)
    source: Any = load(chosen.agent)
    if chosen.to == "table":
        environment = source.description["environment"]
        check_evaluation(chosen, environment)
        with work_progress() as report:
            source = tabulate(
                source,
                signals=chosen.signals,
                episodes=chosen.episodes,
                seed=chosen.seed,
                report=report,
                **grid(chosen, environment),
            )
        print(told(source), flush=True)
    else:
        refuse(
            chosen, ("signals", "speeds", "bandwidths", "episodes", "seed"), f"with --to {chosen.to}, which evaluates nothing"
        )
    for file in export(source, chosen.to, chosen.output, name):
        print(f"wrote {file}", file=sys.stderr)
