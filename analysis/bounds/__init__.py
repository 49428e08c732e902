"""Lower bounds of the cost of every controller, each method a module: its statement and its proof are in its docstring.

A method offers ``refusal(task)``, why there is no such bound for a task, or None; and ``bound(task, speed, bandwidth, ...)``, a
`LowerBound` at an operating point. A new one is a line in `METHODS`.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from roadgym.installation import InstallationError
from roadgym.parameters import ParameterError, shown, whole, within
from roadgym.task import Task

from . import information_relaxation, matrix_inequality, pathwise_multipliers, sums_of_squares, varied
from .bound import PROVED, RIGOURS, SOLVED, STATISTICAL, LowerBound
from .kept import described, kept_files, kept_path, load, save
from .matrix_inequality import MatrixCertificate

__all__ = [
    "METHODS",
    "PRESETS",
    "PROVED",
    "RIGOURS",
    "SOLVED",
    "STATISTICAL",
    "LowerBound",
    "MatrixCertificate",
    "Method",
    "kept_files",
    "lower_bound",
    "refusal",
]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Method:
    """How a lower bound is found.

    Attributes:
        title: the method in words, after "by".
        refusal: of a task, why there is no such bound, in a few words; None where there is.
        bound: of (task, speed, bandwidth), the bound; it takes ``report``, and those of ``settings``, as keywords.
        quick: does it take a second or two at most, for one car?
        each_car: where cars differ from episode to episode, is it taken of each, and the mean over them? Else there is none.
        settings: those of "seed", "threads" and "cache" of `lower_bound` that it takes.
        revision: of results that are kept; raise it whenever they change. None where they are found sooner than read.
    """

    title: str
    refusal: Callable[[Task], str | None]
    bound: Callable[..., LowerBound]
    quick: bool = True
    each_car: bool = False
    settings: tuple[str, ...] = ()
    revision: int | None = None

    def refuses(self, task: Task) -> str | None:
        """Why there is no such bound for ``task``, whose car may vary, in a few words; None where there is."""
        return self.refusal(dataclasses.replace(task, vary=None) if self.each_car else task)

    def of(
        self, task: Task, speed: float, bandwidth: float, settings: Mapping[str, Any], report: Callable[[int, int], None]
    ) -> LowerBound:
        """The bound of ``task``; where its car varies, the mean over cars that the setting "seed" draws."""
        if task.vary is None:
            return self.bound(task, speed, bandwidth, **settings, report=report)
        return varied.mean_bound(task, task.vary, settings["seed"], lambda one: self.bound(one, speed, bandwidth), report)


METHODS: dict[str, Method] = {
    "matrix_inequality": Method(
        title="a matrix inequality", refusal=matrix_inequality.refusal, bound=matrix_inequality.bound, each_car=True
    ),
    "sums_of_squares": Method(
        title="sums of squares",
        refusal=sums_of_squares.refusal,
        bound=sums_of_squares.bound,
        each_car=True,
        revision=2,
    ),
    "pathwise_multipliers": Method(
        title="pathwise multipliers",
        refusal=pathwise_multipliers.refusal,
        bound=pathwise_multipliers.bound,
        quick=False,
        settings=("seed", "threads"),
        revision=1,
    ),
    "information_relaxation": Method(
        title="information relaxation",
        refusal=information_relaxation.refusal,
        bound=information_relaxation.bound,
        quick=False,
        settings=("seed", "threads", "cache"),
        revision=3,
    ),
}
PRESETS: Mapping[str, Callable[[Method], bool]] = MappingProxyType(
    {"fast": lambda method: method.quick, "tight": lambda method: True}
)
UNITS = 100  # of progress, for each method


def chosen_methods(method: str) -> dict[str, Method]:
    """The methods by name that ``method`` speaks of: "fast", "tight", or one method's name.

    Raises:
        ParameterError: another name.
    """
    if not isinstance(method, str) or method not in {*PRESETS, *METHODS}:
        raise ParameterError(f"method must be one of {', '.join((*PRESETS, *METHODS))}, got {shown(method)}")
    if method in PRESETS:
        return {name: each for name, each in METHODS.items() if PRESETS[method](each)}
    return {method: METHODS[method]}


def refusal(task: Task, method: str = "fast") -> str | None:
    """Why there is no lower bound for ``task``, in a few words; None where there is.

    Args:
        task: plant, weights, range of D and control interval.
        method: as of `lower_bound`.

    Raises:
        ParameterError: no task, or an unknown method.
    """
    if not isinstance(task, Task):
        raise ParameterError(f"task must be one that roadgym.task.make_task made, got {shown(task)}")
    reasons = [each.refuses(task) for each in chosen_methods(method).values()]
    return None if None in reasons else "; ".join(dict.fromkeys(reason for reason in reasons if reason is not None))


def lower_bound(
    task: Task,
    *,
    speed: float | None = None,
    bandwidth: float | None = None,
    method: str = "fast",
    seed: int = 0,
    threads: int | None = None,
    cache: str | os.PathLike[str] | None = None,
    report: Callable[[int, int], None] | None = None,
) -> LowerBound:
    """What every controller costs at least, whatever it sees, remembers or computes, at an operating point of ``task``.

    Its damping must stay in the range of the task, and may be late, or chosen from noisy sensors. Whether it must be held over
    the control intervals, as behind a valve that lags it is not, `LowerBound.assumption` tells.

    Args:
        task: plant, weights, range of D and control interval, of `roadgym.task.make_task`.
        speed: m/s; not needed where the task has one alone.
        bandwidth: 1, likewise; in place of the road's, at the same variance.
        method: a name of `METHODS`; or "fast", the largest of those that take a second or two at most; or "tight", the largest
            of all. These pass over methods whose package is not installed.
        seed: fixes the noise of statistical bounds.
        threads: number of threads; results do not depend on it. By default one a processor.
        cache: folder in which bounds that took time are kept, and found again when all parameters are the same; it is made if
            need be.
        report: called as ``report(done, total)`` now and then; ``done`` never falls and ends at ``total``.

    Raises:
        ParameterError: a parameter out of range, or a task for which there is no such bound, with the reason.
        InstallationError: the solver that a method needs is not installed.
    """
    reason = refusal(task, method)
    if reason is not None:
        raise ParameterError(f"there is no lower bound for this task: {reason}")
    speed = _one("speed", task.speed, speed, "moving speed")
    bandwidth = _one("bandwidth", task.bandwidth, bandwidth, "bandwidth") if task.bandwidth[1] > 0 else 0.0
    if not (cache is None or isinstance(cache, (str, os.PathLike))):
        raise ParameterError(f"cache must be a folder or None, got {shown(cache)}")
    if not (report is None or callable(report)):
        raise ParameterError(f"report must be a function or None, got {shown(report)}")
    given = {
        "seed": whole("seed", seed, low=0, of="seed"),
        "threads": None if threads is None else whole("threads", threads, of="threads"),
        "cache": cache,
    }
    methods = {name: each for name, each in chosen_methods(method).items() if each.refuses(task) is None}
    found: list[LowerBound] = []
    failed: list[ParameterError | InstallationError] = []
    for turn, (name, each) in enumerate(methods.items()):
        told = _turn(report, turn, len(methods))
        settings = {setting: given[setting] for setting in (("seed",) if task.vary is not None else each.settings)}
        try:
            found.append(_kept(name, each, task, speed, bandwidth, settings, cache, told))
        except (ParameterError, InstallationError) as error:
            failed.append(error)
        told(1, 1)
    if not found:
        raise failed[0]
    return max(found, key=lambda each: each.safe)


def _one(name: str, values: tuple[float, float], given: float | None, of: str) -> float:
    """The operating point's speed or bandwidth: the given one, or the only one of the task."""
    if given is not None:
        return within(name, given, of)
    if values[0] != values[1]:
        raise ParameterError(f"{name} must be given where the task has a range of it, [{values[0]:g}, {values[1]:g}]")
    return values[0]


def _turn(report: Callable[[int, int], None] | None, turn: int, turns: int) -> Callable[[int, int], None]:
    """What tells of the progress of one method out of some."""

    def told(done: int, total: int) -> None:
        if report is not None:
            report(UNITS * turn + UNITS * done // total, UNITS * turns)

    return told


def _kept(
    name: str,
    method: Method,
    task: Task,
    speed: float,
    bandwidth: float,
    settings: Mapping[str, Any],
    cache: str | os.PathLike[str] | None,
    told: Callable[[int, int], None],
) -> LowerBound:
    """The bound of one method, from ``cache`` where it is kept there."""
    text = None
    if cache is not None and method.revision is not None:
        matters = {setting: value for setting, value in settings.items() if setting == "seed"}
        text = described(task, speed, bandwidth, method=name, revision=method.revision, **matters)
    if cache is None or text is None:
        return method.of(task, speed, bandwidth, settings, told)
    path = kept_path(cache, text)
    found = load(path, text)
    if found is None:
        found = method.of(task, speed, bandwidth, settings, told)
        save(path, text, found)
    return found
