"""Training stable-baselines3 agents on the batch environment, into the folders that `agents.agent` describes."""

from __future__ import annotations

import itertools
import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import roadgym
from roadgym import files
from roadgym.installation import needs, require
from roadgym.parameters import ParameterError, non_negative, whole
from roadgym.task import Task, make_task

from .advantage import has_advantage
from .advantage_reward import AdvantageReward
from .agent import (
    ALGORITHMS,
    CONTENT,
    DEFAULT_ENVIRONMENT,
    DESCRIPTION,
    FORMAT,
    MODEL,
    STATISTICS,
    Agent,
    algorithm_class,
    load,
    read_description,
    save,
)
from .errors import AgentError
from .records import (
    LOCK,
    PACKAGES,
    locked,
    make_folder,
    make_output,
    plain,
    stream_seed,
    training_seed,
    versions,
    write_atomically,
)
from .vec_env import QuarterCarVecEnv

with needs("train"):
    import torch
    import yaml
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.noise import NormalActionNoise
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
    from stable_baselines3.common.utils import LinearSchedule
    from stable_baselines3.common.vec_env import VecNormalize

__all__ = [  # with names that live in `agents.agent` and `agents.records`
    "ALGORITHMS",
    "CONTENT",
    "DEFAULT_ENVIRONMENT",
    "DESCRIPTION",
    "FORMAT",
    "HYPERPARAMETERS",
    "LOCK",
    "MODEL",
    "OWN_HYPERPARAMETERS",
    "PACKAGES",
    "STATISTICS",
    "Agent",
    "AgentError",
    "algorithm_class",
    "load",
    "load_hyperparameters",
    "locked",
    "make_envs",
    "make_folder",
    "make_model",
    "make_output",
    "plain",
    "save",
    "silent",
    "stream_seed",
    "train",
    "training_reward",
    "training_seed",
    "versions",
    "write_atomically",
]
OWN_HYPERPARAMETERS = (  # all others go to the algorithm
    "n_envs",
    "n_timesteps",
    "normalize",
    "features",
    "frame_stack",
    "damping_levels",
    "policy",
    "policy_kwargs",
    "noise_std",
    "training_reward",
)
LARGEST_FILE = 1_000_000  # bytes of a file of hyperparameters, those shipped take 2000
MOST_NODES = 10_000  # numbers, texts and lists in it, its aliases written out
HYPERPARAMETERS = Path(__file__).parent / "hyperparameters"


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
    return found


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
    kind = algorithm_class(algorithm)
    envs = make_envs(hyperparameters, environment)
    policy = hyperparameters.get("policy", "MlpPolicy")
    network = dict(hyperparameters.get("policy_kwargs", {}))
    if isinstance(network.get("activation_fn"), str):
        activation = getattr(torch.nn, network["activation_fn"], None)
        if activation is None:
            raise ParameterError(f"unknown activation_fn {network['activation_fn']!r}; it must be a class of torch.nn")
        network["activation_fn"] = activation
    parameters = {name: _schedule(name, value) for name, value in hyperparameters.items() if name not in OWN_HYPERPARAMETERS}
    if "noise_std" in hyperparameters:
        spread = non_negative("noise_std", hyperparameters["noise_std"])
        parameters["action_noise"] = NormalActionNoise(np.zeros(1), np.full(1, spread))
    try:
        model = kind(
            policy,
            envs,
            policy_kwargs=network,
            seed=seed,
            device="cpu",
            tensorboard_log=None if log is None else str(log),
            **parameters,
        )
    except (TypeError, ValueError, AssertionError) as error:
        raise ParameterError(f"hyperparameters of {algorithm}: {' '.join(str(error).split())}") from None
    envs.seed(training_seed(seed, 0))
    return model


def training_reward(hyperparameters: Mapping[str, Any], task: Task) -> str:
    """What is learned from: "cost", or "advantage" where the hyperparameters ask for it and theory knows it on this plant.

    Raises:
        ParameterError: hyperparameters that ask for something else.
    """
    chosen = hyperparameters.get("training_reward", "cost")
    if chosen not in ("cost", "advantage"):
        raise ParameterError(f'training_reward must be "cost" or "advantage", got {chosen!r}')
    return chosen if has_advantage(task) else "cost"


def make_envs(hyperparameters: Mapping[str, Any], environment: Mapping[str, Any]) -> VecNormalize:
    """The training environments, with rewards scaled by their running spread if the hyperparameters ask for it."""
    batch = QuarterCarVecEnv(
        whole("n_envs", hyperparameters.get("n_envs", 1)),
        environment=environment,
        features=hyperparameters.get("features"),
        frame_stack=hyperparameters.get("frame_stack", 1),
        damping_levels=hyperparameters.get("damping_levels"),
    )
    envs = AdvantageReward(batch) if training_reward(hyperparameters, batch.task) == "advantage" else batch
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


