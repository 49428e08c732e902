"""What is installed: packages that an extra brings, and whether `agents` and `analysis` are those of roadgym.

A plain installation holds gymnasium, numba, NumPy and scipy. Whoever needs more imports it within `needs`, which
says in one line which extra brings it. The names `agents` and `analysis` are nobody's own: another distribution may overwrite
them, and a folder beside a script comes before them. `check_package` finds out.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.metadata
import importlib.util
import shlex
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

from gymnasium.error import DependencyNotInstalled

MARK = b'__distribution__ = "roadgym"'  # in the sources of our own packages


class InstallationError(DependencyNotInstalled, ImportError):
    """A package that is not installed, or another one in its place."""


@contextlib.contextmanager
def needs(extra: str) -> Iterator[None]:
    """Around imports of packages that ``extra`` brings, a key of ``project.optional-dependencies``.

    Raises:
        InstallationError: one is not installed; one line says what installs it.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = str(error.name).partition(".")[0]
        raise InstallationError(
            f"the package {package} is not installed, which the extra {extra} brings: {install_command(extra)}", name=package
        ) from None


def require(package: str, extra: str) -> ModuleType:
    """A package that ``extra`` brings.

    Raises:
        InstallationError: it is not installed; one line says what installs it.
    """
    with needs(extra):
        return importlib.import_module(package)


def install_command(extra: str) -> str:
    """What adds an extra to this installation: in a checkout to the checkout, as no index may have roadgym."""
    root = Path(__file__).resolve().parents[1]
    if not (root / "pyproject.toml").is_file():
        return f"pip install 'roadgym[{extra}]'"
    where = "." if root == Path.cwd() else root
    return f"pip install -e {shlex.quote(f'{where}[{extra}]')}"


def check_package(name: str) -> None:
    """That ``import name`` finds the package of roadgym.

    Raises:
        InstallationError: another distribution, a folder or a file has taken the name; one line says which, and the remedy.
    """
    spec = importlib.util.find_spec(name)
    if spec is None or spec.origin is None:  # a folder without __init__.py is what uninstalling the other distribution leaves
        raise InstallationError(f"the package {name} of roadgym is not whole: install roadgym again", name=name)
    file = Path(spec.origin).resolve()
    if file == (Path(__file__).parents[1] / name / "__init__.py").resolve() and MARK in file.read_bytes():
        return
    owner = _distribution_of(name, file)
    if owner is not None:
        raise InstallationError(
            f"the package {name} is here that of {owner}, not that of roadgym: install roadgym in an environment of its own, "
            f"or uninstall {owner.partition(' ')[0]} and install roadgym again",
            name=name,
        )
    taken = f"the folder {file.parent}" if file.name == "__init__.py" else f"the file {file}"
    raise InstallationError(
        f"the package {name} is here {taken}, not that of roadgym: rename it, or take it out of Python's path", name=name
    )


def _distribution_of(name: str, file: Path) -> str | None:
    """Name and version of the distribution, other than roadgym, whose list of files has this one."""
    for distribution in importlib.metadata.distributions():
        for path in distribution.files or ():
            if (
                path.as_posix() in (f"{name}/__init__.py", f"{name}.py")
                and distribution.name != "roadgym"
                and Path(str(distribution.locate_file(path))).resolve() == file
            ):
                return f"{distribution.name} {distribution.version}"
    return None
