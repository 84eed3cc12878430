"""Per-pixel probability of object, hand and background, from colour histograms and the static background.

There are three histograms over CIE Lab (object, hand, background), updated from frame to frame, and a normal
distribution around the static background where that is known. All are densities per cubic code value, so that they can
be compared. They are combined by Bayes' rule with a prior from the previous frame, and smoothed by mean-field
iterations of a Markov random field whose neighbours are coupled if their colours are similar.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Shaped, UInt8

from tumble.preprocess.background import Background, channel_max, local_mean
from tumble.preprocess.hands import Hand, arm_region, hand_region, hand_strokes, hand_surroundings

OBJECT_CLASS, HAND_CLASS, BACKGROUND_CLASS = 0, 1, 2
"""Indices of the classes in arrays of probabilities."""
BINS = (8, 32, 32)
"""Number of bins for L, a and b; fewer for lightness, because shading changes it most."""
BIN_VOLUME = 256.0**3 / (8 * 32 * 32)
"""Volume of a bin [cubic code values]."""
UNIFORM_DENSITY = 256.0**-3
"""Density of the uniform distribution over all colours [1 / cubic code value]."""
OBJECT_NOVELTY = 0.1
"""Probability that a pixel of the object has a colour not learnt yet, or one of a background known only by colour."""
HAND_NOVELTY = 0.02
"""Probability that a pixel of the hand has a colour not learnt yet."""
NO_HAND_LOG_LIKELIHOOD = math.log(HAND_NOVELTY * UNIFORM_DENSITY)
"""Log likelihood, under hand, of a colour that hands do not have."""
BACKGROUND_NOVELTY = 0.001
"""Probability that a pixel of the static background has another colour; it hardly changes."""
UNKNOWN_BACKGROUND_NOVELTY = 0.5
"""Probability that a pixel of a background that was never visible has a colour that others do not have."""
SHADOW_PENALTY = 5.0
"""Penalty of the log likelihood for explaining a pixel by a shadow on the background."""
MIN_SHADOW_RATIO = 0.55
"""Darkest shadow: minimum ratio of a shaded code value to the unshaded one."""
MAX_LOG_ODDS = 8.0
"""Limit of the absolute log odds of a single pixel."""
LEARNING_RATE = 0.05
"""Weight of a new frame in a histogram."""
SEED_WEIGHT = 0.7
"""Weight of the seed frame in a histogram."""
MIN_PIXELS = 30
"""Minimum number of pixels of a class in a frame; fewer do not update its histogram."""
BORDER_WIDTH = 0.04
"""Width of the border of the image at which arms are expected, as a fraction of its longer side."""
MIN_ARM_PIXELS = 500
"""Minimum number of pixels in all frames from which the colours of arms are learnt."""
SAMPLED_FRAMES = 3
"""Interval of the frames whose masks tell the colours of the object."""
MIN_HAND_COLOUR_LOG_RATIO = 1.5
"""Log likelihood ratio of hand to object above which a pixel has the colour of a hand."""
SKIN_YCRCB = (40, 138, 85), (255, 175, 125)
"""Lower and upper limit of Y, Cr, Cb of skin of all tones; wider than skin, because hands are searched for with it."""
RIM_WIDTH = 2
"""Width of the rim inside a silhouette that may be background: as far as codec and blur mix colours [pixels]."""
NEIGHBOURHOOD = 9
"""Side of the window over which the object's colour next to the rim is averaged [pixels]."""
MEAN_FIELD_ITERATIONS = 6
"""Number of mean-field iterations."""
SMOOTHNESS = 1.2
"""Coupling: log odds that each of the four neighbours contributes if it has the same colour."""
MIN_BACKGROUND_LOG_RATIO = 3.0
"""Mean log likelihood ratio of background to object among neighbouring pixels, below which background close to the
object is doubted: where the object has the colours of what is behind it, all pixels err alike."""
BACKGROUND_WINDOW = 5
"""Side of the square of pixels over which this ratio is averaged."""
CONTRAST = 12.0
"""Standard deviation of the colour difference over which the coupling of neighbours decays [code values]."""


