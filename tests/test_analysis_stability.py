import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import analysis
from roadgym.parameters import ParameterError
from roadgym.speed import WhiteSpeedNoise

SENSES, FORMS = ("almost_sure", "mean"), ("ito", "printed")
dampings = st.floats(0.01, 3).filter(lambda d: abs(d - 1) > 1e-6)  # at D = 1 eigenvalues of a matrix are good to 1e-8 only


@settings(deadline=None, derandomize=True)
@given(damping=dampings, speed=st.floats(0, 5), intensity=st.floats(0.01, 2), scale=st.floats(0.1, 10))
@pytest.mark.parametrize("form", FORMS)
def test_exponents_and_rotation_numbers_are_eigenvalues(form: str, damping, speed, intensity, scale) -> None:
    matrix = analysis.moment_system(
        WhiteSpeedNoise(intensity=intensity),
        damping=damping,
        speed=speed,
        natural_frequency=scale,
        form="closure" if form == "ito" else form,
    ).matrix
    values = np.linalg.eigvals(matrix)
    tolerance = 1e-6 * (scale + speed + intensity**2)
    arguments = {"intensity": intensity, "natural_frequency": scale, "form": form}
    top, second = analysis.lyapunov_exponents(damping, sense="mean", **arguments)
    np.testing.assert_allclose(np.sort(values.real), [second, second, top, top], atol=tolerance)
    upper, lower = analysis.rotation_numbers(damping, speed=speed, natural_frequency=scale)
    expected = sorted([upper, lower, -upper, -lower])
    np.testing.assert_allclose(np.sort(values.imag), expected, atol=tolerance)
    # The noise rotates all amplitudes alike, dV = M V dt + sigma B V dW with B^2 = -1, and B commutes with M:
    # V is exp(sigma B W) times the solution of V' = (M - sigma^2 B^2/2) V.
    top, second = analysis.lyapunov_exponents(damping, **arguments)
    np.testing.assert_allclose(np.sort(values.real + intensity**2 / 2), [second, second, top, top], atol=tolerance)


def test_exponents_by_hand() -> None:
    damping = np.array([0.0, 0.5, 1.0, 1.25])
    own = (np.array([0, -1, -2, -1]), np.array([0, -1, -2, -4]))  # w1 = 2
    for (sense, form), shift in {
        ("almost_sure", "ito"): 0.0,
        ("mean", "ito"): -0.18,
        ("almost_sure", "printed"): 0.36,
        ("mean", "printed"): 0.18,
    }.items():
        got = analysis.lyapunov_exponents(damping, intensity=0.6, natural_frequency=2.0, sense=sense, form=form)
        for exponent, free in zip(got, own, strict=True):
            np.testing.assert_allclose(exponent, free + shift, atol=1e-14)


def test_rotation_numbers_of_figure_13() -> None:
    upper, lower = analysis.rotation_numbers([0.0, 0.6, 1.0, 1.5], speed=[[0.0], [0.5]], wavenumber=4.0)
    np.testing.assert_allclose(upper, [[1, 0.8, 0, 0], [3, 2.8, 2, 2]])
    np.testing.assert_allclose(lower, [[-1, -0.8, 0, 0], [1, 1.2, 2, 2]])


def test_stability_map_of_figure_14() -> None:
    damping = [0.0, 0.5, 1.0, 1.25]
    np.testing.assert_allclose(analysis.critical_noise(damping, natural_frequency=2.0, form="printed"), [0, 1, 2, 1])
    np.testing.assert_allclose(
        analysis.critical_noise(damping, natural_frequency=2.0, form="printed", sense="mean"), [0, 2, 4, 2]
    )
    assert analysis.critical_noise(damping).tolist() == [0, math.inf, math.inf, math.inf]
    assert analysis.critical_noise(damping, sense="mean").tolist() == [math.inf] * 4
    assert isinstance(analysis.critical_noise(0.3), np.float64)


@pytest.mark.parametrize("sense", SENSES)
@settings(deadline=None, derandomize=True)
@given(damping=st.floats(0, 1e6), scale=st.floats(0.01, 100))
def test_stability_is_lost_at_the_critical_noise(sense: str, damping: float, scale: float) -> None:
    arguments = {"natural_frequency": scale, "sense": sense, "form": "printed"}
    critical = float(analysis.critical_noise(damping, **arguments))
    top, second = analysis.lyapunov_exponents(damping, intensity=math.sqrt(critical), **arguments)
    assert top == pytest.approx(0, abs=1e-14 * scale)
    assert second <= top
    assert analysis.lyapunov_exponents(damping, intensity=math.sqrt(critical) * 1.01 + 1e-3, **arguments)[0] > 0


@settings(deadline=None, derandomize=True)
@given(damping=st.floats(0, 10), intensity=st.floats(0, 10))
@pytest.mark.parametrize("sense", SENSES)
def test_noise_never_destabilises(sense: str, damping: float, intensity: float) -> None:
    assert analysis.lyapunov_exponents(damping, intensity=intensity, sense=sense)[0] <= 0


def test_exponents_without_cancellation_and_across_critical_damping() -> None:
    top, second = analysis.lyapunov_exponents(1e9)
    assert top == pytest.approx(-5e-10, rel=1e-12)
    assert second == pytest.approx(-2e9, rel=1e-12)
    for step in (1e-12, 1e-15):
        for exponent in analysis.lyapunov_exponents([1 - step, 1 + step]):
            np.testing.assert_allclose(exponent, -1, atol=3 * math.sqrt(step))


def test_shapes_broadcast() -> None:
    damping, other = np.full((3, 1), 0.2), np.ones(2)
    assert [part.shape for part in analysis.lyapunov_exponents(damping, intensity=other)] == [(3, 2)] * 2
    assert [part.shape for part in analysis.rotation_numbers(damping, speed=other)] == [(3, 2)] * 2
    assert analysis.critical_noise(damping).shape == (3, 1)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: analysis.lyapunov_exponents(-0.1), r"damping must be zero or above, got -0\.1"),
        (lambda: analysis.lyapunov_exponents(0.1, intensity=-1), "intensity must be zero or above"),
        (lambda: analysis.lyapunov_exponents(0.1, sense="sure"), "sense must be one of almost_sure, mean, got 'sure'"),
        (lambda: analysis.lyapunov_exponents(0.1, form="closure"), "form must be one of ito, printed, got 'closure'"),
        (lambda: analysis.critical_noise(0.1, natural_frequency=-1), "natural_frequency must be positive"),
        (lambda: analysis.rotation_numbers(0.1, speed=math.nan), "speed must be finite"),
        (lambda: analysis.rotation_numbers(0.1, speed=1, wavenumber=0), "wavenumber must be positive"),
    ],
)
def test_bad_input_is_named(call, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        call()
