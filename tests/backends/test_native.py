"""Compiling the CPU kernels on first use, with a compiler and without, and what the compiled code may not do."""

import ctypes
import os
import stat
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

from tests.backends import cases
from tumble import backends
from tumble.backends import _native, reference

CPU = torch.device("cpu")


@pytest.fixture
def no_library() -> Iterator[None]:
    """As in a fresh process; afterwards too."""
    _native.library.cache_clear()
    backends._warn_once.cache_clear()
    yield
    _native.library.cache_clear()
    backends._warn_once.cache_clear()


@pytest.fixture
def no_warp(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "warp", None)


@pytest.fixture
def no_compiler(no_library: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only Warp's own Clang is left."""
    pytest.importorskip("warp", reason="needs Warp: pip install 'tumble[cuda]'")
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(_native, "COMPILERS", ())


@pytest.mark.usefixtures("no_library", "no_warp")
def test_without_a_compiler_the_reference_draws_and_one_warning_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder
) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.warns(RuntimeWarning, match=r"no-such-compiler.*install one.*pip install 'tumble\[cuda\]'"):
        assert backends.choose(CPU, torch.float32) is reference
    assert backends.choose(CPU, torch.float32) is reference


@pytest.mark.usefixtures("no_library", "no_warp")
def test_a_failing_compiler_is_named_with_what_it_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("CXX", _script(tmp_path / "broken", "echo out of cheese >&2; exit 1"))
    assert "out of cheese" in backends.load("cpu").ready(CPU, torch.float32)
    assert not list((tmp_path / "tumble").iterdir())


@pytest.mark.parametrize("name", cases.SCENES)
@pytest.mark.usefixtures("no_compiler")
def test_without_a_compiler_the_kernels_of_warps_clang_draw_as_the_reference(name: str) -> None:
    cpu, scene = backends.load("cpu"), cases.SCENES[name]()
    assert backends.choose(CPU, torch.float32) is cpu
    assert not isinstance(_native.library(), ctypes.CDLL)
    view, gradients = cases.render(cpu, scene, torch.float32)
    truth, true_gradients = cases.render(reference, scene, torch.float64)
    # 1e-4 as for a compiler; the variance is a difference of nearly equal numbers.
    pairs = [*zip(view[:6], truth[:6], strict=True), *zip(gradients, true_gradients, strict=True)]
    worst = [cases.difference(a, b) for a, b in pairs]
    assert worst.pop(view._fields.index("depth_var")) < 5e-4
    assert max(worst) < 1e-4, worst
    assert torch.equal(view.touched, truth.touched)


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.usefixtures("no_compiler")
def test_without_a_compiler_every_verb_works_on_any_number_of_threads(threads: int) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        exercise()
    finally:
        torch.set_num_threads(before)


@pytest.mark.usefixtures("no_compiler")
def test_warps_clang_takes_the_vectors_of_the_machine() -> None:
    """Narrower ones cost half the speed, wider ones far more. The flags are those that a compiler would look at."""
    flags = next((x.split() for x in _native._cpu_features().splitlines() if x.startswith("flags")), None)
    if flags is None:
        pytest.skip("this system does not list what its processor can")
    lanes = 16 if {"avx512f", "avx512dq"} <= set(flags) else 8 if "avx2" in flags else 4
    assert _native.library().lanes() == lanes


@pytest.mark.usefixtures("no_compiler")
def test_a_warp_that_cannot_compile_is_named_and_the_reference_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """As an older or a later Warp, which may lack what is used of it."""
    import warp

    monkeypatch.delitem(sys.modules, "tumble.backends._jit", raising=False)
    monkeypatch.delattr(backends, "_jit", raising=False)
    monkeypatch.delattr(warp, "ModuleBuildOptions")
    with pytest.warns(RuntimeWarning, match=r"no C\+\+ compiler.*nor can Warp [0-9.]+.*ModuleBuildOptions"):
        assert backends.choose(CPU, torch.float32) is reference


def test_two_processes_that_start_at_once_compile_to_one_whole_file(tmp_path: Path) -> None:
    """The compiler here is a script that takes its time to copy what was compiled before."""
    library = compiled()
    to_output = 'while [ "$1" != -o ]; do [ "$1" = --version ] && exit; shift; done'
    copy = f'{to_output}; sleep .3; cp {library._name} "$2"'
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "CXX": _script(tmp_path / "slow", copy)}
    program = "import sys; from tumble.backends import _native; sys.exit(_native.library().lanes() not in (4, 8, 16))"
    runs = [subprocess.Popen([sys.executable, "-c", program], env=environment) for _ in range(2)]
    assert [run.wait() for run in runs] == [0, 0]
    assert [path.suffix for path in (tmp_path / "tumble").iterdir()] == [".so"]


