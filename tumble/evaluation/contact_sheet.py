"""Contact sheet: rows of small images with captions under column headings, a table above them, wide strips below.

A *tile* is one image with its caption; a *group* is a set of neighbouring columns under one heading. All images are
8-bit sRGB. All text uses the font that comes with Pillow, so a sheet is the same on every machine.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image, ImageDraw, ImageFont

PAGE_COLOUR = (22, 24, 29)
"""Background of the sheet [sRGB]."""
PANEL_COLOUR = (43, 46, 54)
"""Background of tiles without an image, and of error maps outside the mask [sRGB]."""
TEXT_COLOUR = (236, 238, 242)
"""Colour of titles, labels and values [sRGB]."""
MUTED_COLOUR = (150, 156, 168)
"""Colour of captions, column headings and notes [sRGB]."""
TILE_SIDE = 144
"""Side of a tile [pixels]."""
TILE_GAP = 4
"""Space between tiles [pixels]."""
CAPTION_HEIGHT = 20
"""Height of the caption under a tile [pixels]."""
MARGIN = 24
"""Space around the content of the sheet [pixels]."""
LABEL_WIDTH = 104
"""Width of the row labels, left of the first column [pixels]."""
GROUP_GAP = 20
"""Space between groups of columns [pixels]."""
LINE_HEIGHT = 24
"""Height of one line of text [pixels]."""
MIN_WIDTH = 1200
"""Minimum width of a sheet, so that the table fits even if there are few columns of tiles [pixels]."""


@dataclass(frozen=True)
class Tile:
    """One image and the caption under it."""

    pixels: UInt8[np.ndarray, "h w 3"] | None
    """sRGB; None draws an empty tile labelled "absent"."""
    caption: str = ""


@dataclass(frozen=True)
class Group:
    """Neighbouring columns under one heading."""

    heading: str
    columns: tuple[str, ...]
    max_label: str = ""
    """Text at the end of a colour bar from 0 to the maximum error, above the last column; "" draws no bar."""


@dataclass(frozen=True)
class Sheet:
    """Content of a sheet, from top to bottom."""

    title: str
    subtitle: str
    table: Sequence[Sequence[str]]
    """Rows of equal length. The first row is the heading, the first column holds the row names."""
    groups: Sequence[Group]
    rows: Sequence[tuple[str, Sequence[Tile]]]
    """Label (two lines if it contains a line break) and tiles, one per column."""
    strips: Sequence[Tile] = ()
    """Wide images side by side under the rows, twice as wide as high."""
    remarks: Sequence[str] = ()
    """Lines of text to the right of the strips."""
    notes: Sequence[str] = ()
    """Lines of text at the bottom."""


def heat_map(error: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"], top: float) -> UInt8[np.ndarray, "h w 3"]:
    """Error map in colours: black (0), red, yellow, near white (`top` and above); `PANEL_COLOUR` outside the mask."""
    values = (np.clip(error / top, 0, 1) * 255).round().astype(np.uint8)
    colours = cv2.applyColorMap(values, cv2.COLORMAP_INFERNO)[..., ::-1]
    return np.where(mask[..., None], colours, np.array(PANEL_COLOUR)).astype(np.uint8)


def draw(sheet: Sheet) -> UInt8[np.ndarray, "h w 3"]:
    """The sheet as an sRGB image."""
    starts = _column_starts(sheet.groups)
    strips_end = MARGIN + LABEL_WIDTH + len(sheet.strips) * (2 * TILE_SIDE + GROUP_GAP)
    width = max(starts[-1] + TILE_SIDE if starts else 0, strips_end, MIN_WIDTH)
    max_height = (len(sheet.rows) + 2) * (TILE_SIDE + CAPTION_HEIGHT + TILE_GAP) + (
        len(sheet.table) + len(sheet.notes) + 12
    ) * LINE_HEIGHT
    page = Image.new("RGB", (width + MARGIN, max_height), PAGE_COLOUR)
    pen = ImageDraw.Draw(page)
    y = _draw_head(pen, sheet)
    y = _draw_table(pen, sheet.table, y, width)
    y = _draw_rows(page, pen, sheet, starts, y)
    y = _draw_foot(page, pen, sheet, y)
    for note in sheet.notes:
        pen.text((MARGIN, y), note, MUTED_COLOUR, _font(14))
        y += LINE_HEIGHT
    return np.asarray(page.crop((0, 0, page.width, y + MARGIN // 2)))


def _column_starts(groups: Sequence[Group]) -> list[int]:
    starts, x = [], MARGIN + LABEL_WIDTH
    for group in groups:
        starts += [x + i * (TILE_SIDE + TILE_GAP) for i in range(len(group.columns))]
        x += len(group.columns) * (TILE_SIDE + TILE_GAP) + GROUP_GAP
    return starts


def _draw_head(pen: ImageDraw.ImageDraw, sheet: Sheet) -> int:
    pen.text((MARGIN, MARGIN - 6), sheet.title, TEXT_COLOUR, _font(24))
    pen.text((MARGIN, MARGIN + LINE_HEIGHT + 6), sheet.subtitle, MUTED_COLOUR, _font(15))
    return MARGIN + 2 * LINE_HEIGHT + 20


def _draw_table(pen: ImageDraw.ImageDraw, table: Sequence[Sequence[str]], top: int, width: int) -> int:
    for number, row in enumerate(table):
        step = min(220, (width - MARGIN - LABEL_WIDTH) // max(1, len(row) - 1))
        for column, cell in enumerate(row):
            x = MARGIN if column == 0 else MARGIN + LABEL_WIDTH + (column - 1) * step
            muted = number == 0 or column == 0
            pen.text(
                (x, top + number * LINE_HEIGHT),
                cell,
                MUTED_COLOUR if muted else TEXT_COLOUR,
                _font(14 if muted else 16),
            )
    return top + len(table) * LINE_HEIGHT + 20


def _draw_rows(page: Image.Image, pen: ImageDraw.ImageDraw, sheet: Sheet, starts: list[int], top: int) -> int:
    if not sheet.rows:
        return top
    column = 0
    for group in sheet.groups:
        pen.text((starts[column], top), group.heading, TEXT_COLOUR, _font(17))
        for name in group.columns:
            pen.text((starts[column], top + LINE_HEIGHT), name, MUTED_COLOUR, _font(14))
            column += 1
        if group.max_label:
            _draw_colour_bar(page, pen, group.max_label, (starts[column - 1], top + LINE_HEIGHT))
    top += 2 * LINE_HEIGHT
    for label, tiles in sheet.rows:
        pen.multiline_text((MARGIN, top + TILE_SIDE // 2 - 18), label, TEXT_COLOUR, _font(15), spacing=6)
        for x, tile in zip(starts, tiles, strict=True):
            _draw_tile(page, pen, tile, (x, top), (TILE_SIDE, TILE_SIDE))
        top += TILE_SIDE + CAPTION_HEIGHT + TILE_GAP
    return top + 12


def _draw_colour_bar(page: Image.Image, pen: ImageDraw.ImageDraw, max_label: str, corner: tuple[int, int]) -> None:
    """Draw the colour bar of `heat_map`, from 0 to `max_label`, to the right of a column's heading."""
    x, y = corner
    left, right = x + 52, x + TILE_SIDE - 6 - int(pen.textlength(max_label, _font(13)))
    bar = np.tile(np.linspace(0, 1, right - left), (8, 1))
    page.paste(Image.fromarray(heat_map(bar, np.full(bar.shape, True), 1.0)), (left, y + 6))
    pen.text((left - 11, y + 1), "0", MUTED_COLOUR, _font(13))
    pen.text((right + 4, y + 1), max_label, MUTED_COLOUR, _font(13))


