"""The visual hull of an ellipsoid recorded from all sides approximates that ellipsoid."""

import math
from dataclasses import replace

import pytest
import torch
from torch.nn.functional import max_pool2d

from tumble.maths.se3 import SE3
from tumble.scene import visual_hull
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN, Capture
from tumble.scene.trajectory import Trajectory
from tumble.synthetic import trajectories

AXES = torch.tensor([0.8, 0.5, 0.35])
CENTER = torch.tensor([0.1, -0.05, 0.15])
DISTANCE = trajectories.distance_for(math.radians(30))


def silhouettes(n: int = 40, size: int = 64) -> tuple[Capture, Trajectory]:
    """Masks of an off-centre ellipsoid, by the discriminant of each pixel's ray."""
    camera = Camera.from_fov(math.radians(30), size, size)
    T = trajectories.handheld(n, DISTANCE, seed=1)
    T_cam_obj = SE3(T.wxyz.float(), T.xyz.float())
    masks = []
    for i in range(n):
        T_obj_cam = T_cam_obj[i].inverse()
        o = (T_obj_cam.xyz - CENTER) / AXES
        d = (T_obj_cam.rotation @ camera.directions()) / AXES
        a, b, c = (d * d).sum(-1), (d * o).sum(-1), (o * o).sum() - 1
        masks.append(torch.where(b * b > a * c, OBJECT, BACKGROUND).to(torch.uint8))
    images = torch.zeros(n, size, size, 3, dtype=torch.uint8)
    trajectory = Trajectory(T_cam_obj, "camera")
    names = tuple(f"{i}.png" for i in range(n))
    return Capture(images, torch.stack(masks), camera, names, "camera", trajectory), trajectory


@pytest.fixture(scope="module")
def carved() -> torch.Tensor:
    return visual_hull.carve(*silhouettes(), resolution=64)


def test_the_hull_is_the_ellipsoid(carved: torch.Tensor) -> None:
    ticks = (torch.arange(64) + 0.5) / 64 * 2 - 1
    x = torch.stack(torch.meshgrid(ticks, ticks, ticks, indexing="ij"), -1)
    level = ((x - CENTER) / AXES).norm(dim=-1)
    # A pixel is 0.07 object radii wide, and forty silhouettes leave a little more than the convex body.
    assert (carved[level < 0.85] > 0.5).all()
    assert (carved[level > 1.35] < 0.5).all()


def test_points_lie_on_the_surface_with_outward_normals(carved: torch.Tensor) -> None:
    points = visual_hull.sample_surface(carved, 1500, torch.Generator().manual_seed(0))
    level = (points.positions - CENTER) / AXES
    assert level.norm(dim=-1).median() == pytest.approx(1.0, abs=0.05)
    true = torch.nn.functional.normalize(level / AXES, dim=-1)
    cosine = (points.normals * true).sum(-1)
    assert cosine.median() > math.cos(math.radians(10))
    assert cosine.min() > 0, "no normal points inwards"
    # Evenly spread: as many points per area on the flat sides as on the ends. A grid's own bias would be up to sqrt(3).
    brute = torch.cdist(points.positions, points.positions).fill_diagonal_(9).sort().values[:, :3].mean(-1)
    torch.testing.assert_close(points.spacing, brute, atol=1e-5, rtol=0)


def test_unknown_pixels_carve_nothing() -> None:
    capture, trajectory = silhouettes(6)
    unknown = Capture(
        capture.images, torch.full_like(capture.masks, UNKNOWN), capture.camera, capture.names, "camera", trajectory
    )
    carved = visual_hull.carve(unknown, trajectory, resolution=8)
    ticks = (torch.arange(8) + 0.5) / 8 * 2 - 1
    sphere = torch.stack(torch.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).norm(dim=-1) <= 1
    torch.testing.assert_close(carved, sphere.float())


@pytest.mark.parametrize("half", [1, 2])
def test_a_band_of_unknown_pixels_along_the_silhouette_does_not_enlarge_the_hull(
    half: int, carved: torch.Tensor
) -> None:
    """Half of the band lies inside, half outside of the true silhouettes."""
    capture, trajectory = silhouettes()
    background, inside = ((capture.masks == label).float()[:, None] for label in (BACKGROUND, OBJECT))
    near = [max_pool2d(x, 2 * half + 1, 1, half)[:, 0] > 0 for x in (background, inside)]
    masks = torch.where(near[0] & near[1], UNKNOWN, capture.masks).to(torch.uint8)
    found = visual_hull.carve(replace(capture, masks=masks), trajectory, resolution=64)
    assert int((found > 0.5).sum()) == pytest.approx(int((carved > 0.5).sum()), rel=0.03)


