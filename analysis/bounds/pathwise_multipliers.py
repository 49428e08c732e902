"""A lower bound by information relaxation for every linear car: the road is told, and the damper's sector has a multiplier
for each moment of it.

The plant is that of `matrix_inequality`: dx = (A x - f u) dt + G dW with x = (car, road), a force u = 2 (D - D_min) v_r beyond
the softest damping, and u (k v_r - u) >= 0. For any form P the mean of the penalty, what noise adds to x'P x beyond its
conditional mean, is zero for a controller that does not foresee the road. So its mean cost is at least

    (1/T) E min [integral of the cost - penalty],                                                                       (*)

where the least is sought with the whole road known, over all starts of the car and all forces that keep the sector. The penalty
is linear in (x, u) for a known road. So the inner problem is one of forms and lines under u (k v_r - u) >= 0 at each moment,
and weak duality bounds it: with multipliers m(t) >= 0, chosen for this road, the least over any u of the bracket less the
integral of m u (k v_r - u) is a regulator with known forcing (`relaxation.multipliers`). All multipliers prove a bound; the
best are sought by ascent. With one multiplier for all roads and moments, and its P, (*) is the bound of `matrix_inequality`:
there the sector holds in the mean alone, here at each moment of each road.

On a measured road, or a single wave, there is no noise, hence no penalty: the bound is one of all controllers that know the
road ahead.

*The form P* is a mean of that of the matrix inequality, and of the relative value of the best constant damping; of some shares
the one is taken with which other roads, which are driven for this alone, have the largest bound.

*Ends.* The start is free, and nothing is asked of the end: so no moments need be bounded. It costs a few percent.

*What is not exact.* u is held over short steps, with the mean of v_r at their ends; on some roads the steps are halved, over
the same noise, and what that lowers the bound by is charged, times 4/3 for errors that fall as the square of the step.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from roadgym.linear import LinearSystem, ShapingFilter
from roadgym.parameters import ParameterError, whole, within
from roadgym.processors import usual_threads
from roadgym.roads import Road
from roadgym.task import Task

from ..checks import FloatArray, single_threaded_algebra
from ..feedback.iteration import sharing
from ..optimum import optimal_damping
from ..quadratic import value_form
from . import matrix_inequality
from .bound import STATISTICAL, LowerBound, common_refusal
from .relaxation.multipliers import Chain, Forcing, ascend, dual

ASSUMPTION = (
    "any controller whose damping stays in the range, acting at any time; errors of the time step are estimated and charged"
)
FORESEEN = f"{ASSUMPTION}; it may know the road ahead"
STEP = 0.35  # times the fastest rate of the car at D_min
DURATION = 15.0  # times the slowest
SHARES = (0.0, 0.15, 0.3)  # of the constant damping's value in P
TRIED, GROUP, MOST = 3, 8, 512  # roads: to choose a share by, solved together, and at most
HALVED = 4  # one road in so many is solved again with half the step
CHARGE = 4 / 3  # times what that changes
GAIN, STEPS = 3e-5, 1000  # of the ascent: least gain, over the value, and steps at most
NEARER = (1.0, 0.97, 0.9, 0.7, 0.4)  # shares of the multipliers of whole steps, with which half steps begin
REACH = 3.0  # in units of 1/w1: of what is made shorter in the ascent where there is no value
COARSE = np.logspace(-6, 4, 41)  # single multipliers that are tried, in units of the cost over v_r squared


def refusal(task: Task) -> str | None:
    """Why there is no such bound for this task; None where there is."""
    reason, road = common_refusal(task), task.road.shaping_filter()
    if reason is not None or _lap(task.road) is not None:
        return reason
    if road is None or road.flatness != 0 or not road.noise.any():
        return "pathwise multipliers need a road of Gaussian noise, a measured one, or a single wave"
    if np.any(road.level @ road.noise) and task.car.motion.relative in task.car.motion.rough:
        return "pathwise multipliers need a damper that feels no white noise"
    return None


@single_threaded_algebra()
def bound(
    task: Task,
    speed: float,
    bandwidth: float,
    *,
    precision: float = 0.01,
    seed: int = 0,
    threads: int | None = None,
    report: Callable[[int, int], None] | None = None,
) -> LowerBound:
    """The bound at an operating point, with its standard error; none of a road that is the same at each lap.

    Args:
        task: plant, weights and range of D.
        speed: m/s.
        bandwidth: 1; 0 where the road has none.
        precision: standard error over the bound, at most; roads are added until it is reached, up to `MOST`.
        seed: fixes the noise; the result depends on nothing else.
        threads: number of threads; results do not depend on it. By default one a processor.
        report: called as ``report(done, total)``.

    Raises:
        ParameterError: a parameter out of range, or a plant of another kind.
    """
    reason = refusal(task)
    if reason is not None:
        raise ParameterError(f"there is no such bound for this task: {reason}")
    precision = within("precision", precision, "relative_error")
    count = usual_threads() if threads is None else whole("threads", threads, of="threads")
    told = report or (lambda done, total: None)
    lap = _lap(task.road)
    if lap is not None:
        cost, error = _known(task, speed, lap), 0.0
    else:
        cost, error = _random(task, speed, bandwidth, precision, seed, count, told)
    told(100, 100)
    return LowerBound(
        cost=max(cost, 0.0),
        method="pathwise_multipliers",
        assumption=ASSUMPTION if lap is None else FORESEEN,
        rigour=STATISTICAL,
        standard_error=error,
    )


class Held:
    """The plant over steps in which the force is held.

    Args:
        road: the road.
        task: car, weights and range of D.
        ratio: frequency ratio nu.
        step: in units of 1/w1.

    Attributes:
        system: at D_min and D_max.
        step, whole: the step, and what (x, u) becomes in it, shape (n, n + 1).
        covariance: of what noise adds, shape (n, n).
        cost, constant: the integral of the cost over it, in the mean: a form of (x, u), and a number.
        relative: k v_r, mean of both ends, as a row over (x, u); and the row at an end over x.
    """

    def __init__(self, road: ShapingFilter, task: Task, ratio: float, step: float) -> None:
        from scipy.linalg import expm

        low, high = task.damping_range
        self.system = LinearSystem.of(road, task.car.motion, damping=[low, high], ratio=ratio)
        size = len(self.system.states)
        drift, noise = np.zeros((size + 1, size + 1)), self.system.noise[0]
        drift[:size, :size], drift[:size, size] = self.system.drift[0], -self.system.force_entry
        rate = np.zeros((size + 1, size + 1))
        for name, weight in task.weights_by_name.items():
            row = np.append(self.system.signals[name][0], self.system.force[name])
            rate += weight * np.outer(row, row)
        zero = np.zeros_like(rate)

        def integral(time: float) -> tuple[FloatArray, FloatArray]:
            """(exp(drift time), integral of the cost), by the exponential of a block matrix (C. F. Van Loan, 1978)."""
            both = expm(time * np.block([[-drift.T, rate], [zero, drift]]))
            after = both[size + 1 :, size + 1 :]
            return after, after.T @ both[: size + 1, size + 1 :]

        after, cost = integral(step)
        nodes, weights = np.polynomial.legendre.leggauss(5)
        spread = noise @ noise.T
        means = [np.sum(integral(step * (1 + node) / 2)[1][:size, :size] * spread) for node in nodes]
        self.step, self.whole = step, after[:size]
        self.covariance = _added(self.system.drift[0], spread, step)
        self.cost, self.constant = (cost + cost.T) / 2, float(step / 2 * weights @ means)
        self.end = 2 * (high - low) * self.system.signals[task.car.motion.relative][0]
        self.relative = (np.append(self.end, 0.0) + self.end @ self.whole) / 2
        cars = self.cars = self.system.car_states
        own = [*range(cars), size]
        self.chain = Chain(
            np.ascontiguousarray(self.whole[:cars, :cars]),
            np.ascontiguousarray(self.whole[:cars, size]),
            np.ascontiguousarray(self.cost[np.ix_(own, own)]),
            np.ascontiguousarray(self.relative[:cars]),
            float(self.relative[size]),
        )

    def forcing(self, road: FloatArray, noise: FloatArray, form: FloatArray) -> tuple[Forcing, float]:
        """(the inner problem's forcing, what the bracket of (*) has beyond it) of one road.

        Args:
            road: its states at the beginnings of the steps, shape (N, road states).
            noise: what noise adds to car and road in them, shape (N, n).
            form: P, shape (n, n).
        """
        cars, size = self.cars, len(self.whole)
        own, roads = [*range(cars), size], slice(cars, size)
        penalty = noise @ form @ self.whole  # half of its part that is linear in (x, u)
        linear = road @ self.cost[roads, own] - penalty[:, own]
        known = road @ self.relative[roads] + noise @ self.end / 2
        beyond = np.sum((road @ self.cost[roads, roads] - 2 * penalty[:, roads]) * road) - np.sum((noise @ form) * noise)
        beyond += len(road) * (np.sum(form * self.covariance) + self.constant)
        added = road @ self.whole[:cars, roads].T + noise[:, :cars]
        return Forcing(np.ascontiguousarray(added), np.ascontiguousarray(linear), known), float(beyond)

    def least(
        self, road: FloatArray, noise: FloatArray, form: FloatArray, single: float, near: FloatArray | None = None
    ) -> tuple[float, FloatArray]:
        """(bound of the bracket's mean over time, the multipliers that prove it) of one road, for `forcing`.

        The ascent begins at a ``single`` multiplier, or as near to others as there is a value.
        """
        forcing, beyond = self.forcing(road, noise, form)
        time, found, start = len(road) * self.step, dual(self.chain, forcing), np.full(len(road), single)
        if near is not None:
            tried = (share * near + (1 - share) * start for share in NEARER)
            start = next((each for each in tried if np.isfinite(found(each)[0])), start)
        size = abs(found(start)[0] + beyond)
        value, multipliers = ascend(
            found, start, scale=single, gain=GAIN * size, steps=STEPS, reach=math.ceil(REACH / self.step)
        )
        return (value + beyond) / time, multipliers

    @property
    def unit(self) -> float:
        """Of multipliers."""
        return float(np.trace(self.chain.cost) / (self.chain.relative @ self.chain.relative))


def _added(drift: FloatArray, spread: FloatArray, step: float) -> FloatArray:
    """Covariance of what white noise of intensity ``spread`` adds in a step."""
    from scipy.linalg import expm

    size = len(drift)
    both = expm(step * np.block([[-drift, spread], [np.zeros_like(drift), drift.T]]))
    found = both[size:, size:].T @ both[:size, size:]
    return np.asarray(found + found.T) / 2


def _steps(task: Task, road: ShapingFilter, ratio: float) -> tuple[float, float]:
    """(time step, duration) in units of 1/w1."""
    system = LinearSystem.of(road, task.car.motion, damping=task.damping_range[0], ratio=ratio)
    moving = system.car_states - system.filter_states
    rates = np.linalg.eigvals(system.drift[:moving, :moving])
    return STEP / float(np.abs(rates).max()), DURATION / float((-rates.real).min())


@dataclasses.dataclass(frozen=True, eq=False)
class Lap:
    """A road without noise that repeats itself.

    Attributes:
        filter: what its states become within a step.
        period: angle after which it repeats itself, rad.
        states: of even angles, shape (N + 1,), its states at all but the last, shape (N, 2).
    """

    filter: ShapingFilter
    period: float
    states: Callable[[FloatArray], FloatArray]


def _lap(road: Road) -> Lap | None:
    """That of a measured road, taken straight within a step, or of a single wave; None of any other."""
    wave, measured = road.shaping_filter(), road.periodic
    if wave is not None and road.lines is not None and len(road.lines) == 1:
        ratio = road.lines[0][1]

        def turned(angles: FloatArray) -> FloatArray:
            phases = ratio * angles[:-1]
            return math.sqrt(2) * np.stack([np.cos(phases), -np.sin(phases)], axis=1)

        return Lap(wave, 2 * math.pi / ratio, turned)
    if measured is None:
        return None
    points = np.arange(len(measured.levels) + 1) * measured.angle
    closed = np.append(measured.levels, measured.levels[0])

    def looked_up(angles: FloatArray) -> FloatArray:
        levels = np.interp(angles % measured.period, points, closed)
        return np.stack([levels[:-1], np.diff(levels) / np.diff(angles)], axis=1)

    straight = ShapingFilter(
        states=("level", "slope"),
        drift=np.array([[0.0, 1.0], [0.0, 0.0]]),
        noise=np.zeros((2, 0)),
        level=np.array([1.0, 0.0]),
        covariance=np.eye(2),
    )
    return Lap(straight, measured.period, looked_up)


def _known(task: Task, speed: float, road: Lap) -> float:
    """The bound on a road that is known, over whole laps."""
    ratio = float(task.frequency_ratio(speed))
    longest, duration = _steps(task, road.filter, ratio)
    lap = road.period / ratio
    time = max(1, math.ceil(duration / lap)) * lap
    steps = math.ceil(time / longest)
    found: list[float] = []
    near = None
    for number in (steps, 2 * steps):
        step = time / number
        states = road.states(ratio * step * np.arange(number + 1, dtype=float))
        held = Held(road.filter, task, ratio, step)
        nothing = np.zeros((len(held.whole), len(held.whole)))
        noise = np.zeros((number, len(held.whole)))
        value, multipliers = held.least(states, noise, nothing, _single(held, states, noise, nothing), near)
        found.append(value)
        near = np.repeat(multipliers, 2) / 2
    return found[0] - CHARGE * max(0.0, found[0] - found[1])


def _single(held: Held, road: FloatArray, noise: FloatArray, form: FloatArray) -> float:
    """The best single multiplier for a road, of some."""
    found = dual(held.chain, held.forcing(road, noise, form)[0])
    tried = COARSE * held.unit
    return float(tried[np.argmax([found(np.full(len(road), each))[0] for each in tried.tolist()])])


def _random(
    task: Task, speed: float, bandwidth: float, precision: float, seed: int, threads: int, told: Callable[[int, int], None]
) -> tuple[float, float]:
    """(bound, standard error) on a road of Gaussian noise."""
    road = task.road.shaping_filter(bandwidth if task.bandwidth[1] > 0 else None)
    assert road is not None
    ratio = float(task.frequency_ratio(speed))
    step, duration = _steps(task, road, ratio)
    coarse, fine = (Held(road, task, ratio, each) for each in (step, step / 2))
    number = math.ceil(duration / step)
    proved, constant = _forms(task, speed, bandwidth, coarse.system)
    seeds = np.random.SeedSequence(seed)

    def drive(noise: np.random.SeedSequence) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """(road and noise of the steps, and of half steps)."""
        generator, cars, whole = np.random.default_rng(noise), fine.cars, fine.whole[:, :-1]
        values, vectors = np.linalg.eigh(fine.covariance)
        added = generator.standard_normal((2 * number, len(values))) @ (vectors * np.sqrt(np.maximum(values, 0))).T
        states = np.empty((2 * number, len(values) - cars))
        now = np.linalg.cholesky(road.covariance) @ generator.standard_normal(len(road.states))
        for k in range(2 * number):
            states[k] = now
            now = whole[cars:, cars:] @ now + added[k, cars:]
        return states[::2], added[::2] @ whole.T + added[1::2], states, added

    begun: dict[float, float] = {}

    def solve(noise: np.random.SeedSequence, share: float, again: bool) -> tuple[float, float]:
        """(bound, change by half steps) of one road."""
        form = (1 - share) * proved + share * constant
        states, added, half_states, half_added = drive(noise)
        value, multipliers = coarse.least(states, added, form, begun[share])
        if not again:
            return value, math.nan
        return value, fine.least(half_states, half_added, form, begun[share] / 2, np.repeat(multipliers, 2) / 2)[0] - value

    def solved(noises: list[np.random.SeedSequence], share: float, every: int) -> FloatArray:
        result = np.empty((len(noises), 2))

        def part(begin: int, end: int) -> None:
            for k in range(begin, end):
                result[k] = solve(noises[k], share, every > 0 and k % every == 0)

        run(len(noises), part)
        return result

    with sharing(threads) as run:
        tried = seeds.spawn(TRIED)
        for share in SHARES:
            states, added, _, _ = drive(tried[0])
            begun[share] = _single(coarse, states, added, (1 - share) * proved + share * constant)
        means = []
        for k, share in enumerate(SHARES):
            means.append(float(solved(tried, share, 0)[:, 0].mean()))
            told(6 * (k + 1), 100)
        chosen = SHARES[int(np.argmax(means))]
        found = np.empty((0, 2))
        cost, error = 0.0, math.inf
        while len(found) < 2 * GROUP or (error > precision * abs(cost) and len(found) < MOST):
            found = np.vstack([found, solved(seeds.spawn(GROUP), chosen, HALVED)])
            changes = found[np.isfinite(found[:, 1]), 1]
            cost = float(found[:, 0].mean()) - CHARGE * max(0.0, -float(changes.mean()))
            error = math.hypot(_error(found[:, 0]), CHARGE * _error(changes))
            told(20 + int(79 * min(1.0, (precision * abs(cost) / error) ** 2, len(found) / (2 * GROUP))), 100)
    return cost, error


def _forms(task: Task, speed: float, bandwidth: float, system: LinearSystem) -> tuple[FloatArray, FloatArray]:
    """P of the matrix inequality, and the relative value of the best constant damping."""
    away = np.eye(len(system.states))
    away[: system.car_states, system.car_states :] = -system.heights
    proved = away.T @ matrix_inequality.certificate(task, speed, bandwidth).value @ away
    best = optimal_damping(
        task.road,
        speed=speed,
        car=task.car,
        weights=task.reward_by_name,
        bounds=task.damping_range,
        bandwidth=bandwidth if task.bandwidth[1] > 0 else None,
    )
    road = task.road.shaping_filter(bandwidth if task.bandwidth[1] > 0 else None)
    assert road is not None
    constant = LinearSystem.of(road, task.car.motion, damping=float(best.damping), ratio=float(task.frequency_ratio(speed)))
    return proved, value_form(constant, task.weights_by_name)[0]


def _error(samples: FloatArray) -> float:
    """Standard error of the mean."""
    return float(samples.std(ddof=1)) / math.sqrt(len(samples))
