"""A print on an ellipsoid before a wall: the wall leaves the masks, and nothing of the object does."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.lopsided import AXES, tumbling
from tumble.maths import SE3
from tumble.poses import PoseQuality, PoseResult, background_removal
from tumble.poses.result import Observability
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Camera, Capture, Trajectory, content_key

N, SIZE, HELD = 24, 96, (7, 8)
WALL = torch.tensor([150, 120, 100])
PRINT = (200, 30, 30), (230, 200, 60)
ONE_COLOUR = (200, 30, 30), (200, 30, 30)


def film(colours: tuple[tuple[int, ...], tuple[int, ...]], wall: Tensor = WALL) -> tuple[Capture, Tensor, SE3]:
    """The capture of an ellipsoid with stripes of two colours, its true masks, and its poses.

    On the frames `HELD` the masks also contain a piece of the wall beside the object, within an unknown band.
    """
    base = tumbling(N, size=SIZE, points=10)
    camera, T_cam_obj = base.capture.camera, base.T_cam_obj
    rng = torch.Generator().manual_seed(0)
    inside, photos = [], []
    for i in range(N):
        T = T_cam_obj[i].inverse()
        hit, place = intersection(T.xyz, T.rotation @ camera.directions().double())
        stripe = ((place @ torch.tensor([6.0, 4.0, 5.0], dtype=torch.float64)).sin() > 0)[..., None]
        shown = torch.where(stripe, torch.tensor(colours[0]), torch.tensor(colours[1]))
        photo = torch.where(hit[..., None], shown, wall) + 2 * torch.randn(SIZE, SIZE, 3, generator=rng)
        inside.append(hit)
        photos.append(photo.clamp(0, 255).to(torch.uint8))
    objects, full = torch.stack(inside), torch.stack(photos)
    masks = torch.where(objects, OBJECT, BACKGROUND).to(torch.uint8)
    for i in HELD:
        row, column = torch.nonzero(objects[i]).float().mean(0).round().long().tolist()
        right = int(torch.nonzero(objects[i][row])[-1])
        piece = slice(row - 12, row + 12), slice(column, right + 12)
        masks[i][piece][~objects[i][piece]] = OBJECT
        masks[i, row - 12 : row + 12, right + 12 : right + 14] = UNKNOWN
    images = torch.where((masks == BACKGROUND)[..., None], torch.zeros_like(full), full)
    capture = Capture(images, masks, camera, base.capture.names, "camera", full_images=full)
    return capture, objects, T_cam_obj


def intersection(origin: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Whether rays meet the ellipsoid, and where, object frame."""
    o, d = origin / AXES, directions / AXES
    a, b, c = (d * d).sum(-1), (d * o).sum(-1), (o * o).sum() - 1
    root = b * b - a * c
    distance = (-b - root.clamp_min(0).sqrt()) / a
    return root > 0, origin + distance[..., None] * directions


def result(camera: Camera, T_cam_obj: SE3, lost: tuple[int, ...] = (), uncertainty: float = 0.01) -> PoseResult:
    """Poses with quality as stage 1 would state it."""
    n = len(T_cam_obj.xyz)
    flags = torch.zeros(n, dtype=torch.bool)
    flags[list(lost)] = True
    observability = Observability(torch.tensor([0.0, 1.0, 0.0]), torch.full((3,), 0.01))
    ones = torch.ones(n)
    overlap, step = 0.95 * ones, torch.tensor(3.0)
    quality = PoseQuality(ones, 50 * ones, ones, overlap, uncertainty * ones, flags, step, observability)
    trajectory = Trajectory(SE3(T_cam_obj.wxyz.float(), T_cam_obj.xyz.float()), "camera")
    return PoseResult(trajectory, torch.zeros(0, 3), torch.zeros(0, 3), quality, camera)


@pytest.fixture(scope="module")
def held() -> tuple[Capture, Tensor, SE3]:
    return film(PRINT)


def test_the_wall_beside_the_object_becomes_background(held: tuple[Capture, Tensor, SE3]) -> None:
    capture, objects, T_cam_obj = held
    cut = background_removal.remove_background(capture, result(capture.camera, T_cam_obj))
    wall = (capture.masks == OBJECT) & ~objects
    assert wall.sum() > 200
    assert (cut.masks[wall] == BACKGROUND).float().mean() > 0.75
    assert (cut.masks[objects] == BACKGROUND).float().mean() < 0.002
    assert not cut.images[cut.masks == BACKGROUND].any()
    assert cut.full_images is None


