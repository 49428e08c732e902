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

from . import compiled, kernel
from .cars import Car
from .cars.linear import STATES
from .compiled import COEFFICIENT, LANES, LaneFunction
from .filters import filter_table
from .interval import CommandedInterval as CommandedInterval
from .interval import Floats as Floats
from .interval import Interval as Interval
from .noise import fill_words, keys_from_seeds
from .parameters import ParameterError, PlantError, number_array, shown, within
from .processors import usual_threads
from .record import (
    COUNTERS,
    DISABLED,
    EPISODE,
    NEXT_STEP,
    OBSERVED_BANDWIDTH,
    OBSERVED_SENSOR,
    OBSERVED_SIGNAL,
    OBSERVED_SPEED,
    PENDING,
    PLANT,
    SAME_STEP,
    SQUARES,
    STEP,
    interval_weights,
)
from .reward import divergent_terms
from .roads import Road
from .sensors import SensorTables, check_delays
from .speed import SpeedNoise
from .task import OPERATING_POINT, SATURATION, Task
from .valve import shares_of_ends

AUTORESET = {"next_step": NEXT_STEP, "same_step": SAME_STEP, "disabled": DISABLED}
BLOCKS_PER_THREAD = 32  # below this, starting a thread costs more than it saves

# rows of the state that roads, speed noise and cars share (see `roadgym.compiled`)
BUS = {
    "speed": compiled.SPEED,
    "bandwidth": compiled.BANDWIDTH,
    "turn": compiled.TURN,
    "level": compiled.LEVEL,
    "slope": compiled.SLOPE,
    "rate": compiled.RATE,
}

MOST_THREADS = 1024  # of the pool; it starts a thread only where none is idle, so as many as are at work together

_pools: dict[int, ThreadPoolExecutor] = {}


def _pool() -> ThreadPoolExecutor:
    """The thread pool of this process, one for all plants; a forked worker does not find its parent's."""
    process = os.getpid()
    if process not in _pools:
        _pools[process] = ThreadPoolExecutor(MOST_THREADS, thread_name_prefix="roadgym")
    return _pools[process]


PADDING = 4096  # numbers after a table, all NaN: what reads beyond its end shows, and reads nobody else's memory


def padded_table(name: str, table: Any, dtype: np.dtype[Any], *, finite: bool = True) -> npt.NDArray[Any]:
    """The constants of a component for compiled code, with `PADDING` after them.

    Args:
        name: of the table, for messages.
        table: its numbers.
        dtype: of compiled code.
        finite: must they be; a bound of minus infinity is a constant too.

    Raises:
        ParameterError: no numbers in one row.
    """
    row = number_array(name, table) if finite else np.asarray(table, np.float64)
    if row.ndim != 1 or row.size == 0:
        raise ParameterError(f"{name} must be one row of numbers, got the shape {row.shape}")
    with np.errstate(over="ignore"):
        constants = row.astype(dtype)
    if np.any(np.isinf(constants) & np.isfinite(row)):
        raise ParameterError(f"{name} must have numbers that {dtype} holds, up to {np.finfo(dtype).max:.2g}")
    return np.concatenate([constants, np.full(PADDING, np.nan, dtype)])


def lane_address(component: Road | SpeedNoise | Car, function: LaneFunction | None, dtype: np.dtype[Any]) -> int:
    """Address of a component's function for the kernel, 0 where it has none.

    Raises:
        ParameterError: it does not compile.
    """
    try:
        return 0 if function is None else function.address(dtype)
    except NumbaError as error:
        raise ParameterError(f"a lane function of the {component.kind} component does not compile: {error}") from error


