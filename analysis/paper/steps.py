"""One Euler-Maruyama step of each system of `analysis.paper.euler_maruyama`, compiled, and the march through many.

What is observed after a step, in rows of a block: A and B, or Z and U on a random road; the five mean squares, under phase
noise averaged over the phase; and the squares of the first two.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from roadgym.compiled import LANES, LaneFunction, call, compiled
from roadgym.noise import normal_pair

# rows of a block (see `roadgym.compiled`), in metres and units of time 1/w1
NOISE = 0 * LANES  # two rows of standard normals
OBSERVED = 2 * LANES  # nine rows
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
