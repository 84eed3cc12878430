"""Image and JSON files: written values are read back, and invalid files raise an error with the file, rule and fix."""

from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from tumble.io import files, limits
from tumble.io.files import BadFile

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_png_keeps_every_code_value(tmp_path: Path, channels: int) -> None:
    values = RNG.integers(0, 256, (5, 7, channels), dtype=np.uint8)
    files.write_png(tmp_path / "a" / "x.png", values)
    assert np.array_equal(files.read_image(tmp_path / "a" / "x.png"), values)
    assert files.image_size(tmp_path / "a" / "x.png") == (5, 7)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("half", [True, False])
def test_exr_keeps_linear_values(tmp_path: Path, channels: int, half: bool) -> None:
    values = RNG.gamma(1.0, 3.0, (5, 7, channels)).astype(np.float32)
    files.write_exr(tmp_path / "x.exr", values, half=half)
    # Half precision has 11 significant bits.
    np.testing.assert_allclose(files.read_radiance(tmp_path / "x.exr"), values, rtol=2**-11 if half else 0)


def test_hdr_keeps_eight_bits_of_the_brightest_channel(tmp_path: Path) -> None:
    values = (RNG.random((5, 8, 3)) * [1.0, 10.0, 1000.0]).astype(np.float32)
    files.write_hdr(tmp_path / "x.hdr", values)
    brightest = values.max(-1, keepdims=True)
    assert (np.abs(files.read_radiance(tmp_path / "x.hdr") - values) / brightest).max() < 1 / 128


def test_a_failed_write_leaves_no_file(tmp_path: Path) -> None:
    def fail(partial: Path) -> None:
        partial.write_bytes(b"incomplete")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        files.write_atomically(tmp_path / "x.png", fail)
    assert list(tmp_path.iterdir()) == []


def test_json_has_no_nan_in_either_direction(tmp_path: Path) -> None:
    files.write_json(tmp_path / "x.json", {"a": float("nan"), "b": [1.5, float("inf")]})
    assert files.read_json(tmp_path / "x.json") == {"a": None, "b": [1.5, None]}
    (tmp_path / "y.json").write_text('{"a": NaN}')
    with pytest.raises(BadFile, match=r"y\.json: is not valid JSON: .*no NaN"):
        files.read_json(tmp_path / "y.json")


@pytest.mark.parametrize("name", ["x.exr", "x.hdr", "x.png", "x.json"])
def test_errors_name_invalid_and_missing_files(tmp_path: Path, name: str) -> None:
    read = {".png": files.read_image, ".json": files.read_json}.get(Path(name).suffix, files.read_radiance)
    with pytest.raises(BadFile, match=f"{name}: is missing"):
        read(tmp_path / name)
    (tmp_path / name).write_bytes(b"\x00junk" * 50)
    with pytest.raises(BadFile, match=name):
        read(tmp_path / name)


