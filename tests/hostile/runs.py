"""Run directories and predictions with damaged files."""

import copy
import json
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import safetensors.torch
import torch

from tests.hostile.cases import FRAMES, SIDE, Case, Content, capture, cut, flipped, poses, put, transforms
from tests.hostile.documents import HUGE, value_at
from tests.hostile.light_maps import exr
from tumble import recipes
from tumble.engine import run
from tumble.io import tree
from tumble.scene import Asset, Camera, Environment, Gaussians, Material, Trajectory

RELIGHT = ["relight", "run", "--env", "light.exr", "--fast", "-o", "out"]
EXPORT = ["export", "run", "--preset", "splat", "-o", "out"]
REPORT = ["report", "run"]
EVALUATE = ["evaluate", "run", "-o", "out"]
N_FLIPPED = 30
"""Number of bytes of the header of the asset that are flipped, one per run."""


@cache
def finished() -> dict[str, bytes]:
    """The files of a finished run of the capture `in`, as far as commands read them."""
    generator = torch.Generator().manual_seed(0)

    def randn(*shape: int) -> torch.Tensor:
        return 0.3 * torch.randn(*shape, generator=generator)

    asset = Asset(
        gaussians=Gaussians(randn(9, 3), randn(9, 4), randn(9, 3) - 2, randn(9), randn(9, 4, 3)),
        gamma=torch.tensor(7.0),
        material=Material.constant(9, torch.tensor([0.2, 0.5, 0.7]), 0.3),
        environment=Environment.from_radiance(torch.rand(4, 8, 3, generator=generator)),
        trajectory=Trajectory.from_camera_to_object(torch.from_numpy(poses()).float(), "object"),
        camera=Camera(torch.tensor([40.0, 40.0, 12.0, 12.0]), SIDE, SIDE),
    )
    with TemporaryDirectory() as folder:
        run.open(Path(folder) / "run", Path("in"), recipes.SMOKE)
        tree.save(asset, Path(folder) / "run" / run.ASSET)
        names = [f"{i:04}.png" for i in range(FRAMES)]
        matrices = dict(zip(names, poses().tolist(), strict=True))
        (Path(folder) / "run" / run.POSES).write_text(json.dumps(matrices))
        recipe = json.loads((Path(folder) / "run" / run.RECIPE).read_text())
        recipe["capture"]["path"] = "in"
        (Path(folder) / "run" / run.RECIPE).write_text(json.dumps(recipe))
        kept = (run.ASSET, run.POSES, run.RECIPE)
        found = {f"run/{name}": (Path(folder) / "run" / name).read_bytes() for name in kept}
    return {**found, **capture(), "light.exr": exr()}


def edited(folder: Path, name: str, keys: tuple[str | int, ...], value: object) -> None:
    """A run with a changed JSON document."""
    document = copy.deepcopy(json.loads(finished()[f"run/{name}"]))
    value_at(keys, value)(document)
    put(folder, {**finished(), f"run/{name}": json.dumps(document).encode()})


def damaged(name: str, content: Content) -> Callable[[Path], None]:
    """A run with a replaced file."""
    return partial(put, contents={**finished(), name: content})


JUNK = {
    **{
        "empty": b"",
        "an empty dict": b"{}",
        "a list": b"[]",
        "null": b"null",
        "text": b"hello",
        "nested": b"[" * 99_999,
    },
    **{"NaN": b'{"a": NaN}', "cut": b'{"capture": {"path": "in"', "bytes": b"\xff\xfe\x00" * 50},
}
"""Contents of a damaged JSON document, by name."""


