"""Pickled metadata, read without running it.

A pickle is a program for a stack machine, and a foreign one may do anything. The machine here knows the instructions
that make numbers, strings, lists, tuples, dictionaries and numpy arrays of numbers, and refuses all others. A name in
the file selects one of the `MEANINGS` below; nothing that a file names is ever imported or called. Byte strings of
Python 2 come back as text (Latin-1), numpy's single numbers as Python's.
"""

import codecs
import io
import math
import pickletools
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tumble.io import BadFile

MAX_BYTES = 1 << 20
"""Largest file read, and most bytes of arrays made from it: one frame's metadata has about ten kilobytes."""
MEANINGS = {
    "numpy ndarray": "ndarray",
    "numpy dtype": "dtype",
    **{f"numpy.{core}.multiarray _reconstruct": "array" for core in ("core", "_core")},
    **{f"numpy.{core}.multiarray scalar": "scalar" for core in ("core", "_core")},
    "_codecs encode": "encode",
    "__builtin__ bytes": "bytes",
    "builtins bytes": "bytes",
}
"""What the module and name of a pickle stand for."""
NUMBERS = re.compile(r"b1|[iu][1248]|f[248]")
"""Element types of arrays: truth values, integers and floats."""
LITERALS = {
    *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "FLOAT", "BINFLOAT", "STRING", "BINSTRING"),
    *("SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINBYTES", "SHORT_BINBYTES"),
}
INSTRUCTIONS = {instruction.code: instruction for instruction in pickletools.opcodes}
CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}


def read(path: Path) -> Any:
    """The data in a pickle file.

    Raises:
        BadFile: It is missing, larger than `MAX_BYTES`, broken, or holds anything but plain data.
    """
    if not path.is_file():
        raise BadFile(path, "is missing" if not path.exists() else "is not a file")
    if path.stat().st_size > MAX_BYTES:
        raise BadFile(path, f"has {path.stat().st_size} bytes, over the limit of {MAX_BYTES} for metadata")
    try:
        return _run(path.read_bytes())
    except (ValueError, TypeError, LookupError, OverflowError, struct.error) as error:
        fix = "only numbers, strings, lists, dictionaries and arrays of numbers are read"
        raise BadFile(path, f"cannot be read as pickled metadata: {error}", fix) from None


# The machine ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Name:
    """A module and name of the file, by its meaning."""

    meaning: str


@dataclass(frozen=True)
class _Unbuilt:
    """An array or an element type that still waits for its state."""

    kind: str
    type: str = ""
    memo: list[int] = field(default_factory=list)
    """Where the memo holds it."""


class _Arguments(tuple):
    """A tuple that holds what is no data: good only for a call."""


NOT_DATA = (_Name, _Unbuilt, _Arguments, np.dtype)
MARK = object()


@dataclass
class _Machine:
    """Stack, memo and budget of one program; every instruction changes them."""

    stack: list[Any] = field(default_factory=list)
    memo: dict[int, Any] = field(default_factory=dict)
    budget: int = 2 * MAX_BYTES
    """Bytes left for arrays; Python 3 writes those as text that becomes bytes that become an array."""

    def pop(self, *kinds: type) -> Any:
        value = self.stack.pop()
        if value is MARK or (kinds and not isinstance(value, kinds)):
            raise ValueError(f"an instruction finds a {type(value).__name__} on the stack")
        return value

    def pop_to_mark(self) -> list[Any]:
        values = []
        while (value := self.stack.pop()) is not MARK:
            values.append(value)
        return values[::-1]

    def remember(self, number: int) -> None:
        value = self.stack[-1]
        self.memo[number] = value
        if isinstance(value, _Unbuilt):
            value.memo.append(number)

    def spend(self, text: Any) -> bytes:
        """Bytes of an array, from a string of Python 3 or 2; the same string may be used many times."""
        if not isinstance(text, bytes | str):
            raise ValueError("an array of objects")
        self.budget -= len(text)
        if self.budget < 0:
            raise ValueError(f"arrays of more than {MAX_BYTES} bytes")
        return text if isinstance(text, bytes) else text.encode("latin-1")


def _run(program: bytes) -> Any:
    machine = _Machine()
    for name, argument in _instructions(io.BytesIO(program)):
        if name == "STOP":
            return _data(machine.pop())
        _execute(machine, name, argument)
    raise ValueError("it ends too early")


def _instructions(stream: io.BytesIO) -> Iterator[tuple[str, Any]]:
    while code := stream.read(1):
        known = INSTRUCTIONS.get(code.decode("latin-1"))
        if known is None:
            raise ValueError(f"no instruction {code!r}")
        if known.name == "STRING":
            # pickletools takes these for ASCII; Python 2 wrote the bytes of arrays so.
            yield known.name, codecs.escape_decode(stream.readline().strip()[1:-1])[0].decode("latin-1")
        else:
            yield known.name, known.arg.reader(stream) if known.arg else None


