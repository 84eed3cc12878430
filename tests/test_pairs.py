"""Which frames are matched: counted by hand, and on turns whose way round is known."""

import math

import torch

from tumble.pairs import loops_by_rotation, neighbours
from tumble.se3 import SO3


def test_neighbours_are_counted_by_hand() -> None:
    assert neighbours(4, (1, 2)) == [(0, 1), (1, 2), (0, 2), (2, 3), (1, 3)]
    assert neighbours(1) == []
    # 200 frames: 199 + 198 + 196.
    assert len(neighbours(200)) == 593


def turns(angles: list[float], roll: float = 0.0) -> SO3:
    """About the vertical axis of the object, then rolled in front of the camera."""
    y, z = torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.0, 0.0, 1.0])
    return SO3.exp(roll * z) @ SO3.exp(torch.tensor(angles)[:, None] * y)


def test_a_full_turn_closes_where_it_began() -> None:
    """36 frames in steps of 11 degrees: frame 33 is back at 3 degrees."""
    R = turns([math.radians(11 * t) for t in range(36)])
    assert loops_by_rotation(R, count=5, gap=16, widest=math.radians(5)) == [(0, 33)]
    wide = loops_by_rotation(R, count=50, gap=16, widest=math.radians(9), spread=0)
    # 33 steps are 3 degrees too far, 32 are 8 too few: pairs (t, t + 33) and (t, t + 32).
    assert sorted(wide) == sorted([(t, t + 33) for t in range(3)] + [(t, t + 32) for t in range(4)])
    assert wide[0] in [(0, 33), (1, 34), (2, 35)], "the closest first"
    assert loops_by_rotation(R, count=1, gap=16, widest=math.radians(9)) == wide[:1], "no more than asked for"
    assert loops_by_rotation(R, count=9, gap=33, widest=math.radians(9)) == [], "none that the neighbours see"


def test_a_roll_does_not_matter_but_a_turn_does() -> None:
    """The same side seen again, rolled by a right angle, is a loop; another side, however near in time, is none."""
    there, rolled = turns([0.0, 1.0, 2.0]), turns([0.0, 1.0, 2.5], roll=math.pi / 2)
    R = SO3(torch.cat([there.wxyz, rolled.wxyz]))
    found = loops_by_rotation(R, count=9, gap=2, widest=0.1, spread=0)
    assert sorted(found) == [(0, 3), (1, 4)]
