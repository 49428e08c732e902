"""Lower bounds at the operating points of a comparison: what no controller can beat."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import analysis
from analysis import LowerBound
from analysis.bounds import PRESETS, chosen_methods, refusal
from roadgym.installation import InstallationError
from roadgym.parameters import ParameterError, shown
from roadgym.task import Task

from .controllers import cache_folder
from .evaluation import OperatingPoint

NONE = "none"  # no bound, as a command is asked for one
UNITS = 100  # of progress, for each operating point


def check_bound(method: str) -> None:
    """Raises `ParameterError` for what `lower_bounds` cannot be asked."""
    if method == NONE:
        return
    try:
        chosen_methods(method)
    except ParameterError:
        raise ParameterError(f"bound must be {', '.join(PRESETS)}, {NONE} or a method's name, got {shown(method)}") from None


def lower_bounds(
    task: Task, points: Sequence[OperatingPoint], method: str, report: Callable[[str, int, int], None]
) -> tuple[LowerBound | str, ...]:
    """The lower bound at each operating point, or in a few words why there is none; empty where none is asked for.

    Bounds that take time are kept in the user's cache folder, so a search that was interrupted goes on where it was.

    Args:
        task: the task.
        points: the operating points.
        method: as of `analysis.lower_bound`, or `NONE`.
        report: called as ``report(what, done, in all)``.
    """
    if method == NONE:
        return ()
    reason = refusal(task, method)
    if reason is not None:
        return (reason,) * len(points)
    found: list[LowerBound | str] = []
    for turn, point in enumerate(points):

        def told(done: int, total: int, turn: int = turn) -> None:
            report("lower bounds", UNITS * turn + UNITS * done // total, UNITS * len(points))

        try:
            found.append(
                analysis.lower_bound(
                    task,
                    speed=point.speed,
                    bandwidth=point.bandwidth or None,
                    method=method,
                    cache=cache_folder(),
                    report=told,
                )
            )
        except (ParameterError, InstallationError) as error:
            found.append(str(error))
            told(1, 1)
    return tuple(found)
