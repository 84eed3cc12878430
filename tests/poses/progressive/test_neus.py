"""Losses of the tracker against values computed by hand."""

import math

import pytest
import torch

from tumble.maths.se3 import SE3, SO3
from tumble.poses.progressive import neus, sdf_field
from tumble.poses.progressive.neus import RayBatch, Rendered
from tumble.poses.progressive.ray_sampling import Pixels
from tumble.poses.progressive.sdf_field import Sizes
from tumble.scene.camera import Camera

SIZES = Sizes(width=64, depth=3, skip=0, features=4, octaves=0, colour_width=8, colour_depth=1, colour_octaves=0)


def rendered_rays(opacity: torch.Tensor, rgb: torch.Tensor, points: torch.Tensor | None = None) -> Rendered:
    """Rendered rays with one section each."""
    points = torch.zeros(len(opacity), 3) if points is None else points
    return Rendered(rgb, opacity, opacity[:, None], points[:, None], 2 * torch.ones(len(opacity), 3))


def target_pixels(mask: torch.Tensor, rgb: torch.Tensor) -> Pixels:
    """Targets of rays whose directions do not matter."""
    return Pixels(torch.zeros(len(mask), 3), rgb, mask)


def test_losses_by_hand() -> None:
    rendered = rendered_rays(torch.tensor([0.5, 1.0, 0.0]), torch.full((3, 3), 0.5))
    truth = target_pixels(
        torch.tensor([1.0, 1.0, 0.0]), torch.tensor([[0.5, 0.6, 0.5], [0.2, 0.5, 0.5], [0.0, 0.0, 0.0]])
    )
    # Summed over channels, averaged over the two object pixels.
    assert float(neus.colour_loss(rendered, truth)) == pytest.approx((0.1 + 0.3) / 2, rel=1e-4)
    expected = -(math.log(0.5) + 2 * math.log(1 - neus.OPACITY_MARGIN)) / 3
    assert float(neus.mask_loss(rendered, truth)) == pytest.approx(expected, rel=1e-4)
    assert float(neus.eikonal_loss(rendered)) == pytest.approx((2 * math.sqrt(3) - 1) ** 2, rel=1e-5)


def test_losses_without_rays_are_zero() -> None:
    empty = rendered_rays(torch.zeros(0), torch.zeros(0, 3))
    truth = target_pixels(torch.zeros(0), torch.zeros(0, 3))
    terms = (neus.colour_loss(empty, truth), neus.mask_loss(empty, truth), neus.eikonal_loss(empty))
    assert [float(term) for term in terms] == [0.0, 0.0, 0.0]


def test_transfer_residuals_do_not_depend_on_the_opacity() -> None:
    """FMOV's projection scales with the opacity; a ray that misses the object has weight 0."""
    camera = Camera.from_fov(0.6, 80, 80)
    T_aim_obj = SE3(SO3.exp(torch.tensor([0.2, -0.4, 0.1])).wxyz, torch.tensor([0.1, 0.0, 4.0]))
    points = torch.tensor([[0.2, 0.3, -0.4], [0.2, 0.3, -0.4], [0.5, 0.0, 0.0]])
    truth = camera.project(T_aim_obj @ points)
    residual, weight = neus.transfer_residuals(
        rendered_rays(torch.tensor([1.0, 0.3, 0.0]), torch.zeros(3, 3), points), slice(0, 3), T_aim_obj, camera, truth
    )
    # 1e-4 in the denominator, over an opacity of 0.3, for a point 24 pixels from the centre.
    assert residual[:2].abs().max() < 0.02
    assert weight.tolist() == [1.0, 1.0, 0.0]


def test_the_huber_loss_is_quadratic_for_small_and_linear_for_large_residuals() -> None:
    ones = torch.ones(1)
    near, far = torch.tensor([[0.4, 0.0]]), torch.tensor([[100.0, 100.0]])
    assert float(neus.huber_loss(near, ones, threshold=4.0)) == pytest.approx(0.5 * 0.16 / 4 / 2, rel=1e-3)
    assert float(neus.huber_loss(far, ones, threshold=4.0)) == pytest.approx(98.0, rel=1e-3)
    both = neus.huber_loss(torch.cat([near, far]), torch.tensor([1.0, 0.0]), threshold=4.0)
    assert float(both) == pytest.approx(0.01, rel=1e-3)


def test_the_initial_sphere_renders_as_a_disc_under_any_pose() -> None:
    """Two batches of rays from two sides, rendered together: the silhouette of a sphere of radius 0.5 at distance 4."""
    net = sdf_field.sphere_initialised(SIZES, torch.Generator().manual_seed(0))
    across = torch.linspace(-0.3, 0.3, 61)
    directions = torch.nn.functional.normalize(torch.stack([across, 0 * across, torch.ones(61)], -1), dim=-1)
    pixels = Pixels(directions, torch.zeros(61, 3), torch.zeros(61))
    poses = [SE3(SO3.exp(torch.tensor(w)).wxyz, torch.tensor([0.0, 0.0, 4.0])) for w in ([0.0, 0.0, 0.0], [2.0, 1, 0])]
    rendered = neus.render_batches(net, [RayBatch(pixels, T) for T in poses], 64, bound=1.0, rng=None)
    edge = math.tan(math.asin(0.5 / 4))
    for half in rendered.opacity.detach().split(61):
        # Sharpness 20 blurs the border by 3 / 20 of a radius, 0.04 of a tangent; the shape is a sphere to a twentieth.
        assert half[across.abs() < edge - 0.04].min() > 0.7
        assert half[across.abs() > edge + 0.04].max() < 0.3
