"""Reader of HO3D v2 and v3 sequences: a YCB object rotated in the hand in front of a static camera; poses in metres.

    DATASET/train|evaluation/SEQUENCE/rgb/0000.jpg (v3) or .png (v2)
                                      meta/0000.pkl      pickles of Python 2
                                      masks/0000.png     your own: 255 object, 128 unknown (a hand), 0 background
                                      seg/0000.png       v3, train: green object, blue hand, at a lower resolution
    DATASET/masks_XMem/SEQUENCE/00000.png                masks by XMem: object where not 0,
                       SEQUENCE_hand/0000.png            and hand where not 0

Per frame the first of masks/, masks_XMem/ and seg/ that has a mask is used. A frame without a mask, or with an empty
one, is omitted. A frame without annotation is kept, because tracking needs consecutive frames, but has no true pose.
Camera frames have OpenGL axes, and the centre of the first pixel is (0, 0).
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from tumble.datasets import _images, _unpickle
from tumble.datasets._lens import FrameLens
from tumble.datasets.folder import decode_nonempty_mask
from tumble.io import BadFile, files
from tumble.maths import SE3, SO3
from tumble.scene import (
    OBJECT,
    UNKNOWN,
    Capture,
    Trajectory,
    Truth,
    mask_from_alpha,
    opengl_from_opencv,
    truth_without_views,
)

LAYOUT = "SEQUENCE/rgb/0000.jpg and SEQUENCE/meta/0000.pkl of HO3D v2 or v3, with masks as SEQUENCE/masks/0000.png"
LAST_VALID_FRAME = {"ABF12": 1135, "ABF14": 1135}
"""Last frame with a correct annotation, for sequences with known errors in the dataset."""


def recognises(path: Path) -> bool:
    """Whether a path is an HO3D sequence."""
    return (path / "rgb").is_dir() and (path / "meta").is_dir()


def load(path: Path | str) -> Capture:
    """The frames of a sequence that have a mask, without poses; of the annotation only the camera matrix is used.

    Raises:
        BadFile: A file is missing or broken, or there is no mask.
    """
    root = Path(path).resolve()  # its name, and that of the folder above, say what it is
    images = _list_images(root)
    masked = ((image, mask) for image in images if (mask := _mask(root, image)) is not None)
    return _images.build_capture(root, masked, dict.fromkeys(images, _lens(root, images)), "camera")


def load_truth(path: Path | str) -> Truth | None:
    """Annotated poses of a sequence, in the YCB object frame [metres]; None if there are none.

    Raises:
        BadFile: A file is missing or broken.
    """
    root = Path(path).resolve()
    images = _list_images(root)
    poses = {p.name: pose for p in images if (pose := _pose(root, p)) is not None}
    if not poses:
        return None
    rotations, positions = (torch.from_numpy(np.stack(values)) for values in zip(*poses.values(), strict=True))
    T_gl_obj = SE3.from_rotation(SO3.exp(rotations), positions)
    T_cam_obj = SE3.from_rotation_matrix(opengl_from_opencv(rotations)) @ T_gl_obj
    return replace(
        truth_without_views(_lens(root, images).camera),
        poses=Trajectory(SE3(T_cam_obj.wxyz.float(), T_cam_obj.xyz.float()), "camera"),
        pose_names=tuple(poses),
        units="m",
        setting="handheld",
    )


def _list_images(root: Path) -> list[Path]:
    """Image files of a sequence, sorted."""
    if not recognises(root):
        raise BadFile(root, "is not an HO3D sequence", f"expected {LAYOUT}")
    images = sorted(p for p in (root / "rgb").iterdir() if p.suffix in (".jpg", ".png"))
    if not images:
        raise BadFile(root / "rgb", "has no .jpg or .png files")
    if misnamed := [p for p in images if not p.stem.isdecimal()]:
        raise BadFile(misnamed[0], "is not named by a number", "HO3D names frames 0000, 0001, ...")
    return images


# Annotation -----------------------------------------------------------------------------------------------------------


def _meta(root: Path, image: Path) -> dict[str, Any]:
    path = root / "meta" / f"{image.stem}.pkl"
    meta = _unpickle.read(path)
    if not isinstance(meta, dict):
        raise BadFile(path, f"contains a {type(meta).__name__}, not a dictionary")
    return meta


def _array(path: Path, meta: dict[str, Any], name: str, size: int) -> np.ndarray | None:
    """The flattened numbers of an entry; None if it is null or missing."""
    values = meta.get(name)
    if values is None:
        return None
    if not isinstance(values, np.ndarray) or values.size != size or not np.isfinite(values).all():
        raise BadFile(path, f'"{name}" is not {size} finite numbers')
    return values.astype(np.float64).ravel()


def _lens(root: Path, images: list[Path]) -> FrameLens:
    """The lens of the sequence, from the first frame that has a camera matrix."""
    for image in images:
        if (K := _array(image, _meta(root, image), "camMat", 9)) is not None:
            return _images.opencv_lens(image, K.reshape(3, 3), *files.image_size(images[0]))
    raise BadFile(root / "meta", 'has no frame with the camera matrix "camMat"')


def _pose(root: Path, image: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """Rotation vector and position of the object in the OpenGL camera frame; None without annotation."""
    if int(image.stem) > LAST_VALID_FRAME.get(root.name, int(image.stem)):
        return None
    meta = _meta(root, image)
    rotation, position = (_array(image, meta, name, 3) for name in ("objRot", "objTrans"))
    return None if rotation is None or position is None else (rotation, position)


# Masks ----------------------------------------------------------------------------------------------------------------


def _mask(root: Path, image: Path) -> UInt8[np.ndarray, "h w"] | None:
    """Mask of one frame; None if there is none, or if it contains no object."""
    mask_file = root / "masks" / f"{image.stem}.png"
    xmem = root.parent.parent / "masks_XMem"
    seg = root / "seg" / f"{image.stem}.png"
    mask = None
    if mask_file.exists():
        values = files.read_image(mask_file)[..., 0]
        mask = decode_nonempty_mask(values, mask_file) if values.any() else values
    elif (path := xmem / root.name / f"{int(image.stem):05}.png").exists():
        hand = xmem / f"{root.name}_hand" / f"{int(image.stem):04}.png"
        mask = _from_parts(path, hand)
    elif seg.exists():
        mask = _from_colours(files.read_image(seg), image)
    return mask if mask is not None and (mask == OBJECT).any() else None


def _from_parts(object_file: Path, hand_file: Path) -> UInt8[np.ndarray, "h w"]:
    """Mask from the file of the object's mask and that of the hand's, which may be missing; object where they overlap.

    Raises:
        BadFile: They have different sizes.
    """
    is_object = files.read_image(object_file)[..., :3].max(-1) > 0
    is_hand = files.read_image(hand_file)[..., :3].max(-1) > 0 if hand_file.exists() else np.zeros_like(is_object)
    if is_hand.shape != is_object.shape:
        sizes = [f"{x.shape[1]} x {x.shape[0]}" for x in (is_hand, is_object)]
        raise BadFile(hand_file, f"has {sizes[0]} pixels, but {object_file} has {sizes[1]}", "they must agree")
    return np.select([is_object, is_hand], [OBJECT, UNKNOWN], 0).astype(np.uint8)


def _from_colours(seg: UInt8[np.ndarray, "h w c"], image: Path) -> UInt8[np.ndarray, "H W"]:
    """Mask at the image's size from a colour segmentation: green is object; blue and mixed pixels are unknown."""
    if seg.shape[2] < 3:
        raise BadFile(image, "has a segmentation without colours", "green must be the object, blue the hand")
    height, width = files.image_size(image)
    # cv2.resize treats pixels as areas, so the borders of the image stay aligned.
    large = cv2.resize(seg[..., 1:3], (width, height), interpolation=cv2.INTER_LINEAR)
    mask = mask_from_alpha(large[..., 0])
    return np.where((large[..., 1] > 5) & (mask != OBJECT), np.uint8(UNKNOWN), mask)
