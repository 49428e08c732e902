"""What the commands do that ask theory: certify, explore, figures, errata; and benchmark and cache."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from typing import Any

import numpy as np

from roadgym import ParameterError
from roadgym.cars import make_car
from roadgym.installation import require
from roadgym.parameters import whole

from .options import refuse

# options that go with --optimal; those of the environment are an agent's own
ASKED = tuple(f"environment_{name}" for name in ("damping_range", "reward", "sensors", "valve"))
OPTIMAL = ("bandwidth", *ASKED, "methods")


def run_certify(chosen: argparse.Namespace) -> int:
    """``roadgym certify``."""
    from analysis.certification import certify

    from ..progress import work_progress

    usual = make_car(chosen.car, chosen.natural_frequency).usual_plant
    plant = {name: getattr(chosen, name) for name in ("road", "speed_noise", "natural_frequency", "car")}
    if chosen.road is None:
        plant["road"] = usual.get("road", "multiplicative")
    if chosen.speed is None and not chosen.agent:
        chosen.speed = float(np.mean(usual.get("speed", 1.0)))
    if chosen.optimal:
        return _certify_optimal(chosen, plant)
    refuse(chosen, OPTIMAL, "without --optimal")
    driver = None
    if chosen.agent or chosen.controller:
        driver, plant = _driver(chosen, plant)
    with work_progress() as report:
        certificate = certify(
            **plant,
            speed=chosen.speed,
            damping=chosen.damping,
            seed=chosen.seed,
            lanes=chosen.lanes,
            driver=driver,
            report=report,
        )
    print(certificate.to_json() if chosen.json else certificate.table())
    return 0 if certificate.passed else 1


def _certify_optimal(chosen: argparse.Namespace, plant: dict[str, Any]) -> int:
    """``roadgym certify --optimal``."""
    from roadgym.task import make_task

    from ..agent import load
    from ..comparison import observed_in_full
    from ..evaluation import FEWEST_EPISODES
    from ..optimality import certify_optimality
    from ..progress import work_progress

    refuse(chosen, ["damping"], "with --optimal, which finds the best one")
    if chosen.agent:
        refuse(chosen, [*plant, *ASKED], "with --agent: the agent's environment holds")
        agent = load(chosen.agent)
        environment = agent.description["environment"]
    else:
        agent = None
        given = {name.removeprefix("environment_"): getattr(chosen, name) for name in ASKED}
        environment = {**plant, **given, "speed": chosen.speed, "bandwidth": chosen.bandwidth}
    task = make_task(**observed_in_full(environment))
    episodes = whole("lanes", chosen.lanes, low=FEWEST_EPISODES) if "lanes" in chosen.given else 1024
    with work_progress() as report:
        found = certify_optimality(
            agent,
            environment=environment,
            speed=sum(task.speed) / 2 if chosen.speed is None else chosen.speed,
            bandwidth=sum(task.bandwidth) / 2 if chosen.bandwidth is None else chosen.bandwidth,
            controllers=[chosen.controller] if chosen.controller else [],
            methods=chosen.methods,
            episodes=episodes,
            seed=chosen.seed,
            report=report,
        )
    print(found.to_json() if chosen.json else found.table())
    return 0 if found.passed else 1


def _driver(chosen: argparse.Namespace, plant: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    """The controller that is to be certified under, and the plant: that of an agent is the one that it was trained on."""
    from roadgym.task import make_task

    from ..agent import load
    from ..controllers import make_controller

    if chosen.agent:
        refuse(chosen, plant, "with --agent: the agent's environment holds")
        agent = load(chosen.agent)
        task = agent.task
        if chosen.speed is None:
            chosen.speed = sum(task.speed) / 2
        if not task.speed[0] <= chosen.speed <= task.speed[1]:
            low, high = task.speed
            raise ParameterError(f"speed must lie within the agent's range [{low:g}, {high:g}], got {chosen.speed:g}")
        return agent, {"road": task.road, "speed_noise": task.speed_noise, "car": task.car}
    return make_controller(chosen.controller, make_task(**plant, speed=chosen.speed)), plant


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

    if chosen.only and 7 not in chosen.only:
        refuse(chosen, ["full"], "without Fig. 7, which alone it changes")
    with work_progress() as report:
        files = write(chosen.output, chosen.only, full=chosen.full, report=report)
    for file in files:
        print(file)


def run_explore(chosen: argparse.Namespace) -> None:
    """``roadgym explore``."""
    from analysis import explorer

    names = [name for name, _ in chosen.value]
    for name in names:
        if names.count(name) > 1:
            raise ParameterError(f"--value gives {name!r} twice")
    given = {"road": chosen.road, "weights": chosen.weights}
    view = {"car": chosen.car, "speed_noise": chosen.speed_noise, **dict(chosen.value)}
    print(explorer.write(chosen.output, view | {name: value for name, value in given.items() if value}))


def run_errata(chosen: argparse.Namespace) -> None:
    """``roadgym errata``."""
    from analysis.paper import errata

    from ..progress import work_progress

    with work_progress() as report:
        checks = errata.run(chosen.only, report=report)
    print(json.dumps([dataclasses.asdict(check) for check in checks], indent=2) if chosen.json else errata.table(checks))


def run_cache(chosen: argparse.Namespace) -> None:
    """``roadgym cache``."""
    from analysis.bounds import kept_files as kept_bounds
    from analysis.feedback import kept_files
    from roadgym import cache

    from ..controllers import cache_folder

    places = (
        ("compiled code", cache.compiled_folder(), cache.compiled_files),
        ("optimal feedbacks", cache_folder(), lambda: kept_files(cache_folder())),
        ("lower bounds", cache_folder(), lambda: kept_bounds(cache_folder())),
    )
    print(f"{'':17}  {'files':>6}  {'MB':>8}  folder")
    for what, folder, find in places:
        sizes = [path.stat().st_size for path in find() if path.exists()]
        print(f"{what:17}  {len(sizes):6}  {sum(sizes) / 1e6:8.2f}  {folder or 'nowhere: there is no home folder'}")
    if chosen.clear:
        cache.clear_compiled()
        for path in [*kept_files(cache_folder()), *kept_bounds(cache_folder())]:
            path.unlink(missing_ok=True)
        print("cleared")
