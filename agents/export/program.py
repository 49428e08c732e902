"""What is exported, as a program: values made of values by a few operations on small arrays, written once for every target.

Written in Python with the operators of `Value`, a program is printed as C99 (`agents.export.c_printer`) or as a graph of ONNX
(`agents.export.onnx_graph`). What depends on constants alone is worked out at once.
"""

from __future__ import annotations

import abc
import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Number = float | int

KINDS: dict[str, Any] = {"float": np.float32, "double": np.float64, "bool": np.bool_}
ELEMENTWISE: dict[str, Any] = {
    "+": np.add,
    "-": np.subtract,
    "*": np.multiply,
    "/": np.divide,
    ">": np.greater,
    "and": np.logical_and,
    "where": np.where,
    **{name: getattr(np, name) for name in ("abs", "exp", "floor", "log", "rint", "sqrt", "tanh")},
    "float": np.float32,
    "double": np.float64,
}
REDUCTIONS: dict[str, Any] = {"sum": np.sum, "max": np.max, "argmax": np.argmax}


def _operator(operation: str, swapped: bool = False) -> Callable[[Value, Value | Number], Value]:
    """An operator of values, that of a number before a value if it is ``swapped``."""
    return lambda one, other: elementwise(operation, other, one) if swapped else elementwise(operation, one, other)


@dataclasses.dataclass(frozen=True, eq=False)
class Value:
    """An array of a program, one for each car.

    Attributes:
        operation: what makes it: "constant", "given", one of `ELEMENTWISE` or `REDUCTIONS`, "matmul", "gather" (the places
            ``detail`` of a vector), "take" (a row of the table ``detail``), "concat" (of vectors), "reshape", "scan" (see
            `scan`), "part" (the result ``detail`` of a scan).
        inputs: of what.
        shape: its own, without that of the cars.
        kind: "float", "double" or "bool".
        detail: the constant, the name of what is given, and what is said above.
        scopes: the scans without which it cannot be known.
        number: of all values the how manieth.
    """

    operation: str
    inputs: tuple[Value, ...]
    shape: tuple[int, ...]
    kind: str
    detail: Any = None
    scopes: frozenset[object] = frozenset()
    number: int = dataclasses.field(default_factory=itertools.count().__next__)

    @property
    def size(self) -> int:
        """How many numbers it is."""
        return int(np.prod(self.shape))

    __add__, __sub__, __mul__, __truediv__ = (_operator(sign) for sign in "+-*/")
    __radd__, __rsub__, __rmul__, __rtruediv__ = (_operator(sign, swapped=True) for sign in "+-*/")
    __gt__, __and__ = _operator(">"), _operator("and")

    def __matmul__(self, other: Value) -> Value:
        """The product of matrices; a vector on the left is a row."""
        if len(self.shape) == 1:
            return (self.reshape(1, -1) @ other).reshape(-1)
        return _made("matmul", (self, other), (self.shape[0], other.shape[1]), self.kind)

    def __getitem__(self, places: Sequence[int] | Array | int) -> Value:
        """The entries of a vector at these places, in their shape."""
        at = np.arange(self.size)[np.asarray(places, np.int64)]
        if at.shape == self.shape and np.array_equal(at, np.arange(self.size)):
            return self
        return _made("gather", (self,), at.shape, self.kind, at)

    def reshape(self, *shape: int) -> Value:
        """The same numbers in another shape."""
        found = np.empty(self.shape, np.bool_).reshape(shape).shape
        return self if found == self.shape else _made("reshape", (self,), found, self.kind)

    @property
    def transposed(self) -> Value:
        """Of a matrix."""
        return self.reshape(-1)[np.arange(self.size).reshape(self.shape).T]

    def of_kind(self, kind: str) -> Value:
        """In single or double precision."""
        return self if self.kind == kind else _made(kind, (self,), self.shape, kind)

    def reduced(self, name: str) -> Value:
        """One of `REDUCTIONS` over the last axis; "argmax" is the place of the largest, the first of several."""
        return _made(name, (self,), self.shape[:-1], self.kind)


def constant(values: npt.ArrayLike, kind: str = "float") -> Value:
    """A constant."""
    array = np.asarray(values, KINDS[kind])
    return Value("constant", (), array.shape, kind, array)


