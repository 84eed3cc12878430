"""Names all packages that `make gpu` needs and does not find, before a minute of the GPU is spent.

`python -m benchmarks.requirements` needs none of them itself.
"""

import importlib.util
import re
import sys
import tomllib
from pathlib import Path

MODULES = {"opencv-python-headless": "cv2", "pillow": "PIL", "warp-lang": "warp"}
"""Modules of packages whose name says something else."""
FOR_TESTS = ("pytest", "iniconfig", "pluggy", "packaging")
"""Packages of the tests on a GPU, which need neither those for checks of shapes nor plugins."""


def missing() -> list[str]:
    """Packages that are not found: dependencies of the package and of its extra `cuda`, and those of the tests."""
    project = tomllib.loads(Path(__file__).parents[1].joinpath("pyproject.toml").read_text("utf-8"))["project"]
    needed = [*project["dependencies"], *project["optional-dependencies"]["cuda"], *FOR_TESTS]
    names = [re.split(r"[^\w-]", requirement)[0] for requirement in needed]
    return [x for x in names if importlib.util.find_spec(MODULES.get(x, x.replace("-", "_"))) is None]


if __name__ == "__main__":
    if packages := missing():
        sys.exit(f"{sys.executable} does not find: {' '.join(packages)}")
