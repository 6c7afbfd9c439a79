"""Suns of a sky: the strongest small sources become directional lights, and the rest of the sky remains.

A sun is a connected bright region on a grid of cells, each the mean of the picture over its solid angle. The criterion
is independent of the picture's resolution and exposure. A region grows in order of falling radiance while its spread
stays within that of a disc of `WIDEST` degrees. The radiance at which it would grow wider is its surroundings, and the
radiance above is its excess. A region is a sun if its excess is at least `SMALLEST_SHARE` of the sky's energy. Smooth
skies and wide windows have little excess.

A sun takes the excess of each of its cells in the colour of the cell, and the remaining energy is spread evenly over
the pixels of the cell. The suns and the rest therefore have the energy of the sky exactly, channel by channel.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from formats.scene.lights import DirectionalLight
from prt_bake.lights.lighting import Lighting, Sky
from prt_bake.lights.skies.bright_sources import BrightSource, find_bright_sources
from prt_bake.mathematics.box_filter import box_filter, zone

Array = NDArray[np.float64]

MOST_SUNS = 8
SMALLEST_SHARE = 0.02
"""Of the sky's energy. A light with the share s changes the radiance from nine coefficients by at most this share."""
WIDEST = 12.0
"""Diameter of the widest sun, degrees."""
_CELLS = (128, 256)


@dataclass(frozen=True, eq=False)
class SplitSky:
    """The suns of a sky, strongest first, in object space, and the rest of the sky (the same object without suns).

    shares: each sun's share of the sky's energy (radiance over the sphere, mean over channels).
    """

    suns: tuple[DirectionalLight, ...]
    rest: Sky
    shares: tuple[float, ...]


def split_lighting(lighting: Lighting) -> Lighting:
    """The lighting with the suns of its skies as additional directional lights."""
    parts = [split_suns(sky) for sky in lighting.skies]
    suns = tuple(sun for part in parts for sun in part.suns)
    return replace(lighting, skies=tuple(part.rest for part in parts), suns=lighting.suns + suns) if suns else lighting


def split_suns(sky: Sky) -> SplitSky:
    """Take at most `MOST_SUNS` suns out of a sky.

    The direction of a sun is the mean direction of its energy. Its angular diameter is that of the uniform disc with
    the same spread. The picture is copied only if there is a sun. A picture with texels wider than a sun has none.
    """
    grid = _grid_of(sky.image)
    energy = float((grid.grey * grid.solid_angle).sum())
    if not energy > 0.0:
        return SplitSky((), sky, ())
    spread = math.sin(0.25 * math.radians(WIDEST)) ** 2
    bright = find_bright_sources(grid.grey, grid.solid_angle, grid.direction, spread, SMALLEST_SHARE * energy)
    if not bright:
        return SplitSky((), sky, ())
    bright.sort(key=lambda source: (-source.excess, int(source.cells[0])))
    rest = np.array(sky.image, np.float32)
    suns = tuple(_take(rest, sky.image, grid, source, sky.to_object) for source in bright[:MOST_SUNS])
    shares = tuple(float(sun.irradiance.mean()) / energy for sun in suns)
    return SplitSky(suns, replace(sky, image=rest), shares)


@dataclass(frozen=True)
class _Grid:
    """Means of a picture over cells: grey, solid_angle [R,C] and the mean direction [R,C,3] (shorter than 1).

    Directions are in the polar frame. rows [H], columns [W]: the cell of each pixel's centre.
    """

    grey: Array
    solid_angle: Array
    direction: Array
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]


def _grid_of(image: NDArray[np.float32]) -> _Grid:
    height, width = image.shape[:2]
    rows, columns = min(height, _CELLS[0]), min(width, _CELLS[1])
    across = box_filter(width, columns, np.subtract)
    grey = np.stack([across @ line for line in _zone_means(image, rows)])
    direction, solid_angle = _cell_directions(np.arange(rows), np.arange(columns), (rows, columns))
    return _Grid(
        grey,
        solid_angle,
        direction,
        ((np.arange(height) + 0.5) * rows / height).astype(np.int64),
        ((np.arange(width) + 0.5) * columns / width).astype(np.int64),
    )


