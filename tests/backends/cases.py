"""Scenes for conformance tests of backends: an easy one, a hard one, and an empty one."""

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from tumble import backends
from tumble.backends import Backend, Rendering, reference

DIFFERENTIABLE = 6
"""Number of results of `rasterize` that are differentiable; they are the first ones."""


class Scene(NamedTuple):
    """Differentiable arguments of `rasterize`, in order, and the image size."""

    inputs: list[Tensor]
    height: int
    width: int


def facing(normals: Tensor) -> Tensor:
    """Quaternions of rotations from +z to the normals (none may be -z)."""
    w, x, y = 1 + normals[:, 2], -normals[:, 1], normals[:, 0]
    return normalize(torch.stack([w, x, y, torch.zeros_like(w)], -1), dim=-1)


def fibonacci(n: int) -> Tensor:
    """n directions of equal solid angle."""
    i = torch.arange(n, dtype=torch.float64) + 0.5
    z, phi = 1 - 2 * i / n, i * math.pi * (3 - math.sqrt(5))
    r = (1 - z * z).sqrt()
    return torch.stack([r * phi.cos(), r * phi.sin(), z], -1)


def shell(n: int, thickness: float = 0.1) -> list[Tensor]:
    """Means, quaternions, scales and opacity of a closed unit sphere of flat Gaussians."""
    means = fibonacci(n)
    spread = math.sqrt(4 * math.pi / n)
    scales = torch.tensor([spread, spread, spread * thickness], dtype=torch.float64).expand(n, 3)
    return [means, facing(means), scales, torch.full((n,), 0.9, dtype=torch.float64)]


def camera(height: int, width: int) -> list[Tensor]:
    """Extrinsics of a general pose, and intrinsics with a principal point that is not centred."""
    q = normalize(torch.tensor([[0.9, 0.2, -0.3, 0.25]], dtype=torch.float64), dim=-1)
    focal = torch.tensor([1.3 * width, 1.25 * width, 0.5 * width + 0.3, 0.5 * height - 0.2], dtype=torch.float64)
    return [reference.rotation(q)[0], torch.tensor([0.05, -0.1, 3.0], dtype=torch.float64), focal]


def easy() -> Scene:
    """Semi-transparent Gaussians of moderate shape, all within the image."""
    rng = torch.Generator().manual_seed(1)
    n, height, width = 150, 40, 48
    means, quats, scales, _ = shell(n)
    quats = quats + 0.1 * _normal(rng, n, 4)
    scales = scales * torch.exp(0.3 * _normal(rng, n, 3)) * torch.tensor([1.0, 1.0, 3.0], dtype=torch.float64)
    opacity = 0.1 + 0.6 * torch.rand(n, generator=rng, dtype=torch.float64)
    sh = 0.3 * _normal(rng, n, 4, 3)
    sh[:, 0] += 1.5
    return _round(
        Scene([means, quats, scales, opacity, sh, _normal(rng, n, 4, 3), *camera(height, width)], height, width)
    )


def hard() -> Scene:
    """Opaque, overlapping, elongated and very thin Gaussians; some outside the image, behind the camera, or black."""
    rng = torch.Generator().manual_seed(6)
    n, height, width = 400, 37, 51
    means, quats, scales, _ = shell(n)
    means = means * (0.5 + 0.6 * torch.rand(n, 1, generator=rng, dtype=torch.float64))
    means[:60] += 2.5 * _normal(rng, 60, 3)
    quats = (quats + 0.2 * _normal(rng, n, 4)) * torch.exp(_normal(rng, n, 1))
    scales = 1.2 * scales * torch.exp(0.6 * _normal(rng, n, 3))
    scales[100:140, 2] = 1e-4
    scales[140:170, 1] = 1e-3
    opacity = 0.6 + 0.4 * torch.rand(n, generator=rng, dtype=torch.float64)
    opacity[50:350] = 1.0
    opacity[40:50] = 1 / 300
    sh = _normal(rng, n, 16, 3)
    return _round(
        Scene([means, quats, scales, opacity, sh, _normal(rng, n, 4, 5), *camera(height, width)], height, width)
    )


def empty() -> Scene:
    """A scene without Gaussians."""
    scene = easy()
    return scene._replace(inputs=[*(x[:0] for x in scene.inputs[:6]), *scene.inputs[6:]])


SCENES = {"easy": easy, "hard": hard, "empty": empty}


def seeds(scene: Scene) -> list[Tensor]:
    """Random gradients of all differentiable results; that of the depth variance, which is small, is larger."""
    rng = torch.Generator().manual_seed(5)
    h, w, c = scene.height, scene.width, scene.inputs[5].shape[2]
    shapes = [(h, w, 3), (h, w), (h, w), (h, w), (h, w, 3), (h, w, c)]
    return [scale * _normal(rng, *shape) for shape, scale in zip(shapes, [1, 1, 1, 30, 1, 1], strict=True)]


def render(
    backend: Backend, scene: Scene, dtype: torch.dtype, mask: Tensor | None = None
) -> tuple[Rendering, list[Tensor]]:
    """A view rendered by a backend, and the gradients of all inputs from the gradients `seeds`."""
    inputs = [x.to(dtype).requires_grad_() for x in scene.inputs]
    mask = torch.ones(1, 1) if mask is None else mask
    view = backend.rasterize(*inputs, scene.height, scene.width, mask.to(dtype))
    seeded = [v.to(dtype) for v in seeds(scene)]
    return view, list(torch.autograd.grad(view[:DIFFERENTIABLE], inputs, seeded))


def fast() -> list[str]:
    """Names of all backends except the reference."""
    return [name for name in backends.names() if name != "reference"]


def difference(value: Tensor, truth: Tensor) -> float:
    """Relative L2 distance of a value to the truth; absolute if the truth is zero."""
    value, truth = value.detach().double().cpu(), truth.detach().double()
    norm = truth.norm().item()
    return (value - truth).norm().item() / (norm if norm > 0 else 1.0)


def _normal(rng: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=rng, dtype=torch.float64)


def _round(scene: Scene) -> Scene:
    """The scene with inputs rounded to float32, so that both precisions render the same scene."""
    return scene._replace(inputs=[x.float().double() for x in scene.inputs])
