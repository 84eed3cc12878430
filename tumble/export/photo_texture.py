"""Albedo texture solved from the photographs: per texel a robust linear least-squares problem.

A pixel of a photograph shows the mean albedo of the texels that project into it, times its diffuse light, plus its
highlight (`lit_frames.LitFrame`). The albedo of all texels is the least-squares solution of these equations over all
pixels of all frames, with a Huber loss, regularised towards the texture baked from the Gaussians. Texels that no
photograph shows keep the baked value; in the end what is seen is continued over them (`continued`).

The solution is found by a few simultaneous iterations (SART, Andersen and Kak 1984), which recover coarse detail first
and would reach the noise last. Two corrections keep photographs and texture registered: the surface is moved along its
normals by the distance at which the photographs agree best (`aligned_surface`), and a photograph that fits its
rendering much better after a smooth warp by optical flow (Zhou and Koltun 2014) is warped.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.nn.functional import max_pool2d

from tumble.export import fill, silhouettes, unseen
from tumble.export.atlas import UnwrappedMesh
from tumble.export.bake import Texels, Textures, locate_texels, pad, texture_image
from tumble.io import in_threads
from tumble.maths import linear_from_srgb, to_srgb8
from tumble.rendering import lit_frames
from tumble.scene import BACKGROUND, Camera

if TYPE_CHECKING:
    from scipy import sparse

TEXELS_PER_PIXEL = 2.0
"""Side of the solved texture, relative to that of the photographs: about four texels then lie in a pixel."""
MIN_COSINE = 0.25
"""Minimum cosine between normal and view direction at which a pixel contributes to a texel."""
DEPTH_TOLERANCE = 0.02
"""Maximum depth behind the nearest texel of the surrounding pixels at which a texel counts as visible, besides the
slope of its surface [object radius]."""
ITERATIONS = 6
"""Iterations of the solution."""
HUBER = 0.03
"""Residual from which its weight falls off: highlights and shadows that the light does not explain [linear]."""
REGULARISATION = 1e-3
"""Weight of the baked albedo, relative to that of a pixel that shows this texel alone, frontal and under light of
radiance 1."""
OFFSETS = (0.0, 0.25, 0.5)
"""Offsets of the surface along its normals that are tried [pixels]."""
OFFSET_FRAMES = 12
"""Number of frames from which the offset is found."""
OFFSET_ITERATIONS = 2
"""Iterations of the solution at each offset."""
MIN_RISE = 0.05
"""Fraction by which an offset that is wrong by a quarter of a pixel has to raise the loss; else the texture is too
faint to tell the offset."""
MAX_SHIFT = 3.0
"""Maximum shift of a pixel of a photograph [pixels]."""
SMOOTHING = 4.0
"""Standard deviation of the filter by which the optical flow is smoothed [pixels]."""
WARPED_LOSS = 0.8
"""Loss of a warped photograph, relative to that before, below which it is used: flow is noisy, and where poses are
exact it makes textures worse."""


@dataclass(frozen=True)
class _Equations:
    """Linear equations of a frame's usable pixels that show texels: photo = (shows @ albedo) * diffuse + specular."""

    shows: "sparse.csr_matrix"
    """Fraction of each texel in each pixel; rows (pixels) sum to 1."""
    pixels: Int[np.ndarray, " p"]
    """Indices of the pixels, counted row by row."""
    weight: Float[np.ndarray, "p 1"]
    """Weights of the pixels, 0 to 1: the square of the cosine between normal and view direction."""
    photo: Float[np.ndarray, "p 3"]
    diffuse: Float[np.ndarray, "p 3"]
    specular: Float[np.ndarray, "p 3"]

    def rendered(self, albedo: Float[np.ndarray, "t 3"]) -> Float[np.ndarray, "p 3"]:
        """Radiance of the pixels for an albedo of all texels."""
        return (self.shows @ albedo) * self.diffuse + self.specular


