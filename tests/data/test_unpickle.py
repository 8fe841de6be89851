"""The restricted unpickler: arrays and plain values pass unchanged; nothing that a file names is imported, called or trusted."""

import io
import itertools
import os
import pickle
import pickletools
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from neuspring.core.errors import InputError
from neuspring.data.unpickle import load_pickle

PLAIN = [
    {"a": np.arange(6.0).reshape(2, 3), "b": [np.float32(0.1), 2, None, True, "text", b"bytes", (1, 2.5)]},
    np.arange(24.0).reshape(2, 3, 4).transpose(1, 0, 2),
    np.arange(3, dtype=">f4"),
    np.zeros((4, 0, 3), np.float32),
    np.array(3.0),
    [{1, 2}, frozenset({3})],
    [np.float64(1.5), np.int64(-3), np.bool_(True)],
]


def write(tmp_path, data):
    path = tmp_path / "file.pkl"
    path.write_bytes(data)
    return path


def described(value):
    """A value as something that == compares in full: types, native dtypes, shapes and content."""
    if isinstance(value, (np.ndarray, np.generic)):
        return type(value), value.dtype.newbyteorder("="), value.shape, value.tolist()
    if isinstance(value, dict):
        return {key: described(item) for key, item in value.items()}
    return type(value), list(map(described, value)) if isinstance(value, (list, tuple)) else value


def test_plain_values_pass_in_every_protocol(tmp_path):
    for value, protocol in itertools.product(PLAIN, range(6)):
        data = pickle.dumps(value, protocol)
        # Protocols 0 to 3 spell sets and empty bytes as calls of builtins, which the allow-list leaves out.
        if protocol > 3 or b"builtin" not in data:
            assert described(load_pickle(write(tmp_path, data))) == described(value)


def test_both_spellings_of_numpy_core(tmp_path):
    new = pickle.dumps(np.arange(3.0), protocol=2)
    assert b"numpy._core.multiarray" in new
    old = write(tmp_path, new.replace(b"numpy._core.multiarray", b"numpy.core.multiarray"))
    np.testing.assert_array_equal(load_pickle(old), np.arange(3.0))


def test_arrays_own_their_memory_and_sharing_is_kept(tmp_path):
    shared = np.zeros(3)
    first, second = load_pickle(write(tmp_path, pickle.dumps([shared, shared])))
    first[0] = 1.0
    assert second is first


class Call:
    """Pickles to a call of `function(*arguments)`, then BUILD with the state if there is one."""

    def __init__(self, function, *arguments, state=None):
        self.reduced = (function, arguments, state)

    def __reduce__(self):
        return self.reduced


CALLS = {
    r"builtins\.eval": (eval, "open('ran', 'w')"),
    r"numpy\.save": (np.save, "ran", 1),
    r"builtins\.getattr": (getattr, "np", "save"),
    rf"{os.system.__module__}\.system": (os.system, "touch ran"),
}


def test_a_call_does_not_run_and_is_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, protocol in itertools.product(CALLS, range(6)):
        path = write(tmp_path, pickle.dumps({"object_points": Call(*CALLS[name])}, protocol))
        with pytest.raises(InputError, match=rf"file\.pkl.*global .*{name.removeprefix('builtins')}"):
            load_pickle(path)
        assert list(tmp_path.iterdir()) == [path]


def of_array(*state, code="f8", dtype_state=(3, "<", None, None, None, -1, -1, 0), kind=np.ndarray):
    """A protocol 4 pickle of an array with a chosen dtype state and array state (which gets the dtype as `...`)."""
    dtype = Call(np.dtype, code, False, True, state=dtype_state)
    filled = tuple(dtype if item is ... else item for item in state)
    stream = io.BytesIO()
    # The C pickler insists on the class of a reduced object.
    pickle._Pickler(stream, 4).dump(Call(np.array(0).__reduce__()[0], kind, (0,), b"b", state=filled))
    return stream.getvalue()


