"""Scores do not depend on the object frame and unit of a reconstruction: everything is transformed with the alignment.

The asset is the figure of `tests.learning` with its true surface, material and light, as Gaussians; the truth is
Mitsuba's. Colours, shape and light have no symmetry.
"""

import dataclasses
import math
from typing import Any

import pytest
import torch

from tests.learning.scene import CAPTURE
from tests.learning.true_asset import true_asset
from tumble.datasets import folder
from tumble.evaluation import evaluate, metrics, render_prediction
from tumble.evaluation.metrics import Similarity
from tumble.evaluation.prediction import Prediction
from tumble.maths.directions import local_frame
from tumble.maths.se3 import SE3, SO3
from tumble.rendering import relight
from tumble.scene.asset import Asset
from tumble.scene.camera import Camera
from tumble.scene.capture import Capture, RelitViews, Truth
from tumble.scene.trajectory import Light, Trajectory

CONFIG = relight.Config(brdf_samples=48, light_samples=48)
OTHER = Similarity(torch.tensor(0.8), SO3.exp(torch.tensor([0.7, -1.9, 1.1])), torch.tensor([0.15, -0.1, 0.2]))
"""From the true object frame to the run's: rotated by 132 degrees, smaller, and shifted."""
NAMES = folder.load(CAPTURE).names
OFFSET = torch.tensor([0.05, 0.1, -0.07])
"""Normal offset of the material: the Gaussians are tilted by up to 8 degrees against the true normals."""


def asset_under(light: Light) -> Asset:
    """The figure under the light of the capture, or under another one that is fixed to the object."""
    asset, truth = true_asset(), folder.load_truth(CAPTURE)
    assert truth is not None
    tilted = asset.gaussians.normals - OFFSET
    length = torch.linalg.vector_norm(tilted, dim=-1, keepdim=True)
    offset = (OFFSET / length)[:, None].repeat(1, 4, 1)
    asset = dataclasses.replace(
        asset,
        gaussians=dataclasses.replace(asset.gaussians, quats=SO3.from_matrix(local_frame(tilted / length)).wxyz),
        material=dataclasses.replace(asset.material, normal_offset=offset),
    )
    fixed = Trajectory(asset.trajectory.T_cam_obj, "object")
    return (
        asset if light == "camera" else dataclasses.replace(asset, trajectory=fixed, environment=truth.lights["other"])
    )


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


def mitsuba_truth(light: Light) -> tuple[Capture, Truth]:
    """The capture without poses, and Mitsuba's truth of one view of each region. A light that is fixed to the object is
    that of the relit images."""
    capture, truth = folder.load(CAPTURE), folder.load_truth(CAPTURE)
    assert truth is not None
    assert truth.trajectory is not None
    views = [1, 5]
    regions = tuple(truth.regions[i] for i in views)
    assert regions == ("shared", "sphere")
    maps = {
        name: getattr(truth, name)[views] for name in ("images", "masks", "albedo", "normals", "roughness", "depth")
    }
    relit = {name: images[views] for name, images in truth.relit.items()}
    some = dataclasses.replace(
        truth,
        **maps,
        names=tuple(truth.names[i] for i in views),
        regions=regions,
        relit=relit,
        trajectory=Trajectory(truth.trajectory.select(views).T_cam_obj, light),
    )
    if light == "object":
        some = dataclasses.replace(some, images=relit["other"], light=truth.lights["other"])
    return dataclasses.replace(capture, trajectory=None, light=light), some


def scored(asset: Asset, capture: Capture, truth: Truth) -> tuple[dict[str, Any], str]:
    known = capture.trajectory is not None
    alignment, note = render_prediction.align_views(asset.trajectory, NAMES, capture, truth, known_poses=known)
    predicted = render_prediction.predict_views(CONFIG, asset, capture, truth, alignment, names=NAMES)
    return evaluate.compare(predicted, capture, truth, []), note


@pytest.mark.parametrize("light", ["camera", "object"])
def test_a_run_in_its_own_frame_scores_as_in_the_true_one(light: Light) -> None:
    asset = asset_under(light)
    capture, truth = mitsuba_truth(light)
    known = dataclasses.replace(capture, trajectory=asset.trajectory)
    in_true_frame, known_note = scored(asset, known, truth)
    in_other_frame, other_note = scored(reexpressed(asset), capture, truth)
    assert "its poses were given" in known_note
    assert "first the rotation (132" in other_note
    for region in ("shared", "sphere"):
        a, b = in_true_frame["regions"][region], in_other_frame["regions"][region]
        for key in ("albedo.psnr_fg_srgb", "relit.psnr_fg_srgb", "image.psnr_fg_srgb"):
            # Gaussians a third of a pixel apart reach 33 dB of albedo and 26 dB of images, whose shadows are sharper.
            assert a[key] > (30 if key.startswith("albedo") else 24), key
            # Other random rays change pixels by 3 code values, a fifth of the errors: 0.15 dB.
            assert b[key] == pytest.approx(a[key], abs=0.25), key
        assert b["normal.mean_fg_degrees"] == pytest.approx(a["normal.mean_fg_degrees"], abs=0.1)
        assert 2 < a["normal.mean_fg_degrees"] < 10
        assert b["roughness.rmse_fg"] == pytest.approx(a["roughness.rmse_fg"], abs=0.005)
        assert a["roughness.rmse_fg"] < 0.06
        assert b["silhouette.iou"] == pytest.approx(a["silhouette.iou"], abs=0.005)
        assert a["silhouette.iou"] > 0.95
    assert in_other_frame["albedo_scale"] == pytest.approx(in_true_frame["albedo_scale"], rel=2e-3)
    # A lamp of ten degrees, resampled twice on texels of three, when the light is fixed to the object; else exact.
    assert in_other_frame["light"]["light.rmse_clip10"] < (0.01 if light == "camera" else 0.05)
    assert in_other_frame["poses"]["poses.rotation_mean_degrees"] < 0.01
    assert in_other_frame["poses"]["poses.auc_percent"] > 99.9


