"""Grasps of an object by contact search: the open hand approaches until it touches, then every finger curls joint by
joint until it touches.

Lengths are object radii and positions are in the object frame, unless noted.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tumble.maths import fibonacci_sphere
from tumble.synthetic.hand.rig import FLEXED, Rig, joint_transforms, skinned

LARGEST, GRASPABLE = 0.15, 0.07
"""Object size in relation to the hand: its largest extent is at most the first, its smallest at most the second value
[metres]."""
SURFACE_SAMPLES = 20_000
"""Surface points from which signed distances are computed."""
GRID, REACH = 64, 1.5
"""Signed distances: grid points per axis, and half the side of the grid's cube [object radius]."""
PLACEMENTS = 600
"""Random placements of the palm that are tried per object."""
KEPT = 96
"""Maximum number of grasps that are kept, the best ones."""
STEPS = 9
"""Angles at which each joint is tried between open and closed; the contact is interpolated between two of them."""
PRESS = 0.01
"""Depth to which skin yields where it touches [object radius]."""
TOUCHING = 0.02
"""Maximum distance of a digit that touches the object [object radius]."""
MAX_PENETRATION = 0.035
"""Maximum depth of the hand's vertices below the surface [object radius]."""
CLOSED = ((35.0, 50.0, 60.0), *[(85.0, 95.0, 60.0)] * 4)
"""Maximum flexion of the joints of thumb and fingers [degrees]."""
RELAXED = 0.35
"""Flexion of a digit that meets nothing, as a fraction of the maximum."""
THUMB_BACK = 25.0
"""Extension of the thumb's metacarpal in the open hand [degrees]."""


