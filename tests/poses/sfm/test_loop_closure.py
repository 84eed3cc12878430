"""Loop closures of a painted sphere, for which the surface point of every pixel is known in closed form."""

import math

import pytest
import torch
from torch import Tensor

from tumble.maths.se3 import SE3, SO3
from tumble.poses.sfm import stage
from tumble.poses.sfm.symmetry.loop_closure import loop_closures
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, Capture
from tumble.scene.trajectory import Trajectory

RADIUS, DISTANCE, SIZE, HALF = 0.8, 4.0, 96, 6
CAMERA = Camera.from_fov(math.radians(26), SIZE, SIZE)
TWIST = math.radians(6)
"""Error of the rotations in the second half of the video, about the object's z axis [radians]."""


def orbit_rotations(tilts: list[float], azimuths: list[float]) -> SO3:
    """Rotations `R_cam_obj` of cameras above or below the equator by `tilts`, with the z axis upright."""
    upright = SO3.exp(torch.tensor([math.pi / 2, 0.0, 0.0]))
    x, z = torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 1.0])
    return SO3.exp(torch.tensor(tilts)[:, None] * x) @ upright @ SO3.exp(torch.tensor(azimuths)[:, None] * z)


def intersect_sphere(T_cam_obj: SE3, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Intersections of pixel rays with the sphere, object frame, and whether they exist."""
    T_obj_cam = T_cam_obj.inverse()
    d = torch.nn.functional.normalize(T_obj_cam.rotation @ CAMERA.unproject(uv, torch.ones(uv.shape[:-1])), dim=-1)
    b = (d * T_obj_cam.xyz).sum(-1)
    inside = b * b - (T_obj_cam.xyz @ T_obj_cam.xyz - RADIUS**2)
    return T_obj_cam.xyz + (-b - inside.clamp_min(0).sqrt())[..., None] * d, inside > 0


def painted_sphere_video() -> tuple[Capture, Trajectory]:
    """Six views from above, then six from below of the same sides, 50 degrees apart."""
    tilts, azimuths = [math.radians(25)] * HALF + [math.radians(-25)] * HALF, [0.3 * k for k in range(HALF)] * 2
    T_cam_obj = SE3.from_rotation(orbit_rotations(tilts, azimuths), torch.tensor([0.05, -0.02, DISTANCE]))
    waves = 8 * torch.randn(3, 12, generator=torch.Generator().manual_seed(1))
    images, masks = [], []
    for k in range(2 * HALF):
        x, hit = intersect_sphere(T_cam_obj[k], CAMERA.pixel_centers())
        grey = 0.5 + 0.12 * (x @ waves).sin().sum(-1)
        images.append((255 * grey.clamp(0, 1) * hit)[..., None].expand(-1, -1, 3).to(torch.uint8))
        masks.append(torch.where(hit, OBJECT, BACKGROUND).to(torch.uint8))
    names = tuple(f"{k}.png" for k in range(2 * HALF))
    return Capture(torch.stack(images), torch.stack(masks), CAMERA, names, "camera"), Trajectory(T_cam_obj, "camera")


def test_matches_across_a_wide_angle_are_accurate_although_the_poses_are_not() -> None:
    """A sphere's silhouette does not depend on its rotation; the wrong rotation shifts its paint by about 7 pixels."""
    capture, truth = painted_sphere_video()
    z = torch.tensor([0.0, 0.0, TWIST])
    T = truth.T_cam_obj
    wrong = torch.cat([T.rotation[:HALF].wxyz, (T.rotation[HALF:] @ SO3.exp(z)).wxyz])
    matches = loop_closures(capture, Trajectory(SE3(wrong, T.xyz), "camera"), "mixed", count=20, gap=HALF - 1)
    wide_matches = [match for match in matches if match.i < HALF <= match.j]
    assert len(wide_matches) >= HALF / 2, (
        "every view from above matches one from below; one pair stands for its neighbours"
    )
    assert len({(match.i, match.j) for match in matches}) == len(matches) <= 20
    errors, initial_errors = [], []
    for match in wide_matches:
        x, hit = intersect_sphere(T[match.i], match.uv_i)
        assert bool(hit.all())
        for poses, distances in ((T, errors), (SE3(wrong, T.xyz), initial_errors)):
            distances.append((CAMERA.project(poses[match.j] @ x) - match.uv_j).norm(dim=-1))
    # One of the matched images was warped through a hull of a dozen frames, whose cells are a pixel wide.
    assert float(torch.cat(errors).median()) < 0.6
    assert float(torch.cat(initial_errors).median()) > 4


def test_opposite_views_are_not_matched() -> None:
    """Two views from opposite sides share no surface."""
    capture, truth = painted_sphere_video()
    opposite = orbit_rotations([0.0] * 2, [0.0, math.pi])
    T = SE3.from_rotation(opposite, truth.T_cam_obj.xyz[:2])
    assert loop_closures(capture.select([0, 1]), Trajectory(T, "camera"), "mixed", count=20, gap=0) == []


def test_poses_with_an_empty_hull_have_no_loop_closures() -> None:
    capture, truth = painted_sphere_video()
    away = SE3(truth.T_cam_obj.wxyz, truth.T_cam_obj.xyz + torch.linspace(-1.5, 1.5, 2 * HALF)[:, None])
    assert loop_closures(capture, Trajectory(away, "camera"), "mixed", count=20, gap=3) == []


def test_the_sfm_stage_adds_loop_closures_for_a_body_of_revolution(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every loop closure is a point with two observations that fit the true poses; `Poses.t` is in mean distances."""
    capture, truth = painted_sphere_video()
    monkeypatch.setattr(stage, "LOOP_DISTANCE", HALF - 1)
    inputs, cfg, T = stage.gather(capture, [], "mixed"), stage.Config(), truth.T_cam_obj
    state = stage.init(cfg, inputs, torch.Generator().manual_seed(0))
    known = torch.zeros((), dtype=torch.float64)
    state.params = stage.Poses(T.rotation.matrix().double(), T.xyz.double() / DISTANCE, known)
    state.step = stage.schedule(cfg).index(stage.Step(stage.CloseLoops()))
    stage.step(cfg, inputs, state)
    point, frame, uv = (state.memory[f"loop_{name}"] for name in ("point", "frame", "uv"))
    errors = []
    for k in range(0, int(point.max()), 10):
        a, b = torch.nonzero(point == k)[:, 0].tolist()
        x, _ = intersect_sphere(T[int(frame[a])], uv[a : a + 1].float())
        errors.append((CAMERA.project(T[int(frame[b])] @ x) - uv[b]).norm())
    assert len(errors) > 10
    # The sphere fills half of stage 1's unit sphere, so that the hull's cells are two pixels wide.
    assert float(torch.stack(errors).median()) < 1
