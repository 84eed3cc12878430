"""Pose jumps in a video of known rotations."""

import math

import torch

from tumble.maths.se3 import SO3
from tumble.poses.sfm.relocalization import longest_smooth_sequence

Y = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


def rotations_of_video(n: int = 20, step: float = math.radians(10)) -> torch.Tensor:
    return SO3.exp(torch.arange(n)[:, None] * step * Y).matrix()


def test_a_smooth_video_is_kept_whole() -> None:
    assert bool(longest_smooth_sequence(rotations_of_video(), torch.ones(20) > 0).all())


def test_the_shorter_side_of_a_pose_jump_is_excluded() -> None:
    R = rotations_of_video()
    R[:3] = R[:3] @ SO3.exp(math.pi * torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)).matrix()
    chosen = longest_smooth_sequence(R, torch.ones(20) > 0)
    assert torch.nonzero(~chosen)[:, 0].tolist() == [0, 1, 2]


def test_a_single_frame_between_two_pose_jumps_is_excluded() -> None:
    """The frames on both sides of it belong together."""
    R = rotations_of_video()
    R[12] = SO3.exp(2.5 * Y).matrix() @ R[12]
    usable = torch.ones(20) > 0
    assert torch.nonzero(longest_smooth_sequence(R, usable))[:, 0].tolist() == [*range(12), *range(13, 20)]


def test_rotation_may_add_up_over_unusable_frames() -> None:
    """Over three unusable frames the object rotates by 40 degrees; the placeholder rotations are never chosen."""
    R = rotations_of_video()
    R[5:8] = torch.eye(3, dtype=torch.float64)
    usable = torch.ones(20) > 0
    usable[5:8] = False
    assert torch.equal(longest_smooth_sequence(R, usable), usable)
    assert not bool(longest_smooth_sequence(R, torch.zeros(20) > 0).any())
