"""Kernels in wheels: which of them a processor gets, and a machine without a compiler."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.backends.test_native import compiled, no_library, no_warp  # noqa: F401 (fixtures)
from tumble import backends, doctor
from tumble.backends import _native, _prebuilt

ROOT = Path(__file__).parents[2]
V3 = frozenset({"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "sse4_2"})
AVX512 = frozenset({"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"})


@pytest.mark.parametrize(
    ("machine", "features", "chosen"),
    [
        ("x86_64", V3 | AVX512, "kernels-x86-64-v4.so"),
        ("x86_64", V3 | AVX512 - {"avx512dq"}, "kernels-x86-64-v3.so"),
        ("x86_64", V3 - {"fma"}, "kernels-x86-64.so"),
        ("x86_64", frozenset(), "kernels-x86-64.so"),
        ("aarch64", frozenset(), "kernels-armv8-a.so"),
        ("arm64", frozenset(), "kernels-armv8-a.so"),
        ("riscv64", frozenset(), None),
    ],
)
def test_a_processor_gets_the_widest_vectors_that_it_has(
    tmp_path: Path, machine: str, features: frozenset[str], chosen: str | None
) -> None:
    for march in ("x86-64", "x86-64-v3", "x86-64-v4", "armv8-a"):
        (tmp_path / f"kernels-{march}.so").touch()
    found = _prebuilt.choose(machine, features, tmp_path)
    assert (found and found.name) == chosen
    assert _prebuilt.choose(machine, features, tmp_path / "nowhere") is None


@pytest.mark.usefixtures("no_library", "no_warp")
def test_without_a_compiler_the_kernels_of_the_wheel_are_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "kernels-x86-64.so"
    shutil.copyfile(compiled()._name, path)
    _native.library.cache_clear()
    monkeypatch.setenv("CXX", "no-such-compiler")
    monkeypatch.setattr(_native, "choose", lambda machine, features: path)
    monkeypatch.setattr(_native, "PREBUILT", tmp_path)
    assert backends.choose(torch.device("cpu"), torch.float32) is backends.load("cpu")
    assert backends.origin_of_kernels() == ("kernels-x86-64 of the wheel", "")
    other = tmp_path / "kernels-x86-64-v3.so"
    other.write_bytes(b"for another system")
    monkeypatch.setattr(_native, "choose", lambda machine, features: other)
    _native.library.cache_clear()
    state, fix = backends.origin_of_kernels()
    assert state.startswith("plain torch")
    assert "install one" in fix


def test_a_wheel_without_a_compiler_has_no_kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CXX", "no-such-compiler")
    assert _prebuilt.compile_all(tmp_path) == []


@pytest.mark.skipif(sys.platform != "linux", reason="manylinux is for Linux")
def test_the_tag_of_a_wheel_admits_the_systems_that_have_its_symbols(tmp_path: Path) -> None:
    tag = _prebuilt.platform_tag([Path(compiled()._name)])
    own = os.confstr("CS_GNU_LIBC_VERSION") or ""
    assert tag.startswith("manylinux_2_")
    assert 5 <= int(tag.split("_")[2]) <= int(own.rpartition(".")[2]), "pip would install the wheel here"
    start = b"\x7fELF\0libc.so.6\0GLIBC_2.2.5\0"
    for names, expected in [
        (b"GLIBC_2.14\0GLIBC_2.9\0", "manylinux_2_14_"),
        (b"libm.so.6\0GLIBC_2.34\0", "manylinux_2_34_"),
        (b"libstdc++.so.6\0GLIBC_2.14\0", "linux_"),  # its version matters too
        (b"libgomp.so.1\0", "linux_"),  # not on every system
    ]:
        (tmp_path / "x.so").write_bytes(start + names)
        assert _prebuilt.platform_tag([tmp_path / "x.so"]).startswith(expected)
    (tmp_path / "x.so").write_bytes(b"\x7fELF\0libc.musl-x86_64.so.1\0")
    assert _prebuilt.platform_tag([tmp_path / "x.so"]).startswith("linux_")


def test_the_doctor_names_the_kernels_and_their_speed() -> None:
    (kernels,) = (finding for finding in doctor.findings() if finding.subject == "kernels")
    assert backends.origin_of_kernels()[0] in kernels.state
    assert "4000 Gaussians at 128 x 128 pixels in" in kernels.state


@pytest.mark.slow
def test_an_installed_wheel_renders_without_a_compiler(tmp_path: Path) -> None:
    """Every library of the wheel that this processor can execute, with an empty PATH and an empty home."""
    compiled()
    pip = [sys.executable, "-m", "pip", "--quiet"]
    subprocess.run([*pip, "wheel", "--no-deps", "--wheel-dir", str(tmp_path), str(ROOT)], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    assert "-manylinux_2_" in wheel.name or sys.platform != "linux"
    site, home = tmp_path / "site", tmp_path / "home"
    subprocess.run([*pip, "install", "--no-deps", "--target", str(site), str(wheel)], check=True)
    assert (site / "tumble" / "backends" / "prebuilt").is_dir()
    program = (
        "import platform, sys; sys.modules['warp'] = None; "
        f"sys.path.append({str(ROOT)!r}); import tumble; assert tumble.__file__.startswith({str(site)!r}); "
        "from tumble.backends import _native, _prebuilt; from tests.backends.test_native import exercise; "
        "variants = _prebuilt.VARIANTS[platform.machine()]; has = _prebuilt.processor_features(); "
        "usable = [needed for _, needed in variants if needed <= has]\n"
        "for needed in usable:\n"
        "    _native.library.cache_clear(); _native.processor_features = lambda: needed\n"
        "    assert _native.origin().endswith('of the wheel'); exercise(); print(_native.library().lanes())\n"
    )
    environment = {"PATH": "", "HOME": str(home), "PYTHONPATH": str(site), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert {int(line) for line in done.stdout.split()} <= {4, 8, 16}
    assert done.stdout.split()
    assert not home.exists() or not any(home.rglob("*.so"))
