"""Names at their former places, which still work there, and warn."""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable
from typing import Any

from .cars import MEAN_SQUARES
from .record import OBSERVED

SIGNALS = (*MEAN_SQUARES, *OBSERVED)  # of the car of one mass; `roadgym.task.signals` has those of any


def moved(module: str, **places: str) -> Callable[[str], Any]:
    """The ``__getattr__`` of a module from which names have gone, each to the module that it is given with."""

    def look_up(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        warnings.warn(f"{module}.{name} is now {places[name]}.{name}", DeprecationWarning, stacklevel=2)
        return getattr(importlib.import_module(places[name]), name)

    return look_up
