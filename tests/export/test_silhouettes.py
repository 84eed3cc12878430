"""The offset of a sphere's surface from masks that are computed analytically."""

import math

import numpy as np
import pytest
import torch

from tumble.export import silhouettes
from tumble.export.atlas import UnwrappedMesh
from tumble.maths.se3 import SE3, SO3
from tumble.rendering.lit_frames import LitFrame
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN

SIDE = 64
CAMERA = Camera.from_fov(math.radians(30), SIDE, SIDE)
PIXEL = 5 / float(CAMERA.fx_fy_cx_cy[0])
"""Size of a pixel at the sphere's distance."""
OFFSETS = (0.0, 0.25 * PIXEL, 0.5 * PIXEL)


def sphere(radius: float) -> UnwrappedMesh:
    """A sphere around (0.1, -0.05, 0), of 64 x 32 quads."""
    height, around = np.meshgrid(np.linspace(0, np.pi, 33), np.linspace(0, 2 * np.pi, 65), indexing="ij")
    normals = np.stack([np.sin(height) * np.cos(around), np.sin(height) * np.sin(around), np.cos(height)], -1)
    corner = np.arange(33 * 65).reshape(33, 65)
    a, b, c, d = corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    normals, n = normals.reshape(-1, 3), 33 * 65
    centre = np.array([0.1, -0.05, 0.0])
    return UnwrappedMesh(centre + radius * normals, normals, np.zeros((n, 4)), np.zeros((n, 2)), faces)


def frame(turn: float, radius: float) -> LitFrame:
    """A view from a distance of 5, with the mask of the sphere of this radius."""
    R = SO3.exp(torch.tensor([0.3, turn, 0.1]))
    T_cam_obj = SE3(R.wxyz, torch.tensor([0.0, 0.0, 5.0]))
    ray = CAMERA.unproject(CAMERA.pixel_centers().reshape(-1, 2), torch.ones(SIDE * SIDE)).double()
    centre = (T_cam_obj @ torch.tensor([[0.1, -0.05, 0.0]]))[0].double()
    along = (ray @ centre) / ray.norm(dim=-1)
    hit = ((centre @ centre - along**2).clamp_min(0).sqrt() < radius).reshape(SIDE, SIDE).numpy()
    mask = np.where(hit, OBJECT, BACKGROUND).astype(np.uint8)
    empty = np.zeros((SIDE, SIDE, 3), np.float32)
    return LitFrame(mask, T_cam_obj, CAMERA, empty, hit, empty, empty)


@pytest.mark.parametrize("offset", [0.1, 0.4])
def test_the_offset_of_the_surface_is_found(offset: float) -> None:
    frames = [frame(0.7 * k, 1.0) for k in range(8)]
    found = silhouettes.best_offset(sphere(1.0 - offset * PIXEL), frames, OFFSETS)
    assert found / PIXEL == pytest.approx(offset, abs=0.1)


def test_unknown_pixels_errors_of_masks_and_single_frames_do_not_count() -> None:
    """A hand over the left half, a forgotten patch of background, and a frame that shows something else."""
    frames = [frame(0.7 * k, 1.0) for k in range(7)]
    for each in frames[:-1]:
        each.mask[:, : SIDE // 2] = UNKNOWN
        each.mask[2:8, 50:60] = OBJECT
    frames[-1].mask[:] = OBJECT
    found = silhouettes.best_offset(sphere(1.0 - 0.3 * PIXEL), frames, OFFSETS)
    assert found / PIXEL == pytest.approx(0.3, abs=0.1)


def test_an_offset_beyond_those_tried_is_the_nearest_of_them() -> None:
    frames = [frame(0.7 * k, 1.0) for k in range(5)]
    assert silhouettes.best_offset(sphere(0.9), frames, OFFSETS) == OFFSETS[-1]
    assert silhouettes.best_offset(sphere(1.1), frames, OFFSETS) == OFFSETS[0]


def test_half_a_pixel_is_covered_by_half() -> None:
    """A square from 10.5 to 20 pixels in x and 8 to 12.25 in y."""
    flat = frame(0.0, 1.0)
    corners = torch.tensor([[10.5, 8.0], [20.0, 8.0], [20.0, 12.25], [10.5, 12.25]])
    x_cam = CAMERA.unproject(corners, torch.full((4,), 5.0))
    vertices = (flat.T_cam_obj.inverse() @ x_cam).double().numpy()
    covered = silhouettes.coverage(vertices, np.array([[0, 1, 2], [0, 2, 3]]), flat)
    assert covered[9, 11:20] == pytest.approx(1.0)
    assert covered[9, 10] == pytest.approx(0.5, abs=0.13)
    assert covered[12, 15] == pytest.approx(0.25, abs=0.13)
    assert covered[[7, 13], 15] == pytest.approx(0.0)
    assert covered.sum() == pytest.approx(9.5 * 4.25, rel=0.05)
