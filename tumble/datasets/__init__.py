"""Drop a dataset here: one file that reads one layout.

    LAYOUT                              one line: which files make a path a capture of this kind
    recognises(path) -> bool            whether they are there
    load(path) -> Capture               what a reconstruction may see
    load_truth(path) -> Truth | None    what it is scored against

The last two are apart so that a reconstruction cannot read its own answer.
"""

from pathlib import Path
from types import ModuleType

from tumble.datasets import folder
from tumble.datasets._capture_folder import MAPS, capture_document, evaluation_frame, save_capture, training_frame
from tumble.datasets.folder import read_poses
from tumble.io import BadFile, named, names

__all__ = [
    "MAPS",
    "capture_document",
    "evaluation_frame",
    "folder",
    "layouts",
    "read_poses",
    "save_capture",
    "training_frame",
    "which",
]


def which(path: Path) -> ModuleType:
    """The reader of the layout that a path has.

    Raises:
        BadFile: It has none that is known, or several; the message lists those there are.
    """
    readers, found = _readers(), layouts(path)
    if len(found) == 1:
        return readers[found[0]]
    known = "; ".join(f"{name}: {reader.LAYOUT}" for name, reader in readers.items())
    rule = "has no layout that is known" if path.is_dir() else "is not a folder" if path.exists() else "is missing"
    raise BadFile(path, f"has the layouts of {' and '.join(found)}" if found else rule, f"known are {known}")


def layouts(path: Path) -> list[str]:
    """Names of the layouts that a path has."""
    return [name for name, reader in _readers().items() if reader.recognises(path)]


def _readers() -> dict[str, ModuleType]:
    return {name: named("datasets", name) for name in names("datasets")}
