"""What lies between the signals that a car measures and the damping that a trained agent commands, stage by stage.

A stage is a function of a `Writer` and of a vector, and gives a vector. It writes itself in the few operations of a `Writer`,
each of which `agents.export.c_source` has in C99 and `agents.export.onnx_graph` as nodes of ONNX: what is written once is the
same in both. Another stage is one function more in `stages_of`.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from roadgym.kalman import KalmanFilter
from roadgym.task import OPERATING_POINT, SATURATION, Task

from ..agent import Agent
from ..errors import AgentError
from ..features import Features, Lookahead, Sight
from ..theory import NODES

Array = npt.NDArray[Any]


@dataclasses.dataclass(frozen=True)
class Value:
    """A vector in what is written: its name there and its size; a single number goes with every entry of another one."""

    name: str
    size: int


class Writer(abc.ABC):
    """The operations that stages are made of, all but the filter in single precision."""

    @abc.abstractmethod
    def note(self, what: str) -> None:
        """Tell the reader what follows."""

    @abc.abstractmethod
    def constant(self, values: npt.ArrayLike) -> Value:
        """A number, or a vector of shape (size,)."""

    @abc.abstractmethod
    def pick(self, x: Value, places: Sequence[int] | Array) -> Value:
        """The entries at these places."""

    @abc.abstractmethod
    def join(self, parts: Sequence[Value]) -> Value:
        """One after the other."""

    @abc.abstractmethod
    def combine(self, sign: str, x: Value, y: Value) -> Value:
        """x + y, x - y, x * y or x / y, entry by entry."""

    @abc.abstractmethod
    def apply(self, name: str, x: Value) -> Value:
        """One of `FUNCTIONS` of each entry."""

    @abc.abstractmethod
    def clip(self, x: Value, low: float, high: float) -> Value:
        """Each entry kept within [low, high]."""

    @abc.abstractmethod
    def norm(self, x: Value) -> Value:
        """sqrt(1 + sum of squares), a single number."""

    @abc.abstractmethod
    def affine(self, x: Value, weight: Array, bias: Array) -> Value:
        """weight x + bias, shapes (rows, x.size) and (rows,)."""

    @abc.abstractmethod
    def times(self, matrix: Value, x: Value) -> Value:
        """The product of a matrix, row after row, and a vector."""

    @abc.abstractmethod
    def largest(self, x: Value) -> Value:
        """Place of the largest entry, the first of several, a single number."""

    @abc.abstractmethod
    def interpolate(self, x: Value, low: Array, step: Array, table: Array) -> Value:
        """The bilinear interpolation of a table, shape (n, n, size), over equal steps, shape (2,), from ``low``, shape (2,)."""

    @abc.abstractmethod
    def recall(self, name: str, start: Value) -> Value:
        """What was kept under a name in the step before; ``start`` where the episode begins."""

    @abc.abstractmethod
    def keep(self, name: str, x: Value) -> None:
        """Keep a vector for the next step."""

    @abc.abstractmethod
    def filter(self, known: KalmanFilter, x: Value, damping: Value) -> Value:
        """What a Kalman filter tells after an observation ``x``, at whose interval's start a damping was commanded."""


FUNCTIONS = ("ReLU", "Tanh", "Sigmoid", "ELU", "SiLU", "LeakyReLU")  # as torch.nn calls them, with its parameters

Stage = Callable[[Writer, Value], Value]


def scales_of(task: Task) -> Array:
    """By signal, what to multiply an observation with to get what is measured; of the speed and the bandwidth see `observe`."""
    factors = {"speed": task.speed_unit, "bandwidth": 0.5, "slope": task.road.wavenumber}  # dZ/ds, of what is observed
    return np.array([scale * factors.get(name, 1.0) for name, scale in zip(task.signals, task.signal_scale, strict=True)])


