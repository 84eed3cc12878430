"""Recipes: every number of a run in one place. PAPER holds the published values; the others say what they change.

DRAFT: two CPU cores, minutes. STANDARD: one GPU, minutes. SMOKE: seconds, for tests. The ablations and baselines of the
paper are recipes too.
"""

from dataclasses import dataclass, field, replace

from tumble.decompose import Config as Decompose
from tumble.decompose import Weights as DecomposeWeights
from tumble.refine import Config as Refine
from tumble.relight import Config as Relight


@dataclass(frozen=True)
class Recipe:
    """The configurations of all stages."""

    refine: Refine = field(default_factory=Refine)
    decompose: Decompose = field(default_factory=Decompose)
    relight: Relight = field(default_factory=Relight)
    seed: int = 0
    """Of every random draw."""


PAPER = Recipe()

STANDARD = replace(
    PAPER,
    refine=replace(
        PAPER.refine, steps=20_000, weights=replace(PAPER.refine.weights, normal=2.0), points=20_000, limit=60_000
    ),
    decompose=replace(
        PAPER.decompose,
        steps=10_000,
        warmup=2_000,
        doublings=3,
        weights=DecomposeWeights(light=0.02, material=0.02),
        rates=replace(PAPER.decompose.rates, albedo=0.02, roughness=0.03, light=0.03, f0=0.01),
    ),
)

DRAFT = replace(
    PAPER,
    # At 128 pixels a normal term of the paper's weight leaves normals 3 degrees rougher (mean over all pixels).
    refine=replace(
        PAPER.refine,
        steps=2_000,
        points=6_000,
        limit=12_000,
        hull=96,
        every=200,
        weights=replace(PAPER.refine.weights, normal=2.0),
    ),
    decompose=replace(
        PAPER.decompose,
        steps=1_000,
        warmup=1_000,
        directions=256,
        doublings=1,
        weights=DecomposeWeights(light=0.002, material=0.01),
        rates=replace(PAPER.decompose.rates, albedo=0.02, roughness=0.05, light=0.05, f0=0.05),
    ),
    relight=replace(PAPER.relight, brdf_samples=128, light_samples=128),
)

SMOKE = replace(
    DRAFT,
    refine=replace(DRAFT.refine, steps=30, points=300, limit=400, hull=24, every=10, views=3),
    decompose=replace(DRAFT.decompose, steps=10, warmup=5, directions=64, sets=2, pixels=64),
    relight=replace(DRAFT.relight, brdf_samples=16, light_samples=16),
)

QUALITIES = {"draft": DRAFT, "standard": STANDARD, "paper": PAPER}


def static_colour(recipe: Recipe) -> Recipe:
    """Ablation: the paper's radiance per Gaussian that does not know that the light stands still."""
    return replace(recipe, refine=replace(recipe.refine, colour="sh"))


def no_visibility(recipe: Recipe) -> Recipe:
    """Ablation: nothing shadows anything."""
    return replace(recipe, decompose=replace(recipe.decompose, visibility=False, bounce=False))


def no_indirect(recipe: Recipe) -> Recipe:
    """Ablation: shadows are black."""
    return replace(recipe, decompose=replace(recipe.decompose, bounce=False))


ABLATIONS = {"static-colour": static_colour, "no-visibility": no_visibility, "no-indirect": no_indirect}
