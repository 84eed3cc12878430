"""Two views of an ellipsoid with known rotation between them."""

import pytest
import torch

from tests.lopsided import tumbling
from tumble.maths.se3 import SO3
from tumble.poses.sfm import relative_pose
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN, Capture


@pytest.fixture(scope="module")
def fits() -> tuple[relative_pose.Relative, torch.Tensor]:
    scene = tumbling(24)
    rng = torch.Generator().manual_seed(0)
    matches = [scene.match(t - 1, t, rng) for t in range(1, 24)]
    found = relative_pose.fit(matches, relative_pose.silhouettes(scene.capture), scene.capture.camera)
    R = scene.T_cam_obj.rotation.matrix()
    return found, R[1:] @ R[:-1].mT


def test_the_turn_is_found_the_right_way_round(fits: tuple[relative_pose.Relative, torch.Tensor]) -> None:
    """Two views leave the angle open (bas-relief), not the axis: a mirror image would be off by twice the angle."""
    found, true = fits
    angle = SO3.from_matrix(true).angle()
    off = SO3.from_matrix(found.R_j_i @ true.mT).angle()
    assert (off < angle).float().mean() > 0.9
    assert off.rad2deg().median() < 5


def test_outliers_do_not_count(fits: tuple[relative_pose.Relative, torch.Tensor]) -> None:
    """Nine of ten matches are right to 0.2 pixels; a few wrong ones fall on a segment by chance."""
    found, _ = fits
    share = found.inliers / found.inliers.new_tensor([130.0])
    assert (share > 0.5).all()
    assert (found.cost <= found.rival_cost).all()


def test_a_turn_about_the_viewing_axis_is_exact() -> None:
    """In-plane rotation is seen whatever the depths are."""
    scene = tumbling(2)
    uv, facing = scene.seen(0)
    centre = relative_pose.silhouettes(scene.capture).centre[0].double()
    # Turn the pixels about the silhouette's centre, which is near the principal point: then nothing else changes.
    angle = torch.tensor(0.3, dtype=torch.float64)
    c, s = angle.cos(), angle.sin()
    turn = torch.stack([torch.stack([c, -s]), torch.stack([s, c])])
    match = scene.match(0, 1, torch.Generator().manual_seed(0))
    turned = (uv[facing] - centre) @ turn.T + centre
    exact = type(match)(0, 1, uv[facing], turned, torch.ones(int(facing.sum())))
    shapes = relative_pose.silhouettes(scene.capture)
    same = relative_pose.Silhouettes(*(getattr(shapes, k)[[0, 0]] for k in ("centre", "radius", "extent", "visible")))
    found = relative_pose.fit([exact], same, scene.capture.camera)
    expected = torch.tensor([0.0, 0.0, 0.3], dtype=torch.float64)
    torch.testing.assert_close(SO3.from_matrix(found.R_j_i[0]).log(), expected, atol=0.02, rtol=0)


def test_silhouettes_are_measured() -> None:
    """A 20 x 10 rectangle; unknown pixels are object, for they hide it; an empty mask is said to be one."""
    masks = torch.full((2, 64, 64), BACKGROUND, dtype=torch.uint8)
    masks[0, 30:40, 10:25] = OBJECT
    masks[0, 30:40, 25:30] = UNKNOWN
    camera = Camera(torch.tensor([100.0, 100.0, 32.0, 32.0]), 64, 64)
    images = torch.zeros(2, 64, 64, 3, dtype=torch.uint8)
    shapes = relative_pose.silhouettes(Capture(images, masks, camera, ("a", "b"), "camera"))
    assert shapes.centre[0].tolist() == [20, 35]
    assert float(shapes.radius[0]) == pytest.approx(relative_pose.ROUNDNESS * (200 / torch.pi) ** 0.5 / 100)
    assert shapes.visible.tolist() == [True, False]


def test_a_silhouette_that_jumps_is_odd_and_mended() -> None:
    """Five frames in a row grow by five percent each; one is cut in half, another moved aside."""
    radius = 0.1 * 1.05 ** torch.arange(9, dtype=torch.float64)
    centre = torch.full((9, 2), 64.0, dtype=torch.float64)
    shapes = relative_pose.Silhouettes(centre, radius, torch.full((9,), 30.0), torch.ones(9, dtype=torch.bool))
    assert not relative_pose.odd(shapes).any()
    radius[3] *= 0.7
    centre[6, 0] += 15
    found = relative_pose.odd(shapes)
    assert torch.nonzero(found)[:, 0].tolist() == [3, 6]
    whole = relative_pose.mended(shapes, found)
    assert float(whole.radius[3]) in (float(radius[2]), float(radius[4]))
    assert whole.centre[6].tolist() == [64, 64]
