"""The one stepping kernel: it serves the single environment (lane 0 of one block) and the batch alike.

Data flow of one control interval, for each block of LANES lanes (see `roadgym.compiled` for the layout):

1. clip the actions to the damping range and compute the car's free decay over one substep;
2. draw all random words of the interval, a pure function of (seed, episode, step);
3. for each substep: the speed noise turns the road's angle, the road advances, the car follows, the squares add up;
4. observe, add up the reward from the mean squares, count the step;
5. lanes whose episode is over start anew: all lanes of the block are started aside, and those due are copied over.

What differs between plants is only which lane functions are called, by address, and how many words they take. Nothing depends
on how blocks are shared out between threads. The integers and numbers that describe a plant are two arrays, indexed by the
names below; per-lane integers are rows of ``counters`` like the rows of a block.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .car import free_decay
from .compiled import (
    BANDWIDTH,
    DISPLACEMENT,
    LANES,
    LEVEL,
    LEVEL_EXCESS,
    RATE,
    SIZE,
    SLOPE,
    SPEED,
    TURN,
    TURN_EXCESS,
    TURN_VARIANCE,
    VELOCITY,
    call,
    compiled,
    like,
)
from .noise import INTERVAL, START, WARM_UP, fill_words, uniform

# integers of a plant
(
    SUBSTEPS,
    ROAD_WORDS,
    SPEED_WORDS,
    ROAD_PREPARE,
    ROAD_START,
    ROAD_ADVANCE,
    SPEED_START,
    SPEED_ADVANCE,
    MAX_EPISODE_STEPS,
    AUTORESET,
    WARM_UP_STEPS,
    HAS_SLOPE,
    INTEGERS,
) = range(13)
NEXT_STEP, SAME_STEP, DISABLED = 0, 1, 2

# numbers of a plant
(
    SUBSTEP,
    DAMPING_LOW,
    DAMPING_HIGH,
    SPEED_LOW,
    SPEED_HIGH,
    BANDWIDTH_LOW,
    BANDWIDTH_HIGH,
    WARM_UP_DAMPING,
    SATURATION,
    WEIGHT,  # first of five
) = range(10)
NUMBERS = WEIGHT + 5

# rows of the counters of a block; the first four are what `fill_words` expects
KEY, EPISODE, STEP, PENDING = 0 * LANES, 2 * LANES, 3 * LANES, 4 * LANES
COUNTERS = 5 * LANES

# rows of the scratch of a block
PREVIOUS_LEVEL, DAMPING = 0 * LANES, 1 * LANES
DECAY_11, DECAY_12, DECAY_22 = 2 * LANES, 3 * LANES, 4 * LANES
SQUARE = 5 * LANES  # five rows, in the order of car.MEAN_SQUARES
SIGNAL = 10 * LANES  # nine rows, in the order of SIGNALS
SCRATCH = 19 * LANES
SIGNALS = (
    "displacement",
    "velocity",
    "level",
    "slope",
    "travel",
    "relative_velocity",
    "acceleration",
    "speed",
    "bandwidth",
)

# rows of the results: what a step reports of each environment
REWARD, RESULT_SQUARE, RESULT_DAMPING, RESULT_SPEED, RESULT_BANDWIDTH, RESULTS = 0, 1, 6, 7, 8, 9


@compiled
def drive_interval(
    lanes: Any,
    scratch: Any,
    counters: Any,
    words: Any,
    road_table: Any,
    speed_table: Any,
    integers: Any,
    numbers: Any,
    purpose: int,
) -> None:
    """Drive one block through one control interval; leaves the mean squares in the scratch."""
    substeps = integers[SUBSTEPS]
    words_per_substep = integers[ROAD_WORDS] + integers[SPEED_WORDS]
    interval = like(lanes, numbers[SUBSTEP])
    two, zero = like(lanes, 2.0), like(lanes, 0.0)
    rate = like(lanes, 1.0 / numbers[SUBSTEP])
    fill_words(words, counters, purpose, substeps * words_per_substep)
    for i in range(LANES):
        phi_11, phi_12, phi_22 = free_decay(scratch[DAMPING + i], interval, lanes)
        scratch[DECAY_11 + i] = phi_11
        scratch[DECAY_12 + i] = phi_12
        scratch[DECAY_22 + i] = phi_22
    scratch[SQUARE : SQUARE + 5 * LANES] = zero

    block, road, speed = lanes.ctypes.data, road_table.ctypes.data, speed_table.ctypes.data
    for substep in range(substeps):
        word = words.ctypes.data + np.uint64(4 * LANES * words_per_substep * substep)
        for i in range(LANES):
            scratch[PREVIOUS_LEVEL + i] = lanes[LEVEL + i]
        if integers[SPEED_ADVANCE] != 0:
            call(np.uint64(integers[SPEED_ADVANCE]), block, word, speed)
            call(np.uint64(integers[ROAD_PREPARE]), block, word, road)
            word += np.uint64(4 * LANES * integers[SPEED_WORDS])
        call(np.uint64(integers[ROAD_ADVANCE]), block, word, road)
        for i in range(LANES):
            damping = scratch[DAMPING + i]
            old_z, z, excess = scratch[PREVIOUS_LEVEL + i], lanes[LEVEL + i], lanes[LEVEL_EXCESS + i]
            k = (z - old_z) * rate - two * damping * excess
            r = lanes[DISPLACEMENT + i] - old_z - excess
            p = lanes[VELOCITY + i] - k
            y = scratch[DECAY_11 + i] * r + scratch[DECAY_12 + i] * p + z + excess
            x = scratch[DECAY_22 + i] * p - scratch[DECAY_12 + i] * r + k
            lanes[DISPLACEMENT + i] = y
            lanes[VELOCITY + i] = x
            travel = y - z
            relative = x - lanes[RATE + i] * lanes[SLOPE + i]
            acceleration = two * damping * relative + travel
            scratch[SQUARE + i] += y * y
            scratch[SQUARE + LANES + i] += x * x
            scratch[SQUARE + 2 * LANES + i] += acceleration * acceleration
            scratch[SQUARE + 3 * LANES + i] += travel * travel
            scratch[SQUARE + 4 * LANES + i] += relative * relative
    share = like(lanes, 1.0 / substeps)
    for i in range(5 * LANES):
        scratch[SQUARE + i] *= share


@compiled
def start_block(
    fresh: Any,
    scratch: Any,
    counters: Any,
    words: Any,
    road_table: Any,
    speed_table: Any,
    integers: Any,
    numbers: Any,
    forced: Any,
    first: int,
) -> None:
    """Start every lane of a block: operating point, stationary road, car at rest, warm-up.

    ``forced`` has two rows, speed and bandwidth of each environment, or no columns; where it is not NaN it replaces the draw.
    """
    zero = like(fresh, 0.0)
    fill_words(words, counters, START, 12)
    for i in range(LANES):
        speed = numbers[SPEED_LOW] + (numbers[SPEED_HIGH] - numbers[SPEED_LOW]) * uniform(words[i])
        bandwidth = numbers[BANDWIDTH_LOW] + (numbers[BANDWIDTH_HIGH] - numbers[BANDWIDTH_LOW]) * uniform(words[LANES + i])
        if first + i < forced.shape[1]:
            if not np.isnan(forced[0, first + i]):
                speed = forced[0, first + i]
            if not np.isnan(forced[1, first + i]):
                bandwidth = forced[1, first + i]
        fresh[SPEED + i] = speed
        fresh[BANDWIDTH + i] = bandwidth
        fresh[RATE + i] = speed
        fresh[TURN + i] = speed * numbers[SUBSTEP]
        fresh[TURN_EXCESS + i] = zero
        fresh[TURN_VARIANCE + i] = zero
        fresh[DISPLACEMENT + i] = zero
        fresh[VELOCITY + i] = zero
        scratch[DAMPING + i] = numbers[WARM_UP_DAMPING]
    block, word, road = fresh.ctypes.data, words.ctypes.data, road_table.ctypes.data
    call(np.uint64(integers[ROAD_PREPARE]), block, word, road)
    call(np.uint64(integers[ROAD_START]), block, word + np.uint64(4 * LANES * 4), road)
    if integers[SPEED_START] != 0:
        call(np.uint64(integers[SPEED_START]), block, word + np.uint64(4 * LANES * 8), speed_table.ctypes.data)
    for _ in range(integers[WARM_UP_STEPS]):
        drive_interval(fresh, scratch, counters, words, road_table, speed_table, integers, numbers, WARM_UP)
        for i in range(LANES):
            counters[STEP + i] += np.uint32(1)


@compiled
def restart_due(
    lanes: Any,
    counters: Any,
    due: Any,
    scratch: Any,
    words: Any,
    road_table: Any,
    speed_table: Any,
    integers: Any,
    numbers: Any,
    forced: Any,
    first: int,
) -> None:
    """Start the lanes of a block that are ``due`` in their next episode, and leave the others as they are."""
    fresh = np.empty_like(lanes)
    fresh_counters = counters.copy()
    for i in range(LANES):
        fresh_counters[EPISODE + i] += np.uint32(1)
        fresh_counters[STEP + i] = np.uint32(0)
    start_block(fresh, scratch, fresh_counters, words, road_table, speed_table, integers, numbers, forced, first)
    for i in range(LANES):
        if due[i]:
            for row in range(0, SIZE, LANES):
                lanes[row + i] = fresh[row + i]
            counters[EPISODE + i] = fresh_counters[EPISODE + i]
            counters[STEP + i] = np.uint32(0)
            counters[PENDING + i] = np.uint32(0)


@compiled
def observe_block(lanes: Any, scratch: Any, signals: Any, saturation: Any, observations: Any, first: int, count: int) -> None:
    """Write the chosen signals of the first ``count`` lanes to the rows from ``first`` of ``observations``."""
    one, two = like(lanes, 1.0), like(lanes, 2.0)
    high = like(lanes, saturation)
    low = -high
    for i in range(LANES):
        y, x = lanes[DISPLACEMENT + i], lanes[VELOCITY + i]
        z, u = lanes[LEVEL + i], lanes[SLOPE + i]
        travel, relative = y - z, x - lanes[RATE + i] * u
        scratch[SIGNAL + i] = min(max(y, low), high)
        scratch[SIGNAL + LANES + i] = min(max(x, low), high)
        scratch[SIGNAL + 2 * LANES + i] = min(max(z, low), high)
        scratch[SIGNAL + 3 * LANES + i] = min(max(u, low), high)
        scratch[SIGNAL + 4 * LANES + i] = min(max(travel, low), high)
        scratch[SIGNAL + 5 * LANES + i] = min(max(relative, low), high)
        scratch[SIGNAL + 6 * LANES + i] = min(max(-two * scratch[DAMPING + i] * relative - travel, low), high)
        scratch[SIGNAL + 7 * LANES + i] = lanes[SPEED + i] / (one + lanes[SPEED + i])
        scratch[SIGNAL + 8 * LANES + i] = two * lanes[BANDWIDTH + i] / (one + two * lanes[BANDWIDTH + i])
    width = signals.size
    flat = observations.reshape(-1)[first * width : (first + count) * width]
    for j in range(width):
        row = SIGNAL + signals[j] * LANES
        for i in range(count):
            flat[i * width + j] = scratch[row + i]


@compiled
def step_blocks(
    begin: int,
    end: int,
    state: Any,
    counters: Any,
    road_table: Any,
    speed_table: Any,
    integers: Any,
    numbers: Any,
    signals: Any,
    actions: Any,
    observations: Any,
    results: Any,
    truncated: Any,
    final_observations: Any,
) -> None:
    """Advance the blocks ``begin`` to ``end`` by one control interval; see the module's docstring."""
    substep_words = integers[SUBSTEPS] * (integers[ROAD_WORDS] + integers[SPEED_WORDS])
    words = np.empty(LANES * (max(substep_words, 12) + 3), np.uint32)
    scratch = np.zeros(SCRATCH, state.dtype)
    due = np.zeros(LANES, np.bool_)
    nothing_forced = np.empty((2, 0))
    low, high = like(state, numbers[DAMPING_LOW]), like(state, numbers[DAMPING_HIGH])
    divergent = like(state, np.inf)
    zero = like(state, 0.0)
    limit = integers[MAX_EPISODE_STEPS]
    total = actions.size
    for b in range(begin, end):
        lanes = state[b * SIZE : (b + 1) * SIZE]
        counts = counters[b * COUNTERS : (b + 1) * COUNTERS]
        first = b * LANES
        count = min(LANES, total - first)
        for i in range(LANES):
            scratch[DAMPING + i] = min(max(like(state, actions[first + i]), low), high) if i < count else low
        drive_interval(lanes, scratch, counts, words, road_table, speed_table, integers, numbers, INTERVAL)

        any_due = False
        for i in range(count):
            reward = zero
            for k in range(5):
                # a weight of zero takes no part: its mean square may be meaningless on this road
                if numbers[WEIGHT + k] != 0.0:
                    reward -= like(state, numbers[WEIGHT + k]) * scratch[SQUARE + k * LANES + i]
                results[RESULT_SQUARE + k, first + i] = scratch[SQUARE + k * LANES + i]
            if integers[HAS_SLOPE] == 0:
                results[RESULT_SQUARE + 2, first + i] = divergent
                results[RESULT_SQUARE + 4, first + i] = divergent
            results[REWARD, first + i] = reward
            results[RESULT_DAMPING, first + i] = scratch[DAMPING + i]
            step = counts[STEP + i] + np.uint32(1)
            counts[STEP + i] = step
            over = limit > 0 and step >= limit
            truncated[first + i] = over
            due[i] = False
            if integers[AUTORESET] == SAME_STEP:
                due[i] = over
            elif integers[AUTORESET] == NEXT_STEP:
                if counts[PENDING + i] != 0:
                    # this step is the reset: the plant moved, but what it did is thrown away
                    due[i] = True
                    truncated[first + i] = False
                    results[REWARD, first + i] = zero
                    for k in range(5):
                        results[RESULT_SQUARE + k, first + i] = zero
                elif over:
                    counts[PENDING + i] = np.uint32(1)
            any_due = any_due or due[i]
        if any_due:
            if integers[AUTORESET] == SAME_STEP:
                observe_block(lanes, scratch, signals, numbers[SATURATION], final_observations, first, count)
            # the operating point of the finished step is what its results report
            for i in range(count):
                results[RESULT_SPEED, first + i] = lanes[SPEED + i]
                results[RESULT_BANDWIDTH, first + i] = lanes[BANDWIDTH + i]
            restart_due(
                lanes,
                counts,
                due,
                scratch,
                words,
                road_table,
                speed_table,
                integers,
                numbers,
                nothing_forced,
                first,
            )
            for i in range(count):
                # a new episode has no action yet; its first observation is that of the softest damper, as after `reset`
                scratch[DAMPING + i] = low if due[i] else results[RESULT_DAMPING, first + i]
        else:
            for i in range(count):
                results[RESULT_SPEED, first + i] = lanes[SPEED + i]
                results[RESULT_BANDWIDTH, first + i] = lanes[BANDWIDTH + i]
        observe_block(lanes, scratch, signals, numbers[SATURATION], observations, first, count)


