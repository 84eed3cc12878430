"""Completion of what a hand covers: convex, up to what frames show to be empty.

Where a hand never lets go, silhouettes carve nothing and no photograph shows the surface. What was seen of a box, a
bottle or a can tells most of the rest all the same: it lies within the convex hull of the seen surface, and most of
that which no frame shows to be empty belongs to it. Object frame; a *cell* is that of the grid of signed distances
(`depth_fusion`), its corners hold the values [cells].
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from tumble.export.depth_fusion import HALF_SIDE, TRUNCATION
from tumble.export.mesh import extreme_points
from tumble.export.unseen import MIN_FRAMES, at_pixels, enough, used_masks
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Asset, Capture

MARGIN = 2.0
"""Depth behind the Gaussians up to which a frame shows a point to be empty [cells]: their surface has that much noise,
which would become a second layer over what was seen."""
MIN_SEEN = 100
"""Number of seen vertices below which their convex hull says nothing."""
NEAR = 1.6
"""Distance from the seen surface up to which values stay [cells]."""
COARSE = 4
"""Spacing of the corners at which distances to the convex hull are computed [cells]; they are linear but at edges."""
HULL_DIRECTIONS = 1024
"""Number of directions in which the points of the hull are extreme: a sphere's hull is a fifth of a cell too small."""


@dataclass(frozen=True)
class Completed:
    """The signed distances with what was completed."""

    values: Float[np.ndarray, "g g g"]
    """Values [cells]."""
    changed: Bool[np.ndarray, "g g g"]
    """Corners beside which they differ from those that were given."""

    def changed_at(self, x_obj: Float[np.ndarray, "v 3"]) -> Bool[np.ndarray, " v"]:
        """Whether the corner next to each point is one of these."""
        return self.changed[_corners(x_obj, len(self.values))]


def _corners(x_obj: Float[np.ndarray, "v 3"], n: int) -> tuple[Int[np.ndarray, " v"], ...]:
    """Index of the corner next to each point in a grid of n^3."""
    return tuple(((x_obj + HALF_SIDE) / _cell(n)).round().astype(np.int64).T)


def _cell(n: int) -> float:
    """Side of a cell of a grid of n^3 corners [object radius]."""
    return 2 * HALF_SIDE / (n - 1)


@torch.no_grad()
def completed(
    values: Float[np.ndarray, "g g g"], seen: Float[np.ndarray, "v 3"], asset: Asset, capture: Capture
) -> Completed:
    """Fill what may belong to the object within the convex hull of the seen surface; cut off what is hidden outside it.

    Only where something hides the object from enough frames: a capture without a hand stays as it is.

    Args:
        values: See `depth_fusion.signed_distances`.
        seen: Vertices of the surface that frames show.
        capture: The frames of the asset's trajectory.
    """
    from scipy import ndimage

    n = len(values)
    hull = _hull_distances(seen, n) if bool((capture.masks == UNKNOWN).any()) else None
    if hull is None:
        return Completed(values, np.zeros(values.shape, bool))
    # All that can change lies in this box.
    box = ndimage.find_objects(((hull < TRUNCATION) | (values < TRUNCATION)).astype(np.uint8))[0]
    old, hull, first = values[box], hull[box], np.array([each.start for each in box])
    corners = np.argwhere((hull < 1) & (old > 0) | (hull > -1) & (old < TRUNCATION))
    hidden, empty = np.zeros((2, *old.shape), bool)
    at = tuple(corners.T)
    hidden[at], empty[at] = _shown((corners + first) * _cell(n) - HALF_SIDE, asset, capture, MARGIN * _cell(n))
    at_seen = np.zeros(values.shape, bool)
    at_seen[_corners(seen, n)] = True
    hidden &= _distances_to(at_seen[box]) > NEAR
    fill = hidden & ~empty & (hull < 0) & (old > 0)
    # What is nowhere three cells thick is noise of the surface.
    thick = ndimage.binary_opening(fill, np.ones((3, 3, 3)))
    fill = np.asarray(ndimage.binary_propagation(thick, mask=fill), bool)
    whole = (old <= 0) | fill
    distance = (_distances_to(whole) - _distances_to(~whole)).clip(-TRUNCATION, TRUNCATION)
    beside = ndimage.binary_dilation(fill, iterations=3) & (hidden | (old <= 0))
    new = np.where(beside, np.minimum(old, ndimage.gaussian_filter(distance, 1.0)), old)
    new = np.where(hidden | beside, np.maximum(new, hull.clip(max=TRUNCATION)), new).astype(values.dtype)
    result, changed = values.copy(), np.zeros(values.shape, bool)
    result[box], changed[box] = new, ndimage.binary_dilation(new != old)
    return Completed(result, changed)


def _distances_to(there: Bool[np.ndarray, "a b c"]) -> Float[np.ndarray, "a b c"]:
    """Distance of each corner to the nearest one that is there [cells]."""
    from scipy import ndimage

    return np.asarray(ndimage.distance_transform_edt(~there), np.float32)


def _hull_distances(seen: Float[np.ndarray, "v 3"], n: int) -> Float[np.ndarray, "{n} {n} {n}"] | None:
    """Distance of each of n^3 corners outside the convex hull of points, negative inside [cells]; None without one."""
    from scipy.spatial import ConvexHull, QhullError

    if len(seen) < MIN_SEEN:
        return None
    try:
        planes = torch.from_numpy(ConvexHull(extreme_points(seen, HULL_DIRECTIONS)).equations).float()
    except QhullError:  # all in a plane
        return None
    axis = torch.arange(0, n, COARSE) * _cell(n) - HALF_SIDE
    chunks = torch.cartesian_prod(axis, axis, axis).split(4096)
    coarse = torch.cat([torch.addmm(planes[:, 3], x, planes[:, :3].T).amax(1) for x in chunks]) / _cell(n)
    coarse = coarse.view((1, 1) + (len(axis),) * 3)
    return torch.nn.functional.interpolate(coarse, (n, n, n), mode="trilinear", align_corners=True)[0, 0].numpy()


def _shown(
    x_obj: Float[np.ndarray, "c 3"], asset: Asset, capture: Capture, margin: float
) -> tuple[Bool[np.ndarray, " c"], Bool[np.ndarray, " c"]]:
    """Which points something hides from enough frames, and which enough show to be empty (`unseen.enough`).

    Args:
        margin: Depth behind the Gaussians up to which a point is shown to be empty [object radius].
    """
    x = torch.from_numpy(x_obj).to(asset.gaussians.means)
    empty, hidden = torch.zeros(2, len(x), dtype=torch.int32, device=x.device)
    for frame, mask in used_masks(capture, x.device):
        at = at_pixels(asset, frame, mask, x)
        before = (at.label == OBJECT) & (at.depth > 0) & (at.z < at.depth + margin)
        empty += at.inside & ((at.label == BACKGROUND) | before)
        hidden += at.inside & (at.label == UNKNOWN)
    n_hidden = hidden.cpu().numpy()
    return n_hidden >= MIN_FRAMES, enough(empty.cpu().numpy(), n_hidden)
