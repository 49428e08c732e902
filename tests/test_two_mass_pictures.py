"""The picture of a car of two masses: its tyre, what it says in SI units, and how fast its films run."""

import itertools
import math

import numpy as np
import pygame
import pytest

from agents import driving
from agents.cli import main
from agents.controllers import make_controller
from roadgym import TwoMassCar, rendering
from roadgym.env import QuarterCarEnv
from roadgym.gauges import Gauges
from roadgym.rendering import FORCE, GROUND, INK, NOW, ROAD_REACH, ROAD_ZERO
from roadgym.task import make_task

STATIC = 9.81 * (240 + 36)  # N
FREE = STATIC / 160e3  # m by which the tyre is pressed at rest


@pytest.fixture(autouse=True)
def no_window(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield
    pygame.display.quit()


def make(**parameters):
    return QuarterCarEnv(**{"render_mode": "rgb_array", "car": "two_mass", "road": "iso_c", "speed": 20.0, **parameters})


def act(damping):
    return np.array([damping], np.float32)


def place(env, **heights):
    """Put body, wheel and road to these heights, m, as the picture and nothing else sees them."""
    deviation = math.sqrt(env.task.road.variance)
    history = env.history
    history.heights = [heights["body"] / deviation, heights["wheel"] / deviation]
    history.trace[-1, :2] = heights["body"] / deviation, heights["road"] / deviation
    return env.render(), ROAD_REACH / history.limit / deviation  # pixels a metre


def wheel(picture):
    """Rows of the ink in the column through the hub, below the bridge, and columns of its lowest row."""
    dark = (np.abs(picture.astype(int) - INK) <= 30).all(axis=-1)[: rendering.GROUND_BOTTOM - 20, NOW - 60 : NOW + 60]
    rows = np.nonzero(dark.any(axis=1))[0]
    lowest = np.nonzero(dark[rows.max()])[0]
    return rows, np.ptp(lowest) + 1


def test_the_tyre_is_pressed_and_let_go_as_the_wheel_moves():
    env = make()
    env.reset(seed=0)
    env.history.path = type(env.history.path)([(0.0, -9.0)])  # no road where one looks
    feet, widths, tops = [], [], []
    for deflection in (-0.010, 0.0, 0.010):
        picture, metre = place(env, body=0.0, wheel=deflection, road=0.0)
        rows, width = wheel(picture)
        feet.append(rows.max())
        widths.append(width)
        hub = [row for row in range(ROAD_ZERO - 60, ROAD_ZERO) if tuple(picture[row, NOW - 12]) == (214, 214, 214)]
        tops.append((hub[0] + hub[-1]) / 2)
    assert np.abs(np.array(feet) - (ROAD_ZERO - 1)).max() <= 1  # on the road all the time
    assert widths[0] > widths[1] > widths[2] > 4  # flatter, the more it is pressed
    np.testing.assert_allclose(np.diff(tops), -0.010 * metre, atol=1)  # the hub moves with the wheel
    picture, metre = place(env, body=0.0, wheel=FREE + 0.02, road=0.0)
    gap = ROAD_ZERO - 1 - wheel(picture)[0].max()
    assert gap == pytest.approx(0.02 * metre + FREE * metre - 10, abs=2)  # round, and off the road


def test_a_wheel_off_the_road_is_told():
    env = make(road="iso_f", speed=30.0)
    env.reset(seed=1)
    off, seen = [], []
    for _ in range(400):
        env.step(act(0.1))
        off.append(env.history.loads[-1] <= -STATIC)
        if len(off) % 20 == 0:
            red = (np.abs(env.render().astype(int) - rendering.FIRM) <= 2).all(axis=-1)
            seen.append((off[-1], red[535:552, rendering.WIDTH - 100 : rendering.WIDTH - 20].sum() > 20))
    assert {told for _, told in seen} == {True, False}
    assert all(truth == told for truth, told in seen)
    assert env.history.lifted == sum(off)
    readings = Gauges.of(env.task).readings(env.history, 1)
    assert readings["off the road"] == f"{100 * np.mean(off):.1f} % of the time"
    env.reset()
    assert env.history.lifted == 0


def test_figures_are_those_of_the_plant_in_si_units():
    names = ["acceleration", "wheel_load", "displacement", "level"]
    env = make(observation=names, observe_operating_point=False, car={"kind": "two_mass", "weighting": "Wk"})
    env.reset(seed=3)
    for _ in range(50):
        acceleration, load, body, road = env.step(act(0.3))[0] * env.signal_scale
    history, gauges = env.history, Gauges.of(env.task)
    assert history.signals["acceleration"] == pytest.approx(acceleration, rel=1e-5)
    assert history.loads[-1] == pytest.approx(-load, rel=1e-5)
    assert gauges.height_text(history.trace[-1, 0]) == f"{1e3 * body:.1f} mm".replace("-", "−")
    assert gauges.height_text(history.trace[-1, 1]) == f"{1e3 * road:.1f} mm".replace("-", "−")
    assert gauges.load_text(history.loads[-1]) == f"{STATIC - load:.0f} N"
    readings = gauges.readings(history, 3)
    coefficient = TwoMassCar().damping_coefficient(np.float32(0.3))
    expected = {
        "speed": "72 km/h",
        "σ of the road": "20.1 mm",
        "cost": "ÿ²",
        "damping": f"{coefficient:.4g} N s/m",
        "acceleration": f"{acceleration:.2f} m/s²".replace("-", "−"),
        "off the road": "0.0 % of the time",
        "driven": "0.2 s, 5 m",
        "scale": f"20 px a metre, {ROAD_REACH / history.limit / 20.05:.2g} px a mm up",
        "shown": "1 step in 3, 0.9 × real time",
    }
    assert readings == expected
    assert gauges.readings(history, 1)["shown"] == "60 steps/s, 0.3 × real time"
    assert (gauges.damping(0.5), gauges.static_load) == ("1960 N s/m", pytest.approx(STATIC))


def test_traces_lie_where_their_numbers_say():
    env = make()
    env.reset(seed=4)
    for _ in range(120):
        env.step(act(0.2))
    picture, history, band = env.render(), env.history, Gauges.of(env.task).load
    for ago in (10, 40, 90):
        column = NOW - 2 * ago
        purple = np.nonzero(np.abs(picture[500:590, column].astype(int) - FORCE).max(axis=-1) <= 60)[0] + 500
        expected = band.zero - history.loads[-1 - ago] * band.reach / history.load_limit
        assert purple.min() - 3 <= expected <= purple.max() + 3
    # the road is in metres: as far to the left as the car has come
    columns = np.nonzero((np.abs(picture[ROAD_ZERO + 60].astype(int) - GROUND) <= 2).all(axis=-1))[0]
    assert NOW - columns.min() == pytest.approx(20 * 120 * 0.005 * 20.0, abs=2)


@pytest.mark.parametrize(
    ("car", "road", "bands"),
    [
        ("golden_car", "iso_a", True),
        ({"kind": "two_mass", "tyre_damping": 300.0}, "iso_c", False),  # whose wheel load contains white noise
        ({"kind": "two_mass", "tyre_damping": 300.0}, {"kind": "gaussian", "iso_class": "C"}, True),
    ],
)
def test_other_cars_of_two_masses(car, road, bands):
    env = make(car=car, road=road, speed_noise=None)
    env.reset(seed=0)
    for _ in range(20):
        env.step(act(0.3))
    assert ("off the road" in Gauges.of(env.task).readings(env.history, 1)) == bands
    assert env.render().shape == (640, 800, 3)
    if car == "golden_car":
        assert Gauges.of(env.task).load_text(0.0) == "11.3 N"
        assert Gauges.of(env.task).load_tick == "11 N"


def test_a_car_of_one_mass_is_told_as_theory_counts():
    gauges = Gauges.of(make_task())
    assert (gauges.unit, gauges.height, gauges.load, gauges.signals) == ("σ", 1.0, None, ())
    assert gauges.damping(0.05) == "0.05"


def test_films_run_as_fast_as_the_drive_and_slower_on_demand(tmp_path, monkeypatch):
    counted = []
    usual = driving.frames

    def watched(*given, every, **options):
        counted.append(every)
        return usual(*given, every=every, **options)

    monkeypatch.setattr(driving, "frames", watched)
    command = ["drive", "--controller", "d_min", "--car", "two_mass", "--seconds", "0.1", "--output", str(tmp_path / "a.gif")]
    for options in ([], ["--pace", "0.3"], ["--pace", "2"], ["--control-interval", "0.05"]):
        assert main([*command, *options]) == 0
    assert counted == [3, 1, 7, 1]
    assert main([*command, "--pace", "0"]) == 2


def test_a_film_of_every_third_step_has_the_same_pictures():
    environment = {"car": "two_mass", "road": "iso_c", "speed": 20.0}
    pair = [(name, make_controller(name, make_task(**environment))) for name in ("skyhook", "d_max")]
    car = np.s_[60:432, 420:660]
    every = list(itertools.islice(driving.frames(pair, environment, seed=2), 31))[::3]
    third = list(itertools.islice(driving.frames(pair, environment, seed=2, every=3), 11))
    for one, other in zip(every, third, strict=True):
        np.testing.assert_array_equal(one[car], other[car])
    assert np.any(third[0][car] != third[-1][car])
