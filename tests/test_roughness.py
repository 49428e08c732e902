"""Spectrum, class, waviness and roughness index of profiles: against closed forms, independent sums, and simulated roads."""

import dataclasses
import json
import math

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

import analysis
import roadgym
from analysis.autocovariance import autocovariance
from analysis.roughness import BASE, IRI_SPEED, golden_car
from analysis.spectra import TAPERS, expected_ordinates, ordinates, sine_tapers
from roadgym import FirstOrderRoad, GaussianRoad, ParameterError, TwoMassCar
from roadgym.roads import iso8608

DENSITY = 256e-6  # of class C at n0


def cosines(rng, *, density=DENSITY, waviness=2.0, length=1000.0, spacing=0.1, highest=4.0):
    """Somebody else's generator: a sum of cosines of fixed amplitudes, from the one-sided density."""
    distance, n = np.arange(0, length, spacing), np.arange(1, round(highest * length)) / length
    amplitude = np.sqrt(2 * density * (n / 0.1) ** -waviness / length)
    phase = rng.uniform(0, 2 * math.pi, n.size)
    return sum(a * np.cos(2 * math.pi * k * distance + p) for a, k, p in zip(amplitude, n, phase, strict=True))


def gaussian_waves(rng, waviness, *, points=10_000, spacing=0.1):
    """A Gaussian profile of class C at n0 up to the Nyquist frequency: random Fourier coefficients of four times the length."""
    number = 4 * points
    n = np.fft.rfftfreq(number, spacing)
    density = np.append(0.0, DENSITY * (n[1:] / 0.1) ** -waviness)
    normal = rng.normal(size=(2, n.size))
    coefficients = (normal[0] + 1j * normal[1]) * np.sqrt(density * number / (4 * spacing))
    return np.fft.irfft(coefficients, number)[:points]


@pytest.fixture(scope="module")
def class_c():
    """Profiles of class C that goes on far below the band and above it."""
    road = FirstOrderRoad.from_iso8608("C", lowest_frequency=1e-3)
    return roadgym.sample_road(road, spacing=0.1, points=10_000, number=60, seed=7)[1]


# the spectrum


@pytest.mark.statistical
@pytest.mark.parametrize("road", [GaussianRoad(bandwidth=0.05), FirstOrderRoad(), GaussianRoad.from_iso8608("C")])
def test_mean_ordinates_are_exact_whatever_folds_and_leaks(road):
    spacing, points, number = 0.3, 1500, 400
    _, heights = roadgym.sample_road(road, spacing=spacing, points=points, number=number, seed=1)
    expected = expected_ordinates(autocovariance(road, None, spacing * np.arange(points), speed=1.0))
    ratio = ordinates(heights) / expected
    groups = np.array_split(ratio, 12, axis=1)
    means = np.array([group.mean(axis=1) for group in groups])
    away = (means.mean(axis=1) - 1) / (means.std(axis=1, ddof=1) / math.sqrt(number))
    assert np.abs(away).max() < 4
    assert ratio.var(axis=0).mean() == pytest.approx(1 / TAPERS, rel=0.05)  # 2 K degrees of freedom


def test_a_trend_has_no_spectrum():
    _, heights = roadgym.sample_road("iso_c", spacing=0.1, points=3000, seed=2)
    plain = analysis.profile_spectrum(heights[0], 0.1)
    tilted = analysis.profile_spectrum(heights[0] + 580.0 + 0.03 * np.arange(3000), 0.1)
    np.testing.assert_allclose(tilted.density, plain.density, rtol=1e-6)
    np.testing.assert_allclose(sine_tapers(500) @ sine_tapers(500).T, np.eye(TAPERS), atol=1e-12)


