"""Which frames are matched: counted by hand, and on turns whose way round is known."""

import math

import numpy as np
import torch

from tumble.capture import BACKGROUND, OBJECT, UNKNOWN
from tumble.pairs import loops_by_rotation, loops_by_silhouette, neighbours, silhouette_overlap
from tumble.se3 import SO3


def test_neighbours_are_counted_by_hand() -> None:
    assert neighbours(4, (1, 2)) == [(0, 1), (1, 2), (0, 2), (2, 3), (1, 3)]
    assert neighbours(1) == []
    # 200 frames: 199 + 198 + 196 + 192 + 184.
    assert len(neighbours(200)) == 969


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


def wedge(angle: float, centre: tuple[float, float] = (32.0, 32.0), half: float = 8.0) -> torch.Tensor:
    """A lopsided T: no turn but the full one maps it to itself."""
    rows, columns = np.mgrid[:64, :64] + 0.5
    x, y = columns - centre[0], rows - centre[1]
    u, v = math.cos(angle) * x + math.sin(angle) * y, -math.sin(angle) * x + math.cos(angle) * y
    bar = (np.abs(u) < 2 * half) & (np.abs(v + half) < half / 2)
    stem = (np.abs(u - half) < half / 2) & (v > -half) & (v < 2 * half)
    return torch.from_numpy(np.where(bar | stem, OBJECT, BACKGROUND).astype(np.uint8))


def test_overlap_ignores_place_and_roll() -> None:
    masks = torch.stack([wedge(0.0), wedge(0.0, (29.0, 36.0)), wedge(math.pi / 3), wedge(0.0, half=5.0)])
    overlap = silhouette_overlap(masks)
    torch.testing.assert_close(overlap, overlap.T)
    # Nearest pixels on a grid of 48: what is the same differs along borders only.
    assert float(overlap[0, 1]) > 0.9
    assert float(overlap[0, 2]) > 0.85
    # One lens: an object that looks smaller is another view. Its share of the area is (5 / 8)^2 = 0.39 at most.
    assert float(overlap[0, 3]) < 0.4


def test_overlap_is_that_of_brute_force() -> None:
    """Two squares of 40 and 20 pixels about one centre: a quarter."""
    masks = torch.zeros(2, 64, 64, dtype=torch.uint8)
    masks[0, 10:50, 10:50] = OBJECT
    masks[1, 20:40, 20:40] = OBJECT
    # A cell of the grid is 1.2 pixels: the squares are 17 or 18 and 34 or 35 cells wide.
    assert (17 / 35) ** 2 <= float(silhouette_overlap(masks)[0, 1]) <= (18 / 34) ** 2 + 1e-6


def test_what_is_unknown_counts_for_neither() -> None:
    """A strip of the small frame hidden by a hand: over what is known, both are equal."""
    masks = torch.zeros(2, 64, 64, dtype=torch.uint8)
    masks[:, 16:48, 16:48] = OBJECT
    masks[1, 28:36, 16:48] = UNKNOWN
    assert float(silhouette_overlap(masks)[0, 1]) > 0.98
    masks[1, 28:36, 16:48] = BACKGROUND
    assert float(silhouette_overlap(masks)[0, 1]) < 0.8


def test_frames_without_an_object_are_no_candidates() -> None:
    masks = torch.stack([wedge(0.0), wedge(0.0) * 0, wedge(0.0) * 0])
    assert float(silhouette_overlap(masks)[1, 2]) == 0
    assert loops_by_silhouette(masks, count=5, gap=0) == []


def test_silhouettes_find_the_same_side() -> None:
    """A bar that shortens and grows again while it rolls: frame 10 - t looks like frame t, only rolled."""
    rows, columns = np.mgrid[:64, :64] + 0.5
    masks = []
    for t in range(11):
        long, angle = 8 + 16 * abs(math.cos(math.pi * t / 10)), 0.3 * t
        u = math.cos(angle) * (columns - 32) + math.sin(angle) * (rows - 32)
        v = -math.sin(angle) * (columns - 32) + math.cos(angle) * (rows - 32)
        masks.append(torch.from_numpy(np.where((np.abs(u) < long) & (np.abs(v) < 6), OBJECT, 0).astype(np.uint8)))
    (found,) = loops_by_silhouette(torch.stack(masks), count=1, gap=6)
    assert found in [(0, 10), (1, 9)], "and not (0, 9), (1, 10) or (0, 8)"
