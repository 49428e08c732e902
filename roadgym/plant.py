"""A batch of cars on roads: holds the arrays that the kernel steps, and shares the blocks out between threads."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import numpy.typing as npt
from numba.core.errors import NumbaError

from . import kernel
from .compiled import COEFFICIENT, LANES, LaneFunction
from .noise import fill_words, keys_from_seeds
from .parameters import ParameterError, PlantError, number_array, shown, within
from .roads import Road
from .speed import SpeedNoise
from .task import OPERATING_POINT, SATURATION, Task

AUTORESET = {"next_step": kernel.NEXT_STEP, "same_step": kernel.SAME_STEP, "disabled": kernel.DISABLED}
BLOCKS_PER_THREAD = 32  # below this, starting a thread costs more than it saves

MOST_THREADS = 1024  # of the pool; it starts a thread only where none is idle, so as many as are at work together

_pools: dict[int, ThreadPoolExecutor] = {}


def _pool() -> ThreadPoolExecutor:
    """The thread pool of this process, one for all plants; a forked worker does not find its parent's."""
    process = os.getpid()
    if process not in _pools:
        _pools[process] = ThreadPoolExecutor(MOST_THREADS, thread_name_prefix="roadgym")
    return _pools[process]


PADDING = 4096  # numbers after a table, all NaN: what reads beyond its end shows, and reads nobody else's memory


