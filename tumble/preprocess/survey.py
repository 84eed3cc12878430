"""Survey of footage: what small copies of all frames show.

One pass over the footage yields the static background, the camera's gain drift, the object's masks, how far the object
rotates and how sharp it is. `tumble check` reports them, and the conversion to a capture selects and segments frames
with them.

Background and masks depend on each other. They are estimated in turn: a background from static pixels without hands,
masks from it, then gains and background again without the masked pixels, and the masks once more. What the first masks
leave undecided is looked at separately, if no hand is in the film (`background.crossed_background`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Integer, UInt8

from tumble.io import BadFile
from tumble.preprocess import keyframes, propagation, sam, segmentation
from tumble.preprocess.background import (
    Background,
    BackgroundSamples,
    compensate,
    crossed_background,
    estimate_background,
    estimate_gains,
    fill_unknown,
    resting_background,
    sample_background,
)
from tumble.preprocess.camera_motion import MAX_CAMERA_MOTION, camera_motion
from tumble.preprocess.clicks import Click, correct_masks
from tumble.preprocess.colour_model import hand_coloured_fraction
from tumble.preprocess.footage import Footage, FootageFrame, Lens, open_footage, read_frames, resolve_lens
from tumble.preprocess.hands import Hand, hand_surroundings, track_hands
from tumble.preprocess.options import MAX_SURVEY_FRAMES, MIN_SIDE, FootageOptions
from tumble.preprocess.segmentation import Masks, Seed
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Camera

MAX_FRAMES = 36_000
"""Maximum number of frames of footage: 20 minutes at 30 frames per second."""
SURVEY_SIDE = 384
"""Longer side of the survey's copies of the frames [pixels]."""
MIN_CONFIDENCE = 0.6
"""Minimum mask confidence of a usable frame."""
MIN_GAIN_CHANGE = 0.01
"""Gains closer to 1 than this are not compensated: one code value."""

SURE_PRESENCE = 0.8
"""Probability of a hand from which a frame certainly shows one; a tracked hand needs less, and so do prints that pass
for a hand (median 0.6)."""
MIN_HAND_FRAMES = 0.25
"""Fraction of frames that certainly show a hand below which no hand counts: in films of hands it is 0.53 to 1, in films
of prints at most 0.05 (docs/experiments/hands-masks.md)."""
MAX_ROUNDS = 2
"""Maximum number of segmentations after the first one, which knows less of the background; a third changes nothing."""
MIN_UNCOVERED = 0.01
"""Newly known background for which masks are segmented once more, as a fraction of the object's area."""


@dataclass(frozen=True)
class Survey:
    """What the small copies of the frames show."""

    footage: Footage
    lens: Lens
    images: UInt8[np.ndarray, "t h w 3"]
    """Small undistorted frames without gain drift; sRGB code values."""
    numbers: Integer[np.ndarray, " t"]
    """Numbers of these frames in the footage."""
    times: Float64[np.ndarray, " t"]
    """Times of these frames [s]."""
    scale: float
    """Side of a small image divided by that of the footage."""
    background: Background
    gains: Float32[np.ndarray, "t 3"]
    """Gains that were divided out: linear, relative to the median frame."""
    masks: Masks
    seed: Seed | None
    """The object's position on one frame; None if masks were given."""
    seed_from_motion: bool
    """Whether the seed was found by motion, because neither box nor click was given."""
    hands: Sequence[Sequence[Hand]]
    """The hands that were detected in each frame; none if masks were given, or for SAM."""
    hand_coloured: Float32[np.ndarray, " t"]
    """Fraction of each mask with the colours of the hands, which is small unless a hand is taken for the object."""
    blurs: Float64[np.ndarray, " t"]
    """Blur of the edges on the object, from `keyframes.edge_blur` [pixels of the footage]."""
    still_camera: bool
    """Whether the masks suppose that the camera stood still; those that were given, and SAM's, do not."""
    camera_motion: float
    """Motion of the background, not a number if that is too plain to show any [longer side of the image]."""
    rotation: Float64[np.ndarray, " t"]
    """Angle by which the object has rotated since the first frame, summed along the path [radians]."""
    rotation_range: float
    """Largest angle by which the object is turned in one frame against another [radians]."""

    @property
    def inside(self) -> Bool[np.ndarray, "t h w"]:
        """Pixels that are certainly object."""
        return self.masks.labels == OBJECT

    @property
    def usable(self) -> Bool[np.ndarray, " t"]:
        """Frames with a reliable mask."""
        enough = self.inside.sum((1, 2)) >= segmentation.MIN_PIXELS
        return enough & (self.masks.confidence >= MIN_CONFIDENCE)


