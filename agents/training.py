"""Training stable-baselines3 agents on the batch environment, into the folders that `agents.agent` describes."""

from __future__ import annotations

import contextlib
import inspect
import logging
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from roadgym import files
from roadgym.component import import_modules
from roadgym.installation import needs, require
from roadgym.parameters import ParameterError, non_negative, whole
from roadgym.task import Task, make_task

from .advantage import hidden, is_differentiable
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
    complete,
    load,
    read_description,
    save,
    task_of,
)
from .checkpoints import Checkpoints, thawed
from .errors import AgentError
from .hyperparameters import HYPERPARAMETERS, load_hyperparameters
from .progress import training_progress
from .records import (
    LOCK,
    PACKAGES,
    check_seed,
    differing,
    lasting,
    locked,
    make_folder,
    make_output,
    plain,
    stream_seed,
    texts,
    training_seed,
    versions,
    write_atomically,
)
from .vec_env import QuarterCarVecEnv
from .wrappers import training_reward, with_wrappers, wrapper_names

with needs("train"):
    import torch
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.logger import Logger
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
    "rollout",
    "save",
    "silent",
    "stream_seed",
    "train",
    "training_reward",
    "training_seed",
    "usual_algorithm",
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
    "estimator",
    "wrappers",
)


def usual_algorithm(task: Task, chosen: bool, wrappers: Sequence[Any] = (), estimator: str | None = None) -> str:
    """The algorithm where none is named: "apg", or "ppo" where that cannot be.

    That is where hyperparameters are ``chosen``, which are those of "ppo"; with wrappers, which may pay for something else than
    the cost; behind a valve of limited rate, or any with an ``estimator``; and behind sensors without an ``estimator``, or with
    biases, delays or intervals.
    """
    return "ppo" if chosen or wrappers or not is_differentiable(task, estimator) else "apg"


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
    known = [name for name in inspect.signature(kind).parameters if name[0] != "_"]
    for name in parameters:
        if name not in known:
            raise ParameterError(f"hyperparameters of {algorithm}: unknown {name!r}; known: {', '.join(known)}")
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
    except ParameterError:
        raise
    except (TypeError, ValueError, AssertionError) as error:
        raise ParameterError(f"hyperparameters of {algorithm}: {' '.join(str(error).split())}") from None
    envs.seed(training_seed(seed, 0))
    return _without_log(model, log)


def _without_log(model: BaseAlgorithm, log: Path | None) -> BaseAlgorithm:
    """The model, which would make a temporary folder where it has no log to write, and leave it behind."""
    if log is None:
        model.set_logger(Logger(folder=None, output_formats=[]))
    return model


def rollout(algorithm: str, hyperparameters: Mapping[str, Any]) -> int:
    """Control intervals over all environments between two updates: what is trained for is a multiple of it.

    Raises:
        ParameterError: an unknown algorithm, or a number of environments or steps that is none.
    """
    kind = algorithm_class(algorithm)
    name = "train_freq" if issubclass(kind, OffPolicyAlgorithm) else "n_steps"
    steps = hyperparameters.get(name, inspect.signature(kind).parameters[name].default)
    if isinstance(steps, (list, tuple)):  # a number and its unit, steps or episodes, which end as they like
        steps = steps[0] if steps[1] == "step" else 1
    return whole("n_envs", hyperparameters.get("n_envs", 1)) * whole(name, steps)


def make_envs(hyperparameters: Mapping[str, Any], environment: Mapping[str, Any]) -> VecNormalize:
    """The training environments, with rewards scaled by their running spread if the hyperparameters ask for it."""
    batch = QuarterCarVecEnv(
        whole("n_envs", hyperparameters.get("n_envs", 1)),
        environment=environment,
        features=hyperparameters.get("features"),
        frame_stack=hyperparameters.get("frame_stack", 1),
        damping_levels=hyperparameters.get("damping_levels"),
        training_reward=hyperparameters.get("training_reward", "cost"),
        estimator=hyperparameters.get("estimator"),
        wrappers=hyperparameters.get("wrappers", ()),
    )
    options = dict(hyperparameters.get("normalize", {}))
    if options.pop("norm_obs", False):
        raise ParameterError("norm_obs must be false: the environment scales its observations")
    return VecNormalize(
        batch,
        norm_obs=False,
        norm_reward=bool(options.pop("norm_reward", False)),
        gamma=hyperparameters.get("gamma", 0.99),
        **options,
    )


Report = Callable[[int, int, float | None], None]


def silent(done: int, total: int, reward: float | None) -> None:
    """Report nothing."""


