"""Files of named tensors with a checksum: safetensors whose header holds a SHA-256 of everything in the file.

Disks, memory and copies flip bits without an error. A file that does not match its checksum is never used.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from tumble.io import files
from tumble.io.errors import BadFile

CHECKSUM = "sha256"
"""Entry of the header that holds the checksum."""


def write_tensors(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, str]) -> None:
    """Write tensors and the words of a header atomically, with their checksum.

    Raises:
        WriteError: See `files.write_atomically`.
    """
    # Tensors may share storage (views of one parameter); safetensors requires each to own its bytes. The memory format
    # also gives a single value, which is contiguous with any stride, the stride of 1 that a view of its bytes needs.
    owned = {
        name: value.detach().to("cpu", copy=True, memory_format=torch.contiguous_format)
        for name, value in tensors.items()
    }
    metadata = {**header, CHECKSUM: _checksum(owned, header)}
    files.write_atomically(path, lambda partial: safetensors.torch.save_file(owned, partial, metadata=metadata))


def read_tensors(path: Path, fix: str) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors by name, on the CPU, and the header of a file of `write_tensors`.

    Args:
        fix: What the user should do about a damaged file, for the error message.

    Raises:
        BadFile: The file is damaged, or has no checksum.
        OSError: The file cannot be read.
    """
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except (safetensors.SafetensorError, ValueError, TypeError, LookupError, RuntimeError) as error:
        raise BadFile(path, f"is damaged: {error}", fix) from None
    stored = header.pop(CHECKSUM, None)
    if stored is None:
        raise BadFile(path, "has no checksum: it was not written by this version", fix)
    if stored != _checksum(tensors, header):
        raise BadFile(path, "is damaged: its content does not match its checksum", fix)
    return tensors, header


def _checksum(tensors: Mapping[str, Tensor], header: Mapping[str, str]) -> str:
    """SHA-256 of header, names, types, shapes and values."""
    digest = hashlib.sha256(json.dumps(dict(header), sort_keys=True).encode())
    for name, value in sorted(tensors.items()):
        digest.update(json.dumps([name, str(value.dtype), list(value.shape)]).encode())
        digest.update(value.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
