"""Selection of frame pairs: counted by hand, and on rotations whose revolutions are known."""

import math

import torch
from torch import Tensor

from tumble.poses.frame_pairs import best_pairs, neighbours


def test_neighbours_are_counted_by_hand() -> None:
    assert neighbours(4, (1, 2)) == [(0, 1), (1, 2), (0, 2), (2, 3), (1, 3)]
    assert neighbours(1) == []
    # 200 frames: 199 + 198 + 196.
    assert len(neighbours(200)) == 593


def similarity() -> Tensor:
    """Cosines of the angles between 36 frames in steps of 11 degrees: frame 33 is 3 degrees past one revolution."""
    angle = math.radians(11) * torch.arange(36)
    return (angle[:, None] - angle).cos()


def test_a_full_revolution_closes_where_it_began() -> None:
    score = similarity()
    assert best_pairs(score, count=5, gap=16, min_score=math.cos(math.radians(5)), spread=2) == [(0, 33)]
    wide = best_pairs(score, count=50, gap=16, min_score=math.cos(math.radians(9)), spread=0)
    # 33 steps are 3 degrees too far, 32 are 8 too few: pairs (t, t + 33) and (t, t + 32).
    assert sorted(wide) == sorted([(t, t + 33) for t in range(3)] + [(t, t + 32) for t in range(4)])
    assert wide[0] in [(0, 33), (1, 34), (2, 35)], "the best first"


def test_count_and_gap_limit_the_pairs() -> None:
    min_score = math.cos(math.radians(9))
    assert len(best_pairs(similarity(), count=1, gap=16, min_score=min_score, spread=0)) == 1
    assert best_pairs(similarity(), count=9, gap=33, min_score=min_score, spread=0) == []
