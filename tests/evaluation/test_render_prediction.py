"""Scores do not depend on the object frame and unit of a reconstruction: everything is transformed with the alignment.

The asset is an ellipsoid of Gaussians off the origin; colours, normal detail and light have no symmetry. The truth is
its render in its own frame, with errors that are fixed in the image.
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
from tumble.scene.capture import BACKGROUND, OBJECT, Capture, RelitViews, Truth, truth_without_views
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
"""For rendering the truth: with the same random rays as a prediction, the scores would be too good."""
OTHER = Similarity(torch.tensor(0.8), SO3.exp(torch.tensor([0.7, -1.9, 1.1])), torch.tensor([0.15, -0.1, 0.2]))
"""From the true object frame to the run's: rotated by 132 degrees, smaller, and shifted."""
NAMES = tuple(f"{i:04}.png" for i in range(24))


def smooth_light(tilt: float) -> Environment:
    """Light that is smooth enough for resampling in a rotated frame without loss."""
    d = texel_directions(32, 64)
    lamp = torch.tensor([math.cos(tilt), 0.6, math.sin(tilt)])
    return Environment.from_radiance(
        0.3 + 4 * (4 * (d @ lamp / lamp.norm() - 1)).exp()[..., None] * torch.tensor([1.0, 0.8, 0.5])
    )


def ellipsoid_asset(light: Light) -> Asset:
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
    return Asset(gaussians, torch.tensor(200.0), material, smooth_light(0.4), trajectory, CAMERA)


def reexpressed(asset: Asset) -> Asset:
    """The same asset, expressed in the object frame and unit of `OTHER`."""
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


def rendered_truth(asset: Asset) -> tuple[Capture, Truth]:
    """The capture without poses, and as truth the asset's render in its own frame, with errors."""
    views = trajectories.sphere_views(3, DISTANCE)
    path = Trajectory(SE3(views.wxyz.float(), views.xyz.float()), asset.trajectory.light)
    black = torch.zeros(len(NAMES), SIZE, SIZE, 3, dtype=torch.uint8)
    capture = Capture(black, black[..., 0], CAMERA, NAMES, asset.trajectory.light)
    empty = torch.zeros(3, SIZE, SIZE, 3, dtype=torch.uint8)
    blank = dataclasses.replace(
        truth_without_views(CAMERA),
        images=empty,
        masks=empty[..., 0] + OBJECT,
        names=("a.png", "b.png", "c.png"),
        regions=("shared", "sphere", "shared"),
        trajectory=path,
        albedo=torch.full((3, SIZE, SIZE, 3), 0.5),
        lights={"lamp": smooth_light(2.5)},
        poses=asset.trajectory,
    )
    identity = Similarity(torch.ones(()), SO3.identity(), torch.zeros(3))
    rendered = render_prediction.predict_views(OTHER_CONFIG, asset, capture, blank, identity, names=NAMES)
    assert rendered.albedo is not None
    assert rendered.normals is not None
    assert rendered.masks is not None
    assert rendered.images is not None
    damage = 0.06 * torch.randn(3, SIZE, SIZE, 3, generator=torch.Generator().manual_seed(0))
    truth = dataclasses.replace(
        blank,
        images=(rendered.images + 250 * damage).clamp(0, 255).to(torch.uint8),
        masks=torch.where(rendered.masks, OBJECT, BACKGROUND).to(torch.uint8),
        albedo=(rendered.albedo + damage).clamp_min(0) * rendered.masks[..., None],
        normals=torch.nn.functional.normalize(rendered.normals + damage, dim=-1) * rendered.masks[..., None],
        roughness=rendered.roughness,
        relit={"lamp": (rendered.relit["lamp"] + 250 * damage).clamp(0, 255).to(torch.uint8)},
        light=rendered.light,
    )
    return capture, truth


def scored(asset: Asset, capture: Capture, truth: Truth) -> tuple[dict[str, Any], str]:
    known = capture.trajectory is not None
    alignment, note = render_prediction.align_views(asset.trajectory, NAMES, capture, truth, known_poses=known)
    predicted = render_prediction.predict_views(CONFIG, asset, capture, truth, alignment, names=NAMES)
    return evaluate.compare(predicted, capture, truth, []), note


