"""Progress on the error stream: a bar where there is a terminal, and rich to draw it; else a line now and then."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console


def _terminal() -> Console | None:
    """The terminal that a bar is drawn on; None where there is none, or no rich."""
    try:
        from rich.console import Console
    except ModuleNotFoundError:
        return None
    console = Console(stderr=True)
    return console if console.is_terminal else None


SECONDS = 10.0  # between lines on one piece of work, where there is no terminal


@contextlib.contextmanager
def _bar() -> Iterator[Callable[[str, int, int, str], None]]:
    """A function of (what, done, in all, remark)."""
    console = _terminal()
    if console is None:
        told, finished = time.monotonic(), set()

        def tell(what: str, done: int, total: int, remark: str) -> None:
            nonlocal told
            if what not in finished and (done == total or time.monotonic() - told > SECONDS):
                told = time.monotonic()
                finished.update([what] if done == total else [])
                print(f"{what}: {done} of {total}{remark and ', ' + remark}", file=sys.stderr, flush=True)

        yield tell
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total} {task.fields[remark]}"))
    with Progress(*columns, TimeRemainingColumn(), console=console) as progress:
        bars: dict[str, object] = {}

        def show(what: str, done: int, total: int, remark: str) -> None:
            if what not in bars:
                bars[what] = progress.add_task(what, total=total, remark=remark)
            progress.update(bars[what], completed=done, total=total, remark=remark)  # type: ignore[arg-type]

        yield show


class Stopwatch:
    """How long the parts of a work take, on the clock."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._begin = time.monotonic()

    def note(self, part: str) -> None:
        """Count the time since the last note, or the start, as that of ``part``."""
        now = time.monotonic()
        self.seconds[part] = self.seconds.get(part, 0.0) + now - self._begin
        self._begin = now

    def __str__(self) -> str:
        parts = ", ".join(f"{part} {seconds:.1f}" for part, seconds in self.seconds.items())
        return f"{sum(self.seconds.values()):.1f} s: {parts}"


@contextlib.contextmanager
def training_progress() -> Iterator[Callable[[int, int, float | None], None]]:
    """A report for `agents.train`."""
    with _bar() as tell:

        def report(done: int, total: int, reward: float | None) -> None:
            tell("training", done, total, "" if reward is None else f"mean cost {-reward:.3f}")

        yield report


@contextlib.contextmanager
def tuning_progress() -> Iterator[Callable[[int, int, int, float | None], None]]:
    """A report for `agents.tuning.tune`."""
    with _bar() as tell:

        def report(trial: int, done: int, total: int, best: float | None) -> None:
            tell(f"trial {trial}", done, total, "" if best is None else f"best {best:.4f}")

        yield report


@contextlib.contextmanager
def work_progress() -> Iterator[Callable[[str, int, int], None]]:
    """A report of (what, done, in all)."""
    with _bar() as tell:

        def report(what: str, done: int, total: int) -> None:
            tell(what, done, total, "")

        yield report


@contextlib.contextmanager
def jobs_progress() -> Iterator[Callable[[int, int, int], None]]:
    """A report for `agents.jobs.executor`, with the time that is left at the pace so far."""
    begin, last = time.monotonic(), (0, 0, 0)
    with _bar() as tell:

        def report(done: int, failed: int, total: int) -> None:
            nonlocal last
            last = done, failed, total
            if (over := done + failed) < total:  # more may follow: that all are over is told at the end
                left = (time.monotonic() - begin) / over * (total - over)
                tell("jobs", over, total, f"{f'{failed} failed, ' if failed else ''}about {left:.0f} s left")

        yield report
        done, failed, total = last
        if total:
            tell("jobs", done + failed, total, f"{failed} failed" if failed else "")
