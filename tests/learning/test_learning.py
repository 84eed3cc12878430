"""Stages 2 and 3 find albedo, normals, roughness and light of a scene whose ground truth comes from Mitsuba.

The scene is that of `scene`, the recipe `short.SHORT`. Measured with three seeds, and by averaging the photographs:

                          seed 0   seed 1   seed 2   average   bar
    albedo [dB]             24.8     24.9     24.8      17.4   24.6
    normals [degrees]       7.27     7.23     7.27       7.6    7.4
    roughness [RMSE]       0.200    0.204    0.205     0.224  0.215
    roughness, contrast    0.246    0.236    0.243         0    0.2
    light [RMSE]           0.345    0.346    0.359      1.15   0.39
    lamp [degrees]           2.8      3.0      3.0        88    3.5

A bar is the worst seed, less twice the difference between the best and the worst one, which is what another processor's
rounding may change. The true contrast is 0.45, and 0.225 is the best roughness error of any constant.

Broken on purpose, one at a time, each of these fails the test; `BROKEN` repeats it. Seen with seed 0 (all but the
shadow before the roughness of the object was one parameter, when the light had an error of 0.45):
    loss      stage 3 compares linear radiance with sRGB: contrast -0.01, light 0.95, lamp 9.2 degrees
    rotation  the light's rotation transposed in stages 2 and 3: albedo 16.9 dB, light 1.21, lamp 57 degrees
    shadow    visibility 1 everywhere in stages 2 and 3: albedo 23.1 dB, normals 7.8 degrees, light 0.40
    albedo    its gradient detached in stage 3: albedo 23.1 dB, roughness 0.223
    normals   no consistency of normals and depth in stage 2: normals 8.1 degrees
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.learning.scene import render
from tests.learning.short import SHORT, Errors, averaged, errors, run, scene
from tumble import pipeline, recipes
from tumble.datasets import folder
from tumble.evaluation import align_views, metrics
from tumble.inverse_rendering import decompose, losses, self_shadowing
from tumble.maths.images import to_srgb8
from tumble.scene import Trajectory

BAR = Errors(albedo=24.6, normal=7.4, roughness=0.215, contrast=0.2, light=0.39, lamp=3.5)
"""Least albedo and contrast, and largest of the other errors, of `SHORT`."""
POSES_BAR = Errors(albedo=25.3, normal=8.0, roughness=0.21, contrast=0.05, light=0.47, lamp=8.5)
"""Bar with estimated poses, on larger images."""
SCALED = {
    "standard": (1 / 20, replace(BAR, albedo=23.7, normal=7.5, lamp=6.5)),
    "paper": (1 / 100, replace(BAR, albedo=15.4, normal=40.0, lamp=14.0)),
}
"""Recipes by quality: the factor by which they are scaled down, and the bar. Seen with one seed: STANDARD 24.2 dB of
albedo, normals 7.1 degrees, lamp 4.5 degrees; PAPER 15.9 dB, 33 degrees, 11.2 degrees. Averaging on PAPER's shape has
15.0 dB: so few steps do not bring its sphere to the object. The bars leave 0.5 dB and 6 to 31 % of the angles.
Roughness and light have none: so few steps at unchanged rates hardly move them."""
GAIN = 7.0
"""Least albedo of `SHORT` above that of averaging [dB]; measured 7.3 with all three seeds, which differ by 0.1."""


def failures(found: Errors, bar: Errors = BAR) -> list[str]:
    """Names of the errors that miss their bar."""
    high = ("albedo", "contrast")
    better = {
        name: value > vars(bar)[name] if name in high else value < vars(bar)[name]
        for name, value in vars(found).items()
    }
    return [name for name, reached in better.items() if not reached]


def test_a_short_run_finds_albedo_normals_roughness_and_light() -> None:
    asset, refined = run(SHORT, seed=0)
    found, floor = errors(asset, *scene()), errors(averaged(refined), *scene())
    assert not failures(found), found
    assert found.albedo > floor.albedo + GAIN, floor


def linear_loss(patch: pytest.MonkeyPatch) -> None:
    """Stage 3 takes sRGB values for linear radiance."""
    right = losses.shading_term
    patch.setattr(
        losses, "shading_term", lambda view, pixels, photo, *x: right(view, pixels, to_srgb8(photo / 255), *x)
    )


def transposed_rotation(patch: pytest.MonkeyPatch) -> None:
    """The light turns the wrong way."""
    right = Trajectory.R_env_obj_at
    patch.setattr(Trajectory, "R_env_obj_at", lambda *arguments: right(*arguments).mT)


def no_shadow(patch: pytest.MonkeyPatch) -> None:
    """Every direction is visible from every point, and nothing lights anything else."""
    right = decompose.visibility

    def visible(*arguments: Any, blockers: bool = False) -> Any:
        traced = right(*arguments, blockers=blockers)
        blocker = None if traced.blocker is None else torch.full_like(traced.blocker, -1)
        return replace(traced, bits=torch.full_like(traced.bits, -1), blocker=blocker)

    for user in (self_shadowing, decompose):
        patch.setattr(user, "visibility", visible)


def detached_albedo(patch: pytest.MonkeyPatch) -> None:
    """Stage 3 keeps the albedo of stage 2."""
    right = decompose.corner_features

    def detached(material: Any) -> Any:
        corners, mean_albedo = right(material)
        return torch.cat([corners[..., :3].detach(), corners[..., 3:]], -1), mean_albedo.detach()

    patch.setattr(decompose, "corner_features", detached)


def no_normal_term(patch: pytest.MonkeyPatch) -> None:
    """Stage 2 without the consistency of normals and depth."""
    right = losses.image_terms

    def without(*arguments: Any, **settings: Any) -> dict[str, torch.Tensor]:
        terms = right(*arguments, **settings)
        return terms | {"normal": 0 * terms["normal"]}

    patch.setattr(losses, "image_terms", without)


BROKEN: dict[str, tuple[Callable[[pytest.MonkeyPatch], None], set[str]]] = {
    "loss": (linear_loss, {"contrast", "light", "lamp"}),
    "rotation": (transposed_rotation, {"albedo", "light", "lamp"}),
    "shadow": (no_shadow, {"albedo", "normal", "light"}),
    "albedo": (detached_albedo, {"albedo"}),
    "normals": (no_normal_term, {"normal"}),
}
"""Ways to break the method, and errors that must then miss their bar."""


@pytest.mark.slow
@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_method_misses_the_bars(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    broken, missed = BROKEN[name]
    broken(monkeypatch)
    found = errors(run(SHORT, seed=0)[0], *scene())
    assert missed <= set(failures(found)), found


@pytest.mark.slow
def test_the_committed_capture_is_what_the_script_renders(tmp_path: Path) -> None:
    """With fewer samples, whose noise is 1.5 code values; the motion is the same."""
    pytest.importorskip("mitsuba", reason="needs the extra `synth`")
    capture, made = scene()[0], folder.load(render(tmp_path / "capture", samples=64, truth_samples=1))
    assert made.trajectory is not None
    assert capture.trajectory is not None
    torch.testing.assert_close(made.trajectory.T_cam_obj.matrix(), capture.trajectory.T_cam_obj.matrix())
    assert (made.images.float() - capture.images.float()).abs().mean() < 2
    assert (made.masks != capture.masks).float().mean() < 2e-3


@pytest.mark.slow
def test_metal_is_recognised(tmp_path: Path) -> None:
    """The figure in metal. Seen with one seed: metalness 0.82, 21.8 dB of albedo."""
    pytest.importorskip("mitsuba", reason="needs the extra `synth`")
    path = render(tmp_path / "capture", samples=64, truth_samples=1, eval_sphere=0, material="metal")
    capture, truth = folder.load(path), folder.load_truth(path)
    assert truth is not None
    asset = run(SHORT, seed=0, capture=capture)[0]
    assert asset.material.metalness is not None
    assert asset.material.metalness.mean() > 0.7
    assert errors(asset, capture, truth).albedo > 20.5


@pytest.mark.slow
def test_estimated_poses_are_good_enough_to_learn(tmp_path: Path) -> None:
    """48 frames of 96 x 96 pixels, 5 to 12 degrees apart. Seen with two seeds: rotations 1.5 degrees off, albedo 26.2
    and 25.9 dB, normals 7.7 and 7.8 degrees, lamp 7.4 and 6.8 degrees; a bar is the worse one less twice the
    difference. Roughness is not found (RMSE 0.36 and 0.28, where a constant has 0.225), and has no bar."""
    pytest.importorskip("mitsuba", reason="needs the extra `synth`")
    path = render(tmp_path / "capture", resolution=96, views=48, stride=1, samples=256, truth_samples=1, pose_free=True)
    capture, truth = folder.load(path), folder.load_truth(path)
    assert truth is not None
    assert truth.poses is not None
    asset = pipeline.reconstruct(capture, recipe=SHORT)
    assert len(asset.trajectory) == len(capture)
    assert metrics.rotation_scores(asset.trajectory, truth.poses)["rotation_mean_degrees"] < 2
    alignment, _ = align_views(asset.trajectory, capture.names, capture, truth, known_poses=False)
    assert alignment is not None
    found = errors(asset, capture, truth, alignment)
    assert {"albedo", "normal", "lamp"}.isdisjoint(failures(found, POSES_BAR)), found


@pytest.mark.slow
@pytest.mark.parametrize("name", SCALED)
def test_a_scaled_recipe_learns(name: str) -> None:
    """With given poses; what `SCALED` says."""
    factor, bar = SCALED[name]
    found = errors(run(recipes.scaled(recipes.QUALITIES[name], factor), seed=0)[0], *scene())
    assert {"albedo", "normal", "lamp"}.isdisjoint(failures(found, bar)), found
