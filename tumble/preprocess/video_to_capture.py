"""Conversion of a video or a folder of images to a capture folder: frames, masks and one pinhole camera, without poses.

The footage is read twice. The survey analyses small copies of all frames. The second pass reads the selected frames at
full size, corrects lens distortion and gain drift, crops them to one window around the object's path, and refines the
masks at the edges of the larger images. The window is the same for all frames, so the camera stays one pinhole camera
with a shifted principal point.
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
from jaxtyping import Bool, UInt8

from tumble.datasets import capture_document, training_frame
from tumble.io import BadFile, files, video
from tumble.maths import crop_box, linear_from_srgb, to_srgb8
from tumble.preprocess import keyframes, segmentation
from tumble.preprocess.background import channel_max, compensate, settle_border
from tumble.preprocess.camera_motion import MAX_CAMERA_MOTION
from tumble.preprocess.footage import PROVENANCE, FootageFrame, read_frames
from tumble.preprocess.options import MIN_FRAMES, FootageOptions
from tumble.preprocess.survey import MIN_GAIN_CHANGE, Survey, downsample_mask, survey_footage, undistort_frame
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN

MIN_ROTATION = math.radians(40)
"""Minimum total rotation of the object; a smaller one cannot be reconstructed and may be noise [radians]."""
MARGIN = 0.08
"""Margin of the crop window around the object's path, as a fraction of the path's longer side."""
USUAL_EXTENT = 0.9
"""Quantile over the frames of the longer side of the object's bounding box that counts as its extent: hands hide parts
of it in many frames, and some masks contain more than the object."""
MAX_LARGER = 2.0
"""Largest factor between the longer sides of the capture's images and of a window around the object."""
MAX_TEXTURE = 24
"""Largest difference between neighbouring pixels of the survey's background where it tells the border of the object
[code values]; in front of finer texture the background of a pixel of another size is not known well enough."""
UNCERTAIN_EDGE = (220, 30, 30)
"""Border colour of frames with an uncertain mask in the preview (red)."""
KEPT_EDGE = (40, 200, 60)
"""Border colour of selected frames in the preview (green)."""
DROPPED_EDGE = (60, 60, 60)
"""Border colour of the other frames in the preview (grey)."""
LEFT_BY_WINDOWS = ("thumbs.db", "desktop.ini")
"""Files that Windows leaves in folders at which somebody looks; those of other systems begin with a dot."""
PREVIEW = "mask_preview.mp4"
"""File name of the preview of the masks."""


def capture_from_video(path: Path, out: Path, options: FootageOptions | None = None) -> Path:
    """Convert a video or a folder of images to a capture folder (docs/format.md) without poses; returns the folder.

    The folder also contains `mask_preview.mp4`, and `ingest.json`, the record of how every frame was made.

    Raises:
        BadFile: The footage cannot be converted, or `out` is not empty; nothing is written then.
    """
    options = options or FootageOptions()
    require_new_folder(out)
    survey = survey_footage(path, options)
    kept = select_frames(survey, options)
    window = crop_window(survey, kept)
    return write_folder(out, lambda partial: _write(survey, kept, window, partial, options))


def require_new_folder(out: Path) -> None:
    """Check that a path does not exist or is an empty folder.

    Raises:
        BadFile: It is something else.
    """
    if out.exists() and not out.is_dir():
        raise BadFile(out, "is a file, where a folder is to be written", "choose a new folder")
    if out.exists() and any(out.iterdir()):
        raise BadFile(out, "exists already", "choose a new folder")


