"""Good videos pass the check; each fault is detected and reported with advice."""

import re
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.films import scene, written
from tests.preprocess.test_propagation import landmarks
from tumble import cli
from tumble.io import BadFile, files
from tumble.preprocess import check as checking
from tumble.preprocess import survey
from tumble.preprocess.check import Finding, check_footage, passes
from tumble.preprocess.colour_model import hand_coloured_fraction
from tumble.preprocess.options import FootageOptions
from tumble.preprocess.survey import Survey, survey_footage
from tumble.preprocess.video_to_capture import select_frames
from tumble.scene import BACKGROUND, OBJECT


def findings(pictures: np.ndarray, tmp_path: Path, options: FootageOptions) -> dict[str, Finding]:
    results = check_footage(written(pictures, tmp_path / "x.mp4"), tmp_path / "out", options)
    assert (tmp_path / "out" / "mask_preview.mp4").is_file()
    assert all(bool(finding.advice) == (finding.rating != "good") for finding in results)
    return {finding.subject: finding for finding in results}


OPTIONS = FootageOptions(box=scene().box(), focal=300.0)


def test_a_good_video_passes(tmp_path: Path) -> None:
    results = findings(scene().pictures, tmp_path, OPTIONS)
    assert passes(list(results.values()))
    for subject in ("video", "camera", "masks", "worst", "framing", "sharpness", "exposure", "highlights"):
        assert results[subject].rating == "good", results[subject]


def test_a_moving_camera_does_not_pass(tmp_path: Path) -> None:
    """A pan of 2 pixels per frame, 40 of 160 in all."""
    pictures = np.stack([np.roll(p, 2 * i, 1) for i, p in enumerate(scene().pictures)])
    results = findings(pictures, tmp_path, OPTIONS)
    assert results["camera"].rating == "stop"
    assert "tripod" in results["camera"].advice


def test_masks_of_ones_own_admit_a_moving_camera_and_keep_the_colours(tmp_path: Path) -> None:
    """The brightness of a wall that passes by says nothing about the exposure of the object in front of it."""
    video = scene()
    wall = np.tile(np.concatenate([video.background, video.background[:, ::-1]], 1), (1, 2, 1))
    wall = (wall * np.linspace(0.5, 1, wall.shape[1])[:, None]).astype(np.uint8)
    width = video.pictures.shape[2]
    behind = np.stack([wall[:, 9 * i : 9 * i + width] for i in range(len(video.pictures))])
    pictures = np.where(video.object[..., None], video.pictures, behind)
    for i, mask in enumerate(video.object):
        files.write_png(tmp_path / "m" / f"{i}.png", (mask * np.uint8(255))[..., None])
    results = findings(pictures, tmp_path, FootageOptions(masks=tmp_path / "m", focal=300.0))
    assert results["camera"].rating == "warn"
    assert results["exposure"].rating == "good", results["exposure"].state


def test_an_object_that_does_not_rotate_does_not_pass(tmp_path: Path) -> None:
    results = findings(scene(still=True).pictures, tmp_path, OPTIONS)
    assert results["rotation"].rating == "stop"


def test_an_object_that_is_turned_to_and_fro_is_not_good(tmp_path: Path) -> None:
    """It adds up to much, but shows no other side."""
    n = len(scene().pictures)
    there = [*range(6), *range(6, 0, -1)]
    results = findings(scene().pictures[(there * n)[:n]], tmp_path, OPTIONS)
    assert results["rotation"].rating != "good"
    assert "no two frames are more than about" in results["rotation"].state