def test_a_hand_that_never_lets_go_is_left_out_but_not_what_it_hides() -> None:
    """A ball on the side of the ellipsoid moves with it, and hides it in part, as an unknown region."""
    capture, trajectory = silhouettes()
    ball, radius, masks = CENTER + torch.tensor([0.0, 0.55, 0.0]), 0.3, capture.masks.clone()
    for i, mask in enumerate(masks):
        T_obj_cam = trajectory.T_cam_obj[i].inverse()
        o, d = T_obj_cam.xyz - ball, T_obj_cam.rotation @ capture.camera.directions()
        hit = (d * o).sum(-1).square() > (d * d).sum(-1) * ((o * o).sum() - radius**2)
        in_front = trajectory.T_cam_obj.rotation[i].matrix()[2, 1] < 0
        mask[hit & ((mask == BACKGROUND) | in_front)] = UNKNOWN
    cells = visual_hull.carve(replace(capture, masks=masks), trajectory, resolution=64) > 0.5
    ticks = (torch.arange(64) + 0.5) / 64 * 2 - 1
    x = torch.stack(torch.meshgrid(ticks, ticks, ticks, indexing="ij"), -1)
    level = ((x - CENTER) / AXES).norm(dim=-1)
    in_ball = (x - ball).norm(dim=-1) < radius - 0.05
    assert cells[level < 0.85].all()
    protruding = in_ball & (level > 1.3)
    assert cells[protruding].float().mean() < 0.1


def test_what_lies_outside_of_all_images_is_object_only_if_it_may_be() -> None:
    """Every frame sees only the left half of its image: to its right there may be object, or none."""
    capture, trajectory = silhouettes(1)
    camera, images, masks = capture.camera.cropped(0, 0, 64, 32), capture.images[:, :, :32], capture.masks[:, :, :32]
    half = replace(capture, camera=camera, images=images, masks=masks)
    right = trajectory.T_cam_obj[0].inverse() @ torch.tensor([0.5, 0.0, DISTANCE])
    cell = tuple(((right + 1) * 16).long().tolist())
    assert visual_hull.carve(half, trajectory, resolution=32)[cell] == 1
    assert visual_hull.carve(half, trajectory, resolution=32, outside=0.0)[cell] == 0


def test_a_few_wrong_masks_are_tolerated() -> None:
    """One of twenty masks is empty."""
    capture, trajectory = silhouettes(20)
    masks = capture.masks.clone()
    masks[7] = BACKGROUND
    wrong = Capture(capture.images, masks, capture.camera, capture.names, "camera", trajectory)
    assert not visual_hull.carve(wrong, trajectory, resolution=32).any()
    inside, true = (
        visual_hull.carve(each, trajectory, resolution=32, tolerance=tolerance) > 0.5
        for each, tolerance in ((wrong, 0.05), (capture, 0.0))
    )
    assert (inside & true).sum() == true.sum()
    assert inside.sum() < 1.1 * true.sum()


def test_an_empty_hull_is_an_error() -> None:
    capture, trajectory = silhouettes(6)
    nothing = torch.full_like(capture.masks, BACKGROUND)
    empty = Capture(capture.images, nothing, capture.camera, capture.names, "camera", trajectory)
    cells = visual_hull.carve(empty, trajectory, resolution=16)
    with pytest.raises(ValueError, match="is empty"):
        visual_hull.sample_surface(cells, 100, torch.Generator().manual_seed(0))


def test_an_isolated_cell_does_not_produce_points_without_normals() -> None:
    """The gradient is zero in the middle of an isolated cell, so that it has no normal there."""
    inside = torch.zeros(40, 40, 40)
    inside[5:13, 5:13, 5:13] = 1.0
    inside[30, 30, 30] = 1.0
    points = visual_hull.sample_surface(inside, 100, torch.Generator().manual_seed(0))
    assert len(points.positions) == 100
    torch.testing.assert_close(points.normals.norm(dim=-1), torch.ones(100))
