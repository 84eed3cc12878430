"""Pickled metadata: harmless files are read as by Python's own unpickler, and everything else is refused."""

import datetime
import pickle
import struct
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tumble.datasets import _unpickle
from tumble.io.files import BadFile

PYTHON_2 = {
    "protocol 0": b"""(dp0
S'objRot'
p1
cnumpy.core.multiarray
_reconstruct
p2
(cnumpy
ndarray
p3
(I0
tp4
S'b'
p5
tp6
Rp7
(I1
(I2
I1
tp8
cnumpy
dtype
p9
(S'f8'
p10
I0
I1
tp11
Rp12
(I3
S'<'
p13
NNNI-1
I-1
I0
tp14
bI00
S'\\x00\\x00\\x00\\x00\\x00\\x00\\xf0?\\x00\\x00\\x00\\x00\\x00\\x00\\x00\\xc0'
p15
tp16
bsS'objName'
p17
S'021_bleach'
p18
sS'objLabel'
p19
I5
sS'again'
p20
g7
s.""",
    "protocol 2": b"\x80\x02}q\x00(U\x06objRotq\x01cnumpy.core.multiarray\n_reconstruct\nq\x02cnumpy\nndarray\n"
    b"q\x03K\x00\x85U\x01bq\x04\x87Rq\x05(K\x01K\x02K\x01\x86cnumpy\ndtype\nq\x06U\x02f8q\x07K\x00K\x01\x87Rq\x08(K\x03U\x01<q\x09NNN"
    b"J\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89U\x10\x00\x00\x00\x00\x00\x00\xf0?\x00\x00\x00\x00\x00\x00\x00\xc0tb"
    b"U\x07objNameq\x0aU\x0a021_bleachq\x0bU\x08objLabelq\x0cK\x05U\x05againq\x0dh\x05u.",
}
"""Dictionaries as written by Python 2 and its numpy, with an array that occurs twice."""
DTYPES = {"<f8": np.float64, ">f4": ">f4", "i8": np.int64, "u1": np.uint8, "?": np.bool_, "i2": np.int16}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "0000.pkl"


def read(file: Path, program: bytes) -> Any:
    file.write_bytes(program)
    return _unpickle.read(file)


def assert_same(a: Any, b: Any) -> None:
    assert type(a) is type(b)
    if isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    elif isinstance(a, dict):
        assert list(a) == list(b)
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, list | tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    else:
        assert a == b


@pytest.mark.parametrize("name", PYTHON_2)
def test_files_of_python_2_are_read_as_by_pickle(name: str, file: Path) -> None:
    value = read(file, PYTHON_2[name])
    with pytest.MonkeyPatch.context() as patch:
        import warnings

        # numpy warns that numpy.core is now called numpy._core.
        patch.setattr(warnings, "warn", lambda *_, **__: None)
        assert_same(value, pickle.loads(PYTHON_2[name], encoding="latin1"))
    assert value["objRot"].tolist() == [[1.0], [-2.0]]
    assert value["again"] is value["objRot"]


@pytest.mark.parametrize("protocol", range(5))
@pytest.mark.parametrize("dtype", DTYPES)
def test_arrays_are_read_at_every_protocol(dtype: str, protocol: int, file: Path) -> None:
    values = np.arange(24).reshape(2, 3, 4).astype(DTYPES[dtype])
    arrays = [values, np.asfortranarray(values), values[:0], np.array(values[0, 0, 0]), values[:, ::2]]
    for array_read, array in zip(read(file, pickle.dumps(arrays, protocol)), arrays, strict=True):
        np.testing.assert_array_equal(array_read, array)
        assert array_read.dtype == array.dtype


plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text() | st.binary(max_size=20),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.text() | st.integers(), inner, max_size=4)
        | st.tuples(inner, inner)
        | st.tuples(inner, inner, inner, inner)
    ),
    max_leaves=20,
)


