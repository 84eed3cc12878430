"""Poses by COLMAP, a program for photographs of static scenes, from the masked frames of a capture.

What the masks leave is static with respect to the object, so that a program for a still object and a moving camera
applies. Its features need more pixels than a small frame has: frames are enlarged. Needs `pip install pycolmap`.
"""

import importlib
import tempfile
from pathlib import Path

import cv2
import numpy as np
import torch

from tumble.maths import SE3
from tumble.scene import OBJECT, Capture, Trajectory

ENLARGED = 4
"""Factor on the height and width of the frames."""
MIN_FRAMES = 5
"""Smallest number of frames of a reconstruction."""


def poses(capture: Capture) -> tuple[Trajectory, list[int]] | None:
    """Poses of the frames of COLMAP's largest reconstruction and their indices, ascending; None if there is none.

    All pairs of frames are matched, the camera is known, and all other settings are COLMAP's own.

    Raises:
        ModuleNotFoundError: pycolmap is not installed.
    """
    colmap = importlib.import_module("pycolmap")
    with tempfile.TemporaryDirectory() as folder:
        images, masks, database = Path(folder, "images"), Path(folder, "masks"), Path(folder, "database.db")
        images.mkdir()
        masks.mkdir()
        for k, (image, mask) in enumerate(zip(capture.images.numpy(), capture.masks.numpy(), strict=True)):
            shown = (255 * (mask == OBJECT)).astype(np.uint8)
            _write(images / f"{k:04d}.png", np.where(shown[..., None] > 0, image[..., ::-1], 0), cv2.INTER_CUBIC)
            _write(masks / f"{k:04d}.png.png", shown, cv2.INTER_NEAREST)
        focal = ",".join(str(ENLARGED * value) for value in capture.camera.fx_fy_cx_cy.tolist())
        reader = colmap.ImageReaderOptions(mask_path=str(masks), camera_model="PINHOLE", camera_params=focal)
        colmap.extract_features(database, images, camera_mode=colmap.CameraMode.SINGLE, reader_options=reader)
        colmap.match_exhaustive(database)
        options = colmap.IncrementalPipelineOptions(
            min_model_size=MIN_FRAMES,
            ba_refine_focal_length=False,
            ba_refine_principal_point=False,
            ba_refine_extra_params=False,
        )
        found = colmap.incremental_mapping(database, images, Path(folder), options)
        poses = [_poses(each) for each in found.values()]
    frames, T = max(poses, key=lambda each: len(each[0]), default=([], np.zeros((0, 4, 4), np.float32)))
    if len(frames) < MIN_FRAMES:
        return None
    return Trajectory(SE3.from_matrix(torch.from_numpy(T)), capture.light), frames


def _write(path: Path, image: np.ndarray, interpolation: int) -> None:
    cv2.imwrite(str(path), cv2.resize(image, None, fx=ENLARGED, fy=ENLARGED, interpolation=interpolation))


def _poses(reconstruction) -> tuple[list[int], np.ndarray]:
    """Indices of the frames of a reconstruction, ascending, and their `T_cam_obj` in its own object frame and unit."""
    posed = {
        int(Path(image.name).stem): image.cam_from_world() for image in reconstruction.images.values() if image.has_pose
    }
    frames = sorted(posed)
    bottom = np.tile(np.array([[[0.0, 0.0, 0.0, 1.0]]]), (len(frames), 1, 1))
    return frames, np.concatenate([np.stack([posed[k].matrix() for k in frames]), bottom], 1).astype(np.float32)
