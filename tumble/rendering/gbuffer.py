"""G-buffers of an asset: albedo, roughness, normals and depth of one view, before shading."""

from dataclasses import replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from tumble import backends
from tumble.maths import SE3
from tumble.rendering.rasterizer import Buffers, rasterize
from tumble.scene import TEMPERATURE, Camera, Gaussians, Material

SAMPLE_OFFSET = 1 / 6
"""Offset of a pixel's four samples from its centre along each axis [pixels].

The centres of the pixel's quarters (0.25) would blur the texture a second time, since training already fits it to pixel
values; a single sample (0) aliases at silhouettes.
"""


@runtime_checkable
class HasMaterial(Protocol):
    """Gaussians with material: an asset, or the parameters of stage 3."""

    @property
    def gaussians(self) -> Gaussians: ...

    @property
    def gamma(self) -> Float[Tensor, ""]: ...

    @property
    def material(self) -> Material: ...


def corner_features(material: Material) -> tuple[Float[Tensor, "n 4 7"], Float[Tensor, "n 3"]]:
    """Albedo, roughness and normal offset of all corners for `rasterize_material`, and the Gaussians' mean albedo."""
    backend = backends.choose(material.albedo_logits.device, material.albedo_logits.dtype)
    logits = (material.albedo_logits, material.roughness_logits)
    return backend.corner_features(*logits, material.normal_offset, TEMPERATURE)


def rasterize_material(asset: HasMaterial, corners: Float[Tensor, "n 4 7"], T_cam_obj: SE3, camera: Camera) -> Buffers:
    """View with the feature "material": albedo, roughness and normal offset; normals are those without the offset.

    The feature "metalness" is there, too, if the object has metal.
    """
    features, metalness = {"material": corners}, asset.material.metalness
    if metalness is not None:
        features["metalness"] = metalness[:, None, None].expand(-1, 4, 1)
    return rasterize(asset.gaussians, asset.gamma, T_cam_obj, camera, features)


def with_offset(view: Buffers) -> Buffers:
    """A view by `rasterize_material` whose normals include the offset."""
    return replace(view, normal=view.normal + view.features["material"][..., 4:])


def render_gbuffer(
    asset: HasMaterial, T_cam_obj: SE3, camera: Camera, corners: Float[Tensor, "n 4 7"] | None = None
) -> Buffers:
    """G-buffer of one view with one sample at each pixel's centre; normals include the material's normal offset.

    Args:
        corners: `corner_features` of the material, if they are known.
    """
    corners = corner_features(asset.material)[0] if corners is None else corners
    view = with_offset(rasterize_material(asset, corners, T_cam_obj, camera))
    others = {name: image for name, image in view.features.items() if name != "material"}
    images = view.features["material"].split([3, 1, 3], -1)
    return replace(view, features=dict(zip(("albedo", "roughness", "offset"), images, strict=True)) | others)


@torch.no_grad()
def antialiased_gbuffer(asset: HasMaterial, T_cam_obj: SE3, camera: Camera) -> Buffers:
    """G-buffer of one view with four samples per pixel, for final images; not differentiable."""
    views, corners = [], corner_features(asset.material)[0]
    for x, y in (
        (-SAMPLE_OFFSET, -SAMPLE_OFFSET),
        (SAMPLE_OFFSET, -SAMPLE_OFFSET),
        (-SAMPLE_OFFSET, SAMPLE_OFFSET),
        (SAMPLE_OFFSET, SAMPLE_OFFSET),
    ):
        shifted = camera.fx_fy_cx_cy + camera.fx_fy_cx_cy.new_tensor([0.0, 0.0, x, y])
        views.append(render_gbuffer(asset, T_cam_obj, Camera(shifted, camera.height, camera.width), corners))
    alphas = torch.stack([view.alpha for view in views])
    coverage_weights = alphas / alphas.sum(0).clamp_min(torch.finfo(alphas.dtype).tiny)

    def mean(images: list[Tensor]) -> Tensor:
        weights = coverage_weights if images[0].ndim == 2 else coverage_weights[..., None]
        return (weights * torch.stack(images)).sum(0)

    covered_means = {name: mean([getattr(v, name) for v in views]) for name in ("depth", "depth_var", "normal")}
    plain_means = {name: torch.stack([getattr(v, name) for v in views]).mean(0) for name in ("alpha", "rgb", "weight")}
    densest = alphas.argmax(0, keepdim=True)
    return Buffers(
        **covered_means,
        **plain_means,
        features={name: mean([view.features[name] for view in views]) for name in views[0].features},
        touched=torch.stack([view.touched for view in views]).amax(0),
        dominant=torch.stack([view.dominant for view in views]).gather(0, densest)[0],
    )
