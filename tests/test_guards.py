"""The rules of the house that a machine can check: rooms and their faces, sizes, names, imports, devices, keys.

A *room* is a folder of the package, its *face* what its `__init__` lists in `__all__`.
"""

import ast
import re
import subprocess
import sys
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

from tumble import recipes
from tumble.engine import run
from tumble.pipeline import stage_of

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "tumble"
SOURCES = sorted(PACKAGE.rglob("*.py"))
CALLERS = [*SOURCES, *sorted((ROOT / "benchmarks").glob("*.py")), *sorted((ROOT / "examples").glob("*.py"))]

MAY_IMPORT = {
    "io": set(),
    "maths": set(),
    "backends": set(),
    "scene": {"io", "maths"},
    "engine": {"io", "backends"},
    "rendering": {"maths", "backends", "scene"},
    "matching": {"io", "scene"},
    "datasets": {"io", "maths", "scene"},
    "preprocess": {"io", "maths", "scene", "datasets"},
    "synthetic": {"io", "maths", "scene", "datasets"},
    "poses": {"io", "maths", "backends", "scene", "engine", "matching"},
    "inverse_rendering": {"io", "maths", "backends", "scene", "rendering", "engine"},
    "evaluation": {"io", "maths", "scene", "rendering", "datasets"},
    "export": {"io", "maths", "backends", "scene", "rendering"},
    "report": {
        "io",
        "maths",
        "scene",
        "rendering",
        "engine",
        "datasets",
        "preprocess",
        "poses",
        "evaluation",
        "export",
    },
    "bench": {"io", "maths", "backends", "scene", "engine", "synthetic", "evaluation", "report"},
}
"""Rooms that each room may import, besides itself; the files beside them may import all."""
INNER_ROOMS = {
    "poses.sfm": "poses.progressive",
    "poses.sfm.symmetry": "poses.progressive",
    "poses.progressive": "poses.sfm",
    "preprocess.hands": "preprocess",
}
"""Rooms within a room, with the one that they do not know."""
PLUGINS = ("backends", "matching")
"""Rooms of plugins: their `__init__` is the contract, and files of them are found by name."""
MANY_PARAMETERS = {"rasterize", "gaussian_terms", "image_terms"}
"""Functions over 12 parameters: the backends' contract hands tensors over one by one."""
STAGE_WORDS = {"Config", "Inputs", "Params", "Weights", "Rates"}
"""Classes that every stage names alike."""

of_every_file = pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text("utf-8"))


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(parsed(path)))


@cache
def attributes(path: Path) -> set[str]:
    """All names behind a dot in a file."""
    return {node.attr for node in nodes(path) if isinstance(node, ast.Attribute)}


@cache
def imported_anywhere() -> set[tuple[str, str]]:
    """Package and name of everything that any file imports from this package."""
    return {each for path in CALLERS for each in imports(path)}


@cache
def attributes_anywhere() -> set[str]:
    """All names behind a dot in any file."""
    return set().union(*map(attributes, CALLERS))


