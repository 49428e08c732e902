"""Speed noise: its law, and what the scheme makes of the car's mean squares under it.

*Exact bias.* Over one substep the car and the road are linear in (Y, X, Z, U), with coefficients that depend on the noise of
the substep and on the filtered noise Psi at its start. So the second moments close once they are expanded in the Hermite
polynomials of Psi, and the stationary mean squares of the *discrete* scheme come without any noise: the kernel's own lane
functions are run on the points of a Gauss-Hermite rule in place of random numbers.
"""

import contextlib
import dataclasses
import itertools
import math

import numpy as np
import pytest
from plants import PLANTS, plant_name
from scipy import stats
from scipy.linalg import expm, solve_discrete_lyapunov

import analysis
from roadgym import (
    MEAN_SQUARES,
    SPEED_NOISES,
    GaussianRoad,
    HarmonicRoad,
    HighPassSpeedNoise,
    LowPassSpeedNoise,
    MultiplicativeRoad,
    ParameterError,
    WhiteSpeedNoise,
)
from roadgym import compiled as rows
from roadgym import speed as speed_module
from roadgym.cars import one_mass
from roadgym.compiled import LANES
from roadgym.plant import Plant
from roadgym.roads import first_order, gaussian
from roadgym.speed import make_speed_noise
from roadgym.task import LARGEST_ANGLE, make_task

HARMONIC = HarmonicRoad()


def started_plant(number, **parameters):
    plant = Plant(make_task(**parameters), number)
    plant.start(np.arange(number, dtype=np.uint64))
    return plant


# ---------------------------------------------------------------------- the law of the noise


def phase_variance(noise, time):
    """Variance of the random part of the phase."""
    if noise.kind == "white":
        return noise.intensity**2 * time
    corner = noise.corner_frequency
    filtered = (1 - math.exp(-corner * time)) / corner
    return noise.intensity**2 * (filtered if noise.kind == "high_pass" else time - filtered)


def noise_law(noise, interval, natural_frequency=1.0):
    """(pull of Psi, covariance) of (Psi, angle, area) after a substep, from the table that the kernel reads."""
    table = noise.table(interval, natural_frequency, make_task(road="harmonic").road)
    factor = np.zeros((3, 3))
    factor[np.tril_indices(3)] = table[speed_module.FACTOR : speed_module.FACTOR + 6]
    return table[speed_module.PULL : speed_module.PULL + 3], factor @ factor.T, table[speed_module.SPREAD] ** 2


NOISES = [
    WhiteSpeedNoise(intensity=0.4),
    *(
        kind(intensity=0.4, corner_frequency=corner)
        for kind in (LowPassSpeedNoise, HighPassSpeedNoise)
        for corner in (0.01, 1.0, 30.0)
    ),
]


@pytest.mark.parametrize("noise", NOISES, ids=str)
@pytest.mark.parametrize("interval", [0.02, 0.1, 0.5])
def test_angle_of_a_substep_has_the_variance_of_its_equation(noise, interval):
    pull, covariance, stationary = noise_law(noise, interval)
    assert pull[1] ** 2 * stationary + covariance[1, 1] == pytest.approx(phase_variance(noise, interval), rel=1e-7)
    if noise.kind != "white":
        assert stationary == pytest.approx(noise.intensity**2 / (2 * noise.corner_frequency))
        assert pull[0] ** 2 * stationary + covariance[0, 0] == pytest.approx(stationary)


@pytest.mark.parametrize("noise", NOISES, ids=str)
def test_two_substeps_have_the_law_of_one_of_twice_the_length(noise):
    pull, covariance, _ = noise_law(noise, 0.05)
    # (Psi, angle, area) over a substep as a linear map of the same three at its start, the angle and the area adding up
    step = np.array([[pull[0], 0, 0], [pull[1], 1, 0], [pull[2], 0.05, 1]])
    twice, whole, _ = noise_law(noise, 0.1)
    np.testing.assert_allclose((step @ step)[:, 0], twice, rtol=1e-12)
    np.testing.assert_allclose(step @ covariance @ step.T + covariance, whole, rtol=1e-7, atol=1e-14)


