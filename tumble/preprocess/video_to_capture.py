"""From a film, or a folder of pictures, to a capture folder: frames, masks and one pinhole camera, without poses.

Two passes over the footage. The survey looks at small copies of all frames. The second pass reads the chosen ones again
at full size, undoes lens and drift, cuts one window around the object's whole path out of all of them, and brings the
masks to the edges of the larger picture. The window is the same for all frames, so the camera stays one pinhole camera,
with its principal point moved.
"""

import hashlib
import json
import math
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from tumble.datasets import capture_document, training_frame
from tumble.io import BadFile, files, video
from tumble.maths import linear_from_srgb, to_srgb8
from tumble.preprocess import keyframes, segmentation
from tumble.preprocess.background import compensate, shake
from tumble.preprocess.footage import FootageFrame, frames
from tumble.preprocess.options import LEAST_FRAMES, FootageOptions
from tumble.preprocess.survey import ALIKE, Survey, small_mask, survey, undistorted
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN

LEAST_TURN = math.radians(40)
"""Less turning cannot be reconstructed, and most of it may be the noise of flow and masks [radians]."""
SHAKEN = 0.02
"""Motion of the background, as a share of the picture's longer side, from which no mask comes of it (38 of 1920)."""
COMPARED = 12
"""Frames on which the camera's shake is measured."""
MARGIN = 0.08
"""Room around the object's path, as a share of its longer side."""
UNSURE, KEPT, LEFT = (220, 30, 30), (40, 200, 60), (60, 60, 60)
"""Edges of the frames of the preview."""
PREVIEW = "mask_preview.mp4"
PROVENANCE = "ingest.json"


def capture_from_video(path: Path, out: Path, options: FootageOptions | None = None) -> Path:
    """A capture folder (docs/format.md) without poses from a film or a folder of pictures; returns the folder.

    It holds besides: `mask_preview.mp4`, and `ingest.json` with what was done to every frame.

    Raises:
        BadFile: The footage cannot become a capture, or `out` is there already; nothing is written then.
    """
    options = options or FootageOptions()
    refuse_full(out)
    found = survey(path, options)
    kept = keep(found, options)
    window = crop_window(found, kept)
    return write_folder(out, lambda partial: _write(found, kept, window, partial, options))


def refuse_full(out: Path) -> None:
    """Refuse a place where something is already."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise BadFile(out, "is there already", "choose a new folder")


def write_folder(out: Path, write: Callable[[Path], None]) -> Path:
    """Let `write` fill a partial folder, then put it in place in one step; returns it."""
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=files.partial_prefix(), dir=out.parent))
    try:
        write(partial)
        partial.chmod(0o755)
        partial.replace(out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return out


def origin(path: Path, options: FootageOptions) -> dict[str, Any]:
    """What decides a capture that footage becomes: its content, as a hash, and the options."""
    digest = hashlib.sha256()
    inside = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    for one in inside:
        with one.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return {"footage": digest.hexdigest(), "options": json.loads(json.dumps(vars(options), default=str))}


def keep(found: Survey, options: FootageOptions) -> list[int]:
    """Indices, in the survey, of the frames to keep: by turning and sharpness for a film, all of a folder of pictures.

    Raises:
        BadFile: The camera moved, the object hardly turns, or it is found on too few frames.
    """
    path, usable = found.footage.path, found.usable
    if found.seed is not None and options.segmenter == "grabcut" and (moved := shaken(found)) > SHAKEN:
        rule = f"was filmed by a camera that moved: the background by {100 * moved:.1f} % of the picture"
        raise BadFile(path, rule, "put the camera on a tripod, or give --masks")
    if found.footage.pictures:
        all_good = np.nonzero(usable)[0]
        spread = np.linspace(0, len(all_good) - 1, min(options.frames, len(all_good))).round().astype(int)
        kept = [int(i) for i in all_good[spread]]
    else:
        if found.turned[-1] < LEAST_TURN:
            rule = f"shows an object that turns by {math.degrees(found.turned[-1]):.0f} degrees in all"
            raise BadFile(path, rule, "turn it all the way round; if it has no texture at all, this cannot be seen")
        kept = keyframes.chosen(found.turned, found.blurs, usable, options.frames)
    if len(kept) < LEAST_FRAMES:
        raise BadFile(path, f"shows the object on {len(kept)} usable frames", "see `tumble check` for what is wrong")
    return kept


def shaken(found: Survey) -> float:
    """How far the background moves in three frames of four, as a share of the picture's longer side."""
    samples = np.unique(np.linspace(0, len(found.pictures) - 1, COMPARED).round().astype(int))
    covered = found.masks.labels[samples] != BACKGROUND
    return float(np.percentile(shake(found.pictures[samples], found.backdrop, covered), 75))


def crop_window(found: Survey, kept: list[int]) -> tuple[int, int, int, int]:
    """Top, left, height, width of the window around the object on all kept frames [pixels of the footage]."""
    path = np.logical_or.reduce(found.inside[kept])
    rows, columns = np.nonzero(path.any(1))[0], np.nonzero(path.any(0))[0]
    height, width = found.lens.camera.height, found.lens.camera.width
    margin = 2 + MARGIN * max(rows[-1] - rows[0] + 1, columns[-1] - columns[0] + 1)
    top, left = ((max(low - margin, 0) / found.scale) for low in (rows[0], columns[0]))
    bottom = min((rows[-1] + 1 + margin) / found.scale, height)
    right = min((columns[-1] + 1 + margin) / found.scale, width)
    top, left = math.floor(top), math.floor(left)
    return top, left, math.ceil(bottom) - top, math.ceil(right) - left