def _draw_foot(page: Image.Image, pen: ImageDraw.ImageDraw, sheet: Sheet, top: int) -> int:
    x = MARGIN + LABEL_WIDTH
    for tile in sheet.strips:
        _draw_tile(page, pen, tile, (x, top), (2 * TILE_SIDE, TILE_SIDE))
        x += 2 * TILE_SIDE + GROUP_GAP
    for number, remark in enumerate(sheet.remarks):
        pen.text((x, top + number * LINE_HEIGHT), remark, MUTED_COLOUR if number else TEXT_COLOUR, _font(15))
    height = max(TILE_SIDE + CAPTION_HEIGHT if sheet.strips else 0, len(sheet.remarks) * LINE_HEIGHT)
    return top + height + 16 if height else top


def _draw_tile(
    page: Image.Image, pen: ImageDraw.ImageDraw, tile: Tile, corner: tuple[int, int], size: tuple[int, int]
) -> None:
    x, y = corner
    pen.rectangle((x, y, x + size[0] - 1, y + size[1] - 1), PANEL_COLOUR if tile.pixels is None else (0, 0, 0))
    if tile.pixels is None:
        pen.text((x + size[0] // 2, y + size[1] // 2), "absent", MUTED_COLOUR, _font(14), anchor="mm")
    else:
        image = Image.fromarray(tile.pixels)
        factor = min(size[0] / image.width, size[1] / image.height)
        fitted = (max(1, round(image.width * factor)), max(1, round(image.height * factor)))
        resampling = Image.Resampling.LANCZOS if factor < 1 else Image.Resampling.NEAREST
        page.paste(image.resize(fitted, resampling), (x + (size[0] - fitted[0]) // 2, y + (size[1] - fitted[1]) // 2))
    pen.text((x, y + size[1] + 2), tile.caption, MUTED_COLOUR, _font(13))


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
