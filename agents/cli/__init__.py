"""The command line: ``roadgym train``, ``tune``, ``evaluate``, ``compare``, ``sweep``, ``suite``, ``drive``, ``export``,
``certify``, ``road``, ``benchmark``, ``figures``, ``explore``, ``errata`` and ``cache``.

Exit codes: 0 success, 1 a plant or a profile that is not certified or part of a sweep that failed, 2 a wrong argument, a file
that cannot be read or written, or a missing package (one line says which), 130 interrupted, 143 terminated.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

from roadgym import ParameterError, PlantError
from roadgym.component import import_modules
from roadgym.installation import InstallationError

from ..errors import AgentError
from .commands import DESCRIPTION
from .options import environment_from
from .parser import given_options, make_parser

__all__ = ["environment_from", "main", "make_parser"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # letters that it does not have, and names that are no text
    chosen = make_parser().parse_args(arguments)
    chosen.given = given_options(arguments)
    try:
        with _stopped_by_signals():
            import_modules(chosen.imports)
            code: int | None = chosen.run(chosen)
        print(end="", flush=True)
    except (ParameterError, PlantError, AgentError, InstallationError) as error:
        return _fault(chosen.command, str(error))
    except MemoryError:
        return _fault(chosen.command, "this takes more memory than there is")
    except KeyboardInterrupt as interruption:
        print(f"roadgym {chosen.command}: interrupted{_remedy(chosen)}", file=sys.stderr)
        return 128 + next(iter(interruption.args), signal.SIGINT)
    except BrokenPipeError:
        _finish_output()
        return 0
    except OSError as error:  # such as a full disk
        where = "" if error.filename is None else f"cannot use {str(error.filename)!r}: "
        _finish_output()
        return _fault(chosen.command, f"{where}{error.strerror or error}")
    return code or 0


@contextlib.contextmanager
def _stopped_by_signals() -> Iterator[None]:
    """Signals that end a process interrupt the work as Ctrl-C does, so that nothing half-written stays and agents are saved.

    A library that is being imported may swallow or change the exception: one that comes out after a signal is the interruption.
    """
    came: list[int] = []

    def interrupt(number: int, frame: object) -> None:
        came.append(number)
        raise KeyboardInterrupt(number)

    before = {}
    if threading.current_thread() is threading.main_thread():
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):  # there is no SIGHUP on Windows
            number = getattr(signal, name, None)
            if number is not None and signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
                before[number] = signal.signal(number, interrupt)
    try:
        yield
    except Exception:
        if came:
            raise KeyboardInterrupt(came[0]) from None
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _remedy(chosen: argparse.Namespace) -> str:
    """How to go on after an interruption."""
    if chosen.command == "train":
        saved = (Path(chosen.output) / DESCRIPTION).exists()
        return "; --resume goes on from the last checkpoint" if saved else "; nothing was saved yet"
    return "; the same command goes on" if chosen.command in ("compare", "sweep", "tune") else ""


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
