"""A picture sheet: rows of small pictures under headings, with captions, a table above and wide strips below.

A *tile* is one picture with its caption; a *group* is a run of columns under one heading. All pictures are sRGB code
values; everything is drawn with the font that comes with Pillow, so a sheet looks the same on every machine.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image, ImageDraw, ImageFont

PAGE, PANEL, TEXT, FAINT = (22, 24, 29), (43, 46, 54), (236, 238, 242), (150, 156, 168)
"""Colours of the page, of empty places, of words and of lesser words."""
SIDE, GAP, CAPTION = 144, 4, 20
"""Side of a tile, space between tiles, height of the caption under a tile [pixels]."""
MARGIN, LABEL, GROUP_GAP, LINE, LEAST_WIDTH = 24, 104, 20, 24, 1200
"""Space around the page, width of the row labels, space between groups, height of a line of words, and the width of
a page with little on it [pixels]."""


@dataclass(frozen=True)
class Tile:
    """One picture and what stands under it."""

    pixels: UInt8[np.ndarray, "h w 3"] | None
    """None draws an empty place."""
    caption: str = ""


@dataclass(frozen=True)
class Group:
    """A run of columns under one heading."""

    heading: str
    columns: tuple[str, ...]
    scale: str = ""
    """Where the colours of `heat` end, when the last column shows it: a colour bar from 0 to here is drawn."""


@dataclass(frozen=True)
class Sheet:
    """What a sheet shows, from top to bottom."""

    title: str
    subtitle: str
    table: Sequence[Sequence[str]]
    """Rows of equal length; the first is the heading, the first column names the rows."""
    groups: Sequence[Group]
    rows: Sequence[tuple[str, Sequence[Tile]]]
    """Each with its label, of which a line break makes two lines, and one tile per column."""
    strips: Sequence[Tile] = ()
    """Wide pictures side by side under the rows, twice as wide as high."""
    remarks: Sequence[str] = ()
    """Lines to the right of the strips."""
    notes: Sequence[str] = ()
    """Lines at the foot."""


def heat(error: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"], top: float) -> UInt8[np.ndarray, "h w 3"]:
    """An error map from black (0) through red and yellow to near white (`top` and above); grey off the mask."""
    values = (np.clip(error / top, 0, 1) * 255).round().astype(np.uint8)
    colours = cv2.applyColorMap(values, cv2.COLORMAP_INFERNO)[..., ::-1]
    return np.where(mask[..., None], colours, np.array(PANEL)).astype(np.uint8)


def draw(sheet: Sheet) -> UInt8[np.ndarray, "h w 3"]:
    """The sheet as a picture."""
    starts = _column_starts(sheet.groups)
    strips_end = MARGIN + LABEL + len(sheet.strips) * (2 * SIDE + GROUP_GAP)
    width = max(starts[-1] + SIDE if starts else 0, strips_end, LEAST_WIDTH)
    tallest = (len(sheet.rows) + 2) * (SIDE + CAPTION + GAP) + (len(sheet.table) + len(sheet.notes) + 12) * LINE
    page = Image.new("RGB", (width + MARGIN, tallest), PAGE)
    pen = ImageDraw.Draw(page)
    y = _draw_head(pen, sheet)
    y = _draw_table(pen, sheet.table, y, width)
    y = _draw_rows(page, pen, sheet, starts, y)
    y = _draw_foot(page, pen, sheet, y)
    for note in sheet.notes:
        pen.text((MARGIN, y), note, FAINT, _font(14))
        y += LINE
    return np.asarray(page.crop((0, 0, page.width, y + MARGIN // 2)))


def _column_starts(groups: Sequence[Group]) -> list[int]:
    starts, x = [], MARGIN + LABEL
    for group in groups:
        starts += [x + i * (SIDE + GAP) for i in range(len(group.columns))]
        x += len(group.columns) * (SIDE + GAP) + GROUP_GAP
    return starts


def _draw_head(pen: ImageDraw.ImageDraw, sheet: Sheet) -> int:
    pen.text((MARGIN, MARGIN - 6), sheet.title, TEXT, _font(24))
    pen.text((MARGIN, MARGIN + LINE + 6), sheet.subtitle, FAINT, _font(15))
    return MARGIN + 2 * LINE + 20


def _draw_table(pen: ImageDraw.ImageDraw, table: Sequence[Sequence[str]], top: int, width: int) -> int:
    for number, row in enumerate(table):
        step = min(220, (width - MARGIN - LABEL) // max(1, len(row) - 1))
        for column, word in enumerate(row):
            x = MARGIN if column == 0 else MARGIN + LABEL + (column - 1) * step
            faint = number == 0 or column == 0
            pen.text((x, top + number * LINE), word, FAINT if faint else TEXT, _font(14 if faint else 16))
    return top + len(table) * LINE + 20


def _draw_rows(page: Image.Image, pen: ImageDraw.ImageDraw, sheet: Sheet, starts: list[int], top: int) -> int:
    if not sheet.rows:
        return top
    column = 0
    for group in sheet.groups:
        pen.text((starts[column], top), group.heading, TEXT, _font(17))
        for name in group.columns:
            pen.text((starts[column], top + LINE), name, FAINT, _font(14))
            column += 1
        if group.scale:
            _draw_scale(page, pen, group.scale, (starts[column - 1], top + LINE))
    top += 2 * LINE
    for label, tiles in sheet.rows:
        pen.multiline_text((MARGIN, top + SIDE // 2 - 18), label, TEXT, _font(15), spacing=6)
        for x, tile in zip(starts, tiles, strict=True):
            _draw_tile(page, pen, tile, (x, top), (SIDE, SIDE))
        top += SIDE + CAPTION + GAP
    return top + 12


def _draw_scale(page: Image.Image, pen: ImageDraw.ImageDraw, end: str, corner: tuple[int, int]) -> None:
    """The colour bar of `heat`, from 0 to `end`, at the right of a column's heading."""
    x, y = corner
    left, right = x + 52, x + SIDE - 6 - int(pen.textlength(end, _font(13)))
    bar = np.tile(np.linspace(0, 1, right - left), (8, 1))
    page.paste(Image.fromarray(heat(bar, np.full(bar.shape, True), 1.0)), (left, y + 6))
    pen.text((left - 11, y + 1), "0", FAINT, _font(13))
    pen.text((right + 4, y + 1), end, FAINT, _font(13))


