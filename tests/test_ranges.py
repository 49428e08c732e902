"""What parameters may be: numbers are right within the ranges, and beyond them a value is refused at once."""

import math
import pickle
import time

import numpy as np
import pytest
from speed_plants import exact_mean_squares, finite_terms
from speed_scheme import scheme_mean_squares
from test_car import started_plant

import analysis
import roadgym
from roadgym import MEAN_SQUARES, SPEED_NOISES, GaussianRoad, ParameterError
from roadgym.compiled import LaneFunction
from roadgym.env import QuarterCarEnv
from roadgym.task import make_task
from roadgym.vector import QuarterCarVectorEnv

ELLIPSE = {"kind": "multiplicative", "bandwidth": 0.3, "noise_intensity": 0.3, "slope_bound": 0.7}


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"speed": 1e7}, "speed must be such that nu .* where 1e7|10000000.0 makes it 1e\\+07"),
        ({"speed": 1e4, "control_interval": 1.0}, "control_interval must be such that the number of substeps in it"),
        ({"warm_up": 1e9}, "warm_up must be such that warm_up"),
        ({"warm_up": 1e6, "speed": 100.0}, "warm_up must be such that the number of substeps in it"),
        ({"warm_up_damping": 300}, r"warm_up_damping must lie within \[0.001, 100\], got 300"),
        ({"bandwidth": 8000}, r"bandwidth must lie within \[0.0001, 100\], got 8000"),
        ({"reward": {"travel": 1e39}}, r"weight of travel must lie within .*, got 1e\+39"),
        ({"substeps": 1, "control_interval": 3.0}, "substeps must be such that the largest angle in a substep"),
        ({"substeps": 1, "damping_range": (0.1, 90.0)}, "substeps must be such that the largest angle in a substep"),
        ({"road": ELLIPSE | {"bandwidth": 0.01, "noise_intensity": 0.1}}, "bandwidth on an ellipse must lie within"),
        ({"road": ELLIPSE | {"noise_intensity": 0.01}}, "noise_intensity must be such that the shape alpha lies within"),
        (
            {"road": ELLIPSE | {"slope_bound": 30.0}},
            "slope_bound must be such that u0/z0|noise_intensity must be such that the",
        ),
        (
            {"road": {"kind": "multiplicative", "noise_intensity": 2.0}, "speed": 1e-6},
            "speed must be such that bandwidth times",
        ),
        ({"road": "harmonic", "speed_noise": {"kind": "white", "intensity": 50.0}}, "intensity must be such that sigma/sqrt"),
        ({"road": "harmonic", "speed_noise": {"kind": "low_pass", "corner_frequency": 1e14}}, "corner_frequency must be such"),
        ({"natural_frequency": True}, "natural_frequency must be a number, got True"),
        ({"speed": 10**5000}, "speed must be finite"),
    ],
)
def test_what_would_be_wrong_or_endless_is_refused(parameters, message):
    begin = time.perf_counter()
    with pytest.raises(ParameterError, match=message):
        make_task(**parameters)
    assert time.perf_counter() - begin < 1


def test_batches_have_a_bound():
    for parameters, message in (
        ({"num_envs": 10**9}, "num_envs must be at most"),
        ({"threads": 10**6}, "threads must be at most 1024"),
        ({"max_episode_steps": 2**40}, "max_episode_steps must be at most"),
        ({"render_mode": "nonsense"}, "unknown render_mode 'nonsense'; known: rgb_array"),
        ({"render_mode": "human"}, "unknown render_mode 'human'; known: rgb_array"),
    ):
        with pytest.raises(ParameterError, match=message):
            QuarterCarVectorEnv(**parameters)


def test_theory_has_bounds_too():
    with pytest.raises(ParameterError, match=r"damping .* speed .* must make at most 10000000 entries"):
        analysis.mean_squares("gaussian", damping=np.ones((4000, 1)), speed=np.ones(4000))
    with pytest.raises(ParameterError, match="relative_error must lie within"):
        analysis.mean_squares("gaussian", "low_pass", damping=0.3, speed=1.0, relative_error=1e-9)
    with pytest.raises(ParameterError, match="damping must be a number or an array of numbers"):
        analysis.mean_squares("gaussian", damping=np.ma.array([0.3, 0.5], mask=[False, True]), speed=1.0)
    with pytest.raises(ParameterError, match="time_step must be such that it over the longest that is stable"):
        analysis.simulate("harmonic", damping=0.01, speed=1.0, time_step=0.05)


