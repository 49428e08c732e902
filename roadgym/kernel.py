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
    INVERSE_SUBSTEP,
    LANES,
    LEVEL,
    RATE,
    SHARE,
    SLOPE,
    SPEED,
    SUBSTEP,
    TURN,
    LaneFunction,
    address_of,
    call,
    call_car,
    compiled,
    counted,
    drain,
    like,
    pointer,
    record_at,
    row_of,
)
from .moved import moved
from .noise import INTERVAL, START, WARM_UP, philox, uniform
from .record import (
    BEGIN,
    COUNTERS,
    END,
    EPISODE,
    KEY,
    LEVELS,
    NEXT_STEP,
    PENDING,
    PLANT,
    PLANT_ADDRESS,
    POINTS,
    RESULT_BANDWIDTH,
    RESULT_DAMPING,
    RESULT_SPEED,
    REWARD,
    SAME_STEP,
    SLOPES,
    SPARE_ADDRESS,
    SQUARES,
    STEP,
    UNSOUND,
    WORDS_ADDRESS,
    WORK_ADDRESS,
)
from .sensing import advance_sensors, observe_block, start_sensors
from .signals import (
    add_own_squares,
    add_squares,
    advance_filters,
    clip,
    prepare_filters,
    report_block,
    report_row,
    result_row,
    state_row,
    tell_row,
    work_end,
)

if not TYPE_CHECKING:
    __getattr__ = moved(
        __name__,
        DISABLED="roadgym.record",
        SIGNALS="roadgym.moved",
        free_decay="roadgym.cars.one_mass",
        inlined="roadgym.compiled",
        interval_weights="roadgym.record",
    )

START_WORDS = 12  # random words of the start of an episode: four each for operating point, road and speed noise

# rows of the spare words: which lanes are to start, what `noise.fill_words` is asked, and counters to come back to
DUE, REQUEST, KEPT = 0 * LANES, 1 * LANES, 2 * LANES
SPARE = KEPT + COUNTERS


@counted
def words_met(plant: Any) -> int:
    """How many words the random numbers of an interval, or of a start, take."""
    return int(LANES * (max(plant.substeps * (plant.road_words + plant.speed_words), START_WORDS) + 3))


@counted
def numbers_met(plant: Any) -> int:
    """How many numbers a call of the kernel needs beside the state: ``work``, and a copy of a block."""
    return int(work_end(plant) + plant.block_size)


@compiled
def draw_words(plant: Any, words: Any, spare: Any, counters: Any, purpose: int, count: int) -> None:
    """Fill ``count`` rows of ``words`` with the words of this episode and step for ``purpose``."""
    spare[REQUEST], spare[REQUEST + 1] = purpose, count
    call(plant.fill_words, address_of(counters), address_of(words), address_of(row_of(spare, REQUEST)))


@compiled
def prepare_work(plant: Any, work: Any) -> None:
    """Set what is the same in all intervals."""
    work[SUBSTEP] = plant.substep
    work[INVERSE_SUBSTEP] = 1.0 / plant.substep


