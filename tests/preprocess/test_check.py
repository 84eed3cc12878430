"""Good videos pass the check; each fault is detected and reported with advice."""

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.films import scene, written
from tumble import cli
from tumble.io import files
from tumble.preprocess import check as checking
from tumble.preprocess.check import Finding, check_footage, passes
from tumble.preprocess.options import FootageOptions


def findings(pictures: np.ndarray, tmp_path: Path, options: FootageOptions) -> dict[str, Finding]:
    results = check_footage(written(pictures, tmp_path / "x.mp4"), tmp_path / "out", options)
    assert (tmp_path / "out" / "mask_preview.mp4").is_file()
    assert all(bool(finding.advice) == (finding.rating != "good") for finding in results)
    return {finding.subject: finding for finding in results}


OPTIONS = FootageOptions(box=scene().box(), focal=300.0)


def test_a_good_video_passes(tmp_path: Path) -> None:
    results = findings(scene().pictures, tmp_path, OPTIONS)
    assert passes(list(results.values()))
    for subject in ("video", "camera", "masks", "framing", "sharpness", "exposure", "highlights"):
        assert results[subject].rating == "good", results[subject]


def test_a_moving_camera_does_not_pass(tmp_path: Path) -> None:
    """A pan of 2 pixels per frame, 40 of 160 in all."""
    pictures = np.stack([np.roll(p, 2 * i, 1) for i, p in enumerate(scene().pictures)])
    results = findings(pictures, tmp_path, OPTIONS)
    assert results["camera"].rating == "stop"
    assert "tripod" in results["camera"].advice


def test_an_object_that_does_not_rotate_does_not_pass(tmp_path: Path) -> None:
    results = findings(scene(still=True).pictures, tmp_path, OPTIONS)
    assert results["rotation"].rating == "stop"


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
