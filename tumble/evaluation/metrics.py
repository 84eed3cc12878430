"""How far a reconstruction is from the truth; docs/metrics.md says of each number how others measure it.

*Foreground* pixels surely show the object; *counted* pixels are those a metric looks at, `UNKNOWN` ones never among
them. *fg* in a metric's name: over the foreground of one view; *full*: over the whole picture; *crop*: over the
foreground's bounding box. Pictures are in [0, 1]; "linear" and "srgb" say in which space they are compared.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tumble.evaluation import lpips
from tumble.maths import (
    SE3,
    SO3,
    angle_between,
    crop,
    crop_box,
    mean_rotation,
    srgb_from_linear,
    ssim,
    texel_solid_angles,
    umeyama,
)
from tumble.maths import iou as mask_iou
from tumble.scene import Environment, Trajectory

BEST_PSNR = 100.0
"""What equal pictures score [dB]: an infinite number has no mean and no place in JSON."""
DARK_TRUTH, DARK_PREDICTION = 0.02, 1e-4
"""Albedo under which a pixel says nothing about the scale: its ratio is noise, or has no denominator."""
CROP_MARGIN = 10
"""Pixels around the foreground's bounding box: every window of SSIM (11 x 11) that touches the object is inside."""
NO_NORMAL = 0.5
"""Length under which a predicted normal is missing; it then counts as 90 degrees off, the mean of random guesses."""
LIGHT_GRID = (32, 64)
"""Both light maps are compared on this grid, so that maps of different sizes have comparable errors."""
BRIGHTEST = 10.0
"""Radiance at which both lights are clipped: one lamp of a thousand must not be the whole error."""
LOG_FLOOR = 1e-3
"""Share of the true light's mean luminance under which a texel counts as black in logarithms."""
TRACKED = 10.0
"""Rotation error under which a frame counts as tracked [degrees]."""
LEAST_SPREAD = 0.01
"""Second over first singular value of the camera positions under which they count as a line: errors of one percent of
its length would turn the aligned path about it at will."""
REWEIGHTED = 20
"""Rounds of reweighting towards least absolute errors."""
EXACT = 2e-3
"""Error under which all frames count the same [radians, share of the distance]."""


# Pictures -------------------------------------------------------------------------------------------------------------


def psnr(x: Float[Tensor, "h w 3"], y: Float[Tensor, "h w 3"], counted: Bool[Tensor, "h w"]) -> float:
    """Peak signal-to-noise ratio over the counted pixels, for a peak of 1 [dB], at most `BEST_PSNR`.

    NaN where no pixel counts, or one that does is NaN.
    """
    error = float((x - y)[counted].square().mean())
    return math.nan if math.isnan(error) else min(BEST_PSNR, -10 * math.log10(max(error, 1e-30)))


def rmse(x: Float[Tensor, "h w"], y: Float[Tensor, "h w"], counted: Bool[Tensor, "h w"]) -> float:
    """Root of the mean squared difference over the counted pixels."""
    return float((x - y)[counted].square().mean().sqrt())


def iou(x: Bool[Tensor, "h w"], y: Bool[Tensor, "h w"], counted: Bool[Tensor, "h w"]) -> float:
    """Intersection over union of two silhouettes, among the counted pixels; 1 when both are empty."""
    return float(mask_iou(x, y, counted)) if bool(((x | y) & counted).any()) else 1.0


def image_scores(
    x: Float[Tensor, "h w 3"],
    y: Float[Tensor, "h w 3"],
    foreground: Bool[Tensor, "h w"],
    counted: Bool[Tensor, "h w"],
    networks: Sequence[lpips.Network],
) -> dict[str, float]:
    """PSNR, SSIM and LPIPS of the picture `x` against the true `y`, both sRGB over black.

    Pixels that are not counted are given the true colour before SSIM and LPIPS, which look at neighbourhoods.

    Raises:
        ValueError: A picture smaller than SSIM's window of 11 x 11 pixels, or an empty foreground.
    """
    same = torch.where(counted[..., None], x, y)
    box = crop_box(foreground, CROP_MARGIN)
    pairs = {"full": (same, y), "crop": (crop(same, box), crop(y, box))}
    scores = {"psnr_fg_srgb": psnr(x, y, foreground), "psnr_full_srgb": psnr(x, y, counted)}
    scores |= {f"ssim_{part}_srgb": float(ssim(*pair)) for part, pair in pairs.items()}
    for network in networks:
        for part, pair in pairs.items():
            scores[f"lpips_{part}_srgb_{network.name}"] = float(lpips.distance(network, *pair))
    return scores


# Maps -----------------------------------------------------------------------------------------------------------------


