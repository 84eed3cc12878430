"""Opacity from signed distance, and the activations of the material."""

import math

import torch

from tumble.scene.gaussians import Gaussians, opacity, sdf_from_opacity
from tumble.scene.material import Material


def test_opacity_matches_the_formula_of_the_paper_where_it_does_not_overflow() -> None:
    sdf = torch.linspace(-0.5, 0.5, 11, dtype=torch.float64)
    gamma = torch.tensor(9.0, dtype=torch.float64)
    formula = 4 * torch.exp(-gamma * sdf) / (1 + torch.exp(-gamma * sdf)) ** 2
    torch.testing.assert_close(opacity(sdf, gamma), formula)
    assert opacity(sdf, gamma).argmax() == 5


def test_opacity_and_its_gradient_are_finite_far_from_the_surface() -> None:
    sdf = torch.tensor([-300.0, 300.0], requires_grad=True)
    value = opacity(sdf, torch.tensor(100.0))
    value.sum().backward()
    assert value.tolist() == [0, 0]
    assert torch.isfinite(sdf.grad).all()


def test_sdf_from_opacity_matches_values_computed_by_hand() -> None:
    # gamma |s| for these opacities, from 2 arccosh(o^-1/2).
    opacities = torch.tensor([0.99, 0.8, 0.5, 0.1, 0.01], dtype=torch.float64)
    expected = torch.tensor([0.2007, 0.9624, 1.7627, 3.6369, 5.9864], dtype=torch.float64)
    gamma = torch.tensor(2.0, dtype=torch.float64)
    torch.testing.assert_close(sdf_from_opacity(opacities, gamma) * gamma, expected, atol=5e-5, rtol=0)
    torch.testing.assert_close(opacity(sdf_from_opacity(opacities, gamma), gamma), opacities)


def test_the_normal_is_the_third_local_axis() -> None:
    # A quarter turn about x takes the local z axis to -y.
    quats = torch.tensor([[math.cos(math.pi / 4), math.sin(math.pi / 4), 0.0, 0.0]]) * 3
    gaussians = Gaussians(torch.zeros(1, 3), quats, torch.zeros(1, 3), torch.zeros(1), torch.zeros(1, 1, 3))
    torch.testing.assert_close(gaussians.normals, torch.tensor([[0.0, -1.0, 0.0]]), atol=1e-6, rtol=0)
    assert torch.equal(gaussians.scales, torch.ones(1, 3))


def test_normals_and_their_gradients_are_those_of_the_rotation() -> None:
    rng = torch.Generator().manual_seed(0)
    quats = torch.randn(9, 4, generator=rng, dtype=torch.float64).requires_grad_()

    def normals(q: torch.Tensor) -> torch.Tensor:
        return Gaussians(q[:, :3], q, q[:, :3], q[:, 0], q[:, None, :3]).normals

    gaussians = Gaussians(quats[:, :3], quats, quats[:, :3], quats[:, 0], quats[:, None, :3])
    torch.testing.assert_close(normals(quats), gaussians.R_obj_local[..., 2])
    assert torch.autograd.gradcheck(normals, quats)


def test_a_constant_material_has_the_given_values() -> None:
    material = Material.constant(2, torch.tensor([0.1, 0.5, 0.8]), 0.3)
    torch.testing.assert_close(material.albedo, torch.tensor([0.1, 0.5, 0.8]).expand(2, 4, 3))
    torch.testing.assert_close(material.roughness, torch.full((2, 4), 0.3))
