"""A second look at single frames whose outline contradicts the others': many rotations are tried, the best is kept.

The judge is the frontier (see `frontier`): outlines of all frames together leave a frame little freedom, whatever its
texture. What is tried are the poses of the neighbours in time, turned about many axes.

Outlines do not tell a bottle's bottom from itself half a turn later. A film does: between two frames an object turns
by degrees. Where poses *leap*, one side of the leap is wrong, however well it fits.
"""

from dataclasses import dataclass
from itertools import product

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tumble.maths import SO3, Damping, Linearised, angle_between, minimise, rowwise
from tumble.poses.sfm.frontier_points import Outlines, touch
from tumble.scene import Camera

TURNS = (-0.35, -0.17, 0.17, 0.35)
"""Angles tried about each of 13 axes [radians]."""
KEPT = 6
"""Hypotheses that are refined."""
FEW = 10
"""Planes below which a pose cannot be assessed."""
HOLD = 10.0
"""Weight of the origin's place against one pixel: it moves by a tenth of its distance at most."""
STEP = 1e-4
"""Of the difference quotients."""
LEAP, PACE = 0.7, 0.2
"""Turn from one frame to the next that no matcher survives, and what it may be in the long run [radians]."""
RAGGED = 0.5
"""Noise of a gap where one outline is compared with many: its own errors are the same in all [pixels]."""
TURN, SHIFT = 0.15, 0.02
"""Likewise, where outlines are asked what they know of a pose [radians, distance of the object]."""

Poses = tuple[Float[Tensor, "n 3 3"], Float[Tensor, "n 3"]]
"""`R_cam_obj` and the object's origin, camera frame."""
Pose = tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]


@dataclass(frozen=True)
class Judge:
    """What poses of one frame have to agree with: its outline and those of other frames."""

    others: Poses
    own: Outlines
    """Of the frame, one."""
    outline: Outlines
    """Of the others."""
    camera: Camera
    radius: float
    """Of the object, in the poses' unit."""

    def gaps(self, R: Float[Tensor, "h 3 3"], t: Float[Tensor, "h 3"]) -> Float[Tensor, "h n"]:
        """Distances between touching planes [pixels]; NaN where there are none."""
        h, n = len(R), len(self.others[0])
        mine = torch.arange(h).repeat_interleave(n)
        theirs = torch.arange(n).repeat(h)
        own = Outlines(self.own.corners.expand(h * n, -1, -1), self.own.sure.expand(h * n, -1))
        others = (self.others[0][theirs], self.others[1][theirs])
        found = touch((R[mine], t[mine]), others, own, self.outline[theirs], self.camera, radius=self.radius)
        return torch.where(found.good, found.gap, torch.nan).reshape(h, 2 * n)


def cost(gaps: Float[Tensor, "h n"], scale: float) -> Float[Tensor, " h"]:
    """Mean of Cauchy's loss; infinite where too little can be assessed."""
    known = ~gaps.isnan()
    loss = torch.log1p((torch.where(known, gaps, 0.0) / scale).square()).sum(1)
    return torch.where(known.sum(1) < FEW, torch.inf, loss / known.sum(1).clamp_min(1))


def hypotheses() -> Float[Tensor, "k 3 3"]:
    """No turn, and turns about axes in 13 directions."""
    axes = [axis for axis in product((-1.0, 0.0, 1.0), repeat=3) if axis > (0.0, 0.0, 0.0)]
    unit = torch.nn.functional.normalize(torch.tensor(axes, dtype=torch.float64), dim=-1)
    turns = torch.cat([torch.zeros(1, 3, dtype=torch.float64), *(angle * unit for angle in TURNS)])
    return SO3.exp(turns).matrix()


