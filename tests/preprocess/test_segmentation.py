"""Masks from a box on one frame, against films whose masks are known."""

import numpy as np
import pytest

from tests.films import Scene, scene
from tumble.preprocess import segmentation
from tumble.preprocess.background import Backdrop, backdrop, completed
from tumble.preprocess.segmentation import Masks, Seed, overlap, three_valued
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN


def found(film: Scene, seed: Seed) -> tuple[Masks, Backdrop]:
    still = backdrop(film.pictures)
    still = backdrop(film.pictures, np.stack([segmentation.hands(picture, still) for picture in film.pictures]))
    still = segmentation.trusted(still, film.pictures[seed.index], seed)
    first = segmentation.segment(film.pictures, still, seed)
    still = completed(backdrop(film.pictures, first.labels != BACKGROUND), still)
    return segmentation.segment(film.pictures, still, seed), still


def scores(masks: Masks, film: Scene) -> tuple[float, float, float]:
    """IoU over known pixels, worst share of the object called background, share of the hand called object."""
    pairs = list(zip(masks.labels, film.object, strict=True))
    known = [overlap(labels == OBJECT, truth & (labels != UNKNOWN)) for labels, truth in pairs]
    lost = [float((labels[truth] == BACKGROUND).mean()) for labels, truth in pairs]
    grabbed = float((masks.labels[film.hand] == OBJECT).mean()) if film.hand.any() else 0.0
    return float(np.mean(known)), max(lost), grabbed


def test_an_object_that_turns_alone_is_followed_from_a_box() -> None:
    """The bundled clip turns by 10 degrees from frame to frame, three to ten times what a phone sees."""
    film = scene()
    masks, _ = found(film, Seed(0, film.box()))
    iou, lost, _ = scores(masks, film)
    assert iou > 0.87
    assert lost < 0.06
    assert not masks.unsure.any()
    assert masks.confidence.min() > 0.8


def test_a_hand_in_front_is_unknown_and_not_object() -> None:
    film = scene(hand=True)
    masks, _ = found(film, Seed(0, film.box()))
    iou, lost, grabbed = scores(masks, film)
    assert iou > 0.85
    assert lost < 0.2
    assert grabbed < 0.05
    # Where fingers lie on the object, background would carve it.
    assert (masks.labels[film.hand] == BACKGROUND).mean() < 0.1


def test_a_print_of_the_colour_of_skin_belongs_to_the_object() -> None:
    """A disc that turns into view on the middle of the object: unlike a hand it does not reach in from outside."""
    film = scene()
    pictures, painted = film.pictures.copy(), np.zeros(film.object.shape, bool)
    for i, inside in enumerate(film.object):
        row, column = (int(x.mean()) for x in np.nonzero(inside))
        disc = np.hypot(np.arange(inside.shape[0])[:, None] - row, np.arange(inside.shape[1]) - column) < min(
            3 * (i - 4), 12
        )
        painted[i] = disc & inside
        pictures[i][painted[i]] = (110, 35, 30)
    masks, _ = found(Scene(pictures, film.object, film.hand, film.background), Seed(0, film.box()))
    assert (masks.labels[painted] == OBJECT).mean() > 0.95


def test_a_wall_of_which_a_rim_was_taught_as_hand_is_no_hand() -> None:
    """Past a plain wall a silhouette moves: what differs there from the backdrop shows the wall. An arm is hand."""
    about = np.zeros((60, 80), bool)
    about[20:40, 30:50] = True
    rim = segmentation._dilated(about, 4) & ~about
    wall = np.where(about, np.float32(-3), np.float32(3))
    plain = Backdrop(np.zeros((60, 80, 3), np.uint8), np.ones((60, 80), np.float32), np.ones((60, 80), bool))
    assert not segmentation._hand(wall, about, rim, plain).any()
    arm = ~about & (np.arange(60) > 30)[:, None] & (np.arange(80) > 35)
    found = segmentation._hand(np.where(arm, wall, np.float32(-3)), about, rim, plain)
    assert (found == segmentation._opened(arm, 1)).all()


def test_a_seed_in_the_middle_is_carried_both_ways() -> None:
    film = scene()
    masks, _ = found(film, Seed(10, film.box(10)))
    iou, _, _ = scores(masks, film)
    assert iou > 0.85


