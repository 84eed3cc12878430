"""HO3D v2 and v3 sequences: a YCB object turned in the hand before a still camera; poses in metres.

    DATASET/train|evaluation/SEQUENCE/rgb/0000.jpg (v3) or .png (v2)
                                      meta/0000.pkl      pickles of Python 2
                                      masks/0000.png     not HO3D's own: 255 object, 128 unknown (a hand), 0 background
                                      seg/0000.png       v3, train: green object, blue hand, fewer pixels
    DATASET/masks_XMem/SEQUENCE/00000.png                masks in common use: not 0 is object,
                       SEQUENCE_hand/0000.png            and here hand

The first of masks/, masks_XMem/ and seg/ that has a frame counts. A frame without mask, or with an empty one, is left
out. A frame without annotation stays, for a tracker needs it, but has no true pose. Camera frames of the files have
OpenGL axes, and the centre of their first pixel is (0, 0).
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from tumble.datasets import _pictures, _unpickle
from tumble.datasets.folder import three_valued
from tumble.io import BadFile, files
from tumble.maths import SE3, SO3
from tumble.scene import (
    OBJECT,
    UNKNOWN,
    Camera,
    Capture,
    Trajectory,
    Truth,
    mask_from_alpha,
    no_views,
    opengl_from_opencv,
)

LAYOUT = "SEQUENCE/rgb/0000.jpg and SEQUENCE/meta/0000.pkl of HO3D v2 or v3, with masks as SEQUENCE/masks/0000.png"
WRONG_AFTER = {"ABF12": 1135, "ABF14": 1135}
"""Last frame of a sequence whose annotation is right: the dataset's known mistakes."""


def recognises(path: Path) -> bool:
    """Whether a path is a sequence of HO3D."""
    return (path / "rgb").is_dir() and (path / "meta").is_dir()


def load(path: Path | str) -> Capture:
    """The frames of a sequence that have a mask, without poses; of the annotation only the camera is looked at.

    Raises:
        BadFile: A file is missing or broken, or no mask says where the object is.
    """
    root = Path(path)
    pictures = _list(root)
    masked = ((picture, mask) for picture in pictures if (mask := _mask(root, picture)) is not None)
    return _pictures.capture(root, masked, _camera(root, pictures), "camera")


def load_truth(path: Path | str) -> Truth | None:
    """The annotated poses of a sequence, YCB object frame, in metres; None when there are none.

    Raises:
        BadFile: A file is missing or broken.
    """
    root = Path(path)
    pictures = _list(root)
    motions = {p.name: motion for p in pictures if (motion := _motion(root, p)) is not None}
    if not motions:
        return None
    turns, positions = (torch.from_numpy(np.stack(values)) for values in zip(*motions.values(), strict=True))
    T_gl_obj = SE3.from_rotation(SO3.exp(turns), positions)
    T_cam_obj = SE3.from_rotation_matrix(opengl_from_opencv(turns)) @ T_gl_obj
    return replace(
        no_views(_camera(root, pictures)),
        poses=Trajectory(SE3(T_cam_obj.wxyz.float(), T_cam_obj.xyz.float()), "camera"),
        pose_names=tuple(motions),
        units="m",
        setting="handheld",
    )


def _list(root: Path) -> list[Path]:
    """The photographs, in order."""
    if not recognises(root):
        raise BadFile(root, "is not a sequence of HO3D", LAYOUT)
    pictures = sorted(p for p in (root / "rgb").iterdir() if p.suffix in (".jpg", ".png"))
    if not pictures:
        raise BadFile(root / "rgb", "holds no .jpg and no .png")
    if odd := [p for p in pictures if not p.stem.isdecimal()]:
        raise BadFile(odd[0], "is not named by its number", "HO3D counts frames as 0000, 0001, ...")
    return pictures


# Annotation -----------------------------------------------------------------------------------------------------------


def _meta(root: Path, picture: Path) -> dict[str, Any]:
    path = root / "meta" / f"{picture.stem}.pkl"
    meta = _unpickle.read(path)
    if not isinstance(meta, dict):
        raise BadFile(path, f"holds a {type(meta).__name__}, not a dictionary")
    return meta


def _array(path: Path, meta: dict[str, Any], name: str, size: int) -> np.ndarray | None:
    """The numbers under a name, flat; None where the annotation is null or absent."""
    values = meta.get(name)
    if values is None:
        return None
    if not isinstance(values, np.ndarray) or values.size != size or not np.isfinite(values).all():
        raise BadFile(path, f'"{name}" is not {size} finite numbers')
    return values.astype(np.float64).ravel()


def _camera(root: Path, pictures: list[Path]) -> Camera:
    """One camera took the sequence; frames without annotation do not tell which."""
    for picture in pictures:
        if (K := _array(picture, _meta(root, picture), "camMat", 9)) is not None:
            return _pictures.camera(K.reshape(3, 3), pictures[0])
    raise BadFile(root / "meta", 'has no frame with a camera, "camMat"')


def _motion(root: Path, picture: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """Rotation vector and position of the object before the OpenGL camera; None without annotation."""
    if int(picture.stem) > WRONG_AFTER.get(root.name, int(picture.stem)):
        return None
    meta = _meta(root, picture)
    turn, position = (_array(picture, meta, name, 3) for name in ("objRot", "objTrans"))
    return None if turn is None or position is None else (turn, position)


# Masks ----------------------------------------------------------------------------------------------------------------


def _mask(root: Path, picture: Path) -> UInt8[np.ndarray, "h w"] | None:
    """Where the object is in one frame; None where nothing says so, or it is nowhere."""
    own = root / "masks" / f"{picture.stem}.png"
    tracked = root.parent.parent / "masks_XMem"
    seg = root / "seg" / f"{picture.stem}.png"
    mask = None
    if own.exists():
        values = files.read_image(own)[..., 0]
        mask = three_valued(values, own) if values.any() else values
    elif (path := tracked / root.name / f"{int(picture.stem):05}.png").exists():
        hand = tracked / f"{root.name}_hand" / f"{int(picture.stem):04}.png"
        mask = _from_parts(files.read_image(path), files.read_image(hand) if hand.exists() else None)
    elif seg.exists():
        mask = _from_colours(files.read_image(seg), picture)
    return mask if mask is not None and (mask == OBJECT).any() else None


def _from_parts(
    object_: UInt8[np.ndarray, "h w c"], hand: UInt8[np.ndarray, "h w d"] | None
) -> UInt8[np.ndarray, "h w"]:
    held = np.zeros_like(object_[..., 0]) if hand is None else hand[..., :3].max(-1)
    return np.select([object_[..., :3].max(-1) > 0, held > 0], [OBJECT, UNKNOWN], 0).astype(np.uint8)


def _from_colours(seg: UInt8[np.ndarray, "h w c"], picture: Path) -> UInt8[np.ndarray, "H W"]:
    """Green as object, blue as unknown, both enlarged to the picture's size; what lies between is unknown."""
    if seg.shape[2] < 3:
        raise BadFile(picture, "has a segmentation without colours", "green is object, blue is hand")
    height, width = files.image_size(picture)
    # Pixels are areas for cv2.resize: it keeps their edges where they are.
    large = cv2.resize(seg[..., 1:3], (width, height), interpolation=cv2.INTER_LINEAR)
    mask = mask_from_alpha(large[..., 0])
    return np.where((large[..., 1] > 5) & (mask != OBJECT), np.uint8(UNKNOWN), mask)
