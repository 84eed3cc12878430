"""Suitability of footage for reconstruction: one finding per property, with advice for recording it again.

A finding is rated "stop" if no reconstruction is possible, "warn" if its quality will suffer, and else "good". The
footage is suitable (GO) if no finding is a "stop". A limit given as a pair is (limit of a warning, limit of a stop); if
the first number is larger, small values are bad.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from tumble.io import BadFile, files, outputs, progress, video
from tumble.preprocess import colmap_to_capture, keyframes, segmentation, video_to_capture
from tumble.preprocess.camera_motion import MAX_CAMERA_MOTION
from tumble.preprocess.options import FootageOptions
from tumble.preprocess.picker import pick_box
from tumble.preprocess.source import input_kind
from tumble.preprocess.survey import Survey, survey_footage

SOURCE_FILE = "check.json"
"""File beside the preview that names the footage that it is of."""
CAMERA_MOTION = (0.004, MAX_CAMERA_MOTION)
"""Limits of the motion of the background [longer side of the image]; 8 and 38 of 1920 pixels."""
EDGE_BLUR = (1.2, 2.5)
"""Limits of the blur of the object's edges in the selected frames [pixels of the capture's images]."""
MAX_EXPOSURE_RANGE = 0.15
"""Range of the exposure over the video above which a warning is given [stops]. No range prevents a reconstruction,
because the drift is corrected; pixels that it saturates are counted on their own."""
MAX_WHITE_BALANCE_RANGE = 0.08
"""Range of the gain of red or blue relative to green, over the video, above which a warning is given."""
UNCERTAIN_FRAMES = (0.1, 0.4)
"""Limits of the fraction of frames with an uncertain or empty mask."""
CROPPED_FRAMES = (0.02, 0.3)
"""Limits of the fraction of frames in which the object touches the border of the image."""
MAX_SATURATED = 0.03
"""Fraction of saturated pixels of the object above which a warning is given; specular highlights are tolerated."""
DIAMETER = (96, 40)
"""Limits of the object's diameter [pixels of the footage]."""
TOTAL_ROTATION = (math.radians(300), math.radians(60))
"""Limits of the object's total rotation [radians]."""
ROTATION_PER_FRAME = (math.radians(12), math.radians(25))
"""Limits of the rotation between consecutive frames of the video [radians]."""
FAST_PERCENTILE = 80
"""Percentile of the rotations between consecutive frames that is compared with these limits."""
MAX_KEYFRAME_STEP = math.radians(15)
"""Rotation between selected frames above which a warning is given, because matching becomes unreliable [radians]."""
REPROJECTION_ERROR = (1.0, 3.0)
"""Limits of the mean reprojection error of a COLMAP model [pixels]."""
RAY_DISTANCE = (0.4, 0.8)
"""Limits of the median distance of the rays through the mask centres from a common point [radius of a mask]."""
VIEW_ANGLE = (math.radians(90), math.radians(30))
"""Limits of the largest angle between two views of the object, of photographs or of a film [radians]."""

MAX_HAND_COLOURED = 0.08
"""Fraction of a mask with the colours of a hand above which a part of a hand is probably taken for the object."""
AREA_NEIGHBOURS = 3
"""Number of frames before and after one with whose masks its area is compared."""
MAX_AREA_CHANGE = 1.6
"""Ratio of the area of a mask to the median of its neighbours above which, or below the inverse of which, it jumps."""
N_WORST = 5
"""Maximum number of frames that are named as the worst."""
WORST_SPACING = 4
"""Minimum distance of two named frames; neighbours mostly have the same fault [surveyed frames]."""

CheckRating = Literal["good", "warn", "stop"]


@dataclass(frozen=True)
class Finding:
    """Result of the check of one property of the footage."""

    subject: str
    """Name of the property, at most 10 characters."""
    rating: CheckRating
    state: str
    """The measurement, in words."""
    advice: str = ""
    """How to improve it; empty if the rating is good."""


def check_footage(
    path: Path, out: Path, options: FootageOptions | None = None, *, pick: bool = False, overwrite: bool = False
) -> list[Finding]:
    """Check a video or a folder of images, and write a preview of its masks into the folder `out`.

    Args:
        pick: Draw a box around the object in the browser.
        overwrite: Write into `out` even if it holds something else than an earlier preview.

    Raises:
        BadFile: The footage cannot be read, no moving object is found in it, or `out` holds something else, which may
            be the preview of other footage.
    """
    outputs.require_outside(out, path)
    outputs.claim_folder(out, video_to_capture.PREVIEW, overwrite=overwrite)
    known, source = out / SOURCE_FILE, {"footage": str(path.resolve())}
    shown = files.read_json(known, dict[str, str], outputs.OTHER_PLACE) if known.is_file() and not overwrite else source
    if shown != source:
        raise BadFile(out, f"holds the preview of {shown.get('footage')}", outputs.OTHER_PLACE)
    options = options or FootageOptions()
    options = pick_box(path, options, out / "capture") if pick else options
    findings = _findings(path, out, options)
    files.write_json(known, source)
    return findings


