"""Relighting: images of an asset under any environment map (paper section 4.4).

`relight` traces rays by importance sampling of BRDF and light; `preview` uses the split sum and traces no rays.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.maths import SE3, SO3, fibonacci_sphere
from tumble.rendering.gbuffer import antialiased_gbuffer
from tumble.rendering.importance_sampling import GlossyBounce, light_sampler, relight_surface
from tumble.rendering.prefiltered_light import prefilter
from tumble.rendering.rasterizer import Buffers
from tumble.rendering.shading import Bounce, Surface, material_at, shade_split, surface
from tumble.rendering.trace import Tracer, build_tracer, surface_points, transfer, unoccluded, visibility
from tumble.scene import Asset, Camera, Environment, Trajectory, opacity, opengl_from_opencv

SURFACE_VIEWS = 64
"""Maximum number of frames that are rendered to find the Gaussians' surface points."""
VISIBILITY_DIRECTIONS = 512
"""Number of directions over which light is integrated at each Gaussian, and in which its visibility is traced."""

MAX_ALBEDO = 0.999
"""Largest albedo after scaling."""
MARGIN = 1.1
"""Distance of a turntable's camera, over that at which the object's sphere fills the image."""


@dataclass(frozen=True)
class Config:
    """Settings of relighting; numbers of samples from the paper's appendix A."""

    brdf_samples: int = 512
    """Rays per pixel by importance sampling of the BRDF."""
    light_samples: int = 512
    """Rays per pixel by importance sampling of the light."""
    alpha_min: float = 0.1
    """Minimum coverage of a pixel that is shaded; other pixels are black."""
    preview_directions: int = 256
    """Number of directions over which a preview integrates the light."""


@dataclass(frozen=True)
class TracedGeometry:
    """What relighting needs of an asset's geometry, whatever its light and material."""

    tracer: Tracer
    transfer: Float[Tensor, "n 9"]
    """Transfer vectors of the Gaussians."""


@torch.no_grad()
def trace_geometry(asset: Asset) -> TracedGeometry:
    """Tracer of the Gaussians, and their transfer vectors, traced from the frames of the capture."""
    tracer = build_tracer(asset.gaussians, asset.gamma)
    return TracedGeometry(tracer, _transfer(asset, tracer))


@torch.no_grad()
def relight(
    cfg: Config,
    asset: Asset,
    environment: Environment,
    trajectory: Trajectory,
    camera: Camera,
    *,
    geometry: TracedGeometry | None = None,
    buffers: Sequence[Buffers] | None = None,
    seed: int = 0,
) -> Iterator[Float[Tensor, "h w 3"]]:
    """Images of the object along a trajectory, under a light: linear radiance over black, one view at a time.

    Args:
        cfg: Numbers of samples.
        asset: Geometry and material.
        environment: Light in the env frame of `trajectory`.
        trajectory: Poses; its field `light` defines whether the light is fixed to the camera or to the object.
        camera: Intrinsics and image size.
        geometry: That of the asset, if it is known from an earlier call.
        buffers: Those of the frames by `antialiased_gbuffer`, if they are known.
        seed: Seed of the random samples.
    """
    material = asset.material
    geometry = geometry or trace_geometry(asset)
    sampler = light_sampler(environment)
    diffuse = Bounce(material.diffuse_albedo, geometry.transfer)
    rough, metalness = material.roughness.mean(1, keepdim=True), material.metalness
    metal = None if metalness is None else (material.albedo.mean(1), metalness[:, None])
    bounce = GlossyBounce(diffuse, rough, prefilter(environment), metal)
    generator = torch.Generator().manual_seed(seed)
    for view, points, R_env_obj in _surfaces(cfg, asset, trajectory, camera, buffers):
        albedo, roughness, metalness = material_at(view, points)
        shaded = relight_surface(
            points,
            albedo,
            roughness,
            sampler,
            R_env_obj,
            geometry.tracer,
            f0=float(material.f0),
            generator=generator,
            n_brdf=cfg.brdf_samples,
            n_light=cfg.light_samples,
            bounce=bounce,
            metalness=metalness,
        )
        yield points.paint(shaded, camera.height, camera.width) * view.alpha[..., None]


@torch.no_grad()
def preview(
    cfg: Config, asset: Asset, environment: Environment, trajectory: Trajectory, camera: Camera
) -> Iterator[Float[Tensor, "h w 3"]]:
    """Images as by `relight`, but faster: without shadows and indirect light, with the estimator of training."""
    material = asset.material
    prefiltered = prefilter(environment)
    directions = fibonacci_sphere(cfg.preview_directions).to(asset.gaussians.means)
    for view, points, R_env_obj in _surfaces(cfg, asset, trajectory, camera):
        albedo, roughness, metalness = material_at(view, points)
        lit = (prefiltered, R_env_obj, unoccluded(directions, len(points.points)))
        shaded = shade_split(points, albedo, roughness, *lit, f0=float(material.f0), metalness=metalness)
        yield points.paint(shaded, camera.height, camera.width) * view.alpha[..., None]


