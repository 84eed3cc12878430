"""A signed distance from Gaussians: depth maps from all around, fused (Curless and Levoy 1996, with planes for points).

Object frame, object radius = 1. A *cell* is a cube of the grid, whose corners hold the *values*: signed distances to
the surface, positive outside, in units of a cell and clamped to `BAND`.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int8, Int32
from torch import Tensor
from torch.nn.functional import max_pool3d, normalize

from tumble.maths import SE3, SO3, fibonacci_sphere, local_frame
from tumble.rendering import Buffers, rasterize
from tumble.scene import Camera, Gaussians

BAND = 4
"""How far from the surface values are known [cells]: more than half the diagonal of a block of 4 x 4 x 4."""
THROUGH = 0.15
"""Share of the views that must see through a point for no view to count it as inside: keeps thin walls thin."""
DISTANCE = 6.0
"""From the cameras to the centre [object radius]."""
REACH = 1.08
"""Half the side of the grid, and what the cameras see [object radius]."""
CHUNK = 1 << 18
"""Points fused at once: bounds memory, changes nothing else."""


def around(n: int, pixels: int) -> tuple[SE3, Camera]:
    """Poses of `n` cameras spread evenly around the object, and what they have in common."""
    backward = fibonacci_sphere(n, dtype=torch.float64)
    R_obj_cam = local_frame(-backward)
    T_cam_obj = SE3.from_rotation(SO3.from_matrix(R_obj_cam), DISTANCE * backward).inverse()
    focal = 0.5 * pixels * (DISTANCE**2 / REACH**2 - 1) ** 0.5
    centre = pixels / 2
    camera = Camera(torch.tensor([focal, focal, centre, centre]), pixels, pixels)
    return SE3(T_cam_obj.wxyz.float(), T_cam_obj.xyz.float()), camera


@torch.no_grad()
def distances(
    gaussians: Gaussians, gamma: Float[Tensor, ""], *, cells: int, views: int, pixels: int
) -> Float[np.ndarray, "g g g"]:
    """Values at the corners of a grid of `cells`^3 that spans [-REACH, REACH]^3, from depth maps of `views` cameras.

    What some views see through is outside, what none sees is inside; near the surface it is the weighted mean of
    distances to the planes that the views' depths and normals span (Curless and Levoy 1996, with planes for points).

    Args:
        gamma: Sharpness of the opacity [1 / object radius].
        cells: A multiple of 4.
        pixels: Side of the depth maps.
    """
    poses, camera = around(views, pixels)
    means = gaussians.means
    camera = Camera(camera.fx_fy_cx_cy.to(means), pixels, pixels)
    poses = SE3(poses.wxyz.to(means), poses.xyz.to(means))
    cell, backs = 2 * REACH / cells, _turned_over(gaussians)
    sights, near = [], torch.zeros((cells + 1,) * 3, dtype=torch.bool, device=means.device)
    for i in range(views):
        view = rasterize(gaussians, gamma, poses[i], camera, {})
        known, x_obj = _surface(view, poses[i], camera, 2 * cell)
        back = rasterize(backs, gamma, poses[i], camera, {}).alpha
        sights.append(_sight(view, known, back, x_obj))
        at = ((x_obj[known] + REACH) / cell).round().long().clamp(0, cells)
        near[at[:, 0], at[:, 1], at[:, 2]] = True
    corners = torch.where(_grown(near, BAND))
    coarse = torch.cartesian_prod(*[torch.arange(2, cells + 1, 4, device=means.device)] * 3)

    def fused(index: Int[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        return torch.cat([_fused(rows * cell - REACH, sights, poses, camera, cell) for rows in index.split(CHUNK)])

    blocks = fused(coarse).sign().reshape((cells // 4,) * 3) * BAND
    values = torch.full((cells + 1,) * 3, float(BAND), device=means.device)
    values[:cells, :cells, :cells] = blocks.repeat_interleave(4, 0).repeat_interleave(4, 1).repeat_interleave(4, 2)
    values[corners] = fused(torch.stack(corners, -1))
    # Nothing reaches the grid's own faces, so that the surface is closed.
    values[[0, -1]], values[:, [0, -1]], values[:, :, [0, -1]] = BAND, BAND, BAND
    return values.cpu().numpy()


def _surface(
    view: Buffers, T_cam_obj: SE3, camera: Camera, spread: float
) -> tuple[Bool[Tensor, "h w"], Float[Tensor, "h w 3"]]:
    """Which pixels show one surface, no mixture of a near and a far one, and where it lies, object frame."""
    known = (view.alpha > 0.5) & (view.depth_var < spread**2) & (view.normal.norm(dim=-1) > 0.1)
    x_cam = camera.unproject(camera.pixel_centers().to(view.depth), view.depth)
    return known, T_cam_obj.inverse() @ x_cam


def _turned_over(gaussians: Gaussians) -> Gaussians:
    """The same with the other side outwards: what a view sees of them it sees from within the object."""
    half_turn = SO3(gaussians.quats.new_tensor([0.0, 1.0, 0.0, 0.0]))
    return replace(gaussians, quats=(SO3(normalize(gaussians.quats, dim=-1)) @ half_turn).wxyz)


@dataclass(frozen=True)
class _Sight:
    """What one view tells; most of its pixels tell little, and there are many views of many pixels."""

    state: Int8[Tensor, " p"]
    """1: a surface; 0: nothing; -1: sky."""
    place: Int32[Tensor, " p"]
    """Of a pixel's plane, where it has one."""
    planes: Float[Tensor, "k 5"]
    """Normal, offset and depth."""