@dataclass(frozen=True)
class _Scan:
    """Small undistorted copies of the frames, with gain drift."""

    lens: Lens
    scale: float
    images: UInt8[np.ndarray, "t h w 3"]
    energy: Float32[np.ndarray, "t i j 2"]
    masks: UInt8[np.ndarray, "t h w"] | None
    numbers: Integer[np.ndarray, " t"]
    times: Float64[np.ndarray, " t"]


def survey_footage(path: Path, options: FootageOptions) -> Survey:
    """Read the footage once and estimate background, gains, masks, rotation and blur.

    Raises:
        BadFile: The footage cannot be read, or no object is found in it.
    """
    footage = open_footage(path, options.masks)
    scan = _read_scan(footage, options)
    if scan.masks is not None:
        if options.marks:
            fix = "leave out --box, --click, --object and --not-object"
            raise BadFile(path, "has masks, which neither a box nor clicks change", fix)
        covered = scan.masks != BACKGROUND
        gains, seed, masks = estimate_gains(scan.images, covered), None, _masks_from_labels(path, scan.masks)
        hands: list[list[Hand]] = [[] for _ in scan.images]
        images = _compensated(scan.images, gains)
        background = estimate_background(images, covered)
    else:
        images, gains, background, seed, masks, hands = _segment(path, scan, options)
    still_camera = scan.masks is None and options.segmenter == "grabcut"
    motion = camera_motion(images, background, masks.labels)
    if motion > MAX_CAMERA_MOTION:  # The brightness of a background that moves tells nothing about the exposure.
        images, gains = scan.images, np.ones_like(gains)
    inside = masks.labels == OBJECT
    size = (scan.energy.shape[2], scan.energy.shape[1])
    resized = [cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0 for mask in inside]
    blurs = np.array([keyframes.edge_blur(energy, mask) for energy, mask in zip(scan.energy, resized, strict=True)])
    rotation, rotation_range = keyframes.measured_rotation(images, inside)
    return Survey(
        footage=footage,
        lens=scan.lens,
        images=images,
        numbers=scan.numbers,
        times=scan.times,
        scale=scan.scale,
        background=background,
        gains=gains,
        masks=masks,
        seed=seed,
        seed_from_motion=seed is not None and not (options.box or options.click or options.object),
        hands=hands,
        hand_coloured=hand_coloured_fraction(images, inside, hands, background),
        blurs=blurs,
        still_camera=still_camera,
        camera_motion=motion,
        rotation=rotation,
        rotation_range=rotation_range,
    )


def to_clicks(
    object: Sequence[tuple[int, int, int]],
    not_object: Sequence[tuple[int, int, int]],
    numbers: Integer[np.ndarray, " t"],
    scale: float,
) -> list[Click]:
    """Clicks on small copies of the frames, from column, row and frame number of clicks on the footage.

    Args:
        numbers: Numbers, in the footage, of the frames that have a copy; a click on another frame counts for the next.
        scale: Side of a small image divided by that of the footage.
    """
    return [
        Click(int(np.abs(numbers - number).argmin()), (int(column * scale), int(row * scale)), is_object)
        for is_object, clicks in ((True, object), (False, not_object))
        for column, row, number in clicks
    ]


def undistort_frame(frame: FootageFrame, lens: Lens) -> FootageFrame:
    """The frame as a pinhole camera records it."""
    if lens.undistort is None:
        return frame
    mask = None if frame.mask is None else lens.undistort(frame.mask, cv2.INTER_NEAREST)
    return replace(frame, image=lens.undistort(frame.image, cv2.INTER_LINEAR), mask=mask)


def downsample_mask(mask: UInt8[np.ndarray, "h w"], height: int, width: int) -> UInt8[np.ndarray, "i j"]:
    """A smaller mask: a pixel is object or background if its whole area is (99 %), else unknown."""
    if mask.shape == (height, width):
        return mask
    fractions = [
        cv2.resize((mask == v).astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) for v in (0, 255)
    ]
    return np.select([fractions[0] > 0.99, fractions[1] > 0.99], [BACKGROUND, OBJECT], UNKNOWN).astype(np.uint8)


