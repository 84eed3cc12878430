"""Verdicts on made-up evidence."""

import math
from dataclasses import replace

import pytest
import torch

from tumble.poses.result import Observability, PoseQuality

SEEN = Observability(torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.005, 0.004, 0.003]))
ONES = torch.ones(10)
GOOD = PoseQuality(
    0.3 * ONES,
    100 * ONES,
    0.1 * ONES,
    0.97 * ONES,
    math.radians(0.5) * ONES,
    torch.zeros(10) > 0,
    torch.tensor(3.0),
    SEEN,
)


def test_a_good_capture_says_how_good() -> None:
    assert GOOD.verdict == "good"
    assert GOOD.sentence == "Rotations are right to about 0.5 degrees."


def test_two_witnesses_that_disagree_are_a_warning() -> None:
    shaky = replace(GOOD, drift=math.radians(3) * ONES)
    assert shaky.verdict == "warn"
    assert math.degrees(shaky.uncertainty) == pytest.approx(3)
    assert replace(GOOD, drift=math.radians(6) * ONES).verdict == "bad"


def test_silhouettes_that_contradict_each_other_are_bad() -> None:
    """A solution with an overlap of 0.64 was wrong by 45 degrees (median)."""
    astray = replace(GOOD, overlap=0.64 * ONES)
    assert 30 < math.degrees(astray.uncertainty) < 50
    assert astray.verdict == "bad"
    assert astray.sentence.startswith("The silhouettes contradict each other")


def test_lost_frames_are_counted() -> None:
    lost = torch.arange(10) < 2
    some = replace(GOOD, lost=lost, overlap=torch.where(lost, 0.5, 0.97))
    assert some.verdict == "warn"
    assert "2 of 10 frames contradict the others" in some.sentence
    assert replace(GOOD, lost=torch.arange(10) < 6).verdict == "bad"
    assert replace(GOOD, lost=torch.ones(10) > 0).verdict == "bad"


def test_an_object_that_never_turns_is_not_believed() -> None:
    still = replace(GOOD, turn=torch.tensor(0.05))
    assert still.verdict == "bad"
    assert still.sentence.startswith("Rotation is not observable")


def test_an_unseen_axis_may_be_the_objects_or_the_films_fault() -> None:
    """A printed can filmed with much grain looks as bare as a bare one: advice is for both."""
    spin = Observability(torch.tensor([0.0, 1.0, torch.nan]), torch.tensor([math.pi, 0.05, 0.05]))
    hidden = replace(GOOD, observability=spin)
    assert hidden.verdict == "bad"
    assert "axis (0.00, 1.00) of the first picture" in hidden.sentence
    assert "more light" in hidden.sentence
    assert "stick something" in hidden.sentence
