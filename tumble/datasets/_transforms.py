"""`transforms.json` (docs/format.md), parsed and validated."""

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from tumble.io import BadFile, files
from tumble.scene import Light, Units

TRANSFORMS = "transforms.json"
"""File of the camera and the frames."""
FIX = "docs/format.md lists the keys and their values"
"""Fix that errors suggest."""

Name = Annotated[str, msgspec.Meta(min_length=1)]
Positive = Annotated[float, msgspec.Meta(gt=0)]
Row = tuple[float, float, float, float]
Matrix = tuple[Row, Row, Row, Row]
Direction = tuple[float, float, float]
Rotation = tuple[Direction, Direction, Direction]


class Intrinsics(msgspec.Struct, frozen=True, kw_only=True):
    """Lens of the whole document, or of one frame, which takes precedence."""

    w: Positive | None = None
    h: Positive | None = None
    fl_x: Positive | None = None
    fl_y: Positive | None = None
    cx: float | None = None
    cy: float | None = None
    camera_angle_x: Annotated[float, msgspec.Meta(gt=0, lt=math.pi)] | None = None
    k1: float | None = None
    k2: float | None = None
    k3: float | None = None
    k4: float | None = None
    p1: float | None = None
    p2: float | None = None
    camera_model: Literal["OPENCV", "OPENCV_FISHEYE", "PINHOLE", "SIMPLE_PINHOLE"] | None = None


class FrameRecord(Intrinsics, frozen=True, kw_only=True):
    """One entry of "frames"; an absent path is empty."""

    file_path: Name
    mask_path: Name = ""
    full_image_path: Name = ""
    transform_matrix: Matrix | None = None
    light_turn: Rotation | None = None
    split: Literal["train", "eval"] = "train"
    region: Literal["shared", "sphere"] = "sphere"
    albedo_path: Name = ""
    roughness_path: Name = ""
    metalness_path: Name = ""
    normal_path: Name = ""
    depth_path: Name = ""
    relit: dict[str, Name] = {}

    @property
    def name(self) -> str:
        return Path(self.file_path).name


class TransformsRecord(Intrinsics, frozen=True, kw_only=True):
    """The whole document."""

    frames: Annotated[tuple[FrameRecord, ...], msgspec.Meta(min_length=1)]
    light: Light = "object"
    setting: str | None = None
    units: Units = "arbitrary"
    light_path: Name = ""
    focal_source: str | None = None

    def split(self, name: str) -> list[FrameRecord]:
        """The frames of a split."""
        return [frame for frame in self.frames if frame.split == name]


def stated_intrinsics(record: Intrinsics) -> dict[str, Any]:
    """The values of a document or frame that are not null, by name."""
    values = {name: getattr(record, name) for name in Intrinsics.__struct_fields__}
    return {name: value for name, value in values.items() if value is not None}


def read(root: Path) -> TransformsRecord:
    """The document in a capture folder.

    Raises:
        BadFile: It is missing or breaks a rule.
    """
    if not root.is_dir():
        raise BadFile(root, "is not a folder", f"a capture is a folder that contains {TRANSFORMS}")
    path = root / TRANSFORMS
    try:
        document = files.read_json(path, TransformsRecord)
    except BadFile as error:
        raise BadFile(path, error.rule, error.fix or FIX) from None
    names: set[str] = set()
    for frame in document.frames:
        if frame.file_path in names or frame.name in names:
            rule = f"the frame {frame.file_path} is there twice"
            raise BadFile(path, rule, "frames must have images with different names")
        names |= {frame.file_path, frame.name}
    return document
