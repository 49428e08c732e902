"""The certificate: sound plants pass, deliberately wrong ones fail on the line that is theirs, and its theory is right."""

import dataclasses
import functools
import json
import math
import re

import numpy as np
import pytest
from plants import PLANTS, plant_name
from scipy import integrate, stats
from wrong_plants import WRONG, AllByTime, NotANumber, Stratonovich, advance_shifted

import analysis
import roadgym
from agents.cli import main
from analysis.certification import (
    FALSE_ALARM_RATE,
    autocovariance,
    certify,
    expected_periodogram,
    level_distribution,
)
from analysis.sampling import Samples
from roadgym import (
    FirstOrderRoad,
    GaussianRoad,
    HarmonicRoad,
    HighPassSpeedNoise,
    LowPassSpeedNoise,
    MultiplicativeRoad,
    ParameterError,
    WhiteSpeedNoise,
)
from roadgym.roads import Road

FEW = 2048  # lanes, enough for the faults of `wrong_plants`


@functools.cache
def sound_certificate(road, speed_noise=None):
    return certify(road, speed_noise, speed=1.3, lanes=1024)


def failures(certificate):
    return [line.name for line in certificate.lines if not line.passed]


@pytest.mark.statistical
@pytest.mark.parametrize("plant", PLANTS, ids=plant_name)
def test_sound_plants_pass(plant):
    certificate = sound_certificate(**plant)
    assert not failures(certificate)
    assert certificate.passed
    names = " ".join(line.name for line in certificate.lines)
    closed = plant["speed_noise"] is None or plant["road"] == "harmonic"
    for wanted, where in (
        ("variance of the level", True),
        ("variance of the slope", plant["road"] != "first_order"),
        ("spectral density", closed),
        ("law of the level", True),
        ("law at double against half speed", True),
        ("at most 1", plant["road"] == "multiplicative"),
        ("mean square of the displacement", closed),
        (
            "mean square of the acceleration",
            closed and plant["road"] != "first_order" and plant["speed_noise"] in (None, "low_pass"),
        ),
    ):
        assert (wanted in names) == where
    assert ("spectral density" in " ".join(certificate.left_out)) == (not closed)


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("road", "speed_noise"),
    [
        (MultiplicativeRoad.from_shape(shape=0.3, bandwidth=0.6, level_bound=0.1, wavenumber=0.4), None),
        (MultiplicativeRoad(bandwidth=0.6, noise_intensity=0.1, level_bound=0.1, slope_bound=0.2, wavenumber=0.4), None),
        (GaussianRoad(bandwidth=1.0, noise_intensity=0.01, wavenumber=0.2), None),
        (HarmonicRoad(amplitude=0.05, wavenumber=0.3), HighPassSpeedNoise(intensity=3.0, corner_frequency=5.0)),
    ],
)
def test_sound_plants_pass_in_other_units(road, speed_noise):
    # a natural frequency of 8 rad/s, a speed in m/s, a road of centimetres
    assert not failures(certify(road, speed_noise, speed=20.0, damping=0.4, natural_frequency=8.0, lanes=1024))


# ---------------------------------------------------------------------- deliberately wrong plants


@pytest.mark.statistical
@pytest.mark.parametrize("fault", list(WRONG))
def test_wrong_plants_fail_on_their_line(fault):
    road, speed_noise, lines = WRONG[fault]
    certificate = certify(road, speed_noise, lanes=FEW)
    assert not certificate.passed
    assert "NOT certified" in certificate.table()
    failed = failures(certificate)
    for line in lines:
        assert any(name.startswith(line) or name.endswith(line) for name in failed)


def test_a_plant_that_is_not_a_number_fails():
    certificate = certify(NotANumber(), lanes=1024)
    assert set(failures(certificate)) == {line.name for line in certificate.lines}
    assert json.loads(certificate.to_json())["lines"][0]["measured"] is None


@pytest.mark.statistical
def test_squares_at_the_ends_of_substeps_alone_are_found_out(monkeypatch):
    """At constant damping they have the right mean; where it switches, the acceleration at the beginning is missing."""
    monkeypatch.setattr("roadgym.plant.interval_weights", lambda substeps: np.append(0.0, np.full(substeps, 1 / substeps)))
    failed = failures(certify("gaussian", lanes=FEW))
    assert "acceleration with skyhook (m^2)" in failed
    assert not any(name.startswith(("mean square", "variance", "law")) for name in failed)


@pytest.mark.statistical
def test_another_sound_scheme_passes():
    # the twin of the fault above: the certificate judges the law, not the code
    assert not failures(certify(Stratonovich(), lanes=FEW))
    # faults that leave the law of the level alone are found by other lines
    assert not any("law" in name for name in failures(certify(AllByTime(bandwidth=0.3), lanes=FEW)))


# ---------------------------------------------------------------------- the theory behind the lines


