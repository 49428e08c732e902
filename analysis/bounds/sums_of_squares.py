"""A lower bound by a polynomial value and sums of squares, for every linear plant whose conditional moments are known.

Let x be the state of car and road, and let a controller choose D in [D_min, D_max] and hold it over each interval T. Let V be a
polynomial, E_D V(x) the conditional mean of V after an interval that begins in x, and c_D(x) that of the mean cost over it. If

    P_D(x) = c_D(x) + (E_D V(x) - V(x))/T - g >= 0   for all D of the range and all x that there are,                      (*)

then no controller costs less than g: its mean cost over n intervals is at least g + (E V(x_0) - E V(x_n))/(n T), and V stays
bounded in the mean. As the generator takes polynomials of a degree to such of the same degree, on linear and on bounded roads
(`polynomials.generator`), E_D V and c_D are exact: the exponential of a matrix. (*) is asked for as sums of squares s_0, s_1,

    P_D = s_0 + s_1 (1 - r' R r),                                                                                        (**)

where r' R r <= 1 is where a bounded road stays; on others s_1 = 0. The greatest g is that of a semidefinite program.

*D between levels.* Over the range P_D is nearly a polynomial of t in [0, 1], where t is affine in exp(-rate D). (**) is asked
of its coefficients in Bernstein's basis, which is not negative there. What the polynomial leaves out is analytic in D: it is
bounded by its Chebyshev coefficients, and those beyond the nodes by its size on an ellipse about the range (S. Bernstein;
L. N. Trefethen, *Approximation Theory and Approximation Practice*, SIAM 2013, theorem 8.2).

*D that moves within an interval*, as behind a valve: (*) is asked for in the limit T -> 0, where P_D = c_D + L_D V - g and the
generator L_D is affine in D, so that both ends suffice. Where D enters a weighted signal s, affine in D, its square is replaced
by its tangents 2 h s - h^2 <= s^2 with a polynomial h; the square of h is that of one more variable, y^2 - 2 h y >= -h^2.

*Proved.* The program is solved with Gram matrices that are at least a small multiple of the identity. Afterwards the misfit of
(**), coefficient by coefficient, is added to the Gram matrices of s_0; what is left out between levels, and a bound of all
rounding, are charged to their diagonals, as |b_i b_j| <= (b_i^2 + b_j^2)/2; all matrices must have positive eigenvalues.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence

import numpy as np

from roadgym.linear import LinearSystem
from roadgym.parameters import ParameterError, shown, whole
from roadgym.task import Task

from ..checks import FloatArray, single_threaded_algebra
from ..feedback.grid import variable_of
from ..optimum import optimal_damping
from ..quadratic import has_quadratic_value, plant_system
from .bound import SOLVED, LowerBound, common_refusal
from .levels import Levels
from .polynomials import IntArray, Space, exponents, generator, values
from .semidefinite import Program, solve

HELD = "any controller whose damping stays in the range and is held over each control interval"
MOVING = "any controller whose damping stays in the range, acting at any time"
HIGHEST, USUAL = 12, 8  # degree
LARGEST = 300  # monomials, by default
WIDTH = 2.5  # unit of the car's states, in their root mean squares under the best constant damping
FARTHEST = 3.0  # unit of the road's at most, in standard deviations
CANDIDATES = 5  # points for each monomial
SPREAD = 0.7  # of their car's states, standard deviation
NOTICED = 0.05  # half of the range of exp(-2 D T), where it matters that D is held
MARGINS = (5e-6, 5e-5, 5e-4)  # least eigenvalue of the Gram matrices of s_0 that is asked for, in units of the cost
ROUNDING = 1e-11  # of a coefficient, over the sum of the sizes of all that is added up in it: 5e4 units in the last place


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class SquaresCertificate:
    """What proves a bound; in units of the road's variance and of 1/w1.

    Attributes:
        cost: g.
        held: is D held over each interval, or may it move within?
        powers: exponents of the monomials of V, shape (monomials, states).
        value: their coefficients in V(x).
        least_eigenvalue: of all Gram matrices, after what is charged.
    """

    cost: float
    held: bool
    powers: IntArray
    value: FloatArray
    least_eigenvalue: float

    def value_at(self, states: FloatArray) -> FloatArray:
        """V at states x of shape (any, n)."""
        return values(self.powers, states) @ self.value


def refusal(task: Task) -> str | None:
    """Why there is no such bound for this task; None where there is."""
    reason = common_refusal(task)
    if reason is not None:
        return reason
    road = task.road.shaping_filter()
    if road is None:
        return f"a {task.road.kind} road is no linear filter"
    if not has_quadratic_value(task):
        return (
            f"conditional moments of this {task.road.kind} road are not known" if road.noise.any() else "a road without noise"
        )
    return None


def bound(
    task: Task,
    speed: float,
    bandwidth: float,
    *,
    degree: int | None = None,
    held: bool | None = None,
    report: Callable[[int, int], None] | None = None,
) -> LowerBound:
    """The bound at an operating point; a second or two.

    Args:
        task: plant, weights, range of D and control interval.
        speed: m/s.
        bandwidth: 1; 0 where the road has none.
        degree: of V, even, 2 to `HIGHEST`; the higher the tighter, and slower. By default `USUAL`, or less where that has more
            than `LARGEST` monomials, or where rounding is too large to prove that of the higher one.
        held: does D keep its value within each interval? By default as the task's valve says. Where it does not, only the bound
            for any D is sought, which else is one of two; the other is sought where the damper does much in an interval.
        report: called as ``report(done, in all)``.

    Raises:
        ParameterError: there is none, see `refusal`; or rounding is too large to prove it.
    """
    if held is None:
        held = task.valve.is_still(task.control_interval)
    decay = variable_of(task.damping_range, task.control_interval * task.car.natural_frequency)[1]
    forms = [True, False] if held and decay > NOTICED else [False]
    signals = task.car.motion.signals
    entered = any(signals[name].terms.get("damper_force") for name in task.weights_by_name)  # where coefficients are coarse
    found: list[SquaresCertificate] = []
    for turn, form in enumerate(forms):
        if found and not entered:
            break
        told = None if report is None else functools.partial(_told, report, turn, len(forms))
        try:
            found.append(certificate(task, speed, bandwidth, degree=degree, held=form, report=told))
        except ParameterError:
            if form is forms[-1] and not found:
                raise
    best = max(found, key=lambda each: each.cost)
    return LowerBound(
        cost=max(best.cost, 0.0), method="sums_of_squares", assumption=HELD if best.held else MOVING, rigour=SOLVED
    )


def _told(report: Callable[[int, int], None], turn: int, turns: int, done: int, total: int) -> None:
    report(turn * total + done, turns * total)


@single_threaded_algebra()
def certificate(
    task: Task,
    speed: float,
    bandwidth: float,
    *,
    degree: int | None = None,
    held: bool = True,
    report: Callable[[int, int], None] | None = None,
) -> SquaresCertificate:
    """One of the two bounds of `bound`, for a D that is held over intervals or for any, with what proves it."""
    reason = refusal(task)
    if reason is not None:
        raise ParameterError(f"there is no lower bound by sums of squares: {reason}")
    plant = _Plant(task, speed, bandwidth)
    if degree is not None and (whole("degree", degree, low=2) % 2 or degree > HIGHEST):
        raise ParameterError(f"degree must be even and at most {HIGHEST}, got {shown(degree)}")
    for tried in range(plant.usual_degree(), 1, -2) if degree is None else [degree]:
        conditions: _Conditions = _HeldConditions(plant, tried) if held else _MovingConditions(plant, tried)
        for margin in MARGINS:
            found = conditions.solved(margin, report)
            if found.least_eigenvalue > 0:
                return found
    raise ParameterError("there is no lower bound by sums of squares: what must be charged is too much to prove it")


class _Plant:
    """The plant at one operating point, its states over their scales, its cost over a unit."""

    def __init__(self, task: Task, speed: float, bandwidth: float) -> None:
        self.task, self._ratio, self._bandwidth = task, task.frequency_ratio(speed), bandwidth or None
        self.interval = task.control_interval * task.car.natural_frequency
        weights, bounds = task.reward_by_name, task.damping_range
        best = optimal_damping(task.road, speed=speed, car=task.car, weights=weights, bounds=bounds, bandwidth=self._bandwidth)
        system = self.system(float(best.damping))
        covariance = system.covariance()
        self.cars, self.size = system.car_states, len(system.states)
        self.unit = float(np.sum(system.cost_form(task.weights_by_name) * covariance))
        self.scale = WIDTH * np.sqrt(np.diagonal(covariance))
        roads, flatness = system.road_covariance, system.flatness
        assert flatness is not None
        square = len(roads) * (1 + 1 / flatness) if flatness else math.inf  # r' P^-1 r at most
        deviations = np.sqrt(np.diagonal(roads))
        self.scale[self.cars :] = min(math.sqrt(square), FARTHEST) * deviations
        self.bound: FloatArray | None = None  # the form R of r, scaled, which is 1 at most
        if flatness:
            self.bound = np.linalg.inv(roads) / square * np.outer(self.scale[self.cars :], self.scale[self.cars :])

    def system(self, damping: float) -> LinearSystem:
        """At a constant damping, in its own units."""
        return plant_system(self.task, damping, self._ratio, self._bandwidth)

    def cost_form(self, system: LinearSystem, names: Sequence[str]) -> FloatArray:
        """The weighted squares of ``names`` over the unit, as a form of the scaled states."""
        weights = {name: weight for name, weight in self.task.weights_by_name.items() if name in names}
        return system.cost_form(weights) * np.outer(self.scale, self.scale) / self.unit

    def usual_degree(self) -> int:
        """See `bound`."""
        counts = np.cumsum([math.comb(self.size + each - 1, each) for each in range(0, USUAL + 1, 2)])
        return max(2, 2 * int(np.sum(counts <= LARGEST)) - 2)


class _Conditions:
    """Polynomials that must be sums of squares: cost + rise v - g, linear in the unknowns v; the first of these are V's.

    Attributes:
        cost: shape (conditions, monomials).
        rise: shape (conditions, monomials, unknowns).
    """

    held: bool
    cost: FloatArray
    rise: FloatArray

    def __init__(self, plant: _Plant, degree: int, outputs: int = 0) -> None:
        self.plant = plant
        variables = plant.size + outputs

        def basis(odd: int, most: int) -> IntArray:
            found = exponents(plant.size, range(odd, most + 1, 2))
            return np.hstack([found, np.zeros((len(found), outputs), np.int64)])

        self.unit = np.eye(variables, dtype=np.int64)
        self.odd = basis(1, degree // 2)
        # even and odd monomials do not mix: the plant is the same upside down
        self.bases = [np.vstack([self.odd, self.unit[plant.size :]]), basis(0, degree // 2)]
        none = np.zeros((1, variables), np.int64)
        self.multipliers = [(none, np.ones(1))] * 2
        if plant.bound is not None:
            more = [each for each in (basis(1, degree // 2 - 1), basis(0, degree // 2 - 1)) if len(each)]
            first, second = np.nonzero(plant.bound)
            road = self.unit[plant.cars :]
            multiplier = np.vstack([none, road[first] + road[second]]), np.append(1.0, -plant.bound[first, second])
            self.bases += more
            self.multipliers += [multiplier] * len(more)
        self.space = Space(np.vstack([(each[:, None] + each).reshape(-1, variables) for each in self.bases[:2]]))
        self.powers = basis(0, degree)[1:]

    def left_out(self, unknowns: FloatArray) -> FloatArray:
        """Bound of what the conditions leave out of (*), coefficient by coefficient, shape (monomials,)."""
        return np.zeros(self.space.size)

    @functools.cached_property
    def _points(self) -> FloatArray:
        """As many points as monomials, at which these are as independent as can be."""
        from scipy.linalg import qr

        plant, random = self.plant, np.random.default_rng(0)
        points = SPREAD * random.standard_normal((CANDIDATES * self.space.size, self.space.variables))
        road = points[:, plant.cars : plant.size]
        road *= random.uniform(size=(len(points), 1)) ** (1 / road.shape[1]) / np.linalg.norm(road, axis=1)[:, None]
        monomials = values(self.space.powers, points)
        chosen = qr((monomials / np.linalg.norm(monomials, axis=1)[:, None]).T, mode="r", pivoting=True)[1]
        return np.asarray(points[chosen[: self.space.size]])

    def solved(self, margin: float, report: Callable[[int, int], None] | None) -> SquaresCertificate:
        """The greatest g with room to spare, and whether it is proved."""
        points = self._points
        monomials, bases = values(self.space.powers, points), [values(basis, points) for basis in self.bases]
        turned = [np.linalg.qr(basis) for basis in bases]
        root = math.sqrt(len(points))
        columns = np.concatenate([np.ones((*self.cost.shape[:1], len(points), 1)), -monomials @ self.rise], axis=2)
        program = Program(
            target=self.cost @ monomials.T - margin * sum(np.sum(basis**2, axis=1) for basis in bases[:2]),
            columns=columns,
            gain=np.eye(columns.shape[2])[0],
            bases=[root * orthogonal for orthogonal, _ in turned],
            multipliers=[values(powers, points) @ factors for powers, factors in self.multipliers],
        )
        unknowns, found = solve(program, report)
        back = [root * np.linalg.inv(triangle) for _, triangle in turned]
        grams = [turn @ matrix @ turn.T for turn, matrix in zip(back, found, strict=True)]
        for gram in grams[:2]:
            gram += margin * np.eye(gram.shape[-1])
        best, coefficients = float(unknowns[0]), unknowns[1:]
        plant = self.plant
        value = coefficients[: len(self.powers)] / np.prod(plant.scale ** self.powers[:, : plant.size], axis=1)
        return SquaresCertificate(
            cost=best * plant.unit,
            held=self.held,
            powers=self.powers[:, : plant.size],
            value=value * plant.unit,
            least_eigenvalue=self._least_eigenvalue(best, coefficients, grams),
        )

    def _least_eigenvalue(self, best: float, unknowns: FloatArray, grams: list[FloatArray]) -> float:
        """Of all Gram matrices, less the eigensolver's error; misfit, rounding and what is left out are in those of s_0."""
        misfit, sizes = self.cost + self.rise @ unknowns, np.abs(self.cost) + np.abs(self.rise) @ np.abs(unknowns)
        misfit[:, self.space.one] -= best
        sizes[:, self.space.one] += abs(best)
        places = [self.space.places(basis[:, None] + basis) for basis in self.bases]
        for basis, (powers, factors), gram in zip(self.bases, self.multipliers, grams, strict=True):
            where = self.space.places((basis[:, None] + basis)[:, :, None] + powers).ravel()
            for k, matrix in enumerate(gram):
                entries = (matrix[:, :, None] * factors).ravel()
                misfit[k] -= np.bincount(where, entries, self.space.size)
                sizes[k] += np.bincount(where, np.abs(entries), self.space.size)
        shared = np.bincount(np.concatenate([place.ravel() for place in places[:2]]), minlength=self.space.size)
        charge = (ROUNDING * sizes + self.left_out(unknowns)) / shared
        least = math.inf
        for block, (gram, place) in enumerate(zip(grams, places, strict=True)):
            whole = (gram + np.swapaxes(gram, -1, -2)) / 2
            if block < 2:
                whole = whole + (misfit / shared)[:, place]
                whole[:, range(len(place)), range(len(place))] -= charge[:, place].sum(axis=2)
            eigenvalues = np.linalg.eigvalsh(whole)
            least = min(least, float((eigenvalues[:, 0] - ROUNDING * np.abs(eigenvalues).max(axis=1)).min()))
        return least


