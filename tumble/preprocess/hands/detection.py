"""Detection of hands in one image: palms, then 21 landmarks on each, as in MediaPipe (Zhang et al. 2020).

The palm network sees the whole image, also turned by 60 degrees to both sides, because it was trained on upright hands.
Each palm gives a *crop*, a square of the image that is turned so that the fingers point up; the landmark network sees
the crop. Positions in an image are in pixels, x to the right and y down from the corner of its first pixel, so that
pixel centres are at +0.5.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8

from tumble.preprocess.hands import networks

TURNS = (0.0, -math.pi / 3, math.pi / 3)
"""Rotations of the image in which palms are searched [rad]."""
MIN_PALM_SCORE = 0.3
"""Minimum score of a palm. MediaPipe's 0.5 finds fewer hands that hold an object; others have no presence."""
MIN_PRESENCE = 0.5
"""Minimum probability that a crop shows a hand."""
MAX_OVERLAP = 0.3
"""Overlap (IoU) above which two palms count as one."""
MAX_DISTANCE = 0.3
"""Distance between the centres of two crops, as a fraction of the larger one's side, below which they show one hand."""
PALM_TO_HAND = 2.6
"""Side of the crop of a hand as a multiple of its palm's box."""
PALM_SHIFT = 0.5
"""Distance of the centre of the crop from that of the palm's box, towards the fingers, as a fraction of the box."""
LANDMARKS_TO_HAND = 2.0
"""Side of the crop of a hand as a multiple of the box of its palm's landmarks and first finger joints."""
LANDMARKS_SHIFT = 0.1
"""Distance of the centre of the crop from that of this box, towards the fingers, as a fraction of the box."""
CROP_LANDMARKS = (0, 1, 2, 3, 5, 6, 9, 10, 13, 14, 17, 18)
"""Landmarks in this box: wrist, thumb without its tip, first two joints of each finger."""
WRIST, INDEX, MIDDLE, RING, LITTLE = 0, 5, 9, 13, 17
"""Landmarks of the wrist and of the knuckles."""


