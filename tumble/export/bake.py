"""Textures of an unwrapped mesh: what cameras all around see of the Gaussians' material, gathered texel by texel.

Every texel averages the rendered maps of the views that see it, so that texture and relit picture blend the Gaussians
in the same way. *Texels*: the centres of the texture's pixels that a face covers.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from tumble.export.depth_fusion import around
from tumble.export.mesh import Unwrapped
from tumble.maths import SE3, nearest, srgb_from_linear
from tumble.rendering import Buffers, buffers_of
from tumble.scene import Asset, Camera

GRAZING = 0.2
"""Least cosine between normal and view that counts."""
TOLERANCE = 0.03
"""How far a texel may lie from the rendered surface and still be the one that is seen [object radius]."""
SUBTEXEL = 4
"""Bits of the fraction with which triangles are drawn."""
CHUNK = 1 << 20
"""Texels looked up at once: bounds memory, changes nothing else."""
CHANNELS = 7
"""Albedo, roughness and normal."""


@dataclass(frozen=True)
class Textures:
    """8-bit textures of glTF's metallic-roughness material; row 0 is v = 0."""

    base_color: UInt8[np.ndarray, "r r 3"]
    """sRGB."""
    roughness: UInt8[np.ndarray, "r r"]
    """Linear, perceptual."""
    normal: UInt8[np.ndarray, "r r 3"]
    """Tangent space: +x along the tangent, +y along the bitangent, +z outwards."""
    covered: Bool[np.ndarray, "r r"]
    """Texels of a face; the others repeat their nearest one."""


@dataclass(frozen=True)
class Texels:
    """Where texels lie on the mesh, object frame."""

    rows: Int[Tensor, " t"]
    columns: Int[Tensor, " t"]
    points: Float[Tensor, "t 3"]
    """[object radius]"""
    normals: Float[Tensor, "t 3"]
    """Unit, interpolated between vertices; so are the tangents."""
    tangents: Float[Tensor, "t 3"]
    signs: Float[Tensor, "t 1"]


@torch.no_grad()
def bake(asset: Asset, mesh: Unwrapped, *, resolution: int, views: int, pixels: int) -> Textures:
    """Textures of `resolution`^2 texels from `views` rendered maps of `pixels`^2."""
    spots = texels(mesh, resolution)
    values = _gathered(asset, spots, views, pixels)
    albedo, roughness, normals = values.split([3, 1, 3], -1)
    bitangents = normalize(torch.linalg.cross(spots.normals, spots.tangents), dim=-1) * spots.signs
    local = torch.stack([(normals * axis).sum(-1) for axis in (spots.tangents, bitangents, spots.normals)], -1)
    # A normal map cannot show what faces away from the mesh.
    local = normalize(torch.cat([local[:, :2], local[:, 2:].clamp(min=0.05)], -1), dim=-1)
    painted = torch.cat([srgb_from_linear(albedo), roughness, 0.5 + 0.5 * local], -1)
    picture, covered = _painted(spots, painted, resolution)
    return Textures(picture[..., :3], picture[..., 3], picture[..., 4:], covered)


@torch.no_grad()
def spread(values: Float[Tensor, " n"], asset: Asset, mesh: Unwrapped, *, resolution: int) -> UInt8[np.ndarray, "r r"]:
    """Values in [0, 1], one per Gaussian, as a texture: every texel has that of the Gaussian next to it."""
    spots = texels(mesh, resolution)
    index = nearest(spots.points.to(asset.gaussians.means), asset.gaussians.means)
    return _painted(spots, values[index, None], resolution)[0][..., 0]


