"""A disc of known coverage before a known wall: the border of its mask, shared out to disc and wall."""

import cv2
import numpy as np
import pytest
import torch

from tumble.maths import linear_from_srgb, to_srgb8
from tumble.preprocess.background import settle_border
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN

SIZE = 64
FINER = 8


def coverage(radius: float = 20.3, centre: tuple[float, float] = (33.4, 29.7)) -> np.ndarray:
    """Share of every pixel inside a disc."""
    ticks = (np.arange(SIZE * FINER) + 0.5) / FINER
    inside = (ticks[:, None] - centre[0]) ** 2 + (ticks - centre[1]) ** 2 < radius**2
    return inside.reshape(SIZE, FINER, SIZE, FINER).mean((1, 3)).astype(np.float32)


def code(linear: np.ndarray) -> np.ndarray:
    return to_srgb8(torch.from_numpy(np.asarray(linear, np.float32))).numpy()


def linear(code: np.ndarray) -> np.ndarray:
    return linear_from_srgb(torch.from_numpy(code).float() / 255).numpy()


def banded(share: np.ndarray, shift: int = 0) -> np.ndarray:
    """Mask of a disc with an unknown band of about three pixels, shifted to the right."""
    near, square = np.roll(share, shift, 1), np.ones((3, 3))
    labels = np.where(cv2.dilate(near, square) > 0, np.uint8(UNKNOWN), np.uint8(BACKGROUND))
    labels[cv2.erode(near, square) >= 1] = OBJECT
    return labels


WALL = code(np.broadcast_to(np.array([0.05, 0.3, 0.6]), (SIZE, SIZE, 3)))
DISC = np.array([0.5, 0.2, 0.1])
KNOWN = np.ones((SIZE, SIZE), bool)


def scene(share: np.ndarray) -> np.ndarray:
    return code(share[..., None] * DISC + (1 - share[..., None]) * linear(WALL))


@pytest.mark.parametrize("shift", [0, 1])
def test_the_band_is_shared_out_by_coverage(shift: int) -> None:
    """Half covered and more is object, less than a quarter background; in between nothing is said."""
    share = coverage()
    _, labels = settle_border(scene(share), banded(share, shift), WALL, KNOWN)
    band = banded(share, shift) == UNKNOWN
    assert (labels[band & (share > 0.52)] == OBJECT).all()
    # A mask that is a pixel beside the object has pixels of the wall in it, of which nothing is known any more.
    assert (labels[band & (share < 0.23) & (share > 0)] == BACKGROUND).all()
    assert (labels[band & (share > 0.27) & (share < 0.48)] == UNKNOWN).all()


def test_the_background_is_taken_out_of_the_colours() -> None:
    share = coverage()
    image, labels = settle_border(scene(share), banded(share), WALL, KNOWN)
    mixed = (labels == OBJECT) & (share < 0.95)
    assert mixed.sum() > 20
    np.testing.assert_allclose(linear(image)[mixed], share[mixed][:, None] * DISC, atol=0.01)


def test_what_is_not_known_stays_unknown() -> None:
    share, half = coverage(), KNOWN.copy()
    half[:, : SIZE // 2] = False
    _, labels = settle_border(scene(share), banded(share), WALL, half)
    band = banded(share) == UNKNOWN
    assert (labels[band & ~half] == UNKNOWN).all()
    assert (labels[band & half & ((share > 0.52) | (share < 0.23))] != UNKNOWN).all()


def test_a_disc_of_the_colour_of_the_wall_keeps_its_band() -> None:
    share = coverage()
    image, labels = settle_border(WALL, banded(share), WALL, KNOWN)
    np.testing.assert_array_equal(labels, banded(share))
    np.testing.assert_array_equal(image, WALL)


def test_a_finger_at_the_border_stays_unknown() -> None:
    share, labels = coverage(), banded(coverage())
    image = scene(share)
    finger = np.zeros((SIZE, SIZE), bool)
    finger[26:38, 40:] = True
    labels[finger] = UNKNOWN
    image[finger] = code(np.array([0.4, 0.6, 0.02]))
    _, settled = settle_border(image, labels, WALL, KNOWN)
    assert (settled[29:35, 44:] == UNKNOWN).all()


def test_a_mask_without_object_is_left_alone() -> None:
    empty = np.full((SIZE, SIZE), BACKGROUND, np.uint8)
    image, labels = settle_border(WALL, empty, WALL, KNOWN)
    assert image is WALL
    assert labels is empty
