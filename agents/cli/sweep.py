"""``roadgym sweep``."""

from __future__ import annotations

import argparse
import copy
import itertools
import json
import shlex
import sys
from pathlib import Path
from typing import Any

from roadgym import ParameterError
from roadgym.installation import require
from roadgym.parameters import whole
from roadgym.vector import QuarterCarVectorEnv

from .commands import check_evaluation, choose_algorithm, grid, training_options
from .options import environment_from

SWEPT = ("algorithm", "hyperparameters", "wrapper", "timesteps", "estimator")  # beside those of the environment


def run_sweep(chosen: argparse.Namespace) -> int:
    """``roadgym sweep``; exit code 1 if any of it failed."""
    from ..certified import check_bound
    from ..jobs import executor
    from ..records import check_seed, make_folder
    from ..sweep import sweep, table

    seeds = range(chosen.seed, chosen.seed + whole("seeds", chosen.seeds))
    check_seed(seeds[-1])
    check_bound(chosen.bound)
    for package, extra in (("stable_baselines3", "train"), ("matplotlib", "report"), ("jinja2", "report"), ("yaml", "report")):
        require(package, extra)  # before the work
    cases = {name: _case(case) for name, case in _cases(chosen).items()}
    folder = make_folder(chosen.output)
    QuarterCarVectorEnv(1, **next(iter(cases.values()))[0]["environment"]).reset(seed=0)  # compiles the plant once for all
    with executor(
        chosen.on, chosen.workers, folder / "jobs", imports=chosen.imports, options=dict(map(_option, chosen.launch))
    ) as jobs:
        outcomes = sweep(cases, folder, seeds=seeds, executor=jobs)
    print(table(outcomes))
    print(f"wrote {Path(folder) / 'sweep.json'}", file=sys.stderr)
    return int(any(outcome.failures for outcome in outcomes))


def _cases(chosen: argparse.Namespace) -> dict[str, argparse.Namespace]:
    """What was chosen, once for each combination of the values of --over, by a name that tells them."""
    names = [option for option, *_ in chosen.over]
    for option, *values in chosen.over:
        if not values or names.count(option) > 1:
            raise ParameterError(f"--over must name an option once, and at least one value of it, got {option!r}")
    found = {}
    for values in itertools.product(*(values for _, *values in chosen.over)):
        case = copy.copy(chosen)
        for option, value in zip(names, values, strict=True):
            _choose(case, option, value)
        found[", ".join(f"{option} {value}" for option, value in zip(names, values, strict=True)) or "agent"] = case
    return found


def _choose(case: argparse.Namespace, option: str, value: str) -> None:
    """Set an option, as if it had been given with this value."""
    from .parser import given_options, make_parser

    words = ["sweep", "--output", case.output]
    given = [*words, f"--{option}", *shlex.split(value)]
    (name,) = given_options(given) - given_options(words) or {""}
    if name not in SWEPT and not name.startswith("environment_"):
        raise ParameterError(f"--over must name an option of training or of the environment, got {option!r}")
    setattr(case, name, getattr(make_parser().parse_args(given), name))
    case.given = case.given | {name}


def _case(chosen: argparse.Namespace) -> tuple[dict[str, Any], dict[str, Any]]:
    """What `agents.train` and `agents.compare` are told of a case."""
    environment = environment_from(chosen)
    choose_algorithm(chosen, environment)
    check_evaluation(chosen, environment)
    training = training_options(chosen, environment, seed=chosen.seed, resume=False)
    evaluation = {name: getattr(chosen, name) for name in ("episodes", "seed", "controllers", "bound", "estimator")}
    return training, {**evaluation, **grid(chosen, environment)}


def _option(text: str) -> tuple[str, Any]:
    """A name and a value of what the cluster is asked for: JSON where it is that, else text."""
    name, separator, value = text.partition("=")
    if not separator:
        raise ParameterError(f"--launch must be NAME=VALUE, got {text!r}")
    try:
        return name, json.loads(value)
    except ValueError:
        return name, value
