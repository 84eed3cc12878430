"""From a film or a capture to an asset: the stages in order, kept in a run directory or only handed back."""

import math
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch

from tumble import matching, recipes
from tumble.datasets import which
from tumble.engine import Progress, Stage, run
from tumble.inverse_rendering import decompose, refine
from tumble.io import BadFile, files, tree
from tumble.poses import PoseResult, neighbours
from tumble.poses.progressive import stage as progressive
from tumble.poses.sfm import stage as sfm
from tumble.preprocess import FOOTAGE, PROVENANCE, FootageOptions, input_kind, origin, to_capture
from tumble.recipes import DRAFT, Recipe
from tumble.scene import Asset, Capture, Trajectory, content_key

LEAST_TRACKED = 8
"""Frames with a pose under which a capture shows too little of the object."""
IN_MEMORY = Path("capture")
"""What messages call a capture that was not read from disk."""


def read_capture(path: Path | str) -> Capture:
    """Read the training frames of a capture: a folder of docs/format.md, or another layout that `datasets` knows.

    Raises:
        BadFile: There is no capture, or it breaks a rule. A film has to become one first: `video_to_capture`.
    """
    path = Path(path)
    if input_kind(path) in FOOTAGE:
        raise BadFile(path, "is footage and no capture yet", "tumble.video_to_capture makes one of it")
    return which(path).load(path)


def video_to_capture(path: Path | str, out: Path | str, options: FootageOptions | None = None) -> Path:
    """Make a capture folder of a film, a folder of pictures, or one with a COLMAP model; returns `out`.

    Raises:
        BadFile: The footage cannot become a capture, or `out` is there already; nothing is written then.
    """
    return to_capture(Path(path), Path(out), options or FootageOptions())


def ingested(path: Path, out: Path, options: FootageOptions) -> Path:
    """The capture that a run reconstructs: `path` itself, or what footage became, in the run directory `out`.

    Raises:
        BadFile: The footage cannot become a capture, or `out` holds that of other footage or of other options.
    """
    if input_kind(path) not in FOOTAGE:
        return path
    made = out / run.CAPTURE
    with run.alone(out):
        if not made.exists():
            return to_capture(path, made, options)
    note = made / PROVENANCE
    found, wanted = files.read_json(note) if note.exists() else {}, origin(path, options)
    different = [line for name in wanted for line in run.differences(found.get(name), wanted[name], name)]
    if different:
        rule = f"holds the capture of another film, or one made in another way: {'; '.join(different)}"
        raise BadFile(out, rule, "choose another folder with -o, or remove this one")
    return made


def estimate_poses(
    capture: Capture, recipe: Recipe = DRAFT, *, progress: Callable[[Progress], None] | None = None
) -> PoseResult:
    """Find how the object moved, from the frames and masks alone (stage 1); poses that the capture has are not read.

    Args:
        recipe: Its `matcher`, `track` and `seed` count.
        progress: Called every few seconds.

    Raises:
        BadFile: The capture has too few frames, or cannot be tracked.
    """
    capture = replace(capture, trajectory=None)
    return _track(run.Run(None, recipe, progress), capture, IN_MEMORY, content_key(capture))[0]


def reconstruct(
    capture: Capture | Path | str,
    out: Path | str | None = None,
    recipe: Recipe = DRAFT,
    *,
    poses: Literal["given", "estimate"] | Trajectory | PoseResult = "given",
    device: torch.device | str = "cpu",
    progress: Callable[[Progress], None] | None = None,
) -> Asset:
    """Reconstruct an object: its motion, geometry, albedo and roughness, and the light. Truth is never read.

    Frames whose pose is lost are left out of all that follows stage 1.

    Args:
        capture: Read before, or where it is; footage has to become one first (`video_to_capture`).
        out: A run directory, where every finished stage is kept, a stopped one goes on from its checkpoint, and
            `asset.safetensors`, `light.exr` and `poses.json` are written. None keeps nothing.
        recipe: All settings. Another stage is a module with a `Config` of its own in the place of ours.
        poses: given: those of the capture, which stay as they are, or estimated where it has none. estimate: found from
            the frames all the same. A trajectory, one pose per frame: taken as given. What `estimate_poses` found:
            taken, and realigned in stage 2.
        device: Of stages 2 and 3.
        progress: Called every few seconds.

    Returns:
        The asset, on the CPU.

    Raises:
        BadFile: The capture breaks a rule or cannot be tracked, or `out` holds another run.
        NotFinite: Training met a NaN; names the tensor, the step and the state that is kept.
    """
    where = IN_MEMORY if isinstance(capture, Capture) else Path(capture)
    capture = capture if isinstance(capture, Capture) else read_capture(capture)
    if poses == "estimate" or isinstance(poses, PoseResult):
        capture = replace(capture, trajectory=None)
    elif isinstance(poses, Trajectory):
        capture = replace(capture, trajectory=poses)
    found = poses if isinstance(poses, PoseResult) else None
    if out is None:
        return _reconstruct(run.Run(None, recipe, progress), capture, where, found, device)[0]
    out = Path(out)
    with run.alone(out):
        opened = run.open(out, where, recipe, content=content_key(capture), report=progress)
        asset, names = _reconstruct(opened, capture, where, found, device)
        _keep(asset, names, out)
    return asset


