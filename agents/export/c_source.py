"""Stages as C99: no allocation, no mutable global, and no library but math.h."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from roadgym.kalman import KalmanFilter

from .c_filter import c_filter
from .stages import Array, Value, Writer

FUNCTIONS = {  # of v
    "ReLU": "v > 0.0f ? v : 0.0f",
    "Tanh": "tanhf(v)",
    "Sigmoid": "1.0f / (1.0f + expf(-v))",
    "ELU": "v > 0.0f ? v : expm1f(v)",
    "SiLU": "v / (1.0f + expf(-v))",
    "LeakyReLU": "v > 0.0f ? v : 0.01f * v",
}


def number(value: float) -> str:
    """A literal that single precision reads as the same number."""
    text = f"{np.float32(value):.9g}"
    return f"{text if '.' in text or 'e' in text else f'{text}.0'}f"


def array(values: npt.ArrayLike) -> str:
    """An initialiser of an array of floats, in lines that can be read."""
    texts = [number(value) for value in np.ravel(values)]
    lines = [", ".join(texts[k : k + 8]) for k in range(0, len(texts), 8)]
    return "{" + ",\n    ".join(lines) + "}"


class CSource(Writer):
    """Collects the constants and the statements of one function, and what it keeps from one call to the next.

    Args:
        prefix: of the names of its constants.

    Attributes:
        constants: definitions of the constants, and of the functions that are called.
        body: the statements.
        state: by name, type and size of what is kept.
        numbers: how many numbers, of four bytes, the constants and the variables are.
    """

    def __init__(self, prefix: str) -> None:
        self.prefix = prefix
        self.constants: list[str] = []
        self.body: list[str] = []
        self.state: dict[str, tuple[str, int]] = {}
        self.numbers = {"constant": 0, "variable": 0}
        self._kept: list[str] = []
        self._given: set[str] = set()  # literals, which have no entries

    def _constant(self, values: npt.ArrayLike, kind: str = "float") -> str:
        flat = np.ravel(values)
        name = f"{self.prefix}{len(self.constants)}"
        text = array(flat) if kind == "float" else "{" + ", ".join(map(str, flat)) + "}"
        self.constants.append(f"static const {kind} {name}[{flat.size}] = {text};")
        self.numbers["constant"] += flat.size
        return name

    def _variable(self, size: int) -> Value:
        self.numbers["variable"] += size
        value = Value(f"x{len(self.body)}", size)  # as each has a statement of its own, no two are alike
        self.body.append(f"float {value.name}[{size}];")
        return value

    def _entry(self, x: Value) -> str:
        return x.name if x.name in self._given else f"{x.name}[{'i' if x.size > 1 else '0'}]"

    def _each(self, size: int, statement: str) -> Value:
        """A new vector, each entry of which is what the statement says of i."""
        y = self._variable(size)
        self.body.append(f"for (int i = 0; i < {size}; i++) {y.name}[i] = {statement};")
        return y

    def note(self, what: str) -> None:
        """A comment."""
        self.body.append(f"/* {what} */")

    def constant(self, values: npt.ArrayLike) -> Value:
        """A number, or a vector of shape (size,)."""
        if np.ndim(values):
            return Value(self._constant(values), np.size(values))
        value = Value(number(float(np.asarray(values))), 1)
        self._given.add(value.name)
        return value

    def pick(self, x: Value, places: Sequence[int] | Array) -> Value:
        """The entries at these places."""
        first, size = int(places[0]), len(places)
        if list(places) == list(range(first, first + size)):
            return self._each(size, f"{x.name}[i + {first}]" if first else f"{x.name}[i]")
        return self._each(size, f"{x.name}[{self._constant(places, 'unsigned short')}[i]]")

    def join(self, parts: Sequence[Value]) -> Value:
        """One after the other."""
        if len(parts) == 1:
            return parts[0]
        y, first = self._variable(sum(part.size for part in parts)), 0
        for part in parts:
            to = f"{y.name}[i + {first}]" if first else f"{y.name}[i]"
            self.body.append(f"for (int i = 0; i < {part.size}; i++) {to} = {self._entry(part)};")
            first += part.size
        return y

    def combine(self, sign: str, x: Value, y: Value) -> Value:
        """x + y, x - y, x * y or x / y, entry by entry."""
        return self._each(max(x.size, y.size), f"{self._entry(x)} {sign} {self._entry(y)}")

    def apply(self, name: str, x: Value) -> Value:
        """One of the functions of each entry."""
        y = self._variable(x.size)
        self.body += [
            f"for (int i = 0; i < {x.size}; i++) {{",
            f"    const float v = {self._entry(x)};",
            f"    {y.name}[i] = {FUNCTIONS[name]};",
            "}",
        ]
        return y

    def clip(self, x: Value, low: float, high: float) -> Value:
        """Each entry kept within [low, high]; what is no number becomes the lower end."""
        v = self._entry(x)
        a, b = number(low), number(high)
        return self._each(x.size, f"{v} > {b} ? {b} : ({v} > {a} ? {v} : {a})")

    def norm(self, x: Value) -> Value:
        """sqrt(1 + sum of squares), a single number."""
        y = self._variable(1)
        self.body += [
            f"{y.name}[0] = 1.0f;",
            f"for (int i = 0; i < {x.size}; i++) {y.name}[0] += {self._entry(x)} * {self._entry(x)};",
            f"{y.name}[0] = sqrtf({y.name}[0]);",
        ]
        return y

    def _rows(self, rows: int, start: str, matrix: str, x: Value) -> Value:
        y = self._variable(rows)
        self.body += [
            f"for (int i = 0; i < {rows}; i++) {{",
            f"    float sum = {start};",
            f"    for (int j = 0; j < {x.size}; j++) sum += {matrix}[i * {x.size} + j] * {x.name}[j];",
            f"    {y.name}[i] = sum;",
            "}",
        ]
        return y

    def affine(self, x: Value, weight: Array, bias: Array) -> Value:
        """weight x + bias."""
        return self._rows(len(bias), f"{self._constant(bias)}[i]", self._constant(weight), x)

    def times(self, matrix: Value, x: Value) -> Value:
        """The product of a matrix, row after row, and a vector."""
        return self._rows(matrix.size // x.size, "0.0f", matrix.name, x)

    def largest(self, x: Value) -> Value:
        """Place of the largest entry, the first of several."""
        y = self._variable(1)
        self.body += [
            f"{y.name}[0] = 0.0f;",
            f"for (int i = 1; i < {x.size}; i++) if ({x.name}[i] > {x.name}[(int){y.name}[0]]) {y.name}[0] = (float)i;",
        ]
        return y

    def interpolate(self, x: Value, low: Array, step: Array, table: Array) -> Value:
        """The bilinear interpolation of a table; where in it takes double precision, as a difference of near numbers."""
        nodes, _, size = table.shape
        y, known = self._variable(size), self._constant(table)
        place = [f"((double){x.name}[{k}] - {float(low[k])!r}) / {float(step[k])!r}" for k in range(2)]
        self.body += [
            f"for (int i = 0; i < {size}; i++) {y.name}[i] = 0.0f;",
            "{",
            f"    const double place[2] = {{{', '.join(place)}}};",
            "    int node[2];",
            "    float share[2];",
            "    for (int k = 0; k < 2; k++) {",
            f"        const double p = place[k] > 0.0 ? (place[k] < {nodes - 1}.0 ? place[k] : {nodes - 1}.0) : 0.0;",
            f"        node[k] = (int)p < {nodes - 2} ? (int)p : {nodes - 2};",
            "        share[k] = (float)(p - node[k]);",
            "    }",
            "    for (int a = 0; a < 2; a++) {",
            "        for (int b = 0; b < 2; b++) {",
            "            const float weight = (a ? share[0] : 1.0f - share[0]) * (b ? share[1] : 1.0f - share[1]);",
            f"            const float *corner = {known} + ((node[0] + a) * {nodes} + node[1] + b) * {size};",
            f"            for (int i = 0; i < {size}; i++) {y.name}[i] += weight * corner[i];",
            "        }",
            "    }",
            "}",
        ]
        return y

    def recall(self, name: str, start: Value) -> Value:
        """What was kept under a name in the step before."""
        self.state[name] = "float", start.size
        return self._each(start.size, f"state->begun ? state->{name}[i] : {self._entry(start)}")

    def keep(self, name: str, x: Value) -> None:
        """Keep a vector for the next step."""
        self._kept.append(f"for (int i = 0; i < {x.size}; i++) state->{name}[i] = {self._entry(x)};")

    def filter(self, known: KalmanFilter, x: Value, damping: Value) -> Value:
        """What a Kalman filter tells, in double precision."""
        written = c_filter(known)
        self.constants.append(written.text)
        self.numbers["constant"] += written.constant // 4
        self.numbers["variable"] += written.variable // 4
        self.state |= {
            "mean": ("double", written.states),
            "covariance": ("double", written.states**2),
            "in_force": ("double", 1 + written.waiting),
            "wait": ("int", written.measured),
        }
        y = self._variable(written.told)
        kept = ", ".join(f"state->{name}" for name in ("begun", "mean", "covariance", "in_force", "wait"))
        self.body.append(f"filtered({kept}, (double){damping.name}[0], {x.name}, {y.name});")
        return y

    def statements(self, result: str) -> str:
        """The function's body, at whose end it keeps what is to be kept, and does what ``result`` says."""
        kept = [*self._kept, "state->begun = 1;"] if self.state else []
        return "\n".join(f"    {line}" for line in [*self.body, *kept, *result.splitlines()])
