"""What a decomposed asset says about a capture's evaluation views: the prediction folder of docs/prediction.md."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from tumble.evaluation import metrics
from tumble.evaluation.metrics import Similarity
from tumble.evaluation.prediction import Prediction
from tumble.maths import SO3, to_srgb8
from tumble.rendering import antialiased, relight
from tumble.scene import Asset, Capture, Environment, Trajectory, Truth

SILHOUETTE = 0.55
"""Coverage from which a pixel counts as object. Edges fade more slowly inwards than outwards, so half is too little: of
ten thousand pixels of the chess knight it misses 17 and claims 57 too many, 0.55 32 and 38; mustard bottle 5 and 53,
13 and 31."""


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
    """Render a capture's evaluation views from an asset, under its own light and under those of the truth.

    The truth gives the views, the lights of relit pictures and the albedo's scale; nothing of it changes the asset.

    Args:
        alignment: From `aligned`. Without one, or without evaluation views, the prediction is one of poses and, where
            its frame is known, of light.
        names: Training frames that the asset's trajectory belongs to.
    """
    own = asset.environment
    posed = Prediction(poses=asset.trajectory, pose_names=names)
    if asset.trajectory.light == "camera":
        posed = replace(posed, light=own)
    elif alignment is not None:
        posed = replace(posed, light=own.rotated(alignment.R_true_pred.matrix()))
    if alignment is None or truth.trajectory is None or not len(truth):
        return posed
    views = alignment.to_prediction(truth.trajectory)
    buffers = [antialiased(asset, views.T_cam_obj[i], capture.camera) for i in range(len(views))]
    coverage = torch.stack([view.alpha for view in buffers])
    # Maps reach as far as anything is known; where the object ends, the masks say.
    known = coverage >= cfg.alpha_min
    albedo = torch.stack([view.features["albedo"] for view in buffers]) * known[..., None]
    normals = torch.stack([normalize(view.normal, dim=-1) for view in buffers]) * known[..., None]
    return replace(
        posed,
        albedo=albedo,
        normals=alignment.R_true_pred @ normals,
        roughness=torch.stack([view.features["roughness"][..., 0] for view in buffers]) * known,
        masks=coverage >= SILHOUETTE,
        images=_pictures(cfg, asset, own, views, capture),
        relit=_relit(cfg, asset, albedo, alignment, capture, truth),
    )


def align_views(
    estimated: Trajectory, names: tuple[str, ...], capture: Capture, truth: Truth, *, given: bool, lens: float = 1.0
) -> tuple[Similarity | None, str]:
    """How the true object frame relates to the asset's, from training frames alone, and that in words.

    Args:
        estimated: The asset's trajectory.
        names: Its frames.
        given: Whether the run took the capture's poses: nothing is aligned then.
        lens: The capture's focal length over the run's. Views are seen through the capture's camera: distances along
            its axis change by as much, so that the object is seen as large as the run saw it.
    """
    if given:
        xyz = estimated.T_cam_obj.xyz
        same = Similarity(xyz.new_ones(()), SO3.identity(dtype=xyz.dtype, device=xyz.device), xyz.new_zeros(3))
        return same, "views: rendered in the capture's own object frame, for its poses were given"
    places = truth.posed(capture)
    shared = [i for i, name in enumerate(names) if name in places]
    if truth.poses is None or len(shared) < 2:
        return None, "views: not rendered, for without true poses of training frames the object frame is unknown"
    true = truth.poses.select([places[names[i]] for i in shared])
    try:
        found = metrics.register(_through(lens, estimated.select(shared)), true)
    except ValueError as reason:
        return None, f"views: not rendered; {reason}"
    angle = math.degrees(float(found.R_true_pred.angle()))
    seen = "" if lens == 1 else f"depths times {lens:.4g}, the true focal length over the run's; "
    return found, (
        f"views: rendered at the true poses, brought into the run's object frame by what aligns its {len(shared)} "
        f"training poses: rotation alone ({angle:.1f} degrees), then scale ({float(found.scale):.4g}) and shift; "
        f"{seen}normals and light turned back by it"
    )


def _through(lens: float, trajectory: Trajectory) -> Trajectory:
    """The poses at which a lens of another focal length sees the object in the same place, as large."""
    T_cam_obj = trajectory.T_cam_obj
    xyz = T_cam_obj.xyz * T_cam_obj.xyz.new_tensor([1.0, 1.0, lens])
    return trajectory if lens == 1 else replace(trajectory, T_cam_obj=replace(T_cam_obj, xyz=xyz))


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
    return to_srgb8(linear)
