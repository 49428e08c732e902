"""How a comparison reads: as tables of text, and as one page of HTML with everything in it."""

from __future__ import annotations

import base64
import inspect
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from roadgym.installation import needs

from .agent import Agent
from .certified import bound_cell, bound_notes, mean_share_certified
from .controllers import CONTROLLERS
from .evaluation import Predictor
from .features import has_lookahead
from .names import CONTROLLERS_SHOWN, FILTERED, title
from .numerals import above, aligned, as_exact_as, percent, with_error
from .results import CONFIDENCE, LEAST_ROOM, Comparison, Picture, Row
from .units import KILOMETRES_PER_HOUR, column, in_si, place, root, shown, unit
from .units import weighted as weighted

TEMPLATE = Path(__file__).with_name("report.html")
WIDTH = 80  # columns of the table of text


def notes(comparison: Comparison) -> list[tuple[str, str]]:
    """What is in the tables, in order: a term, and a sentence on it."""
    low, high = comparison.task.damping_range
    task, found = comparison.task, []
    if not in_si(task):
        what = (
            "frequency ratio, the speed in units of natural frequency over wavenumber: at 1 the road's waves excite resonance."
        )
        found.append(("nu", what))
    if comparison.task.bandwidth[1] > 0:
        found.append(("delta", "bandwidth of the road: near 0 it is a sine, the larger the less regular."))
    found += [
        ("D", f"damping ratio of the car, within [{low:.3g}, {high:.3g}]; what a controller sets."),
        (
            "cost",
            f"mean square of {weighted(task)}{'' if in_si(task) else ' over that of the road, E Z^2'}; in brackets the "
            "standard error of the last digits.",
        ),
    ]
    if any(row.theory is not None for row in comparison.rows):
        found.append(("theory", "the exact cost of a constant D."))
    if any(name is not None for name in comparison.references):
        kinds = " or ".join(dict.fromkeys(title(name) for name in comparison.references if name is not None))
        found.append(
            (
                "gap closed",
                f"share of the way from the best constant D to the best known feedback, {kinds}, with its "
                f"{100 * CONFIDENCE:g} % interval; over 100 % where that is beaten, n/a where it saves less than "
                f"{100 * LEAST_ROOM:g} %. The mean counts all other points alike, with negative shares too.",
            )
        )
        if any(row.worst_seed is not None for row in comparison.rows):
            found.append(("worst seed", "the gap that the training seed closes that closes least there, likewise."))
    else:
        found.append(("gain", f"share of the best constant D's cost that is saved, with its {100 * CONFIDENCE:g} % interval."))
    found += bound_notes(comparison)
    if task.sensors is not None and "optimal_feedback" in comparison.controllers:
        found.append((title("optimal_feedback"), "full knowledge: it sees the state itself; all others see through sensors."))
    if measured := comparison.configuration.get("measured"):
        what = f"drives by the mean of a Kalman filter, to which sensors tell {', '.join(measured)}."
        found.append((FILTERED.removeprefix(", "), what))
    if not task.ideal_valve:
        theory = "the best constant D, theory and the optimal feedback are those of an ideal valve; driven, all have this one."
        found.append(("valve", theory))
    if task.vary is not None:
        fields = ", ".join(f"{name} within {low:g} to {high:g}" for name, low, high in task.vary.ranges)
        theory = (
            "the best constant D, rules and the optimal feedback know the nominal car alone; theory tells nothing of the mean."
        )
        found.append(("cars", f"each episode has its own, {fields}, the same for every controller; {theory}"))
    for name, chosen in comparison.configuration.get("parameters", {}).items():
        values = ", ".join(f"{parameter} = {value:g}" for parameter, value in chosen.items())
        found.append((title(name), f"{values}, which cost least of those tried in the middle of the plant's range."))
    for name, seeds in comparison.agents.items():
        given = theory_given(seeds[0])
        training = (
            f"Mean of {len(seeds)} training seeds."
            if len(seeds) > 1
            else "One training seed; the intervals do not hold what another seed would change."
        )
        found.append((name, " ".join([*([given] if given else []), training])))
    variates, balances = (comparison.configuration.get(name, ()) for name in ("control_variates", "balances"))
    if variates:
        away = [(row.driven_cost - row.theory) / row.driven_standard_error for row in comparison.rows if row.theory is not None]
        known = "the one cost of constant D is" if len(away) == 1 else f"the {len(away)} costs of constant D are"
        found.append(
            (
                "less noise",
                f"{adjusted_by(variates, balances)} As driven, without that adjustment, {known} within "
                f"{max(map(abs, away)):.1f} standard errors of theory.",
            )
        )
    return found


