"""Road and car as matrices: against every closed form, against the kernel, and against each other."""

import dataclasses

import numpy as np
import pytest
from plants import EVERY_ROAD
from scipy.integrate import quad

import analysis
from analysis.quadratic import advantage_forms, interval_mean, periodic_mean_squares, plant_system, value_form
from roadgym import MEAN_SQUARES, ROADS, ParameterError, QuarterCar
from roadgym.linear import LinearSystem
from roadgym.plant import Plant
from roadgym.roads import make_road
from roadgym.task import make_task

LINEAR = [name for name in ROADS if make_road(EVERY_ROAD[name]).shaping_filter() is not None]


def system_of(name, damping=0.3, ratio=1.3, bandwidth=0.2):
    road = make_road(name)
    known = bandwidth if hasattr(road, "bandwidth") else None
    return LinearSystem.of(road.shaping_filter(known), QuarterCar().motion, damping=damping, ratio=ratio)


@pytest.mark.parametrize("name", LINEAR)
def test_mean_squares_are_the_closed_forms_at_a_thousand_points(name):
    generator, number = np.random.default_rng(1), 1000
    damping = np.exp(generator.uniform(np.log(0.02), np.log(3), number))
    ratio = np.exp(generator.uniform(np.log(0.05), np.log(8), number))
    bandwidth = np.exp(generator.uniform(np.log(0.01), np.log(2), number))
    road = make_road(name)
    own = {"bandwidth": bandwidth} if hasattr(road, "bandwidth") else {}
    exact = analysis.mean_squares(road, damping=damping, speed=ratio, **own)
    found = system_of(name, damping, ratio, bandwidth).mean_squares()
    assert tuple(found) == MEAN_SQUARES
    for signal, values in found.items():
        np.testing.assert_allclose(values, getattr(exact, signal) / road.variance, rtol=1e-10)


@pytest.mark.parametrize("name", ["first_order", "gaussian"])
def test_small_differences_of_large_numbers_are_right(name):
    """At the ends of the range: a slow road, which the car follows, and a damper that is nearly rigid."""
    generator, number = np.random.default_rng(2), 2000
    damping = np.exp(generator.uniform(np.log(1e-3), np.log(100), number))
    ratio = np.exp(generator.uniform(np.log(1e-3), np.log(1e3), number))
    road = make_road(name)
    found = system_of(name, damping, ratio, np.full(number, 0.1)).mean_squares()
    own = {"bandwidth": 0.1} if name == "gaussian" else {}
    exact = analysis.mean_squares(road, damping=damping, speed=ratio, **own)
    for signal, values in found.items():
        np.testing.assert_allclose(values, getattr(exact, signal) / road.variance, rtol=2e-8)


@pytest.mark.statistical
@pytest.mark.parametrize("name", LINEAR)
def test_kernel_moves_the_state_as_the_matrices_do(name):
    """Each equation stands once in Python and once compiled: mean and covariance of the state after a quarter of a period."""
    lanes, steps = 200_000, 8
    task = make_task(road=name, speed=1.3, damping_range=(0.05, 0.7), precision="float64")
    bandwidth = task.bandwidth[0]
    system = plant_system(task, float(np.float32(0.7)), 1.3, bandwidth)
    kept = ("displacement", "velocity", *task.road.state_rows)
    start = np.array([0.8, -0.5, 0.7, -0.4, 0.3, -0.2])[: len(system.states)]
    plant = Plant(task, lanes)
    plant.start(np.arange(lanes, dtype=np.uint64))
    for row, value in zip(kept, start, strict=True):
        plant.set_row(row, value)
    if name in ("two_corner", "power_law"):  # whose level is a sum of their states
        plant.set_row("level", task.road.shaping_filter().level @ start[2:])
    if name == "harmonic":  # which lives on a circle, to which its kernel returns it
        start[2:] *= np.sqrt(2) / np.hypot(*start[2:])
        plant.set_row("level", start[2])
        plant.set_row("slope", start[3])
    for _ in range(steps):
        plant.step(np.full(lanes, 0.7, np.float32))
    time = steps * task.control_interval
    states = np.concatenate([plant.car_states, plant.road_states]).T.astype(float)
    size = len(start)
    backward, _ = interval_mean(system, np.zeros((size, size)), time)
    mean = system.transition(time) @ start
    second = (np.append(np.outer(start, start).ravel(), 1.0) @ backward)[:-1].reshape(size, size)
    error = states.std(axis=0) / np.sqrt(lanes)
    np.testing.assert_array_less(np.abs(states.mean(axis=0) - mean), 4.5 * error + 1e-5)
    for i in range(size):
        for k in range(i + 1):
            products = states[:, i] * states[:, k]
            assert abs(products.mean() - second[i, k]) < 4.5 * products.std() / np.sqrt(lanes) + 1e-4


