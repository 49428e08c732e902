"""Shared by all tests: windows that do not show, and linear algebra on one thread."""

import os

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # no windows on the screen of who runs the tests
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the matrices are small: threads cost more than they bring
