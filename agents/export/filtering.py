"""The Kalman filter in front of a policy (`roadgym.kalman`) and the valve behind it, in double precision.

Python keeps Phi(D) and Q(D) as series at each operating point. Here they are found anew in each step, as Python finds the nodes
of its series: Taylor's series of the equations over a part of the interval, then doubled. The equations are polynomials of D,
speed and bandwidth, whose coefficients are the constants, so the filter is exact at every operating point.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import operator

import numpy as np
import numpy.typing as npt

from roadgym.kalman import KalmanFilter
from roadgym.kalman_kernel import KNOWN
from roadgym.roads.linear import TERMS
from roadgym.task import OPERATING_POINT, SATURATION
from roadgym.variation import OF_VALVE

from ..errors import AgentError
from .program import Memory, Value, clip, concat, constant, elementwise, least, scan, take, where

FloatArray = npt.NDArray[np.float64]

ROUNDING = 1e-12  # share of the largest value of an entry that is none
FACTORS = (1.0, 2.0)  # of frequency ratio and bandwidth x in what is observed, x/(1 + x)
INSTANT = 1e-9  # share of a part of an interval that stands for no time
FINITE = 1e300  # below which a number is one


def double(values: npt.ArrayLike) -> Value:
    """A constant in double precision."""
    return constant(values, "double")


class Equations:
    """What a filter knows of cars, road and sensors, as polynomials of D, frequency ratio and bandwidth.

    They are of second order at most in each.

    Attributes:
        coefficients: by name, shape (cars, 3, 1 or 3, 1 or 3, ...): drift, intensity of the noise, rows of what is measured, of
            what is told late, and of what is told, and covariance at the start.
        car: which of the cars that vary each filter of the bank is of.

    Raises:
        AgentError: others.
    """

    def __init__(self, known: KalmanFilter) -> None:
        cars, self.car = np.unique(known.bank[:, 2:], axis=0, return_inverse=True)
        self._ends = [max(map(abs, known.task.damping_range)), *(max(ends) for ends in known.ranges[:2])]
        found = [self._fitted(known, car) for car in cars]
        self.coefficients = {name: np.stack([each[name] for each in found]) for name in found[0]}

    def _fitted(self, known: KalmanFilter, car: FloatArray) -> dict[str, FloatArray]:
        """The coefficients of a car with these fields."""
        ranges = known.ranges[:2]
        nodes = [np.array([-1.0, 0.0, 1.0])]  # of D, and whole numbers too of what varies, so that the fit rounds nothing
        nodes += [np.array([1.0, 2.0, 3.0] if low < high else [low]) for low, high in ranges]
        points = np.array([[*point, *car] for point in itertools.product(*nodes[1:])])
        between = [0.3 * high + 0.7 * low for low, high in ((-1.0, 1.0), *ranges)]
        control = self._values(known, np.array([[*between[1:], *car]]), between[0])
        fits = [np.round(2 * np.linalg.inv(np.vander(at, increasing=True))) / 2 for at in nodes]  # as they are
        powers = [np.vander([x], len(at), increasing=True)[0] for x, at in zip(between, nodes, strict=True)]
        levels = [self._values(known, points, damping) for damping in nodes[0].tolist()]
        coefficients = {}
        for name, exact in control.items():
            values = np.stack([level[name] for level in levels]).reshape(*map(len, nodes), *exact.shape[1:])
            largest = np.abs(values).max(axis=(0, 1, 2))
            found = np.einsum("ai,bj,ck,ijk...->abc...", *fits, values)
            found[np.abs(found) <= ROUNDING * largest] = 0.0
            if np.any(np.abs(np.einsum("a,b,c,abc...->...", *powers, found) - exact[0]) > 100 * ROUNDING * largest):
                raise AgentError(
                    "cannot export a Kalman filter whose equations are no polynomials of speed and bandwidth, as after a "
                    "warm-up: fix both, or do without the warm-up"
                )
            coefficients[name] = found
        return coefficients

    @staticmethod
    def _values(known: KalmanFilter, points: FloatArray, damping: float) -> dict[str, FloatArray]:
        """All of them at points of one car and a damping, shape (points, ...) each."""
        model, system = known.model(points), known.system(points, np.array([damping]))
        rows, late = (each[:, 0] + damping * each[:, 1] for each in (model.rows, model.delayed))
        shape = (len(points), 1, len(system.states), len(system.states))
        drift = np.broadcast_to(system.drift, shape)[:, 0]
        intensity = np.broadcast_to(system.noise @ np.swapaxes(system.noise, -1, -2), shape)[:, 0]
        names = ("drift", "intensity", "rows", "late", "told", "start")
        return dict(zip(names, (drift, intensity, rows, late, model.told, model.start), strict=True))

    def __call__(self, name: str, damping: Value, point: Value, car: Value) -> Value:
        """One of them at a damping, a number, and an operating point, shape (2,), of a car, which is its number."""
        coefficients = self.coefficients[name]
        shape, flat = coefficients.shape[4:], coefficients.reshape(*coefficients.shape[:4], -1)
        used = np.argwhere(flat.any(axis=(0, 4))).tolist()
        if not used:
            return double(np.zeros(shape))
        factors = [[damping] * a + [point[0]] * b + [point[1]] * c for a, b, c in used]
        monomials = concat([functools.reduce(operator.mul, each, double(1.0)) for each in factors])
        table = np.stack([flat[:, a, b, c] for a, b, c in used], axis=1).reshape(len(flat), -1)
        return (monomials @ take(table, car, "double").reshape(len(used), -1)).reshape(*shape)

    def doublings(self, time: float) -> int:
        """After which Taylor's series over a part of a time is right wherever it is asked for; see `roadgym.roads.linear`."""
        drift = np.abs(self.coefficients["drift"]).sum(axis=(4, 5)).max(axis=0)
        powers = [np.vander([end], length, increasing=True)[0] for end, length in zip(self._ends, drift.shape, strict=True)]
        largest = float(np.einsum("a,b,c,abc->", *powers, drift))
        return max(0, math.ceil(math.log2(max(4 * time * largest, 1e-9))))


