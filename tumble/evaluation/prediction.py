"""Prediction folder: a method's result for a capture, the input of `tumble evaluate` (docs/prediction.md).

A *view* is an evaluation view of the capture, in the order of its transforms.json. Files are numbered by view: the
fourth view's albedo is albedo/0003.exr. Every part is optional. Maps have the capture's size and are 0 off the object.
"""

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from tumble.datasets import read_poses
from tumble.io import BadFile, files
from tumble.scene import Capture, Environment, RelitViews, Trajectory, Truth

PARTS = ("albedo", "normal", "roughness", "metalness", "mask", "image", "relit", "elsewhere", "light.exr", "poses.json")
"""Files and folders of a prediction; any others in the folder are ignored."""


@dataclass(frozen=True)
class Prediction:
    """One method's result for one capture; absent parts are None or empty."""

    albedo: Float[Tensor, "v h w 3"] | None = None
    """Linear base colour as estimated, not multiplied by the albedo scale of the evaluation."""
    normals: Float[Tensor, "v h w 3"] | None = None
    """Shading normals, true object frame."""
    roughness: Float[Tensor, "v h w"] | None = None
    """Perceptual roughness."""
    metalness: Float[Tensor, "v h w"] | None = None
    """Metalness."""
    masks: Bool[Tensor, "v h w"] | None = None
    """Silhouettes; if None, the pixels whose albedo is not black."""
    images: UInt8[Tensor, "v h w 3"] | None = None
    """The views under the capture's own light, sRGB code values over black."""
    relit: dict[str, UInt8[Tensor, "v h w 3"]] = field(default_factory=dict)
    """The views under other lights, rendered with the scaled albedo, by the light's name; sRGB code values over
    black."""
    light: Environment | None = None
    """Light of the capture, env frame of the capture, not divided by the albedo scale."""
    poses: Trajectory | None = None
    """Estimated poses of training frames, in any object frame and unit."""
    pose_names: tuple[str, ...] = ()
    """Names of the training frames that `poses` belong to, in the capture's order."""
    elsewhere: Float[Tensor, "n i j 3"] | None = None
    """Views in other places (`RelitViews`), linear radiance over black, rendered with the albedo as estimated."""

    def __post_init__(self) -> None:
        maps = [self.albedo, self.normals, self.roughness, self.metalness, self.masks]
        views = [*maps, self.images, *self.relit.values()]
        shapes = {tuple(view.shape[:3]) for view in views if view is not None}
        assert len(shapes) <= 1, f"all parts need the same number and size of views, not {shapes}"
        assert len(self.pose_names) == (0 if self.poses is None else len(self.poses)), "one name per pose"

    @property
    def silhouettes(self) -> Bool[Tensor, "v h w"] | None:
        """Predicted silhouettes, from `masks` or else from the albedo; None without both."""
        if self.masks is not None or self.albedo is None:
            return self.masks
        return (self.albedo > 0).any(-1)

    def write(self, path: Path) -> None:
        """Write the prediction as a folder, replacing all parts of an earlier prediction there.

        All parts are written to a temporary folder first, so that no part is ever incomplete. Other files stay.
        """
        with files.partial_folder(path) as partial:
            _write_parts(self, partial)
            for part in PARTS:
                old, new = path / part, partial / part
                shutil.rmtree(old) if old.is_dir() else old.unlink(missing_ok=True)
                if new.exists():
                    new.rename(old)

    @staticmethod
    def read(path: Path, capture: Capture, truth: Truth) -> "Prediction":
        """Read a prediction folder for a capture and its evaluation views.

        Raises:
            BadFile: The folder breaks a rule of docs/prediction.md.
        """
        if not path.is_dir():
            raise BadFile(path, "is not a folder", "a prediction is a folder, see docs/prediction.md")
        if not any((path / part).exists() for part in PARTS):
            raise BadFile(path, f"holds no part of a prediction, none of: {', '.join(PARTS)}")
        views = _ViewReader(len(truth), capture.camera.height, capture.camera.width)
        roughness, metalness = (views.read(path / x, ".exr", _read_fraction) for x in ("roughness", "metalness"))
        masks = views.read(path / "mask", ".png", _read_mask)
        names, poses = _read_poses(path / "poses.json", capture)
        relit = sorted(p for p in (path / "relit").iterdir() if p.is_dir()) if (path / "relit").is_dir() else []
        return Prediction(
            albedo=views.read(path / "albedo", ".exr", _read_positive),
            normals=views.read(path / "normal", ".exr", _read_normal),
            roughness=None if roughness is None else roughness[..., 0],
            metalness=None if metalness is None else metalness[..., 0],
            masks=None if masks is None else masks[..., 0] >= 128,
            images=views.read(path / "image", ".png", _read_image),
            relit={
                light.name: pixels for light in relit if (pixels := views.read(light, ".png", _read_image)) is not None
            },
            light=Environment.read(path / "light.exr") if (path / "light.exr").exists() else None,
            poses=poses,
            pose_names=names,
            elsewhere=_read_elsewhere(path / "elsewhere", truth.elsewhere),
        )


