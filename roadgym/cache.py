"""Where things are kept that cost time to make, and the cache of compiled code there.

Compiled code must not outlive what it was compiled from, and a compiled function holds code and constants of other modules. So
each is kept under a *stamp*, a digest of all sources of this package and of the package that the function belongs to (of its
file alone, where it belongs to none): after any edit everything is compiled anew. Nothing is written beside the sources,
numba's settings stay as they are, and where nothing can be kept everything works without.

One file holds the code of one function for one signature, or a table that it makes. It begins with a digest of the rest, so a
damaged one is as good as none, and it is written whole, so any number of processes may work at once. Stamps that were not used
for long are removed.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.util
import inspect
import logging
import multiprocessing
import os
import pickle
import re
import shutil
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import llvmlite
import numpy as np
import numpy.typing as npt

from .files import PART, whole_file

KEPT = 32  # stamps; one of the whole package takes about 5 MB
STAMP = re.compile(r"[0-9a-f]{32}")
SUFFIX = ".code"
KERNEL = f"{__package__}.kernel"  # takes nearly all of the time

_warned = False
_told = False
_digests: dict[Path, tuple[str, dict[Path, tuple[int, int]]]] = {}
_used: set[Path] = set()


def user_folder() -> Path | None:
    """This package's folder in the user's cache folder: XDG_CACHE_HOME, or what the system has; None without a home."""
    home = Path(os.path.expanduser("~"))  # noqa: PTH111 - Path.home() raises where there is none
    if sys.platform == "win32":
        usual = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    elif sys.platform == "darwin":
        usual = home / "Library" / "Caches"
    else:
        usual = home / ".cache"
    chosen = Path(os.environ.get("XDG_CACHE_HOME", ""))
    found = chosen if chosen.is_absolute() else usual
    return found / "roadgym" if found.is_absolute() else None


def _numba_folder() -> str:
    """What numba is told as the folder of its cache, by the environment or by its own file of settings; numba is not loaded."""
    if "numba" not in sys.modules and not Path(".numba_config.yaml").exists():
        return os.environ.get("NUMBA_CACHE_DIR", "")
    from numba.core import config

    return str(getattr(config, "CACHE_DIR", ""))


def compiled_folder() -> Path | None:
    """The folder of compiled code: in NUMBA_CACHE_DIR where that is set, else in `user_folder`."""
    chosen = _numba_folder()
    base = Path(chosen).absolute() / "roadgym" if chosen else user_folder()
    return None if base is None else base / "compiled"


def compiled_files() -> list[Path]:
    """All files of compiled code that are kept."""
    folder = compiled_folder()
    found: list[Path] = []
    if folder is not None:
        for stamp in _stamps(folder):
            with contextlib.suppress(OSError):
                found += [path for path in stamp.iterdir() if path.suffix == SUFFIX or PART.fullmatch(path.name)]
    return found


def clear_compiled() -> None:
    """Remove all compiled code that is kept; processes that use it go on.

    Raises:
        OSError: something cannot be removed.
    """
    for path in compiled_files():
        path.unlink(missing_ok=True)
    folder = compiled_folder()
    for stamp in [] if folder is None else _stamps(folder):
        with contextlib.suppress(OSError):  # a file has just come, or is somebody else's
            stamp.rmdir()


def _stamps(folder: Path) -> list[Path]:
    """The folders of stamps, the latest used first."""
    found = []
    with contextlib.suppress(OSError):
        for path in folder.iterdir():
            if STAMP.fullmatch(path.name):
                with contextlib.suppress(OSError):
                    found.append((path.stat().st_mtime, path))
    return [path for _, path in sorted(found, reverse=True)]


def warn_not_kept(folder: Path | None, error: OSError | None) -> None:
    """Warn, once in a process, that what was made cannot be kept and is made again the next time."""
    global _warned
    if not _warned:
        _warned = True
        why = "there is no home folder" if error is None else f"{str(folder)!r}: {error.strerror or error}"
        warnings.warn(
            f"the cache cannot be written, {why}; XDG_CACHE_HOME or NUMBA_CACHE_DIR may name another folder",
            RuntimeWarning,
            stacklevel=2,
        )


def tell_compiling() -> None:
    """Say, once and not in workers, why nothing seems to happen, through the log "roadgym": on the error stream by default."""
    global _told
    if not _told:
        _told = True
        if multiprocessing.parent_process() is None:
            logging.getLogger(__package__).warning("compiling the plant, once: up to half a minute")


def _state(file: Path) -> tuple[int, int]:
    status = file.stat()
    return status.st_mtime_ns, status.st_size


def _digest(file: Path) -> str:
    """Digest of all sources of the package that ``file`` belongs to, read when its first function is decorated."""
    root = file.parent
    while (root.parent / "__init__.py").is_file():
        root = root.parent
    root = root if (root / "__init__.py").is_file() else file
    digest, states = _digests.get(root, ("", {}))
    if states.get(file) != _state(file):  # new here, or edited and reloaded
        sources = sorted({file, *root.rglob("*.py")})
        hashed = hashlib.sha256()
        for path in sources:
            hashed.update(f"{path.relative_to(root.parent).as_posix()}\0{path.stat().st_size}\0".encode())
            hashed.update(path.read_bytes())
        digest = hashed.hexdigest()
        _digests[root] = digest, {path: _state(path) for path in sources}
    return digest


def stamp_of(*functions: Callable[..., Any] | ModuleType) -> str | None:
    """The stamp of the sources that functions, or modules, are of; None where there are none, as at a prompt."""
    try:
        own = "".join(_digest(Path(inspect.getfile(function)).absolute()) for function in functions)
        here = _digest(Path(__file__).absolute())
    except (OSError, TypeError):
        return None
    return hashlib.sha256(f"{here}{own}".encode()).hexdigest()[:32]


@functools.cache
def machine() -> tuple[Any, ...]:
    """What compiled code depends on beside its sources: processor, versions, and numba's settings; numba is not loaded."""
    import llvmlite.binding as llvm

    found = importlib.util.find_spec("numba")
    folder = None if found is None or found.origin is None else Path(found.origin).parent
    settings = {name: value for name, value in os.environ.items() if name.startswith("NUMBA_") and name != "NUMBA_CACHE_DIR"}
    return (
        llvm.get_process_triple(),
        llvm.get_host_cpu_name(),
        llvm.get_host_cpu_features().flatten(),
        (sys.implementation.cache_tag, llvmlite.__version__, np.__version__),
        None if folder is None else (folder / "_version.py").read_bytes(),
        sorted(settings.items()),
    )


