"""Datasets of a sphere in the layouts of TensoIR-Synthetic and Stanford-ORB, painted by the formulas of their tools.

The sphere is off the origin of Blender's world (+z up) and has a radius of 1.3. A photo is the albedo times the light
that arrives along the surface normal, so that a single pixel tells where a map of the light is right.
"""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from tumble.io import files

SIZE = 48
CENTRE, RADIUS = np.array([0.3, -0.2, 0.5]), 1.3
ANGLE = 0.7
"""Horizontal field of view [radians]."""
LAMPS = {"sunset": (1.0, 0.2, 0.3), "bridge": (-0.3, 1.0, 0.4), "city": (0.1, -0.4, 1.0)}
"""Direction of the lamp of each light in Blender's world."""
Matrix = np.ndarray


def light(name: str, d_world: np.ndarray) -> np.ndarray:
    """Radiance of a light from directions in Blender's world."""
    lamp = np.array(LAMPS[name]) / np.linalg.norm(LAMPS[name])
    return 0.1 + 0.8 * np.exp(2 * (d_world @ lamp - 1))[..., None] * np.array([1.0, 0.8, 0.6])


def albedo(n_world: np.ndarray) -> np.ndarray:
    """Linear base colour at the point with a normal."""
    return 0.5 + 0.3 * np.sin(2 * n_world + np.array([0.0, 1.0, 2.0]))


def camera_matrix(azimuth: float, elevation: float, distance: float = 5.0) -> Matrix:
    """Camera to Blender's world, OpenGL camera axes, for a camera that looks at a point beside the sphere's centre."""
    back = np.array([math.cos(azimuth) * math.cos(elevation), math.sin(azimuth) * math.cos(elevation), 0])
    back[2] = math.sin(elevation)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(back, right), back], -1)
    matrix[:3, 3] = CENTRE + 0.1 * right + distance * back
    return matrix


def normals(matrix: Matrix, angle: float = ANGLE) -> tuple[np.ndarray, np.ndarray]:
    """Normals of the sphere in Blender's world, `[h w 3]`, and which pixels show it."""
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    focal = 0.5 * SIZE / math.tan(0.5 * angle)
    d = np.stack([(columns - SIZE / 2) / focal, -(rows - SIZE / 2) / focal, -np.ones_like(rows)], -1)
    d = d / np.linalg.norm(d, axis=-1, keepdims=True) @ matrix[:3, :3].T
    offset = CENTRE - matrix[:3, 3]
    along = d @ offset
    inside = along**2 - offset @ offset + RADIUS**2
    hit = (along - np.sqrt(np.maximum(inside, 0)))[..., None] * d
    return (hit - offset) / RADIUS, inside > 0


def views(n: int, shift: float) -> list[Matrix]:
    """Cameras around the upper half of the sphere."""
    return [camera_matrix(2.4 * (i + shift), 0.1 + 1.1 * ((0.6 * (i + shift)) % 1)) for i in range(n)]


def srgb(linear: np.ndarray) -> np.ndarray:
    """Code values of linear colours."""
    x = np.clip(linear, 0, 1)
    return np.round(255 * np.where(x > 0.0031308, 1.055 * x ** (1 / 2.4) - 0.055, 12.92 * x)).astype(np.uint8)


