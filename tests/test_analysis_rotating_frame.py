import math

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import analysis
from roadgym.parameters import ParameterError
from roadgym.speed import HighPassSpeedNoise, LowPassSpeedNoise, WhiteSpeedNoise

ROTATION = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, -1], [0, 0, 1, 0]])
speeds = st.floats(0, 10)
dampings = st.floats(0.005, 5)


def transfer(s, damping):
    return (1 + 2 * damping * s) / (1 + 2 * damping * s + s * s)


@pytest.mark.parametrize(
    ("noise", "form", "expected"),
    [
        (WhiteSpeedNoise(intensity=0.2), "exact", 4.2648),
        (WhiteSpeedNoise(intensity=0.2), "closure", 4.2648),
        (WhiteSpeedNoise(intensity=0.2), "printed", 6.348),
        (WhiteSpeedNoise(intensity=0.5), "exact", 2.311),
        (WhiteSpeedNoise(intensity=0.5), "printed", 19.57),
        (LowPassSpeedNoise(intensity=0.5), "exact", 2.565),
        (LowPassSpeedNoise(intensity=0.5), "closure", 2.444),
        (LowPassSpeedNoise(intensity=0.5), "printed", 2.444),
        (HighPassSpeedNoise(intensity=0.5), "exact", 4.549),
        (HighPassSpeedNoise(intensity=0.5), "closure", 4.153),
        (HighPassSpeedNoise(intensity=0.5), "printed", 3.176),
    ],
)
def test_reference_values(noise, form: str, expected: float) -> None:
    value = abs(analysis.mean_amplitude(noise, damping=0.1, speed=1.0, form=form))
    assert value == pytest.approx(expected, rel=5e-4)


# to high precision


def laplace(noise, p: mpmath.mpc, nu: mpmath.mpf) -> mpmath.mpc:
    """Laplace transform of exp(-i nu tau - w(tau)/2): incomplete gamma functions, as series that lose no digits."""
    strength, corner = mpmath.mpf(noise.intensity) ** 2 / 2, mpmath.mpf(noise.corner_frequency)
    kappa, b = strength / corner, (p + 1j * nu) / corner
    if isinstance(noise, LowPassSpeedNoise):
        term = total = 1 / (corner * (b + kappa))
        n = 0
        while abs(term) > abs(total) * mpmath.mpf(10) ** -40:
            n += 1
            term *= kappa / (b + kappa + n)
            total += term
        return total
    first = max(0, int(kappa - 20 * mpmath.sqrt(kappa)) - 30)
    weight = mpmath.exp(first * mpmath.log(kappa) - kappa - mpmath.loggamma(first + 1))
    total, n = mpmath.mpc(0), first
    while n < kappa or weight > mpmath.mpf(10) ** -40:
        total += weight / (corner * (b + n))
        n += 1
        weight *= kappa / n
    return total


def reference(noise, damping: float, speed: float) -> complex:
    with mpmath.workdps(50):
        D, nu = mpmath.mpf(damping), mpmath.mpf(speed)
        if damping == 1:
            D += mpmath.mpf(10) ** -25  # moves the answer by less than that
        root = mpmath.sqrt(mpmath.mpc(D * D - 1))
        roots = (D + root, D - root)
        parts = [(1 - 2 * D * p) * laplace(noise, p, nu) for p in roots]
        return complex((parts[0] - parts[1]) / (roots[1] - roots[0]))


@pytest.mark.parametrize("kind", [LowPassSpeedNoise, HighPassSpeedNoise])
@pytest.mark.parametrize("intensity", [1e-3, 0.3, 3.0])
@pytest.mark.parametrize("corner", [1e-3, 0.03, 1.0, 30.0, 1e3])
def test_exact_form_to_ten_digits(kind, intensity: float, corner: float) -> None:
    noise = kind(intensity=intensity, corner_frequency=corner)
    for damping, speed in [(0.005, 0.0), (0.005, 1.0), (0.005, 10.0), (0.3, 0.9), (1.0, 0.5), (5.0, 0.0), (5.0, 10.0)]:
        got = complex(analysis.mean_amplitude(noise, damping=damping, speed=speed))
        expected = reference(noise, damping, speed)
        assert abs(got - expected) <= 1e-10 * abs(expected), (damping, speed)


@pytest.mark.parametrize("kappa", [13.0, 99.9, 100.1, 1e5])
@pytest.mark.parametrize("kind", [LowPassSpeedNoise, HighPassSpeedNoise])
def test_no_jump_where_the_rule_changes_and_beyond(kind, kappa: float) -> None:
    noise = kind(intensity=1.0, corner_frequency=0.5 / kappa)
    for damping, speed in [(1e-4, 1.0), (0.02, 0.9), (2.0, 0.3)]:
        got, expected = complex(analysis.mean_amplitude(noise, damping=damping, speed=speed)), reference(noise, damping, speed)
        assert abs(got - expected) <= 1e-10 * abs(expected)


