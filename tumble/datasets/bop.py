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
from typing import Annotated, Any

import msgspec
import numpy as np
import torch
from jaxtyping import Float, UInt8

from tumble.datasets import _images
from tumble.datasets._lens import FrameLens, common_lens
from tumble.datasets.folder import RIGID_TOLERANCE
from tumble.io import BadFile, files
from tumble.maths import SE3
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Capture, Light, Trajectory, Truth, truth_without_views

CAMERAS = "scene_camera.json"
"""File of the cameras."""
ANNOTATION = "scene_gt.json"
"""File of the object poses."""
LAYOUT = f"SCENE/{CAMERAS}, SCENE/{ANNOTATION}, SCENE/rgb/000000.png and SCENE/mask_visib/000000_000000.png of BOP"
MAX_INTRINSICS_DIFFERENCE = 0.01
"""Maximum difference of the entries of two camera matrices that count as equal: rounding of printed digits [pixels]."""
MAX_DISTANCE = 1e6
"""Maximum entry of a pose: a translation of a thousand kilometres is a mistake [metres]."""
MAX_STATIC_MOTION = 1e-3
"""Maximum change of the entries of the camera pose of a static camera [metres, or no unit for rotations]."""


Frame = Annotated[int, msgspec.Meta(ge=0)]
Nine = Annotated[tuple[float, ...], msgspec.Meta(min_length=9, max_length=9)]
Three = tuple[float, float, float]


class _CameraRecord(msgspec.Struct, frozen=True):
    """Entry of scene_camera.json."""

    cam_K: Nine
    cam_R_w2c: Nine | None = None
    cam_t_w2c: Three = (0.0, 0.0, 0.0)


class _ObjectRecord(msgspec.Struct, frozen=True):
    """Entry of scene_gt.json."""

    obj_id: int
    cam_R_m2c: Nine
    cam_t_m2c: Three


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
    cameras = _read_per_frame(root / CAMERAS, _CameraRecord)
    indices = {frame: index for frame, (index, _) in _object_annotations(root, object_id).items()}
    masks = ((frame, _mask(root, frame, index)) for frame, index in indices.items())
    masked = ((_image_path(root, frame), mask) for frame, mask in masks if (mask == OBJECT).any())
    return _images.build_capture(root, masked, _lenses(root, cameras, list(indices)), _light(root, cameras))


def load_truth(path: Path | str, *, object_id: int | None = None) -> Truth | None:
    """Annotated poses of the object, in the BOP model frame [metres].

    Args:
        object_id: As for `load`.

    Raises:
        BadFile: As for `load`.
    """
    root = Path(path)
    cameras, annotated = _read_per_frame(root / CAMERAS, _CameraRecord), _object_annotations(root, object_id)
    matrices = [
        _rigid_matrix(root / ANNOTATION, frame, entry.cam_R_m2c, entry.cam_t_m2c)
        for frame, (_, entry) in annotated.items()
    ]
    T_cam_obj = SE3.from_matrix(torch.from_numpy(np.stack(matrices)).float())
    lenses = _lenses(root, cameras, list(annotated))
    return replace(
        truth_without_views(common_lens(root / CAMERAS, list(lenses.values())).camera),
        poses=Trajectory(T_cam_obj, _light(root, cameras)),
        pose_names=tuple(_image_path(root, frame).name for frame in annotated),
        units="m",
    )


def _read_per_frame(path: Path, kind: Any) -> dict[int, Any]:
    """A JSON object whose keys are frame numbers, sorted by them."""
    document = files.read_json(path, dict[Frame, kind])
    if not document:
        raise BadFile(path, "has no frame")
    return dict(sorted(document.items()))


def _object_annotations(root: Path, object_id: int | None) -> dict[int, tuple[int, _ObjectRecord]]:
    """Index and content of the object's annotation, per frame that has one."""
    path = root / ANNOTATION
    annotation = _read_per_frame(path, list[_ObjectRecord])
    known = sorted({entry.obj_id for frame in annotation.values() for entry in frame})
    if object_id is None and len(known) != 1:
        raise BadFile(path, f"has the objects {known}", "select one: load(path, object_id=...)")
    wanted = known[0] if object_id is None else object_id
    selected = {}
    for frame, entries in annotation.items():
        indices = [index for index, entry in enumerate(entries) if entry.obj_id == wanted]
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


def _rigid_matrix(path: Path, frame: int, rotation: Nine, translation: Three) -> Float[np.ndarray, "4 4"]:
    """A pose of the files as a homogeneous matrix, in metres."""
    matrix = np.eye(4)
    matrix[:3, :3] = R = np.array(rotation).reshape(3, 3)
    matrix[:3, 3] = 1e-3 * np.array(translation)
    # The entries first, because squares of large numbers overflow.
    if np.abs(R).max() > 2 or np.abs(R.T @ R - np.eye(3)).max() > RIGID_TOLERANCE or np.linalg.det(R) < 0:
        raise BadFile(path, f"frame {frame}: the rotation matrix is not a rotation")
    if not np.abs(matrix).max() <= MAX_DISTANCE:
        raise BadFile(path, f"frame {frame}: the translation is {translation}", "it is in millimetres")
    return matrix


def _lenses(root: Path, cameras: dict[int, _CameraRecord], frames: list[int]) -> dict[Path, FrameLens]:
    """The lens of every image; the camera matrices differ by less than the rounding of their digits, or really."""
    path = root / CAMERAS
    if missing := [frame for frame in frames if frame not in cameras]:
        raise BadFile(path, f"has no frame {missing[0]}, but {ANNOTATION} has")
    matrices = np.array([cameras[frame].cam_K for frame in frames]).reshape(-1, 3, 3)
    if np.abs(matrices - matrices[0]).max() <= MAX_INTRINSICS_DIFFERENCE:
        matrices = np.broadcast_to(matrices[0], matrices.shape)
    paths = [_image_path(root, frame) for frame in frames]
    size = files.image_size(paths[0])
    return {each: _images.opencv_lens(path, K, *size) for each, K in zip(paths, matrices, strict=True)}


def _light(root: Path, cameras: dict[int, _CameraRecord]) -> Light:
    entries = cameras.items()
    poses = [(frame, entry.cam_R_w2c, entry.cam_t_w2c) for frame, entry in entries if entry.cam_R_w2c is not None]
    if len(poses) < len(cameras):
        return "camera"
    matrices = [_rigid_matrix(root / CAMERAS, frame, R, t) for frame, R, t in poses]
    return "object" if max(np.abs(matrix - matrices[0]).max() for matrix in matrices) > MAX_STATIC_MOTION else "camera"
