"""Training stable-baselines3 agents on the batch environment, and the folder that a trained agent is.

An agent's folder holds ``agent.json`` (what was trained, on what, with what and how far) and the model file that it names.
Each checkpoint writes a new model file first and then replaces ``agent.json`` in one step, so the folder holds a sound agent at
every moment, and an interrupted training resumes from the last one.

A model file is read with pickle: load only agents that you trust.
"""

from __future__ import annotations

import dataclasses
import datetime
import importlib.metadata
import json
import platform
import sys
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import stable_baselines3
import torch
import yaml
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize

import roadgym
from roadgym.parameters import ParameterError, whole
from roadgym.task import Task, make_task

from .errors import AgentError
from .features import Features
from .vec_env import QuarterCarVecEnv, damping_from_action, observation_space

ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"ppo": stable_baselines3.PPO}
FORMAT = 1
DESCRIPTION = "agent.json"
HYPERPARAMETERS = Path(__file__).parent / "hyperparameters"
PACKAGES = ("roadgym", "gymnasium", "stable-baselines3", "torch", "numpy", "numba", "scipy")
DEFAULT_ENVIRONMENT: dict[str, Any] = {"road": "multiplicative", "speed": (0.5, 3.2), "bandwidth": (0.05, 0.5)}


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        found[package] = importlib.metadata.version(package)
    return found


def write_atomically(path: Path, text: str) -> None:
    """Write a whole text file or leave what is there."""
    part = path.with_name(f"part-{path.name}")
    try:
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def make_folder(folder: str | Path) -> Path:
    """``folder`` as a directory that exists and can be written.

    Raises:
        AgentError: it cannot.
    """
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise AgentError(f"cannot write to the folder {str(path)!r}: {error.strerror or error}") from None
    return path


