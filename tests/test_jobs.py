"""Jobs: done once, wherever and by whomever, and nothing that is finished is lost."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import worked

from agents import jobs
from agents.jobs import store
from agents.jobs.store import Worker, declare_lost
from roadgym import GaussianRoad, ParameterError

DRIVER = """
import sys, worked
from agents import jobs
with jobs.executor(workers=1, store=sys.argv[1]) as executor:
    assert executor.submit(worked.add, 1, 2, folder=sys.argv[1]).result() == 3
    executor.submit(worked.rest, sys.argv[1], "rested", 2.0).result()
"""


def quiet(done, failed, total):
    """No progress."""


def here(folder, **options):
    return jobs.executor("here", store=folder, report=quiet, **options)


def told(folder):
    """Which jobs were done, each time that they were."""
    return [line.split()[0] for line in (Path(folder) / "told").read_text().splitlines()]


def until(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def ask(folder, function, *arguments):
    """A job in the folder that nobody is at; returns its key."""
    description = store.describe(function, arguments, {})
    key = store.key_of(description)
    (folder / f"{key}.job").write_text(description)
    return key


PLACES = {  # what an executor is told, and the package that it needs
    "processes": ({}, "sys"),
    "ray": ({"num_cpus": 3, "include_dashboard": False, "log_to_driver": False}, "ray"),
    "slurm": ({"cluster": "local"}, "submitit"),
}


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")  # Ray leaves files
@pytest.mark.parametrize("on", PLACES)
def test_jobs_are_done_once_and_like_everywhere(on, tmp_path, capfd):
    """Workers give what this process gives, on one thread each; a job that fails or kills one of them stops no other."""
    folder, (options, package) = str(tmp_path), PLACES[on]
    pytest.importorskip(package)
    with jobs.executor(on, workers=2, store=tmp_path / "jobs", options=options) as executor:
        sums = list(executor.map(worked.add, [0.1, 0.2, 1e300], [0.2, 1 / 3, 1e300]))
        failed, killed = executor.submit(worked.fall, "oh\nno"), executor.submit(worked.kill_the_worker, folder)
        threads, process = executor.submit(worked.surroundings).result()
        assert killed.result() == "survived"
    assert sums == [0.1 + 0.2, 0.2 + 1 / 3, 2e300]
    assert (threads, process != os.getpid()) == ("1", True)
    assert told(folder) == ["killed", "killed"]
    error = failed.exception()
    assert isinstance(error, jobs.JobError)
    assert str(error) == "fall failed: ValueError: oh no"
    assert "raise ValueError(text)\nValueError: oh" in error.traceback
    assert capfd.readouterr().err.splitlines()[-1] == "jobs: 6 of 6, 1 failed"
    assert {path.suffix for path in (tmp_path / "jobs").iterdir() if path.is_file()} == {".result", ".failed"}
    with here(tmp_path / "jobs") as executor:
        assert executor.submit(worked.surroundings).result() == (threads, process)  # kept
        assert executor.submit(worked.kill_the_worker, folder).result() == "survived"


def test_a_killed_driver_loses_nothing(tmp_path):
    """What it finished is kept, what its worker is at is waited for, and that worker ends when nobody wants it any more."""
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    driver = subprocess.Popen([sys.executable, "-c", DRIVER, tmp_path], env={**os.environ, "PYTHONPATH": path})
    until(lambda: (tmp_path / "told").exists() and "rested" in told(tmp_path))
    driver.send_signal(signal.SIGKILL)
    driver.wait()
    (kept,) = tmp_path.glob("*.driver")  # as it was left
    with here(tmp_path) as executor:
        assert executor.submit(worked.add, 1, 2, folder=str(tmp_path)).result() == 3
        assert executor.submit(worked.rest, str(tmp_path), "rested", 2.0).result() == "rested"
    assert told(tmp_path) == ["1+2", "rested"]
    os.utime(kept, (0, 0))  # as after a minute
    until(lambda: not list(tmp_path.glob("*.worker")))


def test_an_interrupted_driver_leaves_nobody_behind(tmp_path):
    def work():
        with jobs.executor(workers=1, store=tmp_path, report=quiet) as executor:
            executor.submit(worked.rest, str(tmp_path), "rested", 600.0)
            executor.submit(worked.add, 1, 2)
            until(lambda: (tmp_path / "told").exists())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work()
    assert {path.suffix for path in tmp_path.iterdir()} <= {"", ".result"}  # of the other job
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "told").read_text().split()[1]), 0)


def test_one_worker_of_many_has_a_job(tmp_path):
    workers = [Worker(tmp_path) for _ in range(4)]
    for number in range(50):
        ask(tmp_path, worked.rest, str(tmp_path), str(number), 0.002)
    threads = [threading.Thread(target=lambda w=w: [w.attempt(key) for key in w.waiting()]) for w in workers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(told(tmp_path), key=int) == list(map(str, range(50)))
    assert len(list(tmp_path.glob("*.result"))) == 50
    assert not [*tmp_path.glob("*.job"), *tmp_path.glob("*.claim-*")]


def test_jobs_of_lost_workers_are_done_by_others(tmp_path):
    key = ask(tmp_path, worked.add, 1, 2)
    other = Worker(tmp_path)
    for number in range(store.LOSSES):
        silent = Worker(tmp_path)
        os.link(silent.presence.path, tmp_path / f"{key}.claim-{number}")
        assert not other.attempt(key)
        assert (tmp_path / f"{key}.job").exists()
        if number == 0:
            os.utime(silent.presence.path, (time.time() - store.LOST - 9, time.time() - store.LOST - 9))
        else:
            declare_lost(tmp_path, silent.presence.name)
    assert not other.attempt(key)
    assert (tmp_path / f"{key}.failed").read_text().startswith("JobError: 3 workers were lost over it\n")
    with here(tmp_path) as executor:  # tries again
        assert executor.submit(worked.add, 1, 2).result() == 3
    ask(tmp_path, worked.add, 4, 5)
    os.link(other.presence.path, tmp_path / f"{ask(tmp_path, worked.add, 4, 5)}.claim-0")
    declare_lost(tmp_path, other.presence.name)
    with here(tmp_path) as executor:
        assert executor.submit(worked.add, 4, 5).result() == 9
    assert not list(tmp_path.glob("*.claim-*"))


def test_a_result_is_of_its_arguments_and_sources_and_sound(tmp_path, monkeypatch):
    folder = str(tmp_path)
    with here(tmp_path / "jobs") as executor:
        for left in (1, 1.0, 1):
            assert executor.submit(worked.add, left, folder=folder).result() == 1
    assert told(folder) == ["1+0.0", "1.0+0.0"]
    for path in (tmp_path / "jobs").glob("*.result"):
        path.write_bytes(path.read_bytes()[:-1] + b"?")
    with here(tmp_path / "jobs") as executor:
        assert executor.submit(worked.add, 1, folder=folder).result() == 1
    key = ask(tmp_path, worked.add, 1)
    monkeypatch.setattr(store, "_versions", lambda: {"python": "2"})
    with here(tmp_path / "jobs") as executor:
        assert executor.submit(worked.add, 1, folder=folder).result() == 1
    assert told(folder)[2:] == ["1+0.0", "1+0.0"]
    assert Worker(tmp_path).attempt(key)
    assert "are not those of who asked for the job" in (tmp_path / f"{key}.failed").read_text()


def test_what_is_no_job_is_refused(tmp_path):
    with here(tmp_path) as executor:
        for function in (lambda: 1, len, threading.Thread().run, None):
            with pytest.raises(ParameterError, match="function must be one of a module that workers can import, got"):
                executor.submit(function)
        with pytest.raises(ParameterError, match="must be what JSON knows, but Object of type object"):
            executor.submit(worked.add, object())
        assert executor.submit(sorted_kind, GaussianRoad(bandwidth=0.1)).result() == "gaussian"
    with pytest.raises(RuntimeError, match="after shutdown"):
        executor.submit(worked.add, 1)
    with pytest.raises(ParameterError, match="on must be one of here, processes, ray, slurm, got 'moon'"):
        jobs.executor("moon")
    with pytest.raises(ParameterError, match="workers must be at least 1, got 0"):
        jobs.executor(workers=0)
    with pytest.raises(ParameterError, match="options must be none"):
        jobs.executor(options={"num_gpus": 1})


def sorted_kind(road):
    return road["kind"]
