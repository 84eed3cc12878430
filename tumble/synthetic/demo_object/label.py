"""Base colour and roughness textures of the pot, drawn with Pillow.

Each chart of the texture atlas is drawn on a `Canvas`, whose shapes have an `Ink`: a colour and a roughness. Positions
are pixels of the chart, x to the right and y down.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

SUPERSAMPLING = 2
"""Factor between the resolution at which charts are drawn and that at which they are stored; pixels are averaged."""
DARKEST = 57
"""sRGB code value of the darkest ink: linear albedo 0.04."""
BRIGHTEST = 236
"""sRGB code value of the brightest ink: linear albedo 0.84."""

Point = tuple[float, float]


@dataclass(frozen=True)
class Ink:
    """Material of a drawn shape."""

    rgb: tuple[int, int, int]
    """sRGB code values, DARKEST to BRIGHTEST."""
    roughness: float
    """Perceptual roughness."""


CREAM = Ink((234, 223, 198), 0.34)
PAPER = Ink((236, 229, 212), 0.76)
NIGHT = Ink((57, 64, 82), 0.55)
TEAL = Ink((57, 112, 114), 0.30)
GLOSS = Ink((57, 104, 110), 0.15)
LEAF = Ink((94, 134, 104), 0.45)
CORAL = Ink((216, 97, 74), 0.40)
MUSTARD = Ink((228, 172, 72), 0.45)
BLUSH = Ink((232, 178, 152), 0.50)
SKY = Ink((150, 190, 196), 0.60)
WOOD = Ink((164, 108, 68), 0.58)
BARK = Ink((120, 74, 57), 0.66)
BRIGHT = (CORAL, MUSTARD, CREAM, SKY, BLUSH)
"""Inks of small ornaments on dark ground."""


class Canvas:
    """Colour and roughness images of one chart, drawn together; mutable, like the Pillow images that it holds."""

    def __init__(self, width: int, height: int, background: Ink) -> None:
        size = (width * SUPERSAMPLING, height * SUPERSAMPLING)
        self.width, self.height = width, height
        self._layers = (Image.new("RGB", size, background.rgb), Image.new("L", size, _code(background)))
        self._brushes = tuple(ImageDraw.Draw(layer) for layer in self._layers)

    def polygon(self, points: list[Point], ink: Ink) -> None:
        """Draw a filled polygon."""
        for brush, fill in zip(self._brushes, (ink.rgb, _code(ink)), strict=True):
            brush.polygon([(SUPERSAMPLING * x, SUPERSAMPLING * y) for x, y in points], fill=fill)

    def box(self, left: float, top: float, right: float, bottom: float, ink: Ink, *, corner: float = 0) -> None:
        """Draw a filled rectangle; `corner` is the radius of its rounded corners."""
        edges = [
            SUPERSAMPLING * left,
            SUPERSAMPLING * top,
            SUPERSAMPLING * right - 1,
            SUPERSAMPLING * bottom - 1,
        ]
        for brush, fill in zip(self._brushes, (ink.rgb, _code(ink)), strict=True):
            brush.rounded_rectangle(edges, SUPERSAMPLING * corner, fill=fill)

    def disc(self, x: float, y: float, radius: float, ink: Ink) -> None:
        """Draw a filled circle."""
        self.polygon([(x + radius * math.cos(a), y + radius * math.sin(a)) for a in _angles(48)], ink)

    def star(self, x: float, y: float, radius: float, ink: Ink, *, tips: int = 5, waist: float = 0.45) -> None:
        """Draw a filled star with one tip upwards; `waist` is the ratio of inner to outer radius."""
        radii = [radius, waist * radius] * tips
        corners = zip(radii, _angles(2 * tips), strict=True)
        self.polygon([(x + r * math.sin(a), y - r * math.cos(a)) for r, a in corners], ink)

    def leaf(self, x: float, y: float, length: float, angle: float, ink: Ink) -> None:
        """Draw a pointed leaf with its base at (x, y); its angle is clockwise from upwards [radians]."""
        sides = [(t, 0.24 * math.sin(math.pi * t) ** 0.8) for t in np.linspace(0, 1, 12)]
        contour = sides + [(t, -w) for t, w in reversed(sides)]
        s, c = math.sin(angle), math.cos(angle)
        self.polygon([(x + length * (t * s + w * c), y - length * (t * c - w * s)) for t, w in contour], ink)

    def text(
        self, x: float, y: float, words: str, size: float, ink: Ink, *, bold: float = 0, rotation: float = 0
    ) -> None:
        """Draw words centred on (x, y), with strokes wider by `bold`, rotated clockwise by `rotation` [radians]."""
        font = ImageFont.load_default(size=size * SUPERSAMPLING)
        stroke = round(bold * SUPERSAMPLING)
        left, top, right, bottom = font.getbbox(words, stroke_width=stroke)
        # The height of a capital letter instead of that of the words: lines of text keep their distance.
        middle = (font.getbbox("H")[1] + font.getbbox("H")[3]) / 2
        half = math.ceil(max(right - left, bottom - top) / 2 + size * SUPERSAMPLING)
        stencil = Image.new("L", (2 * half, 2 * half))
        corner = (half - (left + right) / 2, half - middle)
        ImageDraw.Draw(stencil).text(corner, words, 255, font, stroke_width=stroke)
        stencil = stencil.rotate(-math.degrees(rotation), Image.Resampling.BICUBIC)
        top_left = (round(SUPERSAMPLING * x) - half, round(SUPERSAMPLING * y) - half)
        for layer, fill in zip(self._layers, (ink.rgb, _code(ink)), strict=True):
            layer.paste(fill, top_left, stencil)

    def round_text(
        self, radius: float, words: str, size: float, ink: Ink, *, bold: float = 0, clockwise: bool = True
    ) -> None:
        """Draw words along a whole circle around the centre, with the feet of the letters inwards if clockwise, else
        outwards."""
        sense = 1 if clockwise else -1
        for letter, angle in zip(words, _angles(len(words)), strict=True):
            x, y = radius * math.sin(angle), -sense * radius * math.cos(angle)
            self.text(self.width / 2 + x, self.height / 2 + y, letter, size, ink, bold=bold, rotation=sense * angle)

    def textures(self) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w 1"]]:
        """Colour (sRGB) and roughness textures at the size of the chart."""
        colour, roughness = (np.asarray(layer.reduce(SUPERSAMPLING)) for layer in self._layers)
        return colour.clip(DARKEST, BRIGHTEST), roughness[..., None]


def _code(ink: Ink) -> int:
    """Roughness as an 8-bit code value."""
    return round(255 * ink.roughness)


def _angles(n: int) -> list[float]:
    """`n` equally spaced angles of a revolution, from 0 [radians]."""
    return [2 * math.pi * i / n for i in range(n)]


def paint(name: str, width: int, height: int) -> Canvas:
    """Draw the textures of one chart of the pot, by the chart's name."""
    painters = {"body": _body, "lid": _lid, "base": _base, "spout": _spout, "handle": _handle, "knob": _knob}
    canvas = Canvas(width, height, GLOSS if name == "lid_under" else TEAL)
    if name in painters:
        painters[name](canvas)
    return canvas


