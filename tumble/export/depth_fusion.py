"""Truncated signed distance (TSDF) of Gaussians, fused from rendered depth maps (Curless and Levoy 1996).

The cameras surround the object. Each depth map contributes the distance to the tangent plane at a pixel's surface point
instead of the distance along the ray. Object frame, object radius = 1. A *cell* is a cube of the grid; its corners hold
the *values*: signed distances to the surface, positive outside, in units of a cell and clamped to `TRUNCATION`.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int32
from torch import Tensor
from torch.nn.functional import normalize

from tumble import backends
from tumble.maths import SE3, SO3, fibonacci_sphere, local_frame
from tumble.rendering import Buffers, rasterize
from tumble.scene import Camera, Gaussians

TRUNCATION = 4
"""Distance from the surface up to which values are computed [cells]: more than half the diagonal of 4 x 4 x 4 cells."""
FREE_FRACTION = 0.15
"""Fraction of the views that must show free space at a point before the negative distances of all other views are
ignored: otherwise views from one side thicken thin walls on the other."""
MIN_FREE_FRACTION = 0.05
"""Fraction of the views, and at least two, that must show free space at a point far from the surface for it to be
outside. Fewer look in through holes that are left where no frame shows the object, and see an inner surface."""
CAMERA_DISTANCE = 6.0
"""Distance of the cameras from the centre [object radius]."""
HALF_SIDE = 1.08
"""Half the side of the grid, and radius of the sphere that the cameras' images cover [object radius]."""
UNKNOWN, FREE = -1, -2
"""Values of `DepthMaps.index` in pixels without a plane."""
CHUNK = 1 << 18
"""Number of points fused at once by operations of torch: limits memory, without effect on the result."""


def surrounding_cameras(n: int, pixels: int) -> tuple[SE3, Camera]:
    """Poses `T_cam_obj` of `n` cameras spread evenly around the object, and their common intrinsics."""
    backward = fibonacci_sphere(n, dtype=torch.float64)
    R_obj_cam = local_frame(-backward)
    T_cam_obj = SE3.from_rotation(SO3.from_matrix(R_obj_cam), CAMERA_DISTANCE * backward).inverse()
    focal = 0.5 * pixels * (CAMERA_DISTANCE**2 / HALF_SIDE**2 - 1) ** 0.5
    centre = pixels / 2
    camera = Camera(torch.tensor([focal, focal, centre, centre]), pixels, pixels)
    return SE3(T_cam_obj.wxyz.float(), T_cam_obj.xyz.float()), camera


