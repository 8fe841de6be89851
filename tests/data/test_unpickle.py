"""The restricted unpickler: arrays and plain values pass unchanged; nothing that a file names is imported, called or trusted."""

from __future__ import annotations

import io
import os
import pickle
import pickletools
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neuspring.core.errors import InputError
from neuspring.data.unpickle import load_pickle

PLAIN: list[Any] = [
    {"a": np.arange(6.0).reshape(2, 3), "b": [np.float32(0.1), 2, None, True, "text", b"bytes", (1, 2.5)]},
    np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    np.arange(24.0).reshape(2, 3, 4).transpose(1, 0, 2),
    np.array([[True, False]]),
    np.arange(3, dtype=">f4"),
    np.zeros((4, 0, 3), np.float32),
    np.array(3.0),
    np.array([1 + 2j]),
    [{1, 2}, frozenset({3})],
    [np.float64(1.5), np.int64(-3), np.bool_(True)],
]


def write(tmp_path: Path, data: bytes) -> Path:
    path = tmp_path / "file.pkl"
    path.write_bytes(data)
    return path


def assert_equal(left: Any, right: Any) -> None:
    if isinstance(left, (np.ndarray, np.generic)):
        assert type(left) is type(right)
        assert left.dtype == right.dtype.newbyteorder("=")
        np.testing.assert_array_equal(left, right)
    elif isinstance(left, (list, tuple)):
        assert type(left) is type(right)
        assert len(left) == len(right)
        for a, b in zip(left, right, strict=True):
            assert_equal(a, b)
    elif isinstance(left, dict):
        assert left.keys() == right.keys()
        for key in left:
            assert_equal(left[key], right[key])
    else:
        assert left == right


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("value", PLAIN, ids=range(len(PLAIN)))
def test_plain_values_pass_in_every_protocol(tmp_path: Path, value: Any, protocol: int) -> None:
    if protocol <= 2 and any(name in pickle.dumps(value, protocol) for name in (b"__builtin__", b"builtins")):
        pytest.skip("protocols 0 to 2 spell sets and empty bytes as calls of builtins, which the allow-list leaves out")
    if protocol == 3 and b"builtins" in pickle.dumps(value, protocol):
        pytest.skip("protocol 3 spells sets as calls of builtins")
    assert_equal(load_pickle(write(tmp_path, pickle.dumps(value, protocol))), value)


def test_both_spellings_of_numpy_core(tmp_path: Path) -> None:
    new = pickle.dumps(np.arange(3.0), protocol=2)
    assert b"numpy._core.multiarray" in new
    for spelling in (b"numpy._core.multiarray", b"numpy.core.multiarray"):
        np.testing.assert_array_equal(
            load_pickle(write(tmp_path, new.replace(b"numpy._core.multiarray", spelling))), np.arange(3.0)
        )


def test_arrays_own_their_memory_and_sharing_is_kept(tmp_path: Path) -> None:
    shared = np.zeros(3)
    first, second = load_pickle(write(tmp_path, pickle.dumps([shared, shared])))
    first[0] = 1.0
    assert second is first


