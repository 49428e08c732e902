"""The suite as a benchmark: references, baselines, entries, scores and the leaderboard of the tasks of `roadgym.suite`.

entry = agents.suite.load_entry("runs/Paper-v0/ppo")
found = agents.suite.score(entry.task, {entry.name: entry.drivers})[entry.name]
print(found.mean.value, found.mean.low, found.mean.high)
"""

from .entries import KINDS, Entry, load_entry, task_named
from .leaderboard import table
from .reference import Reference, References, references
from .running import run
from .scoring import Score, score

__all__ = [
    "KINDS",
    "Entry",
    "Reference",
    "References",
    "Score",
    "load_entry",
    "references",
    "run",
    "score",
    "table",
    "task_named",
]
