"""Options of footage: what a quality asks for."""

from typing import get_args

from tumble import recipes
from tumble.preprocess.options import FRAMES_AND_SIZE, FootageOptions, Quality, at_quality


def test_every_quality_has_a_recipe_and_numbers() -> None:
    assert list(recipes.QUALITIES) == list(get_args(Quality)) == list(FRAMES_AND_SIZE)


def test_explicit_numbers_take_precedence_over_those_of_the_quality() -> None:
    options = FootageOptions(focal=300.0)
    assert at_quality(options, "draft", frames=None, size=None) == options
    standard = at_quality(options, "standard", frames=None, size=None)
    assert (standard.frames, standard.size, standard.focal) == (200, 512, 300.0)
    assert at_quality(options, "paper", frames=30, size=96) == FootageOptions(focal=300.0, frames=30, size=96)