def _findings(path: Path, out: Path, options: FootageOptions) -> list[Finding]:
    """Write the preview, and find what there is to say."""
    if input_kind(path) == "posed images":
        return _check_posed(colmap_to_capture.collect_silhouettes(path, options), out, options)
    with progress.task(f"surveying {path.name}"):
        survey = survey_footage(path, options)
    selected = keyframes.select_keyframes(survey.rotation, survey.blurs, survey.usable, options.frames)
    kept = [int(i) for i in np.nonzero(survey.usable)[0]] if survey.footage.images else selected
    video_to_capture.write_preview(survey, out / video_to_capture.PREVIEW, kept)
    findings = [_video(survey), _inputs(survey), _camera(survey), _masks(survey), _worst(survey), _border(survey)]
    with_hand = float(np.mean([bool(hands) for hands in survey.hands]))
    findings += [_hand(with_hand)] if with_hand else []
    if not kept:
        return [*findings, Finding("frames", "stop", "no usable frame", "draw a box with --pick, or give --masks")]
    return [*findings, _size(survey), *_rotation(survey, kept), _sharpness(survey, kept, options), *_light(survey)]


def passes(findings: list[Finding]) -> bool:
    """Whether the footage is suitable: no finding is rated "stop"."""
    return all(finding.rating != "stop" for finding in findings)


def _rate(value: float, limits: tuple[float, float]) -> CheckRating:
    """Rating of a value by the limits of a warning and of a stop."""
    sign = 1 if limits[1] >= limits[0] else -1
    return "stop" if sign * value > sign * limits[1] else "warn" if sign * value > sign * limits[0] else "good"


def _finding(subject: str, rating: CheckRating, state: str, advice: str) -> Finding:
    return Finding(subject, rating, state, "" if rating == "good" else advice)


def _video(survey: Survey) -> Finding:
    camera, n = survey.lens.camera, len(survey.numbers)
    state = f"{camera.width} x {camera.height}, {n} frames surveyed, {survey.times[-1] - survey.times[0]:.1f} s"
    hdr = survey.footage.hdr
    return Finding("video", "good", state if hdr is None else f"{state}, HDR ({hdr}) converted to sRGB")


def _inputs(survey: Survey) -> Finding:
    focal = float(survey.lens.camera.fx_fy_cx_cy[0])
    state = f"focal length {focal:.0f} pixels ({survey.lens.source})"
    if survey.seed_from_motion and survey.seed is not None and survey.seed.box is not None:
        left, top, width, height = (round(v / survey.scale) for v in survey.seed.box)
        state += f"; object detected at {left} {top} {width} {height} on frame {survey.numbers[survey.seed.index]}"
    assumed = survey.seed_from_motion or survey.lens.source == "guess"
    advice = (
        "check the preview of the masks; if it is wrong, draw a box with --pick; give --focal or --fov if you know it"
    )
    advice += " (otherwise the run estimates the focal length)" if survey.lens.source == "guess" else ""
    return _finding("inputs", "warn" if assumed else "good", state, advice)


def _camera(survey: Survey) -> Finding:
    if math.isnan(survey.camera_motion):
        return _finding("camera", "good", "the background is too plain to see whether the camera moves", "")
    state = f"the background moves by {100 * survey.camera_motion:.1f} % of the image"
    rating = _rate(survey.camera_motion, CAMERA_MOTION)
    if survey.still_camera or rating == "good":
        return _finding("camera", rating, state, "put the camera on a tripod: it must stand still")
    return _finding("camera", "warn", state, "put the camera on a tripod: the light is taken to move with the camera")


def _masks(survey: Survey) -> Finding:
    fraction = float(survey.masks.uncertain.mean())
    worst = int(survey.numbers[survey.masks.confidence.argmin()])
    state = f"uncertain on {100 * fraction:.0f} % of the frames"
    if fraction > 0:
        state += f", most on frame {worst}"
    advice = (
        "check the preview (red borders); --pick a box on a clear frame (--at), give --masks, or use a plain background"
    )
    return _finding("masks", _rate(fraction, UNCERTAIN_FRAMES), state, advice)