def test_an_object_at_the_border_does_not_pass(tmp_path: Path) -> None:
    """The image is cropped through the middle of the object."""
    left, top, width, height = scene().box()
    cut = left + width // 2 // 2 * 2
    options = FootageOptions(box=(left, top, cut - left, height), focal=300.0)
    results = findings(np.ascontiguousarray(scene().pictures[:, :, : cut // 2 * 2]), tmp_path, options)
    assert results["framing"].rating == "stop"


def test_drift_and_blur_are_reported(tmp_path: Path) -> None:
    blurred = np.stack([cv2.GaussianBlur(p, (0, 0), 3.0) for p in scene(tint=0.15).pictures])
    for i, mask in enumerate(scene().object):
        files.write_png(tmp_path / "m" / f"{i}.png", (mask * np.uint8(255))[..., None])
    results = findings(blurred, tmp_path, FootageOptions(masks=tmp_path / "m", focal=300.0))
    assert results["sharpness"].rating != "good"
    assert results["exposure"].rating == "warn"
    assert "colours by" in results["exposure"].state


def test_a_drift_of_more_than_a_stop_is_a_warning_because_it_is_corrected(tmp_path: Path) -> None:
    """A film of a real hand whose exposure drifted by 1.25 stops ended in poses that were right to 1.5 degrees."""
    pictures = scene().pictures
    dimmed = (pictures * np.geomspace(1, 0.65, len(pictures))[:, None, None, None]).astype(np.uint8)
    for i, mask in enumerate(scene().object):
        files.write_png(tmp_path / "m" / f"{i}.png", (mask * np.uint8(255))[..., None])
    results = findings(dimmed, tmp_path, FootageOptions(masks=tmp_path / "m", focal=300.0))
    assert "drifts by 1." in results["exposure"].state
    assert results["exposure"].rating == "warn"


@pytest.fixture(scope="module")
def surveyed(tmp_path_factory: pytest.TempPathFactory) -> Survey:
    """Survey of a film with a hand; its masks are replaced by the true ones."""
    video = scene(hand=True)
    path = written(video.pictures, tmp_path_factory.mktemp("film") / "x.mp4")
    survey = survey_footage(path, FootageOptions(box=video.box(), focal=300.0))
    return with_masks(survey, np.where(video.object, np.uint8(OBJECT), np.uint8(BACKGROUND)))


def with_masks(survey: Survey, labels: np.ndarray, fraction: np.ndarray | float = 0.0) -> Survey:
    found = (labels == OBJECT).any((1, 2))
    masks = replace(survey.masks, labels=labels, confidence=found.astype(np.float32), uncertain=~found)
    return replace(survey, masks=masks, hand_coloured=np.zeros(len(labels), np.float32) + np.float32(fraction))


def test_the_two_spoilt_frames_are_named(surveyed: Survey) -> None:
    """On one the mask is empty; on the other two thirds of it are missing."""
    assert checking._worst(surveyed) == Finding("worst", "good", "no frame stands out")
    labels = surveyed.masks.labels.copy()
    labels[6] = BACKGROUND
    columns = np.nonzero((labels[14] == OBJECT).any(0))[0]
    labels[14, :, columns[len(columns) // 3] :] = BACKGROUND
    worst = checking._worst(with_masks(surveyed, labels))
    assert worst.rating == "warn"
    assert re.findall(r"frame (\d+)", worst.state) == ["6", "14"]
    assert "frame 6: the object is not found" in worst.state
    assert re.search(r"frame 14: 0\.\d times the area", worst.state)
    assert "--pick" in worst.advice


def test_a_frame_with_a_doubtful_mask_is_not_selected(surveyed: Survey) -> None:
    sure = select_frames(surveyed, OPTIONS)
    confidence = surveyed.masks.confidence.copy()
    confidence[sure[3]] = 0.1
    found = select_frames(replace(surveyed, masks=replace(surveyed.masks, confidence=confidence)), OPTIONS)
    assert sure[3] not in found
    assert {sure[0], sure[-1]} <= set(found)


def test_a_mask_with_a_hand_is_named(surveyed: Survey) -> None:
    """A frame's mask contains a hand that the other masks leave out."""
    video = scene(hand=True)
    hands = [[landmarks(i)] for i in range(len(video.pictures))]
    labels = surveyed.masks.labels.copy()
    labels[10][video.hand[10]] = OBJECT
    inside = labels == OBJECT
    fraction = hand_coloured_fraction(surveyed.images, inside, hands, surveyed.background)
    assert fraction[10] == pytest.approx((inside[10] & video.hand[10]).sum() / inside[10].sum(), abs=0.1)
    assert np.delete(fraction, 10).max() < checking.MAX_HAND_COLOURED
    worst = checking._worst(with_masks(surveyed, labels, fraction))
    assert re.findall(r"frame (\d+): \d+ % of the mask has the hand's colours", worst.state) == ["10"]
    assert hand_coloured_fraction(surveyed.images, inside, [[] for _ in hands], surveyed.background).max() == 0


@pytest.mark.parametrize(("part", "counts"), [(0.2, False), (0.3, True)])
def test_a_print_that_passes_for_a_hand_in_some_frames_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: float, counts: bool
) -> None:
    path = written(scene().pictures, tmp_path / "x.mp4")
    without = survey_footage(path, OPTIONS)
    n = len(without.images)
    hands = [[landmarks(i)] if i < part * n else [] for i in range(n)]
    monkeypatch.setattr(survey, "track_hands", lambda images: hands)
    found = survey_footage(path, OPTIONS)
    assert any(found.hands) == counts
    assert np.array_equal(found.masks.labels, without.masks.labels) != counts


def test_limits_may_rise_or_fall() -> None:
    assert [checking._rate(v, (1.0, 2.0)) for v in (0.5, 1.5, 2.5)] == ["good", "warn", "stop"]
    assert [checking._rate(v, (2.0, 1.0)) for v in (2.5, 1.5, 0.5)] == ["good", "warn", "stop"]


@pytest.mark.parametrize(("still", "code", "word"), [(False, 0, "GO:"), (True, 1, "NO-GO:")])
def test_the_command_prints_the_result_and_sets_the_exit_code(
    still: bool,
    code: int,
    word: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    video = written(scene(still=still).pictures, tmp_path / "mein Video.mp4")
    box = [str(v) for v in scene().box()]
    arguments = ["tumble", "check", str(video), "--box", *box, "--focal", "300", "-o", str(tmp_path / "o")]
    monkeypatch.setattr(sys, "argv", arguments)
    try:
        cli.main()
        ended = 0
    except SystemExit as end:
        ended = int(end.code or 0)
    out = capsys.readouterr().out
    assert ended == code
    assert out.splitlines()[-1].startswith(word)
    assert "focal length 300 pixels (given)" in out


def test_the_preview_of_another_film_is_not_replaced(tmp_path: Path) -> None:
    """Films of the same name in two folders have the same default folder; overwrite insists."""
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    films = [written(scene(8).pictures, tmp_path / name / "x.mp4") for name in "ab"]
    options = FootageOptions(box=scene(8).box(), focal=300.0)
    for _ in range(2):
        check_footage(films[0], tmp_path / "out", options)
    with pytest.raises(BadFile, match=rf"out: holds the preview of {films[0]} \(choose another place"):
        check_footage(films[1], tmp_path / "out", options)
    check_footage(films[1], tmp_path / "out", options, overwrite=True)
    assert files.read_json(tmp_path / "out" / checking.SOURCE_FILE) == {"footage": str(films[1])}
