"""Is this film, or set of pictures, fit for reconstruction? One finding per property, with what to shoot again.

A finding *stops* when no reconstruction can come of the film, *warns* when it costs quality, and else is good. The film
is a GO when nothing stops.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from tumble.io import video
from tumble.preprocess import colmap_to_capture, keyframes, video_to_capture
from tumble.preprocess.box_picker import pick_box
from tumble.preprocess.options import FootageOptions
from tumble.preprocess.source import input_kind
from tumble.preprocess.survey import Survey, survey

SHAKEN = (0.004, video_to_capture.SHAKEN)
"""Motion of the background, as a share of the picture's longer side: from here it warns, and stops (8, 38 of 1920)."""
BLURRED = (1.2, 2.5)
"""Blur of the object's edges on the frames that would be kept [pixels of the written frames]."""
DRIFTED = (0.15, 1.0)
"""Range of exposure over the film [stops]."""
TINTED = 0.08
"""Range of a colour channel against green from which white balance is said to drift; it warns only."""
UNCERTAIN = (0.1, 0.4)
"""Share of frames whose mask is unsure."""
CLIPPED = (0.02, 0.3)
"""Share of frames in which the object touches the border of the picture."""
BURNT = 0.03
"""Share of the object's pixels that are saturated; a highlight is allowed."""
SMALL = (96, 40)
"""Diameter of the object on the film [pixels]."""
TURNED = (math.radians(300), math.radians(60))
"""Turn in all [radians]."""
FAST = (math.radians(12), math.radians(25))
"""Turn between neighbouring frames of the film [radians]."""
WIDE_STEP = math.radians(15)
"""Turn between kept frames above which matching suffers [radians]."""
MISSED = (1.0, 3.0)
"""Mean reprojection error of a COLMAP model [pixels]."""
APART = (0.4, 0.8)
"""How far the middles of the masks miss one point, in parts of the median mask's radius."""
ROUND = (math.radians(90), math.radians(30))
"""Largest angle between two views of the object [radians]."""

CheckVerdict = Literal["good", "warn", "stop"]


@dataclass(frozen=True)
class Finding:
    """One property of the film."""

    subject: str
    verdict: CheckVerdict
    state: str
    """What was measured."""
    advice: str = ""
    """What to do about it; empty when good."""


def check_footage(path: Path, out: Path, options: FootageOptions | None = None, *, pick: bool = False) -> list[Finding]:
    """Look at a film, or a folder of pictures, and write the preview of its masks to `out`.

    Args:
        pick: Ask a person in the browser where the object is.

    Raises:
        BadFile: It cannot be read, or nothing that moves is found in it.
    """
    options = options or FootageOptions()
    options = pick_box(path, options, out / "capture") if pick else options
    if input_kind(path) == "posed pictures":
        return _check_posed(colmap_to_capture.gather(path, options), out, options)
    found = survey(path, options)
    chosen = keyframes.chosen(found.turned, found.blurs, found.usable, options.frames)
    kept = [int(i) for i in np.nonzero(found.usable)[0]] if found.footage.pictures else chosen
    video_to_capture.preview(found, out / video_to_capture.PREVIEW, kept)
    findings = [_film(found), _hint(found), _camera(found), _masks(found), _border(found)]
    if not kept:
        return [*findings, Finding("frames", "stop", "none is usable", "draw a box with --pick, or give --masks")]
    return [*findings, _size(found), *_turning(found, kept), _sharpness(found, kept, options), *_light(found)]


def passes(findings: list[Finding]) -> bool:
    """Whether nothing stops a reconstruction."""
    return all(finding.verdict != "stop" for finding in findings)


def _graded(value: float, limits: tuple[float, float]) -> CheckVerdict:
    """By where a value stands to the limits of warning and stopping; they may rise or fall."""
    sign = 1 if limits[1] >= limits[0] else -1
    return "stop" if sign * value > sign * limits[1] else "warn" if sign * value > sign * limits[0] else "good"


def _finding(subject: str, verdict: CheckVerdict, state: str, advice: str) -> Finding:
    return Finding(subject, verdict, state, "" if verdict == "good" else advice)


