"""Shared by all tests: windows that do not show, and linear algebra on one thread."""

import os

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # no windows on the screen of who runs the tests
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the matrices are small: threads cost more than they bring
if "PYTEST_XDIST_WORKER" in os.environ:  # several processes at once, of which each has a processor
    os.environ.setdefault("OMP_NUM_THREADS", "1")
