import math

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.linalg import solve_continuous_lyapunov

import analysis
from roadgym.cars import MEAN_SQUARES, QuarterCar
from roadgym.parameters import ParameterError
from roadgym.reward import divergent_terms
from roadgym.roads import FirstOrderRoad, GaussianRoad, HarmonicRoad, MultiplicativeRoad
from roadgym.speed import HighPassSpeedNoise, LowPassSpeedNoise, WhiteSpeedNoise

GAUSSIAN = GaussianRoad(bandwidth=0.1, noise_intensity=0.2)
dampings = st.floats(0.005, 5)
speeds = st.floats(0.01, 10)
bandwidths = st.floats(0.01, 3)


def ratios(road, speed_noise=None, **arguments) -> dict:
    result = analysis.mean_squares(road, speed_noise, **arguments)
    return {name: getattr(result, name) / road.variance for name in MEAN_SQUARES}


def vector(result: analysis.MeanSquares) -> np.ndarray:
    return np.array([getattr(result, name) for name in MEAN_SQUARES])


@pytest.mark.parametrize(
    ("name", "road", "noise", "damping", "speed", "expected", "places"),
    [
        ("displacement", GAUSSIAN, None, 0.105, 1.0, 12.6144, 4),
        ("velocity", GAUSSIAN, None, 0.105, 1.0, 12.13, 2),
        ("displacement", FirstOrderRoad(), None, 0.1, 2.0, 2.111, 3),
        ("displacement", HarmonicRoad(), WhiteSpeedNoise(intensity=0.5), 0.1, 1.0, 2 * 5.895, 2),
        ("displacement", HarmonicRoad(), None, 0.1, 1.0, 26.0, 12),
    ],
)
def test_reference_values(name, road, noise, damping, speed, expected, places) -> None:
    assert round(float(ratios(road, noise, damping=damping, speed=speed)[name]), places) == pytest.approx(expected, abs=1e-12)


def test_field_names_are_those_of_the_plant() -> None:
    assert tuple(analysis.mean_squares("gaussian", damping=0.3, speed=1.0)) == MEAN_SQUARES


# independent solvers


@pytest.mark.parametrize(
    "road", [GaussianRoad(bandwidth=0.3, noise_intensity=0.4, wavenumber=2.0), MultiplicativeRoad(wavenumber=0.5)]
)
@pytest.mark.parametrize("damping", [0.02, 0.7, 1.0, 3.0])
@pytest.mark.parametrize("speed", [0.2, 1.3, 6.0])
def test_second_order_road_against_a_lyapunov_equation(road, damping: float, speed: float) -> None:
    w1 = 1.7
    turn = speed * road.wavenumber
    noise = 4 * road.bandwidth * turn * road.variance  # of U, with E V^2 in it on the multiplicative road
    drift = np.array(  # state (Y, Y', Z, U), in seconds
        [
            [0, 1, 0, 0],
            [-(w1**2), -2 * damping * w1, w1**2, 2 * damping * w1 * turn],
            [0, 0, 0, turn],
            [0, 0, -turn, -2 * road.bandwidth * turn],
        ]
    )
    covariance = solve_continuous_lyapunov(drift, -np.diag([0, 0, 0, noise]))
    rows = {
        "displacement": np.array([1, 0, 0, 0]),
        "velocity": np.array([0, 1, 0, 0]) / w1,
        "acceleration": drift[1] / w1**2,
        "travel": np.array([1, 0, -1, 0]),
        "relative_velocity": np.array([0, 1, 0, -turn]) / w1,
    }
    result = analysis.mean_squares(road, damping=damping, speed=speed, natural_frequency=w1)
    for name, row in rows.items():
        assert float(getattr(result, name)) == pytest.approx(row @ covariance @ row, rel=1e-9), name
    scale = np.diag([1, 1 / w1, 1, 1])
    np.testing.assert_allclose(
        analysis.covariance(road, damping=damping, speed=speed, natural_frequency=w1),
        scale @ covariance @ scale,
        rtol=1e-9,
        atol=1e-12 * covariance.max(),
    )


