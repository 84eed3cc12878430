"""Captures (images, masks and camera of a recorded object) and their ground truth for benchmarks.

A *mask* has three values: `OBJECT`, `BACKGROUND`, and `UNKNOWN` (a hand, an uncertain border), which losses and metrics
ignore. *Evaluation views* are held out from training. Their *region* is "shared" if the training frames of every
capture setting show the same part of the object, else "sphere" (docs/format.md).
"""

import hashlib
import json
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from tumble.io import tree
from tumble.maths import SE3, resize_srgb8
from tumble.scene.camera import Camera
from tumble.scene.environment import Environment
from tumble.scene.trajectory import Light, Trajectory

OBJECT = 255
"""Mask value of pixels that show the object."""
UNKNOWN = 128
"""Mask value of pixels that losses and metrics ignore."""
BACKGROUND = 0
"""Mask value of pixels that do not show the object."""
REGIONS = ("shared", "sphere")
"""Regions of evaluation views."""
Units = Literal["m", "arbitrary"]
Benchmark = Literal["", "tensoir", "stanford-orb"]
"""Published benchmark with a scoring protocol of its own; empty for all other captures."""


def mask_from_alpha(alpha: UInt8[np.ndarray, "*b h w"]) -> UInt8[np.ndarray, "*b h w"]:
    """Mask from an alpha channel: opaque pixels are OBJECT, transparent ones BACKGROUND, all others UNKNOWN."""
    return np.select([alpha >= 250, alpha <= 5], [OBJECT, BACKGROUND], UNKNOWN).astype(np.uint8)


def decode_mask(values: UInt8[np.ndarray, "h w"], *, invert: bool = False) -> UInt8[np.ndarray, "h w"]:
    """Mask with the values OBJECT, UNKNOWN and BACKGROUND from the code values of a mask image.

    Args:
        values: Code values; if the largest is 1, they count as 0 and 255.
        invert: The object is black instead of white.
    """
    if values.max(initial=0) == 1:
        values = values * np.uint8(OBJECT)
    return mask_from_alpha(255 - values if invert else values)


@dataclass(frozen=True)
class Capture:
    """The training frames of one object: the complete input of the method."""

    images: UInt8[Tensor, "t h w 3"]
    """Photos, sRGB code values over black."""
    masks: UInt8[Tensor, "t h w"]
    """OBJECT, UNKNOWN or BACKGROUND."""
    camera: Camera
    names: tuple[str, ...]
    """File names of the frames, unique."""
    light: Light
    """Frame in which the light is static: "camera" or "object"."""
    trajectory: Trajectory | None = None
    """Known object poses, one per frame; None if the poses are unknown."""
    focal_assumed: bool = False
    """Whether the focal length is only assumed; pose estimation then refines it."""
    full_images: UInt8[Tensor, "t h w 3"] | None = None
    """The photos with their background, sRGB code values; None if they were not kept."""

    def __post_init__(self) -> None:
        t, h, w, _ = self.images.shape
        assert self.masks.shape == (t, h, w), "there must be one mask per image, of the same size"
        assert (self.camera.height, self.camera.width) == (h, w), "camera and images must have the same size"
        assert self.full_images is None or self.full_images.shape == self.images.shape, "images must have one size"
        assert len(set(self.names)) == len(self.names) == t, "there must be one name per frame, all different"
        assert self.trajectory is None or len(self.trajectory) == t, "there must be one pose per frame"
        assert self.trajectory is None or self.trajectory.light == self.light, "light must match the trajectory's"

    def __len__(self) -> int:
        return len(self.names)

    def select(self, frames: list[int]) -> "Capture":
        """The capture reduced to the given frames, in the given order."""
        names = tuple(self.names[i] for i in frames)
        trajectory = self.trajectory.select(frames) if self.trajectory else None
        images, masks = self.images[frames], self.masks[frames]
        full_images = None if self.full_images is None else self.full_images[frames]
        return replace(self, images=images, masks=masks, names=names, trajectory=trajectory, full_images=full_images)

    def with_masks(self, masks: UInt8[Tensor, "t h w"]) -> "Capture":
        """The capture with other masks, and its images black where these have background."""
        shown = (masks != BACKGROUND)[..., None]
        return replace(self, masks=masks, images=torch.where(shown, self.images, torch.zeros_like(self.images)))

    def halved(self) -> "Capture":
        """The capture at half the resolution, without `full_images`: 2 x 2 pixels become their mean in linear light.

        Their mask is UNKNOWN unless they agree. An odd last row or column is left out.
        """
        h, w = self.camera.height // 2, self.camera.width // 2
        images, masks = self.images[:, : 2 * h, : 2 * w], self.masks[:, : 2 * h, : 2 * w]
        mean = resize_srgb8(images, h, w)
        masks = masks.unflatten(2, (w, 2)).unflatten(1, (h, 2))
        least, most = masks.amin((2, 4)), masks.amax((2, 4))
        mask = torch.where(least == most, least, torch.full_like(least, UNKNOWN))
        camera = self.camera.cropped(0, 0, 2 * h, 2 * w).resized(h, w)
        return replace(self, images=mean, masks=mask, camera=camera, full_images=None)


