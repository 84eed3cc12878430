"""The Gaussians' albedo as the solution of a linear problem, after stage 3, with everything else fixed.

With the light of every pixel known, photograph = albedo * diffuse + specular is linear in the albedo. Stage 3 has found
such an albedo, but its highlights had other colours: there each channel of the specular lobe has a scale of its own,
while those of a dielectric have the colour of the light, which `absolute_colour` estimates last. Dark, saturated paint
has to make up for the difference, as most of what it reflects are highlights.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.io import tree
from tumble.rendering import lit_frames, rasterize, surface, threads_for_kernels
from tumble.scene import Asset, Capture

HUBER = 0.01
"""Residual from which its weight falls off: highlights and shadows that the light does not explain [linear]."""
REGULARISATION = 1e-3
"""Weight of the previous albedo, relative to a pixel that shows this corner alone, frontal, under radiance 1."""
RANGE = (1e-3, 0.999)
"""Range of the albedo."""


@threads_for_kernels()
def solved(asset: Asset, capture: Capture) -> Asset:
    """The asset with the albedo that explains the photographs best, in linear radiance with a Huber loss.

    The first iteration of SART from the albedo of the asset: each corner of a Gaussian moves by the weighted mean of
    what is missing in the pixels that it contributes to. More iterations fit noise
    (docs/experiments/absolute-colour.md). Gaussians that no usable pixel shows (`lit_frames.usable_pixels`) keep their
    albedo.

    Args:
        asset: The result of stage 3 in absolute colour.
        capture: The asset's training frames, in the order of its trajectory.
    """
    asset = tree.detach(asset)
    albedo = asset.material.albedo
    missing, weight = torch.zeros_like(albedo), torch.full_like(albedo, REGULARISATION)
    for frame in lit_frames.lit_frames(asset, capture):
        residuals, weights = _projected_back(asset, albedo, frame)
        missing, weight = missing + residuals, weight + weights
    solved = (albedo + missing / weight).clamp(*RANGE)
    return replace(asset, material=asset.material.with_albedo(solved))


def _projected_back(
    asset: Asset, albedo: Float[Tensor, "n 4 3"], frame: lit_frames.LitFrame
) -> tuple[Float[Tensor, "n 4 3"], Float[Tensor, "n 4 3"]]:
    """A frame's weighted residuals and weights, summed for every corner over the pixels that it contributes to."""
    corners, T_cam_obj = albedo.clone().requires_grad_(), tree.to(frame.T_cam_obj, albedo.device)
    shown = torch.where(torch.from_numpy(frame.usable).to(albedo.device).flatten())[0]
    with torch.enable_grad():
        view = rasterize(asset.gaussians, asset.gamma, T_cam_obj, asset.camera, {"albedo": corners})
        points = surface(view, T_cam_obj, asset.camera, pixels=shown)
        rendered = points.sample(view.features["albedo"])
    images = (torch.from_numpy(x).to(albedo) for x in (frame.photo, frame.diffuse, frame.specular))
    with torch.no_grad():
        photo, diffuse, specular = (points.sample(image) for image in images)
        residual = photo - rendered * diffuse - specular
        cosine = (points.normals * points.views).sum(-1, keepdim=True)
        robust = cosine.square() * HUBER / residual.abs().amax(-1, keepdim=True).clamp_min(HUBER)
    # The adjoint of rasterizing the corners is its transposed matrix.
    (residuals,) = torch.autograd.grad(rendered, corners, robust * diffuse * residual, retain_graph=True)
    (weights,) = torch.autograd.grad(rendered, corners, robust * diffuse.square())
    return residuals, weights
