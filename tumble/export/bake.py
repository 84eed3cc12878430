"""Texture baking: the Gaussians' material, rendered from all around and averaged per texel of an unwrapped mesh.

Each texel averages the rendered maps of the views in which it is visible, so that textures blend the Gaussians as
rendered images do. A *texel* is a pixel of the texture that a face covers; its position is that of its centre.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from tumble import backends
from tumble.export.atlas import UnwrappedMesh
from tumble.export.depth_fusion import posed_cameras, surrounding_cameras
from tumble.maths import SE3, nearest, srgb_from_linear
from tumble.rendering import Buffers, render_gbuffer
from tumble.scene import Asset, Camera

TEXELS_PER_PIXEL = 2
"""Side of the baked textures, relative to that of the rendered maps: finer textures are interpolated, since a texel of
an object that fills the maps is about as wide as half a pixel then."""
MIN_COSINE = 0.2
"""Minimum cosine between normal and view direction at which a view contributes to a texel."""
DEPTH_TOLERANCE = 0.03
"""Maximum depth difference to the rendered surface at which a texel counts as visible [object radius]."""
SUBTEXEL_BITS = 4
"""Fractional bits of the vertex positions when triangles are rasterized into the texture."""
CHUNK = 1 << 18
"""Number of texels processed at once by operations of torch: limits memory, without effect on the result."""
CHANNELS = 7
"""Number of baked channels: albedo (3), roughness (1), normal (3)."""


@dataclass(frozen=True)
class Textures:
    """8-bit textures of glTF's metallic-roughness material; row 0 is at v = 0."""

    base_color: UInt8[np.ndarray, "r r 3"]
    """sRGB."""
    roughness: UInt8[np.ndarray, "r r"]
    """Linear, perceptual."""
    normal: UInt8[np.ndarray, "r r 3"]
    """Tangent space: x along the tangent, y along the bitangent, z outwards."""
    metalness: UInt8[np.ndarray, "r r"] | None = None
    """Linear; None for an object without metal."""

    def enlarged(self, resolution: int) -> "Textures":
        """The textures at another resolution, interpolated bilinearly."""

        def scaled(x: np.ndarray) -> np.ndarray:
            size = (resolution, resolution)
            return x if len(x) == resolution else cv2.resize(x, size, interpolation=cv2.INTER_LINEAR)

        metalness = None if self.metalness is None else scaled(self.metalness)
        return Textures(scaled(self.base_color), scaled(self.roughness), scaled(self.normal), metalness)


@dataclass(frozen=True)
class Texels:
    """Surface points of texels, object frame."""

    rows: Int[Tensor, " t"]
    columns: Int[Tensor, " t"]
    points: Float[Tensor, "t 3"]
    """[object radius]"""
    normals: Float[Tensor, "t 3"]
    """Unit length, interpolated between vertices."""
    tangents: Float[Tensor, "t 3"]
    """Unit length, interpolated between vertices."""
    signs: Float[Tensor, "t 1"]
    """Sign of the bitangent, as in `UnwrappedMesh.tangents`."""


@torch.no_grad()
def bake(asset: Asset, mesh: UnwrappedMesh, *, resolution: int, views: int, pixels: int) -> Textures:
    """Textures of `resolution`^2 texels from `views` rendered maps of `pixels`^2."""
    texels = locate_texels(mesh, resolution)
    values = _averaged_maps(asset, texels, views, pixels)
    albedo, roughness, normals = values.split([3, 1, 3], -1)
    bitangents = normalize(torch.linalg.cross(texels.normals, texels.tangents), dim=-1) * texels.signs
    local = torch.stack([(normals * axis).sum(-1) for axis in (texels.tangents, bitangents, texels.normals)], -1)
    # A normal map cannot hold normals that point into the mesh.
    local = normalize(torch.cat([local[:, :2], local[:, 2:].clamp(min=0.05)], -1), dim=-1)
    encoded = torch.cat([srgb_from_linear(albedo), roughness, 0.5 + 0.5 * local], -1)
    image, metalness = texture_image(texels, encoded, resolution), asset.material.metalness
    metal = None if metalness is None else _nearest_gaussian_image(metalness, asset, texels, resolution)
    return Textures(image[..., :3], image[..., 3], image[..., 4:], metal)


