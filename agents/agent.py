"""An agent that was trained: how it drives, and the folder that it is.

An agent's folder holds ``agent.json`` (what was trained, on what, with what and how far) and the model file that it names.
Each checkpoint writes a new model file first and then replaces ``agent.json`` in one step, so the folder holds a sound agent at
every moment, and an interrupted training resumes from the last one. While a training runs it holds a lock in the folder.

A model file is read with pickle: load only agents that you trust. Those of `agents.pretrained`, which come with the package,
are plain arrays. This module loads torch and stable-baselines3 with the first agent, not before.
"""

from __future__ import annotations

import contextlib
import datetime
import itertools
import json
import math
import os
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from roadgym import files
from roadgym.component import import_modules
from roadgym.files import whole_file
from roadgym.installation import InstallationError, needs, require
from roadgym.kalman import KalmanFilter
from roadgym.parameters import ParameterError
from roadgym.task import Task, make_task
from roadgym.vector import QuarterCarVectorEnv

from . import pretrained
from .actions import action_space, damping_from_action
from .errors import AgentError
from .estimation import updated
from .features import Sight
from .records import plain
from .wrappers import ActionLayer, blamed, learning, wrap

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

ALGORITHMS = {
    "apg": "agents.analytic_gradient.APG",
    "ppo": "stable_baselines3.PPO",
    "sac": "stable_baselines3.SAC",
    "td3": "stable_baselines3.TD3",
    "a2c": "stable_baselines3.A2C",
    "dqn": "stable_baselines3.DQN",
    "recurrent_ppo": "sb3_contrib.RecurrentPPO",
}
FORMAT = 1
DESCRIPTION = "agent.json"
MODEL = re.compile(r"model-\d+(-\d+)?\.zip")
CONTENT: dict[str, type | tuple[type, ...]] = {  # what agent.json must hold to be loaded, resumed and reported
    "algorithm": str,
    "environment": dict,
    "hyperparameters": dict,
    "seed": int,
    "command": str,
    "model": str,
    "timesteps": int,
    "reward_statistics": (dict, type(None)),
    "saved": str,
}
STATISTICS = ("mean", "var", "count")  # of the rewards that are scaled
TRAINING = "training.pickle"  # in the file of a model that is still trained
DEFAULT_ENVIRONMENT: dict[str, Any] = {"road": "multiplicative", "speed": (0.5, 3.2), "bandwidth": (0.05, 0.5)}


def algorithm_class(algorithm: str) -> type[BaseAlgorithm]:
    """The class of ``algorithm``, a key of `ALGORITHMS`.

    Raises:
        ParameterError: an unknown algorithm.
        InstallationError: its package is not installed.
    """
    if algorithm not in ALGORITHMS:
        raise ParameterError(f"unknown algorithm {algorithm!r}; known: {', '.join(ALGORITHMS)}")
    module, _, name = ALGORITHMS[algorithm].rpartition(".")
    found: type[BaseAlgorithm] = getattr(require(module, "recurrent" if module == "sb3_contrib" else "train"), name)
    return found


