"""Ratings and sentences for made-up pose qualities."""

import math
from dataclasses import replace

import pytest
import torch

from tumble.maths import SE3, SO3
from tumble.poses.result import Observability, PoseQuality, interpolate_lost

OBSERVABLE = Observability(torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.005, 0.004, 0.003]))
ONES = torch.ones(10)
GOOD = PoseQuality(
    0.3 * ONES,
    100 * ONES,
    0.1 * ONES,
    0.97 * ONES,
    math.radians(0.5) * ONES,
    torch.zeros(10) > 0,
    torch.tensor(3.0),
    OBSERVABLE,
)


def test_a_good_capture_states_its_accuracy() -> None:
    assert GOOD.rating == "good"
    assert GOOD.sentence == "Rotations are accurate to about 0.5 degrees."


def test_disagreement_of_tracks_and_contours_is_a_warning() -> None:
    uncertain = replace(GOOD, rotation_disagreement=math.radians(3) * ONES)
    assert uncertain.rating == "warn"
    assert math.degrees(uncertain.uncertainty) == pytest.approx(3)
    assert replace(GOOD, rotation_disagreement=math.radians(6) * ONES).rating == "bad"


def test_inconsistent_silhouettes_are_bad() -> None:
    """A solution with an overlap of 0.64 had a median error of 45 degrees."""
    diverged = replace(GOOD, overlap=0.64 * ONES)
    assert 30 < math.degrees(diverged.uncertainty) < 50
    assert diverged.rating == "bad"
    assert diverged.sentence.startswith("The silhouettes are inconsistent")


def test_lost_frames_are_counted() -> None:
    lost = torch.arange(10) < 2
    some = replace(GOOD, lost=lost, overlap=torch.where(lost, 0.5, 0.97))
    assert some.rating == "warn"
    assert "2 of 10 frames are inconsistent with the others" in some.sentence
    assert replace(GOOD, lost=torch.arange(10) < 6).rating == "bad"
    assert replace(GOOD, lost=torch.ones(10) > 0).rating == "bad"


def test_a_stationary_object_is_bad() -> None:
    still = replace(GOOD, rotation_range=torch.tensor(0.05))
    assert still.rating == "bad"
    assert still.sentence.startswith("Rotation is not observable")


def test_an_unobservable_axis_comes_with_advice_for_object_and_video() -> None:
    """A can with a label in a very noisy video looks like one without a label: the advice covers both."""
    spin = Observability(torch.tensor([0.0, 1.0, torch.nan]), torch.tensor([math.pi, 0.05, 0.05]))
    hidden = replace(GOOD, observability=spin)
    assert hidden.rating == "bad"
    assert "axis (0.00, 1.00) of the first image" in hidden.sentence
    assert "more light" in hidden.sentence
    assert "stick something" in hidden.sentence


def test_lost_poses_at_the_ends_repeat_the_closest() -> None:
    T = SE3(
        SO3.exp(torch.randn(4, 3, generator=torch.Generator().manual_seed(0)).double()).wxyz, torch.rand(4, 3).double()
    )
    interpolated = interpolate_lost(T, torch.tensor([True, False, True, False]))
    torch.testing.assert_close(interpolated.wxyz[0], T.wxyz[1])
    torch.testing.assert_close(interpolated.xyz[2], (T.xyz[1] + T.xyz[3]) / 2)


def test_parts_that_share_few_points_are_named() -> None:
    ties = torch.tensor([torch.inf, 300, 200, 6, torch.inf, 4, 20, 100, 7, 80])
    loose = replace(GOOD, ties=ties)
    assert loose.loose_from == [5, 8], "frame 4 is lost"
    assert loose.rating == "warn"
    assert loose.sentence.startswith("Rotations are accurate to about 0.5 degrees. Hardly any point")
    assert "before and after frame 5 or 8:" in loose.sentence
    assert "before and after frame 5 or 8:" in replace(loose, overlap=0.64 * ONES).sentence
    tied = replace(GOOD, ties=ties.clamp_min(8))
    assert not tied.loose_from
    many = replace(GOOD, ties=torch.tensor([torch.inf, 5, 90, 3, 90, 1, 90, 4, 90, 90]))
    assert many.loose_from == [3, 5, 7]
    assert tied.sentence == GOOD.sentence
