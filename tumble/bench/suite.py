"""Suites as data: TOML files that list objects, lights, settings, materials, poses, methods and seeds.

    title = "..."                       half = "tune", "report" or "none"        recipe = "draft"        seeds = [0, 1]
    glb = true                          the exported GLB is scored as well, path traced
    [capture]                           options of `tumble synth` for all captures, such as `resolution = 128`
    [[object]]                          `model` and more options for its captures, such as `env` and `up`; or `folder`,
                                        a capture of the user in the data folder, in any layout that `tumble run` reads
    [[rows]]                            lists of values: one case for each object and each combination of the values
    [[compare]]                         two sets of rows whose scores are compared object by object

The values of `[[rows]]` are options of `tumble synth`, `poses` ("given" or "estimate") and `method`; for captures of
the user only the last two. `seed` lists seeds of these rows alone, some or all of the suite's.
"""

import dataclasses
import itertools
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import msgspec

from tumble.engine import loop
from tumble.io import BadFile
from tumble.synthetic import SynthOptions

RUN_LABELS = ("poses", "method")
"""Keys of `[[rows]]` that are not options of `tumble synth`."""
GIVEN = "given"
"""Label of light and material of captures that are not rendered."""
FIX = "tumble bench list names the suites; the head of tumble/bench/suite.py explains their files"
"""What errors about suites suggest."""


@dataclass(frozen=True)
class Case:
    """One capture, and how it is reconstructed: what one row is about."""

    model: str
    """File of the object in the data folder, or the name of a built-in one; or the folder of a given capture."""
    options: SynthOptions | None
    """How the capture is rendered; lights are files in the data folder or names of built-in ones. None: it is given."""
    recipe: str
    """Name of the recipe that the method changes."""
    seed: int
    """Seed of the hand-held motion, of the path tracer and of all random numbers of the method."""
    poses: Literal["given", "estimate"] = "given"
    method: str = "tumble"
    """Name of the method, or a Python file with it."""
    varied: tuple[str, ...] = ()
    """Options, besides those in `labels`, that differ between cases of the suite."""

    @property
    def labels(self) -> dict[str, Any]:
        """What distinguishes the case from others of its suite, by heading."""
        path, options = Path(self.model), self.options
        about = {"object": path.stem, "light": GIVEN, "setting": path.parent.name, "material": GIVEN}
        if options is not None:
            light = Path(options.env).stem.removesuffix("_1k")
            about |= {"light": light, "setting": options.setting, "material": options.material}
        others = {name: getattr(options, name, GIVEN) for name in self.varied}
        return {**about, **others, "poses": self.poses, "method": Path(self.method).stem, "seed": self.seed}

    @property
    def name(self) -> str:
        """The labels as one word."""
        return "-".join(f"{k}{v}" if k in (*self.varied, "seed") else str(v) for k, v in self.labels.items())

    @property
    def key(self) -> str:
        """Hash of everything that the case says; files count by their names."""
        return loop.fingerprint(dataclasses.replace(self, varied=()))


@dataclass(frozen=True)
class Comparison:
    """Two sets of rows whose scores are compared in pairs that differ in nothing else."""

    title: str
    ahead: dict[str, Any]
    """Labels of the rows that are expected to have the better scores."""
    behind: dict[str, Any]


@dataclass(frozen=True)
class Suite:
    """The content of a suite's file; see the module's docstring."""

    title: str
    recipe: str
    seeds: tuple[int, ...]
    object: tuple[dict[str, Any], ...]
    rows: tuple[dict[str, list[Any]], ...]
    half: Literal["tune", "report", "none"] = "none"
    """Whether constants of the method may be chosen by the results, or must not be (CONTRIBUTING.md)."""
    frozen: str = ""
    """Commit at which all constants of the method were chosen, before the first row of a suite of the half "report"."""
    capture: dict[str, Any] = field(default_factory=dict)
    compare: tuple[Comparison, ...] = ()
    glb: bool = False
    """Whether the GLB of `tumble export --preset web` is scored beside the Gaussians (docs/metrics.md)."""
    plot: str = ""
    """Label with numeric values along which scores are drawn, such as "views"."""