@pytest.mark.parametrize(
    "noise", [None, WhiteSpeedNoise(intensity=0.7), LowPassSpeedNoise(intensity=0.7), HighPassSpeedNoise(intensity=0.7)]
)
@pytest.mark.parametrize("damping", [0.3, 1.0, 2.0])
def test_exact_form_against_its_definition(noise, damping: float) -> None:
    """E C = int h(tau) exp(-i nu tau - w(tau)/2) dtau, with w the variance of the phase's increments."""
    nu, sigma2 = 0.8, 0.49
    variance = {
        None: lambda t: 0,
        "white": lambda t: sigma2 * t,
        "low_pass": lambda t: sigma2 * (t + mpmath.expm1(-t)),
        "high_pass": lambda t: -sigma2 * mpmath.expm1(-t),
    }[noise and noise.kind]
    root = mpmath.sqrt(mpmath.mpc(damping**2 - 1))

    def response(t: mpmath.mpf) -> mpmath.mpc:
        cosine, sine = (mpmath.cosh(root * t), mpmath.sinh(root * t) / root) if root else (mpmath.mpf(1), t)
        return mpmath.exp(-damping * t) * (2 * damping * cosine + (1 - 2 * damping**2) * sine)

    points = [*range(0, 60, 4), 150]
    value = mpmath.quad(lambda t: response(t) * mpmath.exp(-1j * nu * t - variance(t) / 2), points)
    got = complex(analysis.mean_amplitude(noise, damping=damping, speed=nu))
    assert abs(got - complex(value)) <= 1e-12 * abs(value)


# moment equations


@settings(deadline=None, derandomize=True)
@given(damping=dampings, speed=speeds, intensity=st.floats(0.01, 3))
def test_white_noise_closes_its_moments(damping: float, speed: float, intensity: float) -> None:
    noise = WhiteSpeedNoise(intensity=intensity)
    exact = transfer(1j * speed + intensity**2 / 2, damping)
    for form in ("exact", "closure"):
        assert abs(analysis.mean_amplitude(noise, damping=damping, speed=speed, form=form) - exact) <= 1e-11 * abs(exact)
    printed = transfer(1j * speed - intensity**2 / 2, damping)
    near = abs((1j * speed - intensity**2 / 2) ** 2 + 2 * damping * (1j * speed - intensity**2 / 2) + 1)
    got = analysis.mean_amplitude(noise, damping=damping, speed=speed, form="printed")
    assert abs(got - printed) <= 1e-11 / near * max(1.0, abs(printed)) * (1 + intensity**4)


def hierarchy(noise, damping: float, speed: float, levels: int) -> tuple[np.ndarray, np.ndarray]:
    """Equations of E(Psi^n V), n < levels, by Ito's calculus from (26), (33), w1 = mu = 1, setting E(Psi^levels V) to zero."""
    low_pass = isinstance(noise, LowPassSpeedNoise)
    sigma2, corner = noise.intensity**2, noise.corner_frequency
    white = 0.0 if low_pass else sigma2
    pull = corner if low_pass else -corner  # of Psi on dphi
    drift = np.array([[0, -speed, 1, 0], [speed, 0, 0, 1], [-1, 0, -2 * damping, -speed], [0, -1, speed, -2 * damping]])
    drift = drift - white / 2 * np.eye(4)
    x, y = np.array([0, 0, 1 + damping * white, -2 * damping * speed]), np.array([0, 0, 0, 1.0])
    moments = [1.0, 0.0]  # E Psi^n
    for n in range(2, levels + 2):
        moments.append((n - 1) * sigma2 / (2 * corner) * moments[n - 2])
    matrix, forcing = np.zeros((levels, 4, levels, 4)), np.zeros((levels, 4))
    for n in range(levels):
        matrix[n, :, n] += drift - n * corner * np.eye(4)
        if n + 1 < levels:
            matrix[n, :, n + 1] += pull * ROTATION
        if n >= 2:
            matrix[n, :, n - 2] += n * (n - 1) / 2 * sigma2 * np.eye(4)
        forcing[n] += moments[n] * x - 2 * damping * pull * moments[n + 1] * y
        if n >= 1 and not low_pass:  # d(Psi^n) dV
            matrix[n, :, n - 1] += n * sigma2 * ROTATION
            forcing[n] -= n * sigma2 * moments[n - 1] * 2 * damping * y
    return matrix.reshape(4 * levels, 4 * levels), forcing.ravel()