def test_bandwidth_of_an_ellipse_stays_its_own():
    for ask in (
        lambda: make_task(road=ELLIPSE, bandwidth=0.5),
        lambda: make_task(road=ELLIPSE, bandwidth=(0.3, 0.5)),
        lambda: analysis.mean_squares(ELLIPSE, damping=0.3, speed=1.0, bandwidth=[0.3, 0.5]),
        lambda: analysis.optimal_damping(ELLIPSE, speed=1.0, bandwidth=0.5),
    ):
        with pytest.raises(ParameterError, match=r"bandwidth cannot be replaced on an ellipse.* 0\.3, got 0\.5"):
            ask()
    assert make_task(road=ELLIPSE, bandwidth=0.3) == make_task(road=ELLIPSE)


# ---------------------------------------------------------------------- right within the ranges


def default_substep(**parameters):
    task = make_task(**parameters)
    return task.control_interval / task.substeps


@pytest.mark.parametrize("kind", SPEED_NOISES)
def test_default_substeps_follow_strong_speed_noise(kind):
    """The bar that the documentation states, from a start where the old substep of 0.1 was wrong by factors."""
    bar = 1e-3 if kind == "low_pass" else 1e-4
    terms = finite_terms("harmonic", kind)
    for intensity, corner in ((3.0, 1.0), (10.0, 10.0), (10.0, 100.0)):
        noise = SPEED_NOISES[kind](intensity=intensity, **({} if kind == "white" else {"corner_frequency": corner}))
        interval = default_substep(road="harmonic", speed_noise=noise)
        found = scheme_mean_squares("harmonic", noise, damping=0.05, speed=1.0, interval=interval, modes=30, outer=40, inner=5)
        exact = exact_mean_squares("harmonic", noise, damping=0.05, speed=1.0)
        assert np.all(np.abs(found[terms] / exact[terms] - 1) < bar)


def test_default_substeps_of_cars_up_to_critical_damping_stay():
    for high, speed, substeps in ((1.0, 1.0, 2), (0.5, 1.0, 2), (1.0, 3.0, 6), (2.0, 0.3, 2)):
        assert make_task(speed=speed, damping_range=(0.05, high)).substeps == substeps


@pytest.mark.parametrize(("damping", "bandwidth"), [(2.0, 0.1), (5.0, 0.01), (20.0, 0.1), (1.0, 10.0), (0.3, 100.0)])
def test_default_substeps_follow_firm_dampers_and_broad_roads(damping, bandwidth):
    road = GaussianRoad(bandwidth=bandwidth, noise_intensity=1.0)
    for speed in (0.3, 1.0, 3.0):
        interval = default_substep(road=road, speed=speed, damping_range=(0.05, damping))
        found = scheme_mean_squares(road, None, damping=damping, speed=speed, interval=interval)
        theory = analysis.mean_squares(road, damping=damping, speed=speed)
        exact = np.array([getattr(theory, name) for name in MEAN_SQUARES]) / road.variance
        assert np.all(np.abs(found / exact - 1) < 1.2e-4)


@pytest.mark.parametrize(
    "parameters",
    [
        {"road": "harmonic", "speed": 0.05},
        {"road": "gaussian", "speed": 0.02},
        {"speed": 100.0},
        {"control_interval": 0.002},
        {"damping_range": (0.05, 50.0)},
    ],
)
def test_single_precision_is_left_where_it_is_not_enough(parameters):
    assert make_task(**parameters).precision == "float64"
    assert make_task(**parameters, precision="float32").precision == "float32"  # who asks for it gets it
    assert make_task(speed=(0.7, 3.0), bandwidth=(0.1, 0.5)).precision == "float32"


def test_rounding_of_a_slow_harmonic_road():
    """What made the default leave single precision: the travel, of the order of the speed squared, was lost in rounding."""
    plant = started_plant(64, road="harmonic", speed=0.05)
    actions = np.full(64, 0.05, np.float32)
    for _ in range(2400):  # the start at rest is forgotten to e^-48
        plant.step(actions)
    periods = round(4 * 2 * math.pi / 0.05 / 0.2)
    squares = sum(plant.step(actions).mean_squares.astype(float) for _ in range(periods)).mean(axis=1) / periods
    exact = exact_mean_squares("harmonic", None, damping=float(actions[0]), speed=0.05)
    assert np.all(np.abs(squares / exact - 1) < 2e-4)


# ---------------------------------------------------------------------- arrays of every kind


def read_only(array):
    array.flags.writeable = False
    return array


def out_of_band(array):
    buffers = []
    data = pickle.dumps(array, protocol=5, buffer_callback=buffers.append)
    return pickle.loads(data, buffers=[bytes(buffer.raw()) for buffer in buffers])


