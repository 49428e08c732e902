"""The one stepping kernel: it serves the single environment (lane 0 of one block) and the batch alike.

Data flow of one control interval, for each block of LANES lanes (see `roadgym.compiled` for the layout):

1. clip the actions to the damping range; the car prepares for that damping;
2. draw all random words of the interval, a pure function of (seed, episode, step);
3. for each substep: the speed noise turns the road's angle, the road advances, the car follows, the squares add up;
4. add up the reward from the mean squares, count the step, observe;
5. lanes whose episode is over start anew, one by one.

The mean square of an interval is that of its integral, by Gregory's rule over the ends of the substeps (`interval_weights`).
The acceleration jumps with the damping: its square at the beginning counts with the new damping. Nothing that is not finite
leaves unseen: the functions that step and reset tell the first environment in which a number is not.

What differs between plants is only which lane functions are called, by address, and how many rows and words they take: the
record `PLANT` holds all that. Nothing depends on how blocks are shared out between threads. Per-lane integers are rows of
``counters`` like the rows of a block.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

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
    WORK,
    call,
    call_car,
    compiled,
    like,
    pointer,
)
from .noise import INTERVAL, START, WARM_UP, philox, uniform

NEXT_STEP, SAME_STEP, DISABLED = 0, 1, 2

# A plant as compiled code knows it, one record. Addresses belong to this process. Times are in units of 1/w1.
PLANT = np.dtype(
    [
        # lane functions and the tables of their components; 0 where there is none
        *((name, np.uint64) for name in ("road_prepare", "road_start", "road_advance", "road_table")),
        *((name, np.uint64) for name in ("speed_start", "speed_advance", "speed_table")),
        *((name, np.uint64) for name in ("car_prepare", "car_advance", "car_table", "fill_words")),
        # addresses of 64-bit numbers: weights of the mean squares in the reward, `interval_weights`, and `Motion.rows`; and of
        # 64-bit integers: what is observed, a row of the block or one of the codes below, and whether a mean square is infinite
        *((name, np.uint64) for name in ("weights", "shares", "factors", "observed", "infinite")),
        ("path", np.uint64),  # address of rows for the angle and the level of each substep of each block, see `Plant.trace`
        # how many of each there are, in a block where it is of rows
        *((name, np.int64) for name in ("substeps", "road_words", "speed_words", "states", "signals", "squared", "relative")),
        *((name, np.int64) for name in ("observations", "block_size", "car", "work", "warm_up_steps", "max_episode_steps")),
        ("autoreset", np.int64),
        *((name, np.float64) for name in ("substep", "damping_low", "damping_high", "speed_low", "speed_high")),
        *((name, np.float64) for name in ("bandwidth_low", "bandwidth_high", "warm_up_damping", "saturation")),
    ]
)
OBSERVED = ("level", "slope", "speed", "bandwidth")  # what is observed beside the signals of the car
OBSERVED_SPEED, OBSERVED_BANDWIDTH, OBSERVED_SIGNAL = -1, -2, -3  # the last and below: signals of the car, one after the other


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

# rows of the results: what a step reports of each environment; from SQUARES on the mean squares
REWARD, RESULT_DAMPING, RESULT_SPEED, RESULT_BANDWIDTH, SQUARES = range(5)

START_WORDS = 12  # random words of the start of an episode: four each for operating point, road and speed noise


@compiled
def draw_words(plant: Any, words: Any, counters: Any, purpose: int, count: int) -> None:
    """Fill ``count`` rows of ``words`` with the words of this episode and step for ``purpose``."""
    request = np.array((purpose, count), np.uint32)
    call(plant.fill_words, counters.ctypes.data, words.ctypes.data, request.ctypes.data)


@compiled
def row_of(block: Any, offset: int) -> Any:
    """A pointer to a row of a block; compiled code goes along it without a look at its sign and at the array's end."""
    return pointer(block.ctypes.data + np.uint64(block.itemsize * offset), block)


# ``work`` has the rows of `roadgym.compiled`, those of the car, then the squares of the signals that the car does not square
# itself, and rows for the signal in hand and for the relative velocity
@compiled
def square_row(plant: Any, k: int) -> int:
    """Where ``work`` has the mean square of signal ``k``."""
    return WORK + k * LANES if k < plant.squared else plant.work + (k - plant.squared) * LANES


@compiled
def signal_row(plant: Any) -> int:
    """Where ``work`` has the signal in hand."""
    return int(plant.work + (plant.signals - plant.squared) * LANES)


@compiled
def new_work(plant: Any, state: Any) -> Any:
    """The numbers of an interval of one block, with its constants in place."""
    work = np.zeros(signal_row(plant) + 2 * LANES, state.dtype)
    work[SUBSTEP] = plant.substep
    work[INVERSE_SUBSTEP] = 1.0 / plant.substep
    return work


@compiled
def add_row(target: Any, source: Any, factor: Any, fresh: bool) -> None:
    """Set a row to ``factor`` times another, or add that to it."""
    if fresh:
        for i in range(LANES):
            target[i] = factor * source[i]
    else:
        for i in range(LANES):
            target[i] += factor * source[i]


