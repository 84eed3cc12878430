"""Clicks change masks where they are, where the same fault is nearby in time, and nowhere else."""

from functools import cache
from pathlib import Path

import cv2
import numpy as np

from tests.films import Scene, scene, written
from tumble.preprocess import propagation, segmentation
from tumble.preprocess.background import Background, estimate_background
from tumble.preprocess.clicks import Click, correct_masks
from tumble.preprocess.hands import Hand
from tumble.preprocess.options import FootageOptions
from tumble.preprocess.segmentation import Masks, Seed, overlap
from tumble.preprocess.survey import survey_footage, to_clicks
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN

CLICKED = 8
NO_HANDS = [[]] * 20


@cache
def with_blob() -> tuple[Scene, np.ndarray, Background, Masks]:
    """The film with a blue ball that moves with the object, [t h w] its pixels, and masks that contain the ball."""
    video, rng = scene(), np.random.default_rng(3)
    pictures, blob = video.pictures.copy(), np.zeros(video.object.shape, bool)
    for i, inside in enumerate(video.object):
        row, column = (int(x.mean()) for x in np.nonzero(inside))
        blob[i] = cv2.circle(np.zeros(inside.shape, np.uint8), (column + 30 + i % 3, row + 5), 16, 1, -1) > 0
        shade = 8 * np.sin(np.nonzero(blob[i])[1] / 5)[:, None] + rng.normal(0, 2, (blob[i].sum(), 3))
        pictures[i][blob[i]] = (np.array([60, 90, 170]) + shade).clip(0, 255)
    film = Scene(pictures, video.object & ~blob, blob, video.background)
    background = estimate_background(pictures, video.object | blob)
    rows, columns = np.nonzero((video.object | blob)[0])
    box = int(columns.min()) - 3, int(rows.min()) - 3, int(np.ptp(columns)) + 7, int(np.ptp(rows)) + 7
    return film, blob, background, propagation.segment(pictures, background, Seed(0, box), NO_HANDS)


def on(mask: np.ndarray) -> tuple[int, int]:
    """Column and row in the middle of a region."""
    row, column = (int(np.median(x)) for x in np.nonzero(mask))
    return column, row


def test_one_click_removes_what_is_not_object_in_all_frames() -> None:
    film, blob, background, masks = with_blob()
    assert min((labels == OBJECT)[b].mean() for labels, b in zip(masks.labels, blob, strict=True)) > 0.9
    column, row = on(blob[CLICKED])
    after = correct_masks(film.pictures, masks, background, [Click(CLICKED, (column + 4, row), False)], NO_HANDS)
    for labels, where, truth in zip(after.labels, blob, film.object, strict=True):
        assert (labels == OBJECT)[where].mean() < 0.02
        # It may hide the object, so it must not carve the hull.
        assert (labels == UNKNOWN)[where].mean() > 0.9
        assert overlap(labels == OBJECT, truth & (labels != UNKNOWN)) > 0.94
    assert not after.uncertain[CLICKED]


def test_a_click_on_the_object_brings_back_what_the_mask_lacks() -> None:
    """The masks of all frames have a hole, known to be wrong only by the click."""
    film, blob, background, masks = with_blob()
    holes = np.stack([segmentation.eroded(b, 3) for b in blob])
    labels = np.where(holes, np.uint8(BACKGROUND), masks.labels)
    faulty = Masks(labels, masks.confidence, masks.uncertain)
    after = correct_masks(film.pictures, faulty, background, [Click(CLICKED, on(holes[CLICKED]), True)], NO_HANDS)
    assert min((m == OBJECT)[h].mean() for m, h in zip(after.labels, holes, strict=True)) > 0.8
    unchanged = ~np.stack([segmentation.dilated(b, 3) for b in blob])
    assert (after.labels == faulty.labels)[unchanged].mean() > 0.999


def test_a_click_on_the_object_does_not_add_the_hand() -> None:
    """The object has a print in the colours of the hand, which the mask lacks; the landmarks say where the hand is."""
    film, blob, background, masks = with_blob()
    skin, holes = (205, 150, 120), np.stack([segmentation.eroded(b, 6) for b in blob])
    pictures, hand = film.pictures.copy(), np.zeros(film.pictures.shape[1:3], bool)
    hand[100:, 60:150] = True
    for picture, hole in zip(pictures, holes, strict=True):
        picture[hole | hand] = skin
    # A bridge of that colour between print and hand, such as a shadow of both.
    column, row = on(holes[CLICKED])
    pictures[CLICKED, row:102, column - 4 : column + 5] = skin
    labels = np.where(holes | hand, np.uint8(UNKNOWN), masks.labels)
    labels[CLICKED, row:102, column - 4 : column + 5] = UNKNOWN
    faulty = Masks(labels, masks.confidence, masks.uncertain)
    found = [[Hand(np.stack([np.linspace(65, 145, 21), np.full(21, 115)], 1).astype(np.float32), 1.0, 1.0)]] * 20
    after = correct_masks(pictures, faulty, background, [Click(CLICKED, (column, row), True)], found)
    assert (after.labels[CLICKED] == OBJECT)[row, column]
    assert (after.labels == OBJECT)[:, hand].mean() < 0.01


def test_two_clicks_on_one_frame_are_both_obeyed() -> None:
    """Whatever the colours say, and next to each other."""
    film, _, background, masks = with_blob()
    column, row = on(film.object[CLICKED])
    clicks = [Click(CLICKED, (column, row), False), Click(CLICKED, (column - 8, row), True)]
    after = correct_masks(film.pictures, masks, background, clicks, NO_HANDS).labels[CLICKED]
    assert after[row, column] != OBJECT
    assert after[row, column - 8] == OBJECT


def test_an_object_that_was_lost_is_found_by_a_click() -> None:
    film, blob, background, masks = with_blob()
    labels, confidence = masks.labels.copy(), masks.confidence.copy()
    labels[CLICKED:], confidence[CLICKED:] = UNKNOWN, 0
    faulty = Masks(labels, confidence, np.arange(len(labels)) >= CLICKED)
    after = correct_masks(
        film.pictures, faulty, background, [Click(CLICKED + 2, on(blob[CLICKED + 2]), True)], NO_HANDS
    )
    assert (after.labels == OBJECT)[CLICKED + 2][blob[CLICKED + 2]].mean() > 0.7
    assert after.confidence[CLICKED + 2] == 1


def test_without_clicks_nothing_changes() -> None:
    film, _, background, masks = with_blob()
    after = correct_masks(film.pictures, masks, background, [], NO_HANDS)
    np.testing.assert_array_equal(after.labels, masks.labels)


def test_clicks_are_options_of_the_survey(tmp_path: Path) -> None:
    """Without a box, the first click on the object takes its place; the others correct."""
    video, number = scene(), 5
    column, row = on(video.object[number])
    clicks = (column, row, number), (column - 12, row, number)
    options = FootageOptions(object=clicks[:1], not_object=clicks[1:], focal=300.0)
    survey = survey_footage(written(video.pictures, tmp_path / "x.mp4"), options)
    assert not survey.seed_from_motion
    assert survey.seed == Seed(number, click=(column, row))
    assert survey.inside[number][row, column]
    assert not survey.inside[number][row, column - 12]


def test_clicks_are_in_pixels_and_frames_of_the_footage() -> None:
    """Every fourth frame was surveyed, at a third of the size."""
    clicks = to_clicks([(32, 10, 9)], [(0, 300, 100)], np.arange(0, 30, 4), 1 / 3)
    assert clicks == [Click(2, (10, 3), True), Click(7, (0, 100), False)]
