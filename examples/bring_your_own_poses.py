"""Reconstruction with known poses, for example from a tracker or a robot arm; stage 1 is skipped.

$ python -m examples.bring_your_own_poses OUT           (minutes on two CPU cores)
"""

import json
import sys
from pathlib import Path

import torch

import tumble


def main(out: Path, recipe: tumble.Recipe = tumble.DRAFT) -> tumble.Report:
    clip = tumble.demo_clip(out / "clip")
    capture = tumble.read_capture(clip)

    # Camera to object, 4 x 4, OpenGL camera axes; the object lies in the unit sphere around the origin.
    poses_by_name = json.loads((clip / "truth" / "poses.json").read_text())
    matrices = torch.tensor([poses_by_name[name] for name in capture.names])
    poses = tumble.Trajectory.from_camera_to_object(matrices, light="camera")

    asset = tumble.reconstruct(capture, out / "run", recipe, poses=poses)
    tumble.export_asset(asset, out / "export", "splat", names=list(capture.names))
    scores = tumble.evaluate(asset, clip, out=out / "scores", cfg=recipe.relight)
    print(f"albedo {scores['regions']['shared']['albedo.psnr_fg_srgb']:.1f} dB on the object")
    return scores


if __name__ == "__main__":
    main(Path(sys.argv[1]))
