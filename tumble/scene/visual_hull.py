"""The visual hull on a voxel grid, and oriented points on its surface from which the Gaussians are initialised.

Object frame, object radius 1. UNKNOWN pixels count as foreground, so that they carve nothing, but for narrow bands
along silhouettes, which carve from their middle. What most frames show as unknown, such as a hand that never lets go,
is left out where it protrudes from the rest.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn.functional import grid_sample, normalize, pad

from tumble.maths import gaussian_blur
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN, Capture
from tumble.scene.trajectory import Trajectory

MIN_SURE_FRACTION = 0.5
"""Fraction of the frames that show a cell as object or as something unknown, in which it is object, below which it is
doubtful whether the cell belongs to the object."""
WIDE = 5
"""Width from which an unknown region counts as something before the object [pixels]; bands along silhouettes are
narrower."""
GOLDEN_RATIO = (math.sqrt(5) - 1) / 2
HULL_MARGIN = 2.0
"""Distance up to which doubtful cells may lie outside the convex hull of the others [cells]."""


class EmptyHull(ValueError):
    """No shape has the silhouettes at the poses."""


@dataclass(frozen=True)
class OrientedPoints:
    """Points with normals on a surface, object frame."""

    positions: Float[Tensor, "n 3"]
    """Positions [object radius]."""
    normals: Float[Tensor, "n 3"]
    """Outward, unit length."""
    spacing: Float[Tensor, " n"]
    """Mean distance to the three nearest neighbours [object radius]."""


def carve(
    capture: Capture, trajectory: Trajectory, *, resolution: int, tolerance: float = 0.0, outside: float = 1.0
) -> Float[Tensor, "x y z"]:
    """Occupancy in [0, 1] of each cell of [-1, 1]^3: the minimum over all frames of the bilinearly sampled masks.

    Cells inside the unit sphere that no frame shows are occupied; cells outside the sphere are empty.

    Args:
        tolerance: Fraction of the frames whose masks or poses may be wrong: as many of the smallest samples of each
            cell are ignored.
        outside: Occupancy that a frame gives to cells outside its image: 1 if the object may reach beyond it, else 0.
    """
    like = {"dtype": trajectory.T_cam_obj.xyz.dtype, "device": trajectory.T_cam_obj.xyz.device}
    ticks = (torch.arange(resolution, **like) + 0.5) / resolution * 2 - 1
    x_obj = torch.stack(torch.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3)
    size = torch.tensor([capture.camera.width, capture.camera.height], **like)
    smallest = (x_obj.norm(dim=-1) <= 1).to(**like).repeat(1 + int(tolerance * len(trajectory)), 1)
    left, hidden = torch.where(smallest[-1] > 0)[0], _wide_unknown(capture)
    # Frames that are far apart in time come first: they differ most, and each sees only the cells left by those before.
    for frame in sorted(range(len(trajectory)), key=lambda k: k * GOLDEN_RATIO % 1):
        uv = capture.camera.project(trajectory.T_cam_obj[frame] @ x_obj.index_select(0, left))
        mask = _foreground(capture.masks[frame], hidden[frame]).to(**like)
        at = (uv / size * 2 - 1)[None, None]
        sampled = grid_sample(mask[None, None], at, padding_mode="border", align_corners=False)[0, 0, 0]
        in_image = ((uv > 0) & (uv < size)).all(-1)
        value = torch.where(in_image, sampled, outside)
        for k in range(len(smallest)):
            old = smallest[k].index_select(0, left)
            smallest[k, left], value = torch.minimum(old, value), torch.maximum(old, value)
        left = left[smallest[-1].index_select(0, left) > 0]
    if bool(hidden.any()):
        protrudes = _protruding(x_obj[left], _sure_fraction(capture, trajectory, x_obj[left], hidden), 2 / resolution)
        smallest[-1, left[protrudes]] = 0
    return smallest[-1].reshape(resolution, resolution, resolution)


def _foreground(mask: UInt8[Tensor, "h w"], hidden: Bool[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """A mask in which narrow bands of unknown pixels rise evenly from 0 at the background to 1 at the object.

    The silhouette lies in the middle of such a band. If it carved nothing, the hull would be too large all around.

    Args:
        hidden: Pixels of wide unknown regions.
    """
    import cv2

    foreground, narrow = (mask != BACKGROUND).float(), (mask == UNKNOWN) & ~hidden
    if not bool(narrow.any()):
        return foreground
    out, inward = (
        torch.from_numpy(cv2.distanceTransform((mask != label).byte().cpu().numpy(), cv2.DIST_C, 3)).to(foreground)
        for label in (BACKGROUND, OBJECT)
    )
    band = narrow & (out + inward <= WIDE)
    return torch.where(band, out / (out + inward).clamp_min(1), foreground)


def view_cosine(
    camera_centre: Float[Tensor, "*k 3"], x: Float[Tensor, "*n 3"], normals: Float[Tensor, "*n 3"]
) -> Float[Tensor, "*b"]:
    """Cosine between the normals of points and their lines of sight to a camera; batch axes are broadcast."""
    return (normalize(camera_centre - x, dim=-1) * normals).sum(-1)


def _wide_unknown(capture: Capture) -> Bool[Tensor, "t h w"]:
    """Unknown pixels except those of narrow bands (morphological opening)."""
    unknown = capture.masks == UNKNOWN
    if not bool(unknown.any()):
        return unknown
    import cv2

    window = cv2.getStructuringElement(cv2.MORPH_RECT, (WIDE, WIDE))
    opened = [cv2.morphologyEx(each, cv2.MORPH_OPEN, window) for each in unknown.byte().cpu().numpy()]
    return torch.stack([torch.from_numpy(each) for each in opened]).to(unknown.device) > 0


def _sure_fraction(
    capture: Capture, trajectory: Trajectory, x_obj: Float[Tensor, "n 3"], hidden: Bool[Tensor, "t h w"]
) -> Float[Tensor, " n"]:
    """Fraction of the frames that show each point as object or hidden, in which it is object; 1 if there are none."""
    size = torch.tensor([capture.camera.width, capture.camera.height], device=x_obj.device)
    sure, doubtful = torch.zeros_like(x_obj[:, 0]), torch.zeros_like(x_obj[:, 0])
    for frame in range(len(trajectory)):
        uv = capture.camera.project(trajectory.T_cam_obj[frame] @ x_obj).floor().long()
        inside = ((uv >= 0) & (uv < size)).all(-1)
        column, row = torch.minimum(uv.clamp_min(0), size - 1).T
        sure += inside & (capture.masks[frame][row, column] == OBJECT)
        doubtful += inside & hidden[frame][row, column]
    return torch.where(sure + doubtful > 0, sure / (sure + doubtful).clamp_min(1), 1.0)


def _protruding(x_obj: Float[Tensor, "n 3"], sure: Float[Tensor, " n"], spacing: float) -> Bool[Tensor, " n"]:
    """Doubtful cells outside the convex hull of the others."""
    from scipy.spatial import ConvexHull, QhullError

    doubtful = sure < MIN_SURE_FRACTION
    try:
        planes = torch.from_numpy(ConvexHull(x_obj[~doubtful].cpu().numpy()).equations).to(x_obj)
    except (QhullError, ValueError):  # too few cells, or all in a plane
        return torch.zeros_like(doubtful)
    outside = torch.zeros_like(doubtful)
    outside[doubtful] = (x_obj[doubtful] @ planes[:, :3].T + planes[:, 3]).amax(1) > HULL_MARGIN * spacing
    return outside


def sample_surface(inside: Float[Tensor, "x y z"], n: int, rng: torch.Generator) -> OrientedPoints:
    """At most `n` random points, uniform over the surface on which the occupancy `inside` is one half.

    Raises:
        EmptyHull: Poses and silhouettes contradict each other.
    """
    resolution = inside.shape[0]
    positions, normals = _crossings(inside)
    if len(positions) < 16:
        raise EmptyHull("the visual hull of the silhouettes is empty: check that poses and masks belong together")
    # The number of grid edges that cross a surface, per area, is proportional to the L1 norm of its normal.
    probability = 1 / normals.abs().sum(-1)
    chosen = torch.multinomial(probability.cpu(), min(n, len(positions)), generator=rng).to(positions.device)
    jitter = (torch.rand(len(chosen), 3, generator=rng).to(positions) - 0.5) * (2 / resolution)
    normals = normals[chosen]
    # Tangential jitter, so that points are not aligned with the grid.
    positions = positions[chosen] + jitter - (jitter * normals).sum(-1, keepdim=True) * normals
    return OrientedPoints(positions, normals, neighbour_spacing(positions))


def _crossings(inside: Float[Tensor, "x y z"]) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 3"]]:
    """Points on grid edges where `inside` crosses one half, and outward normals from its smoothed gradient."""
    resolution = inside.shape[0]
    gradient = outward_gradient(inside)
    positions, normals = [], []
    for axis in range(3):
        low, high = inside.narrow(axis, 0, resolution - 1), inside.narrow(axis, 1, resolution - 1)
        index = torch.nonzero((low > 0.5) != (high > 0.5))
        a, b = (values[tuple(index.T)] for values in (low, high))
        at = index.to(inside)
        at[:, axis] += (0.5 - a) / (b - a)
        positions.append((at + 0.5) / resolution * 2 - 1)
        normals.append(gradient[tuple(index.T)])
    has_normal = torch.cat(normals).any(-1)  # the gradient is zero in the middle of an isolated cell
    return torch.cat(positions)[has_normal], normalize(torch.cat(normals)[has_normal], dim=-1)


def outward_gradient(inside: Float[Tensor, "x y z"]) -> Float[Tensor, "x y z 3"]:
    """Negative gradient of the smoothed occupancy; only its direction, the outward normal, is meaningful."""
    return -torch.stack(torch.gradient(_smoothed(inside)), -1)


def _smoothed(inside: Float[Tensor, "x y z"], sigma: float = 1.5) -> Float[Tensor, "x y z"]:
    """The occupancy convolved with a Gaussian of `sigma` [cells], which removes staircases from its normals."""
    padded = pad(inside[None, None], (4,) * 6, mode="replicate")[0, 0]
    return gaussian_blur(padded, 9, sigma, (0, 1, 2))


def neighbour_spacing(positions: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Mean distance of every point to its three nearest neighbours [object radius]."""
    from scipy.spatial import KDTree

    points = positions.detach().cpu().numpy()
    distances, _ = KDTree(points).query(points, 4)
    return torch.from_numpy(distances[:, 1:].mean(-1)).to(positions)
