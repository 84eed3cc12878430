"""Recipes: the settings of all stages. PAPER has the defaults of the stages; the others change some of them.

DRAFT: minutes on two CPU cores. STANDARD: meant for one GPU. SMOKE: seconds, for tests. The ablations and baselines of
the paper are functions from a recipe to a recipe. What experiments said about the values stands in docs/method.md.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from tumble import inverse_rendering, rendering
from tumble.inverse_rendering import densify, mean_colour_baseline
from tumble.poses import progressive, sfm


@dataclass(frozen=True)
class Recipe:
    """The configurations of all stages. The module that defines a configuration's class is the stage that runs."""

    matcher: str = "mixed"
    """Matcher of stage 1: the name of a file of `matching`."""
    track: Any = field(default_factory=sfm.Config)
    """Stage 1, for captures without poses: `poses.sfm` or, as in the paper, `poses.progressive`."""
    refine: Any = field(default_factory=inverse_rendering.refine.Config)
    """Stage 2. Its pose learning rate and realignments are ignored if poses are given."""
    decompose: Any = field(default_factory=inverse_rendering.decompose.Config)
    """Stage 3: `inverse_rendering.decompose` or a baseline in its place."""
    relight: rendering.relight.Config = field(default_factory=rendering.relight.Config)
    """Numbers of rays for relighting and for evaluation."""
    seed: int = 0
    """Seed of all random numbers."""


CREASE = 25.0
"""Stage 2's `crease`: two normals 16 degrees apart have weight 1/2 in the smoothness term."""

PROJ = 0.1
"""Stage 2's weight of the projection term; the paper's weight of 1 fills grooves."""

MASK = 3.0
"""Stage 3's weight of the mask term, which keeps the silhouette while geometry is optimised."""

PAPER = Recipe(refine=inverse_rendering.refine.Config(realignments=4))
"""The default configuration of every stage, except that estimated poses are realigned instead of moved by the paper's
pose network (docs/method.md)."""

STANDARD = replace(
    PAPER,
    refine=replace(
        PAPER.refine,
        steps=20_000,
        weights=replace(PAPER.refine.weights, normal=2.0, proj=PROJ, specular=0.002),
        crease=CREASE,
        rates=replace(PAPER.refine.rates, specular_scale=0.005),
        points=20_000,
        densification=densify.Config(max_gaussians=60_000),
    ),
    decompose=inverse_rendering.decompose.Config(
        steps=10_000,
        warmup=1_000,
        doublings=3,
        fit_specular=True,
        weights=inverse_rendering.decompose.Weights(light=0.02, material=0.02, mask=MASK),
        rates=inverse_rendering.decompose.Rates(albedo=0.02, roughness=0.03, light=0.03, specular_scale=0.03),
    ),
)

DRAFT = replace(
    PAPER,
    # A normal weight above the paper's 0.05 gives smoother normals; `crease` keeps it from filling grooves.
    refine=replace(
        PAPER.refine,
        steps=3_000,
        points=9_000,
        densification=densify.Config(refine_every=300, max_gaussians=16_000),
        hull=96,
        weights=replace(PAPER.refine.weights, normal=2.0, proj=PROJ, specular=0.002),
        crease=CREASE,
        rates=replace(PAPER.refine.rates, specular_scale=0.02),
        ramp=0.5,
    ),
    decompose=inverse_rendering.decompose.Config(
        steps=1_000,
        warmup=100,
        directions=256,
        doublings=1,
        fit_specular=True,
        weights=inverse_rendering.decompose.Weights(light=0.002, material=0.01, mask=MASK),
        rates=inverse_rendering.decompose.Rates(albedo=0.02, roughness=0.05, light=0.05, specular_scale=0.1),
    ),
    relight=replace(PAPER.relight, brdf_samples=128, light_samples=128),
)

SMOKE = replace(
    DRAFT,
    refine=replace(
        DRAFT.refine,
        steps=30,
        points=300,
        densification=densify.Config(refine_every=10, max_gaussians=400, score_views=3),
        hull=24,
        realignments=1,
    ),
    decompose=replace(DRAFT.decompose, steps=10, warmup=5, directions=64, sets=2, pixels=64),
    relight=replace(DRAFT.relight, brdf_samples=16, light_samples=16),
)

QUICK_TRACK = progressive.Config(
    poses="vectors",
    motion="steady",
    sizes=progressive.Sizes(
        width=64, depth=4, skip=2, features=32, octaves=4, colour_width=64, colour_depth=2, colour_octaves=2
    ),
    samples=16,
    warmup=60,
    pose_steps=30,
    joint_steps=80,
    rays=128,
    old_rays=64,
    match_rays=48,
    match_share=1.0,
    inside=1.0,
    block=2,
    weights=progressive.Weights(match=0.5),
    rates=progressive.Rates(poses=3e-3, poses_decay=0.3, fields=2e-3, sharpness=2e-3, ramp=1),
)
"""The progressive stage for two CPU cores: network, rays and steps take a hundredth of the paper's computation. So few
rays need a larger weight of the match term than the paper's."""