def unbroken(R: Float[Tensor, "t 3 3"], known: Bool[Tensor, " t"]) -> Bool[Tensor, " t"]:
    """The most known frames that follow each other without a leap; of more in between, each may turn by PACE."""
    frames = torch.nonzero(known)[:, 0]
    turn = angle_between(SO3.from_matrix(R[frames][:, None]), SO3.from_matrix(R[frames]))
    follows = turn < (PACE * (frames[:, None] - frames).abs()).clamp_min(LEAP)
    length, before = [], []
    for k in range(len(frames)):
        reached = [(length[i], i) for i in torch.nonzero(follows[k, :k])[:, 0].tolist()]
        most, previous = max(reached, default=(0, -1))
        length.append(most + 1)
        before.append(previous)
    found = torch.zeros_like(known)
    k = length.index(max(length)) if length else -1
    while k >= 0:
        found[frames[k]] = True
        k = before[k]
    return found


def relocate(judge: Judge, R: Float[Tensor, "h 3 3"], t: Float[Tensor, "h 3"], *, scale: float) -> tuple[Pose, Tensor]:
    """The best of some poses after refinement, and its cost; the first is always among those refined."""
    rough = cost(judge.gaps(R, t), 3 * scale)
    order = torch.cat([torch.zeros(1, dtype=torch.long), rough[1:].argsort()[:KEPT] + 1])
    (R, t), final = _refine(judge, R[order], t[order], scale)
    best = int(final.argmin())
    return (R[best], t[best]), final[best]


def _refine(
    judge: Judge, R: Tensor, t: Tensor, scale: float, steps: int = 8
) -> tuple[tuple[Tensor, Tensor], Float[Tensor, " h"]]:
    """Levenberg-Marquardt on all hypotheses side by side, Jacobians by difference quotients."""
    hold = torch.diag(torch.tensor([0.0] * 3 + [HOLD**2] * 3, dtype=torch.float64))

    def moved(pose: Poses, gaps: Tensor, damping: Tensor) -> Poses:
        R, t = pose
        J = _jacobian(judge, R, t, gaps)
        known = ~(gaps.isnan() | J.isnan().any(-1))
        r, J = torch.where(known, gaps, 0.0), torch.where(known[..., None], J, 0.0)
        w = known / (1 + (r / scale).square())
        H = torch.einsum("ho,hoi,hoj->hij", w, J, J) + hold
        g = torch.einsum("ho,hoi,ho->hi", w, J, r)
        H = H + torch.diag_embed(damping[:, None] * H.diagonal(dim1=1, dim2=2) + 1e-6)
        step = torch.linalg.solve(H, -g[..., None])[..., 0]
        return SO3.exp(step[:, :3].clamp(-0.2, 0.2)).matrix() @ R, t + step[:, 3:].clamp(-0.05, 0.05)

    def linearised(pose: Poses) -> Linearised:
        gaps = judge.gaps(*pose)
        return Linearised(cost(gaps, scale), gaps)

    damping = Damping(start=1e-2, accepted=0.3, rejected=5.0)
    pose, last = minimise((R, t), linearised, moved, rowwise, steps=steps, damping=damping)
    return pose, last.cost


def information(judge: Judge, R: Float[Tensor, "3 3"], t: Float[Tensor, "3"]) -> Float[Tensor, "6 6"]:
    """Of a pose (turn, shift), from gaps of RAGGED pixels of noise [1 / radian^2 and so on].

    By wide differences: outlines have corners, and the slope at one of them says little.
    """
    unit = torch.eye(3, dtype=torch.float64)
    turns = SO3.exp(torch.cat([TURN * unit, -TURN * unit])).matrix()
    turned = judge.gaps(turns @ R, t.expand(6, 3)) / TURN
    shifted = judge.gaps(R.expand(6, 3, 3), t + SHIFT * torch.cat([unit, -unit])) / SHIFT
    J = torch.cat([turned[:3] - turned[3:], shifted[:3] - shifted[3:]]).T / 2
    J = J[~J.isnan().any(-1)]
    return J.mT @ J / RAGGED**2


def _jacobian(judge: Judge, R: Tensor, t: Tensor, gaps: Tensor) -> Float[Tensor, "h n 6"]:
    """Derivatives for a left turn of R and a shift of t."""
    unit = STEP * torch.eye(3, dtype=torch.float64)
    moved = [(SO3.exp(turn).matrix() @ R, t) for turn in unit] + [(R, t + shift) for shift in unit]
    return torch.stack([(judge.gaps(*pose) - gaps) / STEP for pose in moved], -1)