@compiled
def drive_interval(plant: Any, lanes: Any, work: Any, counters: Any, words: Any, spare: Any, purpose: int, path: Any) -> None:
    """Drive one block through one control interval; leaves the mean squares in ``work``.

    ``path`` is the address of rows for the angle and the level of each substep, or 0.
    """
    substeps, more = plant.substeps, plant.signals > plant.squared
    draw_words(plant, words, spare, counters, purpose, substeps * (plant.road_words + plant.speed_words))
    block, word, own = address_of(lanes), address_of(words), address_of(work)
    car = address_of(row_of(lanes, plant.car))
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
                    call(plant.road_prepare, address_of(row_of(lanes, i)), word, plant.road_table)
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

    ``forced`` is the address of two rows, speed and bandwidth of each environment, or 0; what is not NaN replaces the draw.
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
    if forced != 0 and first + i < plant.environments:
        points = row_of(pointer(forced, 0.0), first + i)
        if not np.isnan(points[0]):
            speed = points[0]
        if not np.isnan(points[plant.environments]):
            bandwidth = points[plant.environments]
    for row in range(0, plant.block_size, LANES):
        if row < plant.kept or row >= plant.kept_end:
            lanes[row + i] = 0.0
    lanes[SPEED + i] = speed
    lanes[BANDWIDTH + i] = bandwidth
    lanes[RATE + i] = speed
    lanes[TURN + i] = speed * plant.substep
    lane, word = address_of(row_of(lanes, i)), address_of(words)
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
def restart_due(plant: Any, lanes: Any, counters: Any, work: Any, words: Any, spare: Any, forced: Any, first: int) -> None:
    """Start the lanes of a block that are due in their next episode, warm-up included, and leave the others as they are."""
    due = row_of(spare, DUE)
    for i in range(LANES):
        if due[i]:
            counters[EPISODE + i] += np.uint32(1)
            counters[STEP + i] = np.uint32(0)
            counters[PENDING + i] = np.uint32(0)
            start_lane(plant, lanes, i, counters, words, forced, first)
    if plant.warm_up_steps > 0:
        kept, kept_counters = row_of(work, work_end(plant)), row_of(spare, KEPT)
        for k in range(plant.block_size):
            kept[k] = lanes[k]
        for k in range(COUNTERS):
            kept_counters[k] = counters[k]
        for i in range(LANES):
            work[DAMPING + i] = plant.warm_up_damping
        for _ in range(plant.warm_up_steps):
            drive_interval(plant, lanes, work, counters, words, spare, WARM_UP, np.uint64(0))
            for i in range(LANES):
                counters[STEP + i] += np.uint32(1)
        for k in range(COUNTERS):
            counters[k] = kept_counters[k]
        for row in range(0, plant.block_size, LANES):
            for i in range(LANES):
                if not due[i]:
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
def forget(plant: Any, lanes: Any, first: int, i: int) -> None:
    """Let the results of lane ``i`` be those of a reset, but for the operating point: reward, D and mean squares are 0."""
    result_row(plant, REWARD, first)[i] = result_row(plant, RESULT_DAMPING, first)[i] = 0.0
    row_of(pointer(plant.rewards, lanes), first)[i] = 0.0
    for row in range(SQUARES, SQUARES + plant.signals + (1 if plant.valve else 0)):
        result_row(plant, row, first)[i] = 0.0


@LaneFunction
def step_blocks(order: Any, state: Any) -> None:
    """Advance blocks by one control interval; see the module's docstring, and `roadgym.record` for the order."""
    plant = record_at(np.uint64(order[PLANT_ADDRESS]), PLANT)
    work = pointer(np.uint64(order[WORK_ADDRESS]), state)
    words, spare = (
        pointer(np.uint64(order[WORDS_ADDRESS]), np.uint32(0)),
        pointer(np.uint64(order[SPARE_ADDRESS]), np.uint32(0)),
    )
    all_counters, actions = pointer(plant.counters, np.uint32(0)), pointer(plant.actions, np.float32(0))
    all_over, due, unsound, nothing_forced = pointer(plant.truncated, np.uint8(0)), row_of(spare, DUE), -1, np.uint64(0)
    low, high = like(state, plant.damping_low), like(state, plant.damping_high)
    mode, size = plant.autoreset, plant.block_size
    limit = np.uint32(plant.max_episode_steps if plant.max_episode_steps > 0 else 0xFFFFFFFF)
    prepare_work(plant, work)
    for i in range(LANES):
        work[DAMPING + i] = low
    for b in range(order[BEGIN], order[END]):
        lanes, counts, first = row_of(state, b * size), row_of(all_counters, b * COUNTERS), b * LANES
        count = min(LANES, plant.environments - first)
        asked, over = row_of(actions, first), row_of(all_over, first)
        for i in range(count):
            work[DAMPING + i] = clip(like(state, asked[i]), low, high)
        path = plant.path
        if path != 0:
            path = address_of(row_of(pointer(path, state), 2 * b * plant.substeps * LANES))
        drive_interval(plant, lanes, work, counts, words, spare, INTERVAL, path)
        found = report_block(plant, lanes, work, first, count)
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
            for i in range(LANES):
                due[i] = counts[PENDING + i] if i < count else np.uint32(0)
                if due[i]:
                    over[i] = 0
                    forget(plant, lanes, first, i)
        elif mode == SAME_STEP and ended:
            for i in range(LANES):
                due[i] = over[i] if i < count else 0
            observe_block(plant, lanes, work, counts, plant.final_observations, first, count)
        if pending or (mode == SAME_STEP and ended):
            restart_due(plant, lanes, counts, work, words, spare, nothing_forced, first)
            speeds, bandwidths = result_row(plant, RESULT_SPEED, first), result_row(plant, RESULT_BANDWIDTH, first)
            for i in range(count):
                # a new episode has no action yet: its first observation is that of the softest damper, as after `reset`
                if plant.valve:
                    work[DAMPING + i] = lanes[plant.valve_row + i]
                else:
                    work[DAMPING + i] = low if due[i] else clip(like(state, asked[i]), low, high)
                if pending and due[i]:
                    speeds[i] = lanes[SPEED + i] * plant.speed_unit
                    bandwidths[i] = lanes[BANDWIDTH + i]
            start_sensors(plant, lanes, work, counts, due)
            if unsound < 0:
                unsound = unsound_state(plant, lanes, count, first)
        if mode == NEXT_STEP and ended:
            for i in range(count):
                counts[PENDING + i] = over[i]
        observe_block(plant, lanes, work, counts, plant.observations, first, count)
    drain()
    order[UNSOUND] = unsound


