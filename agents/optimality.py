"""One operating point from both sides: costs that are reached, and lower bounds that no controller beats."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from analysis import LowerBound
from analysis.bounds import METHODS
from analysis.certificate import FALSE_ALARM_RATE, ROAD_TOLERANCE, wrapped
from roadgym.parameters import ParameterError, shown, whole
from roadgym.task import make_task

from .certified import NONE, bound_cell, lower_bounds
from .comparison import compare, observed_in_full
from .controllers import make_controller
from .evaluation import FEWEST_EPISODES, Predictor, make_points
from .names import title
from .numerals import aligned, percent, with_error
from .results import CONFIDENCE, Comparison, Row, flat
from .units import in_si, place, weighted


@dataclasses.dataclass(frozen=True, kw_only=True)
class Optimality:
    """One operating point from both sides.

    Attributes:
        comparison: what was driven there, held against the largest bound.
        bounds: the lower bound of each method by name, or why there is none.
    """

    comparison: Comparison
    bounds: Mapping[str, LowerBound | str]

    @property
    def rows(self) -> list[Row]:
        """What was driven, the cheapest last."""
        return sorted(self.comparison.rows, key=lambda row: -row.cost)

    def exceeds(self, bound: LowerBound, row: Row) -> bool:
        """Is a bound above a driven cost, beyond their errors? One of them is wrong then."""
        from scipy.stats import norm

        pairs = len(self.comparison.rows) * sum(isinstance(bound, LowerBound) for bound in self.bounds.values())
        error = math.hypot(row.standard_error, bound.standard_error)
        return bound.cost * (1 - ROAD_TOLERANCE) - row.cost > error * float(norm.isf(FALSE_ALARM_RATE / pairs))

    @property
    def passed(self) -> bool:
        """Does no bound exceed a driven cost?"""
        known = [bound for bound in self.bounds.values() if isinstance(bound, LowerBound)]
        return not any(self.exceeds(bound, row) for bound in known for row in self.comparison.rows)

    def table(self) -> str:
        """All of it as text."""
        task, (point, *_) = self.comparison.task, self.comparison.points
        known = {name: bound for name, bound in self.bounds.items() if isinstance(bound, LowerBound)}
        names = ["", *(title(row.controller) for row in self.rows), *(f"bound by {METHODS[name].title}" for name in known)]
        costs = [with_error(row.cost, row.standard_error) for row in self.rows]
        costs += [bound_cell(bound, self.rows[-1]) for bound in known.values()]
        shares = [percent(row.certified) for row in self.rows] + [""] * len(known)
        columns = [names, ["cost", *aligned(costs)], ["certified", *aligned(shares)]]
        widths = [max(map(len, column)) for column in columns]
        text = [
            "  ".join([name.ljust(widths[0]), cost.rjust(widths[1]), share.rjust(widths[2])]).rstrip()
            for name, cost, share in zip(*columns, strict=True)
        ]
        over = "" if in_si(task) else ", over that of the road"
        low, high = task.damping_range
        text = [
            *wrapped(
                f"{task.road.kind} road, {task.car.kind} car, {place(task, point)}, D within [{low:.3g}, {high:.3g}]; cost: "
                f"mean square of {weighted(task)}{over}"
            ),
            "",
            *text,
            "",
        ]
        for name, bound in self.bounds.items():
            method = METHODS[name].title
            said = f"{bound.rigour}, for {bound.assumption}" if isinstance(bound, LowerBound) else f"none, {bound}"
            text += wrapped(f"By {method}: {said}.")
        text += wrapped(
            "certified: share, at least, of what any controller could save over the best constant D, after ± its "
            f"{100 * CONFIDENCE:g} % interval; in brackets the standard error of the last digits."
        )
        verdict = "no bound exceeds a driven cost" if known else "no lower bound is known"
        verdict = verdict if self.passed else "a bound EXCEEDS a driven cost: one of them is wrong"
        return "\n".join([*text, "", verdict])

    def to_json(self) -> str:
        """All of it as JSON."""
        content: dict[str, Any] = {
            "rows": [flat(row) for row in self.rows],
            "bounds": {
                name: {"reason": bound} if isinstance(bound, str) else dataclasses.asdict(bound)
                for name, bound in self.bounds.items()
            },
            "passed": self.passed,
            **self.comparison.configuration,
        }
        return json.dumps(content, indent=2, allow_nan=False)


def certify_optimality(
    agent: Predictor | None = None,
    *,
    environment: Mapping[str, Any],
    speed: float,
    bandwidth: float = 0.0,
    controllers: Sequence[str] = (),
    methods: Sequence[str] | None = None,
    episodes: int = 1024,
    seed: int = 0,
    report: Callable[[str, int, int], None],
) -> Optimality:
    """Drive the best constant damping, the optimal feedback where it is known, and others, and find every lower bound.

    Args:
        agent: a trained agent, or anything with ``predict`` that answers with D.
        environment: parameters of the environment.
        speed, bandwidth: the operating point, m/s and 1; 0 where the road has no bandwidth.
        controllers: names of others to drive.
        methods: names of methods of `analysis.bounds.METHODS`; by default all.
        episodes, seed: as for `agents.evaluate`.
        report: called as ``report(what, done, in all)``.

    Raises:
        ParameterError: a parameter out of range, or an unknown controller or method.
    """
    methods = list(METHODS) if methods is None else methods
    for name in methods:
        if name not in METHODS:
            raise ParameterError(f"methods must be of {', '.join(METHODS)}, got {shown(name)}")
    whole("seed", seed, low=0, of="seed")
    whole("episodes", episodes, low=FEWEST_EPISODES)
    task = make_task(**observed_in_full(environment))
    for name in controllers:  # all that can be wrong is told before the work
        make_controller(name, task)
    points = make_points(task, [speed], [bandwidth])
    bounds = {name: lower_bounds(task, points, name, report)[0] for name in methods}
    known = {name: bound for name, bound in bounds.items() if isinstance(bound, LowerBound)}
    names = list(controllers)
    with contextlib.suppress(ParameterError):  # where it is not known
        make_controller("optimal_feedback", task)
        names.append("optimal_feedback")
    comparison = compare(
        agent,
        environment=environment,
        speeds=[speed],
        bandwidths=[bandwidth],
        controllers=list(dict.fromkeys(names)),
        episodes=episodes,
        seed=seed,
        bound=max(known, key=lambda name: known[name].safe, default=NONE),
        report=report,
    )
    return Optimality(comparison=comparison, bounds=bounds)