def solved_base_color(
    base_color: UInt8[np.ndarray, "r r 3"], mesh: UnwrappedMesh, frames: Sequence[lit_frames.LitFrame]
) -> UInt8[np.ndarray, "r r 3"]:
    """The sRGB base colour solved from photographs, started from and regularised towards `base_color`."""
    resolution = len(base_color)
    side = min(resolution, solved_side(frames[0].camera))
    texels = locate_texels(mesh, side)
    linear = linear_from_srgb(torch.from_numpy(base_color).float() / 255).numpy()
    at = (texels.rows.numpy(), texels.columns.numpy())
    # The mean over the area of a solved texel.
    baked = cv2.resize(linear, (side, side), interpolation=cv2.INTER_AREA)[at]
    correction, covered = np.zeros((side, side, 3), np.float32), np.zeros((side, side), bool)
    correction[at], covered[at] = solve(baked, texels, frames)[0] - baked, True
    correction = cv2.resize(pad(correction, covered), (resolution, resolution), interpolation=cv2.INTER_LINEAR)
    return to_srgb8(torch.from_numpy(linear + correction)).numpy()


def continued(textures: Textures, mesh: UnwrappedMesh, frames: Sequence[lit_frames.MaskedFrame]) -> Textures:
    """The textures with a smooth continuation of what frames show in the place of what none of them shows."""
    resolution = len(textures.base_color)
    side = min(resolution, solved_side(frames[0].camera))
    coarse, texels = locate_texels(mesh, side), locate_texels(mesh, resolution)
    seen, covered = np.zeros((side, side, 1), np.uint8), np.zeros((side, side), bool)
    at = (coarse.rows.numpy(), coarse.columns.numpy())
    labels = in_threads(partial(_labels, coarse), frames)
    seen[at], covered[at] = unseen.enough_show(len(coarse.points), labels)[:, None], True
    if seen[at].all() or not seen.any():
        return textures
    seen = cv2.resize(pad(seen, covered), (resolution, resolution), interpolation=cv2.INTER_NEAREST)
    at = (texels.rows.numpy(), texels.columns.numpy())
    scalars = [x for x in (textures.roughness, textures.metalness) if x is not None]
    values, normals = np.dstack([textures.base_color, *scalars])[at], textures.normal[at]
    values, normals = (torch.from_numpy(x).float() / 255 for x in (values, normals))
    filled, certainty = fill.continued(values, torch.from_numpy(seen[at] > 0), texels.points)
    flat = torch.tensor([0.5, 0.5, 1.0])
    blended = torch.cat([flat + certainty * (normals - flat), filled + certainty * (values - filled)], -1)
    image = texture_image(texels, blended, resolution)
    metalness = None if textures.metalness is None else image[..., 7]
    return Textures(image[..., 3:6], image[..., 6], image[..., :3], metalness)


def _labels(texels: Texels, frame: lit_frames.MaskedFrame) -> Int[np.ndarray, " t"]:
    """What the mask of a frame says of each texel; background of those that the frame cannot show."""
    index, pixel, _ = _in_front(texels, frame)
    label = np.full(len(texels.points), BACKGROUND)
    label[index.numpy()] = frame.mask.ravel()[pixel.numpy()]
    return label