def documents() -> Iterator[Case]:
    """recipe.json, poses.json and ingest.json."""
    for what, content in JUNK.items():
        yield Case(f"recipe.json is {what}", damaged("run/recipe.json", content), RELIGHT, r"run/recipe\.json: ")
        yield Case(f"poses.json is {what}", damaged("run/poses.json", content), EXPORT, r"run/poses\.json: ")
        note = damaged("run/capture/ingest.json", content)
        if what != "an empty dict":  # it has no required entry
            yield Case(f"ingest.json is {what}", note, EVALUATE, r"ingest\.json: |in: ")
    values: dict[str, tuple[tuple[str | int, ...], object]] = {
        "a path that is null": (("capture", "path"), None),
        "a path that is a dict": (("capture", "path"), {}),
        "a path with a zero byte": (("capture", "path"), "a\0b"),
        "a capture that is a list": (("capture",), []),
        "settings that are null": (("recipe",), None),
        "settings that are a list": (("recipe",), [1]),
        "another format": (("format",), 99),
        "a format that is a word": (("format",), "two"),
        "a format of 10^400": (("format",), HUGE),
    }
    for what, (keys, value) in values.items():
        write = partial(edited, name="recipe.json", keys=keys, value=value)
        yield Case(f"recipe.json has {what}", write, REPORT, r"run(/recipe\.json)?: |a\b")
    rays = {"null": None, "a list": [], "words": {"brdf_samples": "many"}, "10^400": {"brdf_samples": HUGE}}
    for what, value in {**rays, "no rays": {"light_samples": 0}}.items():
        write = partial(edited, name="recipe.json", keys=("recipe", "relight"), value=value)
        yield Case(f"recipe.json has {what} as numbers of rays", write, RELIGHT, r"run/recipe\.json: ")
    matrices = {"null": None, "a word": "eye", "10^400": [[HUGE]], "a dict": {}, "long rows": [[0.0] * 9]}
    for what, value in matrices.items():
        write = partial(edited, name="poses.json", keys=("0000.png",), value=value)
        yield Case(f"a pose is {what}", write, EXPORT, r"run/poses\.json: ")
    more = partial(edited, name="poses.json", keys=("x.png",), value=np.eye(4).tolist())
    yield Case("a pose too many", more, EXPORT, r"run/poses\.json: holds 9 frames, the asset 8")


def repacked(change: Callable[[dict[str, torch.Tensor], dict[str, str]], object]) -> bytes:
    """The asset with changed tensors or header."""
    content = finished()["run/asset.safetensors"]
    tensors = safetensors.torch.load(content)
    header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])["__metadata__"]
    change(tensors, header)
    return safetensors.torch.save(tensors, header)


def assets() -> Iterator[Case]:
    """asset.safetensors."""
    content = finished()["run/asset.safetensors"]
    length = int.from_bytes(content[:8], "little")
    files: dict[str, bytes] = {
        **{"empty": b"", "text": b"asset", "zeros": bytes(4000), "a header of 2^64 bytes": b"\xff" * 8 + content[8:]},
        **{f"cut at {part}": cut(content, part) for part in (0.01, 0.2, 0.9, 0.999)},
        "nested": (99_999).to_bytes(8, "little") + b"[" * 99_999,
        "without header": repacked(lambda tensors, header: header.clear()),
        "of another class": repacked(lambda tensors, header: header.update(type="Camera")),
        "with facts that are a list": repacked(lambda tensors, header: header.update(facts="[]")),
        "with facts that are text": repacked(lambda tensors, header: header.update(facts="hello")),
        "with nested facts": repacked(lambda tensors, header: header.update(facts="[" * 99_999)),
        "with empty facts": repacked(lambda tensors, header: header.update(facts="{}")),
    }
    for name in ("gaussians.means", "gamma", "material.f0_logit", "trajectory.T_cam_obj.xyz", "camera.fx_fy_cx_cy"):
        files[f"without {name}"] = repacked(lambda tensors, header, name=name: tensors.pop(name))
        files[f"with integers as {name}"] = repacked(
            lambda tensors, header, name=name: tensors.update({name: tensors[name].int()})
        )
        files[f"with a longer {name}"] = repacked(
            lambda tensors, header, name=name: tensors.update({name: torch.zeros(7, 7, 7)})
        )
    fewer = repacked(lambda tensors, header: tensors.update({"gaussians.sdf": torch.zeros(3)}))
    files["with fewer distances than Gaussians"] = fewer
    for what, other in files.items():
        yield Case(f"an asset {what}", damaged("run/asset.safetensors", other), RELIGHT, r"run/asset\.safetensors: ")
    for i in np.linspace(0, 7 + length, N_FLIPPED).astype(int):
        write = damaged("run/asset.safetensors", flipped(content, int(i), 0x15))
        yield Case(f"an asset with byte {i} flipped", write, RELIGHT, r"run/asset\.safetensors: ", also=(0,))


