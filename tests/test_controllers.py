"""Controllers and the features of learned ones."""

import numpy as np
import pytest

import analysis
from agents.controllers import CONTROLLERS, AnalyticOptimum, ConstantDamping, SkyhookOnOff, make_controller
from agents.features import Features
from roadgym import ParameterError
from roadgym.task import make_task

TASK = make_task(speed=(0.5, 3.0), bandwidth=(0.05, 0.5))
SIGNALS = ("displacement", "velocity", "level", "slope", "speed", "bandwidth")


def observe(**signals):
    """Observations, shape (n, signals), of operating points and states by name."""
    signals = {name: np.atleast_1d(np.asarray(value, float)) for name, value in signals.items()}
    if "speed" in signals:
        signals["speed"] = signals["speed"] / (1 + signals["speed"])
    if "bandwidth" in signals:
        signals["bandwidth"] = 2 * signals["bandwidth"] / (1 + 2 * signals["bandwidth"])
    n = max(len(value) for value in signals.values())
    columns = [np.broadcast_to(signals.get(name, np.zeros(1)), n) for name in SIGNALS]
    return np.stack(columns, axis=1).astype(np.float32)


@pytest.mark.parametrize("name", list(CONTROLLERS))
def test_every_controller_answers_within_the_range(name):
    controller = make_controller(name, TASK)
    state = np.random.default_rng(1).standard_normal((4, 9))
    observation = observe(displacement=state[0], velocity=state[1], level=state[2], slope=state[3], speed=1.5, bandwidth=0.1)
    damping, _ = controller.predict(observation)
    assert damping.shape == (9, 1)
    assert damping.dtype == np.float32
    assert np.all((damping >= np.float32(0.05)) & (damping <= 1))
    single, _ = controller.predict(observation[3])
    assert single.shape == (1,)
    assert single == damping[3]


def test_analytic_optimum_follows_the_operating_point():
    controller = AnalyticOptimum(TASK)
    points = [(2.0, 0.1), (3.0, 0.3), (0.7, 0.1), (2.0, 0.1)]
    observation = observe(speed=[v for v, _ in points], bandwidth=[b for _, b in points])
    damping, _ = controller.predict(observation)
    for value, (speed, bandwidth) in zip(damping[:, 0], points, strict=True):
        road = TASK.road.with_bandwidth(bandwidth)
        assert value == pytest.approx(analysis.optimal_damping(road, speed=speed).damping, rel=1e-4)
    assert damping[2] == 1.0  # below nu = sqrt(2) the firmest damper is the best
    assert np.all(controller.predict(observation[::-1])[0] == damping[::-1])


def test_skyhook_brakes_the_body_and_nothing_else():
    # relative velocity = velocity - nu * slope, with nu = 2
    observation = observe(velocity=[1, 1, -1, -1], slope=[0.25, 0.75, -0.25, -0.75], speed=2.0, bandwidth=0.1)
    damping, _ = SkyhookOnOff(TASK).predict(observation)
    assert damping[:, 0] == pytest.approx([1.0, 0.05, 1.0, 0.05])


def test_controllers_say_which_signal_they_miss():
    with pytest.raises(ParameterError, match="SkyhookOnOff needs the signal 'slope'; the task observes displacement"):
        SkyhookOnOff(make_task(road="first_order"))
    with pytest.raises(ParameterError, match="unknown controller 'fuzzy'; known: analytic_optimum"):
        make_controller("fuzzy", TASK)
    with pytest.raises(ParameterError, match="observation must have 6 signals"):
        ConstantDamping(TASK, 0.3).predict(np.zeros((2, 3), np.float32))


def test_products_alone_are_even_and_signals_are_kept():
    observation = observe(displacement=[0.5, 2], velocity=[1, -1], level=[-0.3, 4], slope=[2, 0.1], speed=1.5, bandwidth=0.1)
    mirrored = observation.copy()
    mirrored[:, :4] *= -1
    even = Features(SIGNALS, ["products"])
    np.testing.assert_array_equal(even(observation), even(mirrored))
    assert even(observation).shape == (2, even.size) == (2, 12)
    both = Features(SIGNALS, ["signals", "products"])
    assert both(observation).shape == (2, 16)
    np.testing.assert_array_equal(both(observation)[:, 2:6], observation[:, :4])
    scale = np.sqrt(1 + np.sum(observation[0, :4] ** 2))
    assert both(observation)[0, 7] == pytest.approx(observation[0, 0] * observation[0, 1] / scale)
    with pytest.raises(ParameterError, match="features must be a selection of signals, products"):
        Features(SIGNALS, ["cubes"])
