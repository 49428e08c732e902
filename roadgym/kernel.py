"""The one stepping kernel: it serves the single environment (lane 0 of one block) and the batch alike.

Data flow of one control interval, for each block of LANES lanes (see `roadgym.compiled` for the layout):

1. clip the actions to the damping range and compute the car's free decay over one substep;
2. draw all random words of the interval, a pure function of (seed, episode, step);
3. for each substep: the speed noise turns the road's angle, the road advances, the car follows, the squares add up;
4. add up the reward from the mean squares, count the step, observe;
5. lanes whose episode is over start anew, one by one.

The mean square of an interval is that of its integral, by Gregory's rule over the ends of the substeps (`interval_weights`).
The acceleration jumps with the damping: its square at the beginning counts with the new damping. Nothing that is not finite
leaves unseen: the functions that step and reset tell the first environment in which a number is not.

What differs between plants is only which lane functions are called, by address, and how many words they take. Nothing depends
on how blocks are shared out between threads. The integers and numbers that describe a plant are two arrays, indexed by the
names below; per-lane integers are rows of ``counters`` like the rows of a block.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from .car import free_decay
from .compiled import (
    BANDWIDTH,
    DISPLACEMENT,
    LANES,
    LEVEL,
    LEVEL_EXCESS,
    RATE,
    SLOPE,
    SPEED,
    TURN,
    VELOCITY,
    LaneFunction,
    call,
    compiled,
    inlined,
    like,
)
from .noise import INTERVAL, START, WARM_UP, philox, uniform

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
    CAR_GRIP,
    CAR_FOLLOW,
    FILL_WORDS,
    MAX_EPISODE_STEPS,
    AUTORESET,
    WARM_UP_STEPS,
    HAS_SLOPE,
    BLOCK_SIZE,
    INTEGERS,
) = range(17)
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
SHARE = WEIGHT + 5  # first of one a substep and one more: the shares of the instants in the mean squares of an interval


def interval_weights(substeps: int) -> npt.NDArray[np.float64]:
    """Shares of the ends of ``substeps`` equal substeps in a mean over the interval, shape (substeps + 1,); their sum is 1.

    Gregory's rule with second differences, exact for cubics; 1/6, 4/6, 1/6 for two substeps, and the trapezoidal rule for one.
    Source: F. B. Hildebrand, Introduction to Numerical Analysis, 1974, section 5.9.
    """
    weights = np.ones(substeps + 1)
    if substeps > 1:
        weights[:3] += (-5 / 8, 1 / 6, -1 / 24)
        weights[-3:] += (-1 / 24, 1 / 6, -5 / 8)
    else:
        weights -= 0.5
    return weights / substeps


# rows of the counters of a block; the first four are what `noise.fill_words` expects
KEY, EPISODE, STEP, PENDING = 0 * LANES, 2 * LANES, 3 * LANES, 4 * LANES
COUNTERS = 5 * LANES

# rows of the scratch of a block
PREVIOUS_LEVEL, DAMPING = 0 * LANES, 1 * LANES
DECAY_11, DECAY_12, DECAY_22 = 2 * LANES, 3 * LANES, 4 * LANES
SQUARE = 5 * LANES  # mean squares of the interval so far, five rows, in the order of car.MEAN_SQUARES
SIGNAL = 10 * LANES  # nine rows, in the order of SIGNALS
COST, SOUND = SIGNAL, SIGNAL + LANES  # of the finished interval, until the signals are needed
CONSTANT = 19 * LANES  # the substep, its inverse, and the share of this instant in the mean squares
SCRATCH = 20 * LANES
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


@inlined
def squares(y: Any, x: Any, z: Any, slope: Any, resistance: Any) -> tuple[Any, Any, Any, Any, Any]:
    """The squares at an instant, in the order of `car.MEAN_SQUARES`; ``slope`` is that in time."""
    travel, relative = y - z, x - slope
    acceleration = resistance * relative + travel
    return y * y, x * x, acceleration * acceleration, travel * travel, relative * relative


@LaneFunction
def grip_road(lanes: Any, words: Any, scratch: Any) -> None:
    """Prepare the car for an interval: free decay over a substep at the damping of each lane, and the squares now."""
    interval, share, two = scratch[CONSTANT], scratch[CONSTANT + 2], like(lanes, 2.0)
    for i in range(LANES):
        phi_11, phi_12, phi_22 = free_decay(scratch[DAMPING + i], interval, lanes)
        scratch[DECAY_11 + i] = phi_11
        scratch[DECAY_12 + i] = phi_12
        scratch[DECAY_22 + i] = phi_22
        z, slope = lanes[LEVEL + i], lanes[RATE + i] * lanes[SLOPE + i]
        scratch[PREVIOUS_LEVEL + i] = z
        yy, xx, aa, tt, rr = squares(lanes[DISPLACEMENT + i], lanes[VELOCITY + i], z, slope, two * scratch[DAMPING + i])
        scratch[SQUARE + i] = share * yy
        scratch[SQUARE + LANES + i] = share * xx
        scratch[SQUARE + 2 * LANES + i] = share * aa
        scratch[SQUARE + 3 * LANES + i] = share * tt
        scratch[SQUARE + 4 * LANES + i] = share * rr


@LaneFunction
def follow_road(lanes: Any, words: Any, scratch: Any) -> None:
    """One substep of the car (see `roadgym.car`); adds the squares at its end to the means over the interval."""
    rate, share, two = scratch[CONSTANT + 1], scratch[CONSTANT + 2], like(lanes, 2.0)
    for i in range(LANES):
        resistance = two * scratch[DAMPING + i]
        old_z, z, excess = scratch[PREVIOUS_LEVEL + i], lanes[LEVEL + i], lanes[LEVEL_EXCESS + i]
        k = (z - old_z) * rate - resistance * excess
        r = lanes[DISPLACEMENT + i] - old_z - excess
        p = lanes[VELOCITY + i] - k
        y = scratch[DECAY_11 + i] * r + scratch[DECAY_12 + i] * p + z + excess
        x = scratch[DECAY_22 + i] * p - scratch[DECAY_12 + i] * r + k
        lanes[DISPLACEMENT + i] = y
        lanes[VELOCITY + i] = x
        scratch[PREVIOUS_LEVEL + i] = z
        yy, xx, aa, tt, rr = squares(y, x, z, lanes[RATE + i] * lanes[SLOPE + i], resistance)
        scratch[SQUARE + i] += share * yy
        scratch[SQUARE + LANES + i] += share * xx
        scratch[SQUARE + 2 * LANES + i] += share * aa
        scratch[SQUARE + 3 * LANES + i] += share * tt
        scratch[SQUARE + 4 * LANES + i] += share * rr


@compiled
def draw_words(words: Any, counters: Any, integers: Any, purpose: int, count: int) -> None:
    """Fill ``count`` rows of ``words`` with the words of this episode and step for ``purpose``."""
    request = np.array((purpose, count), np.uint32)
    call(np.uint64(integers[FILL_WORDS]), counters.ctypes.data, words.ctypes.data, request.ctypes.data)


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
    draw_words(words, counters, integers, purpose, substeps * words_per_substep)
    block, word, own = lanes.ctypes.data, words.ctypes.data, scratch.ctypes.data
    road, speed = road_table.ctypes.data, speed_table.ctypes.data
    scratch[CONSTANT + 2] = numbers[SHARE]
    call(np.uint64(integers[CAR_GRIP]), block, word, own)
    for k in range(substeps):
        if integers[SPEED_ADVANCE] != 0:
            call(np.uint64(integers[SPEED_ADVANCE]), block, word, speed)
            if integers[ROAD_PREPARE] != 0:
                for i in range(LANES):
                    call(np.uint64(integers[ROAD_PREPARE]), block + np.uint64(lanes.itemsize * i), word, road)
            word += np.uint64(4 * LANES * integers[SPEED_WORDS])
        call(np.uint64(integers[ROAD_ADVANCE]), block, word, road)
        scratch[CONSTANT + 2] = numbers[SHARE + 1 + k]
        call(np.uint64(integers[CAR_FOLLOW]), block, word, own)
        word += np.uint64(4 * LANES * integers[ROAD_WORDS])


@compiled
def make_scratch(state: Any, numbers: Any) -> Any:
    """Scratch for one block, with the constants of the car's functions in place."""
    scratch = np.zeros(SCRATCH, state.dtype)
    scratch[CONSTANT] = numbers[SUBSTEP]
    scratch[CONSTANT + 1] = 1.0 / numbers[SUBSTEP]
    return scratch


