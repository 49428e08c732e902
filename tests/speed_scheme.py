"""What the scheme makes of the car's mean squares under speed noise.

*Exact bias.* Over one substep the car and the road are linear in (Y, X, Z, U), with coefficients that depend on the noise of
the substep and on the filtered noise Psi at its start. So the second moments close once they are expanded in the Hermite
polynomials of Psi, and the stationary mean squares of the *discrete* scheme come without any noise: the kernel's own lane
functions are run on the points of a Gauss-Hermite rule in place of random numbers.
"""

import contextlib
import itertools
import math

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

from roadgym import compiled as rows
from roadgym import speed as speed_module
from roadgym.cars import one_mass
from roadgym.compiled import LANES
from roadgym.roads import first_order, gaussian
from roadgym.task import make_task


class Vectors:
    """A block each of whose numbers is a vector, so that a lane function written for one block runs on many at once."""

    def __init__(self, array):
        self.array, self.dtype = array, array.dtype

    def __getitem__(self, index):
        return self.array[index].copy()  # a number, not a view that a later assignment would change

    def __setitem__(self, index, value):
        self.array[index] = value


@contextlib.contextmanager
def given_normals():
    """Within, `normal_pair` hands on its words, so that they may be the normals themselves."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (speed_module, first_order, gaussian):
            patch.setattr(module, "normal_pair", lambda first, second: (first, second))
        patch.setattr(speed_module, "max", np.maximum, raising=False)
        yield


def one_substep(task, damping, state, road_normals, speed_normals):
    """The rows of the block after one substep from ``state``, by the kernel's lane functions; arrays of 64 n numbers."""
    road, noise = task.road, task.speed_noise
    interval = task.control_interval * task.car.natural_frequency
    ratio = task.frequency_ratio(task.speed[0])
    columns = state[rows.LEVEL].size // LANES
    size = rows.COEFFICIENT + road.rows * LANES
    block = np.zeros((size, columns))

    def words(normals):
        return Vectors(np.concatenate([normal.reshape(LANES, columns) for normal in normals]))

    everything = {rows.SPEED: ratio, rows.RATE: ratio, rows.BANDWIDTH: task.bandwidth[0], rows.TURN: ratio * interval, **state}
    cars = [everything.pop(name) for name in ("displacement", "velocity")]
    for row, values in everything.items():
        block[row : row + LANES] = np.broadcast_to(values, LANES * columns).reshape(LANES, columns)
    states = np.array(cars).reshape(2 * LANES, columns)
    work = np.zeros((one_mass.DECAY_22 + LANES, columns))
    work[[rows.SUBSTEP, rows.INVERSE_SUBSTEP]] = np.array([[interval], [1 / interval]])
    work[rows.DAMPING : rows.DAMPING + LANES] = damping
    decay = one_mass.free_decay(damping, interval, np.zeros(1))
    for row, value in zip((one_mass.DECAY_11, one_mass.DECAY_12, one_mass.DECAY_22), decay, strict=True):
        work[row : row + LANES] = value
    work[one_mass.PREVIOUS_LEVEL : one_mass.PREVIOUS_LEVEL + LANES] = block[rows.LEVEL : rows.LEVEL + LANES]
    with given_normals():
        if noise is not None:
            table = noise.table(interval, task.car.natural_frequency, road)
            noise.advance.function(Vectors(block), words(speed_normals), table)
        if road.prepare is not None:  # a function of one lane, written for numbers
            for column, i in itertools.product(range(columns), range(LANES)):
                lane = block[i:, column].copy()
                road.prepare.function(lane, None, road.table())
                block[i:, column] = lane
        road.advance.function(Vectors(block), words(road_normals), road.table())
    one_mass.advance.function(Vectors(block), Vectors(states), Vectors(work), None)
    return block.reshape(size // LANES, -1), states.reshape(2, -1)


def scheme_mean_squares(road, noise, *, damping, speed, interval, modes=24, outer=40, inner=6):
    """Stationary mean squares of the discrete scheme over E Z^2, in the order of MEAN_SQUARES; infinite ones are meaningless.

    With x = (Y, X) and r = (Z, U), one substep is x -> C x + G r + H n, r -> M r + N n, where n is normal, C fixed, and the
    rest depends on Psi and on the noise of the speed. E r r^T is known and independent of Psi. q_m = E x r^T h_m(Psi), with the
    normed Hermite polynomials h_m, obeys a linear equation, and then E x x^T a discrete Lyapunov equation.
    """
    task = make_task(road=road, speed_noise=noise, speed=speed, control_interval=interval, substeps=1, precision="float64")
    road, noise = task.road, task.speed_noise
    spread = gain = 0.0
    if noise is not None:
        spread, gain = noise.table(interval, 1.0, road)[[speed_module.SPREAD, speed_module.RATE_GAIN]]
    if spread == 0:
        modes = outer = 1
    if noise is None:
        inner = 1

    # points (Psi, three normals) of the speed noise, each with six states of unit length (Y, X, Z, U, two normals of the road)
    rules = [np.polynomial.hermite_e.hermegauss(count) for count in (outer, inner, inner, inner)]
    psi, *normals = (grid.ravel() for grid in np.meshgrid(*(nodes for nodes, _ in rules), indexing="ij"))
    weights = math.prod(np.ix_(*(weights / weights.sum() for _, weights in rules))).ravel()
    units = np.diag([1, 1, math.sqrt(2), math.sqrt(2), 1, 1])  # the harmonic road keeps to this radius
    padding = -6 * psi.size % LANES

    def repeat(values):
        return np.concatenate([np.tile(values, 6), np.zeros(padding)])

    y, x, z, u, *road_normals = (np.concatenate([np.repeat(unit, psi.size), np.zeros(padding)]) for unit in units)
    state = {"displacement": y, "velocity": x, rows.LEVEL: z, rows.SLOPE: u, rows.SPEED_STATE: repeat(spread * psi)}
    block, cars = one_substep(task, damping, state, road_normals, [*map(repeat, normals), np.zeros(z.size)])

    def answers(row):
        return row[: 6 * psi.size].reshape(6, psi.size)

    answer = np.stack([answers(row) for row in (*cars, block[rows.LEVEL // LANES], block[rows.SLOPE // LANES])])
    answer /= np.diag(units)[:, None]
    assert np.ptp(answer[:2, :2], axis=-1).max() < 1e-13  # the car's own map does not depend on the noise
    c, g, h, m, n = answer[:2, :2, 0], answer[:2, 2:4], answer[:2, 4:], answer[2:, 2:4], answer[2:, 4:]
    known = np.diag([1.0, float(road.has_slope)])

    def hermite(values):
        result = [np.ones_like(values), values]
        for k in range(2, modes):
            result.append((values * result[-1] - math.sqrt(k - 1) * result[-2]) / math.sqrt(k))
        return np.stack(result[:modes])

    before = weights * hermite(psi)
    after = weights * hermite(answers(block[rows.SPEED_STATE // LANES])[0] / spread) if spread else before
    carried = np.einsum("ap,ijp,bp->abij", after, m, before / weights, optimize=True)
    forced = np.einsum("ikp,kl,jlp->ijp", g, known, m) + np.einsum("ikp,jkp->ijp", h, n)
    system = np.einsum("ik,abjl->aijbkl", c, carried).reshape(4 * modes, 4 * modes)
    forcing = np.einsum("ap,ijp->aij", after, forced).ravel()
    q = np.linalg.solve(np.eye(4 * modes) - system, forcing).reshape(modes, 2, 2)
    crossed = c @ np.einsum("aik,ap,jkp->ij", q, before, g, optimize=True)
    own = np.einsum("ikp,kl,jlp,p->ij", g, known, g, weights) + np.einsum("ikp,jkp,p->ij", h, h, weights)
    p = solve_discrete_lyapunov(c, crossed + crossed.T + own)

    # means with the rate nu + gain Psi of the angle, which stands before U in the velocity of the road
    ratio = task.frequency_ratio(speed)
    with_rate = ratio * q[0, :, 1] + (gain * spread * q[1, :, 1] if modes > 1 else 0.0)
    travel = p[0, 0] - 2 * q[0, 0, 0] + 1
    relative = p[1, 1] - 2 * with_rate[1] + (ratio**2 + (gain * spread) ** 2) * known[1, 1]
    mixed = p[0, 1] - q[0, 1, 0] - with_rate[0]
    return np.array([p[0, 0], p[1, 1], 4 * damping**2 * relative + travel + 4 * damping * mixed, travel, relative])
