"""Prints the rows of `benchmarks/decomposition.json` as the tables of the claim, in Markdown.

`python -m benchmarks.claim [decomposition.json]`. "shared" counts the evaluation views that all settings have seen,
"all" those of both regions. PSNR [dB] of sRGB pictures, fg over the object's pixels, full over the picture.
"""

import json
import statistics
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

SETTINGS = ("handheld", "turntable", "dome")
UNIFORM = "white"
"""A light that says nothing about the claim: there is nothing to be confused."""
Row = dict[str, Any]


def main() -> None:
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("decomposition.json")
    rows = json.loads(path.read_text())["rows"]
    for seed in sorted({row["recipe"]["seed"] for row in rows}):
        plain = [row for row in rows if row["recipe"]["seed"] == seed and "ablation" not in row["recipe"]]
        print(f"\n## Seed {seed}\n")
        print("\n".join([*claim(plain), "", *level(plain)]))
    print("\n## Ablations\n")
    print("\n".join(ablations(rows)))


def claim(rows: list[Row]) -> list[str]:
    """Hand-held, turntable and dome side by side, each capture a line, shared views."""
    lines = [
        "| light | material | object | albedo fg: hand-held | turntable | dome | hand - dome "
        "| relit fg: hand-held | turntable | dome | hand - dome |",
        "|" + "---|" * 11,
    ]
    gaps: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for (material, env, model), group in _groups(rows, ("material", "env", "model")):
        found = {row["made_by"]["setting"]: row["shared"] for row in group}
        if not {"handheld", "dome"} <= found.keys():
            continue
        cells, gap = [], []
        for key in ("albedo.psnr_fg_srgb", "relit.psnr_fg_srgb"):
            values = [found[s][key] if s in found else None for s in SETTINGS]
            gap.append(found["handheld"][key] - found["dome"][key])
            cells += ["-" if v is None else f"{v:.1f}" for v in values] + [f"{gap[-1]:+.1f}"]
        for lights in (_stem(env), *(["all"] if env != UNIFORM else [])):
            gaps.setdefault((material, lights), []).append((gap[0], gap[1]))
        lines.append(f"| {_stem(env)} | {material} | {_stem(model)} | " + " | ".join(cells) + " |")
    for (material, lights), found in sorted(gaps.items()):
        albedo, relit = (statistics.fmean(g[i] for g in found) for i in (0, 1))
        about = f"| {lights} | {material} | mean of {len(found)} |"
        lines.append(f"{about} | | | **{albedo:+.1f}** | | | | **{relit:+.1f}** |")
    return lines


def level(rows: list[Row]) -> list[str]:
    """Hand-held captures, all evaluation views, with time and memory."""
    lines = [
        "| light | material | object | albedo fg / full | relit fg / full | image fg / full | normal [deg] | IoU "
        "| run [s] | score [s] | memory [MiB] |",
        "|" + "---|" * 11,
    ]
    hand = [row for row in rows if row["made_by"]["setting"] == "handheld" and row["made_by"]["env"] != UNIFORM]
    for (material,), group in _groups(hand, ("material",)):
        for row in [*group, None]:
            picked = group if row is None else [row]
            pairs = [
                " / ".join(f"{_mean(picked, f'{name}.psnr_{part}_srgb'):.1f}" for part in ("fg", "full"))
                for name in ("albedo", "relit", "image")
            ]
            about = ["mean", material, ""]
            if row is not None:
                about = [_stem(row["made_by"]["env"]), material, _stem(row["made_by"]["model"])]
            rest = [f"{_mean(picked, 'normal.mean_fg_degrees'):.1f}", f"{_mean(picked, 'silhouette.iou'):.3f}"]
            for key in ("run_seconds", "score_seconds", "peak_memory_MiB"):
                known = [r[key] for r in picked if r[key] is not None]
                rest.append(f"{statistics.fmean(known):.0f}" if known else "-")
            lines.append("| " + " | ".join([*about, *pairs, *rest]) + " |")
    return lines


def ablations(rows: list[Row]) -> list[str]:
    """What each part is worth on the captures that it was left out of."""
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
    found: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        found.setdefault(tuple(row["made_by"][key] for key in keys), []).append(row)
    return sorted(found.items())


def _mean(rows: list[Row], key: str) -> float:
    """Over rows, and over both regions by their number of views."""
    values = []
    for row in rows:
        counts = {region: row["made_by"][f"eval_{region}"] for region in ("shared", "sphere")}
        values.append(sum(row[region][key] * n for region, n in counts.items()) / sum(counts.values()))
    return statistics.fmean(values)


def _stem(name: str) -> str:
    return Path(name).stem.removesuffix("_1k")


if __name__ == "__main__":
    main()
