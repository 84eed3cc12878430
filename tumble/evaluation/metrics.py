"""Metrics of a reconstruction against ground truth; docs/metrics.md compares each with its published variants.

*Foreground* pixels show the object for certain. *Valid* pixels are those with a known mask, that is, all but `UNKNOWN`
ones. In names of metrics, *fg* means over the foreground of one view, *full* over the whole image, and *crop* over the
foreground's bounding box. Images are in [0, 1]; "linear" and "srgb" name the colour space of the comparison.
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

MAX_PSNR = 100.0
"""PSNR of equal images [dB]: infinity has no mean and cannot be written as JSON."""
MIN_TRUE_ALBEDO = 0.02
"""True albedo below which a pixel is left out of the albedo scale [linear]: its ratio is mostly noise."""
MIN_PREDICTED_ALBEDO = 1e-4
"""Predicted albedo below which a pixel is left out of the albedo scale [linear]: it is the ratio's denominator."""
CROP_MARGIN = 10
"""Margin around the foreground's bounding box [pixels]: contains every 11 x 11 window of SSIM that overlaps it."""
MIN_NORMAL_LENGTH = 0.5
"""Length below which a predicted normal counts as missing; its error is then 90 degrees, the mean of random normals."""
LIGHT_GRID = (32, 64)
"""Rows and columns to which both light maps are resampled, so that errors of maps of any size are comparable."""
MAX_RADIANCE = 10.0
"""Radiance at which both light maps are clipped, so that one small bright lamp does not dominate the error."""
LOG_FLOOR = 1e-3
"""Floor of the luminance before the logarithm [fraction of the true light's mean luminance]."""
TRACKED_DEGREES = 10.0
"""Rotation error below which a frame counts as tracked [degrees]."""
MIN_SPREAD = 0.01
"""Minimum ratio of singular values for a determined alignment: below it camera positions count as collinear, and errors
of one percent of the path's length would rotate the aligned path about that line arbitrarily."""
IRLS_ROUNDS = 20
"""Iterations of reweighted least squares towards a fit of least absolute errors."""
IRLS_FLOOR = 2e-3
"""Residual added in the weights of reweighted least squares [radians, or fraction of the mean distance]."""


# Images ---------------------------------------------------------------------------------------------------------------


def psnr(x: Float[Tensor, "h w 3"], y: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]) -> float:
    """Peak signal-to-noise ratio over the pixels of a mask, for a peak of 1 [dB], at most `MAX_PSNR`.

    NaN if the mask is empty or one of its pixels is NaN.
    """
    error = float((x - y)[mask].square().mean())
    return math.nan if math.isnan(error) else min(MAX_PSNR, -10 * math.log10(max(error, 1e-30)))


def rmse(x: Float[Tensor, "h w"], y: Float[Tensor, "h w"], mask: Bool[Tensor, "h w"]) -> float:
    """Root mean square error over the pixels of a mask."""
    return float((x - y)[mask].square().mean().sqrt())


def mae(x: Float[Tensor, "h w"], y: Float[Tensor, "h w"], mask: Bool[Tensor, "h w"]) -> float:
    """Mean absolute error over the pixels of a mask."""
    return float((x - y)[mask].abs().mean())


def iou(x: Bool[Tensor, "h w"], y: Bool[Tensor, "h w"], valid: Bool[Tensor, "h w"]) -> float:
    """Intersection over union of two silhouettes over the valid pixels; 1 if both are empty."""
    return float(mask_iou(x, y, valid)) if bool(((x | y) & valid).any()) else 1.0


