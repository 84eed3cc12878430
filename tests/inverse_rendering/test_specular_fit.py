"""Specular scale by least squares, and the roughness of the object by gradient descent and trials of regions."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.learning.scene import CAPTURE
from tests.learning.true_asset import true_asset
from tumble.datasets import folder
from tumble.inverse_rendering import decompose, specular_fit
from tumble.inverse_rendering.refine import Refined
from tumble.inverse_rendering.sh_lighting import SHLight
from tumble.inverse_rendering.specular_fit import Samples
from tumble.recipes import DRAFT
from tumble.rendering import render_gbuffer
from tumble.scene import OBJECT, TEMPERATURE, UNKNOWN, Asset, Capture


def found_roughness(cfg: decompose.Config, asset: Asset, capture: Capture) -> Tensor:
    """Roughness of each Gaussian after stage 3, with the true shape, albedo and light."""
    assert capture.trajectory is not None
    albedo, light = asset.material.albedo.mean(1), SHLight.constant(0.4, asset.gamma)
    refined = Refined(asset.gaussians, asset.gamma, albedo, light, capture.trajectory)
    brightest = float(albedo.amax(-1).quantile(0.95))
    cfg = replace(cfg, initial_albedo=brightest)  # as true as the light
    inputs = decompose.Inputs(capture, refined)
    state = decompose.init(cfg, inputs, torch.Generator().manual_seed(0))
    state.params = replace(state.params, environment=asset.environment)
    for state.step in range(cfg.steps):
        decompose.step(cfg, inputs, state)
    return decompose.absorbed(state.params).material.roughness.detach().mean(1)


QUICK = replace(
    DRAFT.decompose,
    try_matte=False,
    region_trials=0,
    steps=150,
    warmup=150,
    pixels=512,
    sets=2,
    rates=replace(DRAFT.decompose.rates, light=0.0),
)


@pytest.mark.parametrize(("glossy", "true"), [(True, 0.25), (False, 0.7)])
def test_the_roughness_of_mitsubas_images_is_found(glossy: bool, true: float) -> None:
    """The figure of `tests.learning` with its true shape, albedo and light, from roughness 0.5 in few steps. Its body
    has 0.25, the rest 0.7, and only one of the two is shown. Seen: 0.37 and 0.59."""
    asset, taken = true_asset(2500), folder.load(CAPTURE)
    assert taken.trajectory is not None
    masks = []
    for i in range(len(taken)):
        roughness = render_gbuffer(asset, taken.trajectory.T_cam_obj[i], taken.camera).features["roughness"]
        shown = (roughness[..., 0] < 0.4) if glossy else (roughness[..., 0] > 0.55)
        masks.append(torch.where(shown & (taken.masks[i] == OBJECT), OBJECT, UNKNOWN).to(torch.uint8))
    found = float(found_roughness(QUICK, asset, replace(taken, masks=torch.stack(masks))).mean())
    assert abs(found - true) < 0.15, found


def test_trials_of_regions_tell_the_roughnesses_of_parts_apart() -> None:
    """The whole figure, whose parts differ by 0.45 in truth."""
    asset, capture = true_asset(2500), folder.load(CAPTURE)
    is_glossy = asset.material.roughness.mean(1) < 0.475
    contrast = {}
    for trials in (0, 2):
        found = found_roughness(replace(QUICK, region_trials=trials), asset, capture)
        contrast[trials] = float(found[~is_glossy].mean() - found[is_glossy].mean())
    assert contrast[2] > contrast[0] + 0.1, contrast


def lobes_of_two_halves(first: float, second: float, n: int = 200, per: int = 20) -> list[Samples]:
    """Pixels of a row of Gaussians whose halves have these roughnesses, with lobes that widen with the roughness."""
    rng = torch.Generator().manual_seed(0)
    gaussian, angle = torch.arange(n).repeat_interleave(per), torch.rand(n * per, 1, generator=rng)
    albedo, diffuse = torch.rand(n, 3, generator=rng) * 0.6, 0.3 + 0.4 * torch.rand(n * per, 3, generator=rng)

    def lobe(roughness: Tensor | float) -> Tensor:
        width = torch.as_tensor(roughness) ** 2
        return (0.05 / width * (-((angle / width) ** 2)).exp()).expand(-1, 3)

    true = torch.where(gaussian < n // 2, first, second)[:, None]
    photo = albedo[gaussian] * diffuse + lobe(true)
    return [Samples(gaussian, diffuse, lobe(r), photo) for r in specular_fit.ROUGHNESSES]


def test_regions_have_their_own_roughness(monkeypatch: pytest.MonkeyPatch) -> None:
    """And the mean over all pixels is kept, also where no pixel shows a Gaussian."""
    monkeypatch.setattr(specular_fit, "NEIGHBOURS", 9)
    means, albedo = torch.arange(201)[:, None] * torch.tensor([1.0, 0.5, -0.2]), torch.full((201, 3), 0.5)
    before = torch.full((201,), 0.4)
    logits = specular_fit.of_regions(lobes_of_two_halves(0.3, 0.6), means, albedo, before)
    assert logits is not None
    torch.testing.assert_close(logits[:200].mean(), before.mean())
    assert logits[200] == before[200]
    apart = TEMPERATURE * (math.log(0.6 / 0.4) - math.log(0.3 / 0.7))
    assert float(logits[105:200].mean() - logits[:95].mean()) == pytest.approx(apart, rel=0.1)


def test_an_object_of_one_roughness_has_no_regions(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(specular_fit, "NEIGHBOURS", 9)
    means, albedo = torch.arange(200)[:, None] * torch.tensor([1.0, 0.5, -0.2]), torch.full((200, 3), 0.5)
    assert specular_fit.of_regions(lobes_of_two_halves(0.4, 0.4), means, albedo, torch.zeros(200)) is None


def random_samples(scale: float, dark: float = 0.0, n: int = 200, per: int = 20) -> tuple[Samples, Tensor]:
    """Pixels of `n` Gaussians of random albedos, a part `dark` of them black, and how bright their lobes are."""
    rng = torch.Generator().manual_seed(0)
    albedo = torch.rand(n, 3, generator=rng) * 0.6 * (torch.rand(n, 1, generator=rng) >= dark)
    gaussian = torch.arange(n).repeat_interleave(per)[torch.randperm(n * per, generator=rng)]
    ratio = 0.1 + 0.4 * torch.rand(n, 1, generator=rng)
    diffuse, glint = 0.3 + 0.4 * torch.rand(n * per, 3, generator=rng), torch.rand(n * per, 1, generator=rng)
    specular = ratio[gaussian] * diffuse * (0.5 + glint)
    return Samples(gaussian, diffuse, specular, albedo[gaussian] * diffuse + scale * specular), ratio


@pytest.mark.parametrize("part", [0.0, 0.4, 1.0])
def test_regions_of_metal_are_found(part: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Metal mirrors light in its own colour and has no diffuse lobe. Of 200 Gaussians in a row, the first are metal."""
    samples, _ = random_samples(1.0)
    colour = samples.photo.new_tensor([0.9, 0.6, 0.2]) / 0.3
    is_metal = torch.arange(200) < 200 * part
    photo = torch.where(is_metal[samples.gaussian, None], colour * samples.specular, samples.photo)
    noise = 1 + 0.05 * torch.randn(photo.shape, generator=torch.Generator().manual_seed(2))
    fitted = specular_fit.fit(replace(samples, photo=photo * noise), 200)
    monkeypatch.setattr(specular_fit, "NEIGHBOURS", 9)
    row = torch.arange(200)[:, None] * torch.tensor([1.0, 0.5, -0.2])
    assert (specular_fit.metal_regions(fitted, row) == is_metal).float().mean() > 0.95