def _draw_foot(page: Image.Image, pen: ImageDraw.ImageDraw, sheet: Sheet, top: int) -> int:
    x = MARGIN + LABEL
    for tile in sheet.strips:
        _draw_tile(page, pen, tile, (x, top), (2 * SIDE, SIDE))
        x += 2 * SIDE + GROUP_GAP
    for number, remark in enumerate(sheet.remarks):
        pen.text((x, top + number * LINE), remark, FAINT if number else TEXT, _font(15))
    tallest = max(SIDE + CAPTION if sheet.strips else 0, len(sheet.remarks) * LINE)
    return top + tallest + 16 if tallest else top


def _draw_tile(
    page: Image.Image, pen: ImageDraw.ImageDraw, tile: Tile, corner: tuple[int, int], size: tuple[int, int]
) -> None:
    x, y = corner
    pen.rectangle((x, y, x + size[0] - 1, y + size[1] - 1), PANEL if tile.pixels is None else (0, 0, 0))
    if tile.pixels is None:
        pen.text((x + size[0] // 2, y + size[1] // 2), "absent", FAINT, _font(14), anchor="mm")
    else:
        picture = Image.fromarray(tile.pixels)
        factor = min(size[0] / picture.width, size[1] / picture.height)
        fitted = (max(1, round(picture.width * factor)), max(1, round(picture.height * factor)))
        how = Image.Resampling.LANCZOS if factor < 1 else Image.Resampling.NEAREST
        page.paste(picture.resize(fitted, how), (x + (size[0] - fitted[0]) // 2, y + (size[1] - fitted[1]) // 2))
    pen.text((x, y + size[1] + 2), tile.caption, FAINT, _font(13))


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
