"""Relative poses of two views of an ellipsoid with a known rotation between them."""

import pytest
import torch

from tests.lopsided import tumbling
from tumble.maths.se3 import SO3
from tumble.poses.sfm import relative_pose
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN, Capture


@pytest.fixture(scope="module")
def fits() -> tuple[relative_pose.RelativePoses, torch.Tensor]:
    scene = tumbling(24)
    rng = torch.Generator().manual_seed(0)
    matches = [scene.match(t - 1, t, rng) for t in range(1, 24)]
    found = relative_pose.fit(matches, relative_pose.silhouettes(scene.capture), scene.capture.camera)
    R = scene.T_cam_obj.rotation.matrix()
    return found, R[1:] @ R[:-1].mT


def test_the_rotation_has_the_right_orientation(fits: tuple[relative_pose.RelativePoses, torch.Tensor]) -> None:
    """Two views leave the angle undetermined (bas-relief), not the axis; a mirror image is off by twice the angle."""
    found, true = fits
    angle = SO3.from_matrix(true).angle()
    off = SO3.from_matrix(found.R_j_i @ true.mT).angle()
    assert (off < angle).float().mean() > 0.9
    assert off.rad2deg().median() < 5


def test_most_matches_are_inliers_despite_outliers(fits: tuple[relative_pose.RelativePoses, torch.Tensor]) -> None:
    """Nine of ten matches have 0.2 pixels of noise; a few wrong ones lie on a segment by chance."""
    found, _ = fits
    fraction = found.inliers / found.inliers.new_tensor([130.0])
    assert (fraction > 0.5).all()
    assert (found.cost <= found.alternative_cost).all()


def test_a_rotation_about_the_viewing_axis_is_exact() -> None:
    """In-plane rotation is observable whatever the depths are."""
    scene = tumbling(2)
    uv, facing = scene.seen(0)
    centre = relative_pose.silhouettes(scene.capture).centre[0].double()
    # Rotate the pixels about the silhouette's centre, which is near the principal point: then nothing else changes.
    angle = torch.tensor(0.3, dtype=torch.float64)
    c, s = angle.cos(), angle.sin()
    rotation = torch.stack([torch.stack([c, -s]), torch.stack([s, c])])
    match = scene.match(0, 1, torch.Generator().manual_seed(0))
    rotated = (uv[facing] - centre) @ rotation.T + centre
    exact = type(match)(0, 1, uv[facing], rotated, torch.ones(int(facing.sum())))
    shapes = relative_pose.silhouettes(scene.capture)
    same = relative_pose.Silhouettes(*(getattr(shapes, k)[[0, 0]] for k in ("centre", "radius", "extent", "visible")))
    found = relative_pose.fit([exact], same, scene.capture.camera)
    expected = torch.tensor([0.0, 0.0, 0.3], dtype=torch.float64)
    torch.testing.assert_close(SO3.from_matrix(found.R_j_i[0]).log(), expected, atol=0.02, rtol=0)


def test_silhouettes_have_centre_and_radius() -> None:
    """For a 20 x 10 rectangle whose unknown pixels count as object, and for an empty mask."""
    masks = torch.full((2, 64, 64), BACKGROUND, dtype=torch.uint8)
    masks[0, 30:40, 10:25] = OBJECT
    masks[0, 30:40, 25:30] = UNKNOWN
    camera = Camera(torch.tensor([100.0, 100.0, 32.0, 32.0]), 64, 64)
    images = torch.zeros(2, 64, 64, 3, dtype=torch.uint8)
    shapes = relative_pose.silhouettes(Capture(images, masks, camera, ("a", "b"), "camera"))
    assert shapes.centre[0].tolist() == [20, 35]
    assert float(shapes.radius[0]) == pytest.approx(relative_pose.SPHERE_OVER_DISC * (200 / torch.pi) ** 0.5 / 100)
    assert shapes.visible.tolist() == [True, False]


def test_a_silhouette_that_jumps_is_detected_and_replaced() -> None:
    """Frames grow by five percent each; the radius of one is reduced, and the centre of another is moved."""
    radius = 0.1 * 1.05 ** torch.arange(9, dtype=torch.float64)
    centre = torch.full((9, 2), 64.0, dtype=torch.float64)
    shapes = relative_pose.Silhouettes(centre, radius, torch.full((9,), 30.0), torch.ones(9, dtype=torch.bool))
    assert not relative_pose.failed_masks(shapes).any()
    radius[3] *= 0.7
    centre[6, 0] += 15
    found = relative_pose.failed_masks(shapes)
    assert torch.nonzero(found)[:, 0].tolist() == [3, 6]
    repaired = relative_pose.replace_failed(shapes, found)
    assert float(repaired.radius[3]) in (float(radius[2]), float(radius[4]))
    assert repaired.centre[6].tolist() == [64, 64]