@pytest.mark.parametrize("light", ["camera", "object"])
def test_a_run_in_its_own_frame_scores_as_in_the_true_one(light: Light) -> None:
    asset = ellipsoid_asset(light)
    capture, truth = rendered_truth(asset)
    known = dataclasses.replace(capture, trajectory=asset.trajectory)
    in_true_frame, known_note = scored(asset, known, truth)
    in_other_frame, other_note = scored(reexpressed(asset), capture, truth)
    assert "its poses were given" in known_note
    assert "first the rotation (132" in other_note
    for region in ("shared", "sphere"):
        a, b = in_true_frame["regions"][region], in_other_frame["regions"][region]
        for key in ("albedo.psnr_fg_srgb", "relit.psnr_fg_srgb", "image.psnr_fg_srgb"):
            assert 20 < a[key] < 40, "the errors must be visible"
            # Other random rays change pixels by 3 code values, a fifth of the errors: 0.15 dB.
            assert b[key] == pytest.approx(a[key], abs=0.25), key
        assert b["normal.mean_fg_degrees"] == pytest.approx(a["normal.mean_fg_degrees"], abs=0.1)
        assert 2 < a["normal.mean_fg_degrees"] < 10
        assert b["roughness.rmse_fg"] < 0.01
        assert b["silhouette.iou"] > 0.98
    assert in_other_frame["albedo_scale"] == pytest.approx(in_true_frame["albedo_scale"], rel=2e-3)
    assert in_other_frame["light"]["light.rmse_clip10"] < 0.01
    assert in_other_frame["poses"]["poses.rotation_mean_degrees"] < 0.01
    assert in_other_frame["poses"]["poses.auc_percent"] > 99.9


def test_without_the_alignment_each_part_scores_badly() -> None:
    """Shows that the test above would notice a part that is not transformed."""
    asset = ellipsoid_asset("object")
    capture, truth = rendered_truth(asset)
    other = reexpressed(asset)
    identity = Similarity(torch.ones(()), SO3.identity(), torch.zeros(3))
    right, _ = render_prediction.align_views(other.trajectory, NAMES, capture, truth, known_poses=False)
    assert right is not None
    wrong = render_prediction.predict_views(CONFIG, other, capture, truth, identity, names=NAMES)
    good = render_prediction.predict_views(CONFIG, other, capture, truth, right, names=NAMES)
    unaligned = {"normals": wrong.normals, "relit": wrong.relit, "albedo": wrong.albedo, "light": wrong.light}
    for part, value in unaligned.items():
        scores = evaluate.compare(dataclasses.replace(good, **{part: value}), capture, truth, [])
        shared = scores["regions"]["shared"]
        assert {
            "normals": shared["normal.mean_fg_degrees"] > 30,
            "relit": shared["relit.psnr_fg_srgb"] < 15,
            "albedo": shared["albedo.psnr_fg_srgb"] < 15,
            "light": scores["light"]["light.rmse_clip10"] > 0.1,
        }[part], part


def test_under_drift_of_the_poses_the_object_is_rendered_in_its_place() -> None:
    """With orientations that drift by 12 degrees, the mean rotation, the scale and the shift are still right."""
    asset = ellipsoid_asset("camera")
    capture, truth = rendered_truth(asset)
    drift = torch.linspace(-1, 1, len(NAMES))[:, None] * math.radians(6) * torch.tensor([0.6, 0.0, 0.8])
    turns = SE3.from_rotation(SO3.exp(drift), torch.zeros(len(NAMES), 3))
    path = Trajectory(asset.trajectory.T_cam_obj @ turns, "camera")
    scores, _ = scored(dataclasses.replace(reexpressed(asset), trajectory=OTHER.to_truth(path)), capture, truth)
    assert scores["poses"]["poses.rotation_mean_degrees"] == pytest.approx(3.1, abs=0.3)
    assert scores["regions"]["shared"]["normal.mean_fg_degrees"] < 6
    assert scores["regions"]["shared"]["silhouette.iou"] > 0.97


def test_depths_are_scaled_by_the_ratio_of_focal_lengths() -> None:
    """With a focal length longer by a fifth, an object farther by a fifth has the same size in the image."""
    asset = ellipsoid_asset("camera")
    capture, truth = rendered_truth(asset)
    T = asset.trajectory.T_cam_obj
    farther = Trajectory(dataclasses.replace(T, xyz=T.xyz * torch.tensor([1.0, 1.0, 1.2])), "camera")
    alignment, note = render_prediction.align_views(
        farther, NAMES, capture, truth, known_poses=False, focal_ratio=1 / 1.2
    )
    assert alignment is not None
    assert float(alignment.scale) == pytest.approx(1, abs=1e-4)
    assert float(alignment.R_true_pred.angle()) < 1e-3
    assert alignment.shift.abs().max() < 1e-4
    assert "depths times 0.8333" in note
    plain, note = render_prediction.align_views(farther, NAMES, capture, truth, known_poses=False)
    assert plain is not None
    # Without the ratio, the object would be rendered a fifth too large.
    assert float(plain.scale) == pytest.approx(1 / 1.2, abs=0.01)
    assert "depths" not in note