@settings(deadline=None)
@given(value=plain, protocol=st.integers(0, 4))
def test_plain_data_is_read_unchanged(value: Any, protocol: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    file = tmp_path_factory.getbasetemp() / "plain.pkl"
    assert_same(read(file, pickle.dumps(value, protocol)), value)


def test_numpy_scalars_become_python_numbers(file: Path) -> None:
    value = read(file, pickle.dumps([np.float32(0.5), np.int64(-3), np.bool_(True)], 2))
    assert_same(value, [0.5, -3, True])


class Malicious:
    """An object that executes code when it is unpickled."""

    def __reduce__(self) -> tuple:
        return (Path.touch, (Path("harm"),))


@pytest.mark.parametrize("protocol", range(5))
@pytest.mark.parametrize(
    "value",
    [
        Malicious(),
        [1, {"x": Malicious()}],
        datetime.date(2020, 1, 1),
        OrderedDict(a=1),
        {1, 2},
        complex(1, 2),
        np.array([None, "x"], object),
        np.array(["text"]),
        np.zeros(2, [("a", "f8")]),
        np.dtype("f8"),
        np.ndarray,
        {(1, 2): 3},
    ],
    ids=lambda value: type(value).__name__,
)
def test_anything_but_plain_data_is_refused(value: Any, protocol: int, file: Path) -> None:
    with pytest.raises(BadFile, match=r"0000\.pkl: cannot be read as pickled metadata.*only numbers, strings"):
        read(file, pickle.dumps(value, protocol))
    assert not Path("harm").exists()


MALICIOUS = {
    "a command": b"cos\nsystem\n(S'touch harm'\ntR.",
    "a command by object": b"(cos\nsystem\nS'touch harm'\no.",
    "a command by instance": b"(S'touch harm'\nios\nsystem\n.",
    "a module by stack": b"\x8c\x08builtins\x8c\x04eval\x93(S'1'\ntR.",
    "an attribute of a known name": b"cnumpy\nndarray.tofile\n.",
    "state for a name": b"cnumpy\nndarray\n(dS'x'\nI1\nstb.",
    "a huge index of the memo": b"Nr\xff\xff\xff\x7f0.",
    "a string longer than the file": b"\x8e" + struct.pack("<Q", 1 << 60) + b"x.",
    "no end": b"(lp0\n",
    "an empty stack": b"a.",
    "a mark as a value": b"](a.",
    "an unknown index of the memo": b"h\x07.",
    "no pickle": b"hello",
    "nothing": b"",
    "an array of pointers": b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntS'b'\ntR(I1\n(I1\nt"
    b"cnumpy\ndtype\n(S'O8'\nI0\nI1\ntR(I3\nS'|'\nNNNI-1\nI-1\nI0\ntbI00\nS'AAAAAAAA'\ntb.",
    "an array without numbers": b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntS'b'\ntR.",
    "a key that holds itself many times": b"})" + 60 * b"q\x00h\x00\x86" + b"Ns.",
}


@pytest.mark.parametrize("name", MALICIOUS)
def test_malicious_programs_are_refused_without_effect(
    name: str, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(BadFile, match=r"0000\.pkl"):
        read(file, MALICIOUS[name])
    assert [path.name for path in tmp_path.iterdir()] == [file.name]


def test_the_shape_of_an_array_must_match_its_values(file: Path) -> None:
    program = PYTHON_2["protocol 2"]
    assert program.count(b"(K\x01K\x02K\x01\x86") == 1
    for shape in (b"K\x02K\x02", b"K\x01K\x01", b"J\xff\xff\xff\xffK\x01", b"U\x012K\x01"):
        with pytest.raises(BadFile, match="shape"):
            read(file, program.replace(b"K\x02K\x01\x86", shape + b"\x86"))


def test_a_string_cannot_be_used_for_unlimited_arrays(file: Path) -> None:
    """Half a megabyte in the file, converted to an array a hundred times."""
    encode = b"c_codecs\nencode\nh\x01\x8c\x06latin1\x86Rq\x02"
    program = b"\x80\x04](X" + struct.pack("<I", 1 << 19) + b"0" * (1 << 19) + b"q\x01" + 100 * encode + b"e."
    with pytest.raises(BadFile, match="more than"):
        read(file, program)


def test_missing_and_too_large_files_are_refused(file: Path) -> None:
    with pytest.raises(BadFile, match="is missing"):
        _unpickle.read(file)
    with pytest.raises(BadFile, match=r"over the limit of 1048576"):
        read(file, pickle.dumps(b"0" * _unpickle.MAX_BYTES, 4))
