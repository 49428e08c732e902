"""The plant by simulation, where theory has no closed form and where it needs a witness.

*Driven plants.* `drive_together` measures the stationary mean squares of `roadgym.plant.Plant` at several dampings over the
same noise. `analysis.mean_squares` and `analysis.optimal_damping` call it for low-pass speed noise on a random road.

*Euler-Maruyama*, as in the paper: N steps of w1 dt = 10^-3. `simulate` steps one of these systems, in units of time 1/w1, with
nu = wavenumber v/w1, s = sigma/w1^(1/2) and corner g = w_g/w1,

    original   the equations of the plant: phase (18), (25) or (30), road (2), (4) or (7), (8), and the car (19) as
               dY = X dt, dQ = -(2 D X + Y - Z) dt, X = Q + 2 D Z, which needs no derivative of the road;
    ito        the amplitudes (20)-(23) with the covariations of Ito's calculus, n = -s^2/2;
    printed    the same as printed, n = +s^2/2:
                   dA = (n A - nu B + G) dt - s B dW
                   dB = (n B + nu A + H) dt + s A dW
                   dG = ((n - 2 D) G - A - nu H + mu (1 - 2 D n)) dt - s H dW
                   dH = ((n - 2 D) H - B + nu G - 2 D mu nu) dt + s (G - 2 D mu) dW

On the harmonic road the original equations are driven by mu cos phi and by mu sin phi at once. With Y and Y^ for the two
responses, A = Y cos phi + Y^ sin phi and B = Y sin phi - Y^ cos phi are the very processes of (20), (21), pathwise.

Every lane is an independent path, so each is a batch of its own for standard errors. Noise is counter-based: results depend on
the seed, and not on threads. Steps are first order in the weak sense; `simulate(..., bias=True)` measures what that costs by
driving the same noise through steps twice as long. Equation numbers are those of Wedig (2020).
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import Any

import numpy as np
import numpy.typing as npt

from roadgym.car import MEAN_SQUARES, QuarterCar
from roadgym.compiled import LANES, LEVEL, SLOPE, LaneFunction, call, compiled
from roadgym.kernel import RESULT_SQUARE
from roadgym.noise import fill_words, keys_from_seeds, normal_pair
from roadgym.parameters import ParameterError, check_ratio, number, shown, whole, within
from roadgym.plant import Plant
from roadgym.reward import divergent_terms
from roadgym.roads import FirstOrderRoad, GaussianRoad, HarmonicRoad, MultiplicativeRoad, Road, make_road
from roadgym.speed import SpeedNoise, WhiteSpeedNoise, make_speed_noise
from roadgym.task import LARGEST_ANGLE, LARGEST_DECAY, fastest_rate, make_task

from .checks import FloatArray, check_size, one_of, range_array
from .phase_noise import slowest_decay

SETTLED = 8.0  # times the slowest time constant before a record: e^-8 of the start is left
COARSE_STEP, COARSE_ERROR, COARSE_LANES = 0.15, 0.02, 512  # of an optimum: grid in log D
FINE_POINTS, FINE_LANES = 5, 2048
INTERVAL_SUBSTEPS = 8  # of a driven plant: enough that calling the kernel costs little

# driven plants


def drive_together(
    road: Road,
    speed_noise: SpeedNoise | None,
    *,
    damping: FloatArray,
    speed: float,
    natural_frequency: float,
    relative_error: float,
    lanes: int = 4096,
    seed: int = 0,
    names: Sequence[str] = MEAN_SQUARES,
) -> FloatArray:
    """Stationary mean squares of independent cars, at several dampings over the same noise.

    The record goes on until all finite ones among ``names`` are known to the relative standard error. The level of the road,
    and its slope, have known mean squares: what a lane met in excess of them is taken out of its figures by linear regression
    over the lanes (control variates), which makes slow cars nearly exact.

    Args:
        road, speed_noise: the plant.
        damping: D > 0, 1, shape (dampings,).
        speed: v > 0, m/s.
        natural_frequency: w1, rad/s.
        relative_error: standard error over the mean, of each mean square at each damping.
        lanes: how many cars at each damping.
        seed: fixes the noise.
        names: mean squares that must be known so well.

    Returns:
        Mean squares of each lane in the order of `roadgym.car.MEAN_SQUARES`, m^2, shape (5, dampings, lanes): means over lanes
        estimate the mean squares, and their spread the standard errors. Infinite where they diverge.
    """
    low, high = float(damping.min()), float(damping.max())
    turn = speed * road.wavenumber
    own = getattr(road, "bandwidth", 0.0)
    fastest = fastest_rate(road, speed_noise, QuarterCar(natural_frequency=natural_frequency), speed, own)
    interval = INTERVAL_SUBSTEPS * LARGEST_ANGLE / fastest
    task = make_task(
        road=road,
        speed_noise=speed_noise,
        speed=speed,
        damping_range=(low / 2, high),
        natural_frequency=natural_frequency,
        control_interval=interval,
        substeps=max(INTERVAL_SUBSTEPS, math.ceil(high * interval * natural_frequency / LARGEST_DECAY)),
    )
    plant = Plant(task, damping.size * lanes)
    everyone = np.ones(plant.num_envs, np.bool_)
    seeds = _seeds(np.random.SeedSequence(seed), lanes)
    plant.seed(np.tile(seeds, damping.size), everyone)
    plant.reset(plant.forced({}), everyone)
    actions = np.repeat(damping.astype(np.float32), lanes)

    memory = 1 / (float(slowest_decay(np.asarray(low))) * natural_frequency)
    # on an ellipse the law is not known: there the road must settle as well, and its variance is no control
    settled_road = road.variance_standard_error == 0
    if not settled_road:
        memory = max(memory, 1 / (float(slowest_decay(np.asarray(task.bandwidth[0]))) * turn))
    work = task.substeps * plant.num_envs
    settling = math.ceil(SETTLED * memory / interval)
    check_size("substeps of all lanes until the start is forgotten", "speed and damping", settling * work, "work")
    for _ in range(settling):
        plant.step(actions)

    chosen = [MEAN_SQUARES.index(name) for name in names if name not in divergent_terms(road, speed_noise)]
    known = {LEVEL: 1.0} if road.slope_variance is None else {LEVEL: 1.0, SLOPE: road.slope_variance}  # their mean squares
    totals, controls, steps = np.zeros((5, damping.size, lanes)), np.zeros((len(known), lanes)), 0
    while True:
        more = math.ceil(memory / interval)
        check_size(f"substeps of all lanes, where relative_error is {relative_error:g},", "it", (steps + more) * work, "work")
        for _ in range(more):
            totals += plant.step(actions)[1][RESULT_SQUARE : RESULT_SQUARE + 5].reshape(totals.shape)
            for control, row in zip(controls, known, strict=True):
                control += plant.row(row)[:lanes].astype(np.float64) ** 2
            steps += 1
        figures = totals / steps
        if settled_road:
            figures = _without_controls(figures, controls / steps - np.array(list(known.values()))[:, None])
        means = figures[chosen].mean(axis=-1)
        errors = figures[chosen].std(axis=-1, ddof=1) / math.sqrt(lanes)
        if np.all(errors <= relative_error * means):
            return np.asarray(road.variance * figures)


def _without_controls(figures: FloatArray, controls: FloatArray) -> FloatArray:
    """``figures`` (..., lanes) less their regression on ``controls`` (controls, lanes), whose true means are zero."""
    finite = np.isfinite(figures).all(axis=-1, keepdims=True)
    known = np.where(finite, figures, 0.0)
    centred = controls - controls.mean(axis=1, keepdims=True)
    slopes = known @ np.linalg.pinv(centred)
    return np.where(finite, known - slopes @ controls, figures)


@functools.lru_cache(maxsize=4096)
def driven_mean_squares(
    road: Road, speed_noise: SpeedNoise | None, damping: float, speed: float, natural_frequency: float, relative_error: float
) -> tuple[FloatArray, FloatArray]:
    """The five mean squares and their standard errors, m^2, shape (5,) each, of a driven plant at one operating point."""
    figures = drive_together(
        road,
        speed_noise,
        damping=np.array([damping]),
        speed=speed,
        natural_frequency=natural_frequency,
        relative_error=relative_error,
    )[:, 0]
    return figures.mean(axis=-1), _standard_errors(figures)


def _standard_errors(figures: FloatArray) -> FloatArray:
    """Standard errors of the means over the last axis; infinite means are exact."""
    known = np.where(np.isfinite(figures), figures, 0.0)
    return np.asarray(known.std(axis=-1, ddof=1) / math.sqrt(figures.shape[-1]))


@functools.lru_cache(maxsize=4096)
def driven_optimum(
    road: Road,
    speed_noise: SpeedNoise | None,
    *,
    speed: float,
    natural_frequency: float,
    weights: tuple[float, ...],
    bounds: tuple[float, float],
    relative_error: float,
) -> tuple[float, float, float, float]:
    """The best constant damping of a driven plant and its cost over the road's variance, then their standard errors; all 1.

    Common noise makes the cost a smooth curve of the damping, shifted as a whole by chance: a coarse grid finds the
    neighbourhood of its minimum, and a cubic in log D over a finer one the place. To first order in the noise the cubic of a
    lane is off at the minimum by its own slope there, over the common curvature: that gives the standard error.
    """
    low, high = math.log(bounds[0]), math.log(bounds[1])
    names = [name for name, weight in zip(MEAN_SQUARES, weights, strict=True) if weight]

    def costs_at(places: FloatArray, error: float, lanes: int) -> FloatArray:
        """Cost of each lane, shape (places, lanes)."""
        figures = drive_together(
            road,
            speed_noise,
            damping=np.clip(np.exp(places), *bounds),
            speed=speed,
            natural_frequency=natural_frequency,
            relative_error=error,
            lanes=lanes,
            names=names,
        )
        total = sum(weight * rows for weight, rows in zip(weights, figures, strict=True) if weight)
        return np.asarray(total / road.variance)

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


def _seeds(sequence: np.random.SeedSequence, number: int) -> npt.NDArray[np.uint64]:
    return sequence.generate_state(number, np.uint64).astype(np.uint64)


# Euler-Maruyama: rows of a block (see `roadgym.compiled`), in metres and units of time 1/w1
NOISE = 0 * LANES  # two rows of standard normals
OBSERVED = 2 * LANES  # nine rows, see `simulate`
FIRST, SECOND, SQUARES, FIRST_SQUARE, SECOND_SQUARE = (OBSERVED + row * LANES for row in (0, 1, 2, 7, 8))
OBSERVATIONS = 9
STATE = OBSERVED + OBSERVATIONS * LANES  # up to seven rows
EULER_SIZE = STATE + 7 * LANES
CHUNK = 16  # steps for which noise is drawn at once

# the tables of the three kinds of systems
(STEP, DAMPER, RATIO, CORNER, PULL, WHITE, FEED, AMPLITUDE) = range(8)
KICK, LOSS, LEVEL_LIMIT, SLOPE_LIMIT = AMPLITUDE, 8, 9, 10
DIFFUSION, DRIFT, FORCING = PULL, WHITE, FEED


@LaneFunction
def step_amplitudes(lanes: Any, words: Any, table: Any) -> None:
    """One step of (20)-(23); Ito's form and the printed one differ in DRIFT and FORCING alone."""
    h, twice, ratio, noise = table[STEP], table[DAMPER], table[RATIO], table[DIFFUSION]
    drift, forcing, mu = table[DRIFT], table[FORCING], table[AMPLITUDE]
    for i in range(LANES):
        a, b = lanes[STATE + i], lanes[STATE + LANES + i]
        c, d = lanes[STATE + 2 * LANES + i], lanes[STATE + 3 * LANES + i]  # G, H
        kick = noise * lanes[NOISE + i]
        new_a = a + h * (drift * a - ratio * b + c) - kick * b
        new_b = b + h * (drift * b + ratio * a + d) + kick * a
        new_c = c + h * ((drift - twice) * c - a - ratio * d + forcing) - kick * d
        new_d = d + h * ((drift - twice) * d - b + ratio * c - twice * mu * ratio) + kick * (c - twice * mu)
        lanes[STATE + i], lanes[STATE + LANES + i] = new_a, new_b
        lanes[STATE + 2 * LANES + i], lanes[STATE + 3 * LANES + i] = new_c, new_d
        travel, slip = new_a - mu, new_d + ratio * mu
        lanes[FIRST + i], lanes[SECOND + i] = new_a, new_b
        lanes[SQUARES + i] = 0.5 * (new_a * new_a + new_b * new_b)
        lanes[SQUARES + LANES + i] = 0.5 * (new_c * new_c + new_d * new_d)
        force, other = twice * new_c + travel, twice * slip + new_b
        lanes[SQUARES + 2 * LANES + i] = 0.5 * (force * force + other * other)
        lanes[SQUARES + 3 * LANES + i] = 0.5 * (travel * travel + new_b * new_b)
        lanes[SQUARES + 4 * LANES + i] = 0.5 * (new_c * new_c + slip * slip)
        lanes[FIRST_SQUARE + i], lanes[SECOND_SQUARE + i] = new_a * new_a, new_b * new_b