@torch.no_grad()
def gaussian_colours(asset: Asset, frame: int = 0) -> Float[Tensor, "n 3"]:
    """Linear radiance of every Gaussian along its normal, unshadowed, under the asset's light in one training frame."""
    material, normals, n = asset.material, asset.gaussians.normals, len(asset.gaussians)
    points = Surface(torch.arange(n, device=normals.device), asset.gaussians.means, normals, normals)
    unshadowed = unoccluded(fibonacci_sphere(VISIBILITY_DIRECTIONS).to(normals), n)
    metalness = material.metalness
    return shade_split(
        points,
        material.albedo.mean(1),
        material.roughness.mean(1, keepdim=True),
        prefilter(asset.environment),
        asset.trajectory.R_env_obj[frame],
        unshadowed,
        f0=float(material.f0),
        metalness=None if metalness is None else metalness[:, None],
    )


def turntable(asset: Asset, camera: Camera, n: int, elevation: float) -> tuple[Float[Tensor, "3 3"], Trajectory]:
    """One revolution of the object about the vertical through its centre, before a fixed camera and a fixed light.

    The camera is as far away as in the median of the run's frames, or so far that all of the object is in the image.

    Args:
        camera: The camera; its principal point is the centre of the image.
        n: Number of frames.
        elevation: Angle by which the camera looks down on the object [radians].

    Returns:
        Object to env rotation of the first frame (for `Environment.rotated`), and the trajectory.
    """
    like = asset.trajectory.T_cam_obj.xyz
    centre, radius = _extent(asset)
    narrowest = min(camera.height / float(camera.fx_fy_cx_cy[1]), camera.width / float(camera.fx_fy_cx_cy[0]))
    near = MARGIN * radius / math.sin(math.atan(0.5 * narrowest))
    distance = max(near, float((asset.trajectory.camera_positions - centre).norm(dim=-1).median()))
    tilt = SO3.exp(like.new_tensor([elevation, 0.0, 0.0])).matrix()
    omega = like.new_zeros(n, 3)
    omega[:, 1] = 2 * math.pi * torch.arange(n).to(like) / n
    turn = SO3.exp(omega)
    T_gl_obj = SE3.from_rotation_matrix(tilt) @ SE3.from_rotation(turn, -(turn.matrix() @ centre))
    shift = like.new_tensor([0.0, 0.0, distance])
    flip = opengl_from_opencv(like)
    T_cam_gl = SE3.from_rotation(SO3.from_matrix(flip), shift)
    return tilt, Trajectory(T_cam_gl @ T_gl_obj, "camera")


def _extent(asset: Asset) -> tuple[Float[Tensor, "3"], float]:
    """Centre of the opaque Gaussians' bounds, object frame, and the radius of a sphere around it that holds them."""
    means = asset.gaussians.means
    opaque = means[opacity(asset.gaussians.sdf, asset.gamma) > 0.5]
    points = opaque if len(opaque) else means
    centre = 0.5 * (points.amin(0) + points.amax(0))
    return centre, float((points - centre).norm(dim=-1).max())


def scale_albedo(
    asset: Asset, buffers: Sequence[Buffers], albedo_scale: Float[Tensor, "3"]
) -> tuple[Asset, list[Buffers]]:
    """The asset, and its buffers, with their albedo multiplied by a factor per channel, limited to `MAX_ALBEDO`."""
    material = asset.material
    scaled_material = material.with_albedo((material.albedo * albedo_scale).clamp(1e-4, MAX_ALBEDO))
    scaled = [
        replace(
            view, features=view.features | {"albedo": (view.features["albedo"] * albedo_scale).clamp(max=MAX_ALBEDO)}
        )
        for view in buffers
    ]
    return replace(asset, material=scaled_material), scaled


def _transfer(asset: Asset, tracer: Tracer) -> Float[Tensor, "n 9"]:
    """Transfer vectors of all Gaussians, traced from their surface points in the frames of the capture."""
    frames = range(0, len(asset.trajectory), -(-len(asset.trajectory) // SURFACE_VIEWS))
    poses = [asset.trajectory.T_cam_obj[i] for i in frames]
    points = surface_points(asset.gaussians, asset.gamma, poses, asset.camera)
    directions = fibonacci_sphere(VISIBILITY_DIRECTIONS).to(points)
    return transfer([visibility(tracer, points, asset.gaussians.normals, directions)], asset.gaussians.normals)


def _surfaces(
    cfg: Config, asset: Asset, trajectory: Trajectory, camera: Camera, buffers: Sequence[Buffers] | None = None
) -> Iterator[tuple[Buffers, Surface, Float[Tensor, "3 3"]]]:
    """For each frame: buffers, surface points, and rotation from the object frame to the env frame."""
    for i, R_env_obj in enumerate(trajectory.R_env_obj):
        T_cam_obj = trajectory.T_cam_obj[i]
        view = antialiased_gbuffer(asset, T_cam_obj, camera) if buffers is None else buffers[i]
        yield view, surface(view, T_cam_obj, camera, alpha_min=cfg.alpha_min), R_env_obj
