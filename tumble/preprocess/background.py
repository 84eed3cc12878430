"""The static background of a film, the border of the object before it, and drifts of the exposure and white balance.

The camera is on a tripod, so a pixel that nothing covers keeps its radiance, and changes there come from the camera:
one *gain* per frame and colour channel, in linear light, relative to the median frame.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Integer, Shaped, UInt8

from tumble.maths import linear_from_srgb, to_srgb8
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN

N_SAMPLES = 41
"""Number of frames, evenly spaced, from which the background is estimated."""
MODE_FRACTION = 0.4
"""Fraction of a pixel's visible values that the interval around their mode must contain."""
MIN_SUPPORT = 3
"""Minimum number of values in the interval around the mode; the background of a pixel visible less often is unknown."""
HIDDEN_CODE = 700
"""Multiplied by the number of the sample, replaces a covered value: above all code values and far from the others."""
OBJECT_MARGIN = 2
"""Distance from the object within which no pixel counts as uncovered [pixels]."""
MIN_BESIDE_AGREEMENT = 0.8
"""Minimum fraction of the frames beside the object in which an undecided pixel shows one colour, its background's."""
MAX_COVERED_AGREEMENT = 0.1
"""Maximum fraction of the frames with the object in front in which such a pixel shows that colour nevertheless."""
MAX_STILL = 8.0
"""Maximum change between two frames of a pixel at rest [code values]; over `STILL_SIDE` pixels, as the next two."""
MIN_MOVED = 6.0
"""By how much less it must change than if it had moved with the object [code values]."""
STILL_SIDE = 5
"""Side of the square whose pixels tell whether one is at rest [pixels]."""
MIN_STILL = 4
"""Minimum number of frames in which a pixel has to be at rest for its colour there to be the background's."""
MAX_STILL_SPREAD = 6.0
"""Maximum median deviation of these colours from their median [code values]."""
MOTION_SIGMA = 0.35
"""Standard deviation of the Gaussian over which the motion of the object is averaged [object size]."""
MAX_NOISE = 8.0
"""Maximum noise of a static pixel; a pixel of larger noise is unknown [code values]."""
MIN_NOISE = 1.5
"""Lower limit of the noise estimate: what rounding and compression leave [code values]."""
DIFFERENT_SIGMAS = 5.0
"""Minimum deviation from the background at which a pixel shows something else [standard deviations of the noise]."""
SAME_SIGMAS = 2.5
"""Maximum deviation from the background at which a pixel may show it [standard deviations of the noise]."""
MIN_DIFFERENCE = 14.0
"""Lower limit of the difference that counts as different: above shadows and codec artefacts [code values]."""
UNCLIPPED = (25, 235)
"""Range of the code values from which gains are estimated: neither noise nor clipped."""
MIN_USABLE_FRACTION = 0.01
"""Minimum fraction of usable pixels of an image; with fewer, the gain is not estimated."""
N_BACKGROUND_SAMPLES = 30
"""Number of frames from which colours of the background are sampled."""
SAMPLE_MARGIN = 4
"""Distance from object and hand within which no colour is sampled [pixels]."""
SAMPLE_DEVIATION = 6.0
"""Standard deviation of a pixel of the background over time, as compared with samples [code values]."""
MIN_SAMPLES = 4
"""Minimum number of samples of a pixel; with fewer, nothing is known."""
MIN_AGREEING_SAMPLES = 1.2
"""Minimum number of samples of a colour that count, weighted by similarity."""
SAMPLE_NOVELTY = 0.02
"""Probability that a pixel of the background has a colour of none of its samples."""
NO_SAMPLE_LOG_LIKELIHOOD = math.log(2 * SAMPLE_NOVELTY * 256.0**-3)
"""Log likelihood of the background below which a colour is more likely to be new than one of the samples."""
MAX_BORDER = 4.0
"""Maximum width of a band along a silhouette [pixels]; what a hand hides is wider."""
MIN_BORDER_CONTRAST = 24.0
"""Minimum difference between object and background, the largest over the channels [code values]: with less, noise and
shading decide."""
MAX_BORDER_RESIDUAL = 0.35
"""Maximum distance of a pixel's colour from the line between both, as a fraction of their difference: a shadow, a
highlight, or another object has a colour of its own."""
BORDER_SIDE = 5
"""Side of the square whose pixels tell how much the object's colour varies [pixels]."""
BORDER_SIGMAS = 2.0
"""Standard deviations of the share, from that variation, by which a pixel is clear of the limits between object,
unknown and background: before a dark wall the dark edge of a box looks like a pixel that the box covers in part."""
MAX_BACKGROUND_SHARE = 0.25
"""Share of the object below which a pixel becomes background; between that and one half it stays unknown, since a mask
that is too small in one frame carves the shape of all."""


