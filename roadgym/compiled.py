"""How compiled code is written here: blocks of lanes, and functions that the kernel calls by address.

A *lane* is one car on one road. Lanes are stepped in blocks of ``LANES``; a block is one flat array of numbers in which
quantity ``Q`` of lane ``i`` is ``block[Q + i]``. The row offsets below are compile-time constants, so the compiler can
prove that rows do not overlap and turns every loop over lanes into vector instructions.

The rows below are the bus over which the components of a plant talk. After them come the road's own, from COEFFICIENT on, and
after those the car's, which it alone knows.

Everything in a block is dimensionless: lengths over the road's standard deviation, time over 1/natural_frequency.

A road (or a speed noise) is a few plain functions of pointers ``(lanes, words, table)``:

- ``lanes``: one block, in single or double precision;
- ``words``: rows of random 32-bit words of this substep, word ``k`` of lane ``i`` at ``words[k * LANES + i]``;
- ``table``: constants of the road, the same for every lane.

What happens at every substep is a function of a whole block, with a loop over its lanes. What happens once an episode is a
function of one lane, ``(lane, words, table)``: its pointers begin at that lane, so that quantity ``Q`` is ``lane[Q]`` and word
``k`` is ``words[k * LANES]``.

A car's functions take ``(lanes, car, work, table)``: the block, the car's own rows of it, which begin with its states, the
numbers of this control interval, and constants; see `roadgym.cars.Car`.

`LaneFunction` compiles them and the kernel calls them through their address. That keeps one kernel for all roads, compiled
once, and lets a road live in any module. What is compiled is kept as `roadgym.cache` says.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import from_dtype, njit, types
from numba.core.ccallback import CFunc
from numba.extending import intrinsic, overload

from .cache import CodeCache

LANES = 64

SPEED = 0 * LANES  # frequency ratio nu = v * wavenumber / natural_frequency
BANDWIDTH = 1 * LANES  # damping ratio delta of the road filter
TURN = 2 * LANES  # road angle travelled in this substep, wavenumber * distance
TURN_EXCESS = 3 * LANES  # mean over the substep of the angle's path above its chord, where that is random
TURN_VARIANCE = 4 * LANES  # variance of the Brownian part of the angle in a substep
SPEED_STATE = 5 * LANES  # filtered speed noise Psi, rad
LEVEL = 6 * LANES  # Z
SLOPE = 7 * LANES  # U, with dZ/ds = wavenumber * U; zero on roads that have no slope
LEVEL_EXCESS = 8 * LANES  # mean over the substep of the level's path above its chord
RATE = 9 * LANES  # angle a unit of time now, where the speed is a number; nu without speed noise
COEFFICIENT = 10 * LANES  # first of the rows that belong to the road, ``Road.rows`` of them
OWN_ROWS = 10  # of a road, if it does not say so

# numbers of the interval that a block is in, in ``work``
SUBSTEP, INVERSE_SUBSTEP, SHARE = 0, 1, 2  # the last is the weight of this instant in the mean squares of the interval
DAMPING = 1 * LANES  # D in force
WORK = 2 * LANES  # first of the rows that belong to the car: the mean squares that it adds up itself, then ``Car.working_rows``

# "contract" alone lets a multiplication and an addition fuse; anything wider would let batch and single results differ.
_OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}}


def _kept(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """numba's decorator with a cache that knows all sources."""

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher: Any = njit(**options, **_OPTIONS)(function)
        if dispatcher is not function:  # as it is with NUMBA_DISABLE_JIT
            dispatcher._cache = CodeCache(function)
        return dispatcher

    return decorate


compiled = _kept(nogil=True)
inlined = _kept(inline="always")  # where a call would stop vectorisation


def like(reference: Any, value: Any) -> Any:
    """``value`` in the precision of ``reference`` (a block or a pointer to one), so that literals widen nothing."""
    return reference.dtype.type(value)


@overload(like, inline="always", strict=False)
def _like(reference: Any, value: Any) -> Any:
    real = reference.dtype
    return lambda reference, value: real(value)


def _code_of_call(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Code that calls the function at an address with the addresses after it."""
    pointer = ir.PointerType(ir.IntType(8))
    own = ir.FunctionType(ir.VoidType(), [pointer] * (len(arguments) - 1))
    function, *addresses = (builder.inttoptr(argument, pointer) for argument in arguments)
    builder.call(builder.bitcast(function, ir.PointerType(own)), addresses)
    return context.get_dummy_value()


def _call(typing_context: Any, address: Any, lanes: Any, words: Any, table: Any) -> Any:
    """Call the lane function at ``address`` with three addresses; all are unsigned integers."""
    return types.void(*[types.uintp] * 4), _code_of_call


def _call_car(typing_context: Any, address: Any, lanes: Any, car: Any, work: Any, table: Any) -> Any:
    """Call a car's lane function at ``address`` with four addresses; all are unsigned integers."""
    return types.void(*[types.uintp] * 5), _code_of_call


call: Any = intrinsic(_call)
call_car: Any = intrinsic(_call_car)


def _pointer(typing_context: Any, address: Any, reference: Any) -> Any:
    """A pointer to numbers at an address, of the type of ``reference``, a number or an array."""
    signature = types.CPointer(getattr(reference, "dtype", reference))(types.uintp, reference)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

    return signature, generate


pointer: Any = intrinsic(_pointer)


class LaneFunction:
    """A function of pointers, compiled on demand for one precision: ``words`` are 32-bit integers, all others numbers.

    Use it as a decorator. ``address(dtype)`` is what the kernel calls; it belongs to this process, so it is never stored in
    anything that is pickled. The undecorated function stays in ``function`` and accepts NumPy arrays.
    """

    def __init__(self, function: Callable[..., None]) -> None:
        self.function = function
        self.__doc__ = function.__doc__
        self._cache = CodeCache(function)
        self._compiled: dict[np.dtype[Any], Any] = {}

    def address(self, dtype: npt.DTypeLike) -> int:
        """Address of the function compiled for ``lanes`` and ``table`` of ``dtype``."""
        key = np.dtype(dtype)
        if key not in self._compiled:
            number = types.CPointer(from_dtype(key))
            words = types.CPointer(types.uint32)
            arguments = tuple(words if name == "words" else number for name in inspect.signature(self.function).parameters)
            callback: Any = CFunc(self.function, (arguments, types.void), locals={}, options=dict(_OPTIONS))
            callback._cache = self._cache
            callback.compile()
            self._compiled[key] = callback
        return int(self._compiled[key].address)
