"""Log odds from colours and the static background have the signs and limits that Bayes' rule requires."""

import cv2
import numpy as np
import pytest

from tumble.preprocess import colour_model
from tumble.preprocess.background import Background

RED, BLUE, SKIN, WALL = (200, 30, 30), (30, 40, 190), (205, 150, 120), (120, 130, 110)
SHAPE = 24, 30


def plain(colour: tuple[int, int, int]) -> np.ndarray:
    noise = np.random.default_rng(0).normal(0, 2, (*SHAPE, 3))
    return (np.array(colour) + noise).clip(0, 255).astype(np.uint8)


def lab(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_RGB2LAB)


def learnt_colours() -> colour_model.ColourModel:
    """Colours of a red object in front of a grey-green wall; the hand has the initial density of skin."""
    none, everywhere = np.zeros(SHAPE, bool), np.ones(SHAPE, bool)
    nothing = np.zeros(colour_model.BINS, np.float32)
    colours = colour_model.ColourModel(nothing, colour_model.hand_colours(plain(WALL)[None], [[]], KNOWN), nothing)
    colours = colours.updated(lab(plain(RED)), object=everywhere, hand=none, background=none)
    return colours.updated(lab(plain(WALL)), object=none, hand=none, background=everywhere)


KNOWN = Background(plain(WALL), np.full(SHAPE, 2, np.float32), np.ones(SHAPE, bool))
UNKNOWN = Background(plain(WALL), np.full(SHAPE, 2, np.float32), np.zeros(SHAPE, bool))


def odds(colour: tuple[int, int, int], background: Background) -> float:
    """Median log likelihood ratio of the object to the more likely of hand and background."""
    object_, hand, wall = colour_model.log_likelihoods(plain(colour), background, learnt_colours())
    return float(np.median(object_ - np.maximum(hand, wall)))


def test_densities_integrate_to_one_over_all_colours() -> None:
    total = learnt_colours().object.sum() * colour_model.BIN_VOLUME
    assert total == pytest.approx(1, abs=1e-5)
    assert learnt_colours().hand.sum() * colour_model.BIN_VOLUME == pytest.approx(1, abs=1e-5)


def test_skin_is_recognised_before_the_first_hand() -> None:
    assert colour_model.skin_coloured(plain(SKIN)).mean() > 0.99
    assert colour_model.skin_coloured(plain((120, 80, 60))).mean() > 0.95
    assert colour_model.skin_coloured(plain(BLUE)).mean() < 0.01
    log_ratio = learnt_colours().hand_log_ratio(lab(plain(SKIN)))
    assert np.median(log_ratio) > 1.5
    assert np.median(learnt_colours().hand_log_ratio(lab(plain(RED)))) < -3


def test_object_and_wall_are_separated_with_and_without_a_static_background() -> None:
    for background in (KNOWN, UNKNOWN):
        assert odds(RED, background) > 4
        assert odds(WALL, background) < -2


def test_a_new_colour_counts_as_object_if_the_background_is_known() -> None:
    """A colour that is neither the background's nor skin is object. Without a static background it is undecided."""
    assert odds(BLUE, KNOWN) > 1
    assert abs(odds(BLUE, UNKNOWN)) < 2.5


def test_a_shadow_on_the_wall_is_background() -> None:
    dark = tuple(round(0.75 * value) for value in WALL)
    assert odds((dark[0], dark[1], dark[2]), KNOWN) < -2


def test_smoothing_removes_specks_and_preserves_edges() -> None:
    """A stray pixel in a plain area flips; the edge between two colours does not move."""
    image = plain(WALL)
    image[:, 15:] = RED
    odds = np.where(np.arange(30) < 15, -2.0, 2.0) * np.ones((24, 1))
    odds[5, 5], odds[5, 25] = 2.0, -2.0
    is_object = colour_model.mean_field_probability(odds.astype(np.float32), image) > 0.5
    assert np.array_equal(is_object, np.broadcast_to(np.arange(30) >= 15, SHAPE))


@pytest.mark.parametrize("wall", [WALL, (0, 0, 0)])
def test_a_silhouette_ends_at_pixels_that_are_half_object(wall: tuple[int, int, int]) -> None:
    """A mask is trimmed to the pixels that are at least half covered.

    The object is a blurred red half-plane up to column 12.6; a pixel is half covered up to column 12.
    """
    coverage = cv2.blur(np.broadcast_to((12.6 - np.arange(SHAPE[1])).clip(0, 1), SHAPE), (3, 3))[..., None]
    mixed = (coverage * np.array(RED) + (1 - coverage) * np.array(wall)).round().astype(np.uint8)
    background = Background(np.full_like(mixed, wall), KNOWN.noise, KNOWN.known)
    wide = np.broadcast_to(np.arange(SHAPE[1]) < 14, SHAPE)
    assert (colour_model.trim_rim(wide, mixed, background) == (coverage[..., 0] >= 0.5)).all()
    # Nothing is trimmed where the background is unknown, and never more than the rim.
    assert (
        colour_model.trim_rim(wide, mixed, Background(background.image, background.noise, UNKNOWN.known)) == wide
    ).all()
    hidden = Background(mixed, background.noise, background.known)
    assert (colour_model.trim_rim(wide, mixed, hidden) >= (np.arange(SHAPE[1]) < 14 - colour_model.RIM_WIDTH)).all()
