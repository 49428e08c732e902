"""The scheme of road and car: its bias, exactly, from a discrete Lyapunov equation, and by simulation."""

import inspect
import itertools
import re

import numba
import numpy as np
import pytest
from numba import cfunc, types
from packaging.version import Version
from scipy.linalg import expm, solve_discrete_lyapunov

import analysis
from roadgym import MEAN_SQUARES, GaussianRoad, MultiplicativeRoad
from roadgym import compiled as rows
from roadgym.cars import one_mass
from roadgym.noise import fill_words
from roadgym.plant import Plant
from roadgym.resolution import LARGEST_ANGLE
from roadgym.roads import gaussian, multiplicative
from roadgym.roads.gaussian import oscillator
from roadgym.roads.multiplicative import rotations
from roadgym.task import make_task

SHAPES = (0.5, 1.0, 2.0, 10.0)
CORNERS = list(itertools.product((0.05, 0.1, 0.3, 1.0), (0.05, 0.1, 0.5)))  # damping, bandwidth


def started_plant(number, **parameters):
    plant = Plant(make_task(**parameters), number, threads=1)
    plant.start(np.zeros(number, np.uint64))  # one seed: every lane meets the same words
    return plant


def car_map(damping, speed, interval):
    """Rows of the kernel's own linear map to (Y1, X1) from (Y0, X0, Z0, U0, Z1, U1), by its answers to random states."""
    plant = started_plant(
        64,
        road=GaussianRoad(bandwidth=0.3, noise_intensity=1.0),
        speed=speed,
        control_interval=interval,
        substeps=1,
        precision="float64",
        damping_range=(0.01, 2.0),
    )
    states = np.random.default_rng(5).standard_normal((4, 64))
    # different seeds: the ends (Z1, U1) must not be a function of the beginnings
    plant.seed(np.arange(64, dtype=np.uint64), np.ones(64, np.bool_))
    for row, values in zip(("displacement", "velocity", rows.LEVEL, rows.SLOPE), states, strict=True):
        plant.set_row(row, values)
    plant.step(np.full(64, damping, np.float32))
    ends = np.stack([plant.row("level"), plant.row("slope")])
    answer = plant.car_states
    solution, residual, rank, _ = np.linalg.lstsq(np.vstack([states, ends]).T, answer.T, rcond=None)
    assert rank == 6
    assert np.all(residual < 1e-20)  # the map is linear
    return solution.T


def scheme_mean_squares(damping, speed, bandwidth, interval):
    """Stationary mean squares of the discrete scheme in units of E Z^2: a discrete Lyapunov equation for (Y, X, Z, U)."""
    angle = speed * interval
    transition = expm(angle * np.array([[0, 1], [-1, -2 * bandwidth]]))
    car = car_map(np.float32(damping), speed, interval)
    matrix = np.zeros((4, 4))
    matrix[:2, :2] = car[:, :2]
    matrix[:2, 2:] = car[:, 2:4] + car[:, 4:] @ transition
    matrix[2:, 2:] = transition
    entry = np.vstack([car[:, 4:], np.eye(2)])
    covariance = solve_discrete_lyapunov(matrix, entry @ (np.eye(2) - transition @ transition.T) @ entry.T)
    y, x, z, u = np.eye(4)
    relative, travel = x - speed * u, y - z
    signals = (y, x, -2 * damping * relative - travel, travel, relative)
    return np.array([signal @ covariance @ signal for signal in signals])


@pytest.mark.parametrize("speed", [0.3, 1.0, 3.0])
def test_scheme_has_the_mean_squares_of_the_closed_forms(speed):
    interval = LARGEST_ANGLE / max(1.0, speed)  # the longest substep that a task may have
    for damping, bandwidth in CORNERS:
        damping = float(np.float32(damping))
        road = GaussianRoad(bandwidth=bandwidth, noise_intensity=1.0)
        theory = analysis.mean_squares(road, damping=damping, speed=speed)
        expected = np.array([getattr(theory, name) for name in MEAN_SQUARES]) / road.variance
        found = scheme_mean_squares(damping, speed, bandwidth, interval)
        # the bar is 0.5 %; the scheme is of fourth order and does far better
        assert np.all(np.abs(found / expected - 1) < 1e-4)


def test_bias_falls_with_the_fourth_power_of_the_substep():
    theory = analysis.mean_squares(GaussianRoad(bandwidth=0.1, noise_intensity=1.0), damping=0.1, speed=1.0)
    expected = np.array([getattr(theory, name) for name in MEAN_SQUARES]) / (1 / 0.4)
    intervals = np.array([0.2, 0.4, 0.8])
    bias = np.array([np.abs(scheme_mean_squares(np.float32(0.1), 1.0, 0.1, h) / expected - 1) for h in intervals])
    orders = np.log2(bias[1:] / bias[:-1])
    assert np.all(orders > 3.4)