@compiled
def start_lane(
    lanes: Any,
    i: int,
    counters: Any,
    words: Any,
    road_table: Any,
    speed_table: Any,
    integers: Any,
    numbers: Any,
    forced: Any,
    first: int,
) -> None:
    """Start lane ``i`` of a block: operating point, stationary road, car at rest.

    ``forced`` has two rows, speed and bandwidth of each environment, or no columns; where it is not NaN it replaces the draw.
    """
    for chunk in range(3):
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
    speed = numbers[SPEED_LOW] + (numbers[SPEED_HIGH] - numbers[SPEED_LOW]) * uniform(words[0])
    bandwidth = numbers[BANDWIDTH_LOW] + (numbers[BANDWIDTH_HIGH] - numbers[BANDWIDTH_LOW]) * uniform(words[LANES])
    if first + i < forced.shape[1]:
        if not np.isnan(forced[0, first + i]):
            speed = forced[0, first + i]
        if not np.isnan(forced[1, first + i]):
            bandwidth = forced[1, first + i]
    for row in range(0, lanes.size, LANES):
        lanes[row + i] = 0.0
    lanes[SPEED + i] = speed
    lanes[BANDWIDTH + i] = bandwidth
    lanes[RATE + i] = speed
    lanes[TURN + i] = speed * numbers[SUBSTEP]
    lane, word, road = lanes.ctypes.data + np.uint64(lanes.itemsize * i), words.ctypes.data, road_table.ctypes.data
    if integers[ROAD_PREPARE] != 0:
        call(np.uint64(integers[ROAD_PREPARE]), lane, word, road)
    call(np.uint64(integers[ROAD_START]), lane, word + np.uint64(4 * LANES * 4), road)
    if integers[SPEED_START] != 0:
        call(np.uint64(integers[SPEED_START]), lane, word + np.uint64(4 * LANES * 8), speed_table.ctypes.data)


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
    """Start the lanes of a block that are ``due`` in their next episode, warm-up included, and leave the others as they are."""
    for i in range(LANES):
        if due[i]:
            counters[EPISODE + i] += np.uint32(1)
            counters[STEP + i] = np.uint32(0)
            counters[PENDING + i] = np.uint32(0)
            start_lane(lanes, i, counters, words, road_table, speed_table, integers, numbers, forced, first)
    if integers[WARM_UP_STEPS] > 0:
        kept, kept_counters = lanes.copy(), counters.copy()
        scratch[DAMPING : DAMPING + LANES] = like(lanes, numbers[WARM_UP_DAMPING])
        for _ in range(integers[WARM_UP_STEPS]):
            drive_interval(lanes, scratch, counters, words, road_table, speed_table, integers, numbers, WARM_UP)
            for i in range(LANES):
                counters[STEP + i] += np.uint32(1)
        counters[:] = kept_counters
        for i in range(LANES):
            if not due[i]:
                for row in range(0, lanes.size, LANES):
                    lanes[row + i] = kept[row + i]


