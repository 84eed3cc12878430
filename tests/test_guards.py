"""The design's rules that a machine can check: layers, sizes, hygiene of imports, one place for devices."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "tumble"
SOURCES = sorted(PACKAGE.rglob("*.py"))

LAYERS = [
    {"tree", "named", "files", "weights", "schedule"},
    {"se3", "directions", "harmonics", "images", "video", "backends"},
    {"brdf", "camera", "trajectory"},
    {"gaussians", "material", "environment", "buffers", "coarse_light", "highlight"},
    {"capture", "asset", "match", "photograph"},
    {"rasterize", "trace", "volume", "virtual_camera", "pairs", "pixels", "tracks", "frontier", "health"}
    | {"texture", "symmetry"},
    {"prefilter", "shade", "importance", "mesh", "hull", "views", "shadow"},
    {"losses", "optim", "densify", "fields", "neus", "posenets", "metrics", "lpips", "matching", "comeback"}
    | {"pairwise", "averaging", "evidence", "bundle", "relocate", "gauge", "realign"},
    {"loop"},
    {"track", "lift", "graph", "progressive", "refine", "decompose", "average", "relight"},
    {"datasets", "settings", "pathtracer", "synthesize", "capture_writer", "segment", "prediction", "predict", "sheet"}
    | {"footage", "backdrop", "appearance", "selection", "sam", "survey", "ingest", "pick", "colmap", "posed", "check"}
    | {"scoresheet", "evaluate", "bake", "confidence", "export", "doctor", "demo_assets"},
    {"plots", "lamps", "rerender", "diagnosis", "gallery"},
    {"recipes", "run", "report", "reconstruct", "demo", "viewer"},
    {"cli", "__main__"},
]
"""Each row may import only rows above it and itself."""

LONG_FILES: dict[str, int] = {}
"""Files over 400 lines, each with the reason beside it."""
MANY_PARAMETERS = {"rasterize"}
"""Functions over 12 parameters: the backends' contract hands tensors over one by one."""


def module(path: Path) -> str:
    """The name a layer knows a file by: `backends` for all files in that folder."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def layer(name: str) -> int:
    found = [i for i, row in enumerate(LAYERS) if name in row]
    assert len(found) == 1, f"{name} stands in no row of LAYERS: give it one"
    return found[0]


def imported(tree: ast.AST) -> Iterator[str]:
    """Modules of the package that a file imports, at any depth."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "tumble":
            parts = (node.module or "").split(".")
            yield from [parts[1]] if len(parts) > 1 else [alias.name for alias in node.names]
        if isinstance(node, ast.Import):
            yield from (a.name.split(".")[1] for a in node.names if a.name.startswith("tumble."))


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_a_module_imports_only_its_own_layer_and_those_below(path: Path) -> None:
    if path == PACKAGE / "__init__.py":
        return
    own = module(path)
    for name in imported(ast.parse(path.read_text())):
        if name in ("__version__", own):
            continue
        assert layer(name) <= layer(own), f"{own} (row {layer(own)}) imports {name} (row {layer(name)})"
        assert own != "backends", f"backends import nothing of the package, {path.name} imports {name}"


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_files_and_functions_stay_within_the_size_budget(path: Path) -> None:
    text = path.read_text()
    assert len(text.splitlines()) <= LONG_FILES.get(str(path.relative_to(PACKAGE)), 400)
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
    if module(path) in ("cli", "backends", "doctor"):
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
