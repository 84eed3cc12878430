"""tumble: object motion, shape, material and light from one video of an object turned in the hand.

    import tumble

    asset = tumble.reconstruct("captures/mug", "runs/mug")
    pictures = list(tumble.relight(asset, "studio.hdr"))
    tumble.export_asset(asset, "runs/mug/export")

Each folder is a room, with what it offers in its `__init__`. In the order of the data:

    datasets            readers of captures: ours, BOP, HO3D; drop a file here for another layout
    preprocess          from a film, or pictures with a COLMAP model, to a capture: frames, masks, lens
    matching            pixel correspondences between frames; drop a file here for another matcher
    poses               stage 1: how the object moved; `sfm` from matches and silhouettes, `progressive` as in the paper
    inverse_rendering   stages 2 and 3: Gaussians and poses, then albedo, roughness and light; losses, densification
    rendering           rasterizer, ray tracer, BRDF, shading, relighting
    export              asset to GLB, PLY, light and pose files; mesh and texture baking
    report              the page of a run, with its health card
    evaluation          metrics, and predictions against truth
    synthetic           captures with truth, path traced by Mitsuba

Beneath them:

    scene               what all speak of: camera, trajectory, Gaussians, material, environment, capture, asset
    engine              the training loop, optimizer and run directories; knows no scene
    backends            kernels on tensors: reference, CPU, CUDA; drop a file here for another renderer
    maths, io           rotations, directions, harmonics, images; files, films, trees of tensors, weights

Beside them: `pipeline` (the stages in order), `recipes` (their settings), `actions` (what is done with an asset),
`cli`, `demo`, `doctor`, `viewer`. Which room may import which stands in `tests/test_guards.py`.
"""

from typing import TYPE_CHECKING

from tumble._lazy import lazily

if TYPE_CHECKING:
    from tumble.actions import evaluate, export_asset, relight, render
    from tumble.demo import demo_clip
    from tumble.engine import Progress
    from tumble.evaluation import Report
    from tumble.maths import SE3
    from tumble.pipeline import estimate_poses, read_capture, reconstruct, video_to_capture
    from tumble.poses import PoseResult
    from tumble.preprocess import FootageOptions
    from tumble.recipes import DRAFT, PAPER, STANDARD, Recipe
    from tumble.scene import Asset, Camera, Capture, Environment, Trajectory

__version__ = "0.1.0"

__all__ = [
    "Asset",
    "Camera",
    "Capture",
    "DRAFT",
    "Environment",
    "FootageOptions",
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

__getattr__ = lazily(
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
        "recipes": ("DRAFT", "PAPER", "STANDARD", "Recipe"),
        "scene": ("Asset", "Camera", "Capture", "Environment", "Trajectory"),
    },
)
