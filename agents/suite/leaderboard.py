"""The leaderboard: scores of entries by task, in ``leaderboard.json``, and as a table of text."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from analysis.certificate import wrapped
from roadgym import TASKS
from roadgym.suite import SuiteTask

from .. import pretrained
from ..records import make_output, write_atomically
from .baselines import learner_of
from .drivers import driver_of, known_on
from .entries import Entry
from .reference import references
from .scoring import score, to_json

FILE = Path(__file__).parent / "leaderboard.json"
LEGEND = (
    "score: per cent of the way from the best constant damping to the best known feedback, a mean over operating points, after "
    "± its 95 % interval over roads and training seeds; of one seed, over roads alone. At: speed, m/s, and bandwidth. "
    "Trained: seeds, times steps of each."
)
HEAD = ("entry", "kind", "trained", "score", "worst point")


def read(file: str | Path = FILE) -> list[dict[str, Any]]:
    """The rows: task, entry, kind, steps, origin or None, and what `agents.suite.scoring.Score` tells; the best first."""
    rows: list[dict[str, Any]] = json.loads(Path(file).read_text(encoding="utf-8"))["rows"]
    return sorted(rows, key=lambda row: (list(TASKS).index(row["task"]), -row["mean"]["value"]))


def rows_of_entry(entry: Entry, **driving: Any) -> list[dict[str, Any]]:
    """The row of an entry, driven with what `agents.suite.scoring.score` takes."""
    found = score(entry.task, {entry.name: entry.drivers}, **driving)[entry.name]
    told = {"task": entry.task.name, "entry": entry.name, "kind": entry.kind, "steps": entry.steps, "origin": None}
    return [{**told, **to_json(found), "seeds": list(entry.seeds)}]


def rows_of_package(task: SuiteTask, **driving: Any) -> list[dict[str, Any]]:
    """The rows of what the package itself can drive on a task, each with its origin: rules, and the shipped agent."""
    origins = known_on(task)
    found = score(task, {name: [driver_of(task, origin)] for name, origin in origins.items()}, **driving)
    rows = []
    for name, origin in origins.items():
        told: dict[str, Any] = {"task": task.name, "entry": name, "kind": "rule", "steps": 0, "origin": origin}
        own: dict[str, Any] = {"seeds": []}
        if "agent" in origin:
            description = pretrained.description_of(task.name)
            told |= {"kind": learner_of(task, "own").kind, "steps": description["timesteps"]}
            own = {"seeds": [description["seed"]]}
        rows.append({**told, **to_json(found[name]), **own})
    return rows


def write(rows: Iterable[Mapping[str, Any]], file: str | Path) -> None:
    """Put rows into a file, each in place of one of the same task and entry that it holds."""
    path = make_output(file)
    known = read(path) if path.exists() else []
    new = {(row["task"], row["entry"]): row for row in rows}
    kept = {(row["task"], row["entry"]): row for row in known} | new
    write_atomically(path, json.dumps({"format": 1, "rows": list(kept.values())}, indent=1) + "\n")


def cells(row: Mapping[str, Any], brief: bool = False) -> tuple[str, ...]:
    """A row in the columns of `HEAD`; a ``brief`` one leaves out the interval at the worst point."""

    def share(known: Mapping[str, float]) -> str:
        half = (known["high"] - known["low"]) / 2
        digits = 1 if half < 2 else 0
        return f"{known['value']:.{digits}f} ±{half:.{digits}f}"

    where = f"{row['worst_speed']:g}" + (f", {row['worst_bandwidth']:g}" if row["worst_bandwidth"] else "")
    trained = f"{len(row['seeds'])} x {row['steps'] / 1e6:.2g} M" if row["steps"] else "-"
    worst = f"{row['worst']['value']:.0f}" if brief else share(row["worst"])
    return (row["entry"], row["kind"], trained, share(row["mean"]), f"{worst} at {where}")


def bound_row(task: SuiteTask) -> tuple[str, ...]:
    """The row of the lower bound."""
    score = references(task).bound_score
    return ("lower bound", "bound", "-", "n/a" if score is None else f"{score:.1f}", "-")


def lines(task: SuiteTask, rows: Sequence[Mapping[str, Any]], brief: bool = False) -> list[tuple[str, ...]]:
    """The rows of a task in the columns of `HEAD`, which is the first: the lower bound, then the best first; see `cells`."""
    own = sorted((row for row in rows if row["task"] == task.name), key=lambda row: -row["mean"]["value"])
    return [HEAD, bound_row(task), *(cells(row, brief) for row in own)]


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The leaderboard as text, a block for each task that has rows."""
    text = []
    for task in TASKS.values():
        if not any(row["task"] == task.name for row in rows):
            continue
        columns = list(zip(*lines(task, rows, brief=True), strict=True))
        widths = [max(map(len, column)) for column in columns]
        text += wrapped(f"{task.id}: {task.title}")
        for line in zip(*columns, strict=True):
            left = [line[k].ljust(widths[k]) for k in (0, 1)]
            right = [line[k].rjust(widths[k]) for k in (2, 3)]
            text.append("  ".join([*left, *right, line[4]]).rstrip())
        text.append("")
    return "\n".join([*text, *wrapped(LEGEND)])
