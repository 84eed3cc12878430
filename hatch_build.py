"""Build hook of hatchling: wheels carry the CPU kernels, compiled for every vector width of the machine's architecture.

Without a C++ compiler, and for editable installations, the wheel has no kernels: they are compiled on first use.
"""

import importlib.util
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class KernelsHook(BuildHookInterface):
    """Compiles the kernels into a temporary folder and adds them to the wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the libraries and the tag of the platform; they do not depend on the version of Python."""
        if self.target_name != "wheel" or version == "editable":
            return
        where = Path(self.root) / "tumble" / "backends" / "_prebuilt.py"
        spec = importlib.util.spec_from_file_location("prebuilt", where)
        assert spec is not None and spec.loader is not None  # noqa: PT018
        prebuilt = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(prebuilt)
        self._folder = tempfile.TemporaryDirectory()
        libraries = prebuilt.compile_all(Path(self._folder.name))
        if not libraries:
            self.app.display_warning("no C++ compiler: the wheel has no kernels, which are then compiled on first use")
            return
        build_data["force_include"] |= {str(path): f"tumble/backends/prebuilt/{path.name}" for path in libraries}
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{prebuilt.platform_tag(libraries)}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the temporary folder."""
        if hasattr(self, "_folder"):
            self._folder.cleanup()
