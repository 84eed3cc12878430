"""From pictures with masks and a sparse model of COLMAP to a capture folder with poses.

Every picture is seen again through one pinhole camera: lenses are undone, and where the light stands with the object,
the camera is turned to look at the object's centre, which is exact, for it stays where it is. (A camera that the light
stands with must not turn from frame to frame: all pictures get one turn.) The object's unit is fixed from its
silhouettes: the smallest ball that reaches all rays through them. +y is up on the mean picture.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float64, UInt8

from tumble.datasets import capture_document, training_frame
from tumble.io import BadFile, files
from tumble.maths import SE3, smallest_ball
from tumble.preprocess import colmap, video_to_capture
from tumble.preprocess.colmap import PosedPicture, SparseModel
from tumble.preprocess.footage import mask_of, read_mask
from tumble.preprocess.options import LEAST_FRAMES, FootageOptions
from tumble.preprocess.survey import small_mask
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Camera, Trajectory, mask_from_alpha, undistortion

ROOM = 1.02
"""Radius of the unit ball over what the silhouettes reach."""
PART = 0.05
"""A piece of a mask this small against the largest is a speck, and no part of the silhouette."""
SEARCH = 2000
"""Steps of the search for the ball; the last ones move it by a thousandth of its radius."""
LEVEL = 0.3
"""Length of the mean upward direction under which the cameras have none in common."""


@dataclass(frozen=True)
class Silhouette:
    """One picture with a pose, and the outline of the object in it."""

    view: PosedPicture
    picture: Path
    mask: Path | None
    """None where the picture's alpha is the mask."""
    rays: Float64[np.ndarray, "m 2"]
    """Around the object's convex hull, on the plane at depth 1 before the camera."""
    diameter: float
    """Of a disk of the mask's area [pixels]."""
    cut: bool
    """Whether the object touches the border of the picture."""


@dataclass(frozen=True)
class Posed:
    """Pictures with poses, before they are written."""

    model: SparseModel
    root: Path
    """Folder of the pictures."""
    seen: tuple[Silhouette, ...]
    empty: tuple[str, ...]
    """Pictures whose mask is."""
    centre: Float64[np.ndarray, "3"]
    """Of the object, in the model's frame and unit."""
    radius: float
    """[the model's unit]"""
    apart: float
    """Median distance of the rays through the masks' middles from their meeting point [radius of the median mask]."""


def capture_from_model(path: Path, out: Path, options: FootageOptions) -> Path:
    """A capture folder (docs/format.md) with poses; returns it.

    Raises:
        BadFile: Model, pictures or masks break a rule, or `out` is there already; nothing is written then.
    """
    video_to_capture.refuse_full(out)
    found = gather(path, options)
    if len(found.seen) < LEAST_FRAMES:
        raise BadFile(path, f"shows the object on {len(found.seen)} pictures", "see `tumble check` for what is wrong")
    return video_to_capture.write_folder(out, lambda partial: _write(found, path, partial, options))


def gather(path: Path, options: FootageOptions) -> Posed:
    """The pictures that are used, evenly over the model's, with their outlines and the ball around the object.

    Raises:
        BadFile: Model, pictures or masks break a rule, or the masks do not look at one object.
    """
    if lens := [n for n in ("focal", "fov", "fisheye", "distortion") if getattr(options, n) is not None]:
        raise BadFile(path, f"has a COLMAP model, which knows the lens: --{lens[0]} contradicts it", "leave it out")
    model = colmap.read(path)
    root = path / "images" if (path / "images").is_dir() else path
    spread = np.linspace(0, len(model.views) - 1, min(options.frames, len(model.views))).round().astype(int)
    outlines = [_silhouette(path, root, model.views[i], options) for i in spread]
    seen = tuple(outline for outline in outlines if len(outline.rays))
    empty = tuple(outline.view.name for outline in outlines if not len(outline.rays))
    if not seen:
        raise BadFile(path, "has masks, and all are empty", "white is the object; --invert-masks if it is black")
    centre, radius, apart = ball(seen)
    for outline in seen:
        depth = outline.view.R_cam_world[2] @ centre + outline.view.t_cam_world[2]
        if depth <= 1.05 * radius:
            rule = "the mask does not show what the other masks show"
            raise BadFile(outline.mask or outline.picture, rule, "poses and masks must be those of these pictures")
    return Posed(model, root, seen, empty, centre, radius, apart)


