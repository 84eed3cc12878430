"""Texture information: how precisely surface texture determines the image positions of track observations.

Matchers also return matches on untextured surfaces, where shading and highlights stay with the light and the matches
report no motion. An observation therefore counts as textured only if its patch has local contrast, moves relative to
the silhouette, and correlates with the patch where the track has moved to, but not with the patch where the point would
be had it not moved. Smooth shading has no local contrast, noise does not correlate between frames, and shading does not
move with the surface.

The information about a position is a 2x2 matrix, as an edge determines it only across the edge. It is the structure
tensor of the patch over the noise variance.

Video compression carries grain along from one frame to the next, on moving patches as well. Patches are therefore
compared more than one frame apart, and after averaging over a few pixels, which reduces grain more than most texture.
"""

import torch
from jaxtyping import Float, Int64
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from tumble.poses.sfm.tracks import Tracks
from tumble.scene import OBJECT, Capture

MEAN_WINDOW = 3
"""Side of the window over which images are averaged [pixels]."""
SURROUND_WINDOW = 9
"""Side of the window whose mean is subtracted to obtain the local contrast [pixels]."""
PATCH_RADIUS = 5
"""Half side of the compared patches [pixels]; averaged patches that are smaller correlate by chance."""
MIN_CORRELATION = 0.7
"""Minimum correlation of two patches that show the same texture."""
MIN_CORRELATION_MARGIN = 0.3
"""Minimum excess of this correlation over that with the patch where the point would be had it not moved."""
MIN_DISPLACEMENT = 2.0
"""Minimum displacement of a point relative to the silhouette between two compared observations [pixels]."""
MIN_AHEAD = 2
"""Minimum distance between two compared observations, counted in observations of their track."""
MAX_AHEAD = 8
"""Maximum distance between two compared observations, counted in observations of their track."""
MIN_EIGENVALUE_RATIO = 0.1
"""Ratio of the structure tensor's eigenvalues below which the smaller is set to 0, as for a curved edge."""
MIN_NOISE = 2.0
"""Minimum standard deviation of pixel noise [code values]: rounding, and the change of a patch under rotation."""


def information(capture: Capture, tracks: Tracks) -> Float[Tensor, "o 2 2"]:
    """Information about the image position of each of `o` observations, an inverse covariance [1/pixel^2].

    It is estimated from the patches around the observation and around a later one of the same track. It is zero where
    they do not show the same moving texture, and where there is no such later observation.
    """
    first, second, static_uv = _moving_pairs(capture, tracks)
    contrast = _local_contrast(capture)
    patch = _patches(contrast, tracks)
    static = Tracks(tracks.frame[second], torch.arange(len(second)), static_uv)
    # Patches around the first and the second observation, and around the static position in the second frame.
    a, b, c = (x - x.mean((1, 2), keepdim=True) for x in (patch[first], patch[second], _patches(contrast, static)))
    moving_correlation, static_correlation = _correlation(a, b), _correlation(a, c)
    distinct = static_correlation < moving_correlation - MIN_CORRELATION_MARGIN
    textured = (moving_correlation > MIN_CORRELATION) & distinct
    noise2 = (a - b).square().mean((1, 2)) / 2
    gradient = torch.stack([0.5 * (a[:, 1:-1, 2:] - a[:, 1:-1, :-2]), 0.5 * (a[:, 2:, 1:-1] - a[:, :-2, 1:-1])], -1)
    structure_tensor = torch.einsum("nyxi,nyxj->nij", gradient, gradient)
    eigenvalues, eigenvectors = torch.linalg.eigh(structure_tensor)
    # Noise adds the same to both eigenvalues. Window means two pixels apart have a third of their noise in common.
    common = 1 - 2 / MEAN_WINDOW
    n_pixels = gradient.shape[1] * gradient.shape[2]
    eigenvalues = (eigenvalues - n_pixels * (1 - common) * noise2[:, None] / 2).clamp_min(0)
    eigenvalues[:, 0] *= eigenvalues[:, 0] > MIN_EIGENVALUE_RATIO * eigenvalues[:, 1]
    # Pixels of one averaging window have their noise in common, so that they count as one measurement.
    eigenvalues = eigenvalues * (textured / (MEAN_WINDOW**2 * noise2).clamp_min(MIN_NOISE**2))[:, None]
    precision = eigenvectors @ torch.diag_embed(eigenvalues) @ eigenvectors.mT
    return torch.zeros(len(tracks), 2, 2, dtype=torch.float64).index_copy_(0, first, precision.double())


