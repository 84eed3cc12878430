"""The highlight that is found by trying: exact on data that obey the model, and not fooled by what does not."""

import torch

from tumble.inverse_rendering import specular_fit
from tumble.inverse_rendering.specular_fit import Fit, Samples


def fit(samples: Samples, n: int) -> Fit:
    found = specular_fit.fit(samples, n, 0, 0.5)
    assert found is not None
    return found


def made(strength: float, *, true: int = 1, dark: float = 0.0, n: int = 200, per: int = 20) -> Samples:
    """Pixels of Gaussians with random albedos, a share of them black, under random light; lobes of three widths, of
    which one is true: a wider one is weaker at its peak and reaches further."""
    rng = torch.Generator().manual_seed(0)
    albedo = torch.rand(n, 3, generator=rng) * 0.6 * (torch.rand(n, 1, generator=rng) >= dark)
    gaussian = torch.arange(n).repeat_interleave(per)
    diffuse = 0.3 + 0.4 * torch.rand(n * per, 3, generator=rng)
    off = torch.rand(n * per, 1, generator=rng)
    specular = torch.stack(
        [0.05 / width * torch.exp(-((off / width) ** 2)) * torch.ones(3) for width in (0.3, 0.5, 0.8)]
    )
    return Samples(gaussian, diffuse, specular, albedo[gaussian] * diffuse + strength * specular[true])


def test_width_and_strength_of_a_made_highlight_are_found() -> None:
    for true, strength in ((0, 0.6), (1, 1.0), (1, 1.2), (2, 0.7)):
        found = fit(made(strength, true=true), 200)
        assert (found.which, found.strength) == (true, strength)


def test_a_tenth_of_wrong_pixels_hardly_matters() -> None:
    samples = made(1.0)
    wrong = torch.rand(len(samples.gaussian), generator=torch.Generator().manual_seed(1)) < 0.1
    samples.photograph[wrong] *= 0.3
    found = fit(samples, 200)
    assert found.which == 1
    assert abs(found.strength - 1.0) < 0.11  # a step of the grid


def test_noise_on_dark_print_does_not_pull_the_strength_down() -> None:
    """Half of the surface is black. Errors of light are a tenth: albedos that may not be negative would give 0.9."""
    samples = made(1.0, dark=0.5)
    noise = 1 + 0.3 * torch.randn(samples.photograph.shape, generator=torch.Generator().manual_seed(2))
    noisy = Samples(samples.gaussian, samples.diffuse, samples.specular, samples.photograph * noise.clamp(0.2))
    assert abs(fit(noisy, 200).strength - 1.0) < 0.06


def test_a_highlight_like_the_diffuse_light_tells_nothing() -> None:
    samples = made(1.0)
    even = Samples(samples.gaussian, samples.diffuse, 0.2 * samples.diffuse[None], samples.photograph)
    assert specular_fit.fit(even, 200, 0, 0.5) is None


def test_a_strength_beyond_all_that_are_tried_is_not_believed() -> None:
    assert specular_fit.fit(made(3.0), 200, 0, 0.5) is None


def test_what_is_hardly_better_is_not_believed() -> None:
    samples = made(1.0)
    noise = 1 + 0.1 * torch.randn(samples.photograph.shape, generator=torch.Generator().manual_seed(2))
    noisy = Samples(samples.gaussian, samples.diffuse, samples.specular, samples.photograph * noise)
    assert specular_fit.fit(noisy, 200, 1, 1.05) is None
    found = specular_fit.fit(noisy, 200, 1, 0.5)
    assert found is not None
    assert found.which == 1


def test_the_slope_keeps_what_the_pixels_show() -> None:
    """Where highlight and diffuse light are nearly proportional, taking one for the other changes pixels little."""
    samples = made(1.0)
    specular = 0.2 * samples.diffuse * (1 + 0.3 * (torch.arange(len(samples.gaussian)) % 2 - 0.5))[:, None]
    seen = 0.4 * samples.diffuse + specular
    both = Samples(samples.gaussian, samples.diffuse, torch.stack([specular, 2 * specular]), seen)
    found = fit(both, 201).slope
    torch.testing.assert_close(found[0, :200].mean(0), torch.full((3,), 0.2), atol=0.02, rtol=0)
    torch.testing.assert_close(found[1], 2 * found[0])
    assert (found[:, 200] == 0).all(), "no pixel shows the last one"
