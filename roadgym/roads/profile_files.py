"""Measured profiles of roads from files: heights over the distance, evenly spaced, in metres.

Three formats are told apart by what a file begins with, whatever its name:

- a table of numbers (CSV): distance and height in two columns, between commas, semicolons, tabs or blanks, with a header or
  without; beside another separator a comma is a decimal point;
- ERD, by which profilers exchange their data, in text form; see `roadgym.roads.profile_formats`;
- OpenCRG, one long section of the grid; likewise.

Heights and distances are in metres unless a header tells their units, as in "height [mm]", or ``units`` does. Where nobody
tells, heights that no road has are taken for another unit, and refused: the steps of a road of class H of ISO 8608 have an rms
of 0.23 m^(1/2) times the root of the spacing, and those of a smooth road that is told in millimetres one above `ROUGHEST`.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TextIO

import numpy as np
import numpy.typing as npt

from ..parameters import RANGES, ParameterError, shown, whole
from . import profile_formats
from .profile_formats import HEIGHT_UNITS, METRES, Table

ROUGHEST = 0.5  # rms of the steps of the heights over the root of their spacing, m^(1/2), that is believed without a unit
UNEVEN = 0.05  # of a step, by which distances may be off even ones: files round them
HEADER_LINES = 50  # before the numbers, at most
SAMPLE = 65536  # bytes by which the format is told
SEPARATORS = (";", "\t", ",", None)  # None: any blanks


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Profile:
    """Heights over the distance, evenly spaced.

    Attributes:
        distance: m, shape (n,).
        heights: m, shape (n,).
    """

    distance: npt.NDArray[np.float64]
    heights: npt.NDArray[np.float64]

    @property
    def spacing(self) -> float:
        """Distance between two points, m."""
        return float((self.distance[-1] - self.distance[0]) / (len(self.distance) - 1))


def read_profile(
    path: str | os.PathLike[str], units: str | Sequence[str] | None = None, *, column: int | None = None
) -> Profile:
    """A profile from a file; see the module's docstring for the formats.

    Args:
        path: the file.
        units: of the heights, one of `roadgym.roads.profile_formats.HEIGHT_UNITS`, or of distances and heights, a pair, where
            distances may be in "km" too; in place of what the file tells. By default that, or metres.
        column: which heights, from 1: of a table, its column after that of the distances, of ERD its channel, of OpenCRG its
            long section. By default the only one of a table, the first channel, and the section nearest the reference line.

    Raises:
        ParameterError: a file that cannot be read as a profile: what is wrong, and where.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise ParameterError(f"path must name a file, got {shown(path)}")
    name = f"profile {os.fspath(path)!r}"
    distance_unit, height_unit = _units(units)
    if column is not None:
        whole("column", column)
    try:
        table = _read(Path(path), name, column)
    except OSError as error:
        raise ParameterError(f"cannot read the {name}: {error.strerror or error}") from None
    told = height_unit is not None or table.height_unit is not None
    with np.errstate(over="ignore"):  # what is too large becomes infinite, and is refused
        distance = table.distance * METRES[distance_unit or table.distance_unit or "m"]
        heights = table.heights * METRES[height_unit or table.height_unit or "m"]
    return _checked(name, distance, heights, told=told)


def _units(units: str | Sequence[str] | None) -> tuple[str | None, str | None]:
    """(unit of distances, unit of heights), None where it is not told."""
    if units is None:
        return None, None
    pair = (None, units) if isinstance(units, str) else tuple(units) if isinstance(units, Sequence) else ()
    known = zip(pair, (METRES, HEIGHT_UNITS), strict=False)
    if len(pair) != 2 or any(not (unit is None or (isinstance(unit, str) and unit in names)) for unit, names in known):
        raise ParameterError(
            f"units must be that of heights, or a pair, of distances and heights, of {', '.join(HEIGHT_UNITS)}, or "
            f"km of distances, got {shown(units)}"
        )
    return pair[0], pair[1]


def _read(path: Path, name: str, column: int | None) -> Table:
    """The numbers of a file."""
    if path.is_dir():
        raise ParameterError(f"{name} must be a file, and it is a folder")
    with path.open("rb") as file:
        sample = file.read(SAMPLE)
    if not sample.strip():
        raise ParameterError(f"{name} must hold numbers, and it is empty")
    if profile_formats.is_opencrg(sample):
        return profile_formats.read_opencrg(path, name, column)
    if re.search(rb"[\x00-\x08\x0e-\x1f\x7f]", sample):
        raise ParameterError(f"{name} must be text, a table of distances and heights, ERD or OpenCRG, and it is binary")
    with path.open(encoding="utf-8-sig", errors="replace") as text:
        if profile_formats.is_erd(sample):
            return profile_formats.read_erd(text, name, column)
        return _read_table(text, name, column)


def _fields(line: str, separator: str | None) -> list[str]:
    """The columns of a line; a comma beside another separator is a decimal point."""
    if separator in (";", "\t"):
        line = line.replace(",", ".")
    fields = [field.strip() for field in line.split("#")[0].strip().split(separator)]
    return fields[:-1] if separator and fields[-1] == "" else fields  # some end their lines with a separator


def _are_numbers(fields: Iterable[str]) -> bool:
    try:
        return bool([float(field) for field in fields])
    except ValueError:
        return False


