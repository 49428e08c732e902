"""The threads that plants share."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

MOST_THREADS = 1024  # of the pool; it starts a thread only where none is idle, so as many as are at work together

_pools: dict[int, ThreadPoolExecutor] = {}


def pool() -> ThreadPoolExecutor:
    """The thread pool of this process, one for all plants; a forked worker does not find its parent's."""
    process = os.getpid()
    if process not in _pools:
        _pools[process] = ThreadPoolExecutor(MOST_THREADS, thread_name_prefix="roadgym")
    return _pools[process]
