"""A hand that holds the object while it is turned, and takes it anew whenever its own turn becomes uncomfortable.

During a *grip* the hand is fixed to the object. Between two grips it opens and moves away, and a hand at another place,
right or left, takes over; the object stays on its path, as if the other hand held it.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tumble.maths import SE3, angle_between
from tumble.synthetic.hand.arm import forearm_curve, forearm_parts, hand_part
from tumble.synthetic.hand.grasp import SURFACE_SAMPLES, Grasps, find_grasps, object_radius, signed_distance
from tumble.synthetic.hand.rig import Rig, read_rig, scaled
from tumble.synthetic.pathtracer import ObjectModel, Part

GRIP_TURN = math.radians(90)
"""Rotation of the object during a grip [radians]: what wrist and shoulder can follow."""
CHANGE = 1.5
"""Time that the hand needs to open and leave, and again to come and close [frames]."""
RETREAT = 1.2
"""Distance of the opened hand from its grip when another one takes over [object radius]."""
ELBOW = (2.9, 2.3, 0.5)
"""Distance of the elbow from the object across, below, and in depth [object radius]; outside of the image."""
MAX_BEND = math.radians(55)
"""Angle between hand and forearm above which a grip is uncomfortable [radians]."""
PLAN_SAMPLES = 300
"""Surface points by which grips are compared: how much of the object they hide."""


@dataclass(frozen=True)
class Grip:
    """One hold of the object."""

    start: float
    """Time of its begin [frames]."""
    end: float
    """Time of its end [frames]."""
    grasp: Grasps
    """The hand, without a batch axis."""
    elbow: Float[Tensor, "3"]
    """Position in the camera frame [object radius]."""


@dataclass(frozen=True)
class HandMotion:
    """The grips of a film."""

    rig: Rig
    """The right hand [object radius]."""
    metre: float
    """Length of a metre [object radius]."""
    grips: tuple[Grip, ...]
    """In order of time."""

    def grip_at(self, time: float) -> Grip:
        """The grip at a time [frames]."""
        return next((grip for grip in self.grips if time < grip.end), self.grips[-1])

    def openness(self, time: float) -> float:
        """0 while the hand holds, 1 when one hand gives way to the next."""
        gaps = [abs(time - grip.end) for grip in self.grips[:-1]]
        return max(0.0, 1 - min(gaps, default=math.inf) / CHANGE)

    def parts(self, time: float, T_cam_obj: SE3, tone: float, seed: int) -> dict[str, Part]:
        """Hand, forearm and sleeve in the object frame at a time [frames], when the object has the pose `T_cam_obj`."""
        grip, openness = self.grip_at(time), self.openness(time)
        opened, away = min(1.0, 2.5 * openness), RETREAT * max(0.0, openness - 0.15) / 0.85
        grasp = grip.grasp
        flexion = (1 - opened) * grasp.flexion + opened * grasp.open_flexion
        shift = away * grasp.retreat
        vertices = grasp.vertices(self.rig, flexion) + shift
        T_obj_hand = torch.eye(4, dtype=torch.float64)
        T_obj_hand[:3, :3], T_obj_hand[:3, 3] = grasp.R_obj_hand, grasp.t_obj_hand + shift
        elbow = _double(T_cam_obj).inverse() @ grip.elbow
        arm = forearm_parts(self.rig, T_obj_hand, elbow, self.metre, tone, seed)
        return {"hand": hand_part(self.rig, vertices, tone)} | arm


def plan(model: ObjectModel, T_cam_obj: SE3, *, facing: bool, seed: int) -> HandMotion:
    """Grips for a film of the object.

    Args:
        model: The object.
        T_cam_obj: Pose of the object on every frame.
        facing: Whether the person faces the camera; else the person is beside the camera.
        seed: Seed of the tried grasps.
    """
    samples, normals = surface_samples(model)
    metre = 1 / object_radius(np.ptp(np.concatenate([part.vertices for part in model.parts]), axis=0))
    rig, distance = scaled(read_rig(), metre), signed_distance(samples, normals)
    hands = {left: find_grasps(rig, distance, left=left, seed=seed) for left in (False, True)}
    thinned = np.random.default_rng(0).choice(len(samples), PLAN_SAMPLES, replace=False)
    surface = torch.from_numpy(samples[thinned]), torch.from_numpy(normals[thinned])
    poses = _double(T_cam_obj)
    seen = torch.zeros(PLAN_SAMPLES, dtype=torch.bool)
    grips = []
    for start, end in grip_times(poses):
        first, last = math.ceil(start), math.floor(end)
        moments = [poses[i] for i in (first, (first + last) // 2, last)]
        rated = [
            (score, shown, grasps[i], elbow)
            for left, grasps in hands.items()
            for elbow in [_elbow(poses, left=left, facing=facing)]
            for i, (score, shown) in enumerate(_rated(rig, grasps, elbow, moments, surface, seen, metre))
        ]
        _, shown, grasp, elbow = max(rated, key=lambda each: each[0])
        seen |= shown
        grips.append(Grip(start, end, grasp, elbow))
    return HandMotion(rig, metre, tuple(grips))


def surface_samples(model: ObjectModel) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Points spread evenly over the object's surface, and its outward normals there."""
    import trimesh

    meshes = [trimesh.Trimesh(part.vertices, part.faces, process=False) for part in model.parts]
    mesh = trimesh.util.concatenate(meshes)
    points, faces = trimesh.sample.sample_surface(mesh, SURFACE_SAMPLES, seed=0)[:2]
    return np.asarray(points), np.asarray(mesh.face_normals[faces])


