"""Shared by all tests: a compilation cache of their own, and windows that do not show."""

import hashlib
import os
import tempfile
from pathlib import Path

# A cached kernel does not see an edited function that it calls, so the cache's folder depends on all sources.
_SOURCES = sorted((Path(__file__).parents[1] / "roadgym").rglob("*.py"))
_DIGEST = hashlib.sha256(b"".join(path.read_bytes() for path in _SOURCES)).hexdigest()[:16]
os.environ.setdefault("NUMBA_CACHE_DIR", str(Path(tempfile.gettempdir()) / f"roadgym-test-cache-{_DIGEST}"))

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # no windows on the screen of who runs the tests
