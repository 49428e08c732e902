import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import dblquad, quad

import analysis
from roadgym.parameters import ParameterError
from roadgym.roads import FirstOrderRoad, GaussianRoad, HarmonicRoad, MultiplicativeRoad, Road

ROADS = {
    "harmonic": HarmonicRoad(amplitude=0.7),
    "first_order": FirstOrderRoad(noise_intensity=0.3, wavenumber=2.0),
    "gaussian": GaussianRoad(bandwidth=0.4, noise_intensity=0.3, wavenumber=2.0),
    **{
        f"multiplicative_{shape:g}": MultiplicativeRoad.from_shape(shape=shape, level_bound=0.9)
        for shape in (0.3, 0.5, 1, 3, 40)
    },
}
JOINT = {name: road for name, road in ROADS.items() if isinstance(road, GaussianRoad | MultiplicativeRoad)}


def bound(road: Road) -> float:
    return {"harmonic": 0.7, "multiplicative": 0.9}.get(road.kind, 14 * math.sqrt(road.variance))


@pytest.mark.parametrize("name", ROADS)
def test_marginal_density_has_unit_mass_and_the_road_variance(name: str) -> None:
    road = ROADS[name]
    edge = bound(road)
    # z = edge sin(angle) takes the edge singularity away
    for power, expected in ((0, 1.0), (1, 0.0), (2, road.variance)):
        value = quad(
            lambda a, n=power: (
                (edge * math.sin(a)) ** n * float(analysis.marginal_density(road, edge * math.sin(a))) * edge * math.cos(a)
            ),
            -math.pi / 2 + 1e-9,
            math.pi / 2 - 1e-9,
            epsabs=1e-12,
            limit=200,
        )[0]
        assert value == pytest.approx(expected, rel=2e-6, abs=2e-6)


@pytest.mark.parametrize("name", JOINT)
def test_joint_density_integrates_to_the_marginal(name: str) -> None:
    road = JOINT[name]
    edge = bound(road)
    for level in (0.0, 0.3 * edge, -0.8 * edge):
        half = math.sqrt(edge**2 - level**2)
        mass = quad(
            lambda a, z=level, h=half: float(analysis.density(road, z, h * math.sin(a))) * h * math.cos(a),
            -math.pi / 2 + 1e-6,
            math.pi / 2 - 1e-6,
            limit=200,
        )[0]
        assert mass == pytest.approx(float(analysis.marginal_density(road, level)), rel=1e-3)  # the cut edge at shape 0.3


@pytest.mark.parametrize("name", ["gaussian", "multiplicative_3"])
def test_joint_density_has_unit_mass_and_solves_the_fokker_planck_equation(name: str) -> None:
    road = JOINT[name]
    edge = bound(road) if road.kind == "multiplicative" else 8 * math.sqrt(road.variance)
    mass = dblquad(lambda r, a: float(analysis.density(road, r * math.cos(a), r * math.sin(a))) * r, 0, 2 * math.pi, 0, edge)[0]
    assert mass == pytest.approx(1, rel=1e-7)

    # (10), divided by v: 0 = W d/du[(2 delta u + z) p] - W d/dz[u p] + sigma^2/2 d2/du2 [V^2 p], by central differences
    h = 1e-4 * edge
    z, u = 0.31 * edge, -0.23 * edge

    def p(z: float, u: float) -> float:
        return float(analysis.density(road, z, u))

    def diffused(u: float) -> float:
        return (1 - (z**2 + u**2) / edge**2 if road.kind == "multiplicative" else 1.0) * p(z, u)

    def pulled(u: float) -> float:
        return (2 * road.bandwidth * u + z) * p(z, u)

    terms = [
        road.wavenumber * (pulled(u + h) - pulled(u - h)) / (2 * h),
        -road.wavenumber * u * (p(z + h, u) - p(z - h, u)) / (2 * h),
        road.noise_intensity**2 / 2 * (diffused(u + h) - 2 * diffused(u) + diffused(u - h)) / h**2,
    ]
    assert sum(terms) == pytest.approx(0, abs=1e-5 * max(map(abs, terms)))


