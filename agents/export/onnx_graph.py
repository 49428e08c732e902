"""Stages as a graph of ONNX, from what is measured to the damping ratio, for any number of cars at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

import roadgym
from roadgym.installation import needs
from roadgym.kalman import KalmanFilter

from ..agent import Agent
from ..errors import AgentError
from .stages import Array, Value, Writer, observe, signal_table, stages_of, write_through

with needs("onnx"):
    import onnx
    from onnx import TensorProto, helper, numpy_helper

MEASURED, DAMPING, BEGINS = "measured", "damping", "begins"
OPSET, IR_VERSION = 17, 8  # of 2022: runtimes in use read it
SIGNS = {"+": "Add", "-": "Sub", "*": "Mul", "/": "Div"}
FUNCTIONS = {"ReLU": "Relu", "Tanh": "Tanh", "Sigmoid": "Sigmoid", "ELU": "Elu", "LeakyReLU": "LeakyRelu"}  # with their alpha


class OnnxGraph(Writer):
    """Collects nodes, constants, and what goes in and comes out beside the signals; a vector has the shape (cars, size).

    Attributes:
        nodes, constants: of the graph.
        state: by name, the size of what is kept.
        kept: by name, what is kept for the next step.
    """

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        self.state: dict[str, int] = {}
        self.kept: dict[str, Value] = {}

    def tensor(self, values: npt.ArrayLike, kind: Any = np.float32) -> str:
        """The name of a new constant."""
        self.constants.append(numpy_helper.from_array(np.asarray(values, kind), f"k{len(self.constants)}"))
        return str(self.constants[-1].name)

    def node(self, operator: str, inputs: Sequence[str], size: int, **attributes: Any) -> Value:
        """What a new node gives."""
        value = Value(f"x{len(self.nodes)}", size)
        self.nodes.append(helper.make_node(operator, list(inputs), [value.name], **attributes))
        return value

    def note(self, what: str) -> None:
        """A graph has no comments."""

    def constant(self, values: npt.ArrayLike) -> Value:
        """A number, or a vector of shape (size,)."""
        return Value(self.tensor(np.reshape(values, (1, -1))), np.size(values))

    def pick(self, x: Value, places: Sequence[int] | Array) -> Value:
        """The entries at these places."""
        return self.node("Gather", [x.name, self.tensor(list(places), np.int64)], len(places), axis=1)

    def join(self, parts: Sequence[Value]) -> Value:
        """One after the other; constants for as many cars as there are."""
        rows = [self._each_car(part) for part in parts]
        return self.node("Concat", [row.name for row in rows], sum(row.size for row in rows), axis=1)

    def _each_car(self, x: Value) -> Value:
        """A constant once for each car; anything else as it is."""
        if x.name not in {known.name for known in self.constants}:
            return x
        cars = self.node("Slice", [self.node("Shape", [MEASURED], 2).name, *(self.tensor([k], np.int64) for k in (0, 1))], 1)
        shape = self.node("Concat", [cars.name, self.tensor([x.size], np.int64)], 2, axis=0)
        return self.node("Expand", [x.name, shape.name], x.size)

    def combine(self, sign: str, x: Value, y: Value) -> Value:
        """x + y, x - y, x * y or x / y, entry by entry."""
        return self.node(SIGNS[sign], [x.name, y.name], max(x.size, y.size))

    def apply(self, name: str, x: Value) -> Value:
        """One of the functions of each entry."""
        if name == "SiLU":
            return self.combine("*", x, self.apply("Sigmoid", x))
        return self.node(FUNCTIONS[name], [x.name], x.size)

    def clip(self, x: Value, low: float, high: float) -> Value:
        """Each entry kept within [low, high]."""
        return self.node("Clip", [x.name, self.tensor(low), self.tensor(high)], x.size)

    def norm(self, x: Value) -> Value:
        """sqrt(1 + sum of squares), a single number."""
        total = self.node("ReduceSum", [self.combine("*", x, x).name, self.tensor([1], np.int64)], 1, keepdims=1)
        return self.node("Sqrt", [self.combine("+", total, self.constant(1.0)).name], 1)

    def affine(self, x: Value, weight: Array, bias: Array) -> Value:
        """weight x + bias."""
        return self.node("Gemm", [x.name, self.tensor(weight), self.tensor(bias)], len(bias), transB=1)

    def times(self, matrix: Value, x: Value) -> Value:
        """The product of a matrix, row after row, and a vector."""
        rows = matrix.size // x.size
        whole = self._shaped(matrix.name, rows, x.size)
        product = self.node("MatMul", [whole, self._shaped(x.name, x.size, 1)], rows)
        return self.node("Reshape", [product.name, self.tensor([-1, rows], np.int64)], rows)

    def _shaped(self, name: str, rows: int, columns: int) -> str:
        return self.node("Reshape", [name, self.tensor([-1, rows, columns], np.int64)], columns).name

    def largest(self, x: Value) -> Value:
        """Place of the largest entry, the first of several."""
        return self._cast(self.node("ArgMax", [x.name], 1, axis=1, keepdims=1), TensorProto.FLOAT)

    def _cast(self, x: Value, to: int) -> Value:
        return self.node("Cast", [x.name], x.size, to=to)

    def interpolate(self, x: Value, low: Array, step: Array, table: Array) -> Value:
        """The bilinear interpolation of a table; where in it takes double precision, as a difference of near numbers."""
        nodes, _, size = table.shape
        above = self.node("Sub", [self._cast(x, TensorProto.DOUBLE).name, self.tensor(low, np.float64)], 2)
        place = self.node("Div", [above.name, self.tensor(step, np.float64)], 2)
        place = self.node("Clip", [place.name, *(self.tensor(end, np.float64) for end in (0, nodes - 1))], 2)
        node = self.node("Min", [self.node("Floor", [place.name], 2).name, self.tensor(nodes - 2, np.float64)], 2)
        share = self._cast(self.node("Sub", [place.name, node.name], 2), TensorProto.FLOAT)
        rest = self.combine("-", self.constant(1.0), share)
        known, first = self.tensor(table.reshape(nodes**2, size)), self._cast(node, TensorProto.INT64)
        along = self.node("Mul", [first.name, self.tensor([nodes, 1], np.int64)], 2)
        corner = self.node("ReduceSum", [along.name, self.tensor([1], np.int64)], 1, keepdims=0)  # its row in the table
        total = self.constant(0.0)
        for a, b in ((0, 0), (0, 1), (1, 0), (1, 1)):
            weight = self.combine("*", self.pick(share if a else rest, [0]), self.pick(share if b else rest, [1]))
            row = self.node("Add", [corner.name, self.tensor(a * nodes + b, np.int64)], 1)
            found = self.node("Gather", [known, row.name], size, axis=0)
            total = self.combine("+", total, self.combine("*", weight, found))
        return total

    def recall(self, name: str, start: Value) -> Value:
        """What was kept under a name in the step before: an input."""
        self.state[name] = start.size
        return self.node("Where", [BEGINS, start.name, name], start.size)

    def keep(self, name: str, x: Value) -> None:
        """Keep a vector for the next step: an output."""
        self.kept[name] = x

    def filter(self, known: KalmanFilter, x: Value, damping: Value) -> Value:
        """Refused: it needs double precision."""
        raise AgentError("cannot export an agent that sees by a Kalman filter to ONNX, in single precision: --to c has it")


def onnx_file(agent: Agent, name: str) -> bytes:
    """The model, of ``measured``, float32, shape (cars, signals), in the order and the units of its metadata, to ``damping``,
    shape (cars, 1).

    One that remembers takes ``begins`` too, bool, shape (cars, 1), true where an episode begins, and for each input ``NAME`` of
    what it remembers, shape (cars, size), gives an output ``next_NAME`` that is to be handed back with the next signals.

    Raises:
        AgentError: an agent that cannot be written here, in one line that says why.
    """
    task, writer = agent.task, OnnxGraph()
    signals = Value(MEASURED, len(task.signals))
    damping = write_through(stages_of(agent), writer, observe(task, writer, signals))
    outputs = {DAMPING: damping, **{f"next_{key}": value for key, value in writer.kept.items()}}
    ends = [helper.make_node("Identity", [value.name], [key]) for key, value in outputs.items()]

    def told(key: str, size: int, kind: int = TensorProto.FLOAT) -> Any:
        return helper.make_tensor_value_info(key, kind, ["cars", size])

    given = [told(MEASURED, signals.size), *([told(BEGINS, 1, TensorProto.BOOL)] if writer.state else [])]
    given += [told(key, size) for key, size in writer.state.items()]
    given_back = [told(key, value.size) for key, value in outputs.items()]
    graph = helper.make_graph([*writer.nodes, *ends], name, given, given_back, writer.constants)
    model = helper.make_model(
        graph,
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="roadgym",
        producer_version=roadgym.__version__,
    )
    metadata = {
        "signals": task.signals,
        "units": [unit for _, unit, _ in signal_table(task)],
        "damping_range": task.damping_range,
    }
    metadata["control_interval"] = (task.control_interval,)
    helper.set_model_props(model, {key: " ".join(map(str, values)) for key, values in metadata.items()})
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())