def ball(seen: tuple[Silhouette, ...]) -> tuple[Float64[np.ndarray, "3"], float, float]:
    """Centre and radius of the smallest ball that reaches all rays, in the model's unit; and `Posed.apart`.

    A point of the surface that is the farthest is on the outline of the views across it, so over many views this is the
    ball around the object, up to `ROOM`.
    """
    starts = [-outline.view.R_cam_world.T @ outline.view.t_cam_world for outline in seen]
    rays = [_unit(np.c_[o.rays, np.ones(len(o.rays))]) @ o.view.R_cam_world for o in seen]
    middles = _unit(np.stack([direction.mean(0) for direction in rays]))
    across = np.eye(3) - middles[:, :, None] * middles[:, None]
    # Parallel rays meet nowhere: the least-squares answer stays finite.
    centre = np.linalg.lstsq(across.sum(0), (across @ np.stack(starts)[..., None]).sum(0)[:, 0], rcond=None)[0]
    apart = np.median(np.linalg.norm(_to_ray(centre, np.stack(starts), middles), axis=1))
    far = np.linalg.norm(np.stack(starts) - centre, axis=1)
    wide = [np.linalg.norm(r - middle, axis=1).max() for r, middle in zip(rays, middles, strict=True)]
    start = np.repeat(np.stack(starts), [len(r) for r in rays], 0)
    direction = np.concatenate(rays)

    def offsets(x: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(_to_ray(x.numpy(), start, direction))

    found = smallest_ball(offsets, torch.from_numpy(centre), steps=SEARCH)
    radius = float(offsets(found).norm(dim=-1).max())
    return found.numpy(), ROOM * radius, float(apart / np.median(far * wide))


def _to_ray(x: np.ndarray, start: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """From a point to its feet on lines."""
    off = start - x
    return off - (off * direction).sum(1, keepdims=True) * direction


def _unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


# Pictures -------------------------------------------------------------------------------------------------------------


def _silhouette(path: Path, root: Path, view: PosedPicture, options: FootageOptions) -> Silhouette:
    picture = files.inside(root, view.name)
    folder = options.masks or (path / "masks" if (path / "masks").is_dir() else None)
    mask = None if folder is None else mask_of(picture, folder / Path(view.name).parent)
    labels = _seen(picture, mask, view, options)[1]
    count, pieces, boxes, _ = cv2.connectedComponentsWithStats((labels == OBJECT).astype(np.uint8))
    areas = boxes[1:, cv2.CC_STAT_AREA]
    if count < 2:
        return Silhouette(view, picture, mask, np.zeros((0, 2)), 0.0, False)
    inside = np.isin(pieces, 1 + np.nonzero(areas >= PART * areas.max())[0])
    rows, columns = np.nonzero(inside)
    hull = cv2.convexHull(np.stack([columns, rows], -1).astype(np.int32))[:, 0].astype(np.float64)
    cut = bool(inside[[0, -1]].any() or inside[:, [0, -1]].any())
    diameter = 2 * math.sqrt(len(rows) / math.pi)
    return Silhouette(view, picture, mask, view.optics.normalised(hull), diameter, cut)


def _seen(
    picture: Path, mask: Path | None, view: PosedPicture, options: FootageOptions
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    """A picture as it was taken, and its mask."""
    values = files.read_image(picture)
    if values.shape[:2] != (view.optics.height, view.optics.width):
        found = f"is {values.shape[1]} x {values.shape[0]} pixels"
        fix = "give the pictures that COLMAP saw"
        raise BadFile(picture, f"{found}, its model says {view.optics.width} x {view.optics.height}", fix)
    colour = np.repeat(values, 3, 2) if values.shape[2] == 1 else np.ascontiguousarray(values[..., :3])
    if mask is not None:
        return colour, read_mask(mask, values, options.invert_masks)
    if values.shape[2] != 4:
        fix = "masks/NAME.png beside images/, white object; the camera moves, so masks cannot be found by motion"
        raise BadFile(picture, "has no mask", fix)
    alpha = np.ascontiguousarray(values[..., 3])
    return colour, mask_from_alpha(255 - alpha if options.invert_masks else alpha)


# The one camera -------------------------------------------------------------------------------------------------------


def turns(found: Posed, light: str) -> Float64[np.ndarray, "t 3 3"]:
    """`R_new_cam` of every picture, which makes the camera look at the object."""
    views = [outline.view for outline in found.seen]
    forward = _unit(np.stack([view.R_cam_world @ found.centre + view.t_cam_world for view in views]))
    if light == "camera":
        forward = np.broadcast_to(_unit(forward.mean(0)), forward.shape)
    right = _unit(np.cross([0.0, 1.0, 0.0], forward))
    return np.stack([right, np.cross(forward, right), forward], 1)


def camera(found: Posed, R_new_cam: Float64[np.ndarray, "t 3 3"], size: int) -> tuple[Camera, int]:
    """The camera that holds all silhouettes, and how many pixels of the pictures go into one of its, along a side."""
    corners = [np.c_[o.rays, np.ones(len(o.rays))] @ R.T for o, R in zip(found.seen, R_new_cam, strict=True)]
    plane = np.concatenate([x[:, :2] / x[:, 2:] for x in corners])
    low, high = plane.min(0), plane.max(0)
    low, high = low - video_to_capture.MARGIN * (high - low).max(), high + video_to_capture.MARGIN * (high - low).max()
    native = float(np.median([outline.view.optics.K[0, 0] for outline in found.seen]))
    focal = min(size / float((high - low).max()), native)
    width, height = (max(math.ceil(focal * side - 1e-6), 8) for side in high - low)
    cx, cy = -focal * low
    return Camera(torch.tensor([focal, focal, cx, cy]).float(), height, width), max(1, round(native / focal))


def frames(
    found: Posed, R_new_cam: Float64[np.ndarray, "t 3 3"], glass: Camera, fine: int, options: FootageOptions
) -> Iterator[tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]]:
    """Pictures and masks through the new camera; what it sees beyond a picture's border is unknown."""
    large = glass.resized(fine * glass.height, fine * glass.width)
    for outline, R in zip(found.seen, R_new_cam, strict=True):
        optics = outline.view.optics
        colour, labels = _seen(outline.picture, outline.mask, outline.view, options)
        undistorted = undistortion(optics.K, optics.distortion, large, fisheye=optics.fisheye, R_new_cam=R)
        colour = undistorted(colour, cv2.INTER_LINEAR, cv2.BORDER_REPLICATE)
        labels = undistorted(labels, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT, UNKNOWN)
        picture = video_to_capture.developed(colour, np.ones(3), (glass.height, glass.width))
        mask = small_mask(np.ascontiguousarray(labels), glass.height, glass.width)
        yield np.where(mask[..., None] == BACKGROUND, np.uint8(0), picture), mask


def trajectory(found: Posed, R_new_cam: Float64[np.ndarray, "t 3 3"], light: str) -> Trajectory:
    """Poses in the object's unit: its centre at the origin, its radius 1."""
    R = np.stack([outline.view.R_cam_world for outline in found.seen])
    t = np.stack([outline.view.t_cam_world for outline in found.seen])
    x_cam = R @ found.centre + t
    R_world_obj = _upright(R, -(R.mT @ x_cam[..., None])[..., 0]).T
    matrices = np.tile(np.eye(4), (len(R), 1, 1))
    matrices[:, :3, :3] = R_new_cam @ R @ R_world_obj
    matrices[:, :3, 3] = (R_new_cam @ x_cam[..., None])[..., 0] / found.radius
    T_cam_obj = SE3.from_matrix(torch.from_numpy(matrices))
    return Trajectory(SE3(T_cam_obj.wxyz.float(), T_cam_obj.xyz.float()), "camera" if light == "camera" else "object")


def _upright(R_cam_world: np.ndarray, places: np.ndarray) -> Float64[np.ndarray, "3 3"]:
    """`R_obj_world`: +y up in the mean picture, and the first camera over the +z side.

    Args:
        R_cam_world: All cameras.
        places: Of the cameras, from the object's centre.
    """
    up = -R_cam_world[:, 1].mean(0)
    if np.linalg.norm(up) < LEVEL:
        return np.eye(3)
    y = _unit(up)
    side = places[0] - (places[0] @ y) * y
    if np.linalg.norm(side) < 1e-3 * np.linalg.norm(places[0]):
        side = np.cross(y, np.eye(3)[np.abs(y).argmin()])
    z = _unit(side)
    return np.stack([np.cross(y, z), y, z])


def _write(found: Posed, path: Path, out: Path, options: FootageOptions) -> None:
    R_new_cam = turns(found, options.light)
    glass, fine = camera(found, R_new_cam, options.size)
    matrices = trajectory(found, R_new_cam, options.light).camera_to_object().tolist()
    entries: list[dict[str, Any]] = []
    for i, (picture, mask) in enumerate(frames(found, R_new_cam, glass, fine, options)):
        name = f"{i:04d}.png"
        files.write_png(out / "images" / name, picture)
        files.write_png(out / "masks" / name, mask[..., None])
        entries.append(training_frame(name, matrices[i]))
    provenance = {
        "source": str(path),
        **video_to_capture.origin(path, options),
        "model": str(found.model.path),
        "centre": found.centre.tolist(),
        "radius": found.radius,
        "without_object": found.empty,
        "frames": [
            {"name": entry["file_path"], "source": o.view.name} for entry, o in zip(entries, found.seen, strict=True)
        ],
    }
    files.write_json(out / video_to_capture.PROVENANCE, provenance)
    document = capture_document(glass, options.light, entries, setting=None, with_light=False)
    files.write_json(out / "transforms.json", document | {"focal_source": "model"})
