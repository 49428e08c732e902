"""Roads of any waviness: their spectrum against the law, the roads that there were before, and what is driven on them."""

import dataclasses
import json
import math

import numpy as np
import pytest

import analysis
import roadgym
from roadgym import GaussianRoad, ParameterError, PowerLawRoad
from roadgym.roads import make_road

DENSITY = 256e-6  # of class C at 0.1 cycles/m


def one_sided(road, frequency):
    """G(n), m^3, over the spatial frequency n, cycles/m."""
    return 2 * analysis.spectral_density(road, 2 * math.pi * np.asarray(frequency), speed=1.0)


@pytest.mark.parametrize("waviness", [1.5, 1.8, 2.3, 2.7, 3.0])
def test_the_spectrum_is_the_law_with_rounded_ends(waviness):
    road = PowerLawRoad.from_iso8608("C", waviness=waviness)
    n = np.geomspace(0.01, 10, 301)
    rounded = DENSITY * (0.1 / 0.01) ** waviness * (1 + (n / 0.01) ** 2) ** (-waviness / 2) / (1 + (n / 10) ** 2)
    away = 10 * np.log10(one_sided(road, n) / rounded)
    largest, typical = road.spectrum_error
    assert np.abs(away).max() == pytest.approx(largest, rel=0.02)
    assert np.sqrt(np.mean(away**2)) == pytest.approx(typical, rel=0.02)
    assert largest < 0.25
    middle = (n > 0.1) & (n < 1)  # far from both ends the plain law
    np.testing.assert_allclose(one_sided(road, n)[middle], DENSITY * (n[middle] / 0.1) ** -waviness, rtol=0.06)
    assert road.roughness == pytest.approx(DENSITY)


def test_waviness_two_is_the_second_order_road_of_iso_8608():
    road, known = PowerLawRoad.from_iso8608("C"), GaussianRoad.from_iso8608("C")
    n = np.geomspace(1e-4, 1e3, 50)
    np.testing.assert_allclose(one_sided(road, n), one_sided(known, n), rtol=1e-9)
    assert road.variance == pytest.approx(known.variance, rel=1e-9)
    assert road.slope_variance == pytest.approx(1000.0, rel=1e-9)  # k1 k2 = 1000 k1^2
    assert max(road.spectrum_error) < 1e-6
    for speed, car in ((20.0, roadgym.TwoMassCar()), (5.0, roadgym.QuarterCar(natural_frequency=8.0))):
        mine, theirs = (analysis.mean_squares(each, damping=0.3, speed=speed, car=car) for each in (road, known))
        for name, square in mine.items():
            assert square == pytest.approx(theirs[name], rel=1e-6), name


@pytest.mark.parametrize(("waviness", "within"), [((2.0, 2.5), 0.3), ((2.5, 2.0), 0.3), ((1.5, 3.0), 0.7), ((3.0, 2.0), 0.7)])
def test_two_slopes_break_where_they_should(waviness, within):
    """The law is continuous, and has its density at n0, above the break or below it."""
    for broken in (0.05, 0.5):
        road = PowerLawRoad.from_iso8608("C", waviness=waviness, break_frequency=broken, lowest_frequency=0.002)
        assert road.roughness == pytest.approx(DENSITY)
        n = np.array([broken / 5, broken * 5])
        at_break = DENSITY * (broken / 0.1) ** -(waviness[1] if broken < 0.1 else waviness[0])
        away = 10 * np.log10(one_sided(road, n) / (at_break * (n / broken) ** -np.array(waviness)))
        assert np.abs(away).max() < within + 0.2
        assert road.spectrum_error[0] < 1.4
        assert road.spectrum_error[1] < within


@pytest.mark.statistical
def test_profiles_have_the_spectrum():
    """Periodograms of slopes under Hann's window, averaged over bands and profiles; below a tenth of the Nyquist frequency."""
    road, spacing, points, number = PowerLawRoad.from_iso8608("B", waviness=2.6), 0.02, 2**15, 16
    _, heights = roadgym.sample_road(road, spacing=spacing, points=points, number=number, seed=4)
    window = np.hanning(points - 1)
    density = np.abs(np.fft.rfft(np.diff(heights) * window)) ** 2 * 2 * spacing / np.sum(window**2)
    n = np.fft.rfftfreq(points - 1, spacing)[1:]
    density = density[:, 1:] / (2 * np.sin(math.pi * n * spacing)) ** 2
    for low, high in ((0.05, 0.1), (0.2, 0.4), (1.0, 2.0)):
        band = (n > low) & (n < high)
        ratios = (density[:, band] / one_sided(road, n[band])).mean(axis=1)
        assert abs(ratios.mean() - 1) < 4 * ratios.std(ddof=1) / math.sqrt(number) + 0.01


@pytest.mark.statistical
def test_a_road_in_metres_is_certified():
    road = PowerLawRoad.from_iso8608("C", waviness=2.3, lowest_frequency=0.3)
    certificate = analysis.certify(road, car="two_mass", speed=25.0, lanes=1024)
    assert certificate.passed, certificate.table()


def test_it_is_made_by_name_and_survives_being_a_mapping():
    parameters = {"kind": "power_law", "iso_class": "D", "waviness": [1.8, 2.6], "break_frequency": 0.2}
    road = make_road(json.loads(json.dumps(parameters)))
    assert road == PowerLawRoad.from_iso8608("d", waviness=(1.8, 2.6), break_frequency=0.2)
    assert make_road(json.loads(json.dumps(dataclasses.asdict(road)))) == road
    assert {road: 1}[road] == 1
    assert road.has_slope


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"waviness": 1.2}, r"waviness must lie within \[1.5, 3.5\], got 1.2"),
        ({"waviness": (2.0, 5.0), "break_ratio": 3.0}, r"waviness, above the break, must lie within"),
        ({"waviness": (2.0, 2.5, 3.0)}, "waviness must be one number or a pair, got"),
        ({"waviness": (2.0, 2.5)}, "break_ratio must be given with a pair of waviness, and only then, got None"),
        ({"break_ratio": 4.0}, "break_ratio must be given with a pair of waviness, and only then, got 4.0"),
        ({"waviness": (2.0, 2.5), "break_ratio": 30.0}, "break_ratio must be below band_ratio, 30, got 30"),
        ({"band_ratio": 1.0}, "band_ratio must lie within"),
        ({"iso_class": "C", "break_frequency": -1.0}, "break_frequency must be positive, got -1"),
    ],
)
def test_bad_parameters_are_told(parameters, message):
    with pytest.raises(ParameterError, match=message):
        make_road({"kind": "power_law", **parameters})
