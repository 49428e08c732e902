"""How a valve that is not ideal moves the damping in force through a control interval, and what the car makes of that.

Over a substep the car has the mean D of it. Squares count at both ends of a substep with that D, with the shares of
`roadgym.valve.shares_of_ends`; where D spreads by the variance s^2 within a substep, squares of a signal that contains g times
the damper's force 2 D rv have 4 g^2 s^2 rv^2 more. The mean squares are of second order in the substep.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .compiled import DAMPING, LANES, SHARE, compiled, like, pointer, row_of
from .signals import COMMAND, MEAN, add_row, clip, own_factor, square_row, valve_work, write_own, write_smooth

# rows of the valve in a block: D in force, its target, and the commands that wait, the newest first
IN_FORCE, TARGET, WAITING = 0 * LANES, 1 * LANES, 2 * LANES
LATE, PART, FASTEST, RISE, FALL = (k * LANES for k in range(5))  # rows of the numbers of a valve where each lane has its own
# rows in ``work`` after those that `roadgym.signals` names: D's variance in a substep, what that adds to squares, the relative
# velocity, and the mean squares of the interval so far
SPREAD, GAIN, RELATIVE, TOTALS = (k * LANES for k in range(2, 6))


@compiled
def lagged(value: Any, target: Any, slope: Any, time: Any, constant: Any) -> tuple[Any, Any, Any]:
    """What follows ``target + slope t`` with a lag: at the end, and its integral and that of its square over the time."""
    if constant == 0:
        return (
            target + slope * time,
            (target + slope * time / 2) * time,
            (target * target + target * slope * time + slope * slope * time * time / 3) * time,
        )
    lost = -np.expm1(-time / constant)  # 1 - exp
    line, decays = target - slope * constant, target - value - slope * constant  # value(t) = line + slope t - decays exp
    weight, moment = constant * lost, constant * (constant * lost - time * (1 - lost))
    return (
        line + slope * time - decays * (1 - lost),
        line * time + slope * time * time / 2 - decays * weight,
        (line * line + line * slope * time + slope * slope * time * time / 3) * time
        - 2 * decays * (line * weight + slope * moment)
        + decays * decays * weight * (2 - lost) / 2,
    )


@compiled
def followed(value: Any, target: Any, slope: Any, time: Any, rise: Any, fall: Any) -> Any:
    """`lagged` with one time constant above the value and another one below; a target that comes back meets it once."""
    gap = target - value
    constant = rise if gap > 0 else fall
    if constant == 0:
        gap = 0.0
        value = target
    if gap == 0:
        return lagged(value, target, slope, time, rise if slope > 0 else fall)
    if gap * slope < 0:
        meets = constant * np.log1p(-gap / (slope * constant))
        if meets < time:
            _, area, square = lagged(value, target, slope, meets, constant)
            place = target + slope * meets
            value, rest, more = lagged(place, place, slope, time - meets, rise if slope > 0 else fall)
            return value, area + rest, square + more
    return lagged(value, target, slope, time, constant)


@compiled
def driven(value: Any, target: Any, level: Any, time: Any, rate: Any, rise: Any, fall: Any) -> tuple[Any, Any, Any, Any]:
    """D and its target after a time at a constant level, and the integrals of D and of its square."""
    area, square = 0.0, 0.0
    if rate < np.inf:
        far = level - target
        ramp = min(time, abs(far) / rate)
        slope = np.copysign(rate, far)
        if ramp > 0:
            value, area, square = followed(value, target, slope, ramp, rise, fall)
            target = level if ramp < time else target + slope * ramp
            time -= ramp
    else:
        target = level
    if time > 0:
        value, rest, more = followed(value, target, 0.0, time, rise, fall)
        area, square = area + rest, square + more
    return value, target, area, square


@compiled
def start_valve(plant: Any, lanes: Any, i: int) -> None:
    """At rest at the softest damping."""
    for row in range(plant.valve_row, plant.valve_row + plant.valve_rows * LANES, LANES):
        lanes[row + i] = plant.damping_low


@compiled
def take_commands(plant: Any, lanes: Any, work: Any) -> None:
    """Take the damping of each lane as the command of the interval, and let those that wait move on.

    Where the valve moves nothing within an interval, D is what has arrived.
    """
    rows, own = row_of(lanes, plant.valve_row), row_of(work, valve_work(plant))
    for k in range(plant.valve_rows - 3, 0, -1):
        for i in range(LANES):
            rows[WAITING + k * LANES + i] = rows[WAITING + (k - 1) * LANES + i]
    low = np.float64(plant.damping_low)
    step = (plant.damping_high - low) / max(plant.valve_levels - 1, 1)
    for i in range(LANES):
        command = work[DAMPING + i]
        own[COMMAND + i] = command
        own[MEAN + i] = 0.0
        if plant.valve_levels > 0:
            command = like(lanes, low + step * np.rint((np.float64(command) - low) / step))
        rows[WAITING + i] = command
    if not plant.valve_moves:
        for i in range(LANES):
            command = rows[WAITING + plant.valve_late * LANES + i]
            rows[IN_FORCE + i] = command
            own[MEAN + i] = command
            work[DAMPING + i] = command


@compiled
def open_substep(plant: Any, lanes: Any, work: Any, k: int) -> None:
    """Move the valve through substep ``k``: the damping of each lane is its mean over that."""
    rows, own = row_of(lanes, plant.valve_row), row_of(work, valve_work(plant))
    newer, time = WAITING + plant.valve_late * LANES, plant.substep
    part, rate, rise, fall = plant.valve_part, plant.valve_rate, plant.valve_rise, plant.valve_fall
    numbers = row_of(lanes, plant.own_valve)
    low, high = like(lanes, plant.damping_low), like(lanes, plant.damping_high)
    work[SHARE] = pointer(plant.valve_shares, 0.0)[2 * k]
    for i in range(LANES):
        value, target = np.float64(rows[IN_FORCE + i]), np.float64(rows[TARGET + i])
        area, square = 0.0, 0.0
        if plant.own_valve:
            newer = WAITING + np.int64(numbers[LATE + i]) * LANES
            part, rate = np.float64(numbers[PART + i]), np.float64(numbers[FASTEST + i])
            rise, fall = np.float64(numbers[RISE + i]), np.float64(numbers[FALL + i])
        until = min(max(part * plant.substeps - k, 0.0), 1.0) * time  # at which the newer command arrives
        if until > 0:
            level = np.float64(rows[newer + LANES + i])
            value, target, area, square = driven(value, target, level, until, rate, rise, fall)
        if until < time:
            level = np.float64(rows[newer + i])
            value, target, rest, more = driven(value, target, level, time - until, rate, rise, fall)
            area, square = area + rest, square + more
        mean = area / time
        rows[IN_FORCE + i], rows[TARGET + i] = clip(like(lanes, value), low, high), like(lanes, target)
        work[DAMPING + i] = clip(like(lanes, mean), low, high)
        own[MEAN + i] += work[DAMPING + i] / like(lanes, plant.substeps)
        own[SPREAD + i] = max(square / time - mean * mean, 0.0)
        own[GAIN + i] = 0.0
    add_gain(plant, lanes, work)


@compiled
def add_gain(plant: Any, lanes: Any, work: Any) -> None:
    """Add what the spread of D adds to the square of the damper's force now, 4 s^2 rv^2, with the share of this instant."""
    own = row_of(work, valve_work(plant))
    relative = row_of(work, valve_work(plant) + RELATIVE)
    if plant.own_signals:
        write_own(plant, lanes, plant.relative, relative)
    else:
        write_smooth(plant, lanes, plant.relative, relative)
    share = like(lanes, 4.0) * work[SHARE]
    for i in range(LANES):
        own[GAIN + i] += share * own[SPREAD + i] * own[RELATIVE + i] * own[RELATIVE + i]


@compiled
def close_substep(plant: Any, lanes: Any, work: Any, k: int) -> None:
    """Add the squares of substep ``k`` up; after the last one they are those of the interval. D is what is in force now."""
    add_gain(plant, lanes, work)
    factors = pointer(plant.factors, 0.0)
    for signal in range(plant.signals):
        total = row_of(work, valve_work(plant) + TOTALS + signal * LANES)
        squares = row_of(work, square_row(plant, signal))
        add_row(total, squares, like(lanes, 1.0), k == 0)
        if plant.own_signals:
            own, gain = own_factor(plant, lanes, signal, plant.states + 2), row_of(work, valve_work(plant) + GAIN)
            for i in range(LANES):
                total[i] += own[i] * own[i] * gain[i]
        force = like(lanes, factors[signal * (plant.states + 3) + plant.states + 2])
        if force != 0 and not plant.own_signals:
            add_row(total, row_of(work, valve_work(plant) + GAIN), force * force, False)
        if k == plant.substeps - 1:
            add_row(squares, total, like(lanes, 1.0), True)
    for i in range(LANES):
        work[DAMPING + i] = lanes[plant.valve_row + IN_FORCE + i]
