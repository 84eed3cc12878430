"""The virtual camera against projections of points in space by the true camera."""

import math

import pytest
import torch

from tests.oracles.virtual_camera import warp_images, warp_masks
from tumble.maths.images import linear_from_srgb
from tumble.maths.se3 import SE3
from tumble.poses.progressive.virtual_camera import FILL, aim_at, aim_to_camera, camera_to_aim
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN

CAMERA = Camera(torch.tensor([140.0, 150.0, 70.0, 45.0]), 96, 128)
"""Asymmetric: the focal lengths differ, the principal point is off-centre, and the frame is wide."""


def rectangles(*boxes: tuple[int, int, int, int]) -> torch.Tensor:
    """One mask per box (top, left, bottom, right)."""
    masks = torch.full((len(boxes), CAMERA.height, CAMERA.width), BACKGROUND, dtype=torch.uint8)
    for mask, (top, left, bottom, right) in zip(masks, boxes, strict=True):
        mask[top:bottom, left:right] = OBJECT
    return masks


MASKS = rectangles((10, 80, 40, 120), (50, 12, 92, 40))


def test_the_centre_of_the_silhouette_is_at_the_centre_of_the_virtual_frame() -> None:
    aim = aim_at(MASKS, CAMERA, size=64)
    for frame, centre in enumerate([(100.0, 25.0), (26.0, 71.0)]):
        uv = camera_to_aim(aim, CAMERA, frame, torch.tensor(centre))
        torch.testing.assert_close(uv, torch.tensor([32.0, 32.0]), atol=1e-4, rtol=0)


def test_poses_and_pixels_give_the_same_virtual_positions() -> None:
    """The closed form `T_cam_obj = R_cam_aim @ T_aim_obj`, translation included."""
    aim = aim_at(MASKS, CAMERA, size=64)
    T_cam_obj = SE3.exp(torch.tensor([0.9, -0.4, 4.0, 0.3, -1.2, 0.7]))
    x_obj = torch.tensor([[0.3, -0.5, 0.1], [-0.2, 0.4, 0.6]])
    for frame in range(2):
        T_cam_aim = SE3.from_rotation(aim.R_cam_aim[frame], torch.zeros(3))
        T_aim_obj = T_cam_aim.inverse() @ T_cam_obj
        by_pose = aim.camera.project(T_aim_obj @ x_obj)
        by_pixels = camera_to_aim(aim, CAMERA, frame, CAMERA.project(T_cam_obj @ x_obj))
        torch.testing.assert_close(by_pixels, by_pose, atol=1e-3, rtol=1e-5)


def test_aim_to_camera_inverts_camera_to_aim() -> None:
    aim = aim_at(MASKS, CAMERA, size=200)
    uv = torch.rand(50, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([128.0, 96.0])
    virtual = camera_to_aim(aim, CAMERA, 1, uv)
    torch.testing.assert_close(aim_to_camera(aim, CAMERA, 1, virtual), uv, atol=1e-3, rtol=0)


def test_the_rotation_is_the_shortest_one() -> None:
    """Its angle is that between viewing axis and silhouette, and its axis is perpendicular to the viewing axis."""
    aim = aim_at(MASKS, CAMERA, size=64)
    direction = CAMERA.unproject(torch.tensor([100.0, 25.0]), torch.ones(()))
    angle = math.acos(float(direction[2] / direction.norm()))
    assert float(aim.R_cam_aim[0].angle()) == pytest.approx(angle, abs=1e-5)
    assert float(aim.R_cam_aim.log()[:, 2].abs().max()) < 1e-7


def test_the_largest_silhouette_fills_its_fraction_of_the_frame() -> None:
    masks = rectangles((0, 0, 96, 100), (40, 60, 50, 70))
    aim = aim_at(masks, CAMERA, size=400)
    warped = warp_masks(masks, CAMERA, aim)
    extent = [((mask == OBJECT).nonzero() + 0.5 - 200).abs().max() / 200 for mask in warped]
    # Nearest-neighbour sampling shifts the border by up to one pixel of the frame, here 3 of the virtual frame.
    assert float(extent[0]) == pytest.approx(FILL, abs=0.02)
    assert float(extent[1]) < 0.25, "one focal length for all frames: a smaller silhouette stays smaller"


def test_unknown_pixels_are_ignored_and_frames_without_object_take_the_closest_aim() -> None:
    masks = rectangles((10, 80, 40, 120), (0, 0, 0, 0), (0, 0, 0, 0), (50, 12, 92, 40))
    masks[0, :, :60] = UNKNOWN
    aim, plain = aim_at(masks, CAMERA, size=64), aim_at(MASKS, CAMERA, size=64)
    assert torch.equal(aim.R_cam_aim.wxyz, plain.R_cam_aim.wxyz[[0, 0, 1, 1]])


def test_without_object_pixels_there_is_an_error() -> None:
    with pytest.raises(ValueError, match="no mask has an object pixel"):
        aim_at(MASKS * 0 + UNKNOWN, CAMERA, size=64)


def test_masks_keep_their_three_values_and_are_background_off_the_frame() -> None:
    masks = rectangles((0, 90, 40, 128))
    masks[0, :, 100:110] = UNKNOWN
    aim = aim_at(masks, CAMERA, size=128, fill=0.5)
    warped = warp_masks(masks, CAMERA, aim)[0]
    assert set(warped.unique().tolist()) == {OBJECT, UNKNOWN, BACKGROUND}
    uv = aim_to_camera(aim, CAMERA, 0, aim.camera.pixel_centers())
    outside = (uv[..., 0] > 128) | (uv[..., 1] < 0)
    assert outside.any()
    assert (warped[outside] == BACKGROUND).all()


def test_images_are_resampled_at_the_right_positions() -> None:
    """For a horizontal ramp of light, every virtual pixel has the ramp's value at its position in the frame."""
    ramp = torch.arange(128.0)[None, :, None].expand(96, 128, 3) / 160
    code = (
        (torch.where(ramp <= 0.0031308, 12.92 * ramp, 1.055 * ramp ** (1 / 2.4) - 0.055) * 255).round().to(torch.uint8)
    )
    for size in (48, 256):
        aim = aim_at(MASKS, CAMERA, size=size)
        warped = linear_from_srgb(warp_images(code[None].expand(2, -1, -1, -1), CAMERA, aim) / 255)
        for frame in range(2):
            uv = aim_to_camera(aim, CAMERA, frame, aim.camera.pixel_centers())
            interior = ((uv > 3) & (uv < torch.tensor([125.0, 93.0]))).all(-1)
            # Half a code value each way, at most 1.1 % of light per code value at the bright end.
            assert float((warped[frame, ..., 0] - (uv[..., 0] - 0.5) / 160)[interior].abs().max()) < 0.01


def test_a_coarser_virtual_frame_averages() -> None:
    """Stripes of one pixel become the grey of half the light instead of an aliased pattern."""
    stripes = torch.zeros(1, 96, 128, 3, dtype=torch.uint8)
    stripes[:, :, ::2] = 255
    masks = rectangles((8, 8, 90, 120))
    aim = aim_at(masks, CAMERA, size=24)
    middle = linear_from_srgb(warp_images(stripes, CAMERA, aim)[0, 8:16, 8:16] / 255)
    assert float((middle - 0.5).abs().max()) < 0.15
