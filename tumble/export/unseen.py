"""Parts of a mesh that no frame shows, such as those under a hand that never lets go: spanned like soap films.

Nothing is known of such a part, and the surface of the Gaussians has lumps, holes and the outlines of fingers there.
The smallest surface between what was seen takes its place; the confidence marks it as it marks all that was not seen.
"""

from collections.abc import Iterable

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from tumble.export.mesh import Mesh, components, neighbour_means, vertex_normals
from tumble.rendering import lit_frames, render_gbuffer
from tumble.scene import OBJECT, UNKNOWN, Asset, Capture

MIN_COSINE = 0.25
"""Minimum cosine between normal and view direction at which a frame shows a vertex."""
DEPTH_TOLERANCE = 0.03
"""Maximum difference between the depths of a vertex and of the Gaussians at which it is in front, besides the slope of
its surface [object radius]."""
MIN_FRAMES = 2
"""Number of frames that must show a vertex; a mask may be wrong in one."""
MAX_WRONG = 0.05
"""Fraction of the frames with something in front of a vertex whose masks may be wrong there, and do not count. So what
a hand covers most of the time is seen, too (docs/method.md)."""
AVERAGING_STEPS = 20
"""Number of times that "seen" is averaged over neighbours, so that wrong pixels of masks leave no spikes."""
SMOOTHING_STEPS = 10
"""Number of times that vertices move to the means of their neighbours: steps of the grid vanish, edges hardly."""


def spanned(mesh: Mesh, fixed: Bool[np.ndarray, " v"]) -> Mesh:
    """The mesh with every vertex that is not fixed at the mean of its neighbours: a discrete minimal surface.

    Components of which nothing is fixed stay as they are.
    """
    from scipy.sparse import identity
    from scipy.sparse.linalg import splu

    mean = neighbour_means(mesh)
    component = components(len(fixed), mesh.faces)
    free = ~fixed & (np.bincount(component, fixed) > 0)[component]
    vertices, rows = mesh.vertices.copy(), mean[free]
    if free.any():
        inner = identity(int(free.sum()), format="csc") - rows[:, free].tocsc()
        vertices[free] = splu(inner).solve(rows[:, ~free] @ vertices[~free])
    return Mesh(vertices, mesh.faces)


def smoothed(mesh: Mesh, free: Bool[np.ndarray, " v"]) -> Mesh:
    """The mesh with its free vertices moved to the means of their neighbours a few times."""
    rows, vertices = neighbour_means(mesh)[free], mesh.vertices.copy()
    for _ in range(SMOOTHING_STEPS):
        vertices[free] = rows @ vertices
    return Mesh(vertices, mesh.faces)


def seen_regions(mesh: Mesh, asset: Asset, capture: Capture) -> Bool[np.ndarray, " v"]:
    """Vertices around which most are seen (`seen_vertices`).

    Args:
        capture: The frames of the asset's trajectory.
    """
    mean, seen = neighbour_means(mesh), seen_vertices(mesh, asset, capture).astype(np.float64)
    for _ in range(AVERAGING_STEPS):
        seen = mean @ seen
    return seen >= 0.5


@torch.no_grad()
def seen_vertices(mesh: Mesh, asset: Asset, capture: Capture) -> Bool[np.ndarray, " v"]:
    """Vertices that enough frames show as object: in front, and not too obliquely."""
    x_obj, normals = (torch.from_numpy(x).to(asset.gaussians.means) for x in (mesh.vertices, vertex_normals(mesh)))
    masks = ((i, capture.masks[i].to(x_obj.device)) for i in lit_frames.frame_numbers(capture))
    return enough_show(len(x_obj), (_labels(asset, i, mask, x_obj, normals).cpu().numpy() for i, mask in masks))


def enough_show(n: int, labels: Iterable[Shaped[np.ndarray, " n"]]) -> Bool[np.ndarray, " n"]:
    """Which of n points at least `MIN_FRAMES` frames show as object, besides `MAX_WRONG` of those that hide it.

    Args:
        labels: What the mask of each frame says of each point; neither object nor unknown of those that it cannot show.
    """
    shown, hidden = np.zeros((2, n), np.int64)
    for label in labels:
        shown += label == OBJECT
        hidden += label == UNKNOWN
    return shown >= MIN_FRAMES + MAX_WRONG * hidden


def _labels(
    asset: Asset, frame: int, mask: Tensor, x_obj: Float[Tensor, "v 3"], normals: Float[Tensor, "v 3"]
) -> Float[Tensor, " v"]:
    """What the mask of a frame says of each vertex; not a number of those that the frame cannot show."""
    camera, T_cam_obj = asset.camera, asset.trajectory.T_cam_obj[frame]
    to_camera, x_cam = T_cam_obj.inverse().xyz - x_obj, T_cam_obj @ x_obj
    cosine, z = (to_camera * normals).sum(-1) / to_camera.norm(dim=-1), x_cam[:, 2]
    column_row, size = camera.project(x_cam).floor().long(), torch.tensor(mask.T.shape, device=mask.device)
    inside = ((column_row >= 0) & (column_row < size)).all(-1)
    column, row = torch.minimum(column_row.clamp_min(0), size - 1).T
    slope = 2 / camera.fx_fy_cx_cy[0] * z * (cosine.clamp(MIN_COSINE, 1) ** -2 - 1).sqrt()
    depth = render_gbuffer(asset, T_cam_obj, camera).depth[row, column]
    visible = inside & (cosine > MIN_COSINE) & ((z - depth).abs() < DEPTH_TOLERANCE + slope)
    return torch.where(visible, mask[row, column].to(z), torch.nan)
