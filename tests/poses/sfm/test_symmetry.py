"""Mirror symmetry of silhouettes whose symmetry is known."""

import math

import torch

from tumble.poses.sfm.symmetry import mirror_symmetry
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN

SIDE = 112


def mask(inside: torch.Tensor) -> torch.Tensor:
    return torch.where(inside, OBJECT, BACKGROUND).to(torch.uint8)[None]


def coordinates(angle: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Coordinates along and across a line at this angle, through a point beside the image centre [pixels]."""
    row, column = torch.meshgrid(torch.arange(SIDE) + 0.5, torch.arange(SIDE) + 0.5, indexing="ij")
    x, y = column - 58, row - 52
    return math.cos(angle) * x + math.sin(angle) * y, -math.sin(angle) * x + math.cos(angle) * y


def bottle(angle: float) -> torch.Tensor:
    """Mask of a thick body with a thin neck, along a line at this angle."""
    u, v = coordinates(angle)
    return mask(((u.abs() < 28) & (v.abs() < 17)) | ((u > 0) & (u < 47) & (v.abs() < 7)))


def test_a_bottle_is_mirror_symmetric_about_its_axis_only() -> None:
    angle = math.radians(40)
    symmetry = mirror_symmetry(bottle(angle))
    assert symmetry.is_revolution
    assert not symmetry.is_sphere, "it is not symmetric across the axis"
    # Lines are half a degree apart, and a pixel is one seventieth of the length.
    assert abs(math.degrees(float(symmetry.line_angle[0])) - 40) <= 1


def test_the_axis_is_chosen_by_the_median_perpendicular_extent() -> None:
    """The bottle is 34 pixels wide; the first image shows it foreshortened, as a rectangle with two mirror lines."""
    u, v = coordinates(1.2)
    first = mask((u.abs() < 21) & (v.abs() < 17))
    symmetry = mirror_symmetry(torch.cat([first, *(bottle(angle) for angle in (0.3, 0.9, 1.4))]))
    assert abs(float(symmetry.axis @ torch.tensor([math.cos(1.2), math.sin(1.2)]))) > 0.999


def test_discs_are_compatible_with_a_sphere() -> None:
    u, v = coordinates(0.0)
    assert mirror_symmetry(mask(u.square() + v.square() < 400)).is_sphere


def test_a_handle_breaks_the_symmetry() -> None:
    """The handle, 30 by 12 pixels against 2500, is on one side of the body only."""
    u, v = coordinates(0.5)
    body = (u.abs() < 36) & (v.abs() < 18)
    assert mirror_symmetry(mask(body)).is_revolution
    assert not mirror_symmetry(mask(body | ((u > 4) & (u < 34) & (v > 0) & (v < 30)))).is_revolution


def test_unknown_pixels_are_ignored() -> None:
    """A hand hides one side of the bottle's neck in the first frame; the second frame shows no object."""
    u, v = coordinates(0.7)
    hidden = bottle(0.7)
    hidden[0][(u > 24) & (v > 1)] = UNKNOWN
    symmetry = mirror_symmetry(torch.cat([hidden, torch.full_like(hidden, BACKGROUND)]))
    assert symmetry.best.tolist()[1] == 0
    assert float(symmetry.best[0]) > 0.9
    assert not mirror_symmetry(torch.full_like(hidden, BACKGROUND)).is_revolution
