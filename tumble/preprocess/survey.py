"""The first look at footage: small copies of all frames, and what they tell.

From them come the still background, the drift of the camera, the object on every frame, how far it turns and how sharp
it is: all that `tumble check` reports, and all that `ingest` needs to choose frames and to cut them out.

The backdrop and the masks need each other. So first a backdrop from all that is still and no hand, then masks; then the
drift and the backdrop again, from what no mask covers, and the masks again.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Integer, UInt8

from tumble.io.files import BadFile
from tumble.preprocess import keyframes, sam, segmentation
from tumble.preprocess.background import Backdrop, backdrop, compensate, completed, drift
from tumble.preprocess.footage import Footage, Frame, Lens, frames, lens, open_footage
from tumble.preprocess.segmentation import Masks, Seed
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN

MOST_FRAMES = 36_000
"""Frames read at most: 20 minutes at 30 per second."""
SURVEYED, SURVEY_SIDE = 400, 384
"""Frames that the survey keeps at most (every second, every fourth, ... of a longer film), and their longer side."""
LEAST_SIDE = 64
"""Smaller footage shows nothing to reconstruct [pixels]."""
LEAST_FRAMES = 3
"""A capture has at least this many."""
USABLE_CONFIDENCE = 0.6
"""Frames whose mask is less certain are left out."""
ALIKE = 0.01
"""Drift below this gain is left alone: one code value."""


@dataclass(frozen=True)
class Options:
    """How footage becomes a capture."""

    box: tuple[int, int, int, int] | None = None
    """Left, top, width, height around the object on frame `at` [pixels]. Left out: what moves and is no skin."""
    click: tuple[int, int] | None = None
    """A pixel on the object on frame `at`, instead of a box: column, row."""
    at: int = 0
    """The frame that box or click are on, counted from 0."""
    masks: Path | None = None
    """Folder of masks: white object, black background, grey unknown; one per frame, in order or by name."""
    invert_masks: bool = False
    """The masks' object is black."""
    segmenter: Literal["grabcut", "sam2", "sam3"] = "grabcut"
    """Who makes masks when none are given; sam2 and sam3 are your own installation, with `weights`."""
    weights: Path | None = None
    """Checkpoint of sam2 or sam3."""
    focal: float | None = None
    """Focal length in pixels of the film. Left out: from `fov`, else the metadata, else found with the poses, from a
    guess (a phone's 28 mm)."""
    fov: float | None = None
    """Horizontal field of view [degrees]."""
    fisheye: tuple[float, float, float, float] | None = None
    """A fisheye lens: OpenCV's k1 k2 k3 k4, zeros for the ideal one."""
    distortion: tuple[float, ...] | None = None
    """A normal lens that bends lines: OpenCV's k1 k2 p1 p2 [k3]."""
    light: Literal["object", "camera"] = "object"
    """Pictures with poses by COLMAP: what the light stood still with. object: the camera went round the object; camera:
    the object turned, and the background was masked. (A film's light always stands still with the camera.)"""
    frames: int = 144
    """Frames to keep at most."""
    size: int = 256
    """Longer side of the frames to write [pixels]; never more than the film has."""

    def __post_init__(self) -> None:
        if self.box is not None and self.click is not None:
            raise ValueError("--box and --click are two ways to say the same: give one")
        if self.box is not None and min(self.box[2:]) < 2:
            raise ValueError(f"--box is left, top, width, height; this one is {self.box[2]} x {self.box[3]}")
        if self.segmenter != "grabcut" and self.weights is None:
            raise ValueError(f"--segmenter {self.segmenter} needs --weights, the path of its checkpoint")
        if not LEAST_FRAMES <= self.frames <= SURVEYED or not LEAST_SIDE <= self.size <= 4096:
            raise ValueError(f"--frames is {LEAST_FRAMES} to {SURVEYED}, --size {LEAST_SIDE} to 4096")


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


def survey(path: Path, options: Options) -> Survey:
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


def undistorted(frame: Frame, glass: Lens) -> Frame:
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


def _segmented(path: Path, scan: _Scan, options: Options) -> tuple[np.ndarray, np.ndarray, Backdrop, Seed, Masks]:
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


def _scanned(footage: Footage, options: Options) -> _Scan:
    small: list[tuple[Frame, np.ndarray]] = []
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


def lens_of(footage: Footage, options: Options, height: int, width: int) -> Lens:
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


def _check_hint(footage: Footage, options: Options, camera: Camera, n_frames: int) -> None:
    left, top, width, height = options.box or ((*options.click, 1, 1) if options.click else (0, 0, 1, 1))
    if left < 0 or top < 0 or left + width > camera.width or top + height > camera.height:
        rule = f"is {camera.width} x {camera.height} pixels, the hint lies outside"
        raise BadFile(footage.path, rule, "--box is left top width height, --click column row, on the upright picture")
    if not 0 <= options.at < n_frames:
        raise BadFile(footage.path, f"has about {n_frames} frames, --at is {options.at}")


def _shrunk(frame: Frame, scale: float) -> tuple[Frame, np.ndarray]:
    """The frame made small, and its edges, measured before."""
    height, width = (max(round(side * scale), 1) for side in frame.picture.shape[:2])
    picture = cv2.resize(frame.picture, (width, height), interpolation=cv2.INTER_AREA)
    edges = cv2.resize(keyframes.edges(frame.picture), (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    mask = None if frame.mask is None else small_mask(frame.mask, height, width)
    return replace(frame, picture=picture, mask=mask), edges.astype(np.float32)


def _compensated(pictures: UInt8[np.ndarray, "t h w 3"], gains: Float32[np.ndarray, "t 3"]) -> np.ndarray:
    pairs = zip(pictures, gains, strict=True)
    return np.stack([p if np.abs(gain - 1).max() < ALIKE else compensate(p, gain) for p, gain in pairs])


def _seed(path: Path, scan: _Scan, pictures: np.ndarray, still: Backdrop, options: Options) -> Seed:
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


def _masks(path: Path, pictures: np.ndarray, still: Backdrop, seed: Seed, options: Options) -> Masks:
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