@pytest.mark.parametrize("name", ["first_order", "gaussian", "multiplicative"])
def test_spectrum_and_autocovariance_are_those_of_the_mean_square(name):
    system = system_of(name)
    for signal in [signal for signal in system.signals if signal not in system.rough]:
        square = float(system.mean_squares()[signal])
        assert system.autocovariance(signal, 0.0)[0] == pytest.approx(square, rel=1e-12)
        # the tail of the spectrum falls as 1/w^2 or faster; beyond 4000 lies less than 1e-3 of it
        density = lambda w, signal=signal: system.spectrum(signal, w)[0]  # noqa: E731
        inside = quad(density, 0, 20, limit=200)[0] + quad(density, 20, 4000, limit=200)[0]
        assert inside / np.pi == pytest.approx(square, rel=1e-3)
        lag = 0.7
        wave = quad(density, 0, 4000, weight="cos", wvar=lag, limit=2000)[0] / np.pi
        assert wave == pytest.approx(system.autocovariance(signal, lag)[0], abs=2e-3 * square)


def test_what_contains_white_noise_has_no_spectrum_and_no_cost():
    system = system_of("first_order")
    assert system.rough == {"acceleration", "relative_velocity"}
    for ask in (lambda: system.spectrum("acceleration", 1.0), lambda: system.cost_form({"relative_velocity": 1.0})):
        with pytest.raises(ParameterError, match="contains white noise"):
            ask()
    with pytest.raises(ParameterError, match="unknown signal 'comfort'; known: displacement"):
        system.autocovariance("comfort", 1.0)
    with pytest.raises(ParameterError, match="set of lines"):
        system_of("harmonic").spectrum("displacement", 1.0)


@pytest.mark.parametrize("name", ["first_order", "gaussian", "multiplicative"])
def test_value_and_advantage_know_the_mean_costs(name):
    """The performance difference lemma between two constants, on every road with noise."""
    task = make_task(road=name, reward={"displacement": 1.0, "travel": 0.4})
    delta = [task.bandwidth[0]]
    forms, constants = advantage_forms(task, [0.1, 0.6], [0.3], [1.3], delta)
    costs = {}
    for damping in (0.1, 0.3, 0.6):
        system = plant_system(task, damping, 1.3, delta[0])
        squares = system.mean_squares()
        costs[damping] = float(squares["displacement"] + 0.4 * squares["travel"])
        assert float(value_form(system, task.weights_by_name)[1]) == pytest.approx(costs[damping], rel=1e-9)
    for k, damping in enumerate((0.1, 0.6)):
        covariance = plant_system(task, damping, 1.3, delta[0]).covariance()
        mean = np.sum(forms[0, k] * covariance) + constants[0, k]
        assert mean / task.control_interval == pytest.approx(costs[damping] - costs[0.3], rel=1e-5)


def test_alternating_damping_against_an_independent_simulation():
    """D = 1 and 0.05 in turn, each for 0.2/w1; a simulation of (7), (8), (13) in steps of 0.002/w1 gave these."""
    measured = {"displacement": 1.79318, "velocity": 1.41182, "acceleration": 2.09384, "travel": 0.63403}
    errors = {"displacement": 2e-5, "velocity": 2e-5, "acceleration": 2e-5, "travel": 1e-5}
    for name in ("gaussian", "multiplicative"):
        found = periodic_mean_squares([system_of(name, damping, 0.93, 0.13) for damping in (1.0, 0.05)], 0.2)
        for signal, value in measured.items():
            assert abs(float(found[signal]) - value) < 4 * errors[signal]


@pytest.mark.parametrize("name", LINEAR)
def test_switching_between_equal_dampings_is_constant_damping(name):
    system = system_of(name)
    found = periodic_mean_squares([system, system], 0.2)
    squares = system.mean_squares()
    assert set(found) == set(squares) - system.rough
    for signal, value in found.items():
        assert float(value) == pytest.approx(float(squares[signal]), rel=1e-8)


def test_an_ellipse_has_second_moments_but_no_conditional_ones():
    road = make_road({"kind": "multiplicative", "bandwidth": 0.3, "noise_intensity": 0.4, "slope_bound": 0.7})
    assert road.shaping_filter().flatness is None
    system = LinearSystem.of(road.shaping_filter(), QuarterCar().motion, damping=0.3, ratio=1.0)
    assert np.isfinite(list(system.mean_squares().values())).all()
    with pytest.raises(ParameterError, match="conditional moments"):
        system.form_generator()
    assert dataclasses.replace(system, flatness=0.0).form_generator().shape == (17, 17)
