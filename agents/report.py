"""The report of a comparison: one page of HTML with everything in it."""

from __future__ import annotations

import base64
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jinja2
import yaml

from .comparison import TITLES, Comparison, Row, mean_gap_closed, notes, percent, weighted, with_error
from .figures import Picture

TEMPLATE = Path(__file__).with_name("report.html")


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
