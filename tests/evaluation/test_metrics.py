"""Each metric against its published definition, another implementation, or a case computed by hand."""

import math
from pathlib import Path

import numpy as np
import pytest
import scipy.optimize
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from skimage import metrics as skimage_metrics
from torch import Tensor

from tumble.evaluation import lpips, metrics
from tumble.io.files import BadFile
from tumble.maths.images import srgb_from_linear
from tumble.maths.se3 import SE3, SO3, angle_between
from tumble.scene.environment import Environment
from tumble.scene.trajectory import Trajectory

GREY = 0.5


def images(height: int = 40, width: int = 50) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(3)
    y = torch.rand(height, width, 3, generator=generator)
    return (y + 0.1 * torch.randn(height, width, 3, generator=generator)).clamp(0, 1), y


def disc(height: int = 40, width: int = 50, radius: float = 12) -> Tensor:
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return (rows - height // 2) ** 2 + (columns - width // 2) ** 2 < radius**2


def everywhere(mask: Tensor) -> Tensor:
    return torch.ones_like(mask)


# Images ---------------------------------------------------------------------------------------------------------------


def test_psnr_is_that_of_scikit_image() -> None:
    x, y = images()
    expected = skimage_metrics.peak_signal_noise_ratio(y.numpy(), x.numpy(), data_range=1)
    # One ulp of a float32 mean is 1e-6 dB.
    assert metrics.psnr(x, y, everywhere(disc())) == pytest.approx(expected, abs=1e-4)


def test_equal_images_have_the_best_psnr() -> None:
    _, y = images()
    assert metrics.psnr(y, y, disc()) == metrics.MAX_PSNR


def test_full_image_psnr_exceeds_that_of_the_foreground_by_the_share_of_background() -> None:
    """With no error off the object, the two differ by -10 log10(fraction of object pixels)."""
    mask = disc()
    y = GREY * mask[..., None].float().expand(-1, -1, 3)
    scores = metrics.image_scores(y * 1.1, y, mask, everywhere(mask), [])
    share = float(mask.float().mean())
    assert scores["psnr_fg_srgb"] == pytest.approx(-20 * math.log10(0.1 * GREY), abs=1e-4)
    assert scores["psnr_full_srgb"] - scores["psnr_fg_srgb"] == pytest.approx(-10 * math.log10(share), abs=1e-4)


def test_ssim_is_that_of_scikit_image_on_image_and_crop() -> None:
    x, y = images()
    mask = disc(radius=4.5)
    scores = metrics.image_scores(x, y, mask, everywhere(mask), [])

    def expected(x: Tensor, y: Tensor) -> float:
        how = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
        return skimage_metrics.structural_similarity(x.numpy(), y.numpy(), channel_axis=-1, **how)

    # The disc reaches 4 pixels from (20, 25); ten more on each side.
    crop = slice(6, 35), slice(11, 40)
    assert scores["ssim_full_srgb"] == pytest.approx(expected(x, y), abs=1e-5)
    assert scores["ssim_crop_srgb"] == pytest.approx(expected(x[crop], y[crop]), abs=1e-5)


def test_unknown_pixels_change_no_score() -> None:
    x, y = images(64, 64)
    mask = disc(64, 64)
    unknown = torch.zeros_like(mask)
    unknown[10:20, 10:50] = True
    damaged = torch.where(unknown[..., None], 1 - x, x)
    network = lpips.read()
    before, after = (metrics.image_scores(p, y, mask & ~unknown, ~unknown, [network]) for p in (x, damaged))
    assert before == after


# LPIPS ----------------------------------------------------------------------------------------------------------------


def slow_lpips(network: lpips.Network, x: np.ndarray, y: np.ndarray, plan: list[str]) -> float:
    """The published formula in numpy. In `plan`, "3/2" is a max-pooling with window 3 and stride 2, "4:2" a convolution
    with stride 4 and padding 2, and "!" takes the features."""

    def windows(x: np.ndarray, size: int, stride: int) -> np.ndarray:
        return np.lib.stride_tricks.sliding_window_view(x, (size, size), (1, 2))[:, ::stride, ::stride]

    def taps(image: np.ndarray) -> list[np.ndarray]:
        x = (2 * image - 1 - [-0.030, -0.088, -0.188]) / [0.458, 0.448, 0.450]
        x, taps, number = x.transpose(2, 0, 1), [], 0
        for word in plan:
            if word == "!":
                taps.append(x)
            elif "/" in word:
                x = windows(x, *map(int, word.split("/"))).max((-1, -2))
            else:
                stride, padding = map(int, word.split(":"))
                weight, bias = (network.weights[f"conv{number}.{p}"].double().numpy() for p in ("weight", "bias"))
                x = windows(np.pad(x, [(0, 0), (padding, padding), (padding, padding)]), weight.shape[-1], stride)
                x = np.maximum(np.tensordot(weight, x, ((1, 2, 3), (0, 3, 4))) + bias[:, None, None], 0)
                number += 1
        return taps

    total = 0.0
    for k, (a, b) in enumerate(zip(taps(x), taps(y), strict=True)):
        a, b = (f / (np.linalg.norm(f, axis=0, keepdims=True) + 1e-10) for f in (a, b))
        weight = network.weights[f"lin{k}.weight"].double().numpy()
        total += float(np.tensordot(weight, (a - b) ** 2, 1).mean())
    return total


ALEX = ["4:2", "!", "3/2", "1:2", "!", "3/2", "1:1", "!", "1:1", "!", "1:1", "!"]
VGG = [*["1:1"] * 2, "!", "2/2", *["1:1"] * 2, "!", "2/2", *["1:1"] * 3, "!"] + ["2/2", *["1:1"] * 3, "!"] * 2


def test_lpips_is_the_published_formula() -> None:
    x, y = (image.double() for image in images(70, 90))
    network = lpips.read()
    expected = slow_lpips(network, x.numpy(), y.numpy(), ALEX)
    assert expected > 0.01
    assert float(lpips.distance(network, x, y)) == pytest.approx(expected, rel=1e-9)


def test_lpips_with_vgg_is_the_published_formula(shared_data: Path) -> None:
    x, y = (image.double() for image in images(64, 64))
    network = lpips.read(shared_data / "lpips" / "lpips_vgg_v01_f16.npz")
    expected = slow_lpips(network, x.numpy(), y.numpy(), VGG)
    assert network.name == "vgg"
    assert float(lpips.distance(network, x, y)) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(("name", "published"), [("ex_p0", 0.7219), ("ex_p1", 0.1376)])
def test_lpips_of_the_published_examples(shared_data: Path, name: str, published: float) -> None:
    reference, image = (
        torch.from_numpy(np.asarray(Image.open(shared_data / "lpips" / f"{n}.png")) / 255.0) for n in ("ex_ref", name)
    )
    # Half a unit of the last printed digit, and as much for weights rounded to 16 bits (3e-5 measured).
    assert float(lpips.distance(lpips.read(), reference, image)) == pytest.approx(published, abs=1e-4)


@pytest.mark.parametrize("size", [(1, 1), (5, 40), (31, 31), (63, 64)])
def test_lpips_of_small_images_is_that_of_the_enlarged_ones(size: tuple[int, int]) -> None:
    x, y = images(*size)
    network = lpips.read()
    factor = math.ceil(64 / min(size))

    def enlarged(image: Tensor) -> Tensor:
        planes = image.permute(2, 0, 1)[None]
        planes = torch.nn.functional.interpolate(planes, [factor * side for side in size], mode="bilinear")
        return planes[0].permute(1, 2, 0)

    expected = lpips.distance(network, enlarged(x), enlarged(y))
    torch.testing.assert_close(lpips.distance(network, x, y), expected)
    assert float(lpips.distance(network, x, x)) == 0


def test_lpips_has_a_finite_gradient_where_features_vanish() -> None:
    x = torch.zeros(64, 64, 3, requires_grad=True)
    lpips.distance(lpips.read(), x, torch.ones(64, 64, 3)).backward()
    assert x.grad is not None
    assert x.grad.isfinite().all()


def test_weights_of_another_kind_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", weight=np.zeros(3))
    (tmp_path / "broken.safetensors").write_bytes(b"not weights")
    with pytest.raises(BadFile, match=r"other\.npz: lacks conv0\.bias"):
        lpips.read(tmp_path / "other.npz")
    with pytest.raises(BadFile, match=r"broken\.safetensors: holds no weights"):
        lpips.read(tmp_path / "broken.safetensors")
    with pytest.raises(BadFile, match="is missing"):
        lpips.read(tmp_path / "none.npz")


# Maps -----------------------------------------------------------------------------------------------------------------


def albedos() -> tuple[Tensor, Tensor]:
    """An albedo of three views between 0.1 and 0.8, and its foreground."""
    generator = torch.Generator().manual_seed(5)
    mask = disc()[None].expand(3, -1, -1)
    return (0.1 + 0.7 * torch.rand(3, 40, 50, 3, generator=generator)) * mask[..., None], mask


def test_albedo_scale_undoes_a_factor_per_channel() -> None:
    truth, mask = albedos()
    factor = torch.tensor([1.1, 0.5, 2.0])
    torch.testing.assert_close(metrics.albedo_scale(truth * factor, truth, mask), 1 / factor)


def test_albedo_scale_is_the_median_ratio_over_all_views_together() -> None:
    truth, mask = albedos()
    torch.manual_seed(0)
    predicted = truth * (0.5 + torch.rand(3, 1, 1, 1)) * (0.8 + 0.4 * torch.rand_like(truth))
    ratios = (truth[mask] / predicted[mask]).numpy()
    expected = torch.from_numpy(np.median(ratios, axis=0))
    torch.testing.assert_close(metrics.albedo_scale(predicted, truth, mask), expected)


def test_albedo_scale_ignores_dark_pixels() -> None:
    """Ratios of black ink and of holes in the prediction are near 0 and infinite."""
    truth, mask = albedos()
    predicted = truth * 2
    truth, predicted = truth.clone(), predicted.clone()
    truth[:, :19], predicted[:, :19] = 0.01, 0.5
    predicted[:, 21:] = 0
    torch.testing.assert_close(metrics.albedo_scale(predicted, truth, mask), torch.full((3,), 0.5))


def test_a_channel_without_bright_pixels_takes_the_scale_of_the_others() -> None:
    """A red object does not determine the scale of blue; the geometric mean of the others keeps the common factor."""
    truth, mask = albedos()
    predicted = truth * torch.tensor([2.0, 0.5, 4.0])
    dark = torch.tensor([1.0, 1.0, 0.01])
    scale = metrics.albedo_scale(predicted * dark, truth * dark, mask)
    torch.testing.assert_close(scale, torch.tensor([0.5, 2.0, 1.0]))


def test_a_black_prediction_has_no_albedo_scale() -> None:
    truth, mask = albedos()
    with pytest.raises(ValueError, match="black"):
        metrics.albedo_scale(torch.zeros_like(truth), truth, mask)


def test_albedo_scores_use_the_scale() -> None:
    truth, mask = albedos()
    view = (truth[0] * 1.1, truth[0], mask[0], torch.full((3,), 1 / 1.1), mask[0], everywhere(mask[0]), [])
    scores = metrics.albedo_scores(*view)
    # What 1.1 / 1.1 leaves in float32 is 1e-7, or 140 dB.
    assert scores["psnr_fg_linear"] == scores["psnr_full_linear"] == metrics.MAX_PSNR
    error = (0.1 * truth[0][mask[0]]).square().mean()
    assert scores["psnr_fg_linear_unscaled"] == pytest.approx(-10 * math.log10(error), abs=1e-4)
    difference = (srgb_from_linear((truth[0] * 1.1).clamp(0, 1)) - srgb_from_linear(truth[0]))[mask[0]]
    assert scores["psnr_fg_srgb_unscaled"] == pytest.approx(-10 * math.log10(difference.square().mean()), abs=1e-4)
    linear = skimage_metrics.peak_signal_noise_ratio(truth[0].numpy() * 0.5, truth[0].numpy(), data_range=1)
    rest = (mask[0], torch.ones(3), mask[0], everywhere(mask[0]), [])
    halved = metrics.albedo_scores(truth[0], truth[0] * 0.5, *rest)
    assert halved["psnr_full_linear"] == pytest.approx(linear, abs=1e-4)


def test_the_silhouette_masks_the_albedo_in_full_but_not_in_foreground_metrics() -> None:
    truth, mask = albedos()
    half, everything = mask[0].clone(), everywhere(mask[0])
    half[:, : half.shape[1] // 2] = False
    beyond = torch.where(mask[0][..., None], truth[0], 0.7)
    scores = metrics.albedo_scores(beyond, truth[0], half, torch.ones(3), mask[0], everything, [])
    assert scores["psnr_fg_srgb"] == scores["psnr_fg_linear"] == metrics.MAX_PSNR
    missing = truth[0][mask[0] & ~half].square().sum() / truth[0].numel()
    assert scores["psnr_full_linear"] == pytest.approx(-10 * math.log10(missing), abs=1e-3)


def normals(dtype: torch.dtype = torch.float32) -> Tensor:
    generator = torch.Generator().manual_seed(7)
    return torch.nn.functional.normalize(torch.randn(40, 50, 3, generator=generator, dtype=dtype), dim=-1)


def turned(normals: Tensor, degrees: float) -> Tensor:
    """Each normal rotated about its own perpendicular axis."""
    axis = torch.linalg.cross(normals, torch.roll(normals, 1, 0))
    return SO3.exp(torch.nn.functional.normalize(axis, dim=-1) * math.radians(degrees)) @ normals


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("degrees", [0.01, 2.0, 179.0])
def test_the_error_of_rotated_normals_is_their_angle(dtype: torch.dtype, degrees: float) -> None:
    mask = disc()
    scores = metrics.normal_scores(turned(normals(dtype), degrees), normals(dtype), mask, everywhere(mask))
    assert scores["mean_fg_degrees"] == pytest.approx(degrees, abs=2e-5)
    assert scores["median_fg_degrees"] == pytest.approx(degrees, abs=2e-5)
    assert scores["mean_all_degrees"] == pytest.approx(degrees * float(mask.float().mean()), abs=2e-5)


def test_normals_rounded_to_half_precision_have_small_errors() -> None:
    """Rounding to 11 bits moves a unit vector by at most 0.024 degrees; an arccos would report 0.4."""
    assert metrics.normal_angles(normals().half().float(), normals()).max() < 0.024


def test_a_missing_normal_counts_as_a_right_angle() -> None:
    mask = disc()
    predicted = normals().clone()
    predicted[:20] = 0
    scores = metrics.normal_scores(predicted, normals(), mask, everywhere(mask))
    assert scores["mean_fg_degrees"] == pytest.approx(90 * float(mask[:20].sum() / mask.sum()), rel=1e-5)


def test_rmse_and_iou_by_hand() -> None:
    x, y = torch.tensor([[0.1, 0.5, 0.9]]), torch.tensor([[0.1, 0.2, 0.5]])
    assert metrics.rmse(x, y, torch.tensor([[True, True, False]])) == pytest.approx(0.3 / math.sqrt(2))
    a, b = torch.tensor([[True, True, False, True]]), torch.tensor([[False, True, True, False]])
    assert metrics.iou(a, b, torch.tensor([[True, True, True, False]])) == pytest.approx(1 / 3)
    assert metrics.iou(a & b & False, a & False, a) == 1


# Light ----------------------------------------------------------------------------------------------------------------


def uniform(radiance: float, height: int = 8) -> Tensor:
    return torch.full((height, 2 * height, 3), radiance)


def light_scores(x: Tensor, y: Tensor, scale: float = 1.0) -> dict[str, float | None]:
    return metrics.light_scores(*map(Environment.from_radiance, (x, y)), torch.full((3,), scale))


@pytest.mark.parametrize("height", [8, 32, 96])
def test_uniform_lights_differ_by_their_difference_at_any_size(height: int) -> None:
    scores = light_scores(uniform(1.5, height), uniform(1.0, 16))
    assert scores["rmse_clip10"] == pytest.approx(0.5, abs=1e-5)
    assert scores["rmse_clip10_unweighted"] == pytest.approx(0.5, abs=1e-5)
    assert scores["log_correlation"] is None


def test_the_light_is_divided_by_the_albedo_scale() -> None:
    """Images fix the product of albedo and light: a tenth of the albedo needs ten times the light."""
    torch.manual_seed(0)
    truth = torch.rand(32, 64, 3)
    assert light_scores(truth * 10, truth, scale=10.0)["rmse_clip10"] == pytest.approx(0, abs=1e-6)


def test_light_errors_are_weighted_by_solid_angle() -> None:
    """An error of 1 within 45 degrees of the zenith covers (1 - cos 45) / 2 of the sphere, and a quarter of the map."""
    off = uniform(1.0, 32)
    off[:8] += 1
    scores = light_scores(off, uniform(1.0, 32))
    assert scores["rmse_clip10"] == pytest.approx(math.sqrt((1 - math.cos(math.pi / 4)) / 2), abs=1e-5)
    assert scores["rmse_clip10_unweighted"] == pytest.approx(0.5, abs=1e-5)


def test_one_lamp_is_clipped() -> None:
    lamp = uniform(1.0, 32)
    lamp[10, 20] = 5000
    dimmer = lamp.clamp_max(10.0)
    # Resampling places texels to 1e-6 in float32, and mixes that share of 5000 into neighbours.
    assert light_scores(lamp, dimmer)["rmse_clip10"] == pytest.approx(0, abs=1e-3)


def test_log_correlation_is_the_weighted_one_of_numpy() -> None:
    torch.manual_seed(1)
    x, y = (torch.randn(32, 64, 1).mul(2).exp().expand(-1, -1, 3) for _ in range(2))
    y = (x * y).sqrt()
    sine = np.sin(np.pi * (np.arange(32) + 0.5) / 32)[:, None].repeat(64, 1)
    logs = np.stack([light[..., 0].log().numpy().ravel() for light in (x, y)])
    floor = math.log(metrics.LOG_FLOOR * float((torch.from_numpy(sine) * y[..., 0]).sum() / sine.sum()))
    covariance = np.cov(np.maximum(logs, floor), aweights=sine.ravel())
    expected = covariance[0, 1] / math.sqrt(covariance[0, 0] * covariance[1, 1])
    assert light_scores(x, y)["log_correlation"] == pytest.approx(expected, abs=1e-4)
    assert light_scores(3 * y, y)["log_correlation"] == pytest.approx(1, abs=1e-4)


# Trajectories ---------------------------------------------------------------------------------------------------------


def random_path(n: int = 30, seed: int = 0) -> Trajectory:
    """Poses of an object that rotates at a distance of about 4 from the camera, float64."""
    generator = torch.Generator().manual_seed(seed)
    steps = SO3.exp(0.15 * torch.randn(n, 3, generator=generator, dtype=torch.float64))
    rotations = [SO3.exp(torch.randn(3, generator=generator, dtype=torch.float64))]
    for k in range(1, n):
        rotations.append(steps[k] @ rotations[-1])
    xyz = torch.tensor([0.0, 0.0, 4.0]) + 0.2 * torch.randn(n, 3, generator=generator, dtype=torch.float64)
    return Trajectory(SE3(torch.stack([R.wxyz for R in rotations]), xyz), "camera")


def reexpressed(path: Trajectory, scale: float = 0.3) -> Trajectory:
    """The same motion in another object frame and unit."""
    other = metrics.Similarity(
        torch.tensor(scale, dtype=torch.float64),
        SO3.exp(torch.tensor([0.5, -1.2, 2.0], dtype=torch.float64)),
        torch.tensor([3.0, -2.0, 7.0], dtype=torch.float64),
    )
    return other.to_truth(path)


def perturbed(path: Trajectory, degrees: float, seed: int = 1) -> Trajectory:
    """Each pose rotated by the same angle about its own random axis through the object's origin."""
    generator = torch.Generator().manual_seed(seed)
    axes = torch.randn(len(path), 3, generator=generator, dtype=torch.float64)
    turns = SO3.exp(torch.nn.functional.normalize(axes, dim=-1) * math.radians(degrees))
    return Trajectory(path.T_cam_obj @ SE3(turns.wxyz, torch.zeros(len(path), 3, dtype=torch.float64)), path.light)


def test_another_object_frame_and_unit_is_no_error() -> None:
    truth = random_path()
    predicted = reexpressed(truth)
    alignment = metrics.align(predicted, truth)
    assert float(alignment.scale) == pytest.approx(1 / 0.3)
    scores = metrics.position_scores(alignment.to_truth(predicted), truth, tolerance=0.1)
    scores |= metrics.rotation_scores(predicted, truth)
    scores |= metrics.relative_scores(predicted, truth, range(30), scale=float(alignment.scale))
    for key, value in scores.items():
        assert value == pytest.approx(100 if "percent" in key else 0, abs=1e-5), key


def test_ate_is_the_minimum_over_all_similarities() -> None:
    truth = random_path(12)
    predicted = reexpressed(perturbed(truth, 10))
    x, y = (path.camera_positions.numpy() for path in (predicted, truth))

    def residuals(p: np.ndarray) -> np.ndarray:
        return (y - np.exp(p[0]) * Rotation.from_rotvec(p[1:4]).apply(x) - p[4:]).ravel()

    starts = [np.r_[1.2, rotvec, 0, 0, 0] for rotvec in Rotation.random(12, rng=0).as_rotvec()]
    best = min(scipy.optimize.least_squares(residuals, start).cost for start in starts)
    aligned = metrics.align(predicted, truth).to_truth(predicted)
    ate = metrics.position_scores(aligned, truth, tolerance=1.0)["ate"]
    assert ate == pytest.approx(math.sqrt(2 * best / 12), rel=1e-6)


def test_auc_is_the_area_under_the_recall_curve() -> None:
    truth = random_path()
    generator = torch.Generator().manual_seed(2)
    off = torch.randn(30, 3, generator=generator, dtype=torch.float64) * torch.linspace(0, 0.15, 30)[:, None]
    moved = Trajectory(SE3(truth.T_cam_obj.wxyz, truth.T_cam_obj.xyz + off), "camera")
    errors = off.norm(dim=-1).numpy()  # moving the object moves the camera as far the other way
    thresholds = (np.arange(20000) + 0.5) / 20000 * 0.1
    recall = (errors[:, None] < thresholds).sum(0) / 33
    scores = metrics.position_scores(moved, truth, tolerance=0.1, lost=3)
    assert 10 < scores["auc_percent"] < 90
    # 20000 steps of a curve that falls by at most 1.
    assert scores["auc_percent"] == pytest.approx(100 * recall.mean(), abs=5e-3)


def test_rotation_errors_equal_those_of_scipy_after_its_mean_rotation() -> None:
    truth = random_path()
    predicted = reexpressed(perturbed(truth, 3.0))
    R_true, R_pred = (Rotation.from_matrix(p.T_cam_obj.rotation.inverse().matrix().numpy()) for p in (truth, predicted))
    errors = np.degrees(((R_true * R_pred.inv()).mean().inv() * R_true * R_pred.inv()).magnitude())
    scores = metrics.rotation_scores(predicted, truth)
    # Alignment removes at most the mean of the 30 random rotations.
    assert 2.5 < scores["rotation_mean_degrees"] < 3
    assert scores["rotation_mean_degrees"] == pytest.approx(errors.mean(), abs=1e-6)
    assert scores["rotation_median_degrees"] == pytest.approx(np.median(errors), abs=1e-6)
    assert scores["rotation_below_2_percent"] == pytest.approx(100 * (errors < 2).mean())
    assert scores["rotation_below_5_percent"] == 100


def test_a_rotation_common_to_all_poses_is_no_error() -> None:
    truth = random_path()
    turn = SE3.from_rotation(
        SO3.exp(torch.tensor([0.0, math.radians(3), 0.0], dtype=torch.float64)), torch.zeros(3, dtype=torch.float64)
    )
    scores = metrics.rotation_scores(Trajectory(truth.T_cam_obj @ turn, "camera"), truth)
    assert scores["rotation_mean_degrees"] == pytest.approx(0, abs=1e-9)


def test_lost_frames_count_as_wrong_rotations() -> None:
    scores = metrics.rotation_scores(random_path(), random_path(), lost=10)
    assert scores["rotation_below_2_percent"] == pytest.approx(75)


def test_the_longest_run_ends_at_bad_and_at_lost_frames() -> None:
    """Frame 5 is rotated by 40 degrees, frames 8 and 9 are lost: so 0 1 2 3 4 is longer than 6 7 and 10 11."""
    truth = random_path(12)
    kept = [0, 1, 2, 3, 4, 5, 6, 7, 10, 11]
    offset = torch.zeros(10, 6, dtype=torch.float64)
    offset[5, 3] = math.radians(40)
    predicted = Trajectory(SE3.exp(offset) @ truth.select(kept).T_cam_obj, "camera")
    scores = metrics.rotation_scores(predicted, truth.select(kept), kept, lost=2)
    assert scores["rotation_longest_run_percent"] == pytest.approx(100 * 5 / 12)
    scores = metrics.rotation_scores(truth, truth)
    assert scores["rotation_longest_run_percent"] == 100


def test_registration_keeps_the_object_in_place_in_the_camera_frame() -> None:
    """Under drift, object points stay closer to the true ones than after an alignment of camera positions."""
    truth = random_path(40)
    drift = torch.linspace(-1, 1, 40, dtype=torch.float64)[:, None] * torch.tensor([0.0, 0.2, 0.1], dtype=torch.float64)
    zero = torch.zeros(40, 3, dtype=torch.float64)
    predicted = reexpressed(Trajectory(truth.T_cam_obj @ SE3.from_rotation(SO3.exp(drift), zero), "camera"))
    x_true = torch.randn(50, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    similarity = metrics.align(truth, reexpressed(truth))
    x_pred = similarity.scale * (similarity.R_true_pred @ x_true) + similarity.shift

    def mean_error(alignment: metrics.Similarity) -> float:
        x_cam = alignment.to_prediction(truth).T_cam_obj[:, None] @ x_pred * alignment.scale
        return float((x_cam - truth.T_cam_obj[:, None] @ x_true).norm(dim=-1).mean())

    assert mean_error(metrics.register(predicted, truth)) < 0.02
    assert mean_error(metrics.align(predicted, truth)) > 0.05


def test_registration_is_robust_to_a_few_wrong_frames() -> None:
    """Three of forty frames are off by 10 degrees and a tenth of the object; the others are exact in another frame."""
    truth = random_path(40)
    exact = reexpressed(truth)
    damage = torch.zeros(40, 6, dtype=torch.float64)
    damage[:3] = torch.tensor([0.1, 0.05, 0.2, 0.15, 0.13, 0.05])
    found = metrics.register(Trajectory(SE3.exp(damage) @ exact.T_cam_obj, "camera"), truth)
    known = metrics.align(exact, truth)
    assert float(angle_between(found.R_true_pred, known.R_true_pred)) < math.radians(0.02)  # a mean would be off by 0.9
    assert float(found.scale / known.scale) == pytest.approx(1, abs=1e-3)
    assert (found.shift - known.shift).abs().max() < 2e-3


def test_registration_needs_an_object_that_rotates() -> None:
    still = random_path(10).select([0] * 10)
    with pytest.raises(ValueError, match="hardly rotates"):
        metrics.register(still, still)
    slow = SO3.exp(torch.linspace(0, 1e-3, 10, dtype=torch.float64)[:, None] * torch.tensor([0.0, 1, 0]).double())
    path = Trajectory(SE3.from_rotation(slow, torch.tensor([0.0, 0, 4]).double()), "camera")
    with pytest.raises(ValueError, match="hardly rotates"):
        metrics.register(path, path)


def test_one_wrong_frame_affects_the_two_motions_before_and_after_it() -> None:
    """If frame 4 of 11 is rotated by 3 degrees or shifted by 0.2 in the camera frame, two of ten motions are wrong."""
    truth = random_path(11)
    offset = torch.zeros(11, 6, dtype=torch.float64)
    offset[4, 3] = math.radians(3)
    turned = Trajectory(SE3.exp(offset) @ truth.T_cam_obj, "camera")
    assert metrics.relative_scores(turned, truth, range(11), scale=1.0)["rpe_rotation_degrees"] == pytest.approx(0.6)
    offset = torch.zeros(11, 6, dtype=torch.float64)
    offset[4, 0] = 0.2
    shifted = Trajectory(SE3.exp(offset) @ truth.T_cam_obj, "camera")
    scores = metrics.relative_scores(shifted, truth, range(11), scale=1.0)
    assert scores["rpe_translation"] == pytest.approx(0.04)
    assert scores["rpe_rotation_degrees"] == pytest.approx(0, abs=1e-6)


def test_motions_across_a_lost_frame_are_left_out() -> None:
    truth = random_path(6)
    kept = [0, 1, 2, 4]
    offset = torch.zeros(4, 6, dtype=torch.float64)
    offset[3, 3] = math.radians(30)  # frame 4 has no neighbour, so its error has no effect
    predicted = Trajectory(SE3.exp(offset) @ truth.select(kept).T_cam_obj, "camera")
    scores = metrics.relative_scores(predicted, truth.select(kept), kept, scale=1.0)
    assert scores["rpe_rotation_degrees"] == pytest.approx(0, abs=1e-6)
    apart = metrics.relative_scores(truth.select([0, 2]), truth.select([0, 2]), [0, 2], scale=1.0)
    assert apart == {"rpe_translation": None, "rpe_rotation_degrees": None}


def looking_from(centres: Tensor) -> Trajectory:
    """Cameras at the given places, all with the object frame's axes."""
    n = len(centres)
    return Trajectory(SE3.from_rotation(SO3.identity((n,), dtype=torch.float64), -centres), "camera")


def test_camera_positions_on_a_line_determine_no_alignment() -> None:
    line = torch.linspace(0, 1, 10, dtype=torch.float64)[:, None] * torch.tensor([1.0, 2.0, 3.0])
    bent = line + 0.003 * torch.randn(10, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for centres in (line, bent, line[:1].expand(10, 3), line[:2]):
        with pytest.raises(ValueError, match="true camera positions"):
            metrics.align(looking_from(centres), looking_from(centres))
    with pytest.raises(ValueError, match="predicted camera positions"):
        metrics.align(looking_from(line), random_path(10))
    with pytest.raises(ValueError, match="predicted camera positions"):
        metrics.align(looking_from(line[:1].expand(10, 3)), random_path(10))


def test_a_similarity_and_its_inverse_cancel() -> None:
    path = random_path()
    alignment = metrics.align(reexpressed(path), path)
    again = alignment.to_prediction(alignment.to_truth(reexpressed(path)))
    torch.testing.assert_close(again.T_cam_obj.matrix(), reexpressed(path).T_cam_obj.matrix())


def test_true_views_in_the_predicted_frame_show_the_same_pixels() -> None:
    """A point of the object projects to the same pixel in either frame, as writers of predictions assume."""
    truth = random_path()
    alignment = metrics.align(reexpressed(truth), truth)
    x_pred = torch.randn(30, 3, generator=torch.Generator().manual_seed(4), dtype=torch.float64) * 0.1
    x_true = alignment.scale * (alignment.R_true_pred @ x_pred) + alignment.shift
    true_cam = truth.T_cam_obj @ x_true
    pred_cam = alignment.to_prediction(truth).T_cam_obj @ x_pred
    torch.testing.assert_close(pred_cam[:, :2] / pred_cam[:, 2:], true_cam[:, :2] / true_cam[:, 2:])


def test_psnr_of_nan_or_no_pixels_is_nan() -> None:
    x, everywhere = torch.full((2, 2, 3), 0.5), torch.ones(2, 2, dtype=torch.bool)
    assert math.isnan(metrics.psnr(x, x, ~everywhere))
    assert metrics.psnr(x, x, everywhere) == metrics.MAX_PSNR
    x[0, 0, 0] = math.nan
    assert math.isnan(metrics.psnr(x, torch.full_like(x, 0.5), everywhere))