@pytest.mark.parametrize("damping", [0.02, 0.7, 3.0])
@pytest.mark.parametrize("speed", [0.2, 1.3, 6.0])
def test_first_order_road_against_a_lyapunov_equation(damping: float, speed: float) -> None:
    road = FirstOrderRoad(noise_intensity=0.4, wavenumber=2.0)
    turn = speed * road.wavenumber
    drift = np.array(  # state (Y, Q = Y' - 2 D Z, Z), w1 = 1
        [[0, 1, 2 * damping], [-1, -2 * damping, 1 - 4 * damping**2], [0, 0, -turn]]
    )
    covariance = solve_continuous_lyapunov(drift, -np.diag([0, 0, speed * road.noise_intensity**2]))
    result = analysis.mean_squares(road, damping=damping, speed=speed)
    rows = {"displacement": [1, 0, 0], "velocity": [0, 1, 2 * damping], "travel": [1, 0, -1]}
    for name, row in rows.items():
        assert float(getattr(result, name)) == pytest.approx(row @ covariance @ row, rel=1e-9), name
    assert result.acceleration == result.relative_velocity == math.inf


@pytest.mark.parametrize("road", [FirstOrderRoad(), GaussianRoad(bandwidth=0.5), MultiplicativeRoad(bandwidth=1.5)])
def test_random_roads_against_spectral_integrals(road) -> None:
    damping, speed, w1 = 0.3, 1.4, 1.2
    result = analysis.mean_squares(road, damping=damping, speed=speed, natural_frequency=w1)
    gains = {
        "displacement": lambda s: 1 + 2 * damping * s,
        "velocity": lambda s: s * (1 + 2 * damping * s),
        "travel": lambda s: s**2,
    }
    if road.has_slope:
        gains["acceleration"] = lambda s: s**2 * (1 + 2 * damping * s)
        gains["relative_velocity"] = lambda s: s**3
    for name, numerator in gains.items():

        def integrand(w: float, numerator=numerator) -> float:
            s = 1j * w / w1
            spectrum = float(analysis.spectral_density(road, w, speed=speed))
            return abs(numerator(s) / (1 + 2 * damping * s + s * s)) ** 2 * spectrum / math.pi

        value = quad(integrand, 0, 5, limit=200)[0] + quad(integrand, 5, np.inf, limit=200)[0]
        assert float(getattr(result, name)) == pytest.approx(value, rel=1e-6), name


def test_harmonic_road_against_a_phasor() -> None:
    road = HarmonicRoad(amplitude=0.8, wavenumber=2.0)
    damping, speed, w1 = np.array([[0.01], [1.0], [4.0]]), np.array([0.0, 0.2, 0.6, 5.0]), 1.3
    s = 2j * speed
    y = 0.8 * (w1**2 + 2 * damping * w1 * s) / (s**2 + 2 * damping * w1 * s + w1**2)
    result = analysis.mean_squares(road, damping=damping, speed=speed, natural_frequency=w1)
    amplitudes = [y, y * s / w1, y * s**2 / w1**2, y - 0.8, (y - 0.8) * s / w1]
    np.testing.assert_allclose(vector(result), np.abs(amplitudes) ** 2 / 2, rtol=1e-12)


# speed noise, to high precision


def reference(noise, damping: float, speed: float) -> list[float]:
    """Mean squares over the variance, by the series in sigma^2/2 + n w_g and n w_g, with as many digits as it loses."""
    white = isinstance(noise, WhiteSpeedNoise)
    loss = (
        0
        if isinstance(noise, (WhiteSpeedNoise, HighPassSpeedNoise))
        else int(noise.intensity**2 / noise.corner_frequency / 2.3)
    )
    with mpmath.workdps(60 + loss):
        D, nu, strength = mpmath.mpf(damping), mpmath.mpf(speed), mpmath.mpf(noise.intensity) ** 2 / 2
        corner = mpmath.mpf(1 if white else noise.corner_frequency)
        kappa = 0 if white else strength / corner if isinstance(noise, HighPassSpeedNoise) else -strength / corner
        start = 0 if isinstance(noise, HighPassSpeedNoise) else strength
        term, total, n = mpmath.exp(-kappa), [mpmath.mpf(0)] * 5, 0
        while True:
            s = mpmath.mpc(start + n * corner, nu)
            q = 2 * D * (1 + 2 * D * s + s * s)
            numerators = [
                2 * D + (1 + 4 * D**2) * s,
                s * (1 + 4 * D**2 + 8 * D**3 * s),
                s * (1 + 2 * D * s + 4 * D**2 + 8 * D**3 * s - 16 * D**4 - 32 * D**5 * s - 16 * D**4 * s**2 - 8 * D**3 * s**3),
                s * (1 + 2 * D * s),
                s * (1 + 2 * D * s - 4 * D**2 - 8 * D**3 * s - 4 * D**2 * s**2 - 2 * D * s**3),
            ]
            total = [old + term * (numerator / q).real for old, numerator in zip(total, numerators, strict=True)]
            n += 1
            term *= kappa / n
            if n > 2 * abs(kappa) and abs(term) * (1 + n * corner) ** 4 < mpmath.mpf(10) ** -45:
                return [float(value) for value in total]