@compiled
def reset_blocks(
    begin: int,
    end: int,
    state: Any,
    counters: Any,
    road_table: Any,
    speed_table: Any,
    integers: Any,
    numbers: Any,
    signals: Any,
    forced: Any,
    mask: Any,
    observations: Any,
    results: Any,
) -> None:
    """Start the masked environments of the blocks ``begin`` to ``end`` in their next episode, and observe all."""
    substep_words = integers[SUBSTEPS] * (integers[ROAD_WORDS] + integers[SPEED_WORDS])
    words = np.empty(LANES * (max(substep_words, 12) + 3), np.uint32)
    scratch = np.zeros(SCRATCH, state.dtype)
    due = np.zeros(LANES, np.bool_)
    for b in range(begin, end):
        lanes = state[b * SIZE : (b + 1) * SIZE]
        counts = counters[b * COUNTERS : (b + 1) * COUNTERS]
        first = b * LANES
        count = min(LANES, mask.size - first)
        for i in range(LANES):
            # lanes beyond the last environment follow the first one, so that they hold sound numbers
            due[i] = mask[first + i] if i < count else mask[first]
        restart_due(
            lanes, counts, due, scratch, words, road_table, speed_table, integers, numbers, forced, first
        )
        for i in range(LANES):
            scratch[DAMPING + i] = numbers[DAMPING_LOW]
        observe_block(lanes, scratch, signals, numbers[SATURATION], observations, first, count)
        for i in range(count):
            results[RESULT_DAMPING, first + i] = scratch[DAMPING + i]
            results[RESULT_SPEED, first + i] = lanes[SPEED + i]
            results[RESULT_BANDWIDTH, first + i] = lanes[BANDWIDTH + i]
