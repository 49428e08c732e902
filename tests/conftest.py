"""Shared by all tests: windows that do not show."""

import os

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # no windows on the screen of who runs the tests
