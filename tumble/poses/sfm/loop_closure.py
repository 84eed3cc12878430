"""Matches of frames that see one side of the object from far apart, by a shape and poses that are roughly right.

The visual hull tells which frames share a side, and where each pixel of the one is seen in the other. Drawn there, the
other frame looks almost as if seen from here, whatever the angle in between; what still lies apart is the error of the
poses, a few pixels that any matcher follows. Both ends of a match are places in photographs, so that the hull's own
error does not count.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample, normalize, pad

from tumble import matching
from tumble.maths import SE3
from tumble.poses.frame_pairs import Pairs, best
from tumble.scene import BACKGROUND, OBJECT, Camera, Capture, Match, Trajectory, View, visual_hull

CELLS = 64
"""Of the hull's grid, per side."""
POINTS = 2000
"""Of its surface that are asked which frames see them."""
STEEP = 0.2
"""Cosine between normal and line of sight from which a point is seen well enough to be matched."""
SHARED = 0.03
"""Least mean of that cosine less STEEP over the surface, the smaller of two frames': a ball's seen 60 degrees apart."""
FEW, MOST = 20, 100
"""Matches under which a pair says nothing, and matches about which are kept of one."""


@dataclass(frozen=True)
class Seen:
    """What the object's pixels of a frame show of the hull."""

    at: tuple[Tensor, Tensor]
    """Rows and columns of these pixels."""
    x_obj: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]


def comebacks(capture: Capture, trajectory: Trajectory, matcher: str, *, count: int, gap: int) -> list[Match]:
    """Matches of up to `count` pairs of frames, more than `gap` apart in time, that share most of what they see.

    Args:
        trajectory: Right to some pixels; the object lies in the unit ball.
        matcher: File name in `matching`.
    """
    cells = visual_hull.carve(_bordered(capture), trajectory, resolution=CELLS)
    if not bool((cells > 0.5).any()):
        return []
    normals = visual_hull.outward(cells)
    pairs = _sharing(
        visual_hull.surface(cells, POINTS, torch.Generator().manual_seed(0)), trajectory, count=count, gap=gap
    )
    eyes = trajectory.T_cam_obj.inverse().xyz
    shown = {
        i: _seen(cells, normals, capture.masks[i] == OBJECT, trajectory.T_cam_obj[i], capture.camera)
        for i in {i for i, _ in pairs}
    }
    found = []
    for i, j in pairs:
        seen = shown[i]
        slant = torch.minimum(*(_cosine(eyes[k], seen.x_obj, seen.normals) for k in (i, j)))
        uv = capture.camera.project(trajectory.T_cam_obj[j] @ seen.x_obj)
        found.append(_through(capture, matcher, i, j, seen, uv, slant > STEEP))
    return [match for match in found if len(match) >= FEW]


def _bordered(capture: Capture) -> Capture:
    """Masks with background around them, twice as wide: what no frame shows would count as inside."""
    top, left = (side // 2 for side in capture.masks.shape[1:])
    masks = pad(capture.masks, (left, left, top, top), value=BACKGROUND)
    camera = capture.camera.cropped(-top, -left, *masks.shape[1:])
    return Capture(masks[..., None].expand(-1, -1, -1, 3), masks, camera, capture.names, capture.light)


def _cosine(eye: Float[Tensor, "3"], x: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    return (normalize(eye - x, dim=-1) * normals).sum(-1)


def _sharing(surface: visual_hull.OrientedPoints, trajectory: Trajectory, *, count: int, gap: int) -> Pairs:
    """Pairs of frames that see the same points of a surface, as if nothing stood in the way."""
    eyes = trajectory.T_cam_obj.inverse().xyz
    seen = torch.stack([_cosine(eye, surface.positions, surface.normals) for eye in eyes]).sub(STEEP).clamp_min(0)
    score = torch.stack([torch.minimum(one, seen).mean(-1) for one in seen])
    return best(score, count=count, gap=gap, least=SHARED, spread=1)


def _seen(
    cells: Float[Tensor, "x y z"],
    normals: Float[Tensor, "x y z 3"],
    where: Bool[Tensor, "h w"],
    T_cam_obj: SE3,
    camera: Camera,
) -> Seen:
    """Where the rays of some pixels enter the hull; those that miss it are left out."""
    T_obj_cam = T_cam_obj.inverse()
    directions = normalize(T_obj_cam.rotation @ camera.directions()[where], dim=-1)
    origin = T_obj_cam.xyz
    closest = -(directions @ origin)
    half = (1 - (origin + closest[:, None] * directions).square().sum(-1)).clamp_min(0).sqrt()
    ticks = closest[:, None] + half[:, None] * torch.linspace(-1, 1, 2 * CELLS)
    inside = _sampled(cells[..., None], origin + ticks[..., None] * directions[:, None])[..., 0]
    # The ball's own surface is outside: a crossing always lies behind a first tick.
    after = (inside > 0.5).long().argmax(-1).clamp_min(1)[:, None]
    low, high = inside.gather(1, after - 1), inside.gather(1, after)
    share = ((0.5 - low) / (high - low).clamp_min(1e-6)).clamp(0, 1)
    along = torch.lerp(ticks.gather(1, after - 1), ticks.gather(1, after), share)
    x_obj = origin + along * directions
    hit = (inside > 0.5).any(-1)
    rows, columns = torch.nonzero(where)[hit].T
    return Seen((rows, columns), x_obj[hit], normalize(_sampled(normals, x_obj[hit]), dim=-1))


def _sampled(volume: Float[Tensor, "x y z c"], x_obj: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b c"]:
    at = x_obj.reshape(1, 1, 1, -1, 3).flip(-1)
    found = grid_sample(volume.permute(3, 0, 1, 2)[None], at, padding_mode="border", align_corners=False)
    return found[0, :, 0, 0].T.reshape(*x_obj.shape[:-1], volume.shape[-1])


def _through(
    capture: Capture, matcher: str, i: int, j: int, seen: Seen, uv: Float[Tensor, "n 2"], good: Bool[Tensor, " n"]
) -> Match:
    """Match frame i with frame j as drawn in i's pixels, and go from there to the places in j that were drawn."""
    camera = capture.camera
    shown = _at(torch.cat([capture.images[j].float(), 255.0 * (capture.masks[j] == OBJECT)[..., None]], -1), uv)
    good = good & (shown[:, 3] > 254)
    image = torch.zeros_like(capture.images[i])
    image[seen.at] = (shown[:, :3] * good[:, None]).round().to(torch.uint8)
    mask = torch.full_like(capture.masks[i], BACKGROUND)
    mask[seen.at] = torch.where(good, OBJECT, BACKGROUND).to(mask)
    own, other = View(i, capture.images[i], capture.masks[i]), View(j, image, mask)
    match = matching.match_pairs([own, other], [(0, 1)], matcher)[0]
    match = match.select(torch.arange(len(match))[:: 1 + len(match) // MOST])
    drawn = uv.new_zeros(camera.height, camera.width, 2)
    drawn[seen.at] = uv
    return Match(i, j, match.uv_i, _at(drawn, match.uv_j), match.confidence)


def _at(picture: Float[Tensor, "h w c"], uv: Float[Tensor, "m 2"]) -> Float[Tensor, "m c"]:
    """Values at places of a picture, bilinear."""
    size = uv.new_tensor([picture.shape[1], picture.shape[0]])
    at = (2 * uv / size - 1)[None, None]
    return grid_sample(picture.permute(2, 0, 1)[None], at, align_corners=False)[0, :, 0].T
