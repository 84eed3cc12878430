"""Recipes: PAPER has the paper's numbers, and a scaled recipe still learns."""

import itertools
import math
import signal
from dataclasses import replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.poses.progressive.test_tracker import INPUTS, TRUTH
from tumble import recipes
from tumble.engine.loop import drive
from tumble.inverse_rendering import decompose, refine
from tumble.io import tree
from tumble.maths.se3 import SE3
from tumble.poses.progressive import stage as progressive
from tumble.poses.sfm import stage as sfm
from tumble.scene import DIELECTRIC, TEMPERATURE, Trajectory

PRINTED = [
    # Quantity, value in the paper, where it stands, attribute of recipes.PAPER.
    ("stage 1: warm-up from the first frame [steps]", 100, "appendix A, stage 1", "track.warmup"),
    ("stage 1: pose of a frame alone [steps]", 500, "appendix A, stage 1", "track.pose_steps"),
    ("stage 1: pose and geometry of a frame [steps]", 500, "appendix A, stage 1", "track.joint_steps"),
    ("stage 1: samples along a ray", 32, "appendix A, stage 1", "track.samples"),
    ("stage 1: learning rate of the pose networks", 0.0005, "appendix A, stage 1", "track.rates.poses"),
    ("stage 1: weight of the photometric loss", 1.0, "eq. 6", "track.weights.render"),
    ("stage 1: weight of the eikonal loss", 0.1, "appendix A, stage 1", "track.weights.eikonal"),
    ("stage 1: weight of the mask loss", 5.0, "appendix A, stage 1", "track.weights.mask"),
    ("stage 1: weight of the match loss", 0.1, "appendix A, stage 1", "track.weights.match"),
    ("stage 1: pose parametrisation", "mlps", "section 4.1, a network per frame", "track.poses"),
    ("stage 1: initial pose of a frame", "still", "section 4.1, that of the frame before", "track.motion"),
    ("stage 1: first frame", "first", "appendix A, stage 1", "track.start"),
    ("stage 1: rotation between resets [degrees]", 60.0, "section 4.1, that of FMOV", "track.reset"),
    ("stage 2: lift to six degrees of freedom", "pnp", "section 4.2, RANSAC EPnP", "track.lift"),
    ("stage 2: initial surface", "sphere", "appendix A, stage 2", "refine.start"),
    ("stage 2: colour", "sh", "section 4.2, harmonics per Gaussian", "refine.colour"),
    ("stage 2: steps", 150_000, "appendix A, stage 2", "refine.steps"),
    ("stage 2: pose corrections", "network", "section 4.2, one network over embeddings", "refine.pose_model"),
    ("stage 2: alignments of poses beside the network", 0, "section 4.2", "refine.realignments"),
    ("stage 2: learning rate of centres, of 3DGS", 1.6e-4 * 5, "appendix A, stage 2", "refine.rates.means"),
    ("stage 2: decay of that rate, of 3DGS", 0.01, "appendix A, stage 2", "refine.rates.decay"),
    ("stage 2: decay of other rates, of 3DGS", 1.0, "appendix A, stage 2", "refine.rates.others_decay"),
    ("stage 2: learning rate of rotations, of 3DGS", 0.001, "appendix A, stage 2", "refine.rates.quats"),
    ("stage 2: learning rate of scales, of 3DGS", 0.005, "appendix A, stage 2", "refine.rates.log_scales"),
    ("stage 2: learning rate of harmonics, of 3DGS", 0.0025, "appendix A, stage 2", "refine.rates.sh"),
    ("stage 2: the same from degree 1, of 3DGS", 0.000125, "appendix A, stage 2", "refine.rates.sh_rest"),
    (
        "stage 2: steps until the next degree of harmonics, of 3DGS",
        1_000,
        "appendix A, stage 2",
        "refine.harmonics_every",
    ),
    ("stage 2: steps between densifications, of FastGS", 500, "section 4.2", "refine.densification.refine_every"),
    ("stage 2: end of them after 15,000 steps, of FastGS", 0.1, "section 4.2", "refine.densification.refine_stop"),
    ("stage 2: views that are scored, of FastGS", 10, "section 4.2", "refine.densification.score_views"),
    ("stage 2: score for growth, of FastGS", 5.0, "section 4.2", "refine.densification.grow_score"),
    ("stage 2: gradient for growth, of 3DGS", 2e-4, "section 4.2", "refine.densification.fastgs.gradient"),
    ("stage 2: steps between resets, of FastGS", 3_000, "section 4.2", "refine.densification.fastgs.reset_every"),
    ("stage 2: weight of the normal loss", 0.05, "appendix A, stage 2", "refine.weights.normal"),
    ("stage 2: weight of the depth variance", 1.0, "appendix A, stage 2", "refine.weights.variance"),
    ("stage 2: weight of the rank loss", 0.1, "appendix A, stage 2", "refine.weights.rank"),
    ("stage 2: weight of the gamma loss", 5.0, "appendix A, stage 2", "refine.weights.gamma"),
    ("stage 2: weight of the projection loss", 1.0, "appendix A, stage 2", "refine.weights.proj"),
    ("stage 2: weight of the mask loss", 1.0, "appendix A, stage 2", "refine.weights.mask"),
    ("stage 2: other terms", 0.0, "eq. 11", "refine.weights.specular"),
    ("stage 2: saturation of the normal loss", 0.0, "section 4.2", "refine.crease"),
    ("stage 3: warm-up before geometry and poses [steps]", 5_000, "appendix A, stage 3", "decompose.warmup"),
    ("stage 3: steps", 150_000, "appendix A, stage 3", "decompose.steps"),
    ("stage 3: learning rate of the albedo", 0.025, "appendix A, stage 3", "decompose.rates.albedo"),
    ("stage 3: learning rate of the roughness", 0.025, "appendix A, stage 3", "decompose.rates.roughness"),
    ("stage 3: learning rate of the light", 0.01, "appendix A, stage 3", "decompose.rates.light"),
    ("stage 3: learning rate of F0", 0.0, "section 4.3, F0 = 0.04", "decompose.rates.specular_scale"),
    ("stage 3: first rows of the light", 16, "appendix A, stage 3", "decompose.rows"),
    ("stage 3: doublings to 1024 rows", math.log2(1024 / 16), "appendix A, stage 3", "decompose.doublings"),
    ("stage 3: Fibonacci directions", 512, "appendix A, stage 3", "decompose.directions"),
    ("stage 3: patterns of directions", 1, "section 4.3, a fixed pattern", "decompose.sets"),
    ("stage 3: weight of the light's smoothness", 0.05, "appendix A, stage 3", "decompose.weights.light"),
    ("stage 3: weight of the material's smoothness", 0.25, "appendix A, stage 3", "decompose.weights.material"),
    ("stage 3: weight of a mask loss", 0.0, "eq. 14", "decompose.weights.mask"),
    ("stage 3: other terms", 0.0, "eq. 14", "decompose.weights.specular"),
    ("stage 3: trial without a specular lobe", False, "section 4.3", "decompose.try_matte"),
    ("stage 3: common shift of the roughness", 0.0, "section 4.3", "decompose.rates.roughness_shift"),
    ("stage 3: material at the corners of a Gaussian", True, "section 4.3", "decompose.corners"),
    ("stage 3: self-occlusion", True, "section 4.3", "decompose.visibility"),
    ("stage 3: shadows at the shaded points", "traced", "section 4.3", "decompose.shadows"),
    ("stage 3: both lobes summed over the directions", "sum", "section 4.3", "decompose.lobes"),
    ("stage 3: indirect light from the colours of stage 2", "average", "section 4.3", "decompose.bounce"),
    ("relighting: samples of the BRDF", 512, "appendix A, stage 3", "relight.brdf_samples"),
    ("relighting: samples of the light", 512, "appendix A, stage 3", "relight.light_samples"),
]


