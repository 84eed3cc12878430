"""Recipes: the settings of all stages.

DRAFT, STANDARD and FULL are our method at three sizes; PAPER is the paper's, and `scaled` makes a recipe smaller.
SMOKE: seconds, for tests. docs/method.md says what each was run on and what it reached, and how PAPER and ours differ.
The ablations and baselines of the paper are functions from a recipe to a recipe.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from operator import attrgetter
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

MASK = 1.0
"""Stage 3's weight of the mask term, which keeps the silhouette while geometry is optimised; more costs albedo."""

DIAMETER = 107.0
"""Diameter of the object's sphere in the captures of 128 x 128 pixels on which the numbers of Gaussians were chosen
[pixels]."""

REALIGNMENTS = 9
"""Number of photometric alignments after the progressive stage 1 for CPUs. Gaussians learn errors that neighbouring
frames share, of which each alignment corrects a small part; poses of the graph stage gain nothing from more than 4."""

OURS = Recipe(
    # A normal weight above the paper's 0.05 gives smoother normals; `crease` keeps it from filling grooves.
    refine=inverse_rendering.refine.Config(
        points=9_000,
        densification=densify.Config(max_gaussians=16_000),
        hull=96,
        diameter=DIAMETER,
        weights=inverse_rendering.refine.Weights(normal=2.0, proj=PROJ, specular=0.002),
        crease=CREASE,
        realignments=4,
    )
)
"""What our recipes share: stage 2's weights, realigned poses, and as many Gaussians as the images resolve."""

PAPER = Recipe(
    track=progressive.Config(lift="pnp"),
    refine=inverse_rendering.refine.Config(
        colour="sh",
        start="sphere",
        points=100_000,
        opacity=0.99,
        gamma=1.0,
        gamma_floor=0.1,
        mask_loss="entropy",
        weights=inverse_rendering.refine.Weights(gamma=5.0),
        rates=inverse_rendering.refine.Rates(
            means=5 * 1.6e-4,
            quats=1e-3,
            log_scales=5e-3,
            sdf=0.05,
            gamma=0.005,
            sh=2.5e-3,
            sh_rest=2.5e-3 / 20,
            poses=5e-4,
            decay=0.01,
            others_decay=1.0,
        ),
        densification=densify.Config(
            refine_stop=0.1,
            max_gaussians=1_000_000,
            bad_min_error=0.0,
            grow_score=5.0,
            prune_opacity=0.005,
            prune_weight=0.0,
            fastgs=densify.FastGS(),
        ),
        harmonics_every=1_000,
        pose_model="network",
    ),
    decompose=inverse_rendering.decompose.Config(
        sets=1,
        pixels=512,
        roughness=0.54,
        start="grey",
        initial_albedo=0.415,
        smooth_light="radiance",
        bounce="average",
        shadows="traced",
        lobes="sum",
        pose_model="network",
        weights=inverse_rendering.decompose.Weights(specular=0.0),
        rates=inverse_rendering.decompose.Rates(poses=5e-4, decay=1.0),
    ),
)
"""The paper's method with the numbers that it prints, as far as it is implemented; docs/method.md lists what is not.

Where the paper prints no number, the work that it follows decides. 3DGS: rates of the Gaussians' centres, rotations,
scales and harmonics; only that of the centres decays. DiscretizedSDF: number and opacity of the first Gaussians, start
and rate of gamma, rate of the signed distances, the factor 5 on the centres' rate. FastGS: densification and
pruning, which end after 15,000 and 30,000 steps. R3DG: cross entropy, rates of geometry in stage 3. SVG-IR: level of
the first albedo, and roughness. IRGS: rays per step of stage 3 (2^18). The poses' rate in stages 2 and 3 is that of
stage 1. Never run to the end: only `scaled` versions were.
"""

STANDARD = replace(
    OURS,
    refine=replace(
        OURS.refine,
        steps=20_000,
        rates=replace(OURS.refine.rates, specular_scale=0.005),
    ),
    decompose=inverse_rendering.decompose.Config(
        steps=10_000,
        warmup=1_000,
        doublings=3,
        try_matte=True,
        region_trials=3,
        solve_albedo=True,
        weights=inverse_rendering.decompose.Weights(light=0.005, material=0.02, mask=MASK, specular=0.0),
        rates=inverse_rendering.decompose.Rates(
            albedo=0.02, roughness=0.03, roughness_shift=0.03, metalness=0.03, light=0.03, specular_scale=0.03
        ),
    ),
)

