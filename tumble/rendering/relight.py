"""Pictures of a decomposed object under any light (paper section 4.4): BRDF and light importance sampling.

Two grades of the same: `relight` draws 512 + 512 rays per pixel; `preview` takes the split sum, without rays.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from tumble.maths import SE3, SO3, fibonacci_sphere
from tumble.rendering.gbuffer import antialiased
from tumble.rendering.importance_sampling import GlossyBounce, light_sampler, relight_surface
from tumble.rendering.prefiltered_light import prefilter
from tumble.rendering.rasterizer import Buffers
from tumble.rendering.shading import Bounce, Surface, shade_split, surface
from tumble.rendering.trace import Tracer, build, surface_points, transfer, unoccluded, visibility
from tumble.scene import TEMPERATURE, Asset, Camera, Environment, Trajectory, opengl_from_opencv

SEEN_FROM = 64
"""Most frames from which the points are found that Gaussians stand for."""
SKY_DIRECTIONS = 512
"""In which what a Gaussian sees is traced."""


@dataclass(frozen=True)
class Config:
    """Values of the paper's appendix A."""

    brdf_samples: int = 512
    """Rays per pixel drawn like the surface scatters."""
    light_samples: int = 512
    """Rays per pixel drawn like the light arrives."""
    alpha_min: float = 0.1
    """Least coverage of a pixel that is shaded; what covers less is left black."""
    preview_directions: int = 256
    """Directions of the diffuse light in a preview."""


@torch.no_grad()
def relight(
    cfg: Config, asset: Asset, environment: Environment, trajectory: Trajectory, camera: Camera, *, seed: int = 0
) -> Iterator[Float[Tensor, "h w 3"]]:
    """The object along a trajectory under a light: linear radiance over black, view by view.

    Args:
        asset: With material.
        environment: In the env frame of `trajectory`.
        trajectory: Whose word `light` says what the new light stands still with.
        seed: Of the samples.
    """
    material = asset.material
    tracer = build(asset.gaussians, asset.gamma)
    sampler = light_sampler(environment)
    diffuse = Bounce(material.albedo.mean(1), _transfer(asset, tracer))
    bounce = GlossyBounce(diffuse, material.roughness.mean(1, keepdim=True), prefilter(environment))
    generator = torch.Generator().manual_seed(seed)
    for view, points, R_env_obj in _surfaces(cfg, asset, trajectory, camera):
        shaded = relight_surface(
            points,
            points.sample(view.features["albedo"]),
            points.sample(view.features["roughness"]),
            sampler,
            R_env_obj,
            tracer,
            f0=float(material.f0),
            generator=generator,
            n_brdf=cfg.brdf_samples,
            n_light=cfg.light_samples,
            bounce=bounce,
        )
        yield points.paint(shaded, camera.height, camera.width) * view.alpha[..., None]


@torch.no_grad()
def preview(
    cfg: Config, asset: Asset, environment: Environment, trajectory: Trajectory, camera: Camera
) -> Iterator[Float[Tensor, "h w 3"]]:
    """As `relight`, at once: no shadows, no bounce, highlights as in training."""
    material = asset.material
    prefiltered = prefilter(environment)
    directions = fibonacci_sphere(cfg.preview_directions).to(asset.gaussians.means)
    for view, points, R_env_obj in _surfaces(cfg, asset, trajectory, camera):
        shaded = shade_split(
            points,
            points.sample(view.features["albedo"]),
            points.sample(view.features["roughness"]),
            prefiltered,
            R_env_obj,
            unoccluded(directions, len(points.points)),
            f0=float(material.f0),
        )
        yield points.paint(shaded, camera.height, camera.width) * view.alpha[..., None]


@torch.no_grad()
def gaussian_colours(asset: Asset, frame: int = 0) -> Float[Tensor, "n 3"]:
    """Linear radiance of every Gaussian under the recovered light of one training frame, unshadowed, seen head-on."""
    material, normals, n = asset.material, asset.gaussians.normals, len(asset.gaussians)
    points = Surface(torch.arange(n, device=normals.device), asset.gaussians.means, normals, normals)
    sky = unoccluded(fibonacci_sphere(SKY_DIRECTIONS).to(normals), n)
    return shade_split(
        points,
        material.albedo.mean(1),
        material.roughness.mean(1, keepdim=True),
        prefilter(asset.environment),
        asset.trajectory.R_env_obj[frame],
        sky,
        f0=float(material.f0),
    )


def turntable(seen: Trajectory, n: int, elevation: float) -> tuple[Float[Tensor, "3 3"], Trajectory]:
    """One turn about the object's +y axis before a camera that stands still, as does the light.

    Args:
        seen: The middle distance of its cameras is kept.
        n: Number of frames.
        elevation: How far the camera looks down on the object [radians].

    Returns:
        Object to env rotation of the first frame (`Environment.rotated`), and the trajectory.
    """
    like = seen.T_cam_obj.xyz
    lean = SO3.exp(like.new_tensor([elevation, 0.0, 0.0])).matrix()
    turn = like.new_zeros(n, 3)
    turn[:, 1] = 2 * math.pi * torch.arange(n).to(like) / n
    T_gl_obj = SE3.from_rotation_matrix(lean) @ SE3.from_rotation(SO3.exp(turn), torch.zeros_like(turn))
    shift = like.new_tensor([0.0, 0.0, float(seen.camera_positions.norm(dim=-1).median())])
    flip = opengl_from_opencv(like)
    T_cam_gl = SE3.from_rotation(SO3.from_matrix(flip), shift)
    return lean, Trajectory(T_cam_gl @ T_gl_obj, "camera")


def scaled(asset: Asset, albedo_scale: Float[Tensor, "3"]) -> Asset:
    """The asset with its albedo times a factor per channel, at most 0.999."""
    material = asset.material
    albedo = (material.albedo * albedo_scale).clamp(1e-4, 0.999)
    logits = TEMPERATURE * torch.logit(albedo)
    return replace(asset, material=replace(material, albedo_logits=logits))


def _transfer(asset: Asset, tracer: Tracer) -> Float[Tensor, "n 9"]:
    """What every Gaussian sees of the light, from the surface that it stands for in frames of the capture."""
    frames = range(0, len(asset.trajectory), -(-len(asset.trajectory) // SEEN_FROM))
    poses = [asset.trajectory.T_cam_obj[i] for i in frames]
    points = surface_points(asset.gaussians, asset.gamma, poses, asset.camera)
    directions = fibonacci_sphere(SKY_DIRECTIONS).to(points)
    return transfer([visibility(tracer, points, asset.gaussians.normals, directions)], asset.gaussians.normals)


def _surfaces(
    cfg: Config, asset: Asset, trajectory: Trajectory, camera: Camera
) -> Iterator[tuple[Buffers, Surface, Float[Tensor, "3 3"]]]:
    """What each frame shows, and how its light is turned."""
    for i, R_env_obj in enumerate(trajectory.R_env_obj):
        T_cam_obj = trajectory.T_cam_obj[i]
        view = antialiased(asset, T_cam_obj, camera)
        yield view, surface(view, T_cam_obj, camera, alpha_min=cfg.alpha_min), R_env_obj
