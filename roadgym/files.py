"""Files that are written whole or not at all, and locks that die with who holds them."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import stat
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

if sys.platform == "win32":
    import msvcrt

    def _lock(handle: int) -> None:
        try:
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        except OSError as error:
            raise BlockingIOError(error.errno, error.strerror) from None
else:
    import fcntl

    def _lock(handle: int) -> None:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise
        except OSError:  # a file system without locks: better unlocked than unusable
            pass


PART = re.compile(r"\.part-[0-9a-f]{16}(\.\w{1,8})?")


def _begin(path: str | os.PathLike[str]) -> tuple[Path, Path]:
    """(the file that ``path`` leads to, a new empty file beside it, under a name that nobody can foresee)."""
    target = Path(os.path.realpath(path))
    if target.is_dir():
        raise IsADirectoryError(f"{os.fspath(path)!r} is a folder")
    if target.exists() and not target.is_file():
        raise FileExistsError(f"{os.fspath(path)!r} is not a regular file")
    ending = target.suffix if re.fullmatch(r"\.\w{1,8}", target.suffix) else ""  # writers tell the format by it
    part = target.with_name(f".part-{secrets.token_hex(8)}{ending}")
    part.open("xb").close()  # as new, never through a link that lies there; its permissions are those of any new file
    return target, part


def sync(path: Path) -> None:
    """Let the content of a file reach the disk."""
    with path.open("rb+") as file:
        os.fsync(file.fileno())


@contextlib.contextmanager
def whole_file(path: str | os.PathLike[str], *, durable: bool = True) -> Iterator[Path]:
    """A file beside ``path`` to write to; it takes the place of ``path`` at the end, or is removed where the writing fails.

    Where ``path`` is a symbolic link, the file that it leads to is replaced and the link stays. A file that is replaced hands
    on its permissions.

    Args:
        path: the file to write.
        durable: let the content reach the disk before it takes its place, so that not even a loss of power leaves half of it.

    Raises:
        OSError: at once where ``path`` is a folder, a device, or in a folder that cannot be written.
    """
    target, part = _begin(path)
    try:
        yield part
        if durable:
            sync(part)
        with contextlib.suppress(FileNotFoundError):
            part.chmod(stat.S_IMODE(target.stat().st_mode))
        part.replace(target)
    except OSError as error:
        if error.errno is not None and error.filename in (None, str(part)):
            error.filename = os.fspath(path)  # the name that who asked for it knows
        raise
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def check_file(path: str | os.PathLike[str]) -> None:
    """Raise now what `whole_file` would raise at its beginning."""
    _, part = _begin(path)
    part.unlink()


def make_folder(path: str | os.PathLike[str]) -> Path:
    """``path`` as a folder that exists and can be written.

    Raises:
        OSError: it cannot.
    """
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise NotADirectoryError(f"{os.fspath(path)!r} is not a folder") from None
    with tempfile.TemporaryFile(dir=folder):
        pass
    return folder


def remove_parts(folder: Path) -> None:
    """Remove what killed writers left in ``folder``; nobody may be writing there."""
    for path in folder.iterdir():
        if PART.fullmatch(path.name):
            path.unlink(missing_ok=True)


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock file ``path``, which is made, and removed at the end.

    The lock is the operating system's and ends with the process, however that ends; a file that a killed process left does not
    matter. A file system without locks cannot tell, and lets everybody pass.

    Raises:
        BlockingIOError: it is held, by another process or by this one.
        OSError: the file cannot be made.
    """
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            _lock(handle)
            if os.path.samestat(os.fstat(handle), path.stat()):
                break
        except FileNotFoundError:
            pass  # the holder before removed it after it was opened here: that lock is worth nothing
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)
    try:
        yield
    finally:
        if sys.platform != "win32":  # while it is held, so that no two can hold a file of this name
            path.unlink(missing_ok=True)
        os.close(handle)
        if sys.platform == "win32":
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