@LaneFunction
def step_waves(lanes: Any, words: Any, table: Any) -> None:
    """One step of the phase and of the car on mu cos phi and on mu sin phi.

    Cosine and sine of the phase's increment are Taylor polynomials, exact to 1e-9 below 0.5 rad.
    """
    h, twice, ratio, mu = table[STEP], table[DAMPER], table[RATIO], table[AMPLITUDE]
    corner, pull, white, feed = table[CORNER], table[PULL], table[WHITE], table[FEED]
    for i in range(LANES):
        cosine, sine, psi = lanes[STATE + i], lanes[STATE + LANES + i], lanes[STATE + 2 * LANES + i]
        y, q = lanes[STATE + 3 * LANES + i], lanes[STATE + 4 * LANES + i]
        other_y, other_q = lanes[STATE + 5 * LANES + i], lanes[STATE + 6 * LANES + i]
        noise = lanes[NOISE + i]
        z, other_z = mu * cosine, mu * sine
        x, other_x = q + twice * z, other_q + twice * other_z
        q -= h * (twice * x + y - z)
        y += h * x
        other_q -= h * (twice * other_x + other_y - other_z)
        other_y += h * other_x
        turn = h * (ratio + pull * psi) + white * noise
        psi += feed * noise - h * corner * psi

        t = turn * turn
        c = 1.0 - t * (0.5 - t * (1.0 / 24.0 - t * (1.0 / 720.0 - t / 40320.0)))
        s = turn * (1.0 - t * (1.0 / 6.0 - t * (1.0 / 120.0 - t * (1.0 / 5040.0 - t / 362880.0))))
        new_cosine, new_sine = cosine * c - sine * s, sine * c + cosine * s
        scale = 1.5 - 0.5 * (new_cosine * new_cosine + new_sine * new_sine)
        cosine, sine = new_cosine * scale, new_sine * scale
        lanes[STATE + i], lanes[STATE + LANES + i], lanes[STATE + 2 * LANES + i] = cosine, sine, psi
        lanes[STATE + 3 * LANES + i], lanes[STATE + 4 * LANES + i] = y, q
        lanes[STATE + 5 * LANES + i], lanes[STATE + 6 * LANES + i] = other_y, other_q

        z, other_z = mu * cosine, mu * sine
        x, other_x = q + twice * z, other_q + twice * other_z
        rate = ratio + pull * psi
        first, second = y * cosine + other_y * sine, y * sine - other_y * cosine
        travel, other_travel = y - z, other_y - other_z
        slip, other_slip = x + rate * other_z, other_x - rate * z
        force, other_force = twice * slip + travel, twice * other_slip + other_travel
        lanes[FIRST + i], lanes[SECOND + i] = first, second
        lanes[SQUARES + i] = 0.5 * (y * y + other_y * other_y)
        lanes[SQUARES + LANES + i] = 0.5 * (x * x + other_x * other_x)
        lanes[SQUARES + 2 * LANES + i] = 0.5 * (force * force + other_force * other_force)
        lanes[SQUARES + 3 * LANES + i] = 0.5 * (travel * travel + other_travel * other_travel)
        lanes[SQUARES + 4 * LANES + i] = 0.5 * (slip * slip + other_slip * other_slip)
        lanes[FIRST_SQUARE + i], lanes[SECOND_SQUARE + i] = first * first, second * second