def _execute(machine: _Machine, name: str, argument: Any) -> None:
    stack = machine.stack
    match name:
        case "PROTO" | "FRAME":
            pass
        case _ if name in LITERALS:
            stack.append(argument)
        case _ if name in CONSTANTS:
            stack.append(CONSTANTS[name])
        case "MARK":
            stack.append(MARK)
        case "PUT" | "BINPUT" | "LONG_BINPUT":
            machine.remember(argument)
        case "MEMOIZE":
            machine.remember(len(machine.memo))
        case "GET" | "BINGET" | "LONG_BINGET":
            stack.append(machine.memo[argument])
        case "GLOBAL":
            stack.append(_meaning(argument))
        case "STACK_GLOBAL":
            attribute, module = machine.pop(str), machine.pop(str)
            stack.append(_meaning(f"{module} {attribute}"))
        case "REDUCE":
            arguments = machine.pop(tuple)
            stack.append(_call(machine, machine.pop(_Name).meaning, arguments))
        case "BUILD":
            state = machine.pop(tuple)
            unbuilt = machine.pop(_Unbuilt)
            stack.append(_built(machine, unbuilt, state))
            machine.memo.update(dict.fromkeys(unbuilt.memo, stack[-1]))
        case _:
            _collect(machine, name)


def _collect(machine: _Machine, name: str) -> None:
    """Instructions that make and fill lists, tuples and dictionaries."""
    stack = machine.stack
    match name:
        case "EMPTY_LIST" | "EMPTY_DICT" | "EMPTY_TUPLE":
            stack.append({"EMPTY_LIST": list, "EMPTY_DICT": dict, "EMPTY_TUPLE": tuple}[name]())
        case "LIST":
            stack.append([_data(value) for value in machine.pop_to_mark()])
        case "TUPLE":
            stack.append(_tuple(machine.pop_to_mark()))
        case "TUPLE1" | "TUPLE2" | "TUPLE3":
            stack.append(_tuple([machine.pop() for _ in range(int(name[-1]))][::-1]))
        case "DICT":
            values = machine.pop_to_mark()
            stack.append({})
            _fill(stack[-1], values)
        case "APPEND" | "APPENDS":
            values = [machine.pop()] if name == "APPEND" else machine.pop_to_mark()
            target = machine.pop(list)
            target.extend(_data(value) for value in values)
            stack.append(target)
        case "SETITEM" | "SETITEMS":
            values = [machine.pop(), machine.pop()][::-1] if name == "SETITEM" else machine.pop_to_mark()
            target = machine.pop(dict)
            _fill(target, values)
            stack.append(target)
        case _:
            raise ValueError(f"the instruction {name} makes no plain data")


def _tuple(values: list[Any]) -> tuple:
    return (_Arguments if any(isinstance(value, NOT_DATA) for value in values) else tuple)(values)


def _fill(target: dict, values: list[Any]) -> None:
    for key, value in zip(values[::2], values[1::2], strict=True):
        # Nothing else has a hash whose cost is bounded: tuples may share their parts.
        if not isinstance(key, str | int | float | bytes):
            raise ValueError(f"a {type(key).__name__} as a key")
        target[key] = _data(value)


def _data(value: Any) -> Any:
    if isinstance(value, NOT_DATA):
        raise ValueError(f"a {type(value).__name__.strip('_').lower()} in the place of data")
    return value


# Arrays ---------------------------------------------------------------------------------------------------------------


def _meaning(name: str) -> _Name:
    if name not in MEANINGS:
        raise ValueError(f"it names {'.'.join(name.split())[:80]}")
    return _Name(MEANINGS[name])


def _call(machine: _Machine, meaning: str, arguments: tuple) -> Any:
    match meaning, arguments:
        case "array", (_Name(meaning="ndarray"), _, _):
            return _Unbuilt("array")
        case "dtype", (str() as name, *_) if NUMBERS.fullmatch(name):
            return _Unbuilt("dtype", name)
        case "scalar", (np.dtype() as dtype, text):
            return np.frombuffer(machine.spend(text), dtype, 1)[0].item()
        case "encode", (str() as text, "latin1" | "latin-1"):
            return machine.spend(text)
        case "bytes", ():
            return b""
    raise ValueError(f"a {meaning} that is none of numbers")


def _built(machine: _Machine, unbuilt: _Unbuilt, state: tuple) -> np.ndarray | np.dtype:
    match unbuilt.kind, state:
        case "dtype", (_, "<" | ">" | "|" | "=" as order, *_):
            return np.dtype(order + unbuilt.type)
        case "array", (_, tuple() as shape, np.dtype() as dtype, columns_first, text):
            flat = np.frombuffer(machine.spend(text), dtype)
            if not all(isinstance(n, int) and n >= 0 for n in shape) or math.prod(shape) != len(flat):
                raise ValueError("an array whose shape is not that of its numbers")
            return flat.reshape(shape, order="F" if columns_first else "C").copy()
    raise ValueError(f"an unknown kind of {unbuilt.kind}")
