"""The static background is estimated behind moving objects, and its gain drift is measured and compensated."""

import cv2
import numpy as np
import pytest

from tests.films import scene
from tumble.maths.images import linear_from_srgb
from tumble.preprocess import background as module
from tumble.preprocess.background import (
    Background,
    compensate,
    crossed_background,
    estimate_background,
    estimate_gains,
    fill_unknown,
    resting_background,
    sample_background,
)

RNG = np.random.default_rng(3)
WALL = RNG.integers(60, 180, (12, 16, 3)).astype(np.uint8)


def video_of_wall(covered: np.ndarray) -> np.ndarray:
    """The wall with noise of one code value, and random values where it is covered."""
    pictures = (WALL + RNG.integers(-1, 2, (*covered.shape, 3))).astype(np.uint8)
    pictures[covered] = RNG.integers(0, 256, (int(covered.sum()), 3))
    return pictures


def test_the_background_is_the_mode_where_it_is_visible_half_of_the_time() -> None:
    """The mode is right where 50 % of the values are arbitrary; a median would be off by tens."""
    covered = RNG.permuted(np.arange(40)[:, None, None] < 20 * np.ones((1, 12, 16)), axis=0)
    background = estimate_background(video_of_wall(covered))
    assert background.known.mean() > 0.9
    assert np.abs(background.image.astype(int) - WALL)[background.known].max() <= 4


def test_covered_pixels_are_ignored() -> None:
    """80 % of the frames are hidden by one colour; only the rest counts."""
    covered = np.broadcast_to((np.arange(40) % 5 > 0)[:, None, None], (40, 12, 16))
    pictures = video_of_wall(np.zeros((40, 12, 16), bool))
    pictures[covered] = 77
    assert np.abs(estimate_background(pictures).image.astype(int) - 77).max() <= 1
    assert np.abs(estimate_background(pictures, covered).image.astype(int) - WALL).max() <= 2


def test_a_background_that_is_never_visible_is_unknown() -> None:
    covered = np.zeros((20, 12, 16), bool)
    covered[:, :6] = True
    background = estimate_background(video_of_wall(np.zeros_like(covered)), covered)
    assert not background.known[:6].any()
    assert background.known[6:].all()
    whole = fill_unknown(background, estimate_background(video_of_wall(np.zeros_like(covered))))
    assert whole.known.all()
    assert np.array_equal(whole.image[6:], background.image[6:])