def albedo_scale(
    predicted: Float[Tensor, "v h w 3"], truth: Float[Tensor, "v h w 3"], mask: Bool[Tensor, "v h w"]
) -> Float[Tensor, "3"]:
    """Per channel, the median of truth / prediction over the foreground of all evaluation views (linear albedo).

    Multiply the predicted albedo by it before any metric and before relighting, and divide the light by it: the light's
    strength and colour cannot be told from the albedo's. A channel in which every pixel is darker than `DARK_TRUTH` or
    `DARK_PREDICTION` takes the geometric mean of the other channels.

    Raises:
        ValueError: No pixel is bright enough in both, in any channel.
    """
    usable = mask[..., None] & (truth >= DARK_TRUTH) & (predicted >= DARK_PREDICTION)
    ratios = [(truth[..., c] / predicted[..., c])[usable[..., c]] for c in range(3)]
    if not any(len(r) for r in ratios):
        raise ValueError("no foreground pixel has an albedo to compare: the prediction, or the truth, is black")
    # torch.median takes the lower of two middle values; the mean of both treats prediction and truth alike.
    medians = [0.5 * (r.median() - (-r).median()) if len(r) else r.new_tensor(math.nan) for r in ratios]
    scale = torch.stack(medians)
    return scale.where(~scale.isnan(), scale[~scale.isnan()].log().mean().exp())


def albedo_scores(
    predicted: Float[Tensor, "h w 3"],
    truth: Float[Tensor, "h w 3"],
    silhouette: Bool[Tensor, "h w"],
    scale: Float[Tensor, "3"],
    foreground: Bool[Tensor, "h w"],
    counted: Bool[Tensor, "h w"],
    networks: Sequence[lpips.Network],
) -> dict[str, float]:
    """Scores of a linear albedo map, multiplied by `scale` and clipped to [0, 1], in linear values and as sRGB.

    Over the foreground the map counts as it is, elsewhere as a picture within the predicted `silhouette`. A map that
    ends with the silhouette would pay for every pixel that this one misses with a black albedo: of the bottle of the
    benchmark one in a thousand, as much as all other errors together; the silhouette has a score of its own.
    """
    scaled, unscaled, truth = (a.clamp(0, 1) for a in (predicted * scale, predicted, truth))
    shown = scaled * silhouette[..., None]
    return {
        **image_scores(srgb_from_linear(shown), srgb_from_linear(truth), foreground, counted, networks),
        "psnr_fg_srgb": psnr(srgb_from_linear(scaled), srgb_from_linear(truth), foreground),
        "psnr_fg_linear": psnr(scaled, truth, foreground),
        "psnr_full_linear": psnr(shown, truth, counted),
        "psnr_fg_linear_unscaled": psnr(unscaled, truth, foreground),
    }


