"""Bounds that took time, kept in a folder: a small JSON file each, found again when all that they depend on is the same."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from roadgym.cache import warn_not_kept
from roadgym.files import whole_file
from roadgym.task import Task

from .bound import RIGOURS, LowerBound

NAME = re.compile(r"bound-[0-9a-f]{32}\.json")


def described(task: Task, speed: float, bandwidth: float, **more: Any) -> str | None:
    """All that a bound depends on; None of a road of one's own that JSON does not know."""
    motion = task.car.motion
    content = {
        "road": dataclasses.asdict(task.road),
        "speed_noise": task.speed_noise and dataclasses.asdict(task.speed_noise),
        "equations": {
            name: getattr(motion, name) for name in ("drift", "level_entry", "slope_entry", "force_entry", "follows")
        },
        "signals": {name: dict(motion.signals[name].terms) for name in (*task.weights_by_name, motion.relative)},
        "weights": task.weights_by_name,
        "damping_range": task.damping_range,
        "valve": dataclasses.asdict(task.valve),
        "interval": task.control_interval * task.car.natural_frequency,
        "ratio": task.frequency_ratio(speed),
        "bandwidth": bandwidth,
        **({} if task.vary is None else {"vary": task.vary.ranges, "car": dataclasses.asdict(task.car)}),
        **more,
    }
    try:
        return json.dumps(content, sort_keys=True, default=_listed)
    except TypeError:
        return None


def _listed(value: Any) -> Any:
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    raise TypeError(f"{value!r} is nothing that JSON knows")


def kept_path(cache: str | os.PathLike[str], text: str) -> Path:
    """Where a bound of this description is kept."""
    return Path(cache) / f"bound-{hashlib.sha256(text.encode()).hexdigest()[:32]}.json"


def kept_files(folder: Path | None) -> list[Path]:
    """The bounds that are kept in ``folder``."""
    if folder is None or not folder.is_dir():
        return []
    return [path for path in folder.iterdir() if NAME.fullmatch(path.name)]


def save(path: Path, text: str, found: LowerBound) -> None:
    """Keep a bound, whole or not at all; where it cannot be kept there is a warning."""
    content = {"description": text, "bound": dataclasses.asdict(found)}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as part:
            part.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        warn_not_kept(path.parent, error)


def load(path: Path, text: str) -> LowerBound | None:
    """What is kept, or None where there is nothing, or nothing that is sound and of this description."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        found = LowerBound(**content["bound"])
        figures = (found.cost, found.standard_error)
        sound = (
            content["description"] == text
            and all(type(figure) is float and math.isfinite(figure) for figure in figures)
            and found.standard_error >= 0
            and found.rigour in RIGOURS
        )
    except (OSError, ValueError, TypeError, KeyError):
        return None
    return found if sound else None
