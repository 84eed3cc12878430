"""Conversion of images with masks and a sparse COLMAP model to a capture folder with poses.

Every image is resampled to one common pinhole camera: lens distortion is removed, and the camera is rotated about its
centre of projection to look at the object's centre. If the light is fixed to the camera, the lighting would rotate with
it, so all images get the same rotation. The unit of length is set by the silhouettes: the smallest sphere that reaches
all rays through their contours has radius 1. +y is up in the mean image.
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

from tumble.datasets import bounding_sphere, capture_document, training_frame
from tumble.io import BadFile, files
from tumble.maths import SE3
from tumble.preprocess import colmap, video_to_capture
from tumble.preprocess.colmap import PosedImage, SparseModel
from tumble.preprocess.footage import PROVENANCE, find_mask, read_mask
from tumble.preprocess.options import MIN_FRAMES, FootageOptions
from tumble.preprocess.survey import downsample_mask
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Camera, Trajectory, mask_from_alpha, undistortion

MAX_SLOPE = 100.0
"""Maximum distance of an undistorted ray from the optical axis, on the plane at depth 1: 89.4 degrees."""
MIN_PART_FRACTION = 0.05
"""Minimum area of a component of a mask, as a fraction of the largest one; a smaller one is noise."""
MIN_UP_LENGTH = 0.3
"""Minimum length of the mean of the cameras' up directions (unit vectors); below it there is no common one."""


@dataclass(frozen=True)
class Silhouette:
    """One posed image, and the silhouette of the object in it."""

    view: PosedImage
    image: Path
    """Image file."""
    mask: Path | None
    """Mask file; None if the image's alpha channel is the mask."""
    rays: Float64[np.ndarray, "m 2"]
    """Vertices of the convex hull of the silhouette, on the plane at depth 1 in front of the camera."""
    diameter: float
    """Diameter of a disc of the mask's area [pixels]."""
    cropped: bool
    """Whether the object touches the border of the image."""


@dataclass(frozen=True)
class PosedImages:
    """The images used, with poses and silhouettes, and the sphere around the object."""

    model: SparseModel
    root: Path
    """Folder of the images."""
    silhouettes: tuple[Silhouette, ...]
    empty: tuple[str, ...]
    """Names of images with an empty mask, which are not used."""
    centre: Float64[np.ndarray, "3"]
    """Centre of the object, in the model's frame and unit."""
    radius: float
    """Radius of the object [unit of the model]."""
    ray_distance: float
    """Median distance of the rays through the mask centres from their common point [radius of the median mask]."""


def capture_from_model(path: Path, out: Path, options: FootageOptions) -> Path:
    """Convert images with a COLMAP model to a capture folder (docs/format.md) with poses; returns the folder.

    Raises:
        BadFile: Model, images or masks break a rule, or `out` is not empty; nothing is written then.
    """
    video_to_capture.require_new_folder(out)
    posed = collect_silhouettes(path, options)
    if len(posed.silhouettes) < MIN_FRAMES:
        raise BadFile(
            path, f"shows the object on {len(posed.silhouettes)} images only", "run `tumble check` to find out why"
        )
    return video_to_capture.write_folder(out, lambda partial: _write(posed, path, partial, options))


def collect_silhouettes(path: Path, options: FootageOptions) -> PosedImages:
    """Silhouettes of at most `options.frames` images, evenly spaced in the model, and the sphere around the object.

    Raises:
        BadFile: Model, images or masks break a rule, or the masks do not show one object.
    """
    if lens := [n for n in ("focal", "fov", "fisheye", "distortion") if getattr(options, n) is not None]:
        raise BadFile(
            path, f"has a COLMAP model, which contains the lens: --{lens[0]} contradicts it", "leave that option out"
        )
    if options.marks:
        rule = f"has a COLMAP model, whose images have masks: {options.marks[0]} does not change them"
        raise BadFile(path, rule, "leave that option out")
    if options.part:
        raise BadFile(path, "has a COLMAP model, whose images are all used", "leave out --part")
    model = colmap.read(path)
    root = path / "images" if (path / "images").is_dir() else path
    spread = np.linspace(0, len(model.views) - 1, min(options.frames, len(model.views))).round().astype(int)
    candidates = [_silhouette(path, root, model.views[i], options) for i in spread]
    silhouettes = tuple(silhouette for silhouette in candidates if len(silhouette.rays))
    empty = tuple(silhouette.view.name for silhouette in candidates if not len(silhouette.rays))
    if not silhouettes:
        raise BadFile(path, "has only empty masks", "the object must be white; use --invert-masks if it is black")
    centre, radius, ray_distance = _bounding_sphere(silhouettes)
    for silhouette in silhouettes:
        depth = silhouette.view.R_cam_world[2] @ centre + silhouette.view.t_cam_world[2]
        if depth <= 1.05 * radius:
            rule = "the mask is inconsistent with the other masks"
            raise BadFile(silhouette.mask or silhouette.image, rule, "poses and masks must belong to these images")
    return PosedImages(model, root, silhouettes, empty, centre, radius, ray_distance)