# Writing --------------------------------------------------------------------------------------------------------------


def _write_parts(prediction: Prediction, root: Path) -> None:
    for path, pixels in _view_files(prediction):
        write = files.write_png if path.suffix == ".png" else files.write_exr
        write(root / path, pixels)
    if prediction.light is not None:
        prediction.light.write(root / "light.exr")
    if prediction.poses is not None:
        matrices = prediction.poses.camera_to_object().detach().cpu().tolist()
        files.write_json(root / "poses.json", dict(zip(prediction.pose_names, matrices, strict=True)))


def _view_files(prediction: Prediction) -> Iterator[tuple[Path, np.ndarray]]:
    """Relative path and pixels of every view of every part."""
    masks, roughness, metalness = prediction.masks, prediction.roughness, prediction.metalness
    parts = {
        ("albedo", "exr"): prediction.albedo,
        ("normal", "exr"): prediction.normals,
        ("roughness", "exr"): None if roughness is None else roughness[..., None],
        ("metalness", "exr"): None if metalness is None else metalness[..., None],
        ("mask", "png"): None if masks is None else 255 * masks[..., None].to(torch.uint8),
        ("image", "png"): prediction.images,
        ("elsewhere", "exr"): prediction.elsewhere,
        **{(f"relit/{light}", "png"): pixels for light, pixels in prediction.relit.items()},
    }
    for (folder, suffix), views in parts.items():
        for i, pixels in enumerate([] if views is None else views.detach().cpu().numpy()):
            yield Path(folder) / f"{i:04}.{suffix}", pixels


# Reading --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _ViewReader:
    """Reads the views of one part and checks their number and size [pixels]."""

    count: int
    height: int
    width: int

    def read(self, folder: Path, ending: str, read: Callable[[Path], np.ndarray]) -> Tensor | None:
        """All views of a part, `[v h w c]`; None if the folder is missing."""
        if not folder.exists():
            return None
        expected = [folder / f"{i:04}{ending}" for i in range(self.count)]
        if surplus := sorted(set(folder.glob(f"*{ending}")) - set(expected)):
            problem = f"is not one of the {self.count} evaluation views"
            raise BadFile(surplus[0], problem, f"files are numbered from 0000{ending} in the capture's order")
        if not expected:
            return None
        return torch.from_numpy(np.stack([self._check_size(path, read(path)) for path in expected]))

    def _check_size(self, path: Path, pixels: np.ndarray) -> np.ndarray:
        if pixels.shape[:2] != (self.height, self.width):
            size = f"{pixels.shape[1]} x {pixels.shape[0]}"
            raise BadFile(path, f"is {size} pixels, the capture is {self.width} x {self.height}")
        return pixels


def _read_elsewhere(folder: Path, views: RelitViews | None) -> Tensor | None:
    """The views in other places; None if the prediction or the truth has none."""
    if views is None:
        return None
    return _ViewReader(len(views), *views.foreground.shape[1:]).read(folder, ".exr", _read_positive)


def _check_channels(path: Path, pixels: np.ndarray, expected: int) -> np.ndarray:
    if pixels.shape[2] != expected:
        raise BadFile(path, f"has {pixels.shape[2]} channels, {path.parent.name} needs {expected}")
    return pixels


def _read_positive(path: Path) -> np.ndarray:
    pixels = _check_channels(path, files.read_radiance(path), 3)
    if pixels.min() < 0:
        what = "radiance" if path.parent.name == "elsewhere" else "albedo"
        rule = f"holds a negative {what}, {pixels.min():.3g}"
        raise BadFile(path, rule, f"linear {what} must not be negative: clamp it at 0")
    return pixels


def _read_normal(path: Path) -> np.ndarray:
    return _check_channels(path, files.read_radiance(path), 3)


def _read_fraction(path: Path) -> np.ndarray:
    """A map of roughness or metalness."""
    pixels = _check_channels(path, files.read_radiance(path), 1)
    # Rounding in the blending may exceed 1 by a few units in the last place.
    if pixels.min() < 0 or pixels.max() > 1.001:
        found = f"holds {path.parent.name} from {pixels.min():.3g} to {pixels.max():.3g}"
        raise BadFile(path, found, "it must lie in [0, 1]")
    return pixels


def _read_mask(path: Path) -> np.ndarray:
    return _check_channels(path, files.read_image(path), 1)


def _read_image(path: Path) -> np.ndarray:
    return _check_channels(path, files.read_image(path), 3)


def _read_poses(path: Path, capture: Capture) -> tuple[tuple[str, ...], Trajectory | None]:
    if not path.exists():
        return (), None
    document = files.read_json(path, dict[str, Any])
    if not document:
        raise BadFile(path, 'is not of the form {"0000.png": 4 x 4 matrix, ...}')
    if unknown := sorted(set(document) - set(capture.names)):
        raise BadFile(path, f"has a pose for {unknown[0]}, which is not a training frame of the capture")
    names = tuple(name for name in capture.names if name in document)
    return names, Trajectory.from_camera_to_object(read_poses(path, names), capture.light)
