"""The recipe that learns well, as Gymnasium wrappers of the single environment and of the batch, for any library of learning.

`learning` puts them on. They are what `agents.train` trains on, and one by one they are

- `DampingAction`: an action in [-1, 1], or one of a number of levels, in place of the damping ratio;
- `FeatureObservation`: features of the last observations, `agents.features`, in place of the observation;
- `AdvantageReward`: the cost saved against the best constant damping, `agents.advantage_reward`, in place of minus the cost.

Those of the batch have the same names after "Vector". They keep to its autoreset mode: a stack of observations begins anew with
each episode, and the step that only begins one is paid 0.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast, overload

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import (
    AutoresetMode,
    VectorActionWrapper,
    VectorEnv,
    VectorWrapper,
)
from gymnasium.vector.utils import batch_space
from gymnasium.wrappers.vector import VectorizeTransformAction

from roadgym import PlantError
from roadgym.component import import_modules
from roadgym.parameters import ParameterError, shown, single_precision, whole
from roadgym.task import Task
from roadgym.wrappers import Batch, Environment, EpisodeWrapper, KalmanObservation, Layer, VectorKalmanObservation
from roadgym.wrappers import task_of as task_of

from .actions import action_space, damping_from_action
from .advantage import has_advantage
from .advantage_reward import SavedCost
from .estimation import check_estimator
from .features import FEATURES, Rows, Sight
from .records import texts

if TYPE_CHECKING:  # Gymnasium 1.1's cannot be subscripted
    ActionLayer = VectorActionWrapper[Any, Any, Any, Any]
else:
    ActionLayer = VectorActionWrapper


def training_reward(chosen: Any, task: Task) -> str:
    """What is learned from: "cost", or "advantage" where it is ``chosen`` and theory knows it on this plant, of an ideal valve.

    Raises:
        ParameterError: something else is chosen.
    """
    if chosen not in ("cost", "advantage"):
        raise ParameterError(f'training_reward must be "cost" or "advantage", got {chosen!r}')
    return chosen if has_advantage(task) and task.ideal_valve and task.vary is None else "cost"


@overload
def learning(
    env: Environment,
    *,
    features: Sequence[str] | None = ...,
    frame_stack: int = ...,
    damping_levels: int | None = ...,
    training_reward: str = ...,
    estimator: str | None = ...,
) -> Environment: ...


@overload
def learning(
    env: Batch,
    *,
    features: Sequence[str] | None = ...,
    frame_stack: int = ...,
    damping_levels: int | None = ...,
    training_reward: str = ...,
    estimator: str | None = ...,
) -> Batch: ...


def learning(
    env: Environment | Batch,
    *,
    features: Sequence[str] | None = FEATURES,
    frame_stack: int = 1,
    damping_levels: int | None = None,
    training_reward: str = "advantage",
    estimator: str | None = None,
) -> Environment | Batch:
    """A `roadgym` environment, or a batch of them, as it learns well.

    Args:
        env: what `gymnasium.make` or `gymnasium.make_vec` gives.
        features, frame_stack: what the policy sees; see `agents.features.Sight`.
        damping_levels: number of damping ratios to choose from, at equal distances over the range; by default all of it.
        training_reward: "advantage", where theory knows it, or "cost".
        estimator: "kalman" to see the mean of the state given what is measured (`roadgym.wrappers`); None for the observation.

    Raises:
        ParameterError: one of these that is out of range.
    """
    check_estimator(estimator)
    paid = _paid(training_reward, task_of(env))
    if isinstance(env, VectorEnv):
        batch = VectorAdvantageReward(env) if paid == "advantage" else env
        batch = batch if estimator is None else VectorKalmanObservation(batch)
        return VectorDampingAction(VectorFeatureObservation(batch, features, frame_stack), damping_levels)
    single = AdvantageReward(env) if paid == "advantage" else env
    single = single if estimator is None else KalmanObservation(single)
    return DampingAction(FeatureObservation(single, features, frame_stack), damping_levels)


_paid = training_reward  # which `learning` has a parameter of the name of


def find_wrapper(name: Any) -> Callable[[Batch], Batch]:
    """The function or class of a "module:name", which takes a batch and gives one.

    Raises:
        ParameterError: there is none.
    """
    module, _, attribute = name.partition(":") if isinstance(name, str) else ("", "", "")
    if not (module and attribute):
        raise ParameterError(f"wrapper must be named as module:name, got {shown(name)}")
    import_modules([module])
    found: Any = getattr(sys.modules[module], attribute, None)
    if not callable(found):
        raise ParameterError(f"wrapper {name!r} cannot be found: the module has no such function")
    return cast(Callable[[Batch], Batch], found)


def wrapper_name(wrapper: Callable[[Batch], Batch] | str) -> str:
    """The "module:name" of a wrapper, by which `find_wrapper` finds it again.

    Raises:
        ParameterError: it is not found, such as a lambda.
    """
    if isinstance(wrapper, str):
        find_wrapper(wrapper)
        return wrapper
    name = f"{getattr(wrapper, '__module__', '')}:{getattr(wrapper, '__qualname__', '')}"
    if (found := find_wrapper(name)) is not wrapper:
        raise ParameterError(f"wrapper must be what its module has under its name, got {shown(wrapper)}, not {shown(found)}")
    return name


def wrapper_names(wrappers: Any) -> list[str]:
    """The names of wrappers, each a function, a class or a name; one alone need be no list.

    Raises:
        ParameterError: something else, or one that is not found.
    """
    each = [wrappers] if callable(wrappers) else wrappers
    if isinstance(each, (list, tuple)):
        each = [wrapper_name(wrapper) if callable(wrapper) else wrapper for wrapper in each]
    return list(map(wrapper_name, texts("wrappers", each)))


def with_wrappers(hyperparameters: Mapping[str, Any], wrappers: Any) -> dict[str, Any]:
    """Hyperparameters with these wrappers around those that they have.

    Raises:
        ParameterError: what `wrapper_names` refuses.
    """
    names = wrapper_names(hyperparameters.get("wrappers", ())) + wrapper_names(wrappers)
    return {**hyperparameters, **({"wrappers": names} if names else {})}


def wrap(batch: Batch, names: Sequence[str]) -> tuple[Batch, list[ActionLayer]]:
    """The batch within the wrappers of these names, and those of them that an agent needs when it drives, the outermost first.

    Raises:
        ParameterError: what wraps nothing, or changes what is observed or answered in a way that an agent cannot repeat: the
            observations at all, or the actions by more than a ``VectorActionWrapper`` that takes any number of rows. In use,
            what a wrapper raises, or returns that is no step of a batch.
    """
    layers: list[ActionLayer] = []
    for name in wrapper_names(names):
        put_on = find_wrapper(name)
        with blamed(name):
            outer = layer = put_on(batch)
        found: list[ActionLayer] = []
        while layer is not batch:
            if not isinstance(layer, VectorWrapper):
                raise ParameterError(f"wrapper {name!r} must give a wrapper of the batch that it takes, got {shown(outer)}")
            inner: Batch = layer.env
            if isinstance(layer, VectorActionWrapper) and not isinstance(layer, VectorizeTransformAction):
                found.append(layer)
            elif layer.single_action_space != inner.single_action_space:
                raise ParameterError(f"wrapper {name!r} changes actions: only a VectorActionWrapper may, of any number of rows")
            if layer.single_observation_space != inner.single_observation_space:
                raise ParameterError(f"wrapper {name!r} changes observations: an agent would not see them so when it drives")
            layer = inner
        batch, layers = _Checked(outer, name), found + layers
    return batch, layers


@contextlib.contextmanager
def blamed(name: str) -> Iterator[None]:
    """Tell in one line what a wrapper raises, which can be anything; faults of the plant below it are not its own.

    Raises:
        ParameterError: it raised.
    """
    try:
        yield
    except (PlantError, MemoryError):
        raise
    except Exception as error:
        text = " ".join(str(error).split())
        if isinstance(error, ParameterError):
            raise ParameterError(text if text.startswith("wrapper ") else f"wrapper {name!r}: {text}") from error
        raise ParameterError(f"wrapper {name!r}: {type(error).__name__}: {text}") from error


class _Checked(Layer):
    """Around somebody else's wrapper: what it returns is a step of a batch."""

    def __init__(self, env: Batch, name: str) -> None:
        super().__init__(env)
        self._name = name

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin the next episode, everywhere or where the options say."""
        with blamed(self._name):
            observations, infos = self.env.reset(seed=seed, options=options)
        return observations, infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Drive one control interval."""
        with blamed(self._name):
            observations, rewards, terminated, truncated, infos = self.env.step(actions)
        if not isinstance(rewards, np.ndarray) or rewards.shape != (self.num_envs,) or rewards.dtype.kind not in "fiu":
            raise ParameterError(
                f"wrapper {self._name!r} must return an array of rewards, shape ({self.num_envs},), got {shown(rewards)}"
            )
        if not isinstance(infos, dict):
            raise ParameterError(f"wrapper {self._name!r} must return a mapping of infos, got {shown(infos)}")
        return observations, rewards, terminated, truncated, infos