def _bounding_sphere(silhouettes: tuple[Silhouette, ...]) -> tuple[Float64[np.ndarray, "3"], float, float]:
    """Centre and radius of the sphere around the object [unit of the model], and its `ray_distance`."""
    starts = [-s.view.R_cam_world.T @ s.view.t_cam_world for s in silhouettes]
    rays = [_unit(np.c_[s.rays, np.ones(len(s.rays))]) @ s.view.R_cam_world for s in silhouettes]
    return bounding_sphere(starts, rays)


def _unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


# Images ---------------------------------------------------------------------------------------------------------------


def _silhouette(path: Path, root: Path, view: PosedImage, options: FootageOptions) -> Silhouette:
    image = files.path_inside(root, view.name)
    folder = options.masks or (path / "masks" if (path / "masks").is_dir() else None)
    mask = None if folder is None else find_mask(image, folder / Path(view.name).parent)
    labels = _read_image_and_mask(image, mask, view, options)[1]
    count, ids, boxes, _ = cv2.connectedComponentsWithStats((labels == OBJECT).astype(np.uint8))
    areas = boxes[1:, cv2.CC_STAT_AREA]
    if count < 2:
        return Silhouette(view, image, mask, np.zeros((0, 2)), 0.0, False)
    inside = np.isin(ids, 1 + np.nonzero(areas >= MIN_PART_FRACTION * areas.max())[0])
    rows, columns = np.nonzero(inside)
    hull = cv2.convexHull(np.stack([columns, rows], -1).astype(np.int32))[:, 0].astype(np.float64)
    cropped = bool(inside[[0, -1]].any() or inside[:, [0, -1]].any())
    diameter = 2 * math.sqrt(len(rows) / math.pi)
    rays = view.optics.normalised(hull)
    if not (np.isfinite(rays).all() and np.abs(rays).max() <= MAX_SLOPE):
        raise BadFile(image, "has a lens whose distortion cannot be inverted", "calibrate it again, or crop the images")
    return Silhouette(view, image, mask, rays, diameter, cropped)


def _read_image_and_mask(
    image: Path, mask: Path | None, view: PosedImage, options: FootageOptions
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    """An image as it was recorded, and its mask."""
    values = files.read_image(image)
    if values.shape[:2] != (view.optics.height, view.optics.width):
        size = f"has {values.shape[1]} x {values.shape[0]} pixels"
        fix = "give the images that COLMAP processed, at their size"
        raise BadFile(image, f"{size}, but in the COLMAP model {view.optics.width} x {view.optics.height}", fix)
    colour = np.repeat(values, 3, 2) if values.shape[2] == 1 else np.ascontiguousarray(values[..., :3])
    if mask is not None:
        return colour, read_mask(mask, values, options.invert_masks)
    if values.shape[2] != 4:
        fix = "add masks/NAME.png beside images/, with a white object; the camera moves, so motion cannot segment it"
        raise BadFile(image, "has no mask", fix)
    alpha = np.ascontiguousarray(values[..., 3])
    return colour, mask_from_alpha(255 - alpha if options.invert_masks else alpha)


# Common camera --------------------------------------------------------------------------------------------------------


def camera_rotations(posed: PosedImages, light: str) -> Float64[np.ndarray, "t 3 3"]:
    """Rotation `R_new_cam` per image that makes the camera look at the object.

    If the light is fixed to the camera, all images get the same rotation.
    """
    views = [silhouette.view for silhouette in posed.silhouettes]
    forward = _unit(np.stack([view.R_cam_world @ posed.centre + view.t_cam_world for view in views]))
    if light == "camera":
        forward = np.broadcast_to(_unit(forward.mean(0)), forward.shape)
    right = _unit(np.cross([0.0, 1.0, 0.0], forward))
    return np.stack([right, np.cross(forward, right), forward], 1)


def common_camera(posed: PosedImages, R_new_cam: Float64[np.ndarray, "t 3 3"], size: int) -> tuple[Camera, int]:
    """The camera whose image contains all silhouettes, and the oversampling factor for resampling to it.

    The factor is the number of original pixels per pixel of this camera, along a side.
    """
    rays = [np.c_[s.rays, np.ones(len(s.rays))] @ R.T for s, R in zip(posed.silhouettes, R_new_cam, strict=True)]
    plane = np.concatenate([x[:, :2] / x[:, 2:] for x in rays])
    low, high = plane.min(0), plane.max(0)
    low, high = low - video_to_capture.MARGIN * (high - low).max(), high + video_to_capture.MARGIN * (high - low).max()
    native = float(np.median([silhouette.view.optics.K[0, 0] for silhouette in posed.silhouettes]))
    focal = min(size / float((high - low).max()), native)
    width, height = (max(math.ceil(focal * side - 1e-6), 8) for side in high - low)
    cx, cy = -focal * low
    return Camera(torch.tensor([focal, focal, cx, cy]).float(), height, width), max(1, round(native / focal))


def resampled_frames(
    posed: PosedImages,
    R_new_cam: Float64[np.ndarray, "t 3 3"],
    camera: Camera,
    oversampling: int,
    options: FootageOptions,
) -> Iterator[tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]]:
    """Images and masks as seen by the common camera; pixels beyond the border of an image are unknown."""
    large = camera.resized(oversampling * camera.height, oversampling * camera.width)
    for silhouette, R in zip(posed.silhouettes, R_new_cam, strict=True):
        optics = silhouette.view.optics
        colour, labels = _read_image_and_mask(silhouette.image, silhouette.mask, silhouette.view, options)
        remap = undistortion(optics.K, optics.distortion, large, fisheye=optics.fisheye, R_new_cam=R)
        colour = remap(colour, cv2.INTER_LINEAR, cv2.BORDER_REPLICATE)
        labels = remap(labels, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT, UNKNOWN)
        image = video_to_capture.resample(colour, np.ones(3), (camera.height, camera.width))
        mask = downsample_mask(np.ascontiguousarray(labels), camera.height, camera.width)
        yield np.where(mask[..., None] == BACKGROUND, np.uint8(0), image), mask


