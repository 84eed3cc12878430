"""Health card of a run: quality measures without ground truth, each with a rating and advice in plain sentences."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from tumble.export import N_LIGHTS, Confidence
from tumble.poses import PoseQuality
from tumble.report.training_views import RenderedFrame

CardRating = Literal["good", "warn", "bad", "none"]
"""Rating of a row, or of one frame within a row; "none" where nothing could be measured."""
RATING_LABELS: dict[CardRating, str] = {"good": "Good", "warn": "Check", "bad": "Poor", "none": "No data"}
"""Text of each rating."""
OVERALL: dict[CardRating, tuple[str, str]] = {
    "good": ("Good", "No problem was found; the asset can be used."),
    "warn": ("Usable", "Please check before you use the asset: "),
    "bad": ("Poor", "Please fix before you use the asset: "),
}
"""Word and sentence for the worst rating of a card; the names of the rows with this rating follow."""
LIMITS = {
    "psnr": (26.0, 21.0),
    "iou": (0.95, 0.90),
    "exposure": (0.2, 0.5),
    "turn": (90.0, 40.0),
    "lost": (0.0, 0.1),
    "residual": (1.5, 3.0),
    "few_lights": (0.2, 0.6),
    "colour": (0.3, 1.0),
}
"""Limits beyond which a row is rated "warn" and "bad", rules of thumb: median PSNR [dB], median IoU, range of exposure
[stops], largest rotation between two frames [degrees], fraction of lost frames, median match residual [pixels],
fraction of the surface lit from few directions, relative error of the albedo's scale."""
SHADED = (
    "The exposure was measured on the background and corrected, so that a hand or a person shades the object, or poses "
    "are wrong."
)
UNEVEN = {
    True: {"warn": SHADED, "bad": f"{SHADED} Look at the frames with high bars."},
    False: {
        "warn": "Lock exposure and white balance when you record.",
        "bad": "Exposure was automatic, or the light changed while recording. Lock exposure and white balance, and "
        "record again.",
    },
}
"""Why photos are not as bright as their renders, by whether their exposure was corrected, and by the rating."""
MIN_LIGHT_DIRECTIONS = N_LIGHTS + 1
"""Number of light directions below which a point counts as lit from few directions: light that is fixed to the object
gives at most one per bright light, `N_LIGHTS` in all."""


@dataclass(frozen=True)
class Row:
    """One measure of the card."""

    name: str
    value: str
    """The measured value with its unit."""
    rating: CardRating
    sentence: str
    """Meaning of the rating, and what to do about it."""
    bars: tuple[float, ...] = ()
    """One value per frame for the bar chart; NaN where there is none."""
    marks: tuple[CardRating, ...] = ()
    """Rating of each bar."""


def card(
    frames: Sequence[RenderedFrame],
    quality: PoseQuality | None,
    confidence: Confidence,
    colour_deviation: Sequence[float] = (),
    *,
    corrected: bool = False,
) -> list[Row]:
    """All rows of the card, in the order of the page.

    Args:
        frames: The training frames with their renders.
        quality: Quality of the poses; None if they came with the capture.
        confidence: How well the surface was seen and lit.
        colour_deviation: Standard deviation of the albedo's scale per channel; empty if it was not estimated.
        corrected: Whether the exposure was measured on the background and corrected when the footage was converted.
    """
    return [
        _photo_row(frames),
        _silhouette_row(frames),
        _brightness_row(frames, corrected),
        _turn_row(quality),
        _lost_row(quality),
        _match_row(quality),
        _light_row(confidence),
        _colour_row(colour_deviation),
    ]


def overall(rows: Sequence[Row]) -> tuple[CardRating, str, str]:
    """The worst rating of all rows, with a word and a sentence for it."""
    ratings = {row.rating for row in rows}
    worst: CardRating = "bad" if "bad" in ratings else "warn" if "warn" in ratings else "good"
    word, sentence = OVERALL[worst]
    names = ", ".join(row.name.lower() for row in rows if row.rating == worst)
    return worst, word, sentence if worst == "good" else f"{sentence}{names}. The section Health gives the details."


