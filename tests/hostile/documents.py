"""Documents: transforms.json, the files of BOP and HO3D, and captures that parse but cannot be real."""

import copy
import json
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tests.hostile.cases import FRAMES, RUN, SIDE, Case, capture, pictures, png, put, transforms

DOCUMENT = r"in/transforms\.json: "
HUGE = 10**400


def edited(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    document = copy.deepcopy(transforms())
    change(document)
    put(folder, {**capture(), "in/transforms.json": json.dumps(document).encode()})


def value_at(keys: tuple[str | int, ...], value: object) -> Callable[[dict[str, Any]], object]:
    def change(document: dict[str, Any]) -> None:
        place: Any = document
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value

    return change


def shown(keys: tuple[str | int, ...]) -> str:
    """A key as the message names it."""
    return "".join(rf"\[{key}\]" if isinstance(key, int) else rf"\.?{key}" for key in keys)


NUMBERS = ("w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "camera_angle_x")
WRONG_NUMBERS = {"word": "long", "list": [1, 2], "dict": {}, "true": True, "10^400": HUGE}
WRONG_SIGNS = ("w", "h", "fl_x", "fl_y", "camera_angle_x")
TEXTS = (
    *(("frames", 0, key) for key in ("file_path", "mask_path", "split", "region", "albedo_path", "relit")),
    *((key,) for key in ("light", "units", "light_path", "setting", "camera_model")),
)
MAY_BE_NULL = ("setting", "camera_model")
WRONG_TEXTS = {"null": None, "number": 3, "list": ["a"], "dict": {"a": 1}}


def keyed(place: tuple[str | int, ...], values: dict[str, Any]) -> Iterator[Case]:
    """A key with several wrong values."""
    for what, value in values.items():
        change = partial(edited, change=value_at(place, value))
        yield Case(f"{'.'.join(map(str, place))} is {what}", change, RUN, DOCUMENT + f'"{shown(place)}')


def keys() -> Iterator[Case]:
    """Every key with every wrong type, and numbers with a wrong sign."""
    for key in NUMBERS:
        yield from keyed((key,), WRONG_NUMBERS)
        yield from keyed(("frames", 1, key), {name: WRONG_NUMBERS[name] for name in ("word", "10^400")})
    for key in WRONG_SIGNS:
        yield from keyed((key,), {"0": 0, "-1.5": -1.5})
    for place in TEXTS:
        fine = {"null"} if place[-1] in MAY_BE_NULL else {"dict"} if place[-1] == "relit" else set()
        yield from keyed(place, {what: value for what, value in WRONG_TEXTS.items() if what not in fine})
    matrix = ("frames", 2, "transform_matrix")
    yield from keyed(matrix, {**WRONG_NUMBERS, "ragged": [[1], [2, 3]], "3 x 4": np.eye(4)[:3].tolist()})
    yield from keyed((*matrix, 1), {**WRONG_NUMBERS, "null": None})
    yield from keyed((*matrix, 0, 3), {**WRONG_NUMBERS, "null": None})
    yield from keyed(("frames",), {**WRONG_TEXTS, "word": "all", "empty": []})


def raw() -> Iterator[Case]:
    """Files that are no JSON object."""
    contents = {
        **{"empty": b"", "null": b"null", "a list": b"[]", "a number": b"3", "a word": b'"frames"', "two": b"{} {}"},
        **{"nested": b"[" * 200_000, "nested frames": b'{"frames":' * 50_000},
        "cut": json.dumps(transforms()).encode()[:99],
        **{"zeros": bytes(1000), "Latin-1": '{"setting": "ü"}'.encode("latin-1"), "UTF-16": "{}".encode("utf-16")},
        **{"NaN": b'{"frames": NaN}', "infinity": b'{"fl_x": -Infinity}', "1e999": b'{"fl_x": 1e999}'},
        **{"comment": b"// no\n{}", "a lone surrogate": b'{"frames": [{"file_path": "\\ud800.png"}], "fl_x": 9}'},
    }
    for name, content in contents.items():
        files = {**capture(), "in/transforms.json": content}
        yield Case(f"transforms.json is {name}", partial(put, contents=files), RUN, r"in(/transforms\.json)?: ")

    def large(folder: Path) -> None:
        put(folder, capture())
        with (folder / "in" / "transforms.json").open("wb") as file:
            file.truncate(1 << 40)

    yield Case("transforms.json has a terabyte", large, RUN, DOCUMENT + "has .* bytes, over the limit")


def paths() -> Iterator[Case]:
    """Names of files that leave the folder or cannot be opened."""
    names = {
        **{"up": "../../etc/passwd", "absolute": "/etc/passwd", "a zero byte": "images/\0.png", "long": "a" * 5000},
        **{"the folder": ".", "a folder": "images", "missing": "images/none.png", "deep": "x/" * 3000 + "a.png"},
    }
    for what, name in names.items():
        for key in ("file_path", "mask_path"):
            change = partial(edited, change=value_at(("frames", 0, key), name))
            yield Case(f"{key} is {what}", change, RUN, r"in[:/]")

    for name in ("images/0000.png", "masks/0000.png", "transforms.json"):
        yield Case(f"{name} is a link to itself", partial(looped, name=name), RUN, r"in[:/]")


def looped(folder: Path, name: str) -> None:
    """A capture with a file that is a link to itself."""
    put(folder, capture())
    link = folder / "in" / name
    link.unlink()
    link.symlink_to(link.name)


def scaled(document: dict[str, Any], factor: float) -> None:
    """Move every camera along its ray to the origin."""
    for frame in document["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] *= factor


def implausible() -> Iterator[Case]:
    """Captures that parse, but that no camera has recorded."""
    everywhere = r"in(/[\w./]+)?: "

    def equal_poses(document: dict[str, Any]) -> None:
        for frame in document["frames"]:
            frame["transform_matrix"] = document["frames"][0]["transform_matrix"]

    changes: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
        "one frame": (lambda d: d.update(frames=d["frames"][:1]), "has 1 frames"),
        "two frames": (lambda d: d.update(frames=d["frames"][:2]), "has 2 frames"),
        "fl_x of 1e30": (lambda d: d.update(fl_x=1e30), "has focal lengths of"),
        "fl_x of 1e-30": (lambda d: d.update(fl_x=1e-30), "has focal lengths of"),
        "fl_y of 1e30": (lambda d: d.update(fl_y=1e30), "has focal lengths of"),
        "fl_y ten times fl_x": (lambda d: d.update(fl_y=400.0), "has focal lengths of 40 and 400"),
        "a field of view of 3e-9": (lambda d: (d.pop("fl_x"), d.update(camera_angle_x=3e-9)), "has focal lengths of"),
        "cx of 1e30": (lambda d: d.update(cx=1e30), "principal point"),
        "cy of -1e9": (lambda d: d.update(cy=-1e9), "principal point"),
        "k1 of 1e30": (lambda d: d.update(k1=1e30), "distortion coefficients"),
        "fisheye k4 of 1e30": (lambda d: d.update(k4=1e30, camera_model="OPENCV_FISHEYE"), "distortion coefficients"),
        "equal poses": (equal_poses, "poses that differ by only 0.00 degrees"),
        "cameras a thousand radii away": (lambda d: scaled(d, 250), "too far from the object"),
        "cameras 1e30 away": (lambda d: scaled(d, 1e30), "too far from the object"),
        "cameras 1e300 away": (lambda d: scaled(d, 1e300), "not a rotation and a translation"),
        "cameras in the centre": (lambda d: scaled(d, 0), "inside the object"),
        "cameras almost in the centre": (lambda d: scaled(d, 0.02), "inside the object"),
        "cameras that look away": (lambda d: scaled(d, -1), "masks that contradict the poses"),
        "a frame with another size": (lambda d: d["frames"][0].update(w=SIDE + 1), "has 24 x 24 pixels, but"),
        "a zoom of a hundred": (lambda d: [f.update(fl_x=4e3, fl_y=4e3) for f in d["frames"][:6]], "differ too much"),
        "no training frame": (lambda d: [f.update(split="eval") for f in d["frames"]], "no training frame"),
        "a frame twice": (lambda d: d["frames"].append(d["frames"][0]), "is there twice"),
        "one pose missing": (lambda d: d["frames"][3].pop("transform_matrix"), "has no pose, but others have"),
        "a mirrored pose": (
            lambda d: d["frames"][3].update(transform_matrix=np.diag([1.0, 1, -1, 1]).tolist()),
            "not a rotation",
        ),
        "a scaled pose": (
            lambda d: d["frames"][3].update(transform_matrix=np.diag([2.0, 2, 2, 1]).tolist()),
            "not a rotation",
        ),
    }
    for name, (change, sentence) in changes.items():
        yield Case(name, partial(edited, change=change), RUN, everywhere + ".*" + sentence)
    for name, value in (("white", 255), ("black", 0), ("grey", 100)):
        blank = png(np.full((SIDE, SIDE), value, np.uint8))
        masks = {f"in/masks/{i:04}.png": blank for i in range(FRAMES)}
        yield Case(f"{name} masks", partial(put, contents={**capture(), **masks}), RUN, "in/.*mask")
    bare = json.dumps({**transforms(posed=False), "frames": [{"file_path": f"images/{i:04}.png"} for i in range(8)]})
    unmasked = {**capture(), "in/transforms.json": bare.encode()}
    yield Case("no masks and no poses", partial(put, contents=unmasked), RUN, "in: shows no background in any mask")


# Other layouts --------------------------------------------------------------------------------------------------------


def bop_files() -> dict[str, Any]:
    """The documents of a valid scene."""
    eye = np.eye(3).ravel().tolist()
    camera = {"cam_K": [40.0, 0, 12, 0, 40, 12, 0, 0, 1]}
    return {
        "in/scene_camera.json": {str(i): dict(camera) for i in range(FRAMES)},
        "in/scene_gt.json": {
            str(i): [{"obj_id": 1, "cam_R_m2c": list(eye), "cam_t_m2c": [0, 0, 900]}] for i in range(FRAMES)
        },
    }


def bop_edited(folder: Path, file: str, keys_: tuple[str | int, ...], value: object) -> None:
    documents = bop_files()
    value_at((file, *keys_), value)(documents)
    put(folder, {name: json.dumps(document).encode() for name, document in documents.items()})
    for i in range(FRAMES):
        images = {f"in/rgb/{i:06}.png": pictures()[f"images/{i:04}.png"]}
        put(folder, {**images, f"in/mask_visib/{i:06}_000000.png": pictures()[f"masks/{i:04}.png"]})


def bop() -> Iterator[Case]:
    """Scenes of BOP."""
    nine = [HUGE, *[0.0] * 8]
    values: dict[str, tuple[str, tuple[str | int, ...], object]] = {
        "ids of mixed types": ("scene_gt", ("2", 0, "obj_id"), "1"),
        "an id of null": ("scene_gt", ("2", 0, "obj_id"), None),
        "an id that is a list": ("scene_gt", ("2", 0, "obj_id"), [1]),
        "another id": ("scene_gt", ("2", 0, "obj_id"), 7),
        "a rotation of 10^400": ("scene_gt", ("2", 0, "cam_R_m2c"), nine),
        "a rotation of words": ("scene_gt", ("2", 0, "cam_R_m2c"), ["a"] * 9),
        "a short rotation": ("scene_gt", ("2", 0, "cam_R_m2c"), [1, 2]),
        "a translation of null": ("scene_gt", ("2", 0, "cam_t_m2c"), None),
        "an annotation that is a dict": ("scene_gt", ("2",), {"obj_id": 1}),
        "an annotation that is null": ("scene_gt", ("2",), None),
        "a frame that is a word": ("scene_gt", ("two",), []),
        "a negative frame": ("scene_gt", ("-3",), []),
        "a frame of 5000 digits": ("scene_gt", ("9" * 5000,), []),
        "a frame without camera": ("scene_gt", ("99",), [{"obj_id": 1, "cam_R_m2c": [0] * 9, "cam_t_m2c": [0] * 3}]),
        "a camera matrix of 10^400": ("scene_camera", ("0", "cam_K"), nine),
        "a camera matrix of zeros": ("scene_camera", ("0", "cam_K"), [0] * 9),
        "a camera matrix of 1e30": ("scene_camera", ("0", "cam_K"), [1e30] * 9),
        "a camera matrix that is a dict": ("scene_camera", ("0", "cam_K"), {}),
        "a short camera matrix": ("scene_camera", ("0", "cam_K"), [1, 2, 3]),
        "a camera that is a list": ("scene_camera", ("0",), []),
        "a pose of the camera that is a word": ("scene_camera", ("0", "cam_R_w2c"), "eye"),
    }
    for name, (file, place, value) in values.items():
        write = partial(bop_edited, file=f"in/{file}.json", keys_=place, value=value)
        yield Case(f"BOP: {name}", write, RUN, r"in/scene_(gt|camera)\.json: ")


def pickled(items: bytes) -> bytes:
    """A dictionary as a pickle of protocol 2, from the instructions of its items."""
    return b"\x80\x02}(" + items + b"u."


def ho3d() -> Iterator[Case]:
    """Sequences of HO3D, whose metadata are pickles."""
    contents = {
        "empty": b"",
        "no pickle": b"hello",
        "a call of the system": b"cos\nsystem\n(S'true'\ntR.",
        "a list": b"\x80\x02].",
        "a camera matrix that is a word": pickled(b"U\x06camMatU\x01a"),
        "a camera matrix that is null": pickled(b"U\x06camMatN"),
        "a number of 4000 digits": pickled(b"U\x06camMatL" + b"9" * 4000 + b"L\n"),
        "a number of 5000 digits": pickled(b"U\x06camMatL" + b"9" * 5000 + b"L\n"),
        "a key that is a list": pickled(b"]N"),
        "an endless string": b"\x80\x02T\xff\xff\xff\x7f",
        "a large array": b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(L999999999999L\ntU\x01btR.",
        "doubling lists": b"\x80\x02]" + b"2\x86" * 60 + b".",
        "no end": b"\x80\x02}",
        "a mark alone": b"(.",
        "two megabytes": bytes(2 << 20),
    }
    for name, content in contents.items():
        files = {"in/rgb/0000.png": pictures()["images/0000.png"], "in/meta/0000.pkl": content}
        files |= {"in/masks/0000.png": pictures()["masks/0000.png"]}
        yield Case(f"HO3D: {name}", partial(put, contents=files), RUN, r"in/meta(/0000\.pkl)?: |in/rgb/0000")


def cases() -> Iterator[Case]:
    """All cases of this family."""
    for group in (keys, raw, paths, implausible, bop, ho3d):
        yield from group()
