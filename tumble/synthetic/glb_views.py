"""Views of an exported GLB by the renderer of the ground truth: maps, and images under environment lights."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float

from tumble.maths import SE3
from tumble.scene import Camera, Environment
from tumble.synthetic import pathtracer
from tumble.synthetic.pathtracer import ObjectModel

MAP_SAMPLES = 64
"""Samples per pixel of the maps."""
PATH_DEPTH = 5
"""Maximum number of segments of a path, as in the ground truth of the captures."""
REACH = 2
"""Distance from the silhouette up to which maps continue the nearest pixel of the object [pixels]: scores of maps are
over the true silhouette, and the mesh's own has a score of its own."""


@dataclass(frozen=True)
class GlbMaps:
    """Maps of several views, 0 off the object."""

    albedo: Float[np.ndarray, "v h w 3"]
    """Linear base colour."""
    roughness: Float[np.ndarray, "v h w 1"]
    """Perceptual roughness."""
    metalness: Float[np.ndarray, "v h w 1"]
    """Metalness."""
    normal: Float[np.ndarray, "v h w 3"]
    """Unit normals of the mesh without its normal map, in the file's frame."""
    mask: Bool[np.ndarray, "v h w"]
    """Pixels of which the object covers at least half."""


def read_glb(path: Path, metres: float) -> ObjectModel:
    """A GLB of `tumble export` in the frame of its asset; `metres` is the object radius in the file's unit.

    Raises:
        BadFile: The file is missing, is not readable, or has no triangles or too many.
    """
    parts = tuple(replace(part, vertices=part.vertices / metres) for part in pathtracer.read_parts(path))
    return ObjectModel(parts, np.diag([1 / metres, 1 / metres, 1 / metres, 1.0]))


def glb_maps(model: ObjectModel, views: Sequence[SE3], camera: Camera) -> GlbMaps:
    """Maps of a model, continued `REACH` pixels beyond its silhouette."""
    unlit = pathtracer.unlit_scenes(model, "gltf", None)
    found = [pathtracer.maps(unlit, view, camera, samples=MAP_SAMPLES) for view in views]
    mask = np.stack([view.coverage >= 0.5 for view in found])

    def continued(name: str) -> np.ndarray:
        return np.stack([_continued(getattr(view, name), view.coverage >= 0.5) for view in found])

    albedo, roughness, metalness, normal = map(continued, ("albedo", "roughness", "metalness", "normal"))
    return GlbMaps(albedo, roughness, metalness, normal, mask)


def glb_images(
    model: ObjectModel,
    views: Sequence[SE3],
    camera: Camera,
    light: Environment,
    *,
    albedo_scale: Float[np.ndarray, "3"],
    f0: float,
    samples: int,
) -> Float[np.ndarray, "v h w 3"]:
    """Linear radiance of views under a light in the model's frame, with the base colour scaled and limited to 1.

    Args:
        albedo_scale: Factor of the base colour per channel.
        f0: Reflectance at normal incidence.
        samples: Samples per pixel.
    """
    parts = tuple(replace(part, albedo=(part.albedo * albedo_scale).clip(0, 0.999)) for part in model.parts)
    shapes = pathtracer.mitsuba_shapes(replace(model, parts=parts), "gltf", None, f0)
    scene = pathtracer.lit_scene(shapes, light, PATH_DEPTH)
    still = torch.eye(3)
    images = [
        pathtracer.radiance(scene, view, camera, still, samples=samples, seed=i)[0] for i, view in enumerate(views)
    ]
    return np.stack(images)


def _continued(values: Float[np.ndarray, "h w c"], mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w c"]:
    """The map with pixels near the mask set to their nearest pixel in it."""
    from scipy.ndimage import distance_transform_edt

    if not mask.any():
        return values
    found: Any = distance_transform_edt(~mask, return_indices=True)
    distance, nearest = found
    return np.where((distance <= REACH)[..., None], values[tuple(nearest)], values)
