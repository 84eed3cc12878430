"""Scenes of the BOP benchmark, one object of each; their millimetres become metres.

    DATASET/SPLIT/000001/scene_camera.json        {"0": {"cam_K": [9], "cam_R_w2c": [9], "cam_t_w2c": [3]}, ...}
                         scene_gt.json            {"0": [{"obj_id", "cam_R_m2c": [9], "cam_t_m2c": [3]}, ...], ...}
                         rgb/000000.png (.jpg)    or gray/
                         mask_visib/000000_000000.png    frame and annotation: what is visible of the object
                         mask/000000_000000.png          optional: all of it, also what something hides

What is hidden is unknown, not background. A frame without the object is left out. The light stands still with the
camera, unless `cam_R_w2c` and `cam_t_w2c` say that the camera moves: then the object is taken to rest in the room.
Camera frames have OpenCV axes, and the centre of their first pixel is (0, 0). Symmetries are not looked at.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8

from tumble.datasets import _pictures
from tumble.datasets.folder import RIGID_TOLERANCE
from tumble.io import BadFile, files
from tumble.maths import SE3
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Camera, Capture, Light, Trajectory, Truth, no_views

CAMERAS, ANNOTATION = "scene_camera.json", "scene_gt.json"
LAYOUT = f"SCENE/{CAMERAS}, SCENE/{ANNOTATION}, SCENE/rgb/000000.png and SCENE/mask_visib/000000_000000.png of BOP"
SAME_CAMERA = 0.01
"""Largest difference of two matrices of one camera: what printed digits leave [pixels]."""
STILL = 1e-3
"""A camera has not moved whose matrix changes by less, in metres and parts of a radian."""


def recognises(path: Path) -> bool:
    """Whether a path is a scene of BOP."""
    return (path / CAMERAS).is_file()


def load(path: Path | str, *, object_id: int | None = None) -> Capture:
    """The frames of a scene that show the object, without poses; the annotation only says which mask is whose.

    Args:
        object_id: `obj_id` of the object; needed when the scene has several.

    Raises:
        BadFile: A file is missing or broken, or it is not clear which object is meant.
    """
    root = Path(path)
    cameras = _numbered(root / CAMERAS, dict)
    places = {frame: place for frame, (place, _) in _annotated(root, object_id).items()}
    masks = ((frame, _mask(root, frame, place)) for frame, place in places.items())
    masked = ((_picture(root, frame), mask) for frame, mask in masks if (mask == OBJECT).any())
    return _pictures.capture(root, masked, _camera(root, cameras, list(places)), _light(root, cameras))


def load_truth(path: Path | str, *, object_id: int | None = None) -> Truth | None:
    """The poses of the object in a scene, BOP model frame, in metres.

    Args:
        object_id: As for `load`.

    Raises:
        BadFile: A file is missing or broken, or it is not clear which object is meant.
    """
    root = Path(path)
    cameras, annotated = _numbered(root / CAMERAS, dict), _annotated(root, object_id)
    matrices = [_rigid(root / ANNOTATION, frame, found, "m2c") for frame, (_, found) in annotated.items()]
    T_cam_obj = SE3.from_matrix(torch.from_numpy(np.stack(matrices)).float())
    return replace(
        no_views(_camera(root, cameras, list(annotated))),
        poses=Trajectory(T_cam_obj, _light(root, cameras)),
        pose_names=tuple(_picture(root, frame).name for frame in annotated),
        units="m",
    )


def _numbered(path: Path, kind: type) -> dict[int, Any]:
    """A JSON object whose keys are frame numbers, in their order."""
    document = files.read_json(path)
    good = isinstance(document, dict) and document and all(key.isdecimal() for key in document)
    if not good or not all(isinstance(value, kind) for value in document.values()):
        raise BadFile(path, "is not an object with one entry per frame number")
    return {int(key): document[key] for key in sorted(document, key=int)}


def _annotated(root: Path, object_id: int | None) -> dict[int, tuple[int, dict[str, Any]]]:
    """Place and content of the object's annotation, in each frame that has one."""
    path = root / ANNOTATION
    annotation = _numbered(path, list)
    if not all(isinstance(found, dict) and "obj_id" in found for frame in annotation.values() for found in frame):
        raise BadFile(path, 'has an annotation without "obj_id"')
    known = sorted({found["obj_id"] for frame in annotation.values() for found in frame})
    if object_id is None and len(known) != 1:
        raise BadFile(path, f"has the objects {known}", "say which: load(path, object_id=...), or keep one of them")
    wanted = known[0] if object_id is None else object_id
    chosen = {}
    for frame, found in annotation.items():
        places = [place for place, one in enumerate(found) if one["obj_id"] == wanted]
        if len(places) > 1:
            raise BadFile(path, f"frame {frame} has the object {wanted} {len(places)} times", "one may be told apart")
        if places:
            chosen[frame] = (places[0], found[places[0]])
    if not chosen:
        raise BadFile(path, f"has no object {wanted}, it has {known}")
    return chosen


