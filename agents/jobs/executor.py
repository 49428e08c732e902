"""Who submits jobs, and has workers at them."""

from __future__ import annotations

import contextlib
import json
import secrets
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

from roadgym.component import import_modules
from roadgym.files import whole_file
from roadgym.parameters import ParameterError, shown, whole

from ..progress import jobs_progress
from ..records import make_folder
from .launchers import LAUNCHERS, Handle, Launcher
from .store import FAILED, JOB, LOSSES, RESULT, JobError, Presence, Worker, declare_lost, describe, key_of, read_result
from .worker import POLL

HERE = "here"
PLACES = (HERE, *LAUNCHERS)

Report = Callable[[int, int, int], None]


def executor(
    on: str = "processes",
    workers: int | None = None,
    store: str | Path | None = None,
    report: Report | None = None,
    *,
    imports: Sequence[str] = (),
    options: Mapping[str, Any] | None = None,
) -> JobExecutor:
    """An executor of jobs, as of `concurrent.futures`, to be used in a ``with`` statement.

    A job is a function of a module with arguments that JSON knows, which it is handed as JSON makes them again: tuples as
    lists, roads and cars as mappings. It is done once, however often it is submitted, as long as sources and packages stay the
    same. One that fails leaves the others alone: its future raises `JobError` with the traceback.

    Args:
        on: "processes" of this machine; "ray", which needs the extra ray; "slurm", which needs the extra slurm; or "here", in
            this process and at once when it is submitted.
        workers: how many at once; by default the processors of this machine, or of the Ray cluster. Slurm must be told.
        store: folder of jobs and results, which all workers must see; by default a temporary one, but not for Ray or Slurm.
        report: called as ``report(done, failed, in all)``; by default progress is told on the error stream.
        imports: modules for workers to import first, for the components of one's own that they register.
        options: for Ray those of ``ray.init``; for Slurm those of ``submitit.AutoExecutor.update_parameters``.

    Raises:
        ParameterError: a parameter out of range.
        AgentError: the folder cannot be written.
        InstallationError: a package that it needs is not installed.
    """
    if on not in PLACES:
        raise ParameterError(f"on must be one of {', '.join(PLACES)}, got {shown(on)}")
    if workers is not None:
        whole("workers", workers)
    if on == HERE:
        if options:
            raise ParameterError(f"options must be none here, got {', '.join(options)}")
        return _Here(store, report, imports)
    kind = LAUNCHERS[on]
    if store is None and kind.shared:
        raise ParameterError(f"store must be a folder that all workers see, on {on}, got None")
    launcher = kind(options or {})
    if workers is None and launcher.workers is None:
        raise ParameterError(f"workers must be a number on {on}, got None")
    return _Elsewhere(store, report, imports, launcher, workers or launcher.workers)