CORNERS = [(D, nu) for D in (0.005, 0.1, 1.0, 5.0) for nu in (0.0, 1e-3, 1.0, 10.0)]


@pytest.mark.parametrize("intensity", [1e-3, 0.2, 3.0])
@pytest.mark.parametrize("corner", [1e-3, 0.1, 1.0, 1e3])
def test_low_pass_noise_to_ten_digits(intensity: float, corner: float) -> None:
    intensity = min(intensity, 8 * math.sqrt(corner))  # stronger noise would take thousands of digits: see the next test
    noise = LowPassSpeedNoise(intensity=intensity, corner_frequency=corner)
    for damping, speed in CORNERS:
        got = vector(analysis.mean_squares(HarmonicRoad(), noise, damping=damping, speed=speed)) * 2
        np.testing.assert_allclose(got, reference(noise, damping, speed), rtol=1e-10, err_msg=f"{damping} {speed}")


def average(noise: LowPassSpeedNoise, numerator: list, damping: float, speed: float) -> mpmath.mpc:
    """<numerator / (1 + 2 D s + s^2)> under low-pass noise, from Kummer's form of the incomplete gamma function.

    The numerator's coefficients go from s^0 upwards. Polynomial parts give derivatives of the correlation at 0.
    """
    nu, corner, strength = mpmath.mpf(speed), mpmath.mpf(noise.corner_frequency), mpmath.mpf(noise.intensity) ** 2 / 2
    D, kappa = mpmath.mpf(damping), strength / corner
    rest, polynomial = [mpmath.mpc(c) for c in numerator], []
    while len(rest) > 2:
        lead = rest.pop()
        polynomial.insert(0, lead)
        rest[-1] -= 2 * D * lead
        rest[-2] -= lead

    def laplace(p: mpmath.mpc) -> mpmath.mpc:
        a = (p + 1j * nu) / corner + kappa
        term = 1 / (corner * a)
        total, n = term, 0
        while abs(term) > abs(total) * mpmath.mpf(10) ** -50:
            n += 1
            term *= kappa / (a + n)
            total += term
        return total

    root = mpmath.sqrt(mpmath.mpc(D * D - 1))
    first, second = D + root, D - root
    fraction = ((rest[0] - rest[1] * first) * laplace(first) - (rest[0] - rest[1] * second) * laplace(second)) / (
        second - first
    )
    variance = strength * corner
    derivatives = [1, 1j * nu, -(nu**2) - variance, -1j * nu**3 - 3j * nu * variance - variance * corner]
    return fraction + sum(c * d for c, d in zip(polynomial, derivatives, strict=False))


@pytest.mark.parametrize("damping", [0.005, 0.6, 5.0])
@pytest.mark.parametrize("speed", [0.0, 0.9, 10.0])
@pytest.mark.parametrize(("intensity", "corner"), [(3.0, 1e-3), (1.0, 1e-3), (3.0, 0.02), (0.2, 1e-6)])
def test_strong_and_slow_low_pass_noise_to_ten_digits(intensity: float, corner: float, damping: float, speed: float) -> None:
    noise = LowPassSpeedNoise(intensity=intensity, corner_frequency=corner)
    with mpmath.workdps(60):
        D = mpmath.mpf(damping)
        numerators = [
            [2 * D, 1 + 4 * D**2],
            [0, 1 + 4 * D**2, 8 * D**3],
            [0, 1 + 4 * D**2 - 16 * D**4, 2 * D + 8 * D**3 - 32 * D**5, -16 * D**4, -8 * D**3],
            [0, 1, 2 * D],
            [0, 1 - 4 * D**2, 2 * D - 8 * D**3, -4 * D**2, -2 * D],
        ]
        expected = [float((average(noise, numerator, damping, speed) / (2 * D)).real) for numerator in numerators]
    got = vector(analysis.mean_squares(HarmonicRoad(), noise, damping=damping, speed=speed)) * 2
    np.testing.assert_allclose(got, expected, rtol=1e-10)


