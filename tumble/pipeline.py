"""From a video or a capture to an asset: all stages in order, saved in a run directory or only returned."""

import math
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import UInt8
from torch import Tensor

from tumble import matching, recipes
from tumble.datasets import check_plausible, reader_for
from tumble.engine import Progress, Stage, run
from tumble.evaluation import PREDICTION
from tumble.inverse_rendering import absolute_colour, albedo_solve, decompose, refine
from tumble.io import BadFile, files, outputs, progress, tree
from tumble.poses import PoseResult, background_removal, mask_refinement, neighbours, working_size
from tumble.poses.progressive import stage as progressive
from tumble.poses.sfm import stage as sfm
from tumble.preprocess import (
    FOOTAGE,
    PROVENANCE,
    FootageOptions,
    footage_fingerprint,
    input_kind,
    read_provenance,
    to_capture,
)
from tumble.recipes import DRAFT, Recipe
from tumble.scene import BACKGROUND, Asset, Capture, Trajectory, content_key, opengl_from_opencv, visual_hull

MIN_FRAMES = 8
"""Minimum number of frames with a pose; fewer show too little of the object."""
IN_MEMORY = Path("capture")
"""Name, in error messages, of a capture that was not read from disk."""
MADE_OF_ASSET = {run.EXPORT: "export", run.RELIT: "relight", PREDICTION: "evaluate"}
"""Folders of a run that another command makes of its asset, with that command."""
ROTATIONS_TO_UP = {
    "x": ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "-x": ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "y": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "-y": ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    "z": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
    "-z": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
}
"""Rotations of the object frame, row by row, that take each axis to +y."""


class _WhitePixel(NamedTuple):
    """A pixel that the user calls white or grey."""

    column: int
    row: int
    name: str
    """File name of its frame."""
    shown: UInt8[Tensor, "3"]
    """Its sRGB code values, also beside the object, where stages 2 and 3 see black."""


def read_capture(path: Path | str) -> Capture:
    """Read the training frames of a capture folder, in any layout of `datasets` (docs/format.md).

    Raises:
        BadFile: There is no capture, or it breaks a rule of its layout, or it is a video: see `video_to_capture`.
    """
    path = Path(path)
    if input_kind(path) in FOOTAGE:
        raise BadFile(path, "is footage, not a capture", "convert it with tumble.video_to_capture")
    return reader_for(path).load(path)


def video_to_capture(path: Path | str, out: Path | str, options: FootageOptions | None = None) -> Path:
    """Convert footage to a capture folder; returns `out`.

    Args:
        path: A video, a folder of images with masks, or such a folder with a COLMAP model.
        out: The capture folder to create.

    Raises:
        BadFile: The footage cannot be converted, or `out` exists; nothing is written then.
    """
    return to_capture(Path(path), Path(out), options or FootageOptions())


def capture_of(path: Path, out: Path, options: FootageOptions) -> Path:
    """Path of the capture to reconstruct: `path` itself, or the capture in `out` to which footage is converted.

    Args:
        path: A capture or footage.
        out: The run directory; a capture converted earlier from the same footage is reused.

    Raises:
        BadFile: The footage cannot be converted, or `out` lies in it or holds a capture of other footage or other
            options.
    """
    outputs.require_outside(out, path)
    if input_kind(path) not in FOOTAGE:
        return path
    made = out / run.CAPTURE
    with run.exclusive_access(out):
        if not made.exists():
            with progress.task(f"converting {path.name} to a capture"):
                return to_capture(path, made, options)
    found, wanted = read_provenance(made), footage_fingerprint(path, options)
    stored = {name: getattr(found, name, None) for name in wanted}
    # The hash tells whether the masks are the same; their folder may be written otherwise, or be moved.
    stored["options"] = (stored["options"] or {}) | {"masks": wanted["options"]["masks"]}
    different = [line for name in wanted for line in run.differences(stored[name], wanted[name], name)]
    if different:
        rule = f"holds a capture of other footage or made with other options: {'; '.join(different)}"
        raise BadFile(out, rule, "choose another folder with -o, or remove this one")
    return made


def estimate_poses(
    capture: Capture,
    recipe: Recipe = DRAFT,
    *,
    device: torch.device | str = "cpu",
    progress: Callable[[Progress], None] | None = None,
) -> PoseResult:
    """Estimate the object's pose in every frame from images and masks (stage 1); the capture's own poses are ignored.

    Args:
        recipe: Only `matcher`, `track` and `seed` are used.
        device: Where a matcher's network runs.
        progress: Called every few seconds.

    Raises:
        BadFile: The capture has too few frames, or too few of them could be tracked.
    """
    capture = replace(capture, trajectory=None)
    check_plausible(capture, IN_MEMORY)
    return _poses_of(run.Run(None, recipe, progress), capture, IN_MEMORY, content_key(capture), device)[0]


