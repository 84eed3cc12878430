"""Which parts of the surface the frames show, and what to record again, in one sentence.

Points of the surface come from depth maps of the finished asset, seen from all around. A frame *faces* a point if the
point is in front, unoccluded by the object itself and at a usable angle; it *shows* the point if moreover the mask says
that its pixel is object. So a point that frames face and do not show is hidden by something else: a hand.

Shading tells albedo from light only if the surface turns in the light: the normals of a point, in the frame of the
light, over the frames that show it, must not all be the same.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import normalize

from tumble.maths import SE3, fibonacci_sphere
from tumble.rendering import rasterize
from tumble.scene import OBJECT, Asset, Camera, Capture

N_VIEWS = 40
"""Number of directions from which the surface is sampled."""
VIEW_SIDE = 96
"""Side of the depth maps [pixels]."""
VIEW_DISTANCE = 6.0
"""Distance of the virtual cameras from the object's centre [object radius]."""
VIEW_RADIUS = 1.1
"""Radius of the sphere that fits into a depth map [object radius]."""
CELL = 0.06
"""Side of the cells of which each gives one point per side of the surface [object radius]."""
MAX_GAP = 2.5
"""Largest distance of neighbouring points of one surface [side of a cell]."""
MIN_ALPHA = 0.5
"""Minimum coverage of a pixel that shows the surface."""
MIN_COSINE = math.cos(math.radians(70))
"""Minimum cosine of the angle between the normal of a point and the direction to the camera at which it is usable."""
MAX_DEPTH_DIFFERENCE = 0.08
"""Largest distance of a point behind the visible surface at which it counts as visible [object radius]."""
MIN_SHOWN = 3
"""Minimum number of frames that show a point that counts as seen."""
MIN_TURN = math.radians(10)
"""Minimum RMS angle of the normals of a point from their mean for light from several directions [radians]."""
MIN_REGION = 0.03
"""Smallest fraction of the surface that is worth another recording."""
MIN_LIT_REGION = 0.1
"""Smallest fraction of the surface under one light only that is mentioned."""
NORMAL_WEIGHT = 0.2
"""Distance to which the difference of two unit normals corresponds [object radius]."""
MIN_SIDE_FRACTION = 0.5
"""Fraction of a side above which the whole side is named, not a part of it."""
SIDES = ("top", "bottom", "front", "back", "right side", "left side")
"""Names of the sides of the object, as they are in the first frame."""


@dataclass(frozen=True)
class Coverage:
    """Points of the surface, and the numbers of frames that show them."""

    points: Float[Tensor, "n 3"]
    """Object frame [object radius]."""
    normals: Float[Tensor, "n 3"]
    """Outward, unit length."""
    faced: Float[Tensor, " n"]
    """Number of frames that face the point."""
    shown: Float[Tensor, " n"]
    """Number of frames that show the point."""
    turn: Float[Tensor, " n"]
    """RMS angle between the normals and their mean, in the frame of the light, over these frames [radians]."""
    front: Float[Tensor, "3"]
    """Horizontal unit direction to the camera of the first frame, object frame."""

    @property
    def side(self) -> Int64[Tensor, " n"]:
        """Index in `SIDES` of the side to which each point belongs, by its normal."""
        up = torch.eye(3).to(self.front)[1]
        right = torch.linalg.cross(up, self.front)
        directions = torch.stack([up, -up, self.front, -self.front, right, -right])
        return (self.normals @ directions.T).argmax(-1)

    @property
    def seen(self) -> Bool[Tensor, " n"]:
        """Points that enough frames show."""
        return self.shown >= MIN_SHOWN

    @property
    def hidden(self) -> Bool[Tensor, " n"]:
        """Points that enough frames face, but something hides."""
        return ~self.seen & (self.faced >= MIN_SHOWN)


@dataclass(frozen=True)
class Advice:
    """What to record again."""

    sentence: str
    region: Bool[Tensor, " n"] | None
    """Points of the surface that the sentence is about; None if nothing is to be improved."""


