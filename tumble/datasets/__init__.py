"""Dataset readers: one plugin file per layout. To add a layout, add a file with these four names:

    LAYOUT                              one line: the files by which the layout is recognised
    recognises(path) -> bool            whether a path has these files
    load(path) -> Capture               input of a reconstruction
    load_truth(path) -> Truth | None    ground truth for its evaluation

`load` and `load_truth` are separate, so that a reconstruction cannot read its ground truth.
"""

from pathlib import Path
from types import ModuleType

from tumble.datasets import folder
from tumble.datasets._bounding_sphere import bounding_sphere
from tumble.datasets._capture_folder import MAPS, capture_document, evaluation_frame, save_capture, training_frame
from tumble.datasets._plausibility import MAX_DISTORTION, check_plausible, plausible_focal
from tumble.datasets.folder import read_poses
from tumble.io import BadFile, load_plugin, plugin_names

__all__ = [
    "MAPS",
    "MAX_DISTORTION",
    "bounding_sphere",
    "check_plausible",
    "plausible_focal",
    "capture_document",
    "evaluation_frame",
    "folder",
    "matching_layouts",
    "read_poses",
    "save_capture",
    "training_frame",
    "reader_for",
]


def reader_for(path: Path) -> ModuleType:
    """The reader of the layout of a path.

    Raises:
        BadFile: The path has no known layout, or several; the message lists the known ones.
    """
    readers, matching = _readers(), matching_layouts(path)
    if len(matching) == 1:
        return readers[matching[0]]
    known = "; ".join(f"{name}: {reader.LAYOUT}" for name, reader in readers.items())
    rule = "has no known layout" if path.is_dir() else "is not a folder" if path.exists() else "is missing"
    raise BadFile(path, f"has the layouts {' and '.join(matching)}" if matching else rule, f"known layouts: {known}")


def matching_layouts(path: Path) -> list[str]:
    """Names of the layouts that recognise a path."""
    return [name for name, reader in _readers().items() if reader.recognises(path)]


def _readers() -> dict[str, ModuleType]:
    return {name: load_plugin("datasets", name) for name in plugin_names("datasets")}
