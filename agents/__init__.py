"""Who drives, and how far from optimal: controllers, training, evaluation and comparison.

The names below are imported when they are first used, so that importing this package loads neither torch nor
stable-baselines3.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from roadgym.installation import check_package

if TYPE_CHECKING:
    from .agent import Agent as Agent
    from .agent import load as load
    from .comparison import compare as compare
    from .controllers import CONTROLLERS as CONTROLLERS
    from .controllers import Controller as Controller
    from .controllers import make_controller as make_controller
    from .errors import AgentError as AgentError
    from .evaluation import evaluate as evaluate
    from .training import train as train
    from .tuning import tune as tune

_HOME = {
    "CONTROLLERS": "controllers",
    "Agent": "agent",
    "AgentError": "errors",
    "Controller": "controllers",
    "compare": "comparison",
    "evaluate": "evaluation",
    "load": "agent",
    "make_controller": "controllers",
    "train": "training",
    "tune": "tuning",
}
__all__ = sorted(_HOME)
__distribution__ = "roadgym"  # by which roadgym tells this package from others of its name

check_package("analysis")  # on which this package rests


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