def _read_table(text: TextIO, name: str, column: int | None) -> Table:
    """Distances and heights in columns."""
    header: list[str] = []
    for line in itertools.islice(text, HEADER_LINES):
        separator = next((one for one in SEPARATORS if _are_numbers(_fields(line, one)) and len(_fields(line, one)) > 1), None)
        width = len(_fields(line, separator))
        if _are_numbers(_fields(line, separator)):
            break
        header.append(line)
    else:
        raise ParameterError(
            f"{name} must have two columns of numbers, distance and height, after {HEADER_LINES} lines at most"
        )
    if width < 2:
        raise ParameterError(f"{name} must have two columns, distance and height, got {shown(line.strip())}")
    if column is None and width > 2:
        raise ParameterError(f"{name} has {width} columns: column must tell which heights to take, from 1 to {width - 1}")
    if column is not None and column >= width:
        raise ParameterError(f"column must be at most {width - 1} in the {name}, got {column}")
    chosen = (0, column or 1)
    most = int(RANGES["profile points"].high)

    def lines() -> Iterator[str]:
        for row in itertools.chain([line], text):
            yield row.replace(",", ".") if separator in (";", "\t") else row

    try:
        numbers = np.loadtxt(lines(), delimiter=separator, usecols=chosen, max_rows=most + 1, ndmin=2)
    except ValueError:
        text.seek(0)
        raise ParameterError(_first_wrong(text, len(header), separator, chosen, name)) from None
    units = _units_of(header[-1], separator, chosen) if header else (None, None)
    return Table(numbers[:, 0], numbers[:, 1], *units)


def _first_wrong(text: TextIO, skipped: int, separator: str | None, chosen: tuple[int, int], name: str) -> str:
    """Which line has no numbers where they belong, in words."""
    for number, line in enumerate(text, 1):
        fields = _fields(line, separator)
        taken = [fields[place] for place in chosen if place < len(fields)]
        if number > skipped and any(fields) and not (len(taken) == 2 and _are_numbers(taken)):
            return f"line {number} of the {name} must have numbers, got {shown(line.strip())}"
    return f"{name} must have columns of numbers between the same separators"


def _units_of(header: str, separator: str | None, chosen: tuple[int, int]) -> tuple[str | None, str | None]:
    """Units in brackets of the columns of a header, "distance [m], height (mm)", None where none is known."""
    names = (
        header.strip().lstrip("#%").split(separator)
        if separator
        else re.findall(r"[^\[(\s][^\[(]*(?:[\[(][^\])]*[\])])?", header)
    )
    found = []
    for place in chosen:
        told = re.search(r"[\[(]\s*([^\])]*?)\s*[\])]", names[place]) if place < len(names) else None
        unit = told.group(1).lower() if told else None
        found.append(unit if unit in METRES else None)
    return found[0], found[1]


def _checked(name: str, distance: npt.NDArray[np.float64], heights: npt.NDArray[np.float64], *, told: bool) -> Profile:
    """The profile, if it is one; ``told`` where the unit of the heights is known."""
    allowed = RANGES["profile points"]
    if len(distance) < allowed.low:
        raise ParameterError(f"{name} must have at least {allowed.low:.0f} points, got {len(distance)}")
    if len(distance) > allowed.high:
        raise ParameterError(f"{name} must have at most {allowed.high:.0f} points: cut it, or take every other one")
    for what, values in (("distance", distance), ("height", heights)):
        if not np.isfinite(values).all():
            place = int(np.argmin(np.isfinite(values)))
            raise ParameterError(f"{what} {place + 1} of the {name} must be finite, got {values[place]}")
        allowed = RANGES[f"profile {what}"]
        outside = (values < allowed.low) | (values > allowed.high)
        if outside.any():
            place = int(np.argmax(outside))
            raise ParameterError(
                f"{what} {place + 1} of the {name} must lie within [{allowed.low:g}, {allowed.high:g}] m, "
                f"got {values[place]:g} m"
            )
    steps = np.diff(distance)
    if steps.min() <= 0:
        place = int(np.argmax(steps <= 0))
        raise ParameterError(
            f"distances of the {name} must grow, got {distance[place + 1]:g} after {distance[place]:g} at point {place + 2}"
        )
    profile = Profile(distance=distance, heights=heights)
    spacing = profile.spacing
    off = np.abs(distance - distance[0] - spacing * np.arange(len(distance))) > UNEVEN * spacing
    if off.any():
        usual = float(np.median(steps))
        uneven = np.abs(steps - usual) > UNEVEN * usual
        place = int(np.argmax(uneven if uneven.any() else off[1:]))
        raise ParameterError(
            f"distances of the {name} must be even to {UNEVEN:g} of a step: from {distance[place]:g} m to "
            f"{distance[place + 1]:g} m it is {steps[place]:g} m, elsewhere {usual:g} m; resample it"
        )
    allowed = RANGES["profile spacing"]
    if not allowed.low <= spacing <= allowed.high:
        raise ParameterError(
            f"spacing of the {name} must lie within [{allowed.low:g}, {allowed.high:g}] m, got {spacing:g} m; units tells "
            "another unit of distances and heights, such as units=('mm', 'mm')"
        )
    climbs = np.diff(heights)
    if not told and float(np.std(climbs)) > ROUGHEST * np.sqrt(spacing):
        raise ParameterError(
            f"heights of the {name} step by {float(np.std(climbs)):.3g} m from one point to the next, which no road does: "
            "units must tell their unit, such as units='mm' or, if they are right, units='m'"
        )
    return profile