FULL = replace(
    STANDARD,
    refine=replace(STANDARD.refine, steps=60_000),
    decompose=replace(STANDARD.decompose, steps=30_000, warmup=3_000),
)
"""STANDARD with three times the steps; a light of 1024 rows, the paper's, brings nothing (docs/method.md)."""

DRAFT = replace(
    OURS,
    refine=replace(
        OURS.refine,
        steps=3_000,
        densification=replace(OURS.refine.densification, refine_every=300),
        rates=replace(OURS.refine.rates, specular_scale=0.02),
        ramp=0.5,
    ),
    decompose=inverse_rendering.decompose.Config(
        steps=1_000,
        warmup=100,
        directions=256,
        side=128,
        doublings=1,
        try_matte=True,
        region_trials=3,
        solve_albedo=True,
        weights=inverse_rendering.decompose.Weights(light=5e-4, material=0.01, mask=MASK, specular=0.0),
        rates=inverse_rendering.decompose.Rates(
            albedo=0.02, roughness=0.05, roughness_shift=0.05, metalness=0.05, light=0.05, specular_scale=0.1
        ),
    ),
    relight=replace(OURS.relight, brdf_samples=128, light_samples=128),
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
    motion=progressive.Motion(),
    start="matched",
    sizes=progressive.Sizes(
        nodes=(12, 24, 48), features=6, colour_width=32, colour_depth=1, colour_octaves=1, radius=0.7
    ),
    warmup=300,
    pose_steps=0,
    joint_steps=60,
    closing=2,
    closing_steps=150,
    rays=256,
    old_rays=128,
    match_rays=48,
    match_share=1.0,
    inside=1.0,
    block=2,
    reset=360.0,
    weights=progressive.Weights(mask=2.0),
    rates=progressive.Rates(poses=1e-4, poses_decay=0.3, fields=5e-3, sharpness=2e-3, ramp=1),
)
"""The progressive stage for two CPU cores: voxel grids in place of the paper's networks, initial poses from matches
with several frames, no reset of the shape, and a hundredth of the paper's computation."""

QUALITIES = {"draft": DRAFT, "standard": STANDARD, "full": FULL, "paper": PAPER}
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
    stage = _decompose_of(recipe)
    return replace(recipe, decompose=replace(stage, rows=stage.rows * 2**stage.doublings, doublings=0))


def mean_colour(recipe: Recipe) -> Recipe:
    """Baseline: albedo is the mean colour over the frames under a white light; no inverse rendering."""
    return replace(recipe, decompose=mean_colour_baseline.Config())


def recap(lights: int, recipe: Recipe) -> Recipe:
    """Baseline after ReCap (Li et al. 2025): a separate light for each of `lights` blocks of consecutive frames.

    As in ReCap opacity is a free parameter and there are no shadows and no indirect light.
    """
    recipe = no_specular_fit(no_sdf(static_colour(recipe)))
    base = replace(_decompose_of(recipe), visibility=False, bounce="none", corners=False)
    # The light of a block is trained in few of the steps.
    rates = replace(_faster(base.rates, light=4.0), poses=0.0)
    return replace(recipe, decompose=inverse_rendering.separate_lights.Config(replace(base, rates=rates), lights))


def _faster(rates: inverse_rendering.decompose.Rates, *, light: float) -> inverse_rendering.decompose.Rates:
    """Learning rates of baselines, whose albedo and light start from a mean colour and a uniform light.

    Ours start from the light of stage 2. The works' own rates are lower, but they take 20 to 30 times as many steps as
    DRAFT. Chosen on the mustard bottle and the cracker box.
    """
    return replace(rates, albedo=10 * rates.albedo, light=light * rates.light)


def svg_ir(recipe: Recipe) -> Recipe:
    """Baseline after SVG-IR (Sun et al. 2025), extended to moving objects: the light is looked up in the env frame.

    Opacity is a free parameter, geometry stays that of stage 2, both lobes are summed over sets of 64 directions with
    visibility cached at the Gaussians, indirect light is their mean radiance, and the light has 32 rows.
    """
    return _static_method(recipe, rows=32, shadows="cached", directions=64)


