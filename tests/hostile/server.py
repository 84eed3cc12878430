"""A process that has imported the package and runs commands of it in forks, so that a case costs no start.

It reads one JSON document per line, {"words", "folder", "seconds"}, and answers each with {"code", "error", "bytes",
"seconds"}. The words are those of the command line; or "read", the name of one of the `readers`, and a path. It runs
outside of pytest, whose import hook checks types that nothing checks for a user.
"""

import json
import os
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

MAX_DATA = 6 << 30
"""Limit of the memory of a fork, which protects the machine [bytes]; the tests' own limit is lower."""
MODULES = (
    *("actions", "cli", "datasets.bop", "datasets.ho3d", "evaluation", "export", "pipeline", "report"),
    *("preprocess.check", "preprocess.colmap_to_capture", "preprocess.video_to_capture", "synthetic.synthesize"),
)
"""Modules that commands import when they run."""


def readers() -> dict[str, Callable[[Path], object]]:
    """Every reader of the package, by name."""
    from tumble import datasets
    from tumble.datasets import bop
    from tumble.engine import loop, run
    from tumble.io import files, tree, video
    from tumble.preprocess import colmap, footage
    from tumble.rendering import relight
    from tumble.scene import Asset, Environment
    from tumble.synthetic import pathtracer

    return {
        "capture": lambda path: datasets.reader_for(path).load(path),
        "truth": lambda path: datasets.reader_for(path).load_truth(path),
        "bop": bop.load_truth,
        "picture": files.read_image,
        "film": lambda path: sum(1 for _ in video.timed_frames(path)),
        "light map": Environment.read,
        "model": pathtracer.read_model,
        "colmap": colmap.read,
        "asset": lambda path: tree.load(Asset, path),
        "checkpoint": loop.peek,
        "recipe": lambda path: run.settings(path, "relight", relight.Config),
        "poses": run.frame_names,
        "log": run.log_records,
        "provenance": footage.read_provenance,
    }


def serve() -> None:
    """Answer requests until the input ends."""
    import importlib

    import torch

    for name in MODULES:
        importlib.import_module(f"tumble.{name}")
    import trimesh  # noqa: F401

    torch.set_num_threads(1)
    warm_up()
    answers = os.fdopen(os.dup(1), "w")
    print(json.dumps("ready"), file=answers, flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        print(json.dumps(run(request["words"], Path(request["folder"]), request["seconds"])), file=answers, flush=True)


def warm_up() -> None:
    """Read a valid capture, so that what the libraries load on first use is there."""
    from tests.hostile.cases import capture, put
    from tumble import datasets, pipeline

    with tempfile.TemporaryDirectory() as folder:
        put(Path(folder), capture())
        datasets.check_plausible(pipeline.read_capture(Path(folder) / "in"), Path(folder))


def run(words: list[str], folder: Path, seconds: int) -> dict[str, object]:
    """Run a command in a fork, inside a folder."""
    said, started = folder / ".stderr", time.monotonic()
    child = os.fork()
    if child == 0:
        code = 70
        try:
            code = command(words, folder, said, seconds)
        finally:
            os._exit(code)
    _, status, usage = os.wait4(child, 0)
    error = said.read_text("utf-8", errors="replace")
    said.unlink()
    code = os.waitstatus_to_exitcode(status)
    return {"code": code, "error": error, "bytes": usage.ru_maxrss << 10, "seconds": time.monotonic() - started}


def command(words: list[str], folder: Path, said: Path, seconds: int) -> int:
    """The exit code of the command line in this process, as the shell would see it."""
    from tumble import cli

    os.chdir(folder)
    for number, path in ((0, os.devnull), (1, os.devnull), (2, said)):
        os.dup2(os.open(path, os.O_RDWR | os.O_CREAT), number)
    # Compiled kernels stay where they are; anything else at home would be a file outside of the output folder.
    cache = os.environ.get("XDG_CACHE_HOME", str(Path.home() / ".cache"))
    os.environ |= {"HOME": str(folder), "XDG_CACHE_HOME": cache}
    resource.setrlimit(resource.RLIMIT_DATA, (MAX_DATA, MAX_DATA))
    signal.alarm(seconds)
    sys.argv = ["tumble", *words]
    code = 0
    try:
        if words[0] == "read":
            readers()[words[1]](Path(words[2]))
        else:
            cli.main()
    except (ValueError, OSError) as error:
        print(f"tumble: {error}", file=sys.stderr)
        code = 1
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:
        import traceback

        traceback.print_exc()
        code = 71
    sys.stderr.flush()
    return code


if __name__ == "__main__":
    serve()
