"""Relocalization: a search over candidate rotations for frames whose contour contradicts those of other frames.

A pose is rated by its epipolar tangency gaps (see `frontier_points`). The contours of all other frames together leave
a frame little freedom, whatever its texture. The candidates are the poses of the neighbouring frames, rotated about
many axes, and the best of them are refined by Levenberg-Marquardt.

Contours alone cannot exclude all wrong poses: a bottle seen from below has nearly the same contour after half a
revolution. In a video, however, an object rotates by only a few degrees between frames. Where consecutive poses differ
by much more (a pose jump), those on one side are wrong, however small their gaps.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from tumble.maths import SO3, Damping, Linearised, angle_between, minimise, select_rows
from tumble.poses.sfm.frontier_points import Contours, cauchy_loss, epipolar_tangencies
from tumble.scene import Camera

CANDIDATE_ANGLES = (-0.35, -0.17, 0.17, 0.35)
"""Angles of the candidate rotations about each of 13 axes [radians]."""
MAX_REFINED = 6
"""Number of candidates that are refined, besides the current pose."""
MIN_GAPS = 10
"""Minimum number of valid gaps for a pose to be rated."""
TRANSLATION_DAMPING = 10.0
"""Damping of translation steps [pixels / object's mean distance]: a step of a tenth weighs as much as a pixel."""
JACOBIAN_STEP = 1e-4
"""Finite-difference step of `_jacobian` [radians; object's mean distance]."""
POSE_JUMP = 0.7
"""Rotation between consecutive frames that counts as a pose jump [radians]; matching fails well below it."""
MAX_ROTATION_PER_FRAME = 0.2
"""Maximum rotation per frame between frames that are further apart in time [radians]."""
GAP_NOISE = 0.5
"""Standard deviation of a gap [pixels]; large, because errors of a frame's contour are common to all its gaps."""
ROTATION_STEP = 0.15
"""Finite-difference step of rotations in `information` [radians]; wide, because contours are polygons."""
TRANSLATION_STEP = 0.02
"""Finite-difference step of translations in `information` [object's mean distance]."""

Poses = tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 3"]]
"""`R_cam_obj` and the object's origin in the camera frame [object's mean distance], for several frames."""
Pose = tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]
"""The same for one frame."""


@dataclass(frozen=True)
class ContourConstraints:
    """Epipolar tangency constraints between the contour of one frame and those of reference frames."""

    reference_poses: Poses
    contour: Contours
    """Contour of the frame, as a batch of one."""
    reference_contours: Contours
    camera: Camera
    """Camera of all frames."""
    radius: float
    """Object radius [object's mean distance]."""

    def gaps(self, R: Float[Tensor, "h 3 3"], t: Float[Tensor, "h 3"]) -> Float[Tensor, "h n"]:
        """Tangency gaps of `h` candidate poses, two per reference frame [pixels]; NaN where they are not valid."""
        h, n = len(R), len(self.reference_poses[0])
        candidate = torch.arange(h).repeat_interleave(n)
        reference = torch.arange(n).repeat(h)
        reference_poses = (self.reference_poses[0][reference], self.reference_poses[1][reference])
        tangencies = epipolar_tangencies(
            (R[candidate], t[candidate]),
            reference_poses,
            self.contour[torch.zeros_like(reference)],
            self.reference_contours[reference],
            self.camera,
            radius=self.radius,
        )
        return torch.where(tangencies.valid, tangencies.gap, torch.nan).reshape(h, 2 * n)


def robust_cost(gaps: Float[Tensor, "h n"], scale: float) -> Float[Tensor, " h"]:
    """Mean Cauchy loss of each candidate's gaps; infinite where fewer than `MIN_GAPS` are valid.

    Args:
        gaps: Tangency gaps [pixels], NaN where not valid.
        scale: Scale of the Cauchy loss [pixels].
    """
    valid = ~gaps.isnan()
    loss = cauchy_loss(torch.where(valid, gaps, 0.0), scale).sum(1)
    return torch.where(valid.sum(1) < MIN_GAPS, torch.inf, loss / valid.sum(1).clamp_min(1))


def candidate_rotations(angles: Sequence[float] = CANDIDATE_ANGLES) -> Float[Tensor, "k 3 3"]:
    """The identity, and rotations by angles of either sign [radians] about axes in 13 directions."""
    axes = [axis for axis in product((-1.0, 0.0, 1.0), repeat=3) if axis > (0.0, 0.0, 0.0)]
    unit = torch.nn.functional.normalize(torch.tensor(axes, dtype=torch.float64), dim=-1)
    omega = torch.cat([torch.zeros(1, 3, dtype=torch.float64), *(angle * unit for angle in angles)])
    return SO3.exp(omega).matrix()


def longest_smooth_sequence(
    R: Float[Tensor, "t 3 3"], usable: Bool[Tensor, " t"], confirmed: Int64[Tensor, " t"] | None = None
) -> Bool[Tensor, " t"]:
    """Mask of the longest sequence of usable frames without a pose jump, by dynamic programming.

    Frames may be skipped. Two successive frames of the sequence differ by less than `POSE_JUMP`, or by less than
    `MAX_ROTATION_PER_FRAME` times their distance in frames where that is more.

    Args:
        R: `R_cam_obj` of all frames.
        usable: Frames that the sequence may consist of.
        confirmed: Part of the motion that every frame belongs to, negative if colours do not confirm how the part is
            joined to the others; between parts that they confirm there may be a pose jump. None: one part.
    """
    frames = torch.nonzero(usable)[:, 0]
    angle = angle_between(SO3.from_matrix(R[frames][:, None]), SO3.from_matrix(R[frames]))
    follows = angle < (MAX_ROTATION_PER_FRAME * (frames[:, None] - frames).abs()).clamp_min(POSE_JUMP)
    if confirmed is not None:
        part = confirmed[frames]
        follows |= (part[:, None] != part) & (part[:, None] >= 0) & (part >= 0)
    length, predecessor = [], []
    for k in range(len(frames)):
        candidates = [(length[i], i) for i in torch.nonzero(follows[k, :k])[:, 0].tolist()]
        longest, previous = max(candidates, default=(0, -1))
        length.append(longest + 1)
        predecessor.append(previous)
    chosen = torch.zeros_like(usable)
    k = length.index(max(length)) if length else -1
    while k >= 0:
        chosen[frames[k]] = True
        k = predecessor[k]
    return chosen