class _HeldConditions(_Conditions):
    """D is held over each interval: a condition for each coefficient in Bernstein's basis."""

    held = True

    def __init__(self, plant: _Plant, degree: int) -> None:
        super().__init__(plant, degree)
        self._levels = Levels(self._rate, plant.task.damping_range, plant.interval)
        means = (self._levels.means - np.eye(1 + self.space.size)) / plant.interval
        self._columns = self.space.places(self.powers)
        self.cost, self.rise = means[:, :-1, -1], means[:, :-1, self._columns]

    def _rate(self, damping: float) -> FloatArray:
        """The generator on (polynomials, integral of the cost)."""
        system, space = self.plant.system(damping), self.space
        matrix = np.zeros((space.size + 1, space.size + 1))
        matrix[:-1, :-1] = generator(system, self.plant.scale, space, space.powers)
        matrix[:-1, -1] = space.quadratic(self.plant.cost_form(system, list(self.plant.task.weights_by_name)))
        return matrix

    def left_out(self, unknowns: FloatArray) -> FloatArray:
        """See `levels.Levels.remainder`."""
        start = np.zeros(self.space.size + 1)
        start[self._columns], start[-1] = unknowns, 1.0
        return self._levels.remainder(start)[:-1] / self.plant.interval


class _MovingConditions(_Conditions):
    """D moves as it likes: a condition for each end of its range."""

    held = False

    def __init__(self, plant: _Plant, degree: int) -> None:
        ends = [plant.system(damping) for damping in plant.task.damping_range]
        if not np.array_equal(ends[0].noise, ends[1].noise):
            raise ParameterError("there is no such lower bound: noise reaches the car through its damper; held must be true")
        weights = plant.task.weights_by_name
        moving = [name for name in weights if not np.array_equal(ends[0].signals[name], ends[1].signals[name])]
        super().__init__(plant, degree, len(moving))
        space, odd = self.space, self.odd
        costs, rises = [], []
        for end in ends:
            cost = space.quadratic(plant.cost_form(end, [name for name in weights if name not in moving]))
            rise = [generator(end, plant.scale, space, self.powers)]
            for name, output in zip(moving, self.unit[plant.size :], strict=True):
                weight = weights[name] / plant.unit
                cost[space.places(2 * output)] += weight
                tangents = np.zeros((space.size, len(odd)))
                tangents[space.places(odd + output), range(len(odd))] = -2 * weight
                for unit, factor in zip(self.unit, end.signals[name] * plant.scale, strict=False):
                    tangents[space.places(odd + unit), range(len(odd))] += 2 * weight * factor
                rise.append(tangents)
            costs.append(cost)
            rises.append(np.hstack(rise))
        self.cost, self.rise = np.stack(costs), np.stack(rises)
