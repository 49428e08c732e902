"""Road models. To add one: write a file like its neighbours and a line in `ROADS`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

from ..parameters import ParameterError, shown
from .base import Road
from .first_order import FirstOrderRoad
from .gaussian import GaussianRoad
from .harmonic import HarmonicRoad
from .multiplicative import MultiplicativeRoad

__all__ = ["ROADS", "FirstOrderRoad", "GaussianRoad", "HarmonicRoad", "MultiplicativeRoad", "Road", "make_road"]

ROADS: dict[str, type[Road]] = {
    "harmonic": HarmonicRoad,
    "first_order": FirstOrderRoad,
    "gaussian": GaussianRoad,
    "multiplicative": MultiplicativeRoad,
}

Component = TypeVar("Component")


def make_road(road: str | Mapping[str, Any] | Road) -> Road:
    """A road from its name, from a mapping with the key "kind" and its parameters, or as it is.

    Raises:
        ParameterError: unknown kind or parameter, or a value out of range.
    """
    return make_component("road", road, Road, ROADS)  # type: ignore[type-abstract]


def make_component(what: str, value: Any, base: type[Component], table: Mapping[str, type[Component]]) -> Component:
    """An instance of ``base`` from a name in ``table``, from a mapping, or as it is."""
    if isinstance(value, base):
        return value
    if isinstance(value, str):
        value = {"kind": value}
    if not isinstance(value, Mapping):
        raise ParameterError(f"{what} must be a name, a mapping or a {base.__name__}, got {shown(value)}")
    parameters = dict(value)
    kind = parameters.pop("kind", None)
    if not isinstance(kind, str) or kind not in table:
        raise ParameterError(f"unknown {what} {shown(kind)}; known: {', '.join(table)}")
    cls = table[kind]
    allowed = [field.name for field in dataclasses.fields(cls) if field.init]  # type: ignore[arg-type]
    for name in parameters:
        if name not in allowed:
            raise ParameterError(f"unknown parameter {shown(name)} of {what} {kind!r}; known: {', '.join(allowed)}")
    return cls(**parameters)