@dataclass(frozen=True)
class Background:
    """The static background of a video."""

    image: UInt8[np.ndarray, "h w 3"]
    """sRGB code values."""
    noise: Float32[np.ndarray, "h w"]
    """Robust standard deviation over time, maximum over the channels [code values]."""
    known: Bool[np.ndarray, "h w"]
    """Pixels whose background was visible often enough, and static."""

    def same(self, image: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
        """Pixels whose colour is that of the known background."""
        return self.known & (self._distance(image) < np.maximum(SAME_SIGMAS * self.noise, MIN_DIFFERENCE / 2))

    def differs(self, image: UInt8[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
        """Pixels whose colour is significantly different from the known background."""
        return self.known & (self._distance(image) > np.maximum(DIFFERENT_SIGMAS * self.noise, MIN_DIFFERENCE))

    def _distance(self, image: np.ndarray) -> np.ndarray:
        # A slight blur reduces the codec's noise.
        observed, expected = cv2.GaussianBlur(image, (3, 3), 0), cv2.GaussianBlur(self.image, (3, 3), 0)
        return channel_max(cv2.absdiff(observed, expected)).astype(np.float32)


@dataclass(frozen=True)
class BackgroundSamples:
    """Colours of each pixel on some frames on which nothing covers it (sample consensus, as in ViBe).

    They hold what `Background` cannot: a person behind the object who moves, and a wall that appears late.
    """

    index: Integer[np.ndarray, " k"]
    """Indices of the sampled frames."""
    images: UInt8[np.ndarray, "k h w 3"]
    """sRGB code values, slightly blurred."""
    valid: Bool[np.ndarray, "k h w"]
    """Pixels that show neither object nor hand."""

    def log_likelihood(self, image: UInt8[np.ndarray, "h w 3"], index: int) -> Float32[np.ndarray, "h w"]:
        """Log density of the colours of frame `index`, given the other frames; not a number where these are too few."""
        observed = cv2.GaussianBlur(image, (3, 3), 0)
        total, count = np.zeros(image.shape[:2], np.float32), np.zeros(image.shape[:2], np.float32)
        for sampled, valid in zip(self.images[self.index != index], self.valid[self.index != index], strict=True):
            distance = channel_max(cv2.absdiff(observed, sampled)).astype(np.float32)
            total += valid * np.exp(-0.5 * (distance / SAMPLE_DEVIATION) ** 2)
            count += valid
        # One agreeing sample may be a mask's error.
        density = np.where(total > MIN_AGREEING_SAMPLES, total, 0) / np.maximum(count, 1)
        density *= (SAMPLE_DEVIATION * np.sqrt(2 * np.pi)) ** -3
        known = np.log(density + SAMPLE_NOVELTY * 256.0**-3).astype(np.float32)
        return np.where(count >= MIN_SAMPLES, known, np.float32(np.nan))


def sample_background(images: UInt8[np.ndarray, "t h w 3"], covered: Bool[np.ndarray, "t h w"]) -> BackgroundSamples:
    """Colours of every pixel where nothing covers it or its neighbourhood, on evenly spaced frames.

    Args:
        covered: Pixels of the object and of hands.
    """
    index = np.unique(np.linspace(0, len(images) - 1, N_BACKGROUND_SAMPLES).round().astype(int))
    margin = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * SAMPLE_MARGIN + 1,) * 2)
    near = [cv2.dilate(covered[i].astype(np.uint8), margin) > 0 for i in index]
    return BackgroundSamples(index, np.stack([cv2.GaussianBlur(images[i], (3, 3), 0) for i in index]), ~np.stack(near))


def estimate_background(
    images: UInt8[np.ndarray, "t h w 3"],
    covered: Bool[np.ndarray, "t h w"] | None = None,
    n_samples: int = N_SAMPLES,
) -> Background:
    """Mode over time of every pixel, over the frames in which nothing covers it.

    The mode of a channel is the midpoint of the shortest interval that contains the fraction `MODE_FRACTION` of its
    values (Grenander's estimator), so the object may cover a pixel more than half of the time.

    Args:
        covered: Pixels known to be covered by the object or a hand.
        n_samples: Number of frames, evenly spaced, that are looked at.
    """
    samples = np.unique(np.linspace(0, len(images) - 1, n_samples).round().astype(int))
    dtype = np.int16 if HIDDEN_CODE * len(samples) <= np.iinfo(np.int16).max else np.int32
    stack = images[samples].astype(dtype)
    n_visible = np.full(stack.shape[1:3], len(stack), np.int64)
    if covered is not None:
        hidden = covered[samples]
        codes = HIDDEN_CODE * np.arange(1, len(stack) + 1, dtype=dtype)
        stack = np.where(hidden[..., None], codes[:, None, None, None], stack)
        n_visible -= hidden.sum(0)
    stack.sort(axis=0)
    support = np.maximum(np.ceil(MODE_FRACTION * n_visible).astype(int), min(MIN_SUPPORT, len(samples)))
    image, width = np.zeros(stack.shape[1:], np.uint8), np.full(stack.shape[1:3], np.inf, np.float32)
    for count in np.unique(support).tolist():
        where = (support == count) & (n_visible >= count)
        image[where], width[where] = _mode(stack[:, where], count)
    # The central 40 % of a normal distribution span 1.05 standard deviations.
    noise = np.maximum(width / 1.05, MIN_NOISE)
    return Background(image, noise, noise < MAX_NOISE)


def fill_unknown(background: Background, fallback: Background) -> Background:
    """The background, with unknown pixels taken from the fallback."""
    image = np.where(background.known[..., None], background.image, fallback.image)
    return Background(
        image, np.where(background.known, background.noise, fallback.noise), background.known | fallback.known
    )


def crossed_background(
    images: UInt8[np.ndarray, "t h w 3"], inside: Bool[np.ndarray, "t h w"], background: Background
) -> Background:
    """The background, with the unknown pixels that the object crosses.

    Where nothing is known of the background, masks leave pixels beside the object undecided, and these hide what is
    there. Three observations together tell that an undecided pixel shows background: in some frames the object covers
    it; in the others it has one colour; and it does not have this colour while the object covers it. A part of the
    object that stays in its place and is never recognised, such as dark feet on a turntable, lacks the first; one that
    is recognised in some frames only lacks the third.

    Args:
        inside: Pixels that are certainly object.
    """
    margin, where = np.ones((2 * OBJECT_MARGIN + 1,) * 2), ~background.known
    beside = np.stack([cv2.dilate(mask.astype(np.uint8), margin)[where] == 0 for mask in inside])[:, None]
    covered, colours = inside[:, where][:, None], images[:, where][:, None]
    found = estimate_background(colours, ~beside, n_samples=len(images))
    distance = channel_max(np.abs(colours.astype(np.int16) - found.image))
    agrees = distance < np.maximum(SAME_SIGMAS * found.noise, MIN_DIFFERENCE / 2)
    n_beside, n_covered = beside.sum(0), covered.sum(0)
    known = found.known & (np.minimum(n_beside, n_covered) >= MIN_SUPPORT)
    known &= (agrees & beside).sum(0) >= MIN_BESIDE_AGREEMENT * n_beside
    known &= (agrees & covered).sum(0) <= MAX_COVERED_AGREEMENT * n_covered
    image, noise, everywhere = background.image.copy(), background.noise.copy(), background.known.copy()
    everywhere[where] = known[0]
    image[everywhere & where], noise[everywhere & where] = found.image[known], found.noise[known]
    return Background(image, noise, everywhere)


def resting_background(
    images: UInt8[np.ndarray, "t h w 3"], inside: Bool[np.ndarray, "t h w"], background: Background
) -> Background:
    """The background, with unknown pixels that were seen at rest while the object moved.

    Where nothing is known of the background, a piece of it may belong to the masks of many frames. But it does not move
    with the object: from one frame to the next it stays what it was, while the motion of the object would have brought
    something else. A plain piece of the object stays what it was, too, but then its motion brings the same. An arm may
    rest as well, so this is for films without hands.

    Args:
        inside: Pixels that are rather object.
    """
    where = ~background.known
    rests = np.zeros((len(images), int(where.sum())), bool)
    for t, at_rest in enumerate(_at_rest(images, inside), 1):
        rests[t] = at_rest[where]
    enough = rests.sum(0) >= MIN_STILL
    if not enough.any():
        return background
    where[where] = enough
    at_rest = rests[:, enough][..., None]
    colours = images[:, where].astype(np.int16)
    colour = _median(colours, at_rest)
    spread = channel_max(_median(np.abs(colours - colour), at_rest))
    found = spread <= MAX_STILL_SPREAD
    where[where] = found
    image, noise = background.image.copy(), background.noise.copy()
    image[where] = colour[found].astype(np.uint8)
    noise[where] = np.maximum(1.48 * spread[found], MIN_NOISE)  # of a normal distribution
    return Background(image, noise, background.known | where)


def _median(values: Integer[np.ndarray, "t n 3"], counted: Bool[np.ndarray, "t n 1"]) -> Integer[np.ndarray, "n 3"]:
    """The lower median over the frames that count."""
    ordered = np.sort(np.where(counted, values, np.iinfo(values.dtype).max), 0)
    return np.take_along_axis(ordered, (counted.sum(0, keepdims=True) - 1) // 2, 0)[0]


def _at_rest(
    images: UInt8[np.ndarray, "t h w 3"], inside: Bool[np.ndarray, "t h w"]
) -> Iterator[Bool[np.ndarray, "h w"]]:
    """For the second and later frames, pixels that stay what they were although the object's motion brings others."""
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    gray = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]
    sigma = MOTION_SIGMA * math.sqrt(max(float(np.median(inside.sum((1, 2)))), 1.0))
    for t in range(1, len(images)):
        flow = dis.calc(gray[t], gray[t - 1], np.zeros((*gray[t].shape, 2), np.float32))
        weight = inside[t].astype(np.float32)
        flow = cv2.GaussianBlur(flow * weight[..., None], (0, 0), sigma)
        flow /= np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-6)[..., None]
        moved = moved_along(flow, images[t - 1])
        change, expected = (
            cv2.blur(channel_max(cv2.absdiff(images[t], other)).astype(np.float32), (STILL_SIDE, STILL_SIDE))
            for other in (images[t - 1], moved)
        )
        yield (change < MAX_STILL) & (expected - change > MIN_MOVED)


