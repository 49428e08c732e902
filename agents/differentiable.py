"""The plant as torch sees it: what a policy does to the car over roads that were driven, and what it costs, with gradients.

The road does not heed the car, and what the car does of it is known (`analysis.interval`). So a drive that was recorded can be
driven again with another policy, over the same road and with the same noise, and the costs be differentiated through every
interval: the gradient along the path of that noise, whose mean is that of the mean cost. What the interval's model leaves out,
the path of the road between the ends of intervals, is what it was in the recorded drive.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from analysis.quadratic import active_force, has_quadratic_value, plant_system, value_form
from roadgym.installation import needs
from roadgym.linear import LinearSystem
from roadgym.parameters import ParameterError
from roadgym.roads import FirstOrderRoad, GaussianRoad
from roadgym.task import OPERATING_POINT, Task

from .advantage import ROAD_STATES, is_differentiable
from .differentiable_car import Cars
from .differentiable_filter import DrivenFilter, Filtering, Following, single
from .differentiable_valve import DrivenValve
from .features import Features, Sight

with needs("train"):
    import torch
    from torch import Tensor

CHOICES = 9  # constant dampings of which one is nearly the best
ACTIVE = 0.5  # share of the value of an active force in that of the end of a stretch
LIKENESS = 0.1  # bandwidth of the road whose value stands in for that of a road that theory has none for
# Answers beyond FARTHEST, before the hyperbolic tangent, are an end of the range to a thousandth. There the gradient fades, and
# steps of a fixed size would run away with a policy that is all at one end, so each costs BEYOND for what it is farther out.
FARTHEST, BEYOND = 4.0, 1e-4


class DrivenRoads:
    """Drives of a batch, by which gradients are worked out.

    Args:
        task: the plant.
        sight: what the policy sees of it.
        num_envs: cars of the batch.
        steps: control intervals that are recorded.
        estimator: the layer of the batch that makes of its observations what ``sight`` is of; None where there is none.

    Attributes:
        late: whole intervals that a command may wait.

    Raises:
        ParameterError: a stack of observations, a valve of limited rate, sensors that are not ideal without an estimator, or,
            with one, any valve that is not ideal, and sensors with biases, delays or intervals.
    """

    def __init__(self, task: Task, sight: Sight, num_envs: int, steps: int, estimator: Filtering | None = None) -> None:
        if not is_differentiable(task, None if estimator is None else "kalman"):
            needed = "sensors must be ideal and the rate of the valve unlimited"
            if estimator is not None:
                needed = "sensors must be ideal but for noise and resolution, and the valve ideal,"
            raise ParameterError(f"{needed} for a gradient through the plant: choose another algorithm")
        if sight.frame_stack > 1:
            raise ParameterError(f"frame_stack must be 1 for a gradient through the plant, got {sight.frame_stack}")
        full = task if estimator is None else estimator.filter.full
        self._task, self._shown, self._steps, self._states = task, full, steps, len(task.car.motion.states)
        self._duration = task.control_interval * task.car.natural_frequency
        self._drawn: npt.NDArray[np.float64] | None = None
        self._cars: list[Cars] = []  # before each step
        self._filter = None if estimator is None else DrivenFilter(estimator, num_envs, steps)
        self._valve = None if task.ideal_valve else DrivenValve(task, num_envs, steps)
        self.late = 0 if self._valve is None else self._valve.late
        self._names = full.signals
        self._features = sight.features
        self._combined = None if sight.features is None else Seen(sight.features, len(self._names))
        self._noted = np.empty((steps + 1, num_envs, self._states + 5))
        self._seen = np.empty((steps, num_envs, *sight.space.shape), np.float32)
        self._places = np.empty((steps, num_envs), np.float32)
        self._ended = np.zeros(steps, np.bool_)
        self._looks: dict[bytes, Look] = {}  # by operating points; those of the last visit's last episode are kept

    def note(
        self, step: int, state: npt.NDArray[np.float64], rate: npt.NDArray[np.float64], drawn: npt.NDArray[np.float64]
    ) -> None:
        """Record where a step begins, and after the last one where it ends.

        Args:
            step: its number.
            state: as of `roadgym.vector.QuarterCarVectorEnv.state`.
            rate: of the angle of the road now, over w1, shape (num_envs,).
            drawn: what varies from car to car, as in `roadgym.plant.Plant.drawn_now`.
        """
        self._noted[step] = np.column_stack([state, rate])
        if drawn is not self._drawn:
            self._drawn, self._now = drawn, Cars.of(self._task, self._shown, drawn)
        self._cars[step:] = [self._now]
        if self._filter is not None:
            self._filter.note(step)
        if self._valve is not None:
            self._valve.meet(drawn)

    def answer(
        self, step: int, seen: npt.NDArray[np.float32], action: npt.NDArray[np.float32], ended: npt.NDArray[np.bool_]
    ) -> None:
        """Record what was seen before a step, what was answered, shape (num_envs, 1), and whose episodes ended with it."""
        commands = torch.from_numpy(action[:, 0])
        place = commands if self._valve is None else self._valve.note(step, commands, ended)
        self._seen[step], self._places[step], self._ended[step] = seen, place, ended.any()

    def finish(self) -> None:
        """Work out what the road did, after the last note."""
        begun_at = self._points(0).tobytes()
        self._looks = {points: look for points, look in self._looks.items() if points == begun_at}
        noted = single(self._noted)
        self._car, self._road = noted[..., : self._states], noted[..., self._states : self._states + 2]
        self._path = torch.stack([self._road[..., 0], self._road[..., 1] * noted[..., -1]], -1)  # the level and its rate
        ends = self._path if self._cars[0].smooth else self._path[..., :1]
        self._ends = torch.cat([ends[:-1], ends[1:]], -1)
        begun = [step for step in range(1, self._steps) if self._cars[step] is not self._cars[step - 1]]
        found = [self._worked_out(slice(*span)) for span in itertools.pairwise([0, *begun, self._steps])]
        self._forced, self._given, self._told, measured = map(torch.cat, zip(*found, strict=True))
        if self._filter is not None:
            self._filter.finish(measured[..., self._filter.columns])

    def _worked_out(self, steps: slice) -> tuple[Tensor, ...]:
        """What the road did in steps with the same cars: to states, to signals after them, and what was measured."""
        cars, after = self._cars[steps.start], slice(steps.start + 1, steps.stop + 1)
        place = torch.from_numpy(self._places[steps])
        forced = cars.forced(self._ends[steps])
        forced[..., : self._states] += self._car[after] - cars.moved(self._car[steps], forced, place)
        given, told = (each.from_road(self._path[after], self._road[after]) for each in (cars.sensing, cars.measuring))
        return forced, given, told, cars.measuring(self._car[after], place, told)

    def windows(self, longest: int) -> tuple[npt.NDArray[np.intp], int]:
        """(first steps, length) of stretches in which no episode ends, for `cost`; as long as ``longest`` if possible."""
        left, reach = 0, np.empty(self._steps, np.intp)
        for step in range(self._steps - 1, -1, -1):
            left = 0 if self._ended[step] else left + 1
            reach[step] = left
        length = max(1, min(longest, int(reach.max())))
        return np.flatnonzero(reach >= length), length

    def cost(self, policy: torch.nn.Module, start: int, length: int, noise: float, state_known: bool = False) -> Tensor:
        """What a policy costs from ``start`` on: over ``length`` intervals, and for ever after by `values`.

        It is the mean over all cars, in shares of the best constant damping's cost, and per time. Answers far beyond the ends
        of the range cost a little more.

        Args:
            policy: takes what is seen, shape (n, size), to numbers, shape (n, 1), whose hyperbolic tangent is the place of D in
                its range.
            start: one of `windows`.
            length: number of intervals.
            noise: standard deviation of normal noise on the policy's answers.
            state_known: where there is an estimator, does the policy see the state itself, from the second interval on?
        """
        look, cars, car, seen = self._look(start), self._cars[start], self._car[start], torch.from_numpy(self._seen[start])
        follow = None if self._filter is None or state_known else self._filter.begin(start)
        valve = None if self._valve is None else self._valve.begin(start)
        held = torch.zeros(len(car))
        noises, answers, states, places = noise * torch.randn(length, len(car)), [], [], []
        for n, step in enumerate(range(start, start + length)):
            answer = policy(seen if step == start else self._sees(look, car, held, step, follow))[:, 0]
            answers.append(answer)
            place = held = torch.tanh(answer + noises[n])
            if self._valve is not None and valve is not None:
                place, valve = self._valve(valve, place)
                held = valve[:, 0]
            states.append(car)
            places.append(place)
            car = cars.moved(car, self._forced[step], place)
        # of all intervals at once
        total = cars.cost(torch.stack(states), self._ends[start : start + length], torch.stack(places)).sum(0)
        state = torch.cat([car, self._road[start + length]], 1)[:, : look.value.shape[1]]
        after = (state * (look.value @ state[:, :, None])[:, :, 0]).sum(1)
        mean = ((total * self._duration + after) / look.reference).mean() / (length * self._duration)
        return mean + BEYOND * (torch.stack(answers).abs() - FARTHEST).relu().mean()

    def _sees(self, look: Look, car: Tensor, place: Tensor, step: int, follow: Following | None) -> Tensor:
        """What the policy sees before a step, after an interval with a damping in ``place`` at its end."""
        cars = self._cars[step]
        if self._filter is None or follow is None:
            told = cars.sensing(car, place, self._given[step - 1])
        else:
            told = follow(step, place, cars.measuring(car, place, self._told[step - 1])[:, self._filter.columns])
        observed = told + look.shares
        return observed if self._combined is None else self._combined(observed, look.forms)

    def _points(self, step: int) -> npt.NDArray[np.float64]:
        """Operating points (nu, delta) of all cars in a step, shape (n, 2)."""
        return self._noted[step, :, self._states + 2 : self._states + 4]

    def _look(self, step: int) -> Look:
        """What the operating points in a step say, worked out once an episode."""
        points, names = self._points(step), self._names
        key = points.tobytes()
        if key in self._looks:
            return self._looks[key]
        value, reference = (single(part) for part in values(self._task, points))
        shares = points * [1, 2] / (1 + points * [1, 2])
        observed = np.zeros((len(points), len(names)), np.float32)
        for name, share in zip(OPERATING_POINT, shares.T, strict=True):
            if name in names:
                observed[:, names.index(name)] = share
        lookahead = None if self._features is None else self._features.lookahead
        forms = np.empty((len(points), 0)) if lookahead is None else lookahead.forms(observed[:, lookahead.point])
        shown = single(forms) if self._combined is None else self._combined.of_pairs(single(forms))
        self._looks[key] = Look(value, reference, single(observed), shown)
        return self._looks[key]


class Look(NamedTuple):
    """What operating points say, one a car.

    Attributes:
        value, reference: as of `values`.
        shares: what is observed of the points, the other signals 0; shape (n, signals).
        forms: of the lookahead, if there is one, as of `Seen.of_pairs`.
    """

    value: Tensor
    reference: Tensor
    shares: Tensor
    forms: Tensor


class Seen:
    """`agents.features.Features` in torch, of observations, shape (n, signals).

    Columns are picked by a product with a matrix, whose gradient is quicker than those of indices.
    """

    def __init__(self, features: Features, signals: int) -> None:
        self._features, state = features, np.array(features.state, np.intp)
        self._paired = features.products or features.lookahead is not None
        pairs = list(zip(features.first.tolist(), features.second.tolist(), strict=True)) if self._paired else []
        shown = [*features.point, *(features.state if features.signals else ())]
        columns = [*shown, *(state[i] for i, _ in pairs), *(state[j] for _, j in pairs)]
        self._sizes = [len(shown), len(pairs), len(pairs)]
        sizes, shift = np.ones(len(columns)), np.zeros(len(columns))
        sizes[: len(features.point)], shift[: len(features.point)] = 4, -2
        self._picked, self._shift = single(np.eye(signals)[:, columns] * sizes), single(shift)
        self._same = single(np.array([[float(i == j)] for i, j in pairs]))
        if features.lookahead is not None:
            places = np.searchsorted(state, features.lookahead.columns)
            of = [places[part].tolist() for part in (features.lookahead.first, features.lookahead.second)]
            monomials = [pairs.index((min(pair), max(pair))) for pair in zip(*of, strict=True)]
            self._monomials = single(np.eye(len(pairs))[monomials])

    def of_pairs(self, forms: Tensor) -> Tensor:
        """Forms of the lookahead as those of the products here, the constants last; shape (n, 2, products + 1)."""
        return (
            forms if self._features.lookahead is None else torch.cat([forms[:, :, :-1] @ self._monomials, forms[:, :, -1:]], 2)
        )

    def __call__(self, observed: Tensor, forms: Tensor) -> Tensor:
        """What the policy sees, with the forms of `of_pairs` there."""
        shown, first, second = torch.split(torch.addmm(self._shift, observed, self._picked), self._sizes, 1)
        if not self._paired:
            return shown
        pairs = first * second
        grown = [pairs] if self._features.products else []
        if self._features.lookahead is not None:
            grown.append(torch.baddbmm(forms[:, :, -1:], forms[:, :, :-1], pairs[:, :, None])[:, :, 0])
        return torch.cat([shown, torch.cat(grown, 1) * torch.rsqrt(1 + pairs @ self._same)], 1)


def values(task: Task, points: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """(relative value of what takes over as a form of car and road, mean cost of nearly the best constant damping).

    At operating points (nu, delta), shape (n, 2); of shapes (n, k, k) and (n,). The value is halfway between those of the
    constant damping and of the best active force: what a damper can do lies between the two. Where theory knows neither, it is
    the constant damping's on a second- or first-order road, which tells as well what the end of a drive is worth.
    """
    nu, delta = points.T[:, :, None]
    dampings = np.geomspace(*task.damping_range, CHOICES)
    road = task.road.shaping_filter()
    known = has_quadratic_value(task) and road is not None and set(road.states) <= ROAD_STATES
    if known:
        system = plant_system(task, dampings, nu, delta)
    else:
        like = GaussianRoad().shaping_filter(np.where(delta > 0, delta, LIKENESS))
        system = LinearSystem.of(
            like if task.road.has_slope else FirstOrderRoad().shaping_filter(), task.car.motion, damping=dampings, ratio=nu
        )
    forms, costs = value_form(system, task.weights_by_name)
    best = np.argmin(costs, axis=1)[:, None]
    value, cost = np.take_along_axis(forms, best[:, :, None, None], 1)[:, 0], np.take_along_axis(costs, best, 1)[:, 0]
    if known:
        active = np.array([active_force(task, *point)[1] for point in points.tolist()])
        value = (1 - ACTIVE) * value + ACTIVE * active
    return value, cost