def aligned_surface(
    mesh: UnwrappedMesh, base_color: UInt8[np.ndarray, "r r 3"], frames: Sequence[lit_frames.LitFrame]
) -> UnwrappedMesh:
    """The mesh moved along its normals by the distance at which the photographs agree best on its texture.

    The mean depth of soft Gaussians lies behind the surface that they draw, by a quarter of a pixel of the photographs.
    Where no offset makes a texture agree clearly best, it is the one at which the silhouettes do.

    Args:
        mesh: The surface of the Gaussians.
        base_color: Its sRGB base colour, which may be coarse; it is solved at the same resolution.
        frames: Photographs with their light.
    """
    few = frames[:: -(-len(frames) // OFFSET_FRAMES)]
    texels = locate_texels(mesh, len(base_color))
    at = (texels.rows.numpy(), texels.columns.numpy())
    baked = linear_from_srgb(torch.from_numpy(base_color[at]).float() / 255).numpy()
    distance = float(torch.stack([frame.T_cam_obj.xyz.norm() for frame in few]).median())
    pixel = distance / float(few[0].camera.fx_fy_cx_cy[0])
    losses = []
    for offset in OFFSETS:
        moved = replace(texels, points=texels.points + offset * pixel * texels.normals)
        losses.append(solve(baked, moved, few, iterations=OFFSET_ITERATIONS)[1])
    offset = _lowest(losses)
    if offset is None:  # The texture is too faint to show it.
        offset = silhouettes.best_offset(mesh, few, [offset * pixel for offset in OFFSETS]) / pixel
    return replace(mesh, vertices=mesh.vertices + offset * pixel * mesh.normals)


def _lowest(losses: Sequence[float]) -> float | None:
    """The offset between the first and the last of `OFFSETS` at which a parabola through the losses is lowest, if it is
    clearly lowest there."""
    a, b, _ = np.polyfit(OFFSETS, losses, 2)
    if a * OFFSETS[1] ** 2 <= MIN_RISE * min(losses):
        return None
    lowest = float(-b / (2 * a))
    return lowest if OFFSETS[0] < lowest < OFFSETS[-1] else None


def solved_side(camera: Camera) -> int:
    """Side of the texture that photographs of a camera resolve [texels]."""
    return round(TEXELS_PER_PIXEL * max(camera.height, camera.width))


def solve(
    baked: Float[np.ndarray, "t 3"],
    texels: Texels,
    frames: Sequence[lit_frames.LitFrame],
    *,
    iterations: int = ITERATIONS,
) -> tuple[Float[np.ndarray, "t 3"], float]:
    """Linear albedo of all texels, and the mean Huber loss of the frames before the last iteration.

    Args:
        baked: Linear albedo of the texels, from which the solution starts.
        texels: Surface points.
        frames: Photographs with their light.
        iterations: Number of iterations; photographs are warped after the second one.
    """
    parts = [part for part in in_threads(partial(_equations, texels), frames) if len(part.pixels)]
    albedo, losses = baked, list[float]()
    for iteration in range(iterations):
        if iteration == 2:
            parts = list(in_threads(partial(_registered, albedo, frames[0].camera), parts))
        total, weights = REGULARISATION * (baked - albedo), np.full_like(baked, REGULARISATION)
        for part in parts:
            residual = part.photo - part.rendered(albedo)
            robust = part.weight * HUBER / np.abs(residual).max(1, keepdims=True).clip(HUBER)
            total += part.shows.T @ (robust * part.diffuse * residual)
            weights += part.shows.T @ (robust * part.diffuse**2)
        if iteration == iterations - 1:
            losses = [_loss(part, albedo) for part in parts]
        albedo = (albedo + total / weights).clip(0, 1).astype(np.float32)
    return albedo, sum(losses) / max(1, len(losses))


def _loss(equations: _Equations, albedo: Float[np.ndarray, "t 3"]) -> float:
    """Weighted mean Huber loss of a frame's residuals, relative to `HUBER` squared."""
    size = np.abs(equations.photo - equations.rendered(albedo)).max(1) / HUBER
    return float(np.average(np.where(size < 1, 0.5 * size**2, size - 0.5), weights=equations.weight[:, 0]))


def _in_front(texels: Texels, frame: lit_frames.MaskedFrame) -> tuple[Tensor, Tensor, Tensor]:
    """Texels that face the camera of a frame and that no other texel hides: their indices, pixels (counted row by row)
    and the cosines between their normals and view directions."""
    camera = frame.camera
    to_camera = frame.T_cam_obj.inverse().xyz - texels.points
    cosine = (to_camera * texels.normals).sum(-1) / to_camera.norm(dim=-1)
    x_cam = frame.T_cam_obj @ texels.points
    column, row = camera.project(x_cam).floor().long().unbind(-1)
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    pixel, depth = row * camera.width + column, x_cam[:, 2]
    front = torch.where(inside & (cosine > 0))[0]
    nearest = depth.new_full((camera.height * camera.width,), torch.inf)
    nearest.scatter_reduce_(0, pixel[front], depth[front], "amin")
    # The nearest depth around a pixel excludes texels beside a depth edge, too.
    around = -max_pool2d(-nearest.view(1, camera.height, camera.width), 3, 1, 1).flatten()
    index = front[cosine[front] > MIN_COSINE]
    slope = 3 / camera.fx_fy_cx_cy[0] * depth[index] * (cosine[index] ** -2 - 1).clamp(min=0).sqrt()
    index = index[depth[index] < around[pixel[index]] + DEPTH_TOLERANCE + slope]
    return index, pixel[index], cosine[index]


def _equations(texels: Texels, frame: lit_frames.LitFrame) -> _Equations:
    """Equations of a frame's usable pixels, over the texels that face the camera and that no other texel hides."""
    from scipy import sparse

    camera = frame.camera
    index, pixel, cosine = _in_front(texels, frame)
    kept = torch.from_numpy(frame.usable).flatten()[pixel]
    index, pixel, cosine = index[kept], pixel[kept], cosine[kept]
    shown = np.bincount(pixel.numpy(), minlength=camera.height * camera.width)
    pixels = np.nonzero(shown)[0]
    of_texel = (np.cumsum(shown > 0) - 1)[pixel.numpy()]
    # A texel's area in the image is proportional to its cosine; its distance hardly varies within a pixel.
    facing = cosine.numpy().astype(np.float32)
    area = np.bincount(of_texel, facing, len(pixels))
    shape, places = (len(pixels), len(texels.points)), (of_texel, index.numpy())
    shows = sparse.csr_matrix(((facing / area[of_texel]).astype(np.float32), places), shape)
    mean_cosine = area / shown[pixels]
    photo, diffuse, specular = (x.reshape(-1, 3)[pixels] for x in (frame.photo, frame.diffuse, frame.specular))
    return _Equations(shows, pixels, (mean_cosine**2).astype(np.float32)[:, None], photo, diffuse, specular)


def _registered(albedo: Float[np.ndarray, "t 3"], camera: Camera, equations: _Equations) -> _Equations:
    """The equations with the photograph warped onto the rendering if that lowers their loss to `WARPED_LOSS`."""
    size = (camera.height, camera.width)

    def image(values: Float[np.ndarray, "p c"]) -> Float[np.ndarray, "h w c"]:
        canvas = np.zeros((size[0] * size[1], values.shape[1]), np.float32)
        canvas[equations.pixels] = values
        return canvas.reshape(*size, -1)

    known, photo = image(np.ones_like(equations.weight)), image(equations.photo)
    flow = _flow(image(equations.rendered(albedo)), photo)
    flow *= MAX_SHIFT / np.linalg.norm(flow, axis=-1, keepdims=True).clip(MAX_SHIFT)
    blurred = cv2.GaussianBlur(np.concatenate([flow * known, known], -1), (0, 0), SMOOTHING)
    column, row = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in size[::-1]))
    x, y = (axis + blurred[..., i] / blurred[..., 2].clip(1e-3) for i, axis in enumerate((column, row)))
    warped, inside = (
        cv2.remap(values, x, y, cv2.INTER_LINEAR).reshape(-1, n) for values, n in ((photo, 3), (known, 1))
    )
    # Where the warped photograph has no pixel, the equations get no weight.
    weight = equations.weight * (inside[equations.pixels] > 0.999)
    new = replace(equations, photo=warped[equations.pixels], weight=weight)
    better = bool(weight.any()) and _loss(new, albedo) < WARPED_LOSS * _loss(replace(equations, weight=weight), albedo)
    return new if better else equations


def _flow(x: Float[np.ndarray, "h w 3"], y: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 2"]:
    """Optical flow (DIS) from one linear image to another [pixels]."""
    height, width, _ = x.shape
    # At twice the size, because DIS compares patches of 8 x 8 pixels.
    grey = [cv2.cvtColor(to_srgb8(torch.from_numpy(image)).numpy(), cv2.COLOR_RGB2GRAY) for image in (x, y)]
    first, second = (cv2.resize(image, (2 * width, 2 * height), interpolation=cv2.INTER_LINEAR) for image in grey)
    flow = np.zeros((2 * height, 2 * width, 2), np.float32)
    cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(first, second, flow)
    return cv2.resize(flow, (width, height), interpolation=cv2.INTER_AREA) / 2
