"""Options of `tumble synth`. The module imports nothing heavy, so that `--help` is fast."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

from tyro.conf import arg

Setting = Literal["dome", "turntable", "handheld", "turned"]
Skin = Literal["light", "medium", "dark"]
Background = Literal["none", "wall", "desk", "clutter", "torso"]
MAX_FOV = {"none": 120.0, "wall": 70.0, "desk": 52.0, "clutter": 52.0, "torso": 55.0}
"""Maximum field of view with each background [degrees]: a wall or a desk would end inside the film of a wider image."""


@dataclass(frozen=True)
class SynthOptions:
    """How a synthetic capture is rendered."""

    env: str
    """Environment map: an equirectangular .hdr or .exr file (+y up), or "white" for uniform light."""
    setting: Setting = "handheld"
    """dome: the camera moves around a still object. Camera and light are still in the other two:
    turntable: the object rotates about the vertical; handheld: it rotates about changing axes.
    turned: the cameras of the dome, and the light is turned by the poses of a hand-held motion."""
    turns: int = 0
    """Only with --setting turned: number of poses of the motion by which the light is turned; 0: one a frame."""
    views: int = 64
    """Number of training frames."""
    stride: int = 1
    """Only with --setting handheld: render every so manieth frame of the motion, which is then so many times longer."""
    resolution: int = 128
    """Height and width of all images [pixels]."""
    fov: float = 30.0
    """Field of view [degrees]; the camera's distance is set so that the object fills it."""
    samples: int = 400
    """Samples per pixel of the training and evaluation images."""
    truth_samples: int = 1024
    """Samples per pixel of the relit ground truth; many, because noise there limits the PSNR that can be measured."""
    path_depth: int = 5
    """Maximum number of path segments: 2 is direct light only, each further one adds one interreflection."""
    material: Literal["original", "diffuse", "metal", "gltf"] = "original"
    """original: base colour and roughness of the file as a dielectric (F0 = 0.04); diffuse: Lambertian; metal: base
    colour and roughness of the file as a metal; gltf: base colour, roughness and metalness of the file."""
    roughness: Annotated[float | None, arg(metavar="VALUE", help_behavior_hint="")] = None
    """Constant roughness that replaces the one of the file."""
    env_rotation: float = 0.0
    """Rotation of the environment map about the vertical [degrees]."""
    up: Literal["y", "z"] = "y"
    """Upward axis of the object file."""
    relight: tuple[str, ...] = ()
    """Environment maps of relit ground truth, given like `--env` and fixed to the object frame."""
    eval_shared: int = 12
    """Number of evaluation views 15 to 35 degrees above the horizon (region "shared")."""
    eval_sphere: int = 6
    """Number of evaluation views from all directions (region "sphere")."""
    exposure: Annotated[float | None, arg(metavar="FACTOR", help_behavior_hint="")] = None
    """Factor on the light. Default: about one percent of the object's pixels saturate."""
    pose_free: bool = False
    """Omit the poses of the training frames from transforms.json; truth/poses.json still contains them."""
    video: bool = False
    """Also write the training frames as a video, clip.mp4 (H.264)."""
    hand: bool = False
    """A hand holds the object on the training frames and takes it anew from time to time. Only with --setting handheld.
    Without it all else stays the same."""
    skin: Annotated[Skin | float, arg(metavar="light|medium|dark|VALUE")] = "medium"
    """Skin tone of the hand, or a number from 0 (light) to 1 (dark)."""
    background: Background = "none"
    """What is behind the object on the training frames. none: black; clutter: a desk with boxes; torso: a person who
    faces the camera. Not with --setting dome."""
    film: bool = False
    """Also write film.mp4, as a phone would record it: a wider view with motion blur, noise, drifting exposure and
    compression; film.json has the object's box on its first frame. Not with --setting dome."""
    seed: int = 0
    """Seed of the hand-held trajectory and of the path tracer."""

    def __post_init__(self) -> None:
        in_range = {
            "views": self.views >= 1,
            "turns": 0 <= self.turns <= self.views,
            "stride": self.stride >= 1,
            "resolution": 8 <= self.resolution <= 4096 and self.resolution % 2 == 0,
            "fov": 1 <= self.fov <= 120,
            "samples": self.samples >= 1 and self.truth_samples >= 1,
            "path_depth": self.path_depth >= 2,
            "roughness": self.roughness is None or 0 < self.roughness <= 1,
            "exposure": self.exposure is None or 0 < self.exposure < math.inf,
            "env_rotation": math.isfinite(self.env_rotation),
            "eval_shared": self.eval_shared >= 0 and self.eval_sphere >= 0,
            "seed": 0 <= self.seed < 2**32,
            "skin": self.skin in get_args(Skin) if isinstance(self.skin, str) else 0 <= self.skin <= 1,
        }
        if invalid := [name for name, valid in in_range.items() if not valid]:
            raise ValueError(f"{invalid[0]} is out of range: {getattr(self, invalid[0])} (see tumble synth --help)")
        if self.hand and self.setting != "handheld":
            raise ValueError(f"a hand does not hold the object in the setting {self.setting}: use --setting handheld")
        if self.stride > 1 and (self.setting != "handheld" or self.hand or self.film):
            raise ValueError("a stride needs --setting handheld, without a hand and a film, which need every frame")
        if self.turns and self.setting != "turned":
            raise ValueError(f"the light is not turned in the setting {self.setting}: use --setting turned")
        if self.setting == "turned" and self.pose_free:
            raise ValueError("the turns of the light are known only together with the poses: leave out --pose-free")
        if self.setting in ("dome", "turned") and (self.film or self.background != "none"):
            raise ValueError("the camera of a dome moves: a film or a background needs another --setting")
        if self.fov > MAX_FOV[self.background]:
            limit = f"a field of view of at most {MAX_FOV[self.background]:g} degrees"
            raise ValueError(
                f"the background {self.background} fills {limit}, not {self.fov:g}: choose a smaller --fov"
            )
        if self.roughness is not None and self.material == "diffuse":
            raise ValueError("a diffuse material has no roughness: leave out --roughness, or use another --material")
        _require_light_names([Path(name).stem for name in self.relight])


def _require_light_names(names: list[str]) -> None:
    """Check that the names of the relight maps differ and that folders can have them, as docs/format.md requires."""
    if len(set(names)) < len(names):
        raise ValueError(
            f"the file names of the relight maps must differ, these are {', '.join(names)}: rename one of them"
        )
    if invalid := [name for name in names if name in ("", ".", "..") or "\\" in name]:
        raise ValueError(f"a relight map has the name {invalid[0]!r}, which no folder can have: rename the file")
