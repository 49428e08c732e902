"""The command line: ``roadgym train``, ``tune``, ``evaluate``, ``compare``, ``drive``, ``certify``, ``benchmark``, ``figures``,
``explore``, ``errata`` and ``cache``.

Exit codes: 0 success, 1 a plant that is not certified, 2 a wrong argument, a file that cannot be read or written, or a missing
package (one line says which), 130 interrupted.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections.abc import Sequence

from roadgym import ParameterError, PlantError
from roadgym.installation import InstallationError

from ..errors import AgentError
from .options import environment_from
from .parser import make_parser

__all__ = ["environment_from", "main", "make_parser"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # letters that it does not have, and names that are no text
    parser = make_parser()
    chosen = parser.parse_args(arguments)
    try:
        code: int | None = chosen.run(chosen)
        print(end="", flush=True)
    except (ParameterError, PlantError, AgentError, InstallationError) as error:
        return _fault(chosen.command, str(error))
    except KeyboardInterrupt:
        remedies = {
            "train": "; --resume goes on from the last checkpoint",
            "compare": "; the same command resumes its agent",
            "tune": "; the same command goes on with the study",
        }
        remedy = remedies.get(chosen.command, "")
        print(f"roadgym {chosen.command}: interrupted{remedy}", file=sys.stderr)
        return 130
    except BrokenPipeError:
        _finish_output()
        return 0
    except OSError as error:  # such as a full disk
        where = "" if error.filename is None else f"cannot use {str(error.filename)!r}: "
        _finish_output()
        return _fault(chosen.command, f"{where}{error.strerror or error}")
    return code or 0


def _fault(command: str, message: str) -> int:
    """Say in one line what is wrong; returns the exit code."""
    print(f"roadgym {command}: {' '.join(message.split())}", file=sys.stderr)
    return 2


def _finish_output() -> None:
    """Write out what the standard output still holds, or let it be lost: Python would try at its end, and complain."""
    try:
        print(end="", flush=True)
    except OSError:
        with contextlib.suppress(OSError), open(os.devnull, "wb") as nowhere:  # noqa: PTH123 - a device, not a path
            os.dup2(nowhere.fileno(), sys.stdout.fileno())