def test_without_the_alignment_each_part_scores_badly() -> None:
    """Shows that the test above would notice a part that is not transformed."""
    asset = asset_under("object")
    capture, truth = mitsuba_truth("object")
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


def test_relit_views_have_the_albedo_in_the_scale_of_the_truth() -> None:
    """A run whose albedo is a half of the true one in red."""
    asset, (capture, truth) = asset_under("camera"), mitsuba_truth("camera")
    identity = Similarity(torch.ones(()), SO3.identity(), torch.zeros(3))
    dark = asset.material.with_albedo(asset.material.albedo * torch.tensor([0.5, 1.0, 1.0]))
    cfg = relight.Config(brdf_samples=8, light_samples=8)
    found = [
        render_prediction.predict_views(cfg, each, capture, truth, identity, names=NAMES)
        for each in (asset, dataclasses.replace(asset, material=dark))
    ]
    albedo = [each.albedo for each in found]
    assert albedo[0] is not None
    assert albedo[1] is not None
    torch.testing.assert_close(albedo[1][..., 0], 0.5 * albedo[0][..., 0], atol=0.01, rtol=0)
    for name in truth.lights:
        one, other = (each.relit[name].float() for each in found)
        assert (one - other).abs().mean() < 0.5


def test_under_drift_of_the_poses_the_object_is_rendered_in_its_place() -> None:
    """With orientations that drift by 12 degrees, the mean rotation, the scale and the shift are still right."""
    asset = asset_under("camera")
    capture, truth = mitsuba_truth("camera")
    drift = torch.linspace(-1, 1, len(NAMES))[:, None] * math.radians(6) * torch.tensor([0.6, 0.0, 0.8])
    turns = SE3.from_rotation(SO3.exp(drift), torch.zeros(len(NAMES), 3))
    path = Trajectory(asset.trajectory.T_cam_obj @ turns, "camera")
    scores, _ = scored(dataclasses.replace(reexpressed(asset), trajectory=OTHER.to_truth(path)), capture, truth)
    assert scores["poses"]["poses.rotation_mean_degrees"] == pytest.approx(3.1, abs=0.3)
    assert scores["regions"]["shared"]["normal.mean_fg_degrees"] < 6
    assert scores["regions"]["shared"]["silhouette.iou"] > 0.97


def test_depths_are_scaled_by_the_ratio_of_focal_lengths() -> None:
    """With a focal length longer by a fifth, an object farther by a fifth has the same size in the image."""
    asset = asset_under("camera")
    capture, truth = mitsuba_truth("camera")
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
    asset = asset_under("camera")
    capture, truth = mitsuba_truth("camera")
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
    fixed = render_prediction.predict_views(CONFIG, asset_under("object"), capture, truth, None, names=NAMES)
    assert fixed.light is None
    bare = dataclasses.replace(truth, poses=None)
    missing, note = render_prediction.align_views(asset.trajectory, NAMES, capture, bare, known_poses=False)
    assert missing is None
    assert "unknown" in note


def test_only_frames_with_true_poses_are_aligned_and_scored() -> None:
    """Frames without a true pose are left out; frames without an estimated pose count as lost."""
    asset = asset_under("camera")
    capture, truth = mitsuba_truth("camera")
    annotated = list(range(0, 24, 2))
    some = dataclasses.replace(
        truth, poses=asset.trajectory.select(annotated), pose_names=tuple(NAMES[i] for i in annotated)
    )
    other = reexpressed(asset)
    kept = [i for i in range(len(NAMES)) if i not in (4, 7)]
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
    truth = asset_under("camera").trajectory
    found = metrics.register(OTHER.to_truth(truth), truth)
    undone = found.to_truth(OTHER.to_truth(truth))
    torch.testing.assert_close(undone.T_cam_obj.matrix(), truth.T_cam_obj.matrix(), atol=1e-5, rtol=0)
    assert float(found.scale * OTHER.scale) == pytest.approx(1, abs=1e-5)


def test_views_elsewhere_have_their_own_camera_and_light_in_every_object_frame() -> None:
    """They are the asset relit by hand; and the same for a run in another object frame, up to the noise of few rays."""
    asset, (capture, truth) = asset_under("camera"), mitsuba_truth("camera")
    assert truth.trajectory is not None
    assert truth.light is not None
    size, T_cam_obj = capture.camera.height, truth.trajectory.T_cam_obj
    cameras = tuple(Camera.from_fov(math.radians(angle), size, size) for angle in (20, 28))
    lights = truth.light, truth.light.rotated(SO3.exp(torch.tensor([0.0, 2.0, 0.0])).matrix())
    seen = torch.ones(2, size, size, dtype=torch.bool)
    truth = dataclasses.replace(
        truth, elsewhere=RelitViews(torch.zeros(2, size, size, 3), seen, cameras, T_cam_obj, lights)
    )
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
        # Other random rays of the narrow lamp change pixels by 5 %.
        assert (images[1][i] - wanted).abs().mean() < 0.08 * wanted.mean()
    assert (images[0][0] - images[0][1]).abs().mean() > 0.3 * images[0].mean()