def transition(drift: Value, intensity: Value, time: float, doublings: int) -> tuple[Value, Value]:
    """(phi, spread): x(time) is phi x(0) plus noise of covariance spread."""
    part, one, zero = time / 2**doublings, np.eye(drift.shape[0]), double(np.zeros(drift.shape))
    slow, step = drift * part, intensity * part

    def add_term(now: list[Value], order: list[Value]) -> tuple[list[Value], list[Value]]:
        phi, term, spread, gain = now
        term = term @ slow / order[0]
        grown = slow @ gain
        return [phi + term, term, spread + gain, (grown + grown.transposed) / (order[0] + 1.0)], []

    def double_time(now: list[Value], _: list[Value]) -> tuple[list[Value], list[Value]]:
        phi, spread = now
        return [phi @ phi, spread + phi @ spread @ phi.transposed], []

    (phi, _, spread, _), _ = scan(add_term, [double(one), double(one), zero, step], [double(np.arange(1.0, TERMS))])
    if doublings:
        (phi, spread), _ = scan(double_time, [phi, spread], [], doublings)
    return phi, spread


def in_force(known: KalmanFilter, command: Value, memory: Memory) -> tuple[Value, Value, Value]:
    """The damping in force in a control interval after a command, by `roadgym.actuation`.

    Returns:
        That at its beginning, the means of its parts, shape (parts,), and that at its end.
    """
    task, part = known.task, known.interval / known.parts
    numbers = task.valve.numbers(task.control_interval, task.car.natural_frequency)
    low, high = task.damping_range
    late, share = int(numbers["valve_late"]), float(numbers["valve_part"])
    told = clip(command.of_kind("double"), low, high)
    if numbers["valve_levels"]:
        step = (high - low) / (numbers["valve_levels"] - 1)
        told = elementwise("rint", (told - low) / step) * step + low
    line = concat([told, memory.recall("commands", double(np.full(late + 1, low)))])
    memory.kept["commands"] = line[range(late + 1)]
    newer, older = line[late], line[late + 1]
    if known.parts == 1:
        return older, newer.reshape(1), newer
    rise, fall = (max(float(numbers[f"valve_{name}"]), INSTANT * part) for name in ("rise", "fall"))
    follow = _Follower(float(numbers["valve_rate"]), rise, fall)

    def through(now: list[Value], number: list[Value]) -> tuple[list[Value], list[Value]]:
        value, target = now
        until, early = double(0.0), double(0.0)
        if share:
            until = clip(share * known.parts - number[0], 0.0, 1.0) * part
            value, target, early = follow.driven(value, target, older, until)
        value, target, area = follow.driven(value, target, newer, part - until)
        return [clip(value, low, high), target], [clip((early + area) / part, low, high)]

    start = [memory.recall(name, double(low)) for name in ("in_force", "target")]
    (value, target), (means,) = scan(through, start, [double(np.arange(known.parts))] if share else [], known.parts)
    memory.kept |= {"in_force": value, "target": target}
    return start[0], means, value


