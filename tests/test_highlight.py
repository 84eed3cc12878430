"""The closed-form highlight: exact on data that obey the model, and not fooled by what does not."""

import torch

from tumble import highlight
from tumble.highlight import Fit, Samples


def fit(samples: Samples, n: int) -> Fit:
    found = highlight.fit(samples, n)
    assert found is not None
    return found


def made(strength: torch.Tensor, n: int = 200, per: int = 20) -> Samples:
    """Pixels of Gaussians with random albedos, seen under random light, as the model has them."""
    rng = torch.Generator().manual_seed(0)
    albedo = torch.rand(n, 3, generator=rng) * 0.6
    gaussian = torch.arange(n).repeat_interleave(per)
    diffuse = 0.3 + 0.4 * torch.rand(n * per, 3, generator=rng)
    specular = 0.1 * torch.rand(n * per, 1, generator=rng) ** 2 * torch.ones(3)
    return Samples(gaussian, diffuse, specular, albedo[gaussian] * diffuse + strength * specular)


def test_the_strength_of_a_made_highlight_is_found() -> None:
    truth = torch.tensor([0.7, 1.0, 1.4])
    found = fit(made(truth), 200).strength
    # Exact data: what is left is the pull of the channels' common strength, which falls with the reweighting.
    torch.testing.assert_close(found, truth, atol=0.1, rtol=0)
    even = torch.full((3,), 1.3)
    torch.testing.assert_close(fit(made(even), 200).strength, even, atol=1e-3, rtol=0)


def test_a_tenth_of_wrong_pixels_hardly_matters() -> None:
    samples, truth = made(torch.ones(3)), torch.ones(3)
    wrong = torch.rand(len(samples.gaussian), generator=torch.Generator().manual_seed(1)) < 0.1
    samples.photograph[wrong] *= 0.3
    torch.testing.assert_close(fit(samples, 200).strength, truth, atol=0.05, rtol=0)


def test_a_surface_without_highlight_gets_next_to_none() -> None:
    assert (fit(made(torch.zeros(3)), 200).strength < 0.03).all()


def test_a_highlight_like_the_diffuse_light_tells_nothing() -> None:
    samples = made(torch.ones(3))
    even = Samples(samples.gaussian, samples.diffuse, 0.2 * samples.diffuse, samples.photograph)
    assert highlight.fit(even, 200) is None


def test_the_slope_keeps_what_the_pixels_show() -> None:
    """Where highlight and diffuse light are nearly proportional, taking one for the other changes pixels little."""
    samples = made(torch.ones(3))
    specular = 0.2 * samples.diffuse * (1 + 0.3 * (torch.arange(len(samples.gaussian)) % 2 - 0.5))[:, None]
    found = fit(Samples(samples.gaussian, samples.diffuse, specular, samples.photograph), 201).slope
    torch.testing.assert_close(found[:200].mean(0), torch.full((3,), 0.2), atol=0.02, rtol=0)
    assert (found[200] == 0).all(), "no pixel shows the last one"
