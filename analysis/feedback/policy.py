"""A feedback that was found, and how it is kept in a file."""

from __future__ import annotations

import abc
import dataclasses
import functools
import hashlib
import io
import json
import math
import os
import re
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from roadgym.cache import warn_not_kept
from roadgym.files import PART, whole_file
from roadgym.parameters import ParameterError, number_array
from roadgym.roads import Road

from ..checks import FloatArray
from .grid import SingleArray, evaluate, geometry_of
from .road_grid import grid_of


@dataclasses.dataclass(frozen=True, kw_only=True)
class Refinement:
    """One table and its feedback.

    Attributes:
        rings, rays, rows: size of the grid; it has as many columns as rows.
        sweeps: applications of Bellman's operator.
        expected: average cost that the table expects, 1; biased by its own errors.
        cost: driven cost, 1, over the noise that all refinements share.
        standard_error: of the latter.
    """

    rings: int
    rays: int
    rows: int
    sweeps: int
    expected: float
    cost: float
    standard_error: float


Result = TypeVar("Result", bound="Feedback")
Kept = TypeVar("Kept")


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Feedback(abc.ABC):
    """The best feedback found at one operating point; made by `optimal_feedback`.

    Attributes:
        road: the road, its bandwidth that of the operating point.
        speed: v, m/s.
        natural_frequency: w1, rad/s.
        weights: weights of the mean squares.
        bounds: smallest and largest damping, 1.
        control_interval: s.
        cost: driven cost: minus the mean reward of the environment.
        standard_error: of the cost.
        signals: names of the signals in the observations that `predict` is given, in order.
    """

    road: Road
    speed: float
    natural_frequency: float
    weights: Mapping[str, float]
    bounds: tuple[float, float]
    control_interval: float
    cost: float
    standard_error: float
    signals: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in self.state:
            if name not in self.signals:
                raise ParameterError(f"optimal feedback needs the signal {name!r}; signals has {', '.join(self.signals)}")

    @property
    @abc.abstractmethod
    def state(self) -> tuple[str, ...]:
        """Names of the states of car and road that it takes."""

    @abc.abstractmethod
    def kept(self) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
        """(figures as JSON knows them, arrays) that `save` keeps."""

    @abc.abstractmethod
    def _evaluate(self, rows: npt.NDArray[Any], columns: npt.NDArray[np.int64]) -> SingleArray:
        """D within the bounds, shape (n,), at ``rows`` that have the states in these columns."""

    def with_signals(self: Result, signals: Sequence[str]) -> Result:
        """The same feedback for observations of ``signals``, such as those of a task.

        Raises:
            ParameterError: a signal is missing that the feedback needs.
        """
        return dataclasses.replace(self, signals=tuple(signals))

    def damping(self, states: npt.ArrayLike) -> SingleArray:
        """D, shape (n,), float32, at ``states``, shape (n, states), in standard deviations of the road."""
        rows = np.atleast_2d(number_array("states", states))
        if rows.ndim != 2 or rows.shape[1] != len(self.state):
            raise ParameterError(f"states must have the shape (n, {len(self.state)}), got {np.shape(states)}")
        return self._evaluate(rows, np.arange(len(self.state)))

    def predict(
        self,
        observation: npt.NDArray[np.float32],
        state: Any = None,
        episode_start: npt.NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[SingleArray, Any]:
        """(D, state) for observations of ``signals``, as the environment makes them.

        D has the shape (n, 1), float32, for observations of shape (n, signals), and (1,) for one of shape (signals,). The
        feedback is deterministic and keeps no state. It does not look at the observed operating point: it is made for its own.

        Raises:
            ParameterError: an observation of another shape, or one that is not finite.
        """
        rows = np.atleast_2d(number_array("observation", observation))
        if rows.ndim != 2 or rows.shape[1] != len(self.signals):
            raise ParameterError(f"observation must have {len(self.signals)} signals, got the shape {np.shape(observation)}")
        columns = np.array([self.signals.index(name) for name in self.state])
        return self._evaluate(rows, columns).reshape((*np.shape(observation)[:-1], 1)), state


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class OptimalFeedback(Feedback):
    """The best feedback found of a car of one mass, of the states (Y, X, Z, U), or (Y, X, Z); made by `optimal_feedback`.

    Attributes:
        history: the refinements, coarse to fine.
        box: half the sides of the rectangle of (Y, X), less what follows Z on a first-order road, in standard deviations of the
            road, shape (2,).
        policy: the tabulated polynomials, shape (rings, rays, rows, rows, 4); a first-order road has two rays.
    """

    history: tuple[Refinement, ...]
    box: FloatArray
    policy: SingleArray

    @property
    def state(self) -> tuple[str, ...]:
        """(Y, X, Z, U), without U on a first-order road."""
        return grid_of(self.road).state

    def kept(self) -> tuple[dict[str, Any], dict[str, npt.NDArray[Any]]]:
        """The figures, and the table."""
        history = [dataclasses.asdict(refinement) for refinement in self.history]
        figures = {"cost": self.cost, "standard_error": self.standard_error, "history": history}
        return figures, {"box": self.box, "policy": self.policy}

    def _evaluate(self, rows: npt.NDArray[Any], columns: npt.NDArray[np.int64]) -> SingleArray:
        result = np.empty(len(rows), np.float32)
        evaluate(0, len(rows), rows, columns, *self._table, result)
        return np.clip(result, *np.array(self.bounds, np.float32), out=result)

    @functools.cached_property
    def _table(self) -> tuple[SingleArray, FloatArray, npt.NDArray[np.int64]]:
        """Arguments of `evaluate`."""
        shape = np.array(self.policy.shape[:3])
        interval, ratio = (
            self.control_interval * self.natural_frequency,
            self.speed * self.road.wavenumber / self.natural_frequency,
        )
        follows = grid_of(self.road).follows(ratio, self.bounds)
        geometry = geometry_of(self.road, shape, self.box, self.bounds, interval, follows)
        return self.policy.reshape(-1), geometry, shape


def save(path: Path, text: str, result: Feedback) -> None:
    """Keep a result, whole or not at all; where it cannot be kept there is a warning, for the result is worth more."""
    figures, arrays = result.kept()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        content: dict[str, Any] = {**arrays, "description": text, "figures": json.dumps(figures)}
        with whole_file(path) as part, part.open("wb") as file:
            np.savez(file, **content)
    except OSError as error:
        warn_not_kept(path.parent, error)


def kept_files(folder: Path | None) -> list[Path]:
    """The results that are kept in ``folder``, and what killed writers left there."""
    if folder is None or not folder.is_dir():
        return []
    return [
        path for path in folder.iterdir() if re.fullmatch(r"feedback-[0-9a-f]{32}\.npz", path.name) or PART.fullmatch(path.name)
    ]


def kept_path(cache: str | os.PathLike[str] | None, text: str) -> Path | None:
    """Where a result of this description is kept; None without a folder."""
    return None if cache is None else Path(cache) / f"feedback-{hashlib.sha256(text.encode()).hexdigest()[:32]}.npz"


def read(path: Path, text: str, made: Callable[[dict[str, Any], dict[str, npt.NDArray[Any]]], Kept | None]) -> Kept | None:
    """What is kept, or None where there is nothing, or nothing that is sound and of this description.

    Args:
        path: the file.
        text: the description.
        made: makes of figures and arrays what was kept, or None of what is not sound.
    """
    try:
        content = path.read_bytes()
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if archive.testzip() is not None:  # reads all of it: NumPy looks at no checksum
                return None
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            if str(file["description"]) != text:
                return None
            arrays = {name: file[name] for name in file.files if name not in ("description", "figures")}
            return made(json.loads(str(file["figures"])), arrays)
    except Exception:  # a damaged file can raise anything
        return None


def load(path: Path, text: str, point: Mapping[str, Any]) -> OptimalFeedback | None:
    """A kept `OptimalFeedback`, or None as of `read`."""
    return read(path, text, functools.partial(sound_feedback, point))


def sound_feedback(
    point: Mapping[str, Any], figures: dict[str, Any], arrays: dict[str, npt.NDArray[Any]]
) -> OptimalFeedback | None:
    """The result that was kept, if `optimal_feedback` could have found it."""
    history = tuple(Refinement(**refinement) for refinement in figures["history"])
    known = grid_of(point["road"])
    result = OptimalFeedback(
        **point, **figures | {"history": history}, signals=known.signals, box=arrays["box"], policy=arrays["policy"]
    )
    grids = [(grid.rings, grid.rays, grid.rows) for grid in result.history]
    chosen = min(result.history, key=lambda grid: grid.cost)  # the first of equals, as it chooses
    positive_figures = [result.cost, result.standard_error, *result.box.tolist()]
    for grid in result.history:
        positive_figures += [grid.sweeps, grid.expected, grid.cost, grid.standard_error]
    sound = (
        grids == list(known.sizes[: len(grids)])
        and are_positive(positive_figures)
        and result.box.shape == (2,)
        and result.box.dtype == np.float64
        and result.policy.shape == (chosen.rings, chosen.rays, chosen.rows, chosen.rows, 4)
        and result.policy.dtype == np.float32
        and bool(np.isfinite(result.policy).all())
    )
    return result if sound else None


def are_positive(figures: Sequence[Any]) -> bool:
    """Are all of them finite numbers above zero?"""
    return all(type(figure) in (int, float) and 0 < figure < math.inf for figure in figures)
