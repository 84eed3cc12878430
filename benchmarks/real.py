"""Films and photographs of real objects from file to asset, compared with scans of the objects where there are any.

`python -m benchmarks.real NAME=PATH... -o FOLDER [--scan NAME=GLB...]` runs `tumble run` on the inputs named in
`INPUTS` and writes `benchmarks/real.json` and `benchmarks/real.md`. Nothing of the inputs is copied into them.

With a scan, true poses are found without anything of ours: the scan's albedo and depth are rendered from 42 directions
by `tumble synth`; SIFT features of a film's frame are matched to those views, and the pose is that of RANSAC PnP on
the points of the scan behind them, where these determine it well. The rotation from the asset to the scan is the mean
over frames.
Surfaces are compared after ICP with a similarity: from the vertices of the asset to the scan, and back.
"""

import argparse
import json
import math
import re
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from benchmarks.kernels import machine
from benchmarks.poses import line
from tumble.bench import current_code
from tumble.datasets import reader_for, save_capture
from tumble.io import files, video
from tumble.scene import BACKGROUND, OBJECT, UNKNOWN, Camera, Capture, Trajectory, Truth
from tumble.synthetic import SynthOptions, render_capture

COMMAND = "python -m benchmarks.real NAME=PATH... -o FOLDER"
Row = dict[str, Any]
Features = tuple[np.ndarray, np.ndarray]
"""SIFT descriptors of a view, and the points of the object behind them [object radius]."""


@dataclass(frozen=True)
class Input:
    """A film or a set of photographs."""

    source: str
    """Where it comes from."""
    options: str
    """Options of `tumble run`."""
    focal: float = 0.0
    """Focal length, for poses by the scan; the principal point is the centre [pixels]."""


