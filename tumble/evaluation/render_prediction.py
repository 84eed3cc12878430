"""Prediction of a decomposed asset: a capture's evaluation views, rendered at the true poses (docs/prediction.md)."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from tumble.evaluation import metrics
from tumble.evaluation.metrics import Similarity
from tumble.evaluation.prediction import Prediction
from tumble.io import progress, tree
from tumble.maths import SO3, to_srgb8
from tumble.rendering import Buffers, antialiased_gbuffer, relight
from tumble.scene import Asset, Capture, Environment, RelitViews, Trajectory, Truth

MIN_OBJECT_COVERAGE = 0.55
"""Coverage from which a pixel belongs to the silhouette: coverage falls off more slowly inside an edge than outside, so
one half would make silhouettes slightly too large."""


@torch.no_grad()
def predict_views(
    cfg: relight.Config,
    asset: Asset,
    capture: Capture,
    truth: Truth,
    alignment: Similarity | None,
    *,
    names: tuple[str, ...],
) -> Prediction:
    """Render a capture's evaluation views from an asset, under the asset's own light and under the truth's lights.

    The truth provides the views, the lights for relighting and the albedo scale. It does not change the asset.

    Args:
        alignment: From `align_views`. If None, or without evaluation views, the prediction has only poses and, where
            the light's frame is known, light.
        names: Names of the training frames of the asset's trajectory.
    """
    estimated_light = asset.environment
    prediction = Prediction(poses=asset.trajectory, pose_names=names)
    if asset.trajectory.light == "camera":
        prediction = replace(prediction, light=estimated_light)
    elif alignment is not None:
        prediction = replace(prediction, light=estimated_light.rotated(alignment.R_true_pred.matrix()))
    if alignment is None or truth.trajectory is None or not len(truth):
        return prediction
    views = alignment.to_prediction(truth.trajectory)
    indices = progress.track(range(len(views)), "rendering maps of the evaluation views", len(views))
    buffers = [antialiased_gbuffer(asset, views.T_cam_obj[i], capture.camera) for i in indices]
    coverage = torch.stack([view.alpha for view in buffers])
    # Maps extend beyond the silhouette to all pixels with a usable value; `masks` holds the silhouette.
    known = coverage >= cfg.alpha_min
    geometry = relight.trace_geometry(asset)
    albedo = torch.stack([view.features["albedo"] for view in buffers]) * known[..., None]
    normals = torch.stack([normalize(view.normal, dim=-1) for view in buffers]) * known[..., None]
    return replace(
        prediction,
        albedo=albedo,
        normals=alignment.R_true_pred @ normals,
        roughness=torch.stack([view.features["roughness"][..., 0] for view in buffers]) * known,
        metalness=_metalness(buffers, truth),
        masks=coverage >= MIN_OBJECT_COVERAGE,
        images=_rendered_views(cfg, asset, geometry, buffers, estimated_light, views, capture, "the estimated light"),
        relit=_relit_views(cfg, asset, geometry, buffers, albedo, alignment, capture, truth),
        elsewhere=None
        if truth.elsewhere is None
        else _views_elsewhere(cfg, asset, geometry, alignment, truth.elsewhere),
    )


def _metalness(buffers: list[Buffers], truth: Truth) -> Float[Tensor, "v h w"] | None:
    """Metalness of the views if there is metal; where only the truth has metal, it is 0."""
    if "metalness" in buffers[0].features:
        return torch.stack([view.features["metalness"][..., 0] for view in buffers])
    return None if truth.metalness is None else torch.stack([torch.zeros_like(view.alpha) for view in buffers])


def align_views(
    estimated: Trajectory,
    names: tuple[str, ...],
    capture: Capture,
    truth: Truth,
    *,
    known_poses: bool,
    focal_ratio: float = 1.0,
) -> tuple[Similarity | None, str]:
    """The similarity from the asset's to the true object frame, from training poses alone, and a note for the report.

    The similarity is None where the poses do not determine it; the note gives the reason.

    Args:
        estimated: The asset's trajectory.
        names: Names of its frames.
        known_poses: Whether the run used the capture's own poses; the similarity is then the identity.
        focal_ratio: The capture's focal length over the run's. Views are rendered with the capture's camera, so depths
            are multiplied by this ratio to keep the object's size in the image.
    """
    if known_poses:
        xyz = estimated.T_cam_obj.xyz
        identity = Similarity(xyz.new_ones(()), SO3.identity(dtype=xyz.dtype, device=xyz.device), xyz.new_zeros(3))
        return identity, "views: rendered in the capture's object frame without alignment, because its poses were given"
    true_index = truth.pose_indices(capture)
    shared = [i for i, name in enumerate(names) if name in true_index]
    if truth.poses is None or len(shared) < 2:
        return None, "views: not rendered, because without true poses of training frames the object frame is unknown"
    true = truth.poses.select([true_index[names[i]] for i in shared])
    try:
        alignment = metrics.register(_with_scaled_depths(focal_ratio, estimated.select(shared)), true)
    except ValueError as reason:
        return None, f"views: not rendered; {reason}"
    angle = math.degrees(float(alignment.R_true_pred.angle()))
    depths = "" if focal_ratio == 1 else f"depths times {focal_ratio:.4g}, the true focal length over the run's; "
    return alignment, (
        f"views: rendered at the true poses, transformed to the run's object frame by a similarity fitted to "
        f"{len(shared)} training poses: first the rotation ({angle:.1f} degrees), then scale "
        f"({float(alignment.scale):.4g}) and shift; {depths}normals and light rotated back to the true frame"
    )


def _with_scaled_depths(focal_ratio: float, trajectory: Trajectory) -> Trajectory:
    """The poses at which a camera of another focal length shows the object at the same place and size in the image."""
    T_cam_obj = trajectory.T_cam_obj
    xyz = T_cam_obj.xyz * T_cam_obj.xyz.new_tensor([1.0, 1.0, focal_ratio])
    return trajectory if focal_ratio == 1 else replace(trajectory, T_cam_obj=replace(T_cam_obj, xyz=xyz))


def _relit_views(
    cfg: relight.Config,
    asset: Asset,
    geometry: relight.TracedGeometry,
    buffers: Sequence[Buffers],
    albedo: Float[Tensor, "v h w 3"],
    alignment: Similarity,
    capture: Capture,
    truth: Truth,
) -> dict[str, UInt8[Tensor, "v h w 3"]]:
    """The views under the truth's lights (true object frame), rendered with the scaled albedo."""
    if truth.albedo is None or truth.trajectory is None:
        return {}
    scaled, buffers = relight.scale_albedo(asset, buffers, metrics.albedo_scale(albedo, truth.albedo, truth.foreground))
    views = Trajectory(alignment.to_prediction(truth.trajectory).T_cam_obj, "object")
    R_pred_true = alignment.R_true_pred.inverse().matrix()
    return {
        name: _rendered_views(cfg, scaled, geometry, buffers, light.rotated(R_pred_true), views, capture, name)
        for name, light in truth.lights.items()
    }


