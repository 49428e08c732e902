"""A feedback that was found, and how it is kept in a file."""

from __future__ import annotations

import dataclasses
import functools
import io
import json
import math
import re
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from roadgym.cache import warn_not_kept
from roadgym.files import PART, whole_file
from roadgym.parameters import ParameterError, number_array
from roadgym.roads import Road

from ..checks import FloatArray
from .grid import GRIDS, STATE, SingleArray, evaluate, geometry_of


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


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class OptimalFeedback:
    """The best feedback found at one operating point; made by `optimal_feedback`.

    Attributes:
        road: the road, its bandwidth that of the operating point.
        speed: v, m/s.
        natural_frequency: w1, rad/s.
        weights: weights of the mean squares.
        bounds: smallest and largest damping, 1.
        control_interval: s.
        cost: driven cost, 1: minus the mean reward of the environment.
        standard_error: of the cost.
        history: the refinements, coarse to fine.
        signals: names of the signals in the observations that `predict` is given, in order.
        box: half the sides of the rectangle of (Y, X), in standard deviations of the road, shape (2,).
        policy: the tabulated polynomials, shape (rings, rays, rows, rows, 4).
    """

    road: Road
    speed: float
    natural_frequency: float
    weights: Mapping[str, float]
    bounds: tuple[float, float]
    control_interval: float
    cost: float
    standard_error: float
    history: tuple[Refinement, ...]
    signals: tuple[str, ...] = (*STATE, "speed", "bandwidth")
    box: FloatArray
    policy: SingleArray

    def __post_init__(self) -> None:
        for name in STATE:
            if name not in self.signals:
                raise ParameterError(f"optimal feedback needs the signal {name!r}; signals has {', '.join(self.signals)}")

    def with_signals(self, signals: Sequence[str]) -> OptimalFeedback:
        """The same feedback for observations of ``signals``, such as those of a task.

        Raises:
            ParameterError: a signal is missing that the feedback needs.
        """
        return dataclasses.replace(self, signals=tuple(signals))

    def damping(self, states: npt.ArrayLike) -> SingleArray:
        """D, shape (n,), float32, at ``states`` (Y, X, Z, U), shape (n, 4), in standard deviations of the road."""
        rows = np.atleast_2d(number_array("states", states))
        if rows.ndim != 2 or rows.shape[1] != len(STATE):
            raise ParameterError(f"states must have the shape (n, {len(STATE)}), got {np.shape(states)}")
        return self._evaluate(rows, np.arange(len(STATE)))

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
        columns = np.array([self.signals.index(name) for name in STATE])
        return self._evaluate(rows, columns).reshape((*np.shape(observation)[:-1], 1)), state

    def _evaluate(self, rows: npt.NDArray[Any], columns: npt.NDArray[np.int64]) -> SingleArray:
        result = np.empty(len(rows), np.float32)
        evaluate(0, len(rows), rows, columns, *self._table, result)
        return np.clip(result, *np.array(self.bounds, np.float32), out=result)

    @functools.cached_property
    def _table(self) -> tuple[SingleArray, FloatArray, npt.NDArray[np.int64]]:
        """Arguments of `evaluate`."""
        shape = np.array(self.policy.shape[:3])
        interval = self.control_interval * self.natural_frequency
        geometry = geometry_of(self.road, shape, self.box, self.bounds, interval)
        return self.policy.reshape(-1), geometry, shape


def save(path: Path, text: str, result: OptimalFeedback) -> None:
    """Keep a result, whole or not at all; where it cannot be kept there is a warning, for the result is worth more."""
    figures = {
        "cost": result.cost,
        "standard_error": result.standard_error,
        "history": [dataclasses.asdict(refinement) for refinement in result.history],
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as part, part.open("wb") as file:
            np.savez(file, description=text, figures=json.dumps(figures), box=result.box, policy=result.policy)
    except OSError as error:
        warn_not_kept(path.parent, error)


def kept_files(folder: Path | None) -> list[Path]:
    """The results that are kept in ``folder``, and what killed writers left there."""
    if folder is None or not folder.is_dir():
        return []
    return [
        path for path in folder.iterdir() if re.fullmatch(r"feedback-[0-9a-f]{32}\.npz", path.name) or PART.fullmatch(path.name)
    ]


def load(path: Path, text: str, point: Mapping[str, Any]) -> OptimalFeedback | None:
    """A kept result, or None where there is none, or none that is sound and of this description."""
    try:
        content = path.read_bytes()
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if archive.testzip() is not None:  # reads all of it: NumPy looks at no checksum
                return None
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            if str(file["description"]) != text:
                return None
            figures = json.loads(str(file["figures"]))
            history = tuple(Refinement(**refinement) for refinement in figures["history"])
            box, policy = file["box"], file["policy"]
        return _sound(OptimalFeedback(**point, **figures | {"history": history}, box=box, policy=policy))
    except Exception:  # a damaged file can raise anything
        return None


def _sound(result: OptimalFeedback) -> OptimalFeedback | None:
    """The result, if `optimal_feedback` could have found it."""
    grids = [(grid.rings, grid.rays, grid.rows) for grid in result.history]
    chosen = min(result.history, key=lambda grid: grid.cost)  # the first of equals, as it chooses
    positive_figures = [result.cost, result.standard_error, *result.box.tolist()]
    for grid in result.history:
        positive_figures += [grid.sweeps, grid.expected, grid.cost, grid.standard_error]
    sound = (
        grids == list(GRIDS[: len(grids)])
        and all(type(figure) in (int, float) and 0 < figure < math.inf for figure in positive_figures)
        and result.box.shape == (2,)
        and result.box.dtype == np.float64
        and result.policy.shape == (chosen.rings, chosen.rays, chosen.rows, chosen.rows, 4)
        and result.policy.dtype == np.float32
        and bool(np.isfinite(result.policy).all())
    )
    return result if sound else None