def _picture(root: Path, frame: int) -> Path:
    paths = [root / folder / f"{frame:06}{ending}" for folder in ("rgb", "gray") for ending in (".png", ".jpg", ".tif")]
    return next((path for path in paths if path.exists()), paths[0])


def _mask(root: Path, frame: int, place: int) -> UInt8[np.ndarray, "h w"]:
    name = f"{frame:06}_{place:06}.png"
    visible = files.read_image(root / "mask_visib" / name)[..., 0] > 0
    whole = root / "mask" / name
    hidden = files.read_image(whole)[..., 0] > 0 if whole.exists() else visible
    if hidden.shape != visible.shape:
        raise BadFile(whole, "is not of the size of the one in mask_visib/")
    return np.select([visible, hidden], [OBJECT, UNKNOWN], BACKGROUND).astype(np.uint8)


# Cameras --------------------------------------------------------------------------------------------------------------


def _numbers(path: Path, frame: int, entry: dict[str, Any], name: str, count: int) -> np.ndarray:
    try:
        values = np.array(entry[name], np.float64)
    except (KeyError, TypeError, ValueError):
        values = np.zeros(0)
    if values.size != count or not np.isfinite(values).all():
        raise BadFile(path, f'frame {frame}: "{name}" is not {count} finite numbers')
    return values.ravel()


def _rigid(path: Path, frame: int, entry: dict[str, Any], which: str) -> Float[np.ndarray, "4 4"]:
    """A matrix of the files, in metres."""
    matrix = np.eye(4)
    matrix[:3, :3] = R = _numbers(path, frame, entry, f"cam_R_{which}", 9).reshape(3, 3)
    matrix[:3, 3] = 1e-3 * _numbers(path, frame, entry, f"cam_t_{which}", 3)
    if np.abs(R.T @ R - np.eye(3)).max() > RIGID_TOLERANCE or np.linalg.det(R) < 0:
        raise BadFile(path, f'frame {frame}: "cam_R_{which}" is not a rotation')
    return matrix


def _camera(root: Path, cameras: dict[int, dict[str, Any]], frames: list[int]) -> Camera:
    path = root / CAMERAS
    if missing := [frame for frame in frames if frame not in cameras]:
        raise BadFile(path, f"has no frame {missing[0]}, {ANNOTATION} has")
    matrices = [_numbers(path, frame, cameras[frame], "cam_K", 9).reshape(3, 3) for frame in frames]
    if any(np.abs(K - matrices[0]).max() > SAME_CAMERA for K in matrices):
        raise BadFile(path, 'frames differ in "cam_K"', "one camera took all frames of a capture")
    return _pictures.camera(matrices[0], _picture(root, frames[0]))


def _light(root: Path, cameras: dict[int, dict[str, Any]]) -> Light:
    if not all("cam_R_w2c" in entry for entry in cameras.values()):
        return "camera"
    places = [_rigid(root / CAMERAS, frame, entry, "w2c") for frame, entry in cameras.items()]
    return "object" if max(np.abs(place - places[0]).max() for place in places) > STILL else "camera"
