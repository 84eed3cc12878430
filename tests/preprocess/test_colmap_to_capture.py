"""Images with a COLMAP model become a capture, whose poses and camera project points of the object to their pixels.

The images are painted by COLMAP's formulas (`tests.preprocess.test_colmap.imaged`) for a world with arbitrary unit,
origin and axes, and the capture is read with the capture reader.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.preprocess.test_colmap import imaged, write_binary, write_text
from tumble import pipeline
from tumble.datasets import folder
from tumble.io import files
from tumble.io.files import BadFile
from tumble.preprocess import check, colmap_to_capture
from tumble.preprocess.options import FootageOptions
from tumble.preprocess.source import input_kind
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN

CENTRE = np.array([3.0, -1.0, 7.0])
"""Centre of the object in the model's frame."""
UNIT = 2.5
"""Unit of the object [unit of the model]."""
TILT = Rotation.from_rotvec([0.8, -0.4, 1.1]).as_matrix()
"""Rotation from the room's axes (+y is up) to the world's."""
POINTS = np.array([[0.6, 0.0, 0.1], [0.0, 0.8, -0.2], [-0.4, -0.7, 0.3], [0.1, 0.2, -0.7]])
"""Points of the object relative to its centre, in the room's axes and the object's unit."""
COLOURS = np.array([[255, 40, 40], [40, 255, 40], [40, 40, 255], [255, 255, 40]], np.uint8)
DISK = 0.12
"""Radius of the sphere around every point [unit of the object]."""
HEIGHT, WIDTH = 300, 400
CAMERAS: dict[int, tuple[int, str, int, int, list[float]]] = {
    1: (4, "OPENCV", WIDTH, HEIGHT, [420.0, 430.0, 205.0, 148.0, 0.06, -0.02, 0.003, -0.002]),
    5: (5, "OPENCV_FISHEYE", WIDTH, HEIGHT, [400.0, 400.0, 198.0, 152.0, 0.03, 0.0, 0.0, 0.0]),
}
N = 12


def poses(n: int = N, *, still: bool = False) -> list[tuple[np.ndarray, np.ndarray]]:
    """`R_cam_world, t_cam_world`: around the object and aimed beside it, or, if `still`, of a turntable."""
    poses = []
    rng = np.random.default_rng(3)
    for i in range(n):
        azimuth, elevation = 2 * np.pi * i / n, 0.35 if still else 0.5 * np.sin(3 * i)
        position = 6 * np.array(
            [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
        )
        forward = -position + (0 if still else rng.normal(0, 0.4, 3))
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 1, 0])
        right /= np.linalg.norm(right)
        R_cam_room = np.stack([right, np.cross(forward, right), forward])
        roll = Rotation.from_rotvec([0, 0, 0 if still else rng.normal(0, 0.2)]).as_matrix()
        R = roll @ R_cam_room @ TILT.T
        poses.append((R, -R @ (CENTRE + UNIT * TILT @ position)))
    return poses


def painted(R: np.ndarray, t: np.ndarray, camera: int) -> tuple[np.ndarray, np.ndarray]:
    """Four spheres on a grey background, and which pixels show one."""
    _, model, width, height, parameters = CAMERAS[camera]
    image = np.full((height, width, 3), 90, np.uint8)
    covered = np.zeros((height, width), bool)
    x_cam = (CENTRE + UNIT * POINTS @ TILT.T) @ R.T + t
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    for i in np.argsort(-x_cam[:, 2]):
        u, v = imaged(model, parameters, x_cam[i : i + 1, :2] / x_cam[i, 2])[0]
        radius = parameters[0] * DISK * UNIT / x_cam[i, 2]
        disk = (columns - u) ** 2 + (rows - v) ** 2 < radius**2
        image[disk], covered = COLOURS[i], covered | disk
    return image, covered