@LaneFunction
def step_random_road(lanes: Any, words: Any, table: Any) -> None:
    """One step of the speed (25), of the road (4) if LOSS is negative, else (7), (8), and of the car."""
    h, twice, ratio, corner, pull, feed = table[STEP], table[DAMPER], table[RATIO], table[CORNER], table[PULL], table[FEED]
    kick, loss, level_limit, slope_limit = table[KICK], table[LOSS], table[LEVEL_LIMIT], table[SLOPE_LIMIT]
    first_order = loss < 0.0
    for i in range(LANES):
        z, u, psi = lanes[STATE + i], lanes[STATE + LANES + i], lanes[STATE + 2 * LANES + i]
        y, q = lanes[STATE + 3 * LANES + i], lanes[STATE + 4 * LANES + i]
        x = q + twice * z
        q -= h * (twice * x + y - z)
        y += h * x
        rate = max(ratio + pull * psi, 0.0)
        free = max(1.0 - level_limit * z * z - slope_limit * u * u, 0.0)
        random = kick * np.sqrt(rate * free) * lanes[NOISE + i]
        new_z = z - h * rate * z + random if first_order else z + h * rate * u
        u = 0.0 if first_order else u - h * rate * (loss * u + z) + random
        psi += feed * lanes[NOISE + LANES + i] - h * corner * psi
        lanes[STATE + i], lanes[STATE + LANES + i], lanes[STATE + 2 * LANES + i] = new_z, u, psi
        lanes[STATE + 3 * LANES + i], lanes[STATE + 4 * LANES + i] = y, q

        x = q + twice * new_z
        travel, slip = y - new_z, x - max(ratio + pull * psi, 0.0) * u
        force = twice * slip + travel
        lanes[FIRST + i], lanes[SECOND + i] = new_z, u
        lanes[SQUARES + i], lanes[SQUARES + LANES + i], lanes[SQUARES + 2 * LANES + i] = y * y, x * x, force * force
        lanes[SQUARES + 3 * LANES + i], lanes[SQUARES + 4 * LANES + i] = travel * travel, slip * slip
        lanes[FIRST_SQUARE + i], lanes[SECOND_SQUARE + i] = new_z * new_z, u * u