def _moving_pairs(
    capture: Capture, tracks: Tracks
) -> tuple[Int64[Tensor, " p"], Int64[Tensor, " p"], Float[Tensor, "p 2"]]:
    """Pairs of observations of one track between which its point moves relative to the silhouette.

    Returns:
        Indices of the first observations, at most one pair for each.
        Indices of the second observations, the nearest in time that moved far enough.
        Static positions in the second frames (`_static_position`) [pixels].
    """
    inside = (capture.masks == OBJECT).double()
    area = inside.sum((1, 2)).clamp_min(1)
    centre = torch.einsum("thw,hwc->tc", inside, capture.camera.pixel_centers().double()) / area[:, None]
    order = torch.argsort(tracks.point * len(capture) + tracks.frame)
    first, second = order[:0], order[:0]
    unpaired = torch.ones(len(order), dtype=torch.bool)
    for ahead in range(MIN_AHEAD, MAX_AHEAD + 1):
        a, b = order[:-ahead], order[ahead:]
        static_uv = _static_position(tracks, area, centre, a, b)
        far = (tracks.uv[b] - static_uv).norm(dim=-1) > MIN_DISPLACEMENT
        new = unpaired[a] & (tracks.point[a] == tracks.point[b]) & far
        first, second = torch.cat([first, a[new]]), torch.cat([second, b[new]])
        unpaired[a[new]] = False
    return first, second, _static_position(tracks, area, centre, first, second)


def _static_position(
    tracks: Tracks, area: Tensor, centre: Tensor, first: Tensor, second: Tensor
) -> Float[Tensor, "p 2"]:
    """Positions in the second frames where the first observations keep their place in the silhouette [pixels]."""
    i, j = tracks.frame[first], tracks.frame[second]
    return centre[j] + (tracks.uv[first] - centre[i]) * (area[j] / area[i]).sqrt()[:, None]


def _correlation(a: Float[Tensor, "n p p"], b: Float[Tensor, "n p p"]) -> Float[Tensor, " n"]:
    """Normalised cross-correlation of patches whose mean is 0."""
    energy = (a.square().sum((1, 2)) * b.square().sum((1, 2))).sqrt()
    return (a * b).sum((1, 2)) / energy.clamp_min(1e-9)


def _local_contrast(capture: Capture) -> Float[Tensor, "t h w"]:
    """Means of the object's grey values minus their means over wider windows; zero off the object [code values]."""
    inside = (capture.masks == OBJECT).float()[:, None]
    grey = capture.images.float().mean(-1)[:, None] * inside
    mean, surround = (
        avg_pool2d(grey, n, 1, n // 2) / avg_pool2d(inside, n, 1, n // 2).clamp_min(1e-6)
        for n in (MEAN_WINDOW, SURROUND_WINDOW)
    )
    return ((mean - surround) * inside)[:, 0]


def _patches(images: Float[Tensor, "t h w"], tracks: Tracks) -> Float[Tensor, "o p p"]:
    """Square patches around all observations, sampled bilinearly."""
    ticks = torch.arange(-PATCH_RADIUS, PATCH_RADIUS + 1)
    offsets = torch.stack(torch.meshgrid(ticks, ticks, indexing="xy"), -1).flatten(0, 1)
    size = torch.tensor([images.shape[2], images.shape[1]])
    patches = torch.zeros(len(tracks), len(offsets))
    for frame, image in enumerate(images):
        observations = torch.nonzero(tracks.frame == frame)[:, 0]
        grid = (2 * (tracks.uv[observations, None].float() + offsets) / size - 1)[None]
        patches[observations] = grid_sample(image[None, None], grid, align_corners=False)[0, 0]
    return patches.unflatten(1, (len(ticks), len(ticks)))
