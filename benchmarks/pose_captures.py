"""Synthetic captures of the benchmarks of stage 1: five objects, each under two lights with two hand-held
trajectories; nine other objects under the same lights; two captures at a higher resolution; and eight difficult ones.

All are rendered from the files in `$TUMBLE_BENCH_DATA` into capture folders. A difficulty that concerns images or masks
is introduced after loading (`ODDITIES`).
"""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from tumble.datasets import folder
from tumble.io import files
from tumble.maths import linear_from_srgb, srgb_from_linear
from tumble.scene import BACKGROUND, OBJECT, Capture, Trajectory
from tumble.synthetic import SynthOptions, render_capture

DATA = Path(os.environ.get("TUMBLE_BENCH_DATA") or Path(__file__).parents[2] / "shared" / "data")
"""Folder of meshes and light maps."""
TEXTURED = ("ycb_006_mustard_bottle", "ycb_003_cracker_box", "ycb_005_tomato_soup_can")
"""Objects with rich texture."""
OTHERS = ("chess_Knight", "rubber_duck_toy")
"""Objects with little texture."""
NEW = (
    "AntiqueCameraBody",
    "Avocado",
    "BoomBox",
    "Corset",
    "MaterialsVariantsShoe",
    "WaterBottle",
    "hot3d_puzzle_toy",
    "tea_teapot",
    "yellow_bell_pepper",
)
"""Objects on which nothing was chosen; boom box, corset, water bottle and bell pepper, the worst of them, were seen
when stage 1 was designed."""
LIGHTS = ("immenstadter_horn", "st_fagans_interior")
"""Light maps: sunny, and indoors."""
SEEDS = (0, 1)
"""Seeds of the hand-held trajectories."""
FRAMES = 72
"""Frames per capture."""


@dataclass(frozen=True)
class Case:
    """A capture, and how it is modified after loading."""

    model: str
    light: str = LIGHTS[0]
    seed: int = 0
    resolution: int = 128
    setting: str = "handheld"
    oddity: str = ""
    """Key of `ODDITIES`, "spliced", or empty: no modification."""

    @property
    def folder(self) -> str:
        """Name of the capture's folder, which does not depend on the modification."""
        if self.model in TEXTURELESS:
            return self.model
        suffixes = [str(self.resolution)] if self.resolution != 128 else []
        suffixes += [self.setting] if self.setting != "handheld" else []
        return "-".join([self.model, self.light, str(self.seed), *suffixes])

    @property
    def name(self) -> str:
        """Name of the case in the tables."""
        return f"{self.folder}+{self.oddity}" if self.oddity else self.folder


def load(case: Case, root: Path) -> tuple[Capture, Trajectory | None]:
    """The modified capture without poses, and its true poses; None if it shows two objects or one without texture."""
    path = rendered(case, root)
    truth = folder.load_truth(path)
    assert truth is not None, f"{path} has no ground truth"
    capture = replace(folder.load(path), trajectory=None)
    if case.oddity == "spliced":
        other = folder.load(rendered(Case(OTHERS[0]), root))
        return spliced(capture, other), None
    capture = ODDITIES[case.oddity](capture) if case.oddity else capture
    return capture, None if case.model in TEXTURELESS else truth.poses


def rendered(case: Case, root: Path) -> Path:
    """The capture's folder, rendered if it does not exist."""
    model = DATA / "meshes" / f"{case.model}.glb"
    if case.model in TEXTURELESS:
        model = root / f"{case.model}.glb"
        if not model.exists():
            files.write_atomically(model, lambda partial: partial.write_bytes(textureless_glb(case.model)))
    options = SynthOptions(
        env=str(DATA / "hdri" / f"{case.light}_1k.hdr"),
        setting=case.setting,  # type: ignore[arg-type]
        views=FRAMES,
        resolution=case.resolution,
        samples=256,
        truth_samples=16,
        eval_shared=0,
        eval_sphere=0,
        up="z" if "cracker_box" in case.model else "y",
        pose_free=True,
        seed=case.seed,
    )
    return render_capture(model, root / case.folder, options)


