"""Tables and comparisons of a suite, which follow from its JSON document alone.

Scores are those of the evaluation views of region "shared", which all capture settings cover alike. Failed and stale
rows are listed, and are part of no mean and no comparison.
"""

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from tumble.bench.rows import SuiteResults, SuiteRow, is_stale

METRICS: dict[str, tuple[str, str]] = {
    "albedo.psnr_fg_srgb": ("albedo object [dB]", "{:.1f}"),
    "albedo.psnr_full_srgb": ("albedo picture [dB]", "{:.1f}"),
    "albedo.ssim_full_srgb": ("albedo SSIM", "{:.3f}"),
    "albedo.lpips_full_srgb_alex": ("albedo LPIPS", "{:.3f}"),
    "albedo.psnr_fg_linear_unscaled": ("albedo unscaled [dB]", "{:.1f}"),
    "relit.psnr_fg_srgb": ("relit object [dB]", "{:.1f}"),
    "relit.psnr_full_srgb": ("relit picture [dB]", "{:.1f}"),
    "relit.ssim_full_srgb": ("relit SSIM", "{:.3f}"),
    "relit.lpips_full_srgb_alex": ("relit LPIPS", "{:.3f}"),
    "normal.mean_fg_degrees": ("normals [deg]", "{:.1f}"),
    "roughness.rmse_fg": ("roughness RMSE", "{:.3f}"),
    "glb.albedo.psnr_fg_srgb": ("GLB: albedo object [dB]", "{:.1f}"),
    "glb.albedo.lpips_full_srgb_alex": ("GLB: albedo LPIPS", "{:.3f}"),
    "glb.relit.psnr_fg_srgb": ("GLB: relit object [dB]", "{:.1f}"),
    "glb.normal.mean_fg_degrees": ("GLB: normals [deg]", "{:.1f}"),
    "glb.roughness.rmse_fg": ("GLB: roughness RMSE", "{:.3f}"),
    "light.rmse_clip10": ("light RMSE", "{:.3f}"),
    "light.log_correlation": ("light log corr.", "{:.2f}"),
    "poses.rotation_median_degrees": ("rotation median [deg]", "{:.2f}"),
    "poses.auc_percent": ("AUC of positions [%]", "{:.1f}"),
    "poses.rpe_translation": ("RPE translation", "{:.3f}"),
    "poses.rpe_rotation_degrees": ("RPE rotation [deg]", "{:.2f}"),
    "poses.lost_frames": ("lost frames", "{:.0f}"),
    "tensoir.albedo_psnr": ("TensoIR albedo [dB]", "{:.2f}"),
    "tensoir.relit_psnr": ("TensoIR relit [dB]", "{:.2f}"),
    "tensoir.normal_mae_degrees": ("TensoIR normals [deg]", "{:.2f}"),
    "orb.relit_psnr_h": ("ORB relit PSNR-H [dB]", "{:.2f}"),
    "orb.relit_psnr_l": ("ORB relit PSNR-L [dB]", "{:.2f}"),
    "orb.relit_ssim": ("ORB relit SSIM", "{:.3f}"),
    "orb.image_psnr_h": ("ORB view PSNR-H [dB]", "{:.2f}"),
    "orb.image_psnr_l": ("ORB view PSNR-L [dB]", "{:.2f}"),
    "orb.albedo_psnr": ("ORB albedo [dB]", "{:.2f}"),
    "orb.normal_cosine": ("ORB normals", "{:.3f}"),
    "seconds.run": ("run [s]", "{:.0f}"),
    "peak_memory_MiB": ("memory [MiB]", "{:.0f}"),
}
"""Heading and number format of each column, by the key of its value in a row."""
COMPARED = ("albedo.psnr_fg_srgb", "albedo.psnr_full_srgb", "relit.psnr_fg_srgb", "relit.psnr_full_srgb")
"""Scores for which comparisons are made."""
REGION = "shared"
"""Evaluation views of all tables."""
NOTHING = "-"
"""A cell without a value."""


@dataclass(frozen=True)
class Table:
    """A table of text."""

    title: str
    about: str
    """What the reader has to know, in a few sentences."""
    headings: tuple[str, ...]
    lines: list[tuple[str, ...]]


@dataclass(frozen=True)
class PairedDifference:
    """Differences of one score between two sets of rows, one difference per object."""

    title: str
    group: str
    """Labels that both sets have in common."""
    metric: str
    ahead: float
    """Mean over objects of the set that is expected to be ahead."""
    behind: float
    differences: dict[str, float]
    """By object, the mean over lights and seeds."""
    p: float | None
    """One-sided probability (Wilcoxon signed-rank test) of such differences if neither is better; None for one pair."""


def tables_of(results: SuiteResults) -> list[Table]:
    """All tables of a report, the comparisons first."""
    makers = (comparison_table, mean_table, object_table, row_table, problem_table)
    return [table for make in makers if (table := make(results)).lines]


