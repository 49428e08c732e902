"""Lower bounds where the car differs from episode to episode: the mean over the law of the cars, and what is driven."""

import numpy as np
import pytest

import analysis
import roadgym
from analysis.bounds import STATISTICAL, varied
from roadgym.parameters import ParameterError
from roadgym.plant import Plant
from roadgym.task import make_task

COMFORT = {"car": "two_mass", "road": "iso_c", "speed": 20.0, "vary": {"sprung_mass": (180.0, 300.0)}}


def test_the_cars_are_those_that_the_environment_draws():
    task = make_task(**COMFORT | {"vary": {"sprung_mass": (180.0, 300.0), "valve.rise_time": (0.0, 0.03)}})
    seeds = np.arange(40, dtype=np.uint64)
    plant = Plant(task, len(seeds), threads=1)
    plant.start(seeds)
    np.testing.assert_array_equal(task.vary.first_draws(seeds), plant.drawn)


def test_one_car_that_is_drawn_has_the_bound_of_that_car():
    """Its mass alone is another, so its damper covers other damping ratios."""
    drawn = make_task(**COMFORT | {"vary": {"sprung_mass": (180.0, 180.0001)}})  # bounds change by less than 1e-6 within
    same = make_task(car=roadgym.TwoMassCar(sprung_mass=180.0), road="iso_c", speed=20.0)
    bounds = [analysis.lower_bound(task, method="matrix_inequality").cost for task in (drawn, same)]
    assert bounds[0] == pytest.approx(bounds[1], rel=3e-6)


@pytest.mark.statistical
def test_where_the_damper_is_nearly_fixed_it_is_the_mean_of_the_closed_forms():
    """The law by Gauss's rule, and each car by itself, with the damper of the nominal one, in N s/m."""
    found = analysis.lower_bound(make_task(**COMFORT, damping_range=(0.3, 0.3 + 1e-6)), method="matrix_inequality", seed=2)
    nominal = roadgym.TwoMassCar()
    nodes, weights = np.polynomial.legendre.leggauss(8)
    exact = 0.0
    for node, weight in zip(nodes, weights, strict=True):
        car = roadgym.TwoMassCar(sprung_mass=240 + 60 * node)
        damping = car.damping_ratio(nominal.damping_coefficient(0.3))
        exact += weight / 2 * float(analysis.mean_squares("iso_c", damping=damping, speed=20.0, car=car).acceleration)
    assert found.cost == pytest.approx(exact, abs=4 * found.standard_error + 1e-4 * exact)
    assert found.standard_error < 0.01 * exact
    assert (found.rigour, found.method) == (STATISTICAL, "matrix_inequality")
    assert "told which car" in found.assumption


def test_too_many_draws_and_methods_that_have_none_are_told_in_one_line(monkeypatch):
    task = make_task(**COMFORT)
    with pytest.raises(
        ParameterError, match=r"^there is no lower bound for this task: cars that differ from episode to episode$"
    ):
        analysis.lower_bound(task, method="pathwise_multipliers")
    monkeypatch.setattr(varied, "PRECISION", 1e-6)
    with pytest.raises(ParameterError, match="would need more than 256 draws"):
        analysis.lower_bound(task, method="matrix_inequality")
