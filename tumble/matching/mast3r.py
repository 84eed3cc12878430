"""MASt3R (Leroy et al. 2024), through an installation of the user's own. Code and weights are for non-commercial use.

It is on no package index: clone github.com/naver/mast3r with its submodules and put the clone on PYTHONPATH. The
weights come as the authors publish them on Hugging Face, or from the folder named by TUMBLE_MAST3R (config.json and
model.safetensors; the .pth file is a pickle and is not opened). Written against the interface of 2024-2025 and driven
by the tests through a stand-in of it; with the real network it has not been run by the project.
"""

import importlib
import os
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tumble.matching._window import Window, windows
from tumble.scene import Match, View, no_match

VERSION = 1
WEIGHTS = "naver/MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric"
SIZE = 512
"""The object's window is resampled to this size, that of the training."""
STEP = 8
"""Grid of starting points [pixels of the window]."""
BACK = 2.0
"""Largest distance between a pixel and the nearest descriptor of its nearest descriptor [pixels of the window]."""
CHUNK = 1024
"""Descriptors compared at once."""


def load(device: torch.device | str):
    """A matcher without memory.

    Raises:
        ModuleNotFoundError: mast3r or dust3r is not installed.
        ValueError: TUMBLE_MAST3R names something else than a folder.
    """
    try:
        model, inference = importlib.import_module("mast3r.model"), importlib.import_module("dust3r.inference")
    except ModuleNotFoundError as missing:
        fix = "git clone --recursive https://github.com/naver/mast3r, and put it on PYTHONPATH"
        raise ModuleNotFoundError(f"the matcher mast3r needs a package that is not here: {missing} ({fix})") from None
    where = os.environ.get("TUMBLE_MAST3R", WEIGHTS)
    if where != WEIGHTS and not Path(where).is_dir():
        raise ValueError(f"TUMBLE_MAST3R is {where!r}, not a folder with config.json and model.safetensors")
    network = model.AsymmetricMASt3R.from_pretrained(where).to(device).eval()

    def match(view_i: View, view_j: View) -> Match:
        looks = windows(view_i, view_j, SIZE)
        if looks is None:
            return no_match(view_i.number, view_j.number)
        look_i, look_j = looks
        pair = (_input(look_i, 0), _input(look_j, 1))
        found = inference.inference([pair], network, device, batch_size=1, verbose=False)
        unit_i, unit_j = found["pred1"]["desc"][0].float(), found["pred2"]["desc"][0].float()
        pixels_i, pixels_j = _reciprocal(unit_i, unit_j, torch.from_numpy(look_i.sure), torch.from_numpy(look_j.sure))
        (column_i, row_i), (column_j, row_j) = pixels_i.T, pixels_j.T
        # A cosine; the network's own confidence has no upper end.
        alike = (unit_i[row_i, column_i] * unit_j[row_j, column_j]).sum(-1).clamp(0, 1).cpu()
        uv_i, uv_j = (
            look.in_frame(pixels.cpu().numpy().astype(np.float64) + 0.5)
            for look, pixels in ((look_i, pixels_i), (look_j, pixels_j))
        )
        return Match(view_i.number, view_j.number, uv_i, uv_j, alike)

    return match


def _input(look: Window, index: int) -> dict[str, object]:
    """A picture as dust3r takes it: values in [-1, 1], its size, a number and a name."""
    image = torch.from_numpy(look.rgb).permute(2, 0, 1)[None] / 127.5 - 1
    return {"img": image, "true_shape": np.array([image.shape[-2:]], np.int32), "idx": index, "instance": str(index)}


def _reciprocal(
    unit_i: Float[Tensor, "h w c"], unit_j: Float[Tensor, "h w c"], sure_i: Tensor, sure_j: Tensor
) -> tuple[Int[Tensor, "m 2"], Int[Tensor, "m 2"]]:
    """Pixels (column, row) of i on a grid and of j that are each other's nearest descriptor, or next to it."""
    all_i, all_j = (torch.nonzero(sure.to(unit_i.device)).flip(-1) for sure in (sure_i, sure_j))
    start = all_i[((all_i % STEP) == STEP // 2).all(-1)]
    end = _nearest(unit_i, start, unit_j, all_j)
    back = _nearest(unit_j, end, unit_i, all_i)
    kept = (back - start).float().norm(dim=-1) <= BACK
    return start[kept], end[kept]


def _nearest(unit: Tensor, pixels: Tensor, others: Tensor, candidates: Tensor) -> Int[Tensor, "m 2"]:
    """Of every pixel, the candidate in the other frame with the most similar descriptor."""
    if len(pixels) == 0 or len(candidates) == 0:
        return pixels[:0]
    described = others[candidates[:, 1], candidates[:, 0]]
    parts = [(unit[part[:, 1], part[:, 0]] @ described.T).argmax(1) for part in pixels.split(CHUNK)]
    return candidates[torch.cat(parts)]
