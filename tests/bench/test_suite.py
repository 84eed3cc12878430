"""Suites are data: what they list, which objects and lights each half may use, and what is refused."""

from pathlib import Path

import pytest

from tumble import batch, recipes
from tumble.bench import suite as suites
from tumble.io.files import BadFile
from tumble.scene.environment import Environment

HEAD = 'title = "t"\nrecipe = "smoke"\nseeds = [0]\n'
OBJECT = '[[object]]\nmodel = "pot"\nenv = "room"\n'


def write(folder: Path, text: str) -> str:
    (folder / "own.toml").write_text(text)
    return str(folder / "own.toml")


@pytest.mark.parametrize("name", suites.suite_names())
def test_the_cases_of_a_bundled_suite_have_distinct_names_and_keys(name: str) -> None:
    suite = suites.read_suite(name)
    cases = suites.cases_of(suite)
    assert len({case.name for case in cases}) == len({case.key for case in cases}) == len(cases) > 0
    labels = cases[0].labels
    for comparison in suite.compare:
        assert comparison.ahead.keys() | comparison.behind.keys() <= labels.keys()
        for side in (comparison.ahead, comparison.behind):
            assert any(side.items() <= case.labels.items() for case in cases), "a comparison without rows"


def test_every_recipe_and_method_of_a_suite_exists_and_every_ablation_is_in_the_suite_of_ablations() -> None:
    chosen = {name: suites.cases_of(suites.read_suite(name)) for name in suites.suite_names()}
    for case in (case for cases in chosen.values() for case in cases):
        assert case.recipe in batch.RECIPES
        assert case.method in recipes.METHODS
    assert {case.method for case in chosen["ablations"]} == {"tumble", *recipes.ABLATIONS}


def test_table_3_uses_the_captures_of_table_1() -> None:
    one, three = (suites.cases_of(suites.read_suite(f"paper-table{n}")) for n in (1, 3))
    assert {case.options for case in three} == {case.options for case in one}


def test_table_1_has_ten_objects_in_all_settings() -> None:
    suite = suites.read_suite("paper-table1")
    cases = suites.cases_of(suite, seeds=[0])
    assert len(suites.cases_of(suite)) == 2 * len(cases) == 2 * 10 * 2 * (3 + 2)
    assert {case.options.views for case in cases} == {64}
    assert {case.options.resolution for case in cases} == {128}
    estimated = {case.options.setting for case in cases if case.poses == "estimate"}
    assert estimated == {"turntable", "handheld"}


def test_few_hand_held_views_are_taken_from_the_motion_of_all_400() -> None:
    cases = suites.cases_of(suites.read_suite("views"))
    lengths = {case.options.views * case.options.stride for case in cases if case.options.setting == "handheld"}
    assert lengths == {400}
    assert {case.options.stride for case in cases if case.options.setting == "dome"} == {1}


def test_only_seeds_and_methods_select_cases() -> None:
    suite = suites.read_suite("paper-table1")
    chosen = suites.cases_of(suite, seeds=[7], methods=["average"], only=["Corset", "dome", "diffuse"])
    assert [case.name for case in chosen] == ["Corset-potsdamer_platz-dome-diffuse-given-average-seed7"]
    assert chosen[0].options.seed == 7


def test_rows_may_have_fewer_seeds_than_their_suite(tmp_path: Path) -> None:
    text = HEAD.replace("[0]", "[0, 1]") + OBJECT
    text += '[[rows]]\nmethod = ["tumble"]\n[[rows]]\nmethod = ["average"]\nseed = [1]\n'
    suite = suites.read_suite(write(tmp_path, text))
    assert [(case.method, case.seed) for case in suites.cases_of(suite)] == [
        ("tumble", 0), ("tumble", 1), ("average", 1)
    ]  # fmt: skip
    asked = suites.cases_of(suite, seeds=[7])
    assert {(case.method, case.seed, case.options.seed) for case in asked} == {("tumble", 7, 7), ("average", 7, 7)}
    with pytest.raises(BadFile, match="not one of the suite's"):
        suites.read_suite(write(tmp_path, text.replace("[1]", "[2]")))


def test_no_object_or_light_of_one_half_is_in_the_other() -> None:
    halves: dict[str, set[str]] = {"tune": set(), "report": set(), "none": set()}
    for name in suites.suite_names():
        suite = suites.read_suite(name)
        for case in suites.cases_of(suite):
            halves[suite.half] |= {case.model} | ({case.options.env} if case.options else set())
    assert not halves["tune"] & halves["report"]
    assert len(halves["report"] - {"white"}) == 10 + 5 + 4 + 42 + 16  # with the folders of three datasets


def test_the_directionality_in_a_suite_is_that_of_the_light(shared_data: Path) -> None:
    stated = {
        about["env"]: about["directionality"]
        for name in ("paper-table1", "tune")
        for about in suites.read_suite(name).object
    }
    assert len(stated) == 7
    for env, value in stated.items():
        light = Environment.read(shared_data / "hdri" / env).resampled(32, 64)
        assert light.directionality() == pytest.approx(value, abs=0.01)


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        (HEAD + OBJECT, "missing required field `rows`"),
        (HEAD + OBJECT + "[[rows]]\nwiggle = [1]", "'wiggle' is not an option of tumble synth"),
        (HEAD + OBJECT + '[[rows]]\nposes = ["guess"]', "Invalid enum value 'guess'"),
        (HEAD + OBJECT + "[[rows]]\nviews = [0]", "views is out of range: 0"),
        (HEAD + OBJECT + '[[rows]]\nsetting = "dome"', "Expected `array`, got `str`"),
        (HEAD + '[[object]]\nenv = "room"\n[[rows]]\nviews = [8]', "missing required field `model`"),
        ("colour = 1\n" + HEAD + OBJECT + "[[rows]]\nviews = [8]", "has an unknown key 'colour'"),
        (HEAD + OBJECT + OBJECT + 'up = "z"\n[[rows]]\nviews = [8]', "several rows with the name pot-room-handheld"),
        ("title = ", "is not a suite"),
        (HEAD + '[[object]]\nfolder = "a/b"\n[[rows]]\nviews = [8]', "'views' is not possible for a folder"),
    ],
)
def test_a_wrong_suite_is_refused_with_its_rule(text: str, rule: str, tmp_path: Path) -> None:
    with pytest.raises(BadFile, match=r"own\.toml") as caught:
        suites.read_suite(write(tmp_path, text))
    assert rule in str(caught.value)
    assert "tumble bench list" in str(caught.value)


def test_an_unknown_suite_is_refused_with_the_known_ones() -> None:
    with pytest.raises(BadFile, match=r"smoke.*tune"):
        suites.read_suite("smok")
