"""Where a search's study is kept: in an SQLite file for one process at a time, or in a folder for any number of processes."""

from __future__ import annotations

import contextlib
import datetime
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from .errors import AgentError
from .jobs.store import LOST, Presence
from .records import locked, make_folder

if TYPE_CHECKING:
    import optuna

WORKER = "worker"  # attribute of a trial in a folder: the name of the process that is at it


class Place(Protocol):
    """Where a study is kept, as long as this process works on it."""

    storage: Any  # as of `optuna.create_study`

    def begin(self, trial: optuna.Trial) -> None:
        """This process is at a trial."""

    def alive(self, trial: optuna.trial.FrozenTrial) -> bool:
        """May some other process be at a running trial?"""


class _File:
    def __init__(self, path: Path) -> None:
        self.storage = f"sqlite:///{path}"

    def begin(self, trial: optuna.Trial) -> None:
        pass

    def alive(self, trial: optuna.trial.FrozenTrial) -> bool:
        return False  # this process alone has the file


class _Folder:
    def __init__(self, package: Any, folder: Path, presence: Presence) -> None:
        journal = package.storages.journal
        self.storage = journal.JournalStorage(journal.JournalFileBackend(str(folder / "journal.log")))
        self._folder, self._presence = folder, presence

    def begin(self, trial: optuna.Trial) -> None:
        trial.set_user_attr(WORKER, self._presence.name)

    def alive(self, trial: optuna.trial.FrozenTrial) -> bool:
        if WORKER not in trial.user_attrs:  # it has just been begun, or its process was killed at once
            begun = trial.datetime_start or datetime.datetime.now()
            return datetime.datetime.now() - begun < datetime.timedelta(seconds=LOST)
        sign = self._folder / f"{trial.user_attrs[WORKER]}.worker"
        return sign.exists() and not self._presence.finds_lost(sign)


@contextlib.contextmanager
def held(package: Any, storage: str | Path) -> Iterator[Place]:
    """The place of a study, a folder where ``storage`` is one or ends like one; else a file, kept from other processes.

    Raises:
        AgentError: it cannot be used, or the file is in use; or its database fails, such as on a full disk.
    """
    path = Path(storage)
    try:
        if path.is_dir() or os.fspath(storage).endswith(("/", os.sep)):
            presence = Presence(make_folder(path), "worker")
            try:
                yield _Folder(package, path, presence)
            finally:
                presence.end()
        else:
            make_folder(path.parent)
            with locked(path.with_name(f".{path.name}.lock"), "search"):
                yield _File(path)
    except package.exceptions.StorageInternalError as error:
        reason = str(error.__cause__ or error).splitlines()[0]
        raise AgentError(f"cannot use {str(path)!r} as a study: {reason}") from None
