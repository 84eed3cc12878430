"""The health card: what was measured of a run, how bad that is, and what to do about it, in plain sentences."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from tumble.export import LAMPS, Confidence
from tumble.poses import PoseQuality
from tumble.report.training_views import RenderedFrame

CardVerdict = Literal["good", "warn", "bad", "none"]
WORDS: dict[CardVerdict, str] = {"good": "Good", "warn": "Watch", "bad": "Poor", "none": "Not known"}
OVERALL: dict[CardVerdict, tuple[str, str]] = {
    "good": ("Good", "Nothing stands out; the asset can be used."),
    "warn": ("Usable", "Something is worth a look before the asset is used: "),
    "bad": ("Doubtful", "Something went wrong: "),
}
LIMITS = {
    "fit": (26.0, 21.0),
    "outline": (0.95, 0.90),
    "exposure": (0.2, 0.5),
    "lost": (0.0, 0.1),
    "match": (1.5, 3.0),
    "variety": (0.2, 0.6),
}
"""Where a row turns yellow, and where red: [dB], IoU, [stops], share of frames, [pixels], share of the surface.

Rules of thumb: synthetic captures with exact poses and the draft recipe lie on the good side of all of them.
"""
FEW_LIGHTS = LAMPS + 1
"""Light directions under which a point had no more than light that turns with the object would have given it."""


@dataclass(frozen=True)
class Row:
    """One line of the card."""

    name: str
    value: str
    verdict: CardVerdict
    sentence: str
    bars: tuple[float, ...] = ()
    """One value per frame, NaN where there is none."""
    marks: tuple[CardVerdict, ...] = ()
    """One per bar."""


def card(frames: Sequence[RenderedFrame], quality: PoseQuality | None, seen: Confidence) -> list[Row]:
    """All rows, in order."""
    return [_fit(frames), _outline(frames), _exposure(frames), _lost(quality), _match(quality), _variety(seen)]


def overall(rows: Sequence[Row]) -> tuple[CardVerdict, str, str]:
    """The worst verdict, a word and a sentence for it."""
    found = {row.verdict for row in rows}
    worst: CardVerdict = "bad" if "bad" in found else "warn" if "warn" in found else "good"
    word, sentence = OVERALL[worst]
    names = ", ".join(row.name.lower() for row in rows if row.verdict == worst)
    return worst, word, sentence if worst == "good" else f"{sentence}{names}. The health card says more."


def _fit(frames: Sequence[RenderedFrame]) -> Row:
    values = tuple(frame.psnr for frame in frames)
    middle, limits = _median(values), LIMITS["fit"]
    verdict = _low(middle, limits)
    sentence = {
        "good": "The renders match the photographs.",
        "warn": "The renders differ visibly from the photographs. A longer recipe (--quality) often helps.",
        "bad": "The renders do not look like the photographs. Suspect the poses first, then the masks, then a surface "
        "that is not opaque or moves.",
        "none": "No frame shows the object.",
    }[verdict]
    # A frame is an outlier against its own run: a dark object scores well everywhere.
    off = [frame.name for frame, value in zip(frames, values, strict=True) if value < middle - 6]
    verdict = "warn" if off and verdict == "good" else verdict
    sentence += _list(off, "far worse than the rest; their poses may be wrong")
    marks: tuple[CardVerdict, ...] = tuple("bad" if value < middle - 6 else "good" for value in values)
    return Row("Fit to the photographs", f"{middle:.1f} dB", verdict, sentence, values, marks)


def _outline(frames: Sequence[RenderedFrame]) -> Row:
    values = tuple(frame.iou for frame in frames)
    middle, limits = _median(values), LIMITS["outline"]
    verdict = _low(middle, limits)
    sentence = {
        "good": "The object's outline lies on the masks.",
        "warn": "The outline misses parts of the masks: look for background in the masks, or thin parts that are gone.",
        "bad": "The outline does not lie on the masks: poses or masks are wrong. Look at the mask preview of tumble "
        "check.",
        "none": "No frame has a mask.",
    }[verdict]
    off = [frame.name for frame, value in zip(frames, values, strict=True) if value < limits[1]]
    sentence += _list(off, f"with an overlap under {limits[1]:.2f}")
    return Row("Outline against mask", f"{middle:.3f} IoU", verdict, sentence, values, _lows(values, limits))


def _exposure(frames: Sequence[RenderedFrame]) -> Row:
    values = [frame.stops for frame in frames]
    known = sorted(value for value in values if not math.isnan(value))
    if len(known) < 4:
        return Row("Exposure drift", "-", "none", "Too few frames to tell.")
    # Nine frames in ten: one with a finger in front is no drift.
    margin = len(known) // 20
    drift = known[-1 - margin] - known[margin]
    verdict, middle = _high(drift, LIMITS["exposure"]), statistics.median(known)
    sentence = {
        "good": "All photographs are about equally bright for what they show.",
        "warn": "Some photographs are brighter than others for what they show: lock exposure and white balance.",
        "bad": "The brightness wanders: exposure was automatic, or the light changed while filming. Lock exposure and "
        "white balance, and film again.",
    }[verdict]
    bars = tuple(abs(value - middle) for value in values)
    marks: tuple[CardVerdict, ...] = tuple(_high(bar, (LIMITS["exposure"][0], LIMITS["exposure"][1])) for bar in bars)
    return Row("Exposure drift", f"{drift:.2f} stops", verdict, sentence, bars, marks)


def _lost(quality: PoseQuality | None) -> Row:
    if quality is None:
        return Row("Lost frames", "-", "none", "The poses came with the capture; none was estimated.")
    lost, limits = [bool(x) for x in quality.lost], LIMITS["lost"]
    verdict = _high(sum(lost) / max(1, len(lost)), limits)
    sentence = {
        "good": "Every frame was located.",
        "warn": "A few frames could not be located; they are left out.",
        "bad": "Many frames could not be located. Turn the object more slowly, and keep fingers off its texture.",
        "none": "No frames.",
    }[verdict]
    marks: tuple[CardVerdict, ...] = tuple("bad" if x else "good" for x in lost)
    return Row(
        "Lost frames", f"{sum(lost)} of {len(lost)}", verdict, sentence, tuple(0.15 + 0.85 * x for x in lost), marks
    )


def _match(quality: PoseQuality | None) -> Row:
    if quality is None:
        return Row("Match residual", "-", "none", "The poses came with the capture; no matches were made.")
    values = tuple(float(x) for x in quality.residual)
    middle, limits = _median(values), LIMITS["match"]
    verdict = _high(middle, limits)
    sentence = {
        "good": "The same points are found again in other frames, close to where they should be.",
        "warn": "Points are found again some way off where they should be: the focal length may be wrong, or the "
        "object is shiny.",
        "bad": "Points do not fall where they should: the object may not be rigid, or it looks the same from several "
        "sides.",
        "none": "There were no matches; the poses rest on outlines alone.",
    }[verdict]
    sentence = f"{sentence} {quality.sentence}"
    # Matches may agree with each other on a wrong turn; the health of the poses knows more.
    if quality.verdict == "bad" or (quality.verdict == "warn" and verdict in ("good", "none")):
        verdict = quality.verdict
    value = "-" if math.isnan(middle) else f"{middle:.2f} px"
    return Row("Match residual", value, verdict, sentence, values, tuple(_high(v, limits) for v in values))


def _variety(seen: Confidence) -> Row:
    shown = seen.views > 0
    few = float((seen.lights[shown] < FEW_LIGHTS).float().mean()) if shown.any() else math.nan
    verdict = _high(few, LIMITS["variety"])
    sentence = {
        "good": "Nearly the whole surface was lit from many sides.",
        "warn": "Parts of the surface were lit from few sides; there shading may have gone into the colour.",
        "bad": "Much of the surface was lit from few sides: colour and light cannot be told apart there. Turn the "
        "object about more than one axis.",
        "none": "Nothing was seen.",
    }[verdict]
    return Row("Lit from few sides", "-" if math.isnan(few) else f"{few:.0%} of the surface", verdict, sentence)


def _median(values: Sequence[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return statistics.median(known) if known else math.nan


def _high(value: float, limits: tuple[float, float]) -> CardVerdict:
    if math.isnan(value):
        return "none"
    return "bad" if value > limits[1] else "warn" if value > limits[0] else "good"


def _low(value: float, limits: tuple[float, float]) -> CardVerdict:
    return _high(-value, (-limits[0], -limits[1]))


def _lows(values: Sequence[float], limits: tuple[float, float]) -> tuple[CardVerdict, ...]:
    return tuple(_low(value, limits) for value in values)


def _list(names: Sequence[str], what: str) -> str:
    """A sentence that names at most four frames."""
    if not names:
        return ""
    more = f" and {len(names) - 4} more" if len(names) > 4 else ""
    return f" {len(names)} {'frame' if len(names) == 1 else 'frames'} {what}: {', '.join(names[:4])}{more}."
