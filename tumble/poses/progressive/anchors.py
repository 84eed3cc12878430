"""Anchors: pixels of a frame with their matched positions in other frames, and rays through silhouettes' borders.

They are what `adjustment` explains by poses and a shape. All rays are in the aim frame of `virtual_camera` and have
depth 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from tumble.poses.progressive.virtual_camera import FILL, Aim, camera_to_aim
from tumble.scene import BACKGROUND, OBJECT, Capture, Match

RADIUS_PIXELS = 50.0
"""Radius of the largest silhouette in the frame whose pixels are the unit of residuals [pixels]."""
COUNT = 100
"""Number of anchors per frame."""
NEAREST = 0.012
"""Distance from an anchor to the nearest match, up to which it takes its position from it [image widths]."""
MIN_MATCHES = 20
"""Smallest number of matches of a pair of frames that is used."""
BORDER = 48
"""Number of rays through the silhouette's border per frame."""


@dataclass(frozen=True)
class Anchors:
    """Anchors and silhouettes of `t` frames, double precision."""

    ray: Float[Tensor, "t a 3"]
    """Ray of each anchor in its own frame."""
    partner: Int64[Tensor, "t k"]
    """Frames in which the anchors of a frame are seen; the frame itself where there are fewer."""
    seen: Float[Tensor, "t a k 2"]
    """Positions x / z, y / z in the partners' aim frames."""
    weight: Float[Tensor, "t a k"]
    """Confidence of each observation, 0 where there is none."""
    border: Float[Tensor, "t c 3"]
    """Rays through the silhouette's border."""
    border_weight: Float[Tensor, "t c"]
    """1, or 0 where there is no ray."""
    focal: float
    """Focal length at which the largest silhouette's radius is `RADIUS_PIXELS` [pixels]."""

    def select(self, frames: Sequence[int]) -> "Anchors":
        """Some frames, with what they show of each other."""
        index = torch.tensor(frames)
        place = torch.full((len(self.ray),), -1)
        place[index] = torch.arange(len(index))
        partner = place[self.partner[index]]
        weight = self.weight[index] * (partner >= 0)[:, None]
        partner = torch.where(partner >= 0, partner, torch.arange(len(index))[:, None])
        border = self.border[index], self.border_weight[index]
        return Anchors(self.ray[index], partner, self.seen[index], weight, *border, self.focal)


def gather(capture: Capture, aim: Aim, matches: Sequence[Match]) -> Anchors:
    """Anchors and silhouettes of all frames."""
    n = len(capture)
    of_frame: list[list[Match]] = [[] for _ in range(n)]
    for match in matches:
        if len(match) >= MIN_MATCHES:
            of_frame[match.i].append(match)
            of_frame[match.j].append(match.reversed())
    k = max(1, *(len(found) for found in of_frame))
    ray = torch.tensor([0.0, 0.0, 1.0]).double().repeat(n, COUNT, 1)
    partner = torch.arange(n)[:, None].repeat(1, k)
    seen, weight = torch.zeros(n, COUNT, k, 2).double(), torch.zeros(n, COUNT, k).double()
    border, border_weight = ray[:, :1].repeat(1, BORDER, 1), torch.zeros(n, BORDER).double()
    for frame, found in enumerate(of_frame):
        edge = _border(capture, frame)
        border[frame, : len(edge)] = _rays(capture, aim, frame, edge)
        border_weight[frame, : len(edge)] = 1
        if not found:
            continue
        uv = _spread(torch.cat([match.uv_i for match in found]), COUNT)
        ray[frame, : len(uv)] = _rays(capture, aim, frame, uv)
        for slot, match in enumerate(found):
            distance, nearest = torch.cdist(uv, match.uv_i).min(1)
            near = distance < NEAREST * capture.camera.width
            uv_j = match.uv_j[nearest] + uv - match.uv_i[nearest]
            seen[frame, : len(uv), slot] = _rays(capture, aim, match.j, uv_j)[:, :2]
            weight[frame, : len(uv), slot] = (near * match.confidence[nearest]).double()
            partner[frame, slot] = match.j
    focal = RADIUS_PIXELS * float(aim.camera.fx_fy_cx_cy[0]) / (0.5 * FILL * aim.camera.width)
    return Anchors(ray, partner, seen, weight, border, border_weight, focal)


def _rays(capture: Capture, aim: Aim, frame: int, uv: Float[Tensor, "m 2"]) -> Float[Tensor, "m 3"]:
    """Rays through positions of a frame [pixels]."""
    uv_aim = camera_to_aim(aim, capture.camera, frame, uv.to(capture.camera.fx_fy_cx_cy))
    return aim.camera.unproject(uv_aim, torch.ones_like(uv_aim[:, 0])).double()


def _spread(uv: Float[Tensor, "m 2"], n: int) -> Float[Tensor, "b 2"]:
    """At most `n` of some positions, each far from those chosen before (farthest point sampling)."""
    distance = torch.full_like(uv[:, 0], torch.inf)
    chosen = [0] if len(uv) else []
    while len(chosen) < min(n, len(uv)):
        distance = torch.minimum(distance, (uv - uv[chosen[-1]]).square().sum(-1))
        chosen.append(int(distance.argmax()))
    return uv[chosen]


def _border(capture: Capture, frame: int) -> Float[Tensor, "c 2"]:
    """Positions between neighbouring pixels of object and background, spread along the border [pixels]."""
    mask = capture.masks[frame]
    found = []
    for axis, shift in ((0, (0.5, 1.0)), (1, (1.0, 0.5))):
        a, b = mask.narrow(axis, 0, mask.shape[axis] - 1), mask.narrow(axis, 1, mask.shape[axis] - 1)
        differs = ((a == OBJECT) & (b == BACKGROUND)) | ((a == BACKGROUND) & (b == OBJECT))
        found.append(differs.nonzero().flip(-1) + torch.tensor(shift))
    return _spread(torch.cat(found).to(capture.camera.fx_fy_cx_cy), BORDER)
