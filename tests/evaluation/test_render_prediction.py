"""A reconstruction in an object frame and unit of its own scores as in the true ones: nothing is left unturned.

The asset is a lopsided body of Gaussians with colours and normal detail that have no symmetry, under a light that has
none; the truth is what it shows in its own frame, with damage that is fixed in the picture.
"""

import dataclasses
import math
from typing import Any

import pytest
import torch

from tumble.evaluation import evaluate, metrics, render_prediction
from tumble.evaluation.metrics import Similarity
from tumble.evaluation.prediction import Prediction
from tumble.maths.directions import fibonacci_sphere, local_frame, texel_directions
from tumble.maths.se3 import SE3, SO3
from tumble.rendering import relight
from tumble.scene.asset import Asset
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, Capture, Truth, no_views
from tumble.scene.environment import Environment
from tumble.scene.gaussians import Gaussians
from tumble.scene.material import Material
from tumble.scene.trajectory import Light, Trajectory
from tumble.synthetic import trajectories

SIZE = 32
CAMERA = Camera.from_fov(math.radians(30), SIZE, SIZE)
DISTANCE = trajectories.distance_for(math.radians(30))
CONFIG = relight.Config(brdf_samples=64, light_samples=64)
OTHER_CONFIG = relight.Config(brdf_samples=80, light_samples=80)
"""Of the truth, so that its rays are no run's: equal draws would make a run without disguise too good."""
OTHER = Similarity(torch.tensor(0.8), SO3.exp(torch.tensor([0.7, -1.9, 1.1])), torch.tensor([0.15, -0.1, 0.2]))
"""From the true object frame to the run's: turned by 132 degrees, smaller, and off the centre."""
NAMES = tuple(f"{i:04}.png" for i in range(24))


def a_light(tilt: float) -> Environment:
    """Smooth enough to be told in another frame without loss."""
    d = texel_directions(32, 64)
    lamp = torch.tensor([math.cos(tilt), 0.6, math.sin(tilt)])
    return Environment.from_radiance(
        0.3 + 4 * (4 * (d @ lamp / lamp.norm() - 1)).exp()[..., None] * torch.tensor([1.0, 0.8, 0.5])
    )


def an_asset(light: Light) -> Asset:
    """An ellipsoid off the origin, of axes 0.7, 0.45, 0.3."""
    axes, centre = torch.tensor([0.7, 0.45, 0.3]), torch.tensor([0.1, -0.05, 0.1])
    n = 700
    d = fibonacci_sphere(n)
    frames = local_frame(torch.nn.functional.normalize(d / axes, dim=-1))
    gaussians = Gaussians(
        means=d * axes + centre,
        quats=SO3.from_matrix(frames).wxyz,
        log_scales=torch.tensor([0.05, 0.05, 0.004]).log().expand(n, 3).clone(),
        sdf=torch.zeros(n),
        sh=torch.zeros(n, 1, 3),
    )
    colour = (3 * d + torch.tensor([0.0, 1.0, 2.0])).sin()
    material = dataclasses.replace(
        Material.constant(n, torch.full((3,), 0.5), 0.5),
        albedo_logits=(2 * colour)[:, None].expand(n, 4, 3).clone(),
        roughness_logits=d[:, :1].expand(n, 4).clone(),
        normal_offset=0.3 * torch.tensor([0.0, 1.0, 0.5]).expand(n, 4, 3).clone(),
    )
    poses = trajectories.handheld(len(NAMES), DISTANCE, seed=1)
    trajectory = Trajectory(SE3(poses.wxyz.float(), poses.xyz.float()), light)
    return Asset(gaussians, torch.tensor(200.0), material, a_light(0.4), trajectory, CAMERA)


def disguised(asset: Asset) -> Asset:
    """The same object, told in the frame and unit of `OTHER`."""
    R, scale, old, material = OTHER.R_true_pred, OTHER.scale, asset.gaussians, asset.material
    assert material is not None
    fixed = asset.trajectory.light == "object"
    return dataclasses.replace(
        asset,
        gaussians=dataclasses.replace(
            old,
            means=scale * (R @ old.means) + OTHER.shift,
            quats=(R @ SO3(old.quats)).wxyz,
            log_scales=old.log_scales + scale.log(),
            sdf=scale * old.sdf,
        ),
        gamma=asset.gamma / scale,
        material=dataclasses.replace(material, normal_offset=R @ material.normal_offset),
        environment=asset.environment.rotated(R.matrix()) if fixed else asset.environment,
        trajectory=OTHER.to_truth(asset.trajectory),
    )


