"""Selection of frame pairs, counted by hand."""

from tumble.poses.frame_pairs import neighbours


def test_neighbours_are_counted_by_hand() -> None:
    assert neighbours(4, (1, 2)) == [(0, 1), (1, 2), (0, 2), (2, 3), (1, 3)]
    assert neighbours(1) == []
    # 200 frames: 199 + 198 + 196.
    assert len(neighbours(200)) == 593