def test_table_knows_the_natural_frequency():
    noise = LowPassSpeedNoise(intensity=0.4, corner_frequency=2.0)
    fast = LowPassSpeedNoise(intensity=0.4 * math.sqrt(8), corner_frequency=16.0)  # all rates times 8
    for slow_part, fast_part in zip(noise_law(noise, 0.1), noise_law(fast, 0.1, 8.0), strict=True):
        np.testing.assert_allclose(slow_part, fast_part, rtol=1e-12)


@pytest.mark.statistical
@pytest.mark.parametrize("name", list(SPEED_NOISES))
def test_driven_phase_has_its_law(name):
    """After many substeps the phase is Gaussian, with the mean and the variance of the equation."""
    number, intervals = 50_000, 25
    noise = SPEED_NOISES[name](intensity=0.3)
    plant = started_plant(number, road="harmonic", speed_noise=noise, speed=1.0, precision="float64")
    first = np.arctan2(-plant.row("slope"), plant.row("level"))
    for _ in range(intervals):
        plant.step(np.full(number, 0.5, np.float32))
    time = intervals * plant.task.control_interval
    last = np.arctan2(-plant.row("slope"), plant.row("level"))
    turned = (last - first - time + math.pi) % (2 * math.pi) - math.pi
    assert stats.kstest(turned, stats.norm(scale=math.sqrt(phase_variance(noise, time))).cdf).pvalue > 1e-3


@pytest.mark.parametrize(
    ("noise", "message"),
    [
        ("pink", "unknown speed noise 'pink'; known: white, low_pass, high_pass"),
        ({"kind": "white", "intensity": 0}, "intensity must be positive, got 0"),
        ({"kind": "low_pass", "corner_frequency": -1.0}, "corner_frequency must be positive, got -1.0"),
        ({"kind": "high_pass", "corner_frequency": float("inf")}, "corner_frequency must be finite, got inf"),
        ({"kind": "white", "corner_frequency": 1.0}, "unknown parameter 'corner_frequency' of speed noise 'white'"),
        (0.2, "speed noise must be a name, a mapping or a SpeedNoise, got 0.2"),
    ],
)
def test_bad_noises_are_refused_by_name(noise, message):
    with pytest.raises(ParameterError, match=message):
        make_speed_noise(noise, make_task(road="harmonic").road)


@pytest.mark.parametrize("name", ["white", "high_pass"])
@pytest.mark.parametrize("road", ["first_order", "gaussian", "multiplicative"])
def test_rough_noise_is_refused_on_random_roads(road, name):
    with pytest.raises(ParameterError, match=f"{name} speed noise is defined on the harmonic road only"):
        make_task(road=road, speed_noise=name)


@pytest.mark.parametrize("name", list(SPEED_NOISES))
def test_noise_survives_being_a_mapping(name):
    noise = SPEED_NOISES[name](intensity=0.3)
    assert noise.kind == name
    assert make_speed_noise(dataclasses.asdict(noise), make_task(road="harmonic").road) == noise
    assert make_speed_noise("none", make_task(road="harmonic").road) is None


# ---------------------------------------------------------------------- the scheme, without noise


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
    one_mass.prepare.function(Vectors(block), Vectors(states), Vectors(work), None)
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


def exact_mean_squares(road, noise, *, damping, speed):
    theory = analysis.mean_squares(road, noise, damping=damping, speed=speed)
    return np.array([getattr(theory, name) for name in MEAN_SQUARES]) / make_task(road=road).road.variance


def finite_terms(road, noise):
    """Which of the five mean squares are finite, whether or not there is a closed form."""
    if road == "first_order" or noise in ("white", "high_pass"):
        return [0, 1, 3]
    return [0, 1, 2, 3, 4]


LINEAR_PLANTS = [plant for plant in PLANTS if plant["road"] in ("harmonic", "first_order", "gaussian")]  # known to this file


