"""Whether there is a highlight: objects of known strength, from a start that is a little wrong in all things."""

import math

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from tumble import coarse_light, matte
from tumble.buffers import Buffers
from tumble.coarse_light import CoarseLight
from tumble.directions import fibonacci_sphere, random_rotation
from tumble.photograph import Frame

FRAMES, POINTS = 24, 300


def light(strength: float) -> CoarseLight:
    """One side brighter than the other, and another tint."""
    coefficients = 0.4 * torch.randn(16, 3, generator=torch.Generator().manual_seed(2))
    coefficients[0] += torch.tensor([3.0, 2.5, 2.0])
    return CoarseLight(coefficients, torch.tensor(math.log(strength)))


@pytest.mark.parametrize(("strength", "is_matte"), [(matte.NONE, True), (1.0, False), (0.6, False)])
def test_a_highlight_is_told_from_none(strength: float, is_matte: bool) -> None:
    """A ball of many colours turns under a light."""
    generator = torch.Generator().manual_seed(1)
    normals, albedo = fibonacci_sphere(POINTS), torch.rand(POINTS, 3, generator=generator) * 0.6
    turns = [random_rotation(generator) for _ in range(FRAMES)]
    true = light(strength)

    def seen(lit: CoarseLight, colour: Tensor, number: int) -> tuple[Tensor, Tensor]:
        R_cam_obj = turns[number]
        view = normalize(4 * R_cam_obj.T[:, 2] - normals, dim=-1)
        facing = (view * normals).sum(-1) > 0.1
        return coarse_light.radiance(lit, colour, normals, view, R_cam_obj)[facing], facing

    def error(trial: matte.Trial, number: int) -> Tensor:
        found, _ = seen(trial.light, torch.sigmoid(trial.albedo_logits), number)
        return (found - seen(true, albedo, number)[0]).abs().mean()

    wrong = 0.1 * torch.randn(POINTS, 3, generator=generator)
    coefficients = true.coefficients + 0.1 * torch.randn(16, 3, generator=generator)
    start = matte.Trial(torch.logit(albedo.clamp_min(0.01)) + wrong, CoarseLight(coefficients, torch.tensor(-0.4)))
    before = [x.clone() for x in (start.albedo_logits, start.light.coefficients)]
    found = matte.without_highlight(start, error, FRAMES)
    assert (found is not None) == is_matte
    assert torch.equal(before[0], start.albedo_logits)
    assert torch.equal(before[1], start.light.coefficients)
    if found is not None:
        assert float(found.light.log_highlight.exp()) == pytest.approx(matte.NONE)
        assert error(found, 0) < 0.3 * error(start, 0)


def test_only_pixels_well_inside_are_asked() -> None:
    alpha = torch.tensor([[1.0, 1.0, 0.5], [1.0, 1.0, 1.0]])
    flat = torch.zeros(2, 3)
    normal = torch.zeros(2, 3, 3)
    view = Buffers(
        rgb=torch.zeros(2, 3, 3),
        alpha=alpha,
        depth=flat,
        depth_var=flat,
        normal=normal,
        features={},
        dominant=flat.int(),
        weight=torch.zeros(1),
        touched=torch.zeros(1).int(),
    )
    mask = torch.tensor([[1.0, 0.0, 1.0], [1.0, 1.0, 1.0]])
    image = torch.full((2, 3, 3), 9.0)
    image[mask * alpha == 1] = torch.tensor([0.1, 0.2, 0.3])
    assert float(matte.left_over(view, Frame(image, mask, torch.ones(2, 3, 1)))) == pytest.approx(0.2)
    nothing = Frame(image, torch.zeros(2, 3), torch.ones(2, 3, 1))
    assert float(matte.left_over(view, nothing)) == 0
