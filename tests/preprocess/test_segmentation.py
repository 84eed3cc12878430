"""Masks from a box on one frame, compared with the true masks of synthetic videos."""

import numpy as np
import pytest

from tests.films import scene
from tumble.preprocess import segmentation
from tumble.preprocess.background import Background, estimate_background
from tumble.preprocess.segmentation import Seed, make_trimap, overlap
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN


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
