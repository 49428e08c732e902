import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import expm

import analysis
from analysis.driven import drive_together
from analysis.paper.euler_maruyama import FORMS, Estimate, simulate
from analysis.paper.exponents import simulate_stability
from roadgym.cars import MEAN_SQUARES, QuarterCar
from roadgym.parameters import ParameterError
from roadgym.reward import divergent_terms
from roadgym.roads import FirstOrderRoad, GaussianRoad, HarmonicRoad, MultiplicativeRoad
from roadgym.speed import HighPassSpeedNoise, LowPassSpeedNoise, WhiteSpeedNoise

RANDOM_ROADS = [
    FirstOrderRoad(wavenumber=2.0),
    GaussianRoad(bandwidth=0.3, noise_intensity=0.4),
    MultiplicativeRoad(bandwidth=0.3, level_bound=2.0),
]
NOISES = [None, WhiteSpeedNoise(intensity=0.5), LowPassSpeedNoise(intensity=0.5), HighPassSpeedNoise(intensity=0.5)]
CHANCE = 4.0  # standard errors


def distance(found: Estimate, expected: float) -> float:
    return abs(found.distance(float(expected)))


# driven plants


@pytest.mark.statistical
@pytest.mark.parametrize("road", RANDOM_ROADS, ids=lambda road: road.kind)
def test_driven_plants_against_closed_forms(road) -> None:
    dampings = np.array([0.2, 0.7])
    car = QuarterCar(natural_frequency=1.2)
    figures = drive_together(road, None, damping=dampings, speed=1.3, car=car, relative_error=0.01, lanes=2048)
    theory = analysis.mean_squares(road, damping=dampings, speed=1.3, car=car)
    for k, name in enumerate(MEAN_SQUARES):
        expected = getattr(theory, name)
        if name in divergent_terms(QuarterCar(), road, None):
            assert np.all(np.isinf(figures[k]))
            continue
        error = figures[k].std(axis=1, ddof=1) / math.sqrt(2048)
        assert np.all(error <= 0.01 * figures[k].mean(axis=1))
        assert np.all(np.abs(figures[k].mean(axis=1) - expected) < CHANCE * error), name


def weak_noise_displacement(road, noise, damping: float, speed: float) -> float:
    """E Y^2 = 2 int R(t) r(t) dt, r the autocorrelation of the car's impulse response, where the speed stays positive:
    R = Re sum c exp(-a angle), averaged over the Gaussian angle."""
    if isinstance(road, FirstOrderRoad):
        rates, weights = np.array([1.0 + 0j]), np.array([1.0])
    else:
        delta = road.bandwidth
        rates = np.array([delta + 1j * math.sqrt(1 - delta**2)])
        weights = np.array([1 + 1j * delta / math.sqrt(1 - delta**2)])
    output = np.array([1.0, 2 * damping])
    car = np.array([[0, 1], [-1, -2 * damping]])

    def integrand(t: float) -> float:
        corner = noise.corner_frequency
        variance = noise.intensity**2 * (t + math.expm1(-corner * t) / corner)
        covariance = np.sum(weights * np.exp(-rates * road.wavenumber * speed * t + rates**2 * variance / 2)).real
        return covariance * (output @ expm(car * t) @ output) / (4 * damping)

    return 2 * road.variance * quad(integrand, 0, 60, limit=200)[0]


@pytest.mark.statistical
@pytest.mark.parametrize("road", RANDOM_ROADS, ids=lambda road: road.kind)
def test_low_pass_noise_on_random_roads(road) -> None:
    noise = LowPassSpeedNoise(intensity=0.3, corner_frequency=0.5)
    limit = 0.003 if road.kind == "gaussian" else 0.006  # the former by default
    settings = {} if road.kind == "gaussian" else {"relative_error": limit}
    found = analysis.mean_squares(road, noise, damping=0.3, speed=1.2, **settings)
    expected = weak_noise_displacement(road, noise, 0.3, 1.2)
    still = analysis.mean_squares(road, damping=0.3, speed=1.2)
    assert found.standard_error is not None
    for name in MEAN_SQUARES:
        value, error = getattr(found, name), getattr(found.standard_error, name)
        assert isinstance(value, np.float64)
        if name in divergent_terms(QuarterCar(), road, noise):
            assert (value, error) == (math.inf, 0)
        else:
            assert 0 < error <= limit * value
    error = found.standard_error.displacement
    assert abs(found.displacement - expected) < CHANCE * error
    if road.kind == "gaussian":  # negative control: the noise is seen
        assert abs(found.velocity - still.velocity) > CHANCE * found.standard_error.velocity


