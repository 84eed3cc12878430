"""The first look at footage: small copies of all frames, and what they tell.

From them come the still background, the drift of the camera, the object on every frame, how far it turns and how sharp
it is: all that `tumble check` reports, and all that `ingest` needs to choose frames and to cut them out.

The backdrop and the masks need each other. So first a backdrop from all that is still and no hand, then masks; then the
drift and the backdrop again, from what no mask covers, and the masks again.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Integer, UInt8

from tumble.io import BadFile
from tumble.preprocess import keyframes, sam, segmentation
from tumble.preprocess.background import Backdrop, backdrop, compensate, completed, drift
from tumble.preprocess.footage import Footage, FootageFrame, Lens, frames, lens, open_footage
from tumble.preprocess.options import LEAST_SIDE, SURVEYED, FootageOptions
from tumble.preprocess.segmentation import Masks, Seed
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Camera

MOST_FRAMES = 36_000
"""Frames read at most: 20 minutes at 30 per second."""
SURVEY_SIDE = 384
"""Longer side of the survey's copies of the frames [pixels]."""
USABLE_CONFIDENCE = 0.6
"""Frames whose mask is less certain are left out."""
ALIKE = 0.01
"""Drift below this gain is left alone: one code value."""


@dataclass(frozen=True)
class Survey:
    """What the small copies of the frames tell."""

    footage: Footage
    lens: Lens
    pictures: UInt8[np.ndarray, "t h w 3"]
    """Small, undistorted, without the camera's drift; sRGB code values."""
    numbers: Integer[np.ndarray, " t"]
    """Of these frames in the footage."""
    times: Float64[np.ndarray, " t"]
    """[s]"""
    scale: float
    """Size of a small picture relative to the footage's."""
    backdrop: Backdrop
    gains: Float32[np.ndarray, "t 3"]
    """The drift that was taken out: linear, against the median frame."""
    masks: Masks
    seed: Seed | None
    """None when masks were given."""
    guessed: bool
    """No hint was given: the seed was found by motion."""
    blurs: Float64[np.ndarray, " t"]
    """Width of the edges on the object, as `selection.blur` measures it [pixels of the footage]."""
    turned: Float64[np.ndarray, " t"]
    """Turn of the object since the first frame [radians]."""

    @property
    def inside(self) -> Bool[np.ndarray, "t h w"]:
        """What shows the object, surely or at its border."""
        return self.masks.labels == OBJECT

    @property
    def usable(self) -> Bool[np.ndarray, " t"]:
        """Frames with a mask to rely on."""
        enough = self.inside.sum((1, 2)) >= segmentation.LEAST_PIXELS
        return enough & (self.masks.confidence >= USABLE_CONFIDENCE)


@dataclass(frozen=True)
class _Scan:
    """Small copies of the frames as they are."""

    lens: Lens
    scale: float
    pictures: UInt8[np.ndarray, "t h w 3"]
    edges: Float32[np.ndarray, "t i j 2"]
    masks: UInt8[np.ndarray, "t h w"] | None
    numbers: Integer[np.ndarray, " t"]
    times: Float64[np.ndarray, " t"]


def survey(path: Path, options: FootageOptions) -> Survey:
    """Read the footage once and learn what is in it.

    Raises:
        BadFile: The footage cannot be read, or no object is found in it.
    """
    footage = open_footage(path, options.masks)
    scan = _scanned(footage, options)
    if scan.masks is not None:
        covered = scan.masks != BACKGROUND
        gains, seed, masks = drift(scan.pictures, covered), None, _given(path, scan.masks)
        pictures = _compensated(scan.pictures, gains)
        still = backdrop(pictures, covered)
    else:
        pictures, gains, still, seed, masks = _segmented(path, scan, options)
    inside = masks.labels == OBJECT
    size = (scan.edges.shape[2], scan.edges.shape[1])
    on_edges = [cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0 for mask in inside]
    blurs = np.array([keyframes.blur(edges, mask) for edges, mask in zip(scan.edges, on_edges, strict=True)])
    return Survey(
        footage=footage,
        lens=scan.lens,
        pictures=pictures,
        numbers=scan.numbers,
        times=scan.times,
        scale=scan.scale,
        backdrop=still,
        gains=gains,
        masks=masks,
        seed=seed,
        guessed=seed is not None and options.box is None and options.click is None,
        blurs=blurs,
        turned=keyframes.turned(pictures, inside),
    )