def a_truth(asset: Asset) -> tuple[Capture, Truth]:
    """What the asset shows, in its own frame, with damage; and the capture without poses."""
    views = trajectories.sphere_views(3, DISTANCE)
    path = Trajectory(SE3(views.wxyz.float(), views.xyz.float()), asset.trajectory.light)
    black = torch.zeros(len(NAMES), SIZE, SIZE, 3, dtype=torch.uint8)
    capture = Capture(black, black[..., 0], CAMERA, NAMES, asset.trajectory.light)
    empty = torch.zeros(3, SIZE, SIZE, 3, dtype=torch.uint8)
    blank = dataclasses.replace(
        no_views(CAMERA),
        images=empty,
        masks=empty[..., 0] + OBJECT,
        names=("a.png", "b.png", "c.png"),
        regions=("shared", "sphere", "shared"),
        trajectory=path,
        albedo=torch.full((3, SIZE, SIZE, 3), 0.5),
        lights={"lamp": a_light(2.5)},
        poses=asset.trajectory,
    )
    same = Similarity(torch.ones(()), SO3.identity(), torch.zeros(3))
    shown = render_prediction.predict_views(OTHER_CONFIG, asset, capture, blank, same, names=NAMES)
    assert shown.albedo is not None
    assert shown.normals is not None
    assert shown.masks is not None
    assert shown.images is not None
    damage = 0.06 * torch.randn(3, SIZE, SIZE, 3, generator=torch.Generator().manual_seed(0))
    truth = dataclasses.replace(
        blank,
        images=(shown.images + 250 * damage).clamp(0, 255).to(torch.uint8),
        masks=torch.where(shown.masks, OBJECT, BACKGROUND).to(torch.uint8),
        albedo=(shown.albedo + damage).clamp_min(0) * shown.masks[..., None],
        normals=torch.nn.functional.normalize(shown.normals + damage, dim=-1) * shown.masks[..., None],
        roughness=shown.roughness,
        relit={"lamp": (shown.relit["lamp"] + 250 * damage).clamp(0, 255).to(torch.uint8)},
        light=shown.light,
    )
    return capture, truth


def scored(asset: Asset, capture: Capture, truth: Truth) -> tuple[dict[str, Any], str]:
    given = capture.trajectory is not None
    alignment, words = render_prediction.align_views(asset.trajectory, NAMES, capture, truth, given=given)
    predicted = render_prediction.predict_views(CONFIG, asset, capture, truth, alignment, names=NAMES)
    return evaluate.compare(predicted, capture, truth, []), words


@pytest.mark.parametrize("light", ["camera", "object"])
def test_a_run_in_a_frame_of_its_own_scores_as_in_the_true_one(light: Light) -> None:
    asset = an_asset(light)
    capture, truth = a_truth(asset)
    known = dataclasses.replace(capture, trajectory=asset.trajectory)
    mine, given = scored(asset, known, truth)
    theirs, found = scored(disguised(asset), capture, truth)
    assert "its poses were given" in given
    assert "rotation alone (132" in found
    for region in ("shared", "sphere"):
        a, b = mine["regions"][region], theirs["regions"][region]
        for key in ("albedo.psnr_fg_srgb", "relit.psnr_fg_srgb", "image.psnr_fg_srgb"):
            assert 20 < a[key] < 40, "the damage shows"
            # Rays drawn anew move pixels by 3 code values, a fifth of the damage: 0.15 dB.
            assert b[key] == pytest.approx(a[key], abs=0.25), key
        assert b["normal.mean_fg_degrees"] == pytest.approx(a["normal.mean_fg_degrees"], abs=0.1)
        assert 2 < a["normal.mean_fg_degrees"] < 10
        assert b["roughness.rmse_fg"] < 0.01
        assert b["silhouette.iou"] > 0.98
    assert theirs["albedo_scale"] == pytest.approx(mine["albedo_scale"], rel=2e-3)
    assert theirs["light"]["light.rmse_clip10"] < 0.01
    assert theirs["poses"]["poses.rotation_mean_degrees"] < 0.01
    assert theirs["poses"]["poses.auc_percent"] > 99.9


def test_without_the_alignment_nothing_fits() -> None:
    """The test above sees a frame that is forgotten."""
    asset = an_asset("object")
    capture, truth = a_truth(asset)
    other = disguised(asset)
    same = Similarity(torch.ones(()), SO3.identity(), torch.zeros(3))
    right, _ = render_prediction.align_views(other.trajectory, NAMES, capture, truth, given=False)
    assert right is not None
    wrong = render_prediction.predict_views(CONFIG, other, capture, truth, same, names=NAMES)
    good = render_prediction.predict_views(CONFIG, other, capture, truth, right, names=NAMES)
    halves = {"normals": wrong.normals, "relit": wrong.relit, "albedo": wrong.albedo, "light": wrong.light}
    for part, value in halves.items():
        scores = evaluate.compare(dataclasses.replace(good, **{part: value}), capture, truth, [])
        shared = scores["regions"]["shared"]
        assert {
            "normals": shared["normal.mean_fg_degrees"] > 30,
            "relit": shared["relit.psnr_fg_srgb"] < 15,
            "albedo": shared["albedo.psnr_fg_srgb"] < 15,
            "light": scores["light"]["light.rmse_clip10"] > 0.1,
        }[part], part


