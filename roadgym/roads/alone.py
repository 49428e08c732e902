"""Roads without a car: heights over the distance, for pictures, statistics and other simulators."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..parameters import PlantError, check_ratio, positive, whole

if TYPE_CHECKING:
    from .base import Road


def sample_road(
    road: str | Mapping[str, Any] | Road, *, spacing: float, points: int, number: int = 1, seed: int = 0
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Independent stationary profiles of a road, drawn by the very functions that cars drive on, in double precision.

    On roads that are linear filters the heights have their exact joint law at any spacing; the bounded road keeps its
    stationary law and its autocovariance.

    Args:
        road: a road, or its name or mapping.
        spacing: distance between two points, m.
        points: of a profile.
        number: of profiles.
        seed: fixes them; profile i of seed s is profile 0 of seed s + i.

    Returns:
        Distances, m, shape (points,), and heights, m, shape (number, points).

    Raises:
        ParameterError: a value out of range, or a road that cannot be driven.
        PlantError: a height that is not finite.
    """
    # a road needs none of these, they need roads
    from .. import kernel
    from ..addresses import lane_address, padded_table
    from ..compiled import COEFFICIENT, LANES
    from ..noise import fill_words, keys_from_seeds
    from ..record import (
        COUNTERS,
        END,
        LEVELS,
        ORDER,
        PLANT,
        PLANT_ADDRESS,
        POINTS,
        SLOPES,
        SPARE_ADDRESS,
        UNSOUND,
        WORDS_ADDRESS,
    )
    from ..task import check_component
    from . import make_road

    made = make_road(road)
    check_component(made, "road")
    made.check_driven()
    angle, bandwidth = positive("spacing", spacing) * made.wavenumber, getattr(made, "bandwidth", 0.0)
    check_ratio("spacing", spacing, "the road's angle in it, spacing * wavenumber,", angle, "sampled angle")
    if bandwidth:
        check_ratio("spacing", spacing, "bandwidth times the road's angle in it", bandwidth * angle, made.loss_range)
    whole("points", points), whole("number", number, of="num_envs"), whole("seed", seed, low=0, of="seed")
    check_ratio("points", points, "the number of points of all profiles", points * number, "array size")

    dtype, blocks = np.dtype(float), -(-number // LANES)
    size = COEFFICIENT + made.rows * LANES
    table = padded_table(f"table of the {made.kind} road", made.table(), dtype)
    plant = np.zeros(1, PLANT)
    for role in ("prepare", "start", "advance"):
        plant[f"road_{role}"] = lane_address(made, getattr(made, role), dtype)
    plant["road_table"], plant["fill_words"] = table.ctypes.data, fill_words.address(np.uint32)
    steps = max(1, math.ceil(bandwidth * angle / made.largest_loss))  # from one point to the next
    plant["road_words"], plant["block_size"], plant["substep"] = made.words_per_substep, size, angle / steps
    plant["substeps"] = steps
    plant["speed_low"] = plant["speed_high"] = 1.0
    plant["bandwidth_low"] = plant["bandwidth_high"] = bandwidth
    counters = np.zeros((blocks, COUNTERS // LANES, LANES), np.uint32)
    seeds = np.uint64(seed) + np.arange(blocks * LANES, dtype=np.uint64)
    counters[:, :2] = keys_from_seeds(seeds).reshape(2, blocks, LANES).swapaxes(0, 1)
    levels, slopes = np.empty((points, number)), np.empty((points, number))
    plant["counters"], plant["environments"] = counters.ctypes.data, number
    state, order = np.zeros(blocks * size), np.zeros(ORDER, np.int64)
    words, spare = np.zeros(kernel.words_met(plant.view(np.recarray)[0]), np.uint32), np.zeros(kernel.SPARE, np.uint32)
    order[END], order[POINTS], order[PLANT_ADDRESS] = blocks, points, plant.ctypes.data
    order[WORDS_ADDRESS], order[SPARE_ADDRESS] = words.ctypes.data, spare.ctypes.data
    order[LEVELS], order[SLOPES] = levels.ctypes.data, slopes.ctypes.data
    kernel.drive_roads.entry(dtype)(order.ctypes.data, state.ctypes.data)
    unsound = int(order[UNSOUND])
    if unsound >= 0:
        raise PlantError(f"profile {unsound} of {number} has left the numbers that {dtype} can hold: {made}")
    return spacing * np.arange(points, dtype=float), math.sqrt(made.variance) * levels.T
