"""Antialiased G-buffers against those with one sample per pixel."""

import torch

from tumble.maths.se3 import SE3
from tumble.rendering.gbuffer import antialiased_gbuffer, render_gbuffer
from tumble.scene.camera import Camera
from tumble.scene.gaussians import Gaussians, constant_sh, sdf_from_opacity
from tumble.scene.material import Material


class Disc:
    """One opaque disc that faces the camera, with a diameter of twenty pixels."""

    gamma = torch.tensor(30.0)
    gaussians = Gaussians(
        torch.tensor([[0.0, 0.0, 0.0]]),
        torch.tensor([[0.0, 1.0, 0.0, 0.0]]),
        torch.tensor([[0.3, 0.3, 0.01]]).log(),
        sdf_from_opacity(torch.tensor([0.99]), gamma),
        constant_sh(torch.tensor([[0.5, 0.5, 0.5]])),
    )
    material = Material.constant(1, torch.tensor([0.8, 0.4, 0.1]), 0.3)


T_CAM_OBJ = SE3(torch.tensor([1.0, 0.0, 0.0, 0.0]), torch.tensor([0.02, -0.03, 3.0]))
CAMERA = Camera(torch.tensor([60.0, 60.0, 16.0, 16.0]), 32, 32)


def test_four_samples_give_the_same_material_and_a_softer_silhouette() -> None:
    one, four = render_gbuffer(Disc(), T_CAM_OBJ, CAMERA), antialiased_gbuffer(Disc(), T_CAM_OBJ, CAMERA)
    covered = (one.alpha > 0.1) & (four.alpha > 0.1)
    assert covered.sum() > 50
    for name in ("albedo", "roughness"):
        torch.testing.assert_close(four.features[name][covered], one.features[name][covered])
    torch.testing.assert_close(four.normal[covered], one.normal[covered], atol=1e-4, rtol=0)
    assert (four.alpha - one.alpha).abs().max() > 1e-3
    assert (four.dominant[four.alpha > 0.1] == 0).all()


def test_four_samples_do_not_shift_the_image() -> None:
    """A common shift of the samples would shift the centroid of the coverage."""

    def centre(alpha: torch.Tensor) -> torch.Tensor:
        return (alpha[..., None] * CAMERA.pixel_centers()).sum((0, 1)) / alpha.sum()

    one, four = (centre(f(Disc(), T_CAM_OBJ, CAMERA).alpha) for f in (render_gbuffer, antialiased_gbuffer))
    torch.testing.assert_close(four, one, atol=0.01, rtol=0)


def test_the_coverage_of_a_pixel_is_the_mean_of_its_samples() -> None:
    whole = antialiased_gbuffer(Disc(), T_CAM_OBJ, CAMERA).alpha
    parts = []
    for x in (-1 / 6, 1 / 6):
        for y in (-1 / 6, 1 / 6):
            K = CAMERA.fx_fy_cx_cy + torch.tensor([0.0, 0.0, x, y])
            parts.append(render_gbuffer(Disc(), T_CAM_OBJ, Camera(K, 32, 32)).alpha)
    torch.testing.assert_close(whole, torch.stack(parts).mean(0))
