"""From footage to a capture folder: what is written must be what was filmed, through the camera that is stated."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.films import HEIGHT, WIDTH, scene, written
from tumble.datasets import folder
from tumble.io import files, video
from tumble.io.files import BadFile
from tumble.preprocess import video_to_capture
from tumble.preprocess.options import FootageOptions
from tumble.preprocess.segmentation import overlap
from tumble.preprocess.survey import survey
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN

SHOWN = FootageOptions(box=scene().box())


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A film, in a folder with a difficult name, and its capture."""
    root = tmp_path_factory.mktemp("drei Dinge – ä")
    film = written(scene().pictures, root / "mein Video.mp4")
    return film, video_to_capture.capture_from_video(
        film, root / "capture", FootageOptions(box=scene().box(), focal=300.0)
    )


def test_a_capture_can_be_loaded_and_has_no_poses(made: tuple[Path, Path]) -> None:
    capture = folder.load(made[1])
    assert capture.trajectory is None
    assert capture.light == "camera"
    assert len(capture) >= 8
    assert (made[1] / video_to_capture.PREVIEW).is_file()
    assert len(list(video.read_clip(made[1] / video_to_capture.PREVIEW))) == 20
    assert sorted(p.name for p in made[1].parent.iterdir()) == ["capture", "mein Video.mp4"]


def test_pixels_masks_and_principal_point_belong_together(made: tuple[Path, Path]) -> None:
    """The window is never enlarged, so its pixels are the film's: those of the scene, up to the codec."""
    capture, origin = folder.load(made[1]), files.read_json(made[1] / video_to_capture.PROVENANCE)
    top, left, height, width = origin["window_top_left_height_width"]
    assert (capture.camera.height, capture.camera.width) == (height, width)
    assert capture.camera.fx_fy_cx_cy.tolist() == [300, 300, WIDTH / 2 - left, HEIGHT / 2 - top]
    film = scene()
    for image, mask, said in zip(capture.images.numpy(), capture.masks.numpy(), origin["frames"], strict=True):
        truth = film.object[said["source_frame"]][top : top + height, left : left + width]
        inside = mask == OBJECT

        def off(down: int, right: int) -> float:
            whole = film.pictures[said["source_frame"]].astype(int)  # noqa: B023
            part = whole[top + down : top + down + height, left + right : left + right + width]
            return float(np.abs(image - part)[inside].mean())  # noqa: B023

        # The codec halves the resolution of colour, so nothing is exact; one pixel off is half as far off again.
        assert 1.5 * off(0, 0) < min(off(1, 0), off(-1, 0), off(0, 1), off(0, -1))
        assert (image[mask == BACKGROUND] == 0).all()
        assert overlap(inside, truth & (mask != UNKNOWN)) > 0.75


def test_the_window_holds_the_whole_path_of_the_object(made: tuple[Path, Path]) -> None:
    top, left, height, width = files.read_json(made[1] / video_to_capture.PROVENANCE)["window_top_left_height_width"]
    path = scene().object.any(0)
    assert path[top : top + height, left : left + width].sum() > 0.995 * path.sum()


def test_a_larger_film_is_shrunk_and_its_camera_with_it(tmp_path: Path) -> None:
    """Given masks, of a film four times as large: focal length times the scale, masks thinned to pure pixels."""
    film = scene()
    big = [cv2.resize(p, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC) for p in film.pictures]
    written(np.stack(big), tmp_path / "x.mp4")
    for i, mask in enumerate(film.object):
        large = np.kron(mask.astype(np.uint8) * 255, np.ones((4, 4), np.uint8))
        files.write_png(tmp_path / "m" / f"{i}.png", large[..., None])
    options = FootageOptions(masks=tmp_path / "m", focal=1200.0, size=96)
    out = video_to_capture.capture_from_video(tmp_path / "x.mp4", tmp_path / "out", options)
    capture, origin = folder.load(out), files.read_json(out / video_to_capture.PROVENANCE)
    top, left, height, width = origin["window_top_left_height_width"]
    shrink = 96 / max(height, width)
    assert max(capture.camera.height, capture.camera.width) == 96
    focal_x, focal_y, cx, cy = capture.camera.fx_fy_cx_cy.tolist()
    # Height and width are rounded to whole pixels: half a pixel of 96.
    assert [focal_x, focal_y] == pytest.approx([1200 * shrink] * 2, rel=0.01)
    assert [cx, cy] == pytest.approx([(4 * WIDTH / 2 - left) * shrink, (4 * HEIGHT / 2 - top) * shrink], abs=1.0)
    for mask, said in zip(capture.masks.numpy(), origin["frames"], strict=True):
        truth = np.kron(film.object[said["source_frame"]].astype(np.uint8), np.ones((4, 4), np.uint8))
        part = truth[top : top + height, left : left + width].astype(np.float32)
        share = cv2.resize(part, (mask.shape[1], mask.shape[0]), interpolation=cv2.INTER_AREA)
        assert (share[mask == OBJECT] > 0.98).all()
        assert (share[mask == BACKGROUND] < 0.02).all()