def _photo_row(frames: Sequence[RenderedFrame]) -> Row:
    values = tuple(frame.psnr for frame in frames)
    median, limits = _median(values), LIMITS["psnr"]
    rating = _higher_is_better(median, limits)
    sentence = {
        "good": "The renders match the photos.",
        "warn": "The renders differ visibly from the photos. Reconstructing with a higher --quality often helps.",
        "bad": "The renders do not look like the photos. Check the poses first, then the masks; the method also fails "
        "on objects that are transparent or not rigid.",
        "none": "No frame shows the object.",
    }[rating]
    # Outliers are relative to the run's median, because PSNR depends on the object: it is high for any dark one.
    outliers = [frame.name for frame, value in zip(frames, values, strict=True) if value < median - 6]
    rating = "warn" if outliers and rating == "good" else rating
    sentence += _frame_list(outliers, "more than 6 dB below the median; the poses there may be wrong")
    marks: tuple[CardRating, ...] = tuple("bad" if value < median - 6 else "good" for value in values)
    return Row("Renders against photos", f"{median:.1f} dB", rating, sentence, values, marks)


def _silhouette_row(frames: Sequence[RenderedFrame]) -> Row:
    values = tuple(frame.iou for frame in frames)
    median, limits = _median(values), LIMITS["iou"]
    rating = _higher_is_better(median, limits)
    sentence = {
        "good": "The rendered silhouettes match the masks.",
        "warn": "The rendered silhouettes differ from the masks in places. Look for background inside the masks, and "
        "for thin parts that are missing from the reconstruction.",
        "bad": "The rendered silhouettes do not match the masks, so poses or masks are wrong. Look at the mask preview "
        "of tumble check.",
        "none": "No frame has a mask.",
    }[rating]
    outliers = [frame.name for frame, value in zip(frames, values, strict=True) if value < limits[1]]
    sentence += _frame_list(outliers, f"with an IoU below {limits[1]:.2f}")
    return Row("Silhouettes against masks", f"{median:.3f} IoU", rating, sentence, values, _ratings(values, limits))


def _brightness_row(frames: Sequence[RenderedFrame], corrected: bool) -> Row:
    values = [frame.exposure_stops for frame in frames]
    known = sorted(value for value in values if not math.isnan(value))
    if len(known) < 4:
        return Row("Brightness", "-", "none", "There are too few frames to measure it.")
    # Range of the middle 90 % of the frames: a single frame with a finger in front of the object is no drift.
    margin = len(known) // 20
    drift = known[-1 - margin] - known[margin]
    rating, median = _lower_is_better(drift, LIMITS["exposure"]), statistics.median(known)
    sentence = {
        "good": "All photos are about equally bright, compared with their renders.",
        "warn": f"Some photos are brighter than others, compared with their renders. {UNEVEN[corrected]['warn']}",
        "bad": f"The photos are brighter and darker than their renders. {UNEVEN[corrected]['bad']}",
    }[rating]
    bars = tuple(abs(value - median) for value in values)
    marks: tuple[CardRating, ...] = tuple(
        _lower_is_better(bar, (LIMITS["exposure"][0], LIMITS["exposure"][1])) for bar in bars
    )
    return Row("Brightness", f"{drift:.2f} stops", rating, sentence, bars, marks)


def _turn_row(quality: PoseQuality | None) -> Row:
    if quality is None:
        return Row("Turn of the object", "-", "none", "The poses came with the capture and were not rated.")
    turn = math.degrees(float(quality.rotation_range))
    rating = _higher_is_better(turn, LIMITS["turn"])
    sentence = {
        "good": "The object was turned far enough for its shape to follow from its silhouettes.",
        "warn": "The object was turned by less than a quarter of a revolution: its depth is uncertain, and its other "
        "sides are unknown.",
        "bad": "The object was hardly turned: neither its depth nor the light can be told from such frames. Turn it "
        "all around when you record.",
        "none": "There are no poses.",
    }[rating]
    return Row("Turn of the object", f"{turn:.0f} degrees", rating, sentence)


