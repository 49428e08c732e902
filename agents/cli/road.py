"""``roadgym road``."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from roadgym.installation import require


def run_road(chosen: argparse.Namespace) -> int:
    """``roadgym road``."""
    from ..measured_road import figures, measure, table
    from ..records import make_folder

    if chosen.output:
        for package in ("matplotlib", "jinja2"):
            require(package, "report")  # before the work
        from ..road_page import check_folder

        check_folder(make_folder(chosen.output), Path(chosen.file).name)
    measured = measure(
        chosen.file,
        units=chosen.units,
        column=chosen.column,
        folded=chosen.folded,
        iso_class=chosen.iso_class,
        **({"band": tuple(chosen.band)} if chosen.band else {}),
    )
    print(json.dumps(figures(measured), indent=2) if chosen.json else table(measured), flush=True)
    if chosen.output:
        from ..road_page import write

        for file in write(measured, Path(chosen.output)):
            print(f"wrote {file}", file=sys.stderr)
    return 0 if measured.certificate is None or measured.certificate.passed else 1