def _body(canvas: Canvas) -> None:
    """The pot's wall: a landscape on the back, the label in front, sprigs around spout and handle, two friezes."""
    canvas.box(0, 0, canvas.width, canvas.height, CREAM)
    rng = np.random.default_rng(7)
    _sprigs(canvas, rng)
    _borders(canvas, rng)
    _landscape(canvas, 254, 149)
    _label(canvas, 762, 149)


def _borders(canvas: Canvas, rng: np.random.Generator) -> None:
    """A frieze above and one below with random ornaments, so that they do not repeat around the pot."""
    canvas.box(0, 0, canvas.width, 46, TEAL)
    canvas.box(0, 46, canvas.width, 50, MUSTARD)
    canvas.box(0, 246, canvas.width, 250, CORAL)
    canvas.box(0, 250, canvas.width, canvas.height, NIGHT)
    for i in range(32):
        x, ink = 16 + 31.75 * i, BRIGHT[rng.integers(5)]
        size = 5 + 4 * rng.random()
        (canvas.disc if rng.random() < 0.5 else canvas.star)(x, 32, size, ink)
        height = 10 + 12 * rng.random()
        canvas.polygon(
            [(x - 13, 278), (x + 13, 278), (x + 8 * rng.random() - 4, 278 - height)], BRIGHT[rng.integers(5)]
        )


def _sprigs(canvas: Canvas, rng: np.random.Generator) -> None:
    """Leaves and berries around the spout and the handle."""
    for x in (32, 466, 508, 548, 984):
        tall, lean = 90 + 80 * rng.random(), 0.5 * rng.random() - 0.25
        for i in range(9):
            t = i / 8
            at = (x + lean * t * tall + 6 * math.sin(4 * t), 244 - t * tall)
            side = 0.95 if i % 2 else -0.95
            ink = (TEAL, LEAF, MUSTARD, CORAL)[rng.integers(4)] if i < 8 else CORAL
            canvas.leaf(*at, 34 - 14 * t, side * (1 - 0.6 * t) + lean, ink)
    for _ in range(90):
        x, y = rng.random() * canvas.width, 58 + 180 * rng.random()
        if min(abs(x - 254), abs(x - 762)) < 184:
            continue
        canvas.disc(x, y, 1.5 + 2.5 * rng.random(), BRIGHT[rng.integers(2)] if rng.random() < 0.7 else NIGHT)


