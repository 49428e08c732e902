"""Agents that come with the package, one a task of the suite: weights as plain arrays, which are safe to load.

A file ``NAME.npz`` holds the weights of a policy by the names that torch gives them, and as JSON what else `agents.agent.Agent`
must know.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from roadgym.files import whole_file
from roadgym.suite import NAMESPACE

from ..errors import AgentError

FOLDER = Path(__file__).parent
TOLD = "description"  # the array of JSON, which no weight is named like

Weights = Mapping[str, npt.NDArray[Any]]


def names() -> tuple[str, ...]:
    """Of the agents that come with the package."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.npz")))


def find(name: str) -> Path | None:
    """The file of the agent for a task, such as "Paper-v0" or "roadgym/Paper-v0"; None where there is none."""
    plain = name.removeprefix(NAMESPACE)
    return FOLDER / f"{plain}.npz" if plain in names() else None


def read(path: Path) -> tuple[dict[str, Any], Weights]:
    """(description, weights) of a file.

    Raises:
        AgentError: it cannot be read, or holds no agent.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            weights = {name: file[name] for name in file.files}
        description = json.loads(str(weights.pop(TOLD)))
    except (OSError, ValueError, KeyError) as error:
        raise AgentError(f"cannot read the agent in {str(path)!r}: {error}") from None
    return description, weights


def description_of(name: str) -> dict[str, Any]:
    """What the agent for a task was trained with, and how far.

    Raises:
        AgentError: there is none.
    """
    path = find(name)
    if path is None:
        raise AgentError(f"no agent comes with the package for {name!r}; there are: {', '.join(names())}")
    return read(path)[0]


def write(path: Path, description: Mapping[str, Any], weights: Weights) -> None:
    """Write a file that `read` reads."""
    with whole_file(path) as part, part.open("wb") as file:
        arrays: dict[str, Any] = {**weights, TOLD: np.array(json.dumps(description))}
        np.savez_compressed(file, **arrays)