def signal_table(task: Task) -> list[tuple[str, str, float]]:
    """Name, unit and scale of each signal that is observed."""
    units = {name: signal.unit.replace("²", "^2") for name, signal in task.car.motion.signals.items()}
    units |= {"speed": "m/s", "bandwidth": "1", "slope": "m/m"}
    return [(name, units.get(name, "m"), scale) for name, scale in zip(task.signals, scales_of(task).tolist(), strict=True)]


def observe(task: Task, writer: Writer, measured: Value) -> Value:
    """Observations of what is measured: over their scale and saturated; nu/(1 + nu) and 2 delta/(1 + 2 delta) of the point."""
    scaled = writer.combine("/", measured, writer.constant(scales_of(task)))
    parts = []
    for place, name in enumerate(task.signals):
        x = writer.pick(scaled, [place])
        if name in OPERATING_POINT:
            x = writer.clip(x, 0.0, 1e6)
            parts.append(writer.combine("/", x, writer.combine("+", x, writer.constant(1.0))))
        else:
            parts.append(writer.clip(x, -SATURATION, SATURATION))
    return writer.join(parts)


def estimate(known: KalmanFilter, writer: Writer, observation: Value) -> Value:
    """What a Kalman filter tells: the observation of its ``full`` task."""
    writer.note("what is known of car and road")
    before = writer.recall("damping", writer.constant(known.task.damping_range[0]))
    return writer.filter(known, observation, before)


def see(sight: Sight, writer: Writer, observation: Value) -> Value:
    """What the policy sees: `agents.features.Sight`."""
    writer.note("what the policy sees")
    seen, older = observation, sight.frame_stack - 1
    if older and sight.moving:
        moving = writer.pick(observation, sight.moving)
        before = writer.recall("frames", writer.join([moving] * older))
        seen = writer.join([observation, before])
        kept = before.size - moving.size
        writer.keep("frames", writer.join([moving, *([writer.pick(before, range(kept))] if kept else [])]))
    return seen if sight.features is None else _features(sight.features, writer, seen)


def _features(features: Features, writer: Writer, seen: Value) -> Value:
    parts = []
    if features.point:
        shifted = writer.combine("-", writer.pick(seen, features.point), writer.constant(0.5))
        parts.append(writer.combine("*", shifted, writer.constant(4.0)))
    if features.state:
        state = writer.pick(seen, features.state)
        if features.signals:
            parts.append(state)
        even = []
        if features.products:
            even.append(writer.combine("*", writer.pick(state, features.first), writer.pick(state, features.second)))
        if features.lookahead is not None:
            even.append(_lookahead(features.lookahead, writer, seen))
        if even:
            parts.append(writer.combine("/", writer.join(even), writer.norm(state)))
    return writer.join(parts)


def _lookahead(lookahead: Lookahead, writer: Writer, seen: Value) -> Value:
    point = writer.pick(seen, (lookahead.point * 2)[:2])
    if len(lookahead.point) == 1:  # no bandwidth is one of 0
        point = writer.combine("*", point, writer.constant([1.0, 0.0]))
    table = lookahead.table.reshape(NODES, NODES, -1)
    forms = writer.interpolate(point, lookahead.grid.low, lookahead.grid.step, table)
    state = writer.pick(seen, lookahead.columns)
    squares = writer.combine("*", writer.pick(state, lookahead.first), writer.pick(state, lookahead.second))
    return writer.times(forms, writer.join([squares, writer.constant([1.0])]))


def _linear(module: Any, writer: Writer, x: Value) -> Value:
    writer.note(f"from {module.in_features} to {module.out_features} numbers")
    return writer.affine(x, module.weight.detach().numpy(), module.bias.detach().numpy())