def _worst(survey: Survey) -> Finding:
    """The frames with the worst masks, each with the reasons."""
    faults = [_faults(survey, i) for i in range(len(survey.numbers))]
    severity = np.array([sum(fault.values()) for fault in faults])
    named: list[int] = []
    for i in np.argsort(-severity, kind="stable").tolist():
        if severity[i] > 0 and len(named) < N_WORST and all(abs(i - j) >= WORST_SPACING for j in named):
            named.append(i)
    if not named:
        return Finding("worst", "good", "no frame stands out")
    state = "; ".join(f"frame {survey.numbers[i]}: {', '.join(faults[i])}" for i in named)
    advice = "look at these frames in the preview; correct their masks by clicks with --pick"
    return Finding("worst", "warn", state, advice)


def _faults(survey: Survey, i: int) -> dict[str, float]:
    """What may be wrong with the mask of a frame, in words, and how much it weighs."""
    areas = survey.inside.sum((1, 2))
    if areas[i] == 0:
        return {"the object is not found": 1.0}
    faults = {}
    confidence, hand = float(survey.masks.confidence[i]), float(survey.hand_coloured[i])
    if hand > MAX_HAND_COLOURED:
        faults[f"{100 * hand:.0f} % of the mask has the hand's colours"] = 4 * hand
    if confidence < segmentation.CERTAIN_OVERLAP:
        faults[f"overlap with the predicted mask only {100 * confidence:.0f} %"] = 1 - confidence
    around = [areas[j] for j in range(max(i - AREA_NEIGHBOURS, 0), min(i + AREA_NEIGHBOURS + 1, len(areas))) if j != i]
    ratio = float(areas[i] / max(np.median(around), 1)) if around else 1.0
    if not 1 / MAX_AREA_CHANGE < ratio < MAX_AREA_CHANGE:
        faults[f"{ratio:.1f} times the area of the frames around it"] = abs(math.log(ratio)) / 2
    return faults


def _hand(fraction: float) -> Finding:
    """What can be said of hidden parts before the poses are known, from the fraction of the frames with a hand."""
    state = f"detected on {100 * fraction:.0f} % of the frames; regrasp, so that it covers no part in all of them"
    return Finding("hand", "good", f"{state} (the report of a run names such parts)")


def _border(survey: Survey) -> Finding:
    inside = survey.inside
    edge = inside[:, [0, 1, -2, -1]].any((1, 2)) | inside[:, :, [0, 1, -2, -1]].any((1, 2))
    fraction = float(edge.mean())
    state = f"the object touches the border of the image on {100 * fraction:.0f} % of the frames"
    return _finding(
        "framing", _rate(fraction, CROPPED_FRAMES), state, "keep the whole object in the image, with some margin"
    )


def _size(survey: Survey) -> Finding:
    area = float(np.median(survey.inside[survey.usable].sum((1, 2))))
    diameter = 2 * math.sqrt(area / math.pi) / survey.scale
    state = f"the object is {diameter:.0f} pixels across"
    return _finding(
        "size", _rate(diameter, DIAMETER), state, "move the camera closer, or record at a higher resolution"
    )


def _rotation(survey: Survey, kept: list[int]) -> list[Finding]:
    total = float(survey.rotation[-1])
    state = f"about {math.degrees(total):.0f} degrees in total"
    ratings: list[CheckRating] = [_rate(total, TOTAL_ROTATION)]
    if not survey.footage.images:
        ratings.append(_rate(survey.rotation_range, VIEW_ANGLE))
        if ratings[-1] != "good":
            state += f"; no two frames are more than about {math.degrees(survey.rotation_range):.0f} degrees apart"
    advice = (
        "turn the object by 360 degrees twice, and tilt it; the rotation of a surface without texture is not measured"
    )
    findings = [_finding("rotation", max(ratings, key=get_args(CheckRating).index), state, advice)]
    if survey.footage.images:
        return findings
    spacing = np.maximum(np.diff(survey.numbers), 1)
    # The fastest frames are not asked: where a hand changes its grip, measured rotations are several times too large.
    fast = float(np.percentile(np.diff(survey.rotation) / spacing, FAST_PERCENTILE))
    state = f"{math.degrees(fast):.0f} degrees or more from frame to frame on a fifth of the frames"
    findings.append(
        _finding(
            "speed",
            _rate(fast, ROTATION_PER_FRAME),
            state,
            "turn the object more slowly, or record 60 frames per second",
        )
    )
    step = keyframes.largest_step(survey.rotation, kept)
    state = f"{len(kept)} selected, at most {math.degrees(step):.0f} degrees apart"
    slower = "turn the object more slowly where the preview shows no green border for long"
    advice = slower if len(kept) == len(survey.numbers) else f"select more with --frames, or {slower}"
    return [*findings, _finding("frames", "warn" if step > MAX_KEYFRAME_STEP else "good", state, advice)]