QUALITIES = {"draft": DRAFT, "standard": STANDARD, "paper": PAPER}
"""Recipes by the value of `--quality`."""


def known_poses(recipe: Recipe) -> Recipe:
    """The recipe for captures with given poses: no stage changes them."""
    second, third = recipe.refine, recipe.decompose
    if isinstance(second, inverse_rendering.refine.Config):
        second = replace(second, rates=replace(second.rates, poses=0.0), realignments=0)
    if isinstance(third, inverse_rendering.decompose.Config):
        third = replace(third, rates=replace(third.rates, poses=0.0))
    return replace(recipe, refine=second, decompose=third)


def static_colour(recipe: Recipe) -> Recipe:
    """Ablation: stage 2's radiance is one set of spherical harmonics per Gaussian, as in the paper."""
    return replace(recipe, refine=replace(recipe.refine, colour="sh"))


def no_visibility(recipe: Recipe) -> Recipe:
    """Ablation: no self-shadowing in stages 2 and 3."""
    recipe = replace(recipe, refine=replace(recipe.refine, shadow_start=1.0))
    return _replace_decompose(recipe, visibility=False)


def no_indirect(recipe: Recipe) -> Recipe:
    """Ablation: no indirect light."""
    return _replace_decompose(recipe, bounce="none")


def averaged_indirect(recipe: Recipe) -> Recipe:
    """Ablation: the paper's indirect light, whose radiance is the mean over all frames."""
    return _replace_decompose(recipe, bounce="average")


def no_corners(recipe: Recipe) -> Recipe:
    """Ablation: one material per Gaussian."""
    return _replace_decompose(recipe, corners=False)


def no_sdf(recipe: Recipe) -> Recipe:
    """Ablation: opacity is a free parameter, not derived from a signed distance."""
    stage = recipe.refine
    weights, rates = replace(stage.weights, gamma=0.0, proj=0.0), replace(stage.rates, gamma=0.0)
    return replace(recipe, refine=replace(stage, weights=weights, rates=rates))


def full_light(recipe: Recipe) -> Recipe:
    """Ablation: the environment map has its final resolution from the start."""
    stage = recipe.decompose
    assert isinstance(stage, inverse_rendering.decompose.Config), "an ablation of the method, not of a baseline"
    return replace(recipe, decompose=replace(stage, rows=stage.rows * 2**stage.doublings, doublings=0))


def mean_colour(recipe: Recipe) -> Recipe:
    """Baseline: albedo is the mean colour over the frames under a white light; no inverse rendering."""
    return replace(recipe, decompose=mean_colour_baseline.Config())


def no_specular_fit(recipe: Recipe) -> Recipe:
    """Ablation: roughness and F0 start at the paper's values and are only optimised, without the grid search of
    `specular_fit`."""
    return _replace_decompose(recipe, fit_specular=False)


def progressive_poses(recipe: Recipe) -> Recipe:
    """Stage 1 as in the paper: a neural SDF that grows frame by frame.

    PAPER uses the paper's numbers, which take days on a CPU; other recipes use a small network with few rays and steps,
    which take minutes.
    """
    return replace(recipe, track=progressive.Config() if recipe == PAPER else QUICK_TRACK)


def _replace_decompose(recipe: Recipe, **changes: Any) -> Recipe:
    assert isinstance(recipe.decompose, inverse_rendering.decompose.Config), (
        "an ablation of the method, not of a baseline"
    )
    return replace(recipe, decompose=replace(recipe.decompose, **changes))


ABLATIONS: dict[str, Callable[[Recipe], Recipe]] = {
    "static-colour": static_colour,
    "no-visibility": no_visibility,
    "no-indirect": no_indirect,
    "averaged-indirect": averaged_indirect,
    "no-corners": no_corners,
    "no-sdf": no_sdf,
    "full-light": full_light,
    "mean-colour": mean_colour,
    "no-specular-fit": no_specular_fit,
}
"""Ablations and baselines by name."""


def unchanged(recipe: Recipe) -> Recipe:
    """The method itself."""
    return recipe


METHODS: dict[str, Callable[[Recipe], Recipe]] = {"tumble": unchanged, "average": mean_colour, **ABLATIONS}
"""What a row of a benchmark suite can run, by the value of `--method`: the method, baselines, ablations. The floor is
"average", the mean colour over the frames as albedo."""
