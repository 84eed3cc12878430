"""How likely a pixel shows the object, the hand that holds it, or the background: colours, and the still backdrop.

Three histograms over CIE Lab, learnt as the film goes on, and a normal distribution about the backdrop where that is
known. All are densities per cubic code value, so that they can be compared. The answers are combined by Bayes' rule
with a prior from the frame before, and smoothed by a few rounds of mean field over neighbours of similar colour.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Shaped, UInt8

from tumble.preprocess.background import Backdrop, worst

BINS = (8, 32, 32)
"""Of lightness, a and b: shading changes lightness most."""
BIN_VOLUME = 256.0**3 / (8 * 32 * 32)
ANYTHING = 256.0**-3
"""Density of a colour of which nothing is known."""
NEW_OBJECT, NEW_HAND, NEW_BACKGROUND = 0.1, 0.02, 0.001
"""Share of each class that has never been seen: the object shows new sides, the hand hardly, a still backdrop never."""
SHADOW_PENALTY, DARKEST_SHADOW = 5.0, 0.55
"""A shadow dims the backdrop to this at most; as a log likelihood it costs that much."""
HAND_SHARE = 0.15
"""Of what is not the object, this is expected to be hand."""
UNSEEN = 0.35
"""How often the background shows at a pixel where it was never found: mostly something is in front."""
STRONGEST = 8.0
"""Log odds that no pixel's evidence exceeds."""
LEARNING = 0.05
"""Weight of a new frame in a histogram."""
FIRST = 0.7
"""Weight of the seed frame."""
LEAST_PIXELS = 30
"""Fewer pixels teach nothing."""
SKIN = (40, 138, 85), (255, 175, 125)
"""Least and largest Y, Cr, Cb of skin of all people: where the search for hands starts."""
RIM, BESIDE = 2, 9
"""How far inside a silhouette the backdrop is looked for: as far as the codec and a blur smear [pixels]; and the window
from which the colour of the object beside it is taken."""
ROUNDS, SMOOTHNESS, CONTRAST = 6, 1.2, 12.0
"""Mean field: rounds; log odds from each of the four neighbours; difference of colour that parts neighbours [codes]."""


@dataclass(frozen=True)
class Colours:
    """Densities of Lab colours; each is all zero until learnt."""

    object: Float32[np.ndarray, "8 32 32"]
    hand: Float32[np.ndarray, "8 32 32"]
    background: Float32[np.ndarray, "8 32 32"]

    def learn(
        self,
        lab: UInt8[np.ndarray, "h w 3"],
        *,
        object: Bool[np.ndarray, "h w"],
        hand: Bool[np.ndarray, "h w"],
        background: Bool[np.ndarray, "h w"],
        weight: float = LEARNING,
    ) -> "Colours":
        """With one more frame; classes too small to say anything stay as they are."""
        old = (self.object, self.hand, self.background)
        new = [_learnt(h, lab[where], weight) for h, where in zip(old, (object, hand, background), strict=True)]
        return Colours(*new)

    def hand_evidence(self, lab: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
        """Log likelihood ratio of hand against object, smoothed over three pixels."""
        hand, thing = _looked_up(self.hand, NEW_HAND, lab), _looked_up(self.object, NEW_OBJECT, lab)
        return cv2.blur(hand - thing, (3, 3))


def at_first() -> Colours:
    """Nothing is known but how skin looks in general."""
    empty = np.zeros(BINS, np.float32)
    return Colours(empty, _skin(), empty)


def object_odds(
    picture: UInt8[np.ndarray, "h w 3"],
    prior: Float32[np.ndarray, "h w"],
    hand: Bool[np.ndarray, "h w"],
    backdrop: Backdrop,
    colours: Colours,
) -> Float32[np.ndarray, "h w"]:
    """Log odds of object against hand and background, pixel by pixel.

    Args:
        prior: Probability of the object before the picture is looked at, inside (0, 1).
        hand: What is hand whatever the backdrop says: a hand that holds still is part of the backdrop.
    """
    lab = cv2.cvtColor(picture, cv2.COLOR_RGB2LAB)
    background = _looked_up(colours.background, NEW_OBJECT, lab)
    still = backdrop.known & ~hand
    background[still] = _about_backdrop(picture, backdrop)[still]
    held = _looked_up(colours.hand, NEW_HAND, lab)
    background += np.where(backdrop.known, 0, np.log(UNSEEN)).astype(np.float32)
    other = np.logaddexp(np.log1p(-HAND_SHARE) + background, np.log(HAND_SHARE) + held)
    odds = _looked_up(colours.object, NEW_OBJECT, lab) - other + np.log(prior) - np.log1p(-prior)
    odds[hand] = np.minimum(odds[hand], -1)
    return odds.clip(-STRONGEST, STRONGEST).astype(np.float32)


def smoothed(odds: Float32[np.ndarray, "h w"], picture: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    """Probability of the object when neighbours of similar colour agree more often than not (mean field of an MRF)."""
    colour = picture.astype(np.float32)
    right, below = np.diff(colour, axis=1), np.diff(colour, axis=0)
    across = SMOOTHNESS * np.exp(-_dot(right, right) / (2 * CONTRAST**2))
    down = SMOOTHNESS * np.exp(-_dot(below, below) / (2 * CONTRAST**2))
    votes = np.tanh(odds / 2)
    for _ in range(ROUNDS):
        field = odds.copy()
        field[:, 1:] += across * votes[:, :-1]
        field[:, :-1] += across * votes[:, 1:]
        field[1:] += down * votes[:-1]
        field[:-1] += down * votes[1:]
        votes = np.tanh(field / 2)
    return 0.5 + 0.5 * votes


def trimmed(
    inside: Bool[np.ndarray, "h w"], picture: UInt8[np.ndarray, "h w 3"], backdrop: Backdrop
) -> Bool[np.ndarray, "h w"]:
    """The object without those pixels of its rim that look more like the backdrop than like the object beside them.

    A pixel of which a tenth shows the object differs from a still backdrop: without this, silhouettes are too wide.
    """
    core = cv2.erode(inside.astype(np.float32), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * RIM + 1,) * 2))
    shown, share = picture.astype(np.float32), cv2.blur(core, (BESIDE, BESIDE))
    beside = cv2.blur(shown * core[..., None], (BESIDE, BESIDE)) / np.maximum(share, 1e-6)[..., None]
    from_object, from_backdrop = shown - beside, shown - backdrop.picture
    nearer = _dot(from_backdrop, from_backdrop) < _dot(from_object, from_object)
    return inside & ~((core == 0) & (share > 0) & backdrop.known & nearer)