def _recurrent(module: Any, writer: Writer, x: Value) -> Value:
    """Layers of long short-term memory; torch has the gates in the order input, forget, cell, output."""
    writer.note(f"long short-term memory of {module.num_layers} x {module.hidden_size} cells")
    size, zero = module.hidden_size, writer.constant(np.zeros(module.hidden_size))
    for layer in range(module.num_layers):
        w_x, w_h, b_x, b_h = (
            getattr(module, f"{name}_l{layer}").detach().numpy() for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
        )
        hidden, cell = writer.recall(f"hidden{layer}", zero), writer.recall(f"cell{layer}", zero)
        gates = writer.affine(writer.join([x, hidden]), np.hstack([w_x, w_h]), b_x + b_h)
        taken, kept, new, shown = (
            writer.apply("Tanh" if k == 2 else "Sigmoid", writer.pick(gates, range(k * size, (k + 1) * size))) for k in range(4)
        )
        cell_now = writer.combine("+", writer.combine("*", kept, cell), writer.combine("*", taken, new))
        x = writer.combine("*", shown, writer.apply("Tanh", cell_now))
        writer.keep(f"hidden{layer}", x)
        writer.keep(f"cell{layer}", cell_now)
    return x


def _sequence(modules: Any, writer: Writer, x: Value) -> Value:
    for module in modules:
        x = module_stage(module)(writer, x)
    return x


MODULES: Mapping[str, Callable[[Any, Writer, Value], Value]] = {  # by the class of a module of torch, how it is written
    "FlattenExtractor": lambda module, writer, x: x,
    "Hardtanh": lambda module, writer, x: writer.clip(x, module.min_val, module.max_val),
    "Identity": lambda module, writer, x: x,
    "LSTM": _recurrent,
    "Linear": _linear,
    "Sequential": _sequence,
    **{name: functools.partial(lambda name, module, writer, x: writer.apply(name, x), name) for name in FUNCTIONS},
}


def module_stage(module: Any) -> Stage:
    """The stage of a module of torch.

    Raises:
        AgentError: a module that is not known here.
    """
    name = type(module).__name__
    if name not in MODULES:
        raise AgentError(f"cannot export a policy with a {name}: known are {', '.join(MODULES)}")
    return functools.partial(MODULES[name], module)


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


def answer(agent: Agent, writer: Writer, x: Value) -> Value:
    """The damping ratio that a policy's output stands for, see `agents.actions`; it never leaves the range."""
    low, high = agent.task.damping_range
    levels = agent.damping_levels
    policy = agent.model.policy
    writer.note("the damping ratio")
    if levels is not None:
        place = writer.combine("*", writer.largest(x), writer.constant(2 / (levels - 1)))
        action = writer.combine("-", place, writer.constant(1.0))
    elif getattr(policy, "actor", policy).squash_output:
        action = writer.apply("Tanh", x)
    else:
        action = writer.clip(x, -1.0, 1.0)
    share = writer.combine("*", writer.combine("+", action, writer.constant(1.0)), writer.constant(0.5 * (high - low)))
    damping = writer.combine("+", writer.constant(low), share)
    damping = writer.clip(damping, low, high)
    if agent.filter is not None:
        writer.keep("damping", damping)
    return damping


def stages_of(agent: Agent) -> list[Stage]:
    """The stages from observations, in the order of the task's signals, to the damping ratio.

    Raises:
        AgentError: an agent that cannot be written here, in one line that says why.
    """
    algorithm = agent.description["algorithm"]
    if algorithm not in ACTORS:
        raise AgentError(f"cannot export an agent of {algorithm!r}: known are {', '.join(ACTORS)}")
    if agent.layers:
        raise AgentError("cannot export an agent whose wrapper changes actions: it is Python of its own")
    modules = ACTORS[algorithm](agent.model.policy)
    before = [] if agent.filter is None else [functools.partial(estimate, agent.filter)]
    return [*before, functools.partial(see, agent.sight), *map(module_stage, modules), functools.partial(answer, agent)]


def write_through(stages: Sequence[Stage], writer: Writer, x: Value) -> Value:
    """One stage after the other."""
    for stage in stages:
        x = stage(writer, x)
    return x
