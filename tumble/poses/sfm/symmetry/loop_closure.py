"""Loop closure: matches between frames far apart in time that see the same side of the object.

The visual hull of the silhouettes, carved with approximate poses, predicts which frames share a side and where each
pixel of one frame appears in the other. The other frame is warped into the first view by this prediction. What remains
between the two images is the error of the poses, a few pixels, which any matcher can follow whatever the angle between
the views. The warp is then undone, so that both ends of a match are pixels of input images and the error of the hull
cancels.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from tumble import matching
from tumble.maths import SE3
from tumble.poses.frame_pairs import Pairs, best_pairs
from tumble.scene import BACKGROUND, OBJECT, Camera, Capture, Match, Trajectory, View, visual_hull

HULL_RESOLUTION = 64
"""Cells of the hull's grid along each side."""
SURFACE_POINTS = 2000
"""Points sampled on the hull to estimate which surface two frames share."""
MIN_COSINE = 0.2
"""Minimum cosine between normal and line of sight for a surface point to be matched."""
MIN_COVISIBILITY = 0.03
"""Minimum covisibility of two frames (`_covisible_pairs`): that of views of a sphere 60 degrees apart."""
MIN_MATCHES = 20
"""A pair of frames with fewer matches is discarded."""
MAX_MATCHES = 100
"""Maximum number of matches kept of a pair; more are thinned out evenly."""


@dataclass(frozen=True)
class HullPixels:
    """Pixels of a frame whose rays hit the hull, and the points where they hit it."""

    row_column: tuple[Tensor, Tensor]
    """Rows and columns of these pixels."""
    x_obj: Float[Tensor, "n 3"]
    """First intersection of each ray with the hull, object frame."""
    normals: Float[Tensor, "n 3"]
    """Outward unit normals there."""


def loop_closures(capture: Capture, trajectory: Trajectory, matcher: str, *, count: int, gap: int) -> list[Match]:
    """Matches of the most covisible pairs of frames that are far apart in time.

    Args:
        capture: Images and masks of all frames.
        trajectory: Approximate poses, accurate to some pixels; the object lies in the unit sphere.
        matcher: Name of a module of `matching`.
        count: Maximum number of pairs.
        gap: Pairs are more than this number of frames apart.
    """
    cells = visual_hull.carve(visual_hull.padded(capture), trajectory, resolution=HULL_RESOLUTION)
    if not bool((cells > 0.5).any()):
        return []
    normals = visual_hull.outward_gradient(cells)
    pairs = _covisible_pairs(
        visual_hull.sample_surface(cells, SURFACE_POINTS, torch.Generator().manual_seed(0)),
        trajectory,
        count=count,
        gap=gap,
    )
    camera_centres = trajectory.camera_positions
    hull_pixels = {
        i: _hull_pixels(cells, normals, capture.masks[i] == OBJECT, trajectory.T_cam_obj[i], capture.camera)
        for i in {i for i, _ in pairs}
    }
    # All in one call, for which a matcher computes features of every view once.
    views = matching.views_of(capture)
    predicted = []
    for i, j in pairs:
        pixels = hull_pixels[i]
        cosine = torch.minimum(
            *(visual_hull.view_cosine(camera_centres[k], pixels.x_obj, pixels.normals) for k in (i, j))
        )
        predicted.append(capture.camera.project(trajectory.T_cam_obj[j] @ pixels.x_obj))
        views.append(_warped_view(capture, j, pixels, predicted[-1], cosine > MIN_COSINE))
    numbers = [(i, len(capture) + number) for number, (i, _) in enumerate(pairs)]
    matches = matching.match_pairs(views, numbers, matcher)
    found = [
        _unwarped(match, j, hull_pixels[i], uv, capture.camera)
        for match, (i, j), uv in zip(matches, pairs, predicted, strict=True)
    ]
    return [match for match in found if len(match) >= MIN_MATCHES]


def _covisible_pairs(surface: visual_hull.OrientedPoints, trajectory: Trajectory, *, count: int, gap: int) -> Pairs:
    """Pairs of frames with the highest covisibility; occlusion is ignored.

    The covisibility of two frames is a mean over the surface points. Each point counts by how far the cosine between
    its normal and its line of sight exceeds `MIN_COSINE` in both frames.
    """
    cosines = visual_hull.view_cosine(trajectory.camera_positions[:, None], surface.positions, surface.normals)
    excess = cosines.sub(MIN_COSINE).clamp_min(0)
    score = torch.stack([torch.minimum(row, excess).mean(-1) for row in excess])
    return best_pairs(score, count=count, gap=gap, min_score=MIN_COVISIBILITY, spread=1)


