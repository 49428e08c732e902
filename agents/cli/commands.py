"""What each command does; the libraries that it needs are loaded when it runs."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

from roadgym import ParameterError
from roadgym.installation import require

from .options import environment_from, refuse_environment


def _grid(chosen: argparse.Namespace) -> dict[str, Any]:
    """The operating points that are chosen."""
    from ..comparison import BANDWIDTHS, SPEEDS

    return {"speeds": chosen.speeds or SPEEDS, "bandwidths": chosen.bandwidths or BANDWIDTHS}


def _check_evaluation(chosen: argparse.Namespace, environment: dict[str, Any]) -> None:
    """Find fault with the evaluation before any long work."""
    from roadgym.parameters import whole
    from roadgym.task import make_task

    from ..comparison import observed_in_full
    from ..controllers import make_controller
    from ..evaluation import FEWEST_EPISODES, make_points

    points = _grid(chosen)
    task = make_task(**observed_in_full(environment))
    make_points(task, **points)
    for name in getattr(chosen, "controllers", None) or ():
        make_controller(name, task)
    whole("episodes", chosen.episodes, low=FEWEST_EPISODES)
    whole("seed", chosen.seed, low=0)


def _train(chosen: argparse.Namespace, folder: Path, environment: dict[str, Any] | None, *, seed: int, resume: bool) -> Any:
    from ..progress import training_progress
    from ..training import load_hyperparameters, train

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
    from ..progress import tuning_progress
    from ..records import make_output
    from ..training import load_hyperparameters
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

    from ..agent import load
    from ..comparison import AGENT, compare, group_agents, table, write
    from ..progress import work_progress
    from ..records import LOCK, locked, make_folder

    if chosen.agent:
        refuse_environment(chosen)
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
    for package, extra in (("stable_baselines3", "train"), ("matplotlib", "report"), ("jinja2", "report"), ("yaml", "report")):
        require(package, extra)  # before the work
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

    from ..agent import load
    from ..comparison import observed_in_full
    from ..driving import check_output, drive, find_rival, make_driver
    from ..progress import work_progress

    if chosen.output:
        check_output(chosen.output)
    found = [(chosen.agent or chosen.controller, load(chosen.agent) if chosen.agent else None)]
    if chosen.versus:
        found.append((chosen.versus, find_rival(chosen.versus)))
    agents = [agent for _, agent in found if agent]
    if agents:
        refuse_environment(chosen)
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

    from ..progress import work_progress

    with work_progress() as report:
        certificate = certify(
            chosen.road,
            chosen.speed_noise,
            speed=chosen.speed,
            damping=chosen.damping,
            natural_frequency=chosen.natural_frequency,
            car=chosen.car,
            seed=chosen.seed,
            lanes=chosen.lanes,
            report=report,
        )
    print(certificate.to_json() if chosen.json else certificate.table())
    return 0 if certificate.passed else 1


def run_benchmark(chosen: argparse.Namespace) -> None:
    """``roadgym benchmark``."""
    from ..benchmark import CASES, draw_scaling, scaling, scaling_table, table
    from ..records import make_output, versions, write_atomically

    if chosen.output:
        path = make_output(chosen.output)  # before the work
        picture = path.with_suffix(".png")
        if chosen.scaling and make_output(picture) == path:
            raise ParameterError(f"output must not end in .png, which the picture beside it does, got {chosen.output!r}")
    names = chosen.only or list(CASES)
    for name in names:
        if name not in CASES:
            raise ParameterError(f"unknown case {name!r}; known: {', '.join(CASES)}")
    if {"adapter", "share_of_training"} & set(names):
        require("stable_baselines3", "train")
    if chosen.scaling and chosen.output:
        require("matplotlib", "report")
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

    from ..progress import work_progress

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

    from ..progress import work_progress

    with work_progress() as report:
        checks = errata.run(chosen.only, report=report)
    print(json.dumps([dataclasses.asdict(check) for check in checks], indent=2) if chosen.json else errata.table(checks))


def run_cache(chosen: argparse.Namespace) -> None:
    """``roadgym cache``."""
    from analysis.feedback import kept_files
    from roadgym import cache

    from ..controllers import cache_folder

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
    from ..agent import DESCRIPTION, load
    from ..records import plain
    from ..training import load_hyperparameters

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
