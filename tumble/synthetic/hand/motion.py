"""A hand that holds the object while it is turned, and takes it anew whenever its own turn becomes uncomfortable.

During a *grip* the hand is fixed to the object. Between two grips it opens and moves away, and a hand at another place,
right or left, takes over; the object stays on its path, as if the other hand held it.
"""

import math
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tumble.maths import SE3, angle_between
from tumble.synthetic.hand.arm import forearm_curve, forearm_parts, hand_part
from tumble.synthetic.hand.grasp import (
    SURFACE_SAMPLES,
    Grasps,
    SignedDistance,
    find_grasps,
    object_radius,
    signed_distance,
)
from tumble.synthetic.hand.rig import Rig, read_rig, scaled
from tumble.synthetic.pathtracer import ObjectModel, Part

GRIP_TURN = math.radians(90)
"""Rotation of the object during a grip [radians]: what wrist and shoulder can follow."""
CHANGE = 1.5
"""Time that the hand needs to open and leave, and again to come and close [frames]."""
RETREAT = 1.2
"""Distance of the opened hand from its grip when another one takes over [object radius]."""
ELBOWS = ((2.9, 2.3, 0.5), (3.3, 0.7, 0.5), (1.2, 3.2, 0.5))
"""Places of the elbow outside of the image: distance from the object across, below and in depth [object radius]."""
MAX_BEND = math.radians(55)
"""Angle between hand and forearm above which a grip is uncomfortable [radians]."""
HIDDEN = 0.35
"""Fraction of the object's visible side that a grip should hide; few comfortable grips hide as much."""
COMPARED = 20
"""Most comfortable choices of a grip that are compared by what they hide."""
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


@dataclass(frozen=True)
class _Choices:
    """Every grasp with every place of the elbow."""

    grasps: Grasps
    elbows: Float[Tensor, "c 3"]
    """Positions in the camera frame [object radius]."""
    wrist: Float[Tensor, "c 3"]
    """Positions in the object frame [object radius]."""
    back: Float[Tensor, "c 3"]
    """Unit directions from the hand into the forearm, in the object frame."""

    def __getitem__(self, index: Tensor | int) -> "_Choices":
        return _Choices(**{name: values[index] for name, values in vars(self).items()})


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
    rig, poses = scaled(read_rig(), metre), _double(T_cam_obj)
    choices = _choices(rig, signed_distance(samples, normals), poses.xyz.mean(0), facing=facing, seed=seed)
    thinned = np.random.default_rng(0).choice(len(samples), PLAN_SAMPLES, replace=False)
    surface = torch.from_numpy(samples[thinned]), torch.from_numpy(normals[thinned])
    seen = torch.zeros(PLAN_SAMPLES, dtype=torch.bool)
    grips = []
    for start, end in grip_times(poses):
        first, last = math.ceil(start), math.floor(end)
        moments = [poses[i] for i in (first, (first + last) // 2, last)]
        comfort = _comfort(choices, moments)
        score, number = comfort.topk(min(COMPARED, len(comfort)))
        compared = choices[number]
        hand = compared.grasps.vertices(rig, compared.grasps.flexion)[:, ::3]
        shown = torch.zeros(len(score), PLAN_SAMPLES, dtype=torch.bool)
        for pose in moments:
            elbow_obj = pose.inverse() @ compared.elbows
            arm = forearm_curve(compared.wrist, compared.back, elbow_obj, metre)[:, 4:]
            visible, cosine = _visible(surface, pose.inverse().xyz, hand, arm, metre)
            hidden = 1 - (cosine * visible).sum(-1) / cosine.sum()
            score = score - 2 * (hidden - HIDDEN).abs()
            shown |= visible
        best = int((score + 2 * (shown & ~seen).double().mean(-1)).argmax())
        seen |= shown[best]
        grips.append(Grip(start, end, compared.grasps[best], compared.elbows[best]))
    return HandMotion(rig, metre, tuple(grips))


def _choices(rig: Rig, distance: SignedDistance, centre: Float[Tensor, "3"], *, facing: bool, seed: int) -> _Choices:
    """Grasps of both hands, each with every place of its elbow: at the side of the hand as the camera sees it, and
    behind the object if the person faces the camera, else before it. `centre` is the object's mean position in the
    camera frame."""
    groups = []
    for left in (False, True):
        grasps = find_grasps(rig, distance, left=left, seed=seed)
        signs = centre.new_tensor([1.0 if left == facing else -1.0, 1.0, 1.0 if facing else -1.0])
        for place in ELBOWS:
            elbow = (centre + signs * centre.new_tensor(place)).expand(len(grasps.score), 3)
            wrist = (grasps.R_obj_hand @ rig.bind[0, :3, 3]) + grasps.t_obj_hand
            groups.append(_Choices(grasps, elbow, wrist, grasps.R_obj_hand @ rig.bind[0, :3, 2]))
    joined = {name: torch.cat([vars(g.grasps)[name] for g in groups]) for name in vars(groups[0].grasps)}
    return _Choices(
        Grasps(**joined), *(torch.cat([vars(g)[name] for g in groups]) for name in ("elbows", "wrist", "back"))
    )


def _comfort(choices: _Choices, moments: list[SE3]) -> Float[Tensor, " c"]:
    """How well each choice holds the object, less what the wrist bends too far and the arm points to the camera."""
    score = 0.25 * choices.grasps.score
    for T_cam_obj in moments:
        to_elbow = torch.nn.functional.normalize(T_cam_obj.inverse() @ choices.elbows - choices.wrist, dim=-1)
        bend = torch.acos((to_elbow * choices.back).sum(-1).clamp(-1, 1))
        to_camera = -(T_cam_obj.rotation @ choices.back)[..., 2]
        score = score - 1.5 * (bend - MAX_BEND).clamp_min(0) - (to_camera - 0.4).clamp_min(0)
    return score


def surface_samples(model: ObjectModel) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Points spread evenly over the object's surface, and its outward normals there."""
    import trimesh

    meshes = [trimesh.Trimesh(part.vertices, part.faces, process=False) for part in model.parts]
    mesh = cast(trimesh.Trimesh, trimesh.util.concatenate(meshes))
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


def _visible(
    surface: tuple[Tensor, Tensor], camera_obj: Tensor, hand: Tensor, arm: Tensor, metre: float
) -> tuple[Tensor, Tensor]:
    """Which surface points the camera sees past each hand and arm, which are approximated by balls around their points;
    and the cosine between each point's normal and the direction to the camera, 0 if it faces away."""
    points, normals = surface
    to_camera = torch.nn.functional.normalize(camera_obj - points, dim=-1)
    facing = (to_camera * normals).sum(-1).clamp_min(0)
    hidden = torch.zeros(len(hand), len(points), dtype=torch.bool)
    for blockers, radius in ((hand, 0.005 * metre), (arm, 0.035 * metre)):
        offset = blockers[:, None] - points[:, None]
        along = (offset * to_camera[:, None]).sum(-1)
        across = (offset**2).sum(-1) - along**2
        hidden |= ((along > 0.02) & (across < radius**2)).any(-1)
    return (facing > 0.1) & ~hidden, facing


def _double(pose: SE3) -> SE3:
    return SE3(pose.wxyz.double(), pose.xyz.double())
