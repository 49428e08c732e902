"""Random values for `test_fuzz`, and what must hold of what comes out."""

import collections
import datetime
import decimal
import fractions
import math
import warnings

import numpy as np

import roadgym
from roadgym import MEAN_SQUARES, ROADS, SPEED_NOISES, QuarterCar
from roadgym.parameters import RANGES
from roadgym.roads import make_road
from roadgym.task import make_task, signals


class Rude:
    """An object that raises whatever it is asked."""

    def __repr__(self):
        raise RuntimeError("no representation")

    def __float__(self):
        raise KeyError("no number")

    def __index__(self):
        raise OSError("no integer")

    def __len__(self):
        raise ZeroDivisionError("no length")

    def __array__(self, dtype=None, copy=None):
        raise LookupError("no array")


def junk(rng):
    """A value that hardly any parameter is meant to have."""
    values = (
        *(None, True, False, "", "1.0", "multiplicative", "nan", b"1", bytearray(b"2"), 1j, complex("nan")),
        *(math.nan, math.inf, -math.inf, 0, -0.0, -1, -1.5, 10**400, -(10**400), 10**5000, 2**63, 2**64, 1e308, 5e-324),
        *(
            (),
            [],
            {},
            set(),
            frozenset({1}),
            (1,),
            (1, 2, 3),
            [[1, 2], [3]],
            [None],
            [1, "a"],
            {"kind": []},
            {1: 2},
            {"a": math.nan},
        ),
        *(object(), Rude(), type, len, lambda: 1, (x for x in (1, 2)), range(1, 3), slice(1), ..., NotImplemented),
        *(fractions.Fraction(1, 3), decimal.Decimal("0.3"), decimal.Decimal("NaN"), decimal.Decimal("sNaN")),
        *(datetime.date(2020, 1, 1), np.datetime64("2020-01-01"), np.timedelta64(3, "s"), np.str_("x"), np.bytes_(b"x")),
        *(np.bool_(True), np.int8(3), np.uint64(2**64 - 1), np.float16(0.3), np.float32(0.3), np.longdouble("1e4000")),
        *(
            np.complex64(1),
            np.array(0.3),
            np.array([0.3]),
            np.array([[0.3]]),
            np.array([0.1, 0.9]),
            np.zeros(0),
            np.zeros((2, 0)),
        ),
        *(np.array([0.3, np.nan]), np.array([np.inf]), np.array([None, 1], object), np.array(["a"]), np.array([True])),
        *(
            np.ma.masked,
            np.ma.array([0.2, 0.3], mask=[True, False]),
            np.zeros(2, [("a", float)]),
            np.zeros(2, "M8[s]"),
            np.zeros((2, 0)),
        ),
        *(np.full((2, 2, 2), 0.4), np.array(10**30), memoryview(b"abc")),
        *(np.random.default_rng(0), np.float32, warnings, iter([1]), collections.OrderedDict(a=1), Exception("x")),
    )
    return values[rng.integers(len(values))]


def a_number(rng):
    """A number of any size, most of them sensible."""
    kind = rng.integers(8)
    if kind == 0:
        return junk(rng)
    if kind == 1:
        low_high = list(RANGES.values())[rng.integers(len(RANGES))]
        return float((low_high.low, low_high.high)[rng.integers(2)]) * (1, 1 + 1e-9, 1 - 1e-9)[rng.integers(3)]
    if kind == 2:
        return float(10.0 ** rng.uniform(-320, 308)) * (-1) ** int(rng.integers(2))
    if kind == 3:
        return float(10.0 ** rng.uniform(-9, 9))
    if kind == 4:
        return int(rng.integers(-3, 40))
    return float(10.0 ** rng.uniform(-2, 1.2))


def a_range(rng):
    return [lambda: a_number(rng), lambda: (a_number(rng), a_number(rng)), lambda: sorted(rng.uniform(0.05, 3, 2).tolist())][
        rng.integers(3)
    ]()


def an_array(rng):
    kind = rng.integers(5)
    if kind == 0:
        return a_number(rng)
    if kind == 1:
        return junk(rng)
    shape = [(), (1,), (3,), (2, 3), (0,), (3, 1)][rng.integers(6)]
    values = 10.0 ** rng.uniform(*((-2, 1), (-8, 8), (-300, 300))[rng.integers(3)], shape)
    return odd_storage(rng, values)


