"""The folder is the registry: `named("datasets", "folder")` is the module `tumble.datasets.folder`."""

import importlib
import pkgutil
from types import ModuleType


def names(folder: str) -> list[str]:
    """The plugins of a folder, by file name, sorted."""
    package = importlib.import_module(f"tumble.{folder}")
    return sorted(m.name for m in pkgutil.iter_modules(package.__path__) if not m.name.startswith("_"))


def named(folder: str, name: str) -> ModuleType:
    """The plugin `name` of a folder of the package, imported.

    Raises:
        ValueError: There is no such plugin; the message lists those there are.
    """
    known = names(folder)
    if name not in known:
        raise ValueError(f"no {name!r} in tumble/{folder}; there are: {', '.join(known) or 'none'}")
    return importlib.import_module(f"tumble.{folder}.{name}")
