"""Footage on disk: order, masks, orientation and lens are read as they were written."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from tests.hostile.pictures import stated
from tumble.io import files, video
from tumble.io.files import BadFile
from tumble.preprocess import footage
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN

CORNERS = np.zeros((66, 80, 3), np.uint8)
CORNERS[:33, :40], CORNERS[:33, 40:], CORNERS[33:, :40] = (250, 0, 0), (0, 250, 0), (0, 0, 250)
NO_LENS = {"focal": None, "fov": None, "fisheye": None, "distortion": None}


def opened(path: Path, masks: Path | None = None, *, invert: bool = False) -> list[footage.FootageFrame]:
    return list(footage.read_frames(footage.open_footage(path, masks), invert_masks=invert))


def test_images_are_sorted_by_their_numbers(tmp_path: Path) -> None:
    for number in (1, 2, 10):
        files.write_png(tmp_path / f"frame{number}.png", np.full((8, 9, 3), number, np.uint8))
    (tmp_path / "notes.txt").write_text("not an image")
    frames = opened(tmp_path)
    assert [int(frame.image[0, 0, 0]) for frame in frames] == [1, 2, 10]
    assert [frame.number for frame in frames] == [0, 1, 2]
    assert frames[0].mask is None


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
    (inverted,) = opened(tmp_path, invert=True)
    assert inverted.mask is not None
    assert inverted.mask[[0, 25, 50], 0].tolist() == [BACKGROUND, UNKNOWN, OBJECT]


def test_masks_may_be_alpha_or_have_the_values_0_and_1(tmp_path: Path) -> None:
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


def test_masks_may_be_opaque_images_or_coloured_labels(tmp_path: Path) -> None:
    """Image editors add an opaque alpha channel; DAVIS and VOC label the first object dark red."""
    white = np.zeros((10, 10, 4), np.uint8)
    white[:5, :, :3], white[..., 3] = 255, 255
    label = np.zeros((10, 10, 3), np.uint8)
    label[:5, :, 0] = 128
    for values in (white, label):
        files.write_png(tmp_path / "m" / "a.png", values)
        mask = footage.read_mask(tmp_path / "m" / "a.png", white, False)
        assert mask[[0, 9], 0].tolist() == [OBJECT, BACKGROUND]


def test_images_with_opaque_alpha_have_no_masks_unless_another_has_one(tmp_path: Path) -> None:
    rgba = np.full((10, 10, 4), 255, np.uint8)
    for i in range(2):
        files.write_png(tmp_path / f"{i}.png", rgba)
    assert [frame.mask for frame in opened(tmp_path)] == [None, None]
    rgba[5:, :, 3] = 0
    files.write_png(tmp_path / "2.png", rgba)
    masks = [frame.mask for frame in opened(tmp_path)]
    assert [mask is not None and int((mask == OBJECT).sum()) for mask in masks] == [100, 100, 50]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_images_are_rotated_upright(tmp_path: Path, orientation: int) -> None:
    """Pillow's own transposition is the reference."""
    from PIL import ImageOps

    image = Image.fromarray(CORNERS)
    exif = image.getexif()
    exif[0x0112] = orientation
    image.save(tmp_path / "a.png", exif=exif)
    with Image.open(tmp_path / "a.png") as stored:
        expected = np.asarray(ImageOps.exif_transpose(stored))
    assert np.array_equal(opened(tmp_path)[0].image, expected)


def test_masks_of_a_video_are_one_per_frame_in_order(tmp_path: Path) -> None:
    path = tmp_path / "ein Video.mp4"
    video.write_clip(path, [CORNERS] * 3)
    for i in range(3):
        files.write_png(tmp_path / "m" / f"{i}.png", np.full((66, 80, 1), 255 * (i == 1), np.uint8))
    frames = opened(path, tmp_path / "m")
    assert [int(frame.mask[0, 0]) for frame in frames if frame.mask is not None] == [0, 255, 0]
    files.write_png(tmp_path / "m" / "3.png", np.full((66, 80, 1), 255, np.uint8))
    with pytest.raises(BadFile, match="holds 4 masks, but the video has 3 frames"):
        opened(path, tmp_path / "m")
    (tmp_path / "m" / "3.png").unlink()
    (tmp_path / "m" / "2.png").unlink()
    with pytest.raises(BadFile, match="holds 2 masks, but the video has more frames"):
        opened(path, tmp_path / "m")


def test_a_part_keeps_the_numbers_of_its_frames_and_nothing_after_it_is_read(tmp_path: Path) -> None:
    video.write_clip(tmp_path / "x.mp4", [np.full((66, 80, 3), 20 * i, np.uint8) for i in range(9)])
    for i in range(9):
        files.write_png(tmp_path / "m" / f"{i}.png", np.full((66, 80, 1), 255 * (i == 4), np.uint8))
    film = footage.open_footage(tmp_path / "x.mp4", tmp_path / "m")
    frames = list(footage.read_frames(film, part=(3, 5)))
    assert [frame.number for frame in frames] == [3, 4, 5]
    assert [round(float(frame.image.mean()) / 20) for frame in frames] == [3, 4, 5]
    assert [int(frame.mask[0, 0]) for frame in frames if frame.mask is not None] == [0, 255, 0]
    assert [frame.number for frame in footage.read_frames(film, part=(7, 100))] == [7, 8]
    with pytest.raises(BadFile, match=r"has 9 frames.*begins with frame 9"):
        list(footage.read_frames(film, part=(9, 12)))
    for i in range(9):
        files.write_png(tmp_path / "i" / f"{i}.png", np.full((8, 9 + (i > 5), 3), i, np.uint8))
    frames = list(footage.read_frames(footage.open_footage(tmp_path / "i"), part=(2, 5)))
    assert [int(frame.image[0, 0, 0]) for frame in frames] == [2, 3, 4, 5]