def _lost_row(quality: PoseQuality | None) -> Row:
    if quality is None:
        return Row("Lost frames", "-", "none", "The poses came with the capture, so none were estimated.")
    lost, limits = [bool(x) for x in quality.lost], LIMITS["lost"]
    rating = _lower_is_better(sum(lost) / max(1, len(lost)), limits)
    sentence = {
        "good": "A pose was found for every frame.",
        "warn": "No pose was found for a few frames; they are left out.",
        "bad": "No pose was found for many frames. Turn the object more slowly, and keep your fingers off its texture.",
        "none": "There are no frames.",
    }[rating]
    marks: tuple[CardRating, ...] = tuple("bad" if x else "good" for x in lost)
    return Row(
        "Lost frames", f"{sum(lost)} of {len(lost)}", rating, sentence, tuple(0.15 + 0.85 * x for x in lost), marks
    )


def _match_row(quality: PoseQuality | None) -> Row:
    if quality is None:
        return Row("Match residual", "-", "none", "The poses came with the capture, so no matches were made.")
    values = tuple(float(x) for x in quality.residual)
    median, limits = _median(values), LIMITS["residual"]
    rating = _lower_is_better(median, limits)
    sentence = {
        "good": "Matched points lie close to where the poses predict them.",
        "warn": "Matched points lie off from where the poses predict them. The focal length may be wrong (give --focal "
        "or --fov if you know it), or the object is shiny.",
        "bad": "Matched points lie far from where the poses predict them. The object may not be rigid, or may look the "
        "same from several sides.",
        "none": "There were no matches; the poses come from silhouettes alone.",
    }[rating]
    sentence = f"{sentence} {quality.sentence}"
    # Consistent matches do not exclude wrong rotations; the rating of the poses uses more than the residual.
    if quality.rating == "bad" or (quality.rating == "warn" and rating in ("good", "none")):
        rating = quality.rating
    value = "-" if math.isnan(median) else f"{median:.2f} px"
    return Row("Match residual", value, rating, sentence, values, tuple(_lower_is_better(v, limits) for v in values))


def _light_row(confidence: Confidence) -> Row:
    visible = confidence.views > 0
    few = float((confidence.lights[visible] < MIN_LIGHT_DIRECTIONS).float().mean()) if visible.any() else math.nan
    rating = _lower_is_better(few, LIMITS["few_lights"])
    sentence = {
        "good": "Nearly the whole surface was lit from many directions.",
        "warn": "Parts of the surface were lit from few directions; shading may be mixed into the colour there.",
        "bad": "Much of the surface was lit from few directions, and colour and light cannot be separated there. Turn "
        "the object about more than one axis when you record.",
        "none": "No part of the surface is visible in any frame.",
    }[rating]
    return Row("Lit from few directions", "-" if math.isnan(few) else f"{few:.0%} of the surface", rating, sentence)


def _colour_row(deviation: Sequence[float]) -> Row:
    error = max(deviation, default=math.nan)
    rating = _lower_is_better(error, LIMITS["colour"])
    if rating == "none":
        return Row("Absolute colour", "-", rating, "How albedo and light share each colour was not estimated.")
    sentence = (
        "Photos show the product of albedo and light; this is the standard deviation of the factor between the two in "
        "the least certain channel. A matte object or a flat light leaves its brightness open; a pixel that shows "
        "white or grey (tumble run --white) makes its hue certain."
    )
    return Row("Absolute colour", f"± {error:.0%}", rating, sentence)


def _median(values: Sequence[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return statistics.median(known) if known else math.nan


def _lower_is_better(value: float, limits: tuple[float, float]) -> CardRating:
    """Rating of a value that should stay below both limits, ("warn", "bad"); "none" for NaN."""
    if math.isnan(value):
        return "none"
    return "bad" if value > limits[1] else "warn" if value > limits[0] else "good"


def _higher_is_better(value: float, limits: tuple[float, float]) -> CardRating:
    """Rating of a value that should stay above both limits, ("warn", "bad"); "none" for NaN."""
    return _lower_is_better(-value, (-limits[0], -limits[1]))


def _ratings(values: Sequence[float], limits: tuple[float, float]) -> tuple[CardRating, ...]:
    return tuple(_higher_is_better(value, limits) for value in values)


def _frame_list(names: Sequence[str], description: str) -> str:
    """A sentence that names at most four frames; "" without names."""
    if not names:
        return ""
    more = f" and {len(names) - 4} more" if len(names) > 4 else ""
    return f" {len(names)} {'frame' if len(names) == 1 else 'frames'} {description}: {', '.join(names[:4])}{more}."
