"""Roads of the classes of ISO 8608: their spectra, and what a car of two masses does on them."""

import math

import gymnasium
import numpy as np
import pytest

import analysis
import roadgym
from roadgym import FirstOrderRoad, GaussianRoad, MultiplicativeRoad, ParameterError, TwoMassCar
from roadgym.linear import LinearSystem
from roadgym.roads import make_road

CLASSES = {"A": 16e-6, "B": 64e-6, "C": 256e-6, "D": 1024e-6, "E": 4096e-6, "F": 16384e-6, "G": 65536e-6, "H": 262144e-6}


@pytest.mark.parametrize("road", [FirstOrderRoad, GaussianRoad, MultiplicativeRoad])
@pytest.mark.parametrize(("name", "density"), CLASSES.items())
def test_spectrum_is_that_of_the_class(road, name, density):
    """One-sided over the spatial frequency: between the corners G(n0) (n/n0)^-2, here off by (corner/n)^2 below 1e-4."""
    made = road.from_iso8608(name, lowest_frequency=1e-3, **({} if road is FirstOrderRoad else {"highest_frequency": 1e3}))
    n = np.array([0.1, 0.3, 1.0, 3.0])
    speed = 17.0
    two_sided = analysis.spectral_density(made, 2 * math.pi * n * speed, speed=speed)  # over the time, m^2 s
    np.testing.assert_allclose(2 * two_sided * speed, density * (n / 0.1) ** -2, rtol=2e-4)
    assert road.from_iso8608(density, **({"lowest_frequency": 1e-3})).wavenumber > 0


def test_heights_of_class_c():
    assert math.sqrt(make_road("iso_c").variance) == pytest.approx(0.02005, rel=1e-3)  # pi n0^2 G/(2 n_c), n_c = 0.01
    assert make_road("iso_c") == FirstOrderRoad.from_iso8608("c") == make_road({"kind": "first_order", "iso_class": 256e-6})
    bounded = make_road({"kind": "multiplicative", "iso_class": "C", "shape": 5.0})
    assert bounded.shape == pytest.approx(5.0)
    assert bounded.variance == pytest.approx(GaussianRoad.from_iso8608("C").variance)


@pytest.mark.parametrize(
    ("damper", "acceleration", "travel", "tyre"), [(665, 1.366, 14.5e-3, 5.16e-3), (1500, 1.587, 9.64e-3, 4.10e-3)]
)
def test_a_car_on_class_c_at_20_metres_a_second(damper, acceleration, travel, tyre):
    """Root mean squares on a road of white velocity, worked out by hand to three digits; the corner is far below here."""
    car, road = TwoMassCar(), FirstOrderRoad.from_iso8608("C", lowest_frequency=1e-5)
    damping = damper / (2 * math.sqrt(car.spring_rate * car.sprung_mass))
    ratio = 20.0 * road.wavenumber / car.natural_frequency
    system = LinearSystem.of(road.shaping_filter(), car.motion, damping=damping, ratio=ratio)
    found = {name: math.sqrt(road.variance * square) for name, square in system.mean_squares().items()}
    assert found["acceleration"] * car.natural_frequency**2 == pytest.approx(acceleration, rel=1e-3)  # m/s^2
    assert found["travel"] == pytest.approx(travel, rel=4e-3)
    assert found["tyre_deflection"] == pytest.approx(tyre, rel=2e-3)


def test_a_class_goes_wherever_a_road_goes():
    env = gymnasium.make(roadgym.ENVIRONMENT_ID, road="iso_d", car="two_mass", speed=20.0)
    assert env.unwrapped.task.road == FirstOrderRoad.from_iso8608("D")
    assert make_road({"kind": "gaussian", "iso_class": "A", "highest_frequency": 5.0}).bandwidth == pytest.approx(
        11.2, rel=1e-2
    )
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.task == env.unwrapped.task


@pytest.mark.parametrize(
    ("road", "message"),
    [
        ({"kind": "first_order", "iso_class": "J"}, "iso_class must be a letter of A, B, .* got 'J'"),
        ({"kind": "first_order", "iso_class": -1.0}, "iso_class must be positive, got -1"),
        ({"kind": "gaussian", "iso_class": "A", "lowest_frequency": 1, "highest_frequency": 0.5}, "must be above lowest_freq"),
        (
            {"kind": "gaussian", "iso_class": "A", "bandwidth": 0.1},
            "unknown parameter 'bandwidth' of road 'gaussian' beside 'iso_class'; known: iso_class, low",
        ),
        ("iso_z", "unknown road 'iso_z'; known: harmonic, .*iso_a"),
    ],
)
def test_bad_classes_are_told(road, message):
    with pytest.raises(ParameterError, match=message):
        make_road(road)


@pytest.mark.statistical
@pytest.mark.parametrize("spacing", [0.1, 0.5, 2.0])
def test_a_bounded_road_of_a_class_has_its_autocovariance_at_any_spacing(spacing):
    """Its second corner is far beyond: from point to point the fast motion forgets all."""
    road = MultiplicativeRoad.from_iso8608("C")
    _, heights = roadgym.sample_road(road, spacing=spacing, points=12, number=6000, seed=4)
    assert np.isfinite(heights).all()
    for lag in (0, 1, 5):
        products = heights[:, : 12 - lag] * heights[:, lag:]
        found = products.mean(axis=1)
        expected = road.variance * float(road.shaping_filter().autocovariance(road.wavenumber * spacing * lag))
        assert abs(found.mean() - expected) < 4.5 * found.std(ddof=1) / math.sqrt(len(found)), lag