def moved_along(
    flow: Float32[np.ndarray, "h w 2"], values: Shaped[np.ndarray, "h w *c"]
) -> Shaped[np.ndarray, "h w *c"]:
    """Values of another image where the flow from this one to it leads."""
    rows, columns = np.indices(flow.shape[:2], np.float32)
    return cv2.remap(values, columns + flow[..., 0], rows + flow[..., 1], cv2.INTER_LINEAR)


def estimate_gains(
    images: UInt8[np.ndarray, "t h w 3"], covered: Bool[np.ndarray, "t h w"] | None = None
) -> Float32[np.ndarray, "t 3"]:
    """Gain of every frame and channel relative to the median frame; 1 where it cannot be estimated.

    Interquartile mean of the ratios of many pixels, so the object may cover a good part of them. The gains are
    estimated twice, because the background of drifting frames is blurred: the second time relative to the background of
    the frames corrected by the first estimate.

    Args:
        covered: Pixels known to be covered by the object or a hand.
    """
    rough = _gains_relative_to(images, estimate_background(images, covered).image, covered)
    corrected = np.stack([compensate(image, gain) for image, gain in zip(images, rough, strict=True)])
    gains = _gains_relative_to(images, estimate_background(corrected, covered).image, covered)
    return gains / np.median(gains, 0)


