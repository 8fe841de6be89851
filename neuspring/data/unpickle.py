"""A restricted unpickler: plain values and numeric NumPy arrays, nothing else.

A pickle is a program. This one can name eight globals, and even those are stand-ins: no NumPy code sees the file's bytes
before we have checked dtype, shape and length, because `ndarray.__setstate__` and `dtype.__setstate__` trust their input.
Stand-ins become arrays and scalars after the program has ended.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import re
import reprlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from neuspring.core.errors import InputError

DTYPE_CODE = re.compile(r"[<>|=]?(b1|[iu][1248]|f[248]|c8|c16)")
"""Booleans, integers, floats, complex numbers. Objects (O), records (V) and text (S, U) are refused."""
BYTE_ORDERS = ("<", ">", "=", "|")
REFUSED_OPCODES = {
    "PERSID": "a persistent id",
    "BINPERSID": "a persistent id",
    "EXT1": "a registered extension",
    "EXT2": "a registered extension",
    "EXT4": "a registered extension",
    "NEXT_BUFFER": "an out-of-band buffer",
    "READONLY_BUFFER": "an out-of-band buffer",
}
MEMO_OPCODES = ("PUT", "BINPUT", "LONG_BINPUT")


class _Refused(pickle.UnpicklingError):
    """The pickle is well formed, but asks for something that we do not do."""


class _StandIn:
    """Base of all objects that a pickle can obtain. Without __dict__, and BUILD must not write to its slots."""

    __slots__ = ()

    def __setstate__(self, state: Any) -> None:
        raise _Refused(f"a state for {type(self).__name__}")


class _Global(_StandIn):
    """A name of the allow-list. Calling it calls our own constructor."""

    __slots__ = ("_call", "name")

    def __init__(self, name: str, call: Callable[..., Any]) -> None:
        self.name, self._call = name, call

    def __call__(self, *args: Any) -> Any:
        return self._call(*args)


class _Dtype(_StandIn):
    """Stands for `numpy.dtype(code, align, copy)`, followed by a state that may only set the byte order."""

    __slots__ = ("value",)

    def __init__(self, code: Any, *_flags: Any) -> None:
        if not isinstance(code, str) or not DTYPE_CODE.fullmatch(code):
            kind = "an object dtype" if str(code).lstrip("<>|=").startswith("O") else "a dtype that is not plain numeric"
            raise _Refused(f"{kind}, numpy.dtype({reprlib.repr(code)})")
        self.value = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) < 5 or state[1] not in BYTE_ORDERS:
            raise _Refused("a malformed dtype state")
        _version, order, subarray, names, fields = state[:5]
        if subarray is not None or names is not None or fields is not None:
            raise _Refused("a structured or sub-array dtype")
        if order in "<>":
            self.value = self.value.newbyteorder(order)


class _Value(_StandIn):
    """A finished array or scalar. Wrapped until the program ends, so that BUILD cannot reach NumPy's own __setstate__."""

    __slots__ = ("value",)

    def __init__(self, value: Any) -> None:
        self.value = value


class _Array(_StandIn):
    """Stands for `_reconstruct(ndarray, (0,), b'b')`; its state brings shape, dtype, order and bytes."""

    __slots__ = ("value",)

    def __init__(self, kind: Any, _shape: Any, _code: Any) -> None:
        if kind is not NDARRAY:
            raise _Refused("an array of another class than numpy.ndarray")
        self.value: np.ndarray | None = None

    def __setstate__(self, state: Any) -> None:
        if not isinstance(state, tuple) or len(state) != 5:
            raise _Refused("a malformed array state")
        _version, shape, dtype, fortran, data = state
        self.value = _array(data, dtype, shape, "F" if fortran else "C")


def _array(data: Any, dtype: Any, shape: Any, order: str) -> np.ndarray:
    """Bytes -> a native array that owns its memory, after checking that dtype and shape account for every byte."""
    if not isinstance(dtype, _Dtype) or not isinstance(data, (bytes, bytearray)):
        raise _Refused("array content that is not numeric bytes")
    if not isinstance(shape, tuple) or not all(type(size) is int and size >= 0 for size in shape):
        raise _Refused(f"the array shape {reprlib.repr(shape)}")
    wanted = math.prod(shape) * dtype.value.itemsize
    if wanted != len(data):
        raise _Refused(f"an array of shape {shape} and dtype {dtype.value} ({wanted} bytes) made of {len(data)} bytes")
    if dtype.value.kind == "b":  # A byte other than 0 or 1 is not a valid bool in memory.
        flags: np.ndarray = np.frombuffer(data, np.uint8).reshape(shape, order=order) != 0  # type: ignore[call-overload]
        return flags
    native = dtype.value.newbyteorder("=")
    result: np.ndarray = np.frombuffer(data, dtype.value).astype(native).reshape(shape, order=order)  # type: ignore[call-overload]
    return result