def reconstruct(
    capture: Capture | Path | str,
    out: Path | str | None = None,
    recipe: Recipe = DRAFT,
    *,
    poses: Literal["given", "estimate"] | Trajectory | PoseResult = "given",
    up: str = "auto",
    white: tuple[int, int, str] | None = None,
    device: torch.device | str = "cpu",
    progress: Callable[[Progress], None] | None = None,
) -> Asset:
    """Reconstruct an object's motion, geometry, albedo and roughness, and the light. Ground truth is never read.

    Frames whose pose could not be estimated are dropped after stage 1.

    Args:
        capture: A capture or the path of one; convert footage with `video_to_capture` first.
        out: Run directory: finished stages are saved in it, an interrupted stage resumes from its checkpoint, and
            `asset.safetensors`, `light.exr` and `poses.json` are written. None saves nothing.
        recipe: Settings of all stages. A custom stage is a module whose `Config` replaces the default one.
        poses: "given": the capture's poses, unchanged; estimated if it has none. "estimate": always estimated. A
            trajectory with one pose per frame: used unchanged. A `PoseResult`: the starting poses of stage 2, which
            refines them.
        up: Up direction of the object, which becomes +y of the asset's frame. "auto": that of the poses, which for
            estimated ones is up in the first frame. Or one of `ROTATIONS_TO_UP`, an axis of the frame of "auto"; or
            the name of a frame in which the object is upright. No stage depends on it.
        white: Column and row of a pixel and the name of its frame, which shows a neutral white or grey, on the object
            or on a card beside it that faces the camera. It determines the colour of the light. No stage depends on it.
        device: Where stages 2 and 3 and the network of a matcher run.
        progress: Called every few seconds.

    Returns:
        The asset, on the CPU.

    Raises:
        BadFile: The capture breaks a rule or cannot be tracked, or `out` holds another run.
        ValueError: There is no such direction, frame or pixel, or the capture's own poses define its frame.
        NotFinite: A NaN occurred in training; the message names the tensor, the step and the saved state.
    """
    where = IN_MEMORY if isinstance(capture, Capture) else Path(capture)
    capture = capture if isinstance(capture, Capture) else read_capture(capture)
    if poses == "estimate" or isinstance(poses, PoseResult):
        capture = replace(capture, trajectory=None)
    elif isinstance(poses, Trajectory):
        capture = replace(capture, trajectory=poses)
    check_plausible(capture, where)
    found = poses if isinstance(poses, PoseResult) else None
    _check_up(up, capture, where)
    grey = _white_pixel(white, capture)
    if out is None:
        opened = run.Run(None, recipe, progress)
        return _upright(*_reconstruct(opened, capture, where, found, grey, device), up)
    out = Path(out)
    with run.exclusive_access(out):
        content = content_key(capture)
        frames = content if capture.trajectory is None else content_key(replace(capture, trajectory=None))
        opened = run.open(out, where, recipe, content=content, frames=frames, report=progress)
        asset, names = _reconstruct(opened, capture, where, found, grey, device)
        asset = _upright(asset, names, up)
        _keep(asset, names, out)
    return asset


def _reconstruct(
    opened: run.Run,
    capture: Capture,
    where: Path,
    found: PoseResult | None,
    white: _WhitePixel | None,
    device: torch.device | str,
) -> tuple[Asset, tuple[str, ...]]:
    """The asset on the CPU, and the names of its frames."""
    recipe, trajectory, key = opened.recipe, capture.trajectory, content_key(capture)
    tracked = None
    if trajectory is None:
        tracked, capture, key = (found, capture, "") if found else _poses_of(opened, capture, where, key, device)
        kept = torch.where(~tracked.quality.lost)[0].tolist()
        trajectory = tracked.trajectory.select(kept)
        capture = replace(capture.select(kept), camera=tracked.camera)
        key = key or content_key(replace(capture, trajectory=trajectory))
    else:
        recipe = recipes.known_poses(recipe)
    capture, trajectory = tree.to(capture, device), tree.to(trajectory, device)
    stage_2, inputs = stage_of(recipe.refine), refine.Inputs(capture, trajectory)
    try:
        refined, key = run.stage(opened, run.REFINE, stage_2, recipe.refine, inputs, [key])
    except visual_hull.EmptyHull as error:
        if tracked is None:
            raise
        rule = "could not be reconstructed: no shape has these silhouettes at the estimated poses"
        fix = f"see whether the masks show the object. {tracked.quality.sentence}"
        raise BadFile(where, rule, fix) from error
    inputs = decompose.Inputs(capture, refined)
    asset, _ = run.stage(opened, run.DECOMPOSE, stage_of(recipe.decompose), recipe.decompose, inputs, [key])
    asset = _in_absolute_colour(opened, asset, inputs.capture, white)
    if isinstance(recipe.decompose, decompose.Config) and recipe.decompose.solve_albedo:
        with progress.task("solving the albedo"):
            asset = albedo_solve.solved(asset, inputs.capture)
    return tree.to(asset, "cpu"), capture.names


