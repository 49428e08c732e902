"""A trained agent as files that need no Python: C99, ONNX, or a table of the damping over two signals."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from roadgym import files
from roadgym.parameters import ParameterError

from ..agent import Agent
from ..errors import AgentError
from .c_files import c_files
from .table import Tabulated, table_files, tabulate, told

__all__ = ["Tabulated", "check_output", "export", "file_name", "tabulate", "told"]


def onnx_files(agent: Agent, name: str) -> dict[str, bytes]:
    """The file by its name; see `agents.export.onnx_graph.onnx_file`."""
    from .onnx_graph import onnx_file  # it needs the extra onnx

    return {f"{name}.onnx": onnx_file(agent, name)}


FORMS: dict[str, Callable[[Any, str], Mapping[str, str | bytes]]] = {"c": c_files, "onnx": onnx_files, "table": table_files}
ENDINGS = {  # of the files of each, after the name
    "c": (".h", ".c", "_check.c", "_vectors.h"),
    "onnx": (".onnx",),
    "table": ("_table.csv", "_table.h", "_table.c"),
}


def file_name(text: str) -> str:
    """What names the files and begins the names of C in them, of a folder's name."""
    plain = re.sub(r"\W", "_", text, flags=re.ASCII).strip("_")
    return plain if plain[:1].isalpha() else f"agent_{plain}".rstrip("_")


def check_output(to: str, output: str | Path, name: str) -> Path:
    """``output`` as the folder of new files, before the work.

    Raises:
        ParameterError: an unknown form, or a name that C does not allow.
        AgentError: the folder is not there or cannot be written, or one of the files is there already.
    """
    folder = Path(output)
    if to not in FORMS:
        raise ParameterError(f"to must be one of {', '.join(FORMS)}, got {to!r}")
    if not re.fullmatch(r"[A-Za-z]\w*", name, flags=re.ASCII):
        raise ParameterError(f"name must be letters, digits and underscores, a letter first, got {name!r}")
    if not folder.is_dir():
        raise AgentError(f"cannot write to {str(folder)!r}: no such folder")
    for path in (folder / f"{name}{ending}" for ending in ENDINGS[to]):
        if os.path.lexists(path):
            raise AgentError(f"{str(path)!r} is there already: choose another folder or another name")
        with written(path):
            files.check_file(path)
    return folder


@contextlib.contextmanager
def written(path: Path) -> Iterator[None]:
    """Tell in one line what cannot be written."""
    try:
        yield
    except OSError as error:
        raise AgentError(f"cannot write {str(path)!r}: {error.strerror or error}") from None


def write(contents: Mapping[str, str | bytes], folder: Path) -> list[Path]:
    """Write files, each whole or not at all, and none before the last one's content is on the disk."""
    paths = [folder / name for name in contents]
    with written(folder), contextlib.ExitStack() as stack:
        for path, content in zip(paths, contents.values(), strict=True):
            part = stack.enter_context(files.whole_file(path, durable=False))
            part.write_bytes(content if isinstance(content, bytes) else content.encode())
            files.sync(part)
    return paths


def export(source: Agent | Tabulated, to: str, output: str | Path = ".", name: str = "agent") -> list[Path]:
    """Write an agent into a folder as C99 or ONNX, or what `tabulate` made of it as a table; returns the files.

    Args:
        source: an agent, as `agents.load` gives it; of a table what `tabulate` gives.
        to: "c", "onnx" or "table".
        output: the folder, which must be there; no file in it is replaced.
        name: of the files, and the beginning of the names in C.

    Raises:
        ParameterError: an unknown form, or a name that C does not allow.
        AgentError: files that cannot be written or are there already, or an agent that cannot be exported; one line says why.
        InstallationError: ONNX is not installed.
    """
    folder = check_output(to, output, name)
    return write(FORMS[to](source, name), folder)