def _views_elsewhere(
    cfg: relight.Config, asset: Asset, geometry: relight.TracedGeometry, alignment: Similarity, views: RelitViews
) -> Float[Tensor, "n i j 3"]:
    """The views in other places, each with its own camera and light, from the albedo as estimated."""
    poses = alignment.to_prediction(Trajectory(views.T_cam_obj, "object"))
    R_pred_true = alignment.R_true_pred.inverse().matrix()
    images = []
    for i in progress.track(range(len(views)), "rendering views in other places", len(views)):
        # A tree's tensors in tuples stay where they are.
        light = tree.to(views.lights[i], R_pred_true.device).rotated(R_pred_true)
        camera = tree.to(views.cameras[i], R_pred_true.device)
        view = poses.select([i])
        buffers = [antialiased_gbuffer(asset, view.T_cam_obj[0], camera)]
        images += relight.relight(cfg, asset, light, view, camera, geometry=geometry, buffers=buffers)
    return torch.stack(images)


def _rendered_views(
    cfg: relight.Config,
    asset: Asset,
    geometry: relight.TracedGeometry,
    buffers: Sequence[Buffers],
    light: Environment,
    views: Trajectory,
    capture: Capture,
    name: str,
) -> UInt8[Tensor, "v h w 3"]:
    """The views under a light with this name."""
    linear = relight.relight(cfg, asset, light, views, capture.camera, geometry=geometry, buffers=buffers)
    return to_srgb8(torch.stack(list(progress.track(linear, f"rendering views under {name}", len(views)))))