def test_the_bands_are_those_of_the_standard_and_keep_the_mean():
    _, heights = roadgym.sample_road("iso_c", spacing=0.05, points=60_000, seed=2)
    spectrum = analysis.profile_spectrum(heights[0], 0.05)
    bands = spectrum.smoothed()
    known = [0.0312, 0.0496, 0.0625, 0.0787, 0.0992, 0.125, 0.1575, 0.1984, 0.25, 0.2888]  # its table
    first = int(np.argmin(np.abs(bands.centre - 0.0312)))
    np.testing.assert_allclose(bands.centre[first : first + 10], known, rtol=2e-3)
    np.testing.assert_allclose(bands.high[:-1], bands.low[1:], rtol=1e-12)
    np.testing.assert_allclose(np.diff(np.log2(bands.centre[-5:])), 1 / 12, rtol=1e-9)
    cell = spectrum.frequency[1] - spectrum.frequency[0]
    edges = spectrum.frequency - cell / 2
    for k in (2, 5, 20):
        shares = np.clip(np.minimum(edges + cell, bands.high[k]) - np.maximum(edges, bands.low[k]), 0, None)
        assert bands.density[k] == pytest.approx(shares @ spectrum.density / shares.sum(), rel=1e-9)
    assert np.all(bands.degrees_of_freedom >= 2 * TAPERS)


# class and waviness


@pytest.mark.statistical
def test_roughness_and_waviness_are_found_within_their_errors(class_c):
    """Distances from the truth in standard errors: of mean 0 and deviation 1, for waviness free and given."""
    scores, sound = [], []
    for heights in class_c:
        found = analysis.fit_iso8608(heights, 0.1, folded=True)
        free, standard = found.free, found.standard
        scores.append(
            [
                math.log(free.roughness / DENSITY) / free.relative_error,
                (free.waviness - 2) / free.waviness_error,
                math.log(standard.roughness / DENSITY) / standard.relative_error,
            ]
        )
        sound.append(standard.fit.p_value)
        assert free.iso_class == standard.iso_class == "C"
        assert min(standard.limit_distances) > 10
    scores = np.array(scores)
    assert np.abs(scores.mean(axis=0)).max() < 4 / math.sqrt(len(scores))
    np.testing.assert_array_less(np.abs(scores.std(axis=0, ddof=1) - 1), 0.35)
    assert np.abs(scores).max() < 4
    assert np.mean(np.array(sound) < 0.05) < 0.2


@pytest.mark.statistical
@pytest.mark.parametrize("waviness", [1.7, 2.6])
def test_another_waviness_is_found_and_the_standard_one_refused(waviness):
    generator = np.random.default_rng(3)
    heights = [gaussian_waves(generator, waviness) for _ in range(12)]
    scores = []
    for row in heights:
        found = analysis.fit_iso8608(row, 0.1)
        scores.append((found.free.waviness - waviness) / found.free.waviness_error)
        assert found.standard.fit.p_value < 1e-6
        assert found.free.fit.p_value > 1e-3
        made = found.road()
        assert made.roughness == pytest.approx(found.free.roughness)
        assert made.waviness == found.free.waviness
    assert np.abs(scores).max() < 4
    assert abs(np.mean(scores)) < 4 / math.sqrt(len(scores))


def test_what_folds_back_is_told_apart():
    """A sum of cosines ends below the Nyquist frequency; the points of an endless law do not, and look rougher up there."""
    heights = cosines(np.random.default_rng(1))
    plain, folded = (analysis.fit_iso8608(heights, 0.1, folded=folded).free for folded in (False, True))
    assert abs(plain.waviness - 2) < 3 * plain.waviness_error
    assert folded.waviness > plain.waviness + 2 * folded.waviness_error


def test_classes():
    for name, mean in iso8608.MEANS.items():
        for factor in (0.51, 1.0, 1.99):
            law = analysis.roughness.PowerLaw(
                roughness=mean * factor, relative_error=0.1, waviness=2.0, waviness_error=0.0, fit=None
            )
            assert law.iso_class == name
            low, high = law.class_limits
            assert low < law.roughness < high
    assert dataclasses.replace(law, roughness=1e-9).iso_class == "A"
    assert dataclasses.replace(law, roughness=1e-9).class_limits[0] == 0
    assert dataclasses.replace(law, roughness=10.0).iso_class == "H"
    assert law.density(0.2) == pytest.approx(law.roughness / 4)


