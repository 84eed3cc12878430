"""Outlines of a lopsided ellipsoid touch common planes when its poses are true, and only then."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.lopsided import DISTANCE, Tumble, tumbling
from tumble.maths.se3 import SO3
from tumble.poses.sfm import frontier_points, relocalization
from tumble.poses.sfm.frontier_points import Outlines
from tumble.preprocess.segmentation import three_valued
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN, Capture

RADIUS = 0.9


@pytest.fixture(scope="module")
def scene() -> Tumble:
    return tumbling(24)


def poses(scene: Tumble) -> tuple[torch.Tensor, torch.Tensor]:
    return scene.T_cam_obj.rotation.matrix(), scene.T_cam_obj.xyz


def all_pairs(n: int) -> torch.Tensor:
    return torch.triu_indices(n, n, 1).T


def gaps(scene: Tumble, R: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
    i, j = all_pairs(len(R)).T
    outline = frontier_points.outlines(scene.capture)
    found = frontier_points.touch(
        (R[i], t[i]), (R[j], t[j]), outline[i], outline[j], scene.capture.camera, radius=RADIUS
    )
    # In units of the mean distance, as `touch` is used: a gap is an angle times focal length times distance over it.
    return found.gap[found.good].abs() / DISTANCE


def test_true_poses_leave_no_gap(scene: Tumble) -> None:
    """Corners are pixel centres inside the outline: a fraction of a pixel is lost on each side, nearly alike."""
    gap = gaps(scene, *poses(scene))
    assert len(gap) > 200
    assert gap.median() < 0.25
    assert gap.quantile(0.95) < 0.8


def test_a_wrong_pose_opens_gaps(scene: Tumble) -> None:
    R, t = poses(scene)
    wrong = R.clone()
    wrong[5] = SO3.exp(torch.tensor([0.0, 0.15, 0.1], dtype=torch.float64)).matrix() @ R[5]
    outline = frontier_points.outlines(scene.capture)
    others = torch.tensor([k for k in range(24) if k != 5])
    judge = relocalization.Judge(
        (R[others], t[others]), outline[torch.tensor([5])], outline[others], scene.capture.camera, RADIUS
    )
    both = judge.gaps(torch.stack([R[5], wrong[5]]), t[[5, 5]]).abs().nanmedian(1).values
    assert both[1] > 3 * both[0]


def test_frontier_points_lie_on_both_outlines(scene: Tumble) -> None:
    """And the rays of the two pixels meet, nearly, on the ellipsoid."""
    R, t = poses(scene)
    outline = frontier_points.outlines(scene.capture)
    tracks = frontier_points.frontier(R, t, scene.capture.camera, outline, radius=RADIUS, pairs=all_pairs(24))
    assert (torch.bincount(tracks.point) == 2).all()
    assert len(tracks) == 2 * tracks.n
    row, column = (tracks.uv.floor().long()[:, k] for k in (1, 0))
    masks = scene.capture.masks[tracks.frame]
    index = torch.arange(len(masks))
    assert (masks[index, row, column] != BACKGROUND).all()
    around = torch.stack([masks[index, row + dy, column + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)], 1)
    assert (around == BACKGROUND).any(1).all()


def test_views_along_the_line_of_sight_say_nothing(scene: Tumble) -> None:
    """A frame and its copy from farther away: the line through the cameras pierces the object."""
    R, t = poses(scene)
    outline = frontier_points.outlines(scene.capture)[torch.tensor([3, 3])]
    far = (R[[3, 3]], torch.stack([t[3], t[3] * 1.2]))
    pairs = torch.tensor([[0, 1]])
    assert frontier_points.frontier(*far, scene.capture.camera, outline, radius=RADIUS, pairs=pairs).n == 0


def test_outlines_that_a_hand_or_the_border_cuts_are_not_sure(scene: Tumble) -> None:
    masks = scene.capture.masks[:2].clone()
    columns = torch.nonzero(masks[0])[:, 1]
    masks[0, :, int(columns.float().mean()) :] = torch.where(
        masks[0, :, int(columns.float().mean()) :] != BACKGROUND, UNKNOWN, BACKGROUND
    ).to(torch.uint8)
    masks[1] = 0
    masks[1, 40:60, 100:] = 255
    capture = Capture(scene.capture.images[:2], masks, scene.capture.camera, ("a", "b"), "camera")
    found = frontier_points.outlines(capture)
    assert found.sure[0].any()
    assert not found.sure[0][found.corners[0, :, 0] > columns.float().mean() - 1].any()
    assert not found.sure[1][found.corners[1, :, 0] > 126].any()
    assert found.sure[1][found.corners[1, :, 0] < 101].all()


def test_a_band_along_the_silhouette_hides_nothing(scene: Tumble) -> None:
    """Masks of films have one, half inside: divided again, they are the true ones but for the sharpest corners."""
    true = scene.capture.masks[:6]
    banded = torch.stack([torch.from_numpy(three_valued(m.numpy() == OBJECT, m.numpy() < 0, 1)) for m in true])
    assert not frontier_points.outlines(replace(scene.capture.select(list(range(6))), masks=banded)).sure.any()
    found = frontier_points.divided(banded)
    assert (found != UNKNOWN).all()
    assert float((found != true).float().sum() / (true == OBJECT).sum()) < 0.002


def test_what_a_hand_hides_stays_unknown(scene: Tumble) -> None:
    """Twelve pixels wide, from the border of the picture to the middle of the object, which ends in a band."""
    mask = scene.capture.masks[0].numpy()
    rows, columns = (int(x.mean()) for x in np.nonzero(mask))
    hand = np.zeros(mask.shape, bool)
    hand[rows:, columns - 6 : columns + 6] = True
    labels = three_valued((mask == OBJECT) & ~hand, hand, 1)
    kept = frontier_points.divided(torch.from_numpy(labels)[None])[0].numpy()
    # But for two pixels beside the band, where the three meet.
    assert (kept[hand] == UNKNOWN).mean() > 0.97
    assert (kept[~hand] == mask[~hand]).mean() > 0.99


def test_an_empty_mask_has_no_outline(scene: Tumble) -> None:
    empty = Capture(
        scene.capture.images[:1],
        torch.zeros_like(scene.capture.masks[:1]),
        scene.capture.camera,
        ("a",),
        "camera",
    )
    assert not frontier_points.outlines(empty).sure.any()


def test_a_frame_that_lost_its_way_is_found_again(scene: Tumble) -> None:
    """20 degrees off, tried from its neighbour's pose. One smooth outline tells but a few degrees."""
    R, t = (x.clone() for x in poses(scene))
    t = t / DISTANCE  # the unit of stage 1
    outline = frontier_points.outlines(scene.capture)
    others = torch.tensor([k for k in range(24) if k != 10])
    own = Outlines(outline.corners[10:11], outline.sure[10:11])
    judge = relocalization.Judge((R[others], t[others]), own, outline[others], scene.capture.camera, RADIUS / DISTANCE)
    lost = SO3.exp(torch.tensor([0.25, -0.25, 0.0], dtype=torch.float64)).matrix() @ R[10]
    tried = torch.cat([lost[None], relocalization.hypotheses() @ R[9]])
    (found, _), price = relocalization.relocate(judge, tried, t[10].expand(len(tried), 3), scale=0.7)
    assert SO3.from_matrix(found @ R[10].T).angle().rad2deg() < 5
    assert price < relocalization.cost(judge.gaps(lost[None], t[10:11]), 0.7)[0]