def suite_names() -> list[str]:
    """Names of the suites that come with the package."""
    return sorted(path.name.removesuffix(".toml") for path in _folder().iterdir() if path.name.endswith(".toml"))


def read_suite(name: str) -> Suite:
    """A suite by its name, or by the path of its file.

    Raises:
        BadFile: There is none, or its file breaks a rule.
    """
    path = Path(name) if name.endswith(".toml") else _folder() / f"{name}.toml"
    if not path.is_file():
        raise BadFile(Path(name), "is not a suite", f"choose among {', '.join(suite_names())}")
    try:
        document = tomllib.loads(path.read_text("utf-8"))
        if unknown := document.keys() - {part.name for part in dataclasses.fields(Suite)}:
            raise ValueError(f"has an unknown key {min(unknown)!r}")
        suite = msgspec.convert(document, Suite)
        names = [case.name for case in cases_of(suite)]
        if repeated := {name for name in names if names.count(name) > 1}:
            raise ValueError(f"has several rows with the name {min(repeated)}")
    except (ValueError, TypeError) as error:
        raise BadFile(path, f"is not a suite: {error}", FIX) from None
    return suite


def cases_of(
    suite: Suite, *, seeds: Sequence[int] = (), methods: Sequence[str] = (), only: Sequence[str] = ()
) -> list[Case]:
    """All cases of a suite, without repetition, seed by seed.

    Args:
        seeds: Seeds instead of the suite's.
        methods: Methods instead of the suite's.
        only: Words that a case's name must all contain.

    Raises:
        ValueError: The suite names an option that does not exist, or a value out of its range.
    """
    grids = [grid | ({"method": list(methods)} if methods else {}) for grid in suite.rows]
    varied = {name for grid in grids for name, values in grid.items() if name not in RUN_LABELS and len(values) > 1}
    rest = tuple(sorted(varied - {"env", "setting", "material", "seed"}))
    cases: dict[str, Case] = {}
    for seed, about, grid in itertools.product(seeds or suite.seeds, suite.object, grids):
        own = grid.get("seed", suite.seeds)
        if unknown := set(own) - set(suite.seeds):
            raise ValueError(f"has rows with the seed {min(unknown)}, which is not one of the suite's")
        grid = grid | {"seed": [seed] if seeds or seed in own else []}
        for values in itertools.product(*grid.values()):
            chosen = dict(zip(grid, values, strict=True))
            of_case = _given(about | chosen) if "folder" in about else _rendered(suite.capture | about | chosen)
            more = {"recipe": suite.recipe, "seed": seed, "varied": rest}
            case = msgspec.convert(of_case | more, Case)
            if all(word in case.name for word in only):
                cases[case.key] = case
    return list(cases.values())


def _given(about: dict[str, Any]) -> dict[str, Any]:
    """What a case says of a given capture."""
    labels = {name: value for name, value in about.items() if name not in ("folder", "seed")}
    if unknown := labels.keys() - set(RUN_LABELS):
        raise ValueError(f"{min(unknown)!r} is not possible for a folder, which is not rendered")
    return labels | {"model": about["folder"], "options": None}


def _rendered(about: dict[str, Any]) -> dict[str, Any]:
    """What a case says of a capture that is rendered."""
    options = dict(about)
    labels = {name: options.pop(name) for name in (*RUN_LABELS, "model") if name in options}
    # The directionality of a light is there for the reader of the file.
    options.pop("directionality", None)
    if unknown := options.keys() - {part.name for part in dataclasses.fields(SynthOptions)}:
        raise ValueError(f"{min(unknown)!r} is not an option of tumble synth")
    return labels | {"options": options}


def _folder() -> Any:
    return resources.files("tumble.bench") / "suites"
