"""Division of each colour channel between albedo and light: planted factors are found, and pictures stay the same."""

import dataclasses
import math
from dataclasses import astuple

import pytest
import torch
from torch import Tensor

from tests.surfaces import GAMMA, look_at, sphere
from tumble.inverse_rendering import absolute_colour
from tumble.inverse_rendering.absolute_colour import ShadedPixels
from tumble.maths import SE3, SO3, fibonacci_sphere, srgb_from_linear
from tumble.rendering import render_gbuffer, shade_split, surface, unoccluded
from tumble.rendering.prefiltered_light import prefilter
from tumble.scene.asset import Asset
from tumble.scene.camera import Camera
from tumble.scene.capture import BACKGROUND, OBJECT, UNKNOWN, Capture
from tumble.scene.environment import Environment
from tumble.scene.material import DIELECTRIC, Material
from tumble.scene.trajectory import Trajectory

CAMERA = Camera(torch.tensor([40.0, 40.0, 16.0, 16.0]), 32, 32)
RED, GREY = (0.5, 0.2, 0.15), (0.35, 0.35, 0.35)


def pixels(albedo: tuple[float, ...], light: tuple[float, ...], lobe: float, k: tuple[float, ...]) -> ShadedPixels:
    """Pixels of a true albedo and light, as stage 3 sees them that takes the light for `k` times as bright.

    Args:
        lobe: Specular radiance relative to the light.
    """
    rng, factor = torch.Generator().manual_seed(0), torch.tensor(k)
    shade = 0.5 + torch.rand(4000, 1, generator=rng)
    true = torch.tensor(albedo) * (0.6 + 0.8 * torch.rand(4000, 1, generator=rng))
    return ShadedPixels(
        true / factor, shade * torch.tensor(light) * factor, lobe * shade * torch.tensor(light) * factor
    )


def colour(x: Tensor) -> Tensor:
    return x - x.mean()


def test_a_red_object_under_a_neutral_light_becomes_red_again() -> None:
    """Stage 3 gave half of the colour to the light; a Lambertian object has no highlight that says so."""
    k = (1.5, 0.8, 0.8)
    found = absolute_colour.estimate(pixels(RED, (1.0, 1.0, 1.0), 1e-4, k), 1e-4)
    planted = colour(torch.tensor(k).log())
    # The brightest paint, which is a brown in stage 3's result, holds back a fifth of it.
    assert 0.7 < float(colour(found.log_factor) @ planted / (planted @ planted)) < 1.1


def test_highlights_keep_the_colour_of_a_red_light() -> None:
    """A dark grey object with highlights that outshine it: they outweigh the prior of a neutral light."""
    light = (1.4, 1.0, 0.7)
    shiny = absolute_colour.estimate(pixels((0.03, 0.03, 0.03), light, 0.1, (1.0, 1.0, 1.0)), DIELECTRIC)
    assert colour(shiny.log_factor).abs().max() < 0.05
    # Without highlights either the light or the brightest paint has this colour.
    matte = absolute_colour.estimate(pixels(GREY, light, 1e-4, (1.0, 1.0, 1.0)), 1e-4)
    tint = colour(torch.tensor(light).log())
    assert 0.2 < float(colour(matte.log_factor) @ tint / (tint @ tint)) < 0.8


def test_a_known_white_determines_the_colour_and_no_brightness() -> None:
    light, target = (1.4, 1.0, 0.7), torch.tensor([0.3, -0.1, -0.2])
    shaded = pixels(RED, light, 1e-4, (1.0, 1.0, 1.0))
    free, known = (absolute_colour.estimate(shaded, 1e-4, white) for white in (None, target + 5))
    assert (colour(known.log_factor) - target).abs().max() < 0.03
    # With the colour known, the deviation is that of the brightness alone, which is the same for all channels.
    assert (known.deviation < free.deviation).all()
    assert float(known.deviation.max() - known.deviation.min()) < 0.01


def test_no_paint_is_brighter_than_white() -> None:
    """A black object with white print: its mean asks for four times the albedo, which the print does not allow."""
    white = (1.0, 1.0, 1.0)
    black, print_ = (pixels((x, x, x), white, 1e-4, white) for x in (0.02, 0.6))
    shaded = ShadedPixels(*(torch.cat([x, y[:200]]) for x, y in zip(astuple(black), astuple(print_), strict=True)))
    brightest = shaded.albedo.quantile(0.99, dim=0)
    found = absolute_colour.estimate(shaded, 1e-4)
    assert 0.9 < float((brightest * found.log_factor.exp()).max()) < 1.1
    # The limit is one-sided and makes nothing more certain.
    torch.testing.assert_close(found.deviation, absolute_colour.estimate(black, 1e-4).deviation, atol=0.01, rtol=0)