@torch.no_grad()
def coverage_of(asset: Asset, capture: Capture) -> Coverage:
    """Coverage of an asset's surface by its training frames.

    Args:
        capture: The asset's training frames, in the order of its trajectory.
    """
    points, normals = _surface(asset)
    trajectory, camera = asset.trajectory, asset.camera
    scale = min(1.0, 2 * VIEW_SIDE / max(camera.height, camera.width))
    small = camera.resized(max(1, round(scale * camera.height)), max(1, round(scale * camera.width)))
    faced, shown = torch.zeros_like(points[:, 0]), torch.zeros_like(points[:, 0])
    total = torch.zeros_like(points)
    for i in range(len(trajectory)):
        T_cam_obj = trajectory.T_cam_obj[i]
        view = rasterize(asset.gaussians, asset.gamma, T_cam_obj, small, {})
        x_cam = T_cam_obj @ points
        direction = normalize(trajectory.camera_positions[i] - points, dim=-1)
        depth, inside = _at_pixels(view.depth, small, x_cam)
        in_front = inside & (x_cam[:, 2] < depth + MAX_DEPTH_DIFFERENCE) & ((direction * normals).sum(-1) > MIN_COSINE)
        labels, _ = _at_pixels(capture.masks[i].to(points.device), camera, x_cam)
        visible = in_front & (labels == OBJECT)
        faced, shown = faced + in_front, shown + visible
        total += visible[:, None] * (normals @ trajectory.R_env_obj[i].T)
    # The more unit vectors differ, the shorter is their mean: 1 - length is half the squared RMS angle, if it is small.
    length = total.norm(dim=-1) / shown.clamp(min=1)
    turn = (2 * (1 - length.clamp(max=1))).sqrt()
    return Coverage(points, normals, faced, shown, turn, _front(trajectory.camera_positions[0]))


def advice(coverage: Coverage, *, light_turns: bool) -> Advice:
    """What to record again, in one sentence.

    Args:
        light_turns: Whether the object turns in the light; otherwise the light on a point is always the same.
    """
    n = len(coverage.points)
    if not n:
        return Advice("The reconstruction has no surface, so nothing is known about its parts.", None)
    unseen = ~coverage.seen
    turned_away = unseen & ~coverage.hidden
    covered = float(coverage.hidden.sum()) / n
    away = float(turned_away.sum()) / n
    if max(covered, away) >= MIN_REGION and covered >= away:
        where = f"{_name(coverage, coverage.hidden)} ({_percent(covered)} of the surface)"
        frames = "nearly all frames" if _in_some(coverage, coverage.hidden) else "all frames"
        return Advice(
            f"Something, such as the hand, covers {where} in {frames}: turn the object over and regrasp it, so that "
            "this part is free.",
            coverage.hidden,
        )
    if away >= MIN_REGION:
        where = _name(coverage, turned_away)
        return Advice(
            f"{'Hardly any' if _in_some(coverage, turned_away) else 'No'} frame shows {where} ({_percent(away)} of the "
            f"surface): turn this part to the camera as well.",
            turned_away,
        )
    still = coverage.seen & (coverage.turn < MIN_TURN)
    if light_turns and float(still.sum()) / n >= MIN_LIT_REGION:
        return Advice(
            f"All of the surface was seen, but {_name(coverage, still)} ({_percent(float(still.sum()) / n)} of the "
            f"surface) in one attitude to the light only: turn the object while this part faces the camera.",
            still,
        )
    fewest = int(coverage.shown[coverage.seen].quantile(0.05))
    light = ", in changing light" if light_turns else ""
    return Advice(f"All of the surface was seen, nearly every part in at least {fewest} frames{light}.", None)


def by_side(coverage: Coverage) -> list[tuple[str, str, str]]:
    """Name of each side, the fraction of it that was seen, and the median number of frames that show a point of it."""
    rows = []
    for k, name in enumerate(SIDES):
        on_side = coverage.side == k
        if on_side.any():
            seen = float(coverage.seen[on_side].float().mean())
            rows.append((name, _percent(seen), f"{float(coverage.shown[on_side].median()):.0f}"))
    return rows


def best_direction(coverage: Coverage, region: Bool[Tensor, " n"]) -> Float[Tensor, "3"]:
    """The direction from which most of a region is visible at a good angle, object frame."""
    directions = fibonacci_sphere(N_VIEWS).to(coverage.normals)
    return directions[(directions @ coverage.normals[region].T).clamp(min=0).sum(-1).argmax()]


def nearest_oriented(
    points: Float[Tensor, "m 3"], normals: Float[Tensor, "m 3"], coverage: Coverage
) -> Int64[Tensor, " m"]:
    """Index of the point of the coverage that is nearest in position and normal."""
    ours, theirs = (
        torch.cat([x, NORMAL_WEIGHT * n], -1) for x, n in ((points, normals), (coverage.points, coverage.normals))
    )
    return torch.cat([torch.cdist(part, theirs).argmin(-1) for part in ours.split(4096)])