def compensate(image: UInt8[np.ndarray, "h w 3"], gain: Float32[np.ndarray, "3"]) -> UInt8[np.ndarray, "h w 3"]:
    """The image with the gain divided out in linear light; clipped pixels (255) stay 255."""
    values = torch.from_numpy(_linear_from_code()[:, None] / gain)
    table = to_srgb8(values).numpy()
    table[255] = 255
    return cv2.LUT(image, table[None])


def settle_border(
    image: UInt8[np.ndarray, "h w 3"],
    labels: UInt8[np.ndarray, "h w"],
    background: UInt8[np.ndarray, "h w 3"],
    known: Bool[np.ndarray, "h w"],
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    """Image and mask whose band along the silhouette is shared out to object and background.

    Masks leave a band of unknown pixels there. Where the background is known, a pixel of the band is a mix of its
    colour and that of the object just inside, in linear light, and the share of the object follows (Smith and Blinn,
    *Blue screen matting*, 1996, with a known foreground instead of a second background). Pixels of which the object
    covers most become object, with the background taken out of their colour; those of which it covers little become
    background.

    Args:
        image: A frame, sRGB.
        labels: Its mask: OBJECT, UNKNOWN or BACKGROUND.
        background: What the frame shows without the object, sRGB.
        known: Pixels where that is known; the others of the band stay unknown.
    """
    inner, outer = labels == OBJECT, labels == BACKGROUND
    if not inner.any() or not outer.any():
        return image, labels
    to_object, nearest = cv2.distanceTransformWithLabels(
        (~inner).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    to_background = cv2.distanceTransform((~outer).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    rows, columns = np.nonzero((labels == UNKNOWN) & known & (to_object + to_background < MAX_BORDER + 1.5))
    # Pixels of the object are numbered from 1, row by row.
    row, column = (each[nearest[rows, columns] - 1] for each in np.nonzero(inner))
    mean, deviation = (values[row, column] for values in _inside(image, inner))
    curve = _linear_from_code()
    observed, front, behind = curve[image[rows, columns]], mean, curve[background[rows, columns]]
    line = front - behind
    length = np.square(line).sum(-1).clip(1e-12)
    share = (((observed - behind) * line).sum(-1) / length).clip(0, 1)[:, None]
    residual = np.square(observed - behind - share * line).sum(-1)
    # The object's colour in the pixel is that of its neighbours, but for texture and shading.
    doubt = share[:, 0] * (deviation * np.abs(line)).sum(-1) / length
    contrast = np.abs(_code(front).astype(int) - background[rows, columns]).max(-1)
    certain = (
        (contrast >= MIN_BORDER_CONTRAST)
        & (residual <= MAX_BORDER_RESIDUAL**2 * length)
        & ((share[:, 0] > 0.5 + BORDER_SIGMAS * doubt) | (share[:, 0] < MAX_BACKGROUND_SHARE - BORDER_SIGMAS * doubt))
    )
    rows, columns, share = rows[certain], columns[certain], share[certain]
    image, labels = image.copy(), labels.copy()
    labels[rows, columns] = np.where(share[:, 0] >= 0.5, np.uint8(OBJECT), np.uint8(BACKGROUND))
    image[rows, columns] = _code((observed[certain] - (1 - share) * behind[certain]).clip(0, 1))
    return image, labels


def channel_max(values: Shaped[np.ndarray, "*b 3"]) -> Shaped[np.ndarray, "*b"]:
    """Maximum over three channels; a NumPy reduction over so short an axis is many times slower."""
    return np.maximum(np.maximum(values[..., 0], values[..., 1]), values[..., 2])


def local_mean(
    values: Float32[np.ndarray, "h w *c"], where: Bool[np.ndarray, "h w"], side: int
) -> Float32[np.ndarray, "h w *c"]:
    """Mean over those pixels of the square around each pixel that count; 0 where none does."""
    weight = where.astype(np.float32)
    count, channels = cv2.blur(weight, (side, side)).clip(1e-6), (1,) * (values.ndim - 2)
    total = cv2.blur(values * weight.reshape(*weight.shape, *channels), (side, side))
    return total / count.reshape(*count.shape, *channels)


def _gains_relative_to(
    images: np.ndarray, reference: np.ndarray, covered: np.ndarray | None
) -> Float32[np.ndarray, "t 3"]:
    """Interquartile mean of the ratios to a reference image: robust, and finer than 8 bits."""
    curve, usable = _linear_from_code(), _unclipped(reference)
    gains = np.ones((len(images), 3), np.float32)
    for i, image in enumerate(images):
        keep = usable & _unclipped(image)
        if covered is not None:
            keep &= ~covered[i]
        if keep.mean() >= MIN_USABLE_FRACTION:
            ratios = np.sort(curve[image[keep]] / curve[reference[keep]], 0)
            quarter = len(ratios) // 4
            gains[i] = ratios[quarter : len(ratios) - quarter].mean(0)
    return gains


def _unclipped(image: np.ndarray) -> np.ndarray:
    return cv2.inRange(image, (UNCLIPPED[0],) * 3, (UNCLIPPED[1],) * 3) > 0


def _mode(values: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Midpoint and width (of the widest channel) of the shortest interval that contains `count` of sorted values."""
    widths = values[count - 1 :] - values[: len(values) - count + 1]
    start = widths.argmin(0)[None]
    middle = np.take_along_axis(values, start + (count - 1) // 2, 0)[0]
    return middle.astype(np.uint8), channel_max(np.take_along_axis(widths, start, 0)[0]).astype(np.float32)


@cache
def _linear_from_code() -> Float32[np.ndarray, "256"]:
    """Linear light of all code values."""
    return linear_from_srgb(torch.arange(256, dtype=torch.float32) / 255).numpy()


def _inside(
    image: UInt8[np.ndarray, "h w 3"], inside: Bool[np.ndarray, "h w"]
) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w 3"]]:
    """Mean and standard deviation of the colours of the pixels inside around each pixel, in linear light."""
    linear = _linear_from_code()[image]
    wide, squared = (local_mean(each, inside, BORDER_SIDE) for each in (linear, np.square(linear)))
    return local_mean(linear, inside, 3), np.sqrt((squared - np.square(wide)).clip(0))


def _code(linear: Float32[np.ndarray, "*b 3"]) -> UInt8[np.ndarray, "*b 3"]:
    return to_srgb8(torch.from_numpy(linear)).numpy()