@compiled
def write_smooth(plant: Any, lanes: Any, k: int, row: Any) -> None:
    """Write signal ``k``, but for the damper's force, to a row."""
    factors, first = pointer(plant.factors, 0.0), k * (plant.states + 3)
    fresh = True
    for j in range(plant.states + 1):
        factor = like(lanes, factors[first + j])
        if factor != 0:
            add_row(row, row_of(lanes, plant.car + j * LANES if j < plant.states else LEVEL), factor, fresh)
            fresh = False
    factor = like(lanes, factors[first + plant.states + 1])
    if fresh or factor != 0:
        for i in range(LANES):
            rate = factor * (lanes[RATE + i] * lanes[SLOPE + i])
            row[i] = rate if fresh else row[i] + rate


@compiled
def write_signal(plant: Any, lanes: Any, work: Any, k: int) -> Any:
    """Write signal ``k`` of the car to the row that is returned."""
    row, relative = row_of(work, signal_row(plant)), row_of(work, signal_row(plant) + LANES)
    write_smooth(plant, lanes, k, row)
    force = like(lanes, 2.0 * pointer(plant.factors, 0.0)[k * (plant.states + 3) + plant.states + 2])
    if force != 0:
        write_smooth(plant, lanes, plant.relative, relative)
        for i in range(LANES):
            row[i] += force * work[DAMPING + i] * relative[i]
    return row


@compiled
def add_squares(plant: Any, lanes: Any, work: Any, fresh: bool) -> None:
    """Set, or add to, the mean squares of the signals that the car does not square itself."""
    share = work[SHARE]
    for k in range(plant.squared, plant.signals):
        row = write_signal(plant, lanes, work, k)
        for i in range(LANES):
            row[i] *= row[i]
        add_row(row_of(work, square_row(plant, k)), row, share, fresh)


@compiled
def drive_interval(plant: Any, lanes: Any, work: Any, counters: Any, words: Any, purpose: int, path: Any) -> None:
    """Drive one block through one control interval; leaves the mean squares in ``work``.

    ``path`` is the address of rows for the angle and the level of each substep, or 0.
    """
    substeps, more = plant.substeps, plant.signals > plant.squared
    draw_words(plant, words, counters, purpose, substeps * (plant.road_words + plant.speed_words))
    block, word, own = lanes.ctypes.data, words.ctypes.data, work.ctypes.data
    car = block + np.uint64(lanes.itemsize * plant.car)
    shares = pointer(plant.shares, 0.0)
    work[SHARE] = shares[0]
    call_car(plant.car_prepare, block, car, own, plant.car_table)
    if more:
        add_squares(plant, lanes, work, True)
    for k in range(substeps):
        if plant.speed_advance != 0:
            call(plant.speed_advance, block, word, plant.speed_table)
            if plant.road_prepare != 0:
                for i in range(LANES):
                    call(plant.road_prepare, block + np.uint64(lanes.itemsize * i), word, plant.road_table)
            word += np.uint64(4 * LANES * plant.speed_words)
        call(plant.road_advance, block, word, plant.road_table)
        work[SHARE] = shares[k + 1]
        call_car(plant.car_advance, block, car, own, plant.car_table)
        if more:
            add_squares(plant, lanes, work, False)
        if path != 0:
            rows = pointer(path, lanes)
            for i in range(LANES):
                rows[2 * k * LANES + i] = lanes[TURN + i]
                rows[(2 * k + 1) * LANES + i] = lanes[LEVEL + i]
        word += np.uint64(4 * LANES * plant.road_words)