def test_low_pass_noise_repeats_itself_and_broadcasts() -> None:
    road, noise = GaussianRoad(), LowPassSpeedNoise()
    settings = {"damping": [[0.3], [0.5]], "speed": 1.0, "bandwidth": [0.2, 0.4], "relative_error": 0.05}
    found = analysis.mean_squares(road, noise, **settings)
    assert found.travel.shape == found.standard_error.travel.shape == (2, 2)
    alone = analysis.mean_squares(road.with_bandwidth(0.4), noise, damping=0.5, speed=1.0, relative_error=0.05)
    assert alone.travel == found.travel[1, 1]


@pytest.mark.statistical
def test_a_slow_car_is_nearly_exact() -> None:
    road = GaussianRoad()
    found = analysis.mean_squares(road, LowPassSpeedNoise(intensity=0.01), damping=0.3, speed=0.02, relative_error=0.05)
    still = analysis.mean_squares(road, damping=0.3, speed=0.02)
    error = found.standard_error.displacement
    assert error < 1e-3 * still.displacement
    assert abs(found.displacement - still.displacement) < CHANCE * error


@pytest.mark.statistical
def test_best_damping_under_low_pass_noise() -> None:
    road, noise = FirstOrderRoad(), LowPassSpeedNoise(intensity=0.01)
    settings = {"speed": 3.0, "bounds": (0.4, 1.0)}
    best = analysis.optimal_damping(road, noise, **settings, relative_error=0.01)
    still = analysis.optimal_damping(road, **settings)
    assert still.standard_error is None
    assert 0 < best.standard_error.damping < 0.03
    assert abs(best.damping - still.damping) < CHANCE * best.standard_error.damping
    assert abs(best.cost - still.cost) < CHANCE * best.standard_error.cost
    at_bound = analysis.optimal_damping("gaussian", noise, speed=[0.9], bounds=(0.7, 1.0), relative_error=0.02)
    assert at_bound.damping.tolist() == [1.0]
    assert at_bound.standard_error.damping.tolist() == [0.0]
    fixed = analysis.optimal_damping("gaussian", noise, speed=0.9, bounds=(0.7, 0.7), relative_error=0.02)
    assert (fixed.damping, fixed.standard_error.damping) == (0.7, 0.0)


# Euler-Maruyama


def squares_agree(found, theory, divergent) -> None:
    for name, estimate in found.mean_squares.items():
        if name in divergent:
            assert estimate.value == math.inf
        else:
            assert distance(estimate.without_bias, getattr(theory, name)) < CHANCE, name


@pytest.mark.statistical
@pytest.mark.parametrize("noise", NOISES[1:], ids=lambda noise: noise.kind)
def test_speed_noise_from_the_original_equations(noise) -> None:
    road = HarmonicRoad(amplitude=0.5, wavenumber=2.0)
    settings = {"damping": 0.2, "natural_frequency": 1.3}
    [found] = simulate(road, noise, speed=[0.6], samples=2_000_000, time_step=5e-3, lanes=256, bias=True, **settings)
    mean = analysis.mean_amplitude(noise, speed=0.6, wavenumber=2.0, amplitude=0.5, **settings)
    assert distance(found.first.without_bias, mean.real) < CHANCE
    assert distance(found.second.without_bias, -mean.imag) < CHANCE
    assert distance(found.amplitude.without_bias, abs(mean)) < CHANCE
    assert found.amplitude.standard_error < 0.02 * abs(mean)
    squares_agree(found, analysis.mean_squares(road, noise, speed=0.6, **settings), divergent_terms(QuarterCar(), road, noise))


def test_without_noise_the_bias_is_all_there_is() -> None:
    [found] = simulate("harmonic", damping=0.2, speed=[1.0], samples=200_000, time_step=1e-2, bias=True)
    expected = abs(analysis.mean_amplitude(None, damping=0.2, speed=1.0))
    assert abs(found.amplitude.value / expected - 1) > 0.01
    assert found.amplitude.without_bias.value == pytest.approx(expected, rel=2e-3)
    assert found.amplitude.bias.value == pytest.approx(found.amplitude.value - expected, rel=0.1)
    theory = analysis.mean_squares("harmonic", damping=0.2, speed=1.0)
    for name, estimate in found.mean_squares.items():
        assert estimate.without_bias.value == pytest.approx(float(getattr(theory, name)), rel=5e-3)


@pytest.mark.statistical
@pytest.mark.parametrize("noise", [None, LowPassSpeedNoise(intensity=0.2, corner_frequency=0.5)], ids=["still", "low_pass"])
@pytest.mark.parametrize("road", RANDOM_ROADS, ids=lambda road: road.kind)
def test_random_roads_from_the_original_equations(road, noise) -> None:
    settings = {"damping": 0.4, "natural_frequency": 1.3}
    [found] = simulate(road, noise, speed=[1.2], samples=2_000_000, time_step=5e-3, lanes=512, bias=True, **settings)
    assert distance(found.first, 0.0) < CHANCE
    assert distance(found.first_square.without_bias, road.variance) < CHANCE
    if road.has_slope:
        assert distance(found.second_square.without_bias, road.variance) < CHANCE
    # the drift of the speed is too weak to be seen here
    squares_agree(found, analysis.mean_squares(road, speed=1.2, **settings), divergent_terms(QuarterCar(), road, noise))


