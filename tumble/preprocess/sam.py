"""Masks from SAM 2 and SAM 3 (Meta): adapters for an installation of the user's own, with weights from a path.

Neither is installed with tumble: SAM 2 is Apache-2.0, SAM 3 has gated weights and a licence of its own to accept. The
calls follow the public interface of both (`build_sam2_video_predictor`; `handle_request` of SAM 3's predictor). They
were tried with stand-ins only, never with the networks themselves.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from PIL import Image

from tumble.io import BadFile
from tumble.preprocess.segmentation import Seed

SAM2_CONFIGS = {
    "tiny": "configs/sam2.1/sam2.1_hiera_t.yaml",
    "small": "configs/sam2.1/sam2.1_hiera_s.yaml",
    "base_plus": "configs/sam2.1/sam2.1_hiera_b+.yaml",
    "large": "configs/sam2.1/sam2.1_hiera_l.yaml",
}
"""Configuration by what the name of a checkpoint says, as in sam2.1_hiera_large.pt."""
JPEG_QUALITY = 95
"""Both models read folders of JPEG."""


def sam2(pictures: UInt8[np.ndarray, "t h w 3"], seed: Seed, weights: Path) -> Bool[np.ndarray, "t h w"]:
    """The object in all frames, by SAM 2.1.

    Raises:
        BadFile: No weights there, or of unknown size.
        ModuleNotFoundError: SAM 2 is not installed.
    """
    config = next((config for size, config in SAM2_CONFIGS.items() if size in weights.name), None)
    _checked(weights, "SAM 2", "download sam2.1_hiera_small.pt as the repository facebookresearch/sam2 says")
    if config is None:
        raise BadFile(weights, "does not name its size", f"its name holds one of {', '.join(SAM2_CONFIGS)}")
    try:
        from sam2.build_sam import build_sam2_video_predictor  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"SAM 2 is not installed ({error}): pip install sam2") from None
    predictor = build_sam2_video_predictor(config, str(weights), device=_device())
    masks = np.zeros(pictures.shape[:3], bool)
    with tempfile.TemporaryDirectory() as folder, torch.inference_mode():
        state = predictor.init_state(video_path=_as_jpegs(pictures, Path(folder)), offload_video_to_cpu=True)
        hint: dict[str, Any] = {}
        if seed.box is not None:
            left, top, width, height = seed.box
            hint["box"] = np.array([left, top, left + width, top + height], np.float32)
        else:
            hint["points"], hint["labels"] = np.array([seed.click], np.float32), np.array([1], np.int32)
        predictor.add_new_points_or_box(inference_state=state, frame_idx=seed.index, obj_id=1, **hint)
        for reverse in (False, True):
            for index, _, logits in predictor.propagate_in_video(state, start_frame_idx=seed.index, reverse=reverse):
                masks[index] = (logits[0, 0] > 0).cpu().numpy()
    return masks


def sam3(pictures: UInt8[np.ndarray, "t h w 3"], seed: Seed, weights: Path) -> Bool[np.ndarray, "t h w"]:
    """The object in all frames, by SAM 3; needs an NVIDIA GPU.

    Raises:
        BadFile: No weights there.
        ModuleNotFoundError: SAM 3 is not installed.
    """
    _checked(weights, "SAM 3", "request access to facebook/sam3 on Hugging Face and download sam3.pt")
    try:
        from sam3.model_builder import build_sam3_video_predictor  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"SAM 3 is not installed ({error}): install facebookresearch/sam3") from None
    predictor = build_sam3_video_predictor(checkpoint_path=str(weights))
    height, width = pictures.shape[1:3]
    masks = np.zeros(pictures.shape[:3], bool)
    with tempfile.TemporaryDirectory() as folder:
        request = {"type": "start_session", "resource_path": _as_jpegs(pictures, Path(folder))}
        session = predictor.handle_request(request)["session_id"]
        hint: dict[str, Any] = {"type": "add_prompt", "session_id": session, "frame_index": seed.index}
        if seed.box is not None:
            box = [v / s for v, s in zip(seed.box, (width, height, width, height), strict=True)]
            hint |= {"bounding_boxes": [box], "bounding_box_labels": [1]}
        elif seed.click is not None:
            point = [seed.click[0] / width, seed.click[1] / height]
            hint |= {"points": [point], "point_labels": [1], "obj_id": 1}
        predictor.handle_request(hint)
        stream = {"type": "propagate_in_video", "session_id": session, "start_frame_index": seed.index}
        for answer in predictor.handle_stream_request(stream | {"propagation_direction": "both"}):
            found = np.asarray(answer["outputs"]["out_binary_masks"], bool)
            if len(found):
                best = int(np.argmax(np.asarray(answer["outputs"]["out_probs"])))
                masks[answer["frame_index"]] = found[best].reshape(height, width)
        predictor.handle_request({"type": "close_session", "session_id": session})
    return masks


SEGMENTERS: dict[str, Callable[[np.ndarray, Seed, Path], np.ndarray]] = {"sam2": sam2, "sam3": sam3}


def _checked(weights: Path, model: str, fix: str) -> None:
    if not weights.is_file():
        raise BadFile(weights, f"is missing: the weights of {model}", fix)


def _device() -> str:
    found = torch.accelerator.current_accelerator() if torch.accelerator.is_available() else None
    return "cpu" if found is None else found.type


def _as_jpegs(pictures: UInt8[np.ndarray, "t h w 3"], folder: Path) -> str:
    for i, picture in enumerate(pictures):
        Image.fromarray(picture).save(folder / f"{i:05d}.jpg", quality=JPEG_QUALITY)
    return str(folder)