class Agent:
    """A trained agent: like every controller it answers observations with damping ratios.

    Attributes:
        model: the stable-baselines3 model.
        description: the content of agent.json.
        task: the task it was trained on.
        sight: what its policy sees of observations.
        damping_levels: number of levels of its answers, or None.
        layers: the wrappers that change its actions, the outermost first.
    """

    def __init__(self, model: BaseAlgorithm, description: Mapping[str, Any], task: Task) -> None:
        self.model = model
        self.description = description
        self.task = task
        hyperparameters = description["hyperparameters"]
        self.filter, self.seen, self.sight = _sight(task, hyperparameters)
        self.damping_levels = hyperparameters.get("damping_levels")
        self.layers: list[ActionLayer] = []
        if hyperparameters.get("wrappers"):
            batch = QuarterCarVectorEnv(1, threads=1, **description["environment"])
            learned = learning(batch, features=None, damping_levels=self.damping_levels, training_reward="cost")
            _, self.layers = wrap(learned, hyperparameters["wrappers"])

    def predict(
        self,
        observation: npt.NDArray[np.float32],
        state: Any = None,
        episode_start: npt.NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """(D, state), D of shape (n, 1) for observations of shape (n, signals), or (1,) for one of shape (signals,).

        The state is what the agent remembers: the observations that it stacks, the state of a recurrent network and what a
        Kalman filter knows; None for an agent that has none of them. Hand it back with the next observations; rows where
        ``episode_start`` is true forget.
        """
        rows, belief = np.atleast_2d(observation), None
        frames, memory, filtered = (None, None, None) if state is None else state
        if self.filter is not None:
            belief = updated(self.filter, filtered, rows, episode_start)
            rows = self.filter.observation(belief)
        frames = self.sight.stack(frames, rows, episode_start)
        action, memory = self.model.predict(self.sight(rows, frames), memory, episode_start, deterministic)
        for layer in self.layers:
            with blamed(type(layer).__name__):
                action = layer.actions(action)
        damping = damping_from_action(action, self.task.damping_range, self.damping_levels)
        filtered = None if belief is None else (belief, damping.reshape(-1, 1))
        remembered = None if frames is None and memory is None and filtered is None else (frames, memory, filtered)
        return damping.reshape((*observation.shape[:-1], 1)), remembered


def _sight(task: Task, hyperparameters: Mapping[str, Any]) -> tuple[KalmanFilter | None, Task, Sight]:
    """(the filter between sensors and policy or None, the task as it is seen behind it, what the policy sees of that)."""
    known = None if hyperparameters.get("estimator") is None else KalmanFilter(task)
    seen = task if known is None else known.full
    return known, seen, Sight(seen, hyperparameters.get("features"), hyperparameters.get("frame_stack", 1))


def load(folder: str | Path) -> Agent:
    """The agent in ``folder``, or, where there is no such folder, the one that comes with the package for a task of the suite.

    Args:
        folder: the folder, or the name of the task, such as "Paper-v0".

    Raises:
        AgentError: the folder holds no agent, or a damaged one.
        InstallationError: a package that it needs is not installed.
    """
    path = Path(folder)
    shipped = None if path.exists() else pretrained.find(str(folder))
    description, weights = (read_description(path), None) if shipped is None else pretrained.read(shipped)
    with needs("train"):
        import torch
    torch.set_num_threads(1)  # as in training
    try:
        task = task_of(description)
        kind = algorithm_class(description["algorithm"])
        if weights is None:
            model = kind.load(path / description["model"], device="cpu")
        else:
            model = _model(kind, description["hyperparameters"], task, weights)
        agent = Agent(model, description, task)
        seen, offered = model.observation_space.shape, agent.sight.space.shape
        if seen != offered:
            raise AgentError(f"its model sees {seen}, its environment offers {offered}")
    except InstallationError:
        raise
    except Exception as error:  # unpickling damaged files can raise anything
        remedy = "; its module must lie in the working folder or on PYTHONPATH"
        missing = isinstance(error, ParameterError) and isinstance(error.__cause__, ModuleNotFoundError)
        reason = " ".join(str(error).split()) + (remedy if missing else "")
        raise AgentError(f"cannot load the agent in {str(path)!r}: {reason}") from None
    return agent


def _model(kind: Any, hyperparameters: Mapping[str, Any], task: Task, weights: pretrained.Weights) -> BaseAlgorithm:
    """A model of these weights, which drives; it has no environment."""
    import torch

    network = dict(hyperparameters.get("policy_kwargs", {}))
    if "activation_fn" in network:
        network["activation_fn"] = getattr(torch.nn, network["activation_fn"])
    model: BaseAlgorithm = kind(
        hyperparameters.get("policy", "MlpPolicy"), None, policy_kwargs=network, device="cpu", _init_setup_model=False
    )
    model.observation_space = _sight(task, hyperparameters)[2].space
    model.action_space = action_space(hyperparameters.get("damping_levels"))
    model.n_envs = 1
    model._setup_model()
    model.policy.load_state_dict({name: torch.as_tensor(array) for name, array in weights.items()})
    return model


def weights_of(agent: Agent) -> dict[str, npt.NDArray[Any]]:
    """The weights of an agent's policy by name, for `agents.pretrained.write`."""
    return {name: tensor.detach().cpu().numpy() for name, tensor in agent.model.policy.state_dict().items()}


def task_of(description: Mapping[str, Any]) -> Task:
    """The task of an agent from its description; modules that it names are imported where a component of it is not known.

    Raises:
        ParameterError: a component that stays unknown, or a module that cannot be imported.
    """
    try:
        return make_task(**description["environment"])
    except ParameterError:
        if not description.get("imports"):
            raise
    import_modules(description["imports"])
    return make_task(**description["environment"])


def complete(hyperparameters: Mapping[str, Any]) -> dict[str, Any]:
    """Hyperparameters as they are compared: in terms of what JSON knows, with the reward that holds where none is named."""
    return {"training_reward": "cost", **plain(hyperparameters)}


def read_description(path: Path) -> dict[str, Any]:
    """The content of the agent.json in a folder, checked, with complete hyperparameters.

    Raises:
        AgentError: the folder holds no agent, or a damaged one.
    """
    if not path.is_dir():
        raise AgentError(f"no agent in {str(path)!r}: no such folder")
    try:
        description = json.loads((path / DESCRIPTION).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise AgentError(f"no agent in {str(path)!r}: it has no {DESCRIPTION}") from None
    except (OSError, ValueError, RecursionError) as error:
        raise AgentError(f"cannot read the agent in {str(path)!r}: {error}") from None
    if not isinstance(description, dict) or description.get("format") != FORMAT:
        raise AgentError(f"no agent in {str(path)!r}: its {DESCRIPTION} is not of format {FORMAT}")
    for name, kind in CONTENT.items():
        if name not in description or not isinstance(description[name], kind):
            raise AgentError(f"the agent in {str(path)!r} is damaged: its {DESCRIPTION} has no sound {name!r}")
    statistics = description["reward_statistics"]
    if statistics is not None and not all(
        isinstance(statistics.get(key), (int, float)) and math.isfinite(statistics[key]) for key in STATISTICS
    ):
        raise AgentError(f"the agent in {str(path)!r} is damaged: its {DESCRIPTION} has no sound 'reward_statistics'")
    if not isinstance(imports := description.get("imports", []), list) or not all(isinstance(name, str) for name in imports):
        raise AgentError(f"the agent in {str(path)!r} is damaged: its {DESCRIPTION} has no sound 'imports'")
    model = path / description["model"]
    if not MODEL.fullmatch(description["model"]) or not zipfile.is_zipfile(model):
        raise AgentError(f"the agent in {str(path)!r} is damaged: {model.name!r} is missing or not a model file")
    return description | {"hyperparameters": complete(description["hyperparameters"])}


def save(folder: Path, model: BaseAlgorithm, description: dict[str, Any], training: bytes | None = None) -> None:
    """Write the model under a new name, then make agent.json name it, then drop the model that it named before.

    With the model lies what `agents.checkpoints` keeps of its ``training``, if that is to go on.

    Raises:
        AgentError: it cannot be written; the agent that was there stays.
    """
    before = None
    with contextlib.suppress(AgentError):
        before = read_description(folder)["model"]
    stem = f"model-{model.num_timesteps}"
    names = (f"{stem}.zip" if number == 0 else f"{stem}-{number}.zip" for number in itertools.count())
    name = next(name for name in names if name == before or not os.path.lexists(folder / name))  # nobody else's is touched
    envs = model.get_vec_normalize_env()
    spread = None if envs is None else {key: float(getattr(envs.ret_rms, key)) for key in STATISTICS}
    content = {**description, "model": name, "timesteps": model.num_timesteps, "reward_statistics": spread}
    content["saved"] = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    try:
        # all is on the disk before the two files take their places, one right after the other: who is killed between them
        # leaves a model that nobody names
        with whole_file(folder / DESCRIPTION, durable=False) as text, whole_file(folder / name, durable=False) as part:
            text.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
            with part.open("wb") as file:
                model.save(file)
            if training is not None:
                with zipfile.ZipFile(part, "a") as parts:
                    parts.writestr(TRAINING, training)
            files.sync(text)
            files.sync(part)
        if before not in (None, name):
            (folder / before).unlink(missing_ok=True)
    except OSError as error:
        raise AgentError(f"cannot save the agent in {str(folder)!r}: {error.strerror or error}") from None
