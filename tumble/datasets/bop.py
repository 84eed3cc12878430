"""Reader of scenes of the BOP benchmark: one object of a scene; millimetres are converted to metres.

    DATASET/SPLIT/000001/scene_camera.json        {"0": {"cam_K": [9], "cam_R_w2c": [9], "cam_t_w2c": [3]}, ...}
                         scene_gt.json            {"0": [{"obj_id", "cam_R_m2c": [9], "cam_t_m2c": [3]}, ...], ...}
                         rgb/000000.png (.jpg)    or gray/
                         mask_visib/000000_000000.png    frame and annotation: visible part of the object
                         mask/000000_000000.png          optional: the whole object, including occluded parts

Occluded parts are labelled unknown, not background. Frames without the object are omitted. The light is fixed to the
camera, unless `cam_R_w2c` and `cam_t_w2c` show that the camera moves: then the object is assumed to rest in the room.
Camera frames have OpenCV axes, and the centre of the first pixel is (0, 0). Symmetries of objects are ignored.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8

from tumble.datasets import _images
from tumble.datasets.folder import RIGID_TOLERANCE
from tumble.io import BadFile, files
from tumble.maths import SE3
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Camera, Capture, Light, Trajectory, Truth, truth_without_views

CAMERAS = "scene_camera.json"
"""File of the cameras."""
ANNOTATION = "scene_gt.json"
"""File of the object poses."""
LAYOUT = f"SCENE/{CAMERAS}, SCENE/{ANNOTATION}, SCENE/rgb/000000.png and SCENE/mask_visib/000000_000000.png of BOP"
MAX_INTRINSICS_DIFFERENCE = 0.01
"""Maximum difference of the entries of two camera matrices that count as equal: rounding of printed digits [pixels]."""
MAX_STATIC_MOTION = 1e-3
"""Maximum change of the entries of the camera pose of a static camera [metres, or no unit for rotations]."""


def recognises(path: Path) -> bool:
    """Whether a path is a scene of BOP."""
    return (path / CAMERAS).is_file()


def load(path: Path | str, *, object_id: int | None = None) -> Capture:
    """The frames of a scene that show the object, without poses; the annotation is used only to select the masks.

    Args:
        object_id: `obj_id` of the object; required if the scene has several objects.

    Raises:
        BadFile: A file is missing or broken, or the scene has several objects and `object_id` is None.
    """
    root = Path(path)
    cameras = _read_per_frame(root / CAMERAS, dict)
    indices = {frame: index for frame, (index, _) in _object_annotations(root, object_id).items()}
    masks = ((frame, _mask(root, frame, index)) for frame, index in indices.items())
    masked = ((_image_path(root, frame), mask) for frame, mask in masks if (mask == OBJECT).any())
    return _images.build_capture(root, masked, _camera(root, cameras, list(indices)), _light(root, cameras))


def load_truth(path: Path | str, *, object_id: int | None = None) -> Truth | None:
    """Annotated poses of the object, in the BOP model frame [metres].

    Args:
        object_id: As for `load`.

    Raises:
        BadFile: As for `load`.
    """
    root = Path(path)
    cameras, annotated = _read_per_frame(root / CAMERAS, dict), _object_annotations(root, object_id)
    matrices = [_rigid_matrix(root / ANNOTATION, frame, entry, "m2c") for frame, (_, entry) in annotated.items()]
    T_cam_obj = SE3.from_matrix(torch.from_numpy(np.stack(matrices)).float())
    return replace(
        truth_without_views(_camera(root, cameras, list(annotated))),
        poses=Trajectory(T_cam_obj, _light(root, cameras)),
        pose_names=tuple(_image_path(root, frame).name for frame in annotated),
        units="m",
    )


def _read_per_frame(path: Path, kind: type) -> dict[int, Any]:
    """A JSON object whose keys are frame numbers, sorted by them."""
    document = files.read_json(path)
    valid = isinstance(document, dict) and document and all(key.isdecimal() for key in document)
    if not valid or not all(isinstance(value, kind) for value in document.values()):
        raise BadFile(path, "is not a JSON object with one entry per frame number")
    return {int(key): document[key] for key in sorted(document, key=int)}


def _object_annotations(root: Path, object_id: int | None) -> dict[int, tuple[int, dict[str, Any]]]:
    """Index and content of the object's annotation, per frame that has one."""
    path = root / ANNOTATION
    annotation = _read_per_frame(path, list)
    if not all(isinstance(entry, dict) and "obj_id" in entry for frame in annotation.values() for entry in frame):
        raise BadFile(path, 'has an annotation without "obj_id"')
    known = sorted({entry["obj_id"] for frame in annotation.values() for entry in frame})
    if object_id is None and len(known) != 1:
        raise BadFile(path, f"has the objects {known}", "select one: load(path, object_id=...)")
    wanted = known[0] if object_id is None else object_id
    selected = {}
    for frame, entries in annotation.items():
        indices = [index for index, entry in enumerate(entries) if entry["obj_id"] == wanted]
        if len(indices) > 1:
            raise BadFile(path, f"frame {frame} has the object {wanted} {len(indices)} times", "it must be there once")
        if indices:
            selected[frame] = (indices[0], entries[indices[0]])
    if not selected:
        raise BadFile(path, f"has no object {wanted}, but {known}")
    return selected


