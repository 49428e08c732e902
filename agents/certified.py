"""Lower bounds at the operating points of a comparison: what no controller can beat, and how that reads."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import analysis
from analysis import LowerBound
from analysis.bounds import METHODS, PRESETS, chosen_methods, refusal
from roadgym.installation import InstallationError
from roadgym.parameters import ParameterError, shown
from roadgym.task import Task

from .controllers import cache_folder
from .evaluation import OperatingPoint
from .names import title
from .numerals import as_exact_as, percent, with_error
from .results import LEAST_ROOM, Comparison, Row

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


def bound_cell(bound: LowerBound | str, row: Row) -> str:
    """A lower bound, with its error, or with no fewer decimals than a driven cost has; n/a where there is none."""
    if isinstance(bound, str):
        return "n/a"
    if bound.standard_error:
        return with_error(bound.cost, bound.standard_error)
    return as_exact_as(bound.cost, row.cost, row.standard_error)


def bound_notes(comparison: Comparison) -> list[tuple[str, str]]:
    """What the lower bounds are, and the shares that they certify, or why there are none."""
    reasons = "; ".join(dict.fromkeys(bound for bound in comparison.bounds if isinstance(bound, str)))
    if not comparison.bounded:
        return [("certified", f"n/a here for lack of a lower bound: {reasons}.")] if reasons else []
    methods: dict[tuple[str, str, str], int] = {}
    for bound in comparison.bounds:
        if isinstance(bound, LowerBound):
            kind = (METHODS[bound.method].title, bound.rigour, bound.assumption)
            methods[kind] = methods.get(kind, 0) + 1
    several = len(methods) > 1
    told = "; ".join(
        f"by {method}{f' at {number} of {len(comparison.points)} points' if several else ''}, {rigour}, for {assumption}"
        for (method, rigour, assumption), number in methods.items()
    )
    share = (
        "share of the way from the best constant D to the lower bound: so much at least of what any controller could save; "
        f"n/a where it is less than {100 * LEAST_ROOM:g} % of the cost."
    )
    missing = f" n/a where there is none: {reasons}." if reasons else ""
    return [("lower bound", f"what no controller can beat: {told}.{missing}"), ("certified", share)]


def mean_share_certified(comparison: Comparison, name: str) -> str | None:
    """The mean certified share of a controller, and what it is over, in words; None where there is none."""
    mean = comparison.mean_certified[name]
    if mean.share is None:
        return None
    total = len(mean.points) + len(mean.left_out)
    over = f"on average over {'all' if not mean.left_out else f'{len(mean.points)} of'} {total} operating points"
    over = "at the one operating point" if total == 1 else over
    who = title(name) if name in comparison.agents else f"the {title(name)}"
    if mean.share.value < 0:
        return f"Certified: nothing of what any controller could save is saved by {who} ({percent(mean.share)}), {over}."
    return f"Certified: {who} saves at least {percent(mean.share)} of what any controller could save, {over}."
