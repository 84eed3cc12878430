"""How much the pictures say about where a track's point is: texture, told from shading and noise.

A matcher answers on a plain surface too, and its answer there is "nothing moved": shading and highlights stay with the
light. Texture is what stands out from its surroundings, *moves* against the silhouette, and looks the same where it has
moved to, but not where it would be had it stayed: slow shading does not stand out, noise does not come again, what the
light paints does not move. Along an edge a point may slide: what is known is a matrix, not a number.

Grain is noise that a film's compression carries from one frame to the next, on moving patches as well: patches are
compared across more than a frame, and after a mean over few pixels, which leaves less of grain than of most texture.
"""

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from tumble.poses.sfm.tracks import Tracks
from tumble.scene import OBJECT, Capture

GRAINS, BLUR = 3, 9
"""Windows whose means are compared: what stands out, and its surroundings [pixels]."""
HALF = 5
"""Half side of the patches that are compared: of means, smaller ones look alike by chance [pixels]."""
ALIKE = 0.7
"""Correlation of two patches from which they show one texture."""
UNLIKE = 0.3
"""By how much that has to exceed the correlation with the patch that kept its place in the silhouette."""
MOVED, NEXT, AHEAD = 2.0, 2, 8
"""Way against the silhouette from which a point is known to move [pixels], and the nearest and the farthest of its
later observations among which one that far is looked for."""
CORNER = 0.1
"""Information across the strongest direction, over that along it, from which it counts: a bent edge is no corner."""
GRAIN = 2.0
"""Noise of a photograph at least, code values: rounding, and what a patch changes when it turns."""


def information(capture: Capture, tracks: Tracks) -> Float[Tensor, "o 2 2"]:
    """Of every observation's place, by the patch around it and around a later observation of its point [1/pixel^2].

    Zero where the two do not show one moving texture; of the last observation of a point nothing is said, it is zero.
    """
    first, second, stayed = _pairs(capture, tracks)
    standing = _standing_out(capture)
    patch = _patches(standing, tracks)
    there = Tracks(tracks.frame[second], torch.arange(len(second)), stayed)
    a, b, c = (x - x.mean((1, 2), keepdim=True) for x in (patch[first], patch[second], _patches(standing, there)))
    alike, still = _correlation(a, b), _correlation(a, c)
    good = (alike > ALIKE) & (still < alike - UNLIKE)
    noise2 = (a - b).square().mean((1, 2)) / 2
    slope = torch.stack([0.5 * (a[:, 1:-1, 2:] - a[:, 1:-1, :-2]), 0.5 * (a[:, 2:, 1:-1] - a[:, :-2, 1:-1])], -1)
    found = torch.einsum("nyxi,nyxj->nij", slope, slope)
    strength, axes = torch.linalg.eigh(found)
    # Noise has slopes as well, the same in all directions; means two pixels apart share a third of theirs.
    shared = 1 - 2 / GRAINS
    strength = (strength - slope.shape[1] * slope.shape[2] * (1 - shared) * noise2[:, None] / 2).clamp_min(0)
    strength[:, 0] *= strength[:, 0] > CORNER * strength[:, 1]
    # As many pixels share the noise of one mean, and say nothing new.
    strength = strength * (good / (GRAINS**2 * noise2).clamp_min(GRAIN**2))[:, None]
    found = axes @ torch.diag_embed(strength) @ axes.mT
    return torch.zeros(len(tracks), 2, 2, dtype=torch.float64).index_copy_(0, first, found.double())


def _pairs(capture: Capture, tracks: Tracks) -> tuple[Int64[Tensor, " p"], Int64[Tensor, " p"], Float[Tensor, "p 2"]]:
    """Pairs of observations of one point between which it moved; where it would be, had it kept its place in the
    silhouette."""
    inside = (capture.masks == OBJECT).double()
    area = inside.sum((1, 2)).clamp_min(1)
    centre = torch.einsum("thw,hwc->tc", inside, capture.camera.pixel_centers().double()) / area[:, None]
    order = torch.argsort(tracks.point * len(capture) + tracks.frame)
    first, second = order[:0], order[:0]
    left = torch.ones(len(order), dtype=torch.bool)
    for ahead in range(NEXT, AHEAD + 1):
        a, b = order[:-ahead], order[ahead:]
        stayed = _stayed(tracks, area, centre, a, b)
        far = (tracks.uv[b] - stayed).norm(dim=-1) > MOVED
        new = left[a] & (tracks.point[a] == tracks.point[b]) & far
        first, second = torch.cat([first, a[new]]), torch.cat([second, b[new]])
        left[a[new]] = False
    return first, second, _stayed(tracks, area, centre, first, second)


def _stayed(tracks: Tracks, area: Tensor, centre: Tensor, first: Tensor, second: Tensor) -> Float[Tensor, "p 2"]:
    i, j = tracks.frame[first], tracks.frame[second]
    return centre[j] + (tracks.uv[first] - centre[i]) * (area[j] / area[i]).sqrt()[:, None]


def _correlation(a: Float[Tensor, "n p p"], b: Float[Tensor, "n p p"]) -> Float[Tensor, " n"]:
    energy = (a.square().sum((1, 2)) * b.square().sum((1, 2))).sqrt()
    return (a * b).sum((1, 2)) / energy.clamp_min(1e-9)


def _standing_out(capture: Capture) -> Float[Tensor, "t h w"]:
    """Means of the object's grey values minus those of wider windows; zero off the object [code values]."""
    inside = (capture.masks == OBJECT).float()[:, None]
    grey = capture.images.float().mean(-1)[:, None] * inside
    near, far = (
        avg_pool2d(grey, n, 1, n // 2) / avg_pool2d(inside, n, 1, n // 2).clamp_min(1e-6) for n in (GRAINS, BLUR)
    )
    return ((near - far) * inside)[:, 0]


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
