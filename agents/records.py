"""What makes work repeat and be found again: folders, whole text files, locks, versions, values as JSON, seeds by purpose."""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import importlib.metadata
import platform
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from roadgym import ROADS, files
from roadgym.files import whole_file
from roadgym.parameters import ParameterError, shown, whole

from .errors import AgentError

LOCK = ".lock"  # in the folder of a training or a comparison while it runs
PACKAGES = ("roadgym", "gymnasium", "stable-baselines3", "torch", "numpy", "numba", "scipy")
LARGEST_SEED = 2**32 - 1  # of torch and NumPy, which stable-baselines3 seeds


class Purpose(enum.IntEnum):
    """What a base seed is drawn for, the second number of its entropy.

    A number stands for a batch of roads once; SEARCH and SAMPLER, which draw no roads themselves, share theirs with others.
    They must stay as they are: the same seed would meet other roads.
    """

    TRAINING = 0
    EVALUATION = 1
    PICTURE = 2
    FILM = 3
    EXPORT = 4
    SEARCH = 2  # the seed of a search's evaluations, which draw their roads from it
    SAMPLER = 3  # what a search draws its trials with


def stream_seed(*entropy: int) -> int:
    """A base seed for a batch of environments, 63 bits, from integers: the user's seed, a `Purpose`, and more if need be."""
    return int(np.random.SeedSequence(entropy).generate_state(1, np.uint64)[0] >> np.uint64(1))


def check_seed(seed: int) -> None:
    """Raise `ParameterError` unless a training can have this seed."""
    if whole("seed", seed, low=0) > LARGEST_SEED:
        raise ParameterError(f"seed must be at most {LARGEST_SEED} for a training, got {seed}")


def training_seed(seed: int, timesteps: int) -> int:
    """Base seed of the training environments from ``timesteps`` on; no two seeds of training or evaluation share a road."""
    return stream_seed(seed, Purpose.TRAINING, timesteps)


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on, of those that are installed."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[package] = importlib.metadata.version(package)
    return found


def write_atomically(path: Path, text: str) -> None:
    """Write a whole text file or leave what is there."""
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")


def make_folder(folder: str | Path) -> Path:
    """``folder`` as a directory that exists and can be written.

    Raises:
        AgentError: it cannot.
    """
    try:
        return files.make_folder(folder)
    except OSError as error:
        raise AgentError(f"cannot write to the folder {str(folder)!r}: {error.strerror or error}") from None


def make_output(file: str | Path) -> Path:
    """``file`` as a path that can be written, in a folder that exists.

    Raises:
        AgentError: it cannot.
    """
    path = Path(file)
    try:
        files.make_folder(path.parent)
        files.check_file(path)
    except OSError as error:
        raise AgentError(f"cannot write {str(path)!r}: {error.strerror or error}") from None
    return path


@contextlib.contextmanager
def locked(path: Path, work: str) -> Iterator[None]:
    """Hold the lock file ``path`` while ``work`` is done beside it.

    Raises:
        AgentError: another process, or another thread of this one, holds it.
    """
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(files.locked(path))
        except BlockingIOError:
            raise AgentError(f"{str(path.parent)!r} is in use by another {work}") from None
        except OSError as error:
            raise AgentError(f"cannot write {str(path)!r}: {error.strerror or error}") from None
        yield


def texts(name: str, value: Any) -> list[str]:
    """A list of strings, or one string, as a list.

    Raises:
        ParameterError: something else.
    """
    found = [value] if isinstance(value, str) else value
    if not isinstance(found, (list, tuple)) or not all(isinstance(text, str) for text in found):
        raise ParameterError(f"{name} must be a list of strings, got {shown(value)}")
    return list(found)


def differing(known: Any, value: Any, show: Callable[[Any], str] = repr) -> tuple[str, str]:
    """Two values in words; of mappings no more than what differs."""
    if not (isinstance(known, Mapping) and isinstance(value, Mapping)):
        return show(known), show(value)
    names = [name for name in {**known, **value} if name not in known or name not in value or known[name] != value[name]]

    def told(side: Mapping[str, Any]) -> str:
        return ", ".join(f"{show(name)}: {show(side[name]) if name in side else 'not given'}" for name in names)

    return f"{{{told(known)}}}", f"{{{told(value)}}}"


def lasting(environment: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters of the environment in terms of what JSON knows, and a road in place of the file that it is read from.

    Raises:
        ParameterError: such a file that cannot be read.
    """
    road = {"road": ROADS.lasting(environment["road"])} if "road" in environment else {}
    found: dict[str, Any] = plain({**environment, **road})
    return found


def plain(value: Any) -> Any:
    """``value`` in terms of what JSON knows; roads and speed noises as the mappings that make them again."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value)
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value
