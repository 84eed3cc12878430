"""Masks from a box on one frame, compared with the true masks of synthetic videos."""

import cv2
import numpy as np
import pytest

from tests.films import Scene, scene
from tumble.preprocess import segmentation
from tumble.preprocess.background import Background, estimate_background, fill_unknown
from tumble.preprocess.colour_model import initial_colours
from tumble.preprocess.segmentation import Masks, Seed, make_trimap, overlap
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN


def segmented(video: Scene, seed: Seed) -> tuple[Masks, Background]:
    background = estimate_background(video.pictures)
    hands = np.stack([segmentation.moving_skin(image, background) for image in video.pictures])
    background = estimate_background(video.pictures, hands)
    background = segmentation.exclude_possible_object(background, video.pictures[seed.index], seed)
    first = segmentation.segment(video.pictures, background, seed)
    background = fill_unknown(estimate_background(video.pictures, first.labels != BACKGROUND), background)
    return segmentation.segment(video.pictures, background, seed), background


def scores(masks: Masks, video: Scene) -> tuple[float, float, float]:
    """IoU of known pixels, largest fraction of object labelled background, fraction of hand labelled object."""
    pairs = list(zip(masks.labels, video.object, strict=True))
    known = [overlap(labels == OBJECT, truth & (labels != UNKNOWN)) for labels, truth in pairs]
    lost = [float((labels[truth] == BACKGROUND).mean()) for labels, truth in pairs]
    hand = float((masks.labels[video.hand] == OBJECT).mean()) if video.hand.any() else 0.0
    return float(np.mean(known)), max(lost), hand


def test_a_rotating_object_is_tracked_from_a_box() -> None:
    """The bundled clip rotates by 10 degrees per frame, three to ten times as fast as a typical phone video."""
    video = scene()
    masks, _ = segmented(video, Seed(0, video.box()))
    iou, lost, _ = scores(masks, video)
    assert iou > 0.87
    assert lost < 0.06
    assert not masks.uncertain.any()
    assert masks.confidence.min() > 0.8


def test_a_hand_in_front_of_the_object_is_unknown() -> None:
    video = scene(hand=True)
    masks, _ = segmented(video, Seed(0, video.box()))
    iou, lost, hand = scores(masks, video)
    assert iou > 0.85
    assert lost < 0.2
    assert hand < 0.05
    # Fingers in front of the object must not be background, which would carve the visual hull.
    assert (masks.labels[video.hand] == BACKGROUND).mean() < 0.1


def test_a_skin_coloured_texture_belongs_to_the_object() -> None:
    """A disc rotates into view in the middle of the object; unlike a hand it does not extend beyond the object."""
    video = scene()
    pictures, painted = video.pictures.copy(), np.zeros(video.object.shape, bool)
    for i, inside in enumerate(video.object):
        row, column = (int(x.mean()) for x in np.nonzero(inside))
        disc = np.hypot(np.arange(inside.shape[0])[:, None] - row, np.arange(inside.shape[1]) - column) < min(
            3 * (i - 4), 12
        )
        painted[i] = disc & inside
        pictures[i][painted[i]] = (110, 35, 30)
    masks, _ = segmented(Scene(pictures, video.object, video.hand, video.background), Seed(0, video.box()))
    assert (masks.labels[painted] == OBJECT).mean() > 0.95


def test_a_side_of_the_object_before_a_wall_of_nearly_its_colour_is_doubted() -> None:
    """A red object whose right side is a little brighter than the grey wall behind it."""
    noise = np.random.default_rng(0).normal(0, 1.5, (120, 140, 3))
    wall, known = np.full((120, 140, 3), 150, np.uint8), np.ones((120, 140), bool)
    inside, side, picture = np.zeros_like(known), np.zeros_like(known), wall + noise
    inside[10:110, 20:120], side[10:110, 110:120] = True, True
    picture[inside] = (160, 40, 40) + noise[inside]
    picture[side] = 156 + noise[side]
    picture = picture.round().astype(np.uint8)
    colours = initial_colours().updated(
        cv2.cvtColor(picture, cv2.COLOR_RGB2LAB), object=inside, hand=~known, background=~inside
    )
    background = Background(wall, np.full(known.shape, 2, np.float32), known)
    prior = np.where(inside & ~side, np.float32(0.9), np.float32(0.1))
    found = segmentation._segment_frame(picture, prior, inside & ~side, background, colours)
    lost = side & ~found.inside
    assert lost[side].mean() > 0.5
    assert found.alike[lost].mean() > 0.6
    assert found.alike[~inside].mean() < 0.02