def blocks(comparison: Comparison) -> list[tuple[str, list[tuple[str, list[str]]]]]:
    """What the table shows: a title, and under it columns of a label and a cell for each operating point.

    The operating points come first, then what the comparison is about: learned controllers, the best constant damping, and the
    optimal feedback.
    """
    task, points = comparison.task, comparison.points
    speeds = {"m/s": 1.0, "km/h": KILOMETRES_PER_HOUR} if in_si(task) else {"nu": float(task.frequency_ratio(1.0))}
    where = [(head, [f"{factor * point.speed:g}" for point in points]) for head, factor in speeds.items()]
    if task.bandwidth[1] > 0:
        where.append(("delta", [f"{point.bandwidth:g}" for point in points]))
    found = [("", where)]
    first = [*comparison.agents, "analytic_optimum", "optimal_feedback"]
    for name in sorted(comparison.controllers, key=lambda name: first.index(name) if name in first else len(first)):
        rows = [comparison.row(name, point) for point in points]
        under = [("cost", [with_error(row.cost, row.standard_error) for row in rows])]
        if name == "analytic_optimum":
            if rows[0].theory is not None:
                under.insert(0, ("theory", [_theory(row) for row in rows]))
            under.insert(0, ("D", [f"{row.damping:.3f}" for row in rows]))
        if name in comparison.agents or name.endswith(FILTERED):
            closed = any(comparison.references)
            share = [percent(row.gap_closed if closed else row.gain) for row in rows]
            under.append(("gap closed" if closed else "gain", share))
            if any(row.worst_seed is not None for row in rows):
                under.append(("worst seed", [percent(row.worst_seed) for row in rows]))
        if name in comparison.mean_certified and comparison.bounded:
            under.append(("certified", [percent(row.certified) for row in rows]))
        found.append((title(name), under))
    if comparison.bounded:
        optima = (comparison.row("analytic_optimum", point) for point in points)
        cells = [bound_cell(bound, row) for bound, row in zip(comparison.bounds, optima, strict=True)]
        found.insert(1 + sum(name in first for name in comparison.controllers), ("lower bound", [("cost", cells)]))
    return found


def theory_given(agent: Predictor) -> str | None:
    """What a trained agent was given of theory, in words; None of what was not trained here."""
    if not isinstance(agent, Agent):
        return None
    reward = {
        "advantage": "theory's advantage over the best constant damping, made from the full state whatever it observes",
        "cost": "the cost",
        "gradient": "the cost, differentiated through the plant, with theory's value of what comes after",
    }.get(agent.description.get("training_reward", ""))
    if reward is None:  # of an agent that was trained before this was noted
        return None
    hyperparameters = agent.description["hyperparameters"]
    lookahead = has_lookahead(agent.seen, hyperparameters.get("features", ()))
    if hyperparameters.get("wrappers"):
        reward += f", as changed by {' and '.join(hyperparameters['wrappers'])}"
    sees = "" if agent.filter is None else f"drives by a Kalman filter of {', '.join(agent.filter.measured)}; "
    if told := agent.description.get("filter_told"):
        reward += f", where the filter was told {' and '.join(told)}"
    return f"{sees}learned from {reward}, {'with' if lookahead else 'without'} theory's one-step lookahead among its features."


def adjusted_by(control_variates: Sequence[float], balances: Sequence[str] = ()) -> str:
    """What the control variates are, in a sentence or two."""
    dampings = ", ".join(f"{damping:.2g}" for damping in control_variates)
    more = " So do balances of the drive itself, which every rule must keep." if balances else ""
    if len(control_variates) == 1:
        return (
            f"A constant damping on the same roads, whose cost theory knows, serves as control variate: D = {dampings}.{more}"
        )
    return f"Constant dampings on the same roads, whose costs theory knows, serve as control variates: D = {dampings}.{more}"


def mean_gap_closed(comparison: Comparison, name: str) -> str:
    """The mean share of the gap that a learned controller closes, what it is over, and what is left out, in words."""
    gap = comparison.mean_gaps[name]
    total, left = len(gap.points) + len(gap.left_out), len(gap.left_out)
    text = f"{name}: no operating point has a gap to close."
    if gap.closed is not None:
        have = "has" if len(gap.points) == 1 else "have"
        over = f"the {len(gap.points)} of {total} operating points that {have} one" if left else f"all {total} operating points"
        over = "at the one operating point" if total == 1 else f"on average over {over}"
        closes = f"closes {percent(gap.closed)} of the gap"
        if gap.closed.value < 0:
            closes = f"closes none of the gap ({percent(gap.closed)})"
        kinds = {name for name in comparison.references if name is not None}
        best = "optimal feedback" if kinds == {"optimal_feedback"} else "best known feedback"
        text = f"{name} {closes} from the best constant D to the {best}, {over}."
    if gap.worst_seed is not None and gap.least is not None and gap.least_at is not None:
        text += f" The worst of its training seeds closes {percent(gap.worst_seed)}"
        where = place(comparison.task, gap.least_at)
        text += "." if total == 1 else f" on average, and none less than {percent(gap.least)} anywhere ({where})."
    if gap.loss is not None and gap.largest_loss is not None and gap.largest_at is not None:
        worst = place(comparison.task, gap.largest_at)
        where = "Its" if total == 1 else f"Where there is none ({left} of {total} points), its"
        text += f" {where} cost is {above(gap.loss)} that of the best constant D"
        text += f" ({worst})." if left == 1 else f" on average, {above(gap.largest_loss)} at worst ({worst})."
    return text