@compiled
def start_lane(plant: Any, lanes: Any, i: int, counters: Any, words: Any, forced: Any, first: int) -> None:
    """Start lane ``i`` of a block: operating point, stationary road, car at rest.

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
        lanes[row + i] = 0.0
    lanes[SPEED + i] = speed
    lanes[BANDWIDTH + i] = bandwidth
    lanes[RATE + i] = speed
    lanes[TURN + i] = speed * plant.substep
    lane, word = lanes.ctypes.data + np.uint64(lanes.itemsize * i), words.ctypes.data
    if plant.road_prepare != 0:
        call(plant.road_prepare, lane, word, plant.road_table)
    call(plant.road_start, lane, word + np.uint64(4 * LANES * 4), plant.road_table)
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
def clip(value: Any, low: Any, high: Any) -> Any:
    """``value`` kept within [low, high]; the built-in min and max would not vectorise here."""
    value = value if value > low else low
    return value if value < high else high


@compiled
def observe_block(plant: Any, lanes: Any, work: Any, observations: Any, first: int, count: int) -> None:
    """Write what is observed of the first ``count`` lanes to the rows from ``first`` of ``observations``."""
    one, two = like(lanes, 1.0), like(lanes, 2.0)
    high = like(lanes, plant.saturation)
    low = -high
    observed, number = pointer(plant.observed, np.int64(0)), plant.observations
    own, target = row_of(work, signal_row(plant)), row_of(observations, first * number)
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
        else:
            write_signal(plant, lanes, work, OBSERVED_SIGNAL - what)
        place = j
        for i in range(count):
            target[place] = clip(row[i], low, high)
            place += number


@compiled
def copy_row(source: Any, offset: int, results: Any, row: int, first: int, count: int) -> Any:
    """Copy a row of a block into a row of the results; tells whether a number in it is not finite."""
    target = results[row, first : first + count]
    values = source[offset : offset + count]
    unsound = np.int32(0)
    for i in range(count):
        value = values[i]
        target[i] = value
        unsound |= np.int32(value - value != 0)
    return unsound


@compiled
def first_unsound(rows: Any, width: int, first: int) -> int:
    """``first`` plus the first of ``width`` columns of ``rows``, flat, LANES apart, with a number that is not finite, or -1."""
    for i in range(width):
        for k in range(i, rows.size, LANES):
            if not np.isfinite(rows[k]):
                return first + i
    return -1


@compiled
def report_block(plant: Any, lanes: Any, work: Any, results: Any, first: int, count: int) -> int:
    """Write reward, mean squares, damping and operating point of the finished interval.

    Returns:
        The first environment of the block in which a number is not finite, or -1.
    """
    weights, infinite, cost = pointer(plant.weights, 0.0), pointer(plant.infinite, np.int64(0)), signal_row(plant)
    fresh, unsound = True, np.int32(0)
    for k in range(plant.signals):
        square, weight = square_row(plant, k), like(lanes, -weights[k])
        unsound |= copy_row(work, square, results, SQUARES + k, first, count)
        if weight != 0:
            add_row(row_of(work, cost), row_of(work, square), weight, fresh)
            fresh = False
    unsound |= copy_row(work, cost, results, REWARD, first, count)
    copy_row(work, DAMPING, results, RESULT_DAMPING, first, count)
    copy_row(lanes, SPEED, results, RESULT_SPEED, first, count)
    copy_row(lanes, BANDWIDTH, results, RESULT_BANDWIDTH, first, count)
    found = -1
    if unsound:
        for i in range(first, first + count):
            sound = np.isfinite(results[REWARD, i])
            for k in range(plant.signals):
                sound = sound and np.isfinite(results[SQUARES + k, i])
            if not sound and found < 0:
                found = i
    for k in range(plant.signals):
        if infinite[k]:
            results[SQUARES + k, first : first + count] = np.inf
    return found


@compiled
def unsound_state(plant: Any, lanes: Any, count: int, first: int) -> int:
    """The first environment of a block whose level or slope is not finite, or -1; a car starts at rest, or warm."""
    unsound = np.int32(0)
    for row in (LEVEL, SLOPE):
        for i in range(count):
            unsound |= np.int32(lanes[row + i] - lanes[row + i] != 0)
    return first_unsound(lanes[LEVEL : SLOPE + LANES], count, first) if unsound else -1


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
                    results[REWARD, first + i] = 0.0
                    for row in range(SQUARES, results.shape[0]):
                        results[row, first + i] = 0.0
        elif mode == SAME_STEP and ended:
            for i in range(count):
                due[i] = over[i]
            observe_block(plant, lanes, work, final_observations, first, count)
        if pending or (mode == SAME_STEP and ended):
            restart_due(plant, lanes, counts, due, work, words, nothing_forced, first)
            for i in range(count):
                # a new episode has no action yet: its first observation is that of the softest damper, as after `reset`
                work[DAMPING + i] = low if due[i] else clip(like(state, asked[i]), low, high)
            if unsound < 0:
                unsound = unsound_state(plant, lanes, count, first)
        if mode == NEXT_STEP and ended:
            for i in range(count):
                counts[PENDING + i] = over[i]
        observe_block(plant, lanes, work, observations, first, count)
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
            work[DAMPING + i] = plant.damping_low
        observe_block(plant, lanes, work, observations, first, count)
        copy_row(work, DAMPING, results, RESULT_DAMPING, first, count)
        copy_row(lanes, SPEED, results, RESULT_SPEED, first, count)
        copy_row(lanes, BANDWIDTH, results, RESULT_BANDWIDTH, first, count)
        if unsound < 0:
            unsound = unsound_state(plant, lanes, count, first)
    return unsound


@compiled
def drive_roads(begin: int, end: int, record: Any, state: Any, counters: Any, levels: Any, slopes: Any) -> int:
    """Drive the roads of the blocks ``begin`` to ``end`` alone, from their start on; levels and slopes at each step's end.

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
            if k > 0:
                draw_words(plant, words, counts, INTERVAL, plant.road_words)
                call(plant.road_advance, lanes.ctypes.data, words.ctypes.data, plant.road_table)
                for i in range(LANES):
                    counts[STEP + i] += np.uint32(1)
            wrong = copy_row(lanes, LEVEL, levels, k, first, count) | copy_row(lanes, SLOPE, slopes, k, first, count)
            if wrong and unsound < 0:
                unsound = unsound_state(plant, lanes, count, first)
    return unsound
