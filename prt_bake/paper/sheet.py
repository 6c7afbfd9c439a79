"""A sheet of pictures: a row per scene and sky, each picture above its FLIP map."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from formats.atomic import replacing
from formats.extras import require
from formats.image.png import to_srgb

CELL = 192
"""Width and height of a picture on the sheet, in pixels."""
_GAP, _LABEL, _LEFT, _HEAD = 6, 18, 26, 24
PAPER, INK = (24, 24, 24), (235, 235, 235)


@dataclass(frozen=True)
class Tile:
    """A picture [H,W,3] in linear radiance, its FLIP map [H,W] (or none), and a label."""

    image: NDArray[np.floating]
    flip_map: NDArray[np.floating] | None
    label: str


@dataclass(frozen=True)
class Row:
    """Pictures of one scene under one sky, exposed by `stops`."""

    title: str
    stops: float
    tiles: tuple[Tile | None, ...]


def write_sheet(path: Path, columns: Sequence[str], rows: Sequence[Row]) -> None:
    """Write the sheet as PNG; `columns` are the titles of the tiles; a tile that is None stays empty.

    FLIP maps use magma from 0 to 1. Raises PrtbakeError if the extra `evaluate` is not installed.
    """
    width = _LEFT + len(columns) * (CELL + _GAP)
    height = _HEAD + len(rows) * (2 * CELL + _LABEL + _GAP)
    sheet = Image.new("RGB", (width, height), PAPER)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(13)
    for j, name in enumerate(columns):
        draw.text((_LEFT + j * (CELL + _GAP), 5), name, INK, font)
    for i, row in enumerate(rows):
        top = _HEAD + i * (2 * CELL + _LABEL + _GAP)
        sheet.paste(_upright(row.title, 2 * CELL, font), (3, top + _LABEL))
        for j, tile in enumerate(row.tiles):
            if tile is None:
                continue
            left = _LEFT + j * (CELL + _GAP)
            draw.text((left, top + 1), tile.label, INK, font)
            sheet.paste(resized(encoded(tile.image, row.stops)), (left, top + _LABEL))
            if tile.flip_map is not None:
                sheet.paste(resized(coloured(tile.flip_map)), (left, top + _LABEL + CELL))
    with replacing(path) as part:
        sheet.save(part, format="PNG", optimize=True)


def encoded(image: NDArray[np.floating], stops: float) -> NDArray[np.uint8]:
    """Return linear radiance [H,W,3], exposed by `stops`, as 8-bit sRGB."""
    return np.rint(255.0 * to_srgb(np.asarray(image, np.float64) * 2.0**stops)).astype(np.uint8)


def coloured(values: NDArray[np.floating], largest: float = 1.0, name: str = "magma") -> NDArray[np.uint8]:
    """Return values [H,W] from 0 to `largest` in a colour map of matplotlib, [H,W,3]."""
    require("report", "matplotlib")
    from matplotlib import colormaps

    colours = colormaps[name](np.clip(np.asarray(values, np.float64) / largest, 0.0, 1.0))
    return np.rint(255.0 * colours[..., :3]).astype(np.uint8)


def resized(pixels: NDArray[np.uint8]) -> Image.Image:
    """Resize to a cell: box filter for larger pictures, nearest pixel for smaller ones."""
    picture = Image.fromarray(pixels)
    larger = pixels.shape[0] > CELL
    return picture.resize((CELL, CELL), Image.Resampling.BOX if larger else Image.Resampling.NEAREST)


def _upright(text: str, length: int, font: ImageFont.FreeTypeFont | ImageFont.ImageFont) -> Image.Image:
    """Return a line of text rotated by 90°."""
    strip = Image.new("RGB", (length, _LABEL), PAPER)
    draw = ImageDraw.Draw(strip)
    draw.text(((length - draw.textlength(text, font)) / 2.0, 1), text, INK, font)
    return strip.transpose(Image.Transpose.ROTATE_90)