@pytest.mark.parametrize("plant", LINEAR_PLANTS, ids=plant_name)
def test_bias_falls_with_the_order_of_the_scheme(plant):
    """Fourth order without noise on the speed, second order with it, fitted to the change with each halved substep."""
    kind = plant["speed_noise"]
    noise = kind and SPEED_NOISES[kind](intensity=0.3)
    terms = finite_terms(plant["road"], kind)
    intervals = 0.1 / 2.0 ** np.arange(4)
    found = np.array(
        [
            scheme_mean_squares(plant["road"], noise, damping=0.3, speed=1.0, interval=h, modes=8, outer=16)[terms]
            for h in intervals
        ]
    )
    changes = np.abs(np.diff(found, axis=0)) / found[-1]
    orders = -np.polyfit(np.arange(3), np.log2(changes), 1)[0]
    assert np.all(orders > (3.9 if kind is None else 1.8))
    # so what is left at the finest substep is less than its last change
    if kind is None or plant["road"] == "harmonic":
        exact = exact_mean_squares(plant["road"], noise, damping=0.3, speed=1.0)[terms]
        assert np.all(np.abs(found[-1] / exact - 1) < np.maximum(changes[-1], 1e-9))


RANGE = itertools.product(("low_pass", "high_pass"), (0.2, 1.0), (0.05, 1.0, 10.0))


@pytest.mark.parametrize(("kind", "intensity", "corner"), [("white", 0.2, None), ("white", 1.0, None), *RANGE])
def test_longest_substep_holds_the_bar_for_every_noise(kind, intensity, corner):
    """sigma <= sqrt(w1) and 0.05 w1 <= w_g <= 10 w1 on the harmonic road."""
    noise = SPEED_NOISES[kind](intensity=intensity, **({} if corner is None else {"corner_frequency": corner}))
    terms = finite_terms("harmonic", kind)
    for damping, speed in ((0.1, 1.0), (0.1, 3.0), (1.0, 0.3)):
        interval = LARGEST_ANGLE / max(1.0, speed)
        found = scheme_mean_squares(
            "harmonic", noise, damping=damping, speed=speed, interval=interval, modes=20, outer=30, inner=5
        )
        exact = exact_mean_squares("harmonic", noise, damping=damping, speed=speed)
        # the bar is 0.5 %
        assert np.all(np.abs(found[terms] / exact[terms] - 1) < 1e-3)


@pytest.mark.parametrize("shape", [0.3, 0.5, 2.0])
@pytest.mark.parametrize("noise", [None, LowPassSpeedNoise(intensity=0.5, corner_frequency=2.0)])
def test_car_on_a_bounded_road_follows_it_as_on_the_gaussian_road(shape, noise):
    """The map from the ends of a substep to the car is the same, and so are the first two moments of the road: with them every
    mean square of the scheme, and its bias, is that of the Gaussian road."""
    bandwidth, interval, damping = 0.3, 0.3, np.float32(0.2)
    maps = {}
    for road in (
        GaussianRoad(bandwidth=bandwidth, noise_intensity=1.0),
        MultiplicativeRoad.from_shape(shape=shape, bandwidth=bandwidth, level_bound=1.0),
    ):
        plant = started_plant(
            LANES, road=road, speed_noise=noise, speed=1.3, control_interval=interval, substeps=1, precision="float64"
        )
        old_z, old_u = plant.row("level"), plant.row("slope")
        plant.step(np.full(LANES, damping))
        ends = np.stack([old_z, plant.row("level"), plant.row(rows.TURN) * (plant.row("slope") - old_u)], axis=1)
        car = np.stack([plant.row("displacement"), plant.row("velocity")], axis=1)
        maps[road.kind], residual, rank, _ = np.linalg.lstsq(ends, car, rcond=None)
        assert rank == 3
        assert np.all(residual < 1e-20)  # the car, at rest before, depends on nothing else
    np.testing.assert_allclose(maps["multiplicative"], maps["gaussian"], atol=1e-12)