def outside_view(direction: Float[Tensor, "3"], points: Float[Tensor, "n 3"] | None = None) -> tuple[SE3, Camera]:
    """Pose and camera that show an object from a direction, +y up where that is possible.

    Args:
        points: What is to be shown, object frame; None is a sphere around the object.
    """
    centre = direction.new_zeros(3) if points is None else points.mean(0)
    radius = VIEW_RADIUS if points is None else VIEW_RADIUS * float((points - centre).norm(dim=-1).max())
    backward = normalize(direction, dim=0)
    up = torch.eye(3).to(direction)[1 if abs(float(backward[1])) < 0.9 else 2]
    right = normalize(torch.linalg.cross(up, backward), dim=0)
    R_cam_obj = torch.stack([right, -torch.linalg.cross(backward, right), -backward])
    offset = torch.tensor([0.0, 0.0, VIEW_DISTANCE]).to(direction) - R_cam_obj @ centre
    matrix = torch.cat([torch.cat([R_cam_obj, offset[:, None]], 1), torch.eye(4).to(direction)[3:]])
    fov = 2 * math.asin(min(radius, VIEW_DISTANCE / 2) / VIEW_DISTANCE)
    return SE3.from_matrix(matrix), Camera.from_fov(fov, VIEW_SIDE, VIEW_SIDE)


def _surface(asset: Asset) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Points and normals of the visible surface, about evenly spaced: one for each cell and side of the surface."""
    positions, normals = [], []
    for direction in fibonacci_sphere(N_VIEWS).to(asset.gaussians.means):
        T_cam_obj, camera = outside_view(direction)
        camera = Camera(camera.fx_fy_cx_cy.to(direction), camera.height, camera.width)
        view = rasterize(asset.gaussians, asset.gamma, T_cam_obj, camera, {})
        normal = normalize(view.normal, dim=-1)
        # At the edge of a part before another one, the mean depth is that of neither.
        sharp = view.depth_var.clamp(min=0).sqrt() < CELL
        solid = (view.alpha > MIN_ALPHA) & ((normal @ direction) > MIN_COSINE) & sharp
        x_cam = camera.unproject(camera.pixel_centers(), view.depth)[solid]
        positions.append(T_cam_obj.inverse() @ x_cam)
        normals.append(normal[solid])
    points, directions = torch.cat(positions), torch.cat(normals)
    axis = directions.abs().argmax(-1)
    side = 2 * axis + (directions.gather(-1, axis[:, None])[:, 0] > 0)
    cells = torch.cat([(points / CELL).floor().long(), side[:, None]], -1)
    _, ids, counts = cells.unique(dim=0, return_inverse=True, return_counts=True)
    mean = torch.zeros(len(counts), 6).to(points).index_add(0, ids, torch.cat([points, directions], -1))
    mean = mean / counts[:, None]
    mean = mean[_main_part(mean[:, :3])]
    return mean[:, :3], normalize(mean[:, 3:], dim=-1)


def _main_part(points: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    """The largest group of points whose cells are neighbours; others float beside the object."""
    near = torch.cdist(points, points) < MAX_GAP * CELL
    group = torch.arange(len(points), device=points.device)
    while len(points):
        larger = torch.where(near, group, 0).amax(1)
        if torch.equal(larger, group):
            break
        group = larger
    return group == group.mode().values if len(points) else group > 0


def _at_pixels(image: Tensor, camera: Camera, x_cam: Float[Tensor, "n 3"]) -> tuple[Tensor, Bool[Tensor, " n"]]:
    """Values of an image at points, camera frame, and whether they lie in the image."""
    uv = camera.project(x_cam).nan_to_num().clamp(-1, 1e5).floor().long()
    size = torch.tensor([camera.width, camera.height], device=uv.device)
    inside = ((uv >= 0) & (uv < size)).all(-1) & (x_cam[:, 2] > 0)
    column, row = uv.clamp(min=torch.zeros_like(size), max=size - 1).unbind(-1)
    return image[row, column], inside


def _front(position: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Horizontal unit direction to a camera; +z if that is above or below."""
    horizontal = position * torch.tensor([1.0, 0.0, 1.0]).to(position)
    away = float(horizontal.norm()) > 0.1 * float(position.norm())
    return normalize(horizontal, dim=0) if away else torch.eye(3).to(position)[2]


def _name(coverage: Coverage, region: Bool[Tensor, " n"]) -> str:
    """The sides of the object that a region covers, as they are in the first frame."""
    inside, all_points = (torch.bincount(side, minlength=len(SIDES)) for side in (coverage.side[region], coverage.side))
    whole = [f"the {SIDES[int(k)]}" for k in torch.where(inside > MIN_SIDE_FRACTION * all_points)[0]]
    if not whole:
        return f"part of the {SIDES[int(inside.argmax())]}"
    return whole[0] if len(whole) == 1 else f"{', '.join(whole[:-1])} and {whole[-1]}"


def _in_some(coverage: Coverage, region: Bool[Tensor, " n"]) -> bool:
    """Whether most points of a region are shown by some frames, though by too few."""
    return float(coverage.shown[region].median()) > 0


def _percent(fraction: float) -> str:
    return f"{fraction:.0%}"
