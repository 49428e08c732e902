"""The main job: agents against the analytic optimum, classical controllers and the optimal feedback, over the same noise."""

from __future__ import annotations

import contextlib
import datetime
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from roadgym.parameters import ParameterError
from roadgym.task import OPERATING_POINT, Task, make_task

from .agent import Agent
from .certified import check_bound, lower_bounds
from .controllers import CONTROLLERS, Controller, OptimalFeedback, make_controller, tune_controller
from .estimation import Estimated, check_estimator
from .evaluation import Predictor, evaluate, evaluated_task
from .names import FILTERED, name_folders, title
from .numerals import above, percent, with_error
from .progress import work_progress
from .records import lasting, make_folder, plain, versions, write_atomically
from .report import (
    adjusted_by,
    blocks,
    make_report,
    mean_gap_closed,
    notes,
    table,
    theory_given,
    weighted,
)
from .results import (
    CONFIDENCE,
    CONSTANT,
    LEAST_ROOM,
    Comparison,
    MeanGap,
    Row,
    Share,
    best_feedbacks,
    constant_damping,
    error_over_seeds,
    flat,
    gaps,
    make_rows,
    mean_certified,
    mean_gap,
    ratio,
)

__all__ = [  # with names that live in `agents.results` and `agents.report`
    "AGENT",
    "BANDWIDTHS",
    "CONFIDENCE",
    "CONSTANT",
    "LEAST_ROOM",
    "RIVALS",
    "SPEEDS",
    "WHEEL_RIVALS",
    "Comparison",
    "MeanGap",
    "Row",
    "Share",
    "above",
    "adjusted_by",
    "best_feedbacks",
    "blocks",
    "compare",
    "constant_damping",
    "error_over_seeds",
    "flat",
    "gaps",
    "group_agents",
    "make_rivals",
    "make_rows",
    "mean_gap",
    "mean_gap_closed",
    "notes",
    "observed_in_full",
    "percent",
    "ratio",
    "table",
    "theory_given",
    "weighted",
    "with_error",
    "write",
]
RIVALS = ("analytic_optimum", "d_min", "d_max", "skyhook", "one_step_lookahead", "optimal_feedback")
WHEEL_RIVALS = (  # of a car with a wheel of its own
    *RIVALS[:-2],
    "groundhook",
    "hybrid",
    "power_driven",
    "clipped_lqr",
    "one_step_lookahead",
    "mixed_lookahead",
    "optimal_feedback",
)
SPEEDS = (0.7, 1.0, 1.5, 2.0, 3.0)
BANDWIDTHS = (0.1, 0.3)
AGENT = "agent"


def observed_in_full(environment: Mapping[str, Any]) -> dict[str, Any]:
    """The environment with all that it observes by default."""
    return {name: value for name, value in environment.items() if name not in ("observation", "observe_operating_point")}


def group_agents(agents: Mapping[str, Agent]) -> tuple[dict[str, list[Agent]], dict[str, Any]]:
    """(agents of several training seeds by name, their common environment observed in full), from agents by folder.

    Those that differ in nothing but the seed are one learned controller, named by the first one's folder and as many of the
    folders above it as tell the names apart, or "agent" where there is one only.

    Raises:
        ParameterError: their environments differ in more than what is observed.
    """
    groups: list[list[str]] = []
    kinds: list[Any] = []
    for folder, agent in agents.items():
        kind = [agent.description[key] for key in ("algorithm", "environment", "hyperparameters")]
        if kind not in kinds:
            kinds.append(kind)
            groups.append([])
        groups[kinds.index(kind)].append(folder)
    plants = [observed_in_full(kind[1]) for kind in kinds]
    for plant, group in zip(plants, groups, strict=True):
        if plant != plants[0]:
            raise ParameterError(f"agents must have one environment, but for what they observe; {group[0]!r} has another one")
    if len(groups) == 1:
        return {AGENT: list(agents.values())}, plants[0]
    names = name_folders([group[0] for group in groups], {AGENT, *CONTROLLERS, *map(title, CONTROLLERS)})
    return {name: [agents[folder] for folder in group] for name, group in zip(names, groups, strict=True)}, plants[0]


def make_rivals(
    task: Task, names: Sequence[str] | None, estimator: str | None = None, measured: Task | None = None
) -> dict[str, Controller | Estimated]:
    """The rivals by name, the analytic optimum first; their parameters are tuned on the task.

    By default they are those of `RIVALS` that this task allows, of `WHEEL_RIVALS` where the car has a wheel of its own. With an
    estimator those that take signals of the motion drive by what it makes of the ``measured`` task, and are named so; the
    optimal feedback drives by the state as well.

    Raises:
        ParameterError: an unknown controller, or one that needs what the task has not.
    """
    check_estimator(estimator)
    rivals: dict[str, Controller | Estimated] = {"analytic_optimum": make_controller("analytic_optimum", task)}
    usual = WHEEL_RIVALS if "wheel_velocity" in task.car.mean_squares else RIVALS
    for name in usual if names is None else names:
        try:
            rival = tune_controller(name, task)
        except ParameterError:
            if names is not None:
                raise
            continue
        if estimator is None or set(rival.needs) <= set(OPERATING_POINT):
            rivals[name] = rival
        else:
            if isinstance(rival, OptimalFeedback):
                rivals[name] = rival
            rivals[name + FILTERED] = Estimated(rival, task if measured is None else measured)
    return rivals


