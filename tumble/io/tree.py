"""Trees of tensors: map a function over the tensors, name them, move them between devices, save and load them.

A *tree* is a frozen dataclass whose fields are tensors, other trees, dicts of tensors, or *plain values* (numbers,
strings, tuples of those, None). The *name* of a tensor is its path of field names joined by dots, such as
`trajectory.T_cam_obj.wxyz`. On disk a tree is one safetensors file: tensors by name, and plain values as JSON in the
header under the key "facts", with the checksum of `checked_tensors`. Nothing is pickled.
"""

import dataclasses
import json
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import jaxtyping
import msgspec
import torch
from torch import Tensor

from tumble import __version__
from tumble.io import files
from tumble.io.checked_tensors import read_tensors, write_tensors
from tumble.io.errors import BadFile

T = TypeVar("T")
FIX = "remove it and run the command that made it again"
"""Fix that `BadFile` suggests for an unreadable tree."""


def map(fn: Callable[[Tensor], Tensor], tree: T) -> T:
    """The tree with `fn` applied to every tensor, in field order; plain values are unchanged."""
    if isinstance(tree, Tensor):
        return typing.cast(T, fn(tree))
    if isinstance(tree, dict):
        return typing.cast(T, {key: map(fn, value) for key, value in tree.items()})
    if not dataclasses.is_dataclass(tree):
        return tree
    return dataclasses.replace(typing.cast(Any, tree), **{k: map(fn, v) for k, v in _fields(tree).items()})


def named_tensors(tree: object) -> dict[str, Tensor]:
    """All tensors of a tree by dotted name, in field order."""
    return dict(_walk(tree, ""))


def to(tree: T, device: torch.device | str) -> T:
    """The tree with every tensor on `device`."""
    return map(lambda x: x.to(device), tree)


def detach(tree: T) -> T:
    """The tree detached from the autograd graph; tensors share storage with the originals."""
    return map(torch.Tensor.detach, tree)


def save(tree: object, path: Path) -> None:
    """Write a tree atomically as one safetensors file."""
    header = {"type": type(tree).__name__, "tumble": __version__, "facts": json.dumps(_plain_values(tree))}
    write_tensors(path, named_tensors(tree), header)


def load(cls: type[T], path: Path, device: torch.device | str = "cpu") -> T:
    """The tree of class `cls` stored in a file; types and shapes of all fields are those of the class.

    Raises:
        BadFile: The file does not match its checksum, holds another class, lacks a field, or has one of another type
            or shape.
    """
    tensors, header = read_tensors(path, FIX)
    if header.get("type") != cls.__name__:
        raise BadFile(path, f"holds a {header.get('type', 'file of unknown type')}, not a {cls.__name__}", FIX)
    try:
        # Not the JSON of msgspec, because plain values may be infinite.
        tree = msgspec.convert(_nested(json.loads(header["facts"]), tensors, ""), cls, dec_hook=_tensor)
        _require_consistent(tree)
    except msgspec.ValidationError as error:
        raise BadFile(path, f"holds no valid {cls.__name__}: {files.violated_rule(error)}", FIX) from None
    except (KeyError, ValueError, TypeError, AttributeError, RecursionError, AssertionError) as error:
        raise BadFile(path, f"is damaged: {type(error).__name__}: {str(error)[:200]}", FIX) from None
    return to(tree, device)


def _fields(tree: object) -> dict[str, Any]:
    return {f.name: getattr(tree, f.name) for f in dataclasses.fields(typing.cast(Any, tree))}


def _walk(tree: object, prefix: str) -> Iterator[tuple[str, Tensor]]:
    """Names and tensors of a tree, depth first in field order."""
    if isinstance(tree, Tensor):
        yield prefix, tree
        return
    if dataclasses.is_dataclass(tree):
        tree = _fields(tree)
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from _walk(value, f"{prefix}.{key}" if prefix else str(key))


def _plain_values(tree: object) -> dict[str, Any]:
    """The plain values of a tree, nested like the tree; each tensor is represented by the string "tensor"."""
    facts: dict[str, Any] = {}
    for name, value in (tree if isinstance(tree, dict) else _fields(tree)).items():
        if isinstance(value, Tensor):
            facts[name] = "tensor"
        elif isinstance(value, dict) or dataclasses.is_dataclass(value):
            facts[name] = {"tree": _plain_values(value)}
        else:
            facts[name] = {"fact": value}
    return facts


def _nested(facts: dict[str, Any], tensors: dict[str, Tensor], prefix: str) -> dict[str, Any]:
    """The tree as nested dicts, from what `_plain_values` returned and the tensors, whose names begin with `prefix`."""
    values: dict[str, Any] = {}
    for name, entry in facts.items():
        key = prefix + name
        if entry == "tensor":
            values[name] = tensors[key]
        else:
            values[name] = _nested(entry["tree"], tensors, f"{key}.") if "tree" in entry else entry["fact"]
    return values


def _tensor(kind: type, value: Any) -> Any:
    """The value of a field whose type is no plain one: a tensor, whose annotation states its shape."""
    if not isinstance(value, kind):
        found = f"{value.dtype} {list(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
        raise ValueError(f"expected {kind.__name__}, got {found}")
    return value


def _require_consistent(tree: object) -> None:
    """Raise `ValueError` unless a name of a dimension stands for one number in every dataclass of a tree."""
    if not dataclasses.is_dataclass(tree):
        return
    hints = typing.get_type_hints(type(tree))
    with jaxtyping.jaxtyped("context"):
        for name, value in _fields(tree).items():
            if isinstance(value, Tensor) and not isinstance(value, hints[name]):
                kind = getattr(hints[name], "__name__", hints[name])
                raise ValueError(f"{name} is {value.dtype} {list(value.shape)}, not {kind}")
    for value in _fields(tree).values():
        _require_consistent(value)
