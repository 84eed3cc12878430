"""Stage 3: division of the product of albedo and light. Whole runs are tested in `test_pipeline`."""

import math
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from tests import turning
from tests.inverse_rendering.test_refine import textured_sphere
from tests.learning.scene import CAPTURE
from tests.learning.true_asset import true_asset
from tests.surfaces import GAMMA, MAJOR, MINOR, sphere, torus
from tumble import recipes
from tumble.datasets import folder
from tumble.engine import loop, optim
from tumble.engine.loop import State
from tumble.inverse_rendering import decompose, refine, specular_fit
from tumble.inverse_rendering.pixel_sampling import PixelNumbers, pixels_per_step
from tumble.inverse_rendering.sh_lighting import SHLight
from tumble.io import tree
from tumble.rendering.shading import Bounce, Surface
from tumble.scene.capture import OBJECT, UNKNOWN, Capture
from tumble.scene.environment import Environment
from tumble.scene.material import DIELECTRIC, TEMPERATURE, Material
from tumble.scene.trajectory import Trajectory


def params(log_specular_scale: Tensor) -> decompose.Params:
    gaussians = sphere(20)
    material = Material.constant(20, torch.tensor([0.6, 0.3, 0.05]), 0.5)
    light = Environment.from_radiance(torch.tensor([1.0, 2.0, 0.5]).expand(8, 16, 3))
    no_pose, no_shift = torch.zeros(1, 6), torch.zeros(())
    return decompose.Params(gaussians, torch.tensor(30.0), material, light, no_pose, log_specular_scale, no_shift)


def colours(p: decompose.Params) -> tuple[Tensor, Tensor]:
    """Products of light with albedo and with F0, which determine the diffuse and the specular lobe."""
    light = p.environment.radiance[0, 0]
    return p.material.albedo[0, 0] * light, p.material.f0 * p.log_specular_scale.exp() * light


def test_the_colour_of_the_specular_scale_moves_into_the_light() -> None:
    """The specular lobe becomes grey under a light that is 3 times as bright in green and 1.5 times in red."""
    before = params(torch.tensor([1.5, 3.0, 0.5]).log())
    after = decompose.absorbed(before)
    for old, new in zip(colours(before), colours(after), strict=True):
        torch.testing.assert_close(new, old, rtol=1e-5, atol=0)
    assert after.material.f0.item() == pytest.approx(DIELECTRIC)
    torch.testing.assert_close(after.material.albedo[0, 0], torch.tensor([0.4, 0.1, 0.1]), rtol=1e-5, atol=0)


def test_an_object_without_a_specular_lobe_keeps_an_albedo_below_one() -> None:
    before = params(torch.full((3,), math.log(0.01)))
    after = decompose.absorbed(before)
    torch.testing.assert_close(colours(after)[0], colours(before)[0], rtol=1e-5, atol=0)
    # The lobe is too faint for its colour to be used: still 0.6, 0.3, 0.05, scaled to the largest allowed albedo.
    torch.testing.assert_close(after.material.albedo[0, 0], torch.tensor([0.9, 0.45, 0.075]), rtol=1e-5, atol=0)
    assert after.material.f0.item() < 0.1 * DIELECTRIC


QUICK = replace(recipes.known_poses(recipes.SMOKE).decompose, try_matte=False)


@pytest.mark.parametrize("first", [0.3, 0.8])
def test_the_first_state_has_the_lobes_of_stage_2_whatever_its_albedo(first: float) -> None:
    """What the albedo gains the light loses, and the specular scale gains."""
    inputs = turning.inputs("object", n=2)
    albedo, scale = torch.tensor([0.4, 0.2, 0.1]), torch.tensor(0.7)
    light = replace(inputs.refined.light, log_specular_scale=scale.log())
    refined = replace(inputs.refined, albedo=albedo.expand(400, 3), light=light)
    rates = replace(QUICK.rates, specular_scale=0.01)
    cfg = replace(QUICK, initial_albedo=first, visibility=False, bounce="none", rates=rates)
    state = decompose.init(cfg, replace(inputs, refined=refined), torch.Generator().manual_seed(0))
    torch.testing.assert_close(state.params.material.albedo[0, 0], albedo / 0.4 * first, rtol=1e-4, atol=0)
    # The light of stage 2 is 0.4 everywhere.
    for found, expected in zip(colours(state.params), (0.4 * albedo, 0.4 * DIELECTRIC * scale.expand(3)), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=0)