@pytest.mark.parametrize("kind", [LowPassSpeedNoise, HighPassSpeedNoise])
def test_the_full_hierarchy_of_moments_tends_to_the_exact_form(kind) -> None:
    noise = kind(intensity=0.4, corner_frequency=0.8)
    matrix, forcing = hierarchy(noise, 0.3, 0.9, 30)
    means = np.linalg.solve(matrix, -forcing)
    exact = analysis.mean_amplitude(noise, damping=0.3, speed=0.9)
    assert means[0] - 1j * means[1] == pytest.approx(complex(exact), rel=1e-9)


@pytest.mark.parametrize("kind", [LowPassSpeedNoise, HighPassSpeedNoise])
def test_the_closure_is_the_hierarchy_with_the_second_moment_factorised(kind) -> None:
    noise = kind(intensity=0.4, corner_frequency=0.8)
    matrix, forcing = hierarchy(noise, 0.3, 0.9, 3)
    pull = 0.8 if kind is LowPassSpeedNoise else -0.8
    matrix[4:8, 0:4] += pull * 0.16 / 1.6 * ROTATION  # E(Psi^2 V) = E Psi^2 E V in the equation of E(Psi V)
    system = analysis.moment_system(noise, damping=0.3, speed=0.9)
    np.testing.assert_allclose(system.matrix, matrix[:8, :8], atol=1e-15)
    np.testing.assert_allclose(system.forcing, forcing[:8], atol=1e-15)


def test_moment_systems_as_printed() -> None:
    arguments = {"damping": 0.3, "speed": 0.9, "wavenumber": 2.0, "natural_frequency": 1.5, "amplitude": 0.7, "form": "printed"}
    w1, turn, loss = 1.5, 1.8, 2 * 0.3 * 1.5
    plain = np.array([[0, -turn, w1, 0], [turn, 0, 0, w1], [-w1, 0, -loss, -turn], [0, -w1, turn, -loss]])
    white = analysis.moment_system(WhiteSpeedNoise(intensity=0.4), **arguments)  # (24)
    np.testing.assert_allclose(white.matrix, plain + 0.08 * np.eye(4), atol=1e-15)
    np.testing.assert_allclose(white.forcing, 0.7 * np.array([0, 0, w1 - 0.3 * 0.16, -2 * 0.3 * turn]), atol=1e-15)
    low = analysis.moment_system(LowPassSpeedNoise(intensity=0.4, corner_frequency=0.5), **arguments)  # (28), (29)
    np.testing.assert_allclose(
        low.matrix, np.block([[plain, 0.5 * ROTATION], [0.5 * 0.16 * ROTATION, plain - 0.5 * np.eye(4)]]), atol=1e-15
    )
    np.testing.assert_allclose(low.forcing[:4], 0.7 * np.array([0, 0, w1, -2 * 0.3 * turn]), atol=1e-15)
    np.testing.assert_allclose(low.forcing[4:], [0, 0, 0, -0.7 * 2 * 0.3 * 0.5 * 0.16], atol=1e-15)
    high = analysis.moment_system(HighPassSpeedNoise(intensity=0.4, corner_frequency=0.5), **arguments)  # (35), (36)
    shifted = plain + 0.08 * np.eye(4)
    np.testing.assert_allclose(
        high.matrix, np.block([[shifted, -0.5 * ROTATION], [0.08 * ROTATION, shifted - 0.5 * np.eye(4)]]), atol=1e-15
    )
    np.testing.assert_allclose(high.forcing[:4], white.forcing, atol=1e-15)
    np.testing.assert_allclose(high.forcing[4:], [0, 0, 0, -0.7 * 2 * 0.3 * 0.08], atol=1e-15)


# properties


@settings(deadline=None, derandomize=True)
@given(damping=dampings, speed=speeds, intensity=st.floats(0.01, 3), corner=st.floats(1e-3, 1e3))
def test_no_noise_exceeds_the_peak_of_the_transfer_function(damping, speed, intensity, corner) -> None:
    frequency = np.concatenate([np.linspace(0, 3, 3001), np.sqrt(np.maximum(0, 1 + np.linspace(-4, 4, 401) * damping))])
    peak = np.abs(transfer(1j * frequency, damping)).max() * 1.01
    for noise in (
        None,
        WhiteSpeedNoise(intensity=intensity),
        LowPassSpeedNoise(intensity=intensity, corner_frequency=corner),
        HighPassSpeedNoise(intensity=intensity, corner_frequency=corner),
    ):
        assert abs(analysis.mean_amplitude(noise, damping=damping, speed=speed)) <= peak