def save(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def _rgba(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    return np.concatenate([values * mask[..., None], 255 * mask[..., None]], -1).astype(np.uint8)


def write_tensoir(root: Path, *, n_train: int = 8, n_test: int = 3) -> Path:
    """A scene with one light for training and two for the test views; two maps of 32 x 64 texels."""
    scene = root / "TensoIR_Synthetic" / "ball"
    for split, matrices in (("train", views(n_train, 0.0)), ("test", views(n_test, 0.5))):
        for i, matrix in enumerate(matrices):
            folder = scene / f"{split}_{i:03}"
            n_world, mask = normals(matrix)
            photo = {name: albedo(n_world) * light(name, n_world) for name in LAMPS}
            for name in LAMPS if split == "test" else ("sunset",):
                save(folder / f"rgba_{name}.png", _rgba(srgb(photo[name]), mask))
            if split == "test":
                save(folder / "albedo.png", _rgba(np.round(255 * albedo(n_world)), mask))
                save(folder / "normal.png", _rgba(np.round(127.5 * (n_world + 1)), mask))
            numbers = ",".join(str(x) for x in matrix.ravel())
            about = {"cam_angle_x": ANGLE, "cam_transform_mat": numbers, "imh": SIZE, "imw": SIZE, "scene": "ball"}
            (folder / "metadata.json").write_text(json.dumps(about))
    phi, theta = (x[..., None] for x in np.meshgrid(*_middles((1, -1, 32), (2, -2, 64)), indexing="ij"))
    d_world = np.concatenate([np.cos(theta) * np.cos(phi), np.sin(theta) * np.cos(phi), np.sin(phi)], -1)
    for name in LAMPS:
        map_ = root / "Environment_Maps" / "high_res_envmaps_1k" / f"{name}.hdr"
        files.write_hdr(map_, light(name, d_world).astype(np.float32))
    return scene


def _middles(*ranges: tuple[float, float, int]) -> list[np.ndarray]:
    """Middles of equal intervals from and to an angle [quarter turns]."""
    return [math.pi / 2 * (a + (b - a) * (np.arange(n) + 0.5) / n) for a, b, n in ranges]


CAPTURES = {"ball_scene001": "sunset", "ball_scene002": "bridge"}
"""Captures of Stanford-ORB with their lights."""


def write_orb(root: Path, kind: str = "LDR") -> Path:
    """Two captures of the sphere; the first has the test views of the second as novel views, with another lens."""
    captures = {name: _write_orb_capture(root, name, lamp) for name, lamp in CAPTURES.items()}
    frames = [
        frame | {"scene_name": "ball_scene002", "camera_angle_x": 0.9 * ANGLE}
        for frame in captures["ball_scene002"]["test"]
    ]
    for folder in ("blender_LDR", "blender_HDR"):
        files.write_json(root / folder / "ball_scene001" / "transforms_novel.json", {"frames": frames})
    return root / f"blender_{kind}" / "ball_scene001"


def _write_orb_capture(root: Path, name: str, lamp: str) -> dict[str, list[dict[str, Any]]]:
    frames: dict[str, list[dict[str, Any]]] = {"train": [], "test": []}
    angle = ANGLE if lamp == "sunset" else 0.9 * ANGLE
    for split, matrices in (("train", views(8, 0.0)), ("test", views(3, 0.3 if lamp == "sunset" else 0.7))):
        for i, matrix in enumerate(matrices):
            n_world, mask = normals(matrix, angle)
            photo = albedo(n_world) * light(lamp, n_world)
            frames[split].append({"file_path": f"{split}/{i:04}", "transform_matrix": matrix.tolist()})
            for kind in ("LDR", "HDR"):
                save(root / f"blender_{kind}" / name / f"{split}_mask" / f"{i:04}.png", 255 * mask.astype(np.uint8))
            save(root / "blender_LDR" / name / split / f"{i:04}.png", srgb(photo))
            files.write_exr(root / "blender_HDR" / name / split / f"{i:04}.exr", photo)
            if split == "test":
                truth = root / "ground_truth" / name
                save(truth / "pseudo_gt_albedo" / f"{i:04}.png", srgb(albedo(n_world)))
                (truth / "surface_normal").mkdir(parents=True, exist_ok=True)
                np.save(truth / "surface_normal" / f"{i:04}.npy", (n_world @ matrix[:3, :3]).astype(np.float32))
                files.write_exr(truth / "env_map" / f"{i:04}.exr", light(lamp, _orb_directions(32) @ matrix[:3, :3].T))
    for kind, split in ((kind, split) for kind in ("LDR", "HDR") for split in frames):
        document = {"camera_angle_x": angle, "frames": frames[split]}
        files.write_json(root / f"blender_{kind}" / name / f"transforms_{split}.json", document)
    return frames


def _orb_directions(height: int) -> np.ndarray:
    """Direction of each texel of a light map in the camera frame: +z at the left border, +y at the top."""
    phi, theta = np.meshgrid(*_middles((0, 2, height), (-1, 3, 2 * height)), indexing="ij")
    return np.stack([-np.cos(theta) * np.sin(phi), np.cos(phi), -np.sin(theta) * np.sin(phi)], -1)


WRITERS: dict[str, Callable[[Path], Path]] = {"tensoir": write_tensoir, "stanford_orb": write_orb}
"""One writer per reader of a published benchmark with given poses: `root -> path`."""