ARRAYS = {
    "read-only": read_only,
    "pickled out of band": out_of_band,
    "byte-swapped": lambda array: array.astype(array.dtype.newbyteorder()),
    "double": lambda array: array.astype(np.float64),
    "Fortran": lambda array: np.asfortranarray(np.repeat(array, 2, axis=-1))[..., :1],
    "strided": lambda array: np.repeat(array, 2, axis=0)[::2],
    "memory map": lambda array: array,
    "subclass": lambda array: array.view(type("Own", (np.ndarray,), {})),
}


@pytest.mark.parametrize("kind", ARRAYS)
def test_actions_masks_and_options_of_every_kind_work(kind, tmp_path):
    def made(values, dtype):
        array = np.array(values, dtype)
        if kind == "memory map":
            array.tofile(tmp_path / "array")
            return np.memmap(tmp_path / "array", dtype, "r", shape=array.shape)
        return ARRAYS[kind](array) if dtype is not bool or kind in ("read-only", "subclass", "strided") else array

    env, envs = QuarterCarEnv(), QuarterCarVectorEnv(3, speed=(0.5, 2.0), autoreset_mode="DISABLED")
    env.reset(seed=1)
    env.step(np.array([0.25], np.float32))
    assert env.step(made([0.25], np.float32))[4]["damping"] == np.float32(0.25)
    envs.reset(seed=1, options={"speed": made([0.5, 1.0, 2.0], np.float32)})
    damping = envs.step(made([[0.25], [0.5], [0.75]], np.float32))[4]["damping"]
    np.testing.assert_array_equal(damping, np.array([0.25, 0.5, 0.75], np.float32))
    observations, _ = envs.reset(options={"reset_mask": made([True, False, True], bool)})
    assert np.all(observations[[0, 2], 0] == 0)
    assert observations[1, 0] != 0


def test_seeds_are_integers_of_any_type_in_their_range():
    env, envs = QuarterCarEnv(), QuarterCarVectorEnv(2)
    expected = env.reset(seed=7)[0]
    for seed in (np.int64(7), np.uint8(7), np.uint64(7), np.array(7)):
        np.testing.assert_array_equal(env.reset(seed=seed)[0], expected)
        np.testing.assert_array_equal(envs.reset(seed=seed)[0][0], expected)
    np.testing.assert_array_equal(envs.reset(seed=np.array([7, 2**64 - 1], np.uint64))[0][0], expected)
    for seed in (-1, 2**64, 7.0, "7", True, np.float64(7)):
        with pytest.raises(ParameterError, match="seed must be"):
            env.reset(seed=seed)
        with pytest.raises(ParameterError, match="seed 1 must be"):
            envs.reset(seed=[0, seed])
    with pytest.raises(ParameterError, match="seed of the last environment must be at most"):
        envs.reset(seed=2**64 - 1)


# ---------------------------------------------------------------------- roads of one's own


@LaneFunction
def stay(lanes, words, table):
    """Leave the lanes alone."""


@LaneFunction
def start_beyond(lane, words, table):
    """Read beyond the table."""
    lane[roadgym.compiled.LEVEL] = table[7]


def own_road(**body):
    return type("OwnRoad", (roadgym.Road,), {"start": stay, "advance": stay, "variance": 1.0, **body})()


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ({"table": lambda self: np.array([1.0, np.nan])}, "table of the .* road must be finite, got nan"),
        ({"table": lambda self: np.zeros((2, 2))}, "table of the .* road must be one row of numbers"),
        ({"table": lambda self: "constants"}, "table of the .* road must be a number or an array of numbers"),
        ({"words_per_substep": -3}, "words_per_substep of the .* road must be at least 0, got -3"),
        ({"words_per_substep": 10**9}, "words_per_substep of the .* road must be at most 64"),
        ({"advance": lambda lanes, words, table: None}, "advance of the .* road must be a LaneFunction"),
        ({"start": None}, "start of the .* road must be a LaneFunction, got None"),
        ({"variance": math.nan}, "variance of the .* road must be finite"),
        ({"advance": LaneFunction(lambda lanes, words, table: lanes.nonsense())}, "a lane function .* does not compile"),
    ],
)
def test_roads_that_say_nonsense_of_themselves_are_refused(body, message):
    with pytest.raises(ParameterError, match=message):
        QuarterCarEnv(road=own_road(**body))


def test_what_is_read_beyond_a_table_is_not_a_number():
    env = QuarterCarEnv(road=own_road(start=start_beyond, table=lambda self: np.ones(3)))
    with pytest.raises(roadgym.PlantError, match="environment 0 of 1"):
        env.reset(seed=0)
