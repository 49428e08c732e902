"""The plant driven, where theory has no closed form.

`drive_together` measures the stationary mean squares of `roadgym.plant.Plant` at several dampings over the same noise.
`analysis.mean_squares` and `analysis.optimal_damping` call it for low-pass speed noise on a random road.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from roadgym.cars import Car
from roadgym.plant import Plant
from roadgym.resolution import LARGEST_ANGLE, LARGEST_DECAY, fastest_rate
from roadgym.reward import cost_unit, divergent_terms
from roadgym.roads import Road
from roadgym.speed import SpeedNoise
from roadgym.task import make_task

from .checks import FloatArray, check_size
from .phase_noise import slowest_decay

SETTLED = 8.0  # times the slowest time constant before a record: e^-8 of the start is left
COARSE_STEP, COARSE_ERROR, COARSE_LANES = 0.15, 0.02, 512  # of an optimum: grid in log D
FINE_POINTS, FINE_LANES = 5, 2048
INTERVAL_SUBSTEPS = 8  # of a driven plant: enough that calling the kernel costs little


def drive_together(
    road: Road,
    speed_noise: SpeedNoise | None,
    *,
    damping: FloatArray,
    speed: float,
    car: Car,
    relative_error: float,
    lanes: int = 4096,
    seed: int = 0,
    names: Sequence[str] | None = None,
) -> FloatArray:
    """Stationary mean squares of independent cars, at several dampings over the same noise.

    The record goes on until all finite ones among ``names`` are known to the relative standard error. The level of the road,
    and its slope, have known mean squares: what a lane met in excess of them is taken out of its figures by linear regression
    over the lanes (control variates), which makes slow cars nearly exact.

    Args:
        road, speed_noise: the plant.
        damping: D > 0, 1, shape (dampings,).
        speed: v > 0, m/s.
        car: the car.
        relative_error: standard error over the mean, of each mean square at each damping.
        lanes: how many cars at each damping.
        seed: fixes the noise.
        names: mean squares that must be known so well; all by default.

    Returns:
        Mean squares of each lane in the order of the car's, as told, shape (squares, dampings, lanes): means over lanes
        estimate the mean squares, and their spread the standard errors. Infinite where they diverge.
    """
    low, high = float(damping.min()), float(damping.max())
    turn = speed * road.wavenumber
    own = getattr(road, "bandwidth", 0.0)
    fastest = fastest_rate(road, speed_noise, car, speed, own)
    interval = INTERVAL_SUBSTEPS * LARGEST_ANGLE / fastest
    task = make_task(
        road=road,
        speed_noise=speed_noise,
        speed=speed,
        damping_range=(low / 2, high),
        car=car,
        control_interval=interval,
        substeps=max(INTERVAL_SUBSTEPS, math.ceil(high * car.firmness * interval * car.natural_frequency / LARGEST_DECAY)),
    )
    plant = Plant(task, damping.size * lanes)
    plant.start(np.tile(lane_seeds(np.random.SeedSequence(seed), lanes), damping.size))
    actions = np.repeat(damping.astype(np.float32), lanes)

    memory = 1 / (min(map(car.decay, damping.tolist())) * car.natural_frequency)
    # on an ellipse the law is not known: there the road must settle as well, and its variance is no control
    settled_road = road.variance_standard_error == 0
    if not settled_road:
        memory = max(memory, 1 / (float(slowest_decay(np.asarray(task.bandwidth[0]))) * turn))
    work = task.substeps * plant.num_envs
    settling = math.ceil(SETTLED * memory / interval)
    check_size("substeps of all lanes until the start is forgotten", "speed and damping", settling * work, "work")
    for _ in range(settling):
        plant.step(actions)

    every, infinite = car.mean_squares, divergent_terms(car, road, speed_noise)
    chosen = [every.index(name) for name in (every if names is None else names) if name not in infinite]
    known = {"level": 1.0} if road.slope_variance is None else {"level": 1.0, "slope": road.slope_variance}  # mean squares
    totals, controls, steps = np.zeros((len(every), damping.size, lanes)), np.zeros((len(known), lanes)), 0
    while True:
        more = math.ceil(memory / interval)
        check_size(f"substeps of all lanes, where relative_error is {relative_error:g},", "it", (steps + more) * work, "work")
        for _ in range(more):
            totals += plant.step(actions).mean_squares.reshape(totals.shape)
            for control, row in zip(controls, known, strict=True):
                control += plant.row(row)[:lanes].astype(np.float64) ** 2
            steps += 1
        figures = totals / steps
        if settled_road:
            figures = _without_controls(figures, controls / steps - np.array(list(known.values()))[:, None])
        means = figures[chosen].mean(axis=-1)
        errors = figures[chosen].std(axis=-1, ddof=1) / math.sqrt(lanes)
        if np.all(errors <= relative_error * means):
            return np.asarray(task.square_units[:, None, None] * figures)


def _without_controls(figures: FloatArray, controls: FloatArray) -> FloatArray:
    """``figures`` (..., lanes) less their regression on ``controls`` (controls, lanes), whose true means are zero."""
    finite = np.isfinite(figures).all(axis=-1, keepdims=True)
    known = np.where(finite, figures, 0.0)
    centred = controls - controls.mean(axis=1, keepdims=True)
    slopes = known @ np.linalg.pinv(centred)
    return np.where(finite, known - slopes @ controls, figures)


@functools.lru_cache(maxsize=4096)
def driven_mean_squares(
    road: Road, speed_noise: SpeedNoise | None, damping: float, speed: float, car: Car, relative_error: float
) -> tuple[FloatArray, FloatArray]:
    """The mean squares and their standard errors, as told, shape (squares,) each, of a driven plant at one operating point."""
    figures = drive_together(
        road,
        speed_noise,
        damping=np.array([damping]),
        speed=speed,
        car=car,
        relative_error=relative_error,
    )[:, 0]
    return figures.mean(axis=-1), standard_errors(figures)


def standard_errors(figures: FloatArray) -> FloatArray:
    """Standard errors of the means over the last axis; infinite means are exact."""
    known = np.where(np.isfinite(figures), figures, 0.0)
    return np.asarray(known.std(axis=-1, ddof=1) / math.sqrt(figures.shape[-1]))


@functools.lru_cache(maxsize=4096)
def driven_optimum(
    road: Road,
    speed_noise: SpeedNoise | None,
    *,
    speed: float,
    car: Car,
    weights: tuple[float, ...],
    bounds: tuple[float, float],
    relative_error: float,
) -> tuple[float, float, float, float]:
    """The best constant damping of a driven plant and its cost, then their standard errors.

    Common noise makes the cost a smooth curve of the damping, shifted as a whole by chance: a coarse grid finds the
    neighbourhood of its minimum, and a cubic in log D over a finer one the place. To first order in the noise the cubic of a
    lane is off at the minimum by its own slope there, over the common curvature: that gives the standard error.
    """
    low, high = math.log(bounds[0]), math.log(bounds[1])
    names = [name for name, weight in zip(car.mean_squares, weights, strict=True) if weight]

    def costs_at(places: FloatArray, error: float, lanes: int) -> FloatArray:
        """Cost of each lane, shape (places, lanes)."""
        figures = drive_together(
            road,
            speed_noise,
            damping=np.clip(np.exp(places), *bounds),
            speed=speed,
            car=car,
            relative_error=error,
            lanes=lanes,
            names=names,
        )
        total = sum(weight * rows for weight, rows in zip(weights, figures, strict=True) if weight)
        return np.asarray(total / cost_unit(car, road))

    grid = np.linspace(low, high, max(2, math.ceil((high - low) / COARSE_STEP) + 1)) if high > low else np.array([low])
    best = int(np.argmin(costs_at(grid, COARSE_ERROR, COARSE_LANES).mean(axis=1)))
    centre = grid[best]
    while True:
        left, right = max(centre - 2 * COARSE_STEP, low), min(centre + 2 * COARSE_STEP, high)
        places = np.linspace(left, right, FINE_POINTS) if right > left else np.array([low])
        costs = costs_at(places, relative_error, FINE_LANES)
        means = costs.mean(axis=1)
        polynomials = np.polynomial.polynomial.polyfit(places - centre, costs, min(3, len(places) - 1))
        dense = np.linspace(left, right, 2001) - centre
        offset = dense[np.argmin(np.polynomial.polynomial.polyval(dense, polynomials.mean(axis=1)))]
        place = float(centre + offset)
        if (place in (left, right)) and low < place < high:  # chance misled the coarse grid: follow the slope
            centre = place
            continue
        at_bound = place in (low, high)
        row = 0 if place == low else -1
        cost = costs[row] if at_bound else np.polynomial.polynomial.polyval(offset, polynomials)
        error = float(cost.std(ddof=1)) / math.sqrt(cost.size)
        if at_bound:
            return bounds[0] if place == low else bounds[1], float(means[row]), 0.0, error
        slope = np.polynomial.polynomial.polyval(offset, np.polynomial.polynomial.polyder(polynomials))
        curvature = np.polynomial.polynomial.polyval(offset, np.polynomial.polynomial.polyder(polynomials.mean(axis=1), 2))
        spread = float(slope.std(ddof=1)) / math.sqrt(slope.size) / float(curvature)
        damping = math.exp(place)
        return damping, float(cost.mean()), damping * spread, error


def lane_seeds(sequence: np.random.SeedSequence, number: int) -> npt.NDArray[np.uint64]:
    """Seeds of as many lanes, for `roadgym.noise.keys_from_seeds` or `roadgym.plant.Plant.seed`."""
    return sequence.generate_state(number, np.uint64).astype(np.uint64)