def _film(found: Survey) -> Finding:
    camera, n = found.lens.camera, len(found.numbers)
    state = f"{camera.width} x {camera.height}, {n} frames looked at, {found.times[-1] - found.times[0]:.1f} s"
    hdr = found.footage.hdr
    advice = f"filmed in HDR ({hdr}): its colours are not sRGB; switch HDR video off and shoot again"
    return _finding("film", "good" if hdr is None else "warn", state, advice)


def _hint(found: Survey) -> Finding:
    focal = float(found.lens.camera.fx_fy_cx_cy[0])
    state = f"focal length {focal:.0f} pixels ({found.lens.source})"
    if found.guessed and found.seed is not None and found.seed.box is not None:
        left, top, width, height = (round(v / found.scale) for v in found.seed.box)
        state += f"; object guessed at {left} {top} {width} {height} on frame {found.numbers[found.seed.index]}"
    guesses = found.guessed or found.lens.source == "guess"
    advice = "look at the mask preview, and draw a box with --pick if it is wrong; give --focal or --fov if known"
    advice += ": else the run estimates it" if found.lens.source == "guess" else ""
    return _finding("hints", "warn" if guesses else "good", state, advice)


def _camera(found: Survey) -> Finding:
    moved = video_to_capture.shaken(found)
    state = f"the background moves by {100 * moved:.1f} % of the picture"
    return _finding("camera", _graded(moved, SHAKEN), state, "put the camera on a tripod: it must stand still")


def _masks(found: Survey) -> Finding:
    share = float(found.masks.unsure.mean())
    worst = int(found.numbers[found.masks.confidence.argmin()])
    state = f"unsure on {100 * share:.0f} % of the frames"
    if share > 0:
        state += f", most at frame {worst}"
    advice = "look at the preview (red edges); --pick a box on a clear frame (--at), --masks, or a plainer background"
    return _finding("masks", _graded(share, UNCERTAIN), state, advice)


def _border(found: Survey) -> Finding:
    inside = found.inside
    edge = inside[:, [0, 1, -2, -1]].any((1, 2)) | inside[:, :, [0, 1, -2, -1]].any((1, 2))
    share = float(edge.mean())
    state = f"the object touches the border of the picture on {100 * share:.0f} % of the frames"
    return _finding("framing", _graded(share, CLIPPED), state, "keep the whole object in the picture, with room around")


def _size(found: Survey) -> Finding:
    area = float(np.median(found.inside[found.usable].sum((1, 2))))
    diameter = 2 * math.sqrt(area / math.pi) / found.scale
    state = f"the object is {diameter:.0f} pixels across"
    return _finding("size", _graded(diameter, SMALL), state, "go nearer, or film at a higher resolution")


def _turning(found: Survey, kept: list[int]) -> list[Finding]:
    total = float(found.turned[-1])
    state = f"turns by about {math.degrees(total):.0f} degrees in all"
    advice = "turn it all the way round, twice, tilting it; a surface without any texture looks as if it did not turn"
    findings = [_finding("turning", _graded(total, TURNED), state, advice)]
    if found.footage.pictures:
        return findings
    frames_apart = np.maximum(np.diff(found.numbers), 1)
    fastest = float(np.percentile(np.diff(found.turned) / frames_apart, 95))
    state = f"up to {math.degrees(fastest):.0f} degrees from frame to frame"
    findings.append(_finding("speed", _graded(fastest, FAST), state, "turn it more slowly, or film at 60 per second"))
    step = keyframes.largest_step(found.turned, kept)
    state = f"{len(kept)} to keep, at most {math.degrees(step):.0f} degrees apart"
    slower = "turn more slowly where the preview shows no green edge for long"
    advice = slower if len(kept) == len(found.numbers) else f"keep more of them with --frames; or {slower}"
    return [*findings, _finding("frames", "warn" if step > WIDE_STEP else "good", state, advice)]


