"""Pose files for other programs: JSON, TUM and BOP formats."""

from pathlib import Path

from tumble.io import files
from tumble.scene import Asset


def write_poses(asset: Asset, names: list[str], metres: float, out: Path) -> None:
    """Write `poses.json`, `poses_tum.txt`, and `bop/scene_gt.json` with `bop/scene_camera.json`.

    JSON: camera to object, OpenGL camera axes, as in a capture. TUM: the camera in the object frame, OpenCV axes, the
    number of the frame in the capture as time stamp. BOP: object to camera, OpenCV axes, millimetres, the same numbers.

    Args:
        names: Names of the frames, in the order of the trajectory.
        metres: Object radius in the files' unit.
    """
    trajectory = asset.trajectory
    matrices = trajectory.camera_to_object().double()
    matrices[:, :3, 3] *= metres
    files.write_json(out / "poses.json", dict(zip(names, matrices.tolist(), strict=True)))
    numbers = _frame_numbers(names)
    T_obj_cam = trajectory.T_cam_obj.inverse()
    columns = "timestamp tx ty tz qx qy qz qw: camera in the object frame"
    lines = [f"# {columns}; the timestamp is the number of the frame in the capture"]
    for number, xyz, wxyz in zip(numbers, T_obj_cam.xyz.double() * metres, T_obj_cam.wxyz.double(), strict=True):
        w, x, y, z = wxyz.tolist()
        lines.append(" ".join([str(number), *(f"{value:.9g}" for value in [*xyz.tolist(), x, y, z, w])]))
    text = "\n".join(lines) + "\n"
    files.write_atomically(out / "poses_tum.txt", lambda partial: partial.write_text(text, "utf-8"))
    R_cam_obj = trajectory.T_cam_obj.rotation.matrix().double()
    t_mm = trajectory.T_cam_obj.xyz.double() * metres * 1000
    truth = {
        str(number): [{"cam_R_m2c": R.flatten().tolist(), "cam_t_m2c": t.tolist(), "obj_id": 1}]
        for number, R, t in zip(numbers, R_cam_obj, t_mm, strict=True)
    }
    files.write_json(out / "bop" / "scene_gt.json", truth)
    intrinsics = {"cam_K": asset.camera.opencv_matrix.flatten().tolist(), "depth_scale": 1.0}
    files.write_json(out / "bop" / "scene_camera.json", {str(number): intrinsics for number in numbers})


def _frame_numbers(names: list[str]) -> list[int]:
    """Frame numbers: the names' stems if these are distinct integers, else 0, 1, ..."""
    stems = [Path(name).stem for name in names]
    if all(stem.isdecimal() for stem in stems) and len({int(stem) for stem in stems}) == len(stems):
        return [int(stem) for stem in stems]
    return list(range(len(names)))
