"""A restricted unpickler for plain values and numeric NumPy arrays.

A pickle is a program. This unpickler accepts only the globals in `ALLOWED`, and replaces them by stand-ins that record how they are
called. After the program has ended, the records become arrays and scalars. NumPy therefore receives no bytes of the file before
dtype, shape and length are checked; `ndarray.__setstate__` and `dtype.__setstate__` trust their input.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import re
import reprlib
from pathlib import Path
from typing import Any, Literal

import numpy as np

from neuspring.core.errors import InputError

DTYPE_CODE = re.compile(r"[<>|=]?(b1|[iu][1248]|f[248]|c8|c16)")
"""Booleans, integers, floats, complex numbers. Objects (O), records (V) and text (S, U) are refused."""
REFUSED_OPCODES = {
    **dict.fromkeys(("PERSID", "BINPERSID"), "a persistent id"),
    **dict.fromkeys(("EXT1", "EXT2", "EXT4"), "a registered extension"),
    **dict.fromkeys(("NEXT_BUFFER", "READONLY_BUFFER"), "an out-of-band buffer"),
}
MEMO_OPCODES = ("PUT", "BINPUT", "LONG_BINPUT")


class _Refused(pickle.UnpicklingError):
    """The pickle is well formed, but contains something that is not allowed."""


class _StandIn:
    """An allowed global, or a call of it, with its arguments (None: not called) and the state that BUILD assigns.

    It has no __dict__, and BUILD cannot write to its slots.
    """

    __slots__ = ("args", "name", "state")

    def __init__(self, name: str, args: tuple[Any, ...] | None = None) -> None:
        self.name, self.args, self.state = name, args, None

    def __call__(self, *args: Any) -> _StandIn:
        if self.args is not None:
            raise _Refused(f"a call of the result of {self.name}")
        return _StandIn(self.name, args)

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def made(self) -> Any:
        """The array, scalar or bytes that this call stands for."""
        match self.name, self.args, self.state:
            case "_reconstruct", (_StandIn(name="ndarray", args=None), _, _), (_version, shape, dtype, fortran, data):
                return _array(data, dtype, shape, "F" if fortran else "C")
            case "_frombuffer", (data, dtype, shape, "C" | "F" as order) | (data, dtype, shape, "C" | "F" as order, _), None:
                return _array(data, dtype, shape, order)
            case "_frombuffer", (data, dtype, shape, "K", tuple(axes)), None:
                return _array(data, dtype, shape, "C").transpose(axes)
            case "scalar", (dtype, data), None:
                return _array(data, dtype, (), "C")[()]
            # Old protocols store bytes as text; only pickle's own encoding is accepted.
            case "encode", (str(text), "latin1"), None:
                return text.encode("latin1")
        with_what = "" if self.args is None else f" with {reprlib.repr(self.args)}"
        raise _Refused(f"{self.name}{with_what} and the state {reprlib.repr(self.state)}")


def _dtype(value: Any) -> np.dtype[Any]:
    """`numpy.dtype(code, align, copy)`, followed by a state that may only set the byte order."""
    match value:
        case _StandIn(name="dtype", args=(str(code), *_)) if DTYPE_CODE.fullmatch(code):
            dtype = np.dtype(code)
        case _StandIn(name="dtype", args=args):
            raise _Refused(f"a dtype that is not plain numeric, numpy.dtype{reprlib.repr(args)}")
        case _:
            raise _Refused("array content that is not numeric bytes")
    match value.state:
        case None | (_, "=" | "|", None, None, None, *_):
            return dtype
        case (_, "<" | ">" as order, None, None, None, *_):
            return dtype.newbyteorder(order)
    raise _Refused(f"a structured, sub-array or malformed dtype state {reprlib.repr(value.state)}")


def _array(data: Any, dtype: Any, shape: Any, order: Literal["C", "F"]) -> np.ndarray:
    """Bytes -> a native array that owns its memory, after checking that dtype and shape account for every byte."""
    kind, content = _dtype(dtype), data.made() if isinstance(data, _StandIn) else data
    if not isinstance(content, (bytes, bytearray)):
        raise _Refused("array content that is not numeric bytes")
    if not isinstance(shape, tuple) or not all(type(size) is int and size >= 0 for size in shape):
        raise _Refused(f"the array shape {reprlib.repr(shape)}")
    wanted = math.prod(shape) * kind.itemsize
    if wanted != len(content):
        raise _Refused(f"an array of shape {shape} and dtype {kind} ({wanted} bytes) made of {len(content)} bytes")
    # A byte other than 0 or 1 is not a valid bool in memory.
    native = kind.newbyteorder("=")
    flat = np.frombuffer(content, np.uint8) != 0 if kind.kind == "b" else np.frombuffer(content, kind).astype(native)
    result: np.ndarray = flat.reshape(shape, order=order)
    return result


ALLOWED = {("numpy", "ndarray"), ("numpy", "dtype"), ("_codecs", "encode")} | {
    (f"{core}.{module}", name)
    for core in ("numpy.core", "numpy._core")  # NumPy 1 and 2
    for module, name in (("multiarray", "_reconstruct"), ("multiarray", "scalar"), ("numeric", "_frombuffer"))
}


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> _StandIn:
        if (module, name) not in ALLOWED:
            raise _Refused(f"the global {module}.{name}")
        return _StandIn(name)


def load_pickle(path: Path) -> Any:
    """Read a pickle of plain values (numbers, text, lists, tuples, dicts, sets) and numeric NumPy arrays and scalars.

    Arrays are native-endian and own their memory. Raises InputError with the file and the refused content, also for unreadable
    files. Nothing that the file names is imported or called.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(path, "this pickle must be readable", error.strerror) from error
    try:
        _scan(data)
        return _finished(_Unpickler(io.BytesIO(data)).load(), {})
    except _Refused as error:
        rule = "a pickle may contain only plain values and numeric NumPy arrays"
        raise InputError(path, rule, str(error), "No code of it was run. Get the file from its original source.") from error
    except Exception as error:  # The pickle documentation: damaged data may raise any exception.
        received = f"{type(error).__name__}: {error}"
        raise InputError(path, "this file must be a complete pickle", received, "Copy it again.") from error


def _scan(data: bytes) -> None:
    """Refuse opcodes that `find_class` does not see, and memo indices that would make the C unpickler allocate gigabytes."""
    for count, (opcode, argument, _position) in enumerate(pickletools.genops(data)):
        if opcode.name in REFUSED_OPCODES:
            raise _Refused(REFUSED_OPCODES[opcode.name])
        if opcode.name in MEMO_OPCODES and not (isinstance(argument, int) and 0 <= argument <= count):
            raise _Refused(f"memo index {argument} in operation {count}")


def _finished(value: Any, done: dict[int, Any]) -> Any:
    """`value` with stand-ins replaced. `done` maps id -> result: shared containers stay shared and are converted once."""
    if value is None or isinstance(value, (bool, int, float, complex, str, bytes, bytearray)):
        return value
    if id(value) in done:
        return done[id(value)]
    if isinstance(value, _StandIn):
        result = value.made()
    elif isinstance(value, dict):
        result = {_finished(key, done): _finished(item, done) for key, item in value.items()}
    elif isinstance(value, (list, tuple, set, frozenset)):
        result = type(value)(_finished(item, done) for item in value)
    else:
        raise _Refused(f"a bare {type(value).__name__}")
    done[id(value)] = result
    return result