@LaneFunction
def reset_blocks(order: Any, state: Any) -> None:
    """Start the masked environments of blocks in their next episode, and observe all; see `roadgym.record` for the order."""
    plant = record_at(np.uint64(order[PLANT_ADDRESS]), PLANT)
    work = pointer(np.uint64(order[WORK_ADDRESS]), state)
    words, spare = (
        pointer(np.uint64(order[WORDS_ADDRESS]), np.uint32(0)),
        pointer(np.uint64(order[SPARE_ADDRESS]), np.uint32(0)),
    )
    all_counters, size, unsound = pointer(plant.counters, np.uint32(0)), plant.block_size, -1
    due = row_of(spare, DUE)
    prepare_work(plant, work)
    for b in range(order[BEGIN], order[END]):
        lanes, counts, first = row_of(state, b * size), row_of(all_counters, b * COUNTERS), b * LANES
        count = min(LANES, plant.environments - first)
        mask = row_of(pointer(plant.mask, np.uint8(0)), first)
        for i in range(LANES):
            # lanes beyond the last environment follow the first one, so that they hold sound numbers
            due[i] = mask[i] if i < count else mask[0]
        restart_due(plant, lanes, counts, work, words, spare, plant.forced, first)
        for i in range(LANES):
            work[DAMPING + i] = lanes[plant.valve_row + i] if plant.valve else like(lanes, plant.damping_low)
        start_sensors(plant, lanes, work, counts, due)
        observe_block(plant, lanes, work, counts, plant.observations, first, count)
        report_row(plant, row_of(work, DAMPING), result_row(plant, RESULT_DAMPING, first), count, 1.0)
        report_row(plant, row_of(lanes, SPEED), result_row(plant, RESULT_SPEED, first), count, plant.speed_unit)
        report_row(plant, row_of(lanes, BANDWIDTH), result_row(plant, RESULT_BANDWIDTH, first), count, 1.0)
        if unsound < 0:
            unsound = unsound_state(plant, lanes, count, first)
    drain()
    order[UNSOUND] = unsound


@LaneFunction
def drive_roads(order: Any, state: Any) -> None:
    """Drive the roads of blocks alone, from their start on; levels and slopes after each few substeps.

    They meet the words of control intervals of one substep.
    """
    plant = record_at(np.uint64(order[PLANT_ADDRESS]), PLANT)
    words, spare = (
        pointer(np.uint64(order[WORDS_ADDRESS]), np.uint32(0)),
        pointer(np.uint64(order[SPARE_ADDRESS]), np.uint32(0)),
    )
    levels, slopes = pointer(np.uint64(order[LEVELS]), 0.0), pointer(np.uint64(order[SLOPES]), 0.0)
    all_counters, size, unsound = pointer(plant.counters, np.uint32(0)), plant.block_size, -1
    for b in range(order[BEGIN], order[END]):
        lanes, counts, first = row_of(state, b * size), row_of(all_counters, b * COUNTERS), b * LANES
        count = min(LANES, plant.environments - first)
        for i in range(LANES):
            start_lane(plant, lanes, i, counts, words, np.uint64(0), first)
        for k in range(order[POINTS]):
            for _ in range(plant.substeps if k > 0 else 0):
                draw_words(plant, words, spare, counts, INTERVAL, plant.road_words)
                call(plant.road_advance, address_of(lanes), address_of(words), plant.road_table)
                for i in range(LANES):
                    counts[STEP + i] += np.uint32(1)
            tell_row(row_of(lanes, LEVEL), row_of(levels, k * plant.environments + first), count, 1.0)
            tell_row(row_of(lanes, SLOPE), row_of(slopes, k * plant.environments + first), count, 1.0)
            if unsound < 0:
                unsound = unsound_state(plant, lanes, count, first)
    order[UNSOUND] = unsound