def irgs(recipe: Recipe) -> Recipe:
    """Baseline after IRGS (Gu et al. 2025), extended to moving objects: the light is looked up in the env frame.

    Opacity is a free parameter, geometry stays that of stage 2, visibility is traced from the shaded points in each
    step, indirect light is the mean radiance of the Gaussians, which have one material each, and the light has 64 rows.
    """
    return _static_method(recipe, rows=64, shadows="traced", corners=False)


def _static_method(recipe: Recipe, *, rows: int, **changes: Any) -> Recipe:
    """What SVG-IR and IRGS have in common; their light has `rows` rows from the start."""
    recipe = no_specular_fit(no_sdf(static_colour(recipe)))
    stage = _decompose_of(recipe)
    common = {
        "bounce": "average",
        "lobes": "sum",
        "sets": 8,
        "doublings": 0,
        "solve_albedo": False,
    }
    # Differences of neighbouring texels shrink with their distance; this keeps the same smoothness per solid angle.
    weights = replace(stage.weights, light=stage.weights.light * (rows / stage.rows) ** 2, specular=0.0)
    rates = replace(_faster(stage.rates, light=2.0), specular_scale=0.0)
    # As long as the warm-up lasts, geometry does not change.
    changes |= {"rows": rows, "warmup": stage.steps, "weights": weights, "rates": rates}
    return _replace_decompose(recipe, **common, **changes)


def no_albedo_solve(recipe: Recipe) -> Recipe:
    """Ablation: the albedo of stage 3 is not solved again in absolute colour."""
    return _replace_decompose(recipe, solve_albedo=False)


def no_specular_fit(recipe: Recipe) -> Recipe:
    """Ablation: no trial whether the object has a specular lobe but a penalty on it, none of the roughness of regions,
    and the roughness of a corner depends only on the pixels that show it."""
    stage = _decompose_of(recipe)
    weights = replace(stage.weights, specular=inverse_rendering.decompose.Weights().specular)
    rates = replace(stage.rates, roughness_shift=0.0)
    return _replace_decompose(recipe, try_matte=False, region_trials=0, roughness=0.4, weights=weights, rates=rates)


def progressive_poses(recipe: Recipe) -> Recipe:
    """Stage 1 as in the paper: a neural SDF that grows frame by frame.

    PAPER has it, with the paper's numbers, which take days on a CPU; other recipes get voxel grids and initial poses
    from matches, which take minutes, and more photometric alignments in stage 2, since these poses are rougher.
    """
    if isinstance(recipe.track, progressive.Config):
        return recipe
    refine = replace(recipe.refine, realignments=REALIGNMENTS)
    return replace(recipe, track=QUICK_TRACK, refine=refine)


