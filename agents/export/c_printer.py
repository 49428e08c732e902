"""Programs as C99: no allocation, no mutable global, and no library but math.h."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from .program import ELEMENTWISE, Loop, Printer, Value, walk

TYPES = {"float": "float", "double": "double", "bool": "int"}
BYTES = {"float": 4, "double": 8, "bool": 4}
CALLS = {"abs": "fabs", **{name: name for name in ("exp", "floor", "log", "rint", "sqrt", "tanh")}}
ARGUMENTS = ("observation", "measured")  # what is given that is not remembered
SIGNS = {"+": "+", "-": "-", "*": "*", "/": "/", ">": ">", "and": "&&"}
REDUCTIONS = {  # how each begins, and goes on
    "sum": ("{y} = 0;", "{y} += {x}[j];"),
    "max": ("{y} = {x}[0];", "if ({x}[j] > {y}) {y} = {x}[j];"),
    "argmax": ("{y} = 0;", "if ({x}[j] > {x}[(int){y}]) {y} = ({kind})j;"),
}

PRODUCT = """\
/* c = a b */
static void {name}(int rows, int inner, int columns, const {kind} *a, const {kind} *b, {kind} *c)
{{
    for (int i = 0; i < rows; i++) {{
        for (int k = 0; k < columns; k++) c[i * columns + k] = {zero};
        for (int j = 0; j < inner; j++)
            for (int k = 0; k < columns; k++) c[i * columns + k] += a[i * inner + j] * b[j * columns + k];
    }}
}}"""


def number(value: float, kind: str = "float") -> str:
    """A literal that its precision reads as the same number."""
    if kind == "double":
        return repr(float(value))
    text = f"{np.float32(value):.9g}"
    return f"{text if '.' in text or 'e' in text else f'{text}.0'}f"


def moved(name: str, places: str | int) -> str:
    """An array that begins some places on in another one."""
    return f"({name} + {places})" if places else name


def array(values: npt.ArrayLike, kind: str = "float") -> str:
    """An initialiser of an array, in lines that can be read."""
    texts = [number(value, kind) if kind in BYTES else str(value) for value in np.ravel(values).tolist()]
    lines = [", ".join(texts[k : k + 8]) for k in range(0, len(texts), 8)]
    return "{" + ",\n    ".join(lines) + "}"


def _block(loop: str, lines: Sequence[str]) -> list[str]:
    """The lines of a loop."""
    return [f"for ({loop}) {{", *(f"    {line}" for line in lines), "}"]


class CPrinter(Printer):
    """Collects the constants and the statements of functions.

    Attributes:
        constants: definitions of constants, and of the functions that are called, by what they define.
        bytes: of the constants, and of the variables, which lie on the stack.
    """

    def __init__(self) -> None:
        super().__init__()
        self.constants: dict[object, str] = {}
        self.bytes = {"constant": 0, "variable": 0}
        self._numbers = itertools.count()
        self._fused: set[Value] = set()  # what is worked out where it is used, the only place

    def body(self, results: Sequence[Value], end: str) -> str:
        """The statements of a function, which make ``results``; ``{0}``, ``{1}``, ... are their names in the ``end``."""
        uses = Counter(walk(results))
        for value in uses:
            self._fused |= {
                x
                for x in value.inputs
                if {x.operation, value.operation} <= ELEMENTWISE.keys()
                and (x.shape, x.scopes, uses[x]) == (value.shape, value.scopes, 1)
            }
        self.lines = []
        names = self.write_all(results)
        return "\n".join(f"    {line}" for line in [*self.lines, *end.format(*names).splitlines()])

    def write(self, value: Value) -> str:
        """Write a value, whose inputs are written, and return the name of its first entry's place."""
        operation, detail = value.operation, value.detail
        x = self.names[value.inputs[0]] if value.inputs else ""
        if operation == "constant":
            literal = f"(const {TYPES[value.kind]}[1]){array(detail, value.kind)}"
            return literal if value.size == 1 else self._constant(detail, value.kind)
        if operation == "given":
            return str(detail) if detail in ARGUMENTS else f"state->{detail}"
        if operation == "reshape" or value in self._fused:
            return x
        if operation == "gather" and np.array_equal(np.ravel(detail), detail.min() + np.arange(detail.size)):
            return moved(x, detail.min())
        if operation == "take":
            return moved(self._constant(detail, value.kind), f"(int){x}[0] * {value.size}")
        y = self._variable(value)
        if operation in ELEMENTWISE:
            self._each(value, y)
        elif operation == "gather":
            self._loop(value.size, f"{y}[i] = {x}[{self._constant(np.ravel(detail), 'unsigned short')}[i]];")
        elif operation == "concat":
            first = 0
            for part in value.inputs:
                self._copy(moved(y, first), self.names[part], part.size)
                first += part.size
        elif operation == "matmul":
            name = "multiply" if value.kind == "double" else "multiplyf"
            self.constants.setdefault(name, PRODUCT.format(name=name, kind=value.kind, zero=number(0, value.kind)))
            rows, inner = value.inputs[0].shape
            self.lines.append(f"{name}({rows}, {inner}, {value.shape[1]}, {x}, {self.names[value.inputs[1]]}, {y});")
        else:
            count, several = value.inputs[0].shape[-1], value.size > 1
            row = moved(x, f"i * {count}") if several else x
            words = {"y": f"{y}[{'i' if several else 0}]", "x": row, "kind": value.kind}
            start, each = (text.format(**words) for text in REDUCTIONS[operation])
            entry = [start, f"for (int j = 0; j < {count}; j++) {each}"]
            self.lines += _block(f"int i = 0; i < {value.size}; i++", entry) if several else entry
        return y

    def _constant(self, values: npt.NDArray[Any], kind: str) -> str:
        """The name of a constant, which is defined once."""
        key = kind, values.tobytes()
        name = f"k{list(self.constants).index(key) if key in self.constants else len(self.constants)}"
        if key not in self.constants:
            self.constants[key] = f"static const {kind} {name}[{values.size}] = {array(values, kind)};"
            self.bytes["constant"] += values.size * BYTES.get(kind, 2)
        return name

    def _variable(self, value: Value) -> str:
        """The name of a new variable."""
        name = f"x{next(self._numbers)}"
        self.lines.append(f"{TYPES[value.kind]} {name}[{value.size}];")
        self.bytes["variable"] += value.size * BYTES[value.kind]
        return name

    def _loop(self, size: int, statement: str) -> None:
        """A statement for each i below a size."""
        self.lines.append(f"for (int i = 0; i < {size}; i++) {statement}" if size > 1 else statement)

    def _copy(self, target: str, source: str, size: int) -> None:
        """Copy numbers."""
        for_one = "0" if size == 1 else "i"
        self._loop(size, f"{target}[{for_one}] = {source}[{for_one}];")

    def _leaves(self, value: Value) -> Iterator[Value]:
        for x in value.inputs:
            yield from self._leaves(x) if x in self._fused else [x]

    def _each(self, value: Value, name: str) -> None:
        """Each entry of what operations make entry by entry."""
        if all(x.size == 1 or x.shape == value.shape for x in self._leaves(value)):
            text = self._entry(value, lambda x: "0" if x.size == 1 else "i")
            self._loop(value.size, f"{name}[{'i' if value.size > 1 else 0}] = {text};")
            return
        rows, columns = value.shape

        def place(x: Value) -> str:
            row, column = (f"i * {x.shape[1]}" if x.shape[0] > 1 else ""), ("j" if x.shape[1] > 1 else "")
            return " + ".join(filter(None, (row, column))) or "0"

        self.lines += [
            f"for (int i = 0; i < {rows}; i++)",
            f"    for (int j = 0; j < {columns}; j++) {name}[i * {columns} + j] = {self._entry(value, place)};",
        ]

    def _entry(self, value: Value, place: Callable[[Value], str]) -> str:
        """An entry of a value as an expression."""
        parts = [self._entry(x, place) if x in self._fused else self._number(x, place) for x in value.inputs]
        operation = value.operation
        if operation == "where":
            return "({} ? {} : {})".format(*parts)
        if operation in SIGNS:
            return f"({parts[0]} {SIGNS[operation]} {parts[1]})"
        if operation in TYPES:
            return f"({operation}){parts[0]}"
        return f"{CALLS[operation]}{'f' if value.kind == 'float' else ''}({parts[0]})"

    def _number(self, x: Value, place: Callable[[Value], str]) -> str:
        """The same of one that is written."""
        if x.operation == "constant" and x.size == 1:
            return number(x.detail.item(), x.kind)
        return self.names[x] if self.names[x] == "state->begun" else f"{self.names[x]}[{place(x)}]"

    def scan(self, value: Value, loop: Loop) -> list[str]:
        """Write a scan as a loop."""
        carried = [self._variable(x) for x in loop.carried]
        told = [self._variable(Value("told", (), (loop.count, *x.shape), x.kind)) for x in loop.told]
        for name, x in zip(carried, value.inputs, strict=False):
            self._copy(name, self.names[x], x.size)
        step = f"s{next(self._numbers)}"
        stacks = value.inputs[len(carried) :]
        slices = [moved(self.names[x], f"{step} * {each.size}") for x, each in zip(stacks, loop.slices, strict=True)]
        made, within = self.block(loop, [*carried, *slices])
        outside, self.lines = self.lines, within
        for name, x, source in zip(told, loop.told, made[len(carried) :], strict=True):
            self._copy(moved(name, f"{step} * {x.size}"), source, x.size)
        for name, x, source in zip(carried, loop.carried, made, strict=False):
            self._copy(name, source, x.size)
        self.lines = outside + _block(f"int {step} = 0; {step} < {loop.count}; {step}++", self.lines)
        return carried + told
