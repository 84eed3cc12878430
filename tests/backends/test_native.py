"""Compilation of the CPU kernels on first use, with and without a compiler, and memory safety of the kernels."""

import ctypes
import os
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
import torch

from tests.backends import cases, test_backends
from tests.rendering import test_importance_sampling
from tumble import backends
from tumble.backends import _cache, _native, reference

CPU = torch.device("cpu")


@pytest.fixture
def no_library() -> Iterator[None]:
    """Unload the kernels before and after the test."""
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
    """Hide all C++ compilers, so that only the Clang of Warp remains."""
    pytest.importorskip("warp", reason="needs Warp: pip install 'tumble[cuda]'")
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setattr(_native, "COMPILERS", ())


@pytest.mark.usefixtures("no_library", "no_warp")
def test_without_a_compiler_the_reference_is_used_with_one_warning(
    monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder
) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.warns(RuntimeWarning, match=r"no-such-compiler.*install one.*pip install 'tumble\[cuda\]'"):
        assert backends.choose(CPU, torch.float32) is reference
    assert backends.choose(CPU, torch.float32) is reference


def test_the_compiler_may_have_arguments_or_a_wrapper(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wrapper = _script(tmp_path / "my wrapper", "exit 0")
    for given, command in (
        (f"'{wrapper}' g++ -pipe", [wrapper, "g++", "-pipe"]),
        (wrapper, [wrapper]),
        (" ", [_real_compiler()]),
    ):
        monkeypatch.setenv("CXX", given)
        assert _native.find_compiler() == command


@pytest.mark.usefixtures("no_library", "no_warp")
def test_the_error_of_a_failing_compiler_contains_its_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("CXX", _script(tmp_path / "broken", "echo out of cheese >&2; exit 1"))
    assert "out of cheese" in backends.load("cpu").ready(CPU, torch.float32)
    assert not list((tmp_path / "tumble").iterdir())


@pytest.mark.parametrize("name", cases.SCENES)
@pytest.mark.usefixtures("no_compiler")
def test_kernels_compiled_by_warp_match_the_reference(name: str) -> None:
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
def test_kernels_compiled_by_warp_work_with_any_number_of_threads(threads: int) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        exercise()
    finally:
        torch.set_num_threads(before)


@pytest.mark.usefixtures("no_compiler")
def test_kernels_compiled_by_warp_use_the_vectors_of_the_machine() -> None:
    """Narrower vectors cost half of the speed, wider ones far more."""
    flags = next((x.split() for x in _native._cpu_features().splitlines() if x.startswith("flags")), None)
    if flags is None:
        pytest.skip("this system does not list the features of its processor")
    lanes = 16 if {"avx512f", "avx512dq"} <= set(flags) else 8 if "avx2" in flags else 4
    assert _native.library().lanes() == lanes


@pytest.mark.usefixtures("no_compiler")
def test_if_warp_cannot_compile_the_reference_is_used_with_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    """Other versions of Warp may lack its experimental functions."""
    import warp

    monkeypatch.delitem(sys.modules, "tumble.backends._jit", raising=False)
    monkeypatch.delattr(backends, "_jit", raising=False)
    monkeypatch.delattr(warp, "ModuleBuildOptions")
    with pytest.warns(RuntimeWarning, match=r"no C\+\+ compiler.*installed Warp [0-9.]+ cannot.*ModuleBuildOptions"):
        assert backends.choose(CPU, torch.float32) is reference


def test_concurrent_processes_write_one_complete_library(tmp_path: Path) -> None:
    """The compiler is replaced by a script that slowly copies the library compiled before."""
    library = compiled()
    to_output = 'while [ "$1" != -o ]; do [ "$1" = --version ] && exit; shift; done'
    copy = f'{to_output}; sleep .3; cp {library._name} "$2"'
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "CXX": _script(tmp_path / "slow", copy)}
    program = "import sys; from tumble.backends import _native; sys.exit(_native.library().lanes() not in (4, 8, 16))"
    runs = [subprocess.Popen([sys.executable, "-c", program], env=environment) for _ in range(2)]
    assert [run.wait() for run in runs] == [0, 0]
    assert [path.suffix for path in (tmp_path / "tumble").iterdir()] == [".so"]


def _foreign(path: Path) -> None:
    if os.getuid() != 0:
        pytest.skip("only root can give files away")
    os.chown(path, 65534, 65534)