class JobExecutor(Executor):
    """What all executors of jobs have in common."""

    def __init__(self, store: str | Path | None, report: Report | None, imports: Sequence[str]) -> None:
        self._stack = contextlib.ExitStack()
        folder = self._stack.enter_context(tempfile.TemporaryDirectory()) if store is None else make_folder(store)
        self.folder = Path(folder).resolve()
        self._report = self._stack.enter_context(jobs_progress()) if report is None else report
        import_modules(imports)
        self._imports = imports
        self._driver = Presence(self.folder, "driver")
        for path in [*self.folder.glob("*.driver"), *self.folder.glob("*.worker")]:
            if self._driver.finds_lost(path):
                path.unlink(missing_ok=True)
        self._lock = threading.RLock()
        self._waiting: dict[str, tuple[str, list[Future[Any]]]] = {}  # by the key: what the job is, and who waits for it
        self._done = self._failed = self._total = 0
        self._closing = self._cancelled = False
        self._fault: JobError | None = None  # after which nobody looks after jobs

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **keywords: Any) -> Future[Any]:
        """Ask for a job, see `executor`; returns the future of what the function returns.

        Raises:
            ParameterError: no function of a module, or arguments that JSON does not know.
        """
        description = describe(function, arguments, keywords, self._imports)
        key, future = key_of(description), Future[Any]()
        with self._lock:
            if self._closing:
                raise self._fault or RuntimeError("cannot submit jobs after shutdown")
            self._waiting.setdefault(key, (description, []))[1].append(future)
            self._total += 1
            self._path(key, FAILED).unlink(missing_ok=True)  # it is tried again
            self._look_after(key, {path.name for path in [self._path(key, RESULT)] if path.exists()})
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take no more jobs, end when none is left, or at once; with ``wait``, return only then."""
        with self._lock:
            self._closing, self._cancelled = True, self._cancelled or cancel_futures
            for key in list(self._waiting) if cancel_futures else ():
                for future in self._waiting[key][1]:
                    future.cancel()
                self._look_after(key, set())

    def __exit__(self, kind: Any, value: Any, trace: Any) -> None:
        self.shutdown(wait=True, cancel_futures=kind is not None)

    def _path(self, key: str, ending: str) -> Path:
        return self.folder / f"{key}{ending}"

    def _look_after(self, key: str, there: set[str]) -> None:
        """Hand out what became of a job, by the files that are there; where nothing did yet, ask for it."""
        description, futures = self._waiting[key]
        if all(future.cancelled() for future in futures):
            self._path(key, JOB).unlink(missing_ok=True)
            del self._waiting[key]
        elif key + RESULT in there:
            try:
                self._hand_out(key, read_result(self._path(key, RESULT)), None)
            except ValueError:  # damaged
                self._path(key, RESULT).unlink(missing_ok=True)
        elif key + FAILED in there:
            with contextlib.suppress(FileNotFoundError):  # another driver has just tried again
                self._hand_out(key, None, failure(description, self._path(key, FAILED).read_text(encoding="utf-8")))
        elif key + JOB not in there:
            with whole_file(self._path(key, JOB), durable=False) as part:
                part.write_text(description, encoding="utf-8")

    def _hand_out(self, key: str, result: Any, error: Exception | None) -> None:
        _, futures = self._waiting.pop(key)
        self._failed += len(futures) * (error is not None)
        self._done += len(futures) * (error is None)
        for future in futures:
            if future.set_running_or_notify_cancel():
                if error is None:
                    future.set_result(result)
                else:
                    future.set_exception(error)
        self._report(self._done, self._failed, self._total)


class _Here(JobExecutor):
    """Does jobs at once, in this process."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._worker = Worker(self.folder)

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **keywords: Any) -> Future[Any]:
        future = super().submit(function, *arguments, **keywords)
        while not future.done():  # another driver's worker may be at it
            for key in list(self._waiting):
                if not self._worker.attempt(key):
                    time.sleep(POLL[0])
                self._look_after(key, {path.name for path in self.folder.glob(f"{key}.*")})
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        if not self._closing:
            super().shutdown(wait, cancel_futures=True)
            self._worker.presence.end()
            self._driver.end()
            self._stack.close()


class _Elsewhere(JobExecutor):
    """Has workers do jobs, and starts others in place of those that are lost."""

    def __init__(self, store: Any, report: Any, imports: Sequence[str], launcher: Launcher, workers: int) -> None:
        super().__init__(store, report, imports)
        self._launcher, self._number = launcher, workers
        self._workers: dict[str, Handle] = {}
        self._lost = 0  # workers, since the last job was over
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        super().shutdown(wait, cancel_futures=cancel_futures)
        try:
            while wait and self._thread.is_alive():
                self._thread.join(1.0)
        except BaseException:  # interrupted
            super().shutdown(wait, cancel_futures=True)
            self._thread.join()
            raise

    def _watch(self) -> None:
        pause, most = POLL
        try:
            while self._waiting or not self._closing:
                over = self._done + self._failed
                there = {path.name for path in self.folder.iterdir()}
                with self._lock:
                    for key in list(self._waiting):
                        self._look_after(key, there)
                    if self._done + self._failed > over:
                        pause, self._lost = POLL[0], 0
                    self._tend()
                time.sleep(pause)
                pause = min(2 * pause, most)
        except Exception as error:  # such as a folder that is gone
            with self._lock:
                self._closing = True
                self._fault = JobError(f"nobody can look after the jobs any more: {error}")
                for key in list(self._waiting):
                    self._hand_out(key, None, self._fault)
        finally:
            self._leave()

    def _leave(self) -> None:
        """Have all workers end: those without work of themselves, those at the work of others when they are told."""
        self._driver.end()
        end = time.monotonic() + 2 * POLL[1]
        while not self._cancelled and time.monotonic() < end and any(worker.alive() for worker in self._workers.values()):
            time.sleep(POLL[0])
        for worker in self._workers.values():
            worker.stop()
        for name, worker in self._workers.items():
            worker.join()
            declare_lost(self.folder, name)
        self._launcher.close()
        self._stack.close()

    def _tend(self) -> None:
        """Have as many workers as there is work for."""
        for name in [name for name, worker in self._workers.items() if not worker.alive()]:
            del self._workers[name]
            declare_lost(self.folder, name)
            self._lost += 1
        if self._lost > LOSSES * self._number:
            for key in list(self._waiting):
                self._hand_out(key, None, JobError("workers are lost as soon as they are started"))
        while len(self._workers) < min(self._number, len(self._waiting)):
            name = secrets.token_hex(8)
            self._workers[name] = self._launcher.start(self.folder, name)


def failure(description: str, told: str) -> JobError:
    """The error of a job that failed, of what was told of it."""
    name = json.loads(description)["function"].rpartition(":")[2]
    reason, _, where = told.partition("\n")
    return JobError(f"{name} failed: {reason}", where)