def _painted(
    spots: Texels, values: Float[Tensor, "t c"], resolution: int
) -> tuple[UInt8[np.ndarray, "r r c"], Bool[np.ndarray, "r r"]]:
    """A padded texture with values in [0, 1] at texels, and where those are."""
    picture = np.zeros((resolution, resolution, values.shape[1]), np.uint8)
    covered = np.zeros((resolution, resolution), bool)
    at = (spots.rows.numpy(), spots.columns.numpy())
    picture[at] = (values.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
    covered[at] = True
    return padded(picture, covered), covered


def texels(mesh: Unwrapped, resolution: int) -> Texels:
    """Points of the mesh behind the texels that faces cover; those that a face only touches lie on its plane."""
    places = mesh.uv[mesh.faces] * resolution - 0.5
    owner = np.full((resolution, resolution), -1, np.int32)
    drawn = np.rint(places * (1 << SUBTEXEL)).astype(np.int32)
    for face, corners in enumerate(drawn):
        cv2.fillConvexPoly(owner, corners, face, cv2.LINE_8, SUBTEXEL)
    rows, columns = np.nonzero(owner >= 0)
    face = owner[rows, columns]
    a, b, c = np.moveaxis(places[face], 1, 0)
    share_b, share_c = _barycentric(np.stack([columns, rows], -1) - a, b - a, c - a)
    shares = np.stack([1 - share_b - share_c, share_b, share_c], -1).astype(np.float32)

    def interpolated(values: Float[np.ndarray, "v k"]) -> Float[Tensor, "t k"]:
        # Corner by corner: there are millions of texels.
        parts = (shares[:, k, None] * values.astype(np.float32)[mesh.faces[face, k]] for k in range(3))
        return torch.from_numpy(sum(parts, np.float32(0)))

    return Texels(
        rows=torch.from_numpy(rows),
        columns=torch.from_numpy(columns),
        points=interpolated(mesh.vertices),
        normals=normalize(interpolated(mesh.normals), dim=-1),
        tangents=normalize(interpolated(mesh.tangents[:, :3]), dim=-1),
        signs=torch.from_numpy(mesh.tangents[mesh.faces[face, 0], 3:]).float(),
    )


def padded(picture: UInt8[np.ndarray, "r r c"], covered: Bool[np.ndarray, "r r"]) -> UInt8[np.ndarray, "r r c"]:
    """The picture with each texel that no face covers like the nearest one that a face does: filters and mipmaps
    near a seam then find no foreign colour."""
    if not covered.any():
        return picture
    _, label = cv2.distanceTransformWithLabels(
        (~covered).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    label = np.asarray(label, np.int64)
    source = np.zeros((label.max() + 1, picture.shape[2]), np.uint8)
    source[label[covered]] = picture[covered]
    return source[label]


def _barycentric(
    x: Float[np.ndarray, "t 2"], ab: Float[np.ndarray, "t 2"], ac: Float[np.ndarray, "t 2"]
) -> tuple[Float[np.ndarray, " t"], Float[np.ndarray, " t"]]:
    """Shares of b and c at x, seen from a; at most half a triangle outside, for slivers have no sure plane."""
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    area = np.where(np.abs(area) < 1e-9, 1e-9, area)
    b = (x[:, 0] * ac[:, 1] - x[:, 1] * ac[:, 0]) / area
    c = (ab[:, 0] * x[:, 1] - ab[:, 1] * x[:, 0]) / area
    return b.clip(-0.5, 1.5), c.clip(-0.5, 1.5)


def _gathered(asset: Asset, spots: Texels, views: int, pixels: int) -> Float[Tensor, "t 7"]:
    """Linear albedo, roughness and unit normal of texels, averaged over the views that see them head-on."""
    like = asset.gaussians.means
    poses, camera = around(views, pixels)
    camera = Camera(camera.fx_fy_cx_cy.to(like), pixels, pixels)
    poses = SE3(poses.wxyz.to(like), poses.xyz.to(like))
    points, normals = spots.points.to(like), spots.normals.to(like)
    total, weights = points.new_zeros(len(points), CHANNELS), points.new_zeros(len(points), 1)
    for i in range(views):
        view = buffers_of(asset, poses[i], camera)
        for some in torch.arange(len(points), device=points.device).split(CHUNK):
            to_camera = normalize(poses[i].inverse().xyz - points[some], dim=-1)
            cosine = (normals[some] * to_camera).sum(-1)
            facing = torch.where(cosine > GRAZING)[0]
            index = some[facing]
            values, seen = _looked_up(view, poses[i] @ points[index], camera)
            # The fourth power: a view head-on is the sharpest.
            weight = seen * cosine[facing, None] ** 4
            total.index_add_(0, index, weight * values)
            weights.index_add_(0, index, weight)
    values = total / weights.clamp(min=1e-6)
    unseen = weights[:, 0] < 1e-3
    values[unseen] = _beside(asset, points[unseen], normals[unseen])
    values[:, 4:] = normalize(values[:, 4:], dim=-1)
    return values.cpu()


def _looked_up(
    view: Buffers, x_cam: Float[Tensor, "t 3"], camera: Camera
) -> tuple[Float[Tensor, "t 7"], Float[Tensor, "t 1"]]:
    """A view's maps at points, and how far it sees them: 0 where something else is in front."""
    known = ((view.alpha > 0.5) & (view.depth_var < TOLERANCE**2)).to(view.depth)[..., None]
    normal = normalize(view.normal, dim=-1)
    maps = torch.cat([view.features["albedo"], view.features["roughness"], normal, view.depth[..., None]], -1)
    size = torch.tensor([camera.width, camera.height]).to(x_cam)
    grid = (2 * camera.project(x_cam) / size - 1)[None, None]
    # What is unknown has no part in the mean of four neighbours.
    stacked = torch.cat([maps * known, known], -1).movedim(-1, 0)[None]
    found = grid_sample(stacked, grid, align_corners=False)[0, :, 0].T
    share = found[:, -1:]
    found = found / share.clamp(min=1e-6)
    near = (found[:, CHANNELS : CHANNELS + 1] - x_cam[:, 2:]).abs() < TOLERANCE
    return found[:, :CHANNELS], near * (share > 0.25) * share


def _beside(asset: Asset, points: Float[Tensor, "t 3"], normals: Float[Tensor, "t 3"]) -> Float[Tensor, "t 7"]:
    """What no view sees looks like the Gaussian next to it."""
    material = asset.material
    index = nearest(points, asset.gaussians.means)
    rough = material.roughness.mean(1, keepdim=True)
    return torch.cat([material.albedo.mean(1)[index], rough[index], normals], -1)