def normal_angles(predicted: Float[Tensor, "*b 3"], truth: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """Angles between normals of any length [degrees]; 90 where the predicted one is shorter than `NO_NORMAL`."""
    sine = torch.linalg.vector_norm(torch.linalg.cross(predicted, truth), dim=-1)
    angles = torch.rad2deg(torch.atan2(sine, (predicted * truth).sum(-1)))
    missing = torch.linalg.vector_norm(predicted, dim=-1) < NO_NORMAL
    return angles.masked_fill(missing, 90.0)


def normal_scores(
    predicted: Float[Tensor, "h w 3"],
    truth: Float[Tensor, "h w 3"],
    foreground: Bool[Tensor, "h w"],
    counted: Bool[Tensor, "h w"],
) -> dict[str, float]:
    """Mean and median angle over the foreground, and the mean over all counted pixels with 0 on the background."""
    known = foreground & (torch.linalg.vector_norm(truth, dim=-1) > NO_NORMAL)
    angles = normal_angles(predicted, truth)[known]
    return {
        "mean_fg_degrees": float(angles.mean()),
        "median_fg_degrees": float(angles.quantile(0.5)),
        "mean_all_degrees": float(angles.sum() / counted.sum()),
    }


# Light ----------------------------------------------------------------------------------------------------------------


def light_scores(predicted: Environment, truth: Environment, scale: Float[Tensor, "3"]) -> dict[str, float | None]:
    """Errors of a light map after division by the albedo's `scale`, on a grid of `LIGHT_GRID`; both in one frame.

    The root mean square is over radiance clipped at `BRIGHTEST`, weighted by solid angle, and once unweighted. The
    correlation is of the logarithms of unclipped luminance, weighted by solid angle; None when a light is uniform.
    """
    x = predicted.resampled(*LIGHT_GRID).radiance / scale
    y = truth.resampled(*LIGHT_GRID).radiance.to(x)
    weight = texel_solid_angles(*LIGHT_GRID).to(x) / (4 * math.pi)
    squared = (x.clamp_max(BRIGHTEST) - y.clamp_max(BRIGHTEST)).square().mean(-1)
    luminance = x.new_tensor([0.2126, 0.7152, 0.0722])
    floor = LOG_FLOOR * float((weight * (y @ luminance)).sum())
    log_x, log_y = ((light @ luminance).clamp_min(floor).log() for light in (x, y))
    return {
        "rmse_clip10": float((weight * squared).sum().sqrt()),
        "rmse_clip10_unweighted": float(squared.mean().sqrt()),
        "log_correlation": _correlation(log_x, log_y, weight),
    }


def _correlation(x: Tensor, y: Tensor, weight: Tensor) -> float | None:
    """Pearson's coefficient under weights that sum to 1; None when one of the two does not vary."""
    x, y = x - (weight * x).sum(), y - (weight * y).sum()
    spread = ((weight * x * x).sum() * (weight * y * y).sum()).sqrt()
    return float((weight * x * y).sum() / spread) if spread > 1e-8 else None


# Trajectories ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Similarity:
    """How the true object frame relates to the predicted one: `x_true = scale R_true_pred x_pred + shift`."""

    scale: Float[Tensor, ""]
    """True units per predicted unit."""
    R_true_pred: SO3
    shift: Float[Tensor, "3"]
    """Where the predicted origin lies in the true object frame [true units]."""

    def to_truth(self, predicted: Trajectory) -> Trajectory:
        """Predicted poses, in the true object frame and unit."""
        R_cam_true = predicted.T_cam_obj.rotation @ self.R_true_pred.inverse()
        xyz = self.scale * predicted.T_cam_obj.xyz - R_cam_true @ self.shift
        return Trajectory(SE3(R_cam_true.wxyz, xyz), predicted.light)

    def to_prediction(self, truth: Trajectory) -> Trajectory:
        """True poses, in the predicted object frame and unit: render a reconstruction from these to see true views."""
        R_cam_pred = truth.T_cam_obj.rotation @ self.R_true_pred
        xyz = (truth.T_cam_obj.rotation @ self.shift + truth.T_cam_obj.xyz) / self.scale
        return Trajectory(SE3(R_cam_pred.wxyz, xyz), truth.light)


def align(predicted: Trajectory, truth: Trajectory) -> Similarity:
    """The similarity that brings the predicted camera positions closest to the true ones (Umeyama 1991).

    Raises:
        ValueError: The positions do not determine it; the message says why.
    """
    centres = truth.camera_positions
    spread = torch.linalg.svdvals(centres - centres.mean(0))
    if len(truth) < 3 or spread[1] <= LEAST_SPREAD * spread[0]:
        raise ValueError("the true camera positions lie nearly on a line (or are fewer than three)")
    try:
        return Similarity(*umeyama(predicted.camera_positions, centres))
    except ValueError as error:
        raise ValueError(f"the predicted camera positions: {error}") from None


def register(predicted: Trajectory, truth: Trajectory) -> Similarity:
    """The similarity to show true views of a reconstruction with: it fits what cameras see, not where they stand.

    First the rotation, alone; scale and shift then bring the point that the cameras look at nearest to its true place
    before them. `align` pays for errors of orientation with scale and shift. Both are fits of least absolute errors
    (reweighted least squares): one frame that looks at the end of a bottle may be wrong by ten degrees, and among sixty
    shifts a mean by a third of a pixel.

    Raises:
        ValueError: The poses do not determine it: the object hardly turns.
    """
    R_cam_true, R_cam_pred = truth.T_cam_obj.rotation.matrix(), predicted.T_cam_obj.rotation.matrix()
    relative = truth.T_cam_obj.rotation.inverse() @ predicted.T_cam_obj.rotation
    R_true_pred = mean_rotation(relative)
    for _ in range(REWEIGHTED):
        R_true_pred = mean_rotation(relative, 1 / (angle_between(relative, R_true_pred) + EXACT))
    # Nearest to all optical axes: an error of orientation moves no other point less.
    across, off = R_cam_pred[:, :2].flatten(0, 1), predicted.T_cam_obj.xyz[:, :2].flatten()
    x_pred = torch.linalg.lstsq(across, -off[:, None]).solution[:, 0]
    x_cam = predicted.T_cam_obj @ x_pred
    unit = torch.linalg.vector_norm(x_cam, dim=-1).mean()
    # scale x_cam = R_cam_true x_true + xyz, in every frame.
    columns = torch.cat([x_cam[..., None] / unit, -R_cam_true], -1).flatten(0, 1)
    spread = torch.linalg.svdvals(columns)
    if spread[3] <= LEAST_SPREAD * spread[0]:
        raise ValueError("the object hardly turns: its size and its distance cannot be told apart")
    columns, goal = columns.unflatten(0, (-1, 3)), truth.T_cam_obj.xyz[..., None]
    weight, solution = columns.new_ones(len(columns), 1, 1), columns.new_zeros(4, 1)
    for _ in range(REWEIGHTED):
        solution = torch.linalg.lstsq((weight * columns).flatten(0, 1), (weight * goal).flatten(0, 1)).solution
        off = torch.linalg.vector_norm(columns @ solution - goal, dim=1, keepdim=True)
        weight = (off / goal.norm(dim=1).mean() + EXACT).rsqrt()
    solution = solution[:, 0]
    scale, x_true = solution[0] / unit, solution[1:]
    return Similarity(scale, R_true_pred, x_true - scale * (R_true_pred @ x_pred))


def position_scores(aligned: Trajectory, truth: Trajectory, *, tolerance: float, lost: int = 0) -> dict[str, float]:
    """Errors of camera positions in the true object frame, after alignment.

    Args:
        aligned: Predicted poses in the true frame, one for each of `truth`.
        tolerance: Error at which a frame is worth nothing to the AUC [true units].
        lost: Frames without a predicted pose; the AUC counts them as worth nothing.
    """
    errors = torch.linalg.vector_norm(aligned.camera_positions - truth.camera_positions, dim=-1)
    worth = (1 - errors / tolerance).clamp_min(0).sum() / (len(truth) + lost)
    return {"ate": float(errors.square().mean().sqrt()), "auc_percent": 100 * float(worth)}


def rotation_scores(
    predicted: Trajectory, truth: Trajectory, frames: Sequence[int] | None = None, *, lost: int = 0
) -> dict[str, float]:
    """Errors of orientations after a rotation of the object frame alone (chordal mean) [degrees].

    Args:
        frames: Numbers of the poses' frames among those that have a true pose, rising; from 0 when left out.
        lost: Frames without a predicted pose; the percentages, which are of all frames, count them as wrong.
    """
    R_pred_cam, R_true_cam = (t.T_cam_obj.rotation.inverse() for t in (predicted, truth))
    R_true_pred = mean_rotation(R_true_cam @ R_pred_cam.inverse())
    errors = torch.rad2deg(angle_between(R_true_cam, R_true_pred @ R_pred_cam))
    percent = 100 / (len(truth) + lost)
    return {
        "rotation_mean_degrees": float(errors.mean()),
        "rotation_median_degrees": float(errors.quantile(0.5)),
        **{f"rotation_below_{d}_percent": percent * int((errors < d).sum()) for d in (2, 5, 10)},
        "rotation_longest_run_percent": percent * _longest_run(frames or range(len(truth)), errors < TRACKED),
    }


def _longest_run(frames: Sequence[int], good: Bool[Tensor, " n"]) -> int:
    """Most good frames in a row, neighbours 1 apart."""
    longest = run = 0
    last = -1
    for number, fine in zip(frames, good.tolist(), strict=True):
        run = 0 if not fine else run + 1 if number == last + 1 else 1
        longest, last = max(longest, run), number
    return longest


def relative_scores(
    predicted: Trajectory, truth: Trajectory, frames: Sequence[int], *, scale: float | None
) -> dict[str, float | None]:
    """Mean error of the motion between consecutive frames: translation [true units] and rotation [degrees].

    Args:
        frames: Numbers of the poses' frames among those that have a true pose, rising; only neighbours 1 apart are
            compared. A frame that nobody annotated is no gap, one that the tracker lost is.
        scale: True units per predicted unit, from `align`; None when unknown, and so is the translation's error.
    """
    first = [i for i, (a, b) in enumerate(pairwise(frames)) if b == a + 1]
    if not first:
        return {"rpe_translation": None, "rpe_rotation_degrees": None}
    second = [i + 1 for i in first]

    def motion(path: Trajectory) -> SE3:
        return path.select(first).T_cam_obj @ path.select(second).T_cam_obj.inverse()

    step = motion(predicted)
    error = motion(truth).inverse() @ SE3(step.wxyz, (scale or 0.0) * step.xyz)
    translation = float(torch.linalg.vector_norm(error.xyz, dim=-1).mean())
    return {
        "rpe_translation": None if scale is None else translation,
        "rpe_rotation_degrees": float(torch.rad2deg(error.rotation.angle()).mean()),
    }