@pytest.mark.parametrize(
    "noise",
    [
        WhiteSpeedNoise(intensity=3.0),
        WhiteSpeedNoise(intensity=1e-3),
        HighPassSpeedNoise(intensity=1e-3, corner_frequency=1e-3),
        HighPassSpeedNoise(intensity=0.2, corner_frequency=1e3),
        HighPassSpeedNoise(intensity=3.0, corner_frequency=1e3),
        HighPassSpeedNoise(intensity=3.0, corner_frequency=0.3),
        HighPassSpeedNoise(intensity=3.0, corner_frequency=0.0451),  # just below and just above the switch to quadrature
        HighPassSpeedNoise(intensity=3.0, corner_frequency=0.0449),
    ],
)
def test_white_and_high_pass_noise_to_ten_digits(noise) -> None:
    for damping, speed in CORNERS[::3]:
        got = vector(analysis.mean_squares(HarmonicRoad(), noise, damping=damping, speed=speed)) * 2
        expected = reference(noise, damping, speed)
        expected[2] = expected[4] = math.inf
        np.testing.assert_allclose(got, expected, rtol=1e-10, err_msg=f"{damping} {speed}")


def test_speed_noise_against_its_line_spectrum() -> None:
    """E Y^2 = E Z^2 int |H|^2 S, with the spectrum S of exp(i phi) from its correlation: no series at all."""
    noise = LowPassSpeedNoise(intensity=1.2, corner_frequency=0.7)
    damping, nu, sigma2, corner = 0.4, 0.8, 1.2**2, 0.7
    tau = np.linspace(0, 80, 160_001)
    correlation = np.exp(-sigma2 / 2 * (tau - (1 - np.exp(-corner * tau)) / corner) - 1j * nu * tau)
    # autocorrelation of the car's impulse response, without and with the numerator 1 + 2 D s
    root = math.sqrt(1 - damping**2)
    kernel = np.exp(-damping * tau) * (np.cos(root * tau) + damping * np.sin(root * tau) / root) / (4 * damping)
    curvature = np.exp(-damping * tau) * (-np.cos(root * tau) + damping * np.sin(root * tau) / root) / (4 * damping)
    integrand = ((kernel - 4 * damping**2 * curvature) * correlation).real
    weights = np.full(tau.size, 2.0)
    weights[1::2], weights[0], weights[-1] = 4.0, 1.0, 1.0
    value = 2 * weights @ integrand * (tau[1] / 3)
    assert float(ratios(HarmonicRoad(), noise, damping=damping, speed=nu)["displacement"]) == pytest.approx(value, rel=1e-9)


# properties


@settings(deadline=None, derandomize=True)
@given(damping=dampings, speed=speeds)
def test_narrow_second_order_road_is_the_harmonic_one(damping: float, speed: float) -> None:
    narrow = ratios(GAUSSIAN, damping=damping, speed=speed, bandwidth=1e-13)
    harmonic = ratios(HarmonicRoad(), damping=damping, speed=speed)
    for name in MEAN_SQUARES:
        assert float(narrow[name]) == pytest.approx(float(harmonic[name]), rel=1e-7)


@settings(deadline=None, derandomize=True)
@given(damping=dampings, speed=speeds, scale=st.floats(0.1, 10), wavenumber=st.floats(0.1, 10), bandwidth=bandwidths)
def test_only_ratios_of_frequencies_count(damping, speed, scale, wavenumber, bandwidth) -> None:
    one = ratios(GaussianRoad(bandwidth=bandwidth), damping=damping, speed=speed)
    other = ratios(
        GaussianRoad(bandwidth=bandwidth, wavenumber=wavenumber),
        damping=damping,
        speed=speed * scale / wavenumber,
        natural_frequency=scale,
    )
    for name in MEAN_SQUARES:
        assert float(other[name]) == pytest.approx(float(one[name]), rel=1e-10)


