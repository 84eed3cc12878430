"""The design's rules that a machine can check: rooms, sizes, hygiene of imports, one place for devices."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "tumble"
SOURCES = sorted(PACKAGE.rglob("*.py"))

MAY_IMPORT = {
    "io": set(),
    "maths": set(),
    "backends": set(),
    "scene": {"io", "maths"},
    "engine": {"io"},
    "rendering": {"maths", "backends", "scene"},
    "matching": {"io", "scene"},
    "datasets": {"io", "maths", "scene"},
    "preprocess": {"io", "maths", "scene", "datasets"},
    "synthetic": {"io", "maths", "scene", "datasets"},
    "poses": {"io", "maths", "scene", "engine", "matching"},
    "inverse_rendering": {"io", "maths", "scene", "rendering", "engine"},
    "evaluation": {"io", "maths", "scene", "rendering", "datasets"},
    "export": {"io", "maths", "scene", "rendering"},
    "report": {"io", "maths", "scene", "rendering", "engine", "datasets", "poses", "evaluation", "export"},
}
"""Rooms that each room may import, besides itself; the files beside them may import all."""
PENDING = {("engine", "scene"), ("inverse_rendering", "backends")}
"""Arrows that are still to go."""

LONG_FILES: dict[str, int] = {}
"""Files over 600 lines, each with the reason beside it."""
MANY_PARAMETERS = {"rasterize"}
"""Functions over 12 parameters: the backends' contract hands tensors over one by one."""


def room(path: Path) -> str:
    """The room of a file, or its name where it stands beside the rooms."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported(tree: ast.AST) -> Iterator[str]:
    """Rooms and files of the package that a file imports, at any depth."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "tumble":
            parts = (node.module or "").split(".")
            yield from [parts[1]] if len(parts) > 1 else [alias.name for alias in node.names]
        if isinstance(node, ast.Import):
            yield from (a.name.split(".")[1] for a in node.names if a.name.startswith("tumble."))


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_a_room_imports_only_the_rooms_that_it_may(path: Path) -> None:
    own = room(path)
    if own not in MAY_IMPORT:
        return
    for name in {*imported(ast.parse(path.read_text()))} - {"__version__", own}:
        assert name in MAY_IMPORT[own] or (own, name) in PENDING, f"{own} may not import {name}"


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_files_and_functions_stay_within_the_size_budget(path: Path) -> None:
    text = path.read_text()
    assert len(text.splitlines()) <= LONG_FILES.get(str(path.relative_to(PACKAGE)), 600)
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.FunctionDef):
            continue
        docstring = node.body[0] if ast.get_docstring(node, clean=False) is not None else None
        documented = 0 if docstring is None else docstring.end_lineno - docstring.lineno + 1
        lines = node.end_lineno - node.lineno + 1 - documented
        assert lines <= 60, f"{node.name} has {lines} lines"
        n_parameters = len(node.args.posonlyargs + node.args.args + node.args.kwonlyargs)
        assert n_parameters <= 12 or node.name in MANY_PARAMETERS, f"{node.name} has {n_parameters} parameters"


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_devices_are_named_only_at_the_borders(path: Path) -> None:
    """Everywhere else device and dtype come from the inputs. The doctor asks the machine, that is its work."""
    if room(path) in ("cli", "backends", "doctor"):
        return
    words = {n.attr for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Attribute)}
    strings = {n.value for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Constant)}
    assert "cuda" not in words | strings


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_no_bare_except_and_no_pickle(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        assert not (isinstance(node, ast.ExceptHandler) and node.type is None)
        assert not (isinstance(node, ast.Import) and any(a.name in ("pickle", "dill") for a in node.names))


def test_importing_the_package_is_light_and_starts_no_gpu() -> None:
    """`import tumble` and `tumble --help` load no optional package and no CUDA context."""
    program = (
        "import sys, tumble, tumble.cli\n"
        "optional = {'mitsuba', 'drjit', 'trimesh', 'viser', 'ray', 'scipy', 'skimage', 'warp'}\n"
        "assert not optional & set(sys.modules), optional & set(sys.modules)\n"
        "if 'torch' in sys.modules: assert not sys.modules['torch'].cuda.is_initialized()\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_torchvision_is_never_imported() -> None:
    for path in [*SOURCES, *Path(__file__).parent.rglob("*.py")]:
        names = {a.name for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Import) for a in n.names}
        names |= {n.module or "" for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.ImportFrom)}
        assert not {n for n in names if n.split(".")[0] in ("torchvision", "torchaudio", "torchmetrics")}, path