def _segment(
    path: Path, scan: _Scan, options: FootageOptions
) -> tuple[np.ndarray, np.ndarray, Background, Seed, Masks, list[list[Hand]]]:
    """Images without gain drift, their gains, the background, the seed, the masks and the hands."""
    images = _compensated(scan.images, estimate_gains(scan.images))
    hands = _hands(images) if options.segmenter == "grabcut" else [[] for _ in images]
    background = estimate_background(images)
    background = estimate_background(images, _hand_or_skin(images, hands, background))
    seed = _seed(path, scan, images, background, options)
    background = segmentation.exclude_possible_object(background, images[seed.index], seed)
    clicks = to_clicks(options.object, options.not_object, scan.numbers, scan.scale)
    masks = _masks(path, images, background, seed, hands, options)
    masks = correct_masks(images, masks, background, clicks, hands)
    covered = np.stack([cv2.dilate((m != BACKGROUND).astype(np.uint8), np.ones((5, 5))) for m in masks.labels]) > 0
    gains = estimate_gains(scan.images, covered)
    images = _compensated(scan.images, gains)
    background = fill_unknown(estimate_background(images, covered), background)
    for number in range(MAX_ROUNDS if options.segmenter == "grabcut" else 0):
        found = background if any(hands) else _uncovered_background(images, masks, background)
        new = (found.known & ~background.known).sum()
        if number and new <= MIN_UNCOVERED * np.median((masks.labels == OBJECT).sum((1, 2))):
            break
        background = found
        samples = sample_background(images, _at_hands(images, hands) | segmentation.possible_object(masks.labels))
        masks = _masks(path, images, background, seed, hands, options, samples)
        masks = correct_masks(images, masks, background, clicks, hands)
    return images, gains, background, seed, masks, hands


def _uncovered_background(images: np.ndarray, masks: Masks, background: Background) -> Background:
    """The background with what the object of a film without hands uncovers as it moves."""
    inside = masks.labels == OBJECT
    return resting_background(images, inside, crossed_background(images, inside, background))


def _hands(images: UInt8[np.ndarray, "t h w 3"]) -> list[list[Hand]]:
    """The hands of every frame; none in a film in which few frames show one, since a print passed for it there."""
    found = track_hands(images)
    sure = np.mean([any(hand.presence >= SURE_PRESENCE for hand in hands) for hands in found])
    return found if sure >= MIN_HAND_FRAMES else [[] for _ in images]


def _hand_or_skin(images: np.ndarray, hands: Sequence[Sequence[Hand]], background: Background) -> np.ndarray:
    """Pixels of every frame that may show hands: at their landmarks, or those of moving skin if none were detected."""
    if any(hands):
        return _at_hands(images, hands)
    return np.stack([segmentation.moving_skin(image, background) for image in images])


def _at_hands(images: np.ndarray, hands: Sequence[Sequence[Hand]]) -> Bool[np.ndarray, "t h w"]:
    """Pixels of every frame at the landmarks of its hands."""
    return np.stack([hand_surroundings(found, images.shape[1:3]) for found in hands])


def _read_scan(footage: Footage, options: FootageOptions) -> _Scan:
    small: list[tuple[FootageFrame, np.ndarray]] = []
    stride, lens, scale = 1, None, 1.0
    for frame in read_frames(footage, part=options.part, invert_masks=options.invert_masks):
        height, width = frame.image.shape[:2]
        if lens is None:
            lens, scale = lens_of(footage, options, height, width), min(SURVEY_SIDE / max(height, width), 1.0)
        if frame.number - options.first >= MAX_FRAMES:
            raise BadFile(
                footage.path, f"has more than {MAX_FRAMES} frames", "give --part, in which the object is turned"
            )
        if (frame.number - options.first) % stride:
            continue
        small.append(_downsample(undistort_frame(frame, lens), scale))
        if len(small) > MAX_SURVEY_FRAMES:
            small, stride = small[::2], 2 * stride
    if lens is None:
        raise BadFile(footage.path, "has no frames")
    _check_box_and_click(footage, options, lens.camera, range(options.first, small[-1][0].number + stride))
    kept = [frame for frame, _ in small]
    with_masks = [frame.mask for frame in kept if frame.mask is not None]
    if with_masks and len(with_masks) < len(kept):
        raise BadFile(footage.path, "has masks for some frames only", "give a mask for every frame, or none")
    return _Scan(
        lens,
        scale,
        np.stack([frame.image for frame in kept]),
        np.stack([energy for _, energy in small]),
        np.stack(with_masks) if with_masks else None,
        np.array([frame.number for frame in kept]),
        np.array([frame.time for frame in kept], np.float64),
    )


def lens_of(footage: Footage, options: FootageOptions, height: int, width: int) -> Lens:
    """The lens of footage with frames of this size, from options or metadata.

    Raises:
        BadFile: The frames are too small.
    """
    if min(height, width) < MIN_SIDE:
        raise BadFile(footage.path, f"has {width} x {height} pixels", f"the shorter side must have at least {MIN_SIDE}")
    return resolve_lens(
        footage,
        height,
        width,
        focal=options.focal,
        fov=options.fov,
        fisheye=options.fisheye,
        distortion=options.distortion,
    )