@pytest.mark.parametrize(("quantity", "value", "where", "path"), PRINTED, ids=[row[3] for row in PRINTED])
def test_the_paper_recipe_has_the_numbers_of_the_paper(quantity: str, value: Any, where: str, path: str) -> None:
    assert attrgetter(path)(recipes.PAPER) == pytest.approx(value), f"{quantity} ({where})"


def test_constants_of_the_paper_that_no_recipe_changes() -> None:
    assert TEMPERATURE == 2.0  # appendix A, stage 3: sigmoids of albedo and roughness
    assert DIELECTRIC == 0.04  # section 4.3: F0


CLOSE = Trajectory(SE3.exp(torch.full((6,), 0.01)) @ TRUTH, "camera")
"""Poses with errors, for the networks to correct."""


def losses_of(stage: Any, cfg: Any, inputs: Any) -> tuple[list[float], Any]:
    """The photometric term of every step that has one, and the output of the stage."""
    state, seen = stage.init(cfg, inputs, torch.Generator().manual_seed(0)), []
    for _ in range(stage.length(cfg, inputs)):
        terms = stage.step(cfg, inputs, state)
        seen += [float(terms["render"])] if "render" in terms else []
        state.step += 1
    return seen, stage.finish(cfg, inputs, state)


def fell_to(losses: list[float]) -> float:
    """Mean of the last fifth over mean of the first tenth."""
    n = len(losses)
    return sum(losses[-(n // 5) :]) / (n // 5) / (sum(losses[: n // 10]) / (n // 10))


def test_the_scaled_paper_recipe_learns_in_every_stage() -> None:
    """From five frames of a textured sphere, without its poses, to an asset, whose poses moved in stages 2 and 3."""
    track, recipe = recipes.scaled(recipes.PAPER, 1 / 100).track, recipes.scaled(recipes.PAPER, 1 / 2000)
    seen = sfm.gather(INPUTS.capture, INPUTS.matches)
    inputs = progressive.gather(INPUTS.capture, INPUTS.matches, partial(sfm.assess, seen), seen.failed)
    losses, tracked = losses_of(progressive, track, inputs)
    # Seen: 0.61, 0.61 and 0.65; a stage that does not learn stays at 1.
    assert fell_to(losses) < 0.8
    losses, refined = losses_of(refine, recipe.refine, refine.Inputs(INPUTS.capture, tracked.trajectory))
    assert fell_to(losses) < 0.8
    assert not torch.allclose(refined.trajectory.T_cam_obj.xyz, tracked.trajectory.T_cam_obj.xyz, atol=1e-4)
    losses, asset = losses_of(decompose, recipe.decompose, decompose.Inputs(INPUTS.capture, refined))
    assert fell_to(losses) < 0.8
    assert not torch.allclose(asset.trajectory.T_cam_obj.xyz, refined.trajectory.T_cam_obj.xyz, atol=1e-4)
    assert asset.material.f0.item() == pytest.approx(DIELECTRIC)


def test_the_paper_recipe_keeps_given_poses() -> None:
    recipe = recipes.known_poses(recipes.scaled(recipes.PAPER, 1 / 50_000))
    given = Trajectory(TRUTH, "camera")
    _, refined = losses_of(refine, recipe.refine, refine.Inputs(INPUTS.capture, given))
    _, asset = losses_of(decompose, recipe.decompose, decompose.Inputs(INPUTS.capture, refined))
    assert torch.allclose(asset.trajectory.T_cam_obj.matrix(), given.T_cam_obj.matrix(), atol=1e-6)


def test_the_pose_network_of_stage_2_goes_on_in_stage_3_from_the_same_poses(tmp_path: Path) -> None:
    recipe = recipes.scaled(recipes.PAPER, 1 / 10_000)
    _, refined = losses_of(refine, recipe.refine, refine.Inputs(INPUTS.capture, CLOSE))
    tree.save(refined, tmp_path / "refined.safetensors")
    inputs = decompose.Inputs(INPUTS.capture, tree.load(refine.Refined, tmp_path / "refined.safetensors"))
    state = decompose.init(recipe.decompose, inputs, torch.Generator().manual_seed(0))
    assert state.params.pose_network.keys() == refined.pose_network.keys()
    assert all(torch.equal(x, refined.pose_network[name]) for name, x in state.params.pose_network.items())
    assert refined.pose_network["weight2"].abs().max() > 1e-4  # it has learnt corrections
    start = decompose.finish(recipe.decompose, inputs, state).trajectory.T_cam_obj.matrix()
    torch.testing.assert_close(start, refined.trajectory.T_cam_obj.matrix(), atol=1e-6, rtol=0)


@pytest.mark.parametrize("stage", [refine, decompose])
def test_an_interrupted_stage_of_the_paper_recipe_ends_the_same(
    stage: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With pose networks, which are part of the checkpoint."""
    recipe = recipes.scaled(recipes.PAPER, 1 / 10_000)
    cfg, second = getattr(recipe, stage.__name__.split(".")[-1]), refine.Inputs(INPUTS.capture, CLOSE)
    inputs: Any = second
    if stage is decompose:
        inputs = decompose.Inputs(INPUTS.capture, drive(refine, replace(recipe.refine, steps=2), second, seed=1))
    whole, step = tree.named_tensors(drive(stage, cfg, inputs, seed=1)), stage.step

    def interrupted(cfg: Any, inputs: Any, state: Any) -> Any:
        result = step(cfg, inputs, state)
        if state.step == 9:
            signal.raise_signal(signal.SIGINT)
        return result

    monkeypatch.setattr(stage, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        drive(stage, cfg, inputs, seed=1, checkpoint=tmp_path / "state.safetensors", key="k")
    monkeypatch.setattr(stage, "step", step)
    resumed = drive(stage, cfg, inputs, seed=1, checkpoint=tmp_path / "state.safetensors", key="k")
    assert all(torch.equal(x, whole[name]) for name, x in tree.named_tensors(resumed).items())


def leaves_of(cfg: Any, path: str = "") -> dict[str, Any]:
    """All values of a configuration by attribute path."""
    if not hasattr(cfg, "__dataclass_fields__"):
        return {path: cfg}
    return {k: v for name, part in vars(cfg).items() for k, v in leaves_of(part, f"{path}.{name}").items()}


@pytest.mark.parametrize("factor", [1.0, 1 / 50])
@pytest.mark.parametrize("name", recipes.QUALITIES)
def test_a_scaled_recipe_has_the_same_rates_weights_and_switches(name: str, factor: float) -> None:
    whole, part = leaves_of(recipes.QUALITIES[name]), leaves_of(recipes.scaled(recipes.QUALITIES[name], factor))
    changed = {key for key in whole if whole[key] != part[key]}
    assert all(isinstance(whole[key], int) and part[key] < whole[key] for key in changed)
    assert all("weights" not in key and "realignments" not in key for key in changed)
    assert bool(changed) == (factor < 1)
    assert part[".refine.steps"] == whole[".refine.steps"] * factor


def test_closing_rounds_are_scaled_like_all_steps() -> None:
    track = recipes.scaled(recipes.progressive_poses(recipes.DRAFT), 0.1).track
    assert isinstance(track, progressive.Config)
    assert track.closing_steps == 15


@pytest.mark.parametrize("name", ["draft", "standard", "full"])
def test_the_ladder_leads_from_the_paper_to_the_recipe(name: str) -> None:
    """No setting departs twice, each rung changes something, and nothing is left at its end."""
    recipe = recipes.QUALITIES[name]
    rungs = [recipes.departed(count, recipe) for count in range(len(recipes.DEPARTURES) + 1)]
    assert rungs[0] == recipes.scaled(recipes.PAPER, recipe.refine.steps / recipes.PAPER.refine.steps)
    assert rungs[-1] == recipe
    settings = [name for names in recipes.DEPARTURES.values() for name in names]
    assert len(set(settings)) == len(settings)
    if name == "draft":
        assert all(below != above for below, above in itertools.pairwise(rungs))


@pytest.mark.parametrize("factor", [0.0, -1.0, 1.5, math.nan])
def test_a_recipe_cannot_grow(factor: float) -> None:
    with pytest.raises(ValueError, match=r"by a factor in \(0, 1\]"):
        recipes.scaled(recipes.PAPER, factor)


def test_a_departure_is_taken_back() -> None:
    back = recipes.TAKEN_BACK["without-mask-3"](recipes.DRAFT)
    assert back.decompose is not None
    assert recipes.DRAFT.decompose is not None
    assert back.decompose.weights.mask == 0.0
    with_mask = replace(back.decompose.weights, mask=recipes.DRAFT.decompose.weights.mask)
    assert replace(back, decompose=replace(back.decompose, weights=with_mask)) == recipes.DRAFT
