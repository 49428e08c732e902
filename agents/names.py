"""What things are called wherever they are shown: one name for each controller, in tables, pictures and pages alike.

A learned controller is named by its agents' folders, in a form that is fit to be shown anywhere.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

LONGEST = 40  # letters
FILTERED = ", filtered"  # after the name of a controller that takes the mean of a filter for the state
CONTROLLERS_SHOWN = {  # by the name in `agents.CONTROLLERS`: the name that is shown, and what it does
    "agent": ("agent", "learned: sets D from what it observes"),
    "analytic_optimum": ("best constant D", "a passive suspension, the constant D that costs least by theory at this point"),
    "d_min": ("D_min", "the softest damping all the time"),
    "d_max": ("D_max", "the firmest damping all the time"),
    "skyhook": ("skyhook", "D_max where the damper would brake the body, else D_min"),
    "skyhook_continuous": (
        "continuous skyhook",
        "the force of a damper between body and sky, as far as the damper can give it",
    ),
    "groundhook": ("groundhook", "D_max where the damper would brake the wheel, else D_min"),
    "hybrid": ("hybrid", "a mixture of skyhook and groundhook"),
    "add": ("ADD", "acceleration-driven: D_max where the damper would reduce the body's acceleration, else D_min"),
    "mixed_skyhook_add": ("mixed skyhook-ADD", "skyhook where the body moves slowly, ADD where it moves fast"),
    "one_sensor_mix": ("one-sensor mix", "D_max where the body moves slowly, D_min where it moves fast"),
    "power_driven": ("power-driven", "the D at which the suspension gives back no power, as far as the damper can give it"),
    "least_acceleration": ("least acceleration", "the D that makes the body's acceleration least at this instant"),
    "clipped_lqr": ("clipped LQR", "the best linear active force, as far as the damper can give it"),
    "one_step_lookahead": (
        "one-step lookahead",
        "the D that is best for one interval if the best constant D took over after it",
    ),
    "mixed_lookahead": (
        "mixed lookahead",
        "the D that is best for one interval if what follows cost something between the best constant D and an active force",
    ),
    "optimal_feedback": ("optimal feedback", "the least cost for who sees the whole state, by dynamic programming"),
}


def title(controller: str) -> str:
    """The name of a controller that is shown, its own where it has no other."""
    own = controller.removesuffix(FILTERED)
    return CONTROLLERS_SHOWN[own][0] + controller[len(own) :] if own in CONTROLLERS_SHOWN else controller


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
