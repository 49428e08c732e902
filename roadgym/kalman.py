"""The Kalman filter of a car on a road: what its sensors tell of its state, and what its damper did.

At a given D road and car are linear, x' = A(D) x + noise (`roadgym.linear.LinearSystem`), so over a control interval T in which
D is held

    x(T) = Phi(D) x(0) + w,   Cov w = Q(D),   y = H(D) x(T) + v,   Cov v = R diagonal,

with the acceleration among y that of the D that was in force. Biases of sensors, which are constant in an episode, and what is
measured and not told yet are states as well; rounding to steps q counts as noise of variance q^2/12; and the commands tell what
was in force behind a valve. Mean and covariance of x given all that was measured follow by the filter of R. E. Kalman, "A new
approach to linear filtering and prediction problems", J. Basic Eng. 82, 1960; measurements are taken up one after the other. It
is exact where road and sensors are Gaussian, for every rule that sets D by what was measured. On the bounded road, whose second
moments are those of its linear twin, it is the best linear filter where D is set in advance.

Phi and Q are entire functions of D: each is kept as its Chebyshev series over the range of D, at the operating point of its
car itself. Where that is not told, or the car is not, as it varies (`roadgym.variation`), a bank of filters covers the range,
whose posterior weights are those of their innovations (D. T. Magill, "Optimal adaptive estimation of sampled stochastic
processes", IEEE Trans. Autom. Control 10, 1965).
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from .kalman_kernel import (
    advance_beliefs,
    fit_series,
    follow_valve,
    interval_steps,
    spread_rows,
    spread_start,
    take_up,
    tell,
    weigh,
)
from .linear import FloatArray, LinearSystem, Motion, ShapingFilter
from .parameters import ParameterError, whole
from .sensors import Sensor
from .task import OPERATING_POINT, Task, observed_states

DEGREES = (8, 12, 16, 24, 32, 48, 64, 96, 128)  # of the series, of which the first that is right to ACCURACY is taken
ACCURACY = 1e-12  # of the largest entry
IDEAL = Sensor(noise=0.0, bias=0.0, resolution=0.0, delay=0.0, interval=0.0)
HYPOTHESES = 5  # values of each number in a bank
LARGEST_BANK = 2500  # filters of a car

Rows = npt.NDArray[np.float32]
Starts = npt.NDArray[np.bool_]


@dataclasses.dataclass
class Model:
    """Road and car at some operating points, as filters take them.

    Attributes:
        series: Chebyshev coefficients of Phi and Q over the range of D, shape (points, degree + 1, 2 n^2).
        rows: H at D = 0, and its derivative, shape (points, 2, measured, states).
        delayed: rows of the signals that are told late, likewise, in terms of car and road, shape (points, 2, signals, n).
        start: covariance at the start of an episode, shape (points, states, states).
        told: what is told of car and road, as rows of them, shape (points, names, n).
    """

    series: FloatArray
    rows: FloatArray
    delayed: FloatArray
    start: FloatArray
    told: FloatArray

    @classmethod
    def of(cls, parts: Sequence[Model], order: Sequence[int] | npt.NDArray[np.int64]) -> Model:
        """The points of some models one after the other, of which these are taken in this ``order``."""
        names = [field.name for field in dataclasses.fields(cls)]
        return cls(**{name: np.concatenate([getattr(part, name) for part in parts])[order] for name in names})


@dataclasses.dataclass
class Belief:
    """What is known of ``n`` cars, each of which has one filter, or a bank of ``b``.

    Attributes:
        point: frequency ratio, bandwidth and the fields that vary, of each filter, shape (n, b, 2 + fields).
        weight: posterior weight of each, shape (n, b).
        mean, covariance: of the states of car, road and sensors, shape (n b, states) and (n b, states, states).
        valve: D in force, which comes first, and all else that the valve of each filter keeps, shape (n b, rows).
        numbers: of the valve of each filter, as `roadgym.kalman_kernel.follow_valve` takes them, shape (n b, 6).
        time: control intervals since the episode began, shape (n,).
        model: of the filters, and in ``place`` where they have it.
        surprise: innovations of the last measurements over their deviations, and these, shape (2, n b, measured).
    """

    point: FloatArray
    weight: FloatArray
    mean: FloatArray
    covariance: FloatArray
    valve: FloatArray
    numbers: FloatArray
    time: npt.NDArray[np.int64]
    model: Model
    place: npt.NDArray[np.int64]
    surprise: FloatArray


def check_linear(task: Task) -> ShapingFilter:
    """The road of a plant that a Kalman filter knows, as a filter of white noise.

    Raises:
        ParameterError: another plant.
    """
    road = task.road.shaping_filter()
    if road is None or not road.noise.size or task.speed_noise is not None:
        noise = "" if task.speed_noise is None else f" under {task.speed_noise.kind} speed noise"
        raise ParameterError(
            "a Kalman filter needs a road that is a linear filter of white noise, at a constant speed; "
            f"got a {task.road.kind} road{noise}"
        )
    return road


class KalmanFilter:
    """Filters for what is measured on a task: its observation, through its sensors.

    Args:
        task: the task; signals of its observation but for the operating point are measured. Where it observes the operating
            point, or that is fixed, it is known, else a bank covers its range, in which it is drawn uniformly, as it does those
            of all that varies of car and valve.
        hypotheses: values of the speed, of the bandwidth and of each field that varies, in such a bank: the middles of as many
            equal parts of its range, and all combinations of them.

    Attributes:
        task: as it was given.
        full: the same task observed in full, which is what the filter tells: the states of the car, level and slope, and the
            operating point.
        measured, columns: names of the signals that are measured, and where they are in an observation.
        noise: variance of each of them.
        late, period: control intervals after which a sample is told, and from one to the next, of each.
        fields: names of what varies of car and valve.
        ranges: of frequency ratio, bandwidth and these.
        seen: where frequency ratio and bandwidth are in an observation, or None.
        bank: points of the filters of each car, shape (b, 2 + fields), but for what is seen.
        parts: of a control interval, in each of which D is held.

    Raises:
        ParameterError: a plant that is not linear, no measured signal, a range of D over which the series do not settle, or a
            bank of more than `LARGEST_BANK` filters.
    """

    def __init__(self, task: Task, hypotheses: int = HYPOTHESES) -> None:
        check_linear(task)
        self.task = task
        self.measured = tuple(name for name in task.signals if name not in OPERATING_POINT)
        if not self.measured:
            raise ParameterError(f"a Kalman filter needs a signal to be measured; the task observes {', '.join(task.signals)}")
        self.full = dataclasses.replace(task, signals=observed_states(task), sensors=None)
        count = whole("hypotheses", hypotheses, of="hypotheses")
        self._weighted = any(name in task.car.motion.filters for name in self.measured)
        self.columns = [task.signals.index(name) for name in self.measured]
        sensors = [task.real_sensors.get(name, IDEAL) for name in self.measured]
        self.noise = np.array([sensor.noise**2 + sensor.resolution**2 / 12 for sensor in sensors])
        self.late = np.array([self._intervals("delay", sensor.delay) for sensor in sensors])
        self.period = np.array([self._intervals("interval", sensor.interval) or 1 for sensor in sensors])
        self._biases = np.array([sensor.bias for sensor in sensors])
        low, high = task.damping_range
        self._middle, self._half = (low + high) / 2, (high - low) / 2
        ratios = tuple(task.frequency_ratio(speed) for speed in task.speed)
        varied = () if task.vary is None else task.vary.ranges
        self.fields = tuple(name for name, _, _ in varied)
        self.ranges = (ratios, task.bandwidth, *((low, high) for _, low, high in varied))
        self.parts = 1 if task.holds_damping else task.substeps
        self.seen = [task.signals.index(name) if name in task.signals else None for name in OPERATING_POINT]
        hidden = [a < b and seen is None for seen, (a, b) in zip([*self.seen, *[None] * len(varied)], self.ranges, strict=True)]
        if count ** sum(hidden) > LARGEST_BANK:
            names = ", ".join(itertools.compress((*OPERATING_POINT, *self.fields), hidden))
            raise ParameterError(f"hypotheses of {names} must make at most {LARGEST_BANK} filters, got {count} of each")
        shares = [
            (a + (b - a) * (np.arange(count) + 0.5) / count).tolist() if many else [(a + b) / 2]
            for many, (a, b) in zip(hidden, self.ranges, strict=True)
        ]
        self.bank = np.array(list(itertools.product(*shares)))
        slowest = task.valve if task.vary is None else task.vary.slowest_valve
        self._kept = 4 + int(slowest.numbers(task.control_interval, task.car.natural_frequency)["valve_late"])
        self._numbers = np.array([self._drawn(point)[1] for point in self.bank])
        self._degree = self._needed_degree()
        self._shared = None if any(seen is not None for seen in self.seen) else self.model(self.bank)

    def _intervals(self, what: str, time: float) -> int:
        """A time of a sensor in control intervals, of which it must be a whole number."""
        number = time / self.task.control_interval
        if abs(number - round(number)) > 1e-6:
            whole_ones = f"whole control intervals, {self.task.control_interval:g} s,"
            raise ParameterError(f"{what} of sensors must be {whole_ones} for a Kalman filter, got {time:g}")
        return round(number)

    def _nodes(self, degree: int) -> FloatArray:
        """Chebyshev's points."""
        return np.asarray(np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1)))

    def _drawn(self, point: FloatArray) -> tuple[Motion, list[float]]:
        """The equations of the car at a point, in terms of the nominal one, and what `follow_valve` knows of its valve."""
        task, values = self.task, point[2:].tolist()
        valve = task.valve if task.vary is None else task.vary.drawn(values)[1]
        motion = task.car.motion if task.vary is None else task.vary.motion(values)
        numbers = valve.numbers(task.control_interval, task.car.natural_frequency)
        of_valve = [float(numbers[f"valve_{name}"]) for name in ("late", "part", "levels", "rate", "rise", "fall")]
        return motion if self._weighted else motion.own, of_valve

    @staticmethod
    def _of_each_car(points: FloatArray) -> list[npt.NDArray[np.int64]]:
        """Which of the points, shape (points, 2 + fields), are of the same car."""
        _, car = np.unique(points[:, 2:], axis=0, return_inverse=True)
        return [np.flatnonzero(car.reshape(-1) == k) for k in range(car.max() + 1)]

    def system(self, points: FloatArray, damping: FloatArray) -> LinearSystem:
        """Road and car at points of one car, shape (points, 1 or as many as there are dampings)."""
        ratio, bandwidth = points[:, 0, None], points[:, 1, None]
        road = self.task.road.shaping_filter(bandwidth if self.task.bandwidth[1] > 0 else None)
        assert road is not None  # as `check_linear` has seen
        return LinearSystem.of(road, self._drawn(points[0])[0], damping=damping, ratio=ratio)

    def _steps(self, points: FloatArray, damping: FloatArray, time: float) -> FloatArray:
        """Phi and Q over ``time``, shape (points, dampings, 2, n, n)."""
        system = self.system(points, damping)
        size = len(system.states)
        shape = (len(points), len(damping), size)
        drift = np.ascontiguousarray(np.broadcast_to(system.drift, (*shape, size))).reshape(-1, size, size)
        noise = np.ascontiguousarray(np.broadcast_to(system.noise, (*shape, system.noise.shape[-1])))
        steps = np.empty((len(drift), 2, size, size))
        interval_steps(drift, noise.reshape(*drift.shape[:2], -1), time, steps)
        return steps.reshape(*shape[:2], 2, size, size)

    @property
    def interval(self) -> float:
        """The control interval in units of 1/w1."""
        return self.task.control_interval * self.task.car.natural_frequency

    def _series(self, points: FloatArray, degree: int) -> FloatArray:
        """Coefficients of Phi and Q, shape (points, degree + 1, 2 n^2)."""
        nodes = self._nodes(degree)
        values = self._steps(points, self._middle + self._half * nodes, self.interval / self.parts)
        fit = np.linalg.inv(np.polynomial.chebyshev.chebvander(nodes, degree))
        series = np.empty((len(points), degree + 1, values[0, 0].size))
        fit_series(fit, values.reshape(series.shape), series)
        return series

    def _needed_degree(self) -> int:
        """That at which the series are right at the corners of all ranges."""
        corners = np.array(list(itertools.product(*(dict.fromkeys(ends) for ends in self.ranges))))
        between, time = np.linspace(-1, 1, 7), self.interval / self.parts
        cars = [corners[rows] for rows in self._of_each_car(corners)]
        known = [self._steps(points, self._middle + self._half * between, time) for points in cars]

        def right(degree: int, points: FloatArray, steps: FloatArray) -> bool:
            found = np.polynomial.chebyshev.chebvander(between, degree) @ self._series(points, degree)
            error = np.abs(found.reshape(steps.shape) - steps).max(axis=(0, 1, 3, 4))
            return bool(np.all(error <= ACCURACY * np.abs(steps).max(axis=(0, 1, 3, 4))))

        for degree in DEGREES:
            if all(right(degree, *each) for each in zip(cars, known, strict=True)):
                return degree
        low, high = self.task.damping_range
        raise ParameterError(
            f"damping_range must be narrower for a Kalman filter at this control_interval, got ({low:g}, {high:g})"
        )

    def model(self, points: FloatArray) -> Model:
        """Road and car at points (frequency ratio, bandwidth or 0, fields), shape (points, 2 + fields)."""
        cars = self._of_each_car(points)
        return Model.of([self._model(points[rows]) for rows in cars], np.argsort(np.concatenate(cars)))

    def _model(self, points: FloatArray) -> Model:
        """The same at points of one car."""
        task, still = self.task, self.system(points, np.zeros(1))
        unit = self.system(points, np.ones(1))
        cars, size, count = still.car_states, len(still.states), len(points)
        road = task.road.shaping_filter(points[:, 1] if task.bandwidth[1] > 0 else None)
        assert road is not None
        level, slope = np.zeros((count, size)), np.zeros((count, size))
        level[:, cars:], slope[:, cars:] = road.level, road.level @ road.drift

        def row(system: LinearSystem, name: str) -> FloatArray:
            known = {"level": level, "slope": slope}
            return known[name] if name in known else np.broadcast_to(system.signals[name], (count, 1, size))[:, 0]

        def both(names: Sequence[str]) -> FloatArray:
            """H(0) and dH/dD, shape (points, 2, names, n)."""
            found = [[row(system, name) for name in names] for system in (still, unit)]
            rows = np.moveaxis(np.array(found).reshape(2, len(names), count, size), 2, 0)
            rows[:, 1] -= rows[:, 0]
            return rows

        names = [name for name in self.full.signals if name not in OPERATING_POINT]
        rise = np.concatenate([still.heights * task.car.starts_on_road, np.eye(size - cars)])
        law = rise @ still.road_covariance @ rise.T
        start = np.repeat(law[None], count, axis=0)
        warm = round(task.warm_up / task.control_interval) * self.interval
        if warm:
            spread_start(self._steps(points, np.array([task.warm_up_damping]), warm)[:, 0], law, start)
        delayed = both([name for name, late in zip(self.measured, self.late, strict=True) if late])
        lags, biased = self._lags, np.flatnonzero(self._biases)
        states, chain = size + len(biased) + lags.sum(), size + len(biased)
        rows = np.zeros((count, 2, len(self.measured), states))
        rows[..., :size] = both(self.measured)
        rows[:, 0, biased, size + np.arange(len(biased))] = 1
        at_once = np.zeros((count, lags.sum(), size))  # before it is told what was, the value at the start is
        for j, last in zip(np.flatnonzero(self.late), np.cumsum(lags), strict=True):
            at_once[:, last - self.late[j] : last] = (rows[:, :1] + task.damping_range[0] * rows[:, 1:])[:, 0, j, None, :size]
            rows[:, :, j, :size] = 0
            rows[:, 0, j, chain + last - 1] = 1
        whole_start = np.zeros((count, states, states))
        spread_rows(at_once, start, self._biases[biased] ** 2, whole_start)
        return Model(
            series=self._series(points, self._degree),
            rows=rows,
            delayed=delayed,
            start=whole_start,
            told=np.stack([row(still, name) for name in names], axis=1),
        )

    @property
    def _lags(self) -> npt.NDArray[np.int64]:
        """Those of the signals that are told late."""
        return self.late[self.late > 0]

    def _points(self, observations: Rows) -> FloatArray:
        """The points of the filters of each car, shape (n, b, 2 + fields), from observations."""
        points = np.repeat(self.bank[None], len(observations), axis=0)
        for k, (seen, factor) in enumerate(zip(self.seen, (1.0, 2.0), strict=True)):
            if seen is not None:
                share = observations[:, seen].astype(float)
                points[:, :, k] = np.clip(share / (1 - share) / factor, *self.ranges[k])[:, None]
        return points

    def begin(self, observations: npt.ArrayLike, known: FloatArray | None = None) -> Belief:
        """What is known at the start of an episode, from its first observations, shape (n, signals), made at D_min.

        Where frequency ratio, bandwidth and what varies are ``known``, shape (n, 2 + fields), each car has one filter, of them.
        """
        seen = np.asarray(observations, np.float32)
        points = self._points(seen) if known is None else known[:, None]
        numbers = self._numbers if known is None else np.array([self._drawn(point)[1] for point in known])
        cars, bank = points.shape[:2]
        if self._shared is None or known is not None:
            distinct, place = np.unique(points.reshape(cars * bank, -1), axis=0, return_inverse=True)
            model, place = self.model(distinct), place.reshape(-1).astype(np.int64)
        else:
            model, place = self._shared, np.tile(np.arange(bank), cars)
        belief = Belief(
            point=points,
            weight=np.full((cars, bank), 1 / bank),
            mean=np.zeros((cars * bank, model.start.shape[-1])),
            covariance=model.start[place],
            valve=np.full((cars * bank, self._kept), self.task.damping_range[0]),
            numbers=np.tile(numbers, (cars * bank // len(numbers), 1)),
            time=np.zeros(cars, np.int64),
            model=model,
            place=place,
            surprise=np.zeros((2, cars * bank, len(self.measured))),
        )
        return self._measured(belief, seen)

    def advance(self, belief: Belief, damping: npt.ArrayLike, observations: npt.ArrayLike) -> Belief:
        """What is known after one more control interval.

        Args:
            belief: what was known before it; it is left as it is.
            damping: D that was commanded for it, shape (n,); range and valve make of it what is in force.
            observations: at its end, shape (n, signals).
        """
        names = ("weight", "mean", "covariance", "valve")
        moved = dataclasses.replace(belief, **{name: getattr(belief, name).copy() for name in names}, time=belief.time + 1)
        means, part = np.empty((len(belief.mean), self.parts)), self.interval / self.parts
        commands = np.clip(np.asarray(damping, float), *self.task.damping_range)
        follow_valve(belief.numbers, self.task.damping_range, part, commands, moved.valve, means)
        known = belief.model.series, belief.model.delayed, self._lags, belief.place
        advance_beliefs(*known, belief.valve[:, 0], means, self._middle, self._half, moved.mean, moved.covariance)
        return self._measured(moved, np.asarray(observations, np.float32))

    def _measured(self, belief: Belief, observations: Rows) -> Belief:
        """The belief, which is new, after what was measured; the weights of a bank are those of its innovations."""
        cars, bank = belief.weight.shape
        belief.surprise = np.empty((2, cars * bank, len(self.measured)))
        known = belief.model.rows, belief.place, belief.valve[:, 0], self.noise, self.late, self.period, belief.time
        measured = np.ascontiguousarray(observations[:, self.columns])
        take_up(*known, measured, belief.mean, belief.covariance, belief.surprise)
        if bank > 1:
            weigh(belief.surprise, belief.weight)
        return belief

    def restarted(self, belief: Belief, starts: Starts, observations: npt.ArrayLike, known: FloatArray | None = None) -> Belief:
        """The belief, in which the cars that ``starts`` names, shape (n,), begin an episode as `begin` has it."""
        seen = np.asarray(observations, np.float32)
        if starts.all():
            return self.begin(seen, known)
        fresh = self.begin(seen[starts], None if known is None else known[starts])
        own = np.repeat(starts, belief.weight.shape[1])
        result = dataclasses.replace(belief)
        of_cars, of_filters = ("point", "weight", "time"), ("mean", "covariance", "valve", "numbers")
        for name, where in (dict.fromkeys(of_cars, starts) | dict.fromkeys(of_filters, own)).items():
            setattr(result, name, getattr(belief, name).copy())
            getattr(result, name)[where] = getattr(fresh, name)
        result.surprise = belief.surprise.copy()
        result.surprise[:, own] = fresh.surprise
        if fresh.model is not belief.model:
            result.place = belief.place.copy()
            kept, place = np.unique(belief.place[~own], return_inverse=True)
            result.place[~own], result.place[own] = place.reshape(-1), fresh.place + len(kept)
            order = np.append(kept, len(belief.model.series) + np.arange(len(fresh.model.series)))
            result.model = Model.of([belief.model, fresh.model], order)
        return result

    def observation(self, belief: Belief) -> Rows:
        """The means of what `full` observes, in its units, shape (n, signals)."""
        return self._told(belief)[0]

    def deviations(self, belief: Belief) -> Rows:
        """Their standard deviations, given all that was measured, shape (n, signals)."""
        return self._told(belief)[1]

    def likeliest(self, belief: Belief) -> Rows:
        """The operating point of the most probable filter of each car, as it is observed, shape (n, 1 or 2)."""
        best = np.take_along_axis(belief.point, np.argmax(belief.weight, axis=1)[:, None, None], axis=1)[:, 0]
        found = best[:, :2] * [1, 2] / (1 + best[:, :2] * [1, 2])
        return found[:, [name in self.full.signals for name in OPERATING_POINT]].astype(np.float32)

    def varied(self, belief: Belief) -> dict[str, FloatArray]:
        """Mean and standard deviation of each field that varies, given all that was measured, shape (2, n) by name."""
        means = np.einsum("nb,nbf->nf", belief.weight, belief.point[..., 2:])
        squares = np.einsum("nb,nbf->nf", belief.weight, (belief.point[..., 2:] - means[:, None]) ** 2)
        return {name: np.stack([means[:, k], np.sqrt(squares[:, k])]) for k, name in enumerate(self.fields)}

    def _told(self, belief: Belief) -> tuple[Rows, Rows]:
        """Means and standard deviations."""
        names, cars = self.full.signals, len(belief.weight)
        moving = [name for name in names if name not in OPERATING_POINT]
        means, squares = np.empty((2, cars, len(names)))
        states, powers = np.empty((2, cars, len(moving)))
        tell(belief.model.told, belief.place, belief.weight, belief.mean, belief.covariance, states, powers)
        found = [names.index(name) for name in moving]
        means[:, found], squares[:, found] = states, powers
        for k, (name, factor) in enumerate(zip(OPERATING_POINT, (1.0, 2.0), strict=True)):
            if name in names:
                share = factor * belief.point[:, :, k] / (1 + factor * belief.point[:, :, k])
                means[:, names.index(name)] = np.cumsum(belief.weight * share, axis=1)[:, -1]
                squares[:, names.index(name)] = np.cumsum(belief.weight * share**2, axis=1)[:, -1]
        space, deviations = self.full.observation_space, np.sqrt(np.maximum(squares - means**2, 0.0))
        return np.clip(means.astype(np.float32), space.low, space.high), deviations.astype(np.float32)
