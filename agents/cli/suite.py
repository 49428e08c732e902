"""``roadgym suite run``, ``score``, ``table`` and ``references``."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from typing import Any

from roadgym import TASKS

from .options import nonempty

Command = Callable[[Any, str, Any, str, str], argparse.ArgumentParser]


def add_suite(commands: Any, command: Command) -> None:
    """The command with commands of its own; ``command`` adds one."""
    suite: argparse.ArgumentParser = command(
        commands,
        "suite",
        None,
        "tasks with frozen parameters: train baselines, score entries, print the leaderboard",
        "roadgym suite table",
    )
    parts = suite.add_subparsers(dest="part", required=True, metavar="PART")

    run = command(
        parts,
        "run",
        run_run,
        "train learners on tasks, with some seeds, into folders that are entries; the same command goes on",
        "roadgym suite run --tasks Paper-v0 --learners own ppo --seeds 5 --output runs",
    )
    _add_tasks(run)
    run.add_argument("--learners", nargs="+", default=["own"], metavar="NAME", help="own, ppo, recurrent_ppo, sac or td3 (own)")
    run.add_argument("--seeds", type=int, default=1, metavar="N", help="trainings, of the seeds 0 to N - 1 (%(default)s)")
    run.add_argument("--timesteps", type=int, metavar="N", help="control intervals to train for (the learner's own)")
    run.add_argument("--on", default="processes", metavar="PLACE", help="processes, here, ray or slurm (%(default)s)")
    run.add_argument("--workers", type=int, metavar="N", help="trainings at once (one a processor)")
    run.add_argument("--output", type=nonempty, required=True, metavar="DIR", help="folder of the entries")

    score = command(
        parts,
        "score",
        run_score,
        "drive entries and score them; without an entry, the rules and the shipped agents of tasks",
        "roadgym suite score runs/Paper-v0/ppo",
    )
    score.add_argument("entries", nargs="*", type=nonempty, metavar="ENTRY", help="folder of an entry; its code is run")
    _add_tasks(score)
    _add_roads(score, 1)
    score.add_argument("--json", action="store_true", help="print JSON instead of the table")
    score.add_argument(
        "--leaderboard", type=nonempty, metavar="FILE", help="put the scores into this file, beside what it holds"
    )

    table = command(
        parts,
        "table",
        run_table,
        "print the leaderboard, or write the pages of the tasks",
        "roadgym suite table --tasks Paper-v0",
    )
    _add_tasks(table)
    table.add_argument("--leaderboard", type=nonempty, metavar="FILE", help="a leaderboard of one's own (the shipped one)")
    table.add_argument("--output", type=nonempty, metavar="DIR", help="write a page a task and the leaderboard as Markdown")

    references = command(
        parts,
        "references",
        run_references,
        "find best constant dampings, best known controllers and lower bounds of tasks anew",
        "roadgym suite references --tasks Paper-v0 --output references.json",
    )
    _add_tasks(references)
    _add_roads(references, 0)
    references.add_argument("--output", type=nonempty, required=True, metavar="FILE", help="the file, beside what it holds")


def _add_tasks(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), metavar="TASK", help=f"of {', '.join(TASKS)} (all)")


def _add_roads(parser: argparse.ArgumentParser, seed: int) -> None:
    parser.add_argument("--episodes", type=int, default=256, help="at each operating point (%(default)s)")
    parser.add_argument("--seed", type=int, default=seed, help="seed of the roads (%(default)s)")


def run_run(chosen: argparse.Namespace) -> None:
    """``roadgym suite run``."""
    from roadgym.parameters import whole

    from ..suite import run, task_named

    tasks, seeds = [task_named(name) for name in chosen.tasks], range(whole("seeds", chosen.seeds))
    for folder in run(
        tasks,
        chosen.learners,
        chosen.output,
        seeds=seeds,
        timesteps=chosen.timesteps,
        on=chosen.on,
        workers=chosen.workers,
    ):
        print(folder)


def run_score(chosen: argparse.Namespace) -> None:
    """``roadgym suite score``."""
    from roadgym.parameters import ParameterError, whole

    from ..evaluation import FEWEST_EPISODES
    from ..progress import work_progress
    from ..records import make_output
    from ..suite import load_entry, task_named
    from ..suite.leaderboard import rows_of_entry, rows_of_package, table, write

    if chosen.entries and "tasks" in chosen.given:
        raise ParameterError("--tasks cannot be given with an entry, which names its own")
    size = {
        "episodes": whole("episodes", chosen.episodes, low=FEWEST_EPISODES),
        "seed": whole("seed", chosen.seed, low=0, of="seed"),
    }
    if chosen.leaderboard:
        make_output(chosen.leaderboard)  # before the work
    entries = [load_entry(folder) for folder in chosen.entries]
    rows: list[dict[str, Any]] = []
    with work_progress() as report:
        if entries:
            for entry in entries:
                rows += rows_of_entry(entry, report=report, **size)
        else:
            for name in chosen.tasks:
                rows += rows_of_package(task_named(name), report=report, **size)
    if chosen.leaderboard:
        write(rows, chosen.leaderboard)
    print(json.dumps(rows, indent=2) if chosen.json else table(rows))


def run_table(chosen: argparse.Namespace) -> None:
    """``roadgym suite table``."""
    from ..suite import task_named
    from ..suite.leaderboard import FILE, read, table
    from ..suite.pages import write_pages

    names = [task_named(name).name for name in chosen.tasks]
    rows = [row for row in read(chosen.leaderboard or FILE) if row["task"] in names]
    if chosen.output:
        for file in write_pages(rows, chosen.output):
            print(file)
    else:
        print(table(rows))


def run_references(chosen: argparse.Namespace) -> None:
    """``roadgym suite references``."""
    from ..progress import work_progress
    from ..records import make_output
    from ..suite import task_named
    from ..suite.drivers import CANDIDATES, known_on
    from ..suite.reference import make_references, write_references

    make_output(chosen.output)  # before the work
    tasks = [task_named(name) for name in chosen.tasks]
    with work_progress() as report:
        for task in tasks:
            found = make_references(task, known_on(task, CANDIDATES), episodes=chosen.episodes, seed=chosen.seed, report=report)
            write_references({task.name: found}, chosen.output)
            print(f"{task.name}: best known is {found.best}")
