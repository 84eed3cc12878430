"""Footage on disk: order, masks, orientation and lens, each against what was written."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from tumble.io import files, video
from tumble.io.files import BadFile
from tumble.preprocess import footage
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN

CORNERS = np.zeros((66, 80, 3), np.uint8)
CORNERS[:33, :40], CORNERS[:33, 40:], CORNERS[33:, :40] = (250, 0, 0), (0, 250, 0), (0, 0, 250)
BARE = {"focal": None, "fov": None, "fisheye": None, "distortion": None}


def opened(path: Path, masks: Path | None = None, *, invert: bool = False) -> list[footage.FootageFrame]:
    return list(footage.frames(footage.open_footage(path, masks), invert_masks=invert))


def test_pictures_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for number in (1, 2, 10):
        files.write_png(tmp_path / f"frame{number}.png", np.full((8, 9, 3), number, np.uint8))
    (tmp_path / "notes.txt").write_text("not a picture")
    found = opened(tmp_path)
    assert [int(frame.picture[0, 0, 0]) for frame in found] == [1, 2, 10]
    assert [frame.number for frame in found] == [0, 1, 2]
    assert found[0].mask is None


@pytest.mark.parametrize("name", ["a.png", "a.jpg.png"])
def test_masks_are_found_by_stem_or_by_whole_name(tmp_path: Path, name: str) -> None:
    (tmp_path / "images").mkdir()
    Image.fromarray(CORNERS).save(tmp_path / "images" / "a.jpg")
    mask = np.zeros((66, 80, 1), np.uint8)
    mask[:20], mask[20:30] = 255, 100
    files.write_png(tmp_path / "masks" / name, mask)
    (frame,) = opened(tmp_path)
    assert frame.mask is not None
    assert frame.mask[[0, 25, 50], 0].tolist() == [OBJECT, UNKNOWN, BACKGROUND]
    (other,) = opened(tmp_path, invert=True)
    assert other.mask is not None
    assert other.mask[[0, 25, 50], 0].tolist() == [BACKGROUND, UNKNOWN, OBJECT]


def test_alpha_is_a_mask_and_a_mask_of_zeros_and_ones_counts(tmp_path: Path) -> None:
    rgba = np.full((10, 10, 4), 200, np.uint8)
    rgba[..., 3] = 0
    rgba[:5, :, 3] = 255
    files.write_png(tmp_path / "x" / "a.png", rgba)
    (frame,) = opened(tmp_path / "x")
    assert frame.mask is not None
    assert frame.mask[[0, 9], 0].tolist() == [OBJECT, BACKGROUND]
    files.write_png(tmp_path / "m" / "a.png", (rgba[..., 3:] > 0).astype(np.uint8))
    (frame,) = opened(tmp_path / "x", tmp_path / "m")
    assert frame.mask is not None
    assert frame.mask[[0, 9], 0].tolist() == [OBJECT, BACKGROUND]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_are_turned_upright(tmp_path: Path, orientation: int) -> None:
    """Pillow's own transposition is the oracle."""
    from PIL import ImageOps

    picture = Image.fromarray(CORNERS)
    exif = picture.getexif()
    exif[0x0112] = orientation
    picture.save(tmp_path / "a.png", exif=exif)
    with Image.open(tmp_path / "a.png") as stored:
        expected = np.asarray(ImageOps.exif_transpose(stored))
    assert np.array_equal(opened(tmp_path)[0].picture, expected)


def test_masks_of_a_film_are_one_per_frame_in_order(tmp_path: Path) -> None:
    film = tmp_path / "ein Video.mp4"
    video.write_clip(film, [CORNERS] * 3)
    for i in range(3):
        files.write_png(tmp_path / "m" / f"{i}.png", np.full((66, 80, 1), 255 * (i == 1), np.uint8))
    found = opened(film, tmp_path / "m")
    assert [int(frame.mask[0, 0]) for frame in found if frame.mask is not None] == [0, 255, 0]
    files.write_png(tmp_path / "m" / "3.png", np.full((66, 80, 1), 255, np.uint8))
    with pytest.raises(BadFile, match="holds 4 masks, the film has 3 frames"):
        opened(film, tmp_path / "m")
    (tmp_path / "m" / "3.png").unlink()
    (tmp_path / "m" / "2.png").unlink()
    with pytest.raises(BadFile, match="holds 2 masks, the film has more frames"):
        opened(film, tmp_path / "m")


