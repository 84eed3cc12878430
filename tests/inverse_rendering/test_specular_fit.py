"""Grid search of the specular lobe: exact on data of the model, robust to outliers, None if not determined."""

import torch

from tumble.inverse_rendering import specular_fit
from tumble.inverse_rendering.specular_fit import Samples, SpecularFit


def fit(samples: Samples, n: int) -> SpecularFit:
    best = specular_fit.fit(samples, n, 0, 0.5)
    assert best is not None
    return best


def synthetic_samples(scale: float, *, true: int = 1, dark: float = 0.0, n: int = 200, per: int = 20) -> Samples:
    """Pixels of Gaussians with random albedos, a fraction `dark` of them black, under random light.

    There are candidate lobes of three widths, of which number `true` is the true one; wider lobes have lower peaks.
    """
    rng = torch.Generator().manual_seed(0)
    albedo = torch.rand(n, 3, generator=rng) * 0.6 * (torch.rand(n, 1, generator=rng) >= dark)
    gaussian = torch.arange(n).repeat_interleave(per)
    diffuse = 0.3 + 0.4 * torch.rand(n * per, 3, generator=rng)
    off = torch.rand(n * per, 1, generator=rng)
    specular = torch.stack(
        [0.05 / width * torch.exp(-((off / width) ** 2)) * torch.ones(3) for width in (0.3, 0.5, 0.8)]
    )
    return Samples(gaussian, diffuse, specular, albedo[gaussian] * diffuse + scale * specular[true])


def test_the_true_roughness_and_scale_are_found() -> None:
    for true, scale in ((0, 0.6), (1, 1.0), (1, 1.2), (2, 0.7)):
        found = fit(synthetic_samples(scale, true=true), 200)
        assert (found.roughness_index, found.specular_scale) == (true, scale)


def test_a_tenth_of_outliers_hardly_affects_the_fit() -> None:
    samples = synthetic_samples(1.0)
    outlier = torch.rand(len(samples.gaussian), generator=torch.Generator().manual_seed(1)) < 0.1
    samples.photo[outlier] *= 0.3
    found = fit(samples, 200)
    assert found.roughness_index == 1
    assert abs(found.specular_scale - 1.0) < 0.11  # a step of the grid


def test_noise_on_dark_texture_does_not_bias_the_scale() -> None:
    """Half of the surface is black, and the noise is multiplicative: non-negative albedos would give a scale of 0.9."""
    samples = synthetic_samples(1.0, dark=0.5)
    noise = 1 + 0.3 * torch.randn(samples.photo.shape, generator=torch.Generator().manual_seed(2))
    noisy = Samples(samples.gaussian, samples.diffuse, samples.specular, samples.photo * noise.clamp(0.2))
    assert abs(fit(noisy, 200).specular_scale - 1.0) < 0.06


def test_a_specular_lobe_proportional_to_the_diffuse_lobe_is_rejected() -> None:
    samples = synthetic_samples(1.0)
    proportional = Samples(samples.gaussian, samples.diffuse, 0.2 * samples.diffuse[None], samples.photo)
    assert specular_fit.fit(proportional, 200, 0, 0.5) is None


def test_an_optimum_at_the_end_of_the_grid_is_rejected() -> None:
    assert specular_fit.fit(synthetic_samples(3.0), 200, 0, 0.5) is None


def test_a_small_improvement_is_rejected() -> None:
    samples = synthetic_samples(1.0)
    noise = 1 + 0.1 * torch.randn(samples.photo.shape, generator=torch.Generator().manual_seed(2))
    noisy = Samples(samples.gaussian, samples.diffuse, samples.specular, samples.photo * noise)
    assert specular_fit.fit(noisy, 200, 1, 1.05) is None
    found = specular_fit.fit(noisy, 200, 1, 0.5)
    assert found is not None
    assert found.roughness_index == 1


def test_albedo_per_scale_preserves_the_radiance_of_the_pixels() -> None:
    """For nearly proportional lobes, an exchange of one for the other hardly changes the pixels."""
    samples = synthetic_samples(1.0)
    specular = 0.2 * samples.diffuse * (1 + 0.3 * (torch.arange(len(samples.gaussian)) % 2 - 0.5))[:, None]
    photo = 0.4 * samples.diffuse + specular
    both = Samples(samples.gaussian, samples.diffuse, torch.stack([specular, 2 * specular]), photo)
    found = fit(both, 201).albedo_per_scale
    torch.testing.assert_close(found[0, :200].mean(0), torch.full((3,), 0.2), atol=0.02, rtol=0)
    torch.testing.assert_close(found[1], 2 * found[0])
    assert (found[:, 200] == 0).all(), "no pixel shows the last Gaussian"
