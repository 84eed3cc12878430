"""Small line graphics as SVG whose colours come from the page's style sheet: bars, curves, camera paths.

All that is drawn are numbers and the ratings of `health_card`, so that the graphics are safe `Markup` as they are.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from markupsafe import Markup

RADIUS = 100
"""Radius of a globe [SVG units]."""
MAX_VALUE = float(np.finfo(np.float32).max)
"""Largest value of a curve, beyond that of any loss."""


def bars(values: Sequence[float], marks: Sequence[str]) -> Markup:
    """Bar chart with one bar per frame, coloured by its mark; "" without a positive value. NaN leaves a gap."""
    top = max((value for value in values if not math.isnan(value)), default=0.0)
    if top <= 0:
        return Markup("")
    shapes = [
        f'<rect class="b-{mark}" x="{i + 0.1:.1f}" y="{100 * (1 - value / top):.2f}" width="0.8" '
        f'height="{100 * value / top:.2f}"/>'
        for i, (value, mark) in enumerate(zip(values, marks, strict=True))
        if not math.isnan(value)
    ]
    title = f"One bar per frame; the highest is {top:.3g}"
    return Markup(
        f'<svg viewBox="0 0 {len(values)} 100" preserveAspectRatio="none" role="img"><title>{title}</title>'
        f"{''.join(shapes)}</svg>"
    )


def curve(values: Sequence[float]) -> Markup:
    """Line chart of equally spaced values, on a logarithmic scale if all are positive; "" for less than two values.

    Values that no loss has are left out: NaN, infinities, and those beyond the range of 32-bit floats.
    """
    values = [value for value in values if abs(value) <= MAX_VALUE]
    if len(values) < 2:
        return Markup("")
    y = np.log(values) if min(values) > 0 else np.asarray(values)
    y = (y - y.min()) / max(float(np.ptp(y)), 1e-9)
    steps = " L".join(f"{100 * i / (len(y) - 1):.1f} {4 + 92 * (1 - v):.1f}" for i, v in enumerate(y))
    return Markup(f'<svg viewBox="0 0 100 100" preserveAspectRatio="none"><path d="M{steps}"/></svg>')


def globes(positions: Float[np.ndarray, "t 3"]) -> Markup:
    """Camera path around the object in the object frame, on a globe drawn from two opposite sides, +y up."""
    d = positions / np.linalg.norm(positions, axis=-1, keepdims=True)
    width = 4 * RADIUS + 60
    sides = "".join(
        _globe(d, azimuth, tilt, 15 + RADIUS + i * (2 * RADIUS + 30))
        for i, (azimuth, tilt) in enumerate(((0.5, 0.35), (0.5 + math.pi, -0.35)))
    )
    return Markup(f'<svg viewBox="0 0 {width} {2 * RADIUS + 40}" role="img"><title>Camera path</title>{sides}</svg>')


def _globe(d: Float[np.ndarray, "t 3"], azimuth: float, tilt: float, centre: float) -> str:
    cos, sin = math.cos(azimuth), math.sin(azimuth)
    R = np.array([[1, 0, 0], [0, math.cos(tilt), -math.sin(tilt)], [0, math.sin(tilt), math.cos(tilt)]]) @ np.array(
        [[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]]
    )

    def at(x: np.ndarray) -> str:
        return f"{centre + RADIUS * x[0]:.1f} {RADIUS + 12 - RADIUS * x[1]:.1f}"

    angles = np.linspace(0, 2 * math.pi, 73)
    rings = [
        np.stack([math.cos(v) * np.cos(angles), np.full_like(angles, math.sin(v)), math.cos(v) * np.sin(angles)], -1)
        for v in (-math.pi / 3, -math.pi / 6, 0.0, math.pi / 6, math.pi / 3)
    ]
    rings += [
        np.stack([np.cos(angles) * math.cos(u), np.sin(angles), np.cos(angles) * math.sin(u)], -1)
        for u in np.arange(6) * math.pi / 6
    ]
    lines = "".join(f'<path d="{_near_side_path(ring @ R.T, at)}"/>' for ring in rings)
    camera_path = d @ R.T
    track = f'<path d="{_near_side_path(camera_path, at)}"/>'
    dots = "".join(
        f'<circle cx="{at(x).split()[0]}" cy="{at(x).split()[1]}" r="3.6" fill="{_colour(i / max(1, len(d) - 1))}"/>'
        for i, x in enumerate(camera_path)
        if x[2] >= 0
    )
    return (
        f'<circle cx="{centre}" cy="{RADIUS + 12}" r="{RADIUS}" fill="var(--tile)" stroke="var(--line)"/>'
        f'<g fill="none" stroke="var(--line)">{lines}</g>'
        f'<g fill="none" stroke="var(--soft)" stroke-opacity=".45">{track}</g>{dots}'
    )


def _near_side_path(points: Float[np.ndarray, "n 3"], at) -> str:
    """SVG path of the parts of a polyline that lie on the near side of the globe."""
    commands, before = [], False
    for x in points:
        near = bool(x[2] >= 0)
        if near:
            commands.append(("L" if before else "M") + at(x))
        before = near
    return "".join(commands)


def _colour(fraction: float) -> str:
    """Colour by time, from blue (first frame) over green to orange (last); readable on light and dark pages."""
    return f"hsl({215 - 185 * fraction:.0f} 65% 52%)"