@dataclasses.dataclass(frozen=True)
class _Follower:
    """The lag and the limited rate of a valve; no time constant is zero."""

    rate: float
    rise: float
    fall: float

    def driven(self, value: Value, target: Value, level: Value, time: Value) -> tuple[Value, Value, Value]:
        """D and its target after a time at a constant level, and the integral of D."""
        area = double(0.0)
        if self.rate < math.inf:
            far = level - target
            ramp = least(elementwise("abs", far) / self.rate, time)
            slope = where(far > 0.0, double(self.rate), -self.rate)
            value, area = self.followed(value, target, slope, ramp)
            target = where(time > ramp, level, target + slope * ramp)
            time = time - ramp
        else:
            target = where(time > 0.0, level, target)
        value, rest = self.lagged(value, target, double(0.0), time, self.constant(target - value))
        return value, target, area + rest

    def constant(self, gap: Value) -> Value:
        """The time constant towards a target that is ``gap`` above."""
        return where(gap > 0.0, double(self.rise), self.fall)

    def followed(self, value: Value, target: Value, slope: Value, time: Value) -> tuple[Value, Value]:
        """What follows ``target + slope t``, which may come back and meet it once, after a time, and its integral."""
        gap = target - value
        constant = self.constant(where(elementwise("abs", gap) > 0.0, gap, slope))
        meets = constant * elementwise("log", 1.0 - gap / (slope * constant))
        first = where(gap * slope * -1.0 > 0.0, least(meets, time), time)
        value, area = self.lagged(value, target, slope, first, constant)
        value, rest = self.lagged(value, target + slope * first, slope, time - first, self.constant(slope))
        return value, area + rest

    @staticmethod
    def lagged(value: Value, target: Value, slope: Value, time: Value, constant: Value) -> tuple[Value, Value]:
        """What follows ``target + slope t`` with a lag, after a time, and its integral."""
        left = elementwise("exp", time / constant * -1.0)
        line = target - slope * constant
        decays = line - value
        return line + slope * time - decays * left, (line + slope * time * 0.5) * time - decays * constant * (1.0 - left)


def _due(known: KalmanFilter, memory: Memory) -> Value:
    """Above zero for the sensors that tell a new sample."""
    count = len(known.noise)
    if not known.late.any() and np.all(known.period == 1):
        return double(np.ones(count))
    rest = memory.recall("wait", double(np.zeros(count))) - 1.0
    again = where(memory.begun, double(known.period), double(known.late + known.period))
    memory.kept["wait"] = where(rest > 0.5, rest, again)
    return where(rest > 0.5, double(np.zeros(count)), 1.0)


def _pull(known: KalmanFilter, phi: Value, late: Value, states: int) -> Value:
    """What the states are of those an interval before: car and road, biases, and what is measured and told later."""
    own, lags = phi.shape[0], known.late[known.late > 0].tolist()
    places = np.full((states, states), phi.size + late.size)  # of a zero
    places[:own, :own] = np.arange(phi.size).reshape(own, own)
    row = states - sum(lags)
    biases = range(own, row)
    places[biases, biases] += 1  # of a one
    for j, lag in enumerate(lags):
        places[row, :own] = phi.size + j * own + np.arange(own)
        places[range(row + 1, row + lag), range(row, row + lag - 1)] = phi.size + late.size + 1
        row += lag
    return concat([phi, late, double([0.0, 1.0])])[places]


def _corrected(
    mean: Value, covariance: Value, rows: Value, measured: Value, noise: FloatArray, due: Value
) -> tuple[Value, Value, Value]:
    """Mean and covariance after measurements y = row x + noise, and the logarithm of their density; no number tells nothing."""
    diagonal = np.arange(mean.size) * (mean.size + 1)

    def take_up(now: list[Value], one: list[Value]) -> tuple[list[Value], list[Value]]:
        mean, covariance, density = now
        row, y, variance, tells = one
        gain = row @ covariance
        own = covariance.reshape(-1)[diagonal]
        possible = variance + (row * row * where(own > 1e-9, own, 1e-9)).reduced("sum")
        error = y - (row * mean).reduced("sum")
        variance = variance + (row * gain).reduced("sum")
        sound = (variance > possible * KNOWN) & (double(FINITE) > elementwise("abs", error)) & (tells > 0.5)
        share = where(sound, error / variance, 0.0)
        away = where(sound, gain / variance, 0.0)
        density = density - where(sound, (error * share + elementwise("log", variance)) * 0.5, 0.0)
        return [mean + gain * share, covariance - gain.reshape(-1, 1) * away, density], []

    stacks = [rows, measured, double(noise), due]
    (mean, covariance, density), _ = scan(take_up, [mean, covariance, double(0.0)], stacks)
    return mean, covariance, density