@compiled
def draw_normals(counters: Any, words: Any, normals: Any, fill: int, chunk: int, noise: int) -> None:
    """CHUNK rows of standard normals: pure functions of key, chunk and noise."""
    for i in range(LANES):
        counters[2 * LANES + i] = np.uint32(noise)
        counters[3 * LANES + i] = np.uint32(chunk)
    request = np.array((0, CHUNK), np.uint32)
    call(np.uint64(fill), counters.ctypes.data, words.ctypes.data, request.ctypes.data)
    for row in range(0, CHUNK * LANES, 2 * LANES):
        first, second = words[row : row + LANES], words[row + LANES : row + 2 * LANES]
        low, high = normals[row : row + LANES], normals[row + LANES : row + 2 * LANES]
        for i in range(LANES):
            one, two = normal_pair(first[i], second[i])
            low[i] = one
            high[i] = two


@compiled
def count(lanes: Any, counts: Any, cells: Any, low: float, scale: float) -> None:
    """Add FIRST and SECOND of each lane to their histograms, whose end cells take what lies beyond."""
    last = counts.shape[1] - 1
    for i in range(2 * LANES):
        place = (lanes[FIRST + i] - low) * scale + 1.0
        place = place if place > 0.0 else 0.0
        cells[i] = np.int32(place if place < last else last)
    first, second = counts[0], counts[1]
    for i in range(LANES):  # in turn, so that one count need not wait for the other
        first[np.uint32(cells[i])] += 1
        second[np.uint32(cells[LANES + i])] += 1


