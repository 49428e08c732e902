"""Random calls: each works within bounds, or raises an error of ours that names the parameter, its value and what is allowed.

Every call is a function of ROADGYM_FUZZ_SEED and of its number, so a violation can be called again by itself. The suite makes
a few thousand; by hand, ``ROADGYM_FUZZ_CALLS=1000000 python -m pytest tests/test_fuzz.py``.
"""

import collections
import datetime
import decimal
import fractions
import gc
import math
import os
import pathlib
import pickle
import tempfile
import time
import warnings

import numpy as np
from gymnasium.error import ResetNeeded

import analysis
import roadgym
from agents import AgentError
from agents.controllers import CONTROLLERS, ConstantDamping, make_controller
from agents.training import load, load_hyperparameters
from agents.vec_env import QuarterCarVecEnv, Sight, damping_from_action
from analysis import explorer
from analysis.certification import autocovariance
from analysis.paper import figures as paper_figures
from roadgym import MEAN_SQUARES, ROADS, SPEED_NOISES, HarmonicRoad, ParameterError, QuarterCar
from roadgym.compiled import LaneFunction
from roadgym.env import QuarterCarEnv
from roadgym.parameters import RANGES
from roadgym.plant import Plant
from roadgym.roads import make_road
from roadgym.speed import make_speed_noise
from roadgym.task import make_task, signals
from roadgym.vector import QuarterCarVectorEnv

CALLS = int(os.environ.get("ROADGYM_FUZZ_CALLS", "2000"))
SEED = int(os.environ.get("ROADGYM_FUZZ_SEED", "1"))
SLOWEST = 20.0  # s, of one call on a busy machine, compilation included
OURS = (ParameterError, AgentError, ResetNeeded)


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


