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

import ctypes
import functools
import inspect
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from .cache import Kept
from .linking import link

LANES = 64
LINE = 64  # bytes of a line of the caches

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

# what lane functions point to by the name of the parameter; all others are numbers in the precision that is asked for
KINDS: dict[str, npt.DTypeLike] = {"words": np.uint32, "order": np.int64, "seeds": np.uint64, "seen": np.float32}


class CompilationError(Exception):
    """A function is not one that can be compiled."""


class Deferred:
    """Something of numba's that is made when it is first called, or named in what is being compiled.

    Args:
        function: that it is made of.
        make: what makes it, given the module `roadgym.compiler`.
    """

    def __init__(self, function: Any, make: Callable[[Any], Any]) -> None:
        self.__doc__, self._make = function and function.__doc__, make
        self.function = function

    @functools.cached_property
    def made(self) -> Any:
        """numba's form of it."""
        from . import compiler

        return self._make(compiler)

    @property
    def _numba_type_(self) -> Any:  # numba asks for it
        from . import compiler

        return compiler.type_of(self.made)

    def __call__(self, *arguments: Any) -> Any:
        """Call it, compiled."""
        return self.made(*arguments)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.made, name)


class _Counted(Deferred):
    def __call__(self, *arguments: Any) -> Any:
        return self.function(*arguments)


def _kept(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    def decorate(function: Callable[..., Any]) -> Any:
        return Deferred(function, lambda compiler: compiler.dispatcher(function, options))

    return decorate


compiled = _kept(nogil=True)
inlined = _kept(inline="always")  # where a call would stop vectorisation


def counted(function: Callable[..., int]) -> Any:
    """A function that compiled code calls compiled, and Python as it is: it counts rows for both."""
    return _Counted(function, lambda compiler: compiler.dispatcher(function, {}))


# to call functions by their address, to go along rows by pointers, and to write past the caches: see `roadgym.compiler`
call_two: Any = Deferred(None, lambda compiler: compiler.call_two)
call: Any = Deferred(None, lambda compiler: compiler.call)
call_car: Any = Deferred(None, lambda compiler: compiler.call_car)
pointer: Any = Deferred(None, lambda compiler: compiler.pointer)
record_at: Any = Deferred(None, lambda compiler: compiler.record_at)
row_of: Any = Deferred(None, lambda compiler: compiler.row_of)
address_of: Any = Deferred(None, lambda compiler: compiler.address_of)
stream: Any = Deferred(None, lambda compiler: compiler.stream)
drain: Any = Deferred(None, lambda compiler: compiler.drain)


def like(reference: Any, value: Any) -> Any:
    """``value`` in the precision of ``reference`` (a block or a pointer to one), so that literals widen nothing."""
    return reference.dtype.type(value)


class LaneFunction:
    """A function of pointers, compiled on demand for one precision: ``words`` are 32-bit integers, all others numbers.

    Use it as a decorator. ``address(dtype)`` is what the kernel calls; it belongs to this process, so it is never stored in
    anything that is pickled. The undecorated function stays in ``function`` and accepts NumPy arrays.
    """

    def __init__(self, function: Callable[..., None]) -> None:
        self.function = function
        self.__doc__ = function.__doc__
        self._kept = Kept(function)
        self._addresses: dict[np.dtype[Any], int] = {}
        self._entries: dict[np.dtype[Any], Callable[..., None]] = {}

    def address(self, dtype: npt.DTypeLike) -> int:
        """Address of the function compiled for ``lanes`` and ``table`` of ``dtype``.

        Raises:
            CompilationError: it does not compile.
        """
        key = np.dtype(dtype)
        if key not in self._addresses:
            content = self._kept.read(key.str)
            if content is None:
                from . import compiler

                self._kept.tell()
                *code, keep = compiler.lane_code(self.function, key)
                if keep:
                    self._kept.write(key.str, pickle.dumps(code))
            else:
                code = pickle.loads(content)
            self._addresses[key] = link(*code)
        return self._addresses[key]

    def entry(self, dtype: npt.DTypeLike) -> Callable[..., None]:
        """The function for Python, which gives it addresses, and other threads their turn meanwhile."""
        key = np.dtype(dtype)
        if key not in self._entries:
            count = len(inspect.signature(self.function).parameters)
            self._entries[key] = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * count)(self.address(key))
        return self._entries[key]