@compiled
def march(
    lanes: Any,
    counters: Any,
    table: Any,
    addresses: Any,
    noises: int,
    merged: int,
    begin: int,
    end: int,
    sums: Any,
    counts: Any,
    low: float,
    scale: float,
) -> None:
    """Step one block through the chunks ``begin`` to ``end`` of noise.

    ``merged`` neighbouring normals drive one step. The observed rows are added to ``sums`` (rows * LANES numbers, or none), the
    first two to the histograms ``counts`` (two rows, or none).
    """
    words = np.empty(CHUNK * LANES, np.uint32)
    normals = np.empty((noises, CHUNK * LANES))
    cells = np.empty(2 * LANES, np.int32)
    share = 1.0 / math.sqrt(merged)
    for chunk in range(begin, end):
        for noise in range(noises):
            draw_normals(counters, words, normals[noise], addresses[0], chunk, noise)
        for step in range(CHUNK // merged):
            for noise in range(noises):
                target = lanes[NOISE + noise * LANES : NOISE + (noise + 1) * LANES]
                source = normals[noise, step * merged * LANES : (step + 1) * merged * LANES]
                for i in range(LANES):
                    target[i] = share * source[i]
                for part in range(1, merged):
                    other = source[part * LANES : (part + 1) * LANES]
                    for i in range(LANES):
                        target[i] += share * other[i]
            call(np.uint64(addresses[1]), lanes.ctypes.data, lanes.ctypes.data, table.ctypes.data)
            if sums.size:
                values = lanes[OBSERVED : OBSERVED + OBSERVATIONS * LANES]
                for i in range(OBSERVATIONS * LANES):
                    sums[i] += values[i]
            if counts.size:
                count(lanes, counts, cells, low, scale)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Estimate:
    """A mean from simulation.

    Attributes:
        value: the mean.
        standard_error: of the value, from independent lanes.
        bias: what the time step adds to the value, to first order in it; None if not asked for.
        without_bias: the value less its bias, which has less noise than the two would have apart; None likewise.
    """

    value: float
    standard_error: float
    bias: Estimate | None = None
    without_bias: Estimate | None = None

    def distance(self, expected: float) -> float:
        """The value less what is ``expected``, in standard errors."""
        difference = self.value - expected
        return difference / self.standard_error if self.standard_error > 0 else math.copysign(math.inf, difference)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Simulation:
    """Stationary means at one speed.

    Attributes:
        speed: v, m/s.
        first, second: means of A and B, m; on a random road of Z and U.
        first_square, second_square: their mean squares, m^2.
        amplitude: |E C| = (E(A)^2 + E(B)^2)^(1/2), the paper's V_m, m.
        mean_squares: E Y^2 and its companions by name, m^2; infinite where they diverge. Under phase noise they are averages
            over the phase too.
        edges: of the cells of the histograms, m, shape (cells + 1,).
        first_density, second_density: histograms of A and B, or of Z and U, 1/m, shape (cells,); what lies beyond the edges
            is missing from their integral.
        samples: how many entered each mean.
    """

    speed: float
    first: Estimate
    second: Estimate
    first_square: Estimate
    second_square: Estimate
    amplitude: Estimate
    mean_squares: Mapping[str, Estimate]
    edges: FloatArray
    first_density: FloatArray
    second_density: FloatArray
    samples: int


FORMS = ("original", "ito", "printed")


@dataclasses.dataclass(frozen=True)
class _System:
    """What `march` steps.

    Attributes:
        step: one step of a block.
        table: its constants for a step h.
        noises: how many drive it.
        spread: of Psi at the start, rad.
        memory: how long the start is remembered, in units of 1/w1.
        longest_step: h beyond which steps of twice that, which measure the bias, may diverge.
    """

    step: LaneFunction
    table: Callable[[float], FloatArray]
    noises: int
    spread: float
    memory: float
    longest_step: float


def _strength(speed_noise: SpeedNoise | None, natural_frequency: float) -> float:
    return 0.0 if speed_noise is None else speed_noise.intensity / math.sqrt(natural_frequency)


def _amplitudes(mu: float, strength: float, damping: float, ratio: float, form: str) -> _System:
    """(20)-(23), as printed or with Ito's signs."""
    sign = 1.0 if form == "printed" else -1.0
    square = strength**2
    rate = float(slowest_decay(np.asarray(damping))) - (square if form == "printed" else 0.0)  # of the length of (A, B, G, H)
    return _System(
        step_amplitudes,
        lambda h: np.array(
            [h, 2 * damping, ratio, 0.0, strength * math.sqrt(h), sign * square / 2, mu * (1 - sign * damping * square), mu]
        ),
        1,
        0.0,
        1 / rate if rate > 0 else math.inf,
        # a step h of Euler's turns a rotation r into a growth h r^2/2, and noise adds h s^4/8
        rate / ((1 + ratio + 2 * damping) ** 2 + square**2) if rate > 0 else math.inf,
    )


def _make_system(
    road: Road, speed_noise: SpeedNoise | None, damping: float, speed: float, natural_frequency: float, form: str
) -> _System:
    ratio = speed * road.wavenumber / natural_frequency
    strength = _strength(speed_noise, natural_frequency)
    if one_of("form", form, FORMS) != "original":
        if not isinstance(road, HarmonicRoad) or not (speed_noise is None or isinstance(speed_noise, WhiteSpeedNoise)):
            raise ParameterError(f"form must be original but for the harmonic road with white speed noise or none, got {form}")
        system = _amplitudes(road.amplitude, strength, damping, ratio, form)
        if math.isinf(system.memory):
            limit = math.sqrt(natural_frequency * float(slowest_decay(np.asarray(damping))))
            raise ParameterError(
                f"intensity must be below {limit:g} at damping {damping:g}, where the printed amplitudes diverge, got "
                f"{strength * math.sqrt(natural_frequency):g}"
            )
        return system
    corner = pull = white = 0.0
    if speed_noise is not None:
        corner, pull, white = speed_noise.rates
        corner, pull = corner / natural_frequency, pull / natural_frequency
    spread = strength / math.sqrt(2 * corner) if corner else 0.0
    slowest = float(slowest_decay(np.asarray(damping)))
    memory = 1 / slowest
    # Euler's steps amplify a free motion of the car unless h < D/2 and h < 1/(2 D); the phase may turn by 0.5 rad a step
    longest = min(damping / 2, 0.5 / damping, 0.5 / max(corner, 1e-9))
    noise_rate = max(strength**2 / 0.025 if white else 0.0, 10 * abs(pull) * spread)
    if isinstance(road, HarmonicRoad):
        feed = strength if corner else 0.0
        return _System(
            step_waves,
            lambda h: np.array(
                [h, 2 * damping, ratio, corner, pull, white * strength * math.sqrt(h), feed * math.sqrt(h), road.amplitude]
            ),
            1,
            spread,
            memory,
            min(longest, 1 / max(2 * ratio, noise_rate, 1e-9)),
        )
    limits = (0.0, 0.0)
    if isinstance(road, FirstOrderRoad):
        kick, loss, road_memory = road.noise_intensity, -1.0, 1 / ratio
        road_step = 0.5
    elif isinstance(road, (GaussianRoad, MultiplicativeRoad)):
        kick, loss = road.noise_intensity, 2 * road.bandwidth
        road_step = min(road.bandwidth / 2, 0.5 / road.bandwidth)
        road_memory = 1 / (float(slowest_decay(np.asarray(road.bandwidth))) * ratio)
        if isinstance(road, MultiplicativeRoad):
            limits = (road.level_bound**-2, (road.slope_bound or road.level_bound) ** -2)
    else:
        raise ParameterError(f"road must be of a kind whose equations are known here, got a {road.kind} road")
    return _System(
        step_random_road,
        lambda h: np.array(
            [
                *(h, 2 * damping, ratio, corner, pull, 0.0, strength * math.sqrt(h)),
                *(kick * math.sqrt(h / road.wavenumber), loss, *limits),
            ]
        ),
        1 if speed_noise is None else 2,
        spread,
        max(memory, road_memory),
        min(longest, road_step / (ratio + 3 * abs(pull) * spread)),
    )


def simulate(
    road: str | Mapping[str, Any] | Road,
    speed_noise: str | Mapping[str, Any] | SpeedNoise | None = None,
    *,
    damping: float,
    speed: npt.ArrayLike,
    natural_frequency: float = 1.0,
    form: str = "original",
    samples: int = 20_000_000,
    time_step: float = 1e-3,
    lanes: int = LANES,
    histogram: tuple[float, float, int] | None = None,
    bias: bool = False,
    seed: int = 0,
    threads: int | None = None,
    report: Callable[[int, int], None] | None = None,
) -> list[Simulation]:
    """Euler-Maruyama at the paper's scale (Fig. 7): means, mean squares and histograms at each speed, with standard errors.

    Lanes start at rest, and what they remember of that is skipped. See the module's docstring for the equations.

    Args:
        road: a road, or its name or mapping.
        speed_noise: noise on the speed, or its name or mapping, or None.
        damping: D > 0, 1.
        speed: speeds v >= 0, m/s, a number or several, above zero on random roads; each has noise of its own.
        natural_frequency: w1, rad/s.
        form: "original", the equations of the plant; "ito" or "printed", the amplitudes (20)-(23) under white noise.
        samples: N, steps at each speed, shared out between the lanes.
        time_step: w1 dt, 1.
        lanes: independent paths at each speed, a multiple of 64.
        histogram: first edge, last edge, m, and number of cells; by default none.
        bias: measure the bias of the time step, for about 60 % more work.
        seed: fixes the noise.
        threads: how many; results do not depend on it. By default one a processor.
        report: called as ``report(blocks done, blocks in all)``.

    Returns:
        One `Simulation` for each speed.

    Raises:
        ParameterError: a value out of range, a system without stationary means, or fewer samples than lanes.
    """
    road = make_road(road)
    speed_noise = make_speed_noise(speed_noise, road)
    damping, w1 = within("damping", damping), within("natural_frequency", natural_frequency)
    speeds = range_array("speed", speed, "any speed" if isinstance(road, HarmonicRoad) else "moving speed").reshape(-1).tolist()
    check_size("speeds", "speed", len(speeds), "driven points")
    for value in speeds:
        ratio = value * road.wavenumber / w1
        check_ratio("speed", value, "nu = speed * wavenumber/natural_frequency", ratio, "any frequency ratio")
    if speed_noise is not None:
        speed_noise.check_range(w1)
    h = within("time_step", time_step)
    if whole("lanes", lanes, of="lanes") % LANES:
        raise ParameterError(f"lanes must be a multiple of {LANES}, got {lanes}")
    if whole("samples", samples, of="samples") < CHUNK * lanes:
        raise ParameterError(f"samples must be at least {CHUNK * lanes} for {lanes} lanes, got {samples}")
    whole("seed", seed, low=0, of="seed")
    low, high, cells = _histogram(histogram)
    if threads is not None:
        whole("threads", threads, of="threads")

    systems = [_make_system(road, speed_noise, damping, value, w1, form) for value in speeds]
    for system in systems:
        check_ratio(
            "time_step",
            h,
            "it over the longest that is stable at this damping and speed",
            h / system.longest_step,
            "Euler step",
        )
        work = samples + SETTLED * system.memory / h * lanes
        check_size("steps of all lanes", "samples, lanes and time_step", work * len(speeds), "work")
    blocks = lanes // LANES
    chunks = math.ceil(samples / lanes / CHUNK)
    seeds = np.random.SeedSequence(seed)
    keys = keys_from_seeds(_seeds(seeds, len(speeds) * lanes)).reshape(2, len(speeds), blocks, LANES)
    starts = np.random.default_rng(seeds).standard_normal((len(speeds), blocks, LANES))

    def drive(place: int, block: int, merged: int) -> tuple[FloatArray, npt.NDArray[np.int64]]:
        """Means over time of the observed rows of one block, shape (rows, LANES), and its histograms."""
        system = systems[place]
        rows = np.zeros(EULER_SIZE)
        if system.step is not step_amplitudes:
            rows[STATE + 2 * LANES : STATE + 3 * LANES] = system.spread * starts[place, block]
        if system.step is step_waves:
            rows[STATE : STATE + LANES] = 1.0  # phase 0
        counters = np.concatenate([*keys[:, place, block], np.zeros(2 * LANES, np.uint32)])
        addresses = np.array([fill_words.address(np.uint32), system.step.address(np.float64)])
        skipped = math.ceil(SETTLED * system.memory / h / CHUNK)
        sums, none = np.zeros(OBSERVATIONS * LANES), np.zeros((2, 0), np.int64)
        counts = np.zeros((2, cells + 2 if cells and merged == 1 else 0), np.int64)
        settings = rows, counters, system.table(merged * h), addresses, system.noises, merged
        scale = cells / (high - low)
        march(*settings, 0, skipped, np.zeros(0), none, low, scale)
        march(*settings, skipped, skipped + chunks, sums, counts, low, scale)
        return sums.reshape(OBSERVATIONS, LANES) * (merged / (chunks * CHUNK)), counts

    merges = (1, 2) if bias else (1,)
    jobs = list(itertools.product(range(len(speeds)), range(blocks), merges))
    found = _in_threads(drive, jobs, threads, report)
    divergent = divergent_terms(road, speed_noise)
    results = []
    for place, value in enumerate(speeds):
        fine, coarse = (
            np.concatenate([found[place, block, merged][0] for block in range(blocks)], axis=1) if merged in merges else None
            for merged in (1, 2)
        )
        assert fine is not None
        counts = sum(found[place, block, 1][1] for block in range(blocks))
        results.append(_summary(value, fine, coarse, np.asarray(counts), (low, high, cells), divergent, chunks * CHUNK * lanes))
    return results


def _histogram(value: Any) -> tuple[float, float, int]:
    """Low edge, high edge and number of cells; no cells for None."""
    if value is None:
        return 0.0, 1.0, 0
    if not isinstance(value, Sequence) or isinstance(value, (str, bytes)) or len(value) != 3:
        raise ParameterError(f"histogram must be (low, high, cells), got {shown(value)}")
    low, high = number("histogram, low edge,", value[0]), number("histogram, high edge,", value[1])
    if low >= high:
        raise ParameterError(f"histogram must be (low, high, cells) with low < high, got {shown(value)}")
    return low, high, whole("histogram, number of cells,", value[2], of="cells")


def _in_threads(
    function: Callable[..., Any],
    jobs: Sequence[tuple[Any, ...]],
    threads: int | None,
    report: Callable[[int, int], None] | None,
) -> dict[tuple[Any, ...], Any]:
    """Results of ``function(*job)``, by job; compiled code runs without the interpreter's lock."""
    available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    results: dict[tuple[Any, ...], Any] = {jobs[0]: function(*jobs[0])} if jobs else {}  # compiles, once
    with ThreadPoolExecutor(threads or available) as pool:
        pending: dict[Future[Any], tuple[Any, ...]] = {pool.submit(function, *job): job for job in jobs[1:]}
        try:
            while pending:
                for future in wait(pending, return_when=FIRST_COMPLETED)[0]:
                    results[pending.pop(future)] = future.result()
                    if report:
                        report(len(results), len(jobs))
        except BaseException:  # an interrupt too: what has not begun is given up
            pool.shutdown(cancel_futures=True)
            raise
    return results


def _estimate(fine: FloatArray, coarse: FloatArray | None) -> Estimate:
    """From the figures of each lane at the step h and at 2 h: value(h) = value(0) + c h, value(2 h) = value(0) + 2 c h."""

    def mean(figures: FloatArray, **fields: Estimate) -> Estimate:
        return Estimate(value=float(figures.mean()), standard_error=float(_standard_errors(figures)), **fields)

    if coarse is None:
        return mean(fine)
    return mean(fine, bias=mean(coarse - fine), without_bias=mean(2 * fine - coarse))


def _summary(
    speed: float,
    fine: FloatArray,
    coarse: FloatArray | None,
    counts: npt.NDArray[np.int64],
    histogram: tuple[float, float, int],
    divergent: tuple[str, ...],
    samples: int,
) -> Simulation:
    """Estimates from the means of each lane, shape (rows, lanes), at the step and at twice the step."""

    def estimate(weights: FloatArray) -> Estimate:
        """Of a linear combination of rows."""
        return _estimate(weights @ fine, None if coarse is None else weights @ coarse)

    rows = [estimate(row) for row in np.eye(OBSERVATIONS)]
    mean = np.hypot(rows[0].value, rows[1].value)
    direction = np.zeros(OBSERVATIONS)
    direction[:2] = np.array([rows[0].value, rows[1].value]) / (mean or 1.0)  # to first order, |E C| moves along E C
    squares = {
        name: Estimate(value=math.inf, standard_error=0.0) if name in divergent else row
        for name, row in zip(MEAN_SQUARES, rows[2:7], strict=True)
    }
    low, high, cells = histogram
    edges = np.linspace(low, high, cells + 1) if cells else np.zeros(0)
    densities = counts[:, 1:-1] / samples * (cells / (high - low))
    return Simulation(
        speed=speed,
        first=rows[0],
        second=rows[1],
        first_square=rows[7],
        second_square=rows[8],
        amplitude=estimate(direction),
        mean_squares=squares,
        edges=edges,
        first_density=densities[0],
        second_density=densities[1],
        samples=samples,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stability:
    """Exponents and rotation numbers of the amplitudes, from simulation; see `analysis.stability` for what they should be.

    Attributes:
        top, second: Lyapunov exponents, almost sure, 1/s.
        mean: top exponent of the means, 1/s.
        upper, lower: rotation numbers, rad/s.
    """

    top: Estimate
    second: Estimate
    mean: Estimate
    upper: Estimate
    lower: Estimate


def simulate_stability(
    damping: float,
    *,
    intensity: float,
    speed: float = 1.0,
    wavenumber: float = 1.0,
    natural_frequency: float = 1.0,
    form: str = "original",
    samples: int = 4_000_000,
    time_step: float = 1e-3,
    lanes: int = 2 * LANES,
    seed: int = 0,
    threads: int | None = None,
) -> Stability:
    """Lyapunov exponents and rotation numbers (41)-(45) of the amplitudes without road, under white speed noise.

    Each lane carries two free motions over the same noise, made orthogonal now and then. The first is one of the two modes of
    the car, which the noise turns but does not mix: so all its relative increments are alike, and the mean of those of C gives
    the exponent of the means. Values are free of the first-order bias of the time step, by steps twice as long over the same
    noise; what is left of it, (w1 dt)^2, is part of the standard errors.

    Args:
        damping: D > 0, 1.
        intensity: sigma > 0, rad/s^(1/2).
        speed: v >= 0, m/s.
        wavenumber: of the road, rad/m.
        natural_frequency: w1, rad/s.
        form: "original", phase and car (18), (19); "ito" or "printed", the amplitudes (20)-(23).
        samples: steps, shared out between the lanes.
        time_step: w1 dt, 1.
        lanes: independent paths, a multiple of 128.
        seed: fixes the noise.
        threads: how many; results do not depend on it.
    """
    one_of("form", form, FORMS)
    if threads is not None:
        whole("threads", threads, of="threads")
    damping, w1 = within("damping", damping), within("natural_frequency", natural_frequency)
    ratio = within("speed", speed, "any speed") * within("wavenumber", wavenumber) / w1
    check_ratio("speed", speed, "nu = speed * wavenumber/natural_frequency", ratio, "any frequency ratio")
    strength = within("intensity", intensity, "noise_intensity") / math.sqrt(w1)
    check_ratio("intensity", intensity, "sigma/sqrt(w1)", strength, "relative intensity")
    h = within("time_step", time_step)
    turn = (ratio + 1 + 2 * damping) ** 2 + strength**4
    check_ratio(
        "time_step",
        h,
        "it over the longest that is stable at this damping and speed",
        h * max(turn, 40 * strength**2),
        "Euler step",
    )
    if whole("lanes", lanes, of="lanes") % (2 * LANES):
        raise ParameterError(f"lanes must be a multiple of {2 * LANES}, got {lanes}")
    whole("seed", seed, low=0, of="seed")
    chunk = CHUNK * h
    # per interval the amplitudes turn by less than half a turn, and the noise by five standard deviations less
    per_interval = max(1, int(min(0.5 / (ratio + 1 + 2 * damping), 0.1 / strength**2) / chunk))
    per_window = max(1, round(1 / (per_interval * chunk)))
    windows = whole("samples", samples, of="samples") // (lanes * CHUNK * per_interval * per_window)
    if windows < 1:
        raise ParameterError(f"samples must be at least {lanes * CHUNK * per_interval * per_window}, got {samples}")
    check_size("intervals", "samples over lanes, and time_step", windows * per_window, "stability intervals")
    original = form == "original"
    address = (step_waves if original else step_amplitudes).address(np.float64)
    addresses = np.array([fill_words.address(np.uint32), address])
    keys = keys_from_seeds(_seeds(np.random.SeedSequence(seed), lanes)).reshape(2, -1, LANES)
    root = np.emath.sqrt((damping - 1) * (damping + 1))  # modes x = (-D +- root) y
    slow = 1 / (damping + root) if damping >= 1 else damping - root  # without cancellation

    def table(step: float) -> FloatArray:
        if original:
            return np.array([step, 2 * damping, ratio, 0.0, 0.0, strength * math.sqrt(step), 0.0, 0.0])
        return _amplitudes(0.0, strength, damping, ratio, form).table(step)

    # complex motion y = Y + i Y^ and x in the rows of either system, which has C = A - i B
    rows = [STATE + row * LANES for row in ((3, 5, 4, 6) if original else (0, 1, 2, 3))]
    sign = 1 if original else -1

    def drive(block: int, merged: int) -> tuple[npt.NDArray[np.complex128], FloatArray]:
        """Relative increments of C of the first motion, logarithmic ones of the second; shape (intervals, LANES) each."""
        counters = np.concatenate([*keys[:, block], np.zeros(2 * LANES, np.uint32)])
        own = -slow if block % 2 else -slow.conjugate()
        motions = np.array([[1.0, own], [-np.conjugate(own), 1.0]], np.complex128) / np.hypot(1.0, abs(own))
        motions = np.repeat(motions[..., np.newaxis], LANES, axis=2)  # motion, (y, x), lane
        states = np.zeros((2, EULER_SIZE))
        if original:
            states[:, STATE : STATE + LANES] = 1.0
        intervals = windows * per_window
        increments, logarithms = np.empty((intervals, LANES), np.complex128), np.empty((intervals, LANES))
        settings = table(merged * h), addresses, 1, merged
        nothing = np.zeros(0), np.zeros((2, 0), np.int64), 0.0, 1.0
        for k in range(intervals):
            before = _rotating(motions[0, 0], states[0], original)
            for state, motion in zip(states, motions, strict=True):
                for part, row in enumerate(rows):
                    imaginary, place = part % 2, part // 2
                    state[row : row + LANES] = sign * motion[place].imag if imaginary else motion[place].real
                march(state, counters, *settings, k * per_interval, (k + 1) * per_interval, *nothing)
                motion[0] = state[rows[0] : rows[0] + LANES] + sign * 1j * state[rows[1] : rows[1] + LANES]
                motion[1] = state[rows[2] : rows[2] + LANES] + sign * 1j * state[rows[3] : rows[3] + LANES]
            increments[k] = _rotating(motions[0, 0], states[0], original) / before
            motions[0] /= np.linalg.norm(motions[0], axis=0)
            motions[1] -= np.sum(motions[0].conj() * motions[1], axis=0) * motions[0]
            length = np.linalg.norm(motions[1], axis=0)
            logarithms[k] = np.log(length)
            motions[1] /= length
        return increments, logarithms

    blocks = lanes // LANES
    found = _in_threads(drive, list(itertools.product(range(blocks), (1, 2))), threads, None)
    interval = per_interval * chunk
    remainder = (h * max(1.0, 2 * damping)) ** 2

    def figures(merged: int) -> dict[str, FloatArray]:
        """Figures of each lane, in units of w1."""
        result: dict[str, list[FloatArray]] = {name: [] for name in ("top", "second", "mean", "upper", "lower")}
        for block in range(blocks):
            increments, logarithms = found[block, merged]
            steps = windows * per_window * interval
            result["top"].append(np.log(np.abs(increments)).sum(axis=0) / steps)
            result["second"].append(logarithms.sum(axis=0) / steps)
            result["lower" if block % 2 else "upper"].append(-np.angle(increments).sum(axis=0) / steps)
        for side in range(2):  # the two modes turn differently, so each has a mean of its own
            own = [found[block, merged][0].reshape(windows, per_window, LANES) for block in range(side, blocks, 2)]
            factors = np.concatenate([part.prod(axis=1).mean(axis=0) for part in own])
            mean = factors.mean()
            # the logarithm of the mean, to first order in what a lane is off it
            result["mean"].append((math.log(abs(mean)) + (factors / mean).real - 1) / (per_window * interval))
        return {name: w1 * np.concatenate(parts) for name, parts in result.items()}

    fine, coarse = figures(1), figures(2)
    estimates = {}
    for name in fine:
        result = _estimate(fine[name], coarse[name])
        assert result.without_bias is not None
        value, error = result.without_bias.value, result.without_bias.standard_error
        estimates[name] = Estimate(value=value, standard_error=math.hypot(error, w1 * remainder), bias=result.bias)
    return Stability(**estimates)


def _rotating(motion: npt.NDArray[np.complex128], state: FloatArray, original: bool) -> npt.NDArray[np.complex128]:
    """C from the first component of a motion: exp(-i phi) (Y + i Y^) in the original equations, else as it is."""
    if not original:
        return motion.copy()
    return np.asarray(motion * (state[STATE : STATE + LANES] - 1j * state[STATE + LANES : STATE + 2 * LANES]))
