"""Spin of a body of revolution with little texture: an ellipsoid whose every pixel is known in closed form."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tumble.maths import SE3, SO3, angle_between, mean_rotation
from tumble.poses.sfm import stage, symmetry
from tumble.poses.sfm.observations import Inputs
from tumble.scene import BACKGROUND, OBJECT, Camera, Capture, Match, Trajectory

RADII = torch.tensor([0.35, 0.35, 0.8])
FRAMES, DISTANCE, SIZE = 20, 4.0, 96
CAMERA = Camera.from_fov(math.radians(26), SIZE, SIZE)
LIGHT = torch.nn.functional.normalize(torch.tensor([-0.5, -0.6, -1.0]), dim=0)
"""Direction to the light, camera frame, so that shading keeps its place in the image while the object turns."""


def intersect(T_cam_obj: SE3, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Intersections of pixel rays with the ellipsoid, object frame, and whether they exist."""
    T_obj_cam = T_cam_obj.inverse()
    rays = T_obj_cam.rotation @ CAMERA.unproject(uv, torch.ones(uv.shape[:-1]))
    o, d = T_obj_cam.xyz / RADII, rays / RADII
    a, b, c = (d * d).sum(-1), (d * o).sum(-1), (o * o).sum(-1) - 1
    inside = b * b - a * c
    return T_obj_cam.xyz + ((-b - inside.clamp_min(0).sqrt()) / a)[..., None] * rays, inside > 0


def albedo(x: Tensor) -> Tensor:
    """Plain, but for a few dark patches around the body that cover little of it."""
    angle, z = torch.atan2(x[..., 1], x[..., 0]), x[..., 2]
    dark = torch.zeros_like(z, dtype=torch.bool)
    for centre, height in ((-2.6, 0.2), (-1.5, -0.15), (-0.4, 0.05), (0.6, -0.2), (1.7, 0.15), (2.7, -0.05)):
        apart = torch.remainder(angle - centre + math.pi, 2 * math.pi) - math.pi
        dark |= (apart.abs() < 0.2) & ((z - height).abs() < 0.08)
    return torch.where(dark, 0.25, 0.8)


def film(painted: bool = True, frames: int = FRAMES) -> tuple[Capture, Trajectory]:
    """The ellipsoid turns about its axis by 8 degrees a frame, while the axis swings in the image and in depth."""
    k = torch.arange(frames) / FRAMES
    swing = torch.stack([1.5 + 0.4 * (6 * k).sin(), 0.2 * (4 * k).cos(), 0.5 * (5 * k).sin()], -1)
    about_z = torch.tensor([0.0, 0.0, 1.0]) * torch.deg2rad(8.0 * torch.arange(frames))[:, None]
    T = SE3.from_rotation(SO3.exp(swing) @ SO3.exp(about_z), torch.tensor([0.0, 0.0, DISTANCE]))
    return photographed(T, albedo if painted else lambda x: torch.tensor(0.8))


def past_the_end(albedo: Callable[[Tensor], Tensor]) -> tuple[Capture, Trajectory]:
    """The ellipsoid turns about its axis by 5 degrees a frame, and tilts so that the camera sees one side of it, then
    its end, then the other side."""
    k = torch.arange(44)
    tilt = torch.tensor([1.0, 0.0, 0.0]) * torch.linspace(1.55, -1.55, 44)[:, None]
    about_z = torch.tensor([0.0, 0.0, 1.0]) * torch.deg2rad(5.0 * k)[:, None]
    T = SE3.from_rotation(SO3.exp(tilt) @ SO3.exp(about_z), torch.tensor([0.0, 0.0, DISTANCE]))
    return photographed(T, albedo)


def twice(x: Tensor) -> Tensor:
    """One half of the albedo on both sides of the body."""
    return albedo(torch.where(x[..., 1:2] < 0, x * torch.tensor([-1.0, -1.0, 1.0]), x))


def photographed(T: SE3, albedo: Callable[[Tensor], Tensor]) -> tuple[Capture, Trajectory]:
    """Noisy photographs of the shaded ellipsoid at these poses, with an albedo as a function of the surface point."""
    rng = torch.Generator().manual_seed(0)
    frames, images, masks = len(T.xyz), [], []
    for i in range(frames):
        x, hit = intersect(T[i], CAMERA.pixel_centers())
        normal = torch.nn.functional.normalize(T.rotation[i] @ (x / RADII.square()), dim=-1)
        grey = albedo(x) * (0.5 + 0.5 * (normal @ LIGHT).clamp_min(0))
        grey = (255 * grey.clamp(0, 1) + torch.randn(grey.shape, generator=rng)).clamp(0, 255) * hit
        images.append(grey[..., None].expand(-1, -1, 3).to(torch.uint8))
        masks.append(torch.where(hit, OBJECT, BACKGROUND).to(torch.uint8))
    names = tuple(f"{i}.png" for i in range(frames))
    return Capture(torch.stack(images), torch.stack(masks), CAMERA, names, "camera"), Trajectory(T, "camera")