@pytest.mark.parametrize("bandwidth", [1e-3, 0.05, 0.5, 1.0, 3.0])
@pytest.mark.parametrize("angle", [1e-3, 0.05, 0.1])
def test_both_second_order_roads_have_the_exact_conditional_mean(bandwidth, angle):
    exact = expm(angle * np.array([[0, 1], [-1, -2 * bandwidth]]))
    a, b, d = oscillator(angle, bandwidth)
    np.testing.assert_allclose([[a, b], [-b, d]], exact, rtol=1e-12, atol=1e-14)

    short, long, keep = rotations(angle, bandwidth)
    rotate = [np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]]) for t in (short, long)]
    kick = np.diag([1.0, keep])
    # what is left is rounding, which the arc cosine of nearly 1 lifts to about 1e-16/angle
    np.testing.assert_allclose((rotate[0] @ kick @ rotate[1] + rotate[1] @ kick @ rotate[0]) / 2, exact, rtol=1e-9, atol=1e-11)


def test_free_decay_is_the_matrix_exponential():
    for damping in (0.05, 0.999, 1.0, 1.001, 5.0):
        plant = started_plant(
            2, road="harmonic", speed=1e-9, damping_range=(0.01, 9.0), control_interval=0.1, substeps=1, precision="float64"
        )
        plant.set_row("level", 0.0)
        plant.set_row("slope", 0.0)
        plant.set_row("displacement", [1.0, 0.0])
        plant.set_row("velocity", [0.0, 1.0])
        plant.step(np.full(2, damping, np.float32))
        exact = expm(0.1 * np.array([[0, 1], [-1, -2 * np.float64(np.float32(damping))]]))
        found = np.stack([plant.row("displacement"), plant.row("velocity")])
        # the level is a circle of radius sqrt(2) that starts at 0: it stays there to 1e-9
        np.testing.assert_allclose(found, exact, atol=2e-8)


@pytest.mark.statistical
@pytest.mark.parametrize("road", ["gaussian", *SHAPES])
def test_simulated_mean_squares_agree_with_the_closed_forms(road):
    bandwidth, speed, damping, lanes = 0.2, 1.3, np.float32(0.3), 16384
    if road == "gaussian":
        the_road = GaussianRoad(bandwidth=bandwidth, noise_intensity=1.0)
    else:
        the_road = MultiplicativeRoad.from_shape(shape=road, bandwidth=bandwidth, level_bound=0.9)
    task = make_task(road=the_road, speed=speed)
    plant = Plant(task, lanes)
    plant.start(np.arange(lanes, dtype=np.uint64))
    actions = np.full(lanes, damping)
    for _ in range(120):  # exp(-2 D t) is below 1e-6 after 24 time units
        plant.step(actions)
    steps = 500
    total = sum(plant.step(actions).mean_squares.astype(float) for _ in range(steps)) / steps
    theory = analysis.mean_squares(the_road, damping=float(damping), speed=speed)
    expected = np.array([getattr(theory, name) for name in MEAN_SQUARES]) / the_road.variance
    error = total.std(axis=1, ddof=1) / np.sqrt(lanes)
    assert np.all(error / expected < 0.003)
    assert np.all(np.abs(total.mean(axis=1) - expected) < 4 * error)


def test_single_precision_costs_less_than_the_bar():
    """The same noise in both precisions: what rounding does to the mean squares over 2000 substeps."""
    found = {}
    for precision in ("float32", "float64"):
        plant = Plant(make_task(road="gaussian", speed=1.5, precision=precision), 512)
        plant.start(np.arange(512, dtype=np.uint64))
        actions = np.full(512, 0.05, np.float32)  # the softest damper forgets least, so rounding piles up most
        found[precision] = sum(plant.step(actions).mean_squares.astype(float) for _ in range(700)) / 700
    each = np.abs(found["float32"] / found["float64"] - 1)
    overall = np.abs(found["float32"].mean(axis=1) / found["float64"].mean(axis=1) - 1)
    # the free decay is rounded by 2^-24, its own loss a substep is D times the angle: 1.8e-5 of it, and the bar is 5e-3
    assert overall.max() < 3 * 2.0**-24 / (0.05 * 1 / 15)
    assert each.max() < 1e-4


def test_car_is_continuous_when_the_damping_jumps():
    plant = started_plant(2, road="gaussian", control_interval=0.001, substeps=1, precision="float64")
    before = plant.row("displacement"), plant.row("velocity")
    plant.step(np.array([0.05, 1.0], np.float32))
    after = plant.row("displacement"), plant.row("velocity")
    # both lanes meet the same road; in 1e-3 time units the velocity moves by about 2 D times that, no more
    assert np.all(np.abs(after[0] - before[0]) < 1e-2)
    assert np.all(np.abs(after[1] - before[1]) < 1e-2)


@pytest.mark.parametrize("function", [one_mass.advance, one_mass.prepare, gaussian.advance, multiplicative.advance, fill_words])
def test_loops_over_lanes_are_vector_instructions(function):
    """The optimised code multiplies whole vectors, so the inner loop runs over lanes."""
    if function is multiplicative.advance and Version(numba.__version__) < Version("0.62"):
        pytest.skip("the LLVM of numba below 0.62 leaves the bounded road's loop as it is, slow and right")
    number = types.uint32 if function is fill_words else types.float32
    names = inspect.signature(function.function).parameters
    signature = types.void(*(types.CPointer(types.uint32 if name == "words" else number) for name in names))
    code = cfunc(signature, error_model="numpy", fastmath={"contract"})(function.function)._library.get_llvm_str()
    assert re.search(r"mul .*<\d+ x (float|i64)>", code)