def trajectory(posed: PosedImages, R_new_cam: Float64[np.ndarray, "t 3 3"], light: str) -> Trajectory:
    """Poses in the object frame: the centre is the origin, the radius 1."""
    R = np.stack([silhouette.view.R_cam_world for silhouette in posed.silhouettes])
    t = np.stack([silhouette.view.t_cam_world for silhouette in posed.silhouettes])
    x_cam = R @ posed.centre + t
    R_world_obj = _upright(R, -(R.mT @ x_cam[..., None])[..., 0]).T
    matrices = np.tile(np.eye(4), (len(R), 1, 1))
    matrices[:, :3, :3] = R_new_cam @ R @ R_world_obj
    matrices[:, :3, 3] = (R_new_cam @ x_cam[..., None])[..., 0] / posed.radius
    T_cam_obj = SE3.from_matrix(torch.from_numpy(matrices))
    return Trajectory(SE3(T_cam_obj.wxyz.float(), T_cam_obj.xyz.float()), "camera" if light == "camera" else "object")


def _upright(R_cam_world: np.ndarray, positions: np.ndarray) -> Float64[np.ndarray, "3 3"]:
    """Rotation `R_obj_world` with +y up in the mean image and the first camera in the half plane of +z.

    Args:
        R_cam_world: Rotations of all cameras.
        positions: Camera positions relative to the object's centre.
    """
    up = -R_cam_world[:, 1].mean(0)
    if np.linalg.norm(up) < MIN_UP_LENGTH:
        return np.eye(3)
    y = _unit(up)
    side = positions[0] - (positions[0] @ y) * y
    if np.linalg.norm(side) < 1e-3 * np.linalg.norm(positions[0]):
        side = np.cross(y, np.eye(3)[np.abs(y).argmin()])
    z = _unit(side)
    return np.stack([np.cross(y, z), y, z])


def _write(posed: PosedImages, path: Path, out: Path, options: FootageOptions) -> None:
    R_new_cam = camera_rotations(posed, options.light)
    camera, oversampling = common_camera(posed, R_new_cam, options.size)
    matrices = trajectory(posed, R_new_cam, options.light).camera_to_object().tolist()
    entries: list[dict[str, Any]] = []
    for i, (image, mask) in enumerate(resampled_frames(posed, R_new_cam, camera, oversampling, options)):
        name = f"{i:04d}.png"
        files.write_png(out / "images" / name, image)
        files.write_png(out / "masks" / name, mask[..., None])
        entries.append(training_frame(name, matrices[i]))
    provenance = {
        "source": str(path),
        **video_to_capture.footage_fingerprint(path, options),
        "model": str(posed.model.path),
        "centre": posed.centre.tolist(),
        "radius": posed.radius,
        "without_object": posed.empty,
        "frames": [
            {"name": entry["file_path"], "source": s.view.name}
            for entry, s in zip(entries, posed.silhouettes, strict=True)
        ],
    }
    files.write_json(out / PROVENANCE, provenance)
    document = capture_document(camera, options.light, entries, setting=None, with_light=False)
    files.write_json(out / "transforms.json", document | {"focal_source": "model"})
