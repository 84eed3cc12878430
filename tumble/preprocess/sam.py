"""Segmentation by SAM 2 and SAM 3 (Meta): adapters for packages and weights that the user installs.

Neither is a dependency of tumble: SAM 2 is under Apache-2.0, SAM 3 has gated weights and its own licence. The adapters
follow the public interfaces (`build_sam2_video_predictor`; `handle_request` of SAM 3's predictor). They are tested
against mock predictors only, not with the networks.
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
"""SAM 2.1 configuration per model size; the size is part of the checkpoint's name, as in sam2.1_hiera_large.pt."""
JPEG_QUALITY = 95
"""Quality of the JPEG files that are passed to both models, which read folders of JPEG."""


def sam2(images: UInt8[np.ndarray, "t h w 3"], seed: Seed, weights: Path) -> Bool[np.ndarray, "t h w"]:
    """Masks of the object in all frames, by SAM 2.1.

    Raises:
        BadFile: The weights are missing, or their file name does not contain the model size.
        ModuleNotFoundError: SAM 2 is not installed.
    """
    config = next((config for size, config in SAM2_CONFIGS.items() if size in weights.name), None)
    _require_weights(
        weights, "SAM 2", "download sam2.1_hiera_small.pt as described in the repository facebookresearch/sam2"
    )
    if config is None:
        raise BadFile(
            weights,
            "has a name without the size of the model",
            f"the name must contain one of {', '.join(SAM2_CONFIGS)}",
        )
    try:
        from sam2.build_sam import build_sam2_video_predictor  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"SAM 2 is not installed ({error}): pip install sam2") from None
    predictor = build_sam2_video_predictor(config, str(weights), device=_device())
    masks = np.zeros(images.shape[:3], bool)
    with tempfile.TemporaryDirectory() as folder, torch.inference_mode():
        state = predictor.init_state(video_path=_as_jpegs(images, Path(folder)), offload_video_to_cpu=True)
        prompt: dict[str, Any] = {}
        if seed.box is not None:
            left, top, width, height = seed.box
            prompt["box"] = np.array([left, top, left + width, top + height], np.float32)
        else:
            prompt["points"], prompt["labels"] = np.array([seed.click], np.float32), np.array([1], np.int32)
        predictor.add_new_points_or_box(inference_state=state, frame_idx=seed.index, obj_id=1, **prompt)
        for reverse in (False, True):
            for index, _, logits in predictor.propagate_in_video(state, start_frame_idx=seed.index, reverse=reverse):
                masks[index] = (logits[0, 0] > 0).cpu().numpy()
    return masks


def sam3(images: UInt8[np.ndarray, "t h w 3"], seed: Seed, weights: Path) -> Bool[np.ndarray, "t h w"]:
    """Masks of the object in all frames, by SAM 3; needs an NVIDIA GPU.

    Raises:
        BadFile: The weights are missing.
        ModuleNotFoundError: SAM 3 is not installed.
    """
    _require_weights(weights, "SAM 3", "request access to facebook/sam3 on Hugging Face and download sam3.pt")
    try:
        from sam3.model_builder import build_sam3_video_predictor  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"SAM 3 is not installed ({error}): install facebookresearch/sam3") from None
    predictor = build_sam3_video_predictor(checkpoint_path=str(weights))
    height, width = images.shape[1:3]
    masks = np.zeros(images.shape[:3], bool)
    with tempfile.TemporaryDirectory() as folder:
        request = {"type": "start_session", "resource_path": _as_jpegs(images, Path(folder))}
        session = predictor.handle_request(request)["session_id"]
        prompt: dict[str, Any] = {"type": "add_prompt", "session_id": session, "frame_index": seed.index}
        if seed.box is not None:
            box = [v / s for v, s in zip(seed.box, (width, height, width, height), strict=True)]
            prompt |= {"bounding_boxes": [box], "bounding_box_labels": [1]}
        elif seed.click is not None:
            point = [seed.click[0] / width, seed.click[1] / height]
            prompt |= {"points": [point], "point_labels": [1], "obj_id": 1}
        predictor.handle_request(prompt)
        stream = {"type": "propagate_in_video", "session_id": session, "start_frame_index": seed.index}
        for response in predictor.handle_stream_request(stream | {"propagation_direction": "both"}):
            candidates = np.asarray(response["outputs"]["out_binary_masks"], bool)
            if len(candidates):
                best = int(np.argmax(np.asarray(response["outputs"]["out_probs"])))
                masks[response["frame_index"]] = candidates[best].reshape(height, width)
        predictor.handle_request({"type": "close_session", "session_id": session})
    return masks


SEGMENTERS: dict[str, Callable[[np.ndarray, Seed, Path], np.ndarray]] = {"sam2": sam2, "sam3": sam3}
"""Segmentation functions by the name of the option `--segmenter`."""


def _require_weights(weights: Path, model: str, fix: str) -> None:
    if not weights.is_file():
        raise BadFile(weights, f"is missing; it should hold the weights of {model}", fix)


def _device() -> str:
    accelerator = torch.accelerator.current_accelerator() if torch.accelerator.is_available() else None
    return "cpu" if accelerator is None else accelerator.type


def _as_jpegs(images: UInt8[np.ndarray, "t h w 3"], folder: Path) -> str:
    for i, image in enumerate(images):
        Image.fromarray(image).save(folder / f"{i:05d}.jpg", quality=JPEG_QUALITY)
    return str(folder)
