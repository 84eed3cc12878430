"""Points located by their texture on a painted sphere, of which the surface point of every pixel is known."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from tumble.maths.se3 import SE3, SO3
from tumble.poses.sfm import stage
from tumble.poses.sfm.adjustment import deviation
from tumble.poses.sfm.symmetry.texture_tracks import texture_tracks
from tumble.poses.sfm.tracks import Tracks
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, Capture
from tumble.scene.trajectory import Trajectory

RADIUS, DISTANCE, SIZE, HALF = 0.8, 4.0, 96, 6
CAMERA = Camera.from_fov(math.radians(26), SIZE, SIZE)
TWIST = math.radians(2)
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


def located(capture: Capture, T_cam_obj: SE3) -> Tracks:
    return texture_tracks(capture, Trajectory(T_cam_obj, "camera"), torch.Generator().manual_seed(0))


def distances(tracks: Tracks, T_cam_obj: SE3, truth: SE3) -> Tensor:
    """Distances of the observations from where poses put the point that the true first view of it shows [pixels]."""
    found = []
    for point in range(0, tracks.n, 5):
        first, *rest = torch.nonzero(tracks.point == point)[:, 0].tolist()
        x, hit = intersect_sphere(truth[int(tracks.frame[first])], tracks.uv[first].float())
        assert bool(hit)
        found += [(CAMERA.project(T_cam_obj[int(tracks.frame[o])] @ x) - tracks.uv[o]).norm() for o in rest]
    return torch.stack(found)


def test_points_are_located_although_the_poses_are_wrong() -> None:
    """A sphere's silhouette does not depend on its rotation; the wrong rotation shifts its paint by two pixels."""
    capture, truth = painted_sphere_video()
    T, z = truth.T_cam_obj, torch.tensor([0.0, 0.0, TWIST])
    wrong = SE3(torch.cat([T.rotation[:HALF].wxyz, (T.rotation[HALF:] @ SO3.exp(z)).wxyz]), T.xyz)
    tracks = located(capture, wrong)
    halves = torch.zeros(tracks.n, 2).index_put_((tracks.point, (tracks.frame >= HALF).long()), torch.tensor(1.0))
    both = halves.all(1)
    assert int(both.sum()) > 100, "views from above and from below, 50 degrees apart, show the same points"
    tracks = tracks.select(both[tracks.point])
    assert float(distances(tracks, T, T).median()) < 0.5
    assert float(distances(tracks, wrong, T).median()) > 1


def test_shading_that_stays_while_the_surface_turns_is_not_texture() -> None:
    """A grey sphere under a highlight and a gradient that are fixed to the camera has no points to locate."""
    capture, truth = painted_sphere_video()
    row, column = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    highlight = torch.exp(-0.5 * ((row - 40) ** 2 + (column - 56) ** 2) / 10**2)
    grey = (60 + 0.4 * column + 90 * highlight)[None, ..., None].expand(2 * HALF, -1, -1, 3)
    noise = torch.randn(2 * HALF, SIZE, SIZE, 1, generator=torch.Generator().manual_seed(2))
    images = ((grey + noise).clamp(0, 255) * (capture.masks == OBJECT)[..., None]).to(torch.uint8)
    shaded = located(replace(capture, images=images), truth.T_cam_obj)
    assert len(shaded) < 0.05 * len(located(capture, truth.T_cam_obj))


def test_opposite_views_share_no_points() -> None:
    capture, truth = painted_sphere_video()
    T = SE3.from_rotation(orbit_rotations([0.0] * 2, [0.0, math.pi]), truth.T_cam_obj.xyz[:2])
    assert len(located(capture.select([0, 1]), T)) == 0


def test_poses_with_an_empty_hull_have_no_points() -> None:
    capture, truth = painted_sphere_video()
    away = SE3(truth.T_cam_obj.wxyz, truth.T_cam_obj.xyz + torch.linspace(-1.5, 1.5, 2 * HALF)[:, None])
    assert len(located(capture, away)) == 0


def test_the_stage_corrects_rotations_that_neither_contours_nor_matches_show() -> None:
    """The silhouettes of a sphere fit any rotation; without matches only its paint tells that half of them are off."""
    capture, truth = painted_sphere_video()
    inputs, cfg, T = stage.gather(capture, []), stage.Config(), truth.T_cam_obj
    twist = SO3.exp(torch.tensor([0.0, 0.0, TWIST]))
    R = torch.cat([T.rotation[:HALF].matrix(), (T.rotation[HALF:] @ twist).matrix()]).double()
    state = stage.init(cfg, inputs, torch.Generator().manual_seed(0))
    state.params = stage.Poses(R, T.xyz.double() / DISTANCE, torch.zeros((), dtype=torch.float64))
    steps = stage.schedule(cfg)
    state.step = len(steps) - cfg.texture_rounds * (1 + len(cfg.texture_scales))
    assert steps[state.step].phase == stage.TrackTexture()
    while state.step < len(steps):
        stage.step(cfg, inputs, state)
        state.step += 1
    assert math.degrees(float(deviation(state.params.R, T.rotation.matrix().double()).max())) < 0.5