def module(path: Path) -> str:
    """`tumble.scene.camera`, or `tumble.scene` for its face."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULES = {module(path): path for path in SOURCES}


def room(name: str) -> str:
    """The room of a module, or the inner room; "" for a file that stands beside the rooms."""
    parts = name.split(".")[1:]
    inner = next((each for n in (3, 2) if (each := ".".join(parts[:n])) in INNER_ROOMS), "")
    return inner or (parts[0] if parts and parts[0] in MAY_IMPORT else "")


@cache
def imports(path: Path) -> list[tuple[str, str]]:
    """Package and name of everything that a file imports from this package, at any depth."""
    found: list[tuple[str, str]] = []
    for node in nodes(path):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "tumble":
            found += [(node.module or "", alias.name) for alias in node.names]
        if isinstance(node, ast.Import):
            found += [(a.name.rpartition(".")[0], a.name.rpartition(".")[2]) for a in node.names if "tumble." in a.name]
    return found


def target(package: str, name: str) -> str:
    """The module that an import loads."""
    return f"{package}.{name}" if f"{package}.{name}" in MODULES else package


@cache
def face(name: str) -> set[str]:
    """What a room lists in `__all__`."""
    for node in parsed(PACKAGE.joinpath(*name.split(".")) / "__init__.py").body:
        if isinstance(node, ast.Assign) and any(isinstance(t, ast.Name) and t.id == "__all__" for t in node.targets):
            return set(ast.literal_eval(node.value))
    raise AssertionError(f"{name} has no __all__")


# Rooms ----------------------------------------------------------------------------------------------------------------


@of_every_file
def test_a_room_imports_only_the_rooms_that_it_may(path: Path) -> None:
    own = room(module(path))
    if not own:
        return
    for package, name in imports(path):
        other = room(target(package, name))
        assert other or target(package, name) in ("tumble", "tumble._lazy"), f"{own} imports {package}.{name}"
        assert other != INNER_ROOMS.get(own), f"{own} does not know {other}"
        first = other.partition(".")[0]
        assert first in MAY_IMPORT[own.partition(".")[0]] | {own.partition(".")[0], ""}, f"{own} may not import {other}"


@pytest.mark.parametrize("path", CALLERS, ids=lambda p: str(p.relative_to(ROOT)))
def test_a_room_is_known_by_its_face(path: Path) -> None:
    own = room(module(path))
    whole: dict[str, str] = {}
    for package, name in imports(path):
        if package == "tumble" and name in MAY_IMPORT:
            whole[name] = name
        other = room(package)
        if not other or other == own or own.startswith(f"{other}.") or package == "tumble":
            continue
        assert package == f"tumble.{other}", f"{package}.{name}: outside a room only its face is imported"
        assert name in face(other), f"{name} is not in the face of {other}"
    for node in nodes(path):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in whole:
            assert node.attr in face(node.value.id), f"{node.value.id}.{node.attr} is not in the face of the room"


@pytest.mark.parametrize("name", [*MAY_IMPORT, *INNER_ROOMS])
def test_a_room_has_a_face_with_a_paragraph_and_few_files(name: str) -> None:
    folder = PACKAGE.joinpath(*name.split("."))
    assert len(ast.get_docstring(parsed(folder / "__init__.py")) or "") > 60
    assert len([p for p in folder.glob("*.py") if p.name != "__init__.py"]) <= 16
    assert face(name)
    if name not in PLUGINS:
        used = {n for package, n in imported_anywhere() if package == f"tumble.{name}"} | attributes_anywhere()
        assert face(name) <= used, f"nobody outside uses {face(name) - used}"


def test_the_package_docstring_names_every_room() -> None:
    text = ast.get_docstring(parsed(PACKAGE / "__init__.py")) or ""
    listed = set(re.findall(r"^    (\w+)(?:, (\w+))?  ", text, re.MULTILINE))
    assert {name for names in listed for name in names if name} == set(MAY_IMPORT)


def test_no_circle_of_files() -> None:
    """Lazy imports included."""
    arrows = {module(path): {target(*each) for each in imports(path)} - {module(path)} for path in SOURCES}
    done: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, " -> ".join([*trail[trail.index(name) :], name])
        if name not in done:
            for other in arrows.get(name, ()):
                # A package is loaded before its files; what matters is who asks for whom.
                if other != "tumble":
                    visit(other, (*trail, name))
            done.add(name)

    for name in arrows:
        visit(name, ())


# Sizes and names ------------------------------------------------------------------------------------------------------


@of_every_file
def test_files_and_functions_stay_within_the_size_budget(path: Path) -> None:
    assert len(path.read_text("utf-8").splitlines()) <= 600
    for node in nodes(path):
        if not isinstance(node, ast.FunctionDef):
            continue
        docstring = node.body[0] if ast.get_docstring(node, clean=False) is not None else None
        documented = 0 if docstring is None else (docstring.end_lineno or 0) - docstring.lineno + 1
        lines = (node.end_lineno or 0) - node.lineno + 1 - documented
        assert lines <= 60, f"{node.name} has {lines} lines"
        n_parameters = len(node.args.posonlyargs + node.args.args + node.args.kwonlyargs)
        assert n_parameters <= 12 or node.name in MANY_PARAMETERS, f"{node.name} has {n_parameters} parameters"


@pytest.mark.parametrize("path", CALLERS, ids=lambda p: str(p.relative_to(ROOT)))
def test_no_private_name_is_used_in_another_file(path: Path) -> None:
    modules = {name for package, name in imports(path) if f"{package}.{name}" in MODULES}
    for package, name in imports(path):
        private = name.startswith("_") and not name.startswith("__")
        assert not private or f"{package}.{name}" in MODULES, f"{package}.{name}"
        assert not private or room(package) == room(module(path)), f"{package}.{name}"
    for node in nodes(path):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in modules:
            assert not node.attr.startswith("_") or node.attr.startswith("__"), f"{node.value.id}.{node.attr}"


def test_the_name_of_a_public_class_is_unique() -> None:
    classes = [node.name for path in SOURCES for node in parsed(path).body if isinstance(node, ast.ClassDef)]
    repeated = {name for name, n in Counter(classes).items() if n > 1 and not name.startswith("_")}
    assert repeated <= STAGE_WORDS, repeated - STAGE_WORDS


def test_every_public_function_has_a_caller() -> None:
    """In the package, the benchmarks or the examples; what only tests call stands in `tests/oracles`."""
    used: set[str] = set()
    for path in CALLERS:
        for node in nodes(path):
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
                used.add(node.id)
            if isinstance(node, ast.Attribute):
                used.add(node.attr)
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                used.add(node.value)
    offered = {name for path in SOURCES if path.parent == PACKAGE for name in face_of_package()}
    functions = {
        (module(path), node.name)
        for path in SOURCES
        for node in parsed(path).body
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_")
    }
    idle = {name for name in functions if name[1] not in used | offered and not is_plugin(name[0])}
    assert not idle


def face_of_package() -> set[str]:
    for node in parsed(PACKAGE / "__init__.py").body:
        if isinstance(node, ast.Assign) and any(isinstance(t, ast.Name) and t.id == "__all__" for t in node.targets):
            return set(ast.literal_eval(node.value))
    raise AssertionError("the package has no __all__")


def is_plugin(name: str) -> bool:
    return room(name) in (*PLUGINS, "datasets")


# Imports, devices, keys -----------------------------------------------------------------------------------------------


@of_every_file
def test_devices_are_named_only_at_the_borders(path: Path) -> None:
    """Everywhere else device and dtype come from the inputs. The doctor asks the machine, that is its work."""
    if room(module(path)) == "backends" or path.stem in ("cli", "doctor"):
        return
    words = {n.attr for n in nodes(path) if isinstance(n, ast.Attribute)}
    strings = {n.value for n in nodes(path) if isinstance(n, ast.Constant)}
    assert "cuda" not in words | strings


@of_every_file
def test_no_bare_except_and_no_pickle(path: Path) -> None:
    for node in nodes(path):
        assert not (isinstance(node, ast.ExceptHandler) and node.type is None)
        assert not (isinstance(node, ast.Import) and any(a.name in ("pickle", "dill") for a in node.names))


@pytest.mark.parametrize(
    ("program", "absent"),
    [
        ("import tumble", {"torch", "numpy", "cv2", "tyro"}),
        ("import tumble.cli", {"torch", "numpy", "cv2", "av", "rich.console"}),
        ("import sys; sys.argv = ['tumble', '--help']; from tumble.cli import main; main()", {"torch", "cv2"}),
        ("import sys; sys.argv = ['tumble', 'run', '--help']; from tumble.cli import main; main()", {"torch", "cv2"}),
        (
            "import torch, tumble.pipeline; assert not torch.cuda.is_initialized()",
            {"mitsuba", "drjit", "trimesh", "viser", "ray", "scipy", "skimage", "warp", "xatlas"},
        ),
    ],
)
def test_imports_and_help_are_light(program: str, absent: set[str]) -> None:
    tell = f"print('LOADED', *({absent!r} & set(sys.modules)))"
    check = f"import atexit, sys\n@atexit.register\ndef loaded(): {tell}\n{program}"
    done = subprocess.run([sys.executable, "-c", check], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1].strip() == "LOADED"


def test_torchvision_is_never_imported() -> None:
    for path in [*CALLERS, *(ROOT / "tests").rglob("*.py")]:
        found = re.search(r"^\s*(import|from) (torchvision|torchaudio|torchmetrics)\b", path.read_text("utf-8"), re.M)
        assert not found, path


@pytest.mark.parametrize("name", ["track", "refine", "decompose"])
def test_every_number_in_capitals_that_a_stage_leads_to_is_part_of_its_key(name: str) -> None:
    """By the sources: all files that the stage's own one imports, at any depth."""
    stage = stage_of(getattr(recipes.DRAFT, name))
    todo, seen = [stage.__name__], set()
    while todo:
        if (now := todo.pop()) not in seen and room(now) not in ("io", "engine", *PLUGINS):
            seen.add(now)
            # A constant that is imported by name counts where it is used.
            todo += [home(*each) for each in imports(MODULES[now]) if not each[1].isupper()]
    wanted = {
        f"{file}.{node.targets[0].id}"
        for file in seen
        for node in parsed(MODULES[file]).body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id.isupper()
        if is_number(node.value)
    }
    missing = wanted - run.constants(stage).keys()
    assert not missing
    assert len(wanted) > 20
    assert name == "track" or "tumble.backends.ALPHA_MAX" in run.constants(stage)


def home(package: str, name: str) -> str:
    """The module in which an imported name is defined, through the face of a room."""
    loaded = target(package, name)
    if loaded == package and MODULES[package].name == "__init__.py":
        for inner, offered in imports(MODULES[package]):
            if offered == name:
                return home(inner, offered)
    return loaded


def is_number(node: ast.expr) -> bool:
    """Whether an expression is a number or a tuple of numbers, as far as it can be read."""
    if isinstance(node, ast.Tuple):
        return all(is_number(part) for part in node.elts)
    if isinstance(node, ast.UnaryOp):
        return is_number(node.operand)
    return isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool)
