"""What is made of the part of a ball that a hand covers: convex, except where frames show that there is nothing."""

import numpy as np
import pytest
import torch
from jaxtyping import Float

from tests.export.test_unseen import RADIUS, asset, capture
from tumble.export.completion import completed
from tumble.export.depth_fusion import HALF_SIDE, TRUNCATION
from tumble.maths import fibonacci_sphere
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Asset, Capture

__all__ = ["asset", "capture"]  # fixtures
N = 65
CELL = 2 * HALF_SIDE / (N - 1)
GRID = np.stack(np.meshgrid(*[np.arange(N) * CELL - HALF_SIDE] * 3, indexing="ij"), -1)
SEEN = RADIUS * fibonacci_sphere(20000, dtype=torch.float64).numpy()
SEEN = SEEN[SEEN[:, 0] < 0.3]
TIP = np.array([[0.68, 0.0, 0.0]])
"""A point beyond the hand that is seen all the same."""


def distances(*, flat: float) -> Float[np.ndarray, "g g g"]:
    """A ball that is cut off at an x."""
    return np.maximum(np.linalg.norm(GRID, axis=-1) - RADIUS, GRID[..., 0] - flat)


def values(distance: Float[np.ndarray, "g g g"]) -> Float[np.ndarray, "g g g"]:
    return (distance / CELL).clip(-TRUNCATION, TRUNCATION)


def at(x: Float[np.ndarray, "g g g"], *where: float) -> float:
    return float(x[tuple(((np.array(where) + HALF_SIDE) / CELL).round().astype(int))])


def test_what_a_hand_covers_is_completed_up_to_the_convex_hull(asset: Asset, capture: Capture) -> None:
    """A cone from the seen rim at x = 0.3 to the tip, whose radius is 0.22 at x = 0.55."""
    old = values(distances(flat=0.42))
    found = completed(old, np.concatenate([SEEN, TIP]), asset, capture)
    assert at(old, 0.55, 0, 0) > 0
    assert at(found.values, 0.55, 0, 0) < 0
    assert at(found.values, 0.55, 0.15, 0) < 0
    assert at(found.values, 0.55, 0.3, 0) > 0
    assert at(found.changed, 0.55, 0, 0)
    visible = GRID[..., 0] < 0.25
    assert ((found.values < 0) == (old < 0))[visible].all()
    assert not found.changed[visible & (np.abs(old) < 0.5)].any()


def test_what_a_hand_covers_is_cut_off_outside_the_convex_hull(asset: Asset, capture: Capture) -> None:
    """A lump where fingers were, on a ball that is seen up to x = 0.3; also where frames show that nothing is there."""
    for x in (0.55, 0.75):
        lump = np.linalg.norm(GRID - (x, 0, 0), axis=-1) - 0.15
        found = completed(values(np.minimum(distances(flat=0.3), lump)), SEEN, asset, capture)
        assert at(found.values, x, 0, 0) > 0


def test_what_frames_show_to_be_empty_is_not_filled(asset: Asset, capture: Capture) -> None:
    masks = capture.masks.clone()
    masks[::4][masks[::4] == UNKNOWN] = BACKGROUND
    shown = Capture(capture.images, masks, capture.camera, capture.names, "camera")
    found = completed(values(distances(flat=0.42)), np.concatenate([SEEN, TIP]), asset, shown)
    assert at(found.values, 0.6, 0, 0) > 0


@pytest.mark.parametrize("case", ["no hand", "few points", "flat"])
def test_without_a_hand_or_a_hull_nothing_changes(asset: Asset, capture: Capture, case: str) -> None:
    masks = torch.where(capture.masks == UNKNOWN, OBJECT, capture.masks) if case == "no hand" else capture.masks
    given = Capture(capture.images, masks, capture.camera, capture.names, "camera")
    seen = {"no hand": np.concatenate([SEEN, TIP]), "few points": SEEN[::300], "flat": SEEN * (1, 1, 0)}[case]
    old = values(distances(flat=0.42))
    found = completed(old, seen, asset, given)
    assert (found.values == old).all()
    assert not found.changed.any()