class Kept:
    """What is kept of one function: its code for each signature, or tables that it has made."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self._stamp = stamp_of(function)

    @property
    def folder(self) -> Path | None:
        """Where it is kept; None where it cannot be."""
        folder = compiled_folder()
        return None if folder is None or self._stamp is None else folder / self._stamp

    @property
    def name(self) -> str:
        """The function's name in terms that every file system knows; what tells functions apart is in the digest."""
        return re.sub(r"\W+", "_", f"{self._function.__module__}_{self._function.__qualname__}")[-100:]

    def _path(self, folder: Path, signature: str) -> Path:
        code, closure = self._function.__code__, self._function.__closure__
        key = (
            self._function.__module__,
            self._function.__qualname__,
            code.co_firstlineno,
            code.co_code,
            None if closure is None else pickle.dumps(tuple(cell.cell_contents for cell in closure)),
            signature,
            machine(),
        )
        return folder / f"{self.name}-{hashlib.sha256(repr(key).encode()).hexdigest()[:32]}{SUFFIX}"

    def read(self, signature: str) -> bytes | None:
        """What is kept for a signature, or None where there is nothing, or something damaged."""
        if self.folder is None:
            return None
        path = self._path(self.folder, signature)
        try:
            content = path.read_bytes()
        except OSError:
            return None
        if hashlib.sha256(content[32:]).digest() != content[:32]:
            return None
        if path.parent not in _used:
            _used.add(path.parent)
            with contextlib.suppress(OSError):
                os.utime(path.parent)
        return content[32:]

    def write(self, signature: str, content: bytes) -> None:
        """Keep something for a signature where that is possible."""
        folder = self.folder
        if folder is None:
            if self._stamp is not None:
                warn_not_kept(None, None)
            return
        try:
            if not folder.is_dir():
                folder.mkdir(parents=True, exist_ok=True)
                for old in _stamps(folder.parent)[KEPT:]:
                    shutil.rmtree(old, ignore_errors=True)
            with whole_file(self._path(folder, signature), durable=False) as part:
                part.write_bytes(hashlib.sha256(content).digest() + content)
        except OSError as error:
            warn_not_kept(folder.parent, error)

    def tell(self) -> None:
        """Say that something is about to be compiled, if it takes long."""
        if self._function.__module__.startswith(KERNEL):
            tell_compiling()


def remembered(function: Callable[..., npt.NDArray[np.float64]], *numbers: float) -> npt.NDArray[np.float64]:
    """One row of numbers that a function makes of ``numbers``, made once and kept."""
    kept, signature = Kept(function), repr(numbers)
    content = kept.read(signature)
    if content is not None:
        return np.frombuffer(content).copy()
    made = function(*numbers)
    kept.write(signature, made.tobytes())
    return made