INPUTS = {
    "MC1": Input("HO-3D, cracker box, 141 frames", "--box 315 35 210 275 --focal 617", 617),
    "SMu1": Input("HO-3D, red mug, 130 frames", "--box 230 220 220 200 --focal 617", 617),
    "ABF14": Input("HO-3D, bleach bottle, 131 frames", "--box 340 160 240 180 --focal 617", 617),
    "SM2": Input("HO-3D, mustard bottle, 126 frames", "--box 272 66 112 298 --focal 617", 617),
    "GPMF12": Input("HO-3D, potted meat can, 142 frames", "--box 252 280 172 155 --at 35 --focal 617", 617),
    "ShSu12": Input("HO-3D at half size, sugar box, 148 frames", "--box 122 116 126 106 --focal 308.5", 308.5),
    "MDF14": Input("HO-3D, power drill, 146 frames", "--box 330 135 195 220 --focal 617", 617),
    "AP13": Input("HO-3D at half size, pitcher, 147 frames", "--box 143 60 86 165 --focal 308.5", 308.5),
    "BB12": Input("HO-3D, banana, 91 frames", "--box 204 355 272 80 --focal 617", 617),
    "GSF12": Input("HO-3D, scissors, 108 frames", "--box 240 214 122 262 --focal 617", 617),
    "cube": Input("ViSP, cube_video.mp4, 989 frames", "--part 0 599 --box 390 155 222 222 --at 300 --focal 605", 605),
    "box": Input("OpenCV, box.mp4, 455 frames", "--box 292 16 308 225"),
    "cup": Input("OpenCV, cup.mp4, 217 frames", "--box 300 118 122 272"),
    "dtu": Input("DTU scan 65 in the layout of NeuS: a skull, 49 photographs from a dome, their masks and poses", ""),
    "dinosaur": Input("Oxford dinosaur, turntable, 36 photographs as a film", "--box 80 8 372 468 --focal 3217"),
}
TITLES = {
    "name": "input",
    "result": "rating of the report",
    "frames": "frames with a pose",
    "degrees": "named error [deg]",
    "rotation_median": "rotation, median [deg]",
    "rotation_p90": "90 % below [deg]",
    "with_truth": "frames with truth",
    "reference_overlap": "overlap of the reference",
    "asset_to_scan": "asset to scan, median [% of diameter]",
    "scan_to_asset": "scan to asset, median",
    "seconds": "time of the stages [s]",
    "code": "code",
}
"""Column titles by the key of a row."""
CAMERAS = "cameras_sphere.npz"
"""File of the cameras in the layout of NeuS."""
VIEWS = 42
"""Rendered views of a scan, from all directions."""
WIDTH = 400
"""Width of the photographs of a still object [pixels]."""
VIEW = 512
"""Height and width of the rendered views of a scan [pixels]."""
CONTRAST = 0.02
"""Contrast threshold of SIFT: half of OpenCV's, because films are dark."""
MIN_INLIERS = 25
"""Matches that agree with a pose, for it to count as true."""
MAX_SIGMA = 0.75
"""Largest standard deviation of a rotation by the scan, a quarter of the error that is asked for [degrees]. A flat
label that faces the camera determines its tilt badly: of `SM2` such frames were 16 degrees off."""
MAX_ERROR = 3.0
"""Reprojection error up to which a match agrees with a pose [pixels]."""
MIN_COST_DIFFERENCE = 20.0
"""Difference of the costs of a pose and of its mirror image in depth, below which neither counts as true [pixels^2].
Where a face of the cube fills most of the view, the search found the mirror image, 33 to 76 degrees off, in frames in
which the other pose costs 40 to 200 less; errors are about a pixel."""
REFINEMENTS = 4
"""Number of times that the correspondences that agree and the pose are found in turn."""
MIN_FRAMES = 8
"""Frames with a true pose below which nothing is compared."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("inputs", nargs="+", metavar="NAME=PATH")
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--scan", nargs="*", default=[], metavar="NAME=GLB")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    scans = dict(each.split("=", 1) for each in arguments.scan)
    target = Path(__file__).with_suffix(".json")
    rows: list[Row] = json.loads(target.read_text())["rows"] if target.exists() else []
    for name, path in (each.split("=", 1) for each in arguments.inputs):
        # First, as a scan that cannot be read would end the benchmark after the run.
        rendered = render_scan(Path(scans[name]), arguments.out / f"{name}-scan") if name in scans else None
        row = measure(name, Path(path), arguments.out / name)
        if rendered is not None and "frames" in row:
            row |= compare(name, Path(path), arguments.out / name, rendered)
        rows = [each for each in rows if each["name"] != name] + [row]
        print(line([*TITLES], row), flush=True)
        files.write_json(target, {"command": COMMAND, "machine": machine(), "rows": rows})
        target.with_suffix(".md").write_text(report(rows))


def report(rows: list[Row]) -> str:
    """The table in Markdown."""
    about = "\n".join(f"- {name}: {each.source}. `tumble run FILE {each.options}`" for name, each in INPUTS.items())
    lines = [line([*TITLES], TITLES), "|" + " --- |" * len(TITLES), *(line([*TITLES], row) for row in rows)]
    sentences = "\n".join(f"- {row['name']}: {row['sentence']}" for row in rows)
    return (
        f"# Films of real objects\n\n`{COMMAND} [--scan NAME=GLB...]`. Rotation errors and distances are against scans "
        "of the objects (see the docstring of the script). Times are on a 2-core x86_64 CPU that other "
        "work shared.\n\n" + "\n".join(lines) + f"\n\nWhat the program said:\n\n{sentences}\n\nInputs:\n\n{about}\n"
    )


def measure(name: str, path: Path, run: Path) -> Row:
    """Run the pipeline; the rating of its report, how many frames have a pose, how long the stages took."""
    source = static_capture(path, run.parent / f"{name}-capture") if (path / CAMERAS).exists() else path
    command = [sys.executable, "-m", "tumble", "run", str(source), *INPUTS[name].options.split(), "-o", str(run)]
    done = completed(command)
    code = current_code()["commit"]
    if done.returncode:
        return {"name": name, "result": "NO-GO", "sentence": done.stderr.strip().splitlines()[-1], "code": code}
    capture = run / "capture" / "transforms.json"
    poses = files.read_json(run / "poses.json")
    page = (run / "report.html").read_text()
    rating = re.search(r'<p class="rating \w+"><span>(.*?)</span>\s*(.*?)</p>', page)
    named = re.search(r"accurate to about ([\d.]+) degrees", page)
    assert rating is not None, "every report has one"
    records = [json.loads(text) for text in (run / "log.jsonl").read_text().splitlines()]
    return {
        "name": name,
        "result": rating[1],
        "sentence": rating[2],
        "frames": f"{len(poses)} of {len(files.read_json(capture)['frames']) if capture.exists() else len(poses)}",
        "degrees": float(named[1]) if named else "",
        "code": code,
        "seconds": round(sum(record.get("seconds", 0) for record in records if record.get("event") == "done")),
    }


def completed(command: list[str]) -> subprocess.CompletedProcess[str]:
    """Run a command to its end and return what it printed.

    If this process is interrupted, the command is told so, once, and has the time that it takes to keep its work: it
    has a session of its own, so that Ctrl-C in a terminal does not reach it as well.
    """
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, start_new_session=True)
    try:
        output, errors = process.communicate()
    except KeyboardInterrupt:
        process.terminate()
        process.communicate()
        raise
    return subprocess.CompletedProcess(command, process.returncode, output, errors)


def static_capture(path: Path, out: Path) -> Path:
    """A capture folder of `WIDTH` pixels from photographs, masks and cameras in the layout of NeuS, for a still object.

    The cameras may be those of larger photographs: the factor is the whole number that brings the principal point
    nearest to the centre.
    """
    if out.exists():
        return out
    cameras = np.load(path / CAMERAS)
    images, masks = (sorted((path / name).iterdir()) for name in ("image", "mask"))
    original = files.image_size(images[0])[1]
    pixels = np.stack([shrunk(files.read_image(each)) for each in images])
    inside = np.stack([shrunk(files.read_image(each)[..., 0]) for each in masks]) > 127
    _, height, width, _ = pixels.shape
    lenses, T_obj_gl = [], []
    for i in range(len(images)):
        K, R, x, *_ = cv2.decomposeProjectionMatrix((cameras[f"world_mat_{i}"] @ cameras[f"scale_mat_{i}"])[:3])
        scale = WIDTH / (original * round(float(K[0, 2] / K[2, 2] / (original / 2))))
        lenses.append((np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]) / K[2, 2] + [0, 0, 0.5, 0.5]) * scale)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = R.T @ np.diag([1, -1, -1]), x[:3, 0] / x[3, 0]
        T_obj_gl.append(matrix)
    trajectory = Trajectory.from_camera_to_object(torch.tensor(np.stack(T_obj_gl)).float(), "object")
    capture = Capture(
        torch.from_numpy(pixels * inside[..., None]),
        torch.from_numpy(np.where(inside, OBJECT, BACKGROUND).astype(np.uint8)),
        Camera(torch.tensor(np.median(lenses, 0)).float(), height, width),
        tuple(f"{each.stem}.png" for each in images),
        "object",
        trajectory,
    )
    save_capture(out, capture)
    return out


def shrunk(pixels: np.ndarray) -> np.ndarray:
    """An image of `WIDTH` pixels; every pixel is the mean of those that it covers."""
    size = WIDTH, round(pixels.shape[0] * WIDTH / pixels.shape[1])
    return cv2.resize(np.ascontiguousarray(pixels), size, interpolation=cv2.INTER_AREA)


# Comparison with a scan -----------------------------------------------------------------------------------------------


def render_scan(scan: Path, out: Path) -> Path:
    """A capture folder with the scan from all directions."""
    options = SynthOptions(env="white", views=2, eval_shared=0, eval_sphere=VIEWS, resolution=VIEW, samples=1)
    return render_capture(scan, out, options)


def compare(name: str, film: Path, run: Path, rendered: Path) -> Row:
    """Errors of the poses and of the surface against a scan of the object (`render_scan`)."""
    reader = reader_for(rendered)
    views = rendered_features(reader.load_truth(rendered), reader.load(rendered).camera)
    numbers = {
        each["name"]: each["source_frame"] for each in files.read_json(run / "capture" / "ingest.json")["frames"]
    }
    glb = exported(run)
    poses = files.read_json(glb.with_name("poses.json"))
    estimated = Trajectory.from_camera_to_object(torch.tensor(list(poses.values())), "camera").T_cam_obj
    wanted = {numbers[key]: i for i, key in enumerate(poses)}
    pairs = []
    for number, frame in enumerate(video.read_clip(film)):
        if number in wanted and (pose := true_pose(frame, INPUTS[name].focal, views)) is not None:
            pairs.append((wanted[number], *pose))
    R_est, x_est = estimated.rotation.matrix().numpy(), estimated.xyz.numpy()
    if len(pairs) < MIN_FRAMES:
        return {"with_truth": len(pairs)}
    index = [pair[0] for pair in pairs]
    R, t = np.stack([pair[1] for pair in pairs]), np.stack([pair[2] for pair in pairs])
    relative = Rotation.from_matrix(np.swapaxes(R, 1, 2) @ R_est[index])
    # The frame of which most others are within 15 degrees starts the mean, so that wrong poses do not turn it.
    apart = np.degrees([(relative.inv() * each).magnitude() for each in relative])
    near = apart[np.argmax((apart < 15).sum(1))] < 15
    R_scan_asset = relative[near].mean()
    errors = np.degrees((relative.inv() * R_scan_asset).magnitude())
    matrix = similarity(R[near], t[near], x_est[index][near], R_scan_asset.as_matrix())
    asset, scanned = (trimesh.load_mesh(path, force="mesh") for path in (glb, rendered / "truth" / "mesh.glb"))
    reference = {list(poses)[i]: (R, t) for i, R, t in pairs}
    return {
        "with_truth": len(pairs),
        "reference_overlap": round(reference_overlap(run / "capture", reference, scanned), 3),
        "rotation_median": round(float(np.median(errors)), 2),
        "rotation_p90": round(float(np.quantile(errors, 0.9)), 2),
        **surface_distances(asset, scanned, matrix),
    }


def reference_overlap(
    folder: Path, reference: dict[str, tuple[np.ndarray, np.ndarray]], scan: trimesh.Trimesh
) -> float:
    """Median overlap (IoU) of the masks with the silhouettes of the scan at the poses that serve as truth.

    What is below 0.95 tells that the object of the film is not quite the scanned one: the bottle of `SM2` has another
    label, at another place.

    Args:
        folder: Capture folder.
        reference: Rotation and translation of the scan in the camera frame, by the names of frames.
    """
    capture, overlaps = reader_for(folder).load(folder), []
    K = capture.camera.opencv_matrix
    for name, (R, t) in reference.items():
        mask = capture.masks[capture.names.index(name)].numpy()
        projected = (scan.vertices @ R.T + t) @ K.T
        inside = np.zeros_like(mask)
        for triangle in (projected[:, :2] / projected[:, 2:]).round().astype(np.int32)[scan.faces]:
            cv2.fillConvexPoly(inside, triangle, 1)
        known, there = mask != UNKNOWN, mask == OBJECT
        overlaps.append((known & there & (inside > 0)).sum() / (known & (there | (inside > 0))).sum())
    return float(np.median(overlaps))


def rendered_features(truth: Truth, camera: Camera) -> list[Features]:
    """SIFT features of the views of a scan."""
    assert truth.trajectory is not None, "synth writes it"
    assert truth.albedo is not None, "synth writes it"
    assert truth.depth is not None, "synth writes it"
    views = []
    for i, (albedo, depth) in enumerate(zip(truth.albedo.numpy(), truth.depth.numpy(), strict=True)):
        grey = cv2.cvtColor((255 * albedo.clip(0, 1) ** (1 / 2.2)).astype(np.uint8), cv2.COLOR_RGB2GRAY)
        inside = cv2.erode((depth > 0).astype(np.uint8), np.ones((3, 3)))
        points, descriptors = cv2.SIFT.create(contrastThreshold=CONTRAST).detectAndCompute(grey, inside)
        if len(points) < MIN_INLIERS:
            continue
        uv = np.array([point.pt for point in points])
        column, row = uv.round().astype(int).T
        K = camera.opencv_matrix
        rays = np.concatenate([(uv - K[:2, 2]) / [K[0, 0], K[1, 1]], np.ones((len(uv), 1))], 1)
        x_cam = torch.from_numpy(rays * depth[row, column, None]).float()
        views.append((descriptors, (truth.trajectory.T_cam_obj.inverse()[i] @ x_cam).numpy()))
    return views


def true_pose(frame: np.ndarray, focal: float, views: list[Features]) -> tuple[np.ndarray, np.ndarray] | None:
    """Rotation and translation of the scan in the camera frame (OpenCV axes) in a frame of a film; None if unsure."""
    points, descriptors = cv2.SIFT.create(contrastThreshold=CONTRAST).detectAndCompute(
        cv2.cvtColor(np.ascontiguousarray(frame), cv2.COLOR_RGB2GRAY), None
    )
    if descriptors is None:
        return None
    uv = np.array([point.pt for point in points]) + 0.5
    found = []
    for of_view, x_obj in views:
        matches = cv2.BFMatcher().knnMatch(descriptors, of_view, k=2)
        good = [(a.queryIdx, a.trainIdx) for a, b in matches if a.distance < 0.8 * b.distance]
        found.append([(uv[i], x_obj[j]) for i, j in good])
    chosen = [pair for view in sorted(found, key=len)[-4:] for pair in view]
    if len(chosen) < MIN_INLIERS:
        return None
    image, world = (np.array(values) for values in zip(*chosen, strict=True))
    K = np.array([[focal, 0, frame.shape[1] / 2], [0, focal, frame.shape[0] / 2], [0, 0, 1]])
    return best_pose(world, image, K)


def best_pose(world: np.ndarray, image: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Pose that agrees with most correspondences, unless its mirror image in depth does so nearly as well (Necker
    reversal); None if unsure.

    Args:
        world: Points of the scan.
        image: Their positions, some of them wrong [pixels].
        K: Camera matrix.
    """
    good, rvec, t, inliers = cv2.solvePnPRansac(
        world, image, K, None, iterationsCount=5000, reprojectionError=MAX_ERROR, flags=cv2.SOLVEPNP_AP3P
    )
    if not good or inliers is None or len(inliers) < MIN_INLIERS:
        return None
    start = cv2.Rodrigues(rvec)[0], t[:, 0]
    other = mirror_image(*start, world[np.asarray(inliers, int).ravel()])
    (cost, R, t, sigma), (other_cost, other_R, *_) = sorted(
        (refined_pose(world, image, K, each) for each in (start, other)), key=lambda each: each[0]
    )
    apart = math.degrees(Rotation.from_matrix(R.T @ other_R).magnitude())
    ambiguous = apart > MAX_SIGMA and other_cost - cost < MIN_COST_DIFFERENCE
    return None if ambiguous or sigma > MAX_SIGMA else (R, t)


