"""The still background: found behind things that move, its drift measured and undone."""

import cv2
import numpy as np
import pytest

from tests.films import scene
from tumble.maths.images import linear_from_srgb
from tumble.preprocess import background as module
from tumble.preprocess.background import backdrop, compensate, completed, drift, shake

RNG = np.random.default_rng(3)
WALL = RNG.integers(60, 180, (12, 16, 3)).astype(np.uint8)


def film(covered: np.ndarray) -> np.ndarray:
    """The wall with a grain of one code, and noise where it is covered."""
    pictures = (WALL + RNG.integers(-1, 2, (*covered.shape, 3))).astype(np.uint8)
    pictures[covered] = RNG.integers(0, 256, (int(covered.sum()), 3))
    return pictures


def test_the_background_is_found_where_it_shows_half_of_the_time() -> None:
    """The mode stands where 50 % of the values are arbitrary; a median would be off by tens."""
    covered = RNG.permuted(np.arange(40)[:, None, None] < 20 * np.ones((1, 12, 16)), axis=0)
    found = backdrop(film(covered))
    assert found.known.mean() > 0.9
    assert np.abs(found.picture.astype(int) - WALL)[found.known].max() <= 4


def test_what_is_named_as_cover_does_not_count() -> None:
    """80 % of the frames hidden by one and the same colour: only the rest is the background's."""
    covered = np.broadcast_to((np.arange(40) % 5 > 0)[:, None, None], (40, 12, 16))
    pictures = film(np.zeros((40, 12, 16), bool))
    pictures[covered] = 77
    assert np.abs(backdrop(pictures).picture.astype(int) - 77).max() <= 1
    assert np.abs(backdrop(pictures, covered).picture.astype(int) - WALL).max() <= 2


def test_what_was_never_seen_is_not_known() -> None:
    covered = np.zeros((20, 12, 16), bool)
    covered[:, :6] = True
    found = backdrop(film(np.zeros_like(covered)), covered)
    assert not found.known[:6].any()
    assert found.known[6:].all()
    whole = completed(found, backdrop(film(np.zeros_like(covered))))
    assert whole.known.all()
    assert np.array_equal(whole.picture[6:], found.picture[6:])


def test_the_drift_of_one_channel_is_measured_and_undone() -> None:
    """Truth: red times 1 + 0.15 sin, against its median of 1. The object covers a sixth of the picture."""
    tinted, plain = scene(tint=0.15), scene()
    gains = drift(tinted.pictures)
    # The films are made with a power of 2.2, not the sRGB curve: up to 2 % apart at these values.
    np.testing.assert_allclose(gains[:, 0], 1 + 0.15 * np.sin(2 * np.pi * np.arange(20) / 20), atol=0.03)
    np.testing.assert_allclose(gains[:, 1:], 1, atol=0.01)
    still = ~plain.object[5]
    undone = compensate(tinted.pictures[5], gains[5]).astype(int)
    assert (
        np.abs(undone - plain.pictures[5])[still].mean()
        < 0.3 * np.abs(tinted.pictures[5].astype(int) - plain.pictures[5])[still].mean()
    )


def test_compensation_divides_linear_light_and_keeps_what_is_clipped() -> None:
    picture = np.full((4, 4, 3), 188, np.uint8)
    picture[0] = 255
    new = compensate(picture, np.array([2.0, 1.0, 0.5], np.float32))
    import torch

    def linear(v: float) -> float:
        return float(linear_from_srgb(torch.tensor(v / 255)))

    assert linear(float(new[2, 2, 0])) == pytest.approx(linear(188) / 2, rel=0.01)
    assert new[2, 2, 1] == 188
    assert new[0, 0].tolist() == [255, 255, 255]


def test_a_black_background_carries_no_drift() -> None:
    pictures = np.zeros((6, 20, 20, 3), np.uint8)
    pictures[:, 8:12, 8:12] = 200
    assert np.array_equal(drift(pictures), np.ones((6, 3), np.float32))


def test_shake_is_the_shift_of_the_background() -> None:
    wall = scene().background
    big = cv2.resize(wall, (320, 260), interpolation=cv2.INTER_CUBIC)
    pictures = np.stack([big, np.roll(big, 4, 1)])
    found = shake(pictures, backdrop(pictures[:1]), np.zeros(pictures.shape[:3], bool))
    assert found[0] == pytest.approx(0, abs=1e-3)
    # 4 pixels of 320; the flow is good to a tenth of a pixel or two.
    assert found[1] == pytest.approx(4 / 320, abs=0.2 * 4 / 320)


def test_an_object_that_turns_before_nothing_is_no_shaking_camera() -> None:
    """Over black there is no other texture than the object's, which the backdrop holds where it was never elsewhere."""
    film = scene()
    pictures = np.where(film.object[..., None], film.pictures, np.uint8(0))
    covered = film.object.copy()
    still = backdrop(pictures, covered)
    # Masks that were lost on some frames leave the object bare there.
    covered[[4, 11]] = False
    assert shake(pictures, completed(still, backdrop(pictures)), covered).max() == 0


def test_one_frame_is_enough_to_answer() -> None:
    found = backdrop(WALL[None])
    assert found.known.all()
    assert np.array_equal(found.picture, WALL)
    assert module.worst(np.array([[1, 5, 2]])).tolist() == [5]