def _in_absolute_colour(opened: run.Run, asset: Asset, capture: Capture, white: _WhitePixel | None) -> Asset:
    """The asset with the most likely division of each colour channel between albedo and light; logs the estimate.

    Raises:
        ValueError: The pose of the frame of the pixel `white` was not found.
    """
    target = None
    if white is not None:
        if white.name not in capture.names:
            raise ValueError(f"the pose of frame {white.name} was not found; choose another frame for --white")
        frame = capture.names.index(white.name)
        target = absolute_colour.known_white(asset, capture, frame, white.column, white.row, white.shown)
    pixels = absolute_colour.shaded_pixels(asset, capture)
    metalness = 0.0 if asset.material.metalness is None else float(asset.material.metalness.mean())
    found = absolute_colour.estimate(pixels, float(asset.material.f0), target, metalness=metalness)
    values = {"factor": found.log_factor.exp().tolist(), "deviation": found.deviation.tolist()}
    run.log(opened, {"name": "decompose", "event": "colour", **values, "white": white is not None})
    return absolute_colour.apply(asset, found.log_factor)


def stage_of(cfg: Any) -> Any:
    """The stage module in which the class of a configuration is defined."""
    stage = sys.modules[type(cfg).__module__]
    if not isinstance(stage, Stage):
        raise TypeError(f"{stage.__name__} is not a stage: it needs VERSION, Config, length, init, step and finish")
    return stage


def _poses_of(
    opened: run.Run, whole: Capture, where: Path, content: str, device: torch.device | str
) -> tuple[PoseResult, Capture, str]:
    """Stage 1, repeated with trimmed masks while that explains more: poses, capture with the final masks, and its key.

    The key is empty if stage 1 has not seen that capture: images of its size, and its final masks.
    """
    if len(whole) < MIN_FRAMES:
        rule = f"has {len(whole)} frames, too few to estimate the motion"
        raise BadFile(where, rule, f"record at least {MIN_FRAMES} frames, better 40 to 100")
    if stage_of(opened.recipe.track) is progressive and torch.device(device).type != "cpu":
        warnings.warn("the progressive route of stage 1 runs on the CPU: only later stages use the GPU", stacklevel=2)
    small = capture = working_size.reduced(whole)
    content = content if small is whole else content_key(small)
    tracked, key = _track(opened, capture, where, content, 1, device)
    for number in range(2, mask_refinement.ROUNDS + 1):
        trimmed = mask_refinement.trimmed_further(capture, tracked)
        if trimmed is None:
            break
        new, new_key = _track(opened, trimmed, where, content_key(trimmed), number, device)
        if not mask_refinement.explains_more(new, tracked):
            break
        tracked, capture, key = new, trimmed, new_key
    found = working_size.enlarged(tracked, whole, small)
    _check_quality(opened, whole, where, found)
    cut = background_removal.remove_background(capture, tracked)
    seen = small is whole and torch.equal(cut.masks, capture.masks)
    return found, working_size.with_masks(whole, small, cut), key if seen else ""


def _track(
    opened: run.Run, capture: Capture, where: Path, content: str, number: int, device: torch.device | str
) -> tuple[PoseResult, str]:
    """One round of stage 1: match frames, then estimate all poses; also returns the key of the result."""
    recipe = opened.recipe
    cache = opened.path / run.TRACK / "matches" if opened.path else None
    near = neighbours(len(capture))
    hidden = sfm.is_hidden(capture.masks)
    views = matching.views_of(sfm.shown(capture) if hidden else capture)
    matches = matching.match_pairs(views, near, recipe.matcher, device=device, cache=cache)
    route = stage_of(recipe.track)
    try:
        with progress.task("observations in all frames"):
            inputs: Any = sfm.gather(capture, matches, hidden=hidden)
            if route is progressive:
                if capture.focal_assumed:
                    text = "the focal length is a guess, which the progressive route does not refine"
                    warnings.warn(f"{text}: give --focal or --fov", stacklevel=2)
                assess = partial(sfm.assess, inputs)
                inputs = progressive.gather(capture, inputs.matches, assess, inputs.failed)
    except ValueError as error:
        raise BadFile(where, str(error), "provide masks that show the object") from None
    keys = [content, matching.settings(recipe.matcher)]
    if route is progressive:
        # Stage `sfm` assesses the poses of both routes.
        keys.append(run.key("assess", sfm, sfm.Config(), []))
    return run.stage(opened, mask_refinement.folder(number), route, recipe.track, inputs, keys)