def given(name: str, shape: tuple[int, ...], kind: str = "float") -> Value:
    """What the program is given, or kept the step before."""
    return Value("given", (), shape, kind, name)


def _made(operation: str, inputs: Sequence[Value], shape: tuple[int, ...], kind: str, detail: Any = None) -> Value:
    """A new value, which is a constant if all that it is made of are."""
    scopes = frozenset[object]().union(*(x.scopes for x in inputs))
    value = Value(operation, tuple(inputs), shape, kind, detail, scopes)
    if all(x.operation == "constant" for x in inputs):
        return constant(_computed(value, [x.detail for x in inputs]), kind)
    return value


def elementwise(operation: str, *operands: Value | Number) -> Value:
    """One of `ELEMENTWISE`, of values that are of one kind but for a condition; numbers become constants of that kind."""
    kind = next(x.kind for x in reversed(operands) if isinstance(x, Value))
    values = [x if isinstance(x, Value) else constant(x, kind) for x in operands]
    rank = max(len(x.shape) for x in values)
    aligned = [x.reshape(*(1,) * (rank - len(x.shape)), *x.shape) for x in values]
    shape = np.broadcast_shapes(*(x.shape for x in aligned))
    return _made(operation, aligned, shape, "bool" if operation in (">", "and") else kind)


def where(condition: Value, one: Value | Number, other: Value | Number) -> Value:
    """``one`` where the condition holds, else ``other``, of which one is a value."""
    kind = next(x.kind for x in (one, other) if isinstance(x, Value))
    both = [x if isinstance(x, Value) else constant(x, kind) for x in (one, other)]
    return elementwise("where", condition, *both)


def clip(x: Value, low: float, high: float) -> Value:
    """Each entry kept within [low, high]; what is no number becomes the lower end."""
    return where(x > high, high, where(x > low, x, low))


def least(x: Value, y: Value | Number) -> Value:
    """The smaller one of each pair."""
    return where(x > y, y, x)


def concat(parts: Sequence[Value]) -> Value:
    """Vectors and numbers one after the other, as a vector."""
    flat = [part.reshape(-1) for part in parts if part.size]
    return flat[0] if len(flat) == 1 else _made("concat", flat, (sum(part.size for part in flat),), flat[0].kind)


def take(table: npt.ArrayLike, row: Value, kind: str = "float") -> Value:
    """The row of a table, shape (rows, size), whose number is a value."""
    known = np.asarray(table, KINDS[kind])
    return _made("take", (row,), known.shape[1:], kind, known)


@dataclasses.dataclass(frozen=True)
class Loop:
    """The ``detail`` of a scan: its scope, how often, what stands for what is carried and for slices, and what it makes."""

    scope: frozenset[object]
    count: int
    carried: tuple[Value, ...]
    slices: tuple[Value, ...]
    next: tuple[Value, ...]
    told: tuple[Value, ...]


def scan(
    body: Callable[[list[Value], list[Value]], tuple[Sequence[Value], Sequence[Value]]],
    carried: Sequence[Value],
    stacked: Sequence[Value],
    count: int | None = None,
) -> tuple[list[Value], list[Value]]:
    """Go through stacks step by step.

    Args:
        body: makes of what is carried and of a slice of each stack what is carried on, anew or as it was, and what is told.
        carried: at the beginning.
        stacked: the stacks, shape (count, ...).
        count: of the steps, where there is no stack.

    Returns:
        What is carried at the end, and stacks of what was told.
    """
    scope = frozenset([object()])
    held = tuple(Value("given", (), x.shape, x.kind, None, scope) for x in carried)
    slices = tuple(Value("given", (), x.shape[1:], x.kind, None, scope) for x in stacked)
    after, told = body(list(held), list(slices))
    loop = Loop(scope, stacked[0].shape[0] if count is None else count, held, slices, tuple(after), tuple(told))
    scopes = frozenset[object]().union(*(x.scopes for x in (*carried, *stacked, *after, *told))) - scope
    whole = Value("scan", (*carried, *stacked), (), "bool", loop, scopes)
    results = [Value("part", (whole,), x.shape, x.kind, k, scopes) for k, x in enumerate(after)]
    results += [Value("part", (whole,), (loop.count, *x.shape), x.kind, k, scopes) for k, x in enumerate(told, len(results))]
    return results[: len(after)], results[len(after) :]


