"""Deferred shading of surface points under the environment map of one frame.

All computations are in the object frame, with one set of directions for the whole view: the light of a frame is
`environment.lookup(R_env_obj @ w)`, one lookup per direction and frame. *Bounce* is indirect light: radiance of the
Gaussians that occlude a direction, under the light of the same frame.

There are two estimators. `shade` sums both lobes over the shared directions; it is unbiased, but a few hundred
directions cannot resolve a narrow specular lobe. `shade_split`, which is used in training, sums the diffuse lobe and
wide specular lobes, and takes narrow specular lobes (`NARROW_ROUGHNESS`) from a prefiltered environment map. Final
images use `importance_sampling.relight_surface` instead.
"""

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import torch
from jaxtyping import Float, Int32, Int64, Shaped
from torch import Tensor
from torch.nn.functional import normalize

from tumble import backends
from tumble.backends import NARROW_ROUGHNESS
from tumble.maths import SE3, reflect
from tumble.rendering import brdf
from tumble.rendering.prefiltered_light import Prefiltered, cell_roughness
from tumble.rendering.rasterizer import Buffers
from tumble.rendering.trace import Visibility
from tumble.scene import Camera, Environment


@dataclass(frozen=True)
class Surface:
    """Surface points behind some pixels of a view, object frame."""

    pixels: Int64[Tensor, " p"]
    """Indices of the pixels, counted row by row."""
    points: Float[Tensor, "p 3"]
    """Positions [object radius]."""
    normals: Float[Tensor, "p 3"]
    """Outward unit normals."""
    views: Float[Tensor, "p 3"]
    """Unit directions to the camera."""

    def sample(self, image: Shaped[Tensor, "h w c"]) -> Shaped[Tensor, "p c"]:
        """Values of an image of the same view at the points."""
        return image.flatten(0, 1)[self.pixels]

    def paint(self, values: Float[Tensor, "p c"], height: int, width: int) -> Float[Tensor, "{height} {width} c"]:
        """An image with values at the points, 0 elsewhere."""
        empty = values.new_zeros(height * width, values.shape[1])
        return empty.index_copy(0, self.pixels, values).unflatten(0, (height, width))


def surface(
    buffers: Buffers,
    T_cam_obj: SE3,
    camera: Camera,
    *,
    alpha_min: float = 0.5,
    pixels: Int64[Tensor, " p"] | None = None,
) -> Surface:
    """Surface points behind pixels, at their mean depth; differentiable in buffers and pose.

    Args:
        buffers: Buffers of the view. `normal` must already contain `Material.normal_offset` if it is to be shaded.
        T_cam_obj: Pose of the view.
        camera: Intrinsics of the view.
        alpha_min: Minimum coverage of a pixel, since the mean depth at a depth edge is on neither surface.
        pixels: Indices of the pixels, counted row by row, with coverage above 0; all with `alpha_min` when None.
    """
    if pixels is None:
        pixels = torch.where(buffers.alpha.flatten() >= alpha_min)[0]
    column, row = pixels % camera.width, pixels // camera.width
    uv = torch.stack([column, row], -1).to(buffers.depth) + 0.5
    ray_cam = camera.unproject(uv, torch.ones_like(uv[:, 0])).to(buffers.depth)
    R_cam_obj = T_cam_obj.rotation.matrix()
    points = (buffers.depth.flatten()[pixels][:, None] * ray_cam - T_cam_obj.translation) @ R_cam_obj
    normals = normalize(buffers.normal.flatten(0, 1)[pixels], dim=-1)
    return Surface(pixels, points, normals, normalize(-ray_cam @ R_cam_obj, dim=-1))


def material_at(
    view: Buffers, points: Surface
) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p 1"], Float[Tensor, "p 1"] | None]:
    """Linear albedo, roughness and metalness (None for an object without metal) of a G-buffer's surface points."""
    metalness = view.features.get("metalness")
    of_points = points.sample(view.features["albedo"]), points.sample(view.features["roughness"])
    return *of_points, None if metalness is None else points.sample(metalness)