def recoloured(inputs: decompose.Inputs, where: Tensor, code: int) -> decompose.Inputs:
    """Inputs with other colours in some pixels of the photographs."""
    images = inputs.capture.images.clone()
    images[where] = code
    return replace(inputs, capture=replace(inputs.capture, images=images))


def loss_of_a_step(inputs: decompose.Inputs, metal_logits: Tensor | None = None) -> float:
    """Photometric term of a step on frame 0."""
    state = decompose.init(QUICK, inputs, torch.Generator().manual_seed(0))
    params = replace(state.params, material=replace(state.params.material, metal_logits=metal_logits))
    state.params, rates = optim.leaves(params), decompose.learning_rates(QUICK, params.material)
    state.optimizer = optim.adam(state.params, rates)
    return float(decompose.advance(QUICK, inputs, state, PixelNumbers(0, 0.5, 0, is_fixed=True))["render"])


def held(capture: Capture) -> Capture:
    """The capture with something unknown over the lower half of every image."""
    masks = capture.masks.clone()
    masks[:, masks.shape[1] // 2 :] = UNKNOWN
    return replace(capture, masks=masks)


def test_the_colours_of_a_hand_do_not_count() -> None:
    inputs = turning.inputs("object", n=2)
    inputs = replace(inputs, capture=held(inputs.capture))
    unknown, known = (inputs.capture.masks == label for label in (UNKNOWN, OBJECT))
    before, under_hand, on_object = (
        loss_of_a_step(each) for each in (inputs, recoloured(inputs, unknown, 255), recoloured(inputs, known, 255))
    )
    assert under_hand == before
    assert on_object > before + 0.1


def test_a_metalness_of_0_has_the_loss_of_an_object_without_metal() -> None:
    """Operations of torch shade the first, the kernel the second, both also pixels that the object covers in part."""
    inputs = turning.inputs("object", n=2)
    assert loss_of_a_step(inputs, torch.full((400,), -200.0)) == pytest.approx(loss_of_a_step(inputs), rel=1e-4)


def test_metal_lights_nothing_by_a_diffuse_lobe() -> None:
    inputs = turning.inputs("object", n=2)
    state = decompose.init(QUICK, inputs, torch.Generator().manual_seed(0))
    is_metal = torch.arange(400) < 100
    metal = torch.where(is_metal, 200.0, -200.0)
    params = replace(state.params, material=replace(state.params.material, metal_logits=metal))
    albedo = params.material.albedo.mean(1)
    bounce = decompose._bounce(QUICK, state, params, albedo)
    assert isinstance(bounce, Bounce)
    assert (bounce.albedo[is_metal] < 1e-6).all()
    assert torch.equal(bounce.albedo[~is_metal], albedo[~is_metal])


def test_lobes_are_fitted_to_the_radiance_inside_of_the_object_alone() -> None:
    """Pixels at the contour and beside unknown ones have another colour, which none of the samples has."""
    inputs = turning.inputs("object", n=2)
    inputs = replace(inputs, capture=held(inputs.capture))
    inner = np.stack([cv2.erode((m == OBJECT).astype(np.uint8), np.ones((3, 3))) for m in inputs.capture.masks.numpy()])
    painted = recoloured(inputs, torch.from_numpy(inner == 0), 20)
    painted = recoloured(painted, torch.from_numpy(inner > 0), 188)
    state = decompose.init(QUICK, painted, torch.Generator().manual_seed(0))
    photo = decompose._samples(QUICK, painted, state, state.rng, (0.5,))[0].photo
    assert len(photo) > 100
    linear = ((188 / 255 + 0.055) / 1.055) ** 2.4
    torch.testing.assert_close(photo, torch.full_like(photo, linear), rtol=1e-4, atol=0)


def test_the_smoothness_of_the_light_does_not_depend_on_its_scale() -> None:
    """Else it would decide how albedo and light share each colour. The paper's does, and grows with the square."""
    radiance = 0.1 + torch.rand(8, 16, 3, generator=torch.Generator().manual_seed(0))
    dim, bright = Environment.from_radiance(radiance), Environment.from_radiance(radiance * torch.tensor([3.0, 2, 0.5]))
    one, other = (decompose._light_smoothness(recipes.DRAFT.decompose, light) for light in (dim, bright))
    torch.testing.assert_close(one, other, rtol=1e-5, atol=0)
    tripled = Environment.from_radiance(3 * radiance)
    one, other = (decompose._light_smoothness(recipes.PAPER.decompose, light) for light in (dim, tripled))
    torch.testing.assert_close(other, 9 * one, rtol=1e-5, atol=0)


def test_traced_shadows_are_those_of_the_shaded_points() -> None:
    """Across the hole of a torus is its other side; from the inner rim obliquely upwards there is nothing."""
    gaussians, inner, outer = torus(4000), torch.tensor([MAJOR - MINOR, 0.0, 0.0]), torch.tensor([0.0, 0.0, 2.0])
    across, up = torch.tensor([-1.0, 0.0, 0.0]), torch.nn.functional.normalize(torch.tensor([-0.2, 0.0, 1.0]), dim=0)
    points = Surface(torch.arange(2), torch.stack([inner, outer]), torch.stack([across, up]), torch.zeros(2, 3))
    trained = replace(params(torch.zeros(3)), gaussians=gaussians, gamma=GAMMA)
    state = State(0, trained, None, torch.Generator(), {"directions": torch.stack([across, up])[None]})
    cfg = decompose.Config(shadows="traced", bounce="average", sets=1)
    # The Gaussian that a pixel shows does not count: both pixels show the same one, on the other side of the torus.
    index = (gaussians.means[:, 0] + 1).argmin().repeat(2)
    seen = decompose._pixel_visibility(cfg, state, trained, points, index)
    assert seen.unpacked().tolist() == [[False, True], [True, True]]
    blocker = seen.blocker
    assert blocker is not None
    assert gaussians.means[int(blocker[0, 0])][0] < -0.3


def test_checkpoints_have_no_blockers_which_are_computed_again_from_the_traced_geometry(tmp_path: Path) -> None:
    _, true, taken = textured_sphere()
    second, generator = refine.Inputs(taken, Trajectory(true, "camera")), torch.Generator().manual_seed(0)
    recipe = recipes.known_poses(recipes.SMOKE)
    start = refine.init(recipe.refine, second, generator)
    inputs = decompose.Inputs(taken, refine.finish(recipe.refine, second, start))
    cfg = replace(recipe.decompose, try_matte=False)
    state = decompose.init(cfg, inputs, generator)
    loop._save(state, tmp_path / "checkpoint", "", 0.0)
    names = {name.rpartition("/")[2] for name in loop._read(tmp_path / "checkpoint")[1]}
    blocked = state.memory.pop(decompose.BLOCKERS)
    assert names >= state.memory.keys()
    assert decompose.BLOCKERS not in names
    with torch.no_grad():
        state.params.gaussians.means.add_(0.1)  # as training does after visibility was traced
    found = decompose._cached_visibility(cfg, state).blocker
    assert found is not None
    assert torch.equal(found, blocked[0])
    assert (blocked >= 0).any()


@pytest.mark.parametrize(("part", "factor"), [(0.0, 1.0), (0.5, 2.0), (2.0, 1.0)])
def test_larger_images_have_more_pixels_in_a_step(part: float, factor: float) -> None:
    camera = folder.load(CAPTURE).camera
    assert pixels_per_step(100, round(part * min(camera.height, camera.width)), camera) == 100 * factor


def true_figure() -> decompose.Inputs:
    """The figure of `tests.learning` with its true shape and albedo."""
    asset, capture = true_asset(2500), folder.load(CAPTURE)
    assert capture.trajectory is not None
    light = SHLight.constant(0.4, asset.gamma)
    true = asset.material.albedo.mean(1)
    return decompose.Inputs(capture, refine.Refined(asset.gaussians, asset.gamma, true, light, capture.trajectory))


@pytest.mark.parametrize(
    ("glossy", "metal", "chosen"),
    [(0.94, 0.92, "metal"), (0.94, 0.935, "matte"), (0.92, 0.925, "glossy"), (0.92, 0.91, "metal")],
)
def test_metal_must_explain_as_much_as_a_lobe_must_and_more_than_it_does(
    glossy: float, metal: float, chosen: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Errors of the trials relative to that without a lobe; of the last ones, with less contrast, all are worse."""

    def tried(cfg: object, inputs: object, before: State, start: decompose.Params) -> tuple[State, float]:
        kind = "matte" if start.log_specular_scale.max() == decompose.NO_LOBE else "glossy"
        kind = kind if start.material.metal_logits is None else "metal"
        first = kind not in kinds
        kinds.append(kind)
        return replace(before, params=start), {"glossy": glossy, "matte": 1.0, "metal": metal}[kind] if first else 2.0

    kinds: list[str] = []
    inputs = true_figure()
    monkeypatch.setattr(decompose, "_trial", tried)
    monkeypatch.setattr(specular_fit, "metal_regions", lambda fitted, means: torch.ones(len(means), dtype=torch.bool))
    cfg = replace(recipes.DRAFT.decompose, sets=1, directions=32, pixels=64)
    decompose.init(cfg, inputs, torch.Generator().manual_seed(0))
    assert kinds == ["glossy", "matte", "metal", chosen]


@pytest.mark.parametrize(("metal", "is_metal"), [(0.5, True), (1.5, False)])
def test_a_resumed_run_repeats_no_trial_and_comes_to_the_same_bits(
    metal: float, is_metal: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also after a trial that adds parameters, those of metal. It stops after geometry has begun to move."""
    trial, step = decompose._trial, decompose.step

    def tried(cfg: decompose.Config, inputs: decompose.Inputs, before: State, start: decompose.Params) -> Any:
        """The true state of a trial; metal has this error, all other trials have an error of 1."""
        return trial(cfg, inputs, before, start)[0], 1.0 if start.material.metal_logits is None else metal

    def interrupted(cfg: decompose.Config, inputs: decompose.Inputs, state: State) -> Any:
        if state.step == 9:
            signal.raise_signal(signal.SIGINT)
        return step(cfg, inputs, state)

    def repeated(*_: Any) -> None:
        raise AssertionError("a resumed run tries out starts, or traces visibility, again")

    inputs, checkpoint = true_figure(), tmp_path / "state.safetensors"
    regions = torch.arange(len(inputs.refined.albedo)) % 2 == 0
    monkeypatch.setattr(specular_fit, "metal_regions", lambda fitted, means: regions)
    cfg = replace(recipes.DRAFT.decompose, steps=12, warmup=6, sets=2, directions=32, pixels=64)
    with monkeypatch.context() as patch:
        patch.setattr(decompose, "_trial", tried)
        whole = loop.drive(decompose, cfg, inputs, seed=1)
        patch.setattr(decompose, "step", interrupted)
        with pytest.raises(KeyboardInterrupt, match="stopped at step 10 of 12"):
            loop.drive(decompose, cfg, inputs, seed=1, checkpoint=checkpoint)
    for name in ("choose_start", "_trial", "surface_points"):
        monkeypatch.setattr(decompose, name, repeated)
    resumed = loop.drive(decompose, cfg, inputs, seed=1, checkpoint=checkpoint)
    assert (resumed.material.metal_logits is not None) == is_metal
    expected, found = tree.named_tensors(whole), tree.named_tensors(resumed)
    assert expected.keys() == found.keys()
    assert all(torch.equal(x, expected[name]) for name, x in found.items())


@pytest.mark.parametrize(("factor", "halvings"), [(0.0, 0), (0.5, 0), (0.25, 1), (0.125, 2)])
def test_large_images_are_made_smaller_for_the_trials(
    factor: float, halvings: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`side` is this fraction of the images' side; 0 never makes them smaller."""

    def tried(cfg: object, inputs: decompose.Inputs, before: State, start: object) -> tuple[State, float]:
        sides.append(inputs.capture.camera.width)
        return before, 1.0

    sides: list[int] = []
    inputs = true_figure()
    side = inputs.capture.camera.width
    monkeypatch.setattr(decompose, "_trial", tried)
    cfg = replace(recipes.DRAFT.decompose, sets=1, directions=32, pixels=64, side=round(factor * side))
    decompose.init(cfg, inputs, torch.Generator().manual_seed(0))
    assert set(sides) == {side // 2**halvings}


@pytest.mark.parametrize("exaggerated", [False, True])
def test_an_exaggerated_contrast_of_the_first_albedo_is_halved(exaggerated: bool) -> None:
    """The first albedo is the true one, or has twice its contrast."""
    inputs = true_figure()
    true = inputs.refined.albedo
    mean = true.log().mean(0).exp()
    cfg = replace(recipes.DRAFT.decompose, try_matte=False, steps=120, pixels=512, sets=2)
    state = decompose.init(cfg, inputs, torch.Generator().manual_seed(0))
    albedo = (true.square() / mean if exaggerated else true).clamp(1e-3, 0.99)
    logits = (TEMPERATURE * torch.logit(albedo))[:, None].repeat(1, 4, 1)
    material = replace(state.params.material, albedo_logits=logits)
    state.params = replace(state.params, material=material, environment=true_asset(2500).environment)
    chosen = decompose.choose_start(cfg, inputs, state).params.material.albedo.mean(1).detach()
    contrast = [float(x.log().std(0).mean()) for x in (true, chosen)]
    assert contrast[1] == pytest.approx(contrast[0], rel=0.25)
