"""Components by name: registries of what a plant is made of, such as `roadgym.ROADS`, and how one's own is added."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.metadata
import inspect
import os.path
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Generic, TypeVar

from .parameters import ParameterError, shown

Component = TypeVar("Component")

FILE = "file"  # parameter of a component that is read from one
ENTRY_POINTS = "roadgym.components"  # group of entry points: by a kind, the module whose import registers it


def import_modules(modules: Iterable[str]) -> None:
    """Import modules for what they register; they are looked for in the working folder too, after everywhere else.

    Raises:
        ParameterError: one that is not there, or that raises.
    """
    for module in modules:
        if (here := str(Path.cwd())) not in sys.path:
            sys.path.append(here)
        try:
            importlib.import_module(module)
        except Exception as error:  # somebody else's module can raise anything
            raise ParameterError(f"cannot import {module!r}: {' '.join(str(error).split())}") from error


def make_part(kind: type[Component], what: str, value: Any) -> Component:
    """A part that is of one class alone, from a mapping of its parameters, or as it is.

    Raises:
        ParameterError: something else, an unknown parameter, or a value out of range.
    """
    if isinstance(value, kind):
        return value
    if not isinstance(value, Mapping):
        raise ParameterError(f"{what} must be a mapping of parameters or a {kind.__name__}, got {shown(value)}")
    known = list(inspect.signature(kind).parameters)
    for name in value:
        if name not in known:
            raise ParameterError(f"unknown parameter {shown(name)} of {what}; known: {', '.join(known)}")
    return kind(**value)


class Registry(dict[str, type[Component]], Generic[Component]):
    """Classes of one sort of component by name.

    Args:
        what: what they are, as messages call it.
        base: their common class.
        entries: those that are there from the beginning.
        presets: mappings that have a name of their own.
        of_file: the kind that the name of a file stands for; among its ``constructors`` is that of the parameter `FILE`.
    """

    def __init__(
        self,
        what: str,
        base: Any,
        entries: Mapping[str, type[Component]],
        presets: Mapping[str, Mapping[str, Any]] | None = None,
        of_file: str | None = None,
    ) -> None:
        super().__init__(entries)
        self.what, self.base, self.presets, self.of_file = what, base, dict(presets or {}), of_file

    def register(self, name: str, component: type[Component]) -> None:
        """Add a component, for use by name in the environment, in theory, in tests and in every command.

        Raises:
            ParameterError: no class of this sort, whose field ``kind`` is another name, or a name that is taken.
        """
        if not (isinstance(component, type) and issubclass(component, self.base) and dataclasses.is_dataclass(component)):
            raise ParameterError(
                f"{self.what} {name!r} must be a dataclass that is a {self.base.__name__}, got {shown(component)}"
            )
        kind = {field.name: field.default for field in dataclasses.fields(component)}.get("kind")
        if not isinstance(name, str) or name != kind:
            raise ParameterError(f"name of the {self.what} must be its kind, {kind!r}, got {shown(name)}")
        if self.get(name, component) is not component and self[name].__qualname__ != component.__qualname__:
            raise ParameterError(f"{self.what} {name!r} exists already: {self[name].__module__}.{self[name].__qualname__}")
        self[name] = component

    def make(self, value: Any) -> Component:
        """A component from its name, from a mapping with the key "kind" and its parameters, or as it is.

        A name may also be that of a file that exists, where a kind is read from files and none has this name. The kind may
        be one of the ``presets``, whose parameters hold where they are not given. The parameters are those of the class, or of
        the first of its ``constructors`` whose parameter is among them. A kind that is not there is looked for among the entry
        points of installed packages, in the group `ENTRY_POINTS`.

        Raises:
            ParameterError: unknown kind or parameter, or a value out of range.
        """
        if isinstance(value, self.base):
            return value  # type: ignore[no-any-return]
        if isinstance(value, str):
            value = self.presets.get(value, self._file(value) or {"kind": value})
        if not isinstance(value, Mapping):
            raise ParameterError(f"{self.what} must be a name, a mapping or a {self.base.__name__}, got {shown(value)}")
        parameters = dict(value)
        kind = parameters.pop("kind", None)
        if isinstance(kind, str) and kind in self.presets:
            parameters = {**self.presets[kind], **parameters}
            kind = parameters.pop("kind")
        if isinstance(kind, str) and kind not in self:
            import_modules(point.module for point in importlib.metadata.entry_points(group=ENTRY_POINTS, name=kind))
        if not isinstance(kind, str) or kind not in self:
            file = "" if self.of_file is None else ", or a file that exists"
            raise ParameterError(f"unknown {self.what} {shown(kind)}; known: {', '.join([*self, *self.presets])}{file}")
        component: Any = self[kind]
        own = next((name for name in component.constructors if name in parameters), None)
        others = [] if own else list(component.constructors)
        if own is not None:
            component = getattr(component, component.constructors[own])
        signature = inspect.signature(component).parameters
        allowed = list(signature)
        for name in parameters:
            if name not in allowed:
                beside, known = f" beside {own!r}" if own else "", ", ".join([*allowed, *others])
                raise ParameterError(f"unknown parameter {shown(name)} of {self.what} {kind!r}{beside}; known: {known}")
        for name in allowed:
            if signature[name].default is inspect.Parameter.empty and name not in parameters:
                instead = f"{name} beside {own!r}" if own else " or ".join([name, *others])
                raise ParameterError(f"{self.what} {kind!r} needs {instead}, got {shown(dict(value))}")
        return component(**parameters)  # type: ignore[no-any-return]

    def _file(self, name: str) -> dict[str, Any] | None:
        """What a name that is that of a file stands for; None where it is not."""
        known = self.of_file is not None and name not in self and os.path.isfile(name)  # noqa: PTH113 - any text
        return {"kind": self.of_file, FILE: name} if known else None

    def lasting(self, value: Any) -> Any:
        """``value``, or the component itself where a file stands for it, which may change or be left behind."""
        of_file = FILE in value if isinstance(value, Mapping) else isinstance(value, str) and self._file(value)
        return self.make(value) if of_file else value
