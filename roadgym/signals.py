"""What the kernel makes of the state of a block: signals, mean squares, observations, and the report of an interval.

``work``, the numbers of an interval of one block, has the rows of `roadgym.compiled`, those of the car, then the squares of the
signals that the car does not square itself, rows for the signal in hand and for the relative velocity, and those of each filter
of a signal (`roadgym.filters`): what D makes of its source, 2 n + 4 rows for the n states of the car, then those named below.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .compiled import (
    BANDWIDTH,
    DAMPING,
    INVERSE_SUBSTEP,
    LANES,
    LEVEL,
    LEVEL_EXCESS,
    LINE,
    RATE,
    SHARE,
    SLOPE,
    SPEED,
    WORK,
    compiled,
    counted,
    like,
    pointer,
    row_of,
    stream,
)
from .record import (
    RESULT_BANDWIDTH,
    RESULT_DAMPING,
    RESULT_SPEED,
    REWARD,
    SQUARES,
    STREAMED,
)

# rows of a filter: g and G h/12 at the beginning of a substep, and at its end; the input at both, with what it rises above its
# line; the impulse k m; the level at the beginning
NOW, NEXT, INPUTS, IMPULSE, BEFORE = 0 * LANES, 2 * LANES, 4 * LANES, 6 * LANES, 7 * LANES
FILTER_ROWS = 8
COMMAND, MEAN, VALVE_ROWS = (
    0 * LANES,
    1 * LANES,
    5,
)  # of a valve: the command, D's mean over the interval; how many beside squares
SECTION = 10  # numbers of a section in `roadgym.filters.filter_table`


@compiled
def square_row(plant: Any, k: int) -> int:
    """Where ``work`` has the mean square of signal ``k``."""
    return WORK + k * LANES if k < plant.squared else plant.work + (k - plant.squared) * LANES


@counted
def signal_row(plant: Any) -> int:
    """Where ``work`` has the signal in hand."""
    return int(plant.work + (plant.signals - plant.squared) * LANES)


@compiled
def state_row(plant: Any, k: int) -> int:
    """Where a block has state ``k`` of the car's motion; those of filters come after all rows of the car."""
    return int(plant.car + k * LANES if k < plant.own_states else plant.filter_states + (k - plant.own_states) * LANES)


@counted
def filter_row(plant: Any, k: int) -> int:
    """Where ``work`` has the rows of filter ``k``."""
    return int(signal_row(plant) + (2 + k * (2 * plant.own_states + 4 + FILTER_ROWS)) * LANES)


@counted
def valve_work(plant: Any) -> int:
    """Where ``work`` has the rows of the valve, after all others."""
    return int(filter_row(plant, plant.filters))


@counted
def seen_row(plant: Any) -> int:
    """Where ``work`` has what is observed, row by row."""
    return int(valve_work(plant) + (VALVE_ROWS + plant.signals if plant.valve else 0) * LANES)


@counted
def work_end(plant: Any) -> int:
    """Where all rows of ``work`` end."""
    return int(seen_row(plant) + plant.observed_signals * LANES)


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
def own_factor(plant: Any, lanes: Any, k: int, term: int) -> Any:
    """The row of what each lane has as the factor of a term in signal ``k``; see `roadgym.cars.varied`."""
    return row_of(lanes, plant.own_signals + (k * (plant.states + 3) + term) * LANES)


@compiled
def write_own(plant: Any, lanes: Any, k: int, row: Any) -> None:
    """Write signal ``k``, but for the damper's force, to a row, where each lane has factors of its own."""
    factor = own_factor(plant, lanes, k, plant.states + 1)
    for i in range(LANES):
        row[i] = factor[i] * (lanes[RATE + i] * lanes[SLOPE + i])
    for j in range(plant.states + 1):
        factor = own_factor(plant, lanes, k, j)
        source = row_of(lanes, state_row(plant, j) if j < plant.states else LEVEL)
        for i in range(LANES):
            row[i] += factor[i] * source[i]


@compiled
def write_smooth(plant: Any, lanes: Any, k: int, row: Any) -> None:
    """Write signal ``k``, but for the damper's force, to a row."""
    factors, first = pointer(plant.factors, 0.0), k * (plant.states + 3)
    fresh = True
    for j in range(plant.states + 1):
        factor = like(lanes, factors[first + j])
        if factor != 0:
            add_row(row, row_of(lanes, state_row(plant, j) if j < plant.states else LEVEL), factor, fresh)
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
def write_own_signal(plant: Any, lanes: Any, work: Any, k: int) -> Any:
    """`write_signal` where each lane has factors of its own."""
    row, relative = row_of(work, signal_row(plant)), row_of(work, signal_row(plant) + LANES)
    write_own(plant, lanes, k, row)
    write_own(plant, lanes, plant.relative, relative)
    factor = own_factor(plant, lanes, k, plant.states + 2)
    for i in range(LANES):
        row[i] += like(lanes, 2.0) * factor[i] * work[DAMPING + i] * relative[i]
    return row