@dataclass(frozen=True)
class Hand:
    """A hand in an image."""

    landmarks: Float32[np.ndarray, "21 2"]
    """Wrist, then four joints of thumb, index, middle, ring and little finger, from the palm to the tip [pixels]."""
    presence: float
    """Probability that there is a hand."""
    right: float
    """Probability that it is a right hand."""

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Left, top, width, height of the box around the landmarks [pixels]."""
        low, high = self.landmarks.min(0), self.landmarks.max(0)
        return float(low[0]), float(low[1]), float(high[0] - low[0]), float(high[1] - low[1])


@dataclass(frozen=True)
class Crop:
    """A turned square of an image."""

    centre: Float[np.ndarray, "2"]
    """Position in the image [pixels]."""
    side: float
    """[pixels of the image]"""
    angle: float
    """Rotation from the crop to the image, clockwise as seen [rad]."""

    def to_image(self, size: int) -> Float[np.ndarray, "2 3"]:
        """Affine map from pixels of the crop, drawn with `size` pixels a side, to pixels of the image."""
        c, s = math.cos(self.angle) * self.side / size, math.sin(self.angle) * self.side / size
        linear = np.array([[c, -s], [s, c]])
        return np.column_stack([linear, self.centre - linear @ (size / 2, size / 2)])


@dataclass(frozen=True)
class Palm:
    """A palm in an image."""

    box: Float[np.ndarray, "4"]
    """x and y of the centre, width, height [pixels]."""
    keypoints: Float[np.ndarray, "7 2"]
    """Wrist, knuckles and thumb [pixels]; the third one is the knuckle of the middle finger."""
    score: float
    """Probability that there is a palm."""


def detect_hands(
    image: UInt8[np.ndarray, "h w 3"],
    *,
    turns: Sequence[float] = TURNS,
    min_palm_score: float = MIN_PALM_SCORE,
    min_presence: float = MIN_PRESENCE,
) -> list[Hand]:
    """Hands in an sRGB image, in order of decreasing presence.

    Args:
        image: The image.
        turns: Rotations of the image in which palms are searched [rad]; each costs one run of the palm network.
        min_palm_score: Minimum score of a palm.
        min_presence: Minimum probability of a hand.
    """
    height, width = image.shape[:2]
    views = [Crop(np.array([width / 2, height / 2]), max(height, width), turn) for turn in turns]
    crops = [crop_of_palm(p, v) for v in views for p in find_palms(image, v, min_palm_score)]
    return distinct([hand for hand in find_landmarks(image, crops) if hand.presence >= min_presence])


def distinct(hands: list[Hand]) -> list[Hand]:
    """Hands in one place count as one: the most probable stays."""
    kept: list[Hand] = []
    for hand in sorted(hands, key=lambda each: -each.presence):
        if not any(same_hand(hand, other) for other in kept):
            kept.append(hand)
    return kept


def same_hand(one: Hand, other: Hand) -> bool:
    """Whether two hands of one image, or of consecutive images, are in one place."""
    a, b = crop_of_hand(one), crop_of_hand(other)
    return bool(np.linalg.norm(a.centre - b.centre) < MAX_DISTANCE * max(a.side, b.side))


def draw(image: UInt8[np.ndarray, "h w 3"], crop: Crop, size: int, border: int) -> Float32[torch.Tensor, "3 size size"]:
    """The crop as an RGB image in [0, 1]; `border` says what lies outside the image (`cv2.BORDER_...`)."""
    A_image_crop = crop.to_image(size)
    # Bilinear interpolation at every third pixel of an image would see noise: average first.
    if (reduction := int(crop.side / size)) > 1:
        height, width = image.shape[:2]
        smaller = (math.ceil(width / reduction), math.ceil(height / reduction))
        image = cv2.resize(image, smaller, interpolation=cv2.INTER_AREA)
        A_image_crop = np.diag([smaller[0] / width, smaller[1] / height]) @ A_image_crop
    # OpenCV's pixel centres are at whole numbers.
    A_image_crop[:, 2] += A_image_crop[:, :2].sum(1) / 2 - 0.5
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    pixels = cv2.warpAffine(image, A_image_crop, (size, size), flags=flags, borderMode=border)
    return torch.from_numpy(pixels).permute(2, 0, 1).float() / 255


@cache
def anchors() -> Float[np.ndarray, "2016 2"]:
    """Centres of the cells in which palms are searched [pixels of the network's input]."""
    grids = []
    for n_cells, per_cell in ((24, 2), (12, 6)):
        centres = (np.arange(n_cells) + 0.5) * networks.PALM_SIDE / n_cells
        grid = np.stack(np.meshgrid(centres, centres), -1).reshape(-1, 2)
        grids.append(grid.repeat(per_cell, 0))
    return np.concatenate(grids)


def find_palms(image: UInt8[np.ndarray, "h w 3"], view: Crop, min_score: float) -> list[Palm]:
    """Palms in a view of an image, in pixels of the view."""
    logits, values = networks.palms(draw(image, view, networks.PALM_SIDE, cv2.BORDER_CONSTANT)[None])
    scores = logits[0].sigmoid().numpy()
    likely = scores >= min_score
    boxes = values[0].numpy()[likely].reshape(-1, 9, 2).astype(np.float64)
    boxes[:, :1] += anchors()[likely][:, None]
    boxes[:, 2:] += anchors()[likely][:, None]
    return list(_merged(boxes.reshape(-1, 18), scores[likely]))


def _merged(boxes: Float[np.ndarray, "n 18"], scores: Float[np.ndarray, " n"]) -> Iterator[Palm]:
    """Boxes that overlap the best one become their mean, weighted by score; then the same with the others."""
    centre, half = boxes[:, :2], boxes[:, 2:4] / 2
    corners = np.column_stack([centre - half, centre + half])
    rest = np.argsort(-scores, kind="stable")
    while len(rest):
        same = np.array([overlap(corners[rest[0]], corners[i]) > MAX_OVERLAP for i in rest])
        same[0] = True
        mean = np.average(boxes[rest[same]], 0, weights=scores[rest[same]])
        yield Palm(mean[:4], mean[4:].reshape(7, 2), float(scores[rest[0]]))
        rest = rest[~same]


def overlap(a: Sequence[float] | np.ndarray, b: Sequence[float] | np.ndarray) -> float:
    """Intersection over union of two boxes: left, top, right, bottom."""
    width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    shared = max(width, 0) * max(height, 0)
    union = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - shared
    return shared / union if union > 0 else 0.0


def _upright(wrist: Float[np.ndarray, "2"], knuckle: Float[np.ndarray, "2"]) -> float:
    """Angle of a crop in which the knuckle is above the wrist [rad]."""
    x, y = knuckle - wrist
    return math.atan2(x, -y)


def crop_of_palm(palm: Palm, view: Crop) -> Crop:
    """The part of the image that shows the hand of a palm found in a view."""
    angle = _upright(palm.keypoints[0], palm.keypoints[2])
    up = np.array([math.sin(angle), -math.cos(angle)])
    A_image_view = view.to_image(networks.PALM_SIDE)
    centre = A_image_view[:, :2] @ (palm.box[:2] + PALM_SHIFT * palm.box[3] * up) + A_image_view[:, 2]
    side = PALM_TO_HAND * palm.box[2:].max() * view.side / networks.PALM_SIDE
    return Crop(centre, side, angle + view.angle)


def crop_of_hand(hand: Hand) -> Crop:
    """The part of the image that shows a hand, from its landmarks."""
    points = hand.landmarks.astype(np.float64)
    angle = _upright(points[WRIST], (points[INDEX] + points[RING]) / 4 + points[MIDDLE] / 2)
    c, s = math.cos(angle), math.sin(angle)
    R_image_crop = np.array([[c, -s], [s, c]])
    upright = points[list(CROP_LANDMARKS)] @ R_image_crop
    low, high = upright.min(0), upright.max(0)
    size = high - low
    centre = R_image_crop @ ((low + high) / 2 - (0, LANDMARKS_SHIFT * size[1]))
    return Crop(centre, LANDMARKS_TO_HAND * size.max(), angle)


def find_landmarks(image: UInt8[np.ndarray, "h w 3"], crops: Sequence[Crop]) -> list[Hand]:
    """What the landmark network sees in each crop, whether it is a hand or not."""
    if not crops:
        return []
    size = networks.LANDMARK_SIDE
    inputs = torch.stack([draw(image, crop, size, cv2.BORDER_REPLICATE) for crop in crops])
    points, presences, rights = (each.numpy() for each in networks.landmarks(inputs))
    hands = []
    for crop, seen, presence, right in zip(crops, points, presences, rights, strict=True):
        A_image_crop = crop.to_image(size)
        positions = seen[:, :2] @ A_image_crop[:, :2].T + A_image_crop[:, 2]
        hands.append(Hand(positions.astype(np.float32), float(presence), float(right)))
    return hands
