"""Plugins by file name: `load_plugin("datasets", "folder")` imports the module `tumble.datasets.folder`.

The folder itself is the registry. Modules whose name begins with an underscore are not plugins.
"""

import importlib
import pkgutil
from types import ModuleType


def plugin_names(folder: str) -> list[str]:
    """Sorted file names of the plugins in the subpackage `tumble.<folder>`."""
    package = importlib.import_module(f"tumble.{folder}")
    return sorted(m.name for m in pkgutil.iter_modules(package.__path__) if not m.name.startswith("_"))


def load_plugin(folder: str, name: str) -> ModuleType:
    """Import the plugin `name` of the subpackage `tumble.<folder>`.

    Raises:
        ValueError: There is no such plugin; the message lists the available ones.
    """
    known = plugin_names(folder)
    if name not in known:
        raise ValueError(f"no {name!r} in tumble/{folder}; available: {', '.join(known) or 'none'}")
    return importlib.import_module(f"tumble.{folder}.{name}")
