"""The process of a worker, wherever it was started."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

from .store import Presence, Worker

POLL = 0.05, 1.0  # s between looks into a folder in which nothing happens, at first and at most


def serve(folder: str, name: str | None = None, *command: str) -> None:
    """Do the jobs of ``folder`` until nobody is there any more who waits for any.

    Args:
        folder: of the jobs.
        name: that this worker is known by; by default one of its own.
        command: in place of this process's own, which agents that are trained record.
    """
    sys.argv[:] = command or sys.argv
    worker = Worker(Path(folder), name)
    pause, most = POLL
    try:
        while _wanted(worker.presence):
            for key in worker.waiting():
                if worker.attempt(key):
                    pause = POLL[0]
                    if not _wanted(worker.presence):
                        return
            time.sleep(pause)
            pause = min(2 * pause, most)
    finally:
        worker.presence.end()


def _wanted(presence: Presence) -> bool:
    return any(not presence.finds_lost(path) for path in presence.folder.glob("*.driver"))


def main(folder: str, name: str | None = None, *command: str) -> None:
    """Serve as a process of one's own, which a request to terminate interrupts as Ctrl-C does a command."""

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's, which goes to all: who started this one decides
    signal.signal(signal.SIGTERM, interrupt)
    os.dup2(2, 1)  # what jobs print is no output of the command that waits for them
    try:
        serve(folder, name, *command)
    except KeyboardInterrupt:
        raise SystemExit(128 + signal.SIGTERM) from None