# the roughness index


def test_the_car_is_solved_exactly():
    """Against a general solver of differential equations, on a few slopes."""
    slopes, time = np.array([0.01, -0.02, 0.0, 0.03, 0.01]), 0.07

    def motion(t, x, slope):
        body, body_rate, wheel, wheel_rate = x
        force = 63.3 * (body - wheel) + 6.0 * (body_rate - wheel_rate)
        return [body_rate, -force, wheel_rate, (force - 653.0 * (wheel - slope)) / 0.15]

    state, known = np.array([0.004, 0.0, 0.004, 0.0]), []
    for slope in slopes:
        state = solve_ivp(motion, (0, time), state, args=(slope,), rtol=1e-11, atol=1e-14).y[:, -1]
        known.append(state[0] - state[2])
    np.testing.assert_allclose(golden_car(slopes, time, 0.004), known, rtol=1e-7, atol=1e-12)


def test_the_expected_index_is_the_integral_over_the_spectrum():
    """554.7 sqrt(G) without the average, by the mean squares of the car of two masses; and with it, by quadrature."""
    car = TwoMassCar(sprung_mass=1.0, unsprung_mass=0.15, spring_rate=63.3, tyre_rate=653.0)
    road = FirstOrderRoad.from_iso8608("A", lowest_frequency=1e-3)
    squares = analysis.mean_squares(road, damping=6 / (2 * math.sqrt(63.3)), speed=IRI_SPEED, car=car)
    plain = 1000 * math.sqrt(2 / math.pi * squares.relative_velocity) / IRI_SPEED
    assert plain == pytest.approx(554.7 * math.sqrt(16e-6), rel=2e-4)

    def gain(w):
        s = 1j * w
        body = (6 * s + 63.3) / (s * s + 6 * s + 63.3)
        wheel = 653 / (0.15 * s * s + 653 + (6 * s + 63.3) * (1 - body))
        return abs((1 - body) * wheel) ** 2 * np.sinc(w * BASE / IRI_SPEED / (2 * math.pi)) ** 2

    square = iso8608.strength("A") / IRI_SPEED * quad(gain, 0, 2000, limit=2000)[0] / math.pi
    expected = 1000 * math.sqrt(2 / math.pi * square)
    assert expected == pytest.approx(2.1726, abs=1e-4)
    assert analysis.expected_iri(16e-6, spacing=0.01) == pytest.approx(expected, rel=1e-4)
    assert analysis.expected_iri(4 * 16e-6, spacing=0.05) == pytest.approx(2 * expected, rel=1e-4)
    assert analysis.expected_iri(16e-6) == pytest.approx(expected, rel=3e-3)  # points at 250 mm are averages over it


@pytest.mark.statistical
@pytest.mark.parametrize("spacing", [0.05, 0.25])
def test_the_index_of_simulated_roads(spacing):
    road, number = FirstOrderRoad.from_iso8608("D", lowest_frequency=1e-3), 60
    _, heights = roadgym.sample_road(road, spacing=spacing, points=round(500 / spacing), number=number, seed=5)
    found = [analysis.international_roughness_index(row, spacing) for row in heights]
    error = np.std(found, ddof=1) / math.sqrt(number)
    assert abs(np.mean(found) - analysis.expected_iri(1024e-6, spacing=spacing)) < 4 * error
    assert error < 0.02 * np.mean(found)


def test_the_index_knows_neither_height_nor_trend_nor_unit_of_length():
    _, heights = roadgym.sample_road("iso_b", spacing=0.1, points=3000, seed=6)
    index = analysis.international_roughness_index(heights[0], 0.1)
    assert analysis.international_roughness_index(3 * heights[0], 0.1) == pytest.approx(3 * index, rel=1e-9)
    tilted = heights[0] + 600 + 0.02 * np.arange(3000)
    assert analysis.international_roughness_index(tilted, 0.1) == pytest.approx(index, rel=1e-6)
    assert analysis.international_roughness_index(heights[0], 0.1, speed=10.0) != pytest.approx(index, rel=0.05)


