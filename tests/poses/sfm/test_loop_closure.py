"""Matches across wide angles, on a painted ball whose every pixel's point is known in closed form."""

import math

import pytest
import torch
from torch import Tensor

from tumble.maths.se3 import SE3, SO3
from tumble.poses.sfm import stage
from tumble.poses.sfm.loop_closure import comebacks
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, Capture
from tumble.scene.trajectory import Trajectory

RADIUS, DISTANCE, SIZE, HALF = 0.8, 4.0, 96, 6
CAMERA = Camera.from_fov(math.radians(26), SIZE, SIZE)
TWIST = math.radians(6)
"""About the object's z axis, by which the second half of the film is wrong."""


def looking(tilts: list[float], azimuths: list[float]) -> SO3:
    """A camera above or below the equator by `tilts`: rotations `R_cam_obj` with the z axis upright."""
    upright = SO3.exp(torch.tensor([math.pi / 2, 0.0, 0.0]))
    x, z = torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 1.0])
    return SO3.exp(torch.tensor(tilts)[:, None] * x) @ upright @ SO3.exp(torch.tensor(azimuths)[:, None] * z)


def met(T_cam_obj: SE3, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays through pixels meet the ball, object frame, and whether they do."""
    T_obj_cam = T_cam_obj.inverse()
    d = torch.nn.functional.normalize(T_obj_cam.rotation @ CAMERA.unproject(uv, torch.ones(uv.shape[:-1])), dim=-1)
    b = (d * T_obj_cam.xyz).sum(-1)
    inside = b * b - (T_obj_cam.xyz @ T_obj_cam.xyz - RADIUS**2)
    return T_obj_cam.xyz + (-b - inside.clamp_min(0).sqrt())[..., None] * d, inside > 0


def film() -> tuple[Capture, Trajectory]:
    """Six views from above, then six from below of the same side: 50 degrees in between."""
    tilts, sides = [math.radians(25)] * HALF + [math.radians(-25)] * HALF, [0.3 * k for k in range(HALF)] * 2
    T_cam_obj = SE3.from_rotation(looking(tilts, sides), torch.tensor([0.05, -0.02, DISTANCE]))
    waves = 8 * torch.randn(3, 12, generator=torch.Generator().manual_seed(1))
    images, masks = [], []
    for k in range(2 * HALF):
        x, hit = met(T_cam_obj[k], CAMERA.pixel_centers())
        grey = 0.5 + 0.12 * (x @ waves).sin().sum(-1)
        images.append((255 * grey.clamp(0, 1) * hit)[..., None].expand(-1, -1, 3).to(torch.uint8))
        masks.append(torch.where(hit, OBJECT, BACKGROUND).to(torch.uint8))
    names = tuple(f"{k}.png" for k in range(2 * HALF))
    return Capture(torch.stack(images), torch.stack(masks), CAMERA, names, "camera"), Trajectory(T_cam_obj, "camera")


def test_points_are_found_again_under_another_angle_though_the_poses_are_off() -> None:
    """The ball's outline says nothing of the wrong turn, which shifts its paint by some seven pixels."""
    capture, truth = film()
    z = torch.tensor([0.0, 0.0, TWIST])
    T = truth.T_cam_obj
    wrong = torch.cat([T.rotation[:HALF].wxyz, (T.rotation[HALF:] @ SO3.exp(z)).wxyz])
    found = comebacks(capture, Trajectory(SE3(wrong, T.xyz), "camera"), "mixed", count=20, gap=HALF - 1)
    wide = [match for match in found if match.i < HALF <= match.j]
    assert len(wide) >= HALF / 2, "every view from above has one from below, and neighbours stand for each other"
    assert len({(match.i, match.j) for match in found}) == len(found) <= 20
    off, before = [], []
    for match in wide:
        x, hit = met(T[match.i], match.uv_i)
        assert bool(hit.all())
        for poses, apart in ((T, off), (SE3(wrong, T.xyz), before)):
            apart.append((CAMERA.project(poses[match.j] @ x) - match.uv_j).norm(dim=-1))
    # Flow between pictures of which one was drawn by a hull of a dozen frames, whose cells are a pixel wide.
    assert float(torch.cat(off).median()) < 0.6
    assert float(torch.cat(before).median()) > 4


def test_only_frames_that_share_a_side_are_matched() -> None:
    """From above and from below, and on opposite sides: 110 degrees of turn leave nothing to compare."""
    capture, truth = film()
    far = looking([0.0] * 2, [0.0, math.pi])
    T = SE3.from_rotation(far, truth.T_cam_obj.xyz[:2])
    assert comebacks(capture.select([0, 1]), Trajectory(T, "camera"), "mixed", count=20, gap=0) == []


def test_poses_that_leave_nothing_of_the_object_have_no_comeback() -> None:
    capture, truth = film()
    away = SE3(truth.T_cam_obj.wxyz, truth.T_cam_obj.xyz + torch.linspace(-1.5, 1.5, 2 * HALF)[:, None])
    assert comebacks(capture, Trajectory(away, "camera"), "mixed", count=20, gap=3) == []


def test_the_graph_route_takes_them_for_points_of_a_body_of_revolution(monkeypatch: pytest.MonkeyPatch) -> None:
    """In its own unit, the mean distance; every point is seen by two frames, in places that the truth agrees with."""
    capture, truth = film()
    monkeypatch.setattr(stage, "AGAIN", HALF - 1)
    inputs, cfg, T = stage.gather(capture, [], "mixed"), stage.Config(), truth.T_cam_obj
    state = stage.init(cfg, inputs, torch.Generator().manual_seed(0))
    known = torch.zeros((), dtype=torch.float64)
    state.params = stage.Poses(T.rotation.matrix().double(), T.xyz.double() / DISTANCE, known)
    state.step = stage.schedule(cfg).index(stage.Step(stage.CloseLoops()))
    stage.step(cfg, inputs, state)
    point, frame, uv = (state.memory[f"loop_{name}"] for name in ("point", "frame", "uv"))
    off = []
    for k in range(0, int(point.max()), 10):
        a, b = torch.nonzero(point == k)[:, 0].tolist()
        x, _ = met(T[int(frame[a])], uv[a : a + 1].float())
        off.append((CAMERA.project(T[int(frame[b])] @ x) - uv[b]).norm())
    assert len(off) > 10
    # In stage 1's ball, half as large as here, the hull's cells are two pixels wide.
    assert float(torch.stack(off).median()) < 1
