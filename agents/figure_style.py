"""What the pictures of a comparison have in common: colours and marks, axes, and how they are written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from roadgym.files import whole_file
from roadgym.installation import needs
from roadgym.task import Task

from .results import Comparison
from .units import in_si

with needs("report"):
    from matplotlib.axis import Axis
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

# Okabe and Ito's colours, told apart by readers with any colour vision, each with a mark of its own
STYLES: dict[str, dict[str, Any]] = {
    "analytic_optimum": {"color": "#0072B2", "marker": "s"},
    "d_min": {"color": "#999999", "marker": "v"},
    "d_max": {"color": "#000000", "marker": "^"},
    "skyhook": {"color": "#009E73", "marker": "D"},
    "one_step_lookahead": {"color": "#CC79A7", "marker": "P"},
    "optimal_feedback": {"color": "#E69F00", "marker": "*", "markersize": 9},
}
LEARNED = ("#D55E00", "#56B4E9", "#882255", "#117733")
OTHERS = ("x", "+", "1", "2", "3", "4", "|")
Report = Callable[[str, int, int], None]


def style(comparison: Comparison, name: str) -> dict[str, Any]:
    """Colour and mark of a controller, for `matplotlib.axes.Axes.errorbar`."""
    if name in comparison.agents:
        number = list(comparison.agents).index(name)
        return {"color": LEARNED[number % len(LEARNED)], "marker": "o", "zorder": 5}
    if name in STYLES:
        return STYLES[name]
    others = [other for other in comparison.controllers if other not in STYLES and other not in comparison.agents]
    return {"color": "#666666", "marker": OTHERS[others.index(name) % len(OTHERS)]}


def save_figure(figure: Figure, path: Path) -> None:
    """Write the figure whole or not at all."""
    FigureCanvasAgg(figure)
    with whole_file(path) as part:
        figure.savefig(part, dpi=150)


def plain_ticks(axis: Axis) -> None:
    """Numbers as they are on a logarithmic axis."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def speed_label(task: Task) -> str:
    """Of an axis of `agents.units.abscissa`."""
    return "speed, km/h" if in_si(task) else "frequency ratio $\\nu = v\\Omega/\\omega_1$"