def value_of(row: SuiteRow, key: str) -> float | None:
    """A value of a row, by its key in `METRICS`."""
    first, _, second = key.partition(".")
    found: Any = {
        "seconds": row.get("seconds", {}).get(second),
        "peak_memory_MiB": row.get("peak_memory_MiB"),
        "glb": row.get("glb", {}).get(second),
        "light": row.get("light", {}).get(key),
        "tensoir": row.get("published", {}).get(key),
        "orb": row.get("published", {}).get(key),
        "poses": row.get("poses", {}).get(key) if row["labels"]["poses"] == "estimate" else None,
    }
    return found[first] if first in found else row.get("regions", {}).get(REGION, {}).get(key)


def usable_rows(results: SuiteResults) -> list[SuiteRow]:
    """Rows with scores of the report's own code."""
    return [row for row in results["rows"] if "error" not in row and not is_stale(row, results)]


def varied_labels(rows: Sequence[SuiteRow], without: Sequence[str] = ()) -> list[str]:
    """Labels that differ between rows, in the order of the labels."""
    names = dict.fromkeys(name for row in rows for name in row["labels"])
    return [n for n in names if n not in without and len({str(row["labels"].get(n)) for row in rows}) > 1]


def of_object(results: SuiteResults) -> tuple[str, ...]:
    """Labels over which means are taken: the light belongs to the object unless the suite varies or compares it."""
    suite = results["suite"]
    varied = suite["plot"] == "light" or any("light" in each["ahead"] for each in suite["compare"])
    return ("object", "seed") if varied else ("object", "light", "seed")


def grouped(rows: Sequence[SuiteRow], labels: Sequence[str]) -> dict[tuple[Any, ...], list[SuiteRow]]:
    """Rows by the values of some labels, in the order of their first rows."""
    groups: dict[tuple[Any, ...], list[SuiteRow]] = {}
    for row in rows:
        groups.setdefault(tuple(row["labels"].get(name) for name in labels), []).append(row)
    return groups


# Comparisons ----------------------------------------------------------------------------------------------------------


def comparisons(results: SuiteResults) -> list[PairedDifference]:
    """The comparisons of the suite: by material and whatever else both sets have in common, for each score."""
    found = []
    rows = usable_rows(results)
    shown = varied_labels(rows, of_object(results))
    for about in results["suite"]["compare"]:
        fixed = {**about["ahead"], **about["behind"]}
        common = [name for name in shown if name not in fixed]
        ahead, behind = (
            {_rest(row, fixed): row for row in rows if about[side].items() <= row["labels"].items()}
            for side in ("ahead", "behind")
        )
        pairs = [(ahead[rest], behind[rest]) for rest in ahead if rest in behind]
        for group in dict.fromkeys(tuple(a["labels"].get(name) for name in common) for a, _ in pairs):
            of_group = [(a, b) for a, b in pairs if tuple(a["labels"].get(name) for name in common) == group]
            said = ", ".join(str(value) for value in group)
            found += [d for key in COMPARED if (d := _difference(about["title"], said, key, of_group))]
    return found


def _rest(row: SuiteRow, fixed: dict[str, Any]) -> tuple[Any, ...]:
    """The labels of a row that are not compared."""
    return tuple((name, value) for name, value in row["labels"].items() if name not in fixed)


def _difference(
    title: str, group: str, key: str, pairs: Sequence[tuple[SuiteRow, SuiteRow]]
) -> PairedDifference | None:
    by_object: dict[str, list[tuple[float, float]]] = {}
    for a, b in pairs:
        values = value_of(a, key), value_of(b, key)
        if values[0] is not None and values[1] is not None:
            by_object.setdefault(str(a["labels"]["object"]), []).append((values[0], values[1]))
    if not by_object:
        return None
    means = {name: [statistics.fmean(side) for side in zip(*both, strict=True)] for name, both in by_object.items()}
    differences = {name: a - b for name, (a, b) in sorted(means.items())}
    ahead, behind = (statistics.fmean(pair[side] for pair in means.values()) for side in (0, 1))
    return PairedDifference(title, group, key, ahead, behind, differences, _p_value(list(differences.values())))


def _p_value(differences: Sequence[float]) -> float | None:
    if len(differences) < 2 or not any(differences):
        return None
    from scipy import stats

    return float(stats.wilcoxon(differences, alternative="greater").pvalue)  # pyright: ignore