def write_folder(out: Path, write: Callable[[Path], None]) -> Path:
    """Fill a temporary folder by `write` and rename it to `out`; returns `out`.

    So an interruption leaves no incomplete `out`.
    """
    with files.describe_write_errors(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=files.partial_prefix(), dir=out.parent))
    try:
        write(partial)
        partial.chmod(0o755)
        partial.replace(out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return out


def footage_fingerprint(path: Path, options: FootageOptions) -> dict[str, Any]:
    """What a capture made from footage depends on: the hashes of footage and masks, and the options."""
    # Without clicks and part the options are those of captures made before there were any.
    stated = {name: value for name, value in vars(options).items() if value != () and (name, value) != ("part", None)}
    masks = "" if options.masks is None else _digest(options.masks)
    return {"footage": _digest(path), "masks": masks, "options": json.loads(json.dumps(stated, default=str))}


def _digest(path: Path) -> str:
    """SHA-256 of a file, or of all files in a folder but those that a file manager leaves there."""
    digest = hashlib.sha256()
    for each in sorted(p for p in path.rglob("*") if _is_footage(p, path)) if path.is_dir() else [path]:
        with each.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def _is_footage(path: Path, folder: Path) -> bool:
    hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
    return path.is_file() and not hidden and path.name.lower() not in LEFT_BY_WINDOWS


def select_frames(survey: Survey, options: FootageOptions) -> list[int]:
    """Indices, in the survey, of the selected frames: keyframes of a video, evenly spaced images of a folder.

    Raises:
        BadFile: The camera moved, the object hardly rotates, or too few frames show it.
    """
    path, usable = survey.footage.path, survey.usable
    if survey.still_camera and survey.camera_motion > MAX_CAMERA_MOTION:
        rule = (
            f"was recorded by a moving camera: the background moves by {100 * survey.camera_motion:.1f} % of the image"
        )
        raise BadFile(path, rule, "put the camera on a tripod, or give --masks")
    if survey.footage.images:
        candidates = np.nonzero(usable)[0]
        spread = np.linspace(0, len(candidates) - 1, min(options.frames, len(candidates))).round().astype(int)
        kept = [int(i) for i in candidates[spread]]
    else:
        if survey.rotation[-1] < MIN_ROTATION:
            rule = f"shows an object that rotates by only {math.degrees(survey.rotation[-1]):.0f} degrees in total"
            raise BadFile(
                path, rule, "turn the object by 360 degrees; rotation is not measured without surface texture"
            )
        kept = keyframes.select_keyframes(survey.rotation, survey.blurs, usable, options.frames)
    if len(kept) < MIN_FRAMES:
        raise BadFile(path, f"shows the object on {len(kept)} usable frames only", "run `tumble check` to find out why")
    return kept


def crop_window(survey: Survey, kept: list[int]) -> tuple[int, int, int, int]:
    """Top, left, height, width of the window around the object on all selected frames [pixels of the footage]."""
    union = np.logical_or.reduce(survey.inside[kept])
    rows, columns = np.nonzero(union.any(1))[0], np.nonzero(union.any(0))[0]
    height, width = survey.lens.camera.height, survey.lens.camera.width
    margin = 2 + MARGIN * max(rows[-1] - rows[0] + 1, columns[-1] - columns[0] + 1)
    top, left = ((max(low - margin, 0) / survey.scale) for low in (rows[0], columns[0]))
    bottom = min((rows[-1] + 1 + margin) / survey.scale, height)
    right = min((columns[-1] + 1 + margin) / survey.scale, width)
    top, left = math.floor(top), math.floor(left)
    return top, left, math.ceil(bottom) - top, math.ceil(right) - left


def image_scale(survey: Survey, kept: list[int], window: tuple[int, int, int, int], size: int) -> float:
    """Scale of the capture's images [pixels of an image per pixel of the footage], at most 1.

    `size` is the longer side of a window around the object of a single frame, and that of the images if the object
    stays in its place. A hand moves it about, and in images of that size it would be small: they are up to
    `MAX_LARGER` times as large.
    """
    boxes = [crop_box(torch.from_numpy(inside), 0) for inside in survey.inside[kept]]
    extent = float(np.quantile([max(box[2:]) for box in boxes], USUAL_EXTENT)) / survey.scale
    path = max(window[2:])
    larger = path / ((1 + 2 * MARGIN) * extent)
    return min(size / path * min(max(larger, 1.0), MAX_LARGER), 1.0)


def write_preview(survey: Survey, path: Path, kept: list[int]) -> None:
    """Write a video of the masks; selected frames have a green border, frames with an uncertain mask a red one."""
    edges = [
        UNCERTAIN_EDGE if uncertain else KEPT_EDGE if i in kept else DROPPED_EDGE
        for i, uncertain in enumerate(survey.masks.uncertain)
    ]
    overlays = map(mask_overlay, survey.images, map(survey.masks.with_doubt, range(len(edges))), edges)
    video.write_clip(path, overlays, quality=24)


def mask_overlay(
    image: UInt8[np.ndarray, "h w 3"], labels: UInt8[np.ndarray, "h w"], edge: tuple[int, int, int]
) -> UInt8[np.ndarray, "i j 3"]:
    """Image with the background darkened, unknown pixels orange and a border; its sides are even, as H.264 requires."""
    h, w = (side // 2 * 2 for side in labels.shape)
    overlay = image.copy()
    overlay[labels == BACKGROUND] //= 3
    overlay[labels == UNKNOWN] = overlay[labels == UNKNOWN] // 2 + np.array([120, 60, 0], np.uint8)
    return cv2.rectangle(overlay[:h, :w].copy(), (0, 0), (w - 1, h - 1), edge, 3)


# The second pass ------------------------------------------------------------------------------------------------------


def _write(
    survey: Survey, kept: list[int], window: tuple[int, int, int, int], out: Path, options: FootageOptions
) -> None:
    top, left, height, width = window
    shrink = image_scale(survey, kept, window, options.size)
    size = max(round(height * shrink), 1), max(round(width * shrink), 1)
    camera = survey.lens.camera.cropped(*window).resized(*size)
    indices = {int(survey.numbers[i]): i for i in kept}
    held = any(survey.hands)
    # A hand beside the object is no background, and masks of the user's own are better than this.
    behind = None if held or survey.seed is None else _output_background(survey, window, size)
    entries: list[dict[str, Any]] = []
    records: list[dict[str, Any]] = []
    for frame in read_frames(survey.footage, part=options.part, invert_masks=options.invert_masks):
        if frame.number not in indices:
            continue
        i, name = indices[frame.number], f"{len(entries):04d}.png"
        full = undistort_frame(frame, survey.lens)
        image = resample(full.image[top : top + height, left : left + width], survey.gains[i], size)
        mask = _output_mask(survey, i, full, window, image)
        shown, mask = (image, mask) if behind is None else settle_border(image, mask, *behind)
        if not (mask == OBJECT).any():
            continue
        # Doubted background is black like all background, which tells it from what may hide the object.
        files.write_png(out / "images" / name, np.where(mask[..., None] == BACKGROUND, np.uint8(0), shown))
        files.write_png(out / "masks" / name, _with_doubt(survey, i, mask, window)[..., None])
        # Masks of a held object may contain background; what is around the object shows its contour in stage 1, and
        # after it which parts of the masks are background.
        if held:
            files.write_png(out / "full_images" / name, image)
        entries.append(training_frame(name, None, full=held))
        records.append(_frame_record(survey, i, name))
    document = capture_document(camera, "camera", entries, setting=None, with_light=False)
    write_preview(survey, out / PREVIEW, kept)
    provenance = {
        "source": str(survey.footage.path),
        **footage_fingerprint(survey.footage.path, options),
        "window_top_left_height_width": window,
        "focal_source": survey.lens.source,
        "seed": None if survey.seed is None else vars(survey.seed),
        "seed_guessed": survey.seed_from_motion,
        "frames": records,
    }
    files.write_json(out / PROVENANCE, provenance)
    files.write_json(out / "transforms.json", document | {"focal_source": survey.lens.source})


def _frame_record(survey: Survey, i: int, name: str) -> dict[str, Any]:
    return {
        "name": name,
        "source_frame": int(survey.numbers[i]),
        "time": float(survey.times[i]),
        "gain": [float(g) for g in survey.gains[i]],
        "mask_confidence": float(survey.masks.confidence[i]),
        "hand_coloured": float(survey.hand_coloured[i]),
        "blur": float(survey.blurs[i]) if math.isfinite(survey.blurs[i]) else None,
        "turned_degrees": math.degrees(float(survey.rotation[i])),
    }


def resample(image: np.ndarray, gain: np.ndarray, size: tuple[int, int]) -> UInt8[np.ndarray, "i j 3"]:
    """The window with the gain divided out, resampled by area averaging in linear light."""
    image = np.ascontiguousarray(image)
    if np.abs(gain - 1).max() >= MIN_GAIN_CHANGE:
        image = compensate(image, gain)
    if image.shape[:2] == size:
        return image
    linear = linear_from_srgb(torch.from_numpy(image).float() / 255).numpy()
    return to_srgb8(torch.from_numpy(cv2.resize(linear, size[::-1], interpolation=cv2.INTER_AREA))).numpy()


def _output_mask(
    survey: Survey, i: int, full: FootageFrame, window: tuple[int, int, int, int], image: np.ndarray
) -> UInt8[np.ndarray, "h w"]:
    """The frame's mask at the output size: the given one, or the survey's refined at the edges of the image."""
    top, left, height, width = window
    h, w = image.shape[:2]
    if full.mask is not None:
        return downsample_mask(np.ascontiguousarray(full.mask[top : top + height, left : left + width]), h, w)
    coarse = _at_output(survey.masks.labels[i], survey, window, (h, w), cv2.INTER_NEAREST)
    factor = 1 / (survey.scale * max(width / w, height / h))
    return coarse if factor < 1.3 else segmentation.refine_mask(image, coarse, max(2, math.ceil(1.5 * factor)))


def _with_doubt(
    survey: Survey, i: int, mask: UInt8[np.ndarray, "h w"], window: tuple[int, int, int, int]
) -> UInt8[np.ndarray, "h w"]:
    """A frame's mask at the output size with its doubted background unknown."""
    if survey.masks.doubted is None:
        return mask
    size = mask.shape[0], mask.shape[1]
    doubted = _at_output(survey.masks.doubted[i].astype(np.uint8), survey, window, size, cv2.INTER_NEAREST) > 0
    return segmentation.with_doubt(mask, doubted)


def _output_background(
    survey: Survey, window: tuple[int, int, int, int], size: tuple[int, int]
) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """The static background at the output size, and where it is known and smooth enough for a single pixel."""
    background, square = survey.background, np.ones((3, 3), np.uint8)
    texture = channel_max(cv2.morphologyEx(background.image, cv2.MORPH_GRADIENT, square))
    known = background.known & (texture <= MAX_TEXTURE)
    known = cv2.erode(known.astype(np.uint8), square)
    behind = _at_output(background.image, survey, window, size, cv2.INTER_LINEAR)
    return behind, _at_output(known, survey, window, size, cv2.INTER_NEAREST) > 0


def _at_output(
    values: UInt8[np.ndarray, "i j *c"],
    survey: Survey,
    window: tuple[int, int, int, int],
    size: tuple[int, int],
    interpolation: int,
) -> UInt8[np.ndarray, "h w *c"]:
    """An image of the survey's size, cut to the window and resampled to the output size."""
    (top, left, height, width), (h, w) = window, size
    x, y = width / w * survey.scale, height / h * survey.scale
    affine = np.array([[x, 0, left * survey.scale + x / 2 - 0.5], [0, y, top * survey.scale + y / 2 - 0.5]])
    flags = interpolation | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(values, affine, (w, h), flags=flags, borderMode=cv2.BORDER_REPLICATE)