def _reconstruct(
    opened: run.Run, capture: Capture, where: Path, found: PoseResult | None, device: torch.device | str
) -> tuple[Asset, tuple[str, ...]]:
    """The asset, on the CPU, and the names of its frames."""
    recipe, trajectory, key = opened.recipe, capture.trajectory, content_key(capture)
    if trajectory is None:
        tracked, key = (found, "") if found else _track(opened, capture, where, key)
        kept = torch.where(~tracked.quality.lost)[0].tolist()
        trajectory = tracked.trajectory.select(kept)
        capture = replace(capture.select(kept), camera=tracked.camera)
        key = key or content_key(replace(capture, trajectory=trajectory))
    else:
        recipe = recipes.known_poses(recipe)
    capture, trajectory = tree.to(capture, device), tree.to(trajectory, device)
    refined, key = run.stage(
        opened, run.REFINE, stage_of(recipe.refine), recipe.refine, refine.Inputs(capture, trajectory), [key]
    )
    inputs = decompose.Inputs(capture, refined)
    asset, _ = run.stage(opened, run.DECOMPOSE, stage_of(recipe.decompose), recipe.decompose, inputs, [key])
    return tree.to(asset, "cpu"), capture.names


def stage_of(cfg: Any) -> Any:
    """The stage that a configuration belongs to: the module that defines its class."""
    stage = sys.modules[type(cfg).__module__]
    if not isinstance(stage, Stage):
        raise TypeError(f"{stage.__name__} is no stage: it needs VERSION, Config, length, init, step and finish")
    return stage


def _track(opened: run.Run, capture: Capture, where: Path, content: str) -> tuple[PoseResult, str]:
    """Stage 1: match, then find all poses; also the key of the result."""
    if len(capture) < LEAST_TRACKED:
        rule = f"has {len(capture)} frames: too few to find how the object moved"
        raise BadFile(where, rule, f"film more of it: at least {LEAST_TRACKED} frames, better 40 to 100")
    recipe = opened.recipe
    cache = opened.path / run.TRACK / "matches" if opened.path else None
    near = neighbours(len(capture))
    matches = matching.match_pairs(matching.views_of(capture), near, recipe.matcher, cache=cache)
    route = stage_of(recipe.track)
    try:
        inputs: Any = sfm.gather(capture, matches, recipe.matcher)
        if route is progressive:
            inputs = progressive.gather(capture, matches, partial(sfm.assess, inputs))
    except ValueError as error:
        raise BadFile(where, str(error), "give masks that show the object") from None
    keys = [content, matching.settings(recipe.matcher)]
    tracked, key = run.stage(opened, run.TRACK, route, recipe.track, inputs, keys)
    _told(opened, capture, where, tracked)
    return tracked, key


def _told(opened: run.Run, capture: Capture, where: Path, tracked: PoseResult) -> None:
    """Log how good the poses are, warn where they are bad, and refuse to go on with too few."""
    quality, lost = tracked.quality, int(tracked.quality.lost.sum())
    about = {"lost": lost, "verdict": quality.verdict, "axis": quality.observability.sentence}
    run.log(opened, {"name": "track", "event": "quality", **about, "degrees": math.degrees(quality.uncertainty)})
    focal, guess = (float(camera.fx_fy_cx_cy[0]) for camera in (tracked.camera, capture.camera))
    if focal != guess:
        said = f"focal length {focal:.0f} pixels (estimated; the guess was {guess:.0f})"
        run.log(opened, {"name": "track", "event": "focal", "pixels": focal, "guess": guess, "said": said})
    if len(capture) - lost < LEAST_TRACKED:
        rule = f"could not be tracked: {lost} of {len(capture)} frames contradict the others"
        raise BadFile(where, rule, "film an object with more texture or shape, in smaller turns")
    if quality.verdict == "bad":
        warnings.warn(quality.sentence, stacklevel=2)


def _keep(asset: Asset, names: tuple[str, ...], out: Path) -> None:
    tree.save(asset, out / run.ASSET)
    asset.environment.write(out / run.LIGHT)
    poses = dict(zip(names, asset.trajectory.camera_to_object().tolist(), strict=True))
    files.write_json(out / run.POSES, poses)
