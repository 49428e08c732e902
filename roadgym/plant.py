"""A batch of cars on roads: holds the arrays that the kernel steps, and shares the blocks out between threads."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from . import compiled, kernel
from .addresses import lane_address, padded_table
from .cars import Car
from .cars.linear import STATES
from .compiled import COEFFICIENT, LANES, LaneFunction
from .filters import filter_table
from .interval import CommandedInterval as CommandedInterval
from .interval import Floats as Floats
from .interval import Interval as Interval
from .noise import fill_words, keys_from_seeds
from .parameters import ParameterError, PlantError, number_array, shown, within
from .pool import pool
from .processors import usual_threads
from .record import (
    BEGIN,
    COUNTERS,
    DISABLED,
    END,
    EPISODE,
    NEXT_STEP,
    OBSERVED_BANDWIDTH,
    OBSERVED_SENSOR,
    OBSERVED_SIGNAL,
    OBSERVED_SPEED,
    ORDER,
    PENDING,
    PLANT,
    PLANT_ADDRESS,
    SAME_STEP,
    SPARE_ADDRESS,
    SQUARES,
    STEP,
    STREAMED,
    UNSOUND,
    WORDS_ADDRESS,
    WORK_ADDRESS,
    interval_weights,
)
from .reused import Reused
from .reward import divergent_terms
from .roads import Road
from .sensing import arranged
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

# where the record has what every step sets
OBSERVATIONS, FINAL_OBSERVATIONS, RESULTS, REWARDS, TRUNCATED, MASK, FORCED = (
    PLANT.names.index(name)  # type: ignore[union-attr]
    for name in ("observations", "final_observations", "results", "rewards", "truncated", "mask", "forced")
)


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
        self.car_row = COEFFICIENT + road.rows * LANES
        self._filters = self.car_row + car.rows * LANES
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
        self._observations = Reused((num_envs, len(task.signals)), np.float32)
        self._results = Reused(
            (SQUARES + len(task.reward) + (not valve.ideal), num_envs), np.float64, lines=num_envs >= STREAMED
        )
        self._rewards, self._truncated = Reused(num_envs, self.dtype), Reused(num_envs, np.bool_)
        self._asked = np.zeros(num_envs, np.float32)
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
        self._connect()
        self.drawn = self.drawn_now = np.zeros((0 if vary is None else len(vary.names), num_envs))  # told; who drives on
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

    def _connect(self) -> None:
        """All that has addresses of this process."""
        self._record = self._make_record()
        self._fields = self._record.view(np.uint64)
        plant, edges = self._record.view(np.recarray)[0], [self.blocks * k // self.threads for k in range(self.threads + 1)]
        spaces = (kernel.numbers_met(plant), self.dtype), (kernel.words_met(plant), np.uint32), (kernel.SPARE, np.uint32)
        self._spaces = [[np.zeros(*space) for space in spaces] for _ in range(self.threads)]
        self._orders = np.zeros((self.threads, ORDER), np.int64)
        for order, own, (begin, end) in zip(self._orders, self._spaces, itertools.pairwise(edges), strict=True):
            order[BEGIN], order[END], order[PLANT_ADDRESS] = begin, end, self._record.ctypes.data
            order[[WORK_ADDRESS, WORDS_ADDRESS, SPARE_ADDRESS]] = [space.ctypes.data for space in own]
        self._places = [(order.ctypes.data, self._state.ctypes.data) for order in self._orders]
        self._step, self._reset = kernel.step_blocks.entry(self.dtype), kernel.reset_blocks.entry(self.dtype)

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
        record["arrange"] = arranged(len(task.signals)).address(self.dtype)
        record["counters"], record["actions"] = self._counters.ctypes.data, self._asked.ctypes.data
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
            "observed_signals": len(task.signals),
            "environments": self.num_envs,
            "sensors": len(self._sensors.integers),
            "valve_row": self._valve,
            "valve_rows": valve.rows(task.control_interval),
            **valve.numbers(task.control_interval, car.natural_frequency),
            "valve_moves": not task.holds_damping,
            "block_size": self._block_size,
            "car": self.car_row,
            "work": compiled.WORK + (car.squared + car.working_rows) * LANES,
            "warm_up_steps": round(task.warm_up / task.control_interval),
            "max_episode_steps": self._max_episode_steps,
            "autoreset": DISABLED if self._restarts else self._autoreset,
            **({} if vary is None else vary.places(self.car_row)),
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
        rows = slice(self.car_row // LANES + STATES, self._filters // LANES)
        return self._state.reshape(self.blocks, -1, LANES)[:, rows]

    def _draw(self, mask: npt.NDArray[np.bool_]) -> None:
        """Give the masked environments, which are about to begin their next episode, the cars of that."""
        vary = self.task.vary
        if vary is None or not mask.any():
            return
        where = np.flatnonzero(mask)
        block, lane = np.divmod(where, LANES)
        values = vary.draws(np.ascontiguousarray(self._counter_rows[block, :, lane].T))
        self.drawn_now = self.drawn_now.copy()  # the old ones may have been told
        self.drawn_now[:, where] = values
        rows = vary.numbers(values, self._substep, self.task.control_interval, self._met)
        self._own_numbers[block, :, lane] = rows.T

    def __getstate__(self) -> dict[str, Any]:
        local = ("_record", "_fields", "_spaces", "_orders", "_places", "_step", "_reset")
        return {name: value for name, value in self.__dict__.items() if name not in local}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._connect()

    def _run(self, function: Callable[..., None]) -> None:
        """Run a function of the kernel over all blocks.

        Raises:
            PlantError: a number is not finite.
        """
        if self.threads == 1:
            function(*self._places[0])
        else:
            futures = [pool().submit(function, *places) for places in self._places[1:]]
            function(*self._places[0])
            for future in futures:
                future.result()
        found = self._orders[:, UNSOUND].tolist()
        if max(found) >= 0:
            unsound = min(environment for environment in found if environment >= 0)
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
        observations, results, rewards, _ = self._taken()
        results[:] = 0
        rewards[:] = 0
        mask = np.ascontiguousarray(mask)
        self._fields[MASK], self._fields[FORCED] = mask.ctypes.data, forced.ctypes.data
        self._draw(mask)
        self._run(self._reset)
        self.started, self.drawn = True, self.drawn_now
        return self._interval(observations, results, rewards, np.zeros(self.num_envs, np.bool_), observations)

    def _taken(self) -> tuple[npt.NDArray[Any], ...]:
        """Where the kernel writes next: observations, results, rewards, truncated."""
        fields = self._fields
        observations, fields[OBSERVATIONS] = self._observations.take()
        results, fields[RESULTS] = self._results.take()
        rewards, fields[REWARDS] = self._rewards.take()
        truncated, fields[TRUNCATED] = self._truncated.take()
        return observations, results, rewards, truncated

    def step(self, actions: npt.NDArray[np.float32]) -> Interval:
        """One control interval with the damping ratios ``actions``, shape (num_envs,)."""
        observations, results, rewards, truncated = self._taken()
        final = observations
        if self._autoreset == SAME_STEP:
            final, self._fields[FINAL_OBSERVATIONS] = self._observations.take()
        self._asked[:] = actions
        if self.task.vary is not None:
            self._draw(self._counter_rows[:, PENDING // LANES].reshape(-1)[: self.num_envs] != 0)
            self.drawn = self.drawn_now
        self._run(self._step)
        if self._restarts and truncated.any():
            final[:] = observations
            told, begun = self.drawn, self.reset(self.forced({}), truncated).observations
            self.drawn, observations[truncated] = told, begun[truncated]
        return self._interval(observations, results, rewards, truncated, final)

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
            place, own = states.index(str(row)), self._own_states
            return self.car_row + place * LANES if place < own else self._filters + (place - own) * LANES
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
