"""A table of the damping over two signals, for a car that has no room for a network, and what is lost by it.

The agent drives at several speeds, and its answers are averaged over each node of a grid of two signals, with the weights that
the interpolation between the nodes gives them. Nothing changes when road and car are mirrored, so a sample stands for its
mirror image too. An average of answers that switch is too soft: it is sharpened about the middle of the range, at each speed by
the factor with which the table costs least when it drives itself.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

import roadgym
from analysis.certificate import wrapped
from roadgym.parameters import ParameterError
from roadgym.reward import divergent_terms
from roadgym.task import Task
from roadgym.vector import QuarterCarVectorEnv

from ..agent import Agent
from ..evaluation import Evaluation, drive, evaluate
from ..numerals import with_error
from ..records import Purpose, stream_seed
from ..results import Share, ratio
from ..theory import optimum
from .c_files import units
from .c_printer import CPrinter
from .program import Value, clip, constant, given
from .stages import Array, interpolate, observe, signal_table

CARS, STEPS, FORGOTTEN = 128, 400, 100  # at each operating point; the first steps are not looked at
NODES = 15  # of each signal; they are densest at zero, about which answers switch
EXTENT = 0.999  # share of the samples that lie within the table
BINS = 12  # of each signal, where the two are chosen
FEW = 64  # episodes at each operating point that choose among
FACTORS = (1.0, 1.5, 2.0, 3.0, 5.0, 10.0)

Report = Callable[[str, int, int], None]


@dataclasses.dataclass(frozen=True)
class Table:
    """Damping over two signals and the speed; like every controller it answers observations with damping ratios.

    Attributes:
        task: what it observes: the two signals and the speed.
        shares: the speeds as they are observed, shape (speeds,).
        nodes: observed signals at the nodes, shape (2, NODES).
        damping: D, shape (speeds, NODES, NODES).
    """

    task: Task
    shares: Array
    nodes: Array
    damping: Array

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """(D, state), D of shape (n, 1)."""
        cells, weights = hats([self.shares, *self.nodes], observation[:, [2, 0, 1]])
        damping = (self.damping[tuple(cells)] * weights).sum(axis=0)
        return np.clip(damping, *self.task.damping_range).astype(np.float32)[:, None], state

    def sharpened(self, factors: npt.ArrayLike) -> Table:
        """The table with its distances from the middle of the range times ``factors``, one or one of each speed."""
        low, high = self.task.damping_range
        middle = (low + high) / 2
        distances = np.reshape(factors, (-1, 1, 1)) * (self.damping - middle)
        return dataclasses.replace(self, damping=np.clip(middle + distances, low, high))


def hats(axes: Sequence[Array], points: Array) -> tuple[list[npt.NDArray[np.intp]], npt.NDArray[np.float64]]:
    """Corners of the cells around points, shape (n, axes), and their weights in the interpolation, shape (corners, n).

    It is multilinear, and beyond the ends of the axes as at the ends.
    """
    cells, shares = [], []
    for axis, x in zip(axes, points.T, strict=True):
        k = np.clip(np.searchsorted(axis, x, "right") - 1, 0, max(len(axis) - 2, 0))
        after = np.minimum(k + 1, len(axis) - 1)
        width = np.where(after > k, axis[after] - axis[k], 1.0)
        cells.append((k, after))
        shares.append(np.clip((x - axis[k]) / width, 0, 1))
    corners = list(itertools.product((0, 1), repeat=len(axes)))
    weights = np.array(
        [np.prod([s if c else 1 - s for c, s in zip(corner, shares, strict=True)], axis=0) for corner in corners]
    )
    return [np.array([cell[corner[d]] for corner in corners]) for d, cell in enumerate(cells)], weights


def drive_for_samples(
    agent: Agent, names: Sequence[str], speeds: Sequence[float], bandwidths: Sequence[float], seed: int
) -> Any:
    """What was seen of signals, shape (speeds, n, signals), and what the agent answered, shape (speeds, n)."""
    task = agent.task
    seen = list(dict.fromkeys([*names, *task.signals]))
    points = list(itertools.product(speeds, bandwidths or [0.0]))
    plant = {**agent.description["environment"], "observation": seen, "observe_operating_point": False}
    envs = QuarterCarVectorEnv(CARS * len(points), max_episode_steps=None, **plant)
    options = {"speed": np.repeat([speed for speed, _ in points], CARS)}
    if task.bandwidth[1] > 0:
        options["bandwidth"] = np.repeat([bandwidth for _, bandwidth in points], CARS)
    steps = itertools.islice(drive(agent, envs, stream_seed(seed, Purpose.EXPORT), options), FORGOTTEN, STEPS)
    columns = [seen.index(name) for name in names]
    rows, answers = zip(*((before[:, columns], damping[:, 0]) for before, damping, *_ in steps), strict=True)
    by_speed = np.stack(rows, axis=1).reshape(len(speeds), -1, len(names)), np.stack(answers, axis=1).reshape(len(speeds), -1)
    return np.concatenate([by_speed[0], -by_speed[0]], axis=1), np.concatenate([by_speed[1], by_speed[1]], axis=1)


def telling(names: Sequence[str], seen: Array, answers: Array) -> tuple[tuple[str, str], float]:
    """The two signals whose bins explain most of the answers' variance, and how much of it."""
    shares = dict.fromkeys(itertools.combinations(range(len(names)), 2), 0.0)
    for x, damping in zip(seen, answers, strict=True):
        edges = np.quantile(x, np.linspace(0, 1, BINS + 1)[1:-1], axis=0)
        bins = np.stack([np.searchsorted(edges[:, k], x[:, k]) for k in range(len(names))])
        for a, b in shares:
            place = bins[a] * BINS + bins[b]
            number = np.maximum(np.bincount(place, minlength=BINS**2), 1)
            means = np.bincount(place, damping, BINS**2) / number
            shares[a, b] += means[place].var() / max(damping.var(), 1e-12) / len(seen)
    a, b = max(shares, key=lambda pair: shares[pair])
    return (names[a], names[b]), shares[a, b]


