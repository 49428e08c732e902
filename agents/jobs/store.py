"""A folder of jobs that any number of processes work on, on any number of machines that see it.

A job is a function of a module and its arguments in terms of what JSON knows; its key is a digest of these, of all sources, and
of the versions of the packages that results depend on. By its key, there are in the folder

- ``KEY.job``, what is to be done, until it is done;
- ``KEY.claim-N`` while a worker is at it: a hard link to that worker's *sign of life*, ``NAME.worker``, which it touches every
  `BEAT` seconds. So a claim is made by one worker or by none, and is as old as the last sign of who made it. One that is older
  than `LOST` seconds is left where it is, and the next worker claims N + 1; after `LOSSES` of them the job has failed;
- ``KEY.result`` or ``KEY.failed``, at last. Both are written whole, and a result is checked by a digest when it is read.

While signs of life come through, a job is done by one worker. Where they do not for `LOST` seconds, because a machine stood
still, two may do the same: each writes the same result, whole. Ages are told by the clock of the file system alone.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib
import json
import operator
import os
import pickle
import secrets
import sys
import threading
import traceback
from bisect import bisect
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import analysis
from roadgym.cache import stamp_of
from roadgym.component import import_modules
from roadgym.files import whole_file
from roadgym.parameters import ParameterError, shown

from ..errors import AgentError
from ..records import plain, versions

BEAT = 10.0  # s, between signs of life
LOST = 60.0  # s without one, after which who gave it is taken for lost
LOSSES = 3  # workers that a job may lose
JOB, RESULT, FAILED = ".job", ".result", ".failed"


class JobError(AgentError):
    """A job that failed; ``traceback`` has all of where."""

    def __init__(self, message: str, traceback: str = "") -> None:
        super().__init__(message)
        self.traceback = traceback
        if traceback:
            self.add_note(traceback)


def describe(function: Callable[..., Any], arguments: Any, keywords: Any, imports: Sequence[str] = ()) -> str:
    """A job in words that are the same for the same job: canonical JSON.

    Args:
        function: of a module.
        arguments, keywords: what it is called with.
        imports: modules that are imported, and those that a worker is to import first, for the components that they register.

    Raises:
        ParameterError: a function that no worker can import, or arguments that JSON does not know.
    """
    module, name = getattr(function, "__module__", ""), getattr(function, "__qualname__", "")
    try:
        found = module != "__main__" and operator.attrgetter(name)(sys.modules[module]) is function
    except (AttributeError, KeyError):
        found = False
    stamp = stamp_of(function, analysis, describe, *(sys.modules[name] for name in imports)) if found else None
    if stamp is None:
        raise ParameterError(f"function must be one of a module that workers can import, got {shown(function)}")
    content = {
        "function": f"{module}:{name}",
        "arguments": plain(arguments),
        "keywords": plain(keywords),
        "imports": list(imports),
        "sources": stamp,
        "versions": _versions(),
    }
    try:
        return json.dumps(content, sort_keys=True, separators=(",", ":"))
    except TypeError as error:
        raise ParameterError(f"arguments of a job must be what JSON knows, but {' '.join(str(error).split())}") from None


_versions = functools.cache(versions)


def key_of(description: str) -> str:
    """The name of a job in the folder."""
    return hashlib.sha256(description.encode()).hexdigest()[:32]


def perform(description: str) -> Any:
    """What the function of a job returns.

    Raises:
        JobError: the sources or the packages here are not those that the job is of.
        Exception: whatever the function raises.
    """
    job = json.loads(description)
    import_modules(job["imports"])
    module, _, name = job["function"].partition(":")
    function = operator.attrgetter(name)(importlib.import_module(module))
    if describe(function, job["arguments"], job["keywords"], job["imports"]) != description:
        raise JobError("the sources or the packages of this worker are not those of who asked for the job")
    return function(*job["arguments"], **job["keywords"])


class Presence:
    """The sign of life of a process, ``NAME.KIND`` in the folder, until `end`."""

    def __init__(self, folder: Path, kind: str, name: str | None = None) -> None:
        self.folder, self.name = folder, name or secrets.token_hex(8)
        self.path = folder / f"{self.name}.{kind}"
        self.path.touch()
        self._over = threading.Event()
        threading.Thread(target=self._beat, daemon=True).start()

    def _beat(self) -> None:
        while not self._over.wait(BEAT):
            with contextlib.suppress(OSError):
                os.utime(self.path)

    def finds_lost(self, path: Path) -> bool:
        """Is who gave this sign of life, or made this claim, lost? One that is gone was taken away, which is something else."""
        with contextlib.suppress(FileNotFoundError):
            return _touched(self.path) - _touched(path) > LOST
        return False

    def end(self) -> None:
        """Give no more signs."""
        self._over.set()
        self.path.unlink(missing_ok=True)


def _touched(path: Path) -> float:
    with path.open("rb") as file:  # opened, a network's file system asks the server
        return os.fstat(file.fileno()).st_mtime


def declare_lost(folder: Path, name: str) -> None:
    """Let all know at once that a worker is lost: its claims are as old as can be."""
    path = folder / f"{name}.worker"
    with contextlib.suppress(FileNotFoundError):
        os.utime(path, (0, 0))
        path.unlink()


class Worker:
    """Does jobs of a folder; ``presence`` is its sign of life."""

    def __init__(self, folder: Path, name: str | None = None) -> None:
        self.folder, self.presence = folder, Presence(folder, "worker", name)

    def waiting(self) -> list[str]:
        """Keys of the jobs that are to be done, from a place on that is this worker's own, so that few try the same."""
        keys = sorted(path.stem for path in self.folder.glob(f"*{JOB}"))
        place = bisect(keys, self.presence.name)
        return keys[place:] + keys[:place]

    def attempt(self, key: str) -> bool:
        """Do a job, unless it is done, or another worker is at it."""
        for number in range(LOSSES):
            claim = self._path(key, f".claim-{number}")
            try:
                os.link(self.presence.path, claim)
            except FileExistsError:
                if not self.presence.finds_lost(claim):
                    return False
                continue
            try:
                return self._do(key)
            finally:
                self._release(key, number + 1)
        self._fail(key, JobError(f"{LOSSES} workers were lost over it"))
        self._release(key, LOSSES)
        return False

    def _release(self, key: str, claims: int) -> None:
        for number in range(claims):
            self._path(key, f".claim-{number}").unlink(missing_ok=True)

    def _do(self, key: str) -> bool:
        """Do a job that is claimed, unless it was done before."""
        path = self._path(key, JOB)
        if not self._path(key, RESULT).exists():
            try:
                description = path.read_text(encoding="utf-8")
            except FileNotFoundError:  # it failed just now, or is not wanted any more
                return False
            try:
                content = pickle.dumps(perform(description))
            except Exception as error:
                self._fail(key, error)
                return True
            with whole_file(self._path(key, RESULT)) as part:
                part.write_bytes(hashlib.sha256(content).digest() + content)
        path.unlink(missing_ok=True)
        return True

    def _fail(self, key: str, error: Exception) -> None:
        """Tell why, in a line, and where."""
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        with whole_file(self._path(key, FAILED)) as part:
            part.write_text("".join([reason, "\n", *traceback.format_exception(error)]), encoding="utf-8")
        self._path(key, JOB).unlink(missing_ok=True)

    def _path(self, key: str, ending: str) -> Path:
        return self.folder / f"{key}{ending}"


def read_result(path: Path) -> Any:
    """What a job returned.

    Raises:
        ValueError: the file is damaged.
    """
    content = path.read_bytes()
    if hashlib.sha256(content[32:]).digest() != content[:32]:
        raise ValueError(f"{str(path)!r} is damaged")
    return pickle.loads(content[32:])
