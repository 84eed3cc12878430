"""Line plots of scores along the numeric or named label that a suite varies, as SVG with the page's colours."""

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from tumble.bench import tables
from tumble.bench.rows import SuiteResults, SuiteRow

PLOTTED = ("albedo.psnr_fg_srgb", "relit.psnr_fg_srgb", "light.log_correlation", "roughness.rmse_fg")
"""Scores that are drawn."""
COLOURS = ("#1f6f78", "#d2691e", "#6a4fb3", "#2c7a4b", "#b3261e", "#8a8b90")
"""Colours of the lines; each has its name beside its end."""
WIDTH, HEIGHT, MARGIN = 420, 240, 44
"""Size of a plot and of the space for the axes' numbers [SVG units]."""
Line = list[tuple[int, float]]


@dataclass(frozen=True)
class LinePlot:
    """A plot of one score."""

    title: str
    file: str
    """Name of its file beside the tables."""
    svg: Markup


def line_plots(results: SuiteResults) -> list[LinePlot]:
    """A plot of each score: means over objects and seeds, one line per setting, material and so on."""
    along = results["suite"]["plot"]
    rows = [row for row in tables.usable_rows(results) if along in row["labels"]]
    if not along or not rows:
        return []
    values = list(dict.fromkeys(row["labels"][along] for row in rows))
    numbers = [value for value in values if isinstance(value, int | float)]
    values = sorted(numbers) if len(numbers) == len(values) else values
    of_object = tables.of_object(results)
    labels = tables.varied_labels(rows, (*of_object, along))
    same = [name for name in of_object if name != along]
    plots = []
    for key in PLOTTED:
        lines: dict[str, Line] = {}
        for group, members in tables.grouped(rows, labels).items():
            if means := _means(members, key, along, same):
                name = ", ".join(map(str, group)) or "all"
                lines[name] = [(values.index(value), mean) for value, mean in means.items()]
        if lines:
            title, file = f"{tables.METRICS[key][0]} by {along}", f"{results['name']}-{key.replace('.', '-')}.svg"
            plots.append(LinePlot(title, file, _plot(lines, [str(value) for value in values])))
    return plots


def _means(rows: Sequence[SuiteRow], key: str, along: str, same: Sequence[str]) -> dict[Any, float]:
    """Mean scores by the values of a label, over the objects, lights and seeds (labels `same`) that all values have.

    Otherwise the line would show which rows failed, or were not measured, as if it were an effect of the label.
    """
    at: dict[Any, dict[tuple[Any, ...], float]] = {}
    for row in rows:
        score = tables.value_of(row, key)
        if score is not None:
            at.setdefault(row["labels"][along], {})[tuple(row["labels"].get(name) for name in same)] = score
    shared = set.intersection(*map(set, at.values())) if at else set()
    return {value: statistics.fmean(scores[each] for each in shared) for value, scores in at.items() if shared}


def _plot(lines: dict[str, Line], names: Sequence[str]) -> Markup:
    """Lines over equally spaced names; the vertical axis ends at the smallest and largest value."""
    scores = [score for line in lines.values() for _, score in line]
    low, high = min(scores), max(scores)
    span = high - low or 1.0

    def x(i: int) -> float:
        return MARGIN + (WIDTH - 3 * MARGIN) * (i / max(1, len(names) - 1))

    def y(score: float) -> float:
        return HEIGHT - MARGIN / 2 - (HEIGHT - MARGIN) * (score - low) / span

    text = Markup('<text x="{:.0f}" y="{:.0f}" text-anchor="{}">{}</text>').format
    parts = [text(MARGIN - 6, y(value) + 4, "end", f"{value:.3g}") for value in ((low, high) if high > low else (low,))]
    parts += [text(x(i), HEIGHT - 4, "middle", name) for i, name in enumerate(names)]
    for number, (name, line) in enumerate(lines.items()):
        colour, line = COLOURS[number % len(COLOURS)], sorted(line)
        steps = " L".join(f"{x(i):.1f} {y(score):.1f}" for i, score in line)
        dots = "".join(f'<circle cx="{x(i):.1f}" cy="{y(s):.1f}" r="3" fill="{colour}"/>' for i, s in line)
        parts.append(Markup(f'<path d="M{steps}" fill="none" stroke="{colour}" stroke-width="2"/>{dots}'))
        label = Markup('<text x="{:.0f}" y="{:.0f}" style="fill:{}">{}</text>')
        parts.append(label.format(x(line[-1][0]) + 8, y(line[-1][1]) + 4, colour, name))
    return Markup(
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {} {}" font-family="sans-serif" font-size="11">{}</svg>'
    ).format(WIDTH, HEIGHT, Markup("").join(parts))
