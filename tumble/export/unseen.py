"""Parts of a mesh that no frame shows, such as those under a hand that never lets go: spanned like soap films.

Nothing is known of such a part, and the surface of the Gaussians has lumps, holes and the outlines of fingers there.
The smallest surface between what was seen takes its place. The confidence is near 0 where no frame faces it, but what a
hand covers counts as seen there, since it knows no masks.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
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
a hand covers most of the time is seen, too (docs/experiments/hands-films.md)."""
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
    labels = (_labels(asset, i, mask, x_obj, normals).cpu().numpy() for i, mask in used_masks(capture, x_obj.device))
    return enough_show(len(x_obj), labels)


def used_masks(capture: Capture, device: torch.device) -> Iterator[tuple[int, UInt8[Tensor, "h w"]]]:
    """Numbers of the frames that are asked what they show, and their masks."""
    return ((i, capture.masks[i].to(device)) for i in lit_frames.frame_numbers(capture))


def enough_show(n: int, labels: Iterable[Shaped[np.ndarray, " n"]]) -> Bool[np.ndarray, " n"]:
    """Which of n points at least `MIN_FRAMES` frames show as object, besides `MAX_WRONG` of those that hide it.

    Args:
        labels: What the mask of each frame says of each point; neither object nor unknown of those that it cannot show.
    """
    shown, hidden = np.zeros((2, n), np.int64)
    for label in labels:
        shown += label == OBJECT
        hidden += label == UNKNOWN
    return enough(shown, hidden)


def enough(shown: Int[np.ndarray, " n"], hidden: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Whether enough frames show something of each point, by the numbers of frames that show it and that hide it."""
    return shown >= MIN_FRAMES + MAX_WRONG * hidden


def _labels(
    asset: Asset, frame: int, mask: Tensor, x_obj: Float[Tensor, "v 3"], normals: Float[Tensor, "v 3"]
) -> Float[Tensor, " v"]:
    """What the mask of a frame says of each vertex; not a number of those that the frame cannot show."""
    at = at_pixels(asset, frame, mask, x_obj)
    to_camera = asset.trajectory.T_cam_obj[frame].inverse().xyz - x_obj
    cosine = (to_camera * normals).sum(-1) / to_camera.norm(dim=-1)
    slope = 2 / asset.camera.fx_fy_cx_cy[0] * at.z * (cosine.clamp(MIN_COSINE, 1) ** -2 - 1).sqrt()
    visible = at.inside & (cosine > MIN_COSINE) & ((at.z - at.depth).abs() < DEPTH_TOLERANCE + slope)
    return torch.where(visible, at.label.to(at.z), torch.nan)


@dataclass(frozen=True)
class AtPixels:
    """What a frame has at the pixels of points."""

    inside: Bool[Tensor, " n"]
    """Whether the pixel is in the image; what follows is that of another pixel otherwise."""
    z: Float[Tensor, " n"]
    """Depths of the points [object radius]."""
    depth: Float[Tensor, " n"]
    """Depths of the Gaussians [object radius]; 0 where there are none."""
    label: UInt8[Tensor, " n"]
    """Values of the mask."""


def at_pixels(asset: Asset, frame: int, mask: UInt8[Tensor, "h w"], x_obj: Float[Tensor, "n 3"]) -> AtPixels:
    """What a frame of the asset's trajectory has at the pixels of points."""
    camera, T_cam_obj = asset.camera, asset.trajectory.T_cam_obj[frame]
    x_cam = T_cam_obj @ x_obj
    column_row, size = camera.project(x_cam).floor().long(), torch.tensor(mask.T.shape, device=mask.device)
    inside = ((column_row >= 0) & (column_row < size)).all(-1)
    column, row = torch.minimum(column_row.clamp_min(0), size - 1).T
    depth = render_gbuffer(asset, T_cam_obj, camera).depth
    return AtPixels(inside, x_cam[:, 2], depth[row, column], mask[row, column])