def _sight(
    view: Buffers, known: Bool[Tensor, "h w"], back: Float[Tensor, "h w"], x_obj: Float[Tensor, "h w 3"]
) -> _Sight:
    """A view of the far side's back looks in where no frame ever showed the object: that is no sky."""
    normal = normalize(view.normal[known], dim=-1)
    offset = (normal * x_obj[known]).sum(-1)
    state = known.to(torch.int8) - ((view.alpha < 0.5) & (back < 0.5)).to(torch.int8)
    place = (known.flatten().cumsum(0, dtype=torch.int32) - 1).clamp(min=0)
    planes = torch.cat([normal, torch.stack([offset, view.depth[known]], -1)], -1)
    # A view of nothing but sky.
    planes = planes if len(planes) else planes.new_zeros(1, 5)
    return _Sight(state.flatten(), place, planes)


def _fused(
    x_obj: Float[Tensor, "n 3"], sights: list[_Sight], poses: SE3, camera: Camera, cell: float
) -> Float[Tensor, " n"]:
    """Signed distances [cells] of points, from all views' planes."""
    total, weights, outer, outer_weights, through = x_obj.new_zeros(5, len(x_obj))
    for i, sight in enumerate(sights):
        x_cam = poses[i] @ x_obj
        column, row = camera.project(x_cam).floor().long().unbind(-1)
        inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        pixel = row.clamp(0, camera.height - 1) * camera.width + column.clamp(0, camera.width - 1)
        state, (normal, rest) = sight.state[pixel], sight.planes[sight.place[pixel].long()].split([3, 2], -1)
        offset, depth = rest.unbind(-1)
        distance = ((normal * x_obj).sum(-1) - offset) / cell
        behind = (x_cam[:, 2] - depth) / cell
        through += ~inside | (state < 0) | ((state > 0) & (behind < -3 * BAND) & (distance > BAND))
        cosine = (normal * (poses[i].inverse().xyz - x_obj)).sum(-1) / DISTANCE
        # Two cells behind the surface a view knows no more: it may be another one's air. With a wider fade a plate of
        # three cells comes out four thick (test_a_thin_plate_keeps_both_sides).
        fade = (1 + (distance + 0.5).clamp(max=0) / 1.5).clamp(min=0)
        near = inside & (state > 0) & (distance.abs() < BAND) & (behind.abs() < 3 * BAND)
        weight = near * fade * cosine.clamp(min=0).square()
        total, weights = total + weight * distance, weights + weight
        outer, outer_weights = outer + weight * distance.clamp(min=0), outer_weights + weight * (distance > 0)
    air = through > THROUGH * len(sights)
    total, weights = torch.where(air, outer, total), torch.where(air, outer_weights, weights)
    unseen = torch.where(through >= 2, float(BAND), -float(BAND))
    return torch.where(weights > 0.1, total / weights.clamp(min=0.1), unseen)


def _grown(marked: Bool[Tensor, "a b c"], reach: int) -> Bool[Tensor, "a b c"]:
    """All within `reach` of what is marked, along each axis."""
    x = marked[None, None].float()
    for axis in range(3):
        kernel, padding = [1, 1, 1], [0, 0, 0]
        kernel[axis], padding[axis] = 2 * reach + 1, reach
        x = max_pool3d(x, kernel, 1, padding)
    return x[0, 0] > 0