@pytest.mark.parametrize(
    "road",
    [
        FirstOrderRoad(noise_intensity=0.4, wavenumber=0.7),
        *(GaussianRoad(bandwidth=delta, noise_intensity=0.4, wavenumber=0.7) for delta in (0.2, 1.0, 2.5)),
        MultiplicativeRoad(bandwidth=0.3, wavenumber=0.7),
    ],
)
def test_autocovariance_and_spectral_density_are_a_pair(road):
    speed = 1.7
    assert autocovariance(road, None, 0.0, speed=speed) == pytest.approx(road.variance)
    for frequency in (0.4, 1.19, 3.0):
        both = integrate.quad(lambda t: autocovariance(road, None, t, speed=speed), 0, np.inf, weight="cos", wvar=frequency)
        assert 2 * both[0] == pytest.approx(float(analysis.spectral_density(road, frequency, speed=speed)), rel=1e-6)


@pytest.mark.parametrize("lag", [0.0, 0.3, 2.0, 15.0])
def test_autocovariance_under_phase_noise_is_the_sum_of_its_lines(lag):
    # the exact series in sigma^2/(2 w_g): of decaying exponentials, with Poisson weights of either sign
    road, intensity, corner = HarmonicRoad(amplitude=1.3, wavenumber=0.7), 0.6, 0.5
    mean = intensity**2 / (2 * corner)
    order = np.arange(60)
    power = np.cumprod(np.concatenate([[1.0], mean / order[1:]]))
    high = np.sum(power * np.exp(-mean - order * corner * lag))
    low = np.sum(power * (-1.0) ** order * np.exp(mean - (intensity**2 / 2 + order * corner) * lag))
    for noise, decay in (
        (None, 1.0),
        (WhiteSpeedNoise(intensity=intensity), np.exp(-(intensity**2) * lag / 2)),
        (LowPassSpeedNoise(intensity=intensity, corner_frequency=corner), low),
        (HighPassSpeedNoise(intensity=intensity, corner_frequency=corner), high),
    ):
        expected = road.variance * np.cos(1.1 * 0.7 * lag) * decay
        assert autocovariance(road, noise, lag, speed=1.1) == pytest.approx(expected, rel=1e-9)


def test_expected_periodogram_tends_to_the_spectral_density():
    road, interval, ratios = GaussianRoad(bandwidth=0.2, noise_intensity=1.0), 0.1, (0.5, 1.0, 2.0)
    exact = analysis.spectral_density(road, np.array(ratios), speed=1.0)
    errors = []
    for times in (1000, 4000):
        nothing = np.zeros(0)
        samples = Samples(
            level_square=nothing,
            slope_square=nothing,
            level=nothing,
            largest_square=0.0,
            periodogram=nothing,
            mean_squares=nothing,
            window=np.hanning(times + 2)[1:-1],
            interval=interval,
        )
        errors.append(np.abs(expected_periodogram(samples, road, None, 1.0, ratios) / exact - 1))
    assert np.all(errors[0] < 0.05)
    assert np.all(errors[1] < 0.005)


@pytest.mark.parametrize(
    ("road", "law"),
    [
        (HarmonicRoad(amplitude=1.4), stats.arcsine(-1.4, 2.8)),
        (FirstOrderRoad(noise_intensity=0.3), stats.norm(scale=0.3 / math.sqrt(2))),
        (GaussianRoad(bandwidth=0.1, noise_intensity=0.3), stats.norm(scale=0.3 / math.sqrt(0.4))),
        *(
            (MultiplicativeRoad.from_shape(shape=shape, level_bound=0.9), stats.beta(shape + 0.5, shape + 0.5, -0.9, 1.8))
            for shape in (0.1, 0.5, 3.0, 50.0)
        ),
    ],
)
def test_level_distribution_is_the_law(road, law):
    level = np.linspace(-1.5, 1.5, 1001)
    np.testing.assert_allclose(level_distribution(road, level), law.cdf(level), atol=1e-4)


# ---------------------------------------------------------------------- the certificate itself


@dataclasses.dataclass(frozen=True, kw_only=True)
class NewRoad(Road):
    """A road that theory has not heard of, with the lane functions of another."""

    kind: str = dataclasses.field(default="new", init=False)
    bandwidth: float = 0.3
    variance = 2.0
    prepare = GaussianRoad.prepare
    start = GaussianRoad.start
    advance = GaussianRoad.advance


def test_lines_without_theory_are_left_out():
    certificate = certify(NewRoad(), lanes=1024)
    assert certificate.passed
    assert [line.name.split(" (")[0] for line in certificate.lines] == [
        "variance of the level",
        "law at double against half speed, Kolmogorov-Smirnov distance",
        "variance at double over half speed",
    ]
    assert [reason.split(" (")[0] for reason in certificate.left_out] == [
        "variance of the slope",
        "spectral density",
        "law of the level",
        "mean squares of the car",
        "mean squares of the car where D switches",
    ]


def test_the_same_seed_gives_the_same_certificate_and_another_one_another():
    first = sound_certificate("gaussian")
    assert certify("gaussian", speed=1.3, lanes=1024) == first
    other = certify("gaussian", speed=1.3, lanes=1024, seed=1)
    assert other.lines[0].measured != first.lines[0].measured


