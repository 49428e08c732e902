"""The native batch environment as a stable-baselines3 `VecEnv`."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorWrapper
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit

from roadgym import ENVIRONMENT_ID
from roadgym.env import QuarterCarEnv, check_options
from roadgym.installation import needs
from roadgym.kalman import HYPOTHESES
from roadgym.moved import moved
from roadgym.parameters import ParameterError, shown
from roadgym.task import TaskParameters
from roadgym.vector import QuarterCarVectorEnv
from roadgym.wrappers import KalmanObservation, VectorKalmanObservation

from .actions import damping_from_action as damping_from_action
from .features import Sight as Sight
from .wrappers import AdvantageReward, DampingAction, FeatureObservation, learning, task_of, wrap

with needs("train"):
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import VecEnv

if TYPE_CHECKING:
    from .differentiable import DrivenRoads
if not TYPE_CHECKING:
    __getattr__ = moved(__name__, action_space="agents.actions")


def _described(env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    """The arguments of `QuarterCarVecEnv` that make the same of ``env``."""
    found: dict[str, Any] = {"max_episode_steps": None, "render_mode": env.render_mode}
    layer = env
    while isinstance(layer, gymnasium.Wrapper):
        match layer:
            case DampingAction():
                found["damping_levels"] = layer.levels
            case FeatureObservation():
                found |= layer.arguments
            case AdvantageReward():
                found["training_reward"] = "advantage"
            case KalmanObservation() if layer.arguments == {"deviations": False, "hypotheses": HYPOTHESES}:
                found["estimator"] = "kalman"
            case TimeLimit():
                found["max_episode_steps"] = layer._max_episode_steps
            case Monitor(results_writer=None, info_keywords=()) | OrderEnforcing() | PassiveEnvChecker():
                pass
            case _:
                raise ParameterError(
                    f"the batch has no {type(layer).__name__}; wrap the batch instead, such as in a VecMonitor"
                )
        layer = layer.env
    if not isinstance(layer, QuarterCarEnv) or layer.spec is None or "damping_levels" not in found:
        raise ParameterError(f"env must be gymnasium.make({ENVIRONMENT_ID!r}) within agents.wrappers.learning, got {env}")
    environment = {name: value for name, value in layer.spec.kwargs.items() if name != "render_mode"}
    return {**found, "environment": environment}


@functools.cache
def _dictionaries(names: tuple[str, ...]) -> Callable[[Iterable[Any]], list[dict[str, Any]]]:
    """A function that makes a dictionary with these keys of each row.

    Written out, which takes half the time of ``dict(zip(names, row))``: a batch makes one for each environment in every step.
    """
    places = [f"v{k}" for k in range(len(names))]
    entries = ", ".join(f"{name!r}: {place}" for name, place in zip(names, places, strict=True))
    written = f"lambda rows: [{{{entries}}} for {', '.join(places)}, in rows]"
    made: Callable[[Iterable[Any]], list[dict[str, Any]]] = eval(written)
    return made


def _each(info: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The infos of a batch as plain dictionaries, one of each environment."""
    names = tuple(name for name in info if "_" + name in info and name[:6] != "final_")
    return _dictionaries(names)(zip(*[info[name].tolist() for name in names], strict=True))


def layers(batch: Any) -> Iterator[Any]:
    """The wrappers of a batch from the outermost on, and itself."""
    while isinstance(batch, VectorWrapper):
        yield batch
        batch = batch.env
    yield batch


