"""Colours and backdrop as evidence: the signs and bounds that Bayes' rule dictates."""

import cv2
import numpy as np
import pytest

from tumble.preprocess import colour_model
from tumble.preprocess.background import Backdrop

RED, BLUE, SKIN, WALL = (200, 30, 30), (30, 40, 190), (205, 150, 120), (120, 130, 110)
SHAPE = 24, 30


def plain(colour: tuple[int, int, int]) -> np.ndarray:
    noise = np.random.default_rng(0).normal(0, 2, (*SHAPE, 3))
    return (np.array(colour) + noise).clip(0, 255).astype(np.uint8)


def lab(picture: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(picture, cv2.COLOR_RGB2LAB)


def taught() -> colour_model.Colours:
    """A red object before a grey-green wall, held by a hand."""
    none, everywhere = np.zeros(SHAPE, bool), np.ones(SHAPE, bool)
    colours = colour_model.at_first()
    colours = colours.learn(lab(plain(RED)), object=everywhere, hand=none, background=none)
    return colours.learn(lab(plain(WALL)), object=none, hand=none, background=everywhere)


STILL = Backdrop(plain(WALL), np.full(SHAPE, 2, np.float32), np.ones(SHAPE, bool))
NEVER = Backdrop(plain(WALL), np.full(SHAPE, 2, np.float32), np.zeros(SHAPE, bool))


def odds(colour: tuple[int, int, int], still: Backdrop, prior: float = 0.5) -> float:
    flat, nowhere = np.full(SHAPE, prior, np.float32), np.zeros(SHAPE, bool)
    return float(np.median(colour_model.object_odds(plain(colour), flat, nowhere, still, taught())))


def test_densities_integrate_to_one_over_the_cube_of_colours() -> None:
    total = taught().object.sum() * colour_model.BIN_VOLUME
    assert total == pytest.approx(1, abs=1e-5)
    assert colour_model.at_first().hand.sum() * colour_model.BIN_VOLUME == pytest.approx(1, abs=1e-5)


def test_skin_is_known_before_any_hand_was_seen() -> None:
    assert colour_model.skin_coloured(plain(SKIN)).mean() > 0.99
    assert colour_model.skin_coloured(plain((120, 80, 60))).mean() > 0.95
    assert colour_model.skin_coloured(plain(BLUE)).mean() < 0.01
    evidence = taught().hand_evidence(lab(plain(SKIN)))
    assert np.median(evidence) > 1.5
    assert np.median(taught().hand_evidence(lab(plain(RED)))) < -3


def test_the_object_is_told_from_the_wall_with_and_without_a_backdrop() -> None:
    for still in (STILL, NEVER):
        assert odds(RED, still) > 4
        assert odds(WALL, still) < -2


def test_a_new_side_of_the_object_differs_from_the_backdrop() -> None:
    """A colour that nobody has shown: not the backdrop, not skin, so the object's. Without a backdrop none speaks."""
    assert odds(BLUE, STILL) > 1
    assert abs(odds(BLUE, NEVER)) < 2.5


def test_a_shadow_on_the_wall_is_background() -> None:
    dark = tuple(round(0.75 * value) for value in WALL)
    assert odds((dark[0], dark[1], dark[2]), STILL) < -2


def test_the_prior_shifts_the_odds_by_its_own() -> None:
    low, high = odds(BLUE, NEVER, 0.2), odds(BLUE, NEVER, 0.8)
    assert high - low == pytest.approx(2 * np.log(4), abs=1e-3)


def test_a_pixel_named_hand_is_never_object() -> None:
    nowhere, everywhere = np.zeros(SHAPE, bool), np.ones(SHAPE, bool)
    sure = np.full(SHAPE, 0.98, np.float32)
    free = colour_model.object_odds(plain(RED), sure, nowhere, STILL, taught())
    held = colour_model.object_odds(plain(RED), sure, everywhere, STILL, taught())
    assert free.min() > 0
    assert held.max() <= -1


def test_smoothing_takes_specks_away_and_respects_edges() -> None:
    """One stray pixel in a plain area flips; the border between two colours stays where it is."""
    picture = plain(WALL)
    picture[:, 15:] = RED
    field = np.where(np.arange(30) < 15, -2.0, 2.0) * np.ones((24, 1))
    field[5, 5], field[5, 25] = 2.0, -2.0
    found = colour_model.smoothed(field.astype(np.float32), picture) > 0.5
    assert np.array_equal(found, np.broadcast_to(np.arange(30) >= 15, SHAPE))


@pytest.mark.parametrize("wall", [WALL, (0, 0, 0)])
def test_a_silhouette_ends_where_pixels_are_half_object(wall: tuple[int, int, int]) -> None:
    """A red half-plane up to column 12.6, blurred: half is covered up to column 12. Found too wide, it is cut back."""
    coverage = cv2.blur(np.broadcast_to((12.6 - np.arange(SHAPE[1])).clip(0, 1), SHAPE), (3, 3))[..., None]
    mixed = (coverage * np.array(RED) + (1 - coverage) * np.array(wall)).round().astype(np.uint8)
    still = Backdrop(np.full_like(mixed, wall), STILL.noise, STILL.known)
    wide = np.broadcast_to(np.arange(SHAPE[1]) < 14, SHAPE)
    assert (colour_model.trimmed(wide, mixed, still) == (coverage[..., 0] >= 0.5)).all()
    # Not where nothing is known of the backdrop, and never deeper than the rim.
    assert (colour_model.trimmed(wide, mixed, Backdrop(still.picture, still.noise, NEVER.known)) == wide).all()
    hidden = Backdrop(mixed, still.noise, still.known)
    assert (colour_model.trimmed(wide, mixed, hidden) >= (np.arange(SHAPE[1]) < 14 - colour_model.RIM)).all()
