"""Terms of stage 1 at cases whose value is known."""

import math

import pytest
import torch

from tumble.maths.se3 import SE3, SO3
from tumble.poses.progressive import neus, sdf_field
from tumble.poses.progressive.neus import Glimpse, Rendered
from tumble.poses.progressive.ray_sampling import Pixels
from tumble.poses.progressive.sdf_field import Sizes
from tumble.scene.camera import Camera

SIZES = Sizes(width=64, depth=3, skip=0, features=4, octaves=0, colour_width=8, colour_depth=1, colour_octaves=0)


def seen(opacity: torch.Tensor, rgb: torch.Tensor, points: torch.Tensor | None = None) -> Rendered:
    """Rays that met the object in one section each."""
    points = torch.zeros(len(opacity), 3) if points is None else points
    return Rendered(rgb, opacity, opacity[:, None], points[:, None], 2 * torch.ones(len(opacity), 1, 3))


def shown(mask: torch.Tensor, rgb: torch.Tensor) -> Pixels:
    return Pixels(torch.zeros(len(mask), 3), rgb, mask)


def test_errors_by_hand() -> None:
    rendered = seen(torch.tensor([0.5, 1.0, 0.0]), torch.full((3, 3), 0.5))
    truth = shown(torch.tensor([1.0, 1.0, 0.0]), torch.tensor([[0.5, 0.6, 0.5], [0.2, 0.5, 0.5], [0.0, 0.0, 0.0]]))
    # Channels summed, over the two object pixels.
    assert float(neus.colour_error(rendered, truth)) == pytest.approx((0.1 + 0.3) / 2, rel=1e-4)
    expected = -(math.log(0.5) + 2 * math.log(1 - neus.LEAST)) / 3
    assert float(neus.mask_error(rendered, truth)) == pytest.approx(expected, rel=1e-4)
    assert float(neus.eikonal(rendered)) == pytest.approx((2 * math.sqrt(3) - 1) ** 2, rel=1e-5)


def test_a_frame_of_unknown_pixels_costs_nothing() -> None:
    nothing = seen(torch.zeros(0), torch.zeros(0, 3))
    truth = shown(torch.zeros(0), torch.zeros(0, 3))
    terms = (neus.colour_error(nothing, truth), neus.mask_error(nothing, truth), neus.eikonal(nothing))
    assert [float(term) for term in terms] == [0.0, 0.0, 0.0]


def test_a_transfer_is_a_projection_whatever_the_weights_sum_to() -> None:
    """FMOV's sum would shrink with the opacity; a ray that met nothing has no say."""
    camera = Camera.from_fov(0.6, 80, 80)
    T_aim_obj = SE3(SO3.exp(torch.tensor([0.2, -0.4, 0.1])).wxyz, torch.tensor([0.1, 0.0, 4.0]))
    points = torch.tensor([[0.2, 0.3, -0.4], [0.2, 0.3, -0.4], [0.5, 0.0, 0.0]])
    truth = camera.project(T_aim_obj @ points)
    residual, weight = neus.transfer(
        seen(torch.tensor([1.0, 0.3, 0.0]), torch.zeros(3, 3), points), slice(0, 3), T_aim_obj, camera, truth
    )
    # 1e-4 against division by zero, over 0.3, of a point 24 pixels from the middle.
    assert residual[:2].abs().max() < 0.02
    assert weight.tolist() == [1.0, 1.0, 0.0]


def test_the_robust_mean_is_squared_near_and_straight_far() -> None:
    ones = torch.ones(1)
    near, far = torch.tensor([[0.4, 0.0]]), torch.tensor([[100.0, 100.0]])
    assert float(neus.robust(near, ones, threshold=4.0)) == pytest.approx(0.5 * 0.16 / 4 / 2, rel=1e-3)
    assert float(neus.robust(far, ones, threshold=4.0)) == pytest.approx(98.0, rel=1e-3)
    both = neus.robust(torch.cat([near, far]), torch.tensor([1.0, 0.0]), threshold=4.0)
    assert float(both) == pytest.approx(0.01, rel=1e-3)


def test_a_look_at_the_starting_sphere_sees_a_disc_under_any_pose() -> None:
    """Two glimpses of one shape from two sides, in one batch; the silhouette of a ball of radius 0.5 at 4."""
    net = sdf_field.sphere(SIZES, torch.Generator().manual_seed(0))
    across = torch.linspace(-0.3, 0.3, 61)
    directions = torch.nn.functional.normalize(torch.stack([across, 0 * across, torch.ones(61)], -1), dim=-1)
    part = Pixels(directions, torch.zeros(61, 3), torch.zeros(61))
    poses = [SE3(SO3.exp(torch.tensor(w)).wxyz, torch.tensor([0.0, 0.0, 4.0])) for w in ([0.0, 0.0, 0.0], [2.0, 1, 0])]
    rendered = neus.look(net, [Glimpse(part, T) for T in poses], 64, bound=1.0, rng=None)
    edge = math.tan(math.asin(0.5 / 4))
    for half in rendered.opacity.detach().split(61):
        # Sharpness 20 blurs the border over 3 / 20 of a radius, 0.04 of a tangent; the sphere is one to a twentieth.
        assert half[across.abs() < edge - 0.04].min() > 0.7
        assert half[across.abs() > edge + 0.04].max() < 0.3
