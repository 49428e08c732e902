"""Training learners on tasks of the suite, into folders that are entries: one job for each task, learner and seed."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

from roadgym.suite import SuiteTask

from ..agent import DESCRIPTION
from ..jobs import executor
from ..records import make_folder, write_atomically
from .baselines import learner_of
from .entries import FILE, task_named

STORE = "jobs"  # folder of what executors remember, beside the tasks


def train_one(task: str, learner: str, seed: int, folder: str, timesteps: int) -> int:
    """Train one agent into ``folder``, or go on with it; returns the control intervals that it was trained for."""
    from ..training import silent, train

    chosen, path = learner_of(task_named(task), learner), Path(folder)
    agent = train(
        path,
        algorithm=chosen.algorithm,
        environment=task_named(task).parameters,
        hyperparameters=chosen.hyperparameters,
        seed=seed,
        timesteps=timesteps,
        resume=(path / DESCRIPTION).exists(),
        report=silent,
    )
    return int(agent.description["timesteps"])


def run(
    tasks: Sequence[SuiteTask],
    learners: Sequence[str],
    folder: str | Path,
    *,
    seeds: Sequence[int] = (0,),
    timesteps: int | None = None,
    on: str = "processes",
    workers: int | None = None,
    report: Callable[[int, int, int], None] | None = None,
) -> list[Path]:
    """Train every learner on every task with every seed; returns the folders of the entries, ``FOLDER/TASK/LEARNER``.

    What is done is not done again; what was interrupted goes on from its last checkpoint.

    Args:
        tasks: the tasks.
        learners: names of learners, see `agents.suite.baselines`.
        folder: where to; all workers must see it.
        seeds: of training.
        timesteps: control intervals in place of the learners' own.
        on, workers, report: as of `agents.jobs.executor`.

    Raises:
        ParameterError: an unknown learner, or a place that `agents.jobs.executor` does not know.
        AgentError: a folder that cannot be written.
        JobError: a training that failed, with its traceback; the others are finished first.
    """
    root = make_folder(folder).resolve()
    asked = [(task, name, learner_of(task, name)) for task in tasks for name in learners]
    with executor(on, workers=workers, store=root / STORE, report=report) as jobs:
        waiting = [
            [
                jobs.submit(train_one, task.name, name, seed, str(root / task.name / name / f"agent-{seed}"), steps)
                for seed in seeds
            ]
            for task, name, learner in asked
            for steps in [learner.timesteps if timesteps is None else timesteps]
        ]
    entries = []
    for (task, name, learner), futures in zip(asked, waiting, strict=True):
        steps = max(future.result() for future in futures)
        content = {"name": learner.title, "task": task.name, "seeds": list(seeds), "steps": steps, "kind": learner.kind}
        entries.append(make_folder(root / task.name / name))
        write_atomically(entries[-1] / FILE, json.dumps(content, indent=2) + "\n")
    return entries