@dataclass(frozen=True)
class Bounce:
    """Indirect light from the shadowed diffuse radiance of every Gaussian under the light of the frame."""

    albedo: Float[Tensor, "n 3"]
    """Linear albedo of every Gaussian's diffuse lobe."""
    transfer: Float[Tensor, "n 9"]
    """Transfer vector of every Gaussian (`trace.transfer`)."""

    def radiance(self, directions: Float[Tensor, "D 3"], light: Float[Tensor, "D 3"]) -> Float[Tensor, "n 3"]:
        """Radiance of every Gaussian under a light given in evenly distributed directions.

        The light is projected onto harmonics up to degree 2, which is accurate to 1 % of the irradiance for most lights
        (Ramamoorthi and Hanrahan 2001). Shadows and all bounces are included: the occluding surface is assumed to be as
        bright as the occluded point, which makes the bounces a geometric series (Jimenez et al. 2016).
        """
        backend = backends.choose(self.albedo.device, self.albedo.dtype)
        return backend.bounce(self.albedo, self.transfer, directions, light)


@dataclass(frozen=True)
class AveragedBounce:
    """The paper's indirect light: the mean radiance of every Gaussian over all frames."""

    colour: Float[Tensor, "n 3"]
    """Mean linear radiance of every Gaussian."""

    def radiance(self, directions: Float[Tensor, "D 3"], light: Float[Tensor, "D 3"]) -> Float[Tensor, "n 3"]:
        """Radiance of every Gaussian, the same under every light."""
        return self.colour


def shade(
    surface: Surface,
    albedo: Float[Tensor, "p 3"],
    roughness: Float[Tensor, "p 1"],
    environment: Environment,
    R_env_obj: Float[Tensor, "3 3"],
    visibility: Visibility,
    *,
    f0: float | Float[Tensor, "*c"],
    bounce: Bounce | AveragedBounce | None = None,
) -> Float[Tensor, "p 3"]:
    """Reflected radiance (eq. 3), both lobes summed over the visibility's directions.

    Differentiable in everything but directions and visibility. Unbiased if the directions are rotated at random.

    Args:
        surface: Surface points.
        albedo: Linear albedo of the points.
        roughness: Perceptual roughness of the points.
        environment: Light, env frame.
        R_env_obj: Rotation from the object frame to the env frame.
        visibility: Visibility from the points; `trace.unoccluded` for no shadows.
        f0: Reflectance at normal incidence.
        bounce: Indirect light, used if the visibility has blockers; occluded directions are black when None.
    """
    light = environment.lookup(visibility.directions @ R_env_obj.mT)
    lobes = _lobes(surface, roughness, visibility, light, bounce)
    return albedo * lobes.diffuse + f0 * lobes.specular


def diffuse(
    surface: Surface,
    albedo: Float[Tensor, "p 3"],
    environment: Environment,
    R_env_obj: Float[Tensor, "3 3"],
    visibility: Visibility,
    *,
    bounce: Bounce | AveragedBounce | None = None,
) -> Float[Tensor, "p 3"]:
    """The diffuse lobe of `shade`."""
    light = environment.lookup(visibility.directions @ R_env_obj.mT)
    return albedo * _lobes(surface, torch.ones_like(albedo[:, :1]), visibility, light, bounce).diffuse


def shade_split(
    surface: Surface,
    albedo: Float[Tensor, "p 3"],
    roughness: Float[Tensor, "p 1"],
    prefiltered: Prefiltered,
    R_env_obj: Float[Tensor, "3 3"],
    visibility: Visibility,
    *,
    f0: float | Float[Tensor, "*c"],
    bounce: Bounce | AveragedBounce | None = None,
    metalness: Float[Tensor, "p 1"] | None = None,
) -> Float[Tensor, "p 3"]:
    """Reflected radiance with wide lobes summed over the directions, and narrow specular lobes by the split sum.

    The split sum is multiplied by the visible fraction of the specular lobe (`Backend.shade`). It is not used for wide
    lobes (`NARROW_ROUGHNESS`), since it is up to 1.6 times too bright at grazing angles, where the horizon cuts the
    lobe (test_a_wide_lobe_matches_the_path_tracer). Arguments as for `shade`, and the points' metalness: None for 0.
    """
    lit = (surface, roughness, prefiltered, R_env_obj, visibility)
    of_colour, other = coloured_lobes(*lit, f0=f0, bounce=bounce, metalness=metalness)
    return albedo * of_colour + other


