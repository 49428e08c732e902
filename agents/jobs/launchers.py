"""Where workers run: processes of this machine, tasks of Ray, or jobs of Slurm. Each is one `agents.jobs.worker.serve`."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

from roadgym.installation import require
from roadgym.parameters import ParameterError
from roadgym.processors import processors

from .worker import serve

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
PATIENCE = 60.0  # s, for a worker that is told to end


def environment() -> dict[str, str]:
    """What differs in the environment of a worker: as many threads on every machine, and the modules of this process."""
    return {**ONE_THREAD, "PYTHONPATH": os.pathsep.join(path or str(Path.cwd()) for path in sys.path)}


class Handle(Protocol):
    """A worker that was started."""

    def alive(self) -> bool:
        """Is it still there, or still to come?"""

    def stop(self) -> None:
        """Tell it to end."""

    def join(self) -> None:
        """Wait for it to end."""


class Launcher(Protocol):
    """Starts workers.

    Attributes:
        workers: how many at once, where nobody says.
        shared: may they be elsewhere, so that the folder must be one that all see?
    """

    workers: int | None
    shared: bool

    def start(self, folder: Path, name: str) -> Handle:
        """Start a worker of this name."""

    def close(self) -> None:
        """End what was begun for all workers."""


class _Process:
    def __init__(self, folder: Path, name: str) -> None:
        command = [sys.executable, "-m", __package__, str(folder), name, *sys.argv]
        self._process = subprocess.Popen(command, env={**os.environ, **environment()}, stdin=subprocess.DEVNULL)

    def alive(self) -> bool:
        return self._process.poll() is None

    def stop(self) -> None:
        self._process.terminate()

    def join(self) -> None:
        try:
            self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class Processes:
    """Workers are processes of this machine."""

    shared = False

    def __init__(self, options: Mapping[str, Any]) -> None:
        if options:
            raise ParameterError(f"options must be none for processes, got {', '.join(options)}")
        self.workers: int | None = processors()

    def start(self, folder: Path, name: str) -> Handle:
        """See `Launcher`."""
        return _Process(folder, name)

    def close(self) -> None:
        """See `Launcher`."""


class _Task:
    def __init__(self, ray: Any, reference: Any) -> None:
        self._ray, self._reference = ray, reference

    def alive(self) -> bool:
        return not self._ray.wait([self._reference], timeout=0)[0]

    def stop(self) -> None:
        self._ray.cancel(self._reference)

    def join(self) -> None:
        with contextlib.suppress(self._ray.exceptions.RayError):
            self._ray.get(self._reference, timeout=PATIENCE)


class Ray:
    """Workers are tasks of a Ray cluster: the one that this process is connected to, or RAY_ADDRESS names, else a local one.

    Options are those of ``ray.init``.
    """

    shared = True

    def __init__(self, options: Mapping[str, Any]) -> None:
        self._ray = require("ray", "ray")
        self._own = not self._ray.is_initialized()
        if self._own:
            self._ray.init(**options)
        self.workers: int | None = int(self._ray.cluster_resources().get("CPU", 1))
        self._task = self._ray.remote(num_cpus=1, max_retries=0, runtime_env={"env_vars": environment()})(serve)

    def start(self, folder: Path, name: str) -> Handle:
        """See `Launcher`."""
        return _Task(self._ray, self._task.remote(str(folder), name, *sys.argv))

    def close(self) -> None:
        """See `Launcher`."""
        if self._own:
            self._ray.shutdown()


class _SlurmJob:
    def __init__(self, job: Any) -> None:
        self._job = job

    def alive(self) -> bool:
        return not self._job.done()

    def stop(self) -> None:
        self._job.cancel(check=False)

    def join(self) -> None:
        with contextlib.suppress(Exception):  # it was told to end, however it does
            self._job.wait()


class Slurm:
    """Workers are jobs of Slurm, by submitit; their logs are in the folder's ``slurm``.

    Options are those of ``submitit.AutoExecutor.update_parameters``, such as ``slurm_partition`` and ``timeout_min``;
    ``cluster`` "local" starts processes instead, to try it.
    """

    shared = True
    workers: int | None = None

    def __init__(self, options: Mapping[str, Any]) -> None:
        self._submitit = require("submitit", "slurm")
        self._options = {"name": "roadgym", "cpus_per_task": 1, **options}
        self._cluster = self._options.pop("cluster", "slurm")

    def start(self, folder: Path, name: str) -> Handle:
        """See `Launcher`."""
        executor = self._submitit.AutoExecutor(folder / "slurm", cluster=self._cluster)
        executor.update_parameters(**self._options)
        with _in_environment():
            return _SlurmJob(executor.submit(serve, str(folder), name, *sys.argv))

    def close(self) -> None:
        """See `Launcher`."""


@contextlib.contextmanager
def _in_environment() -> Iterator[None]:
    """This process has a worker's environment for a moment, which Slurm hands on."""
    before = dict(os.environ)
    os.environ.update(environment())
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


LAUNCHERS: dict[str, Any] = {"processes": Processes, "ray": Ray, "slurm": Slurm}  # each takes its options