# Difficulties ---------------------------------------------------------------------------------------------------------


def textureless_glb(name: str) -> bytes:
    """A GLB of a grey sphere, or of a grey can with its axis along z."""
    import trimesh
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    if name == "grey_sphere":
        mesh = trimesh.creation.icosphere(subdivisions=5)
    else:
        mesh = trimesh.creation.cylinder(radius=0.5, height=1.5, sections=256)
        mesh.apply_transform(trimesh.transformations.rotation_matrix(math.pi / 2, [1, 0, 0]))
        mesh.unmerge_vertices()
    grey = PBRMaterial(baseColorFactor=[128, 128, 128, 255], roughnessFactor=0.6, metallicFactor=0.0)
    mesh.visual = TextureVisuals(uv=np.zeros((len(mesh.vertices), 2)), material=grey)
    exported = mesh.export(file_type="glb", include_normals=True)
    assert isinstance(exported, bytes), "a GLB"
    return exported


def wrong_masks(capture: Capture) -> Capture:
    """Every tenth mask is wrong, alternately without half of the object and with background as foreground."""
    masks = capture.masks.clone()
    for number, frame in enumerate(range(5, len(capture), 10)):
        rows, columns = torch.nonzero(masks[frame] == OBJECT).T
        centre = int(columns.float().mean())
        if number % 2 == 0:
            masks[frame, :, centre:] = BACKGROUND
        else:
            height, width = int(rows.max() - rows.min()), int(columns.max() - columns.min())
            masks[frame, int(rows.min()) : int(rows.min()) + height // 2, centre : centre + 3 * width // 4] = OBJECT
    return replace(capture, masks=masks)


def drifting_exposure(capture: Capture) -> Capture:
    """The exposure rises by a factor of 1.3 over the video."""
    gain = torch.linspace(1.0, 1.3, len(capture))[:, None, None, None]
    linear = (gain * linear_from_srgb(capture.images.float() / 255)).clamp(0, 1)
    return replace(capture, images=(255 * srgb_from_linear(linear)).round().to(torch.uint8))


def spliced(capture: Capture, other: Capture) -> Capture:
    """The second half of the frames shows another object."""
    half = len(capture) // 2
    images, masks = (torch.cat([getattr(capture, n)[:half], getattr(other, n)[half:]]) for n in ("images", "masks"))
    return replace(capture, images=images, masks=masks)


TEXTURELESS = ("grey_sphere", "bare_can")
"""Objects without texture, generated here."""
ODDITIES: dict[str, Callable[[Capture], Capture]] = {"wrong masks": wrong_masks, "exposure": drifting_exposure}
"""Modifications of a capture by name."""
PLAIN = [Case(model, light, seed) for seed in SEEDS for light in LIGHTS for model in (*TEXTURED, *OTHERS)]
"""All objects, lights and trajectories at the default resolution."""
OTHER_OBJECTS = [Case(model, light) for light in LIGHTS for model in NEW]
"""The nine other objects under both lights, one trajectory."""
COMPARED = [Case(model, light) for light in LIGHTS for model in (*TEXTURED, *OTHERS, *NEW)]
"""Captures on which the routes of stage 1 are compared: all objects under both lights, one trajectory."""
TABLE_4 = COMPARED[: len(TEXTURED + OTHERS)]
"""Captures on which refinements of the progressive route's poses are compared."""
LARGE = [Case(TEXTURED[0], resolution=256), Case(OTHERS[0], LIGHTS[1], resolution=256)]
"""Captures at twice the resolution."""
DIFFICULT = [
    Case(TEXTURED[0], setting="turntable"),
    *(Case(model, oddity=oddity) for model in (TEXTURED[0], OTHERS[0]) for oddity in ODDITIES),
    *(Case(model) for model in TEXTURELESS),
    Case(TEXTURED[0], oddity="spliced"),
]
"""Captures with modifications, rotation about a single axis, or no texture."""