# ---------------------------------------------------------------------- by simulation


def driven_mean_squares(plant, damping, settle, measure, terms):
    """Means and standard errors of the chosen mean squares over E Z^2, from independent lanes."""
    actions = np.full(plant.num_envs, damping, np.float32)
    interval = plant.task.control_interval
    for _ in range(round(settle / interval)):
        plant.step(actions)
    total = np.zeros((len(terms), plant.num_envs))
    for _ in range(round(measure / interval)):
        total += plant.step(actions).mean_squares[list(terms)]
    total /= round(measure / interval)
    return total.mean(axis=1), total.std(axis=1, ddof=1) / math.sqrt(plant.num_envs)


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("kind", "corner", "measure"),
    [("white", None, 500), ("low_pass", 0.05, 500), ("low_pass", 10.0, 500), ("high_pass", 0.05, 500), ("high_pass", 10.0, 50)],
)
def test_default_substep_holds_the_bar_by_simulation(kind, corner, measure):
    damping = 0.1
    noise = SPEED_NOISES[kind](intensity=1.0, **({} if corner is None else {"corner_frequency": corner}))
    plant = started_plant(24_576, road="harmonic", speed_noise=noise, speed=1.0)
    terms = finite_terms("harmonic", kind)
    found, error = driven_mean_squares(plant, damping, 100, measure, terms)
    exact = exact_mean_squares("harmonic", noise, damping=damping, speed=1.0)[terms]
    assert np.all(error / exact < 0.0015)
    assert np.all(np.abs(found / exact - 1) < 0.005 + 3 * error / exact)


class IndependentPlant:
    """Low-pass noise on the speed of a random road, in plain NumPy: nothing of it comes from the package but parameters.

    The noise is exact, with the trapezoidal rule for the distance of a step. The road follows over that distance by Strang's
    splitting into half a rotation, the rest of the equation and half a rotation (first order: exact). Between, the level is a
    straight line, on which the car's motion is exact. The steps must be fine.
    """

    def __init__(self, road, noise, speed, damping, step, lanes, seed):
        self.generator = np.random.default_rng(seed)
        self.road, self.noise, self.speed, self.step = road, noise, speed, step
        self.damping = damping
        self.psi = noise.intensity / math.sqrt(2 * noise.corner_frequency) * self.normal(lanes)
        self.rate = np.maximum(speed + noise.corner_frequency * self.psi, 0)
        if road.kind == "multiplicative":
            self.square_radius = 2 * (road.shape + 1)
            radius = np.sqrt(self.square_radius * (1 - self.generator.random(lanes) ** (1 / road.shape)))
            angle = 2 * math.pi * self.generator.random(lanes)
            self.z, self.u = radius * np.cos(angle), radius * np.sin(angle)
        else:
            self.z, self.u = self.normal(lanes), self.normal(lanes)
        self.y, self.x = np.zeros(lanes), np.zeros(lanes)
        # Y, X, level and its rate over one step, the rate being constant
        drift = np.array([[0, 1, 0, 0], [-1, -2 * damping, 1, 2 * damping], [0, 0, 0, 1], [0, 0, 0, 0]])
        self.car = expm(step * drift)[:2]

    def normal(self, lanes):
        return self.generator.standard_normal(lanes)

    def advance(self):
        keep = math.exp(-self.noise.corner_frequency * self.step)
        noise = self.noise.intensity * math.sqrt((1 - keep**2) / (2 * self.noise.corner_frequency))
        self.psi = keep * self.psi + noise * self.normal(self.psi.size)
        old_rate, old_z = self.rate, self.z
        self.rate = np.maximum(self.speed + self.noise.corner_frequency * self.psi, 0)  # the car does not reverse
        self.advance_road((old_rate + self.rate) / 2 * self.step)
        self.y, self.x = self.car @ np.stack([self.y, self.x, old_z, (self.z - old_z) / self.step])

    def advance_road(self, angle):
        noise = self.normal(angle.size)
        if self.road.kind == "first_order":
            keep = np.exp(-angle)
            self.z = keep * self.z + np.sqrt(1 - keep**2) * noise
            return
        cosine, sine = np.cos(angle / 2), np.sin(angle / 2)
        z, u = cosine * self.z + sine * self.u, cosine * self.u - sine * self.z
        delta = self.road.bandwidth
        if self.road.kind == "gaussian":
            keep = np.exp(-2 * delta * angle)
            u = keep * u + np.sqrt(1 - keep**2) * noise
        else:  # in Stratonovich's calculus, on the circle, with half of the damping before and after the kick
            keep = np.exp(-delta * (1 - 1 / (2 * self.road.shape)) * angle)
            kick = np.sqrt(2 * delta * angle / self.road.shape) * noise
            u = keep * u
            u = u * np.cos(kick) + np.sqrt(np.maximum(self.square_radius - z**2 - u**2, 0)) * np.sin(kick)
            u = keep * u
        self.z, self.u = cosine * z + sine * u, cosine * u - sine * z

    def mean_squares(self, settle, measure, every=10):
        total, count = np.zeros((5, self.z.size)), 0
        for step in range(round((settle + measure) / self.step)):
            self.advance()
            if step * self.step >= settle and step % every == 0:
                slope = self.u if self.road.has_slope else 0.0
                travel, relative = self.y - self.z, self.x - self.rate * slope
                acceleration = 2 * self.damping * relative + travel
                total += np.stack([self.y, self.x, acceleration, travel, relative]) ** 2
                count += 1
        total /= count
        return total.mean(axis=1), total.std(axis=1, ddof=1) / math.sqrt(self.z.size)


