"""Every dataset reader: true poses project painted points of the object to their disks in the images.

The images are painted by the formulas of the datasets' own tools (OpenGL axes and integer pixel centres in HO3D,
millimetres in BOP), and the poses that are read are projected by `Camera`.
"""

import json
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from tests import spheres
from tumble import datasets
from tumble.datasets import _capture_folder, bop, folder, ho3d
from tumble.evaluation import evaluate, metrics
from tumble.evaluation.prediction import Prediction
from tumble.io import files, plugins
from tumble.io.files import BadFile
from tumble.maths.se3 import SE3, SO3
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN, Capture, Truth, content_key, truth_without_views
from tumble.scene.trajectory import Trajectory

HEIGHT, WIDTH = 96, 128
K = np.array([[150.0, 0, 60.0], [0, 155.0, 50.0], [0, 0, 1]])
"""Camera matrix; the centre of the first pixel is (0, 0)."""
POINTS = np.array([[0.06, 0.0, 0.01], [0.0, 0.05, -0.02], [-0.04, -0.03, 0.03]])
"""Points of the object [metres]."""
COLOURS = np.array([[255, 40, 40], [40, 255, 40], [40, 40, 255]], np.uint8)
RADIUS = 7


def random_poses(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotation vectors and positions [m] of an object half a metre in front of an OpenCV camera."""
    rng = np.random.default_rng(seed)
    return Rotation.random(n, rng=rng).as_rotvec(), rng.normal([0, 0, 0.5], [0.02, 0.02, 0.03], (n, 3))


def painted(rotvec: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A disk per point on a grey background, the nearest on top; and which pixels show a disk."""
    x = Rotation.from_rotvec(rotvec).apply(POINTS) + position
    image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    covered = np.zeros((HEIGHT, WIDTH), bool)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    for i in np.argsort(-x[:, 2]):
        u, v = x[i, :2] / x[i, 2] * [K[0, 0], K[1, 1]] + K[:2, 2]
        disk = (columns - u) ** 2 + (rows - v) ** 2 < RADIUS**2
        image[disk], covered = COLOURS[i], covered | disk
    return image, covered


def save(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, quality=98, subsampling=0)


def python_2(value: Any) -> bytes:
    """A value as pickled by Python 2 and its numpy, without memo."""
    if value is None:
        return b"N"
    if isinstance(value, int):
        return b"J" + struct.pack("<i", value)
    if isinstance(value, str):
        return b"U" + bytes([len(value)]) + value.encode()
    if isinstance(value, dict):
        return b"}(" + b"".join(python_2(key) + python_2(item) for key, item in value.items()) + b"u"
    data = np.ascontiguousarray(value, "<f8").tobytes()
    shape = b"(" + b"".join(python_2(n) for n in value.shape) + b"t"
    dtype = b"cnumpy\ndtype\n(U\x02f8K\x00K\x01tR(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    empty = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(K\x00tU\x01btR"
    return empty + b"(K\x01" + shape + dtype + b"\x89T" + struct.pack("<i", len(data)) + data + b"tb"


# Layouts --------------------------------------------------------------------------------------------------------------


def write_ho3d(root: Path, seed: int = 0, *, ending: str = ".jpg", masks: str = "masks") -> Path:
    """A sequence of six frames; frames 0 and 3 have no annotation, and frame 3 has no camera either."""
    path = root / "evaluation" / "SM1"
    images = [painted(*pose) for pose in zip(*random_poses(6, 0), strict=True)]
    for i, (rotvec, position) in enumerate(zip(*random_poses(6, seed), strict=True)):
        image, covered = images[i]
        save(path / "rgb" / f"{i:04}{ending}", image)
        # OpenGL axes: y and z are inverted.
        flip = np.diag([1.0, -1.0, -1.0])
        R_gl_obj = flip @ Rotation.from_rotvec(rotvec).as_matrix()
        rotvec_gl = Rotation.from_matrix(R_gl_obj).as_rotvec()[:, None]
        meta = {"camMat": K, "objRot": rotvec_gl, "objTrans": flip @ position, "objName": "021_bleach", "objLabel": 12}
        meta |= {"handPose": np.zeros(48), "objCorners3D": np.zeros((8, 3))}
        if i in (0, 3):
            meta = dict.fromkeys(meta)
        if i == 0:
            meta["camMat"] = K
        (path / "meta").mkdir(exist_ok=True)
        (path / "meta" / f"{i:04}.pkl").write_bytes(b"\x80\x02" + python_2(meta) + b".")
        _write_ho3d_mask(root, path, i, covered, masks)
    return path


def _write_ho3d_mask(root: Path, path: Path, i: int, covered: np.ndarray, masks: str) -> None:
    hand = np.zeros_like(covered)
    hand[-16:] = True
    if masks == "masks":
        values = np.where(covered, OBJECT, np.where(hand, UNKNOWN, BACKGROUND)).astype(np.uint8)
        save(path / "masks" / f"{i:04}.png", values)
    elif masks == "masks_XMem":
        save(root / "masks_XMem" / "SM1" / f"{i:05}.png", covered.astype(np.uint8))
        save(root / "masks_XMem" / "SM1_hand" / f"{i:04}.png", hand.astype(np.uint8) * 255)
    else:
        colours = np.stack([~covered & ~hand, covered, hand & ~covered], -1)[2::4, 2::4]
        save(path / "seg" / f"{i:04}.png", colours.astype(np.uint8) * 255)


def write_bop(root: Path, seed: int = 0, *, objects: int = 1, moving: bool | None = None) -> Path:
    """A scene of four frames; the object is the last in the list, behind a bar, and missing in the last frame."""
    path = root / "test" / "000048"
    cameras: dict[str, Any] = {}
    annotation: dict[str, Any] = {}
    numbers = (2, 10, 11, 30)
    images = [painted(*pose) for pose in zip(*random_poses(4, 0), strict=True)]
    for k, (frame, rotvec, position) in enumerate(zip(numbers, *random_poses(4, seed), strict=True)):
        image, covered = images[k]
        bar = np.zeros_like(covered)
        bar[:, 60:64] = True
        image[bar] = 200
        save(path / "rgb" / f"{frame:06}.png", image)
        index = objects - 1
        if frame != 30:
            save(path / "mask" / f"{frame:06}_{index:06}.png", covered.astype(np.uint8) * 255)
            save(path / "mask_visib" / f"{frame:06}_{index:06}.png", (covered & ~bar).astype(np.uint8) * 255)
        R = Rotation.from_rotvec(rotvec).as_matrix()
        wanted = {"obj_id": 5, "cam_R_m2c": R.ravel().tolist(), "cam_t_m2c": (1000 * position).tolist()}
        others = [{"obj_id": 2, "cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [0, 0, 900]}] * (objects - 1)
        annotation[str(frame)] = others + [wanted] * (frame != 30)
        cameras[str(frame)] = {"cam_K": K.ravel().tolist(), "depth_scale": 0.1}
        if moving is not None:
            pose = {"cam_R_w2c": np.eye(3).ravel().tolist(), "cam_t_w2c": [0, 0, 10.0 * k * moving]}
            cameras[str(frame)] |= pose
    # Keys sorted as text, as by some writers.
    for name, document in ((bop.CAMERAS, cameras), (bop.ANNOTATION, annotation)):
        (path / name).write_text(json.dumps(document, sort_keys=True))
    return path


def write_folder(root: Path, seed: int = 0) -> Path:
    rotvecs, positions = random_poses(3, seed)
    T = SE3.from_rotation(SO3.exp(torch.from_numpy(rotvecs).float()), torch.from_numpy(positions).float())
    images, covered = (
        torch.from_numpy(np.stack(parts))
        for parts in zip(*(painted(*pose) for pose in zip(*random_poses(3, 0), strict=True)), strict=True)
    )
    camera = Camera(torch.tensor([150.0, 155.0, 60.5, 50.5]), HEIGHT, WIDTH)
    masks = torch.where(covered, OBJECT, BACKGROUND).to(torch.uint8)
    capture = Capture(images * covered[..., None], masks, camera, ("a.png", "b.png", "c.png"), "camera")
    truth = Truth(**{**vars(truth_without_views(camera)), "poses": Trajectory(T, "camera")})
    _capture_folder.save_capture(root / "mug", capture, truth)
    return root / "mug"


LAYOUTS: dict[str, Callable[..., Path]] = {"bop": write_bop, "folder": write_folder, "ho3d": write_ho3d}
"""One writer per reader: `(root, seed of the true poses) -> path`; the images do not depend on the seed."""


def assert_points_project_to_their_disks(capture: Capture, truth: Truth, tolerance: float = 0.16) -> None:
    """The mean of a disk's pixels is the projection of its point by the true pose, unless another disk covers it."""
    assert truth.poses is not None
    n_checked = 0
    for name, index in truth.pose_indices(capture).items():
        image, mask = (x[capture.names.index(name)] for x in (capture.images, capture.masks))
        x_cam = truth.poses.T_cam_obj[index] @ torch.from_numpy(POINTS).float()
        uv = capture.camera.project(x_cam)
        separate = (torch.cdist(uv, uv) + 99 * torch.eye(3)).amin(-1) > 2 * RADIUS
        for centre, colour, isolated in zip(uv, COLOURS, separate, strict=True):
            disk = ((image.float() - torch.from_numpy(colour).float()).abs().amax(-1) < 60) & (mask == OBJECT)
            near = (capture.camera.pixel_centers() - centre).norm(dim=-1) < RADIUS
            if isolated and disk.any() and not (mask[near] == UNKNOWN).any():
                # The mean of a rasterised disk is within 0.15 of its centre; a wrong pixel centre is an error of 0.5.
                mean = capture.camera.pixel_centers()[disk].mean(0)
                torch.testing.assert_close(mean, centre, atol=tolerance, rtol=0)
                n_checked += 1
    assert n_checked >= 4


# Conformance ----------------------------------------------------------------------------------------------------------


def test_every_reader_has_a_test_layout() -> None:
    assert {*LAYOUTS, *spheres.WRITERS} == set(plugins.plugin_names("datasets"))


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_reader_is_selected_by_layout_and_reads_capture_and_truth(name: str, tmp_path: Path) -> None:
    path = LAYOUTS[name](tmp_path)
    reader = datasets.reader_for(path)
    assert reader is plugins.load_plugin("datasets", name)
    assert isinstance(reader.LAYOUT, str)
    capture, truth = reader.load(path), reader.load_truth(path)
    assert isinstance(capture, Capture)
    assert isinstance(truth, Truth)
    assert len(capture) >= 3
    assert set(truth.pose_indices(capture)) <= set(capture.names)
    assert (capture.images[capture.masks == BACKGROUND] == 0).all()
    assert_points_project_to_their_disks(capture, truth)


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_capture_does_not_depend_on_its_truth(name: str, tmp_path: Path) -> None:
    reader = plugins.load_plugin("datasets", name)
    path_a, path_b = (LAYOUTS[name](tmp_path / str(seed), seed) for seed in (0, 1))
    assert content_key(reader.load(path_a)) == content_key(reader.load(path_b))
    a, b = (reader.load_truth(path).poses.T_cam_obj.matrix() for path in (path_a, path_b))
    assert (a - b).abs().max() > 0.1


@pytest.mark.parametrize("name", LAYOUTS)
def test_true_poses_in_another_object_frame_have_the_best_score(name: str, tmp_path: Path) -> None:
    path = LAYOUTS[name](tmp_path)
    subject = evaluate.read_with_truth(path)
    assert subject.truth.poses is not None
    names = tuple(subject.truth.pose_indices(subject.capture))
    similarity = metrics.Similarity(
        torch.tensor(3.0), SO3.exp(torch.tensor([0.3, 1.0, -2.0])), torch.tensor([1.0, 0.0, 2.0])
    )
    Prediction(poses=similarity.to_truth(subject.truth.poses), pose_names=names).write(tmp_path / "prediction")
    poses = evaluate.score(tmp_path / "prediction", subject, tmp_path / "out")["poses"]
    assert poses["poses.lost_frames"] == 0
    assert poses["poses.auc_percent"] == pytest.approx(100, abs=0.01)
    assert poses["poses.rpe_translation"] == pytest.approx(0, abs=1e-5)
    assert poses["poses.rotation_longest_run_percent"] == 100
    assert poses["poses.alignment"]["scale"] == pytest.approx(1 / 3, rel=1e-4)


def test_an_unknown_layout_is_refused_with_a_list_of_the_known_ones(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(
            BadFile, match=r"known layouts: bop: .*scene_gt\.json.*folder: .*transforms\.json.*ho3d: .*meta"
        ):
            datasets.reader_for(path)
    both = write_ho3d(tmp_path)
    (both / folder.TRANSFORMS).write_text("{}")
    with pytest.raises(BadFile, match="has the layouts folder and ho3d"):
        datasets.reader_for(both)


# HO3D -----------------------------------------------------------------------------------------------------------------


def test_images_of_ho3d_version_2_are_png(tmp_path: Path) -> None:
    path = write_ho3d(tmp_path, ending=".png")
    capture, truth = ho3d.load(path), ho3d.load_truth(path)
    assert truth is not None
    assert capture.names == tuple(f"{i:04}.png" for i in range(6))
    assert_points_project_to_their_disks(capture, truth)


def test_frames_without_annotation_are_kept_without_a_true_pose(tmp_path: Path) -> None:
    path = write_ho3d(tmp_path)
    capture, truth = ho3d.load(path), ho3d.load_truth(path)
    assert truth is not None
    assert len(capture) == 6
    assert capture.trajectory is None
    assert truth.pose_names == ("0001.jpg", "0002.jpg", "0004.jpg", "0005.jpg")
    assert list(truth.pose_indices(capture).values()) == [0, 1, 2, 3]
    assert truth.units == "m"
    assert capture.camera.fx_fy_cx_cy.tolist() == [150, 155, 60.5, 50.5]


@pytest.mark.parametrize("masks", ["masks_XMem", "seg"])
def test_masks_of_other_kinds_label_object_and_hand(masks: str, tmp_path: Path) -> None:
    path = write_ho3d(tmp_path, ending=".png", masks=masks)
    capture = ho3d.load(path)
    for i, pose in enumerate(zip(*random_poses(6, 0), strict=True)):
        covered = torch.from_numpy(painted(*pose)[1])
        hand = torch.zeros_like(covered)
        hand[-16:] = True
        labels = capture.masks[i]
        if masks == "masks_XMem":
            assert torch.equal(labels == OBJECT, covered)
            assert torch.equal(labels == UNKNOWN, hand & ~covered)
        # At a quarter of the resolution known pixels are right, but of a small disk only the middle is known.
        wrong = ((labels == OBJECT) & ~covered) | ((labels == BACKGROUND) & (covered | hand))
        assert wrong.float().mean() < 0.01
        assert ((labels == OBJECT) & covered).sum() > 0.15 * covered.sum()
        assert (labels[-12:][hand[-12:] & ~covered[-12:]] != BACKGROUND).all()


def test_a_pixel_in_the_masks_of_both_object_and_hand_is_object(tmp_path: Path) -> None:
    path = write_ho3d(tmp_path, ending=".png", masks="masks_XMem")
    alone = ho3d.load(path).masks[2] == OBJECT
    save(tmp_path / "masks_XMem" / "SM1_hand" / "0002.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    labels = ho3d.load(path).masks[2]
    assert torch.equal(labels == OBJECT, alone)
    assert torch.equal(labels == UNKNOWN, ~alone)


def test_a_mask_of_the_hand_of_another_size_than_that_of_the_object_is_refused(tmp_path: Path) -> None:
    path = write_ho3d(tmp_path, ending=".png", masks="masks_XMem")
    save(tmp_path / "masks_XMem" / "SM1_hand" / "0002.png", np.full((4, 5), 255, np.uint8))
    with pytest.raises(
        BadFile, match=rf"SM1_hand/0002\.png: has 5 x 4 pixels, but .*00002\.png has {WIDTH} x {HEIGHT}"
    ):
        ho3d.load(path)


def test_masks_beside_a_sequence_are_found_from_inside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_ho3d(tmp_path, ending=".png", masks="masks_XMem")
    monkeypatch.chdir(path)
    assert torch.equal(ho3d.load(".").masks, ho3d.load(path).masks)
    monkeypatch.chdir(path.parent)
    assert torch.equal(ho3d.load(path.name).masks, ho3d.load(path).masks)


def test_frames_without_a_mask_are_omitted(tmp_path: Path) -> None:
    path = write_ho3d(tmp_path)
    (path / "masks" / "0001.png").unlink()
    save(path / "masks" / "0004.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    capture, truth = ho3d.load(path), ho3d.load_truth(path)
    assert truth is not None
    assert capture.names == ("0000.jpg", "0002.jpg", "0003.jpg", "0005.jpg")
    assert truth.pose_indices(capture) == {"0002.jpg": 1, "0005.jpg": 3}
    for mask in (path / "masks").iterdir():
        mask.unlink()
    with pytest.raises(BadFile, match="no frame with a mask"):
        ho3d.load(path)


def test_known_errors_of_the_annotation_are_not_read(tmp_path: Path) -> None:
    path = write_ho3d(tmp_path)
    for i in (4, 5):
        for name, ending in (("rgb", ".jpg"), ("meta", ".pkl"), ("masks", ".png")):
            (path / name / f"{i:04}{ending}").rename(path / name / f"{i + 1131:04}{ending}")
    path = path.rename(path.parent / "ABF12")
    truth = ho3d.load_truth(path)
    assert truth is not None
    assert truth.pose_names == ("0001.jpg", "0002.jpg", "1135.jpg")
    assert len(ho3d.load(path)) == 6


def test_a_sequence_without_annotation_has_no_truth(tmp_path: Path) -> None:
    path = write_ho3d(tmp_path)
    for i in range(6):
        (path / "meta" / f"{i:04}.pkl").write_bytes(b"\x80\x02" + python_2({"camMat": K, "objRot": None}) + b".")
    assert ho3d.load_truth(path) is None
    with pytest.raises(BadFile, match="has no truth to score against"):
        evaluate.read_with_truth(path)


def overwrite(name: str, content: bytes) -> Callable[[Path], None]:
    return lambda path: (path / name).write_bytes(content) and None


BROKEN_HO3D: dict[str, tuple[Callable[[Path], Any], str]] = {
    "a program": (overwrite("meta/0000.pkl", b"cos\nsystem\n(S'touch harm'\ntR."), r"0000\.pkl: .*os\.system"),
    "a list": (overwrite("meta/0000.pkl", b"]."), r"0000\.pkl: contains a list"),
    "no meta": (lambda path: (path / "meta" / "0000.pkl").unlink(), r"0000\.pkl: is missing"),
    "a camera of eight numbers": (
        overwrite("meta/0000.pkl", b"\x80\x02" + python_2({"camMat": np.ones(8)}) + b"."),
        '"camMat" is not 9 finite numbers',
    ),
    "a name that is no number": (
        lambda path: save(path / "rgb" / "cover.png", np.zeros((2, 2, 3), np.uint8)),
        "cover.png: .*number",
    ),
    "a mask of another size": (
        lambda path: save(path / "masks" / "0001.png", np.full((4, 4), 255, np.uint8)),
        r"0001\.jpg: has a mask of 4 x 4",
    ),
    "text as an image": (overwrite("rgb/0001.jpg", b"hello"), r"0001\.jpg: is not an image"),
}


@pytest.mark.parametrize("name", BROKEN_HO3D)
def test_a_broken_sequence_is_refused_with_file_and_rule(name: str, tmp_path: Path) -> None:
    path = write_ho3d(tmp_path)
    damage, message = BROKEN_HO3D[name]
    damage(path)
    with pytest.raises(BadFile, match=message):
        ho3d.load(path)


# BOP ------------------------------------------------------------------------------------------------------------------


def test_one_of_several_objects_is_selected_by_its_id(tmp_path: Path) -> None:
    path = write_bop(tmp_path, objects=3)
    with pytest.raises(BadFile, match=r"has the objects \[2, 5\].*object_id"):
        bop.load(path)
    capture, truth = bop.load(path, object_id=5), bop.load_truth(path, object_id=5)
    assert truth is not None
    assert capture.names == truth.pose_names == ("000002.png", "000010.png", "000011.png")
    assert_points_project_to_their_disks(capture, truth)
    with pytest.raises(BadFile, match="no object 7"):
        bop.load(path, object_id=7)
    with pytest.raises(BadFile, match="the object 2 2 times"):
        bop.load(path, object_id=2)


def test_occluded_parts_are_unknown(tmp_path: Path) -> None:
    capture = bop.load(write_bop(tmp_path))
    for i, pose in enumerate(list(zip(*random_poses(4, 0), strict=True))[:3]):
        covered = torch.from_numpy(painted(*pose)[1])
        hidden = torch.zeros_like(covered)
        hidden[:, 60:64] = True
        assert torch.equal(capture.masks[i] == UNKNOWN, covered & hidden)
        assert torch.equal(capture.masks[i] == OBJECT, covered & ~hidden)
    assert capture.camera.fx_fy_cx_cy.tolist() == [150, 155, 60.5, 50.5]


@pytest.mark.parametrize(("moving", "light"), [(None, "camera"), (False, "camera"), (True, "object")])
def test_the_light_is_fixed_to_the_object_if_the_camera_moves(moving: bool | None, light: str, tmp_path: Path) -> None:
    path = write_bop(tmp_path, moving=moving)
    truth = bop.load_truth(path)
    assert truth is not None
    assert truth.poses is not None
    assert bop.load(path).light == truth.poses.light == light


def change(name: str, how: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def changed(path: Path) -> None:
        document = json.loads((path / name).read_text())
        how(document)
        (path / name).write_text(json.dumps(document))

    return changed


BROKEN_BOP: dict[str, tuple[Callable[[Path], Any], str]] = {
    "an impossible focal length": (
        change(bop.CAMERAS, lambda d: d["10"].update(cam_K=(1e9 * K).ravel().tolist())),
        "has the camera matrix",
    ),
    "lenses without a common field of view": (
        change(bop.CAMERAS, lambda d: [d[i].update(cam_K=(9 * K).ravel().tolist()) for i in ("10", "11")]),
        "the lenses of the frames differ too much",
    ),
    "no camera": (change(bop.CAMERAS, lambda d: d.pop("10")), r"has no frame 10"),
    "a scaled rotation": (
        change(bop.ANNOTATION, lambda d: d["10"][0].update(cam_R_m2c=(2 * np.eye(3)).ravel().tolist())),
        "frame 10: the rotation matrix is not a rotation",
    ),
    "a rotation of 1e200": (
        change(bop.ANNOTATION, lambda d: d["10"][0].update(cam_R_m2c=[1e200] * 9)),
        "frame 10: the rotation matrix is not a rotation",
    ),
    "a position with two numbers": (
        change(bop.ANNOTATION, lambda d: d["10"][0].update(cam_t_m2c=[1, 2])),
        r"cam_t_m2c\": expected array of length 3",
    ),
    "frames by name": (change(bop.ANNOTATION, lambda d: d.update(first=[])), '"key": expected int, got str'),
    "no visible mask": (
        lambda path: (path / "mask_visib" / "000010_000000.png").unlink(),
        "000010_000000.png: is missing",
    ),
    "no annotation": (lambda path: (path / bop.ANNOTATION).unlink(), r"scene_gt\.json: is missing"),
}


@pytest.mark.parametrize("name", BROKEN_BOP)
def test_a_broken_scene_is_refused_with_file_and_rule(name: str, tmp_path: Path) -> None:
    path = write_bop(tmp_path)
    damage, message = BROKEN_BOP[name]
    damage(path)

    def read() -> None:
        bop.load(path)
        bop.load_truth(path)

    with pytest.raises(BadFile, match=message):
        read()


# Frames with different lenses ----------------------------------------------------------------------------------------


def dot(image_size: tuple[int, int], uv: tuple[float, float]) -> np.ndarray:
    """A grey image with a blurred white dot; the centre of the first pixel is (0.5, 0.5)."""
    rows, columns = np.mgrid[: image_size[0], : image_size[1]] + 0.5
    values = 40 + 200 * np.exp(-((columns - uv[0]) ** 2 + (rows - uv[1]) ** 2) / (2 * 2.0**2))
    return np.repeat(values.round().astype(np.uint8)[..., None], 3, 2)


def dot_position(capture: Capture, i: int) -> torch.Tensor:
    weights = (capture.images[i, ..., 0].double() - 60).clamp_min(0)
    return (weights[..., None] * capture.camera.pixel_centers().double()).sum((0, 1)) / weights.sum()


LENSES = ((80.0, 84.0, 30.0, 27.0, 64, 48), (120.0, 118.0, 47.0, 20.0, 72, 56))
"""fl_x, fl_y, cx, cy, w, h of two frames."""
DIRECTION = (0.08, -0.05)
"""x / z and y / z of a point that both frames show."""


def test_frames_with_lenses_of_their_own_are_resampled_to_one_camera(tmp_path: Path) -> None:
    """A point that is seen in one direction is at one pixel in all frames, and where the common camera projects it."""
    frames = []
    for i, (fx, fy, cx, cy, w, h) in enumerate(LENSES):
        uv = fx * DIRECTION[0] + cx, fy * DIRECTION[1] + cy
        save(tmp_path / f"{i}.png", dot((h, w), uv))
        save(tmp_path / f"mask{i}.png", np.pad(np.full((h - 8, w - 8), 255, np.uint8), 4))
        lens = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": w, "h": h}
        frames.append({"file_path": f"{i}.png", "mask_path": f"mask{i}.png", **lens})
    files.write_json(tmp_path / "transforms.json", {"light": "camera", "frames": frames})
    capture = folder.load(tmp_path)
    wanted = capture.camera.project(torch.tensor([*DIRECTION, 1.0])).double()
    for i in range(2):
        # Resampling a dot of two pixels moves its mean by hundredths; half a pixel is the limit for poses.
        torch.testing.assert_close(dot_position(capture, i), wanted, atol=0.1, rtol=0)
    # The first frame sees more on the right: all of it is there, and what the second did not see is unknown.
    assert capture.masks[0, 3, 3] == BACKGROUND
    assert (capture.masks[1, :, -1] == UNKNOWN).all()
    assert (capture.masks == OBJECT).flatten(1).any(1).all()


@pytest.mark.parametrize("own", [{"fl_x": 90.0}, {"camera_angle_x": 2 * math.atan(32 / 90)}])
def test_the_focal_length_of_a_frame_takes_precedence_under_each_of_its_names(own: Any, tmp_path: Path) -> None:
    save(tmp_path / "0.png", np.full((48, 64, 3), 99, np.uint8))
    for general in ({"fl_x": 60.0, "fl_y": 61.0}, {"camera_angle_x": 1.0, "fl_y": 61.0}):
        files.write_json(tmp_path / "transforms.json", {**general, "frames": [{"file_path": "0.png", **own}]})
        assert folder.load(tmp_path).camera.fx_fy_cx_cy[:2].tolist() == pytest.approx([90, 90])


def test_a_frame_with_an_impossible_principal_point_is_refused(tmp_path: Path) -> None:
    for name in ("0.png", "1.png"):
        save(tmp_path / name, np.full((48, 64, 3), 99, np.uint8))
    frames = [{"file_path": "0.png"}, {"file_path": "1.png", "cx": 1e308}]
    files.write_json(tmp_path / "transforms.json", {"fl_x": 60.0, "frames": frames})
    with pytest.raises(BadFile, match=r"transforms\.json: has its principal point at \(1e\+308, 24\)"):
        folder.load(tmp_path)


def test_pixels_beyond_a_distorted_image_are_unknown_if_it_has_no_mask(tmp_path: Path) -> None:
    save(tmp_path / "0.png", np.full((48, 64, 3), 99, np.uint8))
    save(tmp_path / "mask.png", np.full((48, 64), 255, np.uint8))
    frames = [{"file_path": "0.png"}]
    for label in (UNKNOWN, BACKGROUND):
        files.write_json(tmp_path / "transforms.json", {"fl_x": 60.0, "k1": 0.3, "frames": frames})
        mask = folder.load(tmp_path).masks[0]
        assert mask[0, 0] == label
        assert mask[24, 32] == OBJECT
        frames = [{"file_path": "0.png", "mask_path": "mask.png"}]


def test_a_scene_with_two_camera_matrices_is_resampled_to_one(tmp_path: Path) -> None:
    """Of BOP: the disks of the frame with the longer lens are where the common camera projects the points."""
    path = write_bop(tmp_path)
    document = json.loads((path / bop.CAMERAS).read_text())
    zoom = np.diag([1.2, 1.2, 1.0]) @ K
    document["10"]["cam_K"] = zoom.ravel().tolist()
    (path / bop.CAMERAS).write_text(json.dumps(document))
    for folder_name in ("rgb", "mask", "mask_visib"):
        for image in (path / folder_name).glob("000010*"):
            values = np.asarray(Image.open(image))
            affine = (zoom @ np.linalg.inv(K))[:2]
            save(image, cv2.warpAffine(values, affine, (WIDTH, HEIGHT), flags=cv2.INTER_NEAREST))
    capture, truth = bop.load(path), bop.load_truth(path)
    assert truth is not None
    assert capture.camera.width > WIDTH * 0.99
    assert_points_project_to_their_disks(capture, truth, tolerance=0.5)


def test_the_documentation_names_every_layout() -> None:
    text = (Path(__file__).parents[2] / "docs" / "format.md").read_text()
    for name in (*LAYOUTS, *spheres.WRITERS):
        assert f"`tumble.datasets.{name}`" in text


def test_units_and_setting_of_a_folder_are_read(tmp_path: Path) -> None:
    path = write_folder(tmp_path)
    document = files.read_json(path / folder.TRANSFORMS)
    files.write_json(path / folder.TRANSFORMS, {**document, "units": "m", "setting": "turntable"})
    truth = folder.load_truth(path)
    assert truth is not None
    assert (truth.units, truth.setting) == ("m", "turntable")