def crossing(feet: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A film of 60 frames of the wall, its object, and the pixels that only the object's ends uncover.

    A printed object covers columns 4 to 12 but for six frames, in which it is edge-on and covers columns 7 to 9. Pixels
    in `feet` show one dark colour whenever nothing else is in front of them.
    """
    images, inside = video_of_wall(np.zeros((60, 12, 16), bool)), np.zeros((60, 12, 16), bool)
    images[:, feet] = 20 + RNG.integers(-1, 2, images[:, feet].shape)
    inside[:, :, 4:13] = True
    edge_on = [10, 11, 12, 40, 41, 42]
    inside[edge_on] = False
    inside[np.ix_(edge_on, range(12), range(7, 10))] = True
    images[inside] = RNG.integers(0, 256, (int(inside.sum()), 3))
    uncovered = np.zeros((12, 16), bool)
    uncovered[:, [4, 12]] = True
    return images, inside, uncovered


def nothing_known() -> Background:
    """A background that is known beside columns 2 to 14 only."""
    known = np.ones((12, 16), bool)
    known[:, 2:15] = False
    return Background(np.where(known[..., None], WALL, 99).astype(np.uint8), np.full((12, 16), 2, np.float32), known)


def test_what_the_object_crosses_becomes_known() -> None:
    """In 6 of 60 frames the wall is visible, beside an object whose print has any colour; behind its middle never."""
    images, inside, uncovered = crossing(np.zeros((12, 16), bool))
    background = crossed_background(images, inside, nothing_known())
    assert background.known[uncovered].all()
    assert np.abs(background.image.astype(int) - WALL)[uncovered].max() <= 2
    assert not background.known[:, 5:12].any()
    # Columns 2, 3, 13 and 14 are never covered, so that nothing tells whether an object stays there.
    assert not background.known[:, [2, 3, 13, 14]].any()
    assert np.array_equal(background.image[:, [0, 1, 15]], WALL[:, [0, 1, 15]])


@pytest.mark.parametrize("recognised", [0, 30])
def test_dark_feet_that_stay_in_their_place_do_not_become_background(recognised: int) -> None:
    """Feet are at the same pixels in all frames; masks recognise them in none, or in the first half of them."""
    feet = np.zeros((12, 16), bool)
    feet[6:, [3, 4, 12, 13]] = True
    images, inside, _ = crossing(feet)
    images[:, feet] = 20 + RNG.integers(-1, 2, images[:, feet].shape)
    inside[:, feet] = np.arange(60)[:, None] < recognised
    background = crossed_background(images, inside, nothing_known())
    assert not (background.known & feet).any()
    assert background.known[:4, [4, 12]].all()


def test_a_background_that_is_known_stays_as_it_is() -> None:
    images, inside, _ = crossing(np.zeros((12, 16), bool))
    known = Background(WALL, np.full((12, 16), 2, np.float32), np.ones((12, 16), bool))
    crossed = crossed_background(images, inside, known)
    assert crossed.known.all()
    assert np.array_equal(crossed.image, WALL)


def swinging() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A film of a printed square that swings by 16 pixels before a wall, its pixels, and the wall."""
    blocks = RNG.integers(60, 180, (2, 30, 40, 3)).repeat(2, 1).repeat(2, 2)  # detail that survives a compression
    wall, board = blocks.astype(np.uint8)
    images, inside = np.repeat(wall[None], 40, 0), np.zeros((40, 60, 80), bool)
    for t, left in enumerate((28 + 8 * np.sin(np.arange(40) / 2)).round().astype(int)):
        images[t, 18:42, left : left + 24] = board[:24, :24]
        inside[t, 18:42, left : left + 24] = True
    noise = RNG.integers(-1, 2, images.shape)
    return (images + noise).astype(np.uint8), inside, wall, board


def test_a_wall_in_the_masks_is_found_since_it_rests_while_the_object_moves() -> None:
    """Masks take in 6 pixels of the wall all around the square, so that no frame shows it beside the object there."""
    images, inside, wall, _ = swinging()
    wide = np.stack([cv2.dilate(mask.astype(np.uint8), np.ones((13, 13))) > 0 for mask in inside])
    known = ~wide.any(0)
    unknown = Background(wall, np.full(known.shape, 2, np.float32), known)
    found = resting_background(images, wide, unknown)
    new = found.known & ~known
    assert new[(wide & ~inside).sum(0) >= 10].mean() > 0.4
    assert (np.abs(found.image.astype(int) - wall)[new].max(-1) <= 3).mean() > 0.97
    assert inside.all(0).any()
    assert not (new & inside.all(0)).any(), "what no frame shows stays unknown"


def test_a_plain_part_of_the_object_is_no_wall_although_it_stays_the_same() -> None:
    """The middle of the square has one colour, and is wider than its path."""
    images, inside, wall, _ = swinging()
    for t, mask in enumerate(inside):
        left = int(np.flatnonzero(mask.any(0))[0])
        images[t, 22:38, left + 4 : left + 20] = (200, 40, 40)
    unknown = Background(wall, np.full(wall.shape[:2], 2, np.float32), ~inside.any(0))
    found = resting_background(images, inside, unknown)
    red = np.abs(found.image.astype(int) - (200, 40, 40)).max(-1) < 20
    assert (found.known & inside.any(0) & red).sum() < 0.02 * inside.any(0).sum()


def test_the_gain_drift_of_one_channel_is_estimated_and_compensated() -> None:
    """The true red gain is 1 + 0.15 sin, with median 1. The object covers a sixth of the image."""
    tinted, plain = scene(tint=0.15), scene()
    gains = estimate_gains(tinted.pictures)
    # The videos are rendered with a gamma of 2.2 instead of the sRGB curve, which differ by up to 2 % here.
    np.testing.assert_allclose(gains[:, 0], 1 + 0.15 * np.sin(2 * np.pi * np.arange(20) / 20), atol=0.03)
    np.testing.assert_allclose(gains[:, 1:], 1, atol=0.01)
    background = ~plain.object[5]
    compensated = compensate(tinted.pictures[5], gains[5]).astype(int)
    assert (
        np.abs(compensated - plain.pictures[5])[background].mean()
        < 0.3 * np.abs(tinted.pictures[5].astype(int) - plain.pictures[5])[background].mean()
    )


def test_compensation_divides_linear_light_and_keeps_clipped_pixels() -> None:
    image = np.full((4, 4, 3), 188, np.uint8)
    image[0] = 255
    new = compensate(image, np.array([2.0, 1.0, 0.5], np.float32))
    import torch

    def linear(v: float) -> float:
        return float(linear_from_srgb(torch.tensor(v / 255)))

    assert linear(float(new[2, 2, 0])) == pytest.approx(linear(188) / 2, rel=0.01)
    assert new[2, 2, 1] == 188
    assert new[0, 0].tolist() == [255, 255, 255]


def test_the_gains_of_a_black_background_are_one() -> None:
    pictures = np.zeros((6, 20, 20, 3), np.uint8)
    pictures[:, 8:12, 8:12] = 200
    assert np.array_equal(estimate_gains(pictures), np.ones((6, 3), np.float32))


def test_one_frame_is_its_own_background() -> None:
    background = estimate_background(WALL[None])
    assert background.known.all()
    assert np.array_equal(background.image, WALL)
    assert module.channel_max(np.array([[1, 5, 2]])).tolist() == [5]


def test_samples_know_a_wall_that_appears_late_and_colours_that_alternate() -> None:
    """The left half shows two walls in turn, the right half is always covered; the colour of neither is unlikely."""
    images = np.stack([WALL if i % 2 else 255 - WALL for i in range(20)])
    covered = np.zeros(images.shape[:3], bool)
    covered[:, :, 12:] = True
    samples = sample_background(images, covered)
    likely = [samples.log_likelihood(images[i], i)[:, :7] for i in (4, 5)]
    strange = samples.log_likelihood(np.roll(images[4], 1, -1), 4)[:, :7]
    assert np.mean([np.median(each) for each in likely]) > np.median(strange) + 5
    assert np.isnan(samples.log_likelihood(images[4], 4)[:, 12:]).all()


def test_a_local_mean_leaves_out_what_does_not_count() -> None:
    values, where = np.zeros((5, 7), np.float32), np.zeros((5, 7), bool)
    values[2, 2:5] = 2, 50, 4
    where[2, 2], where[2, 4] = True, True
    mean = module.local_mean(values, where, 3)
    assert mean[2, 1:6].tolist() == pytest.approx([2, 2, 3, 4, 4])
    assert not mean[0].any()
    assert module.local_mean(np.stack([values, 2 * values], -1), where, 3)[2, 3].tolist() == pytest.approx([3, 6])