@pytest.mark.statistical
@pytest.mark.parametrize("name", ["first_order", "gaussian", "multiplicative"])
def test_low_pass_noise_on_random_roads_agrees_with_an_independent_simulation(name):
    # strong noise: the speed would be negative for 8 % of the time, and is zero then
    noise, speed, damping = LowPassSpeedNoise(intensity=1.0, corner_frequency=1.0), 1.0, 0.3
    parameters = {} if name == "first_order" else {"bandwidth": 0.3}
    plant = started_plant(8192, road={"kind": name, **parameters}, speed_noise=noise, speed=speed)
    terms = finite_terms(name, "low_pass")
    found, error = driven_mean_squares(plant, damping, 20, 60, terms)
    witness = IndependentPlant(plant.task.road, noise, speed, damping, 0.025, 6000, seed=5)
    expected, its_error = (figures[terms] for figures in witness.mean_squares(20, 60))
    assert np.all(np.hypot(error, its_error) / expected < 0.01)
    assert np.all(np.abs(found - expected) < 4 * np.hypot(error, its_error))
    # the noise matters: at constant speed the figures are others
    constant = exact_mean_squares(plant.task.road, None, damping=damping, speed=speed)[terms]
    assert np.any(np.abs(found - constant) > 10 * np.hypot(error, its_error))


@pytest.mark.parametrize("name", list(SPEED_NOISES))
@pytest.mark.parametrize("corner", [10.0, 300.0, 3000.0])
def test_table_holds_for_any_corner(name, corner):
    """The variance of the angle a substep against its closed form, also where the filter is much faster than the substep."""
    interval = 0.1
    noise = SPEED_NOISES[name](intensity=0.5, **({} if name == "white" else {"corner_frequency": corner}))
    table = noise.table(interval, 1.0, HARMONIC)
    psi, angle = speed_module.FACTOR, slice(speed_module.FACTOR + 1, speed_module.FACTOR + 3)
    spread = table[speed_module.SPREAD]
    # given Psi at the start the angle has the pull times Psi and the factor times normals
    variance = (table[speed_module.PULL + 1] * spread) ** 2 + np.sum(table[angle] ** 2)
    assert variance == pytest.approx(phase_variance(noise, interval), rel=1e-6)
    if name != "white":
        assert table[psi] ** 2 + (table[speed_module.PULL] * spread) ** 2 == pytest.approx(spread**2, rel=1e-6)