def _landscape(canvas: Canvas, x: float, y: float) -> None:
    """A landscape centred on (x, y), mostly in matte inks: sun, two ranges of hills, firs and a tent."""
    left, top, right, bottom = x - 160, y - 84, x + 160, y + 82
    canvas.box(left - 5, top - 5, right + 5, bottom + 5, NIGHT, corner=12)
    canvas.box(left, top, right, bottom, SKY, corner=8)
    canvas.disc(x + 62, y - 26, 34, Ink(MUSTARD.rgb, 0.20))
    canvas.disc(x + 62, y - 26, 25, Ink(CORAL.rgb, 0.20))
    for bumps, ink in (((34, 78, 40, 96, 60, 84, 30), Ink(BLUSH.rgb, 0.7)), ((66, 30, 54, 18, 40, 26, 58), TEAL)):
        ridge = [(left + 320 * i / 6, bottom - 22 - height) for i, height in enumerate(bumps)]
        canvas.polygon([(left, bottom), *ridge, (right, bottom)], ink)
    canvas.box(left, bottom - 32, right, bottom, Ink(LEAF.rgb, 0.8), corner=8)
    for i, (dx, size) in enumerate([(-138, 62), (-112, 44), (-84, 72), (20, 38), (112, 56), (138, 40)]):
        for k in range(3):
            w, base = size * (0.30 - 0.07 * k), bottom - 12 - size * 0.25 * k
            ink = NIGHT if i % 2 else Ink((57, 86, 78), 0.7)
            canvas.polygon([(x + dx - w, base), (x + dx + w, base), (x + dx, base - size * 0.5)], ink)
    canvas.polygon([(x - 52, bottom - 8), (x + 8, bottom - 8), (x - 22, bottom - 50)], CORAL)
    canvas.polygon([(x - 32, bottom - 8), (x - 12, bottom - 8), (x - 22, bottom - 36)], NIGHT)
    canvas.text(x - 92, top + 24, "CAMP No 7", 20, NIGHT, bold=1)
    for i in range(7):
        canvas.star(left + 16 + 23 * i, top + 46 + 7 * (i % 3), 2.5 + i % 3, PAPER, tips=4, waist=0.3)


def _label(canvas: Canvas, x: float, y: float) -> None:
    """A paper label centred on (x, y): name, ornaments, colour bar, small text."""
    left, top, right, bottom = x - 170, y - 86, x + 170, y + 84
    canvas.box(left - 4, top - 4, right + 4, bottom + 4, TEAL, corner=16)
    canvas.box(left, top, right, bottom, PAPER, corner=13)
    canvas.text(x + 4, y - 29, "tumble", 86, Ink(MUSTARD.rgb, 0.7), bold=4)
    canvas.text(x, y - 33, "tumble", 86, Ink(CORAL.rgb, 0.25), bold=3)
    canvas.box(left + 14, y + 16, right - 14, y + 19, NIGHT)
    canvas.text(x - 50, y + 32, "TURN IT IN THE LIGHT", 17, NIGHT, bold=0.6)
    for i, ink in enumerate((CORAL, MUSTARD, LEAF, TEAL, SKY, BLUSH, WOOD, NIGHT)):
        canvas.box(left + 16 + 24 * i, y + 46, left + 38 + 24 * i, y + 70, Ink(ink.rgb, 0.7), corner=3)
    canvas.star(right - 46, y + 48, 33, Ink(MUSTARD.rgb, 0.3), tips=14, waist=0.78)
    canvas.text(right - 46, y + 43, "0.33", 19, NIGHT, bold=0.8)
    canvas.text(right - 46, y + 58, "LITRE", 9, NIGHT, bold=0.4)
    for dx, dy, size, ink in (
        (-154, -72, 7, TEAL),
        (152, -66, 9, MUSTARD),
        (138, -76, 5, CORAL),
        (-155, -52, 4, CORAL),
    ):
        canvas.star(x + dx, y + dy, size, ink)
    canvas.text(x - 78, y + 77, "shape - motion - material - light", 9.5, NIGHT, bold=0.2)