def test_highlights_make_the_estimate_more_certain_and_darker_objects_more_so() -> None:
    white = (1.0, 1.0, 1.0)
    none, some = (absolute_colour.estimate(pixels(GREY, white, lobe, white), DIELECTRIC) for lobe in (1e-4, 0.06))
    dark = absolute_colour.estimate(pixels((0.05, 0.05, 0.05), white, 0.06, white), DIELECTRIC)
    assert none.deviation.mean() > some.deviation.mean() > dark.deviation.mean()


def test_a_light_object_under_a_directional_light_stays_light() -> None:
    """Typical lightness would darken it by half; the scale of stage 3 counts the more, the more shading varies."""
    rng, white = torch.Generator().manual_seed(0), torch.full((4000, 3), 0.5)
    sunny, cloudy = (
        ShadedPixels(white, shade.expand(-1, 3), 1e-4 * shade.expand(-1, 3))
        for shade in (torch.rand(4000, 1, generator=rng), 0.9 + 0.2 * torch.rand(4000, 1, generator=rng))
    )
    kept, darkened = (float(absolute_colour.estimate(x, 0.024).log_factor.mean()) for x in (sunny, cloudy))
    assert -0.15 < kept < 0
    assert darkened < -0.4


def test_a_metal_has_the_reflectance_of_metals_and_no_highlight_tells_its_brightness() -> None:
    """A paint of this albedo, with highlights under a directional light, is darker, and its brightness better known."""
    rng, grey = torch.Generator().manual_seed(0), torch.full((4000, 3), 0.5)
    shade = torch.rand(4000, 1, generator=rng).expand(-1, 3)
    shaded = ShadedPixels(grey, shade, 0.1 * shade)
    paint, metal = (absolute_colour.estimate(shaded, DIELECTRIC, metalness=metalness) for metalness in (0.0, 1.0))
    torch.testing.assert_close(0.5 * metal.log_factor.exp(), torch.full((3,), 0.6), rtol=0.01, atol=0)
    assert (paint.log_factor < metal.log_factor - 0.1).all()
    # That of a typical object, which is all that is known of the metal's.
    assert float(metal.deviation.mean()) > absolute_colour.MEAN_ALBEDO_SD > 2 * float(paint.deviation.mean())


def test_of_an_object_that_no_frame_shows_nothing_is_changed() -> None:
    empty = torch.zeros(0, 3)
    found = absolute_colour.estimate(ShadedPixels(empty, empty, empty), DIELECTRIC)
    assert found.log_factor.tolist() == [0, 0, 0]


@pytest.fixture(scope="module")
def asset() -> Asset:
    """A sphere with a red and a green half, and light from one side, seen by two cameras."""
    gaussians = sphere(1500)
    material = Material.constant(1500, torch.tensor([0.5, 0.2, 0.1]), 0.4)
    logits = material.albedo_logits.clone()
    logits[gaussians.means[:, 0] > 0] = 2 * torch.logit(torch.tensor([0.1, 0.4, 0.3]))
    poses = [look_at([4.0, 0.5, 1.0]), look_at([-3.0, 2.0, 2.0])]
    trajectory = Trajectory(SE3(*(torch.stack([getattr(p, x) for p in poses]) for x in ("wxyz", "xyz"))), "camera")
    radiance = torch.linspace(0.2, 1.5, 16)[None, :, None] * torch.tensor([1.0, 0.8, 0.6]).expand(8, 16, 3)
    light = Environment.from_radiance(radiance)
    material = dataclasses.replace(material, albedo_logits=logits)
    return Asset(gaussians, GAMMA, material, light, trajectory, CAMERA)


@pytest.fixture(scope="module")
def capture(asset: Asset) -> Capture:
    images = torch.stack([(srgb_from_linear(picture(asset, i)).clamp(0, 1) * 255).round() for i in range(2)])
    masks = torch.where(images.amax(-1) > 0, OBJECT, BACKGROUND).to(torch.uint8)
    images[0, :6, :6] = torch.tensor([200.0, 180.0, 150.0])  # a card beside the object
    names = ("a.png", "b.png")
    return Capture(images.to(torch.uint8), masks, CAMERA, names, "camera", asset.trajectory)


def picture(asset: Asset, frame: int) -> Tensor:
    """Linear radiance of a frame without interreflections."""
    T_cam_obj = asset.trajectory.T_cam_obj[frame]
    view = render_gbuffer(asset, T_cam_obj, CAMERA)
    points = surface(view, T_cam_obj, CAMERA)
    maps = (points.sample(view.features[name]) for name in ("albedo", "roughness"))
    seen = unoccluded(fibonacci_sphere(64), len(points.pixels))
    R_env_obj = asset.trajectory.R_env_obj[frame]
    shaded = shade_split(points, *maps, prefilter(asset.environment), R_env_obj, seen, f0=asset.material.f0)
    return points.paint(shaded, 32, 32)


