"""How compiled code knows a plant, and where it counts and reports.

What differs between plants is only which lane functions are called, by address, and how many rows and words they take: the
record `PLANT` holds all that.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .compiled import LANES

NEXT_STEP, SAME_STEP, DISABLED = 0, 1, 2

# A plant as compiled code knows it, one record. Addresses belong to this process. Times are in units of 1/w1.
PLANT = np.dtype(
    [
        # lane functions and the tables of their components; 0 where there is none
        *((name, np.uint64) for name in ("road_prepare", "road_start", "road_advance", "road_table")),
        *((name, np.uint64) for name in ("speed_start", "speed_advance", "speed_table")),
        *((name, np.uint64) for name in ("car_prepare", "car_advance", "car_table", "fill_words")),
        # addresses of 64-bit numbers: weights of the mean squares in the reward, their units, `interval_weights` and
        # `Motion.rows`, and heights of the car at the start over that of the road; and of 64-bit integers: what is observed, a
        # row of the block or one of the codes below, and whether a mean square is infinite
        *((name, np.uint64) for name in ("weights", "square_units", "shares", "factors", "start", "observed", "infinite")),
        ("filter_table", np.uint64),  # address of 64-bit numbers, `roadgym.filters.filter_table`
        # addresses of 64-bit integers and numbers, `roadgym.sensors.SensorTables`
        *((name, np.uint64) for name in ("sensor_integers", "sensor_numbers")),
        # addresses of the counters of all blocks, and of what is taken and told at this call: actions, single precision; of a
        # reset which environments begin anew, truth values, and the speeds and bandwidths that are forced on them, 64-bit
        # numbers, or 0; observations, single precision; the rows of the results, 64-bit numbers; rewards, in the precision of
        # the state; and whose episode is over, truth values
        *((name, np.uint64) for name in ("counters", "actions", "mask", "forced", "observations", "final_observations")),
        *((name, np.uint64) for name in ("results", "rewards", "truncated")),
        ("arrange", np.uint64),  # lane function that writes the observations of a whole block, `roadgym.sensing.arranged`
        ("path", np.uint64),  # address of rows for the angle and the level of each substep of each block, see `Plant.trace`
        # how many of each there are, in a block where it is of rows
        *((name, np.int64) for name in ("substeps", "road_words", "speed_words", "states", "signals", "squared", "relative")),
        *((name, np.int64) for name in ("observed_signals", "block_size", "car", "work", "warm_up_steps", "max_episode_steps")),
        ("autoreset", np.int64),
        ("environments", np.int64),
        # states of the car itself, filters of its signals, and the row of the block at which the states of these begin
        *((name, np.int64) for name in ("own_states", "filters", "filter_states")),
        ("sensors", np.int64),  # signals that are observed by them
        # is there a valve that is not ideal, `roadgym.valve`, and does it move D within an interval: where its rows of a block
        # begin, how many they are, the whole intervals of its delay, its levels or 0; address of 64-bit numbers,
        # `valve.shares_of_ends`; the rest of its delay in intervals, its largest rate and its time constants
        *((name, np.int64) for name in ("valve", "valve_moves", "valve_row", "valve_rows", "valve_late", "valve_levels")),
        ("valve_shares", np.uint64),
        *((name, np.float64) for name in ("valve_part", "valve_rate", "valve_rise", "valve_fall")),
        # where each lane has numbers of its own (`roadgym.cars.varied`): the rows of a block that a start leaves as they are,
        # and among them those of signals, sources of filters and valve; 0 where there are none
        *((name, np.int64) for name in ("kept", "kept_end", "own_signals", "own_sources", "own_valve")),
        *((name, np.float64) for name in ("substep", "damping_low", "damping_high", "speed_low", "speed_high")),
        *((name, np.float64) for name in ("bandwidth_low", "bandwidth_high", "warm_up_damping", "saturation")),
        ("speed_unit", np.float64),  # in which results are told
    ]
)
OBSERVED = ("level", "slope", "speed", "bandwidth")  # what is observed beside the signals of the car
OBSERVED_SPEED, OBSERVED_BANDWIDTH, OBSERVED_SIGNAL = -1, -2, -3  # the last and below: signals of the car, one after the other
OBSERVED_SENSOR = -1_000_000  # and below: sensors, one after the other


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

# what a call of the kernel is told and tells, 64-bit integers: the first of the blocks to serve, and the end of them; the first
# environment in which a number is not finite, or -1; addresses of the plant and of memory for this call alone: numbers, words,
# and others of 32 bits; and for `roadgym.kernel.drive_roads` the number of points, and where their levels and slopes go
BEGIN, END, UNSOUND, PLANT_ADDRESS, WORK_ADDRESS, WORDS_ADDRESS, SPARE_ADDRESS, POINTS, LEVELS, SLOPES = range(10)
ORDER = 10

# rows of the results: what a step reports of each environment; from SQUARES on the mean squares
REWARD, RESULT_DAMPING, RESULT_SPEED, RESULT_BANDWIDTH, SQUARES = range(5)
STREAMED = 1 << 15  # environments from which on no near cache holds them, and they are written past all