def mirror_image(R: np.ndarray, t: np.ndarray, world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pose in which the normal of the plane closest to the points is mirrored in the line of sight.

    Not that of `tumble.poses.sfm.registration`, which is part of what is measured here.
    """
    middle = world.mean(0)
    centre, normal = R @ middle + t, R @ np.linalg.svd(world - middle, full_matrices=False)[2][2]
    ray = centre / np.linalg.norm(centre)
    axis = np.cross(normal, 2 * (normal @ ray) * ray - normal)
    angle = 2 * math.acos(min(abs(float(normal @ ray)), 1.0))
    turn = Rotation.from_rotvec(axis / max(np.linalg.norm(axis), 1e-12) * angle).as_matrix()
    return turn @ R, centre - turn @ (R @ middle)


def refined_pose(
    world: np.ndarray, image: np.ndarray, K: np.ndarray, start: tuple[np.ndarray, np.ndarray]
) -> tuple[float, np.ndarray, np.ndarray, float]:
    """A pose fitted to the correspondences that agree with it, its cost, and how certain it is.

    Returns:
        The sum of the squared errors, limited to `MAX_ERROR` [pixels^2]; rotation; translation; the largest standard
        deviation of the rotation [degrees], infinite if too few correspondences agree.
    """
    rvec, t = cv2.Rodrigues(start[0])[0], start[1].reshape(3, 1)
    for _ in range(REFINEMENTS):
        agrees = np.linalg.norm(cv2.projectPoints(world, rvec, t, K, None)[0][:, 0] - image, axis=1) < MAX_ERROR
        if agrees.sum() >= MIN_INLIERS:
            rvec, t = cv2.solvePnPRefineLM(world[agrees], image[agrees], K, None, rvec, t)
    projected, jacobian = cv2.projectPoints(world, rvec, t, K, None)
    difference = projected[:, 0] - image
    error = np.linalg.norm(difference, axis=1)
    agrees, sigma = error < MAX_ERROR, math.inf
    if agrees.sum() >= MIN_INLIERS:
        J = jacobian[np.repeat(agrees, 2), :6]
        variance = difference[agrees].var() * np.linalg.inv(J.T @ J)
        sigma = math.degrees(np.sqrt(variance.diagonal()[:3].max()))
    return float((error.clip(max=MAX_ERROR) ** 2).sum()), cv2.Rodrigues(rvec)[0], t[:, 0], sigma


def similarity(R: np.ndarray, t: np.ndarray, x_est: np.ndarray, R_scan_asset: np.ndarray) -> np.ndarray:
    """Asset frame to scan frame, from the poses of both: R c + t = s x_est in every frame, by least squares."""
    A = np.concatenate([np.concatenate([R[i], -x_est[i][:, None]], 1) for i in range(len(R))])
    *c, s = np.linalg.lstsq(A, -t.ravel(), rcond=None)[0]
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = s * R_scan_asset, c
    return matrix


def surface_distances(asset: trimesh.Trimesh, scan: trimesh.Trimesh, matrix: np.ndarray) -> Row:
    """Median distances between two surfaces after ICP [% of the scan's diameter]."""
    points, on_scan = (trimesh.sample.sample_surface(mesh, 60000, seed=0)[0] for mesh in (asset, scan))
    tree = KDTree(on_scan)
    kept: np.ndarray = points[::10]
    for share in (1.0, 0.85):
        distance = tree.query(trimesh.transform_points(kept, matrix))[0]
        kept = kept[distance <= np.quantile(distance, share)]
        matrix, *_ = trimesh.registration.icp(kept, on_scan, matrix, max_iterations=60, reflection=False)
    moved = trimesh.transform_points(points, matrix)
    diameter = pdist(scan.convex_hull.vertices).max()
    back = KDTree(moved).query(on_scan)[0]
    forward = tree.query(moved)[0]
    return {
        "asset_to_scan": round(float(100 * np.median(forward) / diameter), 2),
        "scan_to_asset": round(float(100 * np.median(back) / diameter), 2),
    }


def exported(run: Path) -> Path:
    """The GLB of a run, with the object frame of its poses."""
    out = run / "export"
    if not list(out.glob("*.glb")):
        command = [sys.executable, "-m", "tumble", "export", str(run), "--preset", "web", "-o", str(out)]
        completed(command).check_returncode()
    return next(out.glob("*.glb"))


if __name__ == "__main__":
    main()