def compare(
    agents: Predictor | Mapping[str, Sequence[Predictor]] | None,
    *,
    environment: Mapping[str, Any],
    speeds: Sequence[float] = SPEEDS,
    bandwidths: Sequence[float] = BANDWIDTHS,
    controllers: Sequence[str] | None = None,
    episodes: int = 256,
    seed: int = 0,
    bound: str = "fast",
    estimator: str | None = None,
    report: Callable[[str, int, int], None] | None = None,
) -> Comparison:
    """Drive learned agents, classical controllers and the optimal feedback over the same roads.

    Args:
        agents: one agent, anything with ``predict`` that answers with D; or by name the agents of several training seeds;
            None to compare the classical controllers alone.
        environment: parameters of the environment, with ranges that hold the operating points. Every controller is handed the
            signals that it needs, whatever the environment observes, through its sensors if it has some; but the optimal
            feedback the truth.
        speeds, bandwidths: the grid of operating points, m/s and 1.
        controllers: names of the rivals; the analytic optimum is always among them. By default those of `RIVALS`, or of
            `WHEEL_RIVALS`, that the plant allows. Those that have a parameter are tuned on the plant.
        episodes, seed: as for `agents.evaluate`.
        bound: which lower bounds to hold the costs against: "fast", "tight" or a method's name, as of `analysis.lower_bound`;
            or "none".
        estimator: "kalman" to have the rivals drive by the mean of a Kalman filter of what the environment observes.
        report: called as ``report(what, done, in all)``; by default progress is told on the error stream.

    Raises:
        ParameterError: a parameter out of range, or a signal missing that a controller needs.
    """
    named = {} if agents is None else agents if isinstance(agents, Mapping) else {AGENT: [agents]}
    check_bound(bound)
    plant = observed_in_full(environment)
    task = make_task(**plant)
    # what evaluations tell beside is not theirs to know
    rivals = make_rivals(make_task(**plant), controllers, estimator, None if estimator is None else make_task(**environment))
    drivers: dict[str, Predictor] = {}
    for name, seeds in named.items():
        if name in rivals or not seeds:
            raise ParameterError(f"agents must have names of their own and at least one agent each, got {name!r}")
        drivers.update({f"{name}, seed {k + 1} of {len(seeds)}": agent for k, agent in enumerate(seeds)})
    with work_progress() if report is None else contextlib.nullcontext(report) as tell:
        for rival in rivals.values():
            for rule in (rival, getattr(rival, "controller", None)):
                if isinstance(rule, OptimalFeedback):
                    rule.report = tell
        evaluations = evaluate(
            {**drivers, **rivals},
            environment=plant,
            speeds=speeds,
            bandwidths=bandwidths,
            episodes=episodes,
            seed=seed,
            report=tell,
        )
        bounds = lower_bounds(task, evaluations["analytic_optimum"].points, bound, tell)
    driven = iter([evaluations.pop(name) for name in drivers])
    learned = {name: [next(driven) for _ in seeds] for name, seeds in named.items()}
    task = evaluated_task(plant)
    rows, references = make_rows(task, learned, evaluations, bounds)
    mean_gaps = {name: mean_gap(seeds, evaluations, references) for name, seeds in learned.items()} if any(references) else {}
    optimal = {name: [evaluations[name]] for name in evaluations if name == "optimal_feedback"}
    certified = {name: mean_certified(seeds, evaluations, bounds) for name, seeds in {**learned, **optimal}.items() if bounds}
    configuration = {
        "environment": lasting(plant),
        **({} if estimator is None else {"estimator": estimator, "measured": list(make_task(**environment).signals)}),
        "episodes": episodes,
        "seed": seed,
        "confidence": CONFIDENCE,
        "parameters": {name: rival.parameters for name, rival in rivals.items() if rival.parameters},
        "control_variates": evaluations["analytic_optimum"].control_variates,
        "balances": evaluations["analytic_optimum"].balances,
        "best_known_feedback": references,
        "bound": bound,
        "agents": {name: [plain(getattr(agent, "description", None)) for agent in seeds] for name, seeds in named.items()},
        "versions": versions(),
        "written": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
    return Comparison(rows, task, named, references, configuration, mean_gaps, bounds, certified)


def write(comparison: Comparison, folder: str | Path, report: Callable[[str, int, int], None] | None = None) -> list[Path]:
    """Write the report, comparison.html with everything in it, and beside it JSON, CSV, the table and the figures.

    Args:
        comparison: what was driven.
        folder: where to; it is made if need be.
        report: called as ``report(what, done, in all)`` while the figures are drawn.

    Returns:
        The files, the report first.
    """
    from .figures import draw_figures

    path = make_folder(folder)
    contents = {
        "comparison.json": comparison.to_json(),
        "comparison.csv": comparison.to_csv(),
        "comparison.txt": table(comparison) + "\n",
    }
    for name, content in contents.items():  # the numbers first, whatever becomes of the pictures
        write_atomically(path / name, content)
    figures = draw_figures(comparison, path, report)
    write_atomically(path / "comparison.html", make_report(comparison, figures))
    drawn = [file for figure in figures for file in (figure.path, figure.narrow) if file is not None]
    return [path / "comparison.html", *(path / name for name in contents), *drawn]