def _check_box_and_click(footage: Footage, options: FootageOptions, camera: Camera, used: range) -> None:
    left, top, width, height = options.box or ((*options.click, 1, 1) if options.click else (0, 0, 1, 1))
    if left < 0 or top < 0 or left + width > camera.width or top + height > camera.height:
        rule = f"has {camera.width} x {camera.height} pixels; the box or click lies outside"
        raise BadFile(footage.path, rule, "--box is left top width height, --click column row, in the upright image")
    used_frames = f"frames {used.start} to about {used.stop - 1} are used"
    if (options.box or options.click or options.at) and options.at not in used:
        raise BadFile(footage.path, f"{used_frames}, but --at is {options.at}", "mark the object on one of them")
    for column, row, number in (*options.object, *options.not_object):
        fix = "--object and --not-object are column, row and frame, counted from 0, in the upright image"
        if not (0 <= column < camera.width and 0 <= row < camera.height):
            rule = f"has {camera.width} x {camera.height} pixels; the click {column} {row} lies outside"
            raise BadFile(footage.path, rule, fix)
        if number not in used:
            raise BadFile(footage.path, f"{used_frames}, but a click is on frame {number}", fix)


def _downsample(frame: FootageFrame, scale: float) -> tuple[FootageFrame, np.ndarray]:
    """The frame at the survey's size, and its edge energy, measured at full size."""
    height, width = (max(round(side * scale), 1) for side in frame.image.shape[:2])
    image = cv2.resize(frame.image, (width, height), interpolation=cv2.INTER_AREA)
    energy = cv2.resize(keyframes.edge_energy(frame.image), (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    mask = None if frame.mask is None else downsample_mask(frame.mask, height, width)
    return replace(frame, image=image, mask=mask), energy.astype(np.float32)


def _compensated(images: UInt8[np.ndarray, "t h w 3"], gains: Float32[np.ndarray, "t 3"]) -> np.ndarray:
    pairs = zip(images, gains, strict=True)
    return np.stack([p if np.abs(gain - 1).max() < MIN_GAIN_CHANGE else compensate(p, gain) for p, gain in pairs])


def _seed(path: Path, scan: _Scan, images: np.ndarray, background: Background, options: FootageOptions) -> Seed:
    if options.box is None and options.click is None and options.object:
        first = to_clicks(options.object[:1], (), scan.numbers, scan.scale)[0]
        return Seed(first.index, click=first.pixel)
    if options.box is None and options.click is None:
        seed = segmentation.find_seed(images, background)
        if seed is None:
            fix = "draw a box in the browser with --pick, or give --box LEFT TOP WIDTH HEIGHT --at FRAME, or --masks"
            raise BadFile(path, "shows nothing that moves in front of a static background", fix)
        return seed
    index = int(np.abs(scan.numbers - options.at).argmin())
    if options.click is not None:
        return Seed(index, click=(int(options.click[0] * scan.scale), int(options.click[1] * scan.scale)))
    left, top, width, height = (v * scan.scale for v in options.box or ())
    low = math.floor(left), math.floor(top)
    return Seed(index, (*low, math.ceil(left + width) - low[0], math.ceil(top + height) - low[1]))


def _masks(
    path: Path,
    images: np.ndarray,
    background: Background,
    seed: Seed,
    hands: Sequence[Sequence[Hand]],
    options: FootageOptions,
    samples: BackgroundSamples | None = None,
) -> Masks:
    if options.segmenter != "grabcut":
        assert options.weights is not None, "checked by FootageOptions"
        inside = sam.SEGMENTERS[options.segmenter](images, seed, options.weights)
        pairs = zip(images, inside, strict=True)
        labels = np.stack([segmentation.make_trimap(m, background.differs(p) & ~m, 1) for p, m in pairs])
        return _masks_from_labels(path, labels)
    try:
        return propagation.segment(images, background, seed, hands, samples)
    except ValueError as error:
        fix = "the camera must stand still; if it does, give a --box around the whole object"
        raise BadFile(path, str(error), fix) from None


def _masks_from_labels(path: Path, labels: UInt8[np.ndarray, "t h w"]) -> Masks:
    """Masks used as they are; frames without object have confidence 0."""
    visible = (labels == OBJECT).sum((1, 2)) >= segmentation.MIN_PIXELS
    if not visible.any():
        raise BadFile(path, "has only empty masks", "the object must be white; use --invert-masks if it is black")
    return Masks(labels, visible.astype(np.float32), ~visible)
