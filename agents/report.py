"""How a comparison reads: as a table of text, and as one page of HTML with everything in it."""

from __future__ import annotations

import base64
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from roadgym.installation import needs
from roadgym.task import Task

from .agent import Agent
from .evaluation import Predictor
from .features import has_lookahead
from .results import CONFIDENCE, LEAST_ROOM, Comparison, Picture, Row, Share

TEMPLATE = Path(__file__).with_name("report.html")
TITLES = {
    "agent": "agent",
    "analytic_optimum": "best constant D",
    "d_min": "D_min",
    "d_max": "D_max",
    "skyhook": "skyhook",
    "skyhook_continuous": "cont. skyhook",
    "add": "ADD",
    "mixed_skyhook_add": "mixed SH-ADD",
    "least_acceleration": "least acc.",
    "clipped_lqr": "clipped LQR",
    "one_step_lookahead": "lookahead",
    "optimal_feedback": "optimal",
}


def percent(share: Share | None) -> str:
    """A share in per cent with half its confidence interval, or n/a."""
    # adding 0 makes 0.0 of -0.0
    return "n/a" if share is None else f"{round(100 * share.value, 1) + 0:.1f} ±{50 * (share.high - share.low):.1f}%"


def above(share: Share) -> str:
    """By how much a cost is above, or below, in per cent with half its confidence interval."""
    if share.value >= 0:
        return f"{percent(share)} above"
    return f"{percent(Share(-share.value, -share.high, -share.low))} below"


def weighted(task: Task) -> str:
    """The cost in words."""
    return " + ".join((f"{weight:g} " if weight != 1 else "") + name for name, weight in task.weights_by_name.items())


def notes(comparison: Comparison) -> list[str]:
    """What the columns mean, a sentence each."""
    low, high = comparison.task.damping_range
    lines = [
        f"cost: mean square of {weighted(comparison.task)} over E Z^2, with the standard error of the last digits in brackets; "
        f"D within [{low:g}, {high:g}].",
        f"gain: share of the cost of the best constant D that is saved. Intervals are of {100 * CONFIDENCE:g} % confidence.",
    ]
    variates = comparison.configuration.get("control_variates")
    if variates:
        lines.append(adjusted_by(variates))
        away = [(row.driven_cost - row.theory) / row.driven_standard_error for row in comparison.rows if row.theory is not None]
        lines.append(
            f"As driven, without that adjustment, the {len(away)} costs of constant D in this table are within "
            f"{max(map(abs, away)):.1f} standard errors of theory."
        )
    if any(name is not None for name in comparison.references):
        kinds = " or ".join(dict.fromkeys(TITLES.get(name, name) for name in comparison.references if name is not None))
        lines.append(
            f"gap closed: share of the way from the best constant D to the best known feedback ({kinds}); over 100 % where "
            f"that is beaten, n/a where it saves less than {100 * LEAST_ROOM:g} %. The mean counts all other "
            "points alike, with negative shares too."
        )
    for name, seeds in comparison.agents.items():
        given = theory_given(seeds[0])
        if given is not None:
            lines.append(f"{name} {given}")
        lines.append(
            f"{name}: mean of {len(seeds)} training seeds."
            if len(seeds) > 1
            else f"{name}: one training seed; the intervals do not hold what another seed would change."
        )
    return lines


def columns(comparison: Comparison) -> list[tuple[str, str, list[str]]]:
    """The table as columns: title of the controller, of the column, and a cell for each operating point."""
    task, points = comparison.task, comparison.points
    found = [("nu", "", [f"{task.frequency_ratio(point.speed):g}" for point in points])]
    if task.bandwidth[1] > 0:
        found.append(("delta", "", [f"{point.bandwidth:g}" for point in points]))
    for name in comparison.controllers:
        rows = [comparison.row(name, point) for point in points]
        found.append((TITLES.get(name, name), "cost", [with_error(row.cost, row.standard_error) for row in rows]))
        if name == "analytic_optimum":
            if rows[0].theory is not None:
                found.append(("", "theory", [f"{row.theory:.4f}" for row in rows]))
            found.append(("", "D", [f"{row.damping:.3f}" for row in rows]))
        if name in comparison.agents:
            if any(comparison.references):
                found.append(("", "gap closed", [percent(row.gap_closed) for row in rows]))
            else:
                found.append(("", "gain", [percent(row.gain) for row in rows]))
    return found


def theory_given(agent: Predictor) -> str | None:
    """What a trained agent was given of theory, in words; None of what was not trained here."""
    if not isinstance(agent, Agent):
        return None
    reward = {
        "advantage": "theory's advantage over the best constant damping, made from the full state whatever it observes",
        "cost": "the cost",
    }.get(agent.description.get("training_reward", ""))
    if reward is None:  # of an agent that was trained before this was noted
        return None
    lookahead = has_lookahead(agent.task, agent.description["hyperparameters"].get("features", ()))
    return f"learned from {reward}, {'with' if lookahead else 'without'} theory's one-step lookahead among its features."


