"""MASt3R (Leroy et al. 2024), installed by the user. Its code and weights are for non-commercial use only.

MASt3R is on no package index: clone github.com/naver/mast3r with its submodules and add the clone to PYTHONPATH. The
weights are those that the authors publish on Hugging Face, or those in the folder given by TUMBLE_MAST3R (config.json
and model.safetensors; the .pth file is a pickle and is not read). This adapter is written for the interface of
2024-2025 and tested with a mock of it; it has not been run with the real network.
"""

import importlib
import os
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tumble.matching._window import Window, crop_windows
from tumble.scene import Match, View, empty_match

VERSION = 1
WEIGHTS = "naver/MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric"
"""Default weights, by their name on Hugging Face."""
SIZE = 512
"""Height and width of the window around the object that is matched, as in training [pixels]."""
STEP = 8
"""Spacing of the grid of starting points [pixels of the window]."""
MAX_CYCLE_ERROR = 2.0
"""Largest error of a pixel after matching descriptors there and back [pixels of the window]."""
CHUNK_SIZE = 1024
"""Number of descriptors compared at once, which limits memory."""


def load(device: torch.device | str):
    """Matcher on a device; it has no state.

    Raises:
        ModuleNotFoundError: mast3r or dust3r is not installed.
        ValueError: TUMBLE_MAST3R is set, but not to a folder.
    """
    try:
        model, inference = importlib.import_module("mast3r.model"), importlib.import_module("dust3r.inference")
    except ModuleNotFoundError as missing:
        fix = "git clone --recursive https://github.com/naver/mast3r, and add the clone to PYTHONPATH"
        raise ModuleNotFoundError(
            f"the matcher mast3r needs a package that is not installed: {missing} ({fix})"
        ) from None
    where = os.environ.get("TUMBLE_MAST3R", WEIGHTS)
    if where != WEIGHTS and not Path(where).is_dir():
        raise ValueError(f"TUMBLE_MAST3R is {where!r}, not a folder with config.json and model.safetensors")
    network = model.AsymmetricMASt3R.from_pretrained(where).to(device).eval()

    def match(view_i: View, view_j: View) -> Match:
        window_pair = crop_windows(view_i, view_j, SIZE)
        if window_pair is None:
            return empty_match(view_i.number, view_j.number)
        window_i, window_j = window_pair
        pair = (_input(window_i, 0), _input(window_j, 1))
        output = inference.inference([pair], network, device, batch_size=1, verbose=False)
        unit_i, unit_j = output["pred1"]["desc"][0].float(), output["pred2"]["desc"][0].float()
        pixels_i, pixels_j = _reciprocal(
            unit_i, unit_j, torch.from_numpy(window_i.usable), torch.from_numpy(window_j.usable)
        )
        (column_i, row_i), (column_j, row_j) = pixels_i.T, pixels_j.T
        # The cosine as confidence: that of the network has no upper limit.
        cosine = (unit_i[row_i, column_i] * unit_j[row_j, column_j]).sum(-1).clamp(0, 1).cpu()
        uv_i, uv_j = (
            window.in_frame(pixels.cpu().numpy().astype(np.float64) + 0.5)
            for window, pixels in ((window_i, pixels_i), (window_j, pixels_j))
        )
        return Match(view_i.number, view_j.number, uv_i, uv_j, cosine)

    return match


def _input(window: Window, index: int) -> dict[str, object]:
    """Input of dust3r: image in [-1, 1], its size, an index and a name."""
    image = torch.from_numpy(window.rgb).permute(2, 0, 1)[None] / 127.5 - 1
    return {"img": image, "true_shape": np.array([image.shape[-2:]], np.int32), "idx": index, "instance": str(index)}


def _reciprocal(
    unit_i: Float[Tensor, "h w c"], unit_j: Float[Tensor, "h w c"], usable_i: Tensor, usable_j: Tensor
) -> tuple[Int[Tensor, "m 2"], Int[Tensor, "m 2"]]:
    """Pixels (column, row) of i on a grid and of j whose descriptors are mutual nearest neighbours, or nearly so."""
    all_i, all_j = (torch.nonzero(usable.to(unit_i.device)).flip(-1) for usable in (usable_i, usable_j))
    start = all_i[((all_i % STEP) == STEP // 2).all(-1)]
    end = _nearest(unit_i, start, unit_j, all_j)
    back = _nearest(unit_j, end, unit_i, all_i)
    kept = (back - start).float().norm(dim=-1) <= MAX_CYCLE_ERROR
    return start[kept], end[kept]


def _nearest(unit: Tensor, pixels: Tensor, others: Tensor, candidates: Tensor) -> Int[Tensor, "m 2"]:
    """Candidate in the other frame with the most similar descriptor, for every pixel."""
    if len(pixels) == 0 or len(candidates) == 0:
        return pixels[:0]
    described = others[candidates[:, 1], candidates[:, 0]]
    parts = [(unit[part[:, 1], part[:, 0]] @ described.T).argmax(1) for part in pixels.split(CHUNK_SIZE)]
    return candidates[torch.cat(parts)]