def _from_buffer(data: Any, dtype: Any, shape: Any, order: Any, axes: Any = None) -> _Value:
    if order == "K" and axes is not None:
        return _Value(_array(data, dtype, shape, "C").transpose(axes))
    if order not in ("C", "F"):
        raise _Refused(f"the array order {reprlib.repr(order)}")
    return _Value(_array(data, dtype, shape, order))


def _scalar(dtype: Any, data: Any) -> _Value:
    return _Value(_array(data, dtype, (), "C")[()])


def _encode(text: Any, encoding: Any = None) -> bytes:
    """Old protocols spell bytes as text; only the encoding that pickle itself uses is accepted."""
    if encoding != "latin1" or not isinstance(text, str):
        raise _Refused(f"_codecs.encode with encoding {reprlib.repr(encoding)}")
    return text.encode("latin1")


def _no_call(*_args: Any) -> NoReturn:
    raise _Refused("a direct call of numpy.ndarray")


NDARRAY = _Global("numpy.ndarray", _no_call)
ALLOWED: dict[tuple[str, str], _Global] = {
    ("numpy", "ndarray"): NDARRAY,
    ("numpy", "dtype"): _Global("numpy.dtype", _Dtype),
    ("_codecs", "encode"): _Global("_codecs.encode", _encode),
}
for _core in ("numpy.core", "numpy._core"):  # NumPy 1 and 2
    ALLOWED[f"{_core}.multiarray", "_reconstruct"] = _Global("_reconstruct", _Array)
    ALLOWED[f"{_core}.multiarray", "scalar"] = _Global("scalar", _scalar)
    ALLOWED[f"{_core}.numeric", "_frombuffer"] = _Global("_frombuffer", _from_buffer)


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        try:
            return ALLOWED[module, name]
        except KeyError:
            raise _Refused(f"the global {module}.{name}") from None


def load_pickle(path: Path) -> Any:
    """Read a pickle of plain values (numbers, text, lists, tuples, dicts, sets) and numeric NumPy arrays and scalars.

    Arrays come back native-endian and owning their memory. Raises InputError, naming the file and what was refused, for every
    other content and for files that cannot be read; nothing that the file names is imported or called.
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
        rule = "a pickle may hold plain values and numeric NumPy arrays only"
        raise InputError(path, rule, str(error), "Nothing in it was run; get the file from its original source.") from error
    except Exception as error:  # The pickle documentation: damaged data may raise any exception.
        raise InputError(
            path, "this file must be a complete pickle", f"{type(error).__name__}: {error}", "Copy it again."
        ) from error


def _scan(data: bytes) -> None:
    """Refuse opcodes that `find_class` does not see, and memo indices that would make the C unpickler allocate gigabytes."""
    for count, (opcode, argument, _position) in enumerate(pickletools.genops(data)):
        if opcode.name in REFUSED_OPCODES:
            raise _Refused(REFUSED_OPCODES[opcode.name])
        if opcode.name in MEMO_OPCODES and not (isinstance(argument, int) and 0 <= argument <= count):
            raise _Refused(f"memo index {argument} in operation {count}")


def _finished(value: Any, done: dict[int, Any]) -> Any:
    """`value` with stand-ins replaced. `done` maps id -> result, so shared containers stay shared and cost once."""
    if value is None or isinstance(value, (bool, int, float, complex, str, bytes, bytearray)):
        return value
    if id(value) in done:
        return done[id(value)]
    if isinstance(value, (_Value, _Array)):
        if value.value is None:
            raise _Refused("an array without content")
        result = value.value
    elif isinstance(value, dict):
        result = {_finished(key, done): _finished(item, done) for key, item in value.items()}
    elif isinstance(value, (list, tuple, set, frozenset)):
        result = type(value)(_finished(item, done) for item in value)
    else:
        raise _Refused(f"a bare {getattr(value, 'name', type(value).__name__)}")
    done[id(value)] = result
    return result
