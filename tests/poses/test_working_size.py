"""A capture with a planted hand, enlarged: poses see it smaller, and what they change in its masks comes back."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.poses.test_background_removal import PRINT, film, result
from tumble import pipeline, recipes
from tumble.engine import run as runs
from tumble.maths import SE3
from tumble.poses import sfm, working_size
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Capture

FACTOR = 4


def enlarged(x: Tensor) -> Tensor:
    return x.repeat_interleave(FACTOR, 1).repeat_interleave(FACTOR, 2)


@pytest.fixture(scope="module")
def scene() -> tuple[Capture, Capture, SE3]:
    """The film of an ellipsoid before a wall that is unknown to the right of its centre, that at four times its size,
    and its poses."""
    capture, objects, T_cam_obj = film(PRINT)
    masks = capture.masks.clone()
    for mask, inside in zip(masks, objects, strict=True):
        middle = int(torch.nonzero(inside)[:, 1].float().mean())
        mask[:, middle:][~inside[:, middle:] & (mask[:, middle:] == BACKGROUND)] = UNKNOWN
    capture = replace(capture, masks=masks, images=torch.where((masks != BACKGROUND)[..., None], full_of(capture), 0))
    h, w = (FACTOR * side for side in masks.shape[1:])
    large = Capture(
        enlarged(capture.images),
        enlarged(masks),
        capture.camera.resized(h, w),
        capture.names,
        "camera",
        full_images=enlarged(full_of(capture)),
    )
    return capture, large, T_cam_obj


def full_of(capture: Capture) -> Tensor:
    assert capture.full_images is not None
    return capture.full_images


def test_poses_of_a_hidden_object_are_estimated_from_smaller_images(scene: tuple[Capture, Capture, SE3]) -> None:
    capture, large, _ = scene
    small = working_size.reduced(large)
    assert max(small.camera.height, small.camera.width) == working_size.SIDE
    scale = working_size.SIDE / large.camera.width
    assert torch.allclose(small.camera.fx_fy_cx_cy, scale * large.camera.fx_fy_cx_cy)
    row, column = torch.meshgrid(*(torch.arange(working_size.SIDE) for _ in range(2)), indexing="ij")
    at = tuple(((x + 0.5) / scale / FACTOR).long() for x in (row, column))
    assert (small.masks == capture.masks[:, at[0], at[1]]).float().mean() > 0.99
    assert not small.images[small.masks == BACKGROUND].any()
    shown = small.masks != BACKGROUND
    assert torch.equal(small.images[shown], full_of(small)[shown])
    difference = (full_of(small).int() - full_of(capture)[:, at[0], at[1]].int()).abs().float()
    assert difference.median() <= 2


def test_other_captures_stay_as_they_are(scene: tuple[Capture, Capture, SE3]) -> None:
    capture, large, _ = scene
    assert working_size.reduced(capture) is capture, "it is small"
    masks = torch.where(large.masks == OBJECT, large.masks, torch.zeros_like(large.masks))
    alone = replace(large, masks=masks)
    assert working_size.reduced(alone) is alone, "nothing hides the object"


def test_doubted_background_is_still_known_in_smaller_images(scene: tuple[Capture, Capture, SE3]) -> None:
    """It is unknown, and black in images of a photo that is not."""
    _, large, _ = scene
    above = torch.zeros_like(large.masks, dtype=torch.bool)
    above[:, : large.camera.height // 8] = True
    doubted = replace(large, masks=large.masks.masked_fill(above & (large.masks == BACKGROUND), UNKNOWN))
    small, same = working_size.reduced(doubted), working_size.reduced(large)
    assert (small.masks != same.masks).float().mean() > 0.05
    settled = sfm.without_doubt(small)
    assert torch.equal(settled.masks, same.masks)
    assert torch.equal(settled.images, same.images)
    own = replace(small, full_images=None)
    assert torch.equal(sfm.without_doubt(own).masks, small.masks), "masks of the user's own"


def test_only_changes_of_the_masks_come_back(scene: tuple[Capture, Capture, SE3]) -> None:
    _, large, _ = scene
    large = replace(large, masks=large.masks.clone())
    large.masks[:, 5, 7] = OBJECT  # a detail that smaller images do not show
    small = working_size.reduced(large)
    masks = small.masks.clone()
    masks[3, 64:128, 64:128] = BACKGROUND
    masked = working_size.with_masks(large, small, replace(small, masks=masks))
    block = torch.zeros(large.masks.shape, dtype=torch.bool)
    block[3, 96:192, 96:192] = True
    assert torch.equal(masked.masks[~block], large.masks[~block])
    assert (large.masks[block] != BACKGROUND).float().mean() > 0.5
    assert (masked.masks[block] != BACKGROUND).float().mean() < 0.01, (
        "only where the smaller mask was background before"
    )
    assert not masked.images[masked.masks == BACKGROUND].any()
    assert torch.equal(masked.images[masked.masks != BACKGROUND], large.images[masked.masks != BACKGROUND])


def test_stage_1_sees_the_smaller_images_and_later_stages_the_capture(
    scene: tuple[Capture, Capture, SE3], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, large, T_cam_obj = scene
    seen = []

    def track(_: object, capture: Capture, *__: object) -> tuple[object, str]:
        seen.append((capture.camera.height, capture.camera.width))
        return result(capture.camera, T_cam_obj), "key"

    monkeypatch.setattr(pipeline, "_track", track)
    opened = runs.Run(None, recipes.SMOKE, None)
    tracked, cut, key = pipeline._poses_of(opened, large, Path("film"), "content", "cpu")
    assert set(seen) == {(working_size.SIDE, working_size.SIDE)}
    assert torch.equal(tracked.camera.fx_fy_cx_cy, large.camera.fx_fy_cx_cy), "a focal length that nobody estimated"
    assert (cut.camera.height, cut.camera.width) == (large.camera.height, large.camera.width)
    zoomed = replace(tracked, camera=working_size.reduced(large).camera.zoomed(1.25))
    focal = working_size.enlarged(zoomed, large, working_size.reduced(large)).camera.fx_fy_cx_cy[0]
    assert float(focal) == pytest.approx(1.25 * float(large.camera.fx_fy_cx_cy[0])), "an estimated one"
    assert key == "", "stage 1 has not seen these images"
    assert (cut.masks != large.masks).any(), "a piece of the wall that counted as object is gone"
