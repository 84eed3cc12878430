"""What was filmed, and, for benchmarks, what is true about it.

A *mask* has three values: `OBJECT`, `BACKGROUND`, and `UNKNOWN` (a hand, an uncertain border), which no loss and no
metric counts. *Evaluation views* are never trained on; their *region* is "shared" where every capture setting has seen
what they show, else "sphere" (format.md).
"""

import hashlib
import json
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from tumble.io import tree
from tumble.scene.camera import Camera
from tumble.scene.environment import Environment
from tumble.scene.trajectory import Light, Trajectory

OBJECT, UNKNOWN, BACKGROUND = 255, 128, 0
REGIONS = ("shared", "sphere")
Units = Literal["m", "arbitrary"]
UNITS: tuple[str, ...] = get_args(Units)


def mask_from_alpha(alpha: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """Opaque pixels are the object, clear ones background, what lies between is unknown."""
    return np.select([alpha >= 250, alpha <= 5], [OBJECT, BACKGROUND], UNKNOWN).astype(np.uint8)


def decoded_mask(values: UInt8[np.ndarray, "h w"], *, invert: bool = False) -> UInt8[np.ndarray, "h w"]:
    """A mask picture's code values as OBJECT, UNKNOWN and BACKGROUND; a picture of only 0 and 1 counts as 0 and 255.

    Args:
        invert: The object is black.
    """
    if values.max(initial=0) == 1:
        values = values * np.uint8(OBJECT)
    return mask_from_alpha(255 - values if invert else values)


@dataclass(frozen=True)
class Capture:
    """The training frames of one object: all that the method may see."""

    images: UInt8[Tensor, "t h w 3"]
    """Photographs, sRGB code values over black."""
    masks: UInt8[Tensor, "t h w"]
    """OBJECT, UNKNOWN or BACKGROUND."""
    camera: Camera
    names: tuple[str, ...]
    """File names of the frames, unique."""
    light: Light
    """What the light stands still with."""
    trajectory: Trajectory | None = None
    """Object poses where they are known, one per frame."""
    focal_guessed: bool = False
    """Whether nobody stated the camera's focal length: estimated poses bring a better one."""

    def __post_init__(self) -> None:
        t, h, w, _ = self.images.shape
        assert self.masks.shape == (t, h, w), "one mask per image, of its size"
        assert (self.camera.height, self.camera.width) == (h, w), "the camera has the images' size"
        assert len(set(self.names)) == len(self.names) == t, "one name per frame, all different"
        assert self.trajectory is None or len(self.trajectory) == t, "one pose per frame"
        assert self.trajectory is None or self.trajectory.light == self.light, "one light"

    def __len__(self) -> int:
        return len(self.names)

    def select(self, frames: list[int]) -> "Capture":
        """Some of the frames, in the order given."""
        names = tuple(self.names[i] for i in frames)
        trajectory = self.trajectory.select(frames) if self.trajectory else None
        images, masks = self.images[frames], self.masks[frames]
        return replace(self, images=images, masks=masks, names=names, trajectory=trajectory)


@dataclass(frozen=True)
class Truth:
    """What is known about a capture and must not be trained on. Every part but the views is optional."""

    images: UInt8[Tensor, "v h w 3"]
    """Photographs of the evaluation views, sRGB code values over black."""
    masks: UInt8[Tensor, "v h w"]
    """Of the evaluation views."""
    names: tuple[str, ...]
    """File names of the evaluation views, in order."""
    regions: tuple[str, ...]
    """"shared" or "sphere", one per evaluation view."""
    trajectory: Trajectory | None = None
    """Object poses of the evaluation views; None when there are no such views."""
    albedo: Float[Tensor, "v h w 3"] | None = None
    """Linear base colour, 0 outside the object."""
    roughness: Float[Tensor, "v h w"] | None = None
    """Perceptual roughness, 0 outside the object."""
    normals: Float[Tensor, "v h w 3"] | None = None
    """Unit shading normals, object frame, 0 outside the object."""
    depth: Float[Tensor, "v h w"] | None = None
    """z-depth in the camera frame [object radius], 0 outside the object."""
    relit: dict[str, UInt8[Tensor, "v h w 3"]] = field(default_factory=dict)
    """The evaluation views under other lights, sRGB code values over black, by the light's name."""
    light: Environment | None = None
    """The light of the capture, env frame of the capture."""
    lights: dict[str, Environment] = field(default_factory=dict)
    """The lights of `relit`, object frame."""
    poses: Trajectory | None = None
    """True poses of the training frames."""
    pose_names: tuple[str, ...] = ()
    """Names of the training frames that `poses` belong to, in order; empty: of all."""
    units: Units = "arbitrary"
    """Of the poses: metres, or nobody knows."""
    setting: str | None = None
    """A label for reports: "handheld", "turntable", "dome"."""

    def __len__(self) -> int:
        return len(self.names)

    def posed(self, capture: Capture) -> dict[str, int]:
        """The training frames of its capture that have a true pose, in order, with their place in `poses`."""
        if self.poses is None:
            return {}
        places = {name: place for place, name in enumerate(self.pose_names or capture.names)}
        return {name: places[name] for name in capture.names if name in places}

    def views(self, region: str) -> list[int]:
        """Indices of the evaluation views of one region, in order."""
        return [i for i, r in enumerate(self.regions) if r == region]

    @property
    def foreground(self) -> Tensor:
        """Pixels that surely show the object, `bool[v h w]`."""
        return self.masks == OBJECT


def no_views(camera: Camera) -> Truth:
    """A truth without evaluation views, to hang light and poses on."""
    shape = (0, camera.height, camera.width)
    return Truth(torch.zeros(*shape, 3, dtype=torch.uint8), torch.zeros(shape, dtype=torch.uint8), (), ())


def content_key(capture: Capture) -> str:
    """A hash of what a capture shows: images, masks, camera, poses, names of the frames, and who carries the light; and
    of whether its focal length is a guess."""
    digest = hashlib.sha256()
    facts = {"names": capture.names, "light": capture.light, "size": (capture.camera.height, capture.camera.width)}
    facts |= {"focal": "guess"} if capture.focal_guessed else {}
    digest.update(json.dumps(facts, sort_keys=True).encode())
    for name, x in tree.named_tensors(capture).items():
        digest.update(f"{name} {x.dtype} {tuple(x.shape)}".encode())
        digest.update(x.detach().cpu().contiguous().numpy().data)
    return digest.hexdigest()


@dataclass(frozen=True)
class TargetView:
    """One photograph as losses compare with it."""

    image: Float[Tensor, "h w 3"]
    """sRGB in [0, 1]."""
    mask: Float[Tensor, "h w"]
    """1 where the pixel surely shows the object."""
    valid: Float[Tensor, "h w 1"]
    """0 where nobody knows what the pixel shows."""


def target_view(capture: Capture, number: int, like: Tensor) -> TargetView:
    """Photograph `number` of a capture in the dtype and on the device of `like`."""
    mask = capture.masks[number].to(like.device)
    image = capture.images[number].to(like) / 255
    return TargetView(image, (mask == OBJECT).to(like), (mask != UNKNOWN).to(like)[..., None])