def padded_table(component: Road | SpeedNoise, table: Any, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """The constants of a component for compiled code, with `PADDING` after them.

    Raises:
        ParameterError: no finite numbers in one row.
    """
    name = f"table of the {component.kind} {'road' if isinstance(component, Road) else 'speed noise'}"
    # a bound of minus infinity is a constant too
    row = number_array(name, table) if isinstance(component, Road) else np.asarray(table, np.float64)
    if row.ndim != 1 or row.size == 0:
        raise ParameterError(f"{name} must be one row of numbers, got the shape {row.shape}")
    with np.errstate(over="ignore"):
        constants = row.astype(dtype)
    if np.any(np.isinf(constants) & np.isfinite(row)):
        raise ParameterError(f"{name} must have numbers that {dtype} holds, up to {np.finfo(dtype).max:.2g}")
    return np.concatenate([constants, np.full(PADDING, np.nan, dtype)])


class Plant:
    """``num_envs`` independent cars.

    Args:
        task: what they drive.
        num_envs: how many.
        max_episode_steps: control intervals in an episode; 0 for no limit.
        autoreset: a key of `AUTORESET`.
        threads: number of threads; results do not depend on it. By default one a processor, where the batch is large enough.
    """

    def __init__(
        self,
        task: Task,
        num_envs: int,
        *,
        max_episode_steps: int = 0,
        autoreset: str = "disabled",
        threads: int | None = None,
    ) -> None:
        self.task = task
        self.num_envs = num_envs
        self.blocks = -(-num_envs // LANES)
        self.dtype = np.dtype(task.precision)
        available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
        self.threads = max(1, min(threads or available, self.blocks // BLOCKS_PER_THREAD))
        self._block_size = COEFFICIENT + task.road.rows * LANES
        self._state = np.zeros(self.blocks * self._block_size, self.dtype)
        self._counters = np.zeros(self.blocks * kernel.COUNTERS, np.uint32)
        self._signals = np.array([kernel.SIGNALS.index(name) for name in task.signals])
        self._max_episode_steps = max_episode_steps
        self._autoreset = AUTORESET[autoreset]
        self.started = False

        w1, road = task.car.natural_frequency, task.road
        substep = task.control_interval * w1 / task.substeps
        noise = task.speed_noise
        within(f"variance of the {road.kind} road", road.variance, "variance")
        self._road_table = padded_table(road, road.table(), self.dtype)
        if noise is None:
            self._speed_table = np.zeros(1, self.dtype)
        else:
            self._speed_table = padded_table(noise, noise.table(substep, w1, road), self.dtype)
        self._numbers = np.zeros(kernel.SHARE + task.substeps + 1)
        self._numbers[: kernel.WEIGHT] = (
            substep,
            *task.damping_range,
            *(task.frequency_ratio(speed) for speed in task.speed),
            *task.bandwidth,
            task.warm_up_damping,
            SATURATION,
        )
        self._numbers[kernel.WEIGHT : kernel.SHARE] = task.weights
        self._numbers[kernel.SHARE :] = kernel.interval_weights(task.substeps)
        self._integers = self._make_integers()

    def _make_integers(self) -> npt.NDArray[np.int64]:
        task, road, noise = self.task, self.task.road, self.task.speed_noise
        integers = np.zeros(kernel.INTEGERS, np.int64)
        integers[kernel.SUBSTEPS] = task.substeps
        integers[kernel.ROAD_WORDS] = road.words_per_substep
        integers[kernel.ROAD_PREPARE] = 0 if road.prepare is None else self._address(road, road.prepare)
        integers[kernel.ROAD_START] = self._address(road, road.start)
        integers[kernel.ROAD_ADVANCE] = self._address(road, road.advance)
        integers[kernel.FILL_WORDS] = fill_words.address(np.uint32)
        integers[kernel.CAR_GRIP] = kernel.grip_road.address(self.dtype)
        integers[kernel.CAR_FOLLOW] = kernel.follow_road.address(self.dtype)
        if noise is not None:
            integers[kernel.SPEED_WORDS] = noise.words_per_substep
            integers[kernel.SPEED_START] = self._address(noise, noise.start)
            integers[kernel.SPEED_ADVANCE] = self._address(noise, noise.advance)
        integers[kernel.MAX_EPISODE_STEPS] = self._max_episode_steps
        integers[kernel.AUTORESET] = self._autoreset
        integers[kernel.WARM_UP_STEPS] = round(task.warm_up / task.control_interval)
        integers[kernel.BLOCK_SIZE] = self._block_size
        integers[kernel.HAS_SLOPE] = road.has_slope and (noise is None or noise.smooth)
        return integers

    def _address(self, component: Road | SpeedNoise, function: LaneFunction) -> int:
        try:
            return function.address(self.dtype)
        except NumbaError as error:
            raise ParameterError(f"a lane function of the {component.kind} component does not compile: {error}") from error

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__.copy()
        del state["_integers"]  # holds addresses, which belong to this process
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._integers = self._make_integers()

    def _run(self, function: Callable[..., int], *arguments: Any) -> None:
        """Run a function of the kernel over all blocks.

        Raises:
            PlantError: a number is not finite.
        """
        if self.threads == 1:
            unsound = function(0, self.blocks, *arguments)
        else:
            edges = [self.blocks * k // self.threads for k in range(self.threads + 1)]
            pool = _pool()
            futures = [pool.submit(function, low, high, *arguments) for low, high in itertools.pairwise(edges[1:])]
            found = [function(edges[0], edges[1], *arguments), *(future.result() for future in futures)]
            unsound = min((environment for environment in found if environment >= 0), default=-1)
        if unsound >= 0:
            raise PlantError(
                f"environment {unsound} of {self.num_envs} has left the numbers that {self.dtype} can hold; reset it, and look "
                f"for what drove it there: {self.task}"
            )

    def seed(self, seeds: npt.NDArray[np.uint64], mask: npt.NDArray[np.bool_]) -> None:
        """Give the masked environments new keys, shape (num_envs,) each, and start their count of episodes again."""
        counters = self._counters.reshape(self.blocks, -1, LANES)
        where = np.flatnonzero(mask)
        block, lane = np.divmod(where, LANES)
        counters[block, 0, lane], counters[block, 1, lane] = keys_from_seeds(seeds[where])
        counters[block, kernel.EPISODE // LANES, lane] = np.uint32(0xFFFFFFFF)  # the reset makes it 0

    def forced(self, options: dict[str, Any]) -> npt.NDArray[np.float64]:
        """The operating points that the options "speed" and "bandwidth" fix for the next episode; NaN where they do not.

        Raises:
            ParameterError: a value outside the task's range, or of a wrong shape.
        """
        forced = np.full((2, self.num_envs), np.nan)
        for row, name in enumerate(OPERATING_POINT):
            value = options.get(name)
            if value is None:
                continue
            low, high = getattr(self.task, name)
            if high == 0:
                raise ParameterError(f"option {name!r} does not exist: a {self.task.road.kind} road has no {name}")
            values = number_array(f"option {name!r}", value)
            if values.shape not in ((), (1,), (self.num_envs,)):
                raise ParameterError(f"option {name!r} must be a number or {self.num_envs} numbers, got {shown(value)}")
            if not np.all((values >= low) & (values <= high)):
                raise ParameterError(f"option {name!r} must lie within [{low:g}, {high:g}], got {shown(value)}")
            forced[row] = self.task.frequency_ratio(values) if name == "speed" else values
        return forced

    def reset(
        self, forced: npt.NDArray[np.float64], mask: npt.NDArray[np.bool_]
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[Any]]:
        """Start the masked environments in their next episode: observations (num_envs, signals), results (rows, num_envs)."""
        observations = np.empty((self.num_envs, len(self._signals)), np.float32)
        results = np.zeros((kernel.RESULTS, self.num_envs), self.dtype)
        self._run(
            kernel.reset_blocks,
            self._state,
            self._counters,
            self._road_table,
            self._speed_table,
            self._integers,
            self._numbers,
            self._signals,
            forced,
            mask,
            observations,
            results,
        )
        self.started = True
        return observations, results

    def step(
        self, actions: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[Any], npt.NDArray[np.bool_], npt.NDArray[np.float32]]:
        """One control interval: observations, results, truncated, and the final observations of episodes that ended.

        The last are meaningful only where an episode was truncated, with the autoreset "same_step".
        """
        n = self.num_envs
        observations = np.empty((n, len(self._signals)), np.float32)
        final = np.empty_like(observations) if self._autoreset == kernel.SAME_STEP else observations
        results = np.empty((kernel.RESULTS, n), self.dtype)
        truncated = np.empty(n, np.bool_)
        self._run(
            kernel.step_blocks,
            self._state,
            self._counters,
            self._road_table,
            self._speed_table,
            self._integers,
            self._numbers,
            self._signals,
            actions,
            observations,
            results,
            truncated,
            final,
        )
        return observations, results, truncated, final

    def row(self, offset: int) -> npt.NDArray[Any]:
        """A copy of one row of the state (see `roadgym.compiled`), shape (num_envs,), in the kernel's units."""
        rows = self._state.reshape(self.blocks, -1, LANES)
        return rows[:, offset // LANES, :].reshape(-1)[: self.num_envs].copy()

    def set_row(self, offset: int, values: npt.ArrayLike) -> None:
        """Replace one row of the state, for every environment."""
        rows = self._state.reshape(self.blocks, -1, LANES)
        padded = np.resize(np.broadcast_to(np.asarray(values, self.dtype), self.num_envs), self.blocks * LANES)
        rows[:, offset // LANES, :] = padded.reshape(self.blocks, LANES)
