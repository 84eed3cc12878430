"""The motion of the camera is that of the background, whatever the object does."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.films import scene
from tumble.preprocess.background import estimate_background, fill_unknown
from tumble.preprocess.camera_motion import background_shift


def test_background_shift_is_the_displacement_of_the_background() -> None:
    wall = scene().background
    big = cv2.resize(wall, (320, 260), interpolation=cv2.INTER_CUBIC)
    pictures = np.stack([big, np.roll(big, 4, 1)])
    shift = background_shift(pictures, estimate_background(pictures[:1]), np.zeros(pictures.shape[:3], bool))
    assert shift[0] == pytest.approx(0, abs=1e-3)
    # 4 of 320 pixels; the error of the flow is one or two tenths of a pixel.
    assert shift[1] == pytest.approx(4 / 320, abs=0.2 * 4 / 320)


def test_an_object_that_rotates_over_black_does_not_count_as_camera_motion() -> None:
    """Over black the only texture is the object's, which is in the background where the object never moves away."""
    video = scene()
    pictures = np.where(video.object[..., None], video.pictures, np.uint8(0))
    covered = video.object.copy()
    background = estimate_background(pictures, covered)
    # Where the mask is lost on some frames, the object is not covered.
    covered[[4, 11]] = False
    reference = fill_unknown(background, estimate_background(pictures))
    assert np.isnan(background_shift(pictures, reference, covered)).all()


def test_what_moves_before_a_plain_wall_does_not_count_as_camera_motion() -> None:
    """The background of a place that is always covered is unknown, and its border is the only edge of the wall."""
    texture = np.random.default_rng(0).integers(0, 256, (12, 12, 3), np.uint8)
    texture = cv2.resize(texture, (120, 120), interpolation=cv2.INTER_CUBIC)
    pictures = np.full((8, 100, 140, 3), 190, np.uint8)
    for i, picture in enumerate(pictures):
        picture[30:80, 40:100] = texture[5 * i : 5 * i + 50, 5 * i : 5 * i + 60]
    covered = np.zeros(pictures.shape[:3], bool)
    covered[:, 30:80, 40:100] = True
    reference = replace(estimate_background(pictures), known=~covered[0])
    assert np.isnan(background_shift(pictures, reference, covered)).all()
