"""Search for hyperparameters with Optuna, in a study that is kept and gone on with by the same call.

What is least is the mean, over operating points, of the agent's cost over that of the best constant damping by theory, on roads
that neither training nor any comparison meets. A trial is given up early where its cost so far is above the median of the
trials before it at the same time.

Source: T. Akiba, S. Sano, T. Yanase, T. Ohta and M. Koyama, "Optuna: a next-generation hyperparameter optimization framework",
KDD 2019; the sampler is its tree-structured Parzen estimator.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import roadgym
from roadgym.installation import needs, require
from roadgym.parameters import ParameterError, whole
from roadgym.task import Task, make_task

from .agent import DEFAULT_ENVIRONMENT, Agent, algorithm_class, complete
from .errors import AgentError
from .evaluation import evaluate, make_points
from .records import Purpose, differing, lasting, make_output, stream_seed, write_atomically
from .study import Place, held
from .theory import optimum
from .training import load_hyperparameters, make_model
from .wrappers import with_wrappers

with needs("train"):
    import torch
    import yaml
    from stable_baselines3.common.callbacks import BaseCallback

if TYPE_CHECKING:
    import optuna

# What a trial draws: one of a list, or from a pair on a logarithmic scale. All else is as in the algorithm's file.
_COMMON: dict[str, Any] = {
    "learning_rate": (3e-4, 5e-3),  # at the start; it falls to zero
    "gamma": [0.9, 0.95, 0.97, 0.98, 0.99, 0.995],
    "net_arch": ["32-32", "64-64", "128-64", "128-128"],
}
_ON_POLICY = _COMMON | {
    "n_steps": [16, 32, 64, 128],
    "gae_lambda": [0.8, 0.9, 0.95, 0.98],
    "ent_coef": (1e-4, 1e-2),
}
_PROXIMAL = _ON_POLICY | {"batch_size": [512, 1024, 2048, 4096], "n_epochs": [2, 4, 8], "clip_range": [0.1, 0.2, 0.3]}
_OFF_POLICY = _COMMON | {
    "batch_size": [256, 512, 1024],
    "n_steps": [1, 2, 4, 8],
    "tau": (5e-3, 1e-1),
    "gradient_steps": [1, 2, 4],
}
SEARCH_SPACES: dict[str, dict[str, Any]] = {
    "apg": {
        "learning_rate": (1e-3, 1e-2),
        "net_arch": _COMMON["net_arch"],
        "horizon": [48, 96, 144],
        "first_share": [0.111, 0.333, 1.0],
        "lookahead_steps": [0, 500, 1000, 2000],
        "gradient_steps": [3, 4, 6],
        "noise": (0.03, 0.3),
    },
    "ppo": _PROXIMAL,
    "sac": _OFF_POLICY | {"ent_coef": (1e-4, 3e-2)},
    "td3": _OFF_POLICY | {"noise_std": (0.1, 1.0)},
    "a2c": _ON_POLICY,
    "dqn": _OFF_POLICY | {"exploration_final_eps": [0.05, 0.1, 0.2, 0.4]},
    "recurrent_ppo": _PROXIMAL | {"lstm_hidden_size": [16, 32, 64]},
}
NETWORK = ("net_arch", "lstm_hidden_size")  # these go into policy_kwargs
EVALUATIONS = 4  # of a trial, the last one at its end
EPISODES = 32  # of an evaluation, at each operating point
DURATION = 100.0  # of each episode, in units of 1/natural_frequency
ERROR = "error"  # attribute of a trial that failed for a reason of its own


@dataclasses.dataclass(frozen=True)
class Best:
    """The best trial of a study.

    Attributes:
        number: of the trial, from 0.
        value: mean ratio of its costs to those of the best constant damping.
        hyperparameters: all of them, as `agents.train` takes them.
        trials: number of trials that are over.
    """

    number: int
    value: float
    hyperparameters: dict[str, Any]
    trials: int


def silent(trial: int, done: int, timesteps: int, best: float | None) -> None:
    """Report nothing."""


def tune(
    storage: str | Path,
    *,
    algorithm: str = "ppo",
    trials: int = 20,
    timesteps: int | None = None,
    environment: Mapping[str, Any] | None = None,
    hyperparameters: Mapping[str, Any] | None = None,
    seed: int = 0,
    report: Callable[[int, int, int, float | None], None] = silent,
) -> Best:
    """Run a study up to ``trials`` trials in all, and return the best.

    Args:
        storage: SQLite file of the study, for one process at a time; or a folder, which is there or whose name ends in a
            separator, for any number of processes on any number of machines, each of which calls this with the same
            parameters. One that is there is gone on with. A trial that was interrupted is marked as failed, and does not count.
        algorithm: a key of `SEARCH_SPACES`.
        trials: number of trials in all, those of earlier calls included.
        timesteps: control intervals that each trial trains for; by default the hyperparameters' n_timesteps.
        environment: parameters of the environment; by default as for `agents.train`.
        hyperparameters: where the search does not choose; by default the algorithm's own.
        seed: fixes the trials, also over interruptions; not negative. Of several processes each draws from what was finished.
        report: called as ``report(trial, timesteps done, in all, best value so far or None)``.

    Raises:
        ParameterError: a parameter out of range, or a study of something else in the file.
        AgentError: the file cannot be used or is in use, or every trial failed.
        InstallationError: a package that it needs is not installed.
    """
    optuna = _optuna()
    algorithm_class(algorithm)
    whole("trials", trials)
    whole("seed", seed, low=0)
    base = with_wrappers(load_hyperparameters(algorithm) if hyperparameters is None else hyperparameters, ())
    total = base["n_timesteps"] = whole("timesteps", int(base.get("n_timesteps", 0)) if timesteps is None else timesteps)
    plant = lasting(DEFAULT_ENVIRONMENT if environment is None else environment)
    task = make_task(**plant)
    torch.set_num_threads(1)  # as in training
    asked = {"algorithm": algorithm, "environment": plant, "hyperparameters": complete(base), "seed": seed}

    def report_of(number: int, best: float | None) -> Callable[[int], None]:
        return lambda done: report(number, done, total, best)

    with held(optuna, storage) as place:
        study = _open(optuna, storage, place, asked)
        while (finished := _finished(study)) < trials:
            if finished + _running(study, place) >= trials:  # others are at the last ones
                time.sleep(1.0)
                continue
            trial = study.ask()
            place.begin(trial)
            # drawn from the number of trials before it that count, so that an interruption changes nothing
            turn = trial.number - sum(_interrupted(t) for t in study.get_trials(deepcopy=False) if t.number < trial.number)
            if turn >= trials:  # another process began the last one at the same time
                _interrupt(study, trial.number)
                continue
            study.sampler = optuna.samplers.TPESampler(seed=stream_seed(seed, Purpose.SAMPLER, turn) % 2**32)
            chosen = draw(trial, algorithm, base)
            trial.set_user_attr("hyperparameters", chosen)
            completed = study.get_trials(deepcopy=False, states=(optuna.trial.TrialState.COMPLETE,))
            best = min((t.values[0] for t in completed), default=None)
            objective = _Objective(trial, algorithm, chosen, plant, task, seed, report_of(turn, best))
            try:
                value = objective.run()
            except (KeyboardInterrupt, ParameterError):
                _interrupt(study, trial.number)
                raise
            except optuna.TrialPruned:
                study.tell(trial, state=optuna.trial.TrialState.PRUNED)
            except (ArithmeticError, ValueError) as error:  # networks that diverge
                trial.set_user_attr(ERROR, " ".join(str(error).split()))
                study.tell(trial, state=optuna.trial.TrialState.FAIL)
            else:
                study.tell(trial, value, skip_if_finished=True)
        return best_of(study)


def _optuna() -> Any:
    optuna = require("optuna", "tune")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


def _open(package: Any, storage: str | Path, place: Place, asked: dict[str, Any]) -> optuna.Study:
    """The study, which must be of what is ``asked``."""
    try:
        study: optuna.Study = package.create_study(
            storage=place.storage,
            study_name="roadgym",
            pruner=package.pruners.MedianPruner(n_startup_trials=5),
            load_if_exists=True,
        )
    except Exception as error:  # whatever the database raises
        raise AgentError(f"cannot use {str(storage)!r} as a study: {str(error).splitlines()[0]}") from None
    for name, value in asked.items():
        known = study.user_attrs.get(name, value)
        if name == "hyperparameters":
            known = complete(known)
        if known != value:
            told, got = differing(known, value, json.dumps)
            raise ParameterError(f"{name} of the study in {str(storage)!r} is {told}, got {got}: choose another place")
        study.set_user_attr(name, value)
    return study


def _interrupted(trial: optuna.trial.FrozenTrial) -> bool:
    """Was the trial given up halfway, so that it does not count?"""
    return trial.state.name == "FAIL" and ERROR not in trial.user_attrs


def _interrupt(study: optuna.Study, trial: int) -> None:
    """Mark a trial as given up halfway."""
    study.tell(trial, state=type(study.trials[trial].state).FAIL, skip_if_finished=True)


def _running(study: optuna.Study, place: Place) -> int:
    """Number of trials that other processes are at; those that killed ones left behind are marked."""
    running = [trial for trial in study.get_trials(deepcopy=False) if not trial.state.is_finished()]
    alive = [trial for trial in running if place.alive(trial)]
    for trial in running:
        if trial not in alive:
            _interrupt(study, trial.number)
    return len(alive)


def _finished(study: optuna.Study) -> int:
    """Number of trials that are over and count."""
    return sum(trial.state.is_finished() and not _interrupted(trial) for trial in study.get_trials(deepcopy=False))


def best_of(study: optuna.Study) -> Best:
    """The best trial of ``study``.

    Raises:
        AgentError: none was completed.
    """
    try:
        trial = study.best_trial
    except ValueError:
        errors = [t.user_attrs[ERROR] for t in study.get_trials(deepcopy=False) if ERROR in t.user_attrs]
        raise AgentError(f"no trial of the study was completed: {errors[-1] if errors else 'none ran'}") from None
    return Best(trial.number, float(trial.value or 0.0), trial.user_attrs["hyperparameters"], _finished(study))


def draw(trial: optuna.Trial, algorithm: str, base: Mapping[str, Any]) -> dict[str, Any]:
    """Hyperparameters of a trial: ``base`` with those of `SEARCH_SPACES` drawn."""
    chosen, network = dict(base), dict(base.get("policy_kwargs", {}))
    for name, values in SEARCH_SPACES[algorithm].items():
        if isinstance(values, list):
            # a stretch is no longer than a visit
            usable = [value for value in values if name != "horizon" or value <= base.get("n_steps", value)]
            value: Any = trial.suggest_categorical(name, usable or [base["n_steps"]])
        else:
            value = float(f"{trial.suggest_float(name, *values, log=True):.3g}")
        if name == "learning_rate":
            value = f"lin_{value:g}"
        if name == "net_arch":
            value = [int(width) for width in value.split("-")]
        (network if name in NETWORK else chosen)[name] = value
    return chosen | {"policy_kwargs": network}


class _Objective(BaseCallback):
    """Trains one trial, with evaluations on the way."""

    def __init__(
        self,
        trial: optuna.Trial,
        algorithm: str,
        hyperparameters: dict[str, Any],
        environment: dict[str, Any],
        task: Task,
        seed: int,
        report: Callable[[int], None],
    ) -> None:
        super().__init__()
        self.trial, self.algorithm, self.hyperparameters = trial, algorithm, hyperparameters
        self.environment, self.task, self.seed, self.report = environment, task, seed, report
        self.total = hyperparameters["n_timesteps"]
        self.told = 0

    def run(self) -> float:
        """The value at the end of training; raises `optuna.TrialPruned` where it is not reached."""
        model = make_model(self.algorithm, self.hyperparameters, self.environment, self.seed, None)
        model.learn(self.total, callback=self)
        return self.value()

    def _on_step(self) -> bool:
        self.report(min(self.num_timesteps, self.total))
        if self.told < EVALUATIONS - 1 and self.num_timesteps >= (self.told + 1) * self.total / EVALUATIONS:
            self.told += 1
            self.trial.report(self.value(), self.told)
            if self.trial.should_prune():
                import optuna

                raise optuna.TrialPruned
        return True

    def value(self) -> float:
        """Mean, over operating points, of the cost over that of the best constant damping."""
        agent = Agent(self.model, {"hyperparameters": self.hyperparameters, "environment": self.environment}, self.task)
        speeds, bandwidths = ends_and_middle(self.task.speed), ends_and_middle(self.task.bandwidth)
        result = evaluate(
            {"agent": agent},
            environment=self.environment,
            speeds=speeds,
            bandwidths=bandwidths,
            episodes=EPISODES,
            duration=DURATION / self.task.car.natural_frequency,
            seed=stream_seed(self.seed, Purpose.SEARCH),  # far from every seed that a comparison is given
        )["agent"]
        best = [optimum(self.task, p.speed, p.bandwidth).cost for p in make_points(self.task, speeds, bandwidths)]
        return float(np.mean(result.mean / np.array(best)))


def ends_and_middle(bounds: tuple[float, float]) -> list[float]:
    """A range's ends and its geometric middle, each once."""
    low, high = bounds
    return sorted({low, float(np.sqrt(low * high)), high})


def write_best(best: Best, path: str | Path, command: str) -> None:
    """The best hyperparameters as a YAML file that ``roadgym train --hyperparameters`` takes."""
    head = (
        f"# The best of {best.trials} trials: trial {best.number}, its costs {best.value:.4g} of the best constant damping's,\n"
        f"# found by: {command}\n"
    )
    content = yaml.safe_dump(
        {roadgym.ENVIRONMENT_ID: best.hyperparameters}, sort_keys=False, default_flow_style=None, width=120
    )
    write_atomically(make_output(path), head + content)