def test_the_factor_leaves_pictures_as_they_are(asset: Asset) -> None:
    """Of a matte object for any factor, of a glossy one for a grey factor: 1e-4 is rounding in logits."""
    dull = dataclasses.replace(asset, material=dataclasses.replace(asset.material, f0_logit=torch.tensor(-30.0)))
    tinted, grey = torch.tensor([0.4, -0.3, 0.1]), torch.full((3,), 0.3)
    for before, factor in ((dull, tinted), (asset, grey)):
        after = absolute_colour.apply(before, factor)
        ratio = after.material.albedo / before.material.albedo
        torch.testing.assert_close(ratio, factor.exp().expand_as(ratio), atol=0, rtol=1e-4)
        for frame in range(2):
            torch.testing.assert_close(picture(after, frame), picture(before, frame), atol=1e-5, rtol=1e-4)
    assert float(picture(dull, 0).max()) > 0.05


def test_pixels_of_a_hand_are_none_of_the_object(asset: Asset, capture: Capture) -> None:
    """All of the second frame is unknown: what is left are the pixels of the first one."""
    masks = capture.masks.clone()
    masks[1] = UNKNOWN
    first = dataclasses.replace(asset, trajectory=asset.trajectory.select([0]))
    alone = absolute_colour.shaded_pixels(first, capture.select([0]))
    found = absolute_colour.shaded_pixels(asset, dataclasses.replace(capture, masks=masks))
    assert len(found.albedo) > 100
    assert all(torch.equal(x, y) for x, y in zip(astuple(found), astuple(alone), strict=True))


def white_at(asset: Asset, capture: Capture, frame: int, place: int) -> torch.Tensor:
    shown = absolute_colour.code_values(capture.images[frame], place, place)
    return absolute_colour.known_white(asset, capture, frame, place, place, shown)


def test_a_light_that_turns_by_itself_is_taken_with_its_turns(asset: Asset, capture: Capture) -> None:
    """The same light on the object, once turned by the trajectory and once by the map."""
    turn = SO3.exp(torch.tensor([0.4, 1.1, -0.3])).matrix()
    uneven = dataclasses.replace(
        asset, environment=Environment.from_radiance(torch.linspace(0.1, 4, 16 * 32 * 3).reshape(16, 32, 3))
    )
    turned = dataclasses.replace(asset.trajectory, light_turns=turn.expand(len(capture), 3, 3))
    by_trajectory = dataclasses.replace(uneven, trajectory=turned)
    by_map = dataclasses.replace(uneven, environment=uneven.environment.rotated(turn.mT))
    pixels = [absolute_colour.shaded_pixels(each, capture).diffuse.mean(0) for each in (by_trajectory, by_map, uneven)]
    torch.testing.assert_close(pixels[0], pixels[1], rtol=0.05, atol=0)
    assert float((pixels[2] / pixels[1] - 1).abs().max()) > 0.1
    cards = [white_at(each, capture, 0, 2) for each in (by_trajectory, by_map)]
    torch.testing.assert_close(cards[0], cards[1], rtol=0, atol=0.05)


def test_a_pixel_on_the_object_is_made_neutral(asset: Asset, capture: Capture) -> None:
    target = white_at(asset, capture, 0, 16)
    after = absolute_colour.apply(asset, target - target.mean())
    shown = render_gbuffer(after, asset.trajectory.T_cam_obj[0], CAMERA).features["albedo"][16, 16]
    torch.testing.assert_close(shown, shown.mean().expand(3), rtol=0.02, atol=0)
    # The first camera looks at the green half, the other one at the red one.
    other = white_at(asset, capture, 1, 16)
    assert [int(target.argmin()), int(other.argmin())] == [1, 0]


def test_a_card_beside_the_object_is_lit_by_the_light_before_the_camera(asset: Asset, capture: Capture) -> None:
    """Under this light all irradiances are in the ratio 1 : 0.8 : 0.6."""
    target = white_at(asset, capture, 0, 2)
    card = (((torch.tensor([200.0, 180.0, 150.0]) / 255) + 0.055) / 1.055) ** 2.4
    expected = torch.tensor([1.0, 0.8, 0.6]).log() - card.log()
    torch.testing.assert_close(colour(target), colour(expected), atol=1e-4, rtol=0)


def test_a_black_pixel_is_no_white(asset: Asset, capture: Capture) -> None:
    with pytest.raises(ValueError, match="too dark or saturated"):
        absolute_colour.code_values(capture.images[0], 30, 30)


def test_the_estimate_undoes_a_planted_factor(asset: Asset, capture: Capture) -> None:
    """An asset whose light took half of the red: the same estimate but for this factor, as far as cues are absolute."""
    planted = torch.tensor([-0.3, 0.2, 0.1])
    moved = absolute_colour.apply(asset, planted)
    pictures = [absolute_colour.shaded_pixels(x, capture) for x in (asset, moved)]
    f0s = [float(x.material.f0) for x in (asset, moved)]
    one, other = (absolute_colour.estimate(x, f0).log_factor for x, f0 in zip(pictures, f0s, strict=True))
    # Highlights change their colour with the light, so that a part of the planted factor counts as theirs.
    assert float((one - other) @ planted / (planted @ planted)) > 0.7
    assert math.isfinite(float(other.sum()))