@compiled
def write_observed(plant: Any, lanes: Any, work: Any, k: int) -> Any:
    """Write signal ``k`` of any car to the row that is returned."""
    return write_own_signal(plant, lanes, work, k) if plant.own_signals else write_signal(plant, lanes, work, k)


@compiled
def add_own_squares(plant: Any, lanes: Any, work: Any, fresh: bool) -> None:
    """`add_squares` where each lane has factors of its own."""
    for k in range(plant.signals):
        row = write_own_signal(plant, lanes, work, k)
        for i in range(LANES):
            row[i] *= row[i]
        add_row(row_of(work, square_row(plant, k)), row, work[SHARE], fresh)


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
def write_source(plant: Any, lanes: Any, factors: Any, target: Any) -> None:
    """Write g and G h/12 of a filter's source to two rows, from what D makes of them."""
    for i in range(LANES):
        target[i] = target[LANES + i] = like(lanes, 0.0)
    rates = (plant.own_states + 1) * LANES
    for j in range(plant.own_states + 1):
        state, row = row_of(lanes, plant.car + j * LANES if j < plant.own_states else LEVEL), j * LANES
        for i in range(LANES):
            target[i] += factors[row + i] * state[i]
            target[LANES + i] += factors[row + rates + i] * state[i]


@compiled
def prepare_filters(plant: Any, lanes: Any, work: Any) -> None:
    """What the damping of each lane makes of the sources of the filters, and these now."""
    table, width, place = pointer(plant.filter_table, 0.0), 2 * plant.own_states + 4, 0
    for k in range(plant.filters):
        factors = row_of(work, filter_row(plant, k))
        for j in range(width if plant.own_sources else 0):
            row = plant.own_sources + (3 * k * width + j) * LANES
            q0, q1, q2 = row_of(lanes, row), row_of(lanes, row + width * LANES), row_of(lanes, row + 2 * width * LANES)
            for i in range(LANES):
                factors[j * LANES + i] = q0[i] + work[DAMPING + i] * (q1[i] + work[DAMPING + i] * q2[i])
        for j in range(0 if plant.own_sources else width):
            p = place + 1 + j
            p0, p1, p2 = like(lanes, table[p]), like(lanes, table[p + width]), like(lanes, table[p + 2 * width])
            for i in range(LANES):
                factors[j * LANES + i] = p0 + work[DAMPING + i] * (p1 + work[DAMPING + i] * p2)
        rows = row_of(work, filter_row(plant, k) + width * LANES)
        write_source(plant, lanes, factors, rows)
        for i in range(LANES):
            rows[BEFORE + i] = lanes[LEVEL + i]
        place += 1 + 3 * width + SECTION * int(table[place])


@compiled
def advance_filters(plant: Any, lanes: Any, work: Any) -> None:
    """One substep of the filters, after the car has moved; see `roadgym.filters`."""
    table, width, place = pointer(plant.filter_table, 0.0), 2 * plant.own_states + 4, 0
    inverse, first = work[INVERSE_SUBSTEP], plant.filter_states
    for k in range(plant.filters):
        factors = filter_row(plant, k)
        after = factors + width * LANES
        rate, lift, rows = row_of(work, after - 2 * LANES), row_of(work, after - LANES), row_of(work, after)
        write_source(plant, lanes, row_of(work, factors), row_of(work, after + NEXT))
        for i in range(LANES):
            excess, z = lanes[LEVEL_EXCESS + i], lanes[LEVEL + i]
            above = rows[NOW + LANES + i] - rows[NEXT + LANES + i] + lift[i] * excess
            above += rate[i] * (z - rows[BEFORE + i]) * inverse
            rows[INPUTS + i] = rows[NOW + i] + above
            rows[INPUTS + LANES + i] = rows[NEXT + i] + above
            rows[IMPULSE + i] = rate[i] * excess
            rows[NOW + i], rows[NOW + LANES + i], rows[BEFORE + i] = rows[NEXT + i], rows[NEXT + LANES + i], z
        sections = int(table[place])
        place += 1 + 3 * width
        for _ in range(sections):
            e00, e01 = like(lanes, table[place]), like(lanes, table[place + 1])
            e10, e11 = like(lanes, table[place + 2]), like(lanes, table[place + 3])
            p0, p1 = like(lanes, table[place + 4]), like(lanes, table[place + 5])
            q0, q1 = like(lanes, table[place + 6]), like(lanes, table[place + 7])
            j0, j1 = like(lanes, table[place + 8]), like(lanes, table[place + 9])
            state = row_of(lanes, first)
            for i in range(LANES):
                x, y = state[i], state[LANES + i]
                a, b, impulse = rows[INPUTS + i], rows[INPUTS + LANES + i], rows[IMPULSE + i]
                state[i] = (e00 * x + e01 * y) + (p0 * a + q0 * b) + j0 * impulse
                state[LANES + i] = (e10 * x + e11 * y) + (p1 * a + q1 * b) + j1 * impulse
            first += 2 * LANES
            place += SECTION


