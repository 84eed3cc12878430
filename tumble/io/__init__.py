"""Pictures, films, JSON and trees of tensors on disk, and the plugins of a folder.

Every file is written whole or not at all; every reader says which rule a file breaks, and the fix.
"""

from tumble.io import files, tree, video, weights
from tumble.io.files import BadFile
from tumble.io.plugins import named, names

__all__ = [
    "BadFile",
    "files",
    "named",
    "names",
    "tree",
    "video",
    "weights",
]