@compiled
def clip(value: Any, low: Any, high: Any) -> Any:
    """``value`` kept within [low, high]; the built-in min and max would not vectorise here."""
    value = value if value > low else low
    return value if value < high else high


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
        scratch[SIGNAL + i] = clip(y, low, high)
        scratch[SIGNAL + LANES + i] = clip(x, low, high)
        scratch[SIGNAL + 2 * LANES + i] = clip(z, low, high)
        scratch[SIGNAL + 3 * LANES + i] = clip(u, low, high)
        scratch[SIGNAL + 4 * LANES + i] = clip(travel, low, high)
        scratch[SIGNAL + 5 * LANES + i] = clip(relative, low, high)
        scratch[SIGNAL + 6 * LANES + i] = clip(-two * scratch[DAMPING + i] * relative - travel, low, high)
        scratch[SIGNAL + 7 * LANES + i] = lanes[SPEED + i] / (one + lanes[SPEED + i])
        scratch[SIGNAL + 8 * LANES + i] = two * lanes[BANDWIDTH + i] / (one + two * lanes[BANDWIDTH + i])
    flat = observations.reshape(-1)[first * signals.size : (first + count) * signals.size]
    width, lanes_here = np.uint64(signals.size), np.uint64(count)
    for j in range(signals.size):
        row, place = np.uint64(SIGNAL + signals[j] * LANES), np.uint64(j)
        for i in range(lanes_here):
            flat[place] = scratch[row + i]
            place += width