def test_without_an_alignment_the_prediction_has_poses_only_and_a_note() -> None:
    asset = ellipsoid_asset("camera")
    capture, truth = rendered_truth(asset)
    still = Trajectory(asset.trajectory.select([0] * len(NAMES)).T_cam_obj, "camera")
    missing, note = render_prediction.align_views(
        still, NAMES, capture, dataclasses.replace(truth, poses=still), known_poses=False
    )
    assert missing is None
    assert "hardly rotates" in note
    unaligned = render_prediction.predict_views(CONFIG, asset, capture, truth, None, names=NAMES)
    assert unaligned.albedo is None
    assert unaligned.poses is asset.trajectory
    assert unaligned.light is asset.environment, "the camera's frame needs no alignment"
    fixed = render_prediction.predict_views(CONFIG, ellipsoid_asset("object"), capture, truth, None, names=NAMES)
    assert fixed.light is None
    bare = dataclasses.replace(truth, poses=None)
    missing, note = render_prediction.align_views(asset.trajectory, NAMES, capture, bare, known_poses=False)
    assert missing is None
    assert "unknown" in note


def test_only_frames_with_true_poses_are_aligned_and_scored() -> None:
    """Frames without a true pose are left out; frames without an estimated pose count as lost."""
    asset = ellipsoid_asset("camera")
    capture, truth = rendered_truth(asset)
    annotated = list(range(0, 24, 2))
    some = dataclasses.replace(
        truth, poses=asset.trajectory.select(annotated), pose_names=tuple(NAMES[i] for i in annotated)
    )
    other = reexpressed(asset)
    kept = [i for i in range(24) if i not in (4, 7)]
    names = tuple(NAMES[i] for i in kept)
    path = other.trajectory.select(kept)
    alignment, note = render_prediction.align_views(path, names, capture, some, known_poses=False)
    assert alignment is not None
    assert "11 training poses" in note
    torch.testing.assert_close(alignment.to_truth(path).T_cam_obj.xyz, asset.trajectory.select(kept).T_cam_obj.xyz)
    predicted = Prediction(poses=path, pose_names=names)
    scores = evaluate.compare(predicted, capture, some, [])["poses"]
    assert (scores["poses.posed_frames"], scores["poses.lost_frames"]) == (11, 1)
    assert scores["poses.auc_percent"] == pytest.approx(100 * 11 / 12, abs=1e-2)
    assert scores["poses.rpe_rotation_degrees"] == pytest.approx(0, abs=1e-2), "between annotated neighbours"
    assert scores["poses.rotation_longest_run_percent"] == pytest.approx(100 * 9 / 12)


def test_registration_inverts_a_similarity() -> None:
    truth = ellipsoid_asset("camera").trajectory
    found = metrics.register(OTHER.to_truth(truth), truth)
    undone = found.to_truth(OTHER.to_truth(truth))
    torch.testing.assert_close(undone.T_cam_obj.matrix(), truth.T_cam_obj.matrix(), atol=1e-5, rtol=0)
    assert float(found.scale * OTHER.scale) == pytest.approx(1, abs=1e-5)


def test_views_elsewhere_have_their_own_camera_and_light_in_every_object_frame() -> None:
    """They are the asset relit by hand; and the same for a run in another object frame, up to the noise of few rays."""
    asset = ellipsoid_asset("camera")
    poses = trajectories.shared_views(2, 1.3 * DISTANCE)
    T_cam_obj = SE3(poses.wxyz.float(), poses.xyz.float())
    black = torch.zeros(1, SIZE, SIZE, 3, dtype=torch.uint8)
    capture = Capture(black, black[..., 0], CAMERA, NAMES[:1], "camera")
    view = Trajectory(T_cam_obj[[0]], "camera")
    cameras = tuple(Camera.from_fov(math.radians(angle), SIZE, SIZE) for angle in (20, 28))
    lights = smooth_light(1.0), smooth_light(-2.0)
    seen = torch.ones(2, SIZE, SIZE, dtype=torch.bool)
    views = RelitViews(torch.zeros(2, SIZE, SIZE, 3), seen, cameras, T_cam_obj, lights)
    truth = Truth(black, black[..., 0], NAMES[:1], ("shared",), trajectory=view, elsewhere=views)
    identity = Similarity(torch.ones(()), SO3.identity(), torch.zeros(3))
    similar = OTHER.R_true_pred.inverse()
    back = Similarity(1 / OTHER.scale, similar, -(similar @ OTHER.shift) / OTHER.scale)
    images = []
    for run, alignment in ((asset, identity), (reexpressed(asset), back)):
        rendered = render_prediction.predict_views(CONFIG, run, capture, truth, alignment, names=NAMES).elsewhere
        assert rendered is not None
        images.append(rendered)
    for i in range(2):
        path = Trajectory(T_cam_obj[[i]], "object")
        (wanted,) = relight.relight(CONFIG, asset, lights[i], path, cameras[i])
        torch.testing.assert_close(images[0][i], wanted)
        assert (images[1][i] - wanted).abs().mean() < 0.03 * wanted.mean()
    assert (images[0][0] - images[0][1]).abs().mean() > 0.1 * images[0].mean()