@pytest.mark.parametrize("scale", [0.3, 1.7])
def test_the_scale_is_found_in_spite_of_a_tenth_of_outliers(scale: float) -> None:
    samples, _ = random_samples(scale)
    outlier = torch.rand(len(samples.gaussian), generator=torch.Generator().manual_seed(1)) < 0.1
    samples.photo[outlier] *= 0.3
    assert specular_fit.fit(samples, 200).specular_scale == pytest.approx(scale, rel=0.03)


def test_noise_on_dark_texture_hardly_biases_the_scale() -> None:
    """Half of the surface is black, and the noise is multiplicative."""
    samples, _ = random_samples(1.0, dark=0.5)
    noise = 1 + 0.2 * torch.randn(samples.photo.shape, generator=torch.Generator().manual_seed(2))
    noisy = replace(samples, photo=samples.photo * noise.clamp(0.2))
    assert specular_fit.fit(noisy, 200).specular_scale == pytest.approx(1, abs=0.08)


def test_albedo_per_scale_is_the_mean_ratio_of_the_lobes() -> None:
    """Their ratio in a pixel is 0.5 to 1.5 times that of the Gaussian."""
    samples, ratio = random_samples(1.0)
    samples.photo[samples.gaussian == 3] = 1.0  # clipped
    found = specular_fit.fit(samples, 201).albedo_per_scale
    assert ((found[:200] / ratio)[ratio[:, 0] != ratio[3, 0]] - 1).abs().mean() < 0.1
    assert (found[[3, 200]] == 0).all(), "no usable pixel shows them"
