"""Geometry of crops against transformations made by hand, and detection on a photograph."""

import math

import cv2
import numpy as np
import pytest

from tests.preprocess.hands.picture import LITTLE_FINGER, THUMB_TIP, WRIST_SIDE, picture
from tumble.preprocess.hands import Hand, detect_hands, detection

RIGHT_ANGLE = math.pi / 2


def noise(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)


def drawn(image: np.ndarray, crop: detection.Crop, size: int) -> np.ndarray:
    """[size size 3] in 0 to 255."""
    return detection.draw(image, crop, size, cv2.BORDER_CONSTANT).permute(1, 2, 0).numpy() * 255


def test_a_crop_is_turned_clockwise() -> None:
    """Its left upper corner is at the right upper one after a quarter; its second pixel is below the first."""
    crop = detection.Crop(np.array([100.0, 50.0]), 40.0, RIGHT_ANGLE)
    A_image_crop = crop.to_image(4)
    np.testing.assert_allclose(A_image_crop @ (0, 0, 1), (120, 30), atol=1e-9)
    np.testing.assert_allclose(A_image_crop @ (1, 0, 1), (120, 40), atol=1e-9)
    np.testing.assert_allclose(A_image_crop @ (0, 4, 1), (80, 30), atol=1e-9)


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_a_crop_in_the_size_of_its_pixels_is_the_turned_part_of_the_image(quarters: int) -> None:
    """Exactly: half a pixel too far would mix neighbours. Turned clockwise, the crop sees the image anticlockwise."""
    image = noise(20, 30)
    crop = detection.Crop(np.array([14.0, 9.0]), 8.0, quarters * RIGHT_ANGLE)
    np.testing.assert_allclose(drawn(image, crop, 8), np.rot90(image[5:13, 10:18], quarters), atol=0.5)


def test_a_reduced_crop_has_the_mean_of_the_pixels() -> None:
    image = noise(24, 36)
    crop = detection.Crop(np.array([18.0, 12.0]), 24.0, 0.0)
    mean = image[:, 6:30].reshape(8, 3, 8, 3, 3).mean((1, 3))
    np.testing.assert_allclose(drawn(image, crop, 8), mean, atol=1)


def test_outside_the_image_a_crop_is_black() -> None:
    image = np.full((10, 30, 3), 200, np.uint8)
    seen = drawn(image, detection.Crop(np.array([15.0, 5.0]), 30.0, 0.0), 30)
    assert (seen[10:20] == 200).all()
    assert not seen[:10].any()
    assert not seen[20:].any()


def pointing(direction: tuple[float, float], origin: tuple[float, float] = (100, 80)) -> Hand:
    """A flat hand, wrist at the origin, fingers 3 to 9 units long in a direction, knuckles side by side."""
    along = np.array(direction)
    across = np.array([-along[1], along[0]])
    points = [np.zeros(2)]
    for finger, side in enumerate((-4, -2, 0, 2, 4)):
        points += [along * (4 + joint * (1 + 0.1 * finger)) + across * side for joint in range(1, 5)]
    return Hand((np.array(points) * 5 + origin).astype(np.float32), 0.9, 0.5)


def test_fingers_point_up_in_the_crop_of_a_hand() -> None:
    """A quarter clockwise for fingers that point right. The crop is centred on the palm, a little to the fingers."""
    crop = detection.crop_of_hand(pointing((1.0, 0.0)))
    assert crop.angle == pytest.approx(RIGHT_ANGLE, abs=0.05)
    # The landmarks of the palm and the first joints reach from 0 to 6.8 and from -4 to 4 units of 5 pixels.
    assert crop.side == pytest.approx(2 * 8 * 5, rel=0.05)
    np.testing.assert_allclose(crop.centre, (100 + (3.4 + 0.68) * 5, 80), atol=1.5)
    assert detection.crop_of_hand(pointing((0.0, -1.0))).angle == pytest.approx(0, abs=0.05)
    assert abs(detection.crop_of_hand(pointing((0.0, 1.0))).angle) == pytest.approx(math.pi, abs=0.05)


def test_the_crop_of_a_palm_is_in_front_of_it() -> None:
    """In a view that is turned clockwise by a quarter, a palm whose fingers point up has them on the image's right."""
    view = detection.Crop(np.array([320.0, 240.0]), 640.0, RIGHT_ANGLE)
    keypoints = np.full((7, 2), 96.0)
    keypoints[0], keypoints[2] = (96, 106), (96, 86)
    crop = detection.crop_of_palm(detection.Palm(np.array([96.0, 96.0, 24.0, 30.0]), keypoints, 0.9), view)
    assert crop.angle == pytest.approx(RIGHT_ANGLE)
    assert crop.side == pytest.approx(2.6 * 30 * 640 / 192)
    np.testing.assert_allclose(crop.centre, (320 + 15 * 640 / 192, 240))


def test_overlap_of_boxes() -> None:
    assert detection.overlap((0, 0, 4, 2), (2, 0, 6, 2)) == pytest.approx(4 / 12)
    assert detection.overlap((0, 0, 4, 2), (5, 0, 6, 2)) == 0
    assert detection.overlap((0, 0, 0, 0), (0, 0, 0, 0)) == 0


def test_the_most_probable_of_hands_in_one_place_stays() -> None:
    near = Hand(pointing((1, 0)).landmarks + 3, 0.95, 0.5)
    far = pointing((1, 0), (300, 80))
    kept = detection.distinct([pointing((1, 0)), far, near])
    assert kept[0] is near
    assert len(kept) == 2
    assert kept[1] is far


def test_a_hand_in_a_photograph_is_found_in_its_place() -> None:
    (hand,) = detect_hands(picture())
    assert hand.presence > 0.8
    assert hand.right > 0.8
    # The thumb is 12 pixels wide.
    np.testing.assert_allclose(hand.landmarks[4], THUMB_TIP, atol=8)
    np.testing.assert_allclose(hand.landmarks[0], WRIST_SIDE, atol=8)
    np.testing.assert_allclose(hand.landmarks[18:20].mean(0), LITTLE_FINGER, atol=12)
    left, top, width, height = hand.box
    assert left < THUMB_TIP[0] + 8 < left + width
    assert top < WRIST_SIDE[1] < top + height


def test_landmarks_turn_with_the_photograph() -> None:
    """A mirrored photograph shows a left hand; one that is turned by a half shows the same one."""
    upright = detect_hands(picture())[0]
    (turned,) = detect_hands(np.ascontiguousarray(picture()[::-1, ::-1]))
    (mirrored,) = detect_hands(np.ascontiguousarray(picture()[:, ::-1]))
    assert turned.right > 0.5 > mirrored.right
    # Found from another view: the crop differs by a few pixels, and the landmarks of hidden fingers with it.
    assert np.abs(np.array([320, 240]) - turned.landmarks - upright.landmarks).mean() < 6
    assert np.abs(np.array([320, 0]) + mirrored.landmarks * (-1, 1) - upright.landmarks).mean() < 6


def test_without_a_hand_nothing_is_found() -> None:
    assert detect_hands(picture()[:, :160].copy()) == []
    assert detect_hands(np.full((30, 500, 3), 255, np.uint8)) == []
