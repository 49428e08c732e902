"""Hyperparameters: YAML files of this folder and of one's own, in the convention of rl-baselines3-zoo, which reads them too."""

from __future__ import annotations

import ast
import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import roadgym
from roadgym.installation import needs
from roadgym.parameters import ParameterError, shown

from ..agent import ALGORITHMS
from ..features import FEATURES

with needs("train"):
    import yaml

LARGEST_FILE = 1_000_000  # bytes of a file of hyperparameters, those shipped take 2000
MOST_NODES = 10_000  # numbers, texts and lists in it, its aliases written out
HYPERPARAMETERS = Path(__file__).parent
LEARNING = "agents.wrappers.learning"  # the zoo's name of what puts our wrappers on


def load_hyperparameters(algorithm: str, file: str | Path | None = None) -> dict[str, Any]:
    """Hyperparameters of ``algorithm`` for this environment.

    Args:
        algorithm: a key of `ALGORITHMS`.
        file: a YAML file, or the name of one of those in `HYPERPARAMETERS`, such as "ppo_stacked"; by default the algorithm's.

    Raises:
        ParameterError: an unknown algorithm, or a file that holds no hyperparameters for this environment.
    """
    if not isinstance(algorithm, str) or algorithm not in ALGORITHMS:
        name = algorithm if isinstance(algorithm, str) else type(algorithm).__name__
        raise ParameterError(f"unknown algorithm {name!r}; known: {', '.join(ALGORITHMS)}")
    chosen = algorithm if file is None else file
    shipped = [path.stem for path in sorted(HYPERPARAMETERS.glob("*.yaml"))]
    path = HYPERPARAMETERS / f"{chosen}.yaml" if str(chosen) in shipped else Path(chosen)
    try:
        content = _read_yaml(path)
    except (OSError, ValueError, yaml.YAMLError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise ParameterError(
            f"cannot read hyperparameters from {str(path)!r}: {reason}; by name there are: {', '.join(shipped)}"
        ) from None
    found = content.get(roadgym.ENVIRONMENT_ID) if isinstance(content, dict) else None
    if not isinstance(found, dict):
        raise ParameterError(f"{str(path)!r} holds no hyperparameters for {roadgym.ENVIRONMENT_ID}")
    return _from_zoo(found)


def _from_zoo(found: Mapping[str, Any]) -> dict[str, Any]:
    """Hyperparameters as `train` takes them, from what rl-baselines3-zoo takes too; those that it does not know stay.

    Raises:
        ParameterError: what it takes and we do not.
    """
    result = dict(found)
    wrapper = result.pop("env_wrapper", None)
    if wrapper is not None:
        given = wrapper[0] if isinstance(wrapper, list) and len(wrapper) == 1 else wrapper
        given = {given: {}} if isinstance(given, str) else given
        if not isinstance(given, dict) or list(given) != [LEARNING] or not isinstance(given[LEARNING] or {}, dict):
            raise ParameterError(f"env_wrapper must be {LEARNING} alone, got {shown(wrapper)}")
        arguments = given[LEARNING] or {}
        for name, value in arguments.items():
            if result.setdefault(name, value) != value:
                raise ParameterError(f"{name} must stand in the file once, got {shown(result[name])} beside {shown(value)}")
        result = {"features": list(FEATURES), "training_reward": "advantage"} | result
    if result.pop("noise_type", "normal") != "normal":
        raise ParameterError(f"noise_type must be normal, got {shown(found['noise_type'])}")
    for name in ("policy_kwargs", "normalize"):
        if isinstance(result.get(name), str):
            result[name] = _mapping(name, result[name])
    return result


def _mapping(name: str, text: str) -> dict[str, Any]:
    """What ``dict(net_arch=[64, 64], activation_fn=nn.ReLU)`` says, with the class as its name: nothing is evaluated."""
    try:
        literal = ast.literal_eval
        call = ast.parse(text, mode="eval").body
        if not (isinstance(call, ast.Call) and ast.unparse(call.func) == "dict" and not call.args):
            raise ValueError
        values = {each.arg: each.value for each in call.keywords}
        return {
            str(key): value.attr if isinstance(value, ast.Attribute) and ast.unparse(value.value) == "nn" else literal(value)
            for key, value in values.items()
        }
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise ParameterError(
            f"{name} must be a mapping, or dict(...) of plain values and classes of nn, got {text!r}"
        ) from None


def _read_yaml(path: Path) -> Any:
    """The content of a YAML file, of a size that hyperparameters can have; ValueError where it is larger."""
    with path.open("rb") as file:
        text = file.read(LARGEST_FILE + 1)
    if len(text) > LARGEST_FILE:
        raise ValueError(f"it has more than {LARGEST_FILE} bytes")
    node = yaml.compose(text.decode("utf-8"), yaml.SafeLoader)
    sizes: dict[int, int] = {}

    def size(node: yaml.Node) -> int:
        """Number of nodes under ``node``, each as often as it is named."""
        if id(node) not in sizes:
            sizes[id(node)] = MOST_NODES + 1  # what it has if it holds itself
            parts = node.value if isinstance(node, yaml.CollectionNode) else ()
            sizes[id(node)] = 1 + sum(map(size, itertools.chain(*parts) if isinstance(node, yaml.MappingNode) else parts))
        return sizes[id(node)]

    if node is not None and size(node) > MOST_NODES:
        raise ValueError(f"it has more than {MOST_NODES} entries, its aliases written out")
    return yaml.safe_load(text)
