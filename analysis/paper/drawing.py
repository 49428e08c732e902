"""What the figures share: colours and line styles, panels, and what a figure hands over."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy.typing as npt

from roadgym.installation import needs

with needs("report"):
    from matplotlib.figure import Figure

# M. Okabe and K. Ito's colours, told apart by readers with any colour vision, each with a line style of its own
BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILION, PURPLE = (
    *("#000000", "#E69F00", "#56B4E9", "#009E73"),
    *("#F0E442", "#0072B2", "#D55E00", "#CC79A7"),
)
SERIES: tuple[tuple[str, Any], ...] = (
    (BLACK, "-"),
    (BLUE, (0, (6, 1.5))),
    (VERMILION, "-."),
    (GREEN, (0, (3, 1))),
    (ORANGE, (0, (8, 1.5, 1, 1.5))),
    (PURPLE, (0, (5, 1, 1, 1, 1, 1))),
    (SKY, (0, (1, 0.8))),
    ("#7F7F7F", "--"),
)
STABLE = "corrected: stable, almost surely and\nin mean, at every noise for $D > 0$"
PRINTED: Any = (0, (3, 1.6))
SPEED_LABEL = "frequency ratio $\\nu = v\\Omega/\\omega_1$"
AMPLITUDE_LABEL = "mean amplitude $V_m/\\mu = |E\\,C|/\\mu$"
STYLE = {"linewidth": 1.5}

Table = Mapping[str, npt.ArrayLike]
Report = Callable[[str, int, int], None]


@dataclasses.dataclass(frozen=True)
class Drawing:
    """A picture, and what is drawn in it.

    Attributes:
        figure: the picture.
        tables: columns of equal length by name, with unit; one table or several, by what they are ("" for the only one).
    """

    figure: Figure
    tables: Mapping[str, Table]


def panels(columns: int = 1, rows: int = 1, width: float = 5.6, height: float = 3.8, **options: Any) -> tuple[Figure, Any]:
    """A figure and its axes, shape (rows, columns); in inches the ``width`` of a single column and the ``height`` of a row."""
    figure = Figure(figsize=(width if columns == 1 else 4.4 * columns, height * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    for axis in axes.flat:
        axis.grid(visible=True, linewidth=0.3)
    return figure, axes