X8 = b"x" * 8
VALID = (1, (1,), ..., False, X8)
REFUSED = [
    # Every way to name a global
    (b"(ios\nsystem\n.", r"global os\.system"),
    (b"cos\nsystem\n(S'true'\ntR.", r"global os\.system"),
    (b"(cos\nsystem\nS'true'\no.", r"global os\.system"),
    (b"\x80\x02cos\nsystem\n)\x81.", r"global os\.system"),
    (b"\x80\x04\x8c\x05posix\x8c\x06system\x93\x8c\x04true\x85R.", r"global posix\.system"),
    # Opcodes that name no global
    (b"Pid\n.", "persistent id"),
    (b"NQ.", "persistent id"),
    (b"\x80\x02\x82\x01.", "extension"),
    (b"\x80\x05\x97.", "out-of-band"),
    (b"Nr" + struct.pack("<I", 0xFFFFFFFF) + b".", "memo index"),
    # Other uses of the names that are allowed
    (b"cnumpy\nndarray\n.", "received ndarray"),
    (b"cnumpy\nndarray\n(I4\ntR.", r"received ndarray with \(4,\)"),
    (b"cnumpy\nndarray\n(I4\ntR(I4\ntR.", "a call of the result of ndarray"),
    (b"cnumpy\ndtype\n}b.", r"received dtype and the state \{\}"),
    (b"c_codecs\nencode\n(Vx\nVrot13\ntR.", r"encode with \('x', 'rot13'\)"),
    (b"c_codecs\nencode\n(Vx\ntR.", r"encode with \('x',\)"),
    (b"cnumpy\ndtype\n(VO8\nI00\nI01\ntR.", "dtype with .*'O8'"),
    (b"cnumpy\ndtype\n(VV8\nI00\nI01\ntR.", "dtype with .*'V8'"),
    (b"cnumpy._core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntVb\ntR.", "_reconstruct .* and the state None"),
    # Arrays that contradict themselves
    (of_array(*VALID, code="O8"), "not plain numeric"),
    (of_array(*VALID, code="V8"), "not plain numeric"),
    (of_array(*VALID, kind=np.dtype), "received _reconstruct"),
    (of_array(1, (2**40,), ..., False, X8), "made of 8 bytes"),
    (of_array(1, (-1,), ..., False, X8), "array shape"),
    (of_array(1, (2,), ..., False, [1, 2]), "not numeric bytes"),
    (of_array(1, (1,), None, False, X8), "not numeric bytes"),
    (of_array(1, (2,), ..., False, X8, dtype_state=(3, "<", None, None, None, -1, -1)), "made of 8 bytes"),
    (of_array(*VALID, dtype_state=(3, "<", ("f8", (2,)), None, None, 16, 8, 0)), "sub-array"),
    (of_array(*VALID, dtype_state=(3, "|", None, ("a",), {"a": 1}, 8, 1, 27)), "structured"),
    (of_array(*VALID, dtype_state=(3, "!", None, None, None, -1, -1, 0)), "malformed dtype state"),
]


def test_what_is_refused_is_named(tmp_path):
    for program, reason in REFUSED:
        with pytest.raises(InputError, match=reason):
            load_pickle(write(tmp_path, program))


def test_bool_bytes_are_normalized(tmp_path):
    data = of_array(1, (3,), ..., False, b"\x00\x01\xff", code="b1", dtype_state=(3, "|", None, None, None, -1, -1, 0))
    assert load_pickle(write(tmp_path, data)).view(np.uint8).tolist() == [0, 1, 1]


def test_every_truncation_is_an_input_error(tmp_path):
    whole = pickle.dumps({"a": np.arange(3.0), "b": [1, "x"]})
    for length in range(len(whole)):
        with pytest.raises(InputError, match=r"file\.pkl"):
            load_pickle(write(tmp_path, whole[:length]))


def test_recursive_and_repeated_containers(tmp_path):
    loop = []
    loop.append(loop)
    with pytest.raises(InputError, match="RecursionError"):
        load_pickle(write(tmp_path, pickle.dumps(loop)))
    doubled = [0]
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
def test_random_bytes_raise_nothing_but_input_error(tmp_path_factory, data):
    path = write(tmp_path_factory.getbasetemp(), data + b".")
    message = str(path)
    try:
        load_pickle(path)
    except InputError as error:
        message = str(error)
    assert str(path) in message