def test_drift_of_the_camera_is_taken_out_of_the_frames(tmp_path: Path) -> None:
    """Red swings by 15 %; after compensation a frame has the red of the film without drift, to 4 codes on average."""
    tinted, plain = scene(tint=0.15), scene()
    film = written(tinted.pictures, tmp_path / "x.mp4")
    out = video_to_capture.capture_from_video(film, tmp_path / "out", FootageOptions(box=tinted.box(), focal=300.0))
    capture, origin = folder.load(out), files.read_json(out / video_to_capture.PROVENANCE)
    top, left, height, width = origin["window_top_left_height_width"]
    before, after = [], []
    for image, mask, said in zip(capture.images.numpy(), capture.masks.numpy(), origin["frames"], strict=True):
        window = np.s_[said["source_frame"], top : top + height, left : left + width, 0]
        wanted = plain.pictures[window].astype(int)[mask == OBJECT]
        after.append((image[..., 0].astype(int)[mask == OBJECT] - wanted).mean())
        before.append((tinted.pictures[window].astype(int)[mask == OBJECT] - wanted).mean())
    assert np.abs(before).max() > 7
    assert np.abs(after).max() < 4


def test_a_folder_of_pictures_with_alpha_keeps_all_of_them(tmp_path: Path) -> None:
    film = scene()
    for i in range(5):
        alpha = np.where(film.object[i], 255, 0).astype(np.uint8)
        files.write_png(tmp_path / "in" / f"{i}.png", np.dstack([film.pictures[i], alpha]))
    capture = folder.load(
        video_to_capture.capture_from_video(tmp_path / "in", tmp_path / "out", FootageOptions(fov=40.0))
    )
    assert len(capture) == 5


def test_an_empty_mask_drops_its_frame_and_only_empty_ones_are_refused(tmp_path: Path) -> None:
    film = scene()
    for i in range(5):
        files.write_png(tmp_path / "in" / "images" / f"{i}.png", film.pictures[i])
        files.write_png(tmp_path / "in" / "masks" / f"{i}.png", (film.object[i] * np.uint8(255 * (i != 2)))[..., None])
    out = video_to_capture.capture_from_video(tmp_path / "in", tmp_path / "out", FootageOptions())
    assert [said["source_frame"] for said in files.read_json(out / video_to_capture.PROVENANCE)["frames"]] == [
        0,
        1,
        3,
        4,
    ]
    for i in range(5):
        files.write_png(tmp_path / "in" / "masks" / f"{i}.png", np.zeros((HEIGHT, WIDTH, 1), np.uint8))
    with pytest.raises(BadFile, match="all are empty"):
        video_to_capture.capture_from_video(tmp_path / "in", tmp_path / "again", FootageOptions())


@pytest.mark.parametrize(
    ("pictures", "options", "message"),
    [
        (scene().pictures[:1], FootageOptions(), "nothing that moves"),
        (scene(still=True).pictures, SHOWN, "turns by"),
        (np.stack([np.roll(p, 2 * i, 1) for i, p in enumerate(scene().pictures)]), SHOWN, "a camera that moved"),
        (scene().pictures, FootageOptions(box=(100, 100, 100, 100)), "the hint lies outside"),
        (scene().pictures, FootageOptions(box=(1, 1, 20, 20), at=99), "--at is 99"),
        (np.repeat(scene().background[None], 8, 0), FootageOptions(), "nothing that moves"),
        (np.zeros((4, 40, 40, 3), np.uint8), FootageOptions(), "is 40 x 40 pixels"),
    ],
)
def test_what_cannot_be_a_capture_is_refused_and_leaves_nothing(
    pictures: np.ndarray, options: FootageOptions, message: str, tmp_path: Path
) -> None:
    film = written(pictures, tmp_path / "x.mp4")
    with pytest.raises(BadFile, match=rf"x\.mp4: .*{message}"):
        video_to_capture.capture_from_video(film, tmp_path / "out", options)
    assert list(tmp_path.iterdir()) == [film]


def test_nothing_is_overwritten_and_a_failure_midway_leaves_nothing(
    made: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(BadFile, match="is there already"):
        video_to_capture.capture_from_video(made[0], made[1])

    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(video_to_capture, "preview", fail)
    with pytest.raises(OSError, match="disk full"):
        video_to_capture.capture_from_video(made[0], tmp_path / "out", FootageOptions(box=scene().box()))
    assert list(tmp_path.iterdir()) == []


def test_long_films_are_thinned_and_endless_ones_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    film = written(scene().pictures, tmp_path / "x.mp4")
    monkeypatch.setattr("tumble.preprocess.survey.SURVEYED", 8)
    found = survey(film, FootageOptions(box=scene().box(), frames=8))
    assert found.numbers.tolist() == [0, 4, 8, 12, 16]
    monkeypatch.setattr("tumble.preprocess.survey.MOST_FRAMES", 10)
    with pytest.raises(BadFile, match="has more than 10 frames"):
        survey(film, FootageOptions(box=scene().box(), frames=8))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"box": (1, 1, 5, 5), "click": (3, 3)}, "give one"),
        ({"box": (1, 1, 0, 5)}, "left, top, width, height"),
        ({"segmenter": "sam2"}, "needs --weights"),
        ({"frames": 1}, "--frames is 3"),
        ({"size": 8}, "--size 64"),
    ],
)
def test_contradicting_options_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FootageOptions(**options)
