"""How much the pictures say about where a track's point is: texture, told from shading and noise.

A matcher answers on a plain surface too, and its answer there is "nothing moved": shading and highlights stay with the
light. Texture is what stands out from its surroundings *and* looks the same in the next frame: slow shading does not
stand out, noise does not come again. Along an edge a point may slide: what is known is a matrix, not a number.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from tumble.capture import OBJECT, Capture
from tumble.tracks import Tracks

BLUR = 5
"""Window whose mean is the surroundings [pixels]."""
HALF = 3
"""Half side of the patches that are compared [pixels]."""
ALIKE = 0.7
"""Correlation of two patches from which they show one texture."""
GRAIN = 2.0
"""Noise of a photograph at least, code values: rounding, and what a patch changes when it turns."""


def information(capture: Capture, tracks: Tracks) -> Float[Tensor, "o 2 2"]:
    """Of every observation's place, by the patch around it and around the next observation of its point [1/pixel^2].

    Zero where the two are not alike; of the last observation of a point nothing is said, it is zero as well.
    """
    order = torch.argsort(tracks.point * len(capture) + tracks.frame)
    follows = tracks.point[order][1:] == tracks.point[order][:-1]
    first, second = order[:-1][follows], order[1:][follows]
    patch = _patches(_standing_out(capture), tracks)
    a, b = (patch[k] - patch[k].mean((1, 2), keepdim=True) for k in (first, second))
    energy = (a.square().sum((1, 2)) * b.square().sum((1, 2))).sqrt()
    alike = (a * b).sum((1, 2)) > ALIKE * energy.clamp_min(1e-9)
    noise2 = ((a - b).square().mean((1, 2)) / 2).clamp_min(GRAIN**2)
    slope = torch.stack([0.5 * (a[:, 1:-1, 2:] - a[:, 1:-1, :-2]), 0.5 * (a[:, 2:, 1:-1] - a[:, :-2, 1:-1])], -1)
    found = torch.einsum("nyxi,nyxj->nij", slope, slope) * (alike / noise2)[:, None, None]
    return torch.zeros(len(tracks), 2, 2, dtype=torch.float64).index_copy_(0, first, found.double())


def _standing_out(capture: Capture) -> Float[Tensor, "t h w"]:
    """Grey values minus the mean of the object's around them; zero off the object [code values]."""
    inside = (capture.masks == OBJECT).float()[:, None]
    grey = capture.images.float().mean(-1)[:, None] * inside
    around, share = (avg_pool2d(picture, BLUR, 1, BLUR // 2) for picture in (grey, inside))
    mean = around / share.clamp_min(1e-6)
    return ((grey - mean) * inside)[:, 0]


def _patches(pictures: Float[Tensor, "t h w"], tracks: Tracks) -> Float[Tensor, "o p p"]:
    """The square around every observation, bilinear."""
    ticks = torch.arange(-HALF, HALF + 1)
    around = torch.stack(torch.meshgrid(ticks, ticks, indexing="xy"), -1).flatten(0, 1)
    size = torch.tensor([pictures.shape[2], pictures.shape[1]])
    out = torch.zeros(len(tracks), len(around))
    for frame, picture in enumerate(pictures):
        mine = torch.nonzero(tracks.frame == frame)[:, 0]
        at = (2 * (tracks.uv[mine, None].float() + around) / size - 1)[None]
        out[mine] = grid_sample(picture[None, None], at, align_corners=False)[0, 0]
    return out.unflatten(1, (len(ticks), len(ticks)))
