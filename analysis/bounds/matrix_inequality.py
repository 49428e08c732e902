"""A lower bound by a quadratic value: the linear matrix inequality of a semi-active damper, for every linear plant.

The plant is dx/dt = A x - f u + noise, x = (car, road), with the damper at D_min in A, and the additional force
u = 2 (D - D_min) v_r, where v_r is the relative velocity. Whatever D in [D_min, D_max] a controller sets, from whatever it
knows,

    u (k v_r - u) >= 0,   k = 2 (D_max - D_min).

The cost c(x, u), weighted squares of signals, is a quadratic form of x and u. Let V = x' P x, which in the mean changes at the
rate V'(x, u) + <P, W>, with V' = 2 x' P (A x - f u) and the intensity W of the noise. Let there be a multiplier lambda >= 0
such that for all x and u

    c(x, u) + V'(x, u) - lambda u (k v_r - u) - r' S r >= 0,                                                           (*)

where r is the state of the road and S any form of it (the S-lemma: V. A. Yakubovich 1971; S. Boyd et al., *Linear Matrix
Inequalities in System and Control Theory*, SIAM 1994, section 2.6.3). In the mean over time V does not change, and E r r' is
known, as nothing acts back on the road: so no controller costs less than

    g = <S, E r r'> + <P, W>.

What is needed of the controller is that D stays in the range and does not foresee the noise. A D that is held over intervals,
lagged, or chosen from noisy sensors is a special case, and the cost of an interval is the integral over it. It is needed of
the car that its second moments stay bounded, and of the road that its drift is linear: a noise whose intensity depends on the
state, as on the bounded road, has in the mean the intensity of the linear twin.

Where the rate of the level contains white noise and the damper feels it, the noise is that of D: then <P, W> is a quadratic
polynomial of D, and g takes the least over the range.

*Without a solver.* For one lambda, (*) is that of a linear-quadratic regulator, whose Riccati equation has the largest P of all
(J. C. Willems, IEEE Trans. Automatic Control 16, 1971), the one that makes g largest, whatever the noise; its part between car
and road follows from a Sylvester equation, and S takes what is left. The largest g for each lambda is concave in lambda, as (*)
is linear in (P, S, lambda): a search in one dimension finds the greatest, the optimum of the semidefinite program.

*Proved.* The equations are solved for a cost that is less by a small positive definite form, so that (*) holds with room to
spare. That it does is checked: the matrix of (*), written over u + K x in place of u, where it is nearly block-diagonal, must
have all eigenvalues above a bound of the rounding in it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from roadgym.parameters import ParameterError
from roadgym.task import Task

from ..checks import FloatArray, single_threaded_algebra
from ..quadratic import plant_system
from .bound import PROVED, LowerBound, common_refusal

ASSUMPTION = "any controller whose damping stays in the range, acting at any time"
MULTIPLIERS = (1e-9, 1e6)  # in units of the mean cost over that of k v_r squared
MARGINS = tuple(10.0**power for power in range(-10, -3))  # of the cost, that are given away to have room to spare


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class MatrixCertificate:
    """What proves a bound; in units of the road's variance and of 1/w1, heights above the level of the road.

    Attributes:
        cost: g, less all rounding.
        states: names of the states x, n of them.
        value: P, shape (n, n); zero among states of the road.
        road: S, shape (n, n); zero elsewhere.
        multiplier: lambda.
        inequality: the matrix of (*) over (x, u), shape (n + 1, n + 1).
        gain: K, shape (n,).
        least_eigenvalue: of the matrix over (x, u + K x), scaled.
        rounding: a bound of the spectral norm of all rounding in it, likewise.
    """

    cost: float
    states: tuple[str, ...]
    value: FloatArray
    road: FloatArray
    multiplier: float
    inequality: FloatArray
    gain: FloatArray
    least_eigenvalue: float
    rounding: float

    @property
    def holds(self) -> bool:
        """Is the inequality proved?"""
        return self.least_eigenvalue > self.rounding


def refusal(task: Task) -> str | None:
    """Why there is no such bound for this task; None where there is."""
    if task.road.shaping_filter() is None:
        return common_refusal(task) or f"a {task.road.kind} road is no linear filter"
    return common_refusal(task)


def bound(task: Task, speed: float, bandwidth: float, *, report: Callable[[int, int], None] | None = None) -> LowerBound:
    """The bound at an operating point; milliseconds.

    Args:
        task: plant, weights and range of D.
        speed: m/s.
        bandwidth: 1; 0 where the road has none.
        report: called as ``report(done, in all)``.

    Raises:
        ParameterError: there is none, see `refusal`, or rounding is too large to prove it.
    """
    found = certificate(task, speed, bandwidth)
    if report is not None:
        report(1, 1)
    return LowerBound(cost=max(found.cost, 0.0), method="matrix_inequality", assumption=ASSUMPTION, rigour=PROVED)


@single_threaded_algebra()
def certificate(task: Task, speed: float, bandwidth: float) -> MatrixCertificate:
    """The bound of `bound` with all that proves it."""
    from scipy.optimize import minimize_scalar

    reason = refusal(task)
    if reason is not None:
        raise ParameterError(f"there is no lower bound for this task by a matrix inequality: {reason}")
    problem = _Problem(task, speed, bandwidth)
    low, high = np.log(MULTIPLIERS)
    found = minimize_scalar(lambda power: -problem.solved(float(np.exp(power)), 0.0).cost, bounds=(low, high), method="bounded")
    for margin in MARGINS:
        proved = problem.solved(float(np.exp(found.x)), margin)
        if proved.holds and np.isfinite(proved.cost):
            return proved
    raise ParameterError("there is no lower bound for this task by a matrix inequality: rounding is too large to prove it")


class _Problem:
    """The matrices at one operating point, with heights above the level and D_min in the drift."""

    def __init__(self, task: Task, speed: float, bandwidth: float) -> None:
        low, high = task.damping_range
        systems = plant_system(task, [low, high], task.frequency_ratio(speed), bandwidth or None)
        size, self.cars = len(systems.states), systems.car_states
        away, back = np.eye(size), np.eye(size)
        away[: self.cars, self.cars :], back[: self.cars, self.cars :] = -systems.heights, systems.heights
        self.states = systems.states
        self.drift = away @ systems.drift[0] @ back
        self.entry = -systems.force_entry
        soft = away @ systems.noise[0]
        self.noise = soft, away @ systems.noise[1] - soft  # at D_min, and what it is more at D_max
        self.relative = 2 * (high - low) * systems.signals[task.car.motion.relative][0] @ back  # k v_r
        self.driver = systems.road_covariance
        self.square, self.cross, self.price = np.zeros((size, size)), np.zeros(size), 0.0
        self.terms = np.zeros((size + 1, size + 1))  # what the cost is a sum of, in absolute values
        for name, weight in task.weights_by_name.items():
            row, force = systems.signals[name][0] @ back, systems.force[name]
            self.square += weight * np.outer(row, row)
            self.cross += weight * force * row
            self.price += weight * force**2
            whole = np.abs(np.append(row, force))
            self.terms += weight * np.outer(whole, whole)
        middle = dataclasses.replace(systems, drift=systems.drift.mean(axis=0), noise=systems.noise.mean(axis=0))
        covariance = away @ middle.covariance() @ away.T
        self.unit = float(np.sum(self.square * covariance))  # nearly the cost at the middle damping
        self.scale = np.sqrt(np.maximum(np.diagonal(covariance), 1e-12 * np.diagonal(covariance).max()))
        self.force = float(self.relative @ covariance @ self.relative)

    def solved(self, multiplier: float, margin: float) -> MatrixCertificate:
        """The best form for a multiplier, in units of `MULTIPLIERS`, and a margin; its cost is -inf where there is none."""
        from scipy.linalg import LinAlgError, solve_continuous_are, solve_sylvester

        cars, size = self.cars, len(self.states)
        car, road = slice(cars), slice(cars, size)
        weight = multiplier * self.unit / self.force
        square, price = self.square, self.price + weight
        cross = self.cross - weight / 2 * self.relative
        spare = np.diag(margin * self.unit / self.scale**2)
        less, entry = square - spare, self.entry[car]
        value, left, gain = np.zeros((size, size)), np.zeros((size, size)), np.zeros(size)
        own, driven, driver = self.drift[car, car], self.drift[car, road], self.drift[road, road]
        try:
            p = solve_continuous_are(own, entry[:, None], less[car, car], [[price]], s=cross[car, None])
            gain[car] = (p @ entry + cross[car]) / price
            closed = own - np.outer(entry, gain[car])
            q = solve_sylvester(closed.T, driver, -(p @ driven + less[car, road] - np.outer(gain[car], cross[road])))
        except (LinAlgError, ValueError):
            return self._none(multiplier)
        gain[road] = (q.T @ entry + cross[road]) / price
        value[car, car], value[car, road], value[road, car] = (p + p.T) / 2, q, q.T
        rate = value @ self.drift
        whole = rate + rate.T + square
        left[road, road] = (whole - price * np.outer(gain, gain) - spare)[road, road]
        side = value @ self.entry + cross
        inequality = np.block([[whole - left, side[:, None]], [side[None, :], np.array([[price]])]])
        least, rounding = self._least_eigenvalue(inequality, value, gain, weight)
        soft, more = self.noise
        # <P, noise noise'> is a polynomial of the share of the range that D is above D_min
        terms = [float(np.sum(value * (one @ other.T))) for one, other in ((soft, soft), (soft, more), (more, more))]
        shares = [0.0, 1.0] + ([float(np.clip(-terms[1] / terms[2], 0, 1))] if terms[2] > 0 else [])
        noise = min(terms[0] + 2 * share * terms[1] + share**2 * terms[2] for share in shares)
        known = float(np.sum(left[road, road] * self.driver))
        sizes = np.abs(value) @ (np.abs(soft) + np.abs(more)), np.abs(left[road, road]) * np.abs(self.driver)
        slack = 4 * size * np.finfo(float).eps * float(np.sum(sizes[0] * (np.abs(soft) + np.abs(more))) + np.sum(sizes[1]))
        return MatrixCertificate(
            cost=float(known + noise - slack),
            states=self.states,
            value=value,
            road=left,
            multiplier=weight,
            inequality=inequality,
            gain=gain,
            least_eigenvalue=least,
            rounding=rounding,
        )

    def _least_eigenvalue(
        self, inequality: FloatArray, value: FloatArray, gain: FloatArray, weight: float
    ) -> tuple[float, float]:
        """(least eigenvalue over (x, u + K x), bound of the rounding in that matrix), both over the scale of the states."""
        size = len(gain)
        scale = np.append(self.scale / np.sqrt(self.unit), 1 / np.sqrt(inequality[-1, -1]))
        shear = np.eye(size + 1)
        shear[-1, :-1] = -gain
        moved = scale[:, None] * (shear.T @ inequality @ shear) * scale
        # each entry is a sum of products of at most four factors: what rounding does is below 4 (n + 4) eps times their sizes
        rate = np.abs(value) @ np.abs(self.drift)
        side = np.abs(value) @ np.abs(self.entry) + weight / 2 * np.abs(self.relative)
        sizes = (
            np.abs(inequality) + self.terms + np.block([[rate + rate.T, side[:, None]], [side[None, :], np.array([[weight]])]])
        )
        products = scale[:, None] * (np.abs(shear).T @ sizes @ np.abs(shear)) * scale
        rounding = 4 * (size + 4) * np.finfo(float).eps * float(np.linalg.norm(products))
        return float(np.linalg.eigvalsh((moved + moved.T) / 2)[0]), rounding

    def _none(self, multiplier: float) -> MatrixCertificate:
        size = len(self.states)
        nothing = np.zeros((size, size))
        return MatrixCertificate(
            cost=-np.inf,
            states=self.states,
            value=nothing,
            road=nothing,
            multiplier=multiplier,
            inequality=np.zeros((size + 1, size + 1)),
            gain=np.zeros(size),
            least_eigenvalue=-np.inf,
            rounding=0.0,
        )