def undistorted(frame: FootageFrame, glass: Lens) -> FootageFrame:
    """The frame as the pinhole camera sees it."""
    if glass.undistort is None:
        return frame
    mask = None if frame.mask is None else glass.undistort(frame.mask, cv2.INTER_NEAREST)
    return replace(frame, picture=glass.undistort(frame.picture, cv2.INTER_LINEAR), mask=mask)


def small_mask(mask: UInt8[np.ndarray, "h w"], height: int, width: int) -> UInt8[np.ndarray, "i j"]:
    """A pixel is object or background when all it covers is, else unknown."""
    if mask.shape == (height, width):
        return mask
    shares = [
        cv2.resize((mask == v).astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) for v in (0, 255)
    ]
    return np.select([shares[0] > 0.99, shares[1] > 0.99], [BACKGROUND, OBJECT], UNKNOWN).astype(np.uint8)


def _segmented(
    path: Path, scan: _Scan, options: FootageOptions
) -> tuple[np.ndarray, np.ndarray, Backdrop, Seed, Masks]:
    """Pictures without drift, the drift, the backdrop, the seed and the masks."""
    pictures = _compensated(scan.pictures, drift(scan.pictures))
    still = backdrop(pictures)
    still = backdrop(pictures, np.stack([segmentation.hands(picture, still) for picture in pictures]))
    seed = _seed(path, scan, pictures, still, options)
    still = segmentation.trusted(still, pictures[seed.index], seed)
    masks = _masks(path, pictures, still, seed, options)
    covered = np.stack([cv2.dilate((m != BACKGROUND).astype(np.uint8), np.ones((5, 5))) for m in masks.labels]) > 0
    gains = drift(scan.pictures, covered)
    pictures = _compensated(scan.pictures, gains)
    still = completed(backdrop(pictures, covered), still)
    if options.segmenter == "grabcut":
        masks = _masks(path, pictures, still, seed, options)
    return pictures, gains, still, seed, masks


def _scanned(footage: Footage, options: FootageOptions) -> _Scan:
    small: list[tuple[FootageFrame, np.ndarray]] = []
    stride, glass, scale = 1, None, 1.0
    for frame in frames(footage, invert_masks=options.invert_masks):
        height, width = frame.picture.shape[:2]
        if glass is None:
            glass, scale = lens_of(footage, options, height, width), min(SURVEY_SIDE / max(height, width), 1.0)
        if frame.number >= MOST_FRAMES:
            raise BadFile(footage.path, f"has more than {MOST_FRAMES} frames", "cut the part in which the object turns")
        if frame.number % stride:
            continue
        small.append(_shrunk(undistorted(frame, glass), scale))
        if len(small) > SURVEYED:
            small, stride = small[::2], 2 * stride
    if glass is None:
        raise BadFile(footage.path, "holds no frames")
    _check_hint(footage, options, glass.camera, 1 + small[-1][0].number + stride - 1)
    kept = [frame for frame, _ in small]
    with_masks = [frame.mask for frame in kept if frame.mask is not None]
    if with_masks and len(with_masks) < len(kept):
        raise BadFile(footage.path, "has masks for some frames only", "give all frames a mask, or none")
    return _Scan(
        glass,
        scale,
        np.stack([frame.picture for frame in kept]),
        np.stack([edges for _, edges in small]),
        np.stack(with_masks) if with_masks else None,
        np.array([frame.number for frame in kept]),
        np.array([frame.time for frame in kept], np.float64),
    )


