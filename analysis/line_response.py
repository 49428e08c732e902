"""Mean squares of a linear car on a road that repeats itself: the sum over the lines of its spectrum.

A car at constant D that meets the period at a uniform place has for each signal s, H its transfer function from the level,

    E s^2 = E Z^2  sum over k of share_k |H(i w_k)|^2,    w_k = nu ratio_k,

with the shares and ratios of `roadgym.roads.periodic`: lines with different k have nothing to do with each other in the mean.
From some w on |H|^2 is a series a w^2 + b + c w^-2 + ..., and the lines beyond, whose shares fall as w^-4, are summed up in
closed form; the relative velocity of a car of one mass, where a is not zero, would need very many of them.
"""

from __future__ import annotations

import math

import numpy as np

from roadgym.linear import FloatArray, Motion
from roadgym.parameters import check_ratio
from roadgym.roads import Road

BEYOND = 8.0  # times the fastest rate of the car, from where on |H|^2 is its series: that leaves out less than 1e-10
REFERENCE = 0.5  # the D in whose terms all others are: one at which no car resonates much
BLOCK = 2**19  # complex numbers at once, of dampings times lines


def line_mean_squares(road: Road, car: Motion, *, damping: FloatArray, ratio: FloatArray) -> dict[str, FloatArray]:
    """Mean squares of the signals by name over E Z^2, in the common shape of ``damping`` D and ``ratio`` nu.

    Args:
        road: one that is `periodic`.
        car: the equations.
        damping: D > 0, 1.
        ratio: nu > 0, 1, in the same shape.

    Raises:
        ParameterError: a speed so low, or a car so fast, that too many lines count.
    """
    level = road.periodic
    assert level is not None
    found = np.empty((len(car.signals), *damping.shape))
    for nu in np.unique(ratio).tolist():
        here = ratio == nu
        dampings = damping[here]
        drift = car.drift + 2 * dampings.max() * car.damper
        fastest = max(float(np.abs(np.linalg.eigvals(matrix)).max()) for matrix in (car.drift, drift))
        bands = max(1, math.ceil(BEYOND * fastest * level.angle / (2 * math.pi * nu)))
        number = bands * len(level.levels)
        name = "nu = speed * wavenumber/natural_frequency"
        check_ratio(name, nu, "the number of lines of the road that move the car, at this damping,", number, "lines")
        lines = level.lines(bands)
        total = _beyond(car, dampings, nu, lines.rest)
        block = max(1, BLOCK // len(dampings))
        for first in range(0, len(lines.shares), block):
            part = slice(first, first + block)
            total += _sums(car, dampings, nu * lines.ratios[part], lines.shares[part])
        found[:, here] = total
    return dict(zip(car.signals, found, strict=True))


def _sums(car: Motion, damping: FloatArray, frequency: FloatArray, shares: FloatArray) -> FloatArray:
    """Sums of the shares times |H|^2 of the signals, shape (signals, dampings), over lines at angular frequencies over w1.

    The states are taken above the road, as on a slow one they follow it. What the damper of D does more than that of
    `REFERENCE` is a force, which moves a signal by - g times itself: so one inverse for each frequency serves all D, with
    H = a + c r, where r is that of the relative velocity and c = 2 D force - 2 (D - REFERENCE) g.
    """
    size, rows = len(car.states), car.rows
    relative = list(car.signals).index(car.relative)
    iw = 1j * frequency
    # of the signals: what is left of level and rate beside the states above the road
    direct = (rows[:, :size] @ car.follows + rows[:, size])[:, None] + rows[:, size + 1, None] * iw
    drift = car.drift + 2 * REFERENCE * car.damper
    pushed = (car.drift @ car.follows + car.level_entry)[:, None] + (car.slope_entry - car.follows)[:, None] * iw
    pushed = pushed - 2 * REFERENCE * car.force_entry[:, None] * direct[relative]
    sides = np.stack([pushed.T, np.broadcast_to(car.force_entry + 0j, pushed.T.shape)], axis=-1)
    above, moved = np.moveaxis(np.linalg.solve(iw[:, None, None] * np.eye(size) - drift, sides), -1, 0)
    a, g = rows[:, :size] @ above.T + direct, rows[:, :size] @ moved.T
    more, force = 2 * (damping - REFERENCE), 2 * damping * rows[:, size + 2, None]
    r = a[relative] / (1 + more[:, None] * g[relative])
    square = shares * (r.real**2 + r.imag**2)
    crossed = (shares * a.conj()) @ r.T, (shares * a.conj() * g) @ r.T
    total: FloatArray = (shares @ (np.abs(a) ** 2).T)[:, None] + 2 * (force * crossed[0].real - more * crossed[1].real)
    total += force**2 * square.sum(axis=1) - 2 * force * more * (g.real @ square.T) + more**2 * (np.abs(g) ** 2 @ square.T)
    return total


def _beyond(car: Motion, damping: FloatArray, nu: float, rest: tuple[float, ...]) -> FloatArray:
    """Sums over the lines beyond, shape (signals, dampings), of the first terms of the series of |H|^2 in 1/w.

    H = h[0] iw + h[1] + h[2]/(iw) + ..., where all after the second is what an impulse leaves.
    """
    size, rows = len(car.states), car.rows
    relative = rows[list(car.signals).index(car.relative)]
    total = np.zeros((len(rows), len(damping)))
    for n, twice in enumerate((2 * damping).tolist()):
        drift, entry = car.drift + twice * car.damper, car.slope_entry - twice * relative[size + 1] * car.force_entry
        signals = rows[:, : size + 2] + twice * rows[:, size + 2, None] * relative[: size + 2]
        h = [signals[:, size + 1], signals[:, :size] @ entry + signals[:, size]]
        impulse = drift @ entry + car.level_entry - twice * relative[size] * car.force_entry
        while len(h) < 2 * len(rest) - 1:
            h.append(signals[:, :size] @ impulse)
            impulse = drift @ impulse
        for k, share in enumerate(rest):  # of w^(2 - 2 k)
            gain = sum((-1) ** (k - a) * h[a] * h[2 * k - a] for a in range(2 * k + 1))
            total[:, n] += gain * nu ** (2 - 2 * k) * share
    return total
