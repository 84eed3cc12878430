"""Writer of capture folders (docs/format.md): the entries of transforms.json, and whole captures.

A frame `0007.png` has its image in `images/`, with its background in `full_images/`, its mask in `masks/`, and its
ground truth in `truth/albedo/0007.exr`, ..., `truth/relit/<light>/0007.png`. `transforms.json` is written last, so a
folder without it is an incomplete capture.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from tumble.io import BadFile, files
from tumble.scene import Camera, Capture, Truth, Units

MAPS = ("albedo", "roughness", "metalness", "normal", "depth")
"""Ground-truth maps of an evaluation view; a map is a folder of truth/ and the key `<map>_path` of a frame."""


def capture_document(
    camera: Camera,
    light: str,
    frames: list[dict[str, Any]],
    *,
    setting: str | None,
    with_light: bool,
    units: Units = "arbitrary",
) -> dict[str, Any]:
    """Content of a transforms.json.

    Args:
        light: What the light is fixed to, "camera" or "object".
        frames: Entries from `training_frame` and `evaluation_frame`.
        setting: Label of the capture setting; None writes none.
        with_light: Whether there is a truth/light.hdr.
        units: Unit of the poses.
    """
    fx, fy, cx, cy = camera.fx_fy_cx_cy.tolist()
    intrinsics = {"w": camera.width, "h": camera.height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    label = {} if setting is None else {"setting": setting}
    light_path = {"light_path": "truth/light.hdr"} if with_light else {}
    head = {"camera_model": "OPENCV", **intrinsics, "light": light, **label, **light_path, "units": units}
    return head | {"frames": frames}


def training_frame(
    name: str, matrix: list[list[float]] | None, light_turn: list[list[float]] | None = None, *, full: bool = False
) -> dict[str, Any]:
    """Entry of a training frame.

    Args:
        matrix: Camera to object with OpenGL camera axes; None if unknown.
        light_turn: Rotation of the light in this frame; None if the light does not turn by itself.
        full: Whether the photo with its background is in full_images/.
    """
    entry: dict[str, Any] = {"file_path": f"images/{name}", "mask_path": f"masks/{name}", "split": "train"}
    entry |= {"full_image_path": f"full_images/{name}"} if full else {}
    entry |= {} if light_turn is None else {"light_turn": light_turn}
    return entry if matrix is None else entry | {"transform_matrix": matrix}


def evaluation_frame(
    name: str, matrix: list[list[float]], region: str, *, maps: Iterable[str], lights: Iterable[str]
) -> dict[str, Any]:
    """Entry of an evaluation view with ground-truth maps and with images relit by some lights."""
    entry = training_frame(name, matrix) | {"split": "eval", "region": region}
    entry |= {f"{kind}_path": f"truth/{kind}/{Path(name).stem}.exr" for kind in maps}
    return entry | {"relit": {light: f"truth/relit/{light}/{name}" for light in lights}}


def save_capture(path: Path, capture: Capture, truth: Truth | None = None, *, setting: str | None = None) -> None:
    """Write a capture, and optionally its ground truth, as a new folder.

    Raises:
        BadFile: `path` exists and is not an empty folder, or the frames have no files or poses of their own.
    """
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise BadFile(path, "exists already", "choose a new folder")
    _require_storable(path, capture, truth)
    for name, image, mask in zip(capture.names, capture.images, capture.masks, strict=True):
        _save_image_and_mask(path, name, image, mask)
    if capture.full_images is not None:
        for name, image in zip(capture.names, capture.full_images, strict=True):
            files.write_png(path / "full_images" / name, image.cpu().numpy())
    matrices = [None] * len(capture) if capture.trajectory is None else capture.trajectory.camera_to_object().tolist()
    turns = None if capture.trajectory is None else capture.trajectory.light_turns
    frames = [
        training_frame(name, matrix, None if turns is None else turns[i].tolist(), full=capture.full_images is not None)
        for i, (name, matrix) in enumerate(zip(capture.names, matrices, strict=True))
    ]
    if truth is not None:
        frames += _save_truth(path, capture, truth)
    with_light = truth is not None and truth.light is not None
    fields = capture_document(
        capture.camera,
        capture.light,
        frames,
        setting=setting,
        with_light=with_light,
        units="arbitrary" if truth is None else truth.units,
    )
    files.write_json(path / "transforms.json", fields | ({"focal_source": "guess"} if capture.focal_assumed else {}))


def _require_storable(path: Path, capture: Capture, truth: Truth | None) -> None:
    """Check that all frames have different names, and that there are true poses of all training frames or of none."""
    names = [*capture.names, *(() if truth is None else truth.names)]
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        raise BadFile(path, f"would have several frames {repeated[0]}", "training and evaluation frames need own names")
    if truth is None or truth.poses is None:
        return
    posed = truth.pose_names or capture.names
    if len(posed) != len(truth.poses):
        raise BadFile(path, f"would have {len(truth.poses)} true poses for {len(posed)} frames", "give pose_names")
    if missing := [name for name in capture.names if name not in posed]:
        rule = f"would have no true pose of the frame {missing[0]}, but of others"
        raise BadFile(path, rule, "select the frames that have one, or leave out the true poses")


def _save_image_and_mask(path: Path, name: str, image: Tensor, mask: Tensor) -> None:
    files.write_png(path / "images" / name, image.cpu().numpy())
    files.write_png(path / "masks" / name, mask.cpu().numpy()[..., None])


def _save_truth(path: Path, capture: Capture, truth: Truth) -> list[dict[str, Any]]:
    if truth.light is not None:
        truth.light.write(path / "truth" / "light.hdr")
    for light, environment in truth.lights.items():
        environment.write(path / "truth" / "lights" / f"{light}.hdr")
    if truth.poses is not None:
        poses = dict(zip(truth.pose_names or capture.names, truth.poses.camera_to_object().tolist(), strict=True))
        files.write_json(path / "truth" / "poses.json", poses)
    if truth.trajectory is None:
        return []
    materials = {"albedo": truth.albedo, "roughness": truth.roughness, "metalness": truth.metalness}
    values = materials | {"normal": truth.normals, "depth": truth.depth}
    maps = {kind: images.cpu().numpy() for kind, images in values.items() if images is not None}
    frames = []
    for i, (name, matrix) in enumerate(zip(truth.names, truth.trajectory.camera_to_object().tolist(), strict=True)):
        _save_image_and_mask(path, name, truth.images[i], truth.masks[i])
        for kind, images in maps.items():
            pixels = images[i] if images[i].ndim == 3 else images[i][..., np.newaxis]
            files.write_exr(path / "truth" / kind / f"{Path(name).stem}.exr", pixels)
        for light, relit in truth.relit.items():
            files.write_png(path / "truth" / "relit" / light / name, relit[i].cpu().numpy())
        frames.append(evaluation_frame(name, matrix, truth.regions[i], maps=maps, lights=truth.relit))
    return frames
