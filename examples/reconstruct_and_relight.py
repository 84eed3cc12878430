"""From a video to images under another light in Python, as `tumble run` and `tumble relight` do.

$ python -m examples.reconstruct_and_relight OUT        (minutes on two CPU cores)
"""

import sys
from pathlib import Path

import tumble
from tumble.io import files
from tumble.maths import to_srgb8


def main(out: Path, recipe: tumble.Recipe = tumble.DRAFT) -> tumble.Asset:
    clip = tumble.demo_clip(out / "clip")  # or tumble.video_to_capture("clip.mp4", out / "clip")
    capture = tumble.read_capture(clip)

    def print_progress(progress: tumble.Progress) -> None:
        print(f"{progress.name}: step {progress.step} of {progress.of}, {progress.eta:.0f} s to go")

    poses = tumble.estimate_poses(capture, recipe, progress=print_progress)
    print(poses.quality.sentence)
    asset = tumble.reconstruct(capture, recipe=recipe, poses=poses, progress=print_progress)

    maps = tumble.render(asset, 0)  # in the pose of the first frame
    files.write_png(out / "albedo.png", to_srgb8(maps.features["albedo"] * maps.alpha[..., None]).numpy())
    light = tumble.Environment.read(clip / "truth" / "lights" / "sunset.hdr")
    first = tumble.Trajectory(asset.trajectory.T_cam_obj[:1], light="object")
    for linear in tumble.relight(asset, light, first, cfg=recipe.relight):
        files.write_png(out / "sunset.png", to_srgb8(linear).numpy())
    return asset


if __name__ == "__main__":
    main(Path(sys.argv[1]))