def _sharpness(found: Survey, kept: list[int], options: FootageOptions) -> Finding:
    window = video_to_capture.crop_window(found, kept)
    shrink = min(options.size / max(window[2:]), 1.0)
    width = float(np.median(found.blurs[kept]))
    blur = math.sqrt(max(width**2 - keyframes.PROBE_BLUR**2, 0.0)) * shrink if math.isfinite(width) else math.inf
    state = f"edges are blurred by {blur:.1f} pixels at the size of the written frames"
    return _finding("sharpness", _graded(blur, BLURRED), state, "more light, a shorter exposure, focus on the object")


def _light(found: Survey) -> list[Finding]:
    stops = float(np.ptp(np.log2(found.gains[:, 1])))
    tint = float(np.ptp(found.gains / found.gains[:, 1:2], axis=0).max())
    advice = "lock exposure and white balance; what drifted is taken out, what was clipped is lost"
    verdict = _graded(stops, DRIFTED)
    verdict = "warn" if verdict == "good" and tint > TINTED else verdict
    drifted = _finding("exposure", verdict, f"drifts by {stops:.2f} stops, colours by {100 * tint:.0f} %", advice)
    pixels = found.pictures[found.inside]
    burnt = float((pixels.min(-1) >= 250).mean()) if len(pixels) else 0.0
    state = f"{100 * burnt:.1f} % of the object is saturated"
    advice = "expose for the object's brightest side: what is saturated has no colour"
    return [drifted, _finding("highlights", "warn" if burnt > BURNT else "good", state, advice)]


# Pictures with poses --------------------------------------------------------------------------------------------------


def _check_posed(found: colmap_to_capture.Posed, out: Path, options: FootageOptions) -> list[Finding]:
    """What a COLMAP model, its pictures and their masks are good for."""
    R_new_cam = colmap_to_capture.turns(found, options.light)
    glass, fine = colmap_to_capture.camera(found, R_new_cam, options.size)
    shown = colmap_to_capture.frames(found, R_new_cam, glass, fine, options)
    video.write_clip(
        out / video_to_capture.PREVIEW,
        (video_to_capture.tinted(p, m, video_to_capture.KEPT) for p, m in shown),
        quality=24,
    )
    n = len(found.seen)
    words = {"object": "the camera went round it", "camera": "it turned, its background masked"}
    state = f"stands still with the {options.light}: {words[options.light]}; --light says otherwise"
    findings = [_model(found), Finding("light", "good", state)]
    share = len(found.empty) / (n + len(found.empty))
    state, advice = f"{100 * share:.0f} % of the pictures do not show the object", "mend the masks that are empty"
    findings.append(_finding("masks", _graded(share, UNCERTAIN), state, advice))
    state = f"the middles of the masks meet within {100 * found.apart:.0f} % of a mask's radius"
    advice = "masks and poses contradict each other, or the object did not stand still in the model"
    findings.append(_finding("agreement", _graded(found.apart, APART), state, advice))
    share = sum(outline.cut for outline in found.seen) / n
    state = f"the object touches the border of the picture on {100 * share:.0f} % of the pictures"
    advice = "keep the whole object in the picture, with room around"
    findings.append(_finding("framing", _graded(share, CLIPPED), state, advice))
    diameter = float(np.median([outline.diameter for outline in found.seen]))
    state = f"the object is {diameter:.0f} pixels across"
    findings.append(_finding("size", _graded(diameter, SMALL), state, "go nearer, or take larger pictures"))
    places = colmap_to_capture.trajectory(found, R_new_cam, options.light).camera_positions.double().numpy()
    places = places / np.linalg.norm(places, axis=1, keepdims=True)
    widest = math.acos(float((places @ places.T).clip(-1, 1).min()))
    state = f"seen from {n} places, up to {math.degrees(widest):.0f} degrees apart"
    findings.append(_finding("views", _graded(widest, ROUND), state, "take pictures from all sides, from above, too"))
    return findings


def _model(found: colmap_to_capture.Posed) -> Finding:
    state = f"{len(found.model.views)} pictures with a pose, {len(found.model.points)} points"
    if not len(found.model.errors):
        return Finding("model", "good", state)
    error = float(found.model.errors.mean())
    advice = "sharper pictures, more texture around the object, or fewer wrong matches"
    return _finding("model", _graded(error, MISSED), f"{state}, off by {error:.2f} pixels on average", advice)