def estimate(known: KalmanFilter, observation: Value, memory: Memory) -> Value:
    """What a Kalman filter tells, or a bank of them: the observation of its ``full`` task. It keeps what is commanded."""
    if any(name.startswith(OF_VALVE) for name in known.fields):
        raise AgentError("cannot export a bank of Kalman filters over valves that vary: vary the car alone")
    equations, low, step = Equations(known), known.task.damping_range[0], known.interval / known.parts
    own, states = (equations.coefficients[name].shape[-1] for name in ("drift", "start"))
    doublings = equations.doublings(step)
    begin, means, end = in_force(known, memory.recall("commanded", constant(low)), memory)
    measured = observation[known.columns].of_kind("double")
    due = _due(known, memory)
    names = known.full.signals
    moving = [name for name in names if name not in OPERATING_POINT]
    seen: dict[int, Value] = {}
    for k, (column, factor, ends) in enumerate(zip(known.seen, FACTORS, known.ranges[:2], strict=True)):
        if column is not None:
            share = observation[column].of_kind("double")
            seen[k] = clip(share / (1.0 - share) / factor, *ends)

    def follow(point: Value, car: Value, mean: Value, covariance: Value) -> tuple[Value, Value, Value, Value]:
        """Mean, covariance, what is told of them, and the density of what was measured."""

        def go_on(now: list[Value], damping: list[Value]) -> tuple[list[Value], list[Value]]:
            drift, intensity = (equations(name, damping[0], point, car) for name in ("drift", "intensity"))
            phi, spread = transition(drift, intensity, step, doublings)
            return [phi @ now[0], phi @ now[1] @ phi.transposed + spread], []

        (phi, spread), _ = scan(go_on, [double(np.eye(own)), double(np.zeros((own, own)))], [means])
        pull = _pull(known, phi, equations("late", begin, point, car), states)
        places = np.full((states, states), spread.size)
        places[:own, :own] = np.arange(own**2).reshape(own, own)
        moved = pull @ covariance @ pull.transposed + concat([spread, double(0.0)])[places]
        corner = np.arange(states)  # rounding must not make it less symmetric from step to step
        moved = moved.reshape(-1)[np.maximum.outer(corner, corner) * states + np.minimum.outer(corner, corner)]
        mean = where(memory.begun, mean @ pull.transposed, double(np.zeros(states)))
        covariance = where(memory.begun, moved, equations("start", double(low), point, car))
        mean, covariance, density = _corrected(mean, covariance, equations("rows", end, point, car), measured, known.noise, due)
        told = [mean[range(own)] @ equations("told", double(low), point, car).transposed]
        for name in names[len(moving) :]:
            x = point[OPERATING_POINT.index(name)] * FACTORS[OPERATING_POINT.index(name)]
            told.append(x / (x + 1.0))
        return mean, covariance, concat(told), density

    bank = len(known.bank)
    points = [concat([seen.get(k, double(x)) for k, x in enumerate(point)]) for point in known.bank[:, :2].tolist()]
    shapes = ((states,), (states, states))
    before = [double(np.zeros(shape if bank == 1 else (bank, *shape))) for shape in shapes]
    before = [memory.recall(name, x) for name, x in zip(("mean", "covariance"), before, strict=True)]
    if bank == 1:
        mean, covariance, told, _ = follow(points[0], double(0.0), *before)
    else:
        stacks = [concat(points).reshape(bank, 2), double(equations.car.reshape(-1)), *before]
        _, (mean, covariance, tolds, density) = scan(lambda _, one: ((), follow(*one)), [], stacks)
        weight = memory.recall("weight", double(np.full(bank, 1 / bank)))
        exponent = elementwise("log", weight) + density
        weight = elementwise("exp", exponent - exponent.reduced("max"))
        memory.kept["weight"] = weight = weight / weight.reduced("sum")
        told = weight @ tolds
    memory.kept |= {"mean": mean, "covariance": covariance}
    told = told.of_kind("float")
    return concat([clip(told[range(len(moving))], -SATURATION, SATURATION), told[range(len(moving), told.size)]])
