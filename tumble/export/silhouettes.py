"""Where a mesh's surface lies, from the silhouettes in photographs."""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int

from tumble.export.atlas import UnwrappedMesh
from tumble.rendering import lit_frames
from tumble.scene import BACKGROUND, OBJECT

SUBPIXELS = 8
"""Samples along each side of a pixel. OpenCV also draws those that an edge passes, so that a silhouette is too large by
half a sample on every side."""
BAND = 5
"""Width of the band around the mesh's contour in which masks are compared [pixels]: an error of a mask elsewhere says
nothing of the surface."""
FRACTION_BITS = 4
"""Binary digits after the point of the coordinates that OpenCV draws."""


def best_offset(mesh: UnwrappedMesh, frames: Sequence[lit_frames.LitFrame], offsets: Sequence[float]) -> float:
    """The offset along the normals at which the mesh's silhouettes are as large as the masks, in the median frame.

    Args:
        mesh: Mesh, object frame.
        frames: Photographs with their masks.
        offsets: Ascending offsets that are tried; between them the difference of the areas is taken as linear, and the
            result lies between the first and the last [object radius].
    """
    excess = []
    for offset in offsets:
        vertices = mesh.vertices + offset * mesh.normals
        excess.append(float(np.median([_excess(vertices, mesh.faces, frame) for frame in frames])))
    return float(np.interp(0.0, excess, offsets))


def _excess(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], frame: lit_frames.LitFrame) -> float:
    """Area of the mesh's silhouette minus that of the mask, per length of the contour [about a pixel]."""
    covered = coverage(vertices, faces, frame)
    contour = ((covered > 0) & (covered < 1)).astype(np.uint8)
    near = cv2.dilate(contour, np.ones((BAND, BAND), np.uint8)) > 0
    near &= (frame.mask == OBJECT) | (frame.mask == BACKGROUND)
    return float((covered - (frame.mask == OBJECT))[near].sum() / max(1, contour.sum()))


def coverage(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], frame: lit_frames.LitFrame
) -> Float[np.ndarray, "h w"]:
    """Fraction of each pixel that the mesh covers."""
    height, width = frame.mask.shape
    uv = frame.camera.project(frame.T_cam_obj @ torch.from_numpy(vertices).float()).numpy()
    # OpenCV's coordinates are 0 at the middle of the first sample.
    at = np.round((uv * SUBPIXELS - 0.5) * 2**FRACTION_BITS).astype(np.int32)
    drawn = np.zeros((height * SUBPIXELS, width * SUBPIXELS), np.uint8)
    for triangle in at[faces]:
        cv2.fillConvexPoly(drawn, triangle, 1, shift=FRACTION_BITS)
    return drawn.reshape(height, SUBPIXELS, width, SUBPIXELS).mean((1, 3))
