"""Masks with a planted arm: it goes, and nothing of the object does."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from tests.lopsided import Tumble, truth, tumbling
from tumble.engine import run
from tumble.io import tree
from tumble.poses import PoseQuality, PoseResult, mask_refinement
from tumble.poses.result import Observability
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN, Capture

N, HELD = 24, 6


@pytest.fixture(scope="module")
def scene() -> Tumble:
    return tumbling(N, size=96, points=10)


def with_arm(capture: Capture) -> tuple[Capture, Tensor]:
    """A bar from the object to the right border, labelled object on the first frames, and its pixels."""
    masks, arm = capture.masks.clone(), torch.zeros(capture.masks.shape, dtype=torch.bool)
    arm[:HELD, 42:54, 48:] = True
    arm &= masks == BACKGROUND
    masks[arm] = OBJECT
    masks[:, :3, :3] = UNKNOWN
    return replace(capture, masks=masks), arm


def result(scene: Tumble, overlap: float = 0.9, lost: int = 0) -> PoseResult:
    """The true poses, with quality as stage 1 would state it."""
    ones, flags = torch.ones(N), torch.arange(N) < lost
    observability = Observability(torch.tensor([0.0, 1.0, 0.0]), torch.full((3,), 0.01))
    quality = PoseQuality(ones, 50 * ones, ones, overlap * ones, 0.01 * ones, flags, torch.tensor(3.0), observability)
    return PoseResult(truth(scene), torch.zeros(0, 3), torch.zeros(0, 3), quality, scene.capture.camera)


def test_an_arm_that_others_frames_do_not_show_becomes_background(scene: Tumble) -> None:
    capture, arm = with_arm(scene.capture)
    trimmed = mask_refinement.trim_masks(capture, result(scene))
    assert (trimmed.masks[arm] == BACKGROUND).float().mean() > 0.8
    assert (trimmed.masks[arm] == OBJECT).float().mean() < 0.1
    inside = scene.capture.masks == OBJECT
    assert not (trimmed.masks[inside] == BACKGROUND).any()
    assert (trimmed.masks[inside] == OBJECT).float().mean() > 0.97
    assert not trimmed.images[trimmed.masks == BACKGROUND].any()


def test_more_matches_outweigh_a_lost_frame_but_not_many_nor_a_rating(scene: Tumble) -> None:
    old, new = (result(scene, overlap=0.93, lost=lost) for lost in (1, 2))
    more = replace(new, quality=replace(new.quality, inliers=60 * torch.ones(N)))
    assert mask_refinement.explains_more(more, old)
    assert not mask_refinement.explains_more(new, old), "fewer frames with as many matches each"
    fewer = result(scene, overlap=0.93, lost=1 + N // 10)
    fewer = replace(fewer, quality=replace(fewer.quality, inliers=60 * torch.ones(N)))
    assert fewer.quality.rating == old.quality.rating
    assert not mask_refinement.explains_more(fewer, old), "a tenth of the frames fewer"
    assert mask_refinement.explains_more(old, fewer)
    contradicting = replace(more, quality=replace(more.quality, overlap=0.8 * torch.ones(N)))
    assert contradicting.quality.rating == "bad"
    assert not mask_refinement.explains_more(contradicting, old)


def test_few_accurate_poses_outweigh_more_that_are_inconsistent_if_these_are_not_many_more(scene: Tumble) -> None:
    few, fewer = (result(scene, overlap=0.93, lost=lost) for lost in (14, 20))
    inconsistent = result(scene, overlap=0.8, lost=8)
    assert {each.quality.rating for each in (few, fewer, inconsistent)} == {"bad"}
    assert mask_refinement.explains_more(few, inconsistent)
    assert not mask_refinement.explains_more(inconsistent, few)
    assert not mask_refinement.explains_more(fewer, inconsistent)
    assert mask_refinement.explains_more(inconsistent, fewer)


def test_a_frame_without_pose_keeps_its_mask(scene: Tumble) -> None:
    capture, arm = with_arm(scene.capture)
    trimmed = mask_refinement.trim_masks(capture, result(scene, lost=2))
    assert torch.equal(trimmed.masks[:2], capture.masks[:2])
    assert (trimmed.masks[2:][arm[2:]] == BACKGROUND).float().mean() > 0.8


def test_only_doubtful_masks_of_a_known_shape_are_trimmed_further(scene: Tumble) -> None:
    capture, _ = with_arm(scene.capture)
    assert mask_refinement.trimmed_further(capture, result(scene, lost=1)) is not None
    assert mask_refinement.trimmed_further(capture, result(scene, overlap=1.0)) is None
    assert mask_refinement.trimmed_further(capture, result(scene, overlap=0.4)) is None
    # Masks without unknown pixels were given, or made of an object that nothing covers.
    assert mask_refinement.trimmed_further(scene.capture, result(scene, lost=1)) is None


def test_masks_that_the_shape_hardly_contradicts_are_not_trimmed_further(scene: Tumble) -> None:
    """A frame may be lost for other reasons, and stage 1 would only do the same again."""
    masks = scene.capture.masks.clone()
    masks[:, :1, :3] = UNKNOWN
    assert mask_refinement.trimmed_further(replace(scene.capture, masks=masks), result(scene, lost=1)) is None


def test_a_stored_result_is_that_of_the_best_round(scene: Tumble, tmp_path: Path) -> None:
    capture, _ = with_arm(scene.capture)
    assert mask_refinement.stored_result(tmp_path, capture) == (None, capture)
    first, better, worse = (result(scene, lost=lost) for lost in (4, 1, 7))
    for number, each in ((1, first), (2, better), (3, worse)):
        (tmp_path / mask_refinement.folder(number)).mkdir()
        tree.save(each, tmp_path / mask_refinement.folder(number) / run.OUT)
    found, trimmed = mask_refinement.stored_result(tmp_path, capture)
    assert found is not None
    assert int(found.quality.lost.sum()) == 1
    assert torch.equal(trimmed.masks, mask_refinement.trim_masks(capture, first).masks)