def _zone_means(image: NDArray[np.float32], rows: int) -> Iterator[Array]:
    """The mean of an image [H,W,3] over each of `rows` zones and over channels [W]."""
    height, width = image.shape[:2]
    down = box_filter(height, rows, zone)
    for row in range(rows):
        overlapping = slice(row * height // rows, -(-(row + 1) * height // rows))
        shares = down[[row], overlapping].toarray()
        # Rows are summed before channels: along memory.
        line = shares @ image[overlapping].reshape(-1, 3 * width).astype(np.float64)
        yield line.reshape(width, 3).mean(axis=1)


def _cell_directions(
    rows: NDArray[np.int64], columns: NDArray[np.int64], shape: tuple[int, int]
) -> tuple[Array, Array]:
    """Mean direction [r,c,3] (∫ ω dω over solid angle, polar frame) and solid angle [r,c] of the cells of a grid."""
    top, bottom = math.pi * rows / shape[0], math.pi * (rows + 1) / shape[0]
    half = math.pi / shape[1]
    phi = 2.0 * math.pi * ((columns + 0.5) / shape[1] - 0.5)
    fall = 2.0 * np.sin(0.5 * (top + bottom)) * np.sin(0.5 * (bottom - top))  # cos(top) − cos(bottom)
    # ∫ sin²θ dθ and ∫ sinθ cosθ dθ
    across = 0.5 * (bottom - top) - 0.5 * np.cos(top + bottom) * np.sin(bottom - top)
    along = 0.5 * np.sin(top + bottom) * np.sin(bottom - top)
    solid_angle = np.repeat((2.0 * half * fall)[:, None], len(columns), axis=1)
    chord = math.sin(half) / half
    sideways = (across / fall * chord)[:, None]
    upward = np.repeat((along / fall)[:, None], len(columns), axis=1)
    return np.stack([sideways * np.cos(phi), sideways * np.sin(phi), upward], axis=2), solid_angle


def _take(
    rest: NDArray[np.float32], image: NDArray[np.float32], grid: _Grid, source: BrightSource, to_object: Array
) -> DirectionalLight:
    """Take the excess of a bright source out of `rest` [H,W,3], and return it as a light."""
    irradiance, moment, places = np.zeros(3), np.zeros(3), []
    for row in np.unique(source.cells // grid.grey.shape[1]):
        pixel_rows = np.flatnonzero(grid.rows == row)
        for column in source.cells[source.cells // grid.grey.shape[1] == row] % grid.grey.shape[1]:
            pixel_columns = np.flatnonzero(grid.columns == column)
            direction, solid_angle = _cell_directions(pixel_rows, pixel_columns, image.shape[:2])
            pixels = np.ix_(pixel_rows, pixel_columns)
            places.append(pixels)
            radiance = image[pixels].astype(np.float64)
            share = min(1.0, source.level / grid.grey[row, column])
            rest[pixels] = share * np.einsum("rc,rck->k", solid_angle, radiance) / solid_angle.sum()
            taken = solid_angle[..., None] * (radiance - rest[pixels])
            irradiance += taken.sum(axis=(0, 1))
            moment += np.einsum("rc,rck->k", taken.mean(axis=2), direction)
    length = float(np.linalg.norm(moment))
    mean = length / float(irradiance.mean())
    negative = irradiance < 0.0  # of colours outside Rec.709; no light has less than none, so the sky keeps it
    for pixels in places if negative.any() else []:
        rest[pixels] = np.where(negative, image[pixels], rest[pixels])
    # The mean direction of a uniform disc with the cosine c at its rim has the length (1 + c) / 2.
    diameter = 2.0 * math.degrees(math.acos(min(1.0, max(-1.0, 2.0 * mean - 1.0))))
    return DirectionalLight(to_object @ moment / length, np.maximum(irradiance, 0.0), diameter)
