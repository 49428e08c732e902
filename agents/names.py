"""Names of learned controllers, made from the folders of their agents: one for each, and fit to be shown anywhere."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

LONGEST = 40  # letters


def printable(text: str) -> str:
    """``text`` in one line, with what cannot be printed as Python would write it."""
    with contextlib.suppress(UnicodeEncodeError):  # a path whose bytes the locale does not know is UTF-8 all the same
        text = text.encode("utf-8", "surrogateescape").decode("utf-8", "surrogateescape")
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def shortened(text: str, longest: int = LONGEST) -> str:
    """``text`` of at most ``longest`` letters; the end tells more than the beginning."""
    return text if len(text) <= longest else f"…{text[1 - longest :]}"


def name_folders(folders: Sequence[str], taken: Collection[str]) -> list[str]:
    """Names that tell the folders apart, also where case does not matter, and from those that are ``taken``.

    They are the ends of their paths, of as many parts as that needs.
    """
    paths = [[part for part in Path(folder).absolute().parts if not Path(part).anchor] for folder in folders]
    names: list[str] = []
    others = {name.casefold() for name in taken}
    for depth in range(1, max(map(len, paths), default=0) + 1):
        names = [shortened(printable("/".join(path[-depth:]))) for path in paths]
        found = {name.casefold() for name in names}
        if len(found) == len(names) and not found & others:
            return names
    return [f"{number}: {name}" for number, name in enumerate(names, 1)]


def file_names(names: Iterable[str]) -> dict[str, str]:
    """By name what stands for it in the name of a file on every system, no two alike."""
    found: dict[str, str] = {}
    used: set[str] = set()
    for name in names:
        stem = re.sub(r"[^A-Za-z0-9_.-]+", "_", name)[-LONGEST:]
        number = 1
        while (plain := stem if number == 1 else f"{stem}-{number}").casefold() in used:
            number += 1
        used.add(plain.casefold())
        found[name] = plain
    return found


def figure_label(name: str) -> str:
    """``name`` as matplotlib shows it letter for letter: no formula between dollars, and not left out for an underscore."""
    text = shortened(printable(name)).replace("$", r"\$")
    return f" {text}" if text.startswith("_") else text


def csv_cell(value: object) -> object:
    """``value``, a text led by an apostrophe where a spreadsheet would take it for a formula."""
    return f"'{value}" if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r")) else value