class Memory:
    """What a program keeps from one step to the next.

    Attributes:
        begun: false in the first step of a drive.
        fields: by name, what was kept, as it is given.
        kept: by name, what to keep.
    """

    def __init__(self) -> None:
        self.begun = given("begun", (), "bool")
        self.fields: dict[str, Value] = {}
        self.kept: dict[str, Value] = {}

    def recall(self, name: str, start: Value) -> Value:
        """What was kept under a name in the step before; ``start`` where the drive begins."""
        self.fields[name] = given(name, start.shape, start.kind)
        return where(self.begun, self.fields[name], start)


@dataclasses.dataclass(frozen=True)
class Program:
    """What an agent answers to an observation, and what it remembers."""

    answer: Value
    memory: Memory

    @property
    def results(self) -> list[Value]:
        """The answer, and what is kept, in the order of the memory's fields."""
        return [self.answer, *(self.memory.kept[name] for name in self.memory.fields)]


def _computed(value: Value, inputs: Sequence[Array]) -> Any:
    """What an operation makes of arrays."""
    operation, detail = value.operation, value.detail
    if operation in ELEMENTWISE:
        with np.errstate(all="ignore"):
            return ELEMENTWISE[operation](*inputs)
    if operation in REDUCTIONS:
        return REDUCTIONS[operation](inputs[0], axis=-1)
    others: Mapping[str, Callable[[], Any]] = {
        "matmul": lambda: inputs[0] @ inputs[1],
        "gather": lambda: inputs[0][detail],
        "take": lambda: detail[int(inputs[0])],
        "concat": lambda: np.concatenate(inputs),
        "reshape": lambda: inputs[0].reshape(value.shape),
    }
    return others[operation]()


def walk(results: Sequence[Value]) -> Iterator[Value]:
    """Each use of each value of a program: a value as often as something is made of it, and as it is a result."""
    seen: set[Value] = set()
    waiting = list(results)
    while waiting:
        value = waiting.pop()
        yield value
        if value not in seen:
            seen.add(value)
            waiting += value.inputs
            if value.operation == "scan":
                waiting += (*value.detail.next, *value.detail.told)


class Printer(abc.ABC):
    """Writes values in the order in which they were made, those within a loop where the loop is written.

    Attributes:
        lines: what was written, of whatever sort, in the block that is being written.
        names: of what is written.
    """

    def __init__(self) -> None:
        self.lines: list[Any] = []
        self.names: dict[Value, str] = {}
        self._open: frozenset[object] = frozenset()
        self._parts: dict[Value, Sequence[str]] = {}  # the names of what a scan makes

    def write_all(self, results: Sequence[Value]) -> list[str]:
        """Write what results need, but for what only a loop within knows, and return their names."""
        for value in sorted(set(walk(results)), key=lambda value: value.number):
            if value in self.names or value in self._parts or not value.scopes <= self._open:
                continue
            if value.operation == "scan":
                self._parts[value] = self.scan(value, value.detail)
            elif value.operation == "part":
                self.names[value] = self._parts[value.inputs[0]][value.detail]
            else:
                self.names[value] = self.write(value)
        return [self.names[value] for value in results]

    def block(self, loop: Loop, names: Sequence[str]) -> tuple[list[str], list[Any]]:
        """The names of what a loop makes, and the lines that do, with the names that it has for what stands in it."""
        outside = self.lines, self._open
        self.lines, self._open = [], self._open | loop.scope
        self.names |= zip((*loop.carried, *loop.slices), names, strict=True)
        made, within = self.write_all([*loop.next, *loop.told]), self.lines
        self.lines, self._open = outside
        return made, within

    @abc.abstractmethod
    def write(self, value: Value) -> str:
        """Write a value, whose inputs are written, and return its name; no scan."""

    @abc.abstractmethod
    def scan(self, value: Value, loop: Loop) -> Sequence[str]:
        """Write a scan, and return the names of what is carried at its end, and of what it told."""