def average(task: Task, pair: tuple[str, str], speeds: Sequence[float], seen: Array, answers: Array) -> Table:
    """The table of averages of answers, shape (speeds, n), at signals, shape (speeds, n, 2)."""
    ratios = np.array([task.frequency_ratio(speed) for speed in speeds])
    steps = np.linspace(-1, 1, NODES)
    nodes = np.quantile(np.abs(seen), EXTENT, axis=(0, 1))[:, None] * (steps * np.abs(steps))
    damping = np.empty((len(speeds), NODES, NODES))
    for k, (x, answer) in enumerate(zip(seen, answers, strict=True)):
        cells, weights = hats(list(nodes), x)
        place = cells[0] * NODES + cells[1]
        total = np.bincount(place.ravel(), weights.ravel(), NODES**2)
        known = total > 1e-3 * total.mean()
        sums = np.bincount(place.ravel(), (weights * answer).ravel(), NODES**2)
        found = np.divide(sums, total, out=np.zeros(NODES**2), where=known)
        rows, columns = np.divmod(np.arange(NODES**2), NODES)
        distance = np.hypot(rows[:, None] - rows[known], columns[:, None] - columns[known])
        damping[k] = found[known][distance.argmin(axis=1)].reshape(NODES, NODES)  # where nobody was, as at the nearest node
    return Table(dataclasses.replace(task, signals=(*pair, "speed")), ratios / (1 + ratios), nodes, damping)


@dataclasses.dataclass(frozen=True)
class Tabulated:
    """A table, and what it costs.

    Attributes:
        table: the table.
        explained: share of the variance of the agent's answers that its two signals explain.
        factors: by which it is sharpened, by speed.
        evaluations: of "agent" and "table", over the same roads.
        loss: cost of the table over that of the agent, on average over the operating points, with its interval.
    """

    table: Table
    explained: float
    factors: tuple[float, ...]
    evaluations: Mapping[str, Evaluation]
    loss: Share


def loss(table: Evaluation, agent: Evaluation, points: slice = slice(None)) -> Share:
    """Cost of the table over that of the agent, on average over operating points."""
    freedom = min(table.degrees_of_freedom, agent.degrees_of_freedom)
    return ratio(table.adjusted_costs[points, None], agent.adjusted_costs[points], freedom)


def tabulate(
    agent: Agent,
    *,
    speeds: Sequence[float],
    bandwidths: Sequence[float] = (),
    signals: Sequence[str] | None = None,
    episodes: int = 256,
    seed: int = 0,
    report: Report | None = None,
) -> Tabulated:
    """The table of an agent, driven beside it.

    Args:
        agent: the agent.
        speeds, bandwidths: operating points, m/s and 1. The table has each speed, and averages over bandwidths, which no car
            measures.
        signals: two signals of the car; by default those that explain most of the agent's answers.
        episodes: of the evaluation, at each operating point.
        seed: of the roads.
        report: as of `agents.evaluate`.

    Raises:
        ParameterError: signals that the car does not have, and what `agents.evaluate` refuses.
    """
    task, speeds = agent.task, sorted(set(speeds))
    infinite = divergent_terms(task.car, task.road, task.speed_noise)
    known = [name for name in task.car.mean_squares if name not in infinite]
    names = known if signals is None else list(signals)
    if len(set(names)) < 2 or not set(names) <= set(known) or (signals is not None and len(names) != 2):
        raise ParameterError(f"signals must be two of {', '.join(known)}, got {', '.join(names)}")
    seen, answers = drive_for_samples(agent, names, speeds, bandwidths, seed)
    pair, explained = telling(names, seen, answers)
    columns = [names.index(name) for name in pair]
    first = average(task, pair, speeds, seen[..., columns], answers)
    tried = {f"table sharpened by {factor:g}": first.sharpened(factor) for factor in FACTORS}
    driven: dict[str, Any] = {"environment": agent.description["environment"], "speeds": speeds, "bandwidths": bandwidths}
    costs = evaluate(tried, episodes=FEW, seed=stream_seed(seed, Purpose.EXPORT), report=report, **driven)
    by_speed = np.array([each.mean.reshape(len(speeds), -1) for each in costs.values()])
    best = np.array(FACTORS)[(by_speed / by_speed[0]).mean(axis=2).argmin(axis=0)]
    table = first.sharpened(best)
    both = evaluate({"agent": agent, "table": table}, episodes=episodes, seed=seed, report=report, **driven)
    return Tabulated(table, explained, tuple(best.tolist()), both, loss(both["table"], both["agent"]))


