"""The suite's pages, one a task in the form of Gymnasium's, and the leaderboard: all from the table of tasks and its files."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from roadgym import TASKS
from roadgym.suite import SuiteTask
from roadgym.task import Task, make_task

from .. import pretrained
from ..numerals import with_error
from ..records import make_folder, write_atomically
from .baselines import learner_of
from .entries import KINDS
from .leaderboard import LEGEND, lines
from .reference import references

WHOLE = 128  # letters in a line


def write_pages(rows: Sequence[Mapping[str, Any]], folder: str | Path) -> list[Path]:
    """Write ``TASK.md`` for every task and ``leaderboard.md``, from rows of the leaderboard."""
    path = make_folder(folder)
    pages = {f"{task.name}.md": page(task, rows) for task in TASKS.values()} | {"leaderboard.md": leaderboard_page(rows)}
    for name, text in pages.items():
        write_atomically(path / name, text)
    return [path / name for name in pages]


def page(task: SuiteTask, rows: Sequence[Mapping[str, Any]]) -> str:
    """The page of a task."""
    plant = make_task(**task.parameters)
    low, high = plant.damping_range
    interval = _number(plant.control_interval)
    sections = {
        "Description": task.description,
        "Action space": f"`Box({low:.4g}, {high:.4g}, (1,), float32)`: the damping ratio $D$ of the next "
        f"{interval} s. It saturates at the range.",
        "Observation space": f"`Box({len(plant.signals)} numbers, float32)`; those of motion and road in standard deviations "
        "of the road, ± 20 of them at most.\n\n" + _observations(plant),
        "Reward": _reward(plant),
        "Starting state": "The road in its stationary law, the car at rest. Speed"
        + (" and bandwidth are" if plant.bandwidth[1] else " is")
        + " drawn uniformly from the ranges below at each reset"
        + (", and so is the car." if plant.vary else "."),
        "Episode end": f"Truncated after {task.max_episode_steps} steps, "
        f"{_number(task.max_episode_steps * plant.control_interval)} s; never terminated.",
        "Arguments": "Only `render_mode`, of `gymnasium.make`, and `num_envs`, `autoreset_mode`, `threads` and `render_mode`, "
        "of `gymnasium.make_vec`. Whoever passes others has another task. Frozen are:\n\n" + _parameters(task),
        "Score": _score(task),
        "Versions": "\n".join(f"- {version}: {what}" for version, what in task.versions.items()),
    }
    text = [
        f"# {task.name}",
        f"{task.title}.",
        f'```python\nenv = gymnasium.make("{task.id}")\nenvs = gymnasium.make_vec("{task.id}", num_envs=1024)\n```',
    ]
    if pretrained.find(task.name) is not None:
        learner = learner_of(task, "own")
        text.append(f'`agents.load("{task.name}")` is the agent that comes with the package, {learner.title} of one seed.')
    for head, content in sections.items():
        text += [f"## {head}", content]
    if any(row["task"] == task.name for row in rows):
        text += ["## Leaderboard", markdown_table(lines(task, rows))]
    return _pages_text(text)


def leaderboard_page(rows: Sequence[Mapping[str, Any]]) -> str:
    """The page of all tasks."""
    text = ["# Leaderboard", LEGEND, "\n".join(f"- *{kind}*: {what}." for kind, what in KINDS.items())]
    for task in TASKS.values():
        if any(row["task"] == task.name for row in rows):
            text += [f"## [{task.name}]({task.name}.md)", f"{task.title}.", markdown_table(lines(task, rows))]
    return _pages_text(text)


def markdown_table(rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells, the first of them the head."""
    text = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([text[0], "|" + "---|" * len(rows[0]), *text[1:]])


def _pages_text(parts: Sequence[str]) -> str:
    """The parts as paragraphs, those in one line broken where it is long."""
    paragraphs = [paragraph for part in parts for paragraph in part.split("\n\n")]
    return (
        "\n\n".join(
            paragraph if "\n" in paragraph else textwrap.fill(paragraph, WHOLE, break_on_hyphens=False, break_long_words=False)
            for paragraph in paragraphs
        )
        + "\n"
    )


def _number(value: float) -> str:
    return f"{value:.6g}"


def _observations(plant: Task) -> str:
    real = plant.real_sensors
    rows = [("place", "signal", "how it is seen")]
    for place, name in enumerate(plant.signals):
        told = {"speed": "$\\nu/(1 + \\nu)$ of the frequency ratio $\\nu$", "bandwidth": "$2\\delta/(1 + 2\\delta)$"}.get(
            name, "as it is"
        )
        if name in real:
            parts = {"noise": real[name].noise, "steps of": real[name].resolution}
            told = ", ".join(f"{what} {_number(value)}" for what, value in parts.items() if value)
        rows.append((str(place), f"`{name}`", told))
    return markdown_table(rows)


def _reward(plant: Task) -> str:
    names = dict(plant.reward_by_name)
    terms = " + ".join((f"{_number(weight)} × " if weight != 1 else "") + f"`{name}`" for name, weight in names.items())
    over = "over the road's variance" if plant.car.cost_unit is None else "in SI units"
    return f"Minus the mean squares over the control interval, {terms}, {over}. The environment's `info` has each by its name."


def _parameters(task: SuiteTask) -> str:
    return f"```json\n{json.dumps(dict(task.parameters), indent=1)}\n```"


def _score(task: SuiteTask) -> str:
    known = references(task)
    zero = "one constant damping" if task.single_constant else "the best constant damping at each operating point"
    table: list[tuple[str, ...]] = [("speed", "bandwidth", "constant D", "its cost", f"{known.best}", "lower bound", "room")]
    for each in known.points:
        bound = "n/a" if each.bound is None else f"{each.bound:.4g}"
        room = f"{100 * each.room:.1f} %"
        best = with_error(each.best, each.best_error)
        cells = (
            _number(each.point.speed),
            _number(each.point.bandwidth) if each.point.bandwidth else "-",
            f"{each.damping:.4g}",
            f"{each.constant:.5g}",
            best,
            bound,
            room,
        )
        table.append(cells)
    how = f"The lower bound is by {known.bound}" if known.bound_score is not None else f"No lower bound is known, {known.bound}"
    return (
        f"Zero is {zero}, 100 the best that was known when the references were made: {known.best}, driven over "
        f"{known.episodes} episodes of {_number(task.duration)} s. {how}. Costs at each operating point, with the standard "
        f"error of the last digits:\n\n{markdown_table(table)}"
    )