def _check_quality(opened: run.Run, capture: Capture, where: Path, tracked: PoseResult) -> None:
    """Log the quality of the poses, warn if it is bad.

    Raises:
        BadFile: Too few frames have a pose.
    """
    quality, lost = tracked.quality, int(tracked.quality.lost.sum())
    about = {"lost": lost, "verdict": quality.rating, "axis": quality.observability.sentence}
    run.log(opened, {"name": "track", "event": "quality", **about, "degrees": math.degrees(quality.uncertainty)})
    focal, assumed = (float(camera.fx_fy_cx_cy[0]) for camera in (tracked.camera, capture.camera))
    if focal != assumed:
        said = f"focal length {focal:.0f} pixels (estimated; {assumed:.0f} was assumed)"
        run.log(opened, {"name": "track", "event": "focal", "pixels": focal, "guess": assumed, "said": said})
    if len(capture) - lost < MIN_FRAMES:
        rule = f"could not be tracked: {lost} of {len(capture)} frames are inconsistent with the others"
        raise BadFile(where, rule, "record an object with more texture or shape, and turn it more slowly")
    if quality.rating == "bad":
        warnings.warn(quality.sentence, stacklevel=2)


def _check_up(up: str, capture: Capture, where: Path) -> None:
    """Raise `ValueError` unless `up` is a direction or a frame, and the frame of the capture may be changed.

    The poses of a capture with ground truth share its frame; those of estimated poses and of COLMAP have their own.
    """
    if up == "auto":
        return
    if up not in ROTATIONS_TO_UP and up not in capture.names:
        choices = ", ".join(["auto", *ROTATIONS_TO_UP])
        raise ValueError(f"--up {up} is neither a direction nor a frame; choose {choices}, or a frame's file name")
    if capture.trajectory is not None and not (where / PROVENANCE).is_file():
        raise ValueError("--up is for estimated poses: the poses of this capture define its frame, in which +y is up")


def _white_pixel(white: tuple[int, int, str] | None, capture: Capture) -> _WhitePixel | None:
    """The pixel with what it shows; raise `ValueError` unless it exists and is neither dark nor saturated."""
    if white is None:
        return None
    column, row, name = white
    if name not in capture.names:
        shown = f"{capture.names[0]} to {capture.names[-1]}"
        raise ValueError(f"--white {column} {row} {name}: there is no such frame; choose one of {shown}")
    height, width = capture.masks.shape[1:]
    if not (0 <= column < width and 0 <= row < height):
        raise ValueError(f"--white {column} {row} is outside of the images of {width} x {height} pixels")
    frame, photos = capture.names.index(name), capture.images if capture.full_images is None else capture.full_images
    if capture.full_images is None and capture.masks[frame, row, column] == BACKGROUND:
        rule = "is background, which these images leave black"
        raise ValueError(f"the pixel of --white {column} {row} {rule}; choose one on the object")
    return _WhitePixel(column, row, name, absolute_colour.code_values(photos[frame], column, row))


def _upright(asset: Asset, names: tuple[str, ...], up: str) -> Asset:
    """The asset with the direction `up` rotated to +y; for a frame, to up in its image.

    Raises:
        ValueError: The frame has no pose.
    """
    if up == "auto":
        return asset
    if up in ROTATIONS_TO_UP:
        return asset.rotated(torch.tensor(ROTATIONS_TO_UP[up]))
    if up not in names:
        raise ValueError(f"the pose of frame {up} was not found; choose another frame for --up")
    T_cam_obj = asset.trajectory.T_cam_obj[names.index(up)]
    return asset.rotated(opengl_from_opencv(T_cam_obj.xyz) @ T_cam_obj.rotation.matrix())


def _keep(asset: Asset, names: tuple[str, ...], out: Path) -> None:
    """Write the asset, its light and its poses; warn of files that other commands made of another asset."""
    kept = [out / run.LIGHT, out / run.POSES]
    before = [path.read_bytes() if path.is_file() else b"" for path in kept]
    tree.save(asset, out / run.ASSET)
    asset.environment.write(out / run.LIGHT)
    poses = dict(zip(names, asset.trajectory.camera_to_object().tolist(), strict=True))
    files.write_json(out / run.POSES, poses)
    if before == [path.read_bytes() for path in kept]:
        return
    for name, command in MADE_OF_ASSET.items():
        if (out / name).exists():
            warnings.warn(f"{out / name} shows the object before this run; repeat tumble {command}", stacklevel=2)