def test_a_wall_in_the_learnt_hand_colours_is_not_a_hand() -> None:
    """Where a silhouette moves past a plain wall, the changing pixels are wall; an arm is a hand."""
    expected = np.zeros((60, 80), bool)
    expected[20:40, 30:50] = True
    rim = segmentation.dilated(expected, 4) & ~expected
    wall = np.where(expected, np.float32(-3), np.float32(3))
    background = Background(np.zeros((60, 80, 3), np.uint8), np.ones((60, 80), np.float32), np.ones((60, 80), bool))
    assert not segmentation._hand_mask(wall, expected, rim, background).any()
    arm = ~expected & (np.arange(60) > 30)[:, None] & (np.arange(80) > 35)
    hand = segmentation._hand_mask(np.where(arm, wall, np.float32(-3)), expected, rim, background)
    assert (hand == segmentation.opened(arm, 1)).all()


def test_a_seed_in_the_middle_is_propagated_both_ways() -> None:
    video = scene()
    masks, _ = segmented(video, Seed(10, video.box(10)))
    iou, _, _ = scores(masks, video)
    assert iou > 0.85


def test_a_click_suffices_on_a_clear_video() -> None:
    video = scene()
    rows, columns = np.nonzero(video.object[0])
    masks, _ = segmented(video, Seed(0, click=(int(np.median(columns)), int(np.median(rows)))))
    assert scores(masks, video)[0] > 0.75


def test_the_default_seed_is_a_box_around_the_moving_object() -> None:
    video = scene()
    seed = segmentation.find_seed(video.pictures, estimate_background(video.pictures))
    assert seed is not None
    assert seed.box is not None
    left, top, width, height = seed.box
    truth = video.object[seed.index]
    assert truth[top : top + height, left : left + width].sum() > 0.9 * truth.sum()
    assert width * height < 4 * truth.sum()


def test_there_is_no_default_seed_if_nothing_moves() -> None:
    wall = np.broadcast_to(scene().background, (6, *scene().background.shape)).copy()
    assert segmentation.find_seed(wall, estimate_background(wall)) is None


def test_an_object_that_leaves_is_not_found() -> None:
    """From frame 12 on there is no object: the confidence is 0, and the frames are uncertain."""
    video = scene()
    pictures = video.pictures.copy()
    pictures[12:] = video.background
    gone = Scene(pictures, video.object & (np.arange(20) < 12)[:, None, None], video.hand, video.background)
    masks, _ = segmented(gone, Seed(0, video.box()))
    assert (masks.labels[13:] == OBJECT).mean() < 1e-3
    assert masks.confidence[13:].max() == 0
    assert masks.uncertain[13:].all()


def test_a_box_on_the_empty_wall_is_refused() -> None:
    video = scene()
    with pytest.raises(ValueError, match="no object in the box, or at the click, on frame 0"):
        segmentation.segment(video.pictures, estimate_background(video.pictures), Seed(0, (0, 100, 20, 20)))


def test_the_band_of_unknown_pixels_straddles_the_silhouette() -> None:
    inside = np.zeros((20, 20), bool)
    inside[5:15, 5:15] = True
    other = np.zeros_like(inside)
    other[0:3, 0:3] = True
    labels = make_trimap(inside, other, 1)
    assert (labels[6:14, 6:14] == OBJECT).all()
    assert (labels[5, 6:14] == UNKNOWN).all()
    assert (labels[4, 6:14] == UNKNOWN).all()
    assert (labels[3, 6:14] == BACKGROUND).all()
    assert (labels[:3, :3] == UNKNOWN).all()


