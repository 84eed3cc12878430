"""What a decomposed asset says about a capture's evaluation views: the prediction folder of docs/prediction.md."""

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from tumble import metrics, relight
from tumble.asset import Asset
from tumble.capture import Capture, Truth
from tumble.decompose import buffers_of
from tumble.environment import Environment
from tumble.images import photograph
from tumble.metrics import Similarity
from tumble.prediction import Prediction
from tumble.se3 import SO3
from tumble.trajectory import Trajectory

SILHOUETTE = 0.5
"""Coverage from which a pixel counts as object."""


@torch.no_grad()
def predict(cfg: relight.Config, asset: Asset, capture: Capture, truth: Truth) -> Prediction:
    """Render a capture's evaluation views from an asset, under its own light and under those of the truth.

    The truth gives the views, the alignment of the trajectories, the lights of relit pictures and the albedo's scale;
    nothing of it changes the asset.
    """
    assert truth.trajectory is not None, "evaluation views have poses"
    alignment = aligned(asset.trajectory, capture, truth)
    views = alignment.to_prediction(truth.trajectory)
    buffers = [buffers_of(asset, views.T_cam_obj[i], capture.camera) for i in range(len(views))]
    solid = torch.stack([view.alpha >= SILHOUETTE for view in buffers])
    albedo = torch.stack([view.features["albedo"] for view in buffers]) * solid[..., None]
    normals = torch.stack([normalize(view.normal, dim=-1) for view in buffers]) * solid[..., None]
    own = asset.environment
    assert own is not None, "an asset with light"
    return Prediction(
        albedo=albedo,
        normals=alignment.R_true_pred @ normals,
        roughness=torch.stack([view.features["roughness"][..., 0] for view in buffers]) * solid,
        masks=solid,
        images=_pictures(cfg, asset, own, views, capture),
        relit=_relit(cfg, asset, albedo, alignment, capture, truth),
        light=own.rotated(alignment.R_true_pred.matrix()) if views.light == "object" else own,
        poses=asset.trajectory,
        pose_names=capture.names,
    )


def aligned(estimated: Trajectory, capture: Capture, truth: Truth) -> Similarity:
    """How the true object frame relates to the asset's: the identity where the poses were given."""
    if capture.trajectory is not None or truth.poses is None:
        xyz = estimated.T_cam_obj.xyz
        return Similarity(xyz.new_ones(()), SO3.identity(dtype=xyz.dtype, device=xyz.device), xyz.new_zeros(3))
    return metrics.align(estimated, truth.poses)


def _relit(
    cfg: relight.Config,
    asset: Asset,
    albedo: Float[Tensor, "v h w 3"],
    alignment: Similarity,
    capture: Capture,
    truth: Truth,
) -> dict[str, UInt8[Tensor, "v h w 3"]]:
    """The views under the truth's lights, from the scaled albedo. Those lights stand in the true object frame."""
    if truth.albedo is None or truth.trajectory is None:
        return {}
    scaled = relight.scaled(asset, metrics.albedo_scale(albedo, truth.albedo, truth.foreground))
    still = Trajectory(alignment.to_prediction(truth.trajectory).T_cam_obj, "object")
    R_pred_true = alignment.R_true_pred.inverse().matrix()
    return {
        name: _pictures(cfg, scaled, light.rotated(R_pred_true), still, capture) for name, light in truth.lights.items()
    }


def _pictures(
    cfg: relight.Config, asset: Asset, light: Environment, views: Trajectory, capture: Capture
) -> UInt8[Tensor, "v h w 3"]:
    linear = torch.stack(list(relight.relight(cfg, asset, light, views, capture.camera)))
    return photograph(linear)
