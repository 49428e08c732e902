"""Many trainings and what they are worth: cases by training seeds, as jobs of one machine or of many.

Each case is trained from several seeds and compared with the best constant damping, the optimal feedback and the lower bounds.
All are jobs of `agents.jobs`: trainings, one for each case and seed; feedbacks and bounds, one for each operating point of each
plant, which are kept in the user's cache folder; and comparisons, one for each case, as soon as its agents are trained.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

from analysis import LowerBound
from roadgym.parameters import ParameterError
from roadgym.task import make_task

from .agent import DESCRIPTION, load
from .certified import NONE, lower_bounds
from .comparison import AGENT, RIVALS, compare, observed_in_full, write
from .controllers import OptimalFeedback
from .evaluation import OperatingPoint, make_points
from .jobs import JobError
from .names import file_names
from .numerals import aligned, percent
from .records import write_atomically
from .results import Share
from .training import silent, train


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What became of a case.

    Attributes:
        name: of the case.
        seeds: training seeds whose agents were compared.
        cost: mean over operating points of the agents' cost over that of the best constant damping; None without agents.
        closed: mean share of the gap to the best known feedback, with its interval over seeds and roads; None without a gap.
        certified: mean share, at least, of what any controller could save, likewise.
        failures: what failed, in a line each.
    """

    name: str
    seeds: tuple[int, ...]
    cost: float | None
    closed: Share | None
    certified: Share | None
    failures: tuple[str, ...]


def quiet(what: str, done: int, total: int) -> None:
    """Report nothing."""


def train_agent(folder: str, options: Mapping[str, Any]) -> int:
    """Train an agent, or go on with the one in the folder; returns the timesteps that it is trained for. This is a job."""
    agent = train(folder, resume=(Path(folder) / DESCRIPTION).exists(), report=silent, **options)
    return int(agent.description["timesteps"])


def find_feedback(environment: Mapping[str, Any], speed: float, bandwidth: float) -> None:
    """Have the optimal feedback of an operating point in the user's cache folder, where there is one. This is a job."""
    task = make_task(**environment)
    with contextlib.suppress(ParameterError):
        OptimalFeedback(task).make_forms(task.frequency_ratio(speed), bandwidth)


def find_bound(environment: Mapping[str, Any], speed: float, bandwidth: float, method: str) -> LowerBound | str:
    """The lower bound of an operating point, or why there is none; kept in the user's cache folder. This is a job."""
    return lower_bounds(make_task(**environment), [OperatingPoint(speed, bandwidth)], method, quiet)[0]


def compare_agents(folder: str, agents: Sequence[str], evaluation: Mapping[str, Any]) -> dict[str, Any]:
    """Compare agents of several seeds and write the report into a folder; returns parts of an `Outcome`. This is a job."""
    loaded = [load(agent) for agent in agents]
    environment = loaded[0].description["environment"]
    comparison = compare({AGENT: loaded}, environment=environment, **evaluation, report=quiet)
    write(comparison, folder, quiet)
    ratios = [comparison.row(AGENT, p).cost / comparison.row("analytic_optimum", p).cost for p in comparison.points]
    gap, certified = comparison.mean_gaps.get(AGENT), comparison.mean_certified.get(AGENT)
    return {
        "cost": sum(ratios) / len(ratios),
        "closed": None if gap is None else gap.closed,
        "certified": None if certified is None else certified.share,
    }


def sweep(
    cases: Mapping[str, tuple[Mapping[str, Any], Mapping[str, Any]]],
    folder: str | Path,
    *,
    seeds: Sequence[int],
    executor: Executor,
) -> list[Outcome]:
    """Train and compare all cases; one that fails leaves the others alone.

    Args:
        cases: by name, keyword arguments of `agents.train`, and of `agents.compare`: at least speeds, bandwidths,
            controllers and bound.
        folder: each case has a folder in it, with its agents and its comparison; and ``sweep.json`` has the outcomes.
        seeds: of training.
        executor: of jobs, as of `agents.jobs.executor`.

    Returns:
        The outcomes, in the order of the cases.
    """
    place, folders = Path(folder).resolve(), file_names(cases)
    trainings: dict[str, dict[int, tuple[str, Future[int]]]] = {}
    for name, (training, _) in cases.items():
        agents = {seed: str(place / folders[name] / f"agent-{seed}") for seed in seeds}
        trainings[name] = {
            seed: (agent, executor.submit(train_agent, agent, {**training, "seed": seed})) for seed, agent in agents.items()
        }
    for training, evaluation in cases.values():
        plant = observed_in_full(training["environment"])
        for point in make_points(make_task(**plant), evaluation["speeds"], evaluation["bandwidths"]):
            if "optimal_feedback" in (evaluation["controllers"] or RIVALS):
                executor.submit(find_feedback, plant, point.speed, point.bandwidth)
            if evaluation["bound"] != NONE:
                executor.submit(find_bound, plant, point.speed, point.bandwidth, evaluation["bound"])
    comparisons: dict[str, Future[dict[str, Any]]] = {}
    for name, (_, evaluation) in cases.items():
        trained = [agent for agent, future in trainings[name].values() if future.exception() is None]
        if trained:
            comparisons[name] = executor.submit(compare_agents, str(place / folders[name]), trained, evaluation)
    outcomes = []
    for name in cases:
        futures = {seed: future for seed, (_, future) in trainings[name].items()}
        errors = [f"seed {seed}: {future.exception()}" for seed, future in futures.items() if future.exception()]
        found: dict[str, Any] = {"cost": None, "closed": None, "certified": None}
        try:
            found = comparisons[name].result() if name in comparisons else found
        except JobError as error:
            errors.append(str(error))
        compared = tuple(seed for seed, future in futures.items() if future.exception() is None)
        outcomes.append(Outcome(name=name, seeds=compared, failures=tuple(errors), **found))
    write_atomically(place / "sweep.json", json.dumps([dataclasses.asdict(outcome) for outcome in outcomes], indent=2) + "\n")
    return outcomes


def table(outcomes: Sequence[Outcome]) -> str:
    """The outcomes as text."""
    columns = [
        ["", *(outcome.name for outcome in outcomes)],
        ["seeds", *(str(len(outcome.seeds)) for outcome in outcomes)],
        ["cost", *aligned(["n/a" if outcome.cost is None else f"{outcome.cost:.4f}" for outcome in outcomes])],
        ["gap closed", *aligned([percent(outcome.closed) for outcome in outcomes])],
        ["certified", *aligned([percent(outcome.certified) for outcome in outcomes])],
    ]
    widths = [max(map(len, column)) for column in columns]
    lines = [
        "  ".join([name.ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True))])
        for name, *cells in zip(*columns, strict=True)
    ]
    failures = [f"{outcome.name}: {failure}" for outcome in outcomes for failure in outcome.failures]
    return "\n".join([*lines, *(["", *failures] if failures else [])])
