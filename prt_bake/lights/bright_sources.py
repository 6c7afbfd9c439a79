"""Small bright regions of a function on a lat-long grid: floods that start at its peaks, brightest cells first."""

import heapq
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Region:
    """Cells [N] (row · columns + column, ascending) above `level`; excess: Σ (value − level) · solid angle."""

    cells: NDArray[np.int64]
    level: float
    excess: float


def small_regions(values: Array, solid_angle: Array, direction: Array, widest: float, least: float) -> list[Region]:
    """The regions of values [R,C] that are as large as they can be and spread no further than `widest`, of an excess of
    `least` > 0 or more, by falling peaks.

    A region is a connected part of what is above a level; its spread is 1 − |its mean direction|, by solid angle [R,C]
    and the cells' own mean directions [R,C,3]. Its level is the lowest at which it is not too wide. Cells that share an
    edge or a corner touch, columns wrap around, and those about a pole all touch.
    """
    grid = _Grid(values, solid_angle, direction)
    # The widest region is a cap, of the solid angle 4π · widest.
    high = np.flatnonzero(grid.values * (4.0 * math.pi * widest) >= least)
    found: list[Region] = []
    taken: set[int] = set()
    for peak in high[np.argsort(-grid.values[high], kind="stable")].tolist():
        if peak in taken or not grid.is_peak(peak):
            continue
        cells, level = _flood(grid, peak, widest)
        excess = float(((grid.values[cells] - level) * grid.solid_angle[cells]).sum())
        if excess >= least:
            found.append(Region(np.sort(cells), level, excess))
            taken.update(cells.tolist())
    return found


class _Grid:
    def __init__(self, values: Array, solid_angle: Array, direction: Array) -> None:
        self.rows, self.columns = values.shape
        self.values, self.solid_angle = values.ravel(), solid_angle.ravel()
        self.moments = direction.reshape(-1, 3) * self.solid_angle[:, None]

    def is_peak(self, cell: int) -> bool:
        """Whether no neighbour is brighter, or as bright and earlier: one cell of a level place is enough."""
        here = self.values[cell]
        return not any((self.values[near], -near) > (here, -cell) for near in self.neighbours(cell))

    def neighbours(self, cell: int) -> list[int]:
        row, column = divmod(cell, self.columns)
        near = [
            r * self.columns + c % self.columns
            for r in (row - 1, row, row + 1)
            if 0 <= r < self.rows
            for c in (column - 1, column, column + 1)
        ]
        if row in (0, self.rows - 1):
            near += range(row * self.columns, (row + 1) * self.columns)
        return near


def _flood(grid: _Grid, peak: int, widest: float) -> tuple[NDArray[np.int64], float]:
    """The cells about a peak above the level at which they spread too far, and that level (the least value of all where
    they never do).
    """
    level = float(grid.values[peak])
    cells: list[int] = []
    above = 0  # of the cells, how many are above the level
    seen, rim = {peak}, [(-level, peak)]
    moment, area = np.zeros(3), 0.0
    while rim:
        negative, cell = heapq.heappop(rim)
        if -negative < level:
            level, above = -negative, len(cells)
        cells.append(cell)
        moment, area = moment + grid.moments[cell], area + float(grid.solid_angle[cell])
        if 1.0 - math.sqrt(float(moment @ moment)) / area > widest:
            return np.array(cells[:above], np.int64), level
        for near in grid.neighbours(cell):
            if near not in seen:
                seen.add(near)
                heapq.heappush(rim, (-float(grid.values[near]), near))
    return np.array(cells, np.int64), level
