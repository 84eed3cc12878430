"""Lazy imports for the `__init__` of packages whose import must stay fast (PEP 562)."""

import importlib
from collections.abc import Callable, Mapping
from typing import Any


def lazy_getattr(package: str, exports: Mapping[str, tuple[str, ...]]) -> Callable[[str], Any]:
    """The `__getattr__` of a package (PEP 562) that imports each exported name from its module at first use.

    Args:
        package: Name of the package.
        exports: Exported names by the submodule that defines them. No exported name may equal the name of a submodule,
            because the imported submodule would hide it.
    """
    modules = {name: f"{package}.{module}" for module, names in exports.items() for name in names}

    def load(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(modules[name]), name)

    return load