def coloured_lobes(
    surface: Surface,
    roughness: Float[Tensor, "p 1"],
    prefiltered: Prefiltered,
    R_env_obj: Float[Tensor, "3 3"],
    visibility: Visibility,
    *,
    f0: float | Float[Tensor, "*c"],
    bounce: Bounce | AveragedBounce | None = None,
    metalness: Float[Tensor, "p 1"] | None = None,
) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p 3"]]:
    """Radiance of `shade_split` per base colour, and that without the base colour; both are linear in metalness.

    The base colour of a dielectric is that of its diffuse lobe, that of a metal its reflectance at normal incidence.
    The lobe of a metal is a split sum for every roughness.
    """
    lobes = split_lobes(surface, roughness, prefiltered, R_env_obj, visibility, bounce=bounce)
    if metalness is None:
        return lobes.diffuse, f0 * lobes.specular
    reflectance = _metal_reflectance(surface.normals, surface.views, roughness)
    of_colour, of_all = (lobes.mirrored * x for x in reflectance)
    return torch.lerp(lobes.diffuse, of_colour, metalness), torch.lerp(f0 * lobes.specular, of_all, metalness)


class SplitLobes(NamedTuple):
    """Radiance of the lobes of `shade_split`."""

    diffuse: Float[Tensor, "p 3"]
    """Of a white diffuse lobe."""
    specular: Float[Tensor, "p 3"]
    """Of a dielectric's specular lobe, per reflectance at normal incidence."""
    mirrored: Float[Tensor, "p 3"]
    """Mean over a specular lobe, times its visible fraction."""


def split_lobes(
    surface: Surface,
    roughness: Float[Tensor, "p 1"],
    prefiltered: Prefiltered,
    R_env_obj: Float[Tensor, "3 3"],
    visibility: Visibility,
    *,
    bounce: Bounce | AveragedBounce | None = None,
) -> SplitLobes:
    """Lobes of `shade_split`, whatever the base colour and the reflectance at normal incidence are."""
    # One lookup for both kinds of directions, since its gradient is an image of the size of all levels.
    mirrored = reflect(surface.views, surface.normals)
    in_env = torch.cat([visibility.directions, mirrored]) @ R_env_obj.mT
    cell = torch.full_like(visibility.directions[:, :1], cell_roughness(len(visibility.directions)))
    radiance = prefiltered.lookup(in_env, torch.cat([cell, roughness]))
    light, of_mirrored = radiance.split([len(cell), len(mirrored)])
    lobes = _lobes(surface, roughness, visibility, light, bounce)
    seen = lobes.specular_visibility[:, None]
    narrow = of_mirrored * (seen * _reflectance(surface.normals, surface.views, roughness))
    wideness = ((roughness - NARROW_ROUGHNESS[0]) / (NARROW_ROUGHNESS[1] - NARROW_ROUGHNESS[0])).clamp(0, 1)
    return SplitLobes(lobes.diffuse, torch.lerp(narrow, lobes.specular, wideness), of_mirrored * seen)


def shading_light(prefiltered: Prefiltered, visibility: Visibility, bounce: Bounce | None) -> backends.ShadingLight:
    """Light and occlusion of `shade_split` for the kernel `Backend.shading_term`, which finds the rows by itself.

    Raises:
        ValueError: The light has a higher resolution than its convolutions, which the kernel does not look up.
    """
    stack = prefiltered.stack
    if prefiltered.is_finer:
        raise ValueError(
            f"a light of {len(prefiltered.radiance)} rows is finer than its {stack.shape[1]} filtered ones"
        )
    albedo, transfer = stack.new_zeros(0, 3), stack.new_zeros(0, 9)
    blocker = stack.new_full((1, 1), -1, dtype=torch.int32)
    if bounce is not None and visibility.blocker is not None:
        albedo, transfer, blocker = bounce.albedo, bounce.transfer, visibility.blocker
    seen = (visibility.directions, visibility.bits, blocker, albedo, transfer)
    return backends.ShadingLight(stack, *seen, reflectance_table(stack.dtype, stack.device))