@dataclass(frozen=True)
class RelitViews:
    """Views of the object in other places than that of the capture, each with a light and a lens of its own."""

    radiance: Float[Tensor, "n h w 3"]
    """Photos, linear radiance in any unit, 0 outside the object; float32."""
    foreground: Bool[Tensor, "n h w"]
    """Pixels that show the object."""
    cameras: tuple[Camera, ...]
    T_cam_obj: SE3
    """Object poses, in the object frame of the capture."""
    lights: tuple[Environment, ...]
    """Light of each view, object frame."""

    def __len__(self) -> int:
        return len(self.cameras)


@dataclass(frozen=True)
class Truth:
    """Ground truth of a capture, for evaluation only. Everything except the evaluation views is optional."""

    images: UInt8[Tensor, "v h w 3"]
    """Photos of the evaluation views, sRGB code values over black."""
    masks: UInt8[Tensor, "v h w"]
    """Masks of the evaluation views."""
    names: tuple[str, ...]
    """File names of the evaluation views, in order."""
    regions: tuple[str, ...]
    """"shared" or "sphere", one per evaluation view."""
    trajectory: Trajectory | None = None
    """Object poses of the evaluation views; None if there are no views."""
    albedo: Float[Tensor, "v h w 3"] | None = None
    """Linear base colour, 0 outside the object."""
    roughness: Float[Tensor, "v h w"] | None = None
    """Perceptual roughness, 0 outside the object."""
    metalness: Float[Tensor, "v h w"] | None = None
    """Metalness, 0 outside the object; None if nothing is metal."""
    normals: Float[Tensor, "v h w 3"] | None = None
    """Unit shading normals, object frame, 0 outside the object."""
    depth: Float[Tensor, "v h w"] | None = None
    """z-depth in the camera frame [object radius], 0 outside the object."""
    relit: dict[str, UInt8[Tensor, "v h w 3"]] = field(default_factory=dict)
    """Evaluation views under other lights, sRGB code values over black, by name of the light."""
    light: Environment | None = None
    """Light of the capture, env frame of the capture."""
    lights: dict[str, Environment] = field(default_factory=dict)
    """Lights of `relit`, object frame."""
    poses: Trajectory | None = None
    """True poses of the training frames."""
    pose_names: tuple[str, ...] = ()
    """Names of the training frames that `poses` belong to, in order; empty if they belong to all training frames."""
    units: Units = "arbitrary"
    """Unit of the poses: metres, or unknown."""
    setting: str | None = None
    """Label for reports: "handheld", "turntable", "dome" or "turned"."""
    benchmark: Benchmark = ""
    """Benchmark by whose protocol the capture is scored, too."""
    alpha: UInt8[Tensor, "v h w"] | None = None
    """Fraction of each pixel that the object covers, times 255."""
    radiance: Float[Tensor, "v h w 3"] | None = None
    """Photos of the evaluation views in linear radiance, over black, if they were stored in more than 8 bits."""
    elsewhere: RelitViews | None = None
    """Views of the same object in other places."""

    def __len__(self) -> int:
        return len(self.names)

    def pose_indices(self, capture: Capture) -> dict[str, int]:
        """Index in `poses` of every training frame with a true pose, by frame name in the order of the capture."""
        if self.poses is None:
            return {}
        indices = {name: index for index, name in enumerate(self.pose_names or capture.names)}
        return {name: indices[name] for name in capture.names if name in indices}

    def views(self, region: str) -> list[int]:
        """Indices of the evaluation views of one region, in order."""
        return [i for i, r in enumerate(self.regions) if r == region]

    @property
    def foreground(self) -> Tensor:
        """Pixels whose mask is OBJECT, `bool[v h w]`."""
        return self.masks == OBJECT


def truth_without_views(camera: Camera) -> Truth:
    """Ground truth without evaluation views, to which light and poses can be added."""
    shape = (0, camera.height, camera.width)
    return Truth(torch.zeros(*shape, 3, dtype=torch.uint8), torch.zeros(shape, dtype=torch.uint8), (), ())


def content_key(capture: Capture) -> str:
    """SHA-256 of everything in a capture: images, masks, camera, poses, frame names, light and `focal_assumed`."""
    digest = hashlib.sha256()
    facts = {"names": capture.names, "light": capture.light, "size": (capture.camera.height, capture.camera.width)}
    facts |= {"focal": "guess"} if capture.focal_assumed else {}
    digest.update(json.dumps(facts, sort_keys=True).encode())
    for name, x in tree.named_tensors(capture).items():
        digest.update(f"{name} {x.dtype} {tuple(x.shape)}".encode())
        digest.update(x.detach().cpu().contiguous().numpy().data)
    return digest.hexdigest()


@dataclass(frozen=True)
class TargetView:
    """One training image in the form that losses compare a rendered image with."""

    image: Float[Tensor, "h w 3"]
    """sRGB in [0, 1]."""
    mask: Float[Tensor, "h w"]
    """1 at OBJECT pixels, else 0."""
    valid: Float[Tensor, "h w 1"]
    """0 at UNKNOWN pixels, else 1."""


def target_view(capture: Capture, number: int, like: Tensor) -> TargetView:
    """Training image `number` of a capture, with the dtype and device of `like`."""
    mask = capture.masks[number].to(like.device)
    image = capture.images[number].to(like) / 255
    return TargetView(image, (mask == OBJECT).to(like), (mask != UNKNOWN).to(like)[..., None])