def relocalize(
    constraints: ContourConstraints, R: Float[Tensor, "h 3 3"], t: Float[Tensor, "h 3"], *, scale: float
) -> tuple[Pose, Tensor]:
    """The pose of lowest robust cost after refinement of the best candidates, and its cost.

    Args:
        constraints: Contours and poses of the reference frames.
        R: Rotations `R_cam_obj` of the candidates; the first candidate, the current pose, is always refined.
        t: The object's origin in the camera frame for each candidate [object's mean distance].
        scale: Scale of the Cauchy loss [pixels].
    """
    initial_cost = robust_cost(constraints.gaps(R, t), 3 * scale)
    order = torch.cat([torch.zeros(1, dtype=torch.long), initial_cost[1:].argsort()[:MAX_REFINED] + 1])
    (R, t), final_cost = _refine(constraints, R[order], t[order], scale)
    best = int(final_cost.argmin())
    return (R[best], t[best]), final_cost[best]


def _refine(
    constraints: ContourConstraints, R: Tensor, t: Tensor, scale: float, steps: int = 8
) -> tuple[tuple[Tensor, Tensor], Float[Tensor, " h"]]:
    """Candidates refined side by side by Levenberg-Marquardt with finite-difference Jacobians, and their costs."""

    def moved(pose: Poses, gaps: Tensor, damping: Tensor) -> Poses:
        R, t = pose
        rotation, shift = damped_step(gaps, _jacobian(constraints, R, t, gaps), damping, scale)
        return SO3.exp(rotation).matrix() @ R, t + shift

    def linearised(pose: Poses) -> Linearised:
        gaps = constraints.gaps(*pose)
        return Linearised(robust_cost(gaps, scale), gaps)

    damping = Damping(start=1e-2, accepted=0.3, rejected=5.0)
    pose, last = minimise((R, t), linearised, moved, select_rows, steps=steps, damping=damping)
    return pose, last.cost


def damped_step(
    gaps: Float[Tensor, "h n"], J: Float[Tensor, "h n p"], damping: Float[Tensor, " h"], scale: float
) -> tuple[Float[Tensor, "h 3"], Float[Tensor, "h q"]]:
    """Levenberg-Marquardt steps of the robust cost: rotations [radians], and all other parameters [mean distance].

    Args:
        gaps: Tangency gaps [pixels], NaN where not valid.
        J: Their derivatives with respect to a rotation, and to lengths in units of the object's mean distance.
        damping: Of every hypothesis, relative to the diagonal.
        scale: Scale of the Cauchy loss [pixels].
    """
    valid = ~(gaps.isnan() | J.isnan().any(-1))
    r, J = torch.where(valid, gaps, 0.0), torch.where(valid[..., None], J, 0.0)
    w = valid / (1 + (r / scale).square())
    of_lengths = J.new_tensor([0.0] * 3 + [TRANSLATION_DAMPING**2] * (J.shape[-1] - 3))
    H = torch.einsum("hn,hni,hnj->hij", w, J, J) + torch.diag(of_lengths)
    g = torch.einsum("hn,hni,hn->hi", w, J, r)
    H = H + torch.diag_embed(damping[:, None] * H.diagonal(dim1=1, dim2=2) + 1e-6)
    step = torch.linalg.solve(H, -g[..., None])[..., 0]
    return step[:, :3].clamp(-0.2, 0.2), step[:, 3:].clamp(-0.05, 0.05)


def information(
    constraints: ContourConstraints, R: Float[Tensor, "3 3"], t: Float[Tensor, "3"]
) -> Float[Tensor, "6 6"]:
    """Fisher information of the gaps about a pose, as (rotation, translation) of the object in the camera frame.

    Units are those of inverse covariances [radians; object's mean distance]. Central differences are wide, because the
    contours are polygons and derivatives at their vertices are not representative.
    """
    unit = torch.eye(3, dtype=torch.float64)
    rotations = SO3.exp(torch.cat([ROTATION_STEP * unit, -ROTATION_STEP * unit])).matrix()
    rotated = constraints.gaps(rotations @ R, t.expand(6, 3)) / ROTATION_STEP
    shifted = constraints.gaps(R.expand(6, 3, 3), t + TRANSLATION_STEP * torch.cat([unit, -unit])) / TRANSLATION_STEP
    J = torch.cat([rotated[:3] - rotated[3:], shifted[:3] - shifted[3:]]).T / 2
    J = J[~J.isnan().any(-1)]
    return J.mT @ J / GAP_NOISE**2


def _jacobian(constraints: ContourConstraints, R: Tensor, t: Tensor, gaps: Tensor) -> Float[Tensor, "h n 6"]:
    """Derivatives of the gaps with respect to a left rotation of R and a shift of t, by forward differences."""
    unit = JACOBIAN_STEP * torch.eye(3, dtype=torch.float64)
    moved = [(SO3.exp(omega).matrix() @ R, t) for omega in unit] + [(R, t + shift) for shift in unit]
    return torch.stack([(constraints.gaps(*pose) - gaps) / JACOBIAN_STEP for pose in moved], -1)
