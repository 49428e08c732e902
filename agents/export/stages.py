"""What lies between the signals that a car measures and the damping that a trained agent commands, stage by stage.

Each stage makes values of values (`agents.export.program`), so what is written here once is the same in all targets: scaling of
what is measured, Kalman filter (`agents.export.filtering`), features, the layers of the policy, and the damping's range.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from roadgym.task import OPERATING_POINT, SATURATION, Task

from ..agent import Agent
from ..errors import AgentError
from ..features import Features, Lookahead, Sight
from ..theory import NODES
from .filtering import estimate
from .program import Memory, Program, Value, clip, concat, constant, elementwise, given, least, take, where

Array = npt.NDArray[Any]


def scales_of(task: Task) -> Array:
    """By signal, what to multiply an observation with to get what is measured; of the speed and the bandwidth see `observe`."""
    factors = {"speed": task.speed_unit, "bandwidth": 0.5, "slope": task.road.wavenumber}  # dZ/ds, of what is observed
    return np.array([scale * factors.get(name, 1.0) for name, scale in zip(task.signals, task.signal_scale, strict=True)])


def signal_table(task: Task) -> list[tuple[str, str, float]]:
    """Name, unit and scale of each signal that is observed."""
    units = {name: signal.unit.replace("²", "^2") for name, signal in task.car.motion.signals.items()}
    units |= {"speed": "m/s", "bandwidth": "1", "slope": "m/m"}
    return [(name, units.get(name, "m"), scale) for name, scale in zip(task.signals, scales_of(task).tolist(), strict=True)]


def observe(task: Task, measured: Value) -> Value:
    """Observations of what is measured: over their scale and saturated; nu/(1 + nu) and 2 delta/(1 + 2 delta) of the point."""
    scaled, parts = measured / constant(scales_of(task)), []
    for place, name in enumerate(task.signals):
        if name in OPERATING_POINT:
            x = clip(scaled[place], 0.0, 1e6)
            parts.append(x / (x + 1.0))
        else:
            x = scaled[place]
            # no number stays none, for a filter to know it
            parts.append(where(x > SATURATION, SATURATION, where(x * -1.0 > SATURATION, -SATURATION, x)))
    return concat(parts)


def see(sight: Sight, observation: Value, memory: Memory) -> Value:
    """What the policy sees: `agents.features.Sight`."""
    seen, older = observation, sight.frame_stack - 1
    if older and sight.moving:
        moving = observation[sight.moving]
        before = memory.recall("frames", concat([moving] * older))
        seen = concat([observation, before])
        memory.kept["frames"] = concat([moving, before[range(before.size - moving.size)]])
    return seen if sight.features is None else _features(sight.features, seen)


def _features(features: Features, seen: Value) -> Value:
    parts, even, state = [], [], seen[features.state]
    if features.point:
        parts.append((seen[features.point] - 0.5) * 4.0)
    if features.signals and features.state:
        parts.append(state)
    if features.products and features.state:
        even.append(state[features.first] * state[features.second])
    if features.lookahead is not None:
        even.append(_lookahead(features.lookahead, seen))
    if even:
        parts.append(concat(even) / elementwise("sqrt", (state * state).reduced("sum") + 1.0))
    return concat(parts)


def _lookahead(lookahead: Lookahead, seen: Value) -> Value:
    points = [seen[place].of_kind("double") for place in lookahead.point]
    points += [constant(0.0, "double")] * (2 - len(points))  # no bandwidth is one of 0
    places = [
        (x - low) / step for x, low, step in zip(points, lookahead.grid.low.tolist(), lookahead.grid.step.tolist(), strict=True)
    ]
    forms = interpolate(places, lookahead.table.reshape(NODES, NODES, 2, -1).swapaxes(2, 3))
    state = seen[lookahead.columns]
    return concat([state[lookahead.first] * state[lookahead.second], constant(1.0)]) @ forms


def interpolate(places: list[Value], table: Array) -> Value:
    """The multilinear interpolation of a table at a place in it, each in steps of an axis, in double precision.

    That is needed as it is made of a difference of near numbers. Beyond the ends the table goes on as there.
    """
    count, row = len(places), constant(0.0, "double")
    lengths, shares = table.shape[:count], []
    for place, length in zip(places, lengths, strict=True):
        within = clip(place, 0.0, length - 1.0)
        node = least(elementwise("floor", within), max(length - 2.0, 0.0))
        shares.append((within - node).of_kind("float"))
        row = row * float(length) + node
    rows = table.reshape(-1, *table.shape[count:])
    total = constant(0.0)
    for corner in itertools.product(*(range(min(length, 2)) for length in lengths)):
        weight = constant(1.0)
        for after, share in zip(corner, shares, strict=True):
            weight = weight * (share if after else 1.0 - share)
        found = take(rows, row + float(np.ravel_multi_index(corner, lengths)))
        total = total + weight * found
    return total


def _sigmoid(x: Value) -> Value:
    return 1.0 / (1.0 + elementwise("exp", x * -1.0))


def _recurrent(module: Any, x: Value, memory: Memory) -> Value:
    """Layers of long short-term memory; torch has the gates in the order input, forget, cell, output."""
    zero = constant(np.zeros(module.hidden_size))
    for layer in range(module.num_layers):
        names = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
        w_x, w_h, b_x, b_h = (getattr(module, f"{name}_l{layer}").detach().numpy() for name in names)
        hidden, cell = (memory.recall(f"{name}{layer}", zero) for name in ("hidden", "cell"))
        gates = (concat([x, hidden]) @ constant(np.hstack([w_x, w_h]).T) + constant(b_x + b_h)).reshape(4, -1)
        taken, kept, new, shown = (gates.reshape(-1)[range(k * zero.size, (k + 1) * zero.size)] for k in range(4))
        cell = _sigmoid(kept) * cell + _sigmoid(taken) * elementwise("tanh", new)
        x = _sigmoid(shown) * elementwise("tanh", cell)
        memory.kept |= {f"hidden{layer}": x, f"cell{layer}": cell}
    return x


def _sequence(modules: Any, x: Value, memory: Memory) -> Value:
    for module in modules:
        name = type(module).__name__
        if name not in MODULES:
            raise AgentError(f"cannot export a policy with a {name}: known are {', '.join(MODULES)}")
        x = MODULES[name](module, x, memory)
    return x


def _linear(module: Any, x: Value, memory: Memory) -> Value:
    return x @ constant(module.weight.detach().numpy().T) + constant(module.bias.detach().numpy())


MODULES: Mapping[str, Callable[[Any, Value, Memory], Value]] = {  # by the class of a module of torch, with its parameters
    "FlattenExtractor": lambda module, x, memory: x,
    "Hardtanh": lambda module, x, memory: clip(x, module.min_val, module.max_val),
    "Identity": lambda module, x, memory: x,
    "LSTM": _recurrent,
    "Linear": _linear,
    "Sequential": _sequence,
    "ReLU": lambda module, x, memory: where(x > 0.0, x, 0.0),
    "Tanh": lambda module, x, memory: elementwise("tanh", x),
    "Sigmoid": lambda module, x, memory: _sigmoid(x),
    "ELU": lambda module, x, memory: where(x > 0.0, x, elementwise("exp", x) - 1.0),
    "SiLU": lambda module, x, memory: x * _sigmoid(x),
    "LeakyReLU": lambda module, x, memory: where(x > 0.0, x, x * 0.01),
}


def _actor_critic(policy: Any) -> list[Any]:
    return [policy.pi_features_extractor, policy.mlp_extractor.policy_net, policy.action_net]


ACTORS: Mapping[str, Callable[[Any], list[Any]]] = {  # by algorithm, the modules from what is seen to the action's mean
    "apg": lambda policy: [policy.features_extractor, policy.network],
    "ppo": _actor_critic,
    "a2c": _actor_critic,
    "recurrent_ppo": lambda policy: [(own := _actor_critic(policy))[0], policy.lstm_actor, *own[1:]],
    "sac": lambda policy: [policy.actor.features_extractor, policy.actor.latent_pi, policy.actor.mu],
    "td3": lambda policy: [policy.actor.features_extractor, *list(policy.actor.mu)[:-1]],  # its end squashes, as below
    "dqn": lambda policy: [policy.q_net.features_extractor, policy.q_net.q_net],
}


def answer(agent: Agent, x: Value) -> Value:
    """The damping ratio that a policy's output stands for, see `agents.actions`; it never leaves the range."""
    low, high = agent.task.damping_range
    policy = agent.model.policy
    if agent.damping_levels is not None:
        action = x.reduced("argmax") * (2 / (agent.damping_levels - 1)) - 1.0
    elif getattr(policy, "actor", policy).squash_output:
        action = elementwise("tanh", x[0])
    else:
        action = clip(x[0], -1.0, 1.0)
    return clip((action + 1.0) * (0.5 * (high - low)) + low, low, high)


def program_of(agent: Agent, observation: Value | None = None) -> Program:
    """What an agent answers to an observation, by default one that is given under this name.

    Raises:
        AgentError: an agent that cannot be written here, in one line that says why.
    """
    algorithm, memory = agent.description["algorithm"], Memory()
    if algorithm not in ACTORS:
        raise AgentError(f"cannot export an agent of {algorithm!r}: known are {', '.join(ACTORS)}")
    if agent.layers:
        raise AgentError("cannot export an agent whose wrapper changes actions: it is Python of its own")
    x = given("observation", (len(agent.task.signals),)) if observation is None else observation
    if agent.filter is not None:
        x = estimate(agent.filter, x, memory)
    x = see(agent.sight, x, memory)
    damping = answer(agent, _sequence(ACTORS[algorithm](agent.model.policy), x, memory))
    if agent.filter is not None:
        memory.kept["commanded"] = damping
    return Program(damping, memory)