def test_bad_folders_are_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(BadFile, match="holds no pictures"):
        footage.open_footage(tmp_path / "empty")
    files.write_png(tmp_path / "a" / "1.png", np.zeros((8, 9, 3), np.uint8))
    files.write_png(tmp_path / "a" / "2.png", np.zeros((9, 9, 3), np.uint8))
    with pytest.raises(BadFile, match=r"2\.png: frame 1 is 9 x 9, the first 9 x 8"):
        opened(tmp_path / "a")
    with pytest.raises(BadFile, match=r"has no mask for 1\.png"):
        footage.open_footage(tmp_path / "a", tmp_path / "empty")
    files.write_png(tmp_path / "m" / "1.png", np.zeros((4, 4, 1), np.uint8))
    files.write_png(tmp_path / "m" / "2.png", np.zeros((9, 9, 1), np.uint8))
    with pytest.raises(BadFile, match=r"1\.png: is 4 x 4 pixels, its frame is 9 x 8"):
        opened(tmp_path / "a", tmp_path / "m")
    Image.fromarray(np.zeros((8, 9, 3), np.uint8)).save(tmp_path / "a" / "1.jpg")
    with pytest.raises(BadFile, match=r"holds both 1\..* and 1\."):
        footage.open_footage(tmp_path / "a")


def test_the_focal_length_is_given_read_or_guessed(tmp_path: Path) -> None:
    picture = Image.fromarray(CORNERS)
    picture.save(tmp_path / "a.png")
    bare = footage.open_footage(tmp_path)
    guess = footage.lens(bare, 66, 80, **BARE)
    assert guess.source == "guess"
    assert guess.camera.fx_fy_cx_cy.tolist() == pytest.approx(
        [28 / math.hypot(36, 24) * math.hypot(66, 80)] * 2 + [40, 33]
    )
    given = footage.lens(bare, 66, 80, **{**BARE, "fov": 90.0})
    assert given.source == "given"
    assert float(given.camera.fx_fy_cx_cy[0]) == pytest.approx(40)
    exif = picture.getexif()
    exif.get_ifd(0x8769)[0xA405] = 50
    picture.save(tmp_path / "a.jpg", exif=exif)
    (tmp_path / "a.png").unlink()
    read = footage.lens(footage.open_footage(tmp_path), 66, 80, **BARE)
    assert read.source == "metadata"
    # On 36 x 24 mm a lens of 50 mm sees 46.8 degrees along the diagonal.
    diagonal = 2 * math.degrees(math.atan(math.hypot(66, 80) / 2 / float(read.camera.fx_fy_cx_cy[0])))
    assert diagonal == pytest.approx(46.8, abs=0.05)


def test_a_fisheye_is_undone(tmp_path: Path) -> None:
    """Equidistant lens, r = f theta: a dot at 40 degrees goes to f tan 40 degrees of the pinhole camera."""
    files.write_png(tmp_path / "a.png", CORNERS)
    focal, theta = 90.0, math.radians(40)
    glass = footage.lens(
        footage.open_footage(tmp_path), 240, 320, **{**BARE, "focal": focal, "fisheye": (0.0, 0.0, 0.0, 0.0)}
    )
    assert glass.undistort is not None
    seen = np.zeros((240, 320, 3), np.uint8)
    # A pixel's centre is half a pixel from its corner.
    cv2.circle(seen, (round(160 + focal * theta - 0.5), 120), 2, (255, 255, 255), -1)
    rows, columns = np.nonzero(glass.undistort(seen, cv2.INTER_LINEAR)[..., 0] > 100)
    assert columns.mean() + 0.5 == pytest.approx(160 + focal * math.tan(theta), abs=1.0)
    assert rows.mean() + 0.5 == pytest.approx(120.5, abs=0.6)
    fov = footage.lens(
        footage.open_footage(tmp_path), 240, 320, **{**BARE, "fov": 180.0, "fisheye": (0.0, 0.0, 0.0, 0.0)}
    )
    assert float(fov.camera.fx_fy_cx_cy[0]) == pytest.approx(320 / math.pi, rel=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fov": 500.0}, "--fov is out of range"),
        ({"focal": -1.0}, "--focal must be positive"),
        ({"fisheye": (0.0,) * 4, "distortion": (0.0,) * 4}, "two lens models"),
    ],
)
def test_impossible_lenses_are_refused(tmp_path: Path, change: dict, message: str) -> None:
    files.write_png(tmp_path / "a.png", CORNERS)
    with pytest.raises(ValueError, match=message):
        footage.lens(footage.open_footage(tmp_path), 66, 80, **{**BARE, **change})