def train(
    folder: str | Path,
    *,
    algorithm: str | None = None,
    environment: Mapping[str, Any] | None = None,
    hyperparameters: Mapping[str, Any] | None = None,
    seed: int | None = None,
    timesteps: int | None = None,
    checkpoint_interval: int = 100_000,
    resume: bool = False,
    wrappers: Sequence[str | Callable[[Any], Any]] = (),
    imports: Sequence[str] = (),
    tensorboard: bool = False,
    report: Report | None = None,
) -> Agent:
    """Train an agent into ``folder`` and return it.

    Args:
        folder: the agent's folder; must not hold an agent yet, unless ``resume``.
        algorithm: a key of `ALGORITHMS`; by default that of `usual_algorithm`.
        environment: parameters of the environment; by default the bounded road over a range of speeds and bandwidths.
        hyperparameters: by default those of the algorithm's YAML file.
        seed: fixes roads, weights and exploration; not negative, 0 by default.
        timesteps: control intervals to train for in all, over every environment; by default the hyperparameters' n_timesteps.
            An algorithm learns from whole rollouts (`rollout`), so the last one is completed.
        checkpoint_interval: timesteps between checkpoints, at least; they are between rollouts. Whoever interrupts or kills a
            training loses what came after the last one.
        resume: go on with the agent in ``folder``; its algorithm, environment, hyperparameters, wrappers and seed hold, and
            must be those that are given. From a checkpoint the result is that of an unbroken run, bit by bit, where wrappers of
            one's own can be pickled. An agent that was trained to its end, and is to be trained for longer, meets new noise
            instead, and an off-policy algorithm, whose replay buffer is gone, fills that anew for learning_starts timesteps of
            random damping.
        wrappers: functions or classes, or "module:name" of them, around the batch of training, the innermost first, after those
            of the hyperparameters: Gymnasium's vector wrappers or one's own. They may pay other rewards, made of the infos, and
            map actions as a ``VectorActionWrapper`` does, which the agent repeats wherever it drives; observations must stay
            as they are. Costs are evaluated without them.
        imports: modules that register components of one's own; they are imported here, and `agents.load` imports them again
            where a component is not known. Those that hold the components' classes need not be named.
        tensorboard: write logs for TensorBoard under ``folder``.
        report: called as ``report(timesteps done, in all, mean reward a step of recent episodes or None)``; by default progress
            is told on the error stream, and `silent` tells nothing.

    Raises:
        ParameterError: a parameter out of range, or other than that of the agent that is resumed.
        AgentError: the folder cannot be written, is in use by another training, holds an agent already, or none to resume.
        InstallationError: a package that it needs is not installed.
    """
    check_seed(0 if seed is None else seed)
    whole("checkpoint_interval", checkpoint_interval)
    path = Path(folder)
    torch.set_num_threads(1)  # the networks are small: more threads only wait for each other
    imports = texts("imports", imports)
    import_modules(imports)
    names = wrapper_names(wrappers)
    if resume:
        description = read_description(path)
        asked = None
        if hyperparameters is not None or names:
            own = description["hyperparameters"]
            inner = own | {"wrappers": own.get("wrappers", [])[: -len(names)]} if hyperparameters is None else hyperparameters
            asked = complete(with_wrappers(inner, names))
        held = None if environment is None else lasting(environment)
        _refuse_contradictions(path, description, algorithm, held, asked, seed)
        if timesteps is not None and outlasts(description, timesteps):
            known = description["timesteps"]
            raise ParameterError(f"timesteps must be at least the {known} of the agent in {str(path)!r}, got {timesteps}")
    else:
        _refuse_agent(path)
        environment = lasting(DEFAULT_ENVIRONMENT if environment is None else environment)
        task, seed = make_task(**environment), 0 if seed is None else seed
        algorithm = usual_algorithm(task, hyperparameters is not None, names) if algorithm is None else algorithm
        hyperparameters = load_hyperparameters(algorithm) if hyperparameters is None else hyperparameters
        hyperparameters = with_wrappers(hyperparameters, names)
        description = {
            "format": FORMAT,
            "algorithm": algorithm,
            "environment": environment,
            "hyperparameters": complete(hyperparameters),
            "training_reward": getattr(
                algorithm_class(algorithm),
                "learns_from",
                training_reward(hyperparameters.get("training_reward", "cost"), task),
            ),
            "filter_told": _filter_told(algorithm, task, hyperparameters),
            "imports": _homes(task, imports),
            "seed": seed,
            "versions": versions(),
            "command": " ".join(sys.argv),
        }
    # a missing package or a wrong number is told before the folder is there
    algorithm_class(description["algorithm"])
    if tensorboard:
        require("tensorboard", "train")
    total = total_timesteps(description["algorithm"], description["hyperparameters"], timesteps)
    if timesteps is not None and total != timesteps and total > description.get("timesteps", 0):
        of = rollout(description["algorithm"], description["hyperparameters"])
        logging.getLogger("roadgym").warning("%d timesteps are no whole rollouts of %d: training for %d", timesteps, of, total)
    if not resume:
        own = description["hyperparameters"], description["environment"]
        model = make_model(description["algorithm"], *own, description["seed"], _log(path, tensorboard))
    with _folder(path), locked(path / LOCK, "training"):
        files.remove_parts(path)
        new: list[str] = []
        if resume:
            description = read_description(path)  # another training may have gone on with it
            known = description.get("imports", [])
            new = [name for name in imports if name not in known]
            description["imports"] = [*known, *new]
            model = _resumed(path, description, tensorboard)
        else:
            _refuse_agent(path)
        remaining = total - model.num_timesteps
        if remaining > 0:
            with training_progress() if report is None else contextlib.nullcontext(report) as tell:
                callback = Checkpoints(path, description, total, checkpoint_interval, tell)
                model.learn(remaining, callback=callback, reset_num_timesteps=not resume, tb_log_name="train")
        if remaining > 0 or new:
            save(path, model, description)
        description = read_description(path)
    return Agent(model, description, task_of(description))