def odd_storage(rng, values):
    """The same numbers as arrays of other types and layouts."""
    values = np.asarray(values)
    kind = rng.integers(9)
    with np.errstate(all="ignore"):
        if kind == 0:
            values = values.astype(np.float32)
        elif kind == 1:
            values = values.astype(">f8")
        elif kind == 2:
            values = np.asfortranarray(values)
        elif kind == 3:
            values = values.copy()
            values.flags.writeable = False
        elif kind == 4:
            values = np.repeat(values[..., None], 2, -1)[..., 0]
        elif kind == 5:
            values = np.frombuffer(bytes(values.astype(np.float32).tobytes()), np.float32).reshape(values.shape)
        elif kind == 6:
            values = values.astype(np.float16)
        elif kind == 7:
            buffer = np.zeros(values.nbytes + 1, np.uint8)[1:]
            unaligned = buffer.view(np.float64) if values.dtype == np.float64 else buffer.view(values.dtype)
            unaligned = unaligned.reshape(values.shape)
            unaligned[...] = values
            values = unaligned
    return values


def a_seed(rng, n=1):
    kind = rng.integers(6)
    if kind == 0:
        return junk(rng)
    if kind == 1:
        return [int(seed) if rng.integers(3) else None for seed in rng.integers(0, 2**63, rng.integers(1, n + 2))]
    types = (int, np.int64, np.uint64, np.int32, np.uint8)
    return types[rng.integers(len(types))](rng.integers(0, 100))


def a_component(rng, table, fields):
    kind = rng.integers(6)
    if kind == 0:
        return junk(rng)
    names = list(table)
    value = {"kind": names[rng.integers(len(names))]}
    for name in fields:
        if rng.integers(6) == 0:
            value[name] = a_number(rng)
    return value


ROAD_FIELDS = ("wavenumber", "amplitude", "noise_intensity", "bandwidth", "level_bound", "slope_bound")
NOISE_FIELDS = ("intensity", "corner_frequency")


def a_road(rng):
    if rng.integers(2):
        return list(ROADS)[rng.integers(len(ROADS))]
    return a_component(rng, ROADS, ROAD_FIELDS)


def a_noise(rng):
    kind = rng.integers(4)
    return None if kind < 2 else a_component(rng, SPEED_NOISES, NOISE_FIELDS) if kind == 2 else "low_pass"


TASK = {
    "road": a_road,
    "speed_noise": a_noise,
    "speed": a_range,
    "bandwidth": lambda rng: a_range(rng) if rng.integers(2) else None,
    "damping_range": lambda rng: (0.05, 1.0) if rng.integers(2) else a_range(rng),
    "reward": lambda rng: {str(name): a_number(rng) for name in rng.choice(MEAN_SQUARES, 2)} if rng.integers(2) else junk(rng),
    "observation": lambda rng: list(map(str, rng.choice(signals(QuarterCar()), 3))) if rng.integers(2) else junk(rng),
    "observe_operating_point": lambda rng: bool(rng.integers(2)) if rng.integers(2) else junk(rng),
    "natural_frequency": a_number,
    "control_interval": a_number,
    "substeps": a_number,
    "warm_up": a_number,
    "warm_up_damping": a_number,
    "precision": lambda rng: ("float32", "float64", junk(rng))[rng.integers(3)],
}


def chosen(rng, generators, base=()):
    """A few random parameters out of ``generators``."""
    parameters = dict(base)
    names = list(generators)
    for name in rng.choice(names, rng.integers(1, 4), replace=False):
        parameters[str(name)] = generators[str(name)](rng)
    return parameters


def is_slow(task):
    """What is allowed, and takes more than a moment."""
    road = task.road
    ellipse = isinstance(road, roadgym.MultiplicativeRoad) and not road.is_circle
    return ellipse or task.warm_up / task.control_interval * task.substeps > 1e4 or task.substeps > 2000


def quick_task(parameters):
    """The task, or None where to drive it takes long."""
    road = make_road(parameters.get("road", "multiplicative"))
    if isinstance(road, roadgym.MultiplicativeRoad) and not road.is_circle:
        return None  # its variance is found by simulation
    task = make_task(**parameters)
    return None if is_slow(task) else task


def check_observations(space, observations):
    assert observations.dtype == np.float32
    assert np.isfinite(observations).all(), "an observation is not finite"
    assert np.all((observations >= space.low) & (observations <= space.high)), "an observation is outside the space"


def check_info(task, info):
    divergent = roadgym.reward.divergent_terms(task.car, task.road, task.speed_noise)
    for name in MEAN_SQUARES:
        values = np.asarray(info[name])
        # zero in the step that is a reset
        fine = np.isposinf(values) | (values == 0) if name in divergent else np.isfinite(values) & (values >= 0)
        assert np.all(fine), f"{name} is {values}"


def an_action(rng, shape):
    if rng.integers(3):
        return odd_storage(rng, rng.uniform(-0.5, 1.5, shape))
    return an_array(rng)


def finite(result, *, infinite=False):
    for field in result if isinstance(result, tuple) else [result]:
        values = np.asarray(field)
        assert not np.isnan(values).any(), "a result is not a number"
        assert infinite or np.isfinite(values).all(), "a result is infinite"
