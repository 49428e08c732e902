"""Programs as a graph of ONNX, from what is measured to the damping ratio, for any number of cars at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

import roadgym
from roadgym.installation import needs

from ..agent import Agent
from .program import KINDS, Loop, Printer, Value, given
from .stages import observe, program_of, signal_table

with needs("onnx"):
    import onnx
    from onnx import TensorProto, helper, numpy_helper

MEASURED, DAMPING, BEGINS = "measured", "damping", "begins"
OPSET, IR_VERSION = 17, 8  # of 2022: runtimes in use read it
OPERATORS = {
    "+": "Add",
    "-": "Sub",
    "*": "Mul",
    "/": "Div",
    ">": "Greater",
    "rint": "Round",
    "matmul": "MatMul",
    **{name: name.capitalize() for name in ("abs", "and", "exp", "floor", "log", "sqrt", "tanh", "where")},
}
TYPES = {"float": TensorProto.FLOAT, "double": TensorProto.DOUBLE, "bool": TensorProto.BOOL}


class OnnxPrinter(Printer):
    """Collects nodes and constants; an array has the cars, or one for all of them, as an axis before its own.

    Attributes:
        lines: the nodes.
        constants: of the graph.
    """

    def __init__(self) -> None:
        super().__init__()
        self.constants: list[Any] = []
        self._count = 0

    def new(self) -> str:
        """A new name."""
        self._count += 1
        return f"x{self._count}"

    def tensor(self, values: npt.ArrayLike, kind: Any = np.int64) -> str:
        """The name of a new constant."""
        self.constants.append(numpy_helper.from_array(np.asarray(values, kind), self.new()))
        return str(self.constants[-1].name)

    def node(self, operator: str, *inputs: str, **attributes: Any) -> str:
        """The name of what a new node gives."""
        name = self.new()
        self.lines.append(helper.make_node(operator, list(inputs), [name], **attributes))
        return name

    def each_car(self, x: Value) -> str:
        """The name of a value; a constant once for each car."""
        if x.operation != "constant":
            return self.names[x]
        cars = self.node("Slice", self.node("Shape", MEASURED), *(self.tensor([k]) for k in (0, 1)))
        return self.node("Expand", self.names[x], self.node("Concat", cars, self.tensor(x.shape), axis=0))

    def write(self, value: Value) -> str:
        """Write a value, whose inputs are written, and return its name."""
        operation, detail = value.operation, value.detail
        inputs = [self.names[x] for x in value.inputs]
        if operation == "constant":
            return self.tensor(detail[None], KINDS[value.kind])
        if operation == "given":
            if detail != "begun":
                return str(detail)
            return self.node("Reshape", self.node("Not", BEGINS), self.tensor([-1]))
        if operation in KINDS:
            return self.node("Cast", *inputs, to=TYPES[value.kind])
        if operation in OPERATORS:
            return self.node(OPERATORS[operation], *inputs)
        if operation == "argmax":
            return self.node("Cast", self.node("ArgMax", *inputs, axis=-1, keepdims=0), to=TYPES[value.kind])
        if operation == "max":
            return self.node("ReduceMax", *inputs, axes=[-1], keepdims=0)
        if operation == "sum":
            return self.node("ReduceSum", *inputs, self.tensor([-1]), keepdims=0)
        if operation == "gather":
            return self.node("Gather", *inputs, self.tensor(detail), axis=1)
        if operation == "take":
            row = self.node("Cast", *inputs, to=TensorProto.INT64)
            return self.node("Gather", self.tensor(detail, KINDS[value.kind]), row, axis=0)
        if operation == "concat":
            return self.node("Concat", *map(self.each_car, value.inputs), axis=1)
        return self.node("Reshape", *inputs, self.tensor([-1, *value.shape]))

    def scan(self, value: Value, loop: Loop) -> list[str]:
        """Write a scan as the operator of that name."""
        inputs = [self.each_car(x) for x in value.inputs]
        steps = [] if loop.slices else [self.tensor(np.zeros((1, loop.count)))]  # which says how many there are
        held = [self.new() for _ in inputs]
        made, within = self.block(loop, held)
        results = [self.new() for _ in made]
        within = [*within, *(helper.make_node("Identity", [x], [y]) for x, y in zip(made, results, strict=True))]

        def told(names: Sequence[str], values: Sequence[Value]) -> list[Any]:
            shapes = [[None] * (1 + len(x.shape)) for x in values]
            known = zip(names, values, shapes, strict=True)
            return [helper.make_tensor_value_info(name, TYPES[x.kind], shape) for name, x, shape in known]

        given_in = told(held, [*loop.carried, *loop.slices])
        given_in += [helper.make_tensor_value_info(self.new(), TensorProto.INT64, [None]) for _ in steps]
        body = helper.make_graph(within, self.new(), given_in, told(results, [*loop.next, *loop.told]))
        names = [self.new() for _ in made]
        ones = [1] * len([*loop.slices, *steps])
        axes: dict[str, Any] = {"scan_input_axes": ones}
        if loop.told:
            axes["scan_output_axes"] = [1] * len(loop.told)
        node = helper.make_node("Scan", [*inputs, *steps], names, body=body, num_scan_inputs=len(ones), **axes)
        self.lines.append(node)
        return names


def onnx_file(agent: Agent, name: str) -> bytes:
    """The model, of ``measured``, float32, shape (cars, signals), in the order and the units of its metadata, to ``damping``,
    shape (cars, 1).

    One that remembers takes ``begins`` too, bool, shape (cars, 1), true where an episode begins, and for each input ``NAME`` of
    what it remembers, shape (cars, ...), gives an output ``next_NAME`` that is to be handed back with the next signals.

    Raises:
        AgentError: an agent that cannot be written here, in one line that says why.
    """
    task, printer = agent.task, OnnxPrinter()
    signals = given(MEASURED, (len(task.signals),))
    program = program_of(agent, observe(task, signals))
    fields = program.memory.fields
    outputs = {DAMPING: program.answer.reshape(1)}
    outputs |= zip((f"next_{key}" for key in fields), program.results[1:], strict=True)
    made = printer.write_all([*outputs.values()])
    ends = [helper.make_node("Identity", [x], [y]) for x, y in zip(made, outputs, strict=True)]

    def told(key: str, value: Value) -> Any:
        return helper.make_tensor_value_info(key, TYPES[value.kind], ["cars", *value.shape])

    inputs = {MEASURED: signals, **({BEGINS: given(BEGINS, (1,), "bool")} if fields else {}), **fields}
    graph = helper.make_graph(
        [*printer.lines, *ends],
        name,
        [told(key, value) for key, value in inputs.items()],
        [told(key, value) for key, value in outputs.items()],
        printer.constants,
    )
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
        "control_interval": (task.control_interval,),
    }
    helper.set_model_props(model, {key: " ".join(map(str, values)) for key, values in metadata.items()})
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())
