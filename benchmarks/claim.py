"""Tables of the paper's claim in Markdown, from the rows of `benchmarks/decomposition.json`.

`python -m benchmarks.claim [decomposition.json]` prints them. The comparison of capture settings uses the evaluation
views of region "shared", the table of hand-held captures those of both regions. PSNR [dB] of sRGB images, "fg" over
the object's pixels, "full" over the image.
"""

import json
import statistics
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

SETTINGS = ("handheld", "turntable", "dome")
"""Capture settings in the order of the columns."""
UNIFORM = "white"
"""The uniform light, which is left out of the means: it has no structure that could be mistaken for albedo."""
Row = dict[str, Any]


def main() -> None:
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("decomposition.json")
    rows = json.loads(path.read_text())["rows"]
    for seed in sorted({row["recipe"]["seed"] for row in rows}):
        plain = [row for row in rows if row["recipe"]["seed"] == seed and "ablation" not in row["recipe"]]
        print(f"\n## Seed {seed}\n")
        print("\n".join([*setting_table(plain), "", *handheld_table(plain)]))
    print("\n## Ablations\n")
    print("\n".join(ablation_table(rows)))


def setting_table(rows: list[Row]) -> list[str]:
    """Scores of hand-held, turntable and dome capture side by side, one line per object and light, shared views."""
    lines = [
        "| light | material | object | albedo fg: hand-held | turntable | dome | hand - dome "
        "| relit fg: hand-held | turntable | dome | hand - dome |",
        "|" + "---|" * 11,
    ]
    gaps: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for (material, env, model), group in _groups(rows, ("material", "env", "model")):
        scores = {row["made_by"]["setting"]: row["shared"] for row in group}
        if not {"handheld", "dome"} <= scores.keys():
            continue
        cells, gap = [], []
        for key in ("albedo.psnr_fg_srgb", "relit.psnr_fg_srgb"):
            values = [scores[s][key] if s in scores else None for s in SETTINGS]
            gap.append(scores["handheld"][key] - scores["dome"][key])
            cells += ["-" if v is None else f"{v:.1f}" for v in values] + [f"{gap[-1]:+.1f}"]
        for lights in (_stem(env), *(["all"] if env != UNIFORM else [])):
            gaps.setdefault((material, lights), []).append((gap[0], gap[1]))
        lines.append(f"| {_stem(env)} | {material} | {_stem(model)} | " + " | ".join(cells) + " |")
    for (material, lights), gap_list in sorted(gaps.items()):
        albedo, relit = (statistics.fmean(g[i] for g in gap_list) for i in (0, 1))
        label = f"| {lights} | {material} | mean of {len(gap_list)} |"
        lines.append(f"{label} | | | **{albedo:+.1f}** | | | | **{relit:+.1f}** |")
    return lines


def handheld_table(rows: list[Row]) -> list[str]:
    """Scores of hand-held captures over all evaluation views, with time and memory."""
    lines = [
        "| light | material | object | albedo fg / full | relit fg / full | image fg / full | normal [deg] | IoU "
        "| run [s] | score [s] | memory [MiB] |",
        "|" + "---|" * 11,
    ]
    handheld = [row for row in rows if row["made_by"]["setting"] == "handheld" and row["made_by"]["env"] != UNIFORM]
    for (material,), group in _groups(handheld, ("material",)):
        for row in [*group, None]:
            selected = group if row is None else [row]
            pairs = [
                " / ".join(f"{_mean(selected, f'{name}.psnr_{part}_srgb'):.1f}" for part in ("fg", "full"))
                for name in ("albedo", "relit", "image")
            ]
            labels = ["mean", material, ""]
            if row is not None:
                labels = [_stem(row["made_by"]["env"]), material, _stem(row["made_by"]["model"])]
            others = [f"{_mean(selected, 'normal.mean_fg_degrees'):.1f}", f"{_mean(selected, 'silhouette.iou'):.3f}"]
            for key in ("run_seconds", "score_seconds", "peak_memory_MiB"):
                values = [r[key] for r in selected if r[key] is not None]
                others.append(f"{statistics.fmean(values):.0f}" if values else "-")
            lines.append("| " + " | ".join([*labels, *pairs, *others]) + " |")
    return lines


def ablation_table(rows: list[Row]) -> list[str]:
    """Scores of each ablation, on shared views, beside those of the method on the same captures."""
    lines = ["| capture | without / instead | albedo fg | relit fg | normal [deg] |", "|---|---|---|---|---|"]
    for (model, env, setting, material), group in _groups(rows, ("model", "env", "setting", "material")):
        if not any("ablation" in row["recipe"] for row in group):
            continue
        for row in sorted(group, key=lambda row: row["recipe"].get("ablation", "")):
            if row["recipe"]["seed"] != 0:
                continue
            name = row["recipe"].get("ablation", "(the method)")
            scores = [row["shared"][k] for k in ("albedo.psnr_fg_srgb", "relit.psnr_fg_srgb", "normal.mean_fg_degrees")]
            capture = f"{_stem(model)} {_stem(env)} {setting} {material}"
            lines.append(f"| {capture} | {name} | " + " | ".join(f"{s:.2f}" for s in scores) + " |")
    return lines


def _groups(rows: list[Row], keys: tuple[str, ...]) -> Iterable[tuple[tuple[str, ...], list[Row]]]:
    """Rows grouped by the given options of their captures, in sorted order."""
    groups: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row["made_by"][key] for key in keys), []).append(row)
    return sorted(groups.items())


def _mean(rows: list[Row], key: str) -> float:
    """Mean of a score over rows and over both regions, weighted by their numbers of views."""
    values = []
    for row in rows:
        counts = {region: row["made_by"][f"eval_{region}"] for region in ("shared", "sphere")}
        values.append(sum(row[region][key] * n for region, n in counts.items()) / sum(counts.values()))
    return statistics.fmean(values)


def _stem(name: str) -> str:
    """The name of a file without its ending and without the resolution of a light map."""
    return Path(name).stem.removesuffix("_1k")


if __name__ == "__main__":
    main()
