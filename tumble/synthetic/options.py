"""How a synthetic capture is made: the options of `tumble synth`. Loads nothing, for `--help`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Setting = Literal["dome", "turntable", "handheld"]


@dataclass(frozen=True)
class SynthOptions:
    """How a capture is made."""

    env: str
    """The light: a lat-long .hdr or .exr file (+y up), or the word "white" for a uniform one."""
    setting: Setting = "handheld"
    """dome (still object), turntable, or handheld."""
    views: int = 64
    """Training frames."""
    resolution: int = 128
    """Height and width [pixels]."""
    fov: float = 30.0
    """Field of view [degrees]; the object fills it."""
    samples: int = 400
    """Paths per pixel of a photograph."""
    truth_samples: int = 1024
    """Paths per pixel of a relit picture: a score near 40 dB must not measure the truth's noise."""
    path_depth: int = 5
    """Path segments: 2 is direct light alone, each further one adds a bounce between parts of the object."""
    material: Literal["original", "diffuse"] = "original"
    """original: the file's base colour and roughness as a dielectric (F0 = 0.04); diffuse: Lambertian."""
    roughness: float | None = None
    """Replaces the file's roughness everywhere."""
    env_rotation: float = 0.0
    """Turns the light about the vertical [degrees]."""
    up: Literal["y", "z"] = "y"
    """The object file's upward axis."""
    relight: tuple[str, ...] = ()
    """Lights for relit truth, like `env`; their frame is the object's, their names are the files' stems."""
    eval_shared: int = 12
    """Evaluation views 15 to 35 degrees above the horizon."""
    eval_sphere: int = 6
    """Evaluation views from anywhere."""
    exposure: float | None = None
    """Factor on the light; None lets about one percent of the object's pixels saturate."""
    pose_free: bool = False
    """Leave the poses of training frames out of transforms.json (they are kept in truth/poses.json)."""
    video: bool = False
    """Also write the training frames as clip.mp4 (H.264), as a user would bring them."""
    seed: int = 0
    """Of the tumble and of the path tracer."""

    def __post_init__(self) -> None:
        rules = {
            "views": self.views >= 1,
            "resolution": 8 <= self.resolution <= 4096 and self.resolution % 2 == 0,
            "fov": 1 <= self.fov <= 120,
            "samples": self.samples >= 1 and self.truth_samples >= 1,
            "path_depth": self.path_depth >= 2,
            "roughness": self.roughness is None or 0 < self.roughness <= 1,
            "exposure": self.exposure is None or self.exposure > 0,
            "eval_shared": self.eval_shared >= 0 and self.eval_sphere >= 0,
        }
        if broken := [name for name, kept in rules.items() if not kept]:
            raise ValueError(f"{broken[0]} is out of range: {getattr(self, broken[0])} (see tumble synth --help)")
        stems = [Path(name).stem for name in self.relight]
        if len(set(stems)) < len(stems):
            raise ValueError(f"relight needs lights of different names, these are {', '.join(stems)}: rename one")