@dataclass(frozen=True)
class SignedDistance:
    """Signed distance to a surface, negative inside, on a grid over the cube of half side `REACH`."""

    grid: Float[Tensor, "1 1 n n n"]
    """Distances [object radius]; axes z, y, x."""

    def __call__(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Signed distances by linear interpolation; outside the cube an upper bound."""
        inside = points.clamp(-REACH, REACH)
        lookup = (inside / REACH).reshape(1, -1, 1, 1, 3).to(self.grid)
        values = torch.nn.functional.grid_sample(self.grid, lookup, align_corners=True)
        return values.reshape(points.shape[:-1]).to(points) + (points - inside).norm(dim=-1)

    def gradient(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Unit outward directions, by central differences over a grid cell."""
        step = torch.eye(3).to(points) * (2 * REACH / GRID)
        slope = self(points[..., None, :] + step) - self(points[..., None, :] - step)
        return torch.nn.functional.normalize(slope, dim=-1)


def signed_distance(samples: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> SignedDistance:
    """Signed distances from points of a surface with outward normals: distance to the nearest point, with the sign of
    the mean offset along the normals of the nearest three."""
    from scipy.spatial import KDTree

    axis = np.linspace(-REACH, REACH, GRID)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    points = np.stack([x, y, z], -1).reshape(-1, 3)
    distance, index = KDTree(samples).query(points, k=3)
    height = ((points[:, None] - samples[index]) * normals[index]).sum(-1)
    # Close to the surface the height over the tangent plane is exact, while the nearest sample is to the side.
    nearest = np.where(distance[:, 0] < 0.04, np.abs(height).mean(1), distance[:, 0])
    signed = np.where(height.mean(1) < 0, -nearest, nearest)
    return SignedDistance(torch.from_numpy(signed.reshape(1, 1, GRID, GRID, GRID).astype(np.float32)))


@dataclass(frozen=True)
class Grasps:
    """Hands that hold the object."""

    R_obj_hand: Float[Tensor, "*g 3 3"]
    """Rotation of the hand; for a left hand that of its mirror image, which has determinant -1."""
    t_obj_hand: Float[Tensor, "*g 3"]
    """Origin of the hand frame in the object frame."""
    retreat: Float[Tensor, "*g 3"]
    """Unit direction in which the opened hand moves away from the object."""
    flexion: Float[Tensor, "*g 5 3"]
    """Flexion of the joints while the hand holds [radians]."""
    open_flexion: Float[Tensor, "*g 5 3"]
    """Flexion of the joints of the open hand [radians]."""
    opposition: Float[Tensor, "*g"]
    """Opposition of the thumb [radians]."""
    score: Float[Tensor, "*g"]
    """How well thumb and fingers oppose each other; larger is better."""

    def __getitem__(self, index: Tensor | int) -> "Grasps":
        return Grasps(**{name: values[index] for name, values in vars(self).items()})

    def vertices(self, rig: Rig, flexion: Float[Tensor, "*g 5 3"]) -> Float[Tensor, "*g v 3"]:
        """Vertices of the hands with another flexion, in the object frame."""
        v_hand = skinned(rig, joint_transforms(rig, flexion, self.opposition))
        return v_hand @ self.R_obj_hand.mT + self.t_obj_hand[..., None, :]


def object_radius(extents: Float[np.ndarray, "3"]) -> float:
    """Radius of the object in relation to the hand [metres], such that a hand can hold it."""
    return float(min(LARGEST / extents.max(), GRASPABLE / extents.min()))


def find_grasps(rig: Rig, distance: SignedDistance, *, left: bool, seed: int) -> Grasps:
    """The best of `PLACEMENTS` random grasps by a hand, best first; at least one.

    Args:
        rig: The right hand [object radius].
        distance: Signed distance to the object.
        left: Whether the hand is a left one, the mirror image of the right one.
        seed: Seed of the placements.
    """
    rng = torch.Generator().manual_seed(2 * seed + left)
    placed = _placements(rig, distance, rng, left=left)
    held = _closed(rig, distance, placed)
    score = _scores(rig, distance, held)
    order = score.argsort(descending=True)[:KEPT]
    order = order[score[order] > max(0.0, float(score.max()) - 2.5)] if score.max() > 0 else order[:1]
    return dataclasses.replace(held, score=score)[order]


def _placements(rig: Rig, distance: SignedDistance, rng: torch.Generator, *, left: bool) -> Grasps:
    """Open hands around the object with the palm towards it, at the place where they first touch it or up to half a
    radius before it."""
    n = PLACEMENTS

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(n, *shape, generator=rng, dtype=torch.float64)

    away = fibonacci_sphere(n).double()
    across = torch.nn.functional.normalize(torch.linalg.cross(away, torch.randn(n, 3, generator=rng).double()), dim=-1)
    side = torch.linalg.cross(away, across)
    # The palm faces its -y axis and the forearm leaves along +z; the directions are mapped to those of the object.
    R_hand_wrist = rig.bind[0, :3, :3]
    R_obj_wrist = torch.stack([side * (1.0 if left else -1.0), away, -across], -1)
    R_obj_hand = R_obj_wrist @ R_hand_wrist.T
    flexion = torch.zeros(n, 5, 3, dtype=torch.float64)
    flexion[:, 1:, 0] = uniform(-10, 50)[:, None].deg2rad()
    flexion[:, 1:, 1:] = uniform(5, 35)[:, None, None].deg2rad()
    flexion[:, 0, 0] = -np.radians(THUMB_BACK)
    middle = rig.chains[2, 0]
    anchor = 0.25 * rig.bind[0, :3, 3] + 0.75 * rig.bind[middle, :3, 3] + uniform(-0.35, 0.35, 3)
    start = 3 * away - (R_obj_hand @ anchor[..., None])[..., 0]
    hands = Grasps(R_obj_hand, start, away, flexion, flexion, uniform(15, 65).deg2rad(), uniform(0, 0))
    vertices = hands.vertices(rig, flexion)
    slid = torch.zeros(n, dtype=torch.float64)
    for _ in range(12):  # the distance of the nearest vertex is a safe step
        slid += distance(vertices - slid[:, None, None] * away[:, None]).amin(1).clamp_min(0)
    slid -= uniform(0, 0.5) * (uniform(0, 1) < 0.6)
    return dataclasses.replace(hands, t_obj_hand=start - slid[:, None] * away)


def digit_vertices(rig: Rig) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"], Int[Tensor, " n"]]:
    """Vertices that move with the digits: their index, their digit and the last joint of the chain that moves them."""
    strongest = rig.weights.argmax(1)
    digit, level = torch.full_like(strongest, -1), torch.zeros_like(strongest)
    for d, chain in enumerate(rig.chains.tolist()):
        for i, joint in enumerate([*chain, chain[-1] + 1]):
            digit[strongest == joint], level[strongest == joint] = d, min(i, FLEXED - 1)
    (index,) = (digit >= 0).nonzero(as_tuple=True)
    return index, digit[index], level[index]


def _closed(rig: Rig, distance: SignedDistance, hands: Grasps) -> Grasps:
    """The hands with every digit curled joint by joint until the joint's own segment or one beyond it touches."""
    index, digit, level = (values[::2] for values in digit_vertices(rig))
    of_digits = {"vertices": rig.vertices[index], "weights": rig.weights[index], "uv": rig.uv[index]}
    fingers = dataclasses.replace(rig, **of_digits)
    limits = torch.tensor(CLOSED, dtype=torch.float64).deg2rad()
    flexion = hands.flexion.clone()
    touched = torch.zeros(len(flexion), 5, dtype=torch.bool)
    for joint in range(FLEXED):
        start = flexion[:, :, joint]
        fraction = torch.linspace(0, 1, STEPS, dtype=torch.float64)[:, None, None]
        angles = start + fraction * (limits[:, joint] - start).clamp_min(0)
        gaps = []
        for angle in angles:
            tried = flexion.clone()
            tried[:, :, joint] = angle
            gap = distance(hands.vertices(fingers, tried)) + PRESS
            beyond = [gap[:, (digit == d) & (level >= joint)].amin(1) for d in range(5)]
            gaps.append(torch.stack(beyond, 1))
        gap = torch.stack(gaps)
        flexion[:, :, joint], touches = _first_contact(angles, gap)
        touched |= touches
    flexion = torch.where(touched[..., None], flexion, torch.maximum(hands.flexion, RELAXED * limits))
    return dataclasses.replace(hands, flexion=flexion)


def _first_contact(angles: Float[Tensor, "k g 5"], gap: Float[Tensor, "k g 5"]) -> tuple[Tensor, Tensor]:
    """The angle at which the gap first vanishes, else the last one, and whether it vanishes."""
    closed = gap <= 0
    after = torch.where(closed.any(0), closed.int().argmax(0), len(gap) - 1)[None]
    before = (after - 1).clamp_min(0)
    gap_after, gap_before = gap.gather(0, after)[0], gap.gather(0, before)[0]
    share = (gap_before / (gap_before - gap_after).clamp_min(1e-9)).clamp(0, 1)
    share = torch.where(closed.any(0), share, 1.0)
    low, high = angles.gather(0, before)[0], angles.gather(0, after)[0]
    return low + share * (high - low), closed.any(0)


def _scores(rig: Rig, distance: SignedDistance, hands: Grasps) -> Float[Tensor, " g"]:
    """Sum over the touching fingers of how opposite their contact is to the thumb's, plus a tenth per contact; -1 if
    the hand is in the object."""
    index, digit, _ = digit_vertices(rig)
    vertices = hands.vertices(rig, hands.flexion)
    gap = distance(vertices)
    fingers, finger_gap = vertices[:, index], gap[:, index]
    contact, touches = [], []
    for d in range(5):
        nearest = finger_gap[:, digit == d].argmin(1)
        contact.append(fingers[:, digit == d].gather(1, nearest[:, None, None].expand(-1, 1, 3))[:, 0])
        touches.append(finger_gap[:, digit == d].amin(1) < TOUCHING)
    normal, touching = distance.gradient(torch.stack(contact, 1)), torch.stack(touches, 1).double()
    against = -(normal[:, :1] * normal[:, 1:]).sum(-1) * touching[:, :1] * touching[:, 1:]
    score = against.sum(1) + 0.1 * touching.sum(1)
    return torch.where(gap.amin(1) > -MAX_PENETRATION, score, -1.0)
