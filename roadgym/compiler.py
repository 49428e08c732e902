"""numba's side of `roadgym.compiled`, loaded only where something is not compiled yet, since to load numba takes its time."""

from __future__ import annotations

import inspect
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import from_dtype, njit, types
from numba.core import serialize
from numba.core.caching import NullCache
from numba.core.ccallback import CFunc
from numba.core.compiler import CompileResult
from numba.core.compiler_lock import global_compiler_lock
from numba.core.errors import NumbaError
from numba.core.registry import cpu_target
from numba.extending import intrinsic, overload

from .cache import Kept
from .compiled import KINDS, LANES, LINE, CompilationError, like

# "contract" alone lets a multiplication and an addition fuse; anything wider would let batch and single results differ.
OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}}


class CodeCache(NullCache):
    """Keeps the compiled code of one function; numba asks it in place of the cache that ``cache=True`` would make."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._kept = Kept(function)

    @property
    def cache_path(self) -> str | None:
        """The folder of this function's code."""
        return None if self._kept.folder is None else str(self._kept.folder)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The code for a signature, or None."""
        target_context.refresh()
        content = self._kept.read(repr(sig))
        return None if content is None else CompileResult._rebuild(target_context, *pickle.loads(content))

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the code for a signature where that is possible."""
        if not data.library.has_dynamic_globals and all(lifted.can_cache for lifted in data.lifted):
            self._kept.write(repr(sig), serialize.dumps(data._reduce()))


def dispatcher(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    """numba's form of a function, with a cache that knows all sources."""
    made: Any = njit(**options, **OPTIONS)(function)
    if made is not function:  # as it is with NUMBA_DISABLE_JIT
        made._cache = CodeCache(function)
    return made


def type_of(value: Any) -> Any:
    """What numba takes ``value`` for where compiled code names it."""
    return cpu_target.typing_context.resolve_value_type(value)


@overload(like, inline="always", strict=False)
def _like(reference: Any, value: Any) -> Any:
    real = reference.dtype
    return lambda reference, value: real(value)


def _code_of_call(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Code that calls the function at an address with the addresses after it."""
    place = ir.PointerType(ir.IntType(8))
    own = ir.FunctionType(ir.VoidType(), [place] * (len(arguments) - 1))
    function, *addresses = (builder.inttoptr(argument, place) for argument in arguments)
    builder.call(builder.bitcast(function, ir.PointerType(own)), addresses)
    return context.get_dummy_value()


@intrinsic
def call_two(typing_context: Any, address: Any, lanes: Any, other: Any) -> Any:
    """Call the lane function at ``address`` with two addresses; all are unsigned integers."""
    return types.void(*[types.uintp] * 3), _code_of_call


@intrinsic
def call(typing_context: Any, address: Any, lanes: Any, words: Any, table: Any) -> Any:
    """Call the lane function at ``address`` with three addresses; all are unsigned integers."""
    return types.void(*[types.uintp] * 4), _code_of_call


@intrinsic
def call_car(typing_context: Any, address: Any, lanes: Any, car: Any, work: Any, table: Any) -> Any:
    """Call a car's lane function at ``address`` with four addresses; all are unsigned integers."""
    return types.void(*[types.uintp] * 5), _code_of_call


@intrinsic
def pointer(typing_context: Any, address: Any, reference: Any) -> Any:
    """A pointer to numbers at an address, of the type of ``reference``, a number, an array or a pointer."""
    signature = types.CPointer(getattr(reference, "dtype", reference))(types.uintp, reference)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

    return signature, generate


@intrinsic
def record_at(typing_context: Any, address: Any, dtype: Any) -> Any:
    """The record of ``dtype`` at an address."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

    return dtype.dtype(types.uintp, dtype), generate


@intrinsic
def row_of(typing_context: Any, block: Any, offset: Any) -> Any:
    """A pointer ``offset`` numbers behind another.

    Name it before a loop that writes there: numba takes what a function returns for memory of its own, and drops a write to it
    that nothing can read again.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.gep(arguments[0], [arguments[1]])

    return block(block, types.intp), generate


@intrinsic
def address_of(typing_context: Any, block: Any) -> Any:
    """The address that a pointer holds."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.ptrtoint(arguments[0], context.get_value_type(types.uintp))

    return types.uintp(block), generate


@intrinsic
def stream(typing_context: Any, source: Any, target: Any, unit: Any) -> Any:
    """Write LANES numbers, times a unit, as 64-bit ones past the caches, to a place at a multiple of 64 bytes; see `drain`.

    What is seldom read does not push out what is: and a line that is written whole need not be fetched first.
    """
    signature = types.void(source, target, types.float64)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        (source, target, unit), width = arguments, LINE // 8
        kind, index = ir.DoubleType(), ir.IntType(64)
        whole = ir.VectorType(kind, width)
        units = ir.Constant(whole, ir.Undefined)
        for k in range(width):
            units = builder.insert_element(units, unit, ir.Constant(ir.IntType(32), k))
        past = builder.module.add_metadata([ir.Constant(ir.IntType(32), 1)])
        for k in range(0, LANES, width):
            own, place = (builder.gep(each, [ir.Constant(index, k)]) for each in (source, target))
            number = source.type.pointee
            numbers = builder.load(builder.bitcast(own, ir.VectorType(number, width).as_pointer()), align=4)
            if number != kind:
                numbers = builder.fpext(numbers, whole)
            written = builder.store(builder.fmul(numbers, units), builder.bitcast(place, whole.as_pointer()), align=LINE)
            written.set_metadata("nontemporal", past)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
def drain(typing_context: Any) -> Any:
    """Let all that was written by `stream` be there for other threads."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.fence("seq_cst")
        return context.get_dummy_value()

    return types.void(), generate


def make_ready() -> None:
    """Let compiled code find what numba has for it."""
    cpu_target.target_context.refresh()


@global_compiler_lock
def lane_code(function: Callable[..., None], dtype: np.dtype[Any]) -> tuple[str, list[str], bytes, bool]:
    """A lane function in machine code for one precision: its name, what it calls by name, an object file, and is it to be kept.

    Raises:
        CompilationError: numba does not take it.
    """
    number = types.CPointer(from_dtype(dtype))
    fixed = {name: types.CPointer(from_dtype(np.dtype(kind))) for name, kind in KINDS.items()}
    arguments = tuple(fixed.get(name, number) for name in inspect.signature(function).parameters)
    try:
        callback: Any = CFunc(function, (arguments, types.void), locals={}, options=dict(OPTIONS))
        made = callback._compile_uncached()
    except NumbaError as error:
        raise CompilationError(str(error)) from error
    # numba's own wrapper would tell Python of errors, and so need Python, and numba; a lane function has none
    context, name = made.target_context, f"lane.{made.fndesc.llvm_func_name}"
    module = context.create_module("lane")
    values = [context.get_value_type(kind) for kind in arguments]
    callee = ir.Function(module, context.call_conv.get_function_type(types.void, arguments), made.fndesc.llvm_func_name)
    builder = ir.IRBuilder(ir.Function(module, ir.FunctionType(ir.VoidType(), values), name).append_basic_block())
    context.call_conv.call_function(builder, callee, types.void, arguments, builder.function.args)
    builder.ret_void()
    library = context.codegen().create_library(name)
    library.add_linking_library(made.library)
    library.add_ir_module(module)
    library.finalize()
    final = library._final_module
    names = [each.name for each in (*final.functions, *final.global_variables) if each.is_declaration]
    needed = [each for each in names if not each.startswith("llvm.")]
    return name, needed, context.codegen()._tm.emit_object(final), not made.library.has_dynamic_globals
