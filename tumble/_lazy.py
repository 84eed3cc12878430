"""Faces that load nothing before it is asked for: the package's own, and those of rooms that the command line names."""

import importlib
from collections.abc import Callable, Mapping
from typing import Any


def lazily(package: str, offered: Mapping[str, tuple[str, ...]]) -> Callable[[str], Any]:
    """A package's `__getattr__` (PEP 562): each name is imported from its module when it is first used.

    Args:
        package: Name of the package.
        offered: Names by the module that defines them, below the package. None may be that of a module, which would
            hide it once imported.
    """
    homes = {name: f"{package}.{module}" for module, names in offered.items() for name in names}

    def load(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(homes[name]), name)

    return load
