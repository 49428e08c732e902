"""What is observed of a block: the state, signals and the operating point, as they are or as sensors tell them."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from .compiled import BANDWIDTH, LANES, SPEED, LaneFunction, address_of, call_two, compiled, like, pointer, row_of
from .noise import SENSOR, SENSOR_BIAS, normal_pair, philox
from .record import (
    EPISODE,
    KEY,
    OBSERVED_BANDWIDTH,
    OBSERVED_SENSOR,
    OBSERVED_SIGNAL,
    OBSERVED_SPEED,
    STEP,
)
from .sensors import (
    BIAS,
    COMMON,
    DELAY,
    INTEGERS,
    NAME,
    NOISE,
    NUMBERS,
    OFFSET,
    PERIOD,
    PLACE,
    RESOLUTION,
    SLOTS,
    SOURCE,
)
from .signals import clip, seen_row, signal_row, write_observed


@compiled
def source_row(plant: Any, lanes: Any, work: Any, source: int) -> Any:
    """The row of a signal now."""
    return row_of(lanes, source) if source >= 0 else write_observed(plant, lanes, work, OBSERVED_SIGNAL - source)


@compiled
def sensor_of(plant: Any, s: int) -> tuple[Any, Any]:
    """The integers and the numbers of sensor ``s``."""
    integers = pointer(plant.sensor_integers + np.uint64(8 * INTEGERS * s), np.int64(0))
    return integers, pointer(plant.sensor_numbers + np.uint64(8 * NUMBERS * s), 0.0)


@compiled
def draw(sensor: Any, purpose: int, number: int, counters: Any, i: int) -> Any:
    """A standard normal number of a sensor of lane ``i``."""
    w0, w1, _, _ = philox(
        np.uint32(sensor[NAME]),
        np.uint32(number),
        counters[EPISODE + i],
        np.uint32(purpose),
        counters[KEY + i],
        counters[KEY + LANES + i],
    )
    return normal_pair(w0, w1)[0]


@compiled
def sample(lanes: Any, i: int, value: Any, sensor: Any, numbers: Any, number: int, counters: Any) -> Any:
    """Sample ``number`` of lane ``i`` of a signal that is ``value``."""
    found = value + lanes[sensor[PLACE] + i] + like(lanes, numbers[NOISE]) * draw(sensor, SENSOR, number, counters, i)
    step = like(lanes, numbers[RESOLUTION])
    return np.rint(found / step) * step if step > 0 else found


@compiled
def start_sensors(plant: Any, lanes: Any, work: Any, counters: Any, due: Any) -> None:
    """Draw the biases of the lanes that are ``due`` to start, and take their first samples."""
    for s in range(plant.sensors):
        sensor, numbers = sensor_of(plant, s)
        row, place = source_row(plant, lanes, work, sensor[SOURCE]), sensor[PLACE]
        for i in range(LANES):
            if due[i]:
                lanes[place + i] = like(lanes, numbers[BIAS]) * draw(sensor, SENSOR_BIAS, 0, counters, i)
                first = sample(lanes, i, row[i], sensor, numbers, 0, counters)
                for slot in range(1, sensor[SLOTS] + 1):
                    lanes[place + slot * LANES + i] = first


@compiled
def advance_sensors(plant: Any, lanes: Any, work: Any, counters: Any, done: int) -> None:
    """Take the samples that are due after ``done`` substeps of an interval."""
    for s in range(plant.sensors):
        sensor, numbers = sensor_of(plant, s)
        period, slots = sensor[PERIOD], sensor[SLOTS]
        if (done + sensor[OFFSET]) % sensor[COMMON] != 0:
            continue
        row = source_row(plant, lanes, work, sensor[SOURCE])
        for i in range(LANES):
            time = np.int64(counters[STEP + i]) * plant.substeps + done + sensor[OFFSET]
            if time % period == 0:
                number = time // period
                place = sensor[PLACE] + (1 + number % slots) * LANES
                lanes[place + i] = sample(lanes, i, row[i], sensor, numbers, number, counters)


@compiled
def read_sensor(plant: Any, lanes: Any, counters: Any, s: int, target: Any) -> None:
    """Write what sensor ``s`` tells at the end of an interval to a row; before its first sample that of the start."""
    sensor, _ = sensor_of(plant, s)
    for i in range(LANES):
        time = np.int64(counters[STEP + i]) * plant.substeps + sensor[OFFSET] - sensor[DELAY]
        target[i] = lanes[sensor[PLACE] + (1 + (time // sensor[PERIOD]) % sensor[SLOTS]) * LANES + i]


@functools.cache
def arranged(number: int) -> LaneFunction:
    """Writes ``number`` rows of a block as columns: for a number that is known the compiler turns them in registers."""

    def arrange(rows: Any, seen: Any) -> None:
        for i in range(LANES):
            for j in range(number):
                seen[number * i + j] = rows[j * LANES + i]

    return LaneFunction(arrange)


@compiled
def observe_block(plant: Any, lanes: Any, work: Any, counters: Any, observations: Any, first: int, count: int) -> None:
    """Write what is observed of the first ``count`` lanes to the rows from ``first`` at the address ``observations``."""
    one, two = like(lanes, 1.0), like(lanes, 2.0)
    high = like(lanes, plant.saturation)
    low = -high
    observed, number = pointer(plant.observed, np.int64(0)), plant.observed_signals
    own, seen = row_of(work, signal_row(plant)), row_of(work, seen_row(plant))
    for j in range(number):
        what, row = observed[j], own
        if what >= 0:
            row = row_of(lanes, what)
        elif what == OBSERVED_SPEED:
            for i in range(LANES):
                own[i] = lanes[SPEED + i] / (one + lanes[SPEED + i])
        elif what == OBSERVED_BANDWIDTH:
            for i in range(LANES):
                own[i] = two * lanes[BANDWIDTH + i] / (one + two * lanes[BANDWIDTH + i])
        elif what <= OBSERVED_SENSOR:
            read_sensor(plant, lanes, counters, OBSERVED_SENSOR - what, own)
        else:
            write_observed(plant, lanes, work, OBSERVED_SIGNAL - what)
        for i in range(LANES):
            seen[j * LANES + i] = clip(row[i], low, high)
    target = row_of(pointer(observations, np.float32(0)), first * number)
    if count == LANES:
        call_two(plant.arrange, address_of(seen), address_of(target))
    else:
        for i in range(count):
            for j in range(number):
                target[i * number + j] = seen[j * LANES + i]
