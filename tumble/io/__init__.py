"""Images, videos, JSON documents and trees of tensors on disk, network weights, the rules for
outputs, progress, threads, and loading plugins by file name.

Every file is written atomically. Every reader raises `BadFile` with the rule that the file breaks and the fix.
"""

from tumble.io import files, limits, outputs, progress, tree, video, weights
from tumble.io.checked_tensors import read_tensors, write_tensors
from tumble.io.errors import BadFile, one_line
from tumble.io.plugins import load_plugin, plugin_names
from tumble.io.threads import begin, in_threads

__all__ = [
    "BadFile",
    "begin",
    "files",
    "in_threads",
    "limits",
    "load_plugin",
    "one_line",
    "outputs",
    "plugin_names",
    "progress",
    "read_tensors",
    "tree",
    "video",
    "weights",
    "write_tensors",
]