MISTAKEN = (2, 9, 17)
"""Frames whose masks take the hand for the object."""


def test_a_hand_that_keeps_its_place_becomes_background() -> None:
    """A ball on the object that is unknown in most frames, although many show the object before it."""
    capture, objects, T_cam_obj = film(PRINT)
    rays, radius = capture.camera.directions().double(), 0.3
    middle = T_cam_obj @ torch.tensor([0.0, float(AXES[1]) + 2 * radius, 0.0], dtype=torch.float64)
    along = (rays * middle[:, None, None]).sum(-1) / (rays * rays).sum(-1)
    ball = (along[..., None] * rays - middle[:, None, None]).norm(dim=-1) < radius
    # Behind the object, the ball is hidden.
    ball &= ~objects | (T_cam_obj.xyz[:, 2] > middle[:, 2])[:, None, None]
    masks = torch.where(objects, OBJECT, BACKGROUND).to(torch.uint8)
    masks[ball] = UNKNOWN
    for i in MISTAKEN:
        masks[i][ball[i]] = OBJECT
    cut = background_removal.remove_background(replace(capture, masks=masks), result(capture.camera, T_cam_obj))
    assert not (cut.masks[objects] == BACKGROUND).any()
    beside = ball & ~objects
    mistaken = beside[list(MISTAKEN)]
    assert beside.sum() > 1000
    assert mistaken.sum() > 100
    assert (cut.masks[beside] == BACKGROUND).float().mean() > 0.6
    assert (cut.masks[list(MISTAKEN)][mistaken] == BACKGROUND).float().mean() > 0.6


def test_an_object_that_is_hidden_in_most_frames_is_not_taken_for_a_hand(held: tuple[Capture, Tensor, SE3]) -> None:
    capture, objects, T_cam_obj = held
    shown = torch.rand(objects.shape, generator=torch.Generator().manual_seed(0)) < 0.05
    masks = torch.where(objects, UNKNOWN, BACKGROUND).to(torch.uint8)
    masks[objects & shown] = OBJECT
    cut = background_removal.remove_background(replace(capture, masks=masks), result(capture.camera, T_cam_obj))
    assert not (cut.masks[objects] == BACKGROUND).any()


@pytest.mark.parametrize("colours", [PRINT, ONE_COLOUR])
def test_poses_with_errors_remove_nothing_of_the_object(colours: tuple[tuple[int, ...], tuple[int, ...]]) -> None:
    capture, objects, T_cam_obj = film(colours)
    rng = torch.Generator().manual_seed(1)
    turn = SE3.exp(torch.cat([torch.zeros(N, 3), 0.05 * torch.randn(N, 3, generator=rng)], -1).double())
    cut = background_removal.remove_background(capture, result(capture.camera, T_cam_obj @ turn))
    assert (cut.masks[objects] == BACKGROUND).float().mean() < 0.002


def test_a_wall_of_the_objects_colour_takes_nothing_of_the_object() -> None:
    capture, objects, T_cam_obj = film(ONE_COLOUR, torch.tensor(ONE_COLOUR[0]))
    cut = background_removal.remove_background(capture, result(capture.camera, T_cam_obj))
    assert not (cut.masks[objects] == BACKGROUND).any()


def test_frames_without_pose_and_bad_poses_keep_their_masks(held: tuple[Capture, Tensor, SE3]) -> None:
    capture, _, T_cam_obj = held
    cut = background_removal.remove_background(capture, result(capture.camera, T_cam_obj, lost=HELD))
    assert torch.equal(cut.masks[list(HELD)], capture.masks[list(HELD)])
    bad = result(capture.camera, T_cam_obj, uncertainty=1.0)
    assert bad.quality.rating == "bad"
    assert torch.equal(background_removal.remove_background(capture, bad).masks, capture.masks)


def test_a_capture_without_full_images_is_unchanged(held: tuple[Capture, Tensor, SE3]) -> None:
    """Captures of films without hands have none, so nothing about them changes."""
    capture = replace(held[0], full_images=None)
    cut = background_removal.remove_background(capture, result(capture.camera, held[2]))
    assert content_key(cut) == content_key(capture)