class Plant:
    """``num_envs`` independent cars.

    Args:
        task: what they drive.
        num_envs: how many.
        max_episode_steps: control intervals in an episode; 0 for no limit.
        autoreset: a key of `AUTORESET`.
        threads: number of threads; results do not depend on it. By default one a processor, where the batch is large enough.
        told: whether mean squares and speeds are told in the units of the task, or in the kernel's: those of the road's
            variance and times in 1/w1, and the frequency ratio.
    """

    def __init__(
        self,
        task: Task,
        num_envs: int,
        *,
        max_episode_steps: int = 0,
        autoreset: str = "disabled",
        threads: int | None = None,
        told: bool = False,
    ) -> None:
        self.task = task
        self.num_envs = num_envs
        self.blocks = -(-num_envs // LANES)
        self.dtype = np.dtype(task.precision)
        self.threads = max(1, min(threads or usual_threads(), self.blocks // BLOCKS_PER_THREAD))
        road, noise, vary = task.road, task.speed_noise, task.vary
        self._driven = car = task.car if vary is None else vary.driven_car
        self._slowest = valve = task.valve if vary is None else vary.slowest_valve
        self._car = COEFFICIENT + road.rows * LANES
        self._filters = self._car + car.rows * LANES
        self._own_states = len(car.motion.own.states)
        end, sensors = self._filters + (len(car.motion.states) - self._own_states) * LANES, task.real_sensors
        sources = {name: self._observed_code(name) for name in sensors}
        self._sensors = SensorTables.of(sensors, sources, task.control_interval, task.substeps, end)
        self._valve = end + self._sensors.rows * LANES
        self._block_size = self._valve + valve.rows(task.control_interval) * LANES
        self._state = np.zeros(self.blocks * self._block_size, self.dtype)
        self._counters = np.zeros(self.blocks * COUNTERS, np.uint32)
        if max_episode_steps:
            delays = {"the valve": valve.delay} | {f"the sensor of {name}": each.delay for name, each in sensors.items()}
            check_delays(delays, task.control_interval, max_episode_steps)
        self._max_episode_steps, self._speed_unit = max_episode_steps, task.speed_unit if told else 1.0
        self._autoreset = AUTORESET[autoreset]
        self._restarts = vary is not None and autoreset == "same_step"  # here, with another car, and not in compiled code
        self._observed = num_envs, len(task.signals)
        self._results = SQUARES + len(task.reward) + (not valve.ideal), num_envs
        self._interval = Interval if valve.ideal else CommandedInterval
        self.started = False

        within(f"variance of the {road.kind} road", road.variance, "variance")
        self._substep = task.control_interval * car.natural_frequency / task.substeps
        dampings = *task.damping_range, task.warm_up_damping
        self._met = min(dampings), max(dampings)
        self._tables = {
            "road": padded_table(f"table of the {road.kind} road", road.table(), self.dtype),
            "car": padded_table(f"table of the {car.kind} car", car.table(self._substep, self._met), self.dtype),
        }
        if noise is not None:
            table = noise.table(self._substep, car.natural_frequency, road)
            self._tables["speed"] = padded_table(f"table of the {noise.kind} speed noise", table, self.dtype, finite=False)
        signals = list(car.mean_squares)
        infinite, codes = divergent_terms(car, road, noise), {name: OBSERVED_SENSOR - k for k, name in enumerate(sensors)}
        self._constants: dict[str, npt.NDArray[Any]] = {
            "weights": np.array(task.weights, np.float64),
            "square_units": task.square_units if told else np.ones(len(task.reward)),
            "shares": interval_weights(task.substeps),
            "factors": np.ascontiguousarray(car.motion.rows, np.float64),
            "filter_table": filter_table(car.motion, self._substep),
            "start": task.car.starts_on_road * car.motion.follows,
            "observed": np.array([codes.get(name, self._observed_code(name)) for name in task.signals], np.int64),
            "valve_shares": shares_of_ends(task.substeps),
            "sensor_integers": self._sensors.integers,
            "sensor_numbers": self._sensors.numbers,
            "infinite": np.array([name in infinite for name in signals], np.int64),
        }
        self._record = self._make_record()
        self.drawn = self._drawn = np.zeros((0 if vary is None else len(vary.names), num_envs))
        if vary is not None:  # lanes beyond the last environment keep the nominal car
            nominal = vary.driven_car.numbers(task.car, task.valve, 1.0, self._substep, task.control_interval, self._met)
            self._own_numbers[:] = nominal[:, None]

    def _observed_code(self, name: str) -> int:
        """How the kernel finds an observed signal."""
        signals = self.task.car.motion.signals
        if name in ("speed", "bandwidth"):
            return OBSERVED_SPEED if name == "speed" else OBSERVED_BANDWIDTH
        if name in signals and self.task.vary is not None:  # in terms of the nominal car
            return OBSERVED_SIGNAL - list(signals).index(name)
        if name not in signals or dict(signals[name].terms) == {name: 1.0}:  # as it is
            return self._offset(name)
        return OBSERVED_SIGNAL - list(signals).index(name)

    def _make_record(self) -> npt.NDArray[Any]:
        """The plant as the kernel knows it; its addresses belong to this process."""
        task, road, noise, car = self.task, self.task.road, self.task.speed_noise, self._driven
        vary, valve = task.vary, self._slowest
        record = np.zeros(1, PLANT)
        functions: dict[str, tuple[Road | SpeedNoise | Car, LaneFunction | None]] = {
            "road_prepare": (road, road.prepare),
            "road_start": (road, road.start),
            "road_advance": (road, road.advance),
            "car_prepare": (car, car.prepare),
            "car_advance": (car, car.advance),
        }
        if noise is not None:
            functions |= {"speed_start": (noise, noise.start), "speed_advance": (noise, noise.advance)}
        for name, (component, function) in functions.items():
            record[name] = lane_address(component, function, self.dtype)
        record["fill_words"] = fill_words.address(np.uint32)
        for name, table in self._tables.items():
            record[f"{name}_table"] = table.ctypes.data
        for name, constants in self._constants.items():
            record[name] = constants.ctypes.data
        signals = list(car.mean_squares)
        numbers = {
            "substeps": task.substeps,
            "road_words": road.words_per_substep,
            "speed_words": 0 if noise is None else noise.words_per_substep,
            "states": len(car.motion.states),
            "own_states": self._own_states,
            "filters": len(car.motion.filters),
            "filter_states": self._filters,
            "signals": len(signals),
            "squared": car.squared,
            "relative": signals.index(car.motion.relative),
            "observations": len(task.signals),
            "sensors": len(self._sensors.integers),
            "valve_row": self._valve,
            "valve_rows": valve.rows(task.control_interval),
            **valve.numbers(task.control_interval, car.natural_frequency),
            "valve_moves": not task.holds_damping,
            "block_size": self._block_size,
            "car": self._car,
            "work": compiled.WORK + (car.squared + car.working_rows) * LANES,
            "warm_up_steps": round(task.warm_up / task.control_interval),
            "max_episode_steps": self._max_episode_steps,
            "autoreset": DISABLED if self._restarts else self._autoreset,
            **({} if vary is None else vary.places(self._car)),
            "substep": self._substep,
            "warm_up_damping": task.warm_up_damping,
            "saturation": SATURATION,
            "speed_unit": self._speed_unit,
        }
        speeds = tuple(task.frequency_ratio(speed) for speed in task.speed)
        for name, ends in (("damping", task.damping_range), ("speed", speeds), ("bandwidth", task.bandwidth)):
            numbers[f"{name}_low"], numbers[f"{name}_high"] = ends
        for name, number in numbers.items():
            record[name] = number
        return record

    @property
    def _own_numbers(self) -> npt.NDArray[Any]:
        """The numbers of each lane's own car, shape (blocks, rows, LANES)."""
        rows = slice(self._car // LANES + STATES, self._filters // LANES)
        return self._state.reshape(self.blocks, -1, LANES)[:, rows]

    def _draw(self, mask: npt.NDArray[np.bool_]) -> None:
        """Give the masked environments, which are about to begin their next episode, the cars of that."""
        vary = self.task.vary
        if vary is None or not mask.any():
            return
        where = np.flatnonzero(mask)
        block, lane = np.divmod(where, LANES)
        values = vary.draws(np.ascontiguousarray(self._counter_rows[block, :, lane].T))
        self._drawn = self._drawn.copy()  # the old ones may have been told
        self._drawn[:, where] = values
        rows = vary.numbers(values, self._substep, self.task.control_interval, self._met)
        self._own_numbers[block, :, lane] = rows.T

    def __getstate__(self) -> dict[str, Any]:
        state = self.__dict__.copy()
        del state["_record"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._record = self._make_record()

    def _run(self, function: Callable[..., int], *arguments: Any) -> None:
        """Run a function of the kernel over all blocks.

        Raises:
            PlantError: a number is not finite.
        """
        if self.threads == 1:
            unsound = function(0, self.blocks, self._record, self._state, self._counters, *arguments)
        else:
            edges = [self.blocks * k // self.threads for k in range(self.threads + 1)]
            pool = _pool()
            arguments = (self._record, self._state, self._counters, *arguments)
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
        counters = self._counter_rows
        where = np.flatnonzero(mask)
        block, lane = np.divmod(where, LANES)
        counters[block, 0, lane], counters[block, 1, lane] = keys_from_seeds(seeds[where])
        counters[block, EPISODE // LANES, lane] = np.uint32(0xFFFFFFFF)  # the reset makes it 0

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

    def start(self, seeds: npt.NDArray[np.uint64]) -> Interval:
        """Give every environment a seed, shape (num_envs,), and start its first episode."""
        everyone = np.ones(self.num_envs, np.bool_)
        self.seed(seeds, everyone)
        return self.reset(self.forced({}), everyone)

    def reset(self, forced: npt.NDArray[np.float64], mask: npt.NDArray[np.bool_]) -> Interval:
        """Start the masked environments in their next episode; reward and mean squares are 0."""
        observations = np.empty(self._observed, np.float32)
        results = np.zeros(self._results)
        self._draw(mask)
        self._run(kernel.reset_blocks, forced, mask, observations, results)
        self.started, self.drawn = True, self._drawn
        return self._interval(observations, results, np.zeros(self.num_envs, np.bool_), observations)

    def step(self, actions: npt.NDArray[np.float32]) -> Interval:
        """One control interval with the damping ratios ``actions``, shape (num_envs,)."""
        observations = np.empty(self._observed, np.float32)
        final = np.empty_like(observations) if self._autoreset == SAME_STEP else observations
        results = np.empty(self._results)
        truncated = np.empty(self.num_envs, np.bool_)
        if self.task.vary is not None:
            self._draw(self._counter_rows[:, PENDING // LANES].reshape(-1)[: self.num_envs] != 0)
            self.drawn = self._drawn
        self._run(kernel.step_blocks, actions, observations, results, truncated, final)
        if self._restarts and truncated.any():
            final[:] = observations
            told, begun = self.drawn, self.reset(self.forced({}), truncated).observations
            self.drawn, observations[truncated] = told, begun[truncated]
        return self._interval(observations, results, truncated, final)

    def trace(self, actions: npt.NDArray[np.float32]) -> tuple[Interval, npt.NDArray[Any], npt.NDArray[Any]]:
        """`step`, and what was met on the way.

        Returns:
            The interval; the angle wavenumber * distance that each substep turned, and the level at its end in standard
            deviations of the road, shape (substeps, num_envs) each.
        """
        path = np.empty((self.blocks, self.task.substeps, 2, LANES), self.dtype)
        self._record["path"] = path.ctypes.data
        try:
            interval = self.step(actions)
        finally:
            self._record["path"] = 0
        angle, level = np.moveaxis(path, (2, 1), (0, 1)).reshape(2, self.task.substeps, -1)[:, :, : self.num_envs]
        return interval, angle, level

    @property
    def elapsed_steps(self) -> npt.NDArray[np.int64]:
        """Control intervals since each environment's episode began, shape (num_envs,); can be set, to stagger their ends."""
        return self._counter_rows[:, STEP // LANES].reshape(-1)[: self.num_envs].astype(np.int64)

    @elapsed_steps.setter
    def elapsed_steps(self, steps: npt.ArrayLike) -> None:
        padded = np.resize(np.broadcast_to(np.asarray(steps, np.uint32), self.num_envs), self.blocks * LANES)
        self._counter_rows[:, STEP // LANES] = padded.reshape(self.blocks, LANES)

    @property
    def _counter_rows(self) -> npt.NDArray[np.uint32]:
        return self._counters.reshape(self.blocks, -1, LANES)

    @property
    def nbytes(self) -> int:
        """Memory of the state of all environments, bytes."""
        return self._state.nbytes + self._counters.nbytes

    @property
    def road_states(self) -> npt.NDArray[Any]:
        """The states of the road's shaping filter, shape (states, num_envs).

        Raises:
            ParameterError: a road that does not keep them.
        """
        rows = self.task.road.state_rows
        if rows is None:
            raise ParameterError(f"a {self.task.road.kind} road does not keep the states of a shaping filter")
        return np.stack([self.row(row) for row in rows])

    @property
    def car_states(self) -> npt.NDArray[Any]:
        """The states of the car, in the order of its motion, shape (states, num_envs)."""
        return np.stack([self.row(name) for name in self.task.car.motion.states])

    def _offset(self, row: str | int) -> int:
        states = self.task.car.motion.states
        if row in states:
            place = states.index(str(row))
            return self._car + place * LANES if place < self._own_states else self._filters + (place - self._own_states) * LANES
        if row == "damping" and not self.task.ideal_valve:
            return self._valve
        return BUS[row] if isinstance(row, str) else row

    def row(self, row: str | int) -> npt.NDArray[Any]:
        """A copy of one row of the state, shape (num_envs,), in the kernel's units.

        Args:
            row: the name of a state of the car, a name of `BUS`, "damping" for that in force behind a valve that is not ideal,
                or a row of the road's own by its offset.
        """
        rows = self._state.reshape(self.blocks, -1, LANES)
        return rows[:, self._offset(row) // LANES, :].reshape(-1)[: self.num_envs].copy()

    def set_row(self, row: str | int, values: npt.ArrayLike) -> None:
        """Replace one row of the state, for every environment."""
        rows = self._state.reshape(self.blocks, -1, LANES)
        padded = np.resize(np.broadcast_to(np.asarray(values, self.dtype), self.num_envs), self.blocks * LANES)
        rows[:, self._offset(row) // LANES, :] = padded.reshape(self.blocks, LANES)