def plain(value: Any) -> Any:
    """``value`` in terms of what JSON knows; roads and speed noises as the mappings that make them again."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value)
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def load_hyperparameters(algorithm: str, file: str | Path | None = None) -> dict[str, Any]:
    """Hyperparameters of ``algorithm`` for this environment, from its own YAML file or from ``file``.

    Raises:
        ParameterError: an unknown algorithm, or a file that holds no hyperparameters for this environment.
    """
    if algorithm not in ALGORITHMS:
        raise ParameterError(f"unknown algorithm {algorithm!r}; known: {', '.join(ALGORITHMS)}")
    path = HYPERPARAMETERS / f"{algorithm}.yaml" if file is None else Path(file)
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ParameterError(f"cannot read hyperparameters from {str(path)!r}: {' '.join(str(error).split())}") from None
    chosen = content.get(roadgym.ENVIRONMENT_ID) if isinstance(content, dict) else None
    if not isinstance(chosen, dict):
        raise ParameterError(f"{str(path)!r} holds no hyperparameters for {roadgym.ENVIRONMENT_ID}")
    return chosen


def _schedule(name: str, value: Any) -> Any:
    """A linear schedule from "lin_<start>", or the value itself."""
    if isinstance(value, str) and value.startswith("lin_"):
        try:
            return LinearSchedule(float(value[4:]), 0.0, 1.0)
        except ValueError:
            raise ParameterError(f"hyperparameter {name} must be a number or lin_<number>, got {value!r}") from None
    return value


def make_model(
    algorithm: str, hyperparameters: Mapping[str, Any], environment: Mapping[str, Any], seed: int, log: Path | None
) -> BaseAlgorithm:
    """A new model on its own environments."""
    parameters = dict(hyperparameters)
    envs = make_envs(parameters, environment)
    for name in ("n_envs", "n_timesteps", "normalize", "features"):
        parameters.pop(name, None)
    policy = parameters.pop("policy", "MlpPolicy")
    network = dict(parameters.pop("policy_kwargs", {}))
    if isinstance(network.get("activation_fn"), str):
        activation = getattr(torch.nn, network["activation_fn"], None)
        if activation is None:
            raise ParameterError(f"unknown activation_fn {network['activation_fn']!r}; it must be a class of torch.nn")
        network["activation_fn"] = activation
    parameters = {name: _schedule(name, value) for name, value in parameters.items()}
    try:
        model = ALGORITHMS[algorithm](
            policy,
            envs,
            policy_kwargs=network,
            seed=seed,
            device="cpu",
            tensorboard_log=None if log is None else str(log),
            **parameters,
        )
    except TypeError as error:
        raise ParameterError(f"hyperparameters of {algorithm}: {error}") from None
    envs.seed(training_seed(seed, 0))
    return model


def training_seed(seed: int, timesteps: int) -> int:
    """Base seed of the training environments from ``timesteps`` on; no two seeds of training or evaluation share a road."""
    return stream_seed(seed, 0, timesteps)


def stream_seed(*entropy: int) -> int:
    """A base seed for a batch of environments, 63 bits, from integers that tell its purpose."""
    return int(np.random.SeedSequence(entropy).generate_state(1, np.uint64)[0] >> np.uint64(1))


def make_envs(hyperparameters: Mapping[str, Any], environment: Mapping[str, Any]) -> VecNormalize:
    """The training environments, with rewards scaled by their running spread if the hyperparameters ask for it."""
    envs = QuarterCarVecEnv(
        whole("n_envs", hyperparameters.get("n_envs", 1)), environment=environment, features=hyperparameters.get("features")
    )
    options = dict(hyperparameters.get("normalize", {}))
    if options.pop("norm_obs", False):
        raise ParameterError("norm_obs must be false: the environment scales its observations")
    return VecNormalize(
        envs,
        norm_obs=False,
        norm_reward=bool(options.pop("norm_reward", False)),
        gamma=hyperparameters.get("gamma", 0.99),
        **options,
    )


class Agent:
    """A trained agent: like every controller it answers observations with damping ratios.

    Attributes:
        model: the stable-baselines3 model.
        description: the content of agent.json.
        task: the task it was trained on.
    """

    def __init__(self, model: BaseAlgorithm, description: Mapping[str, Any], task: Task) -> None:
        self.model = model
        self.description = description
        self.task = task
        kinds = description["hyperparameters"].get("features")
        self.features = None if kinds is None else Features(task.signals, kinds)

    def predict(
        self,
        observation: npt.NDArray[np.float32],
        state: Any = None,
        episode_start: npt.NDArray[np.bool_] | None = None,
        deterministic: bool = True,
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """(D, state), D of shape (n, 1) for observations of shape (n, signals), or (1,) for one of shape (signals,)."""
        seen = observation
        if self.features is not None:
            seen = self.features(np.atleast_2d(observation)).reshape((*observation.shape[:-1], -1))
        action, state = self.model.predict(seen, state, episode_start, deterministic)
        return damping_from_action(action, self.task.damping_range), state


def load(folder: str | Path) -> Agent:
    """The agent in ``folder``.

    Raises:
        AgentError: the folder holds no agent, or a damaged one.
    """
    path = Path(folder)
    description = _read_description(path)
    try:
        task = make_task(**description["environment"])
        model = ALGORITHMS[description["algorithm"]].load(path / description["model"], device="cpu")
        agent = Agent(model, description, task)
        expected = observation_space(task.observation_space, agent.features).shape
        if model.observation_space.shape != expected:
            raise AgentError(f"its model sees {model.observation_space.shape}, its environment offers {expected}")
    except Exception as error:  # unpickling damaged files can raise anything
        raise AgentError(f"cannot load the agent in {str(path)!r}: {' '.join(str(error).split())}") from None
    return agent


def _read_description(path: Path) -> dict[str, Any]:
    if not path.is_dir():
        raise AgentError(f"no agent in {str(path)!r}: no such folder")
    try:
        description = json.loads((path / DESCRIPTION).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise AgentError(f"no agent in {str(path)!r}: it has no {DESCRIPTION}") from None
    except (OSError, ValueError) as error:
        raise AgentError(f"cannot read the agent in {str(path)!r}: {error}") from None
    if not isinstance(description, dict) or description.get("format") != FORMAT:
        raise AgentError(f"no agent in {str(path)!r}: its {DESCRIPTION} is not of format {FORMAT}")
    model = path / str(description.get("model"))
    if description.get("algorithm") not in ALGORITHMS or not zipfile.is_zipfile(model):
        raise AgentError(f"the agent in {str(path)!r} is damaged: {model.name} is missing or not a model file")
    return description


class _Checkpoint(BaseCallback):
    """Saves the agent every ``interval`` timesteps and reports progress."""

    def __init__(self, folder: Path, description: dict[str, Any], total: int, interval: int, report: Any) -> None:
        super().__init__()
        self.folder, self.description, self.total, self.interval, self.report = folder, description, total, interval, report
        self._next = interval

    def _init_callback(self) -> None:
        self._next = self.num_timesteps + self.interval

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next:
            self._next += self.interval
            save(self.folder, self.model, self.description)
        self.report(min(self.num_timesteps, self.total), self.total, self._mean_reward())
        return True

    def _mean_reward(self) -> float | None:
        episodes = self.model.ep_info_buffer
        if not episodes:
            return None
        return float(np.mean([episode["r"] / episode["l"] for episode in episodes]))


def save(folder: Path, model: BaseAlgorithm, description: dict[str, Any]) -> None:
    """Write the model under a new name, then make agent.json name it, then drop the models before it."""
    name = f"model-{model.num_timesteps}.zip"
    part = folder / f"part-{name}"
    model.save(part)
    part.replace(folder / name)
    envs = model.get_vec_normalize_env()
    spread = None if envs is None else {key: float(getattr(envs.ret_rms, key)) for key in ("mean", "var", "count")}
    content = {**description, "model": name, "timesteps": model.num_timesteps, "reward_statistics": spread}
    content["saved"] = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    write_atomically(folder / DESCRIPTION, json.dumps(content, indent=2) + "\n")
    for old in folder.glob("model-*.zip"):
        if old.name != name:
            old.unlink()


def silent(done: int, total: int, reward: float | None) -> None:
    """Report nothing."""


def train(
    folder: str | Path,
    *,
    algorithm: str = "ppo",
    environment: Mapping[str, Any] | None = None,
    hyperparameters: Mapping[str, Any] | None = None,
    seed: int = 0,
    timesteps: int | None = None,
    checkpoint_interval: int = 100_000,
    resume: bool = False,
    tensorboard: bool = False,
    report: Any = silent,
) -> Agent:
    """Train an agent into ``folder`` and return it.

    Args:
        folder: the agent's folder; must not hold an agent yet, unless ``resume``.
        algorithm: a key of `ALGORITHMS`.
        environment: parameters of the environment; by default the bounded road over a range of speeds and bandwidths.
        hyperparameters: by default those of the algorithm's YAML file.
        seed: fixes roads, weights and exploration; not negative.
        timesteps: control intervals to train for in all, over every environment; by default the hyperparameters' n_timesteps.
        checkpoint_interval: timesteps between checkpoints.
        resume: go on with the agent in ``folder``; its algorithm, environment, hyperparameters and seed hold. The noise of the
            second part is new, so the result differs from that of one unbroken run, but repeats.
        tensorboard: write logs for TensorBoard under ``folder``.
        report: called as ``report(timesteps done, in all, mean reward a step of recent episodes or None)``.

    Raises:
        ParameterError: a parameter out of range.
        AgentError: the folder cannot be written, holds an agent already, or holds none to resume.
    """
    whole("seed", seed, low=0)
    whole("checkpoint_interval", checkpoint_interval)
    path = Path(folder)
    torch.set_num_threads(1)  # the networks are small: more threads only wait for each other
    if resume:
        description = _read_description(path)
        algorithm, seed = description["algorithm"], description["seed"]
        hyperparameters, environment = description["hyperparameters"], description["environment"]
    elif (path / DESCRIPTION).exists():
        raise AgentError(f"the folder {str(path)!r} holds an agent already: resume it or choose another folder")
    else:
        hyperparameters = load_hyperparameters(algorithm) if hyperparameters is None else hyperparameters
        environment = plain(DEFAULT_ENVIRONMENT if environment is None else environment)
        description = {
            "format": FORMAT,
            "algorithm": algorithm,
            "environment": environment,
            "hyperparameters": plain(hyperparameters),
            "seed": seed,
            "versions": versions(),
            "command": " ".join(sys.argv),
        }
    total = whole("timesteps", int(hyperparameters.get("n_timesteps", 0)) if timesteps is None else timesteps)
    task = make_task(**environment)
    path = make_folder(path)
    log = path / "tensorboard" if tensorboard else None

    if resume:
        load(path)  # a damaged model is reported as such
        envs = make_envs(hyperparameters, environment)
        for key, value in (description["reward_statistics"] or {}).items():
            setattr(envs.ret_rms, key, value)
        model = ALGORITHMS[algorithm].load(
            path / description["model"], env=envs, device="cpu", tensorboard_log=None if log is None else str(log)
        )
        envs.seed(training_seed(seed, model.num_timesteps))
        torch.manual_seed(training_seed(seed, model.num_timesteps))
    else:
        model = make_model(algorithm, hyperparameters, environment, seed, log)
    remaining = total - model.num_timesteps
    if remaining > 0:
        callback = _Checkpoint(path, description, total, checkpoint_interval, report)
        try:
            model.learn(remaining, callback=callback, reset_num_timesteps=not resume, tb_log_name="train")
        except KeyboardInterrupt:
            save(path, model, description)
            raise
        save(path, model, description)
    return Agent(model, json.loads((path / DESCRIPTION).read_text(encoding="utf-8")), task)