def specular(
    normals: Float[Tensor, "p 3"],
    views: Float[Tensor, "p 3"],
    roughness: Float[Tensor, "p 1"],
    prefiltered: Prefiltered,
    R_env_obj: Float[Tensor, "3 3"],
    f0: float | Float[Tensor, "*c"],
    *,
    albedo: Float[Tensor, "p 3"] | None = None,
    metalness: Float[Tensor, "p 1"] | None = None,
) -> Float[Tensor, "p 3"]:
    """The specular lobe by the split sum, without occlusion.

    Args:
        normals: Unit normals, object frame.
        views: Unit directions to the camera, object frame.
        roughness: Perceptual roughness.
        prefiltered: Light, env frame.
        R_env_obj: Rotation from the object frame to the env frame.
        f0: Reflectance at normal incidence of dielectrics.
        albedo: Linear base colour, of metals.
        metalness: Metalness; None for 0.
    """
    reflected = prefiltered.lookup(reflect(views, normals) @ R_env_obj.mT, roughness)
    dielectric = f0 * reflected * _reflectance(normals, views, roughness)
    if metalness is None or albedo is None:
        return dielectric
    of_colour, of_all = _metal_reflectance(normals, views, roughness)
    return torch.lerp(dielectric, reflected * (albedo * of_colour + of_all), metalness)


def _reflectance(
    normals: Float[Tensor, "p 3"], views: Float[Tensor, "p 3"], roughness: Float[Tensor, "p 1"]
) -> Float[Tensor, "p 1"]:
    """Directional albedo of the specular lobe divided by f0."""
    nov = (normals * views).sum(-1, keepdim=True).clamp(0, 1)
    return brdf.split_sum(reflectance_table(nov.dtype, nov.device), nov, roughness)


def _metal_reflectance(
    normals: Float[Tensor, "p 3"], views: Float[Tensor, "p 3"], roughness: Float[Tensor, "p 1"]
) -> tuple[Float[Tensor, "p 1"], Float[Tensor, "p 1"]]:
    """Directional albedo of a metal's lobe: the part that its base colour multiplies, and the rest."""
    nov = (normals * views).sum(-1, keepdim=True).clamp(0, 1)
    of_colour, of_all = _metal_reflectance_tables(nov.dtype, nov.device)
    return brdf.split_sum(of_colour, nov, roughness), brdf.split_sum(of_all, nov, roughness)


@cache
def _metal_reflectance_tables(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "2 size size"]:
    """The split-sum tables of metals, cached per device."""
    return brdf.metal_split_sum_tables().to(device, dtype)


@cache
def reflectance_table(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "size size"]:
    """The split-sum table, cached per device."""
    return brdf.split_sum_table().to(device, dtype)


def _lobes(
    surface: Surface,
    roughness: Float[Tensor, "p 1"],
    visibility: Visibility,
    light: Float[Tensor, "D 3"],
    bounce: Bounce | AveragedBounce | None,
) -> backends.Lobes:
    """Sums of both lobes over the directions, by the backend's kernel."""
    blocker, indirect = _blocker_radiance(visibility, light, bounce)
    backend = backends.choose(light.device, light.dtype)
    point = (surface.normals, roughness[:, 0], surface.views)
    seen = (visibility.bits, blocker, visibility.rows())
    return backend.shade(*point, visibility.directions, light, *seen, indirect)


def _blocker_radiance(
    visibility: Visibility, light: Float[Tensor, "D 3"], bounce: Bounce | AveragedBounce | None
) -> tuple[Int32[Tensor, "#q #D"], Float[Tensor, "n 3"]]:
    """Index of the Gaussian that occludes each direction, -1 for none, and the radiance of every Gaussian."""
    if bounce is None or visibility.blocker is None:
        return torch.full((1, 1), -1, dtype=torch.int32, device=light.device), light.new_zeros(0, 3)
    return visibility.blocker, bounce.radiance(visibility.directions, light)