@torch.no_grad()
def nearest_gaussian_texture(
    values: Float[Tensor, " n"], asset: Asset, mesh: UnwrappedMesh, *, resolution: int
) -> UInt8[np.ndarray, "r r"]:
    """Texture of values in [0, 1], one per Gaussian: each texel has the value of the nearest Gaussian."""
    return _nearest_gaussian_image(values, asset, locate_texels(mesh, resolution), resolution)


def _nearest_gaussian_image(
    values: Float[Tensor, " n"], asset: Asset, texels: Texels, resolution: int
) -> UInt8[np.ndarray, "r r"]:
    """The texture of `nearest_gaussian_texture` for texels that are located already."""
    index = _nearest(texels.points, asset.gaussians.means)
    return texture_image(texels, values[index, None], resolution)[..., 0]


def texture_image(texels: Texels, values: Float[Tensor, "t c"], resolution: int) -> UInt8[np.ndarray, "r r c"]:
    """8-bit texture of values in [0, 1] at texels; all other texels repeat the nearest of these."""
    image = np.zeros((resolution, resolution, values.shape[1]), np.uint8)
    covered = np.zeros((resolution, resolution), bool)
    at = (texels.rows.numpy(), texels.columns.numpy())
    image[at] = (values.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    covered[at] = True
    return pad(image, covered)


def locate_texels(mesh: UnwrappedMesh, resolution: int) -> Texels:
    """Surface points of all texels that faces cover; a texel centre just outside a face gets a point on its plane."""
    corners_uv = mesh.uv[mesh.faces] * resolution - 0.5
    owner = np.full((resolution, resolution), -1, np.int32)
    drawn = np.rint(corners_uv * (1 << SUBTEXEL_BITS)).astype(np.int32)
    for face, corners in enumerate(drawn):
        cv2.fillConvexPoly(owner, corners, face, cv2.LINE_8, SUBTEXEL_BITS)
    rows, columns = np.nonzero(owner >= 0)
    face = owner[rows, columns]
    a, b, c = np.moveaxis(corners_uv[face], 1, 0)
    weight_b, weight_c = _barycentric(np.stack([columns, rows], -1) - a, b - a, c - a)
    weights = np.stack([1 - weight_b - weight_c, weight_b, weight_c], -1).astype(np.float32)

    def interpolated(values: Float[np.ndarray, "v k"]) -> Float[Tensor, "t k"]:
        # One corner at a time, to save memory: there are millions of texels.
        parts = (weights[:, k, None] * values.astype(np.float32)[mesh.faces[face, k]] for k in range(3))
        return torch.from_numpy(sum(parts, np.float32(0)))

    return Texels(
        rows=torch.from_numpy(rows),
        columns=torch.from_numpy(columns),
        points=interpolated(mesh.vertices),
        normals=normalize(interpolated(mesh.normals), dim=-1),
        tangents=normalize(interpolated(mesh.tangents[:, :3]), dim=-1),
        signs=torch.from_numpy(mesh.tangents[mesh.faces[face, 0], 3:]).float(),
    )


def pad(image: Shaped[np.ndarray, "r r c"], covered: Bool[np.ndarray, "r r"]) -> Shaped[np.ndarray, "r r c"]:
    """The texture with uncovered texels set to their nearest covered texel, so that filtering at seams is correct."""
    if not covered.any():
        return image
    _, label = cv2.distanceTransformWithLabels(
        (~covered).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    label = np.asarray(label, np.int64)
    source = np.zeros((label.max() + 1, image.shape[2]), image.dtype)
    source[label[covered]] = image[covered]
    return source[label]


def _barycentric(
    x: Float[np.ndarray, "t 2"], ab: Float[np.ndarray, "t 2"], ac: Float[np.ndarray, "t 2"]
) -> tuple[Float[np.ndarray, " t"], Float[np.ndarray, " t"]]:
    """Barycentric coordinates of b and c at `x`, relative to a; clamped, because slivers make them unreliable."""
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    area = np.where(np.abs(area) < 1e-9, 1e-9, area)
    b = (x[:, 0] * ac[:, 1] - x[:, 1] * ac[:, 0]) / area
    c = (ab[:, 0] * x[:, 1] - ab[:, 1] * x[:, 0]) / area
    return b.clip(-0.5, 1.5), c.clip(-0.5, 1.5)


def _averaged_maps(asset: Asset, texels: Texels, views: int, pixels: int) -> Float[Tensor, "t 7"]:
    """Linear albedo, roughness and unit normal of texels, averaged over the views in which they are visible."""
    like = asset.gaussians.means
    poses, camera = surrounding_cameras(views, pixels)
    camera = Camera(camera.fx_fy_cx_cy.to(like), pixels, pixels)
    poses = SE3(poses.wxyz.to(like), poses.xyz.to(like))
    points, normals = texels.points.to(like), texels.normals.to(like)
    total, weights = points.new_zeros(len(points), CHANNELS), points.new_zeros(len(points))
    blend = backends.blend_kernel(backends.choose(like.device, like.dtype)) or blend_by_operations
    for i in range(views):
        maps = _stacked_maps(render_gbuffer(asset, poses[i], camera))
        view = posed_cameras(poses[i : i + 1], camera)
        blend(total, weights, maps, view, points, normals, min_cosine=MIN_COSINE, tolerance=DEPTH_TOLERANCE)
    values = total / weights.clamp(min=1e-6)[:, None]
    hidden = weights < 1e-3
    values[hidden] = _nearest_material(asset, points[hidden], normals[hidden])
    values[:, 4:] = normalize(values[:, 4:], dim=-1)
    return values.cpu()


def _stacked_maps(view: Buffers) -> Float[Tensor, "h w 9"]:
    """Albedo, roughness, normal and depth of a view, 0 in pixels without a known surface; and which pixels have one."""
    known = ((view.alpha > 0.5) & (view.depth_var < DEPTH_TOLERANCE**2)).to(view.depth)[..., None]
    normal = normalize(view.normal, dim=-1)
    maps = torch.cat([view.features["albedo"], view.features["roughness"], normal, view.depth[..., None]], -1)
    return torch.cat([maps * known, known], -1)


def blend_by_operations(
    total: Float[Tensor, "n 7"],
    weights: Float[Tensor, " n"],
    maps: Float[Tensor, "h w 9"],
    camera: backends.Cameras,
    points: Float[Tensor, "n 3"],
    normals: Float[Tensor, "n 3"],
    *,
    min_cosine: float,
    tolerance: float,
) -> None:
    """The definition of `BlendKernel` by operations of torch."""
    planes = maps.movedim(-1, 0)[None].contiguous()
    size = torch.tensor([maps.shape[1], maps.shape[0]]).to(points)
    focal, centre = camera.fx_fy_cx_cy.split(2)
    for start in range(0, len(points), CHUNK):
        x, chunk = points[start : start + CHUNK], slice(start, start + CHUNK)
        to_camera = camera.positions[0] - x
        cosine = (to_camera * normals[chunk]).sum(-1) / to_camera.norm(dim=-1)
        facing = torch.where(cosine > min_cosine)[0]
        x_cam = x[facing] @ camera.R[0].T + camera.t[0]
        uv = x_cam[:, :2] / x_cam[:, 2:] * focal + centre
        # Pixels without a known surface are left out of the bilinear interpolation.
        values = grid_sample(planes, (2 * uv / size - 1)[None, None], align_corners=False)[0, :, 0]
        fraction = values[-1]
        values = values[:-1] / fraction.clamp(min=1e-6)
        near = (values[CHANNELS] - x_cam[:, 2]).abs() < tolerance
        # The fourth power favours frontal views, which resolve the most detail.
        weight = near * (fraction > 0.25) * fraction * cosine[facing] ** 4
        total[chunk].index_add_(0, facing, (weight * values[:CHANNELS]).T)
        weights[chunk].index_add_(0, facing, weight)


def _nearest_material(
    asset: Asset, points: Float[Tensor, "t 3"], normals: Float[Tensor, "t 3"]
) -> Float[Tensor, "t 7"]:
    """Material of the nearest Gaussian, for points that are visible in no view, with the given normals."""
    material = asset.material
    index = _nearest(points, asset.gaussians.means)
    rough = material.roughness.mean(1, keepdim=True)
    return torch.cat([material.albedo.mean(1)[index], rough[index], normals], -1)


def _nearest(points: Float[Tensor, "t 3"], means: Float[Tensor, "n 3"]) -> Int[Tensor, " t"]:
    """Index of the nearest Gaussian of every point."""
    return nearest(points.cpu(), means.detach().cpu()).to(means.device)