class Call:
    """Pickles to a call of `function(*arguments)`."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return self.function, self.arguments


@pytest.mark.parametrize("protocol", range(6))
def test_a_system_call_does_not_run_and_is_named(tmp_path: Path, protocol: int) -> None:
    trace = tmp_path / "ran"
    path = write(tmp_path, pickle.dumps({"object_points": Call(os.system, f"touch {trace}")}, protocol))
    with pytest.raises(InputError, match=rf"file\.pkl.*global {os.system.__module__}\.system"):
        load_pickle(path)
    assert not trace.exists()


@pytest.mark.parametrize(
    ("function", "arguments", "name"),
    [
        (open, ("TRACE", "w"), r"open"),
        (eval, ("open('TRACE', 'w')",), r"builtins\.eval"),
        (np.save, ("TRACE", 1), r"numpy\.save"),
        (np.load, ("TRACE", None, True), r"numpy\.load"),
        (getattr, (np, "save"), r"builtins\.getattr"),
    ],
)
def test_other_calls_do_not_run(tmp_path: Path, function: Callable[..., Any], arguments: tuple[Any, ...], name: str) -> None:
    trace = tmp_path / "ran"
    filled = tuple(a.replace("TRACE", str(trace)) if isinstance(a, str) else a for a in arguments)
    if np in filled:  # a module cannot be pickled; the refusal comes first anyway
        filled = ("np", "save")
    with pytest.raises(InputError, match=name):
        load_pickle(write(tmp_path, pickle.dumps(Call(function, *filled))))
    assert not list(tmp_path.glob("ran*"))


@pytest.mark.parametrize(
    "program",
    [
        b"(ios\nsystem\n.",
        b"cos\nsystem\n(S'true'\ntR.",
        b"(cos\nsystem\nS'true'\no.",
        b"\x80\x02cos\nsystem\n)\x81.",
        b"\x80\x04\x8c\x05posix\x8c\x06system\x93\x8c\x04true\x85R.",
    ],
    ids=["INST", "REDUCE", "OBJ", "NEWOBJ", "STACK_GLOBAL"],
)
def test_every_way_to_name_a_global_is_refused(tmp_path: Path, program: bytes) -> None:
    with pytest.raises(InputError, match=r"global (os|posix)\.system"):
        load_pickle(write(tmp_path, program))


@pytest.mark.parametrize(
    ("program", "reason"),
    [
        (b"Pid\n.", "persistent id"),
        (b"N" + b"Q.", "persistent id"),
        (b"\x80\x02\x82\x01.", "extension"),
        (b"\x80\x05\x97.", "out-of-band"),
        (b"N" + b"r" + struct.pack("<I", 0xFFFFFFFF) + b".", "memo index"),
        (b"cnumpy\nndarray\n.", "bare numpy.ndarray"),
        (b"cnumpy\nndarray\n(I4\ntR.", "direct call of numpy.ndarray"),
        (b"cnumpy\ndtype\n}b.", "a state for _Global"),
        (b"c_codecs\nencode\n(Vx\nVrot13\ntR.", "encoding 'rot13'"),
        (b"c_codecs\nencode\n(Vx\ntR.", "encoding None"),
        (b"cnumpy\ndtype\n(VO8\nI00\nI01\ntR.", "object dtype"),
        (b"cnumpy\ndtype\n(VV8\nI00\nI01\ntR.", "not plain numeric"),
    ],
)
def test_other_refusals(tmp_path: Path, program: bytes, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        load_pickle(write(tmp_path, program))


OBJECTS = np.array([1, "x", None], dtype=object)
RECORDS = np.zeros(2, dtype=[("a", "f4"), ("b", "O")])
NESTED = np.zeros(2, dtype=[("a", [("b", "O", (2,))])])


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("value", [OBJECTS, RECORDS, NESTED, RECORDS.dtype, np.array(["text"])], ids=range(5))
def test_object_and_structured_dtypes_are_refused(tmp_path: Path, value: Any, protocol: int) -> None:
    with pytest.raises(InputError, match=r"file\.pkl.*dtype"):
        load_pickle(write(tmp_path, pickle.dumps(value, protocol)))


def _state(*, code: str = "f8", dtype_state: Any = (3, "<", None, None, None, -1, -1, 0), state: Any) -> bytes:
    """A protocol 4 pickle of an array with a chosen dtype state and array state (state gets the dtype as `...`)."""

    class Dtype:
        def __reduce__(self) -> Any:
            return (np.dtype, (code, False, True), dtype_state)

    class Array:
        def __reduce__(self) -> Any:
            filled = tuple(Dtype() if item is ... else item for item in state)
            return (np.array(0).__reduce__()[0], (np.ndarray, (0,), b"b"), filled)

    class Pickler(pickle._Pickler):  # the C pickler insists on the class of a reduced object
        pass

    stream = io.BytesIO()
    Pickler(stream, 4).dump(Array())
    return stream.getvalue()


def test_the_hand_made_array_is_valid(tmp_path: Path) -> None:
    data = _state(state=(1, (2,), ..., False, np.arange(2.0).tobytes()))
    np.testing.assert_array_equal(load_pickle(write(tmp_path, data)), [0.0, 1.0])


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (_state(state=(1, (2**40,), ..., False, b"x" * 8)), "made of 8 bytes"),
        (_state(state=(1, (-1,), ..., False, b"x" * 8)), "array shape"),
        (_state(state=(1, (2,), ..., False, [1, 2])), "not numeric bytes"),
        (_state(state=(1, (1,), None, False, b"x" * 8)), "not numeric bytes"),
        (_state(dtype_state=(3, "<", None, None, None, -1, -1), state=(1, (2,), ..., False, b"x" * 8)), "made of 8 bytes"),
        (_state(dtype_state=(3, "<", ("f8", (2,)), None, None, 16, 8, 0), state=(1, (1,), ..., False, b"x" * 8)), "sub-array"),
        (_state(dtype_state=(3, "|", None, ("a",), {"a": 1}, 8, 1, 27), state=(1, (1,), ..., False, b"x" * 8)), "structured"),
        (_state(dtype_state=(3, "!", None, None, None, -1, -1, 0), state=(1, (1,), ..., False, b"x" * 8)), "dtype state"),
    ],
    ids=range(8),
)
def test_inconsistent_arrays_are_refused(tmp_path: Path, data: bytes, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        load_pickle(write(tmp_path, data))


def test_bool_bytes_are_normalized(tmp_path: Path) -> None:
    data = _state(code="b1", dtype_state=(3, "|", None, None, None, -1, -1, 0), state=(1, (3,), ..., False, b"\x00\x01\xff"))
    assert load_pickle(write(tmp_path, data)).view(np.uint8).tolist() == [0, 1, 1]


def test_every_truncation_is_an_input_error(tmp_path: Path) -> None:
    whole = pickle.dumps({"a": np.arange(3.0), "b": [1, "x"]})
    for length in range(len(whole)):
        with pytest.raises(InputError, match=r"file\.pkl"):
            load_pickle(write(tmp_path, whole[:length]))


def test_missing_file_and_folder(tmp_path: Path) -> None:
    for path in (tmp_path / "absent.pkl", tmp_path):
        with pytest.raises(InputError, match=path.name):
            load_pickle(path)


def test_recursive_and_repeated_containers(tmp_path: Path) -> None:
    loop: list[Any] = []
    loop.append(loop)
    with pytest.raises(InputError, match="RecursionError"):
        load_pickle(write(tmp_path, pickle.dumps(loop)))
    doubled: list[Any] = [0]
    for _ in range(60):  # 2^60 leaves if containers were copied
        doubled = [doubled, doubled]
    assert len(load_pickle(write(tmp_path, pickle.dumps(doubled)))) == 2


WORDS = [bytes([ord(op.code)]) for op in pickletools.opcodes] + [
    b"cnumpy\ndtype\n", b"cnumpy.core.multiarray\nscalar\n", b"cnumpy.core.multiarray\n_reconstruct\n", b"cnumpy\nndarray\n",
    b"c_codecs\nencode\n", b"cnumpy.core.numeric\n_frombuffer\n", b"Vf8\n", b"VO\n", b"Vlatin1\n", b"I1\n", b"C\x08abcdefgh",
    b"cos\nsystem\n",
]  # fmt: skip


@settings(max_examples=200, deadline=None)
@given(data=st.one_of(st.binary(max_size=200), st.lists(st.sampled_from(WORDS), max_size=30).map(b"".join)))
def test_random_bytes_raise_nothing_but_input_error(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = write(tmp_path_factory.getbasetemp(), data + b".")
    message = str(path)
    try:
        load_pickle(path)
    except InputError as error:
        message = str(error)
    assert str(path) in message
