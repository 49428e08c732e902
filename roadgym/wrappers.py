"""Wrappers of the environments: what a car's sensors tell of its state.

`KalmanObservation` shows the mean of a Kalman filter (`roadgym.kalman`) in place of what is measured, in names and units of the
full observation. That of the batch has the same name after "Vector"; each of its environments equals the single one bit by bit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorObservationWrapper, VectorWrapper
from gymnasium.vector.utils import batch_space

from .kalman import HYPOTHESES, Belief, KalmanFilter
from .parameters import ParameterError, shown
from .task import SATURATION, Task

Environment = gymnasium.Env[Any, Any]
Batch = VectorEnv[Any, Any, Any]
if TYPE_CHECKING:  # Gymnasium 1.1's cannot be subscripted
    Layer = VectorWrapper[Any, Any, Any, Any, Any]
else:
    Layer = VectorWrapper


def task_of(env: Environment | Batch) -> Task:
    """The task of a `roadgym` environment or batch, as the wrappers around it show it.

    Raises:
        ParameterError: it is another one's.
    """
    layer: Any = env
    while isinstance(layer, (gymnasium.Wrapper, VectorWrapper)) and not isinstance(getattr(layer, "task", None), Task):
        layer = layer.env
    task = getattr(layer, "task", None)
    if not isinstance(task, Task):
        raise ParameterError(f"env must be a roadgym environment, got {shown(env)}")
    return task


class EpisodeWrapper(Layer):
    """A wrapper that knows which environments begin an episode; its autoreset mode is an attribute, as TorchRL reads it."""

    def __init__(self, env: Batch) -> None:
        super().__init__(env)
        self.autoreset_mode: AutoresetMode = env.metadata["autoreset_mode"]
        self._ended = np.zeros(env.num_envs, np.bool_)

    def _begun(self, ended: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """Whose observation after this step is the first of an episode, from who ended one in it; once a step."""
        before, self._ended = self._ended, ended
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            return ended
        return before if self.autoreset_mode is AutoresetMode.NEXT_STEP else np.zeros_like(ended)

    def _start(self, options: dict[str, Any] | None) -> npt.NDArray[np.bool_] | None:
        """Who is reset with these options; None for everyone."""
        mask = (options or {}).get("reset_mask")
        self._ended = np.zeros_like(self._ended) if mask is None else self._ended & ~mask
        return None if mask is None or np.all(mask) else mask


def _filter(env: Environment | Batch, space: Any, hypotheses: int, deviations: Any) -> KalmanFilter:
    """The filter of what ``env`` observes, which is what its task does; ``deviations`` is checked."""
    layer: Any = env
    task = task_of(env)
    altered = space != task.observation_space
    while layer is not env.unwrapped:
        others = gymnasium.ObservationWrapper, VectorObservationWrapper, KalmanObservation, VectorKalmanObservation
        altered, layer = altered or isinstance(layer, others), layer.env
    if not isinstance(deviations, bool):
        raise ParameterError(f"deviations must be True or False, got {shown(deviations)}")
    if altered:
        raise ParameterError(f"env must show the observation of its task to a Kalman filter, got {shown(env)}")
    return KalmanFilter(task, hypotheses)


def _space(task: Task, deviations: bool) -> spaces.Box[np.float32]:
    """The space of the means, and of their standard deviations after them."""
    means = task.observation_space
    if not deviations:
        return means
    high = np.where(means.low < 0, SATURATION, 1).astype(np.float32)
    ends = np.append(means.low, 0 * high), np.append(means.high, high)
    return spaces.Box(*ends, dtype=np.float32)


def _seen(known: KalmanFilter, belief: Belief, deviations: bool) -> npt.NDArray[np.float32]:
    """What is shown, shape (n, size)."""
    means = known.observation(belief)
    if not deviations:
        return means
    high = _space(known.full, True).high[means.shape[1] :]
    return np.concatenate([means, np.minimum(known.deviations(belief), high)], axis=1)


def _command(info: dict[str, Any]) -> Any:
    """The damping ratios that were commanded; those in force behind an ideal valve."""
    return info.get("damping_command", info["damping"])


class KalmanObservation(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """Shows the mean of the state, given all that was measured and the dampings in force, as if the state were observed.

    What the environment observes is measured, through its sensors: ``task``, an attribute, is that of the mean.

    Args:
        env: a `roadgym` environment, whose observation nothing has changed.
        deviations: show after the means their standard deviations too.
        hypotheses: as of `roadgym.kalman.KalmanFilter`, where the operating point is hidden, or cars vary.

    Raises:
        ParameterError: a plant that is not linear, no measured signal, or ``deviations`` that are neither True nor False.
    """

    def __init__(self, env: Environment, deviations: bool = False, hypotheses: int = HYPOTHESES) -> None:
        self.arguments: dict[str, Any] = {"deviations": deviations, "hypotheses": hypotheses}
        RecordConstructorArgs.__init__(self, **self.arguments)
        gymnasium.Wrapper.__init__(self, env)
        self.filter = _filter(env, env.observation_space, hypotheses, deviations)
        self.task, self._deviations = self.filter.full, deviations
        self.observation_space = _space(self.task, deviations)
        self.belief: Belief | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin the next episode."""
        observation, info = self.env.reset(seed=seed, options=options)
        self.belief = self.filter.begin(observation[None])
        return _seen(self.filter, self.belief, self._deviations)[0], info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Drive one control interval."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        assert self.belief is not None  # without a reset the environment raises
        self.belief = self.filter.advance(self.belief, [_command(info)], observation[None])
        return _seen(self.filter, self.belief, self._deviations)[0], reward, terminated, truncated, info