@dataclass(frozen=True)
class ColourModel:
    """Densities of Lab colours per class; a density is all zero until it is learnt."""

    object: Float32[np.ndarray, "8 32 32"]
    hand: Float32[np.ndarray, "8 32 32"]
    background: Float32[np.ndarray, "8 32 32"]

    def updated(
        self,
        lab: UInt8[np.ndarray, "h w 3"],
        *,
        object: Bool[np.ndarray, "h w"],
        hand: Bool[np.ndarray, "h w"],
        background: Bool[np.ndarray, "h w"],
        weight: float = LEARNING_RATE,
    ) -> "ColourModel":
        """The model updated with one more frame; a class with fewer than `MIN_PIXELS` pixels stays unchanged."""
        old = (self.object, self.hand, self.background)
        new = [
            _updated_density(h, lab[where], weight) for h, where in zip(old, (object, hand, background), strict=True)
        ]
        return ColourModel(*new)

    def hand_log_ratio(self, lab: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
        """Log likelihood ratio of hand to object, averaged over 3 x 3 pixels."""
        log_hand, log_object = (
            _log_density(self.hand, HAND_NOVELTY, lab),
            _log_density(self.object, OBJECT_NOVELTY, lab),
        )
        return cv2.blur(log_hand - log_object, (3, 3))


def is_alike(log_ratio: Float32[np.ndarray, "h w"], background: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels of the background at which the object is hardly less likely, by the mean over those of a window.

    Args:
        log_ratio: Log likelihood ratio of background to object.
    """
    log_ratio = log_ratio.clip(-MAX_LOG_ODDS, MAX_LOG_ODDS)
    return background & (local_mean(log_ratio, background, BACKGROUND_WINDOW) < MIN_BACKGROUND_LOG_RATIO)


def mean_field_probability(
    odds: Float32[np.ndarray, "h w"], image: UInt8[np.ndarray, "h w 3"]
) -> Float32[np.ndarray, "h w"]:
    """Probability of the object after mean-field smoothing, which couples neighbours of similar colour."""
    across, down = _couplings(image)
    spin = np.tanh(odds / 2)
    for _ in range(MEAN_FIELD_ITERATIONS):
        field = odds.copy()
        field[:, 1:] += across * spin[:, :-1]
        field[:, :-1] += across * spin[:, 1:]
        field[1:] += down * spin[:-1]
        field[:-1] += down * spin[1:]
        spin = np.tanh(field / 2)
    return 0.5 + 0.5 * spin


def log_likelihoods(
    image: UInt8[np.ndarray, "h w 3"],
    background: Background,
    colours: ColourModel,
    sampled: Float32[np.ndarray, "h w"] | None = None,
) -> Float32[np.ndarray, "3 h w"]:
    """Log likelihood of every pixel's colour under object, hand and background.

    Args:
        sampled: Log likelihood of the background from other frames (`BackgroundSamples`); not a number if unknown.
    """
    lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB)
    log_background = _log_density(colours.background, UNKNOWN_BACKGROUND_NOVELTY, lab)
    static = _background_log_density(image, background)
    log_background = np.where(background.known, static, log_background)
    if sampled is not None:
        known = np.nan_to_num(sampled)
        both = np.where(background.known, np.logaddexp(static, known) - np.float32(np.log(2)), known)
        log_background = np.where(np.isnan(sampled), log_background, both)
    log_object, log_hand = (
        _log_density(colours.object, OBJECT_NOVELTY, lab),
        _log_density(colours.hand, HAND_NOVELTY, lab),
    )
    return np.stack([log_object, log_hand, log_background]).astype(np.float32)


def class_probabilities(
    log_posterior: Float32[np.ndarray, "3 h w"], image: UInt8[np.ndarray, "h w 3"]
) -> Float32[np.ndarray, "3 h w"]:
    """Probabilities of the classes after mean-field smoothing, which couples neighbours of similar colour."""
    across, down = _couplings(image)
    probabilities = _softmax(log_posterior)
    for _ in range(MEAN_FIELD_ITERATIONS):
        field = log_posterior.copy()
        field[:, :, 1:] += across * probabilities[:, :, :-1]
        field[:, :, :-1] += across * probabilities[:, :, 1:]
        field[:, 1:] += down * probabilities[:, :-1]
        field[:, :-1] += down * probabilities[:, 1:]
        probabilities = _softmax(field)
    return probabilities


def hand_colours(
    images: UInt8[np.ndarray, "t h w 3"], hands: Sequence[Sequence[Hand]], background: Background
) -> Float32[np.ndarray, "8 32 32"]:
    """Density of the colours of hands, arms and sleeves in all frames.

    The mean of three densities: of the hands' landmarks; of what moves behind the wrists; of what moves at the border
    of the image, which an arm reaches and an object that is shown does not. Some landmarks are hidden by the object, so
    half the density of the colours around the hands is subtracted from theirs.
    """
    shape = images.shape[1:3]
    width = round(BORDER_WIDTH * max(shape))
    border = np.ones(shape, bool)
    border[width:-width, width:-width] = False
    skin, around, arms, at_border = [], [], [], []
    for image, found in zip(images, hands, strict=True):
        lab, moving = cv2.cvtColor(image, cv2.COLOR_RGB2LAB), background.differs(image)
        at_border.append(lab[border & (cv2.morphologyEx(moving.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3))) > 0)])
        if found:
            skin.append(lab[hand_strokes(found, shape)])
            arm, close = arm_region(found, shape), hand_surroundings(found, shape)
            around.append(lab[hand_region(found, shape) & ~close & ~arm])
            arms.append(lab[arm & ~close & moving])
    if not skin:
        return _skin_density()
    density, others = _density(np.concatenate(skin)), np.concatenate(around)
    if len(others):
        density = np.maximum(density - _density(others) / 2, 0)
        density /= density.sum() * np.float32(BIN_VOLUME)
    moving = (np.concatenate(each) for each in (arms, at_border))
    densities = [density, *(_density(lab) for lab in moving if len(lab) >= MIN_ARM_PIXELS)]
    return np.stack(densities).mean(0)


def hand_coloured_fraction(
    images: UInt8[np.ndarray, "t h w 3"],
    inside: Bool[np.ndarray, "t h w"],
    hands: Sequence[Sequence[Hand]],
    background: Background,
) -> Float32[np.ndarray, " t"]:
    """Fraction of each mask whose colours are more likely those of the hands than those of all masks together.

    It finds masks with a part of a hand or an arm, if most of the other masks have none; 0 if no hand was detected.
    """
    fractions = np.zeros(len(images), np.float32)
    if not any(hands):
        return fractions
    lab = np.stack([cv2.cvtColor(image, cv2.COLOR_RGB2LAB) for image in images])
    object_ = lab[::SAMPLED_FRAMES][inside[::SAMPLED_FRAMES]]
    density = _density(object_) if len(object_) else np.zeros(BINS, np.float32)
    colours = ColourModel(density, hand_colours(images, hands, background), np.zeros(BINS, np.float32))
    for i, mask in enumerate(inside):
        if mask.any():
            fractions[i] = (colours.hand_log_ratio(lab[i])[mask] > MIN_HAND_COLOUR_LOG_RATIO).mean()
    return fractions


def trim_rim(
    inside: Bool[np.ndarray, "h w"], image: UInt8[np.ndarray, "h w 3"], background: Background
) -> Bool[np.ndarray, "h w"]:
    """The silhouette without rim pixels whose colour is closer to the background than to the object nearby.

    A pixel of which a tenth is object differs from a static background already, so untrimmed silhouettes are too wide.
    """
    rim = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * RIM_WIDTH + 1,) * 2)
    core, colour = cv2.erode(inside.astype(np.uint8), rim), image.astype(np.float32)
    nearby = local_mean(colour, core > 0, NEIGHBOURHOOD)
    near = cv2.dilate(core, np.ones((NEIGHBOURHOOD,) * 2, np.uint8)) > 0
    to_object, to_background = colour - nearby, colour - background.image
    closer = _dot(to_background, to_background) < _dot(to_object, to_object)
    return inside & ~((core == 0) & near & background.known & closer)


def skin_coloured(image: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    """Pixels in the colour range of skin, which includes wood and cardboard."""
    return cv2.inRange(cv2.cvtColor(image, cv2.COLOR_RGB2YCrCb), *SKIN_YCRCB) > 0


def _couplings(image: np.ndarray) -> tuple[Float32[np.ndarray, "h w1"], Float32[np.ndarray, "h1 w"]]:
    """Coupling of every pixel with the next one to the right, and with the one below."""
    colour = image.astype(np.float32)
    right, below = np.diff(colour, axis=1), np.diff(colour, axis=0)
    across = SMOOTHNESS * np.exp(-_dot(right, right) / (2 * CONTRAST**2))
    down = SMOOTHNESS * np.exp(-_dot(below, below) / (2 * CONTRAST**2))
    return across, down


def _softmax(logits: Float32[np.ndarray, "3 h w"]) -> Float32[np.ndarray, "3 h w"]:
    e = np.exp(logits - logits.max(0))
    return e / e.sum(0)


def _background_log_density(image: np.ndarray, background: Background) -> Float32[np.ndarray, "h w"]:
    """Log density of the image's colours, given the static background with or without a shadow on it."""
    colour = cv2.GaussianBlur(image, (3, 3), 0).astype(np.float32)
    unshaded = cv2.GaussianBlur(background.image, (3, 3), 0).astype(np.float32)
    scale = -3 * np.log(background.noise * np.sqrt(2 * np.pi))
    lit = scale - _half_squared_deviation(colour - unshaded, background.noise)
    dimming = (_dot(colour, unshaded) / np.maximum(_dot(unshaded, unshaded), 1)).clip(MIN_SHADOW_RATIO, 1)
    shaded = scale - SHADOW_PENALTY - _half_squared_deviation(colour - dimming[..., None] * unshaded, background.noise)
    return np.logaddexp(np.maximum(lit, shaded), np.log(BACKGROUND_NOVELTY * UNIFORM_DENSITY)).astype(np.float32)


def _half_squared_deviation(difference: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Half the squared deviation in units of the noise, maximum over the channels."""
    return 0.5 * np.square(channel_max(np.abs(difference)) / noise)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("hwc,hwc->hw", a, b)


def _log_density(density: np.ndarray, novelty: float, lab: np.ndarray) -> Float32[np.ndarray, "h w"]:
    table = (
        np.log((1 - novelty) * density + novelty * UNIFORM_DENSITY)
        if density.any()
        else np.full(BINS, np.log(UNIFORM_DENSITY))
    )
    return table[lab[..., 0] >> 5, lab[..., 1] >> 3, lab[..., 2] >> 3].astype(np.float32)


def _updated_density(density: np.ndarray, lab: Shaped[np.ndarray, "m 3"], weight: float) -> np.ndarray:
    if len(lab) < MIN_PIXELS:
        return density
    new = _density(lab)
    return (1 - weight) * density + weight * new if density.any() else new


def _density(lab: Shaped[np.ndarray, "m 3"]) -> Float32[np.ndarray, "8 32 32"]:
    """Normalised histogram of colours, smoothed over neighbouring bins."""
    bins = np.ravel_multi_index((lab[:, 0] >> 5, lab[:, 1] >> 3, lab[:, 2] >> 3), BINS)
    counts = np.bincount(bins, minlength=8 * 32 * 32).reshape(BINS).astype(np.float32)
    smooth = np.stack([cv2.GaussianBlur(layer, (0, 0), 0.7, borderType=cv2.BORDER_REPLICATE) for layer in counts])
    padded = np.concatenate([smooth[:1], smooth, smooth[-1:]])
    smooth = 0.7 * smooth + 0.15 * (padded[:-2] + padded[2:])
    return smooth / (smooth.sum() * np.float32(BIN_VOLUME))


def _skin_density() -> Float32[np.ndarray, "8 32 32"]:
    """A broad density of skin colours, for hands that are not yet seen apart from the object."""
    width = np.array([32, 8, 8], np.uint8)
    codes = np.indices(BINS, np.uint8).reshape(3, -1).T * width + width // 2
    rgb = cv2.cvtColor(codes[None], cv2.COLOR_LAB2RGB)
    # Lab colours outside the sRGB gamut do not survive the round trip.
    in_gamut = np.abs(cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB)[0].astype(int) - codes).max(-1) < 6
    return _density(codes[skin_coloured(rgb)[0] & in_gamut])