@compiled
def clip(value: Any, low: Any, high: Any) -> Any:
    """``value`` kept within [low, high]; the built-in min and max would not vectorise here."""
    value = value if value > low else low
    return value if value < high else high


@compiled
def tell_row(source: Any, target: Any, count: int, unit: Any) -> None:
    """Write the first ``count`` numbers of a row, times a unit, to others; a whole row at its best."""
    if count == LANES:
        for i in range(LANES):
            target[i] = np.float64(source[i]) * unit
    else:
        for i in range(count):
            target[i] = np.float64(source[i]) * unit


@compiled
def report_row(plant: Any, source: Any, target: Any, count: int, unit: Any) -> None:
    """`tell_row` to the results; where no cache holds these, past the caches."""
    if count == LANES and plant.environments >= STREAMED:
        stream(source, target, unit)
    else:
        tell_row(source, target, count, unit)


@compiled
def result_row(plant: Any, row: int, first: int) -> Any:
    """Where a row of the results has the environment ``first``; rows that are streamed begin with a line."""
    length = plant.environments
    if length >= STREAMED:
        length = (length + LINE // 8 - 1) // (LINE // 8) * (LINE // 8)
    return row_of(pointer(plant.results, 0.0), row * length + first)


@compiled
def report_block(plant: Any, lanes: Any, work: Any, first: int, count: int) -> int:
    """Write reward, mean squares, damping and operating point of the finished interval.

    Returns:
        The first environment of the block in which a number is not finite, or -1.
    """
    weights, units = pointer(plant.weights, 0.0), pointer(plant.square_units, 0.0)
    infinite = pointer(plant.infinite, np.int64(0))
    cost, total = row_of(work, signal_row(plant)), row_of(work, signal_row(plant) + LANES)
    fresh = True
    for k in range(plant.signals):
        square, weight = row_of(work, square_row(plant, k)), like(lanes, -weights[k])
        report_row(plant, square, result_row(plant, SQUARES + k, first), count, units[k])
        add_row(total, square, like(lanes, 1.0), k == 0)
        if weight != 0:
            add_row(cost, square, weight, fresh)
            fresh = False
    report_row(plant, cost, result_row(plant, REWARD, first), count, 1.0)
    rewards = row_of(pointer(plant.rewards, lanes), first)
    for i in range(count):
        rewards[i] = cost[i]
    valve = valve_work(plant)
    report_row(
        plant, row_of(work, valve + MEAN if plant.valve else DAMPING), result_row(plant, RESULT_DAMPING, first), count, 1.0
    )
    if plant.valve:
        report_row(plant, row_of(work, valve + COMMAND), result_row(plant, SQUARES + plant.signals, first), count, 1.0)
    report_row(plant, row_of(lanes, SPEED), result_row(plant, RESULT_SPEED, first), count, plant.speed_unit)
    report_row(plant, row_of(lanes, BANDWIDTH), result_row(plant, RESULT_BANDWIDTH, first), count, 1.0)
    # of numbers that are not finite, or too large together, the sum is not finite either
    unsound, found = np.int32(0), -1
    for i in range(LANES):
        value = total[i] + cost[i]
        unsound |= np.int32(value - value != 0)
    if unsound:
        for i in range(count - 1, -1, -1):
            sound = np.isfinite(cost[i])
            for k in range(plant.signals):
                sound = sound and np.isfinite(work[square_row(plant, k) + i])
            if not sound:
                found = first + i
    for k in range(plant.signals):
        if infinite[k]:
            row = result_row(plant, SQUARES + k, first)
            for i in range(count):
                row[i] = np.inf
    return found