def grip_times(T_cam_obj: SE3) -> list[tuple[float, float]]:
    """Begin and end of each grip [frames]: equal shares of the object's whole rotation, about `GRIP_TURN` each; the
    changes lie halfway between two frames."""
    R = T_cam_obj.rotation
    steps = angle_between(R[1:], R[:-1])
    turned = torch.cat([torch.zeros(1, dtype=steps.dtype), steps.cumsum(0)])
    n = max(1, round(float(turned[-1]) / GRIP_TURN))
    ends = [int((turned < turned[-1] * i / n).sum()) - 0.5 for i in range(1, n)]
    return list(zip([-0.5, *ends], [*ends, len(turned) - 0.5], strict=True))


def _elbow(poses: SE3, *, left: bool, facing: bool) -> Float[Tensor, "3"]:
    """Position of the elbow in the camera frame: below the object, at the side of the hand as the camera sees it,
    and behind the object if the person faces the camera."""
    across, below, behind = ELBOW
    side = 1.0 if left == facing else -1.0
    return poses.xyz.mean(0) + torch.tensor([side * across, below, behind if facing else -behind], dtype=torch.float64)


def _rated(
    rig: Rig,
    grasps: Grasps,
    elbow: Float[Tensor, "3"],
    moments: list[SE3],
    surface: tuple[Tensor, Tensor],
    seen: Tensor,
    metre: float,
) -> Iterable[tuple[float, Tensor]]:
    """Score of each grasp for one grip, and the surface points that it leaves visible at some of the moments: a score
    is low if the wrist bends far, the arm points to the camera or much of the object is hidden, above all parts that
    have not been seen before."""
    wrist = (grasps.R_obj_hand @ rig.bind[0, :3, 3]) + grasps.t_obj_hand
    back = grasps.R_obj_hand @ rig.bind[0, :3, 2]
    hand = grasps.vertices(rig, grasps.flexion)[:, ::5]
    score = 0.25 * grasps.score
    shown = torch.zeros(len(wrist), len(seen), dtype=torch.bool)
    for T_cam_obj in moments:
        elbow_obj = T_cam_obj.inverse() @ elbow
        bend = torch.acos((torch.nn.functional.normalize(elbow_obj - wrist, dim=-1) * back).sum(-1).clamp(-1, 1))
        to_camera = -(T_cam_obj.rotation @ back)[..., 2]
        score -= 1.5 * (bend - MAX_BEND).clamp_min(0) + (to_camera - 0.4).clamp_min(0)
        arm = forearm_curve(wrist, back, elbow_obj.expand_as(wrist), metre)[:, 4:]
        visible, front = _visible(surface, T_cam_obj.inverse().xyz, hand, arm, metre)
        score -= 1.2 * (front & ~visible).sum(-1) / front.sum()
        shown |= visible
    score += 2.0 * (shown & ~seen).double().mean(-1)
    return zip(score.tolist(), shown, strict=True)


def _visible(
    surface: tuple[Tensor, Tensor], camera_obj: Tensor, hand: Tensor, arm: Tensor, metre: float
) -> tuple[Tensor, Tensor]:
    """Which surface points the camera sees past each hand and arm, and which face the camera; both are approximated by
    balls around their points."""
    points, normals = surface
    to_camera = torch.nn.functional.normalize(camera_obj - points, dim=-1)
    front = (to_camera * normals).sum(-1) > 0.1
    hidden = torch.zeros(len(hand), len(points), dtype=torch.bool)
    for blockers, radius in ((hand, 0.007 * metre), (arm, 0.04 * metre)):
        offset = blockers[:, None] - points[:, None]
        along = (offset * to_camera[:, None]).sum(-1)
        across = (offset**2).sum(-1) - along**2
        hidden |= ((along > 0.02) & (across < radius**2)).any(-1)
    return front & ~hidden, front


def _double(pose: SE3) -> SE3:
    return SE3(pose.wxyz.double(), pose.xyz.double())