def test_density_at_and_beyond_the_bound() -> None:
    singular, uniform, smooth = (MultiplicativeRoad.from_shape(shape=shape) for shape in (0.5, 1, 3))
    assert analysis.density(singular, [1.0, 1.1], 0.0).tolist() == [math.inf, 0]
    assert analysis.density(uniform, [[0.2], [1.0], [1.1]], [0.0, 0.0]).tolist() == [
        [1 / math.pi] * 2,
        [1 / math.pi] * 2,
        [0, 0],
    ]
    assert analysis.density(smooth, [1.0, 1.1], 0.0).tolist() == [0, 0]
    # alpha = 1/2: a uniform marginal, against the paper's remark that it is the sinusoid's
    np.testing.assert_allclose(analysis.marginal_density(singular, [-1.0, 0.1, 0.99, 1.01]), [0.5, 0.5, 0.5, 0])
    assert analysis.marginal_density(HarmonicRoad(amplitude=2.0), [2.0, 2.1]).tolist() == [math.inf, 0]


def test_marginal_density_tends_to_the_arcsine_and_to_the_gaussian_law() -> None:
    level = np.linspace(-0.95, 0.95, 9)
    arcsine = analysis.marginal_density(HarmonicRoad(), level)
    np.testing.assert_allclose(analysis.marginal_density(MultiplicativeRoad.from_shape(shape=1e-9), level), arcsine, rtol=1e-7)
    wide = MultiplicativeRoad.from_shape(shape=1e8, level_bound=1e4)
    gaussian = GaussianRoad(bandwidth=wide.bandwidth, noise_intensity=wide.noise_intensity)
    np.testing.assert_allclose(analysis.marginal_density(wide, level), analysis.marginal_density(gaussian, level), rtol=1e-7)
    np.testing.assert_allclose(analysis.density(wide, level, 0.3), analysis.density(gaussian, level, 0.3), rtol=1e-7)


@pytest.mark.parametrize("name", ["first_order", *JOINT])
@pytest.mark.parametrize("speed", [0.3, 5.0])
def test_spectral_density_integrates_to_the_variance(name: str, speed: float) -> None:
    road = ROADS[name]
    corner = speed * road.wavenumber

    def spectrum(w: float) -> float:
        return float(analysis.spectral_density(road, w, speed=speed))

    half = quad(spectrum, 0, 3 * corner, limit=200)[0] + quad(spectrum, 3 * corner, np.inf)[0]
    assert half / math.pi == pytest.approx(road.variance, rel=1e-7)
    assert spectrum(-0.7) == spectrum(0.7)


def test_spectral_density_is_that_of_equation_5() -> None:
    road = ROADS["first_order"]
    w, v = np.array([[0.0], [1.3]]), np.array([0.5, 1.0, 7.0])
    expected = v * 0.3**2 / (w**2 + (2 * v) ** 2)
    np.testing.assert_allclose(analysis.spectral_density(road, w, speed=v), expected, rtol=1e-14)


@settings(deadline=None, derandomize=True)
@given(scale=st.floats(0.1, 10), shape=st.floats(0.05, 50), level=st.floats(-0.99, 0.99))
def test_marginal_density_scales_with_the_bound(scale: float, shape: float, level: float) -> None:
    one = MultiplicativeRoad.from_shape(shape=shape)
    other = MultiplicativeRoad.from_shape(shape=shape, level_bound=scale)
    assert float(analysis.marginal_density(other, scale * level)) * scale == pytest.approx(
        float(analysis.marginal_density(one, level)), rel=1e-9
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: analysis.density("first_order", 0, 0), "slope of a first_order road is white noise"),
        (lambda: analysis.density("harmonic", 0, 0), "lie on an ellipse"),
        (lambda: analysis.density("gaussian", [0, 1], [0, 1, 2]), r"level \(2,\), slope \(3,\)"),
        (lambda: analysis.density("gaussian", math.nan, 0), "level must be finite, got nan"),
        (lambda: analysis.marginal_density("gaussian", "high"), "level must be a number or an array of numbers, got 'high'"),
        (lambda: analysis.marginal_density("gaussian", [[1], [1, 2]]), "level must be a number or an array of numbers"),
        (lambda: analysis.spectral_density("harmonic", 1.0, speed=1.0), "pair of lines"),
        (lambda: analysis.spectral_density("gaussian", 1.0, speed=0.0), r"speed must be positive, got 0\.0"),
        (lambda: analysis.marginal_density("cobbles", 0.0), "unknown road 'cobbles'"),
    ],
)
def test_bad_input_is_named(call, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        call()


@pytest.mark.parametrize(
    "function", [lambda road: analysis.density(road, 0.0, 0.0), lambda road: analysis.marginal_density(road, 0)]
)
def test_density_on_an_ellipse_is_not_known(function):
    with pytest.raises(ParameterError, match=r"on a circle, got .*slope_bound=0\.5"):
        function(MultiplicativeRoad(slope_bound=0.5))
