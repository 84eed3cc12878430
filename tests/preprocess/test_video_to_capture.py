"""Conversion of footage to a capture folder: images, masks and camera are those of the synthetic video."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests.films import HEIGHT, WIDTH, scene, written
from tests.preprocess.test_propagation import landmarks
from tumble.datasets import folder
from tumble.demo import bundled_folder
from tumble.io import files, video
from tumble.io.files import BadFile
from tumble.preprocess import survey, video_to_capture
from tumble.preprocess.background import Background
from tumble.preprocess.hands import Hand, track_hands
from tumble.preprocess.options import FootageOptions
from tumble.preprocess.segmentation import Masks, overlap
from tumble.preprocess.survey import survey_footage
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN

WITH_BOX = FootageOptions(box=scene().box())


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A video in a folder whose name has spaces and umlauts, and its capture."""
    root = tmp_path_factory.mktemp("drei Dinge – ä")
    path = written(scene().pictures, root / "mein Video.mp4")
    return path, video_to_capture.capture_from_video(
        path, root / "capture", FootageOptions(box=scene().box(), focal=300.0)
    )


def test_a_capture_from_video_can_be_loaded_and_has_no_poses(made: tuple[Path, Path]) -> None:
    capture = folder.load(made[1])
    assert capture.trajectory is None
    assert capture.light == "camera"
    assert len(capture) >= 8
    assert (made[1] / video_to_capture.PREVIEW).is_file()
    assert len(list(video.read_clip(made[1] / video_to_capture.PREVIEW))) == 20
    assert sorted(p.name for p in made[1].parent.iterdir()) == ["capture", "mein Video.mp4"]


def test_images_masks_and_principal_point_are_consistent(made: tuple[Path, Path]) -> None:
    """The window is never enlarged, so its pixels are those of the video, up to compression."""
    capture, provenance = folder.load(made[1]), files.read_json(made[1] / video_to_capture.PROVENANCE)
    top, left, height, width = provenance["window_top_left_height_width"]
    assert (capture.camera.height, capture.camera.width) == (height, width)
    assert capture.camera.fx_fy_cx_cy.tolist() == [300, 300, WIDTH / 2 - left, HEIGHT / 2 - top]
    synthetic = scene()
    for image, mask, record in zip(capture.images.numpy(), capture.masks.numpy(), provenance["frames"], strict=True):
        truth = synthetic.object[record["source_frame"]][top : top + height, left : left + width]
        inside = mask == OBJECT

        def difference(down: int, right: int) -> float:
            full = synthetic.pictures[record["source_frame"]].astype(int)  # noqa: B023
            part = full[top + down : top + down + height, left + right : left + right + width]
            return float(np.abs(image - part)[inside].mean())  # noqa: B023

        # Not exact, because the codec halves the resolution of colour; a shift by a pixel is 1.5 times as different.
        assert 1.5 * difference(0, 0) < min(difference(1, 0), difference(-1, 0), difference(0, 1), difference(0, -1))
        assert (image[mask == BACKGROUND] == 0).all()
        assert overlap(inside, truth & (mask != UNKNOWN)) > 0.75