def scaled(recipe: Recipe, factor: float) -> Recipe:
    """The recipe at a fraction of its computation, with the same learning rates, loss weights and switches.

    Numbers of steps are multiplied by the factor. Rays, pixels, directions, Gaussians and the widths of networks are
    multiplied by its square root, as is the final resolution of the environment map, but none falls below a minimum
    with which a stage still trains. Stage 1 is scaled if it is the progressive one. With unchanged learning rates a
    tenth of the steps moves Gaussians a tenth as far: at 1/20, parts of PAPER's sphere have not reached the object.

    Args:
        factor: In (0, 1].

    Raises:
        ValueError: The factor is not in this range.
    """
    if not 0 < factor <= 1:
        raise ValueError(f"a recipe is scaled by a factor in (0, 1], not by {factor}")
    fewer, smaller = partial(_times, factor), partial(_times, math.sqrt(factor))
    track, second, third, relight = recipe.track, recipe.refine, recipe.decompose, recipe.relight
    if isinstance(track, progressive.Config):
        phases = ("warmup", "pose_steps", "joint_steps", "closing_steps")
        steps = {name: fewer(getattr(track, name), 1) for name in phases}
        rays = {name: smaller(getattr(track, name), 16) for name in ("rays", "old_rays", "match_rays")}
        # The skip connection of the distance network needs a width above that of the encoded point, 39.
        widths = {name: smaller(getattr(track.sizes, name), 64) for name in ("width", "features", "colour_width")}
        rates = replace(track.rates, ramp=fewer(track.rates.ramp, 1))
        sizes = replace(track.sizes, **widths)
        track = replace(track, **steps, **rays, sizes=sizes, rates=rates, samples=smaller(track.samples, 12))
    if isinstance(second, inverse_rendering.refine.Config):
        growth = second.densification
        every, most = fewer(growth.refine_every, 10), smaller(growth.max_gaussians, 500)
        rules = growth.fastgs
        if rules is not None:
            rules = replace(rules, reset_every=every * round(rules.reset_every / growth.refine_every))
        second = replace(
            second,
            steps=fewer(second.steps, 1),
            points=smaller(second.points, 500),
            harmonics_every=fewer(second.harmonics_every, 1),
            densification=replace(growth, refine_every=every, max_gaussians=most, fastgs=rules),
        )
    if isinstance(third, inverse_rendering.decompose.Config):
        third = replace(
            third,
            steps=fewer(third.steps, 1),
            warmup=fewer(third.warmup, 1),
            directions=smaller(third.directions, 64),
            pixels=smaller(third.pixels, 64),
            doublings=max(0, third.doublings + round(math.log2(factor) / 2)),
        )
    samples = {name: smaller(getattr(relight, name), 16) for name in ("brdf_samples", "light_samples")}
    return replace(recipe, track=track, refine=second, decompose=third, relight=replace(relight, **samples))


def _times(factor: float, number: int, least: int) -> int:
    """A number of things times a factor, but at least `least`, and not more than before."""
    return min(number, max(least, round(factor * number)))


def _replace_decompose(recipe: Recipe, **changes: Any) -> Recipe:
    return replace(recipe, decompose=replace(_decompose_of(recipe), **changes))


def _decompose_of(recipe: Recipe) -> inverse_rendering.decompose.Config:
    """Settings of our stage 3."""
    stage = recipe.decompose
    assert isinstance(stage, inverse_rendering.decompose.Config), "a variant of the method, not of a baseline"
    return stage


ABLATIONS: dict[str, Callable[[Recipe], Recipe]] = {
    "static-colour": static_colour,
    "no-visibility": no_visibility,
    "no-indirect": no_indirect,
    "averaged-indirect": averaged_indirect,
    "no-corners": no_corners,
    "no-sdf": no_sdf,
    "full-light": full_light,
    "mean-colour": mean_colour,
    "no-albedo-solve": no_albedo_solve,
    "no-specular-fit": no_specular_fit,
}
"""Ablations and baselines by name."""


def unchanged(recipe: Recipe) -> Recipe:
    """The method itself."""
    return recipe


BASELINES: dict[str, Callable[[Recipe], Recipe]] = {
    "average": mean_colour,
    "recap-10": partial(recap, 10),
    "recap-40": partial(recap, 40),
    "recap-100": partial(recap, 100),
    "svg-ir": svg_ir,
    "irgs": irgs,
}
"""Baselines by name; docs/benchmarks.md says how they differ from the methods after which they are named."""


