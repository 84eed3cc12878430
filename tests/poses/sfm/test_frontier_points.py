"""Epipolar tangency of the contours of an asymmetric ellipsoid, for true and for wrong poses."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.lopsided import DISTANCE, Tumble, tumbling
from tumble.maths.se3 import SE3, SO3
from tumble.poses.sfm import frontier_points, relocalization
from tumble.poses.sfm.frontier_points import Contours
from tumble.preprocess.segmentation import make_trimap
from tumble.scene.camera import Camera
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
    contours = frontier_points.convex_contours(scene.capture)
    tangencies = frontier_points.epipolar_tangencies(
        (R[i], t[i]), (R[j], t[j]), contours[i], contours[j], scene.capture.camera, radius=RADIUS
    )
    # `epipolar_tangencies` expects lengths in units of the object's mean distance; gaps are proportional to length.
    return tangencies.gap[tangencies.valid].abs() / DISTANCE


def test_gaps_vanish_for_true_poses(scene: Tumble) -> None:
    """Vertices are centres of object pixels: both contours lie a similar fraction of a pixel inside the true ones."""
    gap = gaps(scene, *poses(scene))
    assert len(gap) > 200
    assert gap.median() < 0.25
    assert gap.quantile(0.95) < 0.8


def test_a_wrong_rotation_increases_the_gaps(scene: Tumble) -> None:
    R, t = poses(scene)
    wrong = R.clone()
    wrong[5] = SO3.exp(torch.tensor([0.0, 0.15, 0.1], dtype=torch.float64)).matrix() @ R[5]
    contours = frontier_points.convex_contours(scene.capture)
    others = torch.tensor([k for k in range(24) if k != 5])
    constraints = relocalization.ContourConstraints(
        (R[others], t[others]), contours[torch.tensor([5])], contours[others], scene.capture.camera, RADIUS
    )
    gap_true, gap_wrong = constraints.gaps(torch.stack([R[5], wrong[5]]), t[[5, 5]]).abs().nanmedian(1).values
    assert gap_wrong > 3 * gap_true


def dumbbell_in_a_hand(scene: Tumble) -> Capture:
    """A large and a small ball on a stick; in every other frame a hand hides all of the large one."""
    camera = scene.capture.camera
    rows, columns = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    pixels = torch.stack([columns, rows], -1) + 0.5

    def disc(pose: SE3, centre: tuple[float, float, float], radius: float) -> torch.Tensor:
        x = pose @ torch.tensor(centre, dtype=torch.float64)
        return (pixels - camera.project(x)).norm(dim=-1) < radius * float(camera.fx_fy_cx_cy[0] / x[2])

    masks = torch.zeros_like(scene.capture.masks)
    for k, mask in enumerate(masks):
        pose = scene.T_cam_obj[k]
        for x, radius in ((-0.45, 0.2), (-0.25, 0.06), (-0.15, 0.06), (0.25, 0.45)):
            mask[disc(pose, (x, 0.0, 0.0), radius)] = OBJECT
        if k % 2:
            mask[disc(pose, (0.25, 0.0, 0.0), 0.48)] = UNKNOWN
    return replace(scene.capture, masks=masks)


def test_tangents_beyond_which_a_hand_may_hide_the_object_do_not_count(scene: Tumble) -> None:
    """The small ball has extremes in all directions, most of which the large one exceeds."""
    R, t = poses(scene)
    contours = frontier_points.convex_contours(dumbbell_in_a_hand(scene))
    i, j = all_pairs(24).T

    def tangencies(R: torch.Tensor, contours: Contours) -> frontier_points.EpipolarTangencies:
        camera = scene.capture.camera
        return frontier_points.epipolar_tangencies(
            (R[i], t[i]), (R[j], t[j]), contours[i], contours[j], camera, radius=RADIUS
        )

    naive, found = tangencies(R, replace(contours, outer=None)), tangencies(R, contours)
    assert naive.gap[naive.valid].abs().max() / DISTANCE > 20
    assert found.valid.sum() > 200
    assert found.gap[found.valid].abs().max() / DISTANCE < 1
    assert found.conflict.nan_to_num().abs().max() / DISTANCE < 1
    turned = R.clone()
    turned[5] = SO3.exp(torch.tensor([0.0, 0.5, 0.3], dtype=torch.float64)).matrix() @ R[5]
    conflict = tangencies(turned, contours).conflict[(i == 5) | (j == 5)]
    assert conflict.nan_to_num().abs().max() / DISTANCE > 3


def test_the_border_of_the_image_may_hide_the_object(scene: Tumble) -> None:
    """In every other frame a window cuts off all that is left of the object's middle."""
    R, t = poses(scene)
    masks = scene.capture.masks.clone()
    for mask in masks[1::2]:
        middle = int(torch.nonzero(mask)[:, 1].float().mean())
        mask[:, : mask.shape[1] - middle] = mask[:, middle:].clone()
        mask[:, mask.shape[1] - middle :] = BACKGROUND
    shifted = [int(torch.nonzero(mask)[:, 1].float().mean()) for mask in scene.capture.masks]
    contours = frontier_points.convex_contours(replace(scene.capture, masks=masks))
    assert contours.outer is not None
    for k in range(1, 24, 2):  # back to where the object is: contours are those of the whole image again
        contours.vertices[k, :, 0] += shifted[k]
        contours.outer[k, :, 0] += shifted[k]
    i, j = all_pairs(24).T
    camera = scene.capture.camera
    found = frontier_points.epipolar_tangencies(
        (R[i], t[i]), (R[j], t[j]), contours[i], contours[j], camera, radius=RADIUS
    )
    assert found.valid.sum() > 100
    assert found.gap[found.valid].abs().max() / DISTANCE < 2
    assert found.conflict.nan_to_num().abs().max() / DISTANCE < 2