def discrete_moments(form: str, damping: float, ratio: float, strength: float, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Stationary mean and second moments of the scheme V' = V + h (M V + f) + h^(1/2) s (B V + b) N, exactly."""
    system = analysis.moment_system(
        WhiteSpeedNoise(intensity=strength), damping=damping, speed=ratio, form="closure" if form == "ito" else form
    )
    rotation = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, -1], [0, 0, 1, 0]])
    shift = np.array([0, 0, 0, -2 * damping])
    # of the vector (V, 1)
    drift, noise = np.zeros((5, 5)), np.zeros((5, 5))
    drift[:4, :4], drift[:4, 4] = system.matrix, system.forcing
    noise[:4, :4], noise[:4, 4] = rotation, shift
    first, second = np.eye(5) + step * drift, math.sqrt(step) * strength * noise
    transition = np.kron(first, first) + np.kron(second, second)
    values, vectors = np.linalg.eig(transition)
    order = np.argsort(-np.abs(values))
    assert values[order[0]] == pytest.approx(1)
    assert abs(values[order[1]]) < 1
    moments = np.real(vectors[:, order[0]] / vectors[-1, order[0]]).reshape(5, 5)
    return moments[:4, 4], moments[:4, :4]


@pytest.mark.statistical
@pytest.mark.parametrize("form", ["ito", "printed"])
def test_amplitudes_against_the_exact_moments_of_the_scheme(form: str) -> None:
    damping, ratio, strength, step = 0.3, 0.8, 0.4, 0.02
    mean, square = discrete_moments(form, damping, ratio, strength, step)
    # the mean of the scheme is that of the equations, at any step
    exact = analysis.mean_amplitude(
        WhiteSpeedNoise(intensity=strength), damping=damping, speed=ratio, form="exact" if form == "ito" else form
    )
    np.testing.assert_allclose([mean[0], -mean[1]], [exact.real, exact.imag], rtol=1e-9)
    [found] = simulate(
        "harmonic",
        WhiteSpeedNoise(intensity=strength),
        damping=damping,
        speed=[ratio],
        form=form,
        samples=4_000_000,
        time_step=step,
        lanes=256,
    )
    assert distance(found.first, mean[0]) < CHANCE
    assert distance(found.second, mean[1]) < CHANCE
    assert distance(found.first_square, square[0, 0]) < CHANCE
    assert distance(found.second_square, square[1, 1]) < CHANCE
    assert distance(found.mean_squares["displacement"], (square[0, 0] + square[1, 1]) / 2) < CHANCE
    assert distance(found.mean_squares["velocity"], (square[2, 2] + square[3, 3]) / 2) < CHANCE
    # negative control: the other form
    other = discrete_moments("printed" if form == "ito" else "ito", damping, ratio, strength, step)[0]
    assert distance(found.amplitude, np.hypot(*other[:2])) > 2 * CHANCE


def test_ito_amplitudes_are_the_original_motion_path_by_path() -> None:
    settings = {"damping": 0.2, "speed": [0.9], "samples": 200_000, "seed": 7}
    noise = WhiteSpeedNoise(intensity=0.3)
    (original,), (ito,), (printed,) = (simulate("harmonic", noise, form=form, **settings) for form in FORMS)
    for name in ("first", "second"):
        error = getattr(original, name).standard_error  # of chance, which the two share
        assert abs(getattr(ito, name).value - getattr(original, name).value) < 0.1 * error
    assert abs(printed.amplitude.value - original.amplitude.value) > original.amplitude.standard_error


def test_results_depend_on_the_seed_and_not_on_threads() -> None:
    settings = {"damping": 0.3, "speed": [0.5, 1.0], "samples": 40_000, "lanes": 128, "time_step": 0.01, "bias": True}
    reports = []
    one = simulate("gaussian", "low_pass", threads=1, report=lambda *state: reports.append(state), **settings)
    two = simulate("gaussian", "low_pass", threads=2, **settings)
    assert [point.mean_squares for point in one] == [point.mean_squares for point in two]
    assert reports[-1] == (8, 8)
    other = simulate("gaussian", "low_pass", seed=1, **settings)
    assert other[0].first.value != one[0].first.value
    assert one[0].first.value != one[1].first.value