def adjusted_by(control_variates: Sequence[float]) -> str:
    """What the control variates are, in a sentence."""
    dampings = ", ".join(f"{damping:.2g}" for damping in control_variates)
    if len(control_variates) == 1:
        return f"A constant damping on the same roads, whose cost theory knows, serves as control variate: D = {dampings}."
    return f"Constant dampings on the same roads, whose costs theory knows, serve as control variates: D = {dampings}."


def mean_gap_closed(comparison: Comparison, name: str) -> str:
    """The mean share of the gap that a learned controller closes, what it is over, and what is left out, in words."""
    gap = comparison.mean_gaps[name]
    total, left = len(gap.points) + len(gap.left_out), len(gap.left_out)
    text = f"{name}: no operating point has a gap to close."
    if gap.closed is not None:
        over = (
            f"all {total} operating points" if not left else f"the {len(gap.points)} of {total} operating points that have one"
        )
        text = f"{name} closes {percent(gap.closed)} of the gap on average over {over}."
    if gap.loss is not None and gap.largest_loss is not None and gap.largest_at is not None:
        place = f"nu = {comparison.task.frequency_ratio(gap.largest_at.speed):g}"
        place += f", delta = {gap.largest_at.bandwidth:g}" if gap.largest_at.bandwidth else ""
        text += (
            f" Where there is none ({left} of {total} points), its cost is {above(gap.loss)} that of the best constant D on "
            f"average, {above(gap.largest_loss)} at worst ({place})."
        )
    return text


def table(comparison: Comparison) -> str:
    """The comparison as text: one line an operating point, costs with the standard error of their last digits in brackets."""
    found = columns(comparison)
    head, under = [title for title, _, _ in found], [label for _, label, _ in found]
    lines = [head, under, *(list(cells) for cells in zip(*(cells for _, _, cells in found), strict=True))]
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    # a title may reach into the columns that belong to it
    for i, title in enumerate(head):
        if title and i + 1 < len(head) and not head[i + 1]:
            widths[i] = max(len(line[i]) for line in lines[1:])
    text = []
    for number, line in enumerate(lines):
        if number == 0:
            text.append(_title_line(head, widths))
        else:
            text.append("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)).rstrip())
        if number == 1:
            text.append("-" * max(map(len, text)))
    text.append("")
    text += [mean_gap_closed(comparison, name) for name in comparison.mean_gaps]
    return "\n".join([*text, *notes(comparison)])


def _title_line(head: Sequence[str], widths: Sequence[int]) -> str:
    """Titles, each right-aligned over its own column and the untitled ones after it."""
    cells, i = [], 0
    while i < len(head):
        j = i + 1
        while j < len(head) and not head[j]:
            j += 1
        cells.append(head[i].center(sum(widths[i:j]) + 2 * (j - i - 1)) if j > i + 1 else head[i].rjust(widths[i]))
        i = j
    return "  ".join(cells).rstrip()


def with_error(value: float, error: float) -> str:
    """``value`` with the standard error of its last digits in brackets: 0.2561(12) is 0.2561 ± 0.0012."""
    if not np.isfinite(error) or error <= 0:
        return f"{value:.4f}"
    digits = min(max(1 - int(np.floor(np.log10(error))), 0), 6)
    return f"{value:.{digits}f}({round(error * 10**digits)})"


@dataclasses.dataclass(frozen=True)
class Group:
    """All controllers at one operating point."""

    heading: str
    rows: list[dict[str, Any]]


def _cells(comparison: Comparison, row: Row) -> dict[str, Any]:
    return {
        "name": TITLES.get(row.controller, row.controller),
        "learned": row.controller in comparison.agents,
        "cost": with_error(row.cost, row.standard_error),
        "theory": "" if row.theory is None else f"{row.theory:.4f}",
        "damping": "" if row.damping is None else f"{row.damping:.3f}",
        "gain": percent(row.gain),
        "gap": percent(row.gap_closed),
        "switches": f"{row.switches:.2f}",
        "squares": [f"{value:.4g}" for value in row.squares.values()],
    }


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
    groups = []
    for point in comparison.points:
        heading = f"ν = {task.frequency_ratio(point.speed):g}" + (f", δ = {point.bandwidth:g}" if point.bandwidth else "")
        rows = [comparison.row(name, point) for name in comparison.controllers]
        groups.append(Group(heading, [_cells(comparison, row) for row in rows]))
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(
        cost=weighted(task),
        means=[mean_gap_closed(comparison, name) for name in comparison.mean_gaps],
        groups=groups,
        squares=list(comparison.rows[0].squares),
        notes=notes(comparison),
        pictures=[
            {"data": base64.b64encode(picture.path.read_bytes()).decode(), "caption": picture.caption} for picture in pictures
        ],
        configuration=yaml.safe_dump(_configuration(comparison), sort_keys=False, allow_unicode=True, default_flow_style=None),
        versions=comparison.configuration["versions"],
        written=comparison.configuration["written"],
    )