HEADER = """\
/* {name}_table: the damping ratio over {a} and {b}{of}, a table of a trained agent, by roadgym {version}.
 *
 * On average over the operating points it costs {loss.value:.4g} of what the agent costs,
 * 95 % interval {loss.low:.4g} to {loss.high:.4g}.
 * Call it every {interval:g} s with {a} in {unit_a}, {b} in {unit_b}{unit_speed}.{units}
 */
#ifndef {NAME}_TABLE_H
#define {NAME}_TABLE_H

float {name}_table(float {a}, float {b}{speed});

#endif
"""

SOURCE = """\
/* See {name}_table.h. */
#include "{name}_table.h"

#include <math.h>

{constants}

float {name}_table(float {a}, float {b}{speed})
{{
    const float measured[{count}] = {{{given}}};
{body}
}}
"""


def look_up(table: Table, observation: Value) -> Value:
    """The damping of a table for an observation of its signals, of which the speed is left out where the table has one."""
    places = []
    for nodes, x in zip((table.shares, *table.nodes), (observation[[-1]], observation[[0]], observation[[1]]), strict=True):
        if len(nodes) == 1:
            places.append(constant(0.0, "double"))
            continue
        share = (x.of_kind("double") - constant(nodes[:-1], "double")) / constant(np.diff(nodes), "double")
        places.append(clip(share, 0.0, 1.0).reduced("sum"))
    return interpolate(places, table.damping)


def table_files(result: Tabulated, name: str) -> dict[str, str]:
    """The files by their names, ``name`` first: the table as CSV, and as C99 that looks it up."""
    table, task = result.table, result.table.task
    (a, unit_a, scale_a), (b, unit_b, scale_b), (_, _, speed_unit) = signal_table(task)
    speeds = speed_unit * table.shares / (1 - table.shares)
    rows = itertools.product(speeds, table.nodes[0] * scale_a, table.nodes[1] * scale_b)
    lines = [f"speed m/s,{a} {unit_a},{b} {unit_b},damping ratio"]
    lines += [
        ",".join(f"{value:.9g}" for value in (*row, damping)) for row, damping in zip(rows, table.damping.ravel(), strict=True)
    ]
    several = len(speeds) > 1
    words: dict[str, Any] = {"name": name, "NAME": name.upper(), "a": a, "b": b, "version": roadgym.__version__}
    words |= {"speed": ", float speed", "given": f"{a}, {b}, speed"} if several else {"speed": "", "given": f"{a}, {b}"}
    seen = task if several else dataclasses.replace(task, signals=(a, b))
    printer, count = CPrinter(), len(seen.signals)
    body = printer.body([look_up(table, observe(seen, given("measured", (count,))))], "return {0}[0];")
    header = HEADER.format(
        of=" and the speed" if several else f" at {speeds[0]:.4g} m/s",
        loss=result.loss,
        unit_a=unit_a,
        unit_b=unit_b,
        unit_speed=", speed in m/s" if several else "",
        units=units(task),
        interval=task.control_interval,
        **words,
    )
    source = SOURCE.format(constants="\n".join(printer.constants.values()), count=count, body=body, **words)
    return {f"{name}_table.csv": "\n".join(lines) + "\n", f"{name}_table.h": header, f"{name}_table.c": source}


def told(result: Tabulated) -> str:
    """What the table costs, in lines."""
    table, evaluations = result.table, result.evaluations
    agent, own = evaluations["agent"], evaluations["table"]
    first, second, _ = table.task.signals
    lines = wrapped(
        f"{first} and {second} explain {100 * result.explained:.0f} % of the variance of the agent's damping; "
        f"sharpened by {', '.join(f'{factor:g}' for factor in result.factors)}"
    )
    lines.append("speed  bandwidth  best D        agent        table  table over agent")
    for k, point in enumerate(agent.points):
        best = optimum(table.task, point.speed, point.bandwidth).cost
        costs = "".join(f"{with_error(each.mean[k], each.standard_error[k]):>13}" for each in (agent, own))
        share = loss(own, agent, slice(k, k + 1))
        lines.append(f"{point.speed:5g}  {point.bandwidth:9g}  {best:6.4f}{costs}  {interval(share)}")
    return "\n".join([*lines, f"the table costs {interval(result.loss)} of the agent's costs, on average"])


def interval(share: Share) -> str:
    """A share with its 95 % interval."""
    return f"{share.value:.3f} ({share.low:.3f} to {share.high:.3f})"