@pytest.mark.parametrize("name", ["x.exr", "x.hdr", "x.png"])
def test_truncated_files_are_rejected_and_libraries_print_nothing(
    tmp_path: Path, name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    values = RNG.random((64, 64, 3)).astype(np.float32)
    {".exr": files.write_exr, ".hdr": files.write_hdr}.get(
        Path(name).suffix, lambda path, v: files.write_png(path, (v * 255).astype(np.uint8))
    )(tmp_path / name, values)
    whole = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(whole[: len(whole) // 2])
    read = files.read_image if name.endswith("png") else files.read_radiance
    with pytest.raises(BadFile, match=name):
        read(tmp_path / name)
    assert capfd.readouterr() == ("", "")


def test_too_large_images_are_rejected_before_decoding(tmp_path: Path) -> None:
    (tmp_path / "x.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 100000 +X 200000\n")
    with pytest.raises(BadFile, match="over the limit"):
        files.read_radiance(tmp_path / "x.hdr")


def test_limits_count_the_bytes_of_all_channels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three channels of 64 x 128 floats have 96 KiB, with sixteen more 608."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    names = ["R", "G", "B", *(f"layer{i}" for i in range(16))]
    OpenEXR.File(header, {name: np.zeros((64, 128), np.float32) for name in names}).write(str(tmp_path / "x.exr"))
    files.write_exr(tmp_path / "rgb.exr", np.zeros((64, 128, 3), np.float32))
    monkeypatch.setattr(limits, "MAX_DECODED_BYTES", 100 << 10)
    assert files.read_radiance(tmp_path / "rgb.exr").shape == (64, 128, 3)
    with pytest.raises(BadFile, match=r"x\.exr: holds 128 x 64 pixels of 76 bytes"):
        files.read_radiance(tmp_path / "x.exr")


def test_limits_count_the_bytes_of_all_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    planes = {name: np.zeros((64, 128), np.float32) for name in "RGB"}
    parts = [OpenEXR.Part({**header, "name": f"part{i}"}, planes) for i in range(3)]
    OpenEXR.File(parts).write(str(tmp_path / "x.exr"))
    assert files.read_radiance(tmp_path / "x.exr").shape == (64, 128, 3)
    monkeypatch.setattr(limits, "MAX_DECODED_BYTES", 200 << 10)
    with pytest.raises(BadFile, match=r"x\.exr: holds 3 parts"):
        files.read_radiance(tmp_path / "x.exr")


def test_an_image_that_is_millions_of_pixels_wide_is_rejected(tmp_path: Path) -> None:
    """OpenCV raises an error of its own above 2^20 pixels a side, and its functions end at 2^15."""
    (tmp_path / "x.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 4000000\n" + bytes(16_000_000))
    with pytest.raises(BadFile, match="has 4000000 x 1 pixels, over the limit"):
        files.read_radiance(tmp_path / "x.hdr")


def test_a_document_names_files_in_utf8_only(tmp_path: Path) -> None:
    """File names can be any bytes; a document with such a name could be written, but not be read again."""
    files.write_json(tmp_path / "x.json", {"path": "caf\u00e9 \U0001f600"})
    assert files.read_json(tmp_path / "x.json") == {"path": "caf\u00e9 \U0001f600"}
    with pytest.raises(BadFile, match=r"y\.json: would name a file .*caf\\udce9.* \(rename it\)"):
        files.write_json(tmp_path / "y.json", {"path": "/home/caf\udce9/x"})
    assert not (tmp_path / "y.json").exists()


def test_a_document_is_validated_with_its_keys(tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text('{"a": [{"b": 1}, {"b": null}]}')
    with pytest.raises(BadFile, match=r'x\.json: "\[\.\.\.\]\[1\]\[\.\.\.\]": expected int, got null'):
        files.read_json(tmp_path / "x.json", dict[str, list[dict[str, int]]])


def test_control_characters_of_file_names_are_escaped_in_messages(tmp_path: Path) -> None:
    with pytest.raises(BadFile, match=r"a\\nb\\x1b\.png: is missing") as error:
        files.read_image(tmp_path / "a\nb\x1b.png")
    assert len(str(error.value).splitlines()) == 1


def test_non_finite_pixels_are_rejected(tmp_path: Path) -> None:
    files.write_exr(tmp_path / "x.exr", np.full((2, 2, 1), np.nan, np.float32))
    with pytest.raises(BadFile, match="NaN"):
        files.read_radiance(tmp_path / "x.exr")


def test_sixteen_bit_images_are_rejected_with_the_fix(tmp_path: Path) -> None:
    from PIL import Image

    Image.fromarray(np.zeros((2, 2), np.uint16)).save(tmp_path / "x.png")
    with pytest.raises(BadFile, match="8-bit sRGB"):
        files.read_image(tmp_path / "x.png")


@pytest.mark.parametrize("name", ["../x", "/etc/passwd", "a/../../x"])
def test_paths_outside_the_folder_are_rejected(tmp_path: Path, name: str) -> None:
    with pytest.raises(BadFile, match="leaves the folder"):
        files.path_inside(tmp_path, name)


def test_links_outside_the_folder_are_rejected(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "link").symlink_to(tmp_path)
    with pytest.raises(
        BadFile, match=rf"in/link: is a link to {tmp_path}, outside of .*in \(copy the files there; links"
    ):
        files.path_inside(tmp_path / "in", "link/x.png")
    with pytest.raises(BadFile, match="leaves the folder"):
        files.path_inside(tmp_path / "in", "link/../../x.png")