def _hull_pixels(
    cells: Float[Tensor, "x y z"],
    normals: Float[Tensor, "x y z 3"],
    foreground: Bool[Tensor, "h w"],
    T_cam_obj: SE3,
    camera: Camera,
) -> HullPixels:
    """Intersections of the foreground pixels' rays with the hull; pixels whose rays miss it are left out."""
    T_obj_cam = T_cam_obj.inverse()
    directions = normalize(T_obj_cam.rotation @ camera.directions()[foreground], dim=-1)
    origin = T_obj_cam.xyz
    middle = -(directions @ origin)
    half_chord = (1 - (origin + middle[:, None] * directions).square().sum(-1)).clamp_min(0).sqrt()
    distances = middle[:, None] + half_chord[:, None] * torch.linspace(-1, 1, 2 * HULL_RESOLUTION)
    inside = _sample_volume(cells[..., None], origin + distances[..., None] * directions[:, None])[..., 0]
    # The first sample lies on the unit sphere, outside the hull, so that a sample always precedes the crossing.
    after = (inside > 0.5).long().argmax(-1).clamp_min(1)[:, None]
    low, high = inside.gather(1, after - 1), inside.gather(1, after)
    fraction = ((0.5 - low) / (high - low).clamp_min(1e-6)).clamp(0, 1)
    distance = torch.lerp(distances.gather(1, after - 1), distances.gather(1, after), fraction)
    x_obj = origin + distance * directions
    hit = (inside > 0.5).any(-1)
    rows, columns = torch.nonzero(foreground)[hit].T
    return HullPixels((rows, columns), x_obj[hit], normalize(_sample_volume(normals, x_obj[hit]), dim=-1))


def _sample_volume(volume: Float[Tensor, "x y z c"], x_obj: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b c"]:
    """Values of a grid over [-1, 1]^3 at points, trilinear."""
    zyx = x_obj.reshape(1, 1, 1, -1, 3).flip(-1)
    values = grid_sample(volume.permute(3, 0, 1, 2)[None], zyx, padding_mode="border", align_corners=False)
    return values[0, :, 0, 0].T.reshape(*x_obj.shape[:-1], volume.shape[-1])


def _warped_view(
    capture: Capture, j: int, pixels: HullPixels, uv: Float[Tensor, "n 2"], visible: Bool[Tensor, " n"]
) -> View:
    """Frame j warped into the view of another frame.

    Args:
        capture: Images and masks of all frames.
        j: Frame that is warped.
        pixels: Pixels of the other frame.
        uv: Predicted positions of these pixels in frame j [pixels].
        visible: Whether the surface there is visible in both frames, by the angle of its normal.
    """
    rgba = torch.cat([capture.images[j].float(), 255.0 * (capture.masks[j] == OBJECT)[..., None]], -1)
    warped = _sample_image(rgba, uv)
    visible = visible & (warped[:, 3] > 254)
    image = torch.zeros_like(capture.images[j])
    image[pixels.row_column] = (warped[:, :3] * visible[:, None]).round().to(torch.uint8)
    mask = torch.full_like(capture.masks[j], BACKGROUND)
    mask[pixels.row_column] = torch.where(visible, OBJECT, BACKGROUND).to(mask)
    return View(j, image, mask)


def _unwarped(match: Match, j: int, pixels: HullPixels, uv: Float[Tensor, "n 2"], camera: Camera) -> Match:
    """A match with the warped frame j, thinned out, as one with the original pixels of that frame."""
    match = match.select(torch.arange(len(match))[:: 1 + len(match) // MAX_MATCHES])
    warp = uv.new_zeros(camera.height, camera.width, 2)
    warp[pixels.row_column] = uv
    return Match(match.i, j, match.uv_i, _sample_image(warp, match.uv_j), match.confidence)


def _sample_image(image: Float[Tensor, "h w c"], uv: Float[Tensor, "m 2"]) -> Float[Tensor, "m c"]:
    """Values of an image at positions [pixels], bilinear."""
    size = uv.new_tensor([image.shape[1], image.shape[0]])
    grid = (2 * uv / size - 1)[None, None]
    return grid_sample(image.permute(2, 0, 1)[None], grid, align_corners=False)[0, :, 0].T