def _image_path(root: Path, frame: int) -> Path:
    paths = [root / folder / f"{frame:06}{ending}" for folder in ("rgb", "gray") for ending in (".png", ".jpg", ".tif")]
    return next((path for path in paths if path.exists()), paths[0])


def _mask(root: Path, frame: int, index: int) -> UInt8[np.ndarray, "h w"]:
    name = f"{frame:06}_{index:06}.png"
    visible = files.read_image(root / "mask_visib" / name)[..., 0] > 0
    whole = root / "mask" / name
    amodal = files.read_image(whole)[..., 0] > 0 if whole.exists() else visible
    if amodal.shape != visible.shape:
        raise BadFile(whole, "differs in size from the mask in mask_visib/")
    return np.select([visible, amodal], [OBJECT, UNKNOWN], BACKGROUND).astype(np.uint8)


# Cameras --------------------------------------------------------------------------------------------------------------


def _numbers(path: Path, frame: int, entry: dict[str, Any], name: str, count: int) -> np.ndarray:
    try:
        values = np.array(entry[name], np.float64)
    except (KeyError, TypeError, ValueError):
        values = np.zeros(0)
    if values.size != count or not np.isfinite(values).all():
        raise BadFile(path, f'frame {frame}: "{name}" is not {count} finite numbers')
    return values.ravel()


def _rigid_matrix(path: Path, frame: int, entry: dict[str, Any], transform: str) -> Float[np.ndarray, "4 4"]:
    """A pose of the files as a homogeneous matrix, in metres; `transform` is m2c or w2c."""
    matrix = np.eye(4)
    matrix[:3, :3] = R = _numbers(path, frame, entry, f"cam_R_{transform}", 9).reshape(3, 3)
    matrix[:3, 3] = 1e-3 * _numbers(path, frame, entry, f"cam_t_{transform}", 3)
    if np.abs(R.T @ R - np.eye(3)).max() > RIGID_TOLERANCE or np.linalg.det(R) < 0:
        raise BadFile(path, f'frame {frame}: "cam_R_{transform}" is not a rotation')
    return matrix


def _camera(root: Path, cameras: dict[int, dict[str, Any]], frames: list[int]) -> Camera:
    path = root / CAMERAS
    if missing := [frame for frame in frames if frame not in cameras]:
        raise BadFile(path, f"has no frame {missing[0]}, but {ANNOTATION} has")
    matrices = [_numbers(path, frame, cameras[frame], "cam_K", 9).reshape(3, 3) for frame in frames]
    if any(np.abs(K - matrices[0]).max() > MAX_INTRINSICS_DIFFERENCE for K in matrices):
        raise BadFile(path, 'frames differ in "cam_K"', "all frames of a capture must be from one camera")
    return _images.opencv_camera(matrices[0], _image_path(root, frames[0]))


def _light(root: Path, cameras: dict[int, dict[str, Any]]) -> Light:
    if not all("cam_R_w2c" in entry for entry in cameras.values()):
        return "camera"
    matrices = [_rigid_matrix(root / CAMERAS, frame, entry, "w2c") for frame, entry in cameras.items()]
    return "object" if max(np.abs(matrix - matrices[0]).max() for matrix in matrices) > MAX_STATIC_MOTION else "camera"