def write(root: Path, *, model: Callable[..., Path] = write_binary, masks: str = "stem", still: bool = False) -> Path:
    """A COLMAP folder with images in two subfolders, and masks by stem, by whole name, or as alpha."""
    path = root / "Tonkrug ä"
    images: dict[str, tuple[int, list[float], int, int]] = {}
    for i, (R, t) in enumerate(poses(still=still)):
        camera = 1 if i % 2 or still else 5
        name = f"{'one' if i < 5 else 'two'}/{i:03d}.png"
        image, covered = painted(R, t, camera)
        alpha = np.where(covered, 255, 0).astype(np.uint8)
        save(path / "images" / name, np.dstack([image, alpha]) if masks == "alpha" else image)
        if masks != "alpha":
            save(path / "masks" / (name if masks == "stem" else f"{name}.png"), alpha)
        images[name] = (i + 1, [*Rotation.from_matrix(R).as_quat(scalar_first=True), *t], camera, 2)
    points = [(i, tuple(p), (1, 2, 3), 0.4, 2) for i, p in enumerate(CENTRE + UNIT * POINTS @ TILT.T)]
    model(path / "sparse" / "0", cameras=CAMERAS, images=images, points=points)
    return path


def save(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def made(tmp_path: Path, options: FootageOptions | None = None, **how: Any) -> Path:
    return colmap_to_capture.capture_from_model(write(tmp_path, **how), tmp_path / "out", options or FootageOptions())


def object_from_room(capture_path: Path, *, still: bool = False) -> tuple[np.ndarray, np.ndarray, float]:
    """Rotation and origin of the capture's frame in the room, and its unit, from the camera positions."""
    trajectory = folder.load(capture_path).trajectory
    assert trajectory is not None
    positions = trajectory.camera_positions.double().numpy()
    room = np.stack([-(R @ TILT).T @ (t + R @ CENTRE) / UNIT for R, t in poses(still=still)])
    scale = np.linalg.norm(positions - positions.mean(0)) / np.linalg.norm(room - room.mean(0))
    rotation, residual = Rotation.align_vectors(positions - positions.mean(0), scale * (room - room.mean(0)))
    # Single precision and six digits; a mirrored frame would have a large residual.
    assert residual < 1e-3
    return rotation.as_matrix(), positions.mean(0) - scale * rotation.as_matrix() @ room.mean(0), scale


def assert_points_project_to_their_disks(path: Path, *, still: bool = False) -> None:
    capture = folder.load(path)
    assert capture.trajectory is not None
    R, origin, scale = object_from_room(path, still=still)
    x_obj = torch.from_numpy(scale * POINTS @ R.T + origin).float()
    errors = []
    for i in range(len(capture)):
        uv = capture.camera.project(capture.trajectory.T_cam_obj[i] @ x_obj)
        depth = (capture.trajectory.T_cam_obj[i] @ x_obj)[:, 2]
        size = capture.camera.fx_fy_cx_cy[0] * DISK * scale / depth
        separate = (torch.cdist(uv, uv) + 999 * torch.eye(len(uv))).amin(-1) > 2.2 * size
        for position, colour, isolated in zip(uv, COLOURS, separate, strict=True):
            disk = (capture.images[i].float() - torch.from_numpy(colour).float()).abs().amax(-1) < 70
            if isolated and disk.any():
                errors.append(capture.camera.pixel_centers()[disk].mean(0) - position)
    assert len(errors) > 2 * len(capture)
    # A disc of the distorted image is not a disc after undistortion, which averages out over the cameras; a wrong pixel
    # centre would be an error of 0.5.
    assert torch.stack(errors).abs().max() < 0.45
    assert torch.stack(errors).mean(0).abs().max() < (0.2 if still else 0.06)


@pytest.mark.parametrize(
    ("model", "masks", "size"), [(write_binary, "stem", 256), (write_text, "name", 100), (write_binary, "alpha", 160)]
)
def test_painted_points_project_to_their_pixels(
    model: Callable[..., Path], masks: str, size: int, tmp_path: Path
) -> None:
    path = made(tmp_path, FootageOptions(size=size), model=model, masks=masks)
    capture = folder.load(path)
    assert len(capture) == N
    assert capture.light == "object"
    side, focal = max(capture.camera.height, capture.camera.width), float(capture.camera.fx_fy_cx_cy[0])
    # Not larger than in the images: the median focal length of both lenses.
    assert side == size if size < 120 else focal == 410
    assert_points_project_to_their_disks(path)


def test_the_object_is_upright_and_its_bounding_sphere_is_the_unit_sphere(tmp_path: Path) -> None:
    path = made(tmp_path)
    R, origin, scale = object_from_room(path)
    x_obj = scale * POINTS @ R.T + origin
    reach = np.linalg.norm(x_obj, axis=1) + scale * DISK
    # All points are inside, and the farthest is within a twentieth of the unit sphere.
    assert 0.95 < reach.max() < 1.0
    # The cameras roll by 0.2 radians and aim beside the object; on average +y is up.
    assert R[1, 1] > 0.98
    trajectory = folder.load(path).trajectory
    assert trajectory is not None
    first = trajectory.camera_positions[0]
    assert first[2] > 0
    assert abs(first[0]) < 1e-4 * first[2]
    # Every camera looks at the centre.
    centres = trajectory.T_cam_obj.xyz / trajectory.T_cam_obj.xyz.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(centres, torch.tensor([[0.0, 0, 1]]).expand_as(centres), atol=1e-4, rtol=0)


def test_images_of_a_turntable_get_a_common_rotation(tmp_path: Path) -> None:
    """After a common rotation of the static camera, the poses still rotate about the axis of the turntable."""
    path = made(tmp_path, FootageOptions(light="camera"), still=True)
    capture = folder.load(path)
    assert capture.light == "camera"
    assert_points_project_to_their_disks(path, still=True)
    assert capture.trajectory is not None
    R = capture.trajectory.T_cam_obj.rotation.matrix().double().numpy()
    steps = Rotation.from_matrix(R[1:] @ R[:-1].transpose(0, 2, 1)).as_rotvec()
    # The axis in the camera frame and the angle are those of the turntable.
    np.testing.assert_allclose(steps, np.broadcast_to(steps[0], steps.shape), atol=1e-4)
    assert np.linalg.norm(steps[0]) == pytest.approx(2 * np.pi / N, abs=1e-4)


def test_pixels_beyond_an_image_are_unknown(tmp_path: Path) -> None:
    """The new camera looks at the object's centre, beyond the border of images that were aimed beside it."""
    source = write(tmp_path)
    for name in ("images", "masks"):
        for file in sorted((source / name).rglob("*.png")):
            values = np.asarray(Image.open(file)).copy()
            values[:, :170] = 0
            save(file, values)
    capture = folder.load(colmap_to_capture.capture_from_model(source, tmp_path / "out", FootageOptions()))
    original = folder.load(
        colmap_to_capture.capture_from_model(write(tmp_path / "again"), tmp_path / "other", FootageOptions())
    )
    assert (original.masks == UNKNOWN).float().mean() < 0.1
    for masks in (capture.masks, original.masks):
        assert ((masks == OBJECT) | (masks == BACKGROUND) | (masks == UNKNOWN)).all()
    assert (capture.images[capture.masks == BACKGROUND] == 0).all()
    few = made(tmp_path / "few", FootageOptions(frames=3))
    assert len(folder.load(few)) == 3


def test_an_image_with_an_empty_mask_is_dropped(tmp_path: Path) -> None:
    source = write(tmp_path)
    save(source / "masks" / "one" / "002.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    path = colmap_to_capture.capture_from_model(source, tmp_path / "out", FootageOptions())
    provenance = files.read_json(path / "ingest.json")
    assert provenance["without_object"] == ["one/002.png"]
    assert len(folder.load(path)) == N - 1
    assert [frame["source"] for frame in provenance["frames"]][2] == "one/003.png"


# Commands -------------------------------------------------------------------------------------------------------------


def test_a_run_converts_the_folder_once_and_refuses_other_options(tmp_path: Path) -> None:
    source, out = write(tmp_path), tmp_path / "run"
    path = pipeline.capture_of(source, out, FootageOptions())
    assert path == out / "capture"
    assert pipeline.capture_of(source, out, FootageOptions()) == path
    with pytest.raises(BadFile, match=r"options\.light is 'object' in the folder, 'camera' was requested"):
        pipeline.capture_of(source, out, FootageOptions(light="camera"))
    with pytest.raises(BadFile, match="whose images have masks: --not-object does not change them"):
        pipeline.capture_of(source, tmp_path / "other", FootageOptions(not_object=((1, 1, 0),)))


def test_check_assesses_images_with_a_colmap_model(tmp_path: Path) -> None:
    source = write(tmp_path)
    results = {finding.subject: finding for finding in check.check_footage(source, tmp_path / "out", FootageOptions())}
    # The area of the four spheres is that of a disc of 33 pixels; nothing else is wrong.
    assert {subject for subject, finding in results.items() if finding.rating == "stop"} == {"size"}
    assert "12 images with a pose, 4 points, mean reprojection error 0.40 pixels" in results["model"].state
    assert "12 camera positions" in results["views"].state
    assert (tmp_path / "out" / "mask_preview.mp4").is_file()
    # Every other mask is shifted by a quarter of the image, so the rays have no common point.
    for mask in sorted((source / "masks").rglob("*.png"))[::2]:
        save(mask, np.roll(np.asarray(Image.open(mask)), -WIDTH // 4, 1))
    shifted = {finding.subject: finding for finding in check.check_footage(source, tmp_path / "out", FootageOptions())}
    assert (results["agreement"].rating, shifted["agreement"].rating) == ("good", "stop")


def shrink(path: Path) -> None:
    save(path / "images" / "one" / "001.png", np.zeros((HEIGHT // 2, WIDTH // 2, 3), np.uint8))


def escape(path: Path) -> None:
    write_text(path / "sparse" / "0", images={"../../x.png": (1, [1, 0, 0, 0, 0, 0, 1], 1, 0)}, cameras=CAMERAS)
    for file in (path / "sparse" / "0").glob("*.bin"):
        file.unlink()


def wipe(path: Path) -> None:
    for mask in (path / "masks").rglob("*.png"):
        save(mask, np.zeros((HEIGHT, WIDTH), np.uint8))


BROKEN: dict[str, tuple[Callable[[Path], Any], FootageOptions, str]] = {
    "a missing image": (lambda p: (p / "images/two/007.png").unlink(), FootageOptions(), r"007\.png: is missing"),
    "a missing mask": (
        lambda p: (p / "masks/two/007.png").unlink(),
        FootageOptions(),
        r"has no mask for 007\.png",
    ),
    "no masks": (lambda p: (p / "masks").rename(p / "other"), FootageOptions(), r"000\.png: has no mask"),
    "shrunk images": (shrink, FootageOptions(), r"001\.png: has 200 x 150 pixels, but in the COLMAP model 400 x 300"),
    "a path to elsewhere": (escape, FootageOptions(), r"'\.\./\.\./x\.png' leaves the folder"),
    "empty masks": (wipe, FootageOptions(), "has only empty masks"),
    "a part": (lambda p: None, FootageOptions(part=(0, 3)), "whose images are all used .leave out --part"),
    "a second lens": (lambda p: None, FootageOptions(fov=40.0), "--fov contradicts it"),
    "text as a model": (
        lambda p: (p / "sparse/0/images.bin").write_text("hello"),
        FootageOptions(),
        r"images\.bin: is damaged",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_folder_is_refused_with_file_and_rule(name: str, tmp_path: Path) -> None:
    path = write(tmp_path)
    damage, options, message = BROKEN[name]
    damage(path)
    with pytest.raises(BadFile, match=message):
        colmap_to_capture.capture_from_model(path, tmp_path / "out", options)
    assert not (tmp_path / "out").exists()


def test_a_capture_folder_that_also_has_a_model_is_a_capture(tmp_path: Path) -> None:
    path = write(tmp_path)
    assert input_kind(path) == "posed images"
    (path / folder.TRANSFORMS).write_text(json.dumps({}))
    assert input_kind(path) == "capture"
