"""Entries: folders that drive on a task of the suite.

An entry holds ``entry.json``,

    {"name": "my PPO", "task": "Paper-v0", "seeds": [0, 1, 2], "steps": 1000000, "kind": "plain", "description": "..."}

where ``steps`` are control intervals of training over all environments, 0 where nothing was learned, and ``kind`` tells what
it was given, see `KINDS`. Beside it lie, for every seed, one of

    agent-SEED/     a folder of ``roadgym train``
    SEED.onnx       a model of ``roadgym export --to onnx``, or another one with the same inputs and outputs
    entry.py        for all seeds: Python with ``Driver(task, seed)``, of a `roadgym.SuiteTask`, a class whose objects have
                    ``predict``; or, where nothing depends on the seed, a function ``predict`` alone

``predict(observation, state=None, episode_start=None, deterministic=True)`` is that of stable-baselines3: from observations of
the task, float32, shape (n, signals), it gives damping ratios, shape (n, 1), and the state that it is handed back with the next
ones; ``episode_start``, shape (n,), tells whose state is to be forgotten. Scoring an entry runs its code: score only what you
trust.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from roadgym import TASKS
from roadgym.installation import needs
from roadgym.parameters import ParameterError, shown, whole
from roadgym.suite import NAMESPACE, SuiteTask
from roadgym.task import OPERATING_POINT, make_task

from ..agent import DESCRIPTION, load
from ..errors import AgentError
from ..evaluation import Predictor
from ..export.stages import scales_of

FILE, CODE = "entry.json", "entry.py"
KINDS = {
    "rule": "a rule that is given the equations of car and road, or parts of them",
    "plain": "learned from observations and rewards alone",
    "recipe": "learned with what theory tells: a gradient through the plant, the lookahead or a Kalman filter",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Entry:
    """What an entry says of itself, and who drives for it, one for each seed; see `KINDS`."""

    name: str
    task: SuiteTask
    seeds: tuple[int, ...]
    steps: int
    kind: str
    description: str
    drivers: tuple[Predictor, ...]


def task_named(name: Any) -> SuiteTask:
    """A task of the suite by its name or its Gymnasium id.

    Raises:
        ParameterError: there is none.
    """
    plain = name.removeprefix(NAMESPACE) if isinstance(name, str) else ""
    if plain not in TASKS:
        raise ParameterError(f"task must be one of {', '.join(TASKS)}, got {shown(name)}")
    return TASKS[plain]


def load_entry(folder: str | Path) -> Entry:
    """The entry in a folder.

    Raises:
        AgentError: the folder holds none, or one that cannot be loaded.
        ParameterError: what it says of itself is wrong.
    """
    path = Path(folder)
    try:
        content = json.loads((path / FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise AgentError(f"no entry in {str(path)!r}: cannot read its {FILE}: {error}") from None
    if not isinstance(content, dict):
        raise AgentError(f"no entry in {str(path)!r}: its {FILE} is no mapping")
    seeds = content.get("seeds", [0])
    if not isinstance(seeds, list) or not seeds:
        raise ParameterError(f"seeds of the entry must be a list of integers, got {shown(seeds)}")
    kind, told = content.get("kind"), {name: content.get(name, "") for name in ("name", "description")}
    if kind not in KINDS:
        raise ParameterError(f"kind of the entry must be one of {', '.join(KINDS)}, got {shown(kind)}")
    for name, text in told.items():
        if not isinstance(text, str):
            raise ParameterError(f"{name} of the entry must be a text, got {shown(text)}")
    task = task_named(content.get("task"))
    chosen = tuple(whole("seed of the entry", seed, low=0) for seed in seeds)
    return Entry(
        name=told["name"] or path.resolve().name,
        task=task,
        seeds=chosen,
        steps=whole("steps of the entry", content.get("steps", 0), low=0),
        kind=kind,
        description=told["description"],
        drivers=tuple(_driver(path, task, seed) for seed in chosen),
    )


def _driver(path: Path, task: SuiteTask, seed: int) -> Predictor:
    """Who drives for one seed."""
    if (path / f"agent-{seed}" / DESCRIPTION).exists():
        return load(path / f"agent-{seed}")
    if (path / f"{seed}.onnx").exists():
        return OnnxDriver(path / f"{seed}.onnx", task)
    if (path / CODE).exists():
        module = _imported(path / CODE)
        made: Callable[..., Any] | None = getattr(module, "Driver", None)
        driver = module if made is None else made(task, seed)
        if not callable(getattr(driver, "predict", None)):
            raise AgentError(f"{str(path / CODE)!r} has neither a class Driver with predict nor a function predict")
        return driver  # what it answers is checked when it drives
    raise AgentError(f"the entry in {str(path)!r} has nothing that drives for seed {seed}: agent-{seed}, {seed}.onnx or {CODE}")


def _imported(file: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"entry_{abs(hash(file.resolve()))}", file)
    assert spec is not None
    assert spec.loader is not None  # of a file of Python there is one
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # it is somebody else's
        raise AgentError(f"cannot import {str(file)!r}: {type(error).__name__}: {' '.join(str(error).split())}") from None
    return module


class OnnxDriver:
    """A model of ONNX as `agents.export.onnx_graph.onnx_file` writes it, run by the reference implementation of onnx.

    It takes ``measured`` in the units of the car, ``begins`` where it remembers anything, and each ``NAME`` of that, and gives
    ``damping`` and each ``next_NAME``.

    Raises:
        AgentError: a file that holds no such model.
        InstallationError: onnx is not installed.
    """

    def __init__(self, file: Path, task: SuiteTask) -> None:
        with needs("onnx"):
            import onnx
            from onnx.reference import ReferenceEvaluator
        plant = make_task(**task.parameters)
        self._scales = scales_of(plant)
        self._point = [k for k, name in enumerate(plant.signals) if name in OPERATING_POINT]
        try:
            model = onnx.load(file)
            self._run = ReferenceEvaluator(model)
        except Exception as error:  # whatever is wrong with the file
            raise AgentError(f"cannot read {str(file)!r}: {' '.join(str(error).split())}") from None
        sizes = {each.name: each.type.tensor_type.shape.dim[1].dim_value for each in model.graph.input}
        if sizes.pop("measured", None) != len(plant.signals):
            raise AgentError(f"the model {str(file)!r} must have an input 'measured' of {len(plant.signals)} signals")
        self._begins = sizes.pop("begins", None) is not None
        self._memory = sizes

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        """(D, state) for observations, shape (n, signals)."""
        rows = np.asarray(observation, np.float32)
        known = state or {name: np.zeros((len(rows), size), np.float32) for name, size in self._memory.items()}
        begins = np.full(len(rows), state is None) if episode_start is None else np.asarray(episode_start, np.bool_)
        given = {"measured": self._measured(rows), **known} | ({"begins": begins[:, None]} if self._begins else {})
        found = dict(zip(self._run.output_names, self._run.run(None, given), strict=True))
        return found["damping"], {name: found[f"next_{name}"] for name in self._memory}

    def _measured(self, rows: Any) -> Any:
        """Observations in the units of the car; of the operating point shares are seen, nu/(1 + nu)."""
        found = rows.astype(float)
        found[:, self._point] /= 1 - found[:, self._point]
        return (found * self._scales).astype(np.float32)
