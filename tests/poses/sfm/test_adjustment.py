"""Overlapping windows of frames: the choice between their starts, and how they are joined to larger ones."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from tests.lopsided import tumbling_rotations
from tumble.maths import SO3
from tumble.poses.sfm.adjustment import DISTINCT, Windows, averaged_windows, deviation

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


def turned_about_x(R: Float[Tensor, "*b 3 3"], degrees: float) -> Float[Tensor, "*b 3 3"]:
    """The rotations in another object frame."""
    return R @ SO3.exp(torch.tensor([math.radians(degrees), 0.0, 0.0], dtype=torch.float64)).matrix()


def test_a_larger_window_starts_from_all_pairs_of_motions_of_two_smaller_ones() -> None:
    """Each smaller window has the true motion, in an object frame of its own, and a wrong one, at different places."""
    R = tumbling_rotations(N)
    frames = torch.arange(0, N - SIZE + 1, 2)[:, None] + torch.arange(SIZE)
    right = torch.stack([turned_about_x(R[each], 20.0 * k) for k, each in enumerate(frames)])
    wrong = R[:SIZE].mT.expand(len(frames), -1, -1, -1)
    order = torch.arange(len(frames))[:, None, None, None] % 2
    starts = torch.stack([torch.where(order == 0, right, wrong), torch.where(order == 0, wrong, right)], 1)
    found = Windows(frames, starts, torch.zeros(len(frames), 2, dtype=torch.float64))
    larger = torch.tensor([0, 2, 7, 16])[:, None] + torch.arange(8)
    joined = found.joined(larger)
    assert joined.shape == (4, 4, 8, 3, 3)
    for each, pairs in zip(larger, joined, strict=True):
        errors = torch.stack([deviation(pair, R[each]).max() for pair in pairs])
        assert errors.amin() < 1e-6
        assert (errors > math.radians(5)).sum() == 3


def test_of_starts_that_ended_in_the_same_motion_one_is_kept_before_any_other() -> None:
    R = tumbling_rotations(SIZE)
    same = [turned_about_x(R, 50.0), R, turned_about_x(R, 10.0)]
    other = FLIP @ R @ FLIP
    starts = torch.stack([*same, other])[None]
    assert deviation(R, other).mean() > DISTINCT
    found = Windows(torch.arange(SIZE)[None], starts, torch.tensor([[0.3, 0.1, 0.2, 0.9]], dtype=torch.float64))
    assert found.promising(2).tolist() == [[1, 3]]
    assert found.promising(3).tolist() == [[1, 3, 2]]
    assert found.promising(9).tolist() == [[1, 3, 2, 0]]