def commands() -> Iterator[Case]:
    """Options, missing files, and folders that are no run."""
    whole = partial(put, contents=finished())
    for value in ("nan", "inf", "1e30", "-1000"):
        yield Case(f"--exposure {value}", whole, [*RELIGHT, "--exposure", value], "--exposure is out of range")
        turntable = ["relight", "run", "--env", "light.exr", "--turntable", "out/x.mp4", "--exposure", value]
        yield Case(f"a turntable with --exposure {value}", whole, turntable, "--exposure is out of range")
    for value in ("nan", "inf", "0", "-5", "1e30"):
        yield Case(f"--scale-mm {value}", whole, [*EXPORT, "--scale-mm", value], "--scale-mm is out of range")
    for words in (RELIGHT, EXPORT, REPORT, EVALUATE):
        nowhere = [word.replace("run", "nowhere") for word in words]
        yield Case(f"{words[0]} of nothing", whole, nowhere, "nowhere")
        yield Case(f"{words[0]} of a capture", whole, [word.replace("run", "in") for word in words], "in")
    missing = ["relight", "run", "--env", "nowhere.hdr", "-o", "out"]
    yield Case("a light that is missing", whole, missing, "nowhere")
    yield Case("a light that is a folder", whole, ["relight", "run", "--env", "in", "-o", "out"], "in")
    truth = {**finished(), "in/truth/poses.json": b"[]"}
    yield Case("true poses that are a list", partial(put, contents=truth), EVALUATE, r"truth/poses\.json: ")
    evaluated = ["evaluate", "prediction", "in", "-o", "out"]
    frames = [*transforms()["frames"], {**transforms()["frames"][0], "file_path": "images/v.png", "split": "eval"}]
    frames[-1]["mask_path"] = "masks/0000.png"
    views = {**capture(), "in/transforms.json": json.dumps({**transforms(), "frames": frames}).encode()}
    views |= {"in/images/v.png": capture()["in/images/0000.png"]}
    predictions: dict[str, dict[str, bytes]] = {
        "nothing": {"prediction/x": b""},
        "an albedo that is text": {"prediction/albedo/0000.exr": b"hello"},
        "an albedo of another size": {"prediction/albedo/0000.exr": exr()},
        "a negative albedo": {"prediction/albedo/0000.exr": exr(SIDE, SIDE, value=-1.0)},
        "roughness of 7": {"prediction/roughness/0000.exr": exr(SIDE, SIDE, ("Y",), 7.0)},
        "a mask that is text": {"prediction/mask/0000.png": b"hello"},
        "a view too many": {"prediction/albedo/0001.exr": exr(SIDE, SIDE)},
        **{f"poses that are {what}": {"prediction/poses.json": content} for what, content in JUNK.items()},
        "a pose of an unknown frame": {"prediction/poses.json": b'{"x.png": []}'},
        "a pose that is null": {"prediction/poses.json": b'{"0000.png": null}'},
        "a light that is text": {"prediction/light.exr": b"hello"},
    }
    for what, files in predictions.items():
        yield Case(f"a prediction with {what}", partial(put, contents={**views, **files}), evaluated, "prediction")


def cases() -> Iterator[Case]:
    """All cases of this family."""
    for group in (documents, assets, commands):
        yield from group()
