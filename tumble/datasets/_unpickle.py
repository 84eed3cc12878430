"""Reader of pickled metadata that does not run the pickle.

A pickle is a program for a stack machine, and an untrusted one can execute anything. The machine implemented here
supports only the instructions that create numbers, strings, lists, tuples, dictionaries and numpy arrays of numbers,
and refuses all others. A global name in the file selects one of the `ALLOWED_NAMES`; nothing that a file names is
imported or called. Byte strings of Python 2 are returned as text (Latin-1), numpy scalars as Python numbers.
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
"""Maximum size of a file, and of the arrays created from it; the metadata of a frame has about ten kilobytes."""
ALLOWED_NAMES = {
    "numpy ndarray": "ndarray",
    "numpy dtype": "dtype",
    **{f"numpy.{core}.multiarray _reconstruct": "array" for core in ("core", "_core")},
    **{f"numpy.{core}.multiarray scalar": "scalar" for core in ("core", "_core")},
    "_codecs encode": "encode",
    "__builtin__ bytes": "bytes",
    "builtins bytes": "bytes",
}
"""Global names that a pickle may contain (module and attribute), and what each stands for."""
ELEMENT_TYPES = re.compile(r"b1|[iu][1248]|f[248]")
"""Element types of arrays: booleans, integers and floats."""
LITERALS = {
    *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "FLOAT", "BINFLOAT", "STRING", "BINSTRING"),
    *("SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINBYTES", "SHORT_BINBYTES"),
}
"""Instructions that push their argument on the stack."""
INSTRUCTIONS = {instruction.code: instruction for instruction in pickletools.opcodes}
"""All pickle instructions by their code."""
CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
"""Instructions that push a constant on the stack."""


def read(path: Path) -> Any:
    """The data in a pickle file.

    Raises:
        BadFile: The file is missing, larger than `MAX_BYTES`, broken, or contains anything but plain data.
    """
    if not path.is_file():
        raise BadFile(path, "is missing" if not path.exists() else "is not a file")
    if path.stat().st_size > MAX_BYTES:
        raise BadFile(path, f"has {path.stat().st_size} bytes, over the limit of {MAX_BYTES} for metadata")
    try:
        return _run(path.read_bytes())
    except (ValueError, TypeError, LookupError, OverflowError, struct.error) as error:
        fix = "only numbers, strings, lists, dictionaries and arrays of numbers are accepted"
        raise BadFile(path, f"cannot be read as pickled metadata: {error}", fix) from None


# The machine ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Global:
    """A global name of the file."""

    meaning: str
    """What the name stands for, from `ALLOWED_NAMES`."""


@dataclass(frozen=True)
class _Incomplete:
    """An array or element type whose state is set by a later BUILD instruction."""

    kind: str
    type: str = ""
    memo: list[int] = field(default_factory=list)
    """Numbers of its entries in the memo."""


class _Arguments(tuple):
    """A tuple that contains values that are not data; valid only as the arguments of a call."""


NOT_DATA = (_Global, _Incomplete, _Arguments, np.dtype)
"""Types of stack values that are not data."""
MARK = object()
"""Stack value of the instruction MARK."""


@dataclass
class _Machine:
    """Stack, memo and byte budget of one program; mutable, because every instruction changes them."""

    stack: list[Any] = field(default_factory=list)
    memo: dict[int, Any] = field(default_factory=dict)
    budget: int = 2 * MAX_BYTES
    """Bytes left for arrays; twice the limit, because Python 3 stores them as text, which is decoded to bytes and then
    to an array."""

    def pop(self, *kinds: type) -> Any:
        value = self.stack.pop()
        if value is MARK or (kinds and not isinstance(value, kinds)):
            raise ValueError(f"an instruction has a {type(value).__name__} as its operand")
        return value

    def pop_to_mark(self) -> list[Any]:
        values = []
        while (value := self.stack.pop()) is not MARK:
            values.append(value)
        return values[::-1]

    def memoize(self, number: int) -> None:
        value = self.stack[-1]
        self.memo[number] = value
        if isinstance(value, _Incomplete):
            value.memo.append(number)

    def charge(self, text: Any) -> bytes:
        """Bytes of an array from a string of Python 2 or 3, charged to the budget.

        A string is charged whenever it is used, because a program may use it many times.
        """
        if not isinstance(text, bytes | str):
            raise ValueError("an array that is not numeric")
        self.budget -= len(text)
        if self.budget < 0:
            raise ValueError(f"arrays of more than {MAX_BYTES} bytes")
        return text if isinstance(text, bytes) else text.encode("latin-1")


def _run(program: bytes) -> Any:
    machine = _Machine()
    for name, argument in _instructions(io.BytesIO(program)):
        if name == "STOP":
            return _require_data(machine.pop())
        _execute(machine, name, argument)
    raise ValueError("the program has no end")


def _instructions(stream: io.BytesIO) -> Iterator[tuple[str, Any]]:
    while code := stream.read(1):
        instruction = INSTRUCTIONS.get(code.decode("latin-1"))
        if instruction is None:
            raise ValueError(f"unknown instruction {code!r}")
        if instruction.name == "STRING":
            # pickletools decodes these as ASCII, but Python 2 wrote the bytes of arrays this way.
            yield instruction.name, codecs.escape_decode(stream.readline().strip()[1:-1])[0].decode("latin-1")
        else:
            yield instruction.name, instruction.arg.reader(stream) if instruction.arg else None


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
            machine.memoize(argument)
        case "MEMOIZE":
            machine.memoize(len(machine.memo))
        case "GET" | "BINGET" | "LONG_BINGET":
            stack.append(machine.memo[argument])
        case "GLOBAL":
            stack.append(_resolve(argument))
        case "STACK_GLOBAL":
            attribute, module = machine.pop(str), machine.pop(str)
            stack.append(_resolve(f"{module} {attribute}"))
        case "REDUCE":
            arguments = machine.pop(tuple)
            stack.append(_call(machine, machine.pop(_Global).meaning, arguments))
        case "BUILD":
            state = machine.pop(tuple)
            incomplete = machine.pop(_Incomplete)
            stack.append(_build(machine, incomplete, state))
            machine.memo.update(dict.fromkeys(incomplete.memo, stack[-1]))
        case _:
            _collect(machine, name)


def _collect(machine: _Machine, name: str) -> None:
    """Execute instructions that create or fill lists, tuples and dictionaries."""
    stack = machine.stack
    match name:
        case "EMPTY_LIST" | "EMPTY_DICT" | "EMPTY_TUPLE":
            stack.append({"EMPTY_LIST": list, "EMPTY_DICT": dict, "EMPTY_TUPLE": tuple}[name]())
        case "LIST":
            stack.append([_require_data(value) for value in machine.pop_to_mark()])
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
            target.extend(_require_data(value) for value in values)
            stack.append(target)
        case "SETITEM" | "SETITEMS":
            values = [machine.pop(), machine.pop()][::-1] if name == "SETITEM" else machine.pop_to_mark()
            target = machine.pop(dict)
            _fill(target, values)
            stack.append(target)
        case _:
            raise ValueError(f"the instruction {name} is not allowed")


def _tuple(values: list[Any]) -> tuple:
    return (_Arguments if any(isinstance(value, NOT_DATA) for value in values) else tuple)(values)


def _fill(target: dict, values: list[Any]) -> None:
    for key, value in zip(values[::2], values[1::2], strict=True):
        # Other types have a hash of unlimited cost: tuples may share their parts.
        if not isinstance(key, str | int | float | bytes):
            raise ValueError(f"a {type(key).__name__} as a key")
        target[key] = _require_data(value)


def _require_data(value: Any) -> Any:
    if isinstance(value, NOT_DATA):
        raise ValueError(f"a {type(value).__name__.strip('_').lower()} where data is expected")
    return value


# Arrays ---------------------------------------------------------------------------------------------------------------


def _resolve(name: str) -> _Global:
    if name not in ALLOWED_NAMES:
        raise ValueError(f"the name {'.'.join(name.split())[:80]} is not allowed")
    return _Global(ALLOWED_NAMES[name])


def _call(machine: _Machine, meaning: str, arguments: tuple) -> Any:
    match meaning, arguments:
        case "array", (_Global(meaning="ndarray"), _, _):
            return _Incomplete("array")
        case "dtype", (str() as name, *_) if ELEMENT_TYPES.fullmatch(name):
            return _Incomplete("dtype", name)
        case "scalar", (np.dtype() as dtype, text):
            return np.frombuffer(machine.charge(text), dtype, 1)[0].item()
        case "encode", (str() as text, "latin1" | "latin-1"):
            return machine.charge(text)
        case "bytes", ():
            return b""
    raise ValueError(f"a {meaning} that is not numeric")


def _build(machine: _Machine, incomplete: _Incomplete, state: tuple) -> np.ndarray | np.dtype:
    match incomplete.kind, state:
        case "dtype", (_, "<" | ">" | "|" | "=" as order, *_):
            return np.dtype(order + incomplete.type)
        case "array", (_, tuple() as shape, np.dtype() as dtype, columns_first, text):
            flat = np.frombuffer(machine.charge(text), dtype)
            if not all(isinstance(n, int) and n >= 0 for n in shape) or math.prod(shape) != len(flat):
                raise ValueError("an array whose shape does not match its number of values")
            return flat.reshape(shape, order="F" if columns_first else "C").copy()
    raise ValueError(f"an unknown kind of {incomplete.kind}")