@settings(deadline=None, derandomize=True)
@given(
    kind=st.sampled_from([WhiteSpeedNoise, LowPassSpeedNoise, HighPassSpeedNoise]),
    damping=dampings,
    speed=speeds,
    scale=st.floats(0.1, 10),
    intensity=st.floats(0.01, 3),
    corner=st.floats(0.01, 100),
)
def test_only_ratios_of_frequencies_count_under_noise(kind, damping, speed, scale, intensity, corner) -> None:
    def noise(scale: float):
        more = {} if kind is WhiteSpeedNoise else {"corner_frequency": corner * scale}
        return kind(intensity=intensity * math.sqrt(scale), **more)

    one = vector(analysis.mean_squares(HarmonicRoad(), noise(1.0), damping=damping, speed=speed))
    road = HarmonicRoad(wavenumber=2.0)
    other = vector(analysis.mean_squares(road, noise(scale), damping=damping, speed=speed * scale / 2, natural_frequency=scale))
    np.testing.assert_allclose(other, one, rtol=1e-9)


@settings(deadline=None, derandomize=True)
@given(damping=dampings, speed=speeds, intensity=st.floats(0.1, 2))
def test_limits_of_filtered_noise(damping: float, speed: float, intensity: float) -> None:
    def of(noise) -> np.ndarray:
        return vector(analysis.mean_squares(HarmonicRoad(), noise, damping=damping, speed=speed))[[0, 1, 3]]

    white, none = of(WhiteSpeedNoise(intensity=intensity)), of(None)
    # slow or weak against the car's own rate of decay, and fast against everything
    slow, fast, weak = 1e-11 * damping**2, 1e9, 1e-6 * damping
    np.testing.assert_allclose(of(LowPassSpeedNoise(intensity=intensity, corner_frequency=slow)), none, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(of(LowPassSpeedNoise(intensity=intensity, corner_frequency=fast)), white, rtol=1e-5)
    np.testing.assert_allclose(of(HighPassSpeedNoise(intensity=intensity, corner_frequency=slow)), white, rtol=1e-5)
    np.testing.assert_allclose(of(HighPassSpeedNoise(intensity=weak, corner_frequency=1.0)), none, rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(of(LowPassSpeedNoise(intensity=weak, corner_frequency=1.0)), none, rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(of(WhiteSpeedNoise(intensity=weak)), none, rtol=1e-3, atol=1e-9)


@settings(deadline=None, derandomize=True)
@given(speed=speeds, corner=st.floats(1e-3, 1e3), intensity=st.floats(0.1, 3))
def test_critical_damping_is_no_special_point(speed: float, corner: float, intensity: float) -> None:
    noise = LowPassSpeedNoise(intensity=intensity, corner_frequency=corner)
    step = 1e-9
    below, at, above = vector(analysis.mean_squares(HarmonicRoad(), noise, damping=[1 - step, 1, 1 + step], speed=speed)).T
    np.testing.assert_allclose(below, at, rtol=2e-7)
    np.testing.assert_allclose(above, at, rtol=2e-7)
    np.testing.assert_allclose((below + above) / 2, at, rtol=1e-10)


@settings(deadline=None, derandomize=True)
@given(damping=dampings, speed=speeds, bandwidth=bandwidths)
def test_covariance_agrees_with_the_closed_forms(damping: float, speed: float, bandwidth: float) -> None:
    road = GaussianRoad(bandwidth=bandwidth)
    matrix = analysis.covariance(road, damping=damping, speed=speed)
    result = analysis.mean_squares(road, damping=damping, speed=speed)
    assert matrix[0, 0] == pytest.approx(float(result.displacement), rel=1e-8)
    assert matrix[1, 1] == pytest.approx(float(result.velocity), rel=1e-8)
    assert matrix[0, 0] + matrix[2, 2] - 2 * matrix[0, 2] == pytest.approx(
        float(result.travel), rel=1e-8, abs=1e-10 * matrix[0, 0]
    )
    assert np.linalg.eigvalsh(matrix)[0] > -1e-12 * matrix.max()


@pytest.mark.parametrize("road", [HarmonicRoad(), FirstOrderRoad(), GAUSSIAN, MultiplicativeRoad()])
@pytest.mark.parametrize("noise", [None, WhiteSpeedNoise(), LowPassSpeedNoise(), HighPassSpeedNoise()])
def test_what_diverges_is_what_the_reward_says(road, noise) -> None:
    if noise is not None and not noise.smooth and road.kind != "harmonic":
        with pytest.raises(ParameterError, match="speed noise is defined on the harmonic road only"):
            analysis.mean_squares(road, noise, damping=0.2, speed=1.0)
        return
    result = ratios(road, noise, damping=0.2, speed=1.0, relative_error=0.05)
    assert tuple(name for name in MEAN_SQUARES if result[name] == math.inf) == divergent_terms(QuarterCar(), road, noise)
    assert all(value > 0 for value in result.values())


@pytest.mark.parametrize("road", [HarmonicRoad(), FirstOrderRoad(), GAUSSIAN, MultiplicativeRoad()])
def test_standing_still(road) -> None:
    np.testing.assert_allclose(vector(analysis.mean_squares(road, damping=0.2, speed=0.0)), [road.variance, 0, 0, 0, 0])


def test_shapes_broadcast() -> None:
    damping, speed, bandwidth = np.full((4, 1, 1), 0.2), np.ones((3, 1)), np.array([0.1, 0.2])
    result = analysis.mean_squares(GAUSSIAN, damping=damping, speed=speed, bandwidth=bandwidth)
    assert all(value.shape == (4, 3, 2) for value in vector(result))
    for i, delta in enumerate(bandwidth):
        alone = analysis.mean_squares(GAUSSIAN.with_bandwidth(float(delta)), damping=0.2, speed=1.0)
        assert result.displacement[0, 0, i] == pytest.approx(float(alone.displacement), rel=1e-14)
    for noise in (None, WhiteSpeedNoise(), LowPassSpeedNoise(), HighPassSpeedNoise()):
        result = analysis.mean_squares(HarmonicRoad(), noise, damping=damping, speed=speed)
        assert all(value.shape == (4, 3, 1) for value in vector(result))
        assert result.standard_error is None
        number = analysis.mean_squares("harmonic", noise, damping=0.2, speed=1)
        assert all(isinstance(getattr(number, name), np.float64) for name in MEAN_SQUARES)
    assert analysis.covariance(GAUSSIAN, damping=damping, speed=speed).shape == (4, 3, 1, 4, 4)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: analysis.mean_squares("gaussian", damping=0.0, speed=1.0), r"damping must be positive, got 0\.0"),
        (lambda: analysis.mean_squares("gaussian", damping=[0.1, -2], speed=1.0), r"damping must be positive, got -2\.0"),
        (lambda: analysis.mean_squares("gaussian", damping=0.1, speed=-1), r"speed must be zero or above, got -1\.0"),
        (lambda: analysis.mean_squares("gaussian", damping=0.1, speed=math.inf), "speed must be finite, got inf"),
        (lambda: analysis.mean_squares("gaussian", damping=[0.1] * 2, speed=[1.0] * 3), r"damping \(2,\), speed \(3,\)"),
        (
            lambda: analysis.mean_squares("gaussian", damping=0.1, speed=1.0, natural_frequency=0),
            "natural_frequency must be positive",
        ),
        (
            lambda: analysis.mean_squares("gaussian", damping=0.1, speed=1.0, bandwidth=0),
            r"bandwidth must be positive, got 0\.0",
        ),
        (
            lambda: analysis.mean_squares("harmonic", damping=0.1, speed=1.0, bandwidth=0.1),
            "bandwidth must be None: a harmonic road",
        ),
        (
            lambda: analysis.mean_squares("gaussian", "low_pass", damping=0.1, speed=1.0, relative_error=0),
            "relative_error must be positive",
        ),
        (lambda: analysis.mean_squares("gaussian", "low_pass", damping=0.1, speed=0.0), "speed must be positive"),
        (lambda: analysis.mean_squares("gaussian", "white", damping=0.1, speed=1.0), "harmonic road only"),
        (lambda: analysis.mean_squares("harmonic", "pink", damping=0.1, speed=1.0), "unknown speed noise 'pink'"),
        (lambda: analysis.covariance("cobbles", damping=0.1, speed=1.0), "unknown road 'cobbles'"),
        (
            lambda: analysis.mean_squares(
                "harmonic", LowPassSpeedNoise(intensity=1e5, corner_frequency=1e-9), damping=1e-3, speed=1.0
            ),
            "low_pass speed_noise must be weaker or faster",
        ),
    ],
)
def test_bad_input_is_named(call, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        call()