def test_a_drifting_tracker_still_shows_the_object_in_its_place() -> None:
    """Orientations that drift by 12 degrees: the mean turn is right, and so are scale and shift."""
    asset = an_asset("camera")
    capture, truth = a_truth(asset)
    drift = torch.linspace(-1, 1, len(NAMES))[:, None] * math.radians(6) * torch.tensor([0.6, 0.0, 0.8])
    turns = SE3.from_rotation(SO3.exp(drift), torch.zeros(len(NAMES), 3))
    path = Trajectory(asset.trajectory.T_cam_obj @ turns, "camera")
    scores, _ = scored(dataclasses.replace(disguised(asset), trajectory=OTHER.to_truth(path)), capture, truth)
    assert scores["poses"]["poses.rotation_mean_degrees"] == pytest.approx(3.1, abs=0.3)
    assert scores["regions"]["shared"]["normal.mean_fg_degrees"] < 6
    assert scores["regions"]["shared"]["silhouette.iou"] > 0.97


def test_what_another_lens_saw_is_brought_to_where_this_one_sees_it_as_large() -> None:
    """A lens longer by a fifth sees the object as large from a fifth farther off: nothing else is to be aligned."""
    asset = an_asset("camera")
    capture, truth = a_truth(asset)
    T = asset.trajectory.T_cam_obj
    farther = Trajectory(dataclasses.replace(T, xyz=T.xyz * torch.tensor([1.0, 1.0, 1.2])), "camera")
    found, words = render_prediction.align_views(farther, NAMES, capture, truth, given=False, lens=1 / 1.2)
    assert found is not None
    assert float(found.scale) == pytest.approx(1, abs=1e-4)
    assert float(found.R_true_pred.angle()) < 1e-3
    assert found.shift.abs().max() < 1e-4
    assert "depths times 0.8333" in words
    plain, words = render_prediction.align_views(farther, NAMES, capture, truth, given=False)
    assert plain is not None
    # Otherwise the object would be drawn a fifth too large.
    assert float(plain.scale) == pytest.approx(1 / 1.2, abs=0.01)
    assert "depths" not in words


def test_what_cannot_be_aligned_is_a_prediction_of_poses_and_says_so() -> None:
    asset = an_asset("camera")
    capture, truth = a_truth(asset)
    still = Trajectory(asset.trajectory.select([0] * len(NAMES)).T_cam_obj, "camera")
    nothing, words = render_prediction.align_views(
        still, NAMES, capture, dataclasses.replace(truth, poses=still), given=False
    )
    assert nothing is None
    assert "hardly turns" in words
    made = render_prediction.predict_views(CONFIG, asset, capture, truth, None, names=NAMES)
    assert made.albedo is None
    assert made.poses is asset.trajectory
    assert made.light is asset.environment, "the camera's frame needs no alignment"
    fixed = render_prediction.predict_views(CONFIG, an_asset("object"), capture, truth, None, names=NAMES)
    assert fixed.light is None
    bare = dataclasses.replace(truth, poses=None)
    blind, words = render_prediction.align_views(asset.trajectory, NAMES, capture, bare, given=False)
    assert blind is None
    assert "unknown" in words


def test_true_poses_of_some_frames_align_and_score_those() -> None:
    """Frames that nobody annotated are left out, those that the tracker lost are counted."""
    asset = an_asset("camera")
    capture, truth = a_truth(asset)
    annotated = list(range(0, 24, 2))
    some = dataclasses.replace(
        truth, poses=asset.trajectory.select(annotated), pose_names=tuple(NAMES[i] for i in annotated)
    )
    other = disguised(asset)
    kept = [i for i in range(24) if i not in (4, 7)]
    names = tuple(NAMES[i] for i in kept)
    path = other.trajectory.select(kept)
    alignment, words = render_prediction.align_views(path, names, capture, some, given=False)
    assert alignment is not None
    assert "11 training poses" in words
    torch.testing.assert_close(alignment.to_truth(path).T_cam_obj.xyz, asset.trajectory.select(kept).T_cam_obj.xyz)
    predicted = Prediction(poses=path, pose_names=names)
    scores = evaluate.compare(predicted, capture, some, [])["poses"]
    assert (scores["poses.posed_frames"], scores["poses.lost_frames"]) == (11, 1)
    assert scores["poses.auc_percent"] == pytest.approx(100 * 11 / 12, abs=1e-2)
    assert scores["poses.rpe_rotation_degrees"] == pytest.approx(0, abs=1e-2), "between annotated neighbours"
    assert scores["poses.rotation_longest_run_percent"] == pytest.approx(100 * 9 / 12)


def test_registering_undoes_a_similarity() -> None:
    truth = an_asset("camera").trajectory
    found = metrics.register(OTHER.to_truth(truth), truth)
    undone = found.to_truth(OTHER.to_truth(truth))
    torch.testing.assert_close(undone.T_cam_obj.matrix(), truth.T_cam_obj.matrix(), atol=1e-5, rtol=0)
    assert float(found.scale * OTHER.scale) == pytest.approx(1, abs=1e-5)