class VectorKalmanObservation(EpisodeWrapper):
    """`KalmanObservation` of a batch.

    Attributes:
        measured: what the batch observed last, shape (num_envs, signals).
        car_known: has each car one filter, of its true operating point and fields that vary, where else it has a bank? False,
            but while those learn who may know; to be set before a reset.
    """

    def __init__(self, env: Batch, deviations: bool = False, hypotheses: int = HYPOTHESES) -> None:
        super().__init__(env)
        self.filter = _filter(env, env.single_observation_space, hypotheses, deviations)
        self.task, self._deviations = self.filter.full, deviations
        self.single_observation_space = _space(self.task, deviations)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.belief: Belief | None = None
        self.measured = np.empty((0, len(self.filter.task.signals)), np.float32)
        self.car_known = False

    def _known(self) -> npt.NDArray[np.float64] | None:
        """What the filters are told of their cars, as of `roadgym.kalman.KalmanFilter.begin`."""
        if not self.car_known or len(self.filter.bank) == 1:
            return None
        batch: Any = self.env.unwrapped
        return np.column_stack([batch.state()[:, -2:], batch.plant.drawn_now.T])

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin the next episode, everywhere or where the options say."""
        observations, info = self.env.reset(seed=seed, options=options)
        mask, self.measured = self._start(options), observations
        if mask is None or self.belief is None:
            self.belief = self.filter.begin(observations, self._known())
        else:
            self.belief = self.filter.restarted(self.belief, mask, observations, self._known())
        return _seen(self.filter, self.belief, self._deviations), info

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Drive one control interval."""
        observations, rewards, terminated, truncated, info = self.env.step(actions)
        begun = self._begun(terminated | truncated)
        last = observations
        if "final_obs" in info:
            last = observations.copy()
            last[begun] = np.stack(info["final_obs"][begun])
        assert self.belief is not None  # without a reset the environment raises
        belief = self.filter.advance(self.belief, _command(info), last)
        if "final_obs" in info:
            info = {**info, "final_obs": np.full(self.num_envs, None, object)}
            for i, row in zip(np.flatnonzero(begun), _seen(self.filter, belief, self._deviations)[begun], strict=True):
                info["final_obs"][i] = row
        self.belief = self.filter.restarted(belief, begun, observations, self._known()) if begun.any() else belief
        self.measured = observations
        return _seen(self.filter, self.belief, self._deviations), rewards, terminated, truncated, info