def test_a_coarse_mask_is_refined_at_the_edges_of_the_image() -> None:
    """A disc on a wall of another colour, with a mask of a third of the resolution."""
    rows, columns = np.indices((90, 90))
    disc = (rows - 45) ** 2 + (columns - 45) ** 2 < 30**2
    image = np.where(disc[..., None], np.array([200, 60, 50]), np.array([90, 110, 140]))
    image = (image + np.random.default_rng(0).normal(0, 4, image.shape)).clip(0, 255).astype(np.uint8)
    small = make_trimap(disc[1::3, 1::3], np.zeros((30, 30), bool), 1)
    coarse = np.kron(small, np.ones((3, 3), np.uint8))
    fine = segmentation.refine_mask(image, coarse, 5)
    assert overlap(fine != BACKGROUND, disc) > 0.9
    assert (fine[~disc] != OBJECT).all()
    assert (fine == OBJECT).sum() > 1.1 * (coarse == OBJECT).sum()


def test_a_small_hole_is_unknown_and_a_large_one_is_background() -> None:
    """A disc of radius 40 with holes of 2 % and 8 % of its area, and an inlet that is open to the outside."""
    y, x = np.mgrid[:100, :100] - 49.5
    inside = np.hypot(x, y) < 40
    small, large = np.hypot(x + 20, y) < 5.5, np.hypot(x - 12, y) < 11
    inlet = (np.abs(x) < 2) & (y > 30)
    labels = make_trimap(inside & ~small & ~large & ~inlet, np.zeros_like(inside), 1)
    assert (labels[small] != BACKGROUND).all()
    assert labels[49, 61] == BACKGROUND
    assert labels[86, 49] == BACKGROUND
    assert labels[0, 0] == labels[99, 50] == BACKGROUND


def test_what_is_unknown_within_the_object_may_be_its_print() -> None:
    """The print reaches the silhouette; a hand beside the object, and background in a corner, are no part of it."""
    labels = np.full((40, 40), BACKGROUND, np.uint8)
    labels[10:30, 10:30] = OBJECT
    labels[10:20, 15:25] = UNKNOWN
    labels[20:26, 30:40] = UNKNOWN
    labels[10:14, 10:12] = BACKGROUND
    possible = segmentation.possible_object(np.stack([labels, np.full_like(labels, UNKNOWN)]))
    assert possible[0, 10:20, 15:25].all()
    assert possible[0].sum() == 400 - 8
    assert not possible[1].any()


@pytest.mark.parametrize("elsewhere", [False, True])
def test_a_static_part_of_a_colour_of_its_own_is_not_background_though_it_reaches_the_wall(elsewhere: bool) -> None:
    """A plain ball rotates in place before a dark wall: its right half never changes, its left edge does. A patch of
    its colour on the wall, beside the box, means that the part may be wall as well."""
    row, column = np.mgrid[:96, :96]
    ball = (np.hypot(row - 48, column - 48) < 25)[..., None]
    image = np.where(ball, np.array([73, 61, 26]), 0).astype(np.uint8)
    image[:12, :40] = (73, 61, 26) if elsewhere else 0
    before = image.copy()
    before[:, :40] = np.where(ball[:, :40], 120, before[:, :40])
    background = Background(before, np.full((96, 96), 1.5, np.float32), np.ones((96, 96), bool))
    found = segmentation.exclude_possible_object(background, image, Seed(0, (20, 20, 56, 56)))
    right = ball[..., 0] & (column > 50)
    assert found.known[right].mean() == (1 if elsewhere else 0)
    assert found.known[~ball[..., 0]].mean() > 0.95


def test_in_a_box_as_large_as_the_image_all_that_is_static_may_be_the_object() -> None:
    """Nothing around it shows a background to compare with."""
    image = np.zeros((96, 96, 3), np.uint8)
    image[30:60, 30:60] = (73, 61, 26)
    before = image.copy()
    before[:20] = 200
    background = Background(before, np.full((96, 96), 1.5, np.float32), np.ones((96, 96), bool))
    found = segmentation.exclude_possible_object(background, image, Seed(0, (0, 0, 96, 96)))
    assert found.known[:20].all()
    assert not found.known[22:].any()