def _sharpness(survey: Survey, kept: list[int], options: FootageOptions) -> Finding:
    window = video_to_capture.crop_window(survey, kept)
    shrink = video_to_capture.image_scale(survey, kept, window, options.size)
    width = float(np.median(survey.blurs[kept]))
    blur = math.sqrt(max(width**2 - keyframes.PROBE_BLUR**2, 0.0)) * shrink if math.isfinite(width) else math.inf
    state = f"edges are blurred by {blur:.1f} pixels in the capture's images"
    return _finding(
        "sharpness", _rate(blur, EDGE_BLUR), state, "use more light, a shorter exposure, and focus on the object"
    )


def _light(survey: Survey) -> list[Finding]:
    stops = float(np.ptp(np.log2(survey.gains[:, 1])))
    colour = float(np.ptp(survey.gains / survey.gains[:, 1:2], axis=0).max())
    advice = "lock exposure and white balance; the drift is corrected, but clipped colours are lost"
    rating = "warn" if stops > MAX_EXPOSURE_RANGE or colour > MAX_WHITE_BALANCE_RANGE else "good"
    exposure = _finding("exposure", rating, f"drifts by {stops:.2f} stops, colours by {100 * colour:.0f} %", advice)
    pixels = survey.images[survey.inside]
    saturated = float((pixels.min(-1) >= 250).mean()) if len(pixels) else 0.0
    state = f"{100 * saturated:.1f} % of the object is saturated"
    advice = "expose for the object's brightest side: saturated pixels have no colour"
    return [exposure, _finding("highlights", "warn" if saturated > MAX_SATURATED else "good", state, advice)]


# Images with poses ----------------------------------------------------------------------------------------------------


def _check_posed(posed: colmap_to_capture.PosedImages, out: Path, options: FootageOptions) -> list[Finding]:
    """Findings of a COLMAP model with its images and masks."""
    R_new_cam = colmap_to_capture.camera_rotations(posed, options.light)
    camera, oversampling = colmap_to_capture.common_camera(posed, R_new_cam, options.size)
    resampled = colmap_to_capture.resampled_frames(posed, R_new_cam, camera, oversampling, options)
    video.write_clip(
        out / video_to_capture.PREVIEW,
        (video_to_capture.mask_overlay(p, m, video_to_capture.KEPT_EDGE) for p, m in resampled),
        quality=24,
    )
    n = len(posed.silhouettes)
    reasons = {"object": "the camera moved around the object", "camera": "the object was turned, its background masked"}
    state = f"fixed to the {options.light}: {reasons[options.light]}; change it with --light"
    findings = [_model(posed), Finding("light", "good", state)]
    fraction = len(posed.empty) / (n + len(posed.empty))
    state, advice = f"{100 * fraction:.0f} % of the masks are empty", "correct the empty masks"
    findings.append(_finding("masks", _rate(fraction, UNCERTAIN_FRAMES), state, advice))
    state = (
        f"the rays through the mask centres miss a common point by {100 * posed.ray_distance:.0f} % of a mask's radius"
    )
    advice = "masks and poses are inconsistent, or the object did not rest relative to the model's points"
    findings.append(_finding("agreement", _rate(posed.ray_distance, RAY_DISTANCE), state, advice))
    fraction = sum(silhouette.cropped for silhouette in posed.silhouettes) / n
    state = f"the object touches the border of {100 * fraction:.0f} % of the images"
    advice = "keep the whole object in the image, with some margin"
    findings.append(_finding("framing", _rate(fraction, CROPPED_FRAMES), state, advice))
    diameter = float(np.median([silhouette.diameter for silhouette in posed.silhouettes]))
    state = f"the object is {diameter:.0f} pixels across"
    findings.append(_finding("size", _rate(diameter, DIAMETER), state, "move the camera closer, or take larger images"))
    positions = colmap_to_capture.trajectory(posed, R_new_cam, options.light).camera_positions.double().numpy()
    positions = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    widest = math.acos(float((positions @ positions.T).clip(-1, 1).min()))
    state = f"{n} camera positions, up to {math.degrees(widest):.0f} degrees apart"
    findings.append(_finding("views", _rate(widest, VIEW_ANGLE), state, "take images from all sides, also from above"))
    return findings


def _model(posed: colmap_to_capture.PosedImages) -> Finding:
    state = f"{len(posed.model.views)} images with a pose, {len(posed.model.points)} points"
    if not len(posed.model.errors):
        return Finding("model", "good", state)
    error = float(posed.model.errors.mean())
    advice = "use sharper images or more texture around the object, and remove wrong matches"
    return _finding(
        "model", _rate(error, REPROJECTION_ERROR), f"{state}, mean reprojection error {error:.2f} pixels", advice
    )
