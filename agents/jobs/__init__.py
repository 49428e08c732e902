"""One seam for a machine or a hundred: submit a function with its arguments, and have its result as a future.

    with agents.jobs.executor(on="processes", store="runs/bounds") as executor:
        futures = [executor.submit(bound_at, speed) for speed in speeds]
    print([future.result() for future in futures])

Jobs and results are files in a folder, `agents.jobs.store`: what is done is done once, by whichever worker of whichever driver.
"""

from .executor import HERE, PLACES, JobExecutor, executor
from .store import JobError

__all__ = ["HERE", "PLACES", "JobError", "JobExecutor", "executor"]