def _lid(canvas: Canvas) -> None:
    """Glossy enamel: a sun with unequal rays and a motto around it."""
    cx, cy = canvas.width / 2, canvas.height / 2
    canvas.box(0, 0, canvas.width, canvas.height, GLOSS)
    canvas.disc(cx, cy, 67, Ink(NIGHT.rgb, 0.2))
    for i, angle in enumerate(_angles(18)):
        reach, ink = 52 + (i * 7) % 12, Ink(BRIGHT[(i * i + i // 5) % 3].rgb, 0.2)
        spread = [(angle - 0.10, 24), (angle + 0.10, 24), (angle + 0.05, reach), (angle - 0.05, reach)]
        canvas.polygon([(cx + r * math.sin(a), cy - r * math.cos(a)) for a, r in spread], ink)
    canvas.disc(cx, cy, 30, Ink(MUSTARD.rgb, 0.2))
    canvas.round_text(76, "TURN * LOOK * TURN AGAIN * TUMBLE * ", 17, Ink(CREAM.rgb, 0.2), bold=0.7, clockwise=False)
    for i, angle in enumerate(_angles(40)):
        ink = Ink(BRIGHT[(i * i // 3 + i) % 5].rgb, 0.2)
        canvas.disc(cx + 94 * math.sin(angle), cy - 94 * math.cos(angle), 2.2 + (i * 5 % 3), ink)


def _base(canvas: Canvas) -> None:
    """The underside: a maker's mark."""
    cx, cy = canvas.width / 2, canvas.height / 2
    canvas.box(0, 0, canvas.width, canvas.height, NIGHT)
    canvas.disc(cx, cy, 92, MUSTARD)
    canvas.disc(cx, cy, 68, Ink(PAPER.rgb, 0.7))
    canvas.round_text(80, "MADE BY CODE - KEEP TURNING - BATCH 2026 - ", 15, NIGHT, bold=0.7)
    canvas.text(cx - 26, cy - 24, "7", 64, CORAL, bold=3)
    canvas.star(cx + 22, cy - 34, 18, TEAL, tips=6)
    canvas.text(cx + 22, cy - 8, "CODE", 14, NIGHT, bold=0.6)
    widths = (2, 1, 3, 1, 1, 2, 4, 1, 2, 1, 3, 2, 1, 1, 4, 1, 2, 3)
    for i, width in enumerate(widths):
        left = cx - 46 + sum(widths[:i]) + 2.2 * i
        canvas.box(left, cy + 14, left + width, cy + 40, NIGHT)
    for i, ink in enumerate((CORAL, MUSTARD, LEAF, TEAL)):
        canvas.box(cx - 29 + 15 * i, cy + 45, cx - 17 + 15 * i, cy + 57, ink)


def _spout(canvas: Canvas) -> None:
    """The spout: dark inside, a coral mouth, and rings, dots and stars on teal enamel below."""
    canvas.box(0, 0, canvas.width, 22, Ink(BARK.rgb, 0.5))
    canvas.box(0, 22, canvas.width, 46, CORAL)
    canvas.box(0, 46, canvas.width, canvas.height, TEAL)
    for i in range(7):
        y, ink = 54 + 22 * i, BRIGHT[(3 * i + i // 2) % 5]
        if i % 3 == 1:
            canvas.box(0, y, canvas.width, y + 5, ink)
            continue
        for k in range(6):
            x = (k + 0.5 * (i % 2) + 0.25) * canvas.width / 6
            (canvas.disc if (k * k + i) % 3 else canvas.star)(x, y + 4, 5 + (k + i) % 3, BRIGHT[(k * 3 + i) % 5])


def _handle(canvas: Canvas) -> None:
    """The handle: chevrons of changing colour and width, like wound tape."""
    canvas.box(0, 0, canvas.width, canvas.height, WOOD)
    middle, inks = canvas.width / 2, (CORAL, NIGHT, MUSTARD, CREAM, TEAL)
    y = -24.0
    for n, choice in enumerate((0, 1, 3, 2, 4, 0, 3, 1, 2, 0, 4, 3, 1, 0, 2, 4, 1, 3, 0, 2)):
        # Both ends of a chevron are at the same height, so that the pattern closes at the seam.
        thick = 9 + (n * n) % 13
        tip = [(0, y), (middle, y + 24), (canvas.width, y)]
        canvas.polygon([*tip, *[(x, below + thick) for x, below in reversed(tip)]], inks[choice])
        y += thick + 9
    for i in range(16):
        canvas.disc(10 + (i * 29) % (canvas.width - 20), 14 + 27 * i, 3.5, Ink(PAPER.rgb, 0.3))


def _knob(canvas: Canvas) -> None:
    """The lid's knob: wood with painted segments."""
    canvas.box(0, 0, canvas.width, canvas.height, WOOD)
    inks = (CORAL, BARK, CREAM, NIGHT, MUSTARD, BARK, TEAL)
    for i, ink in enumerate(inks):
        left = i * canvas.width / len(inks)
        canvas.box(left, 0, left + canvas.width / 9, 64, ink)
        canvas.disc(left + canvas.width / 18, 74, 3 + i % 3, ink)
    canvas.box(0, 84, canvas.width, 90, BARK)
    canvas.box(0, 108, canvas.width, canvas.height, MUSTARD)
