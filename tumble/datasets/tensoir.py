"""Reader of scenes of TensoIR-Synthetic (Jin et al. 2023): 100 training and 200 test views of a static object.

    DATASET/SCENE/train_000/metadata.json         {"cam_angle_x": radians, "cam_transform_mat": "16 numbers"}
                            rgba_sunset.png       photo, sRGB with alpha
                  test_000/ metadata.json, rgba_sunset.png
                            rgba_bridge.png ...   photos under other lights
                            albedo.png            linear (not sRGB) base colour with alpha
                            normal.png            (normal + 1) / 2 in the world frame, with alpha
    DATASET/../Environment_Maps/high_res_envmaps_1k/bridge.hdr ...    maps of the lights, if there are any

Poses are camera to world with OpenGL camera axes, +z up; the reader changes to the object frame of `_blender`. The
poses are given, and the light is fixed to the object. Of the test views `MAX_VIEWS` are read.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import msgspec
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from tumble.datasets import _blender
from tumble.datasets._lens import FrameLens
from tumble.datasets.folder import composite_over_black, rigid_matrices
from tumble.io import BadFile, files, limits
from tumble.scene import Capture, Environment, Truth, mask_from_alpha, truth_without_views

METADATA = "metadata.json"
"""File of the camera in the folder of a view."""
LIGHT = "sunset"
"""Light of the training views."""
TEST_LIGHTS = ("bridge", "city", "fireplace", "forest", "night")
"""Lights of the published scores. A scene that has none of them is scored under all lights that it has a map of."""
MAPS_FOLDER = Path("Environment_Maps") / "high_res_envmaps_1k"
"""Folder of the maps of the lights, beside that of the scenes."""
MAX_VIEWS = 20
"""Number of test views that are read, evenly spaced: those from which TensoIR computes the scale of the albedo. All 200
would take 30 GB when they are rendered."""
LAYOUT = f"SCENE/train_000/{METADATA} and SCENE/train_000/rgba_{LIGHT}.png of TensoIR-Synthetic"


class _Metadata(msgspec.Struct, frozen=True):
    """Content of a metadata.json."""

    cam_angle_x: float
    cam_transform_mat: str


@dataclass(frozen=True)
class _Views:
    """The views of a split."""

    root: Path
    folders: tuple[Path, ...]

    @cached_property
    def metadata(self) -> list[_Metadata]:
        return [files.read_json(self.file(i, METADATA), _Metadata) for i in range(len(self.folders))]

    @cached_property
    def lens(self) -> FrameLens:
        """Lens of the views, which is the same for all."""
        path = self.file(0, METADATA)
        angle = self.metadata[0].cam_angle_x
        if any(abs(other.cam_angle_x - angle) > 1e-6 * angle for other in self.metadata):
            raise BadFile(path, "has a field of view that other views do not have", "all must have one camera")
        return _blender.lens_of(path, angle, *files.image_size(self.file(0, f"rgba_{LIGHT}.png")))

    @cached_property
    def T_world_cam(self) -> Float[Tensor, "t 4 4"]:
        """Poses, camera to world, OpenGL camera axes [unit of the scene]."""
        matrices = [_matrix(self.file(i, METADATA), each) for i, each in enumerate(self.metadata)]
        return torch.cat(matrices)

    def file(self, i: int, name: str) -> Path:
        """A file of view `i`."""
        return files.path_inside(self.root, f"{self.folders[i].name}/{name}")

    def rgba(self, name: str) -> UInt8[np.ndarray, "t h w 4"]:
        """An image of all views.

        Raises:
            BadFile: One is missing, has no alpha channel, or has another size.
        """
        shape = (len(self.folders), self.lens.height, self.lens.width, 4)
        limits.require_bytes(self.root, math.prod(shape), f"{shape[0]} images", limits.MAX_CAPTURE_BYTES)
        images = np.empty(shape, np.uint8)
        for i in range(len(self.folders)):
            path = self.file(i, f"{name}.png")
            pixels = files.read_image(path)
            if pixels.shape != shape[1:]:
                found, wanted = (" x ".join(map(str, size)) for size in (pixels.shape, shape[1:]))
                raise BadFile(path, f"has the shape {found} instead of {wanted}", "height, width, and RGB with alpha")
            images[i] = pixels
        return images


def recognises(path: Path) -> bool:
    """Whether a path is a scene of TensoIR-Synthetic."""
    return (path / "train_000" / METADATA).is_file()


def load(path: Path | str) -> Capture:
    """The training views of a scene, with their poses.

    Raises:
        BadFile: A file is missing or broken.
    """
    views = _split(Path(path), "train")
    rgba = views.rgba(f"rgba_{LIGHT}")
    masks = mask_from_alpha(rgba[..., 3])
    frame = _blender.object_frame(Path(path), masks, views.lens, views.T_world_cam)
    trajectory = frame.trajectory(views.T_world_cam)
    names = tuple(f"{folder.name}.png" for folder in views.folders)
    return Capture(_over_black(rgba), torch.from_numpy(masks), views.lens.camera, names, "object", trajectory)


def load_truth(path: Path | str) -> Truth | None:
    """The test views of a scene, with albedo, normals and other lights; without test views, only light and poses.

    Raises:
        BadFile: A file is missing or broken.
    """
    root = Path(path)
    train = _split(root, "train")
    masks = mask_from_alpha(train.rgba(f"rgba_{LIGHT}")[..., 3])
    frame = _blender.object_frame(root, masks, train.lens, train.T_world_cam)
    light = _light_map(root, LIGHT)
    truth = replace(
        truth_without_views(train.lens.camera),
        light=None if light is None else Environment.read(light),
        poses=frame.trajectory(train.T_world_cam),
        setting="dome",
        benchmark="tensoir",
    )
    views = _split(root, "test")
    if not views.folders:
        return truth
    if views.lens != train.lens:
        raise BadFile(views.file(0, METADATA), "has another camera than the training views")
    rgba = views.rgba(f"rgba_{LIGHT}")
    lights = _lights(views)
    return replace(
        truth,
        images=_over_black(rgba),
        masks=torch.from_numpy(mask_from_alpha(rgba[..., 3])),
        alpha=torch.from_numpy(rgba[..., 3].copy()),
        names=tuple(f"{folder.name}.png" for folder in views.folders),
        regions=("shared",) * len(views.folders),
        trajectory=frame.trajectory(views.T_world_cam),
        albedo=_albedo(views),
        normals=_normals(views),
        relit={name: _over_black(views.rgba(f"rgba_{name}")) for name in lights},
        lights={name: Environment.read(map_) for name in lights if (map_ := _light_map(root, name)) is not None},
    )


def _split(root: Path, name: str) -> _Views:
    """The training views, or `MAX_VIEWS` evenly spaced ones of the test views."""
    if not recognises(root):
        raise BadFile(root, "is not a scene of TensoIR-Synthetic", f"expected {LAYOUT}")
    folders = sorted(path for path in root.glob(f"{name}_[0-9]*") if path.is_dir())
    n = len(folders) if name == "train" else min(len(folders), MAX_VIEWS)
    return _Views(root, tuple(folders[i * len(folders) // n] for i in range(n)))


def _matrix(path: Path, metadata: _Metadata) -> Float[Tensor, "1 4 4"]:
    try:
        values = np.array([float(word) for word in metadata.cam_transform_mat.split(",")]).reshape(4, 4)
    except ValueError:
        rule = f'"cam_transform_mat" is {metadata.cam_transform_mat[:40]!r}'
        raise BadFile(path, rule, "it must be 16 numbers, separated by commas") from None
    return rigid_matrices(path, [(path.parent.name, values)])


# Images ---------------------------------------------------------------------------------------------------------------


def _over_black(rgba: UInt8[np.ndarray, "t h w 4"]) -> UInt8[Tensor, "t h w 3"]:
    return torch.from_numpy(np.stack([composite_over_black(pixels) for pixels in rgba]))


def _albedo(views: _Views) -> Float[Tensor, "t h w 3"] | None:
    """Linear base colour, 0 outside the object; None if the first view has none."""
    if not views.file(0, "albedo.png").exists():
        return None
    rgba = torch.from_numpy(views.rgba("albedo"))
    return rgba[..., :3].float() / 255 * (rgba[..., 3:] > 0)


def _normals(views: _Views) -> Float[Tensor, "t h w 3"] | None:
    """Unit normals in the object frame, 0 outside the object; None if the first view has none."""
    if not views.file(0, "normal.png").exists():
        return None
    rgba = torch.from_numpy(views.rgba("normal"))
    n_world = rgba[..., :3].float() / 255 * 2 - 1
    return normalize(n_world @ n_world.new_tensor(_blender.R_OBJ_WORLD).T, dim=-1) * (rgba[..., 3:] > 0)


def _lights(views: _Views) -> list[str]:
    """Names of the lights of the relit test views."""
    found = sorted(path.stem.removeprefix("rgba_") for path in views.folders[0].glob("rgba_*.png"))
    published = [name for name in TEST_LIGHTS if name in found]
    return published or [name for name in found if name != LIGHT and _light_map(views.root, name) is not None]


def _light_map(root: Path, name: str) -> Path | None:
    """File of a light's map; None if there is none."""
    data = root.resolve().parent.parent
    path = files.path_inside(data, str(MAPS_FOLDER / f"{name}.hdr"))
    return path if path.is_file() else None