def image_scores(
    x: Float[Tensor, "h w 3"],
    y: Float[Tensor, "h w 3"],
    foreground: Bool[Tensor, "h w"],
    valid: Bool[Tensor, "h w"],
    networks: Sequence[lpips.Network],
) -> dict[str, float]:
    """PSNR, SSIM and LPIPS of the predicted image `x` against the true image `y`, both sRGB over black.

    Invalid pixels get the true colour before SSIM and LPIPS, whose value at a pixel depends on its neighbourhood.

    Raises:
        ValueError: An image smaller than SSIM's window of 11 x 11 pixels, or an empty foreground.
    """
    filled = torch.where(valid[..., None], x, y)
    box = crop_box(foreground, CROP_MARGIN)
    pairs = {"full": (filled, y), "crop": (crop(filled, box), crop(y, box))}
    scores = {"psnr_fg_srgb": psnr(x, y, foreground), "psnr_full_srgb": psnr(x, y, valid)}
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

    Images determine the product of albedo and light only. So the predicted albedo is multiplied by this scale before
    any metric and before relighting, and the predicted light is divided by it. A channel in which every pixel is below
    `MIN_TRUE_ALBEDO` or `MIN_PREDICTED_ALBEDO` takes the geometric mean of the other channels.

    Raises:
        ValueError: No pixel of any channel reaches both limits.
    """
    usable = mask[..., None] & (truth >= MIN_TRUE_ALBEDO) & (predicted >= MIN_PREDICTED_ALBEDO)
    ratios = [(truth[..., c] / predicted[..., c])[usable[..., c]] for c in range(3)]
    if not any(len(r) for r in ratios):
        raise ValueError("no foreground pixel has an albedo to compare: the prediction or the truth is black")
    # torch.median returns the lower of two middle values; their mean treats prediction and truth alike.
    medians = [0.5 * (r.median() - (-r).median()) if len(r) else r.new_tensor(math.nan) for r in ratios]
    scale = torch.stack(medians)
    return scale.where(~scale.isnan(), scale[~scale.isnan()].log().mean().exp())


def albedo_scores(
    predicted: Float[Tensor, "h w 3"],
    truth: Float[Tensor, "h w 3"],
    silhouette: Bool[Tensor, "h w"],
    scale: Float[Tensor, "3"],
    foreground: Bool[Tensor, "h w"],
    valid: Bool[Tensor, "h w"],
    networks: Sequence[lpips.Network],
) -> dict[str, float]:
    """Scores of a linear albedo map, multiplied by `scale` and clipped to [0, 1], in linear values and as sRGB.

    Foreground metrics use the map as it is; all others use it masked by the predicted `silhouette`. If foreground
    metrics used the masked map too, every pixel missing from the silhouette would count as black albedo; the
    silhouette has a metric of its own.
    """
    scaled, unscaled, truth = (a.clamp(0, 1) for a in (predicted * scale, predicted, truth))
    masked = scaled * silhouette[..., None]
    return {
        **image_scores(srgb_from_linear(masked), srgb_from_linear(truth), foreground, valid, networks),
        "psnr_fg_srgb": psnr(srgb_from_linear(scaled), srgb_from_linear(truth), foreground),
        "psnr_fg_linear": psnr(scaled, truth, foreground),
        "psnr_full_linear": psnr(masked, truth, valid),
        "psnr_fg_linear_unscaled": psnr(unscaled, truth, foreground),
        "psnr_fg_srgb_unscaled": psnr(srgb_from_linear(unscaled), srgb_from_linear(truth), foreground),
    }


def normal_angles(predicted: Float[Tensor, "*b 3"], truth: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """Angles between normals of any length [degrees]; 90 where the predicted one is under `MIN_NORMAL_LENGTH`."""
    sine = torch.linalg.vector_norm(torch.linalg.cross(predicted, truth), dim=-1)
    angles = torch.rad2deg(torch.atan2(sine, (predicted * truth).sum(-1)))
    missing = torch.linalg.vector_norm(predicted, dim=-1) < MIN_NORMAL_LENGTH
    return angles.masked_fill(missing, 90.0)


def normal_scores(
    predicted: Float[Tensor, "h w 3"],
    truth: Float[Tensor, "h w 3"],
    foreground: Bool[Tensor, "h w"],
    valid: Bool[Tensor, "h w"],
) -> dict[str, float]:
    """Mean and median angle over the foreground, and the mean over all valid pixels with 0 for the background."""
    known = foreground & (torch.linalg.vector_norm(truth, dim=-1) > MIN_NORMAL_LENGTH)
    angles = normal_angles(predicted, truth)[known]
    return {
        "mean_fg_degrees": float(angles.mean()),
        "median_fg_degrees": float(angles.quantile(0.5)),
        "mean_all_degrees": float(angles.sum() / valid.sum()),
    }


# Light ----------------------------------------------------------------------------------------------------------------


def light_scores(predicted: Environment, truth: Environment, scale: Float[Tensor, "3"]) -> dict[str, float | None]:
    """Errors of a light map, divided by the albedo `scale` and resampled to `LIGHT_GRID`; both maps in one frame.

    Root mean square error of radiance clipped at `MAX_RADIANCE`, weighted by solid angle and unweighted, and the
    Pearson correlation of log luminance, unclipped and weighted by solid angle; None if one of the lights is uniform.
    """
    x = predicted.resampled(*LIGHT_GRID).radiance / scale
    y = truth.resampled(*LIGHT_GRID).radiance.to(x)
    weight = texel_solid_angles(*LIGHT_GRID).to(x) / (4 * math.pi)
    squared = (x.clamp_max(MAX_RADIANCE) - y.clamp_max(MAX_RADIANCE)).square().mean(-1)
    luminance = x.new_tensor([0.2126, 0.7152, 0.0722])
    floor = LOG_FLOOR * float((weight * (y @ luminance)).sum())
    log_x, log_y = ((light @ luminance).clamp_min(floor).log() for light in (x, y))
    return {
        "rmse_clip10": float((weight * squared).sum().sqrt()),
        "rmse_clip10_unweighted": float(squared.mean().sqrt()),
        "log_correlation": _correlation(log_x, log_y, weight),
    }


def _correlation(x: Tensor, y: Tensor, weight: Tensor) -> float | None:
    """Pearson correlation coefficient under weights with sum 1; None if `x` or `y` is constant."""
    x, y = x - (weight * x).sum(), y - (weight * y).sum()
    spread = ((weight * x * x).sum() * (weight * y * y).sum()).sqrt()
    return float((weight * x * y).sum() / spread) if spread > 1e-8 else None


# Trajectories ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Similarity:
    """Similarity transform from the predicted to the true object frame: `x_true = scale R_true_pred x_pred + shift`."""

    scale: Float[Tensor, ""]
    """True units per predicted unit."""
    R_true_pred: SO3
    shift: Float[Tensor, "3"]
    """Predicted origin in the true object frame [true units]."""

    def to_truth(self, predicted: Trajectory) -> Trajectory:
        """Predicted poses, expressed in the true object frame and unit."""
        R_cam_true = predicted.T_cam_obj.rotation @ self.R_true_pred.inverse()
        xyz = self.scale * predicted.T_cam_obj.xyz - R_cam_true @ self.shift
        return Trajectory(SE3(R_cam_true.wxyz, xyz), predicted.light)

    def to_prediction(self, truth: Trajectory) -> Trajectory:
        """True poses, expressed in the predicted object frame and unit: those at which a reconstruction is rendered."""
        R_cam_pred = truth.T_cam_obj.rotation @ self.R_true_pred
        xyz = (truth.T_cam_obj.rotation @ self.shift + truth.T_cam_obj.xyz) / self.scale
        return Trajectory(SE3(R_cam_pred.wxyz, xyz), truth.light)


def align(predicted: Trajectory, truth: Trajectory) -> Similarity:
    """The similarity that best maps the predicted camera positions to the true ones (Umeyama 1991).

    Raises:
        ValueError: The positions do not determine the similarity; the message gives the reason.
    """
    centres = truth.camera_positions
    spread = torch.linalg.svdvals(centres - centres.mean(0))
    if len(truth) < 3 or spread[1] <= MIN_SPREAD * spread[0]:
        raise ValueError("the true camera positions lie nearly on a line (or are fewer than three)")
    try:
        return Similarity(*umeyama(predicted.camera_positions, centres))
    except ValueError as error:
        raise ValueError(f"the predicted camera positions: {error}") from None


def register(predicted: Trajectory, truth: Trajectory) -> Similarity:
    """The similarity for rendering true views of a reconstruction, fitted to object poses in the camera frame.

    The rotation is fitted first and alone. Scale and shift are then fitted so that the point at which the cameras look
    comes closest to its true position in the camera frame. (`align` fits camera positions and compensates errors of
    orientation by scale and shift.) Both fits minimise absolute errors, by iteratively reweighted least squares, so
    that a few wrong frames do not shift all views.

    Raises:
        ValueError: The object hardly rotates, so that the poses do not determine the similarity.
    """
    R_cam_true, R_cam_pred = truth.T_cam_obj.rotation.matrix(), predicted.T_cam_obj.rotation.matrix()
    relative = truth.T_cam_obj.rotation.inverse() @ predicted.T_cam_obj.rotation
    R_true_pred = mean_rotation(relative)
    for _ in range(IRLS_ROUNDS):
        R_true_pred = mean_rotation(relative, 1 / (angle_between(relative, R_true_pred) + IRLS_FLOOR))
    # The point nearest to all optical axes: errors of orientation move it least.
    across, offset = R_cam_pred[:, :2].flatten(0, 1), predicted.T_cam_obj.xyz[:, :2].flatten()
    x_pred = torch.linalg.lstsq(across, -offset[:, None]).solution[:, 0]
    x_cam = predicted.T_cam_obj @ x_pred
    unit = torch.linalg.vector_norm(x_cam, dim=-1).mean()
    # Solve scale x_cam = R_cam_true x_true + xyz over all frames.
    columns = torch.cat([x_cam[..., None] / unit, -R_cam_true], -1).flatten(0, 1)
    spread = torch.linalg.svdvals(columns)
    if spread[3] <= MIN_SPREAD * spread[0]:
        raise ValueError("the object hardly rotates, so its size and its distance cannot be separated")
    columns, target = columns.unflatten(0, (-1, 3)), truth.T_cam_obj.xyz[..., None]
    weight, solution = columns.new_ones(len(columns), 1, 1), columns.new_zeros(4, 1)
    for _ in range(IRLS_ROUNDS):
        solution = torch.linalg.lstsq((weight * columns).flatten(0, 1), (weight * target).flatten(0, 1)).solution
        residual = torch.linalg.vector_norm(columns @ solution - target, dim=1, keepdim=True)
        weight = (residual / target.norm(dim=1).mean() + IRLS_FLOOR).rsqrt()
    solution = solution[:, 0]
    scale, x_true = solution[0] / unit, solution[1:]
    return Similarity(scale, R_true_pred, x_true - scale * (R_true_pred @ x_pred))


def position_scores(aligned: Trajectory, truth: Trajectory, *, tolerance: float, lost: int = 0) -> dict[str, float]:
    """Errors of camera positions in the true object frame, after alignment.

    Args:
        aligned: Predicted poses in the true object frame, one for each pose of `truth`.
        tolerance: Error up to which the recall curve of the AUC is integrated [true units].
        lost: Number of frames without a predicted pose; each contributes 0 to the AUC.
    """
    errors = torch.linalg.vector_norm(aligned.camera_positions - truth.camera_positions, dim=-1)
    auc = (1 - errors / tolerance).clamp_min(0).sum() / (len(truth) + lost)
    return {"ate": float(errors.square().mean().sqrt()), "auc_percent": 100 * float(auc)}


def rotation_scores(
    predicted: Trajectory, truth: Trajectory, frames: Sequence[int] | None = None, *, lost: int = 0
) -> dict[str, float]:
    """Errors of orientations after a rotation of the object frame alone (chordal mean) [degrees].

    Args:
        frames: Index of each pose's frame among the frames with a true pose, increasing; by default 0, 1, ...
        lost: Number of frames without a predicted pose; the percentages are of all frames and count these as wrong.
    """
    R_pred_cam, R_true_cam = (t.T_cam_obj.rotation.inverse() for t in (predicted, truth))
    R_true_pred = mean_rotation(R_true_cam @ R_pred_cam.inverse())
    errors = torch.rad2deg(angle_between(R_true_cam, R_true_pred @ R_pred_cam))
    percent = 100 / (len(truth) + lost)
    return {
        "rotation_mean_degrees": float(errors.mean()),
        "rotation_median_degrees": float(errors.quantile(0.5)),
        **{f"rotation_below_{d}_percent": percent * int((errors < d).sum()) for d in (2, 5, 10)},
        "rotation_longest_run_percent": percent * _longest_run(frames or range(len(truth)), errors < TRACKED_DEGREES),
    }


def _longest_run(frames: Sequence[int], tracked: Bool[Tensor, " n"]) -> int:
    """Maximum number of consecutive tracked frames, whose indices differ by 1."""
    longest = run = 0
    last = -1
    for number, good in zip(frames, tracked.tolist(), strict=True):
        run = 0 if not good else run + 1 if number == last + 1 else 1
        longest, last = max(longest, run), number
    return longest


def relative_scores(
    predicted: Trajectory, truth: Trajectory, frames: Sequence[int], *, scale: float | None
) -> dict[str, float | None]:
    """Mean error of the motion between consecutive frames: translation [true units] and rotation [degrees].

    Args:
        frames: Index of each pose's frame among the frames with a true pose, increasing. Only frames whose indices
            differ by 1 are compared: a frame without a true pose leaves no gap, a frame without a predicted pose does.
        scale: True units per predicted unit, from `align`; None if unknown, and then no translation error is given.
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
