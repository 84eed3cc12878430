"""Plausibility of a capture: rules that any real recording follows, checked before anything is computed.

Each rule is one line of `ERRORS` or `WARNINGS`: what it measures, the sentence about the measurement, and the fix. The
limits are far from what recordings have; a capture outside of them is a mistake, such as another unit or convention.
"""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.io import BadFile
from tumble.scene import BACKGROUND, OBJECT, Capture

MIN_FRAMES = 3
"""Minimum number of frames; fewer show no motion."""
FOCAL_RANGE = (0.05, 1000.0)
"""Range of the focal length [longer side of the image]: fields of view of 0.06 to 169 degrees; small crops of long
lenses have 100."""
MAX_FOCAL_RATIO = 2.0
"""Maximum ratio of the two focal lengths, as of anamorphic lenses."""
MAX_CENTRE_OFFSET = 1000.0
"""Maximum distance of the principal point from the image [longer side of the image]; crops far from the centre have
10."""
MAX_DISTORTION = 1e3
"""Maximum size of a distortion coefficient; the denominators of OpenCV's rational model have 100."""
MIN_ROTATION = math.radians(2)
"""Minimum rotation of the object between any two frames [radians]."""
DISTANCE_RANGE = (0.3, 300.0)
"""Range of the distance of the cameras from the origin [object radius]."""
SPHERE_RADIUS = 1.05
"""Radius of the sphere that must contain the object, with a margin for masks [object radius]."""
MAX_OUTSIDE = (0.1, 0.99)
"""Fractions of the object's pixels beyond that sphere above which there is a warning and an error."""
N_SAMPLED = 16
"""Number of frames whose masks are compared with the sphere."""


@dataclass(frozen=True)
class Rule:
    """One rule of plausibility."""

    measure: Callable[[Capture], object]
    """What contradicts the rule; None if nothing does."""
    sentence: str
    """Sentence with the measurement as {}."""
    fix: str


def plausible_focal(focal: float, height: int, width: int) -> bool:
    """Whether a focal length [pixels] is that of a real lens; no infinity and no NaN."""
    low, high = (bound * max(height, width) for bound in FOCAL_RANGE)
    return bool(low <= focal <= high)


def plausible_centre(cx: float, cy: float, height: int, width: int) -> bool:
    """Whether a principal point [pixels] may be that of a crop of a photo; no infinity and no NaN."""
    limit = MAX_CENTRE_OFFSET * max(height, width)
    return abs(cx) <= limit and abs(cy) <= limit


def check_plausible(capture: Capture, where: Path) -> None:
    """Check a capture against all rules; warns if the object is not in the unit sphere or has no mask.

    Args:
        where: Path of the capture, for messages.

    Raises:
        BadFile: The capture contradicts a rule.
    """
    for rule in ERRORS:
        if (found := rule.measure(capture)) is not None:
            raise BadFile(where, rule.sentence.format(found), rule.fix)
    for rule in WARNINGS:
        if (found := rule.measure(capture)) is not None:
            warnings.warn(f"{where}: {rule.sentence.format(found)} ({rule.fix})", stacklevel=3)


# Measurements ---------------------------------------------------------------------------------------------------------


def _few_frames(capture: Capture) -> int | None:
    return len(capture) if len(capture) < MIN_FRAMES else None


def _impossible_focal(capture: Capture) -> str | None:
    fx, fy = capture.camera.fx_fy_cx_cy[:2].tolist()
    height, width = capture.camera.height, capture.camera.width
    plausible = plausible_focal(fx, height, width) and plausible_focal(fy, height, width)
    if plausible and 1 / MAX_FOCAL_RATIO <= fx / fy <= MAX_FOCAL_RATIO:
        return None
    return f"{fx:.3g} and {fy:.3g} pixels for images of {width} x {height}"


def _impossible_centre(capture: Capture) -> str | None:
    cx, cy = capture.camera.fx_fy_cx_cy[2:].tolist()
    plausible = plausible_centre(cx, cy, capture.camera.height, capture.camera.width)
    return None if plausible else f"({cx:.3g}, {cy:.3g})"


