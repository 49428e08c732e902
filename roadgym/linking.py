"""Machine code that was kept, brought into this process without numba, whose loading takes longer than all else."""

from __future__ import annotations

import ctypes
import functools
import math
from typing import Any

import llvmlite.binding as llvm

_engines: list[Any] = []  # they own the code


@functools.cache
def _target() -> Any:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple()


@functools.cache
def _mathematics() -> ctypes.CDLL:
    """The library of C's mathematics, as Python has loaded it."""
    return ctypes.CDLL(getattr(math, "__file__", None))


def _is_found(name: str) -> bool:
    """Does compiled code find what is called by a name?"""
    if not llvm.address_of_symbol(name):
        function = getattr(_mathematics(), name, None)
        if function is None:
            return False
        llvm.add_symbol(name, ctypes.cast(function, ctypes.c_void_p).value)
    return True


def link(name: str, needed: list[str], code: bytes) -> int:
    """The address of the function ``name`` of an object file, which calls others by the names ``needed``."""
    if not all(_is_found(each) for each in needed):
        from . import compiler

        compiler.make_ready()
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _target().create_target_machine(jit=True))
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _engines.append(engine)
    return int(engine.get_function_address(name))
