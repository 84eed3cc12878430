"""Mirror images of silhouettes whose symmetry is known."""

import math

import torch

from tumble.poses.sfm.symmetry import mirrors
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN

SIDE = 112


def drawn(inside: torch.Tensor) -> torch.Tensor:
    return torch.where(inside, OBJECT, BACKGROUND).to(torch.uint8)[None]


def coordinates(angle: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Along and across a line at that angle through a place off the middle of the picture [pixels]."""
    row, column = torch.meshgrid(torch.arange(SIDE) + 0.5, torch.arange(SIDE) + 0.5, indexing="ij")
    x, y = column - 58, row - 52
    return math.cos(angle) * x + math.sin(angle) * y, -math.sin(angle) * x + math.cos(angle) * y


def bottle(angle: float) -> torch.Tensor:
    """A thick body with a thin neck along the line."""
    u, v = coordinates(angle)
    return drawn(((u.abs() < 28) & (v.abs() < 17)) | ((u > 0) & (u < 47) & (v.abs() < 7)))


def test_a_bottle_is_its_own_mirror_image_about_its_axis() -> None:
    angle = math.radians(40)
    found = mirrors(bottle(angle))
    assert found.revolves
    assert not found.ball, "across the axis it is not"
    # Lines are half a degree apart; pixels are of one seventieth of the length.
    assert abs(math.degrees(float(found.line[0])) - 40) <= 1


def test_the_axis_is_the_line_across_which_most_are_as_wide() -> None:
    """A bottle 34 pixels wide; the first picture shows it foreshortened, as a box that has two axes."""
    u, v = coordinates(1.2)
    first = drawn((u.abs() < 21) & (v.abs() < 17))
    found = mirrors(torch.cat([first, *(bottle(angle) for angle in (0.3, 0.9, 1.4))]))
    assert abs(float(found.axis @ torch.tensor([math.cos(1.2), math.sin(1.2)]))) > 0.999


def test_a_disc_is_about_every_line() -> None:
    u, v = coordinates(0.0)
    assert mirrors(drawn(u.square() + v.square() < 400)).ball


def test_a_handle_breaks_the_symmetry() -> None:
    """On one side of the body only, 30 by 12 pixels of 2500: the mirror image has them on the other side."""
    u, v = coordinates(0.5)
    body = (u.abs() < 36) & (v.abs() < 18)
    assert mirrors(drawn(body)).revolves
    assert not mirrors(drawn(body | ((u > 4) & (u < 34) & (v > 0) & (v < 30)))).revolves


def test_what_is_unknown_does_not_break_it() -> None:
    """A hand hides one side of the bottle's neck; without an object there is nothing to say."""
    u, v = coordinates(0.7)
    hidden = bottle(0.7)
    hidden[0][(u > 24) & (v > 1)] = UNKNOWN
    found = mirrors(torch.cat([hidden, torch.full_like(hidden, BACKGROUND)]))
    assert found.best.tolist()[1] == 0
    assert float(found.best[0]) > 0.9
    assert not mirrors(torch.full_like(hidden, BACKGROUND)).revolves