def _no_motion(capture: Capture) -> str | None:
    """The largest rotation between the first and any other frame, if it is too small."""
    if capture.trajectory is None:
        return None
    R = capture.trajectory.T_cam_obj.rotation.matrix().double()
    angle = torch.linalg.matrix_norm(R - R[:1]).clamp(max=math.sqrt(8)).div(math.sqrt(8)).asin().mul(2).max()
    return None if angle >= MIN_ROTATION else f"{math.degrees(angle):.2f}"


def _distances(capture: Capture) -> Float[Tensor, " t"]:
    assert capture.trajectory is not None
    return capture.trajectory.T_cam_obj.xyz.double().norm(dim=-1)


def _inside(capture: Capture) -> str | None:
    return _distance(capture, lambda distances: ~(distances >= DISTANCE_RANGE[0]))


def _far_away(capture: Capture) -> str | None:
    return _distance(capture, lambda distances: distances > DISTANCE_RANGE[1])


def _distance(capture: Capture, wrong: Callable[[Tensor], Tensor]) -> str | None:
    """Name of the first frame whose camera has a wrong distance, and the distance."""
    if capture.trajectory is None:
        return None
    distances = _distances(capture)
    found = wrong(distances).nonzero()
    return None if len(found) == 0 else f"{capture.names[int(found[0])]} is {distances[int(found[0])]:.3g}"


def _has_masks(capture: Capture) -> bool:
    return bool((capture.masks == BACKGROUND).any())


def _no_silhouette(capture: Capture) -> str | None:
    return "" if capture.trajectory is None and not _has_masks(capture) else None


def _no_mask(capture: Capture) -> str | None:
    return "" if capture.trajectory is not None and not _has_masks(capture) else None


def _outside(capture: Capture) -> float | None:
    """Fraction of the object's pixels whose rays miss the unit sphere, in some of the frames."""
    if capture.trajectory is None or not _has_masks(capture):
        return None
    rays = capture.camera.directions()
    missed = total = 0
    for i in range(0, len(capture), max(1, len(capture) // N_SAMPLED)):
        x = capture.trajectory.T_cam_obj.xyz[i].to(rays)
        d = rays[capture.masks[i] == OBJECT]
        nearest = (d @ x).clamp_min(0)[:, None] * d  # rays begin at the camera
        missed += int(((x - nearest).norm(dim=-1) > SPHERE_RADIUS).sum())
        total += len(d)
    return missed / max(total, 1)


def _elsewhere(capture: Capture) -> str | None:
    outside = _outside(capture)
    return None if outside is None or outside <= MAX_OUTSIDE[1] else f"{outside:.0%}"


def _partly_outside(capture: Capture) -> str | None:
    outside = _outside(capture)
    return None if outside is None or outside <= MAX_OUTSIDE[0] else f"{outside:.0%}"


UNIT = "move the origin to the object's centre, and scale the translations so that its radius is 1 (docs/format.md)"
"""Fix of the rules about distances."""
ERRORS = (
    Rule(_few_frames, "has {} frames, but a reconstruction needs at least 3", "record 40 to 100"),
    Rule(_impossible_focal, "has focal lengths of {}", "no lens has them: they are in pixels of these images"),
    Rule(_impossible_centre, "has its principal point at {}", "it is in pixels of these images"),
    Rule(_no_silhouette, "shows no background in any mask{}", "poses are estimated from masks: provide some"),
    Rule(_no_motion, "has poses that differ by only {} degrees", "the object must turn, or the camera go around it"),
    Rule(_inside, "has a camera inside the object: the distance of {} object radii", UNIT),
    Rule(_far_away, "has a camera too far from the object: the distance of {} object radii", UNIT),
    Rule(_elsewhere, "has masks that contradict the poses: {} of their pixels are outside the unit sphere", UNIT),
)
"""Rules that a capture must follow, in the order in which they are checked."""
WARNINGS = (
    Rule(_no_mask, "has no masks{}, so the background is reconstructed as if it was the object", "provide masks"),
    Rule(_partly_outside, "shows an object that is not in the unit sphere: {} of its pixels are outside", UNIT),
)
"""Rules whose violation lowers the quality."""