def test_frontier_points_lie_on_both_contours(scene: Tumble) -> None:
    """Each is a track of two observations, at object pixels next to the background."""
    R, t = poses(scene)
    contours = frontier_points.convex_contours(scene.capture)
    tracks = frontier_points.frontier_tracks(R, t, scene.capture.camera, contours, radius=RADIUS, pairs=all_pairs(24))
    assert (torch.bincount(tracks.point) == 2).all()
    assert len(tracks) == 2 * tracks.n
    row, column = (tracks.uv.floor().long()[:, k] for k in (1, 0))
    masks = scene.capture.masks[tracks.frame]
    index = torch.arange(len(masks))
    assert (masks[index, row, column] != BACKGROUND).all()
    around = torch.stack([masks[index, row + dy, column + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)], 1)
    assert (around == BACKGROUND).any(1).all()


def test_a_baseline_that_pierces_the_object_has_no_frontier_points(scene: Tumble) -> None:
    """The same view from two distances."""
    R, t = poses(scene)
    contours = frontier_points.convex_contours(scene.capture)[torch.tensor([3, 3])]
    far = (R[[3, 3]], torch.stack([t[3], t[3] * 1.2]))
    pairs = torch.tensor([[0, 1]])
    assert frontier_points.frontier_tracks(*far, scene.capture.camera, contours, radius=RADIUS, pairs=pairs).n == 0


def test_vertices_at_a_hand_or_the_image_border_are_unreliable(scene: Tumble) -> None:
    masks = scene.capture.masks[:2].clone()
    columns = torch.nonzero(masks[0])[:, 1]
    masks[0, :, int(columns.float().mean()) :] = torch.where(
        masks[0, :, int(columns.float().mean()) :] != BACKGROUND, UNKNOWN, BACKGROUND
    ).to(torch.uint8)
    masks[1] = 0
    masks[1, 40:60, 100:] = 255
    capture = Capture(scene.capture.images[:2], masks, scene.capture.camera, ("a", "b"), "camera")
    contours = frontier_points.convex_contours(capture)
    assert contours.reliable[0].any()
    assert not contours.reliable[0][contours.vertices[0, :, 0] > columns.float().mean() - 1].any()
    assert not contours.reliable[1][contours.vertices[1, :, 0] > 126].any()
    assert contours.reliable[1][contours.vertices[1, :, 0] < 101].all()


def test_bands_along_silhouettes_are_filled(scene: Tumble) -> None:
    """Masks of videos have bands, half of them inside the object; filled masks differ from the true ones at corners."""
    true = scene.capture.masks[:6]
    banded = torch.stack([torch.from_numpy(make_trimap(m.numpy() == OBJECT, m.numpy() < 0, 1)) for m in true])
    assert not frontier_points.convex_contours(
        replace(scene.capture.select(list(range(6))), masks=banded)
    ).reliable.any()
    filled = frontier_points.fill_boundary_bands(banded)
    assert (filled != UNKNOWN).all()
    assert float((filled != true).float().sum() / (true == OBJECT).sum()) < 0.002