def test_a_click_is_enough_on_a_clear_film() -> None:
    film = scene()
    rows, columns = np.nonzero(film.object[0])
    masks, _ = found(film, Seed(0, click=(int(np.median(columns)), int(np.median(rows)))))
    assert scores(masks, film)[0] > 0.75


def test_without_a_hint_what_moves_is_boxed() -> None:
    film = scene()
    seed = segmentation.find_seed(film.pictures, backdrop(film.pictures))
    assert seed is not None
    assert seed.box is not None
    left, top, width, height = seed.box
    truth = film.object[seed.index]
    assert truth[top : top + height, left : left + width].sum() > 0.9 * truth.sum()
    assert width * height < 4 * truth.sum()


def test_nothing_moves_nothing_is_boxed() -> None:
    wall = np.broadcast_to(scene().background, (6, *scene().background.shape)).copy()
    assert segmentation.find_seed(wall, backdrop(wall)) is None


def test_an_object_that_leaves_is_not_invented() -> None:
    """Gone from frame 12 on: no object there, no confidence, and the frames are flagged."""
    film = scene()
    pictures = film.pictures.copy()
    pictures[12:] = film.background
    gone = Scene(pictures, film.object & (np.arange(20) < 12)[:, None, None], film.hand, film.background)
    masks, _ = found(gone, Seed(0, film.box()))
    assert (masks.labels[13:] == OBJECT).mean() < 1e-3
    assert masks.confidence[13:].max() == 0
    assert masks.unsure[13:].all()


def test_a_box_on_the_bare_wall_finds_nothing_or_says_so() -> None:
    film = scene()
    with pytest.raises(ValueError, match="no object at the hint on frame 0"):
        segmentation.segment(film.pictures, backdrop(film.pictures), Seed(0, (0, 100, 20, 20)))


def test_the_band_of_unknown_pixels_straddles_the_silhouette() -> None:
    inside = np.zeros((20, 20), bool)
    inside[5:15, 5:15] = True
    other = np.zeros_like(inside)
    other[0:3, 0:3] = True
    labels = three_valued(inside, other, 1)
    assert (labels[6:14, 6:14] == OBJECT).all()
    assert (labels[5, 6:14] == UNKNOWN).all()
    assert (labels[4, 6:14] == UNKNOWN).all()
    assert (labels[3, 6:14] == BACKGROUND).all()
    assert (labels[:3, :3] == UNKNOWN).all()


def test_a_coarse_mask_is_brought_to_the_edges_of_the_picture() -> None:
    """A disc on a wall of another colour, its mask known on every third pixel only."""
    rows, columns = np.indices((90, 90))
    disc = (rows - 45) ** 2 + (columns - 45) ** 2 < 30**2
    picture = np.where(disc[..., None], np.array([200, 60, 50]), np.array([90, 110, 140]))
    picture = (picture + np.random.default_rng(0).normal(0, 4, picture.shape)).clip(0, 255).astype(np.uint8)
    small = three_valued(disc[1::3, 1::3], np.zeros((30, 30), bool), 1)
    coarse = np.kron(small, np.ones((3, 3), np.uint8))
    fine = segmentation.sharpened(picture, coarse, 5)
    assert overlap(fine != BACKGROUND, disc) > 0.9
    assert (fine[~disc] != OBJECT).all()
    assert (fine == OBJECT).sum() > 1.1 * (coarse == OBJECT).sum()


def test_a_small_hole_is_doubted_and_a_large_one_is_one() -> None:
    """Of a disc of radius 40: holes of 2 % and 8 % of its area, and a bay that is open to the outside."""
    y, x = np.mgrid[:100, :100] - 49.5
    inside = np.hypot(x, y) < 40
    small, large = np.hypot(x + 20, y) < 5.5, np.hypot(x - 12, y) < 11
    bay = (np.abs(x) < 2) & (y > 30)
    labels = three_valued(inside & ~small & ~large & ~bay, np.zeros_like(inside), 1)
    assert (labels[small] != BACKGROUND).all()
    assert labels[49, 61] == BACKGROUND
    assert labels[86, 49] == BACKGROUND
    assert labels[0, 0] == labels[99, 50] == BACKGROUND