# --------------------------------------------------------------------- the calls


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
# by what else a message may name a parameter
WORDS = {
    "road": (*ROAD_FIELDS, "road"),
    "speed_noise": (*NOISE_FIELDS, "speed noise", "speed_noise"),
    "reward": ("weight", "reward term", "mean square"),
    "weights": ("weight", "reward"),
    "environment": ("speed", "damping_range", "warm_up"),
    "bandwidth": ("an ellipse",),
    "observe_operating_point": ("observation",),
    "observation": ("features",),
    "options": ("option",),
    "numbers": ("figure",),
    "folder": ("agent",),
    "file": ("hyperparameter",),
    "view": (*explorer.RANGES, "weight", "reward", "road", "speed_noise"),
    "relative_error": ("relative_error",),
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


def call_env(rng):
    """The single environment."""
    parameters = chosen(rng, TASK)
    yield parameters
    if quick_task(parameters) is None:
        return
    env = QuarterCarEnv(**parameters)
    arguments = {"seed": a_seed(rng)} if rng.integers(2) else {"options": some_options(rng, 1)}
    if not rng.integers(8):
        yield {"reset": "before step"}
        env.step(np.array([0.3], np.float32))
    yield {**arguments, "parameters": parameters}
    observation, info = env.reset(**arguments)
    check_observations(env.observation_space, observation)
    for _ in range(3):
        action = an_action(rng, (1,))
        yield {"action": action, "parameters": parameters}
        observation, reward, terminated, truncated, info = env.step(action)
        check_observations(env.observation_space, observation)
        assert math.isfinite(reward), "the reward is not finite"
        assert reward <= 0
        assert not terminated
        assert not truncated
        check_info(env.task, info)
    if not rng.integers(4):
        again = pickle.loads(pickle.dumps(env))
        action = np.array([0.4], np.float32)
        assert again.step(action)[1] == env.step(action)[1]


def an_action(rng, shape):
    if rng.integers(3):
        return odd_storage(rng, rng.uniform(-0.5, 1.5, shape))
    return an_array(rng)


def some_options(rng, n):
    if not rng.integers(5):
        return junk(rng)
    options = {}
    for name in ("speed", "bandwidth", "reset_mask", "wind"):
        if not rng.integers(4):
            options[name] = np.full(n, 1.0) if rng.integers(2) else an_array(rng)
    if not rng.integers(4):
        mask = rng.integers(0, 2, n).astype(bool)
        mask.flags.writeable = bool(rng.integers(2))
        options["reset_mask"] = mask
    return options


BATCH = {
    "num_envs": lambda rng: int(rng.integers(1, 70)) if rng.integers(2) else a_number(rng),
    "max_episode_steps": lambda rng: a_number(rng) if rng.integers(2) else int(rng.integers(1, 3)),
    "autoreset_mode": lambda rng: ("NEXT_STEP", "SameStep", "disabled", junk(rng))[rng.integers(4)],
    "threads": a_number,
    "render_mode": lambda rng: junk(rng) if not rng.integers(3) else None,
}


def call_vector(rng):
    """The native batch."""
    parameters = {**chosen(rng, BATCH), **(chosen(rng, TASK) if rng.integers(2) else {})}
    yield parameters
    if quick_task({name: value for name, value in parameters.items() if name in TASK}) is None:
        return
    number = parameters.get("num_envs")
    if isinstance(number, (int, np.integer)) and 200 < number <= RANGES["num_envs"].high:
        return
    envs = QuarterCarVectorEnv(**parameters)
    n = envs.num_envs
    arguments = {"seed": a_seed(rng, n), "options": some_options(rng, n) if not rng.integers(3) else None}
    yield {**arguments, "parameters": parameters}
    observations, info = envs.reset(**arguments)
    check_observations(envs.single_observation_space, observations)
    for _ in range(3):
        actions = an_action(rng, (n, 1))
        yield {"actions": actions, "parameters": parameters}
        observations, rewards, _, _, info = envs.step(actions)
        check_observations(envs.single_observation_space, observations)
        assert np.isfinite(rewards).all(), "a reward is not finite"
        check_info(envs.task, info)
    if not rng.integers(4):
        again = pickle.loads(pickle.dumps(envs))
        actions = np.full((n, 1), 0.4, np.float32)
        np.testing.assert_array_equal(again.step(actions)[1], envs.step(actions)[1])


def finite(result, *, infinite=False):
    for field in result if isinstance(result, tuple) else [result]:
        values = np.asarray(field)
        assert not np.isnan(values).any(), "a result is not a number"
        assert infinite or np.isfinite(values).all(), "a result is infinite"


CLOSED = {"damping": an_array, "speed": an_array, "natural_frequency": a_number}


def call_mean_squares(rng):
    parameters = chosen(rng, {**CLOSED, "bandwidth": an_array, "relative_error": a_number}, {"damping": 0.3, "speed": 1.0})
    road, noise = a_road(rng), a_noise(rng)
    yield {"road": road, "speed_noise": noise, **parameters}
    if is_driven(road, noise):
        return
    squares = analysis.mean_squares(road, noise, **parameters)
    for name in MEAN_SQUARES:
        finite(getattr(squares, name), infinite=True)
        assert np.all(getattr(squares, name) >= 0)


def is_driven(road, noise):
    """Simulation, which takes seconds; and a road whose variance does."""
    the_road = make_road(road)
    if isinstance(the_road, roadgym.MultiplicativeRoad) and not the_road.is_circle:
        return True
    return make_speed_noise(noise, the_road) is not None and not isinstance(the_road, HarmonicRoad)


def call_optimal_damping(rng):
    generators = {"speed": an_array, "natural_frequency": a_number, "bounds": a_range, "bandwidth": an_array}
    parameters = chosen(rng, {**generators, "weights": TASK["reward"]}, {"speed": 1.0})
    road, noise = a_road(rng), a_noise(rng)
    yield {"road": road, "speed_noise": noise, **parameters}
    if is_driven(road, noise):
        return
    best = analysis.optimal_damping(road, noise, **parameters)
    finite(best.damping)
    finite(best.cost)


def call_covariance(rng):
    parameters = chosen(rng, CLOSED, {"damping": 0.3, "speed": 1.0})
    road = a_road(rng)
    yield {"road": road, **parameters}
    if not is_driven(road, None):
        finite(analysis.covariance(road, **parameters))


def call_density(rng):
    road = a_road(rng)
    level, slope = an_array(rng), an_array(rng)
    yield {"road": road, "level": level, "slope": slope}
    finite(analysis.density(road, level, slope), infinite=True)
    finite(analysis.marginal_density(road, level), infinite=True)


def call_spectrum(rng):
    road, frequency, speed = a_road(rng), an_array(rng), an_array(rng)
    yield {"road": road, "frequency": frequency, "speed": speed}
    if not is_driven(road, None):
        finite(analysis.spectral_density(road, frequency, speed=speed))


def call_rotating_frame(rng):
    generators = {**CLOSED, "wavenumber": a_number, "amplitude": a_number}
    generators["form"] = lambda rng: ("exact", "closure", "printed", junk(rng))[rng.integers(4)]
    parameters = chosen(rng, generators, {"damping": 0.3, "speed": 1.0})
    noise = a_noise(rng)
    yield {"speed_noise": noise, **parameters}
    finite(analysis.mean_amplitude(noise, **parameters))
    if parameters.get("form") not in (None, "exact"):
        finite(analysis.moment_system(noise, **parameters).matrix)


def call_stability(rng):
    damping, number, speed = an_array(rng), an_array(rng), an_array(rng)
    choice = {
        "sense": ("mean", "almost_sure", junk(rng))[rng.integers(3)],
        "form": ("ito", "printed", junk(rng))[rng.integers(3)],
    }
    yield {"damping": damping, "intensity": number, "speed": speed, **choice}
    finite(analysis.rotation_numbers(damping, speed=speed))
    finite(analysis.lyapunov_exponents(damping, intensity=number, **choice))
    finite(analysis.critical_noise(damping, **choice), infinite=True)


def call_simulation(rng):
    generators = {
        **{"damping": a_number, "natural_frequency": a_number, "samples": a_number, "time_step": a_number, "lanes": a_number},
        **{"seed": a_seed, "threads": a_number, "bias": lambda rng: bool(rng.integers(2))},
        "histogram": lambda rng: (-1.0, 1.0, 10) if rng.integers(2) else junk(rng),
        "form": lambda rng: ("original", "ito", "printed", junk(rng))[rng.integers(4)],
    }
    road, noise, speed = a_road(rng), a_noise(rng), an_array(rng)
    parameters = chosen(rng, generators, {"damping": 0.3, "samples": 2048, "threads": 1})
    yield {"road": road, "speed_noise": noise, "speed": speed, **parameters}
    work = [parameters.get(name, 1) for name in ("samples", "lanes", "threads")]
    if any(isinstance(number, (int, np.integer)) and number > 5000 for number in work):
        return
    if is_long(road, noise, speed, parameters):
        return
    for result in analysis.simulate(road, noise, speed=speed, **parameters):
        finite(result.amplitude.value)
        finite(result.mean_squares["displacement"].value)


def is_long(road, noise, speed, parameters):
    """Does a simulation that is allowed take long, because it remembers long how it started?"""
    from analysis.driven import SETTLED
    from analysis.paper.euler_maruyama import make_system

    try:
        the_road = make_road(road)
        the_noise, w1 = make_speed_noise(noise, the_road), float(parameters.get("natural_frequency", 1.0))
        damping, form = float(parameters["damping"]), parameters.get("form", "original")
        step = float(parameters.get("time_step", 1e-3))
        speeds = np.asarray(speed, float).reshape(-1)
        systems = [make_system(the_road, the_noise, damping, v, w1, form) for v in speeds]
        return sum(SETTLED * system.memory / step for system in systems) > 1e5
    except Exception:  # what is wrong is for the call to say
        return False


def call_feedback_arguments(rng):
    """Parameters of the optimal feedback that are refused; what is not takes seconds."""
    generators = {
        **{
            "speed": a_number,
            "bandwidth": a_number,
            "natural_frequency": a_number,
            "weights": TASK["reward"],
            "bounds": a_range,
        },
        **{"control_interval": a_number, "tolerance": a_number, "precision": a_number, "refinements": a_number, "seed": a_seed},
        **{"threads": a_number},
    }
    parameters = chosen(rng, generators, {"speed": 1.0})
    road = a_road(rng)
    parameters["cache"] = 3  # refused at the end of the checks
    yield {"road": road, **parameters}
    if not is_driven(road, None):
        analysis.optimal_feedback(road, **parameters)


def call_explorer(rng):
    view = {str(name): a_number(rng) for name in rng.choice([*explorer.RANGES, "road", "speed_noise", "weights", "x"], 2)}
    view = view if rng.integers(4) else junk(rng)
    yield {"view": view}
    explorer.make_view(view)


def call_figures(rng):
    numbers = junk(rng) if rng.integers(2) else [junk(rng)]
    folder = 3 if rng.integers(2) else None  # no folder: nothing is ever drawn
    yield {"numbers": numbers, "folder": folder}
    paper_figures.write(folder, numbers)


def call_autocovariance(rng):
    lag = an_array(rng)
    yield {"lag": lag}
    finite(autocovariance(HarmonicRoad(), None, lag, speed=1.0))


CONTROL_TASK = make_task(speed=(0.5, 2.0), bandwidth=(0.05, 0.5))


def call_controller(rng):
    names = [name for name in CONTROLLERS if name not in ("optimal_feedback", "one_step_lookahead", "clipped_lqr")]
    name = names[rng.integers(len(names))] if rng.integers(5) else junk(rng)
    yield {"controller": name}
    controller = make_controller(name, CONTROL_TASK)
    n = (3, 6) if rng.integers(2) else (6,)
    observation = np.concatenate([rng.normal(size=(*n[:-1], 4)), np.full((*n[:-1], 2), 0.4)], axis=-1)
    observation = odd_storage(rng, observation) if rng.integers(2) else an_array(rng)
    yield {"observation": observation}
    damping, _ = controller.predict(observation)
    assert damping.dtype == np.float32
    low, high = np.float32(CONTROL_TASK.damping_range)
    assert np.all((damping >= low) & (damping <= high))
    constant = a_number(rng)
    yield {"damping": constant}
    ConstantDamping(CONTROL_TASK, constant)


def call_vec_env(rng):
    parameters = chosen(
        rng,
        {
            "max_episode_steps": BATCH["max_episode_steps"],
            "environment": lambda rng: (
                chosen(rng, {"speed": a_range, "damping_range": a_range, "warm_up": a_number}) if rng.integers(2) else junk(rng)
            ),
            "features": lambda rng: (["signals"], ["products"], junk(rng))[rng.integers(3)],
            "frame_stack": lambda rng: int(rng.integers(1, 4)) if rng.integers(2) else junk(rng),
            "damping_levels": lambda rng: int(rng.integers(2, 9)) if rng.integers(2) else junk(rng),
        },
    )
    yield {"num_envs": 2, **parameters}
    environment = parameters.get("environment")
    if isinstance(environment, dict) and set(environment) <= set(TASK) and quick_task(environment) is None:
        return
    envs = QuarterCarVecEnv(2, **parameters)
    assert np.isfinite(envs.reset()).all()
    action = an_action(rng, (2, 1))
    yield {"action": action, "parameters": parameters}
    seen, rewards, _, _ = envs.step(action)
    assert np.isfinite(seen).all()
    assert np.isfinite(rewards).all()


def call_actions(rng):
    action, levels = an_array(rng), (None, 5)[rng.integers(2)]
    yield {"action": action}
    finite(damping_from_action(action, (0.05, 1.0), levels))
    stack = junk(rng)
    yield {"frame_stack": stack}
    if not isinstance(stack, int) or stack < 20:
        Sight(CONTROL_TASK, None, stack)


def call_certify_arguments(rng):
    generators = {"speed": a_number, "damping": a_number, "natural_frequency": a_number, "seed": a_seed}
    road, noise = a_road(rng), a_noise(rng)
    parameters = chosen(rng, generators)
    parameters["lanes"] = 7  # refused at the end of the checks
    yield {"road": road, "speed_noise": noise, **parameters}
    analysis.certify(road, noise, **parameters)


@LaneFunction
def do_nothing(lanes, words, table):
    """A lane function that leaves its lanes alone."""


def returning(value):
    return lambda self: value


def call_own_road(rng):
    """A road that says odd things of itself."""
    odd = {
        "words_per_substep": lambda: a_number(rng),
        "variance": lambda: a_number(rng),
        "precision": lambda: junk(rng),
        "start": lambda: junk(rng),
        "advance": lambda: junk(rng),
        "prepare": lambda: junk(rng),
        "table": lambda: returning(an_array(rng)),
    }
    name = list(odd)[rng.integers(len(odd))]
    body = {"start": do_nothing, "advance": do_nothing, "words_per_substep": 0, "variance": 1.0, name: odd[name]()}
    yield {name: body[name], "road": None}
    road = type("OwnRoad", (roadgym.Road,), body)()
    task = make_task(road=road)
    if task.substeps * max(road.words_per_substep, 1) < 10_000:
        plant = Plant(task, 1)
        check_observations(task.observation_space, plant.start(np.zeros(1, np.uint64)).observations)


def call_agents(rng):
    """Folders and files that hold anything but an agent."""
    texts = (
        "",
        "{}",
        "[]",
        "null",
        '{"format": 1}',
        "\x00",
        "a: [",
        "a: 1",
        "- 1",
        "{1: 2}",
        "x" * 9,
    )
    text = texts[rng.integers(len(texts))]
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder, ("agent.json", "other")[rng.integers(2)])
        path.write_bytes(rng.bytes(40) if rng.integers(3) == 0 else text.encode())
        if rng.integers(2):
            yield {"folder": folder}
            load(folder)
        else:
            algorithm = ("ppo", "sac", junk(rng))[rng.integers(3)]
            yield {"algorithm": algorithm, "file": str(path)}
            load_hyperparameters(algorithm, path)