def test_histograms() -> None:
    road = MultiplicativeRoad.from_shape(shape=2.0, bandwidth=0.5)
    [found] = simulate(road, damping=0.3, speed=[1.0], samples=2_000_000, time_step=5e-3, lanes=512, histogram=(-1.1, 1.1, 22))
    middle = (found.edges[1:] + found.edges[:-1]) / 2
    assert found.first_density.sum() * 0.1 == pytest.approx(1.0, abs=1e-12)
    for density in (found.first_density, found.second_density):
        np.testing.assert_allclose(density, analysis.marginal_density(road, middle), atol=0.06)
    [narrow] = simulate("harmonic", damping=0.3, speed=[0.0], samples=20_000, time_step=5e-3, histogram=(5.0, 6.0, 4))
    assert narrow.first_density.tolist() == [0.0] * 4  # A = 1 lies below
    [cut] = simulate("harmonic", damping=0.3, speed=[0.0], samples=20_000, time_step=5e-3, histogram=(0.75, 1.75, 2))
    assert cut.first_density.tolist() == [2.0, 0.0]


@pytest.mark.statistical
@pytest.mark.parametrize("damping", [0.1, 1.0, 1.5])
@pytest.mark.parametrize("form", FORMS)
def test_stability_against_formulas(form: str, damping: float) -> None:
    settings = {"intensity": 0.6, "natural_frequency": 1.4}
    found = simulate_stability(damping, speed=0.8, wavenumber=1.5, form=form, samples=2_000_000, **settings)
    right = "printed" if form == "printed" else "ito"
    top, second = analysis.lyapunov_exponents(damping, form=right, **settings)
    mean, _ = analysis.lyapunov_exponents(damping, form=right, sense="mean", **settings)
    upper, lower = analysis.rotation_numbers(damping, speed=0.8, wavenumber=1.5, natural_frequency=1.4)
    for name, expected in {"top": top, "second": second, "mean": mean, "upper": upper, "lower": lower}.items():
        estimate = getattr(found, name)
        assert distance(estimate, expected) < CHANCE, name
        assert 0 < estimate.standard_error < 0.05
    # negative control: the other form
    other = "ito" if right == "printed" else "printed"
    assert distance(found.top, analysis.lyapunov_exponents(damping, form=other, **settings)[0]) > 10
    assert distance(found.mean, analysis.lyapunov_exponents(damping, form=other, sense="mean", **settings)[0]) > 10


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: simulate("harmonic", damping=0.0, speed=[1.0]), "damping must be positive"),
        (lambda: simulate("gaussian", damping=0.1, speed=[0.0]), "speed must be positive"),
        (lambda: simulate("harmonic", damping=0.1, speed=[-1.0]), "speed must be zero or above"),
        (lambda: simulate("harmonic", damping=0.1, speed=[1.0], lanes=100), "lanes must be a multiple of 64, got 100"),
        (lambda: simulate("harmonic", damping=0.1, speed=[1.0], samples=100), "samples must be at least 1024 for 64 lanes"),
        (lambda: simulate("harmonic", damping=0.1, speed=[1.0], time_step=0), "time_step must be positive"),
        (lambda: simulate("harmonic", damping=0.1, speed=[1.0], histogram=(1, 0, 5)), "low < high"),
        (lambda: simulate("harmonic", damping=0.1, speed=[1.0], histogram=5), r"histogram must be \(low, high, cells\), got 5"),
        (lambda: simulate("harmonic", damping=0.1, speed=[1.0], histogram=(0, 1, 0)), "number of cells, must be at least 1"),
        (lambda: simulate("harmonic", damping=0.1, speed=[1.0], threads=0), "threads must be at least 1"),
        (lambda: simulate("harmonic", damping=0.1, speed="fast"), "speed must be a number or an array"),
        (lambda: simulate("harmonic", damping=0.1, speed=[1.0], form="exact"), "form must be one of original, ito, printed"),
        (lambda: simulate("gaussian", damping=0.1, speed=[1.0], form="ito"), "form must be original but"),
        (lambda: simulate("harmonic", "low_pass", damping=0.1, speed=[1.0], form="ito"), "form must be original but"),
        (
            lambda: simulate("harmonic", WhiteSpeedNoise(intensity=0.4), damping=0.1, speed=[1.0], form="printed"),
            r"intensity must be below 0\.316\d* at damping 0\.1, where the printed amplitudes diverge, got 0\.4",
        ),
        (lambda: simulate_stability(0.1, intensity=0.0), "intensity must be positive"),
        (lambda: simulate_stability(0.1, intensity=0.5, lanes=64), "lanes must be a multiple of 128"),
        (lambda: simulate_stability(0.1, intensity=0.5, samples=10), "samples must be at least"),
        (lambda: simulate_stability(0.1, intensity=0.5, form="exact"), "form must be one of"),
    ],
)
def test_bad_input_is_named(call, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        call()
