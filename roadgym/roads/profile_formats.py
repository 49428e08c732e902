"""Two formats of measured roads: ERD and OpenCRG.

*ERD*: M. W. Sayers and S. M. Karamihas, "ERD file format for storage and analysis of road profiles", University of Michigan
Transportation Research Institute. The first line is ERDFILEV2.00, the second has the number of channels, that of samples, two
numbers about records, the form of the numbers (5: text between blanks) and their spacing; then come lines that begin with a
keyword of eight letters, of which UNITSNAM has the units of the channels in fields of eight letters and XUNITS that of the
spacing; and after the line END the samples, all channels of each. Only the text form is read.

*OpenCRG*: ASAM OpenCRG 1.2, "curved regular grid": sections that begin with $ and a keyword, of which $ROAD_CRG has the spacing
along the reference line and $KD_DEFINITION the columns; after a line that begins with $$ the heights, row by row across the
road, as text in fields of 10 or 20 letters, a new line every 80 letters and for each row, or as big-endian numbers in a row.
Heights are those of the grid: slope and banking of the reference line are left out.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np
import numpy.typing as npt

from ..parameters import RANGES, ParameterError, positive, shown

METRES = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0),
    "km": 1e3,
    "cm": 1e-2,
    "mm": 1e-3,
    **dict.fromkeys(("in", "inch", "inches"), 0.0254),
    "mil": 0.0254e-3,
    "mils": 0.0254e-3,
    **dict.fromkeys(("ft", "feet"), 0.3048),
}
HEIGHT_UNITS = tuple(unit for unit in METRES if unit != "km")  # in which anybody tells heights
ERD_TEXT = 5  # the form of the numbers that is text
FIELDS = {"LRFI": 10, "LDFI": 20}  # letters of a number
BINARY = {"KRBI": ">f4", "KDBI": ">f8"}
RECORD = 80  # letters of a line, and bytes that binary rows are filled up to at the end of the file


class Table(NamedTuple):
    """Numbers of a file, shape (n,) each, and their units, None where it does not tell."""

    distance: npt.NDArray[np.float64]
    heights: npt.NDArray[np.float64]
    distance_unit: str | None = None
    height_unit: str | None = None


def is_erd(sample: bytes) -> bool:
    """Does a file that begins so hold ERD?"""
    return sample.lstrip()[:7].upper() == b"ERDFILE"


def is_opencrg(sample: bytes) -> bool:
    """Does a file that begins so hold OpenCRG?"""
    return re.search(rb"^\$(ROAD_CRG|KD_DEFINITION|CT)\b", sample, re.IGNORECASE | re.MULTILINE) is not None


def read_erd(text: TextIO, name: str, channel: int | None) -> Table:
    """A channel of an ERD file, from 1, by default the first.

    Raises:
        ParameterError: it is not as the format has it, or binary.
    """
    text.readline()
    layout = text.readline()
    try:
        channels, samples, _, _, form = (int(field) for field in layout.replace(",", " ").split()[:5])
        step = float(layout.replace(",", " ").split()[5])
        if channels < 1 or samples < 1:
            raise ValueError
    except (ValueError, IndexError):
        raise ParameterError(
            f"second line of the {name} must have the layout of ERD, six numbers or more, got {shown(layout.strip())}"
        ) from None
    if form != ERD_TEXT:
        raise ParameterError(f"{name} must have its numbers as text (form {ERD_TEXT} of ERD), got the form {form}")
    positive(f"step of the {name}", step)
    chosen = _column(channel, channels, name)
    words: dict[str, str] = {}
    for line in text:
        if line.strip().upper() == "END":
            break
        words[line[:8].strip().upper()] = line[8:]
    else:
        raise ParameterError(f"{name} must have the line END between header and numbers")
    if samples > RANGES["profile points"].high:
        raise ParameterError(f"{name} must have at most {RANGES['profile points'].high:.0f} points, got {samples}")
    found = text.read().replace(",", " ").split()
    if len(found) < channels * samples:
        raise ParameterError(
            f"{name} must have the {samples} samples of {channels} channels that it tells, got {len(found)} numbers"
        )
    try:
        numbers = np.array(found[: channels * samples], float).reshape(samples, channels)
    except ValueError as error:
        raise ParameterError(f"{name} must have numbers after END: {error}") from None
    units = words.get("UNITSNAM", "")
    unit = units[8 * chosen : 8 * chosen + 8].strip().lower()
    spacing_unit = words.get("XUNITS", "").strip().lower()
    return Table(
        step * np.arange(samples, dtype=np.float64),
        numbers[:, chosen],
        spacing_unit if spacing_unit in METRES else None,
        unit if unit in METRES else None,
    )


def read_opencrg(path: Path, name: str, section: int | None) -> Table:
    """A long section of an OpenCRG file, from 1, from right to left; by default the nearest to the reference line.

    Raises:
        ParameterError: it is not as the format has it, or changes its grid by modifiers or other files, which is not done here.
    """
    content = path.read_bytes()
    end = re.search(rb"^\$\$[^\n]*\n", content, re.MULTILINE)
    if end is None:
        raise ParameterError(f"{name} must have a line that begins with $$ between header and numbers")
    sections = _sections(content[: end.start()].decode("ascii", errors="replace"))
    road, definition = (_parameters(sections.get(key, ())) for key in ("ROAD_CRG", "KD_DEFINITION"))
    if sections.get("ROAD_CRG_FILE"):
        raise ParameterError(f"{name} must hold its own grid, and it refers to another file")
    for word in _parameters(sections.get("ROAD_CRG_MODS", ())):
        if word.startswith("SCALE"):
            raise ParameterError(f"{name} must hold its grid as it is, and it has the modifier {word}")
    if "REFERENCE_LINE_INCREMENT" not in road:
        raise ParameterError(f"{name} must have a REFERENCE_LINE_INCREMENT")
    step = positive(f"REFERENCE_LINE_INCREMENT of the {name}", road["REFERENCE_LINE_INCREMENT"])
    lines = [line.partition(":") for line in sections.get("KD_DEFINITION", ())]
    columns = [what.partition(",")[0].strip().lower() for key, _, what in lines if key.strip().upper() == "D"]
    form = next((what.strip().upper() for key, _, what in lines if key.strip() == "#"), "KRBI")
    cuts = [place for place, what in enumerate(columns) if what.startswith("long section")]
    if not cuts:
        raise ParameterError(f"{name} must define a long section, got the columns {shown(columns or definition)}")
    across = _across([columns[cut] for cut in cuts], road, name)
    chosen = cuts[int(np.argmin(np.abs(across)))] if section is None else cuts[_column(section, len(cuts), name)]
    grid = _grid(content[end.end() :], form, len(columns), name)
    return Table(step * np.arange(len(grid), dtype=np.float64), grid[:, chosen].astype(float), "m", "m")


def _column(asked: int | None, number: int, name: str) -> int:
    """Index of the column that was asked for, the first by default."""
    if asked is not None and asked > number:
        raise ParameterError(f"column must be at most {number} in the {name}, got {asked}")
    return (asked or 1) - 1


def _sections(header: str) -> dict[str, list[str]]:
    """Lines of the sections by keyword, without comments."""
    found: dict[str, list[str]] = {}
    lines: list[str] = []
    for line in header.splitlines():
        text = line.partition("!")[0].strip()
        if text.startswith("$"):
            lines = found.setdefault(text[1:].strip().upper(), [])
        elif text and not line.startswith("*"):
            lines.append(text)
    return found


def _parameters(lines: Sequence[str]) -> dict[str, str]:
    """The parameters of a section, NAME = VALUE."""
    pairs = (line.partition("=") for line in lines)
    return {name.strip().upper(): value.strip() for name, equals, value in pairs if equals}


def _across(cuts: list[str], road: dict[str, str], name: str) -> npt.NDArray[np.float64]:
    """Where long sections are, m to the left of the reference line, or in any unit where the middle alone is known."""
    places = [re.search(r"at v\s*=\s*(\S+)", cut) for cut in cuts]
    right, left = road.get("LONG_SECTION_V_RIGHT"), road.get("LONG_SECTION_V_LEFT")
    increment = road.get("LONG_SECTION_V_INCREMENT")
    count = np.arange(len(cuts), dtype=float)
    try:
        told = np.array([float(place.group(1)) for place in places if place is not None])
        if len(told) == len(cuts):
            return told
        if right is not None and (increment is not None or left is not None):
            width = float(increment) if increment is not None else (float(left or 0) - float(right)) / max(1, len(cuts) - 1)
            return float(right) + width * count
    except ValueError as error:
        raise ParameterError(f"long sections of the {name} must be at numbers: {error}") from None
    return np.asarray(count - count.mean())


def _grid(payload: bytes, form: str, columns: int, name: str) -> npt.NDArray[Any]:
    """The numbers, shape (rows, columns); NaN where they are missing."""
    most = int(RANGES["profile points"].high)
    if form in BINARY:
        kind = np.dtype(BINARY[form])
        values = np.frombuffer(payload[: len(payload) // kind.itemsize * kind.itemsize], kind)
        rows = len(values) // columns
        # what fills the last record up may look like rows of nothing
        grid = values[: rows * columns].reshape(rows, columns)
        filled = -(-RECORD // (kind.itemsize * columns))
        while filled and rows and np.isnan(grid[rows - 1]).all():
            rows, filled = rows - 1, filled - 1
        return grid[:rows]
    if form not in FIELDS:
        raise ParameterError(f"{name} must have its numbers as {', '.join([*FIELDS, *BINARY])}, got {shown(form)}")
    width = FIELDS[form]
    records = -(-columns * width // RECORD)  # lines of a row
    lines = payload.decode("ascii", errors="replace").splitlines()
    lines = [line for line in lines if line.strip()][: records * (most + 1)]
    if len(lines) % records:
        raise ParameterError(f"{name} must have {records} lines for each row of {columns} columns, got {len(lines)} lines")
    grid = np.empty((len(lines) // records, columns))
    for row in range(len(grid)):
        text = "".join(line.ljust(RECORD)[:RECORD] for line in lines[row * records : (row + 1) * records])
        fields = [text[width * k : width * (k + 1)].strip() for k in range(columns)]
        try:
            grid[row] = [float("nan") if field.startswith("*") else float(field) for field in fields]
        except ValueError as error:
            raise ParameterError(f"row {row + 1} of the numbers of the {name} must be {columns} numbers: {error}") from None
    return grid
