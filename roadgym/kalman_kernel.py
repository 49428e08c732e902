"""Kalman filters as compiled code; see `roadgym.kalman`.

All of it goes car by car, so the filter of a car is the same, bit by bit, in a batch of any size.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .actuation import driven
from .compiled import compiled
from .roads.linear import product, transition

KNOWN = 1e-12  # share of what could be, at which the variance of a measurement is rounding, and it tells nothing


@compiled
def interval_steps(drift: Any, noise: Any, time: float, steps: Any) -> None:
    """Phi and Q of each of a stack of systems, shape (k, 2, n, n)."""
    size, width = noise.shape[1:]
    for k in range(len(drift)):
        intensity = np.zeros((size, size))
        for a in range(size):
            for b in range(size):
                for c in range(width):
                    intensity[a, b] += noise[k, a, c] * noise[k, b, c]
        phi, sigma = transition(drift[k], intensity, time)
        steps[k, 0] = phi
        steps[k, 1] = sigma


@compiled
def fit_series(fit: Any, values: Any, series: Any) -> None:
    """Chebyshev coefficients of functions, shape (points, degree + 1, functions), from their values at the nodes."""
    for p in range(len(values)):
        for k in range(len(fit)):
            series[p, k] = 0.0
            for d in range(len(fit)):
                for e in range(values.shape[2]):
                    series[p, k, e] += fit[k, d] * values[p, d, e]


@compiled
def spread_start(steps: Any, start: Any, spread: Any) -> None:
    """Covariances after steps of Phi and Q, shape (points, 2, n, n), from a common one."""
    size = len(start)
    for p in range(len(steps)):
        for a in range(size):
            for b in range(size):
                total = steps[p, 1, a, b]
                for c in range(size):
                    for d in range(size):
                        total += steps[p, 0, a, c] * start[c, d] * steps[p, 0, b, d]
                spread[p, a, b] = total


@compiled
def spread_rows(rows: Any, start: Any, variances: Any, whole: Any) -> None:
    """Covariances of x, of independent numbers of these ``variances``, and of ``rows`` of x, shape (points, states, states)."""
    count, size = rows.shape[1:]
    first = size + len(variances)
    for p in range(len(rows)):
        whole[p, :size, :size] = start[p]
        for j in range(len(variances)):
            whole[p, size + j, size + j] = variances[j]
        for j in range(count):
            for a in range(size):
                for b in range(size):
                    whole[p, first + j, a] += rows[p, j, b] * start[p, b, a]
                whole[p, a, first + j] = whole[p, first + j, a]
            for k in range(j + 1):
                for a in range(size):
                    whole[p, first + j, first + k] += whole[p, first + j, a] * rows[p, k, a]
                whole[p, first + k, first + j] = whole[p, first + j, first + k]


@compiled
def follow_valve(numbers: Any, ends: Any, time: float, commands: Any, valve: Any, means: Any) -> None:
    """Move the valve of each filter through a control interval, as `roadgym.actuation` does.

    Args:
        numbers: late, part, levels, rate, rise and fall of `roadgym.valve.Valve.numbers`, of each filter.
        ends: of the range of D.
        time: that each part of the interval lasts, in units of 1/w1.
        commands: of each car, within the range, shape (n,).
        valve: D in force, its target, and the commands that wait, the newest first, shape (n b, 4 + late).
        means: set to the mean D of each part, shape (n b, parts).
    """
    low, high = ends
    bank, parts = len(means) // len(commands), means.shape[1]
    for i in range(len(means)):
        late, part, levels, rate, rise, fall = numbers[i]
        command, step = commands[i // bank], (high - low) / max(levels - 1, 1.0)
        for k in range(valve.shape[1] - 1, 2, -1):
            valve[i, k] = valve[i, k - 1]
        valve[i, 2] = low + step * np.rint((command - low) / step) if levels > 0 else command
        newer, older = valve[i, 2 + int(late)], valve[i, 3 + int(late)]
        for k in range(parts):
            until = min(max(part * parts - k, 0.0), 1.0) * time
            value, target, area = valve[i, 0], valve[i, 1], 0.0
            if until > 0.0:
                value, target, area, _ = driven(value, target, older, until, rate, rise, fall)
            if until < time:
                value, target, more, _ = driven(value, target, newer, time - until, rate, rise, fall)
                area += more
            valve[i, 0], valve[i, 1] = min(max(value, low), high), target
            means[i, k] = min(max(area / time, low), high)


@compiled
def read_series(series: Any, damping: float, powers: Any, step: Any) -> None:
    """Phi and Q of a part of an interval from their Chebyshev series, in terms of D from -1 to 1."""
    degree = len(series) - 1
    powers[0], powers[1] = 1.0, damping
    for k in range(2, degree + 1):
        powers[k] = 2.0 * damping * powers[k - 1] - powers[k - 2]
    step[:] = 0.0
    for k in range(degree + 1):
        for e in range(len(step)):
            step[e] += powers[k] * series[k, e]


@compiled
def lengthen(phi: Any, spread: Any, step: Any, work: Any) -> None:
    """Let another step of Phi and Q follow those that are there."""
    size = len(phi)
    later, added = step[: size * size].reshape(size, size), step[size * size :].reshape(size, size)
    product(later, phi, work)
    phi[:] = work
    product(later, spread, work)
    product(work, later.T, spread)
    spread += added


@compiled
def advance_beliefs(
    series: Any,
    delayed: Any,
    lags: Any,
    place: Any,
    before: Any,
    damping: Any,
    middle: float,
    half: float,
    mean: Any,
    covariance: Any,
) -> None:
    """Move means, shape (n, states), and covariances of the filters of each car over a control interval.

    After the states of car and road come the biases, which stay, and for each delayed signal its last values, the newest first:
    that at the beginning of the interval, where the damping ``before`` was in force, comes in, ``lags`` of them are kept. D is
    ``damping`` in the parts of the interval, shape (n, parts).
    """
    size = mean.shape[1]
    own, chains = delayed.shape[3], lags.sum()
    step, powers = np.empty(2 * own * own), np.empty(series.shape[1])
    phi, spread, work = np.empty((own, own)), np.empty((own, own)), np.empty((own, own))
    moved, turned, pull = np.empty(size), np.empty((size, size)), np.zeros((size, size))
    for a in range(own, size - chains):
        pull[a, a] = 1.0
    for i in range(len(mean)):
        read_series(series[place[i]], (damping[i, 0] - middle) / half, powers, step)
        phi[:] = step[: own * own].reshape(own, own)
        spread[:] = step[own * own :].reshape(own, own)
        for k in range(1, damping.shape[1]):
            read_series(series[place[i]], (damping[i, k] - middle) / half, powers, step)
            lengthen(phi, spread, step, work)
        pull[:own, :own] = phi
        row = size - chains
        for j in range(len(lags)):
            for b in range(own):
                pull[row, b] = delayed[place[i], 0, j, b] + before[i] * delayed[place[i], 1, j, b]
            for a in range(row + 1, row + lags[j]):
                pull[a, a - 1] = 1.0
            row += lags[j]
        for a in range(size):
            total = 0.0
            for b in range(size):
                total += pull[a, b] * mean[i, b]
            moved[a] = total
            for b in range(size):
                total = 0.0
                for c in range(size):
                    total += pull[a, c] * covariance[i, c, b]
                turned[a, b] = total
        for a in range(size):
            mean[i, a] = moved[a]
            for b in range(a + 1):
                total = spread[a, b] if a < own else 0.0
                for c in range(size):
                    total += turned[a, c] * pull[b, c]
                covariance[i, a, b] = total
                covariance[i, b, a] = total


@compiled
def take_up(
    rows: Any,
    place: Any,
    damping: Any,
    noise: Any,
    late: Any,
    period: Any,
    time: Any,
    measured: Any,
    mean: Any,
    covariance: Any,
    surprise: Any,
) -> None:
    """Correct means and covariances of the filters of each car by what was measured.

    Args:
        rows: H(0) and dH/dD of each place.
        place: of each filter.
        damping: that was in force last, of each filter.
        noise: the diagonal of R.
        late, period: intervals after which a sample is told, and from one to the next, of each sensor; those that were told
            already are not taken up again.
        time: control intervals since the episode of each car began.
        measured: a row a car.
        mean, covariance: of the filters, those of each car together.
        surprise: ``surprise[:, i]`` is set to the innovations in their order over their deviations, each given those before it,
            and to these deviations; both 0 where a measurement tells nothing.
    """
    size, bank = mean.shape[1], len(mean) // len(measured)
    row, gain = np.empty(size), np.empty(size)
    for i in range(len(mean)):
        car = i // bank
        for j in range(len(noise)):
            surprise[0, i, j] = surprise[1, i, j] = 0.0
            age = time[car] - late[j]
            if time[car] > 0 and (age <= 0 or age % period[j] != 0):
                continue
            variance, possible = noise[j], noise[j]
            error = np.float64(measured[car, j])
            for a in range(size):
                row[a] = rows[place[i], 0, j, a] + damping[i] * rows[place[i], 1, j, a]
                error -= row[a] * mean[i, a]
            for a in range(size):
                total = 0.0
                for b in range(size):
                    total += covariance[i, a, b] * row[b]
                gain[a] = total
                variance += row[a] * total
                possible += row[a] * row[a] * max(covariance[i, a, a], 1e-9)
            if variance > KNOWN * possible:
                surprise[0, i, j] = error / np.sqrt(variance)
                surprise[1, i, j] = np.sqrt(variance)
                for a in range(size):
                    mean[i, a] += gain[a] * (error / variance)
                    for b in range(a + 1):
                        covariance[i, a, b] -= gain[a] * gain[b] / variance
                        covariance[i, b, a] = covariance[i, a, b]


@compiled
def weigh(surprise: Any, weight: Any) -> None:
    """Multiply the weights of the filters of each bank by the densities of their innovations, and make their sum 1."""
    cars, bank = weight.shape
    logarithm = np.empty(bank)
    for i in range(cars):
        largest = -np.inf
        for b in range(bank):
            logarithm[b] = np.log(weight[i, b]) if weight[i, b] > 0.0 else -np.inf
            for j in range(surprise.shape[2]):
                normal, deviation = surprise[0, i * bank + b, j], surprise[1, i * bank + b, j]
                if deviation > 0.0:
                    logarithm[b] -= 0.5 * normal * normal + np.log(deviation)
            largest = max(largest, logarithm[b])
        total = 0.0
        for b in range(bank):
            weight[i, b] = np.exp(logarithm[b] - largest)
            total += weight[i, b]
        for b in range(bank):
            weight[i, b] /= total


@compiled
def tell(told: Any, place: Any, weight: Any, mean: Any, covariance: Any, means: Any, squares: Any) -> None:
    """Means and mean squares of what is told, shape (n, names), over the filters of each bank."""
    cars, bank = weight.shape
    size = told.shape[2]
    for i in range(cars):
        for j in range(means.shape[1]):
            means[i, j] = squares[i, j] = 0.0
            for b in range(bank):
                k, value, variance = i * bank + b, 0.0, 0.0
                for a in range(size):
                    value += told[place[k], j, a] * mean[k, a]
                    for c in range(size):
                        variance += told[place[k], j, a] * covariance[k, a, c] * told[place[k], j, c]
                means[i, j] += weight[i, b] * value
                squares[i, j] += weight[i, b] * (variance + value * value)
