"""A lower bound by information relaxation: the controller is told the road, and pays for what that tells.

Let x_0, x_1, ... be the states of car and road at the ends of the control intervals, r_k those of the road alone. Let h be any
function, and M_k(x_k, D_k) a penalty whose mean given x_k and D_k is zero, whatever these are. A controller that does not
foresee the road pays in the mean over N intervals

    E sum c_k = E [sum (c(x_k, D_k) - M_k(x_k, D_k)) + h(x_N) - h(x_0)],    c(x, D) = E[interval cost | x, D],            (*)

up to what h changes in the mean, which is nothing in the long run. It pays no less than the least that the bracket can be when
the whole road r_0, ..., r_N is known, over the car's start and all D_k: a deterministic problem over the car's states alone.
The mean of that least value over roads is the bound (D. B. Brown, J. E. Smith and P. Sun, "Information relaxations and duality
in stochastic dynamic programs", Operations Research 58, 2010). With M_k = h(x_{k+1}) - E[h(x_{k+1}) | x_k, D_k] and the
relative value h it would be the optimum.

*The penalty.* h = h0 + w is that of the dynamic programming (`analysis.feedback`). For h0, a quadratic form, the conditional
mean is exact. w is a table, and its mean after an interval is not known; but only *zero* mean matters. M_k expands w in
the noise of the road about its mean, in polynomials less their conditional means, which are exact on these roads
(`analysis.bounds.relaxation.moments`); the car's noise is taken as the linear function of the road's that it nearly is, and a
linear term has the rest. On a first-order road, which is Gaussian, piecewise cubics take the place of the polynomials, and of
the car's noise what does not follow from the road's, at each damping another, is expanded too
(`analysis.bounds.relaxation.expansion`). The coefficients are values of w, which x_k and D_k determine. So the mean is zero for
any table.

*Variance.* The bracket of (*) along a feedback that does not foresee has the mean N g', g' its cost, which is driven on its
own. The bound is g' plus the mean difference between the inner problem's value and that bracket, over the same roads and
penalties.

*Ends.* h need not be the same function as the penalty's: here it is less by a small quartic form of the car's state, which
keeps the free start from leaving for where the table is worst, at little cost at the end.

*What is not exact.* The inner problem is solved on a grid, by linear interpolation of its small difference to h, for a few D in
the range and parabolas between them. On some of the roads it is solved again with half the cells' sides and twice the D; what
that lowers the bound by is charged, times 4/3 for what still finer ones would. It is assumed that leaving the grid, eight root
mean squares of the car each way, does not pay. D is held over each interval; the roads are those of the plant with
substeps a third as long.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from typing import Any

import numpy as np

from roadgym.parameters import ParameterError, whole, within
from roadgym.processors import usual_threads
from roadgym.task import Task, make_task

from ..checks import FloatArray, single_threaded_algebra
from ..feedback.driving import CARS, drive
from ..feedback.grid import SingleArray
from ..feedback.iteration import sharing, tabulate
from ..feedback.model import Model
from ..feedback.policy import OptimalFeedback
from ..feedback.road_grid import grid_of
from ..feedback.search import BOX, is_one_mass, optimal_feedback
from .bound import STATISTICAL, LowerBound, common_refusal
from .relaxation.inner import Grid, Steps, along, relax
from .relaxation.roads import Drives, RoadChain, levels, nearest

VALUE_LEVEL = 2  # of the sizes of tables of w
ROWS = 72  # of the inner problem's grid
LEVELS = 17  # of D, all in the refined inner problems and every second one in the others
GROUP, LEAST = 16, 32  # roads: solved together, and at least for the errors to be known
REFINED = 8  # one road in so many is solved again
CHARGE = 4 / 3  # times what a refinement changes, for errors that fall as the square of the step
QUARTIC = 0.01  # of the cost of an interval: what h gives way by, at one root mean square of the car
DRIVEN = 1 / 3  # of the precision asked for: that of the driven cost
ASSUMPTION = (
    "any controller that sets D once an interval; errors of the grid are estimated and charged; "
    "leaving eight root mean squares of the car does not pay"
)


def refusal(task: Task) -> str | None:
    """Why there is no such bound for ``task``, in a few words; None where there is."""
    reason = common_refusal(task)
    if reason is not None:
        return reason
    if not task.valve.ideal:
        return "information relaxation needs a damping that is held over each control interval, and so an ideal valve"
    if not is_one_mass(task.car):
        return "information relaxation needs the car of one mass"
    try:
        grid_of(task.road)
    except ParameterError:
        return "information relaxation needs a road of first order, a Gaussian one, or a bounded one on a circle"
    return None


@single_threaded_algebra()
def bound(
    task: Task,
    speed: float,
    bandwidth: float,
    *,
    precision: float = 0.003,
    intervals: int = 400,
    seed: int = 0,
    threads: int | None = None,
    cache: str | os.PathLike[str] | None = None,
    report: Callable[[int, int], None] | None = None,
) -> LowerBound:
    """The bound at an operating point, with its standard error.

    Args:
        task: plant, weights, range of D and control interval.
        speed, bandwidth: the operating point, m/s and 1.
        precision: standard error of the bound, at most, over the driven cost; roads are added until it is reached.
        intervals: control intervals on each road.
        seed: fixes the noise; the result depends on nothing else.
        threads: number of threads; results do not depend on it. By default one a processor.
        cache: folder in which the best feedback is kept, see `analysis.optimal_feedback`.
        report: called as ``report(done, total)`` now and then; ``done`` never falls and ends at ``total``.

    Raises:
        ParameterError: a parameter out of range, or a plant of another kind.
    """
    reason = refusal(task)
    if reason is not None:
        raise ParameterError(f"there is no such bound for this task: {reason}")
    precision, intervals = within("precision", precision, "relative_error"), whole("intervals", intervals)
    count = usual_threads() if threads is None else whole("threads", threads, of="threads")

    furthest = 0

    def told(done: float) -> None:
        nonlocal furthest
        furthest = max(furthest, min(int(100 * done), 99))  # the share of roads may fall, when one more tells of larger errors
        if report is not None:
            report(furthest, 100)

    point = make_task(
        road=task.road.with_bandwidth(bandwidth) if task.bandwidth[1] > 0 else task.road,
        speed=speed,
        car=task.car,
        reward=task.reward_by_name,
        damping_range=task.damping_range,
        control_interval=task.control_interval,
        observation=grid_of(task.road).state,
        observe_operating_point=False,
    )
    feedback = optimal_feedback(
        point.road,
        speed=speed,
        car=task.car,
        weights=task.reward_by_name,
        bounds=task.damping_range,
        control_interval=task.control_interval,
        seed=seed,
        threads=threads,
        cache=cache,
        report=lambda done, total: told(0.4 * done / total),
    )
    assert isinstance(feedback, OptimalFeedback)
    found = Relaxation(point, feedback, precision, intervals, seed, count, told)
    if report is not None:
        report(100, 100)
    return LowerBound(
        cost=found.cost,
        method="information_relaxation",
        assumption=ASSUMPTION,
        rigour=STATISTICAL,
        standard_error=found.standard_error,
    )


class Relaxation:
    """The inner problems of some roads at one operating point.

    Args:
        task: the plant at the operating point; its states are observed.
        feedback: the best there.
        precision, intervals, seed, threads: see `bound`.
        told: called with the share that is done.

    Attributes:
        driven, driven_error: cost of the feedback that is compared with, and its standard error.
        bracket: (*) along that feedback on each road, over its intervals; its mean is the feedback's cost, shape (roads,).
        gaps: how much less than that a controller pays on each road that is told of it, shape (roads,).
        changes: what a finer grid and more D add to that, on some of the roads.
        charge: what is taken from the bound for it.
        cost, standard_error: the bound.
    """

    def __init__(
        self,
        task: Task,
        feedback: OptimalFeedback,
        precision: float,
        intervals: int,
        seed: int,
        threads: int,
        told: Callable[[float], None],
    ) -> None:
        road_noise, drive_noise = np.random.SeedSequence(seed).spawn(2)
        dampings = levels(task, LEVELS)
        model = Model(task)
        self._box, self._intervals = feedback.box, intervals
        rings, rays, rows = size = model.grid.sizes[VALUE_LEVEL]
        self._grid = Grid(rows, 2 * self._box / (rows - 1))
        self._chain = RoadChain(task, model, dampings, rings, rays)
        self.bracket, self.gaps, self.changes = np.empty(0), np.empty(0), np.empty(0)

        def respond(begin: int, end: int, states: SingleArray, damping: SingleArray) -> None:
            damping[begin:end] = dampings[nearest(dampings, feedback.damping(states[begin:end]))]

        with sharing(threads) as share:
            self._value, _, expected, _ = tabulate(model, np.array(size), self._box, share, lambda done: told(0.4 + 0.1 * done))
            self._price = QUARTIC * expected
            driven = drive(
                task,
                respond,
                drive_noise,
                cars=CARS,
                moving=task.signals[:2],
                precision=DRIVEN * precision,
                pieces=None,
                share=share,
                threads=threads,
                told=lambda done: told(0.5 + 0.1 * done),
            )
            self.driven, self.driven_error = driven.cost, driven.standard_error
            while len(self.gaps) < LEAST or self.standard_error > precision * self.driven:
                drives = Drives.over(
                    task,
                    dampings,
                    self._chain.chain.maps,
                    model.follows,
                    feedback,
                    paths=GROUP,
                    intervals=intervals,
                    seeds=road_noise.spawn(1)[0].generate_state(GROUP, np.uint64).astype(np.uint64),
                    threads=threads,
                )
                bracket, gaps, changes = np.empty(GROUP), np.empty(GROUP), np.full(GROUP, np.nan)

                def solve(begin: int, end: int, drives: Drives = drives, found: Any = (bracket, gaps, changes)) -> None:
                    for path in range(begin, end):
                        for figures, figure in zip(found, self._solve(drives, path), strict=True):
                            figures[path] = figure

                share(GROUP, solve)
                self.bracket, self.gaps = np.append(self.bracket, bracket), np.append(self.gaps, gaps)
                self.changes = np.append(self.changes, changes[np.isfinite(changes)])
                reached = (precision * self.driven / self.standard_error) ** 2
                told(0.6 + 0.4 * min(len(self.gaps) / LEAST, reached, 1.0))

    def _solve(self, drives: Drives, path: int) -> tuple[float, float, float]:
        """(bracket, gap, change) of one road; the change is NaN where it is solved but once."""
        steps, car = self._chain.steps(drives.road[:, path], drives.added[:, path]), drives.car[:, path]
        paid = along(self._value, self._grid, self._chain.chain, steps, car, drives.chosen[:, path])
        paid -= self._price * float(np.diff(quartic(car[[0, -1]] / self._box))[0])
        coarse = self._least(steps, ROWS, 2)
        change = self._least(steps, 2 * ROWS - 1, 1) - coarse if path % REFINED == 0 else math.nan
        return paid / self._intervals, (coarse - paid) / self._intervals, change / self._intervals

    def _least(self, steps: Steps, rows: int, stride: int) -> float:
        """The inner problem's value on a grid of so many rows, for every ``stride``th damping."""
        ends = np.linspace(-1.0, 1.0, rows)
        given = self._price * quartic(np.stack(np.meshgrid(ends, ends, indexing="ij"), axis=-1).reshape(-1, 2))
        beyond = -given
        relax(self._value, self._grid, self._chain.chain, steps, stride, Grid(rows, 2 * self._box / (rows - 1)), beyond)
        return float(np.min(beyond + given))

    @property
    def charge(self) -> float:
        """See above."""
        return CHARGE * max(0.0, -float(self.changes.mean()))

    @property
    def cost(self) -> float:
        """See above."""
        return self.driven + float(self.gaps.mean()) - self.charge

    @property
    def standard_error(self) -> float:
        """See above."""
        return math.hypot(self.driven_error, standard_error(self.gaps), CHARGE * standard_error(self.changes))


def quartic(places: FloatArray) -> FloatArray:
    """|s|^4 at ``places``, shape (n, 2), in half sides of the box; s in root mean squares of the car."""
    return np.asarray(((BOX * places) ** 2).sum(axis=-1) ** 2)


def standard_error(samples: FloatArray) -> float:
    """Of the mean of independent samples."""
    return float(samples.std(ddof=1)) / math.sqrt(len(samples))