DEPARTURES: dict[str, tuple[str, ...]] = {
    "paper": ("relight", "seed"),
    "hull": ("refine.start", "refine.points", "refine.opacity", "refine.hull"),
    "rates-2": (
        *(f"refine.rates.{name}" for name in ("means", "quats", "log_scales", "albedo", "light", "sh", "sh_rest")),
        *("refine.rates.decay", "refine.rates.others_decay"),
    ),
    "densification": ("refine.densification", "refine.diameter"),
    "squared-mask": ("refine.mask_loss", "refine.weights.mask"),
    "normals": ("refine.weights.normal", "refine.crease", "refine.ramp"),
    "projection": ("refine.weights.proj",),
    "light": (
        "refine.colour",
        "refine.harmonics_every",
        "refine.shadow_start",
        "decompose.roughness",
        "decompose.start",
        "decompose.initial_albedo",
    ),
    "specular-scale": (
        *("refine.weights.specular", "refine.rates.specular_scale"),
        *("decompose.weights.specular", "decompose.rates.specular_scale"),
    ),
    "poses": (
        *("matcher", "track", "refine.pose_model", "refine.realignments", "refine.rates.poses"),
        *("decompose.pose_model", "decompose.rates.poses"),
    ),
    "rates-3": (
        *(f"decompose.{name}" for name in ("steps", "warmup", "doublings", "rows", "pixels", "side")),
        *(f"decompose.rates.{name}" for name in ("albedo", "roughness", "normal", "light", "decay")),
        *(f"decompose.rates.{name}" for name in ("means", "quats", "log_scales", "sdf")),
    ),
    "mask-3": ("decompose.weights.mask",),
    "sharpness": (
        "refine.gamma",
        "refine.gamma_floor",
        "refine.weights.gamma",
        "refine.rates.gamma",
        "refine.rates.sdf",
    ),
    "smoothness": ("decompose.weights.light", "decompose.weights.material", "decompose.smooth_light"),
    "directions": ("decompose.directions", "decompose.sets"),
    "cached-visibility": ("decompose.shadows",),
    "split-sum": ("decompose.lobes",),
    "frame-bounce": ("decompose.bounce",),
    "specular-fit": (
        *("decompose.try_matte", "decompose.region_trials"),
        *("decompose.rates.roughness_shift", "decompose.rates.metalness"),
    ),
    "albedo-solve": ("decompose.solve_albedo",),
}
"""Our departures from the paper, in the order of the ladder: by name, the settings that are ours from there on."""


def departed(count: int, recipe: Recipe) -> Recipe:
    """A rung of the ladder from the paper to a recipe: PAPER with the first `count` of `DEPARTURES`, of the same size.

    PAPER is scaled so that stage 2 has as many steps as the recipe's. With all departures it is the recipe.
    """
    paper = _paper_like(recipe)
    for names in list(DEPARTURES.values())[:count]:
        paper = _with_settings_of(recipe, names, paper)
    return paper


def _paper_like(recipe: Recipe) -> Recipe:
    """PAPER with as many steps of stage 2 as the recipe."""
    return scaled(PAPER, min(1.0, recipe.refine.steps / PAPER.refine.steps))


def _with_settings_of(other: Recipe, names: Sequence[str], recipe: Recipe) -> Recipe:
    """The recipe with the values that another one has at some paths of attributes."""
    for name in names:
        recipe = _with_setting(recipe, name, attrgetter(name)(other))
    return recipe


def _with_setting(settings: Any, name: str, value: Any) -> Any:
    """The settings with another value at a path of attributes."""
    first, _, rest = name.partition(".")
    return replace(settings, **{first: _with_setting(getattr(settings, first), rest, value) if rest else value})


def taken_back(departure: str, recipe: Recipe) -> Recipe:
    """The recipe with the settings of one of `DEPARTURES` taken from PAPER, scaled as by `departed`."""
    return _with_settings_of(_paper_like(recipe), DEPARTURES[departure], recipe)


LADDER: dict[str, Callable[[Recipe], Recipe]] = {
    f"ladder-{i:02d}-{name}": partial(departed, i + 1) for i, name in enumerate(DEPARTURES)
}
"""The rungs from the paper to our method, by name: each has the departure that it is named after, and all before."""
TAKEN_BACK: dict[str, Callable[[Recipe], Recipe]] = {
    f"without-{name}": partial(taken_back, name) for name in DEPARTURES if name not in ("paper", "poses")
}
"""Our method without one of its departures from the paper, by name; not that of the poses, which has no effect where
poses are given and whose parts exclude one another."""
SMALL: dict[str, Callable[[Recipe], Recipe]] = {
    "twentieth": partial(scaled, factor=1 / 20),
    "twentieth-grids": lambda recipe: replace(scaled(recipe, 1 / 20), track=QUICK_TRACK),
}
"""A recipe at a twentieth of its computation, by name; grids: with stage 1 for two CPU cores."""
METHODS: dict[str, Callable[[Recipe], Recipe]] = {
    "tumble": unchanged,
    **BASELINES,
    **ABLATIONS,
    **LADDER,
    **TAKEN_BACK,
    **SMALL,
}
"""What a row of a benchmark suite can run, by the value of `--method`: the method, baselines, ablations, rungs of the
ladder, departures taken back, smaller recipes. The floor is "average", the mean colour over the frames as albedo."""
