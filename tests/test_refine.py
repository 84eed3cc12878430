"""Stage 2: what one step computes."""

import math

import torch

from tumble import losses, refine
from tumble.buffers import Buffers
from tumble.camera import Camera
from tumble.coarse_light import CoarseLight
from tumble.gaussians import Gaussians
from tumble.refine import Config, Frame, Params, Points
from tumble.se3 import SE3, SO3


def test_a_window_around_the_object_gives_the_losses_of_the_whole_picture(monkeypatch) -> None:
    """A ball off the middle, rendered a little to the left of where it was photographed; mask and gradients too."""
    h, w, n = 60, 70, 12
    rng = torch.Generator().manual_seed(0)
    like = {"generator": rng, "dtype": torch.float64}
    row, column = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    rendered, mask = (((row - 25) ** 2 + (column - x) ** 2 < 100).double() for x in (38, 40))
    images = [(rendered * torch.rand(h, w, **like)).requires_grad_() for _ in range(3)]
    normal, rgb = ((rendered[..., None] * torch.rand(h, w, 3, **like)).requires_grad_() for _ in range(2))
    nothing = torch.zeros(n)
    view = Buffers(*images, normal, rgb, {}, nothing + 1, nothing.int(), torch.zeros(h, w, dtype=torch.int32))
    truth = Frame(mask[..., None] * torch.rand(h, w, 3, **like), mask, torch.ones(h, w, 1, dtype=torch.float64))
    means = 0.1 * torch.randn(n, 3, **like)
    gaussians = Gaussians(means, torch.randn(n, 4, **like), means - 2, means[:, 0], means[:, None])
    params = Params(Points(gaussians, means), torch.tensor(30.0), CoarseLight.constant(0.4, means), torch.zeros(1, 6))
    T_cam_obj = SE3.from_rotation(SO3.exp(0.3 * means[0]), torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64))
    arguments = (Config(), params, view, truth, Camera.from_fov(math.radians(40), h, w), T_cam_obj, 0.5)

    def terms_and_gradients() -> list[torch.Tensor]:
        terms = refine._terms(*arguments)
        gradients = torch.autograd.grad(torch.stack(list(terms.values())).sum(), [*images, normal, rgb])
        # The rasterizer has nothing to differentiate where nothing is.
        return [*terms.values(), *(x[rendered > 0] for x in gradients)]

    cut, _, _, share = refine._window(view, truth, arguments[4])
    assert cut.alpha.shape == (19 + 2 * losses.SSIM_MARGIN, 21 + 2 * losses.SSIM_MARGIN)
    assert share == cut.alpha.numel() / (h * w)
    found = terms_and_gradients()
    monkeypatch.setattr(refine, "_window", lambda view, truth, camera: (view, truth, camera, 1.0))
    torch.testing.assert_close(found, terms_and_gradients())


def test_a_picture_with_nothing_in_it_has_losses_too() -> None:
    black, none = torch.zeros(20, 20), torch.zeros(0)
    coloured = torch.zeros(20, 20, 3)
    view = Buffers(black, black, black, coloured, coloured, {}, none, none.int(), black.int())
    truth, camera = Frame(coloured, black, torch.ones(20, 20, 1)), Camera.from_fov(1.0, 20, 20)
    assert refine._window(view, truth, camera) == (view, truth, camera, 1.0)