def _refuse_second(env: Environment | Batch) -> None:
    """Actions are taken for damping ratios once."""
    layer = env
    while isinstance(layer, (gymnasium.Wrapper, VectorWrapper)):
        if isinstance(layer, (DampingAction, VectorDampingAction)):
            raise ParameterError(f"env must take damping ratios, got one within {type(layer).__name__} already: wrap it once")
        layer = layer.env


class DampingAction(gymnasium.ActionWrapper[Any, Any, Any], RecordConstructorArgs):
    """Takes actions in [-1, 1], or ``levels`` of them, for damping ratios; see `agents.actions.damping_from_action`."""

    def __init__(self, env: Environment, levels: int | None = None) -> None:
        _refuse_second(env)
        RecordConstructorArgs.__init__(self, levels=levels)
        gymnasium.ActionWrapper.__init__(self, env)
        self.levels = None if levels is None else whole("damping_levels", levels, low=2, of="levels")
        self.action_space = action_space(self.levels)
        self._range = task_of(env).damping_range

    def action(self, action: Any) -> npt.NDArray[np.float32]:
        """The damping ratio, shape (1,)."""
        return damping_from_action(np.reshape(action, 1), self._range, self.levels).reshape(1)


class FeatureObservation(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Shows what a `agents.features.Sight` sees, with its arguments."""

    def __init__(self, env: Environment, features: Sequence[str] | None = None, frame_stack: int = 1) -> None:
        self.arguments: dict[str, Any] = {"features": features, "frame_stack": frame_stack}
        RecordConstructorArgs.__init__(self, **self.arguments)
        gymnasium.Wrapper.__init__(self, env)
        self.sight = Sight(task_of(env), features, frame_stack)
        self.observation_space = self.sight.space
        self._frames: Rows | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin the next episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._frames = None
        return self._seen(observation), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Drive one control interval."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._seen(observation), reward, terminated, truncated, info

    def _seen(self, observation: Rows) -> Rows:
        rows = observation[None]
        self._frames = self.sight.stack(self._frames, rows, None)
        return np.asarray(self.sight(rows, self._frames)[0])


class AdvantageReward(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Pays for the cost that is saved; see `agents.advantage_reward`. Infos keep minus the reward of ``env`` as "cost".

    The advantage is made from the full state, whatever is observed. Actions must be damping ratios here.
    """

    def __init__(self, env: Environment) -> None:
        RecordConstructorArgs.__init__(self)
        gymnasium.Wrapper.__init__(self, env)
        self._saved = SavedCost(_with_advantage(env), 1)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin the next episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._look()
        return observation, {**info, "cost": 0.0}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Drive one control interval."""
        advantage = self._saved.advantage(single_precision("action", action, (1,))[None])
        observation, reward, terminated, truncated, info = self.env.step(action)
        saved = self._saved.reward(np.array([-float(reward)]), advantage, np.ones(1, np.bool_))
        self._look()
        return observation, float(saved[0]), terminated, truncated, {**info, "cost": -float(reward)}

    def _look(self) -> None:
        plant: Any = self.env.unwrapped
        self._saved.look(plant.state()[None])


class VectorDampingAction(EpisodeWrapper):
    """`DampingAction` of a batch: actions of shape (num_envs, 1), or (num_envs,) where they are levels."""

    def __init__(self, env: Batch, levels: int | None = None) -> None:
        _refuse_second(env)
        super().__init__(env)
        self.levels = None if levels is None else whole("damping_levels", levels, low=2, of="levels")
        self.single_action_space = action_space(self.levels)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._range = task_of(env).damping_range

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Drive one control interval."""
        return self.env.step(damping_from_action(actions, self._range, self.levels))


class VectorFeatureObservation(EpisodeWrapper):
    """`FeatureObservation` of a batch."""

    def __init__(self, env: Batch, features: Sequence[str] | None = None, frame_stack: int = 1) -> None:
        super().__init__(env)
        self.sight = Sight(task_of(env), features, frame_stack)
        self.single_observation_space = self.sight.space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._frames: Rows | None = None

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin the next episode, everywhere or where the options say."""
        observations, info = self.env.reset(seed=seed, options=options)
        mask, fresh = self._start(options), self.sight.stack(None, observations, None)
        if mask is not None and fresh is not None and self._frames is not None:
            fresh = np.where(mask[:, None], fresh, self._frames)
        self._frames = fresh
        return self.sight(observations, self._frames), info

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Drive one control interval."""
        observations, rewards, terminated, truncated, info = self.env.step(actions)
        if "final_obs" in info:
            ended = np.flatnonzero(info["_final_obs"])
            last = np.stack(info["final_obs"][ended])
            before = None if self._frames is None else self._frames[ended]
            seen = self.sight(last, self.sight.stack(before, last, None))
            info = {**info, "final_obs": np.full(self.num_envs, None, object)}
            for row, i in enumerate(ended):
                info["final_obs"][i] = seen[row]
        self._frames = self.sight.stack(self._frames, observations, self._begun(terminated | truncated))
        return self.sight(observations, self._frames), rewards, terminated, truncated, info


class VectorAdvantageReward(EpisodeWrapper):
    """`AdvantageReward` of a batch."""

    def __init__(self, env: Batch) -> None:
        super().__init__(env)
        self._saved = SavedCost(_with_advantage(env), env.num_envs)
        self._everyone = np.ones(env.num_envs, np.bool_)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin the next episode, everywhere or where the options say."""
        observations, info = self.env.reset(seed=seed, options=options)
        mask = self._start(options)
        self._look()
        there = self._everyone if mask is None else mask
        return observations, {**info, "cost": np.zeros(self.num_envs), "_cost": there.copy()}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Drive one control interval."""
        advantage = self._saved.advantage(single_precision("actions", actions, (self.num_envs, 1)))
        observations, rewards, terminated, truncated, info = self.env.step(actions)
        begun = self._begun(terminated | truncated)
        driven = ~begun if self.autoreset_mode is AutoresetMode.NEXT_STEP else self._everyone
        cost = -np.asarray(rewards, np.float64)
        saved = self._saved.reward(cost, advantage, driven)
        self._look()
        return observations, saved, terminated, truncated, {**info, "cost": cost, "_cost": self._everyone.copy()}

    def _look(self) -> None:
        plant: Any = self.env.unwrapped
        self._saved.look(plant.state())


def _with_advantage(env: Environment | Batch) -> Task:
    """The task, which must have an advantage."""
    task = task_of(env)
    if not (has_advantage(task) and task.ideal_valve and task.vary is None):
        raise ParameterError(
            "env must be of a plant whose advantage theory knows: a first- or second-order road at a constant speed, an "
            "ideal valve, and one car"
        )
    return task
