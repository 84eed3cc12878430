"""Trees of tensors: map a function over the tensors, name them, move them between devices, save and load them.

A *tree* is a frozen dataclass whose fields are tensors, other trees, dicts of tensors, or *plain values* (numbers,
strings, tuples of those, None). The *name* of a tensor is its path of field names joined by dots, such as
`trajectory.T_cam_obj.wxyz`. On disk a tree is one safetensors file: tensors by name, and plain values as JSON in the
header under the key "facts", with the checksum of `checked_tensors`. Nothing is pickled.
"""

import dataclasses
import json
import types
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from tumble import __version__
from tumble.io.checked_tensors import read_tensors, write_tensors
from tumble.io.files import BadFile

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
    """The tree of class `cls` stored in a file.

    Raises:
        BadFile: The file does not match its checksum, holds another class, or lacks a field.
    """
    tensors, header = read_tensors(path, FIX)
    if header.get("type") != cls.__name__:
        raise BadFile(path, f"holds a {header.get('type', 'file of unknown type')}, not a {cls.__name__}", FIX)
    try:
        return to(_build(cls, tensors, json.loads(header["facts"]), ""), device)
    except KeyError as missing:
        rule = f"lacks {missing}, a field of {cls.__name__}; written by another version?"
        raise BadFile(path, rule, FIX) from None


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


def _build(cls: Any, tensors: dict[str, Tensor], facts: dict[str, Any], prefix: str) -> Any:
    """The tree of class `cls` from its tensors and what `_plain_values` returned; names begin with `prefix`."""
    hints = {} if cls is dict else typing.get_type_hints(cls)
    values: dict[str, Any] = {}
    for name in facts if cls is dict else hints:
        key, entry = prefix + name, facts[name]
        if entry == "tensor":
            values[name] = tensors[key]
        elif "tree" in entry:
            values[name] = _build(_tree_class(hints.get(name, dict)), tensors, entry["tree"], key + ".")
        else:
            values[name] = tuple(entry["fact"]) if isinstance(entry["fact"], list) else entry["fact"]
    return values if cls is dict else cls(**values)


def _tree_class(hint: Any) -> Any:
    """The dataclass (or dict) in the annotation of a field: `Material` for `Material | None`."""
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        hint = next(option for option in typing.get_args(hint) if option is not type(None))
    return dict if typing.get_origin(hint) is dict else hint