@pytest.mark.parametrize("form", ["exact", "closure"])
@settings(deadline=None, derandomize=True)
@given(damping=st.floats(0.05, 5), speed=speeds, intensity=st.floats(0.01, 2))
def test_limits_of_filtered_noise(form: str, damping: float, speed: float, intensity: float) -> None:
    def of(noise) -> complex:
        return complex(analysis.mean_amplitude(noise, damping=damping, speed=speed, form=form))

    white, none = of(WhiteSpeedNoise(intensity=intensity)), of(None)
    for noise, limit in (
        (LowPassSpeedNoise(intensity=intensity, corner_frequency=1e-10), none),
        (LowPassSpeedNoise(intensity=intensity, corner_frequency=1e9), white),
        (HighPassSpeedNoise(intensity=intensity, corner_frequency=1e-10), white),
        (HighPassSpeedNoise(intensity=intensity, corner_frequency=1e9), none),
    ):
        assert abs(of(noise) - limit) <= 1e-5 * abs(limit), noise


@settings(deadline=None, derandomize=True)
@given(
    form=st.sampled_from(["exact", "closure", "printed"]),
    kind=st.sampled_from([None, WhiteSpeedNoise, LowPassSpeedNoise, HighPassSpeedNoise]),
    damping=st.floats(0.1, 5),
    speed=speeds,
    scale=st.floats(0.1, 10),
    intensity=st.floats(0.01, 0.3),
)
def test_only_ratios_of_frequencies_and_the_amplitude_count(form, kind, damping, speed, scale, intensity) -> None:
    def noise(scale: float):
        if kind is None:
            return None
        more = {} if kind is WhiteSpeedNoise else {"corner_frequency": 0.6 * scale}
        return kind(intensity=intensity * math.sqrt(scale), **more)

    one = analysis.mean_amplitude(noise(1.0), damping=damping, speed=speed, form=form)
    other = analysis.mean_amplitude(
        noise(scale),
        damping=damping,
        speed=speed * scale / 2,
        wavenumber=2.0,
        natural_frequency=scale,
        amplitude=3.0,
        form=form,
    )
    assert complex(other) == pytest.approx(3 * complex(one), rel=1e-9)


@settings(deadline=None, derandomize=True)
@given(speed=speeds, intensity=st.floats(0.01, 3), corner=st.floats(1e-3, 1e3))
def test_critical_damping_is_no_special_point(speed: float, intensity: float, corner: float) -> None:
    for kind in (LowPassSpeedNoise, HighPassSpeedNoise):
        noise = kind(intensity=intensity, corner_frequency=corner)
        below, at, above = analysis.mean_amplitude(noise, damping=[1 - 1e-9, 1, 1 + 1e-9], speed=speed)
        assert abs(below - at) <= 1e-7 * abs(at)
        assert abs((below + above) / 2 - at) <= 1e-11 * abs(at)


def test_shapes_broadcast() -> None:
    damping, speed = np.array([[0.1], [1.0]]), np.array([0.5, 1.0, 2.0])
    for noise in (None, "white", "low_pass", "high_pass"):
        for form in ("exact", "closure", "printed"):
            result = analysis.mean_amplitude(noise, damping=damping, speed=speed, form=form)
            assert result.shape == (2, 3)
            alone = analysis.mean_amplitude(noise, damping=1.0, speed=0.5, form=form)
            assert isinstance(alone, np.complex128)
            assert alone == pytest.approx(result[1, 0], rel=1e-12)
    system = analysis.moment_system("high_pass", damping=damping, speed=speed)
    assert (system.matrix.shape, system.forcing.shape, system.stationary().shape) == ((2, 3, 8, 8), (2, 3, 8), (2, 3, 8))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: analysis.mean_amplitude("white", damping=0, speed=1), r"damping must be positive, got 0\.0"),
        (lambda: analysis.mean_amplitude("white", damping=1, speed=-1), "speed must be zero or above"),
        (
            lambda: analysis.mean_amplitude("white", damping=1, speed=1, form="right"),
            "form must be one of exact, closure, printed",
        ),
        (lambda: analysis.moment_system("white", damping=1, speed=1, form="exact"), "form must be one of closure, printed"),
        (lambda: analysis.mean_amplitude("white", damping=1, speed=1, amplitude=0), "amplitude must be positive"),
        (lambda: analysis.mean_amplitude("white", damping=1, speed=1, wavenumber=-1), "wavenumber must be positive"),
        (
            lambda: analysis.mean_amplitude("white", damping=1, speed=1, natural_frequency=0),
            "natural_frequency must be positive",
        ),
        (lambda: analysis.mean_amplitude("pink", damping=1, speed=1), "unknown speed noise 'pink'"),
        (
            lambda: analysis.mean_amplitude(WhiteSpeedNoise(intensity=1.0), damping=1.25, speed=0, form="printed"),
            "must not make the moment equations singular",
        ),
    ],
)
def test_bad_input_is_named(call, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        call()
