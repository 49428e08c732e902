"""Random calls: each works within bounds, or raises an error of ours that names the parameter, its value and what is allowed.

Every call is a function of ROADGYM_FUZZ_SEED and of its number, so a violation can be called again by itself. The suite makes
a few thousand; by hand, ``ROADGYM_FUZZ_CALLS=1000000 python -m pytest tests/test_fuzz.py``.
"""

import gc
import math
import os
import pathlib
import pickle
import tempfile
import time

import numpy as np
from fuzz_theory import (
    call_autocovariance,
    call_certify_arguments,
    call_covariance,
    call_density,
    call_explorer,
    call_feedback_arguments,
    call_figures,
    call_lower_bound,
    call_mean_squares,
    call_optimal_damping,
    call_rotating_frame,
    call_simulation,
    call_spectrum,
    call_stability,
)
from fuzz_values import (
    NOISE_FIELDS,
    ROAD_FIELDS,
    TASK,
    a_number,
    a_range,
    a_seed,
    an_action,
    an_array,
    check_info,
    check_observations,
    chosen,
    finite,
    junk,
    odd_storage,
    quick_task,
)
from gymnasium.error import ResetNeeded

import roadgym
from agents import AgentError
from agents.controllers import CONTROLLERS, ConstantDamping, make_controller
from agents.training import load, load_hyperparameters
from agents.vec_env import QuarterCarVecEnv, Sight, damping_from_action
from analysis import explorer
from roadgym import ParameterError
from roadgym.compiled import LaneFunction
from roadgym.env import QuarterCarEnv
from roadgym.parameters import RANGES
from roadgym.plant import Plant
from roadgym.task import make_task
from roadgym.vector import QuarterCarVectorEnv

CALLS = int(os.environ.get("ROADGYM_FUZZ_CALLS", "2000"))
SEED = int(os.environ.get("ROADGYM_FUZZ_SEED", "1"))
SLOWEST = 20.0  # s, of one call on a busy machine, compilation included
OURS = (ParameterError, AgentError, ResetNeeded)

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


CONTROL_TASK = make_task(speed=(0.5, 2.0), bandwidth=(0.05, 0.5))


def call_controller(rng):
    slow, on_the_wheel = {"optimal_feedback", "one_step_lookahead", "mixed_lookahead", "clipped_lqr"}, {"groundhook", "hybrid"}
    names = [name for name in CONTROLLERS if name not in slow | on_the_wheel]
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
    *(call_certify_arguments, call_own_road, call_agents, call_lower_bound),
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