def test_only_frames_of_a_held_object_are_kept_with_their_background(made: tuple[Path, Path], tmp_path: Path) -> None:
    assert folder.load(made[1]).full_images is None
    assert not (made[1] / "full_images").exists()
    options = FootageOptions(box=scene().box(), focal=300.0)
    surveyed = survey_footage(made[0], options)
    surveyed = replace(surveyed, masks=replace(surveyed.masks, doubted=None))
    held = replace(surveyed, hands=[[landmarks(i)] for i in range(len(surveyed.images))])
    kept = video_to_capture.select_frames(held, options)
    video_to_capture._write(held, kept, video_to_capture.crop_window(held, kept), tmp_path / "held", options)
    capture = folder.load(tmp_path / "held")
    assert capture.full_images is not None
    background = capture.masks == BACKGROUND
    assert torch.equal(capture.full_images[~background], capture.images[~background])
    assert capture.full_images[background].float().mean() > 20
    doubted = np.zeros_like(held.masks.labels, dtype=bool)
    doubted[:, :, : doubted.shape[2] // 2] = True
    held = replace(held, masks=replace(held.masks, doubted=doubted))
    video_to_capture._write(held, kept, video_to_capture.crop_window(held, kept), tmp_path / "doubted", options)
    other = folder.load(tmp_path / "doubted")
    assert torch.equal(other.images, capture.images), "doubted background is black"
    now_unknown = background & (other.masks == UNKNOWN)
    assert torch.equal(other.masks[~now_unknown], capture.masks[~now_unknown])
    assert 0.2 < now_unknown.sum() / background.sum() < 0.8


@pytest.mark.parametrize(("known", "expected"), [((0.3, 0.3), 2), ((0.0, 0.3), 3)])
def test_masks_are_segmented_again_while_much_more_of_the_background_is_known(
    made: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, known: tuple[float, float], expected: int
) -> None:
    """`known` is the background that is known in each round beside that before, as a fraction of the object's area."""
    runs, rounds = [], iter(known)
    segment = survey._masks
    monkeypatch.setattr(survey, "_masks", lambda *arguments: runs.append(segment(*arguments)) or runs[-1])

    def uncovered(images: np.ndarray, masks: Masks, background: Background) -> Background:
        more = background.known.copy()
        more.flat[: int(next(rounds) * (masks.labels[0] == OBJECT).sum())] = True
        return replace(background, known=more)

    def nothing_known_above(*arguments: object) -> Background:
        found = filled(*arguments)
        less = found.known.copy()
        less[: len(less) // 4] = False
        return replace(found, known=less)

    filled = survey.fill_unknown
    monkeypatch.setattr(survey, "fill_unknown", nothing_known_above)
    monkeypatch.setattr(survey, "_uncovered_background", uncovered)
    survey_footage(made[0], WITH_BOX)
    assert len(runs) == expected


def test_the_window_contains_the_whole_path_of_the_object(made: tuple[Path, Path]) -> None:
    top, left, height, width = files.read_json(made[1] / video_to_capture.PROVENANCE)["window_top_left_height_width"]
    union = scene().object.any(0)
    assert union[top : top + height, left : left + width].sum() > 0.995 * union.sum()


def test_a_larger_video_is_downsampled_and_its_camera_with_it(tmp_path: Path) -> None:
    """With the masks of a video four times as large: the focal length is scaled, and mixed mask pixels are unknown.

    96 pixels are the size of a window around the object; its path is longer.
    """
    synthetic = scene()
    large = [cv2.resize(p, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC) for p in synthetic.pictures]
    written(np.stack(large), tmp_path / "x.mp4")
    for i, mask in enumerate(synthetic.object):
        enlarged = np.kron(mask.astype(np.uint8) * 255, np.ones((4, 4), np.uint8))
        files.write_png(tmp_path / "m" / f"{i}.png", enlarged[..., None])
    options = FootageOptions(masks=tmp_path / "m", focal=1200.0, size=96)
    out = video_to_capture.capture_from_video(tmp_path / "x.mp4", tmp_path / "out", options)
    capture, provenance = folder.load(out), files.read_json(out / video_to_capture.PROVENANCE)
    top, left, height, width = provenance["window_top_left_height_width"]
    sides = [4 * max(np.ptp(np.nonzero(mask), axis=1) + 1) for mask in synthetic.object]
    shrink = 96 / ((1 + 2 * video_to_capture.MARGIN) * np.quantile(sides, video_to_capture.USUAL_EXTENT))
    longer = max(capture.camera.height, capture.camera.width)
    assert longer == pytest.approx(shrink * max(height, width), rel=0.02)
    assert 96 < longer < video_to_capture.MAX_LARGER * 96
    shrink = longer / max(height, width)
    focal_x, focal_y, cx, cy = capture.camera.fx_fy_cx_cy.tolist()
    # Height and width are rounded to whole pixels: half a pixel of 96.
    assert [focal_x, focal_y] == pytest.approx([1200 * shrink] * 2, rel=0.01)
    assert [cx, cy] == pytest.approx([(4 * WIDTH / 2 - left) * shrink, (4 * HEIGHT / 2 - top) * shrink], abs=1.0)
    for mask, record in zip(capture.masks.numpy(), provenance["frames"], strict=True):
        truth = np.kron(synthetic.object[record["source_frame"]].astype(np.uint8), np.ones((4, 4), np.uint8))
        part = truth[top : top + height, left : left + width].astype(np.float32)
        fraction = cv2.resize(part, (mask.shape[1], mask.shape[0]), interpolation=cv2.INTER_AREA)
        assert (fraction[mask == OBJECT] > 0.98).all()
        assert (fraction[mask == BACKGROUND] < 0.02).all()


def test_gain_drift_is_removed_from_the_frames(tmp_path: Path) -> None:
    """Red drifts by 15 %; after compensation the mean red is within 4 code values of the video without drift."""
    tinted, plain = scene(tint=0.15), scene()
    path = written(tinted.pictures, tmp_path / "x.mp4")
    out = video_to_capture.capture_from_video(path, tmp_path / "out", FootageOptions(box=tinted.box(), focal=300.0))
    capture, provenance = folder.load(out), files.read_json(out / video_to_capture.PROVENANCE)
    top, left, height, width = provenance["window_top_left_height_width"]
    before, after = [], []
    for image, mask, record in zip(capture.images.numpy(), capture.masks.numpy(), provenance["frames"], strict=True):
        window = np.s_[record["source_frame"], top : top + height, left : left + width, 0]
        expected = plain.pictures[window].astype(int)[mask == OBJECT]
        after.append((image[..., 0].astype(int)[mask == OBJECT] - expected).mean())
        before.append((tinted.pictures[window].astype(int)[mask == OBJECT] - expected).mean())
    assert np.abs(before).max() > 7
    assert np.abs(after).max() < 4


def test_all_images_of_a_folder_with_alpha_are_selected(tmp_path: Path) -> None:
    synthetic = scene()
    for i in range(5):
        alpha = np.where(synthetic.object[i], 255, 0).astype(np.uint8)
        files.write_png(tmp_path / "in" / f"{i}.png", np.dstack([synthetic.pictures[i], alpha]))
    capture = folder.load(
        video_to_capture.capture_from_video(tmp_path / "in", tmp_path / "out", FootageOptions(fov=40.0))
    )
    assert len(capture) == 5
    for marks in ({"box": (40, 20, 60, 60)}, {"click": (60, 60)}, {"object": ((60, 60, 1),)}):
        with pytest.raises(BadFile, match="has masks, which neither a box nor clicks change"):
            video_to_capture.capture_from_video(tmp_path / "in", tmp_path / "other", FootageOptions(**marks))
        with pytest.raises(ValueError, match="leave them out, or --masks"):
            FootageOptions(masks=tmp_path, **marks)


def test_a_frame_with_an_empty_mask_is_dropped_and_only_empty_masks_are_refused(tmp_path: Path) -> None:
    synthetic = scene()
    for i in range(5):
        files.write_png(tmp_path / "in" / "images" / f"{i}.png", synthetic.pictures[i])
        files.write_png(
            tmp_path / "in" / "masks" / f"{i}.png", (synthetic.object[i] * np.uint8(255 * (i != 2)))[..., None]
        )
    out = video_to_capture.capture_from_video(tmp_path / "in", tmp_path / "out", FootageOptions())
    assert [record["source_frame"] for record in files.read_json(out / video_to_capture.PROVENANCE)["frames"]] == [
        0,
        1,
        3,
        4,
    ]
    for i in range(5):
        files.write_png(tmp_path / "in" / "masks" / f"{i}.png", np.zeros((HEIGHT, WIDTH, 1), np.uint8))
    with pytest.raises(BadFile, match="only empty masks"):
        video_to_capture.capture_from_video(tmp_path / "in", tmp_path / "again", FootageOptions())


@pytest.mark.parametrize(
    ("pictures", "options", "message"),
    [
        (scene().pictures[:1], FootageOptions(), "nothing that moves"),
        (scene(still=True).pictures, WITH_BOX, "rotates by only"),
        (np.stack([np.roll(p, 2 * i, 1) for i, p in enumerate(scene().pictures)]), WITH_BOX, "a moving camera"),
        (scene().pictures, FootageOptions(box=(100, 100, 100, 100)), "the box or click lies outside"),
        (scene().pictures, FootageOptions(box=(1, 1, 20, 20), at=99), "--at is 99"),
        (scene().pictures, FootageOptions(box=(1, 1, 20, 20), part=(2, 9)), "frames 2 to about 9 .* --at is 0"),
        (scene().pictures, FootageOptions(object=((9, 9, 12),), part=(2, 9)), "a click is on frame 12"),
        (scene().pictures, FootageOptions(part=(99, 120)), "begins with frame 99"),
        (np.repeat(scene().background[None], 8, 0), FootageOptions(), "nothing that moves"),
        (np.zeros((4, 40, 40, 3), np.uint8), FootageOptions(), "has 40 x 40 pixels"),
    ],
)
def test_unsuitable_footage_is_refused_and_nothing_is_written(
    pictures: np.ndarray, options: FootageOptions, message: str, tmp_path: Path
) -> None:
    path = written(pictures, tmp_path / "x.mp4")
    with pytest.raises(BadFile, match=rf"x\.mp4: .*{message}"):
        video_to_capture.capture_from_video(path, tmp_path / "out", options)
    assert list(tmp_path.iterdir()) == [path]


def test_nothing_is_overwritten_and_a_failure_leaves_no_files(
    made: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(BadFile, match="exists already"):
        video_to_capture.capture_from_video(made[0], made[1])

    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(video_to_capture, "write_preview", fail)
    with pytest.raises(OSError, match="disk full"):
        video_to_capture.capture_from_video(made[0], tmp_path / "out", FootageOptions(box=scene().box()))
    assert list(tmp_path.iterdir()) == []


def test_prints_that_pass_for_a_hand_do_not_make_a_film_of_hands(monkeypatch: pytest.MonkeyPatch) -> None:
    """The painted pot of the bundled clip shows "hands" on a third of the frames, hardly any of them certain."""
    clip = np.stack(list(video.read_clip(bundled_folder() / "clip.mp4"))[:45:3])
    assert any(track_hands(clip))
    assert not any(survey._hands(clip))
    shape = np.zeros((21, 2), np.float32)
    for presence, counts in ((0.6, False), (0.9, True)):
        shown = [[Hand(shape, presence, 1.0)] if i % 2 else [] for i in range(len(clip))]
        monkeypatch.setattr(survey, "track_hands", lambda _, shown=shown: shown)
        assert any(survey._hands(clip)) == counts


def test_other_masks_of_the_same_name_are_other_footage(tmp_path: Path) -> None:
    path = written(scene().pictures[:2], tmp_path / "x.mp4")
    files.write_png(tmp_path / "m" / "0.png", np.zeros((9, 9, 1), np.uint8))
    options = FootageOptions(masks=tmp_path / "m")
    before = video_to_capture.footage_fingerprint(path, options)
    assert video_to_capture.footage_fingerprint(path, options) == before
    files.write_png(tmp_path / "m" / "0.png", np.ones((9, 9, 1), np.uint8))
    after = video_to_capture.footage_fingerprint(path, options)
    assert after != before
    assert after["footage"] == before["footage"]


def test_a_part_of_a_video_gives_a_capture_of_its_frames(tmp_path: Path) -> None:
    path, last = written(scene().pictures, tmp_path / "x.mp4"), len(scene().pictures) - 4
    options = FootageOptions(box=scene().box(3), at=3, part=(3, last))
    surveyed = survey_footage(path, options)
    assert surveyed.numbers.tolist() == list(range(3, last + 1))
    out = video_to_capture.capture_from_video(path, tmp_path / "out", options)
    record = files.read_json(out / video_to_capture.PROVENANCE)
    assert {3 <= each["source_frame"] <= last for each in record["frames"]} == {True}
    assert record["options"]["part"] == [3, last]
    # Captures made before there was this option have no such entry, and remain valid.
    assert "part" not in video_to_capture.footage_fingerprint(path, FootageOptions())["options"]


def test_long_videos_are_subsampled_and_too_long_ones_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(scene().pictures, tmp_path / "x.mp4")
    monkeypatch.setattr("tumble.preprocess.survey.MAX_SURVEY_FRAMES", 8)
    surveyed = survey_footage(path, FootageOptions(box=scene().box(), frames=8))
    assert surveyed.numbers.tolist() == [0, 4, 8, 12, 16]
    surveyed = survey_footage(path, FootageOptions(box=scene().box(1), at=1, frames=8, part=(1, 15)))
    assert surveyed.numbers.tolist() == [1, 3, 5, 7, 9, 11, 13, 15]
    monkeypatch.setattr("tumble.preprocess.survey.MAX_FRAMES", 10)
    with pytest.raises(BadFile, match="has more than 10 frames"):
        survey_footage(path, FootageOptions(box=scene().box(), frames=8))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"box": (1, 1, 5, 5), "click": (3, 3)}, "give only one"),
        ({"box": (1, 1, 0, 5)}, "left, top, width, height"),
        ({"segmenter": "sam2"}, "needs --weights"),
        ({"frames": 1}, "--frames must be 3"),
        ({"size": 8}, "--size 64"),
        ({"part": (5, 5)}, "the first and the last frame"),
        ({"part": (-1, 5)}, "the first and the last frame"),
    ],
)
def test_contradictory_options_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FootageOptions(**options)