@torch.no_grad()
def signed_distances(
    gaussians: Gaussians, gamma: Float[Tensor, ""], *, cells: int, views: int, pixels: int
) -> Float[np.ndarray, "g g g"]:
    """Values at the corners of a grid of `cells`^3 over [-HALF_SIDE, HALF_SIDE]^3, from depth maps of `views` cameras.

    Near the surface a value is the weighted mean of the distances to the planes given by the views' depths and normals.
    Elsewhere, points in the free space of enough views (`MIN_FREE_FRACTION`) are outside, all others inside.

    Args:
        gamma: Sharpness of the opacity [1 / object radius].
        cells: Cells per side; a multiple of 4.
        pixels: Side of the depth maps [pixels].
    """
    poses, camera = surrounding_cameras(views, pixels)
    means = gaussians.means
    camera = Camera(camera.fx_fy_cx_cy.to(means), pixels, pixels)
    poses = SE3(poses.wxyz.to(means), poses.xyz.to(means))
    cell, backs, centres = 2 * HALF_SIDE / cells, _flipped(gaussians), camera.pixel_centers().to(means)
    # Whether a hole shows backs is a matter of larger regions than pixels.
    small, rows = camera.resized(-(-pixels // 2), -(-pixels // 2)), torch.arange(pixels, device=means.device) // 2
    index, planes = means.new_empty(views, pixels, pixels, dtype=torch.int32), [means.new_zeros(0, 5)]
    near = torch.zeros((cells + 1,) * 3, dtype=torch.bool, device=means.device)
    for i in range(views):
        view = rasterize(gaussians, gamma, poses[i], camera, {})
        known, x_obj = _surface(view, poses[i], camera, centres, 2 * cell)
        back = rasterize(backs, gamma, poses[i], small, {}).alpha[rows[:, None], rows]
        index[i] = _plane_index(view, known, back, sum(map(len, planes)))
        planes.append(_planes(view, known, x_obj))
        at = ((x_obj + HALF_SIDE) / cell).round().long().clamp(0, cells)
        near[at[:, 0], at[:, 1], at[:, 2]] = True
    maps, cameras = backends.DepthMaps(index, torch.cat(planes)), posed_cameras(poses, camera)
    corners = torch.where(_dilated(near, TRUNCATION))
    coarse = torch.cartesian_prod(*[torch.arange(2, cells + 1, 4, device=means.device)] * 3)

    def fused(index: Int[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        return _fuse(index * cell - HALF_SIDE, maps, cameras, cell)

    blocks = fused(coarse).sign().reshape((cells // 4,) * 3) * TRUNCATION
    values = torch.full((cells + 1,) * 3, float(TRUNCATION), device=means.device)
    values[:cells, :cells, :cells] = blocks.repeat_interleave(4, 0).repeat_interleave(4, 1).repeat_interleave(4, 2)
    values[corners] = fused(torch.stack(corners, -1))
    # The grid's own faces are outside, so that the surface is closed.
    values[::cells], values[:, ::cells], values[:, :, ::cells] = TRUNCATION, TRUNCATION, TRUNCATION
    return values.cpu().numpy()


def _surface(
    view: Buffers, T_cam_obj: SE3, camera: Camera, centres: Float[Tensor, "h w 2"], spread: float
) -> tuple[Bool[Tensor, "h w"], Float[Tensor, "k 3"]]:
    """Mask of pixels that show a single surface (small depth variance), and their surface points, object frame."""
    known = (view.alpha > 0.5) & (view.depth_var < spread**2) & (view.normal.norm(dim=-1) > 0.1)
    x_cam = camera.unproject(centres[known], view.depth[known])
    return known, T_cam_obj.inverse() @ x_cam


def _flipped(gaussians: Gaussians) -> Gaussians:
    """The Gaussians with reversed normals: a view that renders them looks at the surface from inside the object."""
    half_turn = SO3(gaussians.quats.new_tensor([0.0, 1.0, 0.0, 0.0]))
    return replace(gaussians, quats=(SO3(normalize(gaussians.quats, dim=-1)) @ half_turn).wxyz)


def _plane_index(
    view: Buffers, known: Bool[Tensor, "h w"], back: Float[Tensor, "h w"], first: int
) -> Int32[Tensor, "h w"]:
    """`DepthMaps.index` of a view; pixels that show only backs of Gaussians (`back`) look in through a hole: unknown.

    Args:
        first: Row of the view's first plane.
    """
    rows = (known.flatten().cumsum(0, dtype=torch.int32) + (first - 1)).view_as(known)
    other = torch.where((view.alpha < 0.5) & (back < 0.5), FREE, UNKNOWN).int()
    return torch.where(known, rows, other)


def _planes(view: Buffers, known: Bool[Tensor, "h w"], x_obj: Float[Tensor, "k 3"]) -> Float[Tensor, "k 5"]:
    """`DepthMaps.planes` of a view."""
    normal = normalize(view.normal[known], dim=-1)
    return torch.cat([normal, (normal * x_obj).sum(-1, keepdim=True), view.depth[known][:, None]], -1)


def posed_cameras(poses: SE3, camera: Camera) -> backends.Cameras:
    """The cameras as kernels take them."""
    return backends.Cameras(poses.rotation.matrix(), poses.xyz, poses.inverse().xyz, camera.fx_fy_cx_cy)


def _fuse(
    x_obj: Float[Tensor, "n 3"], maps: backends.DepthMaps, cameras: backends.Cameras, cell: float
) -> Float[Tensor, " n"]:
    """Signed distances of points [cells], from the depth maps of all views."""
    kernel = backends.fuse_kernel(backends.choose(x_obj.device, x_obj.dtype))
    sums = (kernel or sums_by_operations)(x_obj, maps, cameras, cell=cell, reach=TRUNCATION, distance=CAMERA_DISTANCE)
    total, weights, outer, outer_weights, n_free = sums
    free = n_free > FREE_FRACTION * len(maps.index)
    total, weights = torch.where(free, outer, total), torch.where(free, outer_weights, weights)
    far = torch.where(n_free >= max(2, MIN_FREE_FRACTION * len(maps.index)), float(TRUNCATION), -float(TRUNCATION))
    return torch.where(weights > 0.1, total / weights.clamp(min=0.1), far)


def sums_by_operations(
    points: Float[Tensor, "n 3"],
    maps: backends.DepthMaps,
    cameras: backends.Cameras,
    *,
    cell: float,
    reach: float,
    distance: float,
) -> Float[Tensor, "5 n"]:
    """The definition of `FuseKernel` by operations of torch: weighted sum of the distances to the planes and sum of the
    weights, both sums over positive distances only, and number of views that show free space at the point."""
    return torch.cat([_sums_of_chunk(x, maps, cameras, cell, reach, distance) for x in points.split(CHUNK)], -1)


def _sums_of_chunk(
    x_obj: Float[Tensor, "n 3"],
    maps: backends.DepthMaps,
    cameras: backends.Cameras,
    cell: float,
    reach: float,
    camera_distance: float,
) -> Float[Tensor, "5 n"]:
    _, height, width = maps.index.shape
    focal, centre = cameras.fx_fy_cx_cy.split(2)
    sums = x_obj.new_zeros(5, len(x_obj))
    for i, rows in enumerate(maps.index.flatten(1)):
        x_cam = x_obj @ cameras.R[i].T + cameras.t[i]
        column, row = (x_cam[:, :2] / x_cam[:, 2:] * focal + centre).floor().long().unbind(-1)
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        plane = torch.where(inside, rows[torch.where(inside, row * width + column, 0)], FREE)
        sums[4] += plane == FREE
        index = torch.where(plane >= 0)[0]
        normal, offset, depth = maps.planes[plane[index].long()].split([3, 1, 1], -1)
        x, behind = x_obj[index], (x_cam[index, 2] - depth[:, 0]) / cell
        distance = ((normal * x).sum(-1) - offset[:, 0]) / cell
        sums[4].index_add_(0, index, ((behind < -3 * reach) & (distance > reach)).to(sums))
        cosine = (normal * (cameras.positions[i] - x)).sum(-1) / camera_distance
        # The weight fades to 0 two cells behind the surface, where a thin wall may have ended. With a wider fade, a
        # plate of three cells comes out four cells thick (test_a_thin_plate_keeps_both_sides).
        fade = (1 + (distance + 0.5).clamp(max=0) / 1.5).clamp(min=0)
        weight = (distance.abs() < reach) * (behind.abs() < 3 * reach) * fade * cosine.clamp(min=0).square()
        outside = weight * (distance > 0)
        sums.index_add_(1, index, torch.stack([weight * distance, weight, outside * distance, outside, 0 * weight]))
    return sums


def _dilated(marked: Bool[Tensor, "a b c"], reach: int) -> Bool[Tensor, "a b c"]:
    """Marked voxels dilated by a cube of half side `reach` [voxels]."""
    for axis in range(3):
        grown = marked.movedim(axis, 0).clone()
        for step in range(1, reach + 1):
            grown[step:] |= marked.movedim(axis, 0)[:-step]
            grown[:-step] |= marked.movedim(axis, 0)[step:]
        marked = grown.movedim(0, axis)
    return marked