def comparison_table(results: SuiteResults) -> Table:
    """One line per comparison, group and score."""
    lines = []
    for found in comparisons(results):
        values = list(found.differences.values())
        behind = [name for name, value in found.differences.items() if value <= 0]
        spread = f" ± {statistics.stdev(values):.1f}" if len(values) > 1 else ""
        lines.append(
            (
                found.title,
                found.group or "all",
                METRICS[found.metric][0],
                f"{found.ahead:.1f}",
                f"{found.behind:.1f}",
                f"{statistics.fmean(values):+.1f}{spread}",
                f"{len(values) - len(behind)} of {len(values)}",
                ", ".join(behind) or NOTHING,
                NOTHING if found.p is None else f"{found.p:.3g}",
            )
        )
    about = (
        "Pairs of rows that differ in nothing else, averaged over seeds and lights of an object. After ±, the "
        "standard deviation over objects; p is the one-sided probability of such differences if neither were better "
        "(Wilcoxon signed-rank test over objects)."
    )
    headings = ("comparison", "of", "score", "first", "second", "difference", "objects ahead", "not ahead", "p")
    return Table("Comparisons", about, headings, lines)


# Means and rows -------------------------------------------------------------------------------------------------------


def mean_table(results: SuiteResults) -> Table:
    """One line per setting, material and so on: means over objects, with the spread over seeds."""
    rows = usable_rows(results)
    labels, keys = varied_labels(rows, of_object(results)), _keys(rows)
    lines = []
    for group, members in grouped(rows, labels).items():
        n = len({row["labels"]["object"] for row in members})
        lines.append((*map(str, group), str(n), *(_mean_and_spread(members, key) for key in keys)))
    about = (
        "Means over objects; after ±, their standard deviation over seeds. Object: over the object's pixels; "
        "picture: over the whole image. Unscaled albedo is compared without the albedo scale, in linear values."
    )
    return Table("Means", about, (*labels, "objects", *(METRICS[key][0] for key in keys)), lines)


def object_table(results: SuiteResults) -> Table:
    """One line per object, setting, material and so on, with the spread over seeds; empty if there is one seed."""
    rows = usable_rows(results)
    labels, keys = ["object", *varied_labels(rows, ("object", "seed"))], _keys(rows)
    groups = grouped(rows, labels).items() if len(grouped(rows, ("seed",))) > 1 else ()
    lines = [(*map(str, group), *(_mean_and_spread(members, key) for key in keys)) for group, members in groups]
    about = "Means over seeds; after ±, the standard deviation over seeds."
    return Table("Objects", about, (*labels, *(METRICS[key][0] for key in keys)), lines)


def _keys(rows: Sequence[SuiteRow]) -> list[str]:
    """Columns in which some row has a value."""
    return [key for key in METRICS if any(value_of(row, key) is not None for row in rows)]


def _mean_and_spread(rows: Sequence[SuiteRow], key: str) -> str:
    """Mean over objects, and the spread over seeds of the mean over the objects that all seeds have."""
    per_object = [_mean(members, key) for members in grouped(rows, ("object",)).values()]
    values = [value for value in per_object if value is not None]
    if not values:
        return NOTHING
    form = METRICS[key][1]
    by_seed = grouped(rows, ("seed",))
    shared = set.intersection(*({row["labels"]["object"] for row in members} for members in by_seed.values()))
    seeds = [_mean([r for r in members if r["labels"]["object"] in shared], key) for members in by_seed.values()]
    found = [value for value in seeds if value is not None]
    spread = f" ± {form.format(statistics.stdev(found))}" if len(found) > 1 else ""
    return form.format(statistics.fmean(values)) + spread


def _mean(rows: Sequence[SuiteRow], key: str) -> float | None:
    values = [value for row in rows if (value := value_of(row, key)) is not None and math.isfinite(value)]
    return statistics.fmean(values) if values else None


def row_table(results: SuiteResults) -> Table:
    """One line per row with scores, those of other code included and marked."""
    rows = [row for row in results["rows"] if "error" not in row]
    labels, keys = ["object", *varied_labels(rows, ("object",))], _keys(rows)
    lines = []
    for row in rows:
        cells = [_cell(value_of(row, key), METRICS[key][1].format) for key in keys]
        names = [str(row["labels"].get(name, NOTHING)) for name in labels]
        lines.append((*names, *cells, "stale" if is_stale(row, results) else "current"))
    headings = (*labels, *(METRICS[key][0] for key in keys), "code")
    return Table("Rows", "Stale rows were measured with other code; no mean contains them.", headings, lines)


def _cell(value: float | None, form: Callable[[float], str]) -> str:
    return NOTHING if value is None else form(value)


def problem_table(results: SuiteResults) -> Table:
    """Cases without scores: those that failed, and those that were never measured."""
    measured = {row["name"] for row in results["rows"]}
    lines = [(row["name"], _text(row["error"])) for row in results["rows"] if "error" in row]
    lines += [(name, "not measured") for name in results["cases"] if name not in measured]
    return Table("Without scores", "", ("row", "reason"), lines)


def _text(reason: str) -> str:
    return reason.replace("|", "/")
