"""Leaps in a film of known turns."""

import math

import torch

from tumble.maths.se3 import SO3
from tumble.poses.sfm.relocalization import unbroken

Y = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


def film(n: int = 20, step: float = math.radians(10)) -> torch.Tensor:
    return SO3.exp(torch.arange(n)[:, None] * step * Y).matrix()


def test_a_smooth_film_is_whole() -> None:
    assert bool(unbroken(film(), torch.ones(20) > 0).all())


def test_the_shorter_side_of_a_leap_is_given_up() -> None:
    R = film()
    R[:3] = R[:3] @ SO3.exp(math.pi * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)).matrix()
    found = unbroken(R, torch.ones(20) > 0)
    assert torch.nonzero(~found)[:, 0].tolist() == [0, 1, 2]


def test_a_single_frame_that_leaps_there_and_back() -> None:
    """What lies on both sides of it belongs together."""
    R = film()
    R[12] = SO3.exp(2.5 * Y).matrix() @ R[12]
    known = torch.ones(20) > 0
    assert torch.nonzero(unbroken(R, known))[:, 0].tolist() == [*range(12), *range(13, 20)]


def test_frames_that_do_not_count_leave_room() -> None:
    """After three missing frames the object has turned by 40 degrees; what stands in for them is never the answer."""
    R = film()
    R[5:8] = torch.eye(3, dtype=torch.float64)
    known = torch.ones(20) > 0
    known[5:8] = False
    assert torch.equal(unbroken(R, known), known)
    assert not bool(unbroken(R, torch.zeros(20) > 0).any())
