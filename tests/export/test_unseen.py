"""What no frame shows of a mesh, and the surface that spans it, on a ball that turns once about y."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.export.test_bake import painted
from tests.export.test_mesh import CELL, assert_closed, grid, marched
from tests.lopsided import first_hits
from tests.surfaces import sphere
from tumble.export import mesh, unseen
from tumble.maths import SE3, SO3
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Asset, Camera, Capture, Trajectory

RADIUS, N, SIZE = 0.7, 24, 96


@pytest.fixture(scope="module")
def asset() -> Asset:
    turns = torch.arange(N) * (2 * math.pi / N)
    rotations = SO3.exp(torch.stack([0 * turns, turns, 0 * turns], -1))
    trajectory = Trajectory(SE3(rotations.wxyz, torch.tensor([0.0, 0.0, 4.0]).expand(N, 3)), "camera")
    camera = Camera.from_fov(math.radians(30), SIZE, SIZE)
    return replace(painted(sphere(4000, radius=RADIUS)), trajectory=trajectory, camera=camera)


@pytest.fixture(scope="module")
def capture(asset: Asset) -> Capture:
    """A hand hides all of the ball with x above 0.35 in its frame, whenever it is in front."""
    masks = []
    for i in range(N):
        T_obj_cam = asset.trajectory.T_cam_obj[i].inverse()
        hit, inside = first_hits(T_obj_cam.xyz, T_obj_cam.rotation @ asset.camera.directions(), RADIUS)
        label = torch.where(hit[..., 0] > 0.35, UNKNOWN, OBJECT)
        masks.append(torch.where(inside, label, BACKGROUND).to(torch.uint8))
    images = torch.zeros(N, SIZE, SIZE, 3, dtype=torch.uint8)
    return Capture(images, torch.stack(masks), asset.camera, tuple(map(str, range(N))), "camera")


def test_a_cap_that_was_not_seen_becomes_a_disc() -> None:
    """The smallest surface in a circle is flat; the rest stays, and so does a second ball that nobody saw."""
    ball, other = (np.linalg.norm(grid() - (0, 0, z), axis=-1) - radius for z, radius in ((-0.4, 0.5), (0.75, 0.25)))
    whole = marched(np.minimum(ball, other))
    z, height = whole.vertices[:, 2], -0.2
    result = unseen.spanned(whole, z < height)
    assert_closed(result)
    moved = np.abs(result.vertices - whole.vertices).max(1)
    assert moved[(z < height - 2 * CELL) | (z > 0.4)].max() == 0
    cap = (z > height + 2 * CELL) & (z < 0.4)
    assert np.abs(result.vertices[cap, 2] - height).max() < CELL
    assert moved[cap].max() > 0.2


def test_what_a_hand_or_the_view_hides_was_not_seen(asset: Asset, capture: Capture) -> None:
    shape = mesh.smooth(marched(np.linalg.norm(grid(), axis=-1) - RADIUS))
    seen = unseen.seen_vertices(shape, asset, capture)
    x, y, _ = shape.vertices.T
    assert not seen[x > 0.42].any()
    assert not seen[np.abs(y) > 0.99 * RADIUS].any()
    assert seen[(x < 0.28) & (np.abs(y) < 0.6)].mean() > 0.99


@pytest.mark.parametrize(("shown", "hidden", "seen"), [(2, 0, True), (1, 0, False), (4, 40, True), (3, 40, False)])
def test_a_few_masks_may_be_wrong_where_a_hand_is_most_of_the_time(shown: int, hidden: int, seen: bool) -> None:
    labels = [OBJECT] * shown + [UNKNOWN] * hidden + [BACKGROUND] * 5
    assert unseen.enough_show(1, (np.array([label]) for label in labels)).tolist() == [seen]


def test_a_mesh_of_which_all_was_seen_stays(asset: Asset, capture: Capture) -> None:
    """The poles, which no frame shows well, are the only difference."""
    shape = mesh.smooth(marched(np.linalg.norm(grid(), axis=-1) - RADIUS))
    shown = replace(capture, masks=torch.where(capture.masks == UNKNOWN, OBJECT, capture.masks))
    result = unseen.spanned(shape, unseen.seen_regions(shape, asset, shown))
    moved = np.abs(result.vertices - shape.vertices).max(1)
    assert moved[np.abs(shape.vertices[:, 1]) < 0.9 * RADIUS].max() == 0
