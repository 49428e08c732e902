"""A certificate: figures of a simulation beside those that theory expects, with a verdict on each, as a table and as JSON."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import textwrap
from collections.abc import Sequence
from typing import Any

FALSE_ALARM_RATE = 1e-3  # probability, at most, that a sound plant does not pass
ROAD_TOLERANCE = 1e-3  # what rounding and tables may move the figures of a road that is exact in law
CAR_TOLERANCE = 5e-3  # what the car's scheme promises
WIDTH = 80  # columns of the table
SHORTER = {  # names of lines in the table
    r"^spectral density at ": "PSD, ",
    r", Kolmogorov-Smirnov distance$": " (KS distance)",
    r"^law at double against half speed": "law, 2 v against v/2",
    r"^mean square of the (.*) \(": r"\1, constant (",
    r"^balance of (.*) with (?:D )?(.*) \(1\)$": r"balance, \1, \2",
    r"^(power of the damper .*) with (?:D )?": r"\1, ",
    r" with (?:D )?(alternating|skyhook|the controller) \(": r", \1 (",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Line:
    """One figure of a certificate.

    Attributes:
        name: what it is, with its unit.
        measured: the figure of the simulation.
        expected: that of theory; of a Kolmogorov-Smirnov distance, its mean on a sound plant; of a bound, the bound.
        standard_error: of measured less expected, from independent lanes; None for a bound, which is exact. On an ellipse the
            expected figure has an error too, that of the road's variance.
        tolerance: relative bias that a sound plant may have; of a balance, over the sum of its terms.
        distance: measured less expected, in standard errors; None for a bound.
        p_value: probability of at least this distance, in either direction, on a plant whose bias is the tolerance (of a
            Kolmogorov-Smirnov distance: on a sound plant); None for a bound.
        passed: the verdict.
    """

    name: str
    measured: float
    expected: float
    standard_error: float | None = None
    tolerance: float = 0.0
    distance: float | None = None
    p_value: float | None = None
    passed: bool

    def figures(self) -> dict[str, Any]:
        """The line by name for JSON, None in place of what is not finite."""
        return {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in dataclasses.asdict(self).items()
        }


def table_of(lines: Sequence[Line]) -> list[str]:
    """A table of lines with its head, as lines of `WIDTH` columns, with shorter names."""
    rows = [("", "measured", "expected", "error", "p", ""), *(_cells(line) for line in lines)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    room = min(widths[0], WIDTH - sum(2 + width for width in widths[1:]))
    text = []
    for name, *cells in rows:
        *above, last = textwrap.wrap(name, room, subsequent_indent="  ") or [""]
        padded = (cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True))
        text += [*above, "  ".join([last.ljust(room), *padded]).rstrip()]
    return text


def judged(name: str, measured: float, expected: float, error: float, tolerance: float, unit: float | None = None) -> Line:
    """A figure against what is expected, whose difference has the standard ``error``; the verdict is still to come.

    A sound plant may be off by ``tolerance`` times ``unit``, by default times what is expected.
    """
    from scipy.stats import norm

    difference, allowed = measured - expected, tolerance * (expected if unit is None else unit)
    return Line(
        name=name,
        measured=measured,
        expected=expected,
        standard_error=error,
        tolerance=tolerance,
        distance=difference / error,
        p_value=float(norm.sf((abs(difference) - allowed) / error) + norm.sf((abs(difference) + allowed) / error)),
        passed=False,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Certificate:
    """All lines of one plant.

    Attributes:
        plant: road and speed noise, in words.
        drive: how the plant was driven, in words.
        significance: p-value below which a line fails.
        lines: the figures.
        left_out: what has no closed form on this plant, and why.
    """

    plant: str
    drive: str
    significance: float
    lines: tuple[Line, ...]
    left_out: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Does every line pass?"""
        return all(line.passed for line in self.lines)

    def table(self) -> str:
        """The certificate as text of `WIDTH` columns, with shorter names of the lines."""
        text = [*wrapped(self.plant), *wrapped(self.drive), "", *table_of(self.lines)]
        failed = sum(not line.passed for line in self.lines)
        text += [
            "",
            f"{len(self.lines)} lines, {failed or 'none'} failed: the plant is {'NOT ' if failed else ''}certified",
            *wrapped(
                "error: standard error of measured less expected, from independent lanes. p: p-value, which allows for a bias "
                f"of {100 * ROAD_TOLERANCE:g} % of the road and {100 * CAR_TOLERANCE:g} % of the car. A line fails where it is "
                f"below {self.significance:.2g}; a sound plant fails any with a probability of at most {FALSE_ALARM_RATE:g}. "
                "PSD: power spectral density. KS: Kolmogorov-Smirnov. Mean squares are those of constant D, of D alternating "
                "between two levels, and of the skyhook rule. A balance is what changes the mean of a product, over the sum of "
                "its terms."
            ),
        ]
        return "\n".join([*text, *(line for reason in self.left_out for line in wrapped(f"Left out: {reason}."))])

    def to_json(self) -> str:
        """The certificate as JSON; null for figures that a line does not have, or that are not finite."""
        data = dataclasses.asdict(self) | {"passed": self.passed, "lines": [line.figures() for line in self.lines]}
        return json.dumps(data, indent=2)


def wrapped(text: str) -> list[str]:
    """The text in lines of `WIDTH` columns."""
    return textwrap.wrap(text, WIDTH, subsequent_indent="  ", break_on_hyphens=False)


def _cells(line: Line) -> tuple[str, ...]:
    """A row of the table."""
    name, errors = line.name, ("exact", "")
    for pattern, shorter in SHORTER.items():
        name = re.sub(pattern, shorter, name)
    if line.standard_error is not None and line.p_value is not None:
        errors = (f"{line.standard_error:.2g}", f"{line.p_value:.2g}")
    return name, f"{line.measured:.5g}", f"{line.expected:.5g}", *errors, "pass" if line.passed else "FAIL"