def slipped(truth: Trajectory) -> Trajectory:
    """Poses that show three eighths of the spin too little, as matches on a surface without texture do."""
    angle = torch.deg2rad(-3.0 * torch.arange(FRAMES))[:, None] * torch.tensor([0.0, 0.0, 1.0])
    T = truth.T_cam_obj
    return replace(truth, T_cam_obj=SE3.from_rotation(T.rotation @ SO3.exp(angle), T.xyz))


def consistent_inputs(capture: Capture, trajectory: Trajectory) -> Inputs:
    """Inputs whose matches agree with these poses."""
    T, matches = trajectory.T_cam_obj, []
    for i, j in [(j - gap, j) for gap in (1, 2) for j in range(gap, FRAMES)]:
        uv = CAMERA.pixel_centers()[::4, ::4].reshape(-1, 2)
        x, hit = intersect(T[i], uv)
        target = CAMERA.project(T[j] @ x)
        back, hit_j = intersect(T[j], target)
        seen = hit & hit_j & ((back - x).norm(dim=-1) < 0.02)
        matches.append(Match(i, j, uv[seen], target[seen], torch.ones(int(seen.sum()))))
    return stage.gather(replace(capture, trajectory=None), matches)


def error(T: SE3, truth: Trajectory) -> float:
    """Median rotation error [degrees]."""
    a, b = T.rotation.inverse(), truth.T_cam_obj.rotation.inverse()
    return math.degrees(float(angle_between(b, mean_rotation(b @ a.inverse()) @ a).median()))


@pytest.fixture(scope="module")
def filmed() -> tuple[Capture, Trajectory]:
    return film()


def test_the_spin_is_found_from_little_texture(filmed: tuple[Capture, Trajectory]) -> None:
    capture, truth = filmed
    wrong = slipped(truth)
    found = symmetry.estimate_spin(capture, wrong)
    assert found is not None
    assert found.is_better
    assert error(wrong.T_cam_obj, truth) > 10
    # A cell of the maps is 2 degrees wide.
    assert error(found.surface.turned(wrong, found.angle).T_cam_obj, truth) < 2


def test_a_part_of_the_motion_is_enough_to_contradict_the_poses() -> None:
    """The last six of forty frames slip by 5 degrees each, which changes the mean correlation of all frames little."""
    capture, truth = film(frames=40)
    T, z = truth.T_cam_obj, torch.tensor([0.0, 0.0, 1.0])
    slip = torch.deg2rad(-5.0 * (torch.arange(40) - 34).clamp_min(0))[:, None] * z
    wrong = replace(truth, T_cam_obj=SE3.from_rotation(T.rotation @ SO3.exp(slip), T.xyz))
    found = symmetry.estimate_spin(capture, wrong)
    assert found is not None
    assert float(found.given_correlation.mean() / found.correlation.mean()) > 0.8
    assert found.is_better
    corrected = found.surface.turned(wrong, found.angle).T_cam_obj
    assert math.degrees(float(angle_between(corrected.rotation[-1], corrected.rotation[0]))) == pytest.approx(
        math.degrees(float(angle_between(T.rotation[-1], T.rotation[0]))), abs=3
    )


def test_right_poses_are_not_contradicted(filmed: tuple[Capture, Trajectory]) -> None:
    found = symmetry.estimate_spin(*filmed)
    assert found is not None
    assert not found.is_better


@pytest.mark.parametrize("pattern", [albedo, twice])
def test_parts_before_and_after_a_view_of_the_end_are_joined(pattern: Callable[[Tensor], Tensor]) -> None:
    """Texture that repeats after half a turn is joined without it, as the motion is smooth."""
    capture, truth = past_the_end(pattern)
    right = symmetry.estimate_spin(capture, truth)
    assert right is not None
    assert not right.is_better
    slip = torch.deg2rad(50 * ((torch.arange(44) - 18) / 8).clamp(0, 1))[:, None] * torch.tensor([0.0, 0.0, 1.0])
    T = truth.T_cam_obj
    wrong = replace(truth, T_cam_obj=SE3.from_rotation(T.rotation @ SO3.exp(slip), T.xyz))
    assert error(wrong.T_cam_obj, truth) > 20
    found = symmetry.estimate_spin(capture, wrong)
    assert found is not None
    assert found.joined == 1
    assert found.is_better
    assert error(found.surface.turned(wrong, found.angle).T_cam_obj, truth) < 3


