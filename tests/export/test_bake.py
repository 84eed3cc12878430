"""Baked textures against the known material of the Gaussians."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.functional import normalize

from tests.surfaces import GAMMA, sphere
from tumble import backends
from tumble.export import atlas, bake, depth_fusion, mesh
from tumble.export.atlas import UnwrappedMesh
from tumble.export.bake import Textures
from tumble.maths.images import linear_from_srgb, srgb_from_linear
from tumble.maths.se3 import SE3
from tumble.scene.asset import Asset
from tumble.scene.camera import Camera
from tumble.scene.environment import Environment
from tumble.scene.gaussians import Gaussians
from tumble.scene.material import TEMPERATURE, Material
from tumble.scene.trajectory import Trajectory

RADIUS = 0.8


def colour(x: torch.Tensor) -> torch.Tensor:
    """Linear base colour by position, different along each axis and direction."""
    return (0.4 + torch.tensor([0.35, 0.25, -0.3]) * x / RADIUS).clamp(0.02, 0.98)


def roughness(x: torch.Tensor) -> torch.Tensor:
    return 0.5 + 0.2 * x[..., 1] / RADIUS


def painted(gaussians: Gaussians) -> Asset:
    """An asset whose corners have the colour of their positions, under an uneven light, with three frames."""
    signs = torch.tensor([[-1.0, -1], [1, -1], [-1, 1], [1, 1]])
    # Corners of a Gaussian's plane lie sqrt(3) standard deviations out.
    plane = gaussians.R_obj_local[..., :2] * gaussians.scales[:, None, :2] * 3**0.5
    corners = gaussians.means[:, None] + torch.einsum("nij,cj->nci", plane, signs)
    material = Material(
        TEMPERATURE * torch.logit(colour(corners)),
        TEMPERATURE * torch.logit(roughness(corners)),
        torch.zeros_like(corners),
        torch.tensor(0.3),
    )
    light = Environment.from_radiance(0.5 + torch.linspace(0, 1, 8 * 16 * 3).reshape(8, 16, 3))
    T_cam_obj = SE3.exp(torch.tensor([[0.1, 0, 4, 0.2, 0, 0], [0, 0.2, 4, 0, 0.7, 0.1], [0, 0, 5, 1, 2, 0.5]]))
    return Asset(gaussians, GAMMA, material, light, Trajectory(T_cam_obj, "camera"), Camera.from_fov(0.6, 24, 32))


@pytest.fixture(scope="module")
def asset() -> Asset:
    return painted(sphere(3000, radius=RADIUS))


@pytest.fixture(scope="module")
def sphere_mesh() -> UnwrappedMesh:
    axis = np.linspace(-depth_fusion.HALF_SIDE, depth_fusion.HALF_SIDE, 33)
    values = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1), axis=-1) - RADIUS
    simplified = mesh.simplify(
        mesh.marching_tetrahedra(values, -depth_fusion.HALF_SIDE, 2 * depth_fusion.HALF_SIDE / 32), 1500
    )
    return atlas.unwrap(simplified, 192)


def baked(asset: Asset, sphere_mesh: UnwrappedMesh) -> Textures:
    return bake.bake(asset, sphere_mesh, resolution=192, views=24, pixels=160)


def at(values: np.ndarray, texels: bake.Texels) -> torch.Tensor:
    return torch.from_numpy(values[texels.rows.numpy(), texels.columns.numpy()]).float() / 255


def test_texels_lie_on_the_mesh_with_its_normals(sphere_mesh: UnwrappedMesh) -> None:
    texels = bake.locate_texels(sphere_mesh, 192)
    assert len(texels.rows) > 0.3 * 192**2
    # Chords of 1500 triangles lie up to 0.6 % below the sphere.
    assert (texels.points.norm(dim=-1) - RADIUS).abs().quantile(0.99) < 0.01
    assert (normalize(texels.points, dim=-1) * texels.normals).sum(-1).quantile(0.01) > 0.99


def test_texels_have_the_colour_and_roughness_of_their_position(asset: Asset, sphere_mesh: UnwrappedMesh) -> None:
    """A flip of u, v or an axis would give errors of up to 0.6."""
    texels, textures = bake.locate_texels(sphere_mesh, 192), baked(asset, sphere_mesh)
    error = (linear_from_srgb(at(textures.base_color, texels)) - colour(texels.points)).abs()
    # A Gaussian is 0.04 wide, over which the colour changes by 0.02; 8 bits are 0.008 of a bright linear value.
    assert error.mean() < 0.01
    assert error.max() < 0.06
    assert (at(textures.roughness, texels) - roughness(texels.points)).abs().max() < 0.05


def test_texels_have_the_value_of_the_nearest_gaussian(asset: Asset, sphere_mesh: UnwrappedMesh) -> None:
    texels = bake.locate_texels(sphere_mesh, 96)
    height = 0.5 + 0.5 * asset.gaussians.means[:, 1] / RADIUS
    values = at(bake.nearest_gaussian_texture(height, asset, sphere_mesh, resolution=96), texels)
    # 3000 Gaussians lie 0.05 apart.
    assert (values - 0.5 - 0.5 * texels.points[:, 1] / RADIUS).abs().max() < 0.05


def test_a_smooth_sphere_has_a_flat_normal_map(asset: Asset, sphere_mesh: UnwrappedMesh) -> None:
    texels, textures = bake.locate_texels(sphere_mesh, 192), baked(asset, sphere_mesh)
    z = 2 * at(textures.normal, texels)[:, 2] - 1
    assert z.quantile(0.01) > 0.98


def test_normal_detail_is_recovered_through_the_tangent_frame(asset: Asset, sphere_mesh: UnwrappedMesh) -> None:
    """A tilt in a known object direction, decoded as a viewer does: n = x t + y b + z n, b = w cross(n, t)."""
    tilt = torch.tensor([0.3, -0.15, 0.25])
    material = asset.material
    assert material is not None
    offset = material.normal_offset + tilt
    texels = bake.locate_texels(sphere_mesh, 192)
    textures = baked(replace(asset, material=replace(material, normal_offset=offset)), sphere_mesh)
    x, y, z = (2 * at(textures.normal, texels) - 1).split(1, -1)
    bitangents = torch.linalg.cross(texels.normals, texels.tangents) * texels.signs
    decoded = normalize(x * texels.tangents + y * bitangents + z * texels.normals, dim=-1)
    expected = normalize(normalize(texels.points, dim=-1) + tilt, dim=-1)
    # Facets and interpolated tangents, which are not exactly orthogonal: two degrees; a wrong sign is twenty.
    assert (decoded * expected).sum(-1).quantile(0.05) > 0.998


def test_padding_repeats_the_nearest_texel() -> None:
    covered = np.zeros((24, 24), bool)
    covered[3:8, 4:9] = covered[15:20, 12:20] = True
    image = np.random.default_rng(0).integers(1, 255, (24, 24, 3)).astype(np.uint8)
    filled = bake.pad(image * covered[..., None], covered)
    assert (filled[covered] == image[covered]).all()
    places = np.argwhere(covered)
    for row, column in np.argwhere(~covered):
        distance = np.hypot(*(places - (row, column)).T)
        # The 5 x 5 mask of the distance transform is accurate to 2 %.
        near = image[tuple(places[distance <= 1.03 * distance.min()].T)]
        assert (near == filled[row, column]).all(1).any()


def test_hidden_texels_take_the_material_of_the_nearest_gaussian(asset: Asset) -> None:
    points = torch.tensor([[0.2, 0.1, 0.0], [-0.1, 0.0, 0.3]])
    values = bake._nearest_material(asset, points, normalize(points, dim=-1))
    assert (values[:, :3] - colour(RADIUS * normalize(points, dim=-1))).abs().max() < 0.03


def test_the_kernel_blends_maps_like_its_definition(asset: Asset, sphere_mesh: UnwrappedMesh) -> None:
    """Sums of few terms in single precision; a fifth of the texels that face the camera are hidden or unknown."""
    kernel = backends.blend_kernel(backends.load("cpu"))
    assert kernel is not None, "the kernels are not compiled"
    texels = bake.locate_texels(sphere_mesh, 96)
    poses, camera = depth_fusion.surrounding_cameras(5, 80)
    maps = torch.rand(80, 80, 9, generator=torch.Generator().manual_seed(0))
    maps[..., 7] = 6 - RADIUS + 0.01 * maps[..., 7]
    maps = maps * (maps[..., 8:] > 0.3)
    maps[..., 8] = (maps[..., 8] > 0).float()
    view = depth_fusion.posed_cameras(poses[2:3], camera)
    sums = []
    for blend in (kernel, bake.blend_by_operations):
        total, weights = torch.ones(len(texels.points), 7), torch.ones(len(texels.points))
        blend(total, weights, maps, view, texels.points, texels.normals, min_cosine=0.2, tolerance=0.1)
        sums.append(torch.cat([total, weights[:, None]], -1))
    assert 0.02 < float((sums[1][:, 7] > 1).float().mean()) < 0.3
    torch.testing.assert_close(sums[0], sums[1], rtol=1e-4, atol=1e-5)


def test_larger_textures_are_interpolated(asset: Asset, sphere_mesh: UnwrappedMesh) -> None:
    """A texel of the larger texture lies a quarter of a texel from one of the smaller; colours vary slowly on it."""
    small = baked(asset, sphere_mesh)
    large = small.enlarged(384)
    assert large.base_color.shape == (384, 384, 3)
    assert large.roughness.shape == (384, 384)
    texels = bake.locate_texels(sphere_mesh, 384)
    error = (at(large.base_color, texels) - srgb_from_linear(colour(texels.points))).abs()
    assert error.mean() < 0.012