def preview(found: Survey, path: Path, kept: list[int]) -> None:
    """A film of the masks; a green edge marks the frames that `keep` chose, a red one those whose mask is unsure."""
    edges = [UNSURE if unsure else KEPT if i in kept else LEFT for i, unsure in enumerate(found.masks.unsure)]
    shown = map(tinted, found.pictures, found.masks.labels, edges)
    video.write_clip(path, shown, quality=24)


def tinted(
    picture: UInt8[np.ndarray, "h w 3"], labels: UInt8[np.ndarray, "h w"], edge: tuple[int, int, int]
) -> UInt8[np.ndarray, "i j 3"]:
    """Background dark, unknown orange, the object as it is, with an edge; of even sides, as films want them."""
    h, w = (side // 2 * 2 for side in labels.shape)
    shown = picture.copy()
    shown[labels == BACKGROUND] //= 3
    shown[labels == UNKNOWN] = shown[labels == UNKNOWN] // 2 + np.array([120, 60, 0], np.uint8)
    return cv2.rectangle(shown[:h, :w].copy(), (0, 0), (w - 1, h - 1), edge, 3)


# The second pass ------------------------------------------------------------------------------------------------------


def _write(
    found: Survey, kept: list[int], window: tuple[int, int, int, int], out: Path, options: FootageOptions
) -> None:
    top, left, height, width = window
    shrink = min(options.size / max(height, width), 1.0)
    size = max(round(height * shrink), 1), max(round(width * shrink), 1)
    camera = found.lens.camera.cropped(*window).resized(*size)
    wanted = {int(found.numbers[i]): i for i in kept}
    entries: list[dict[str, Any]] = []
    report: list[dict[str, Any]] = []
    for frame in frames(found.footage, invert_masks=options.invert_masks):
        if frame.number not in wanted:
            continue
        i, name = wanted[frame.number], f"{len(entries):04d}.png"
        full = undistorted(frame, found.lens)
        picture = developed(full.picture[top : top + height, left : left + width], found.gains[i], size)
        mask = _full_mask(found, i, full, window, picture)
        if not (mask == OBJECT).any():
            continue
        files.write_png(out / "images" / name, np.where(mask[..., None] == BACKGROUND, np.uint8(0), picture))
        files.write_png(out / "masks" / name, mask[..., None])
        entries.append(training_frame(name, None))
        report.append(_said(found, i, name))
    document = capture_document(camera, "camera", entries, setting=None, with_light=False)
    preview(found, out / PREVIEW, kept)
    provenance = {
        "source": str(found.footage.path),
        **origin(found.footage.path, options),
        "window_top_left_height_width": window,
        "focal_source": found.lens.source,
        "seed": None if found.seed is None else vars(found.seed),
        "seed_guessed": found.guessed,
        "frames": report,
    }
    files.write_json(out / PROVENANCE, provenance)
    files.write_json(out / "transforms.json", document | {"focal_source": found.lens.source})


def _said(found: Survey, i: int, name: str) -> dict[str, Any]:
    return {
        "name": name,
        "source_frame": int(found.numbers[i]),
        "time": float(found.times[i]),
        "gain": [float(g) for g in found.gains[i]],
        "mask_confidence": float(found.masks.confidence[i]),
        "blur": float(found.blurs[i]) if math.isfinite(found.blurs[i]) else None,
        "turned_degrees": math.degrees(float(found.turned[i])),
    }


def developed(picture: np.ndarray, gain: np.ndarray, size: tuple[int, int]) -> UInt8[np.ndarray, "i j 3"]:
    """The window without drift, averaged over the area of the new pixels in linear light."""
    picture = np.ascontiguousarray(picture)
    if np.abs(gain - 1).max() >= ALIKE:
        picture = compensate(picture, gain)
    if picture.shape[:2] == size:
        return picture
    linear = linear_from_srgb(torch.from_numpy(picture).float() / 255).numpy()
    return to_srgb8(torch.from_numpy(cv2.resize(linear, size[::-1], interpolation=cv2.INTER_AREA))).numpy()


def _full_mask(
    found: Survey, i: int, full: FootageFrame, window: tuple[int, int, int, int], picture: np.ndarray
) -> UInt8[np.ndarray, "h w"]:
    """The frame's mask on the written pixels: the given one, or the survey's brought to the picture's edges."""
    top, left, height, width = window
    h, w = picture.shape[:2]
    if full.mask is not None:
        return small_mask(np.ascontiguousarray(full.mask[top : top + height, left : left + width]), h, w)
    x, y = width / w * found.scale, height / h * found.scale
    place = np.array([[x, 0, left * found.scale + x / 2 - 0.5], [0, y, top * found.scale + y / 2 - 0.5]])
    how = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    coarse = cv2.warpAffine(found.masks.labels[i], place, (w, h), flags=how, borderMode=cv2.BORDER_REPLICATE)
    larger = 1 / max(x, y)
    return coarse if larger < 1.3 else segmentation.sharpened(picture, coarse, max(2, math.ceil(1.5 * larger)))