def test_two_trajectories_differ_by_their_axes_whatever_the_spin(filmed: tuple[Capture, Trajectory]) -> None:
    capture, truth = filmed
    slip = symmetry.axis_deviation(capture, truth, slipped(truth))
    assert slip is not None
    assert math.degrees(float(slip.max())) < 3
    # All about the image's x axis, while the object's axis stays near the vertical.
    angle = torch.deg2rad(12 * (0.5 * torch.arange(FRAMES)).sin())
    T = truth.T_cam_obj
    tilt = SO3.exp(angle[:, None] * torch.tensor([1.0, 0.0, 0.0]))
    tilted = replace(truth, T_cam_obj=SE3.from_rotation(tilt @ T.rotation, T.xyz))
    found = symmetry.axis_deviation(capture, truth, tilted)
    assert found is not None
    torch.testing.assert_close(found, angle.abs(), atol=math.radians(2), rtol=0)


def test_shading_alone_does_not_contradict_poses() -> None:
    capture, truth = film(painted=False)
    found = symmetry.estimate_spin(capture, slipped(truth))
    assert found is not None
    assert not found.is_better


def test_poses_that_texture_contradicts_are_not_rated_good(filmed: tuple[Capture, Trajectory]) -> None:
    """Matches and silhouettes agree with the poses to a fraction of a pixel."""
    capture, truth = filmed
    wrong = slipped(truth)
    quality = stage.assess(consistent_inputs(capture, wrong), wrong).quality
    assert quality.rating == "bad"
    assert math.degrees(quality.uncertainty) == pytest.approx(error(wrong.T_cam_obj, truth), rel=0.4)


def test_the_stage_corrects_the_spin_and_drops_the_observations_that_slipped(
    filmed: tuple[Capture, Trajectory],
) -> None:
    capture, truth = filmed
    wrong = slipped(truth)
    inputs = consistent_inputs(capture, wrong)
    cfg = stage.Config()
    state = stage.init(cfg, inputs, torch.Generator().manual_seed(0))
    T = wrong.T_cam_obj
    state.params = stage.Poses(
        T.rotation.matrix().double(), T.xyz.double() / DISTANCE, torch.zeros((), dtype=torch.float64)
    )
    state.step = [step.phase for step in stage.schedule(cfg)].index(stage.AlignTexture())
    stage.step(cfg, inputs, state)
    assert error(SE3.from_rotation_matrix(state.params.R.float()), truth) < 2
    assert not bool(state.memory["steady"].all())


def test_nothing_contradicts_the_observations_of_a_frame_that_looks_along_the_axis(
    filmed: tuple[Capture, Trajectory],
) -> None:
    """The body is taken for a tube, of which no cell faces the camera there."""
    capture, truth = filmed
    found = symmetry.estimate_spin(capture, truth)
    assert found is not None
    tube = replace(found.surface, radius=torch.full_like(found.surface.radius, 0.35))
    T = truth.T_cam_obj
    R = T.rotation.matrix().clone()
    R[3] = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    end_on = replace(truth, T_cam_obj=SE3.from_rotation(SO3.from_matrix(R), T.xyz))
    tracks = consistent_inputs(capture, truth).tracks
    steady = symmetry.steady_observations(capture, end_on, tube, tracks)
    assert bool((tracks.frame == 3).any())
    assert bool(steady[tracks.frame == 3].all())
    assert 0.5 < float(steady[tracks.frame != 3].float().mean()) < 1


@pytest.mark.parametrize("thickness", [0.35, 0.5])
def test_contours_show_the_spin_of_a_body_that_is_not_round(thickness: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """All silhouettes of an ellipsoid are symmetric, also where its three axes differ. Poses that differ by the spin
    alone are the same to contours if two of them are equal."""
    monkeypatch.setitem(globals(), "RADII", torch.tensor([0.35, thickness, 0.8]))
    capture, truth = film()
    inputs = consistent_inputs(capture, truth)
    assert inputs.mirror_symmetry.is_revolution
    cfg = stage.Config(converged_loss=0.0)
    state = stage.init(cfg, inputs, torch.Generator().manual_seed(0))
    steps = stage.schedule(cfg)
    keep = [k for k, step in enumerate(steps) if isinstance(step.phase, stage.KeepBest) and not step.mends]
    for state.step, found in zip(keep[:2], (truth, slipped(truth)), strict=True):
        R, t = found.T_cam_obj.rotation.matrix().double(), found.T_cam_obj.xyz.double() / DISTANCE
        state.params = stage.Poses(R, t, torch.zeros((), dtype=torch.float64))
        stage.step(cfg, inputs, state)
    assert bool(state.memory["agreed"]) == (thickness == 0.35)
