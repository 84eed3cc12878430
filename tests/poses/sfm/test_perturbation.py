"""Random changes of a part of the motion."""

import torch
from jaxtyping import Float
from torch import Tensor

from tests.lopsided import tumbling_rotations
from tumble.maths import SO3, angle_between
from tumble.poses.sfm.perturbation import LARGEST_TURN, LONGEST_PART, mirrored, perturbed, stretched

N = 50


def steps(R: Float[Tensor, "t 3 3"]) -> SO3:
    return SO3.from_matrix(R[1:] @ R[:-1].mT)


def test_a_stretched_motion_rotates_by_more_about_the_same_axes() -> None:
    R = tumbling_rotations(N)
    assert torch.allclose(steps(stretched(R, 1.2)).log(), 1.2 * steps(R).log(), atol=1e-9)
    assert torch.equal(stretched(R, 1.2)[0], R[0])


def test_the_mirror_image_reverses_depth_about_the_middle_frame() -> None:
    """Rotations about x and y change their sign, that about the optical axis does not; its own image is the motion."""
    R = tumbling_rotations(N)[:9]
    flip = torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)
    assert torch.allclose(mirrored(R)[4], R[4])
    # Relative to the middle frame, in camera coordinates.
    before, after = (SO3.from_matrix(x @ x[4].mT).log() for x in (R, mirrored(R)))
    assert torch.allclose(after, flip * before, atol=1e-9)
    assert torch.allclose(mirrored(mirrored(R)), R)


def test_only_one_part_of_the_motion_is_changed_and_the_frames_behind_it_follow() -> None:
    R, rng = tumbling_rotations(N), torch.Generator().manual_seed(0)
    kinds = set()
    for _ in range(200):
        changed = perturbed(R, rng)
        differs = angle_between(steps(changed), steps(R)) > 1e-6
        assert differs.any()
        part = torch.nonzero(differs)[:, 0]
        assert int(part[-1] - part[0]) < LONGEST_PART
        assert torch.equal(changed[0], R[0])
        assert torch.allclose(changed @ changed.mT, torch.eye(3, dtype=torch.float64), atol=1e-9)
        total = angle_between(steps(changed), steps(R)).sum()
        kinds.add(bool(total <= LARGEST_TURN + 1e-6))
    assert kinds == {True, False}