def means(comparison: Comparison) -> list[str]:
    """What the comparison comes to, in sentences."""
    certified = [mean_share_certified(comparison, name) for name in comparison.mean_certified]
    gaps = [mean_gap_closed(comparison, name) for name in comparison.mean_gaps]
    return [*gaps, *(sentence for sentence in certified if sentence is not None)]


def table(comparison: Comparison) -> str:
    """The comparison as text of `WIDTH` columns: tables one under the other, a line an operating point, and what they show."""
    where, *rest = (_laid_out(name, columns) for name, columns in blocks(comparison))
    tables = [[where]]
    for block in rest:
        if sum(len(part[0]) + 2 for part in tables[-1]) + len(block[0]) > WIDTH and len(tables[-1]) > 1:
            tables.append([where])
        tables[-1].append(block)
    text = []
    for blocks_beside in tables:
        high = max(map(len, blocks_beside))
        whole = [[" " * len(block[0])] * (high - len(block)) + block for block in blocks_beside]
        lines = ["  ".join(parts).rstrip() for parts in zip(*whole, strict=True)]
        lines.insert(len(lines) - len(comparison.points), "-" * max(map(len, lines)))
        text += [*lines, ""]
    if in_si(comparison.task):
        text += [*_roots(comparison), ""]
    said = means(comparison)
    shares = [] if comparison.agents else ["gap closed", "gain"]  # columns that are on the page alone
    if comparison.bounded and not comparison.mean_certified:
        shares.append("certified")
    said += [f"{term}: {sentence}" for term, sentence in notes(comparison) if term not in shares]
    return "\n".join(text + [textwrap.fill(line, WIDTH, subsequent_indent="  ", break_on_hyphens=False) for line in said])


def _roots(comparison: Comparison) -> list[str]:
    """Lines of a table of root mean squares at the middle operating point, a controller a line, in as many columns as fit."""
    task, point = comparison.task, comparison.points[len(comparison.points) // 2]
    rows = [comparison.row(name, point) for name in comparison.controllers]
    columns = [["", "", *(title(row.controller) for row in rows)]]
    for name in shown(task):
        cells = column([root(task, name, row.squares[name]) for row in rows])
        columns.append([name.replace("_", " ").replace("acceleration", "accel."), unit(task, name)[0], *cells])
    widths = [max(map(len, column)) for column in columns]
    while sum(widths) + 2 * (len(widths) - 1) > WIDTH and len(widths) > 2:
        del columns[-1], widths[-1]
    lines = [
        "  ".join([first.ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(rest, widths[1:], strict=True))]).rstrip()
        for first, *rest in zip(*columns, strict=True)
    ]
    return [f"root mean squares at {place(task, point)}", "", *lines[:2], "-" * max(map(len, lines)), *lines[2:]]


def _laid_out(name: str, columns: Sequence[tuple[str, Sequence[str]]]) -> list[str]:
    """A block as lines of one width: its title in as many lines as that takes, the labels, and the cells."""
    cells = [aligned(cells) for _, cells in columns]
    labels = [label for label, _ in columns]
    cells = [[cell.rjust(len(label)) for cell in column] for label, column in zip(labels, cells, strict=True)]
    body = ["  ".join(line) for line in zip(*cells, strict=True)]
    under = "  ".join(label.rjust(len(column[0])) for label, column in zip(labels, cells, strict=True))
    width = max(len(under), *map(len, name.split())) if name and len(columns) == 1 else len(under)
    head = textwrap.wrap(name, width) if name else []
    place = str.rjust if len(columns) == 1 else str.center
    return [*(place(line, width) for line in head), *(line.rjust(width) for line in [under, *body])]


def _theory(row: Row) -> str:
    """The exact cost, with no fewer decimals than the cost as driven has; nothing where there is none."""
    return "" if row.theory is None else as_exact_as(row.theory, row.cost, row.standard_error)