def test_bad_folders_are_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(BadFile, match="holds no images"):
        footage.open_footage(tmp_path / "empty")
    files.write_png(tmp_path / "a" / "1.png", np.zeros((8, 9, 3), np.uint8))
    files.write_png(tmp_path / "a" / "2.png", np.zeros((9, 9, 3), np.uint8))
    with pytest.raises(BadFile, match=r"2\.png: frame 1 has 9 x 9 pixels, the first 9 x 8"):
        opened(tmp_path / "a")
    with pytest.raises(BadFile, match=r"has no mask for 1\.png"):
        footage.open_footage(tmp_path / "a", tmp_path / "empty")
    files.write_png(tmp_path / "m" / "1.png", np.zeros((4, 4, 1), np.uint8))
    files.write_png(tmp_path / "m" / "2.png", np.zeros((9, 9, 1), np.uint8))
    with pytest.raises(BadFile, match=r"1\.png: has 4 x 4 pixels, its frame 9 x 8"):
        opened(tmp_path / "a", tmp_path / "m")
    Image.fromarray(np.zeros((8, 9, 3), np.uint8)).save(tmp_path / "a" / "1.jpg")
    with pytest.raises(BadFile, match=r"holds both 1\..* and 1\."):
        footage.open_footage(tmp_path / "a")


def test_the_focal_length_is_given_or_from_metadata_or_the_default(tmp_path: Path) -> None:
    image = Image.fromarray(CORNERS)
    image.save(tmp_path / "a.png")
    opened_footage = footage.open_footage(tmp_path)
    default = footage.resolve_lens(opened_footage, 66, 80, **NO_LENS)
    assert default.source == "guess"
    assert default.camera.fx_fy_cx_cy.tolist() == pytest.approx(
        [28 / math.hypot(36, 24) * math.hypot(66, 80)] * 2 + [40, 33]
    )
    given = footage.resolve_lens(opened_footage, 66, 80, **{**NO_LENS, "fov": 90.0})
    assert given.source == "given"
    assert float(given.camera.fx_fy_cx_cy[0]) == pytest.approx(40)
    exif = image.getexif()
    exif.get_ifd(0x8769)[0xA405] = 50
    image.save(tmp_path / "a.jpg", exif=exif)
    (tmp_path / "a.png").unlink()
    stated = footage.resolve_lens(footage.open_footage(tmp_path), 66, 80, **NO_LENS)
    assert stated.source == "metadata"
    # On 36 x 24 mm film the diagonal field of view of a 50 mm lens is 46.8 degrees.
    diagonal = 2 * math.degrees(math.atan(math.hypot(66, 80) / 2 / float(stated.camera.fx_fy_cx_cy[0])))
    assert diagonal == pytest.approx(46.8, abs=0.05)


def test_a_fisheye_lens_is_undistorted(tmp_path: Path) -> None:
    """Equidistant lens, r = f theta: a dot at 40 degrees is at f tan 40 degrees in the pinhole camera."""
    files.write_png(tmp_path / "a.png", CORNERS)
    focal, theta = 90.0, math.radians(40)
    lens = footage.resolve_lens(
        footage.open_footage(tmp_path), 240, 320, **{**NO_LENS, "focal": focal, "fisheye": (0.0, 0.0, 0.0, 0.0)}
    )
    assert lens.undistort is not None
    image = np.zeros((240, 320, 3), np.uint8)
    # The centre of a pixel is half a pixel from its corner.
    cv2.circle(image, (round(160 + focal * theta - 0.5), 120), 2, (255, 255, 255), -1)
    rows, columns = np.nonzero(lens.undistort(image, cv2.INTER_LINEAR)[..., 0] > 100)
    assert columns.mean() + 0.5 == pytest.approx(160 + focal * math.tan(theta), abs=1.0)
    assert rows.mean() + 0.5 == pytest.approx(120.5, abs=0.6)
    fov = footage.resolve_lens(
        footage.open_footage(tmp_path), 240, 320, **{**NO_LENS, "fov": 180.0, "fisheye": (0.0, 0.0, 0.0, 0.0)}
    )
    assert float(fov.camera.fx_fy_cx_cy[0]) == pytest.approx(320 / math.pi, rel=1e-6)


def test_a_first_image_that_is_a_decompression_bomb_is_refused(tmp_path: Path) -> None:
    """Its header states 3.6 gigapixels; the EXIF tags are read from it before any pixel."""
    (tmp_path / "a.png").write_bytes(stated(60_000, 60_000))
    with pytest.raises(BadFile, match=r"a\.png: (is over the limit|has 60000 x 60000 pixels)"):
        footage.open_footage(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fov": 500.0}, "--fov is out of range"),
        ({"focal": -1.0}, "--focal is out of range"),
        ({"focal": math.inf}, "--focal is out of range"),
        ({"focal": 1e-30}, "--focal is out of range"),
        ({"distortion": (math.nan, 0.0, 0.0, 0.0)}, "--fisheye and --distortion take"),
        ({"fisheye": (0.0,) * 4, "distortion": (0.0,) * 4}, "different lens models"),
    ],
)
def test_impossible_lenses_are_refused(tmp_path: Path, change: dict, message: str) -> None:
    files.write_png(tmp_path / "a.png", CORNERS)
    with pytest.raises(ValueError, match=message):
        footage.resolve_lens(footage.open_footage(tmp_path), 66, 80, **{**NO_LENS, **change})
