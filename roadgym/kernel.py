"""The one stepping kernel: it serves the single environment (lane 0 of one block) and the batch alike.

Data flow of one control interval, for each block of LANES lanes (see `roadgym.compiled` for the layout):

1. clip the actions to the damping range; the car prepares for that damping;
2. draw all random words of the interval, a pure function of (seed, episode, step);
3. for each substep: a valve that is not ideal moves the damping, and the car prepares anew; the speed noise turns the road's
   angle, the road advances, the car follows, and filters of its signals follow it, the squares add up, sensors take samples;
4. add up the reward from the mean squares, count the step, observe;
5. lanes whose episode is over start anew, one by one.

The mean square of an interval is that of its integral, by Gregory's rule over the ends of the substeps (`interval_weights`).
The acceleration jumps with the damping: its square at the beginning counts with the new damping. Nothing that is not finite
leaves unseen: the functions that step and reset tell the first environment in which a number is not.

What differs between plants is in the record `roadgym.record.PLANT`. Nothing depends on how blocks are shared out between
threads. Per-lane integers are rows of ``counters`` like the rows of a block.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .actuation import close_substep, open_substep, start_valve, take_commands
from .compiled import (
    BANDWIDTH,
    DAMPING,
    LANES,
    LEVEL,
    RATE,
    SHARE,
    SLOPE,
    SPEED,
    TURN,
    call,
    call_car,
    compiled,
    like,
    pointer,
)
from .moved import moved
from .noise import INTERVAL, START, WARM_UP, philox, uniform
from .record import (
    COUNTERS,
    EPISODE,
    KEY,
    NEXT_STEP,
    PENDING,
    RESULT_BANDWIDTH,
    RESULT_DAMPING,
    RESULT_SPEED,
    REWARD,
    SAME_STEP,
    SQUARES,
    STEP,
)
from .sensing import advance_sensors, observe_block, start_sensors
from .signals import (
    add_own_squares,
    add_squares,
    advance_filters,
    clip,
    copy_row,
    new_work,
    prepare_filters,
    report_block,
    row_of,
    state_row,
)

if not TYPE_CHECKING:
    __getattr__ = moved(
        __name__,
        DISABLED="roadgym.record",
        LaneFunction="roadgym.compiled",
        SIGNALS="roadgym.moved",
        free_decay="roadgym.cars.one_mass",
        inlined="roadgym.compiled",
        interval_weights="roadgym.record",
    )

START_WORDS = 12  # random words of the start of an episode: four each for operating point, road and speed noise


@compiled
def draw_words(plant: Any, words: Any, counters: Any, purpose: int, count: int) -> None:
    """Fill ``count`` rows of ``words`` with the words of this episode and step for ``purpose``."""
    request = np.array((purpose, count), np.uint32)
    call(plant.fill_words, counters.ctypes.data, words.ctypes.data, request.ctypes.data)


@compiled
def drive_interval(plant: Any, lanes: Any, work: Any, counters: Any, words: Any, purpose: int, path: Any) -> None:
    """Drive one block through one control interval; leaves the mean squares in ``work``.

    ``path`` is the address of rows for the angle and the level of each substep, or 0.
    """
    substeps, more = plant.substeps, plant.signals > plant.squared
    draw_words(plant, words, counters, purpose, substeps * (plant.road_words + plant.speed_words))
    block, word, own = lanes.ctypes.data, words.ctypes.data, work.ctypes.data
    car = block + np.uint64(lanes.itemsize * plant.car)
    shares, moving = pointer(plant.shares, 0.0), plant.valve_moves != 0 and purpose == INTERVAL
    work[SHARE] = shares[0]
    if plant.valve and purpose == INTERVAL:
        take_commands(plant, lanes, work)
    for k in range(substeps):
        if moving:
            open_substep(plant, lanes, work, k)
        if k == 0 or moving:
            call_car(plant.car_prepare, block, car, own, plant.car_table)
            if plant.filters:
                prepare_filters(plant, lanes, work)
            if plant.own_signals:
                add_own_squares(plant, lanes, work, True)
            elif more:
                add_squares(plant, lanes, work, True)
        if plant.speed_advance != 0:
            call(plant.speed_advance, block, word, plant.speed_table)
            if plant.road_prepare != 0:
                for i in range(LANES):
                    call(plant.road_prepare, block + np.uint64(lanes.itemsize * i), word, plant.road_table)
            word += np.uint64(4 * LANES * plant.speed_words)
        call(plant.road_advance, block, word, plant.road_table)
        work[SHARE] = pointer(plant.valve_shares, 0.0)[2 * k + 1] if moving else shares[k + 1]
        call_car(plant.car_advance, block, car, own, plant.car_table)
        if plant.filters:
            advance_filters(plant, lanes, work)
        if plant.own_signals:
            add_own_squares(plant, lanes, work, False)
        elif more:
            add_squares(plant, lanes, work, False)
        if moving:
            close_substep(plant, lanes, work, k)
        if plant.sensors and purpose == INTERVAL:
            advance_sensors(plant, lanes, work, counters, k + 1)
        if path != 0:
            rows = pointer(path, lanes)
            for i in range(LANES):
                rows[2 * k * LANES + i] = lanes[TURN + i]
                rows[(2 * k + 1) * LANES + i] = lanes[LEVEL + i]
        word += np.uint64(4 * LANES * plant.road_words)


@compiled
def start_lane(plant: Any, lanes: Any, i: int, counters: Any, words: Any, forced: Any, first: int) -> None:
    """Start lane ``i`` of a block: operating point, stationary road, car at rest, where it stands on the road or at zero.

    Filters of its signals start at zero.

    ``forced`` has two rows, speed and bandwidth of each environment, or no columns; where it is not NaN it replaces the draw.
    """
    for chunk in range(START_WORDS // 4):
        w0, w1, w2, w3 = philox(
            np.uint32(chunk),
            np.uint32(0),
            counters[EPISODE + i],
            np.uint32(START),
            counters[KEY + i],
            counters[KEY + LANES + i],
        )
        for k, word in enumerate((w0, w1, w2, w3)):
            words[(4 * chunk + k) * LANES] = word
    speed = plant.speed_low + (plant.speed_high - plant.speed_low) * uniform(words[0])
    bandwidth = plant.bandwidth_low + (plant.bandwidth_high - plant.bandwidth_low) * uniform(words[LANES])
    if first + i < forced.shape[1]:
        if not np.isnan(forced[0, first + i]):
            speed = forced[0, first + i]
        if not np.isnan(forced[1, first + i]):
            bandwidth = forced[1, first + i]
    for row in range(0, lanes.size, LANES):
        if row < plant.kept or row >= plant.kept_end:
            lanes[row + i] = 0.0
    lanes[SPEED + i] = speed
    lanes[BANDWIDTH + i] = bandwidth
    lanes[RATE + i] = speed
    lanes[TURN + i] = speed * plant.substep
    lane, word = lanes.ctypes.data + np.uint64(lanes.itemsize * i), words.ctypes.data
    if plant.road_prepare != 0:
        call(plant.road_prepare, lane, word, plant.road_table)
    call(plant.road_start, lane, word + np.uint64(4 * LANES * 4), plant.road_table)
    start_valve(plant, lanes, i)
    heights = pointer(plant.start, 0.0)
    for j in range(plant.states):
        lanes[state_row(plant, j) + i] = like(lanes, heights[j]) * lanes[LEVEL + i]
    if plant.speed_start != 0:
        call(plant.speed_start, lane, word + np.uint64(4 * LANES * 8), plant.speed_table)


@compiled
def restart_due(plant: Any, lanes: Any, counters: Any, due: Any, work: Any, words: Any, forced: Any, first: int) -> None:
    """Start the lanes of a block that are ``due`` in their next episode, warm-up included, and leave the others as they are."""
    for i in range(LANES):
        if due[i]:
            counters[EPISODE + i] += np.uint32(1)
            counters[STEP + i] = np.uint32(0)
            counters[PENDING + i] = np.uint32(0)
            start_lane(plant, lanes, i, counters, words, forced, first)
    if plant.warm_up_steps > 0:
        kept, kept_counters = lanes.copy(), counters.copy()
        work[DAMPING : DAMPING + LANES] = like(lanes, plant.warm_up_damping)
        for _ in range(plant.warm_up_steps):
            drive_interval(plant, lanes, work, counters, words, WARM_UP, np.uint64(0))
            for i in range(LANES):
                counters[STEP + i] += np.uint32(1)
        counters[:] = kept_counters
        for i in range(LANES):
            if not due[i]:
                for row in range(0, lanes.size, LANES):
                    lanes[row + i] = kept[row + i]


@compiled
def unsound_state(plant: Any, lanes: Any, count: int, first: int) -> int:
    """The first environment of a block whose level or slope is not finite, or -1; a car starts at rest, or warm."""
    unsound = np.int32(0)
    for row in (LEVEL, SLOPE):
        for i in range(count):
            unsound |= np.int32(lanes[row + i] - lanes[row + i] != 0)
    if unsound:
        for i in range(count):
            if not (np.isfinite(lanes[LEVEL + i]) and np.isfinite(lanes[SLOPE + i])):
                return first + i
    return -1


@compiled
def step_blocks(
    begin: int,
    end: int,
    record: Any,
    state: Any,
    counters: Any,
    actions: Any,
    observations: Any,
    results: Any,
    truncated: Any,
    final_observations: Any,
) -> int:
    """Advance the blocks ``begin`` to ``end`` by one control interval; see the module's docstring.

    Returns:
        The first environment in which a number is not finite, or -1.
    """
    plant = record[0]
    unsound = -1
    substep_words = plant.substeps * (plant.road_words + plant.speed_words)
    words = np.empty(LANES * (max(substep_words, START_WORDS) + 3), np.uint32)
    work = new_work(plant, state)
    due = np.zeros(LANES, np.bool_)
    nothing_forced = np.empty((2, 0))
    low, high = like(state, plant.damping_low), like(state, plant.damping_high)
    mode, size = plant.autoreset, plant.block_size
    limit = np.uint32(plant.max_episode_steps if plant.max_episode_steps > 0 else 0xFFFFFFFF)
    work[DAMPING : DAMPING + LANES] = low
    for b in range(begin, end):
        lanes = state[b * size : (b + 1) * size]
        counts = counters[b * COUNTERS : (b + 1) * COUNTERS]
        first = b * LANES
        count = min(LANES, actions.size - first)
        asked, over = row_of(actions, first), truncated[first : first + count]
        for i in range(count):
            work[DAMPING + i] = clip(like(state, asked[i]), low, high)
        path = plant.path
        if path != 0:
            path += np.uint64(2 * b * plant.substeps * LANES * lanes.itemsize)
        drive_interval(plant, lanes, work, counts, words, INTERVAL, path)
        found = report_block(plant, lanes, work, results, first, count)
        if unsound < 0:
            unsound = found

        ended, pending = np.uint32(0), np.uint32(0)
        for i in range(LANES):  # lanes beyond the last environment need new noise too
            counts[STEP + i] += np.uint32(1)
        for i in range(count):
            over[i] = counts[STEP + i] >= limit
            ended |= np.uint32(over[i])
            pending |= counts[PENDING + i]
        if pending:  # these lanes moved, but what they did is thrown away: for them this step is the reset
            for i in range(count):
                due[i] = counts[PENDING + i] != 0
                if due[i]:
                    over[i] = False
                    results[REWARD, first + i], results[RESULT_DAMPING, first + i] = 0.0, 0.0
                    for row in range(SQUARES, results.shape[0]):
                        results[row, first + i] = 0.0
        elif mode == SAME_STEP and ended:
            for i in range(count):
                due[i] = over[i]
            observe_block(plant, lanes, work, counts, final_observations, first, count)
        if pending or (mode == SAME_STEP and ended):
            restart_due(plant, lanes, counts, due, work, words, nothing_forced, first)
            for i in range(count):
                # a new episode has no action yet: its first observation is that of the softest damper, as after `reset`
                if plant.valve:
                    work[DAMPING + i] = lanes[plant.valve_row + i]
                else:
                    work[DAMPING + i] = low if due[i] else clip(like(state, asked[i]), low, high)
                if pending and due[i]:
                    results[RESULT_SPEED, first + i] = lanes[SPEED + i] * plant.speed_unit
                    results[RESULT_BANDWIDTH, first + i] = lanes[BANDWIDTH + i]
            start_sensors(plant, lanes, work, counts, due)
            if unsound < 0:
                unsound = unsound_state(plant, lanes, count, first)
        if mode == NEXT_STEP and ended:
            for i in range(count):
                counts[PENDING + i] = over[i]
        observe_block(plant, lanes, work, counts, observations, first, count)
    return unsound


@compiled
def reset_blocks(
    begin: int,
    end: int,
    record: Any,
    state: Any,
    counters: Any,
    forced: Any,
    mask: Any,
    observations: Any,
    results: Any,
) -> int:
    """Start the masked environments of the blocks ``begin`` to ``end`` in their next episode, and observe all.

    Returns:
        The first environment in which a number is not finite, or -1.
    """
    plant = record[0]
    unsound = -1
    substep_words = plant.substeps * (plant.road_words + plant.speed_words)
    words = np.empty(LANES * (max(substep_words, START_WORDS) + 3), np.uint32)
    work = new_work(plant, state)
    due = np.zeros(LANES, np.bool_)
    size = plant.block_size
    for b in range(begin, end):
        lanes = state[b * size : (b + 1) * size]
        counts = counters[b * COUNTERS : (b + 1) * COUNTERS]
        first = b * LANES
        count = min(LANES, mask.size - first)
        for i in range(LANES):
            # lanes beyond the last environment follow the first one, so that they hold sound numbers
            due[i] = mask[first + i] if i < count else mask[first]
        restart_due(plant, lanes, counts, due, work, words, forced, first)
        for i in range(LANES):
            work[DAMPING + i] = lanes[plant.valve_row + i] if plant.valve else like(lanes, plant.damping_low)
        start_sensors(plant, lanes, work, counts, due)
        observe_block(plant, lanes, work, counts, observations, first, count)
        copy_row(work, DAMPING, results, RESULT_DAMPING, first, count, 1.0)
        copy_row(lanes, SPEED, results, RESULT_SPEED, first, count, plant.speed_unit)
        copy_row(lanes, BANDWIDTH, results, RESULT_BANDWIDTH, first, count, 1.0)
        if unsound < 0:
            unsound = unsound_state(plant, lanes, count, first)
    return unsound


@compiled
def drive_roads(begin: int, end: int, record: Any, state: Any, counters: Any, levels: Any, slopes: Any) -> int:
    """Drive the roads of the blocks ``begin`` to ``end`` alone, from their start on; levels and slopes after each few substeps.

    They meet the words of control intervals of one substep.

    Returns:
        The first road with a number that is not finite, or -1.
    """
    plant = record[0]
    words = np.empty(LANES * (max(plant.road_words, START_WORDS) + 3), np.uint32)
    nothing_forced, size, unsound = np.empty((2, 0)), plant.block_size, -1
    for b in range(begin, end):
        lanes = state[b * size : (b + 1) * size]
        counts = counters[b * COUNTERS : (b + 1) * COUNTERS]
        first = b * LANES
        count = min(LANES, levels.shape[1] - first)
        for i in range(LANES):
            start_lane(plant, lanes, i, counts, words, nothing_forced, first)
        for k in range(levels.shape[0]):
            for _ in range(plant.substeps if k > 0 else 0):
                draw_words(plant, words, counts, INTERVAL, plant.road_words)
                call(plant.road_advance, lanes.ctypes.data, words.ctypes.data, plant.road_table)
                for i in range(LANES):
                    counts[STEP + i] += np.uint32(1)
            wrong = copy_row(lanes, LEVEL, levels, k, first, count, 1.0) | copy_row(lanes, SLOPE, slopes, k, first, count, 1.0)
            if wrong and unsound < 0:
                unsound = unsound_state(plant, lanes, count, first)
    return unsound