def test_threads_of_python_may_draw_at_once() -> None:
    """One has the pool of workers, the other draws alone: the same picture."""
    cpu, scene = backends.load("cpu"), cases.hard()
    if reason := cpu.ready(CPU, torch.float32):
        pytest.skip(reason)
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with ThreadPoolExecutor(4) as pool:
            drawn = list(pool.map(lambda _: cases.render(cpu, scene, torch.float32), range(12)))
    finally:
        torch.set_num_threads(threads)
    for view, gradients in drawn[1:]:
        assert torch.equal(view.rgb, drawn[0][0].rgb)
        # Other threads of torch may see another number of threads: sums in another order.
        assert all(cases.difference(a, b) < 1e-5 for a, b in zip(gradients, drawn[0][1], strict=True))


WIDTHS = {"16": ["-march=x86-64-v4"], "8": ["-march=x86-64-v3"], "4": ["-march=x86-64"]}
"""Floats in a vector, and the flag that brings it about."""


@pytest.mark.slow
@pytest.mark.parametrize("lanes", WIDTHS)
@pytest.mark.usefixtures("no_library")
def test_every_vector_width_gives_the_same_pictures(
    lanes: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if compiled().lanes() < int(lanes):
        pytest.skip("this machine has no such vectors")
    monkeypatch.setattr(_native, "VARIANTS", (WIDTHS[lanes],))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    _native.library.cache_clear()
    assert _native.library().lanes() == int(lanes)
    exercise()


def compiled() -> ctypes.CDLL:
    """What the system's compiler made of the kernels."""
    if reason := backends.load("cpu").ready(CPU, torch.float32):
        pytest.skip(reason)
    library = _native.library()
    if not isinstance(library, ctypes.CDLL):
        pytest.skip("needs a C++ compiler")
    return library


def exercise() -> None:
    """Every verb of the CPU backend on the hard scene, held against the reference."""
    cpu, scene = backends.load("cpu"), cases.hard()
    view, gradients = cases.render(cpu, scene, torch.float32)
    truth, true_gradients = cases.render(reference, scene, torch.float64)
    # 1e-4 as for the machine's own width; the variance is a difference of nearly equal numbers.
    pairs = [*zip(view[:6], truth[:6], strict=True), *zip(gradients, true_gradients, strict=True)]
    assert max(cases.difference(a, b) for a, b in pairs) < 5e-4
    rng = torch.Generator().manual_seed(0)
    cloud, directions = [x.float() for x in scene.inputs[:4]], cases.fibonacci(45).float()
    points = torch.randn(40, 3, generator=rng)
    normals = torch.nn.functional.normalize(torch.randn(40, 3, generator=rng), dim=-1)
    tree, bvh = cpu.build(*cloud), reference.build(*cloud)
    bits = cpu.visible(tree, points, normals, directions)
    blockers = cpu.blockers(tree, points, normals, directions, bits)
    assert (bits != reference.visible(bvh, points, normals, directions)).float().mean() < 0.02
    assert (blockers != reference.blockers(bvh, points, normals, directions, bits)).float().mean() < 0.02
    hits = cpu.trace(tree, points, normals, torch.rand(len(cloud[0]), 3, generator=rng))
    assert cases.difference(hits.transmittance, reference.trace(bvh, points, normals, points[:0]).transmittance) < 1e-4
    surface = [normals, torch.rand(40, 3, generator=rng), torch.rand(40, generator=rng), normals.roll(1, 0)]
    light = [torch.rand(45, 3, generator=rng), torch.rand(len(cloud[0]), 3, generator=rng)]
    inputs = [x.requires_grad_() for x in (*surface, *light)]
    results = []
    for backend in (cpu, reference):
        shaded = backend.shade(*inputs[:4], directions, inputs[4], bits, blockers, inputs[5], 0.04)
        results.append([shaded, *torch.autograd.grad(shaded.sum(), inputs)])
    # Both in 32 bits.
    assert max(cases.difference(a, b) for a, b in zip(*results, strict=True)) < 1e-3


@pytest.mark.slow
def test_the_kernels_touch_no_memory_but_their_own(tmp_path: Path) -> None:
    """Address and undefined-behaviour sanitizers watch every verb, with no Gaussians too, on one and three threads."""
    try:
        compiler = _native.find_compiler()
    except _native.CannotCompile as reason:
        pytest.skip(str(reason))
    runtime = subprocess.run([compiler, "-print-file-name=libasan.so"], capture_output=True, text=True).stdout.strip()
    if not Path(runtime).is_file():
        pytest.skip("the compiler has no address sanitizer")
    library = tmp_path / "kernels.so"
    watch = ["-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-march=native", "-O1"]
    source = str(_native.SOURCES / "kernels.cpp")
    subprocess.run([compiler, *_native.FLAGS, *watch, source, "-o", str(library)], check=True)
    program = (
        "import ctypes, torch; from tumble.backends import _native, load; "
        f"kernels = ctypes.CDLL({str(library)!r}); _native.library = lambda: kernels; "
        "from tests.backends import cases, test_native; "
        "[(torch.set_num_threads(t), test_native.exercise(), "
        "cases.render(load('cpu'), cases.empty(), torch.float32)) for t in (1, 3)]"
    )
    environment = {**os.environ, "LD_PRELOAD": runtime, "ASAN_OPTIONS": "detect_leaks=0"}
    run = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-3000:]


def _script(path: Path, text: str) -> str:
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)