def test_pixels_occluded_by_a_hand_stay_unknown(scene: Tumble) -> None:
    """The hand is 12 pixels wide and reaches from the image border to the middle of the object, which has a band."""
    mask = scene.capture.masks[0].numpy()
    rows, columns = (int(x.mean()) for x in np.nonzero(mask))
    hand = np.zeros(mask.shape, bool)
    hand[rows:, columns - 6 : columns + 6] = True
    labels = make_trimap((mask == OBJECT) & ~hand, hand, 1)
    filled = frontier_points.fill_boundary_bands(torch.from_numpy(labels)[None])[0].numpy()
    # Except two pixels beside the band, where object, background and hand meet.
    assert (filled[hand] == UNKNOWN).mean() > 0.97
    assert (filled[~hand] == mask[~hand]).mean() > 0.99


def test_contours_move_to_the_edges_of_the_photo() -> None:
    """A bright ellipse before two walls, of which the right one has its colour; its mask is 2 pixels off.

    So only vertices at the left wall are at edges, and lie on the ellipse.
    """
    centre, axes, scale = np.array([47.3, 60.6]), np.array([22.0, 37.0]), 8
    row, column = np.mgrid[: 120 * scale, : 100 * scale]
    xy = (np.stack([column, row], -1) + 0.5) / scale
    inside = np.linalg.norm((xy - centre) / axes, axis=-1) < 1
    large = np.where(inside | (xy[..., 0] > 47), 200, 90)
    photo = large.reshape(120, scale, 100, scale).mean((1, 3)).astype(np.uint8)
    mask = inside.reshape(120, scale, 100, scale).mean((1, 3)) > 0.5
    mask = np.roll(mask, (1, -2), (0, 1))
    photos = torch.from_numpy(photo)[None, :, :, None].repeat(1, 1, 1, 3)
    camera = Camera(torch.tensor([100.0, 100.0, 50.0, 60.0]), 120, 100)
    masks = torch.from_numpy(np.where(mask, OBJECT, BACKGROUND).astype(np.uint8))[None]
    capture = Capture(photos, masks, camera, ("a",), "camera", full_images=photos)

    def distance(contours: Contours, chosen: torch.Tensor) -> np.ndarray:
        """Of the vertices from the ellipse, about [pixels]."""
        offset = (contours.vertices[chosen].numpy() - centre) / axes
        return np.abs(np.linalg.norm(offset, axis=1) - 1) * axes.min()

    before = frontier_points.convex_contours(replace(capture, full_images=None))
    after = frontier_points.convex_contours(capture)
    left = before.vertices[..., 0] < 40
    assert after.reliable[left].all()
    assert not after.reliable[before.vertices[..., 0] > 52].any()
    assert np.median(distance(before, left)) > 1
    assert distance(after, left).max() < 0.5


def test_small_parts_away_from_the_object_are_unknown() -> None:
    """The second part, a sixth of the first, stays; the scrap is not; an empty mask stays empty."""
    masks = torch.zeros(2, 40, 60, dtype=torch.uint8)
    masks[0, 5:25, 5:35], masks[0, 5:15, 40:50], masks[0, 35:38, 50:55] = OBJECT, OBJECT, OBJECT
    found = frontier_points.without_scraps(masks)
    expected = masks.clone()
    expected[0, 35:38, 50:55] = UNKNOWN
    assert torch.equal(found, expected)
    assert (masks != UNKNOWN).all()


def test_an_empty_mask_has_no_reliable_vertex(scene: Tumble) -> None:
    empty = Capture(
        scene.capture.images[:1],
        torch.zeros_like(scene.capture.masks[:1]),
        scene.capture.camera,
        ("a",),
        "camera",
    )
    assert not frontier_points.convex_contours(empty).reliable.any()


def test_a_wrong_pose_is_relocalized(scene: Tumble) -> None:
    """The pose is off by 20 degrees; a single smooth contour determines the rotation to a few degrees."""
    R, t = (x.clone() for x in poses(scene))
    t = t / DISTANCE  # the unit of stage 1
    contours = frontier_points.convex_contours(scene.capture)
    others = torch.tensor([k for k in range(24) if k != 10])
    own = Contours(contours.vertices[10:11], contours.reliable[10:11])
    constraints = relocalization.ContourConstraints(
        (R[others], t[others]), own, contours[others], scene.capture.camera, RADIUS / DISTANCE
    )
    lost = SO3.exp(torch.tensor([0.25, -0.25, 0.0], dtype=torch.float64)).matrix() @ R[10]
    candidates = torch.cat([lost[None], relocalization.candidate_rotations() @ R[9]])
    (R_found, _), cost = relocalization.relocalize(constraints, candidates, t[10].expand(len(candidates), 3), scale=0.7)
    assert SO3.from_matrix(R_found @ R[10].T).angle().rad2deg() < 5
    assert cost < relocalization.robust_cost(constraints.gaps(lost[None], t[10:11]), 0.7)[0]
