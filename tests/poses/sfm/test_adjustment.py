"""Choice between overlapping windows of frames and their mirror images."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from tests.lopsided import tumbling_rotations
from tumble.poses.sfm.adjustment import Windows, averaged_windows, deviation

N, SIZE = 24, 6
FLIP = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))


def windows(R: Float[Tensor, "t 3 3"], mirrored_loss: Float[Tensor, " g"]) -> Windows:
    """The true rotations in every window with a loss of 0.1, and their mirror image with a given loss."""
    frames = torch.arange(N - SIZE + 1)[:, None] + torch.arange(SIZE)
    right = R[frames]
    mirrored = FLIP @ right @ right[:, SIZE // 2, None].mT @ FLIP @ right[:, SIZE // 2, None]
    loss = torch.stack([torch.full_like(mirrored_loss, 0.1), mirrored_loss], 1)
    return Windows(frames, torch.stack([right, mirrored], 1), loss)


def test_windows_whose_mirror_images_have_smaller_losses_are_outvoted_by_their_neighbours() -> None:
    R = tumbling_rotations(N)
    mirrored_loss = torch.full((N - SIZE + 1,), 0.13, dtype=torch.float64)
    mirrored_loss[7:11] = torch.tensor([0.095, 0.08, 0.05, 0.09])
    found = windows(R, mirrored_loss)
    by_loss = averaged_windows(found.frames, found.best, n_frames=N)
    assert deviation(by_loss, R).max() > math.radians(20)
    together = averaged_windows(found.frames, found.consistent, n_frames=N)
    assert deviation(together, R).max() < math.radians(0.1)


def test_the_losses_of_all_windows_decide_between_a_motion_and_its_mirror_image() -> None:
    R = tumbling_rotations(N)
    found = windows(R, torch.full((N - SIZE + 1,), 0.09, dtype=torch.float64))
    assert torch.equal(found.consistent, found.R[:, 1])


def test_windows_without_common_frames_are_chosen_by_their_losses() -> None:
    R = tumbling_rotations(N)
    found = windows(R, torch.tensor([0.2, 0.05] * 9 + [0.2], dtype=torch.float64))
    apart = Windows(found.frames[::SIZE], found.R[::SIZE], found.loss[[0, 1, 2, 3]])
    assert torch.equal(apart.consistent, apart.best)