def lens_of(footage: Footage, options: FootageOptions, height: int, width: int) -> Lens:
    """The lens of footage whose frames have this size."""
    if min(height, width) < LEAST_SIDE:
        raise BadFile(footage.path, f"is {width} x {height} pixels", f"the shorter side needs {LEAST_SIDE} at least")
    return lens(
        footage,
        height,
        width,
        focal=options.focal,
        fov=options.fov,
        fisheye=options.fisheye,
        distortion=options.distortion,
    )


def _check_hint(footage: Footage, options: FootageOptions, camera: Camera, n_frames: int) -> None:
    left, top, width, height = options.box or ((*options.click, 1, 1) if options.click else (0, 0, 1, 1))
    if left < 0 or top < 0 or left + width > camera.width or top + height > camera.height:
        rule = f"is {camera.width} x {camera.height} pixels, the hint lies outside"
        raise BadFile(footage.path, rule, "--box is left top width height, --click column row, on the upright picture")
    if not 0 <= options.at < n_frames:
        raise BadFile(footage.path, f"has about {n_frames} frames, --at is {options.at}")


def _shrunk(frame: FootageFrame, scale: float) -> tuple[FootageFrame, np.ndarray]:
    """The frame made small, and its edges, measured before."""
    height, width = (max(round(side * scale), 1) for side in frame.picture.shape[:2])
    picture = cv2.resize(frame.picture, (width, height), interpolation=cv2.INTER_AREA)
    edges = cv2.resize(keyframes.edges(frame.picture), (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    mask = None if frame.mask is None else small_mask(frame.mask, height, width)
    return replace(frame, picture=picture, mask=mask), edges.astype(np.float32)


def _compensated(pictures: UInt8[np.ndarray, "t h w 3"], gains: Float32[np.ndarray, "t 3"]) -> np.ndarray:
    pairs = zip(pictures, gains, strict=True)
    return np.stack([p if np.abs(gain - 1).max() < ALIKE else compensate(p, gain) for p, gain in pairs])


def _seed(path: Path, scan: _Scan, pictures: np.ndarray, still: Backdrop, options: FootageOptions) -> Seed:
    if options.box is None and options.click is None:
        seed = segmentation.find_seed(pictures, still)
        if seed is None:
            fix = "draw a box in the browser: --pick; or --box LEFT TOP WIDTH HEIGHT on --at FRAME; or --masks"
            raise BadFile(path, "shows nothing that moves before a still background", fix)
        return seed
    index = int(np.abs(scan.numbers - options.at).argmin())
    if options.click is not None:
        return Seed(index, click=(int(options.click[0] * scan.scale), int(options.click[1] * scan.scale)))
    left, top, width, height = (v * scan.scale for v in options.box or ())
    low = math.floor(left), math.floor(top)
    return Seed(index, (*low, math.ceil(left + width) - low[0], math.ceil(top + height) - low[1]))


def _masks(path: Path, pictures: np.ndarray, still: Backdrop, seed: Seed, options: FootageOptions) -> Masks:
    if options.segmenter != "grabcut":
        assert options.weights is not None, "checked where options are made"
        inside = sam.SEGMENTERS[options.segmenter](pictures, seed, options.weights)
        pairs = zip(pictures, inside, strict=True)
        labels = np.stack([segmentation.three_valued(m, still.differs(p) & ~m, 1) for p, m in pairs])
        return _given(path, labels)
    try:
        return segmentation.segment(pictures, still, seed)
    except ValueError as error:
        fix = "the camera must stand still; if it does, give a --box around the whole object"
        raise BadFile(path, str(error), fix) from None


def _given(path: Path, labels: UInt8[np.ndarray, "t h w"]) -> Masks:
    """Masks that are taken as they are; frames without object have no confidence."""
    shown = (labels == OBJECT).sum((1, 2)) >= segmentation.LEAST_PIXELS
    if not shown.any():
        raise BadFile(path, "has masks, and all are empty", "white is the object; --invert-masks if it is black")
    return Masks(labels, shown.astype(np.float32), ~shown)