class QuarterCarVecEnv(VecEnv):
    """``num_envs`` quarter cars for stable-baselines3, as they learn well: the batch within `agents.wrappers.learning`.

    Infos hold those of the environment, and what stable-baselines3 reads: "terminal_observation" and "TimeLimit.truncated"
    where an episode ended, and there "episode" with the return "r" of the environment's own reward, length "l" and time "t",
    as its Monitor gives them. Those of a reset are in ``reset_infos``.

    Args:
        num_envs: number of environments.
        max_episode_steps: steps in an episode; None for no limit.
        environment: parameters of `roadgym.vector.QuarterCarVectorEnv`.
        features, frame_stack, damping_levels, training_reward, estimator: see `agents.wrappers.learning`.
        wrappers: Gymnasium's or one's own around all this, each a "module:name"; see `agents.wrappers.wrap`. Where the cost is
            paid, the return "r" is that of their reward.
        render_mode: "rgb_array" for pictures, as stable-baselines3's ``VecVideoRecorder`` takes them. What they show is
            remembered from the first picture on, so that training is as fast as without until then.
    """

    def __init__(
        self,
        num_envs: int,
        *,
        max_episode_steps: int | None = 500,
        environment: Mapping[str, Any] | None = None,
        features: Sequence[str] | None = None,
        frame_stack: int = 1,
        damping_levels: int | None = None,
        training_reward: str = "cost",
        estimator: str | None = None,
        wrappers: Sequence[str] = (),
        render_mode: str | None = None,
    ) -> None:
        if not (environment is None or isinstance(environment, Mapping)):
            raise ParameterError(f"environment must be a mapping of parameters, got {shown(environment)}")
        known = ("threads", *TaskParameters.__annotations__)
        for name in environment or {}:
            if name not in known:
                raise ParameterError(f"unknown parameter {shown(name)} of environment; known: {', '.join(known)}")
        self.envs = QuarterCarVectorEnv(
            num_envs,
            max_episode_steps=max_episode_steps,
            autoreset_mode=AutoresetMode.SAME_STEP,
            render_mode=render_mode,
            **(environment or {}),
        )
        self.envs.render_mode = None  # until somebody asks for a picture, see `get_images`
        self.render_mode = render_mode
        learned = learning(
            self.envs,
            features=features,
            frame_stack=frame_stack,
            damping_levels=damping_levels,
            training_reward=training_reward,
            estimator=estimator,
        )
        self.task = task_of(learned)
        self._batch, _ = wrap(learned, wrappers)
        self._seen, self._wrappers = (features, frame_stack), wrappers
        self._estimator = next((layer for layer in layers(learned) if isinstance(layer, VectorKalmanObservation)), None)
        super().__init__(num_envs, self._batch.single_observation_space, self._batch.single_action_space)
        self.metadata |= {"render_fps": self.envs.metadata["render_fps"]}
        self._actions: npt.NDArray[Any] = np.zeros((num_envs, 1), np.float32)
        self._returns = np.zeros(num_envs)
        self._lengths = np.zeros(num_envs, np.int64)
        self._begin = time.monotonic()

    @classmethod
    def from_functions(cls, functions: Sequence[Callable[[], gymnasium.Env[Any, Any]]]) -> QuarterCarVecEnv:
        """The batch of what functions would make one by one, as ``vec_env_cls`` of stable-baselines3's ``make_vec_env``.

        Each must make the same `roadgym` environment by `gymnasium.make`, within `agents.wrappers.learning`.

        Raises:
            ParameterError: one makes something else, or there is none.
        """
        if not functions:
            raise ParameterError("functions must be at least one, got none")
        described = [_described(function()) for function in functions]
        for number, description in enumerate(described):
            if description != described[0]:
                raise ParameterError(f"environments must be alike, got {described[0]}, and {description} as number {number}")
        return cls(len(described), **described[0])

    def set_options(self, options: list[dict[str, Any]] | dict[str, Any] | None = None) -> None:
        """Options of the next reset, `roadgym.vector.QuarterCarVectorEnv.reset`, for all environments or one each.

        Raises:
            ParameterError: unknown options, or another number of them.
        """
        if isinstance(options, (list, tuple)) and len(options) != self.num_envs:
            raise ParameterError(f"options must be one mapping or {self.num_envs} of them, got {len(options)}")
        for each in options if isinstance(options, (list, tuple)) else [options]:
            check_options(each)
        super().set_options(options)

    def reset(self) -> npt.NDArray[np.float32]:
        """What is seen first, shape (num_envs, size); the seed of `seed` and the options of `set_options` take effect here."""
        given: Any = self._seeds if any(seed is not None for seed in self._seeds) else None
        names = dict.fromkeys(name for each in self._options for name in each)
        options = {name: [each.get(name) for each in self._options] for name in names}
        observations, info = self._batch.reset(seed=given, options=options)
        self.reset_infos = _each(info)
        self._reset_seeds()
        self._reset_options()
        self._returns[:] = 0
        self._lengths[:] = 0
        return np.asarray(observations)

    def driven_roads(self, steps: int) -> DrivenRoads:
        """What records ``steps`` control intervals for a gradient through the plant, of `road_and_car` before each.

        From the next reset on an estimator knows where in what car it is, as the gradient does, where else it is a bank.

        Raises:
            ParameterError: what `agents.differentiable.DrivenRoads` refuses, or wrappers, which could pay for something else.
        """
        from .differentiable import DrivenRoads

        if self._wrappers:
            raise ParameterError(f"wrappers must be none for a gradient through the plant, got {', '.join(self._wrappers)}")
        found = DrivenRoads(self.envs.task, Sight(self.task, *self._seen), self.num_envs, steps, self._estimator)
        if self._estimator is not None:
            self._estimator.car_known = True
        return found

    def road_and_car(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """The states of `roadgym.vector.QuarterCarVectorEnv.state`, the rate of the road's angle over w1, what was drawn."""
        return self.envs.state(), self.envs.plant.row("rate").astype(float), self.envs.plant.drawn_now

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Take the actions, shape (num_envs, 1), or (num_envs,) where they are levels, for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.bool_], list[dict[str, Any]]]:
        """Drive one control interval."""
        observations, rewards, terminated, truncated, info = self._batch.step(self._actions)
        self._returns -= info.get("cost", -rewards)
        self._lengths += 1
        infos = _each(info)
        done = terminated | truncated
        if done.any():
            elapsed = round(time.monotonic() - self._begin, 6)
            for i in np.flatnonzero(done):
                infos[i] |= {
                    "terminal_observation": info["final_obs"][i],
                    "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                    "episode": {"r": float(self._returns[i]), "l": int(self._lengths[i]), "t": elapsed},
                }
            self._returns[done] = 0
            self._lengths[done] = 0
        return observations, np.asarray(rewards, np.float32), done, infos

    def close(self) -> None:
        """Nothing to release."""

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """An attribute of the batch environment, once for each index."""
        return [getattr(self.envs if attr_name != "render_mode" else self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Refused: the environments share their parameters."""
        raise AttributeError(f"cannot set {attr_name!r}: the environments of a batch share their parameters")

    def env_method(
        self, method_name: str, *method_args: Any, indices: int | Iterable[int] | None = None, **method_kwargs: Any
    ) -> list[Any]:
        """Refused: there are no separate environments to call."""
        raise AttributeError(f"cannot call {method_name!r}: a batch has no separate environments")

    def env_is_wrapped(self, wrapper_class: type, indices: int | Iterable[int] | None = None) -> list[bool]:
        """Always false, but for stable-baselines3's Monitor, whose episode statistics the infos hold."""
        return [wrapper_class.__name__ == "Monitor" for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[npt.NDArray[np.uint8] | None]:
        """The pictures now, one of each environment; None each without a ``render_mode``."""
        if self.render_mode is None:
            return [None] * self.num_envs
        if self.envs.render_mode is None:
            self.envs.render_mode = self.render_mode
            if self.envs.plant.started:  # otherwise the reset that is missing does this
                self.envs._begin_histories(np.ones(self.num_envs, np.bool_))
        return list(self.envs.render() or ())
