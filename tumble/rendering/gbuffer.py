"""What a view of an asset shows before it is shaded: albedo, roughness and normals."""

from dataclasses import replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.maths import SE3
from tumble.rendering.rasterizer import Buffers, rasterize
from tumble.scene import Camera, Gaussians, Material

OFFSET = 1 / 6
"""Of the four samples of a pixel from its centre [pixels]. A texture fitted to pixels by their centres is as blurred as
they are: samples as far apart as a pixel's four quarters (0.25) blur print once more, one alone leaves rims to chance.
Albedo at 0, 0.15, 0.2, 0.25: cracker box, indoors, 26.5, 26.6, 26.4, 26.1 dB; mustard bottle 31.2, 32.3, 32.6, 32.5."""


@runtime_checkable
class Shown(Protocol):
    """An asset, or what stage 3 trains."""

    @property
    def gaussians(self) -> Gaussians: ...

    @property
    def gamma(self) -> Float[Tensor, ""]: ...

    @property
    def material(self) -> Material: ...


def buffers_of(asset: Shown, T_cam_obj: SE3, camera: Camera) -> Buffers:
    """One view's albedo, roughness and normal at the centres of its pixels, with the detail of the normal added."""
    material = asset.material
    features = {
        "albedo": material.albedo,
        "roughness": material.roughness[..., None],
        "offset": material.normal_offset,
    }
    view = rasterize(asset.gaussians, asset.gamma, T_cam_obj, camera, features)
    return replace(view, normal=view.normal + view.features["offset"])


@torch.no_grad()
def antialiased(asset: Shown, T_cam_obj: SE3, camera: Camera) -> Buffers:
    """The same over four samples of each pixel, for pictures that are looked at; not differentiable."""
    views = []
    for x, y in ((-OFFSET, -OFFSET), (OFFSET, -OFFSET), (-OFFSET, OFFSET), (OFFSET, OFFSET)):
        moved = camera.fx_fy_cx_cy + camera.fx_fy_cx_cy.new_tensor([0.0, 0.0, x, y])
        views.append(buffers_of(asset, T_cam_obj, Camera(moved, camera.height, camera.width)))
    alphas = torch.stack([view.alpha for view in views])
    share = alphas / alphas.sum(0).clamp_min(torch.finfo(alphas.dtype).tiny)

    def mean(images: list[Tensor]) -> Tensor:
        weights = share if images[0].ndim == 2 else share[..., None]
        return (weights * torch.stack(images)).sum(0)

    over_cover = {name: mean([getattr(v, name) for v in views]) for name in ("depth", "depth_var", "normal")}
    whole = {name: torch.stack([getattr(v, name) for v in views]).mean(0) for name in ("alpha", "rgb", "weight")}
    densest = alphas.argmax(0, keepdim=True)
    return Buffers(
        **over_cover,
        **whole,
        features={name: mean([view.features[name] for view in views]) for name in views[0].features},
        touched=torch.stack([view.touched for view in views]).amax(0),
        dominant=torch.stack([view.dominant for view in views]).gather(0, densest)[0],
    )