def skin_coloured(picture: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Pixels of the colour of skin; wood and cardboard, too."""
    return cv2.inRange(cv2.cvtColor(picture, cv2.COLOR_RGB2YCrCb), *SKIN) > 0


def _about_backdrop(picture: np.ndarray, backdrop: Backdrop) -> Float32[np.ndarray, "h w"]:
    """Log density of the picture's colours when the backdrop, or a shadow on it, is seen."""
    seen = cv2.GaussianBlur(picture, (3, 3), 0).astype(np.float32)
    still = cv2.GaussianBlur(backdrop.picture, (3, 3), 0).astype(np.float32)
    scale = -3 * np.log(backdrop.noise * np.sqrt(2 * np.pi))
    lit = scale - _deviation(seen - still, backdrop.noise)
    dimming = (_dot(seen, still) / np.maximum(_dot(still, still), 1)).clip(DARKEST_SHADOW, 1)
    shaded = scale - SHADOW_PENALTY - _deviation(seen - dimming[..., None] * still, backdrop.noise)
    return np.logaddexp(np.maximum(lit, shaded), np.log(NEW_BACKGROUND * ANYTHING)).astype(np.float32)


def _deviation(difference: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Half the squared deviation, of the worst channel."""
    return 0.5 * np.square(worst(np.abs(difference)) / noise)


def _dot(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.einsum("hwc,hwc->hw", one, other)


def _looked_up(density: np.ndarray, new: float, lab: np.ndarray) -> Float32[np.ndarray, "h w"]:
    table = np.log((1 - new) * density + new * ANYTHING) if density.any() else np.full(BINS, np.log(ANYTHING))
    return table[lab[..., 0] >> 5, lab[..., 1] >> 3, lab[..., 2] >> 3].astype(np.float32)


def _learnt(density: np.ndarray, lab: Shaped[np.ndarray, "m 3"], weight: float) -> np.ndarray:
    if len(lab) < LEAST_PIXELS:
        return density
    new = _histogram(lab)
    return (1 - weight) * density + weight * new if density.any() else new


def _histogram(lab: Shaped[np.ndarray, "m 3"]) -> Float32[np.ndarray, "8 32 32"]:
    """Density, spread to neighbouring bins."""
    bins = np.ravel_multi_index((lab[:, 0] >> 5, lab[:, 1] >> 3, lab[:, 2] >> 3), BINS)
    counts = np.bincount(bins, minlength=8 * 32 * 32).reshape(BINS).astype(np.float32)
    smooth = np.stack([cv2.GaussianBlur(layer, (0, 0), 0.7, borderType=cv2.BORDER_REPLICATE) for layer in counts])
    padded = np.concatenate([smooth[:1], smooth, smooth[-1:]])
    smooth = 0.7 * smooth + 0.15 * (padded[:-2] + padded[2:])
    return smooth / (smooth.sum() * np.float32(BIN_VOLUME))


def _skin() -> Float32[np.ndarray, "8 32 32"]:
    """A broad density of skin, for hands that no frame has shown apart from the object."""
    width = np.array([32, 8, 8], np.uint8)
    codes = np.indices(BINS, np.uint8).reshape(3, -1).T * width + width // 2
    rgb = cv2.cvtColor(codes[None], cv2.COLOR_LAB2RGB)
    # Lab holds colours that no screen shows; those do not come back.
    real = np.abs(cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB)[0].astype(int) - codes).max(-1) < 6
    return _histogram(codes[skin_coloured(rgb)[0] & real])
