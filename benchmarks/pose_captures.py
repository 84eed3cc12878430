"""The captures that stage 1 is measured on: five objects under two lights in two tumbles each, two large, eight odd.

All are made here from the files in `../shared/data` and kept as capture folders; what is odd about a capture's frames
is done to them after loading.
"""

import math
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

DATA = Path(__file__).parents[2] / "shared" / "data"
TEXTURED = ("ycb_006_mustard_bottle", "ycb_003_cracker_box", "ycb_005_tomato_soup_can")
OTHERS = ("chess_Knight", "rubber_duck_toy")
LIGHTS = ("immenstadter_horn", "st_fagans_interior")
SEEDS = (0, 1)
FRAMES = 72


@dataclass(frozen=True)
class Case:
    """One capture and what is done to it."""

    model: str
    light: str = LIGHTS[0]
    seed: int = 0
    resolution: int = 128
    setting: str = "handheld"
    oddity: str = ""

    @property
    def folder(self) -> str:
        """Where the capture is kept, whatever is done to it afterwards."""
        if self.model in BARE:
            return self.model
        more = [str(self.resolution)] if self.resolution != 128 else []
        more += [self.setting] if self.setting != "handheld" else []
        return "-".join([self.model, self.light, str(self.seed), *more])

    @property
    def name(self) -> str:
        return f"{self.folder}+{self.oddity}" if self.oddity else self.folder


def load(case: Case, root: Path) -> tuple[Capture, Trajectory | None]:
    """The capture, without poses, and its true poses where it makes sense to compare with them."""
    path = made(case, root)
    truth = folder.load_truth(path)
    assert truth is not None, f"{path} has no truth"
    capture = replace(folder.load(path), trajectory=None)
    if case.oddity == "spliced":
        other = folder.load(made(Case(OTHERS[0]), root))
        return spliced(capture, other), None
    capture = ODDITIES[case.oddity](capture) if case.oddity else capture
    return capture, None if case.model in BARE else truth.poses


def made(case: Case, root: Path) -> Path:
    """The capture's folder; rendered where it is not there yet."""
    model = DATA / "meshes" / f"{case.model}.glb"
    if case.model in BARE:
        model = root / f"{case.model}.glb"
        if not model.exists():
            files.write_whole(model, lambda partial: partial.write_bytes(bare(case.model)))
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


# What is odd ----------------------------------------------------------------------------------------------------------


def bare(name: str) -> bytes:
    """A GLB of a grey sphere, or of a grey can that lies along the z axis."""
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
    exported = mesh.export(file_type="glb")
    assert isinstance(exported, bytes), "a GLB"
    return exported


def wrong_masks(capture: Capture) -> Capture:
    """Every tenth mask fails: by turns half of the object is missing, or a patch as large as a quarter is added."""
    masks = capture.masks.clone()
    for number, frame in enumerate(range(5, len(capture), 10)):
        rows, columns = torch.nonzero(masks[frame] == OBJECT).T
        middle = int(columns.float().mean())
        if number % 2 == 0:
            masks[frame, :, middle:] = BACKGROUND
        else:
            height, width = int(rows.max() - rows.min()), int(columns.max() - columns.min())
            masks[frame, int(rows.min()) : int(rows.min()) + height // 2, middle : middle + 3 * width // 4] = OBJECT
    return replace(capture, masks=masks)


def drifting(capture: Capture) -> Capture:
    """The exposure rises by 1.3 over the film."""
    gain = torch.linspace(1.0, 1.3, len(capture))[:, None, None, None]
    linear = (gain * linear_from_srgb(capture.images.float() / 255)).clamp(0, 1)
    return replace(capture, images=(255 * srgb_from_linear(linear)).round().to(torch.uint8))


def spliced(capture: Capture, other: Capture) -> Capture:
    """The second half is of another object."""
    half = len(capture) // 2
    images, masks = (torch.cat([getattr(capture, n)[:half], getattr(other, n)[half:]]) for n in ("images", "masks"))
    return replace(capture, images=images, masks=masks)


BARE = ("grey_sphere", "bare_can")
ODDITIES: dict[str, Callable[[Capture], Capture]] = {"wrong masks": wrong_masks, "exposure": drifting}
PLAIN = [Case(model, light, seed) for seed in SEEDS for light in LIGHTS for model in (*TEXTURED, *OTHERS)]
COMPARED = [Case(TEXTURED[0]), Case(OTHERS[0]), Case(TEXTURED[1])]
LARGE = [Case(TEXTURED[0], resolution=256), Case(OTHERS[0], LIGHTS[1], resolution=256)]
ODD = [
    Case(TEXTURED[0], setting="turntable"),
    *(Case(model, oddity=oddity) for model in (TEXTURED[0], OTHERS[0]) for oddity in ODDITIES),
    *(Case(model) for model in BARE),
    Case(TEXTURED[0], oddity="spliced"),
]