class _Checkpoint(BaseCallback):
    """Saves the agent every ``interval`` timesteps and reports progress."""

    def __init__(self, folder: Path, description: dict[str, Any], total: int, interval: int, report: Any) -> None:
        super().__init__()
        self.folder, self.description, self.total, self.interval, self.report = folder, description, total, interval, report
        self._next = interval

    def _init_callback(self) -> None:
        self._next = self.model.num_timesteps + self.interval

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next:
            self._next += self.interval * (1 + (self.num_timesteps - self._next) // self.interval)  # one for all that passed
            save(self.folder, self.model, self.description)
        self.report(min(self.num_timesteps, self.total), self.total, self._mean_reward())
        return True

    def _mean_reward(self) -> float | None:
        episodes = self.model.ep_info_buffer
        if not episodes:
            return None
        return float(np.mean([episode["r"] / episode["l"] for episode in episodes]))


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
            second part is new, so the result differs from that of one unbroken run, but repeats. A replay buffer is not
            saved: an off-policy algorithm fills it anew, for learning_starts timesteps of random damping, before it learns on.
        tensorboard: write logs for TensorBoard under ``folder``.
        report: called as ``report(timesteps done, in all, mean reward a step of recent episodes or None)``.

    Raises:
        ParameterError: a parameter out of range.
        AgentError: the folder cannot be written, is in use by another training, holds an agent already, or none to resume.
        InstallationError: a package that it needs is not installed.
    """
    whole("seed", seed, low=0)
    whole("checkpoint_interval", checkpoint_interval)
    path = Path(folder)
    torch.set_num_threads(1)  # the networks are small: more threads only wait for each other
    if resume:
        description = read_description(path)
    else:
        _refuse_agent(path)
        hyperparameters = load_hyperparameters(algorithm) if hyperparameters is None else hyperparameters
        environment = plain(DEFAULT_ENVIRONMENT if environment is None else environment)
        description = {
            "format": FORMAT,
            "algorithm": algorithm,
            "environment": environment,
            "hyperparameters": plain(hyperparameters),
            "training_reward": training_reward(hyperparameters, make_task(**environment)),
            "seed": seed,
            "versions": versions(),
            "command": " ".join(sys.argv),
        }
    # a missing package or a wrong number is told before the folder is there
    algorithm_class(description["algorithm"])
    if tensorboard:
        require("tensorboard", "train")
    total = _total(description["hyperparameters"], timesteps)
    make_folder(path)
    with locked(path / LOCK, "training"):
        files.remove_parts(path)
        if resume:
            description = read_description(path)  # another training may have gone on with it
            total = _total(description["hyperparameters"], timesteps)
            model = _resumed(path, description, tensorboard)
        else:
            _refuse_agent(path)
            own = description["hyperparameters"], description["environment"]
            model = make_model(algorithm, *own, seed, _log(path, tensorboard))
        remaining = total - model.num_timesteps
        if remaining > 0:
            callback = _Checkpoint(path, description, total, checkpoint_interval, report)
            try:
                model.learn(remaining, callback=callback, reset_num_timesteps=not resume, tb_log_name="train")
            except KeyboardInterrupt:
                save(path, model, description)
                raise
            save(path, model, description)
        description = json.loads((path / DESCRIPTION).read_text(encoding="utf-8"))
    return Agent(model, description, make_task(**description["environment"]))


def _refuse_agent(path: Path) -> None:
    if os.path.lexists(path / DESCRIPTION):
        raise AgentError(f"the folder {str(path)!r} holds an agent already: resume it or choose another folder")


def _total(hyperparameters: Mapping[str, Any], timesteps: int | None) -> int:
    return whole("timesteps", int(hyperparameters.get("n_timesteps", 0)) if timesteps is None else timesteps)


def _log(path: Path, tensorboard: bool) -> Path | None:
    return path / "tensorboard" if tensorboard else None


def _resumed(path: Path, description: Mapping[str, Any], tensorboard: bool) -> BaseAlgorithm:
    """The model of a folder on environments of its own, to be trained on."""
    load(path)  # a damaged model is reported as such
    hyperparameters, seed, log = description["hyperparameters"], description["seed"], _log(path, tensorboard)
    envs = make_envs(hyperparameters, description["environment"])
    for key, value in (description["reward_statistics"] or {}).items():
        setattr(envs.ret_rms, key, value)
    model = algorithm_class(description["algorithm"]).load(
        path / description["model"], env=envs, device="cpu", tensorboard_log=None if log is None else str(log)
    )
    if isinstance(model, OffPolicyAlgorithm):  # its replay buffer is empty
        model.learning_starts = model.num_timesteps + hyperparameters.get("learning_starts", 100)
    model.set_random_seed(training_seed(seed, model.num_timesteps) % 2**32)
    envs.seed(training_seed(seed, model.num_timesteps))
    return model
