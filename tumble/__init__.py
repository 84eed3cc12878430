"""tumble: motion, shape, material and light of an object from one video of it being turned in the hand.

    import tumble

    asset = tumble.reconstruct("captures/mug", "runs/mug")
    images = list(tumble.relight(asset, "studio.hdr"))
    tumble.export_asset(asset, "runs/mug/export", capture=tumble.read_capture("captures/mug"))

Each folder is a room: one part of the method, whose `__init__` lists what other rooms use. In the order of the data:

    datasets            readers of capture folders: ours, BOP, HO3D; a new layout is a new file here
    preprocess          converts a video, or images with a COLMAP model, to a capture: frames, masks, lens
    matching            pixel correspondences between frames; a new matcher is a new file here
    poses               stage 1, object poses: `sfm` from matches and silhouettes, `progressive` as in the paper
    inverse_rendering   stage 2, Gaussians and poses; stage 3, albedo, roughness and light; losses, densification
    rendering           rasterization, ray tracing, BRDF, shading, relighting
    export              asset to textured GLB, PLY, environment map and pose files
    report              the report.html of a run, with its health card
    evaluation          metrics, and scores of predictions against ground truth
    synthetic           captures with ground truth, path traced by Mitsuba
    bench               benchmark suites as data, rows of scores, their tables and page; many tasks at the same time

Used by all of these:

    scene               camera, trajectory, Gaussians, material, environment, capture, match, asset
    engine              training loop, optimizer, run directories; independent of the scene
    backends            rendering kernels on tensors: reference, CPU, CUDA; a new renderer is a new file here
    maths, io           rotations, directions, spherical harmonics, images; files, video, safetensors, weights

Files beside the rooms: `pipeline` (the stages in order), `recipes` (their settings), `actions` (relight, export,
evaluate), `glb_scores`, `batch` (many runs, suites), `cli`, `demo`, `doctor`, `viewer` with `viewer_access`.
`tests/test_guards.py` lists which room may import which.
"""

from typing import TYPE_CHECKING

from tumble._lazy import lazy_getattr

if TYPE_CHECKING:
    from tumble.actions import evaluate, export_asset, relight, render
    from tumble.demo import demo_clip
    from tumble.engine import Progress
    from tumble.evaluation import Report
    from tumble.maths import SE3
    from tumble.pipeline import estimate_poses, read_capture, reconstruct, video_to_capture
    from tumble.poses import PoseResult
    from tumble.preprocess import FootageOptions
    from tumble.recipes import DRAFT, FULL, PAPER, STANDARD, Recipe
    from tumble.scene import Asset, Camera, Capture, Environment, Trajectory

__version__ = "0.1.0"

__all__ = [
    "Asset",
    "Camera",
    "Capture",
    "DRAFT",
    "Environment",
    "FootageOptions",
    "FULL",
    "PAPER",
    "PoseResult",
    "Progress",
    "Recipe",
    "Report",
    "SE3",
    "STANDARD",
    "Trajectory",
    "demo_clip",
    "estimate_poses",
    "evaluate",
    "export_asset",
    "video_to_capture",
    "read_capture",
    "reconstruct",
    "relight",
    "render",
]

__getattr__ = lazy_getattr(
    __name__,
    {
        "actions": ("evaluate", "export_asset", "relight", "render"),
        "demo": ("demo_clip",),
        "engine": ("Progress",),
        "evaluation": ("Report",),
        "maths": ("SE3",),
        "pipeline": ("estimate_poses", "video_to_capture", "read_capture", "reconstruct"),
        "poses": ("PoseResult",),
        "preprocess": ("FootageOptions",),
        "recipes": ("DRAFT", "FULL", "PAPER", "STANDARD", "Recipe"),
        "scene": ("Asset", "Camera", "Capture", "Environment", "Trajectory"),
    },
)


def __dir__() -> list[str]:
    """The public names too, which are imported at first use: what completion offers."""
    return sorted({*globals(), *__all__})