SPOILERS = {
    "a folder that all can write": lambda folder, library: folder.chmod(0o777),
    "a folder that the group can write": lambda folder, library: folder.chmod(0o770),
    "a folder of another user": lambda folder, library: _foreign(folder),
    "a link to a folder": lambda folder, library: folder.symlink_to(folder.rename(folder.with_name("elsewhere"))),
    "a library that all can write": lambda folder, library: library.chmod(0o777),
    "a library of another user": lambda folder, library: _foreign(library),
    "a link to a library": lambda folder, library: library.symlink_to(library.rename(library.with_suffix(".old"))),
    "the shared temporary folder": lambda folder, library: folder.rename(
        folder.parents[1] / "tmp" / f"tumble-{os.getuid()}"
    ),
}
"""Ways in which a cache can be that of somebody else, as functions of its folder and the library in it."""


@pytest.mark.filterwarnings("ignore:.*compiled kernels cannot be kept:RuntimeWarning")
@pytest.mark.parametrize("spoil", SPOILERS.values(), ids=SPOILERS.keys())
def test_a_library_that_others_could_have_written_is_never_loaded(
    spoil: Callable[[Path, Path], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The planted library tells by a file when it is loaded; the compiler is replaced by a copy of the real one."""
    library, ran, folder = compiled(), tmp_path / "ran", tmp_path / "cache" / "tumble"
    source = f'#include <stdio.h>\n__attribute__((constructor)) void f() {{ fclose(fopen("{ran}", "w")); }}\n'
    (tmp_path / "planted.c").write_text(source)
    (tmp_path / "tmp").mkdir()
    folder.mkdir(parents=True, mode=0o700)
    to_output = 'while [ "$1" != -o ]; do [ "$1" = --version ] && exit; shift; done'
    compiler = _script(tmp_path / "copy", f'{to_output}; cp {library._name} "$2"')
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    monkeypatch.setenv("CXX", compiler)
    _cache._process_folder.cache_clear()
    planted = folder / f"kernels-{_native._build_hash([compiler])}.so"
    subprocess.run([_real_compiler(), "-x", "c", tmp_path / "planted.c", "-shared", "-fPIC", "-o", planted], check=True)
    planted.chmod(0o700)
    spoil(folder, planted)
    assert _native._by_compiler().lanes() == library.lanes()
    assert not ran.exists()


def test_a_library_of_this_user_is_loaded_again_without_a_compiler_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = compiled()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    counted = f'echo x >> {tmp_path / "runs"}; umask 0; cp {library._name} "$2"'
    to_output = 'while [ "$1" != -o ]; do [ "$1" = --version ] && exit; shift; done'
    monkeypatch.setenv("CXX", _script(tmp_path / "copy", f"{to_output}; {counted}"))
    for _ in range(2):
        assert _native._by_compiler().lanes() == library.lanes()
    assert (tmp_path / "runs").read_text() == "x\n"
    assert all(stat.S_IMODE(p.stat().st_mode) == 0o700 for p in (tmp_path / "tumble", *(tmp_path / "tumble").iterdir()))


def test_without_a_cache_that_can_be_trusted_the_folder_belongs_to_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "tumble").mkdir(mode=0o700)
    (tmp_path / "tumble").chmod(0o777)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    _cache._process_folder.cache_clear()
    with pytest.warns(RuntimeWarning, match=r"tumble: compiled kernels cannot be kept: .* \(fix: chmod 700"):
        folder = _cache.writable()
    assert folder.parent == Path(tempfile.gettempdir())
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_warp_gets_a_folder_that_others_cannot_enter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Warp loads any kernel that it finds in its cache; others could have put one into a folder that they can write."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    _cache._process_folder.cache_clear()
    folder = _cache.of_warp()
    assert folder.is_relative_to(tmp_path)
    folder.chmod(0o755)
    assert _cache.of_warp() == folder
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    folder.chmod(0o777)
    with pytest.warns(RuntimeWarning, match=r"warp: compiled kernels cannot be kept: .* \(fix: chmod 700"):
        assert not _cache.of_warp().is_relative_to(tmp_path)


def test_python_threads_can_render_concurrently() -> None:
    """One thread uses the pool, the others render without it; the images are equal."""
    cpu, scene = backends.load("cpu"), cases.hard()
    if reason := cpu.ready(CPU, torch.float32):
        pytest.skip(reason)
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with ThreadPoolExecutor(4) as pool:
            results = list(pool.map(lambda _: cases.render(cpu, scene, torch.float32), range(12)))
    finally:
        torch.set_num_threads(threads)
    for view, gradients in results[1:]:
        assert torch.equal(view.rgb, results[0][0].rgb)
        # The number of threads may differ between Python threads, which changes the order of sums.
        assert all(cases.difference(a, b) < 1e-5 for a, b in zip(gradients, results[0][1], strict=True))


WIDTHS = {"16": ["-march=x86-64-v4"], "8": ["-march=x86-64-v3"], "4": ["-march=x86-64"]}
"""Numbers of floats in a vector, and the compiler flags for each."""


@pytest.mark.slow
@pytest.mark.parametrize("lanes", WIDTHS)
@pytest.mark.usefixtures("no_library")
def test_every_vector_width_matches_the_reference(lanes: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if compiled().lanes() < int(lanes):
        pytest.skip("this machine has no such vectors")
    monkeypatch.setattr(_native, "VARIANTS", (WIDTHS[lanes],))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    _native.library.cache_clear()
    assert _native.library().lanes() == int(lanes)
    exercise()


def _real_compiler() -> str:
    compilers = [path for name in _native.COMPILERS if (path := shutil.which(name))]
    return compilers[0]


def compiled() -> ctypes.CDLL:
    """The kernels compiled by the system's compiler."""
    if reason := backends.load("cpu").ready(CPU, torch.float32):
        pytest.skip(reason)
    library = _native.library()
    if not isinstance(library, ctypes.CDLL):
        pytest.skip("needs a C++ compiler")
    return library


def exercise() -> None:
    """Compare every function of the CPU backend with the reference on the hard scene."""
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
    surface = [normals, torch.rand(40, generator=rng), normals.roll(1, 0)]
    light = [torch.rand(45, 3, generator=rng), torch.rand(len(cloud[0]), 3, generator=rng)]
    inputs = [x.requires_grad_() for x in (*surface, *light)]
    results = []
    for backend in (cpu, reference):
        lobes = backend.shade(*inputs[:3], directions, inputs[3], bits, blockers, torch.arange(40), inputs[4])
        results.append([*lobes, *torch.autograd.grad((lobes.diffuse + lobes.specular).sum(), inputs)])
    test_backends.test_lookups_and_their_gradients_are_those_of_the_reference(cpu, 3, 7, 37)
    test_backends.test_shading_by_harmonics_and_its_gradients_are_those_of_the_reference(cpu, 37, True)
    box = slice(2, 9), slice(3, 12)
    test_backends.test_terms_of_images_and_their_gradients_are_those_of_the_reference(cpu, 12, 13, box, 0.2, 9.0)
    test_backends.test_terms_of_gaussians_and_their_gradients_are_those_of_the_reference(cpu, 37, 8.0)
    test_backends.test_features_of_corners_and_their_gradients_are_those_of_the_reference(cpu, 37)
    test_backends.test_bounces_and_their_gradients_are_those_of_the_reference(cpu, 37)
    test_backends.test_terms_of_materials_and_their_gradients_are_those_of_the_reference(cpu, 12, 13)
    test_importance_sampling.test_the_kernel_computes_what_the_operations_do(70, True)
    # Both are computed in float32.
    assert max(cases.difference(a, b) for a, b in zip(*results, strict=True)) < 1e-3


@pytest.mark.slow
def test_the_kernels_access_their_own_memory_only(tmp_path: Path) -> None:
    """Every function passes the address and undefined-behaviour sanitizers, also without Gaussians and with threads."""
    try:
        compiler = _native.find_compiler()
    except _native.CannotCompile as reason:
        pytest.skip(str(reason))
    runtime = subprocess.run([*compiler, "-print-file-name=libasan.so"], capture_output=True, text=True).stdout.strip()
    if not Path(runtime).is_file():
        pytest.skip("the compiler has no address sanitizer")
    library = tmp_path / "kernels.so"
    sanitize = ["-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-march=native", "-O1"]
    source = str(_native.SOURCES / "kernels.cpp")
    subprocess.run([*compiler, *_native.FLAGS, *sanitize, source, "-o", str(library)], check=True)
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