# certificates


@pytest.mark.parametrize(("factor", "failing"), [(1.0, ()), (2.0, ("roughness", "IRI")), (0.25, ("roughness", "IRI"))])
def test_somebody_elses_generator_is_told_its_factor(factor, failing):
    certificate = analysis.certify_profile(cosines(np.random.default_rng(2), density=factor * DENSITY), 0.1, "c")
    assert certificate.passed == (factor == 1.0)
    failed = [line.name for line in certificate.lines if not line.passed]
    assert len(failed) == len(failing)
    assert all(name.startswith(begin) for name, begin in zip(failed, failing, strict=True))
    line = certificate.lines[0]
    assert line.measured / line.expected == pytest.approx(factor, rel=0.05)
    assert all(len(row) <= 80 for row in certificate.table().splitlines())
    assert json.loads(certificate.to_json())["passed"] == certificate.passed


def test_a_wrong_waviness_is_told():
    certificate = analysis.certify_profile(cosines(np.random.default_rng(3), waviness=2.3), 0.1, "C")
    passed = {line.name.split()[0]: line.passed for line in certificate.lines}
    assert not passed["waviness"]
    assert not passed["distance"]


@pytest.mark.statistical
def test_sound_profiles_are_certified_and_their_distances_are_standard_normal(class_c):
    certificates = [analysis.certify_profile(row, 0.1, "C", folded=True) for row in class_c[:30]]
    assert all(certificate.passed for certificate in certificates)
    scores = np.array([[line.distance for line in one.lines if line.name != one.lines[2].name] for one in certificates])
    assert np.abs(scores.mean(axis=0)).max() < 4 / math.sqrt(len(scores))
    np.testing.assert_array_less(np.abs(scores.std(axis=0, ddof=1) - 1), 0.35)


def test_wide_heights_have_no_index():
    certificate = analysis.certify_profile(cosines(np.random.default_rng(4), spacing=1.0, highest=0.4), 1.0, 256e-6)
    assert [line.name.split()[0] for line in certificate.lines] == ["roughness", "waviness", "distance"]
    assert "IRI" in certificate.table()
    with pytest.raises(ParameterError, match=r"spacing must be at most 0\.5 m for an IRI, got 1"):
        analysis.expected_iri(16e-6, spacing=1.0)


@pytest.mark.parametrize(
    ("heights", "spacing", "message"),
    [
        (np.zeros(10), 0.1, "heights must be 256 or more in a row, got the shape"),
        (np.arange(1000.0), 0.1, "heights must not all be on a line"),
        (np.append(np.random.default_rng(0).normal(size=999), np.nan), 0.1, "heights must be finite, got nan"),
        (np.random.default_rng(0).normal(size=1000), 0.0, "spacing must be positive, got 0"),
        (np.random.default_rng(0).normal(size=1000), 1000.0, "band must hold at least 40 of the frequencies"),
    ],
)
def test_bad_profiles_are_told(heights, spacing, message):
    for ask in (analysis.fit_iso8608, analysis.identify):
        with pytest.raises(ParameterError, match=message):
            ask(heights, spacing)
    with pytest.raises(ParameterError, match="band must be a pair"):
        analysis.fit_iso8608(np.random.default_rng(0).normal(size=1000), 0.1, band=(1.0, 0.1))
    with pytest.raises(ParameterError, match="iso_class must be a letter"):
        analysis.certify_profile(np.random.default_rng(0).normal(size=1000), 0.1, "Z")
    with pytest.raises(ParameterError, match="heights must be of more than 11 m for an IRI"):
        analysis.international_roughness_index(np.random.default_rng(0).normal(size=300), 0.01)