def _tables(comparison: Comparison) -> list[dict[str, Any]]:
    """The two tables of the page, costs and mean squares: heads, and for each operating point rows of aligned cells."""
    task, rows = comparison.task, comparison.rows
    closed = any(comparison.references)
    costs = {"cost": [with_error(row.cost, row.standard_error) for row in rows]}
    if any(row.theory is not None for row in rows):
        costs["theory"] = [_theory(row) for row in rows]
    if closed:
        costs["gap closed"] = [percent(row.gap_closed) for row in rows]
        if any(row.worst_seed is not None for row in rows):
            costs["worst seed"] = ["" if row.worst_seed is None else percent(row.worst_seed) for row in rows]
    else:
        costs["gain"] = [percent(row.gain) for row in rows]
    if comparison.bounded:
        costs["certified"] = [percent(row.certified) for row in rows]
        optima = [comparison.row("analytic_optimum", point) for point in comparison.points]
        bounds = [bound_cell(bound, row) for bound, row in zip(comparison.bounds, optima, strict=True)]
        costs = {head: cells + (bounds if head == "cost" else [""] * len(bounds)) for head, cells in costs.items()}
    squares = {"switches": [f"{row.switches:.2f}" for row in rows]}
    for name in rows[0].squares:
        head, values = name.replace("_", " "), [row.squares[name] for row in rows]
        if in_si(task):
            head, values = f"{head}, {unit(task, name)[0]}", [root(task, name, value) for value in values]
        told = [f"{value:.4f}" if np.isfinite(value) else "infinite" for value in values]
        squares[head] = column(values) if in_si(task) else told
    found = []
    for columns in (costs, squares):
        cells = list(zip(*map(aligned, columns.values()), strict=True))
        groups = []
        for point in comparison.points:
            heading = place(task, point).replace("nu", "ν").replace("delta", "δ")
            if in_si(task):
                heading += f", {KILOMETRES_PER_HOUR * point.speed:.3g} km/h"
            lines = [
                {
                    "name": title(row.controller) + ("" if row.damping is None else f" = {row.damping:.3g}"),
                    "learned": row.controller in comparison.agents,
                    "cells": cells[number],
                }
                for number, row in enumerate(rows)
                if row.point == point
            ]
            # after those of the rows come the cells of the lower bounds, if there are any
            for number in range(len(rows), len(cells)):
                if comparison.points[number - len(rows)] == point:
                    lines.append({"name": "lower bound", "learned": False, "cells": cells[number]})
            groups.append({"heading": heading, "rows": lines})
        found.append({"heads": list(columns), "groups": groups})
    return found


def _controllers(comparison: Comparison) -> list[tuple[str, str, str]]:
    """(name shown, name in commands and files or nothing, what it does) of each controller."""
    found = []
    for name in comparison.controllers:
        learned = name in comparison.agents
        meaning = CONTROLLERS_SHOWN["agent" if learned else name][1] if learned or name in CONTROLLERS_SHOWN else ""
        if not meaning and name in CONTROLLERS:  # somebody's own
            meaning = (inspect.getdoc(CONTROLLERS[name]) or "").partition("\n")[0]
        found.append((title(name), "" if learned else name, meaning))
    return found


def _configuration(comparison: Comparison) -> dict[str, Any]:
    """What made the comparison; of agents that differ in the seed alone, what they have in common once."""
    chosen = {name: value for name, value in comparison.configuration.items() if name not in ("versions", "written", "agents")}
    chosen["agents"] = {}
    for name, descriptions in comparison.configuration["agents"].items():
        first = descriptions[0] or {}
        common = {key: first[key] for key in ("algorithm", "environment", "hyperparameters", "training_reward") if key in first}
        own = [{key: each[key] for key in ("seed", "timesteps", "command", "saved")} for each in descriptions if each]
        chosen["agents"][name] = {**common, "training": own}
    return chosen


def make_report(comparison: Comparison, pictures: Sequence[Picture]) -> str:
    """The page, for a browser or for print; it asks the network for nothing."""
    with needs("report"):
        import jinja2
        import yaml
    task = comparison.task
    greek = {"nu": "ν", "delta": "δ"}
    drawn = [
        {
            "data": _encoded(picture.path),
            "narrow": None if picture.narrow is None else _encoded(picture.narrow),
            "caption": picture.caption,
        }
        for picture in pictures
    ]
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    costs, squares = _tables(comparison)
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        cost=weighted(task),
        in_si=in_si(task),
        displacement_alone=list(task.reward_by_name.items()) == [("displacement", 1.0)],
        means=means(comparison),
        controllers=_controllers(comparison),
        points=len(comparison.points),
        episodes=comparison.configuration["episodes"],
        costs=costs,
        squares=squares,
        notes=[(greek.get(term, term), sentence.replace("E Z^2", "E\u00a0Z²")) for term, sentence in notes(comparison)],
        pictures=drawn,
        configuration=yaml.safe_dump(_configuration(comparison), sort_keys=False, allow_unicode=True, default_flow_style=None),
        versions=comparison.configuration["versions"],
        written=comparison.configuration["written"],
    )


def _encoded(path: Path) -> str:
    return base64.b64encode(path.read_bytes()).decode()