CALLED = (
    *(call_env, call_env, call_env, call_vector, call_vector, call_mean_squares, call_mean_squares, call_optimal_damping),
    *(call_covariance, call_density, call_spectrum, call_rotating_frame, call_stability, call_simulation),
    *(call_feedback_arguments, call_explorer, call_figures, call_autocovariance, call_controller, call_vec_env, call_actions),
    *(call_certify_arguments, call_own_road, call_agents),
)


def names_it(message, given):
    """Does the message name one of the parameters that were given?"""
    words = set(given)
    for name in given:
        words.update(WORDS.get(name, ()))
        if isinstance(given[name], dict):
            words.update(map(str, given[name]))
            for inner in list(given[name]):
                words.update(WORDS.get(str(inner), ()) if isinstance(inner, str) else ())
    return any(word in message for word in words)


def violation(number):
    """What was wrong with this call, or None."""
    rng = np.random.default_rng([SEED, number])
    function = CALLED[rng.integers(len(CALLED))]
    given = {}
    begin = time.perf_counter()
    try:
        for given in function(rng):  # noqa: B007
            pass
    except OURS as error:
        if not isinstance(error, ResetNeeded) and not names_it(str(error), given):
            return f"{function.__name__} {number}: the message names no parameter: {error} <- {safely(given)}"
        if len(str(error)) > 1500:
            return f"{function.__name__} {number}: the message has {len(str(error))} characters"
    except Exception as error:
        return f"{function.__name__} {number}: {type(error).__name__}: {error} <- {safely(given)}"
    taken = time.perf_counter() - begin
    if taken > SLOWEST:
        return f"{function.__name__} {number}: took {taken:.0f} s <- {safely(given)}"
    return None


def safely(given):
    try:
        return repr(given)[:600]
    except Exception:
        return ", ".join(given)


def test_random_calls_work_or_say_what_is_wrong():
    found = []
    for number in range(CALLS):
        wrong = violation(number)
        if wrong:
            found.append(wrong)
        if number % 1000 == 0:
            gc.collect()
    assert not found, f"{len(found)} violations in {CALLS} calls:\n" + "\n".join(found[:20])