def test_lines_carry_their_verdict():
    certificate = sound_certificate("multiplicative")
    tested = [line for line in certificate.lines if line.p_value is not None]
    assert certificate.significance == pytest.approx(FALSE_ALARM_RATE / len(tested))
    for line in tested:
        assert line.passed == (line.p_value >= certificate.significance)
        assert line.distance == pytest.approx((line.measured - line.expected) / line.standard_error)
    (bound,) = (line for line in certificate.lines if line.p_value is None)
    assert bound.passed
    assert bound.measured <= bound.expected == 1.0


def test_table_and_json_say_the_same():
    certificate = sound_certificate("first_order")
    table, data = certificate.table(), json.loads(certificate.to_json())
    assert data["passed"] is certificate.passed
    assert data["plant"] == certificate.plant == table.splitlines()[0]
    assert data["plant"] == "first_order (wavenumber 1, noise_intensity 0.5) road, no speed noise"
    assert table.splitlines()[1] == "speed 1.3 m/s, damping 0.3, natural frequency 1 rad/s; 1024 lanes, seed 0"
    assert [line["name"] for line in data["lines"]] == [line.name for line in certificate.lines]
    rows = table.splitlines()[4 : 4 + len(certificate.lines)]
    assert len({len(row) for row in rows}) == 1  # aligned
    for row, line in zip(rows, certificate.lines, strict=True):
        name, *cells, verdict = re.split(r"  +", row)
        assert name.startswith(("variance", "PSD, ", "law", "balance, travel^2", *roadgym.MEAN_SQUARES, "relative velocity"))
        assert cells == [f"{line.measured:.5g}", f"{line.expected:.5g}", f"{line.standard_error:.2g}", f"{line.p_value:.2g}"]
        assert verdict == ("pass" if line.passed else "FAIL")
    assert "Left out: mean square of the acceleration (infinite on this plant)." in table


def test_table_reads_in_a_terminal_of_80_columns():
    certificate = sound_certificate("multiplicative")
    for lines in (certificate.lines, (dataclasses.replace(certificate.lines[0], name="a name " * 20, measured=-1.2345e-105),)):
        table = dataclasses.replace(certificate, lines=lines, left_out=("a reason " * 20,)).table()
        assert max(map(len, table.splitlines())) <= 80
        assert table.count("\n  ") < 20  # most names take one line
    names = {re.split(r"  +", row)[0] for row in certificate.table().splitlines()}
    assert {"variance of the level (m^2)", "relative velocity, skyhook (m^2)", "travel, constant (m^2)"} <= names


def test_reports_end_where_the_work_ends():
    reports = []
    certify("first_order", speed=2.0, lanes=1024, report=lambda *told: reports.append(told))
    assert {told[0] for told in reports} == {"at 1 m/s", "at 2 m/s", "at 4 m/s", "with D alternating", "with skyhook"}
    for what in ("at 1 m/s", "at 2 m/s", "at 4 m/s"):
        done = [told[1] for told in reports if told[0] == what]
        (total,) = {told[2] for told in reports if told[0] == what}
        assert done == sorted(done)
        assert done[-1] == total


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"road": "gravel"}, "unknown road 'gravel'"),
        ({"road": "gaussian", "speed_noise": "white"}, "white speed noise is defined on the harmonic road only"),
        ({"road": "gaussian", "speed": -1.0}, "speed must be positive, got -1.0"),
        ({"road": "gaussian", "damping": 0.0}, "damping must be positive, got 0.0"),
        ({"road": "gaussian", "natural_frequency": "high"}, "natural_frequency must be a number, got 'high'"),
        ({"road": "gaussian", "seed": -1}, "seed must be at least 0, got -1"),
        ({"road": "gaussian", "lanes": 1023}, "lanes must be at least 1024 to have a standard error, got 1023"),
    ],
)
def test_bad_input_is_refused_by_name(parameters, message):
    with pytest.raises(ParameterError, match=message):
        certify(**parameters)


# ---------------------------------------------------------------------- roadgym certify


def test_command_prints_the_table_and_succeeds(capsys):
    assert main(["certify", "--road", "first_order", "--lanes", "1024", "--speed", "2", "--damping", "0.5", "--seed", "1"]) == 0
    assert capsys.readouterr().out == certify("first_order", speed=2.0, damping=0.5, seed=1, lanes=1024).table() + "\n"


def test_command_prints_json_and_says_1_where_the_plant_fails(capsys, monkeypatch):
    arguments = ["certify", "--road", "harmonic", "--speed-noise", '{"kind": "white", "intensity": 0.5}', "--lanes", "1024"]
    assert main([*arguments, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["passed"] is True
    monkeypatch.setattr(WhiteSpeedNoise, "advance", advance_shifted)
    assert main([*arguments, "--lanes", str(FEW)]) == 1
    assert "FAIL" in capsys.readouterr().out


def test_command_refuses_in_one_line(capsys):
    assert main(["certify", "--road", "gaussian", "--lanes", "3"]) == 2
    assert capsys.readouterr().err == "roadgym certify: lanes must be at least 1024 to have a standard error, got 3\n"
