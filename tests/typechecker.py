"""Beartype checks calls of the package's functions while the tests run, and jaxtyping what it says of shapes.

`install` is jaxtyping's import hook in short. That one checks arguments twice, once more together with the result, and
binds them by name, on every call: 52 of 126 s of processor time in the tests of stages 1 and 3. Here beartype checks a
call once, and the first `MAX_CALLS` of a function in every test: 19 s.
"""

import ast
import dataclasses
import functools
import inspect
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import CodeType, ModuleType
from typing import Any

from beartype import BeartypeConf, beartype
from jaxtyping import jaxtyped

DECORATOR = "__checked__"
MAX_CALLS = 20
"""Number of calls of a function that are checked in one test; those of a loop are alike."""

typed = beartype(conf=BeartypeConf(is_pep484_tower=True))
"""An int is allowed where a float is asked for (PEP 484)."""
calls: Counter[Callable[..., Any]] = Counter()
"""Number of checked calls of every function; cleared before every test."""


def install(package: str) -> None:
    """Check all modules of `package` that are imported from now on."""
    sys.meta_path.insert(0, Finder(package))


def checked(target: Any) -> Any:
    """A function that checks its arguments and its result; a dataclass that checks its fields.

    A name in the shapes means the same size within one call.
    """
    if inspect.isclass(target):
        if dataclasses.is_dataclass(target) and "__init__" in vars(target):
            target.__init__ = checked(target.__init__)
        return target
    if hasattr(target, DECORATOR):
        return target
    inner: Callable[..., Any] | None = None

    @functools.wraps(target)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal inner
        if calls[target] == MAX_CALLS:
            return target(*args, **kwargs)
        calls[target] += 1
        if inner is None:  # most functions are never called within one process
            inner = typed(resolved(target))
            # Only a shape such as "{height} {width}" needs to know the values of arguments by name.
            if any("{" in str(annotation) for annotation in target.__annotations__.values()):
                inner = jaxtyped(inner, typechecker=None)
        with jaxtyped("context"):
            return inner(*args, **kwargs)

    setattr(call, DECORATOR, True)
    return call


def resolved(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with the types that its annotations in quotes name; any, if only type checkers import the name."""
    for name, annotation in function.__annotations__.items():
        if isinstance(annotation, str):
            try:
                function.__annotations__[name] = eval(annotation, function.__globals__)
            except NameError:
                function.__annotations__[name] = Any
    return function


class Decorate(ast.NodeTransformer):
    """Put `checked` around every function, under all other decorators, and around every class, above them."""

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        return node if unchecked(node) else self.decorated(node, len(node.decorator_list))

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.AST:
        return node if unchecked(node) else self.decorated(node, 0)

    def decorated(self, node: ast.FunctionDef | ast.ClassDef, position: int) -> ast.AST:
        """The function or class with one more decorator, from the top; all within it are visited too."""
        self.generic_visit(node)
        node.decorator_list.insert(position, ast.copy_location(ast.Name(DECORATOR, ast.Load()), node))
        return node


def unchecked(node: ast.FunctionDef | ast.ClassDef) -> bool:
    """Whether Warp compiles this, which reads the annotations in its own way."""
    return any(ast.unparse(decorator).endswith("no_type_check") for decorator in node.decorator_list)


class Loader(SourceFileLoader):
    """Loads a module whose functions are checked; never its compiled code, in which they are not."""

    def get_code(self, fullname: str) -> CodeType:
        path = self.get_filename(fullname)
        return self.source_to_code(self.get_data(path), path)

    def source_to_code(self, data: Any, path: Any, *, _optimize: int = -1) -> CodeType:
        tree = Decorate().visit(ast.parse(data, path))
        return compile(tree, path, "exec", dont_inherit=True, optimize=_optimize)

    def exec_module(self, module: ModuleType) -> None:
        vars(module)[DECORATOR] = checked
        super().exec_module(module)


class Finder(MetaPathFinder):
    """Finds the modules of one package."""

    def __init__(self, package: str) -> None:
        self.package = package

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname.partition(".")[0] != self.package:
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is not None and isinstance(spec.loader, SourceFileLoader):
            spec.loader = Loader(spec.loader.name, spec.loader.path)
        return spec