@compiled
def copy_row(source: Any, offset: int, results: Any, row: int, first: int, count: int) -> None:
    """Copy a row of a block into a row of the results."""
    target = results[row, first : first + count]
    values = source[offset : offset + count]
    for i in range(count):
        target[i] = values[i]


@compiled
def first_unsound(rows: Any, width: int) -> int:
    """The first of ``width`` columns of ``rows``, LANES apart in a flat array, with a number that is not finite, or -1."""
    unsound = np.int32(0)
    for i in range(rows.size):
        unsound |= np.int32(rows[i] - rows[i] != 0)  # a sum of numbers would be added up one by one
    if unsound != 0:
        for i in range(width):
            for k in range(i, rows.size, LANES):
                if not np.isfinite(rows[k]):
                    return i
    return -1


@compiled
def report_block(lanes: Any, scratch: Any, integers: Any, numbers: Any, results: Any, first: int, count: int) -> Any:
    """Write reward, mean squares, damping and operating point of the finished interval.

    Returns:
        The first environment of the block in which a mean square or the reward is not finite, or -1. The squares hold the whole
        state of the car and the level, so it is finite where they are.
    """
    w0, w1, w2 = like(lanes, numbers[WEIGHT]), like(lanes, numbers[WEIGHT + 1]), like(lanes, numbers[WEIGHT + 2])
    w3, w4 = like(lanes, numbers[WEIGHT + 3]), like(lanes, numbers[WEIGHT + 4])
    for i in range(LANES):
        yy, xx, aa = scratch[SQUARE + i], scratch[SQUARE + LANES + i], scratch[SQUARE + 2 * LANES + i]
        tt, rr = scratch[SQUARE + 3 * LANES + i], scratch[SQUARE + 4 * LANES + i]
        cost = w0 * yy + w1 * xx + w2 * aa + w3 * tt + w4 * rr
        scratch[COST + i] = -cost
        scratch[SOUND + i] = cost + yy + xx + aa + tt + rr  # no term is negative: it is finite if all of them are
    unsound = first_unsound(scratch[SOUND : SOUND + LANES], count)
    copy_row(scratch, COST, results, REWARD, first, count)
    for k in range(5):
        copy_row(scratch, SQUARE + k * LANES, results, RESULT_SQUARE + k, first, count)
    if integers[HAS_SLOPE] == 0:
        results[RESULT_SQUARE + 2, first : first + count] = np.inf
        results[RESULT_SQUARE + 4, first : first + count] = np.inf
    copy_row(scratch, DAMPING, results, RESULT_DAMPING, first, count)
    copy_row(lanes, SPEED, results, RESULT_SPEED, first, count)
    copy_row(lanes, BANDWIDTH, results, RESULT_BANDWIDTH, first, count)
    return unsound if unsound < 0 else first + unsound


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
) -> int:
    """Advance the blocks ``begin`` to ``end`` by one control interval; see the module's docstring.

    Returns:
        The first environment in which a number is not finite, or -1.
    """
    unsound = -1
    substep_words = integers[SUBSTEPS] * (integers[ROAD_WORDS] + integers[SPEED_WORDS])
    words = np.empty(LANES * (max(substep_words, 12) + 3), np.uint32)
    scratch = make_scratch(state, numbers)
    due = np.zeros(LANES, np.bool_)
    nothing_forced = np.empty((2, 0))
    low, high = like(state, numbers[DAMPING_LOW]), like(state, numbers[DAMPING_HIGH])
    limit, mode = integers[MAX_EPISODE_STEPS], integers[AUTORESET]
    scratch[DAMPING : DAMPING + LANES] = low
    size = integers[BLOCK_SIZE]
    for b in range(begin, end):
        lanes = state[b * size : (b + 1) * size]
        counts = counters[b * COUNTERS : (b + 1) * COUNTERS]
        first = b * LANES
        count = min(LANES, actions.size - first)
        for i in range(count):
            scratch[DAMPING + i] = clip(like(state, actions[first + i]), low, high)
        drive_interval(lanes, scratch, counts, words, road_table, speed_table, integers, numbers, INTERVAL)
        found = report_block(lanes, scratch, integers, numbers, results, first, count)
        if unsound < 0:
            unsound = found

        ended, pending = 0, 0
        for i in range(count):
            counts[STEP + i] += np.uint32(1)
            over = limit > 0 and counts[STEP + i] >= limit
            truncated[first + i] = over
            ended += over
            pending += counts[PENDING + i]
        for i in range(count, LANES):  # lanes beyond the last environment need new noise too
            counts[STEP + i] += np.uint32(1)
        if pending:  # these lanes moved, but what they did is thrown away: for them this step is the reset
            for i in range(count):
                due[i] = counts[PENDING + i] != 0
                if due[i]:
                    ended -= truncated[first + i]
                    truncated[first + i] = False
                    for row in range(RESULT_DAMPING):
                        results[row, first + i] = 0.0
        elif mode == SAME_STEP and ended:
            for i in range(count):
                due[i] = truncated[first + i]
            observe_block(lanes, scratch, signals, numbers[SATURATION], final_observations, first, count)
        if pending or (mode == SAME_STEP and ended):
            restart_due(lanes, counts, due, scratch, words, road_table, speed_table, integers, numbers, nothing_forced, first)
            for i in range(count):
                # a new episode has no action yet: its first observation is that of the softest damper, as after `reset`
                scratch[DAMPING + i] = low if due[i] else clip(like(state, actions[first + i]), low, high)
            if unsound < 0:
                found = first_unsound(lanes[LEVEL:RATE], count)
                unsound = found if found < 0 else first + found
        if mode == NEXT_STEP and ended:
            for i in range(count):
                counts[PENDING + i] = truncated[first + i]
        observe_block(lanes, scratch, signals, numbers[SATURATION], observations, first, count)
    return unsound


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
) -> int:
    """Start the masked environments of the blocks ``begin`` to ``end`` in their next episode, and observe all.

    Returns:
        The first environment in which a number is not finite, or -1.
    """
    unsound = -1
    substep_words = integers[SUBSTEPS] * (integers[ROAD_WORDS] + integers[SPEED_WORDS])
    words = np.empty(LANES * (max(substep_words, 12) + 3), np.uint32)
    scratch = make_scratch(state, numbers)
    due = np.zeros(LANES, np.bool_)
    size = integers[BLOCK_SIZE]
    for b in range(begin, end):
        lanes = state[b * size : (b + 1) * size]
        counts = counters[b * COUNTERS : (b + 1) * COUNTERS]
        first = b * LANES
        count = min(LANES, mask.size - first)
        for i in range(LANES):
            # lanes beyond the last environment follow the first one, so that they hold sound numbers
            due[i] = mask[first + i] if i < count else mask[first]
        restart_due(lanes, counts, due, scratch, words, road_table, speed_table, integers, numbers, forced, first)
        for i in range(LANES):
            scratch[DAMPING + i] = numbers[DAMPING_LOW]
        observe_block(lanes, scratch, signals, numbers[SATURATION], observations, first, count)
        copy_row(scratch, DAMPING, results, RESULT_DAMPING, first, count)
        copy_row(lanes, SPEED, results, RESULT_SPEED, first, count)
        copy_row(lanes, BANDWIDTH, results, RESULT_BANDWIDTH, first, count)
        if unsound < 0:
            found = first_unsound(lanes[LEVEL:RATE], count)
            unsound = found if found < 0 else first + found
    return unsound