@contextlib.contextmanager
def _folder(path: Path) -> Iterator[None]:
    """The folder is there; one that was not, and in which nothing is saved, is gone at the end."""
    there = path.exists()
    make_folder(path)
    try:
        yield
    finally:
        if not there:
            with contextlib.suppress(OSError):  # it holds an agent
                path.rmdir()


def _filter_told(algorithm: str, task: Task, hyperparameters: Mapping[str, Any]) -> list[str]:
    """What an estimator is told in training where the gradient knows it, and has to find when the agent drives."""
    knows = getattr(algorithm_class(algorithm), "learns_from", "") == "gradient"
    return list(hidden(task)) if knows and hyperparameters.get("estimator") is not None else []


def _homes(task: Task, imports: Sequence[str]) -> list[str]:
    """The modules that must be imported for the components of ``task``: those named, then those that have their classes."""
    named = [component_type.__module__ for component_type in map(type, (task.road, task.speed_noise, task.car))]
    own = [name for name in named if name.partition(".")[0] not in ("roadgym", "builtins", "__main__")]
    return list(dict.fromkeys([*imports, *own]))


def _refuse_agent(path: Path) -> None:
    if os.path.lexists(path / DESCRIPTION):
        raise AgentError(f"the folder {str(path)!r} holds an agent already: resume it or choose another folder")


def _refuse_contradictions(path: Path, description: Mapping[str, Any], *given: Any) -> None:
    """What is ``given`` of algorithm, environment, hyperparameters and seed must be that of the agent that is resumed."""
    for name, value in zip(("algorithm", "environment", "hyperparameters", "seed"), map(plain, given), strict=True):
        if value is not None and value != description[name]:
            known, got = differing(description[name], value)
            raise ParameterError(f"{name} must be {known}, as of the agent in {str(path)!r} that is resumed, got {got}")


def total_timesteps(algorithm: str, hyperparameters: Mapping[str, Any], timesteps: int | None) -> int:
    """What is trained for in all: ``timesteps``, or else the hyperparameters' n_timesteps, in whole rollouts."""
    asked = whole("timesteps", int(hyperparameters.get("n_timesteps", 0)) if timesteps is None else timesteps)
    whole_rollout = rollout(algorithm, hyperparameters)
    return -(-asked // whole_rollout) * whole_rollout


def outlasts(description: Mapping[str, Any], timesteps: int | None) -> bool:
    """Has an agent trained longer than for ``timesteps``, by more than the end of a rollout?"""
    algorithm, hyperparameters = description["algorithm"], description["hyperparameters"]
    total = total_timesteps(algorithm, hyperparameters, timesteps)
    return bool(description["timesteps"] >= total + rollout(algorithm, hyperparameters))


def _log(path: Path, tensorboard: bool) -> Path | None:
    return path / "tensorboard" if tensorboard else None


def _resumed(path: Path, description: Mapping[str, Any], tensorboard: bool) -> BaseAlgorithm:
    """The model of a folder on environments of its own, to be trained on."""
    load(path)  # a damaged model is reported as such
    hyperparameters, seed, log = description["hyperparameters"], description["seed"], _log(path, tensorboard)
    unbroken = thawed(path / description["model"])
    if unbroken is not None:
        unbroken.tensorboard_log = None if log is None else str(log)
        return _without_log(unbroken, log)
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
    return _without_log(model, log)
